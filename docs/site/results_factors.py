"""The numbers of docs/findings/one-factor.md, from one_factor.csv."""

import csv
from collections import defaultdict
from pathlib import Path
from statistics import fmean

from results_numbers import ENVIRONMENTS, t_interval
from results_words import fill, fixed, spread

RATES_FILE = Path("experiments/references/one_factor.csv")
REGIONS = ("low", "R", "high")
# The column "trained on" of the page's table by that of the file.
POLICIES = {"D": "D", "R": "R", "": "none (heuristic)"}


def rates():
    """Return the success of each seed's policy, %, by task, training version and the parameters' intervals."""
    found = defaultdict(list)
    with RATES_FILE.open() as file:
        for row in csv.DictReader(file):
            regions = tuple(text.split("=")[1] for text in row["parameters"].split())
            rate = 100 * int(row["successes"]) / int(row["episodes"])
            found[row["environment"], row["trained_on"], regions].append(rate)
    return found


def names():
    """Return the names of each task's parameters, in the order of one_factor.csv."""
    with RATES_FILE.open() as file:
        rows = list(csv.DictReader(file))
    return {row["environment"]: [text.split("=")[0] for text in row["parameters"].split()] for row in rows}


def one_factor(_):
    """Return the texts with numbers that the page must contain."""
    found, texts, named = rates(), [], names()
    for task in ENVIRONMENTS:
        parameters = named[task]
        for trained, label in POLICIES.items():
            for place, parameter in enumerate(parameters):
                row = []
                for region in REGIONS:
                    regions = ["R"] * len(parameters)
                    regions[place] = region
                    row.append(spread(found[task, trained, tuple(regions)]))
                texts.append(f"| {task} | {parameter} | {label} | " + " | ".join(row) + " |")
    return texts + comparisons(found, named)


def comparisons(found, named):
    """Return the texts that compare settings, pairs of settings and training versions.

    `named` has the names of each task's parameters.
    """
    texts, mean = [], {key: fmean(runs) for key, runs in found.items()}
    for task, pair in (("Pendulum", (0, 1)), ("Acrobot", (0, 1)), ("Acrobot", (0, 2)), ("Acrobot", (1, 2))):
        parameters = named[task]

        def high(*places, task=task, parameters=parameters):
            return mean[task, "R", tuple("high" if place in places else "R" for place in range(len(parameters)))]

        first, second = (high(place) for place in pair)
        independent = first * second / high()
        assert high(*pair) < independent, f"{task}, {pair}"
        label = " and ".join(parameters[place] for place in pair)
        row = [high(), first, second, high(*pair), independent]
        texts.append(f"| {task} | {label} | " + " | ".join(map(fixed, row)) + " |")
    for end, expected in (("low", 0), ("high", 100)):  # no episode with a weak push succeeds, all with a strong push do
        trained = {key: runs for key, runs in found.items() if key[1]}
        pushed = [runs for (task, _, regions), runs in trained.items() if (task, regions[0]) == ("MountainCar", end)]
        assert all(rate == expected for runs in pushed for rate in runs), end
    weak = {region: mean["MountainCar", "", ("low", region)] for region in REGIONS}
    assert weak["R"] == weak["high"] == 0, weak
    for place in range(3):  # on Acrobot, high values are harder than R, and low values easier
        low, middle, high = (
            mean["Acrobot", "R", tuple(region if other == place else "R" for other in range(3))] for region in REGIONS
        )
        assert low > middle > high, f"{named['Acrobot'][place]}: {low}, {middle}, {high}"
    rod = [mean["Pendulum", "R", (region, "R")] for region in ("R", "high")]
    links = [mean["Acrobot", "R", ("R", region, "R")] for region in ("R", "high")]
    ends = [mean["Acrobot", "R", (end, end, end)] for end in ("low", "high")]
    cart_pole = [runs for (task, trained, _), runs in found.items() if task == "CartPole" and trained]
    long_rod = zip(*(found["Pendulum", trained, ("high", "R")] for trained in "RD"), strict=True)
    gain, low, high = t_interval([[on_r - on_d for on_r, on_d in long_rod]])
    gains = [
        value - mean[task, "D", regions]
        for (task, trained, regions), value in mean.items()
        if trained == "R" and task != "Pendulum" and sum(region != "R" for region in regions) <= 1
    ]
    return [
        *texts,
        fill("a long rod alone lowers success on Pendulum from {:.0f} to {:.0f} %", *rod),
        fill("a heuristic policy keeps {:.1f} %", mean["Pendulum", "", ("high", "R")]),
        fill("heavy links alone lower success from {:.0f} to {:.0f} %", *links),
        fill(
            "that of the heuristic policy from {:.0f} to {:.0f} %",
            *(mean["Acrobot", "", ("R", region, "R")] for region in ("R", "high")),
        ),
        fill("the heuristic policy solves {:.1f} % of them", weak["low"]),
        fill("a mean that is {:.1f} points higher", gain),
        fill("interval of {:.1f} to {:.1f} points", low, high),
        fill("no mean of the table by more than {:.1f} points", max(gains)),
        fill("succeed in {:.1f} % of the episodes if all three are low, and in {:.1f} % if all three are high", *ends),
        fill("is at least {:.1f} % for every combination", min(map(fmean, cart_pole))),
        fill("the lowest result of a single policy is {:.1f} %", min(map(min, cart_pole))),
    ]
