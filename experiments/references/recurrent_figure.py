"""Draw results/figures/recurrent-finding.svg: A2C with and without memory, RL²-A2C and PPO, averaged over four tasks.

Usage: PYTHONPATH=docs/site python experiments/references/recurrent_figure.py, with the Python package and matplotlib,
in the project's folder.
"""

from statistics import fmean

import matplotlib
import matplotlib.pyplot as plt
import results_lines
from results_numbers import METRICS, read_studies
from results_pages import averages
from results_words import FF

matplotlib.rcParams.update({"svg.hashsalt": "perturb", "svg.fonttype": "none"})  # the same bytes at each run

METHODS = {
    "A2C FF": FF["a2c"],
    "A2C RC": ("a2c", "rc", None),
    "RL²-A2C RC": ("rl2-a2c", "rc", 2),
    "PPO FF": FF["ppo"],
}
SEEDS = range(2, 5)


def main():
    _, studies = read_studies()
    rules = results_lines.averages(studies, "text")
    figure, panels = plt.subplots(1, len(METRICS), figsize=(9, 2.6), sharey=True, layout="constrained")
    for place, method in enumerate(METHODS.values()):
        for panel, metric, runs in zip(panels, METRICS, averages(studies, "classic-rc", method, SEEDS), strict=True):
            panel.plot(runs, [place - 0.15] * len(runs), ".", color="C0", label="a seed")
            panel.plot(fmean(runs), place - 0.15, "|", color="C0", markersize=12, label="mean of the seeds")
            panel.plot(studies.paper_mean(method, metric), place + 0.2, "D", color="black", mfc="white", label="paper")
    for panel, metric, index in zip(panels, METRICS, results_lines.METRIC_PLACES, strict=True):
        panel.axvline(rules[index], color="0.35", linestyle="--", linewidth=1.2, label="heuristic policies")
        panel.set_title(metric)
        panel.set_xlim(30, 102)
        panel.set_xlabel("success, %")
        panel.grid(axis="x", alpha=0.3)
    panels[0].set_yticks(range(len(METHODS)), METHODS)
    panels[0].invert_yaxis()
    handles, labels = panels[0].get_legend_handles_labels()
    shown = dict(zip(labels, handles, strict=True))
    figure.legend(shown.values(), shown, loc="outside lower center", ncols=len(shown), frameon=False, fontsize=9)
    figure.savefig("results/figures/recurrent-finding.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
