"""The numbers of docs/findings/stability.md, from the training curves and from the results table."""

import csv
import math
from collections import defaultdict
from pathlib import Path
from statistics import fmean

from results_numbers import ENVIRONMENTS, std
from results_words import CLEAN, FF, NAMES, fill, fixed, spread

CURVES = Path("results/curves/questions-stability.csv")
ALGORITHMS = ("a2c", "ppo", "epopt-ppo")
NUMBER_WORDS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
# A pair of task and algorithm learns on D if the success in some part of its trainings on D is above this rate, %.
LEARNED = 5


def curves():
    """Return the points of each training curve by task, algorithm and training version."""
    found = defaultdict(list)
    with CURVES.open() as file:
        for row in csv.DictReader(file):
            assert int(row["runs"]) == len(CLEAN), row
            numbers = {name: float(row[name]) for name in row if name.endswith(("_mean", "_std"))}
            found[row["environment"], row["algorithm"], row["train"]].append(numbers)
    return found


def counted(count, pairs):
    """Return a count in words, and the probability of at least as many heads in `pairs` throws of a coin, %."""
    tail = sum(math.comb(pairs, heads) for heads in range(count, pairs + 1)) / 2**pairs
    return NUMBER_WORDS[count], 100 * tail


def during_training():
    """Return the rows and counts of the section on training curves."""
    found, texts = curves(), []
    steadier, pairs = defaultdict(int), 0
    for task in ENVIRONMENTS:
        for name in ALGORITHMS:
            points = {version: found[task, name, version] for version in "DRE"}
            fields = []
            for quantity in ("return", "success"):
                spreads = [fmean(point[f"{quantity}_std"] for point in each) for each in points.values()]
                fields += [fixed(number) for number in spreads]
                learned = max(point["success_mean"] for point in points["D"]) > LEARNED
                for version, number in zip("RE", spreads[1:], strict=True):
                    steadier[quantity, version] += learned and number < spreads[0]
            pairs += learned
            label = "" if learned else " (does not learn on D)"
            texts.append(f"| {task} | {NAMES[name]}{label} | " + " | ".join(fields) + " |")
    total = NUMBER_WORDS[pairs]
    return [
        *texts,
        f"{total} pairs of task and algorithm that learn on D",
        *(
            fill(f"{{}} of the {total} pairs vary less on {version} by {quantity} ({{:.0f}} %)", *counted(count, pairs))
            for (quantity, version), count in steadier.items()
        ),
    ]


def final_policies(studies):
    """Return the rows and counts of the section on final policies."""
    texts, gains = [], {}
    steadier = steadier_on_d = 0
    for task in ENVIRONMENTS:
        for name in FF:
            runs = {}
            for version in "DR":
                cells = studies.finished("questions/findings", environment=task, algorithm=name, trained_on=version)
                runs[version] = [cell for cell in cells if cell.seed in CLEAN]
                assert len(runs[version]) == len(CLEAN), f"{task}, {name}, {version}: {len(runs[version])} seeds"
            on_d, on_r, on_d_after_r = (
                [cell.success(tested) for cell in runs[trained]] for trained, tested in ("DD", "RR", "RD")
            )
            if not any(on_d):
                continue
            for each in (on_d, on_r, on_d_after_r):
                assert std(each) <= 30 or max(each) - min(each) > 50, f"{task}, {name}: {each}"
            steadier += std(on_r) < std(on_d)
            steadier_on_d += std(on_d_after_r) < std(on_d)
            gains[NAMES[name], task] = fmean(on_d_after_r) - fmean(on_d)
            row = [spread(on_d), spread(on_r), spread(on_d_after_r)]
            texts.append(f"| {task} | {NAMES[name]} | " + " | ".join(row) + " |")
    pairs = NUMBER_WORDS[len(gains)]
    left_out = len(ENVIRONMENTS) * len(FF) - len(gains)
    better = NUMBER_WORDS[sum(gain > 0 for gain in gains.values())]
    most, least = max(gains, key=gains.get), min(gains, key=gains.get)
    word, tail = counted(steadier, len(gains))
    return [
        *texts,
        f"{NUMBER_WORDS[left_out].capitalize()} of the {len(ENVIRONMENTS) * len(FF)} pairs of task and algorithm",
        fill(f"at least {word} of {pairs} would have a probability of {{:.0f}} %", tail),
        f"In {word} of the {pairs} pairs, the results on R vary less than those on D",
        f"those trained on R vary less in {NUMBER_WORDS[steadier_on_d]} of the {pairs} pairs",
        f"In {better} of the {pairs} pairs, policies trained on R have a higher",
        fill("largest gain is {:.1f} points ({} on {})", gains[most], *most),
        fill("largest loss is {:.1f} points ({} on {})", -gains[least], *least),
    ]


def stability(studies):
    """Return the texts with numbers that the page must contain."""
    return final_policies(studies)
