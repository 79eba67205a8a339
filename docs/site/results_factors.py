"""The numbers of docs/findings/one-factor.md, from one_factor.csv."""

import csv
from collections import defaultdict
from pathlib import Path
from statistics import fmean

from results_numbers import ENVIRONMENTS
from results_words import fill, fixed, spread

COUNTS = Path("experiments/references/one_factor.csv")
REGIONS = ("low", "R", "high")


def rates():
    """Return the success of each seed's policy, %, by task, training version and the parameters' intervals."""
    found = defaultdict(list)
    with COUNTS.open() as file:
        for row in csv.DictReader(file):
            regions = tuple(text.split("=")[1] for text in row["parameters"].split())
            rate = 100 * int(row["successes"]) / int(row["episodes"])
            found[row["environment"], row["trained_on"], regions].append(rate)
    return found


def names():
    """Return the names of each task's parameters, in the order of one_factor.csv."""
    with COUNTS.open() as file:
        rows = list(csv.DictReader(file))
    return {row["environment"]: [text.split("=")[0] for text in row["parameters"].split()] for row in rows}


def one_factor(_):
    """Return the texts with numbers that the page must contain."""
    found, texts = rates(), []
    for task in ENVIRONMENTS:
        parameters = names()[task]
        for trained in "DR":
            for place, parameter in enumerate(parameters):
                row = []
                for region in REGIONS:
                    regions = ["R"] * len(parameters)
                    regions[place] = region
                    row.append(spread(found[task, trained, tuple(regions)]))
                texts.append(f"| {task} | {parameter} | {trained} | " + " | ".join(row) + " |")
    return texts + pairs(found)


def pairs(found):
    """Return the rows of the table of pairs: measured success, and the success that independent effects would give."""
    texts = []
    for task, pair in (("Pendulum", (0, 1)), ("Acrobot", (0, 1)), ("Acrobot", (0, 2)), ("Acrobot", (1, 2))):
        parameters = names()[task]

        def mean(*high, task=task, parameters=parameters):
            regions = tuple("high" if place in high else "R" for place in range(len(parameters)))
            return fmean(found[task, "R", regions])

        first, second = (mean(place) for place in pair)
        row = [mean(), first, second, mean(*pair), first * second / mean()]
        label = " and ".join(parameters[place] for place in pair)
        texts.append(f"| {task} | {label} | " + " | ".join(map(fixed, row)) + " |")
    ends = [fmean(found["Acrobot", "R", (end, end, end)]) for end in ("low", "high")]
    rod = [fmean(found["Pendulum", "R", (region, "R")]) for region in ("R", "high", "low")]
    links = [fmean(found["Acrobot", "R", (region, "R", "R")]) for region in ("R", "high")]
    gains = defaultdict(list)
    for (task, trained, regions), runs in found.items():
        if trained == "R" and sum(region != "R" for region in regions) <= 1:
            gains[task].append(fmean(runs) - fmean(found[task, "D", regions]))
    for end, expected in (("low", 0), ("high", 100)):  # no episode with a weak push succeeds, all with a strong push do
        pushed = [runs for (task, _, regions), runs in found.items() if task == "MountainCar" and regions[0] == end]
        assert all(rate == expected for runs in pushed for rate in runs), end
    lowest = min(fmean(runs) for (task, _, _), runs in found.items() if task == "CartPole")
    return [
        *texts,
        fill("succeed in {:.1f} % of the episodes if all three are low, and in {:.1f} % if all three are high", *ends),
        fill("a long rod alone lowers success from {:.0f} to {:.0f} %, and a short rod raises it to {:.0f} %", *rod),
        fill("long links alone lower success from {:.0f} to {:.0f} %", *links),
        fill("success with a long rod by {:.1f} points", max(gains.pop("Pendulum"))),
        fill("no mean of the table by more than {:.1f} points", max(map(max, gains.values()))),
        fill("in at least {:.1f} % of the episodes for every combination", lowest),
    ]
