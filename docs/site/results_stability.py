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
# A pair of task and algorithm learns on a version if success in some part of its trainings is above this rate, %.
LEARNED = 5
# The number of parts of a training, and so of points of a curve.
POINTS = 100


def curves():
    """Return the points of each training curve by task, algorithm and training version."""
    found = defaultdict(list)
    with CURVES.open() as file:
        for row in csv.DictReader(file):
            assert (row["runs"], row["by"]) == (str(len(CLEAN)), "episodes"), row
            numbers = {name: float(row[name]) for name in row if name.endswith(("_mean", "_std"))}
            found[row["environment"], row["algorithm"], row["train"]].append(numbers)
    assert {len(points) for points in found.values()} == {POINTS}
    return found


def counted(count, pairs):
    """Return a count in words, and the probability of at least as many heads in `pairs` throws of a coin, %."""
    tail = sum(math.comb(pairs, heads) for heads in range(count, pairs + 1)) / 2**pairs
    return NUMBER_WORDS[count], 100 * tail


def second_half(found):
    """Return for how many pairs success varies less on R than on D in the second half of the trainings.

    Check that on CartPole the return of A2C and PPO varies less on E than on D in the last tenth.
    """

    def spread_of(task, name, version, quantity, first):
        return fmean(point[f"{quantity}_std"] for point in found[task, name, version][first:])

    for name in ("a2c", "ppo"):
        on_d, on_e = (spread_of("CartPole", name, version, "return", -POINTS // 10) for version in "DE")
        assert on_e < on_d, f"{name}: {on_d} on D, {on_e} on E"
    learned = [(task, name) for task, name, version in found if version == "D" and learns(found[task, name, "D"])]
    halves = [[spread_of(*pair, version, "success", POINTS // 2) for version in "DR"] for pair in learned]
    return sum(on_r < on_d for on_d, on_r in halves)


def learns(points):
    """Return whether a training learns the task."""
    return max(point["success_mean"] for point in points) > LEARNED


def during_training():
    """Return the rows and counts of the section on training curves."""
    found, texts = curves(), []
    steadier, pairs = defaultdict(int), defaultdict(int)
    for task in ENVIRONMENTS:
        for name in ALGORITHMS:
            points = {version: found[task, name, version] for version in "DRE" if (task, name, version) in found}
            if not points:  # this pair was not trained
                continue
            fields = []
            for quantity in ("return", "success"):
                spreads = {
                    version: fmean(point[f"{quantity}_std"] for point in each) for version, each in points.items()
                }
                fields += map(fixed, spreads.values())
                for version in "RE":
                    comparable = learns(points["D"]) and learns(points[version])
                    pairs[version] += comparable and quantity == "return"
                    steadier[quantity, version] += comparable and spreads[version] < spreads["D"]
            texts.append(f"| {task} | {NAMES[name]} | " + " | ".join(fields) + " |")
    for version in "RE":
        count, tail = counted(steadier["return", version], pairs[version])
        total, others = NUMBER_WORDS[pairs[version]], NUMBER_WORDS[steadier["success", version]]
        less = {"R": "the return varies less on R than on D", "E": "less on E than on D"}[version]
        success = {"R": f"Success varies less on R in all {others} pairs", "E": f"and on E in {others}"}[version]
        texts += [
            f"in {count} of {total} pairs {less}",
            success,
            fill(f"at least {count} of {total} would have a probability of {{:.0f}} %", tail),
        ]
    every, half = NUMBER_WORDS[pairs["R"]], NUMBER_WORDS[second_half(found)]
    texts.append(f"In the second half of the trainings alone, it varies less on R in {half} of {every}")
    texts.append(fill(f"{every} of {every} would have a probability of {{:.1f}} %", 100 / 2 ** pairs["R"]))
    assert steadier["success", "R"] == pairs["R"]
    return texts


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
    for cell in studies.finished("questions/stability"):
        if cell.trained_on != "E":  # questions/findings has the same training
            wanted = {name: getattr(cell, name) for name in ("environment", "algorithm", "trained_on", "seed")}
            (same,) = studies.finished("questions/findings", **wanted)
            assert same.tests == cell.tests, f"{cell.cell} has other results in questions/findings"
    done, _ = studies.planned("questions/stability")
    return [f"{done} of 180 trainings are finished", *during_training(), *final_policies(studies)]
