"""Draw results/figures/one-factor.svg: success if one parameter is low, in its interval of R, or high.

Usage: python experiments/references/one_factor_figure.py, with matplotlib, in the project's folder.
"""

import csv
from collections import defaultdict
from pathlib import Path
from statistics import fmean

import matplotlib
import matplotlib.pyplot as plt

matplotlib.rcParams.update({"svg.hashsalt": "perturb", "svg.fonttype": "none"})  # the same bytes at each run

TASKS = ("CartPole", "Pendulum", "Acrobot", "MountainCar")
REGIONS = ("low", "R", "high")


def main():
    rates = defaultdict(list)
    names = {}
    with Path("experiments/references/one_factor.csv").open() as file:
        for row in csv.DictReader(file):
            pairs = [text.split("=") for text in row["parameters"].split()]
            names[row["environment"]] = [name for name, _ in pairs]
            regions = tuple(region for _, region in pairs)
            rate = 100 * int(row["successes"]) / int(row["episodes"])
            rates[row["environment"], row["trained_on"], regions].append(rate)
    figure, panels = plt.subplots(1, len(TASKS), figsize=(9, 2.8), sharey=True, layout="constrained")
    for panel, task in zip(panels, TASKS, strict=True):
        for place, name in enumerate(names[task]):
            columns = {"R": [], "": []}
            for region in REGIONS:
                regions = ["R"] * len(names[task])
                regions[place] = region
                for trained, found in columns.items():
                    found.append(rates[task, trained, tuple(regions)])
            trained, heuristic = ([fmean(column) for column in found] for found in columns.values())
            line = panel.plot(range(len(REGIONS)), trained, label=name)[0]
            panel.plot(range(len(REGIONS)), heuristic, "--", color=line.get_color(), linewidth=1)
            for x, column in enumerate(columns["R"]):
                panel.plot([x] * len(column), column, ".", color=line.get_color(), markersize=4)
        panel.set_xticks(range(len(REGIONS)), REGIONS)
        panel.set_title(task)
        panel.grid(axis="y", alpha=0.3)
        if task == "CartPole":
            panel.plot([], [], "--", color="grey", linewidth=1, label="heuristic policy")
        panel.legend(frameon=False, fontsize=8)
    panels[0].set_ylabel("success, %")
    figure.savefig("results/figures/one-factor.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
