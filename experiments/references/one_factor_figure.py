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
            if row["trained_on"] == "R":
                regions = tuple(region for _, region in pairs)
                rates[row["environment"], regions].append(100 * int(row["successes"]) / int(row["episodes"]))
    figure, panels = plt.subplots(1, len(TASKS), figsize=(9, 2.8), sharey=True, layout="constrained")
    for panel, task in zip(panels, TASKS, strict=True):
        for place, name in enumerate(names[task]):
            columns = []
            for region in REGIONS:
                regions = ["R"] * len(names[task])
                regions[place] = region
                columns.append(rates[task, tuple(regions)])
            line = panel.plot(range(len(REGIONS)), [fmean(column) for column in columns], label=name)[0]
            for x, column in enumerate(columns):
                panel.plot([x] * len(column), column, ".", color=line.get_color(), markersize=4)
        panel.set_xticks(range(len(REGIONS)), REGIONS)
        panel.set_title(task)
        panel.grid(axis="y", alpha=0.3)
        panel.legend(frameon=False, fontsize=8)
    panels[0].set_ylabel("success, %")
    figure.savefig("results/figures/one-factor.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
