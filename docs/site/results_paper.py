"""The numbers of docs/findings/paper-items.md, from the results table."""

import math
from collections import Counter, defaultdict
from statistics import fmean

from results_numbers import ENVIRONMENTS, std
from results_words import CLEAN, FF, NAMES, fill, spread

# The studies that repeat the paper's methods with seeds that did not select a configuration.
STUDIES = ("classic-ff", "classic-rc", "questions/findings", "beyond/confirm-2", "locomotion")
SELECTION_SEED = 1
KINDS = ("five", "three", "fewer", "none")
NUMBER_WORDS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")


def seeds(studies):
    """Return how many seeds the study with the most seeds has for each number of the paper's tables of environments.

    The keys are environment, method and metric.
    """
    trained = defaultdict(set)
    for cell in studies.cells:
        if cell.study in STUDIES and not cell.failed and cell.seed != SELECTION_SEED:
            trained[cell.study, cell.environment, cell.method, cell.trained_on].add(cell.seed)
    found = {}
    for row in studies.paper_rows:
        if row["environment"] == "Average":
            continue
        trials = row["episodes_per_trial"]
        method = (row["algorithm"].lower(), row["architecture"].lower(), int(trials) if trials else None)
        counts = []
        for study in STUDIES:
            on_d, on_r = (trained[study, row["environment"], method, version] for version in "DR")
            needed = {"default": on_d, "interpolation": on_r, "extrapolation": on_d & on_r}[row["metric"]]
            counts.append(len(needed))
        found[row["environment"], method, row["metric"]] = max(counts)
    return found


def kind(count):
    return "five" if count >= 5 else "three" if count >= 3 else "fewer" if count else "none"


def paper_items(studies):
    """Return the texts with numbers that the page must contain."""
    known = seeds(studies)
    texts, total = [], Counter()
    for environment in (*ENVIRONMENTS, "Hopper", "HalfCheetah"):
        counts = Counter(kind(count) for key, count in known.items() if key[0] == environment)
        total += counts
        texts.append(f"| {environment} | " + " | ".join(str(counts[name]) for name in KINDS) + " |")
    texts.append("| all | " + " | ".join(str(total[name]) for name in KINDS) + " |")
    five, none = total["five"], total["none"]
    answer = [
        f"The paper has {len(known)} numbers for single environments",
        f"For {five} of them, studies of this project have at least five seeds, and for {none} of them no seed",
    ]
    return [*texts, *answer, *stability(studies)]


def stability(studies):
    """Return the rows and counts of the section on training with random physics."""
    texts, gains = [], {}
    steadier = steadier_on_d = 0
    for task in ENVIRONMENTS:
        for name in FF:
            runs = {}
            for version in "DR":
                cells = studies.finished("questions/findings", environment=task, algorithm=name, trained_on=version)
                runs[version] = sorted((cell for cell in cells if cell.seed in CLEAN), key=lambda cell: cell.seed)
                assert len(runs[version]) == len(CLEAN), f"{task}, {name}, {version}: {len(runs[version])} seeds"
            on_d, on_r, on_d_after_r = (
                [cell.success(tested) for cell in runs[trained]] for trained, tested in ("DD", "RR", "RD")
            )
            if not any(on_d):
                continue
            for runs in (on_d, on_r, on_d_after_r):
                assert std(runs) <= 30 or max(runs) - min(runs) > 50, f"{task}, {name}: {runs}"
            steadier += std(on_r) < std(on_d)
            steadier_on_d += std(on_d_after_r) < std(on_d)
            gains[NAMES[name], task] = fmean(on_d_after_r) - fmean(on_d)
            row = [spread(on_d), spread(on_r), spread(on_d_after_r)]
            texts.append(f"| {task} | {NAMES[name]} | " + " | ".join(row) + " |")
    pairs = NUMBER_WORDS[len(gains)]
    left_out = len(ENVIRONMENTS) * len(FF) - len(gains)
    tail = sum(math.comb(len(gains), count) for count in range(steadier, len(gains) + 1)) / 2 ** len(gains)
    better = NUMBER_WORDS[sum(gain > 0 for gain in gains.values())]
    most, least = max(gains, key=gains.get), min(gains, key=gains.get)
    return [
        *texts,
        f"{NUMBER_WORDS[left_out].capitalize()} of the {len(ENVIRONMENTS) * len(FF)} pairs of task and algorithm",
        fill(f"at least {NUMBER_WORDS[steadier]} of {pairs} would have a probability of {{:.0f}} %", 100 * tail),
        f"In {NUMBER_WORDS[steadier]} of the {pairs} pairs, the results on R vary less than those on D",
        f"those trained on R vary less in {NUMBER_WORDS[steadier_on_d]} of the {pairs} pairs",
        f"In {better} of the {pairs} pairs, policies trained on R have a higher",
        fill("largest gain is {:.1f} points ({} on {})", gains[most], *most),
        fill("largest loss is {:.1f} points ({} on {})", -gains[least], *least),
    ]
