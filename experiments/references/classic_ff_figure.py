"""Draw results/figures/classic-ff.svg: the study classic-ff beside the paper, for each task.

Usage: PYTHONPATH=docs/site python experiments/references/classic_ff_figure.py, with the Python package and matplotlib,
in the project's folder.
"""

from statistics import fmean

import matplotlib
import matplotlib.pyplot as plt
import reference_rates
from results_numbers import ENVIRONMENTS, METRICS, read_studies
from results_pages import by_seed
from results_words import CLEAN, FF, NAMES

matplotlib.rcParams.update({"svg.hashsalt": "perturb", "svg.fonttype": "none"})  # the same bytes at each run


def main():
    _, studies = read_studies()
    figure, panels = plt.subplots(
        len(METRICS), len(ENVIRONMENTS), figsize=(9, 6.5), sharex=True, sharey=True, layout="constrained"
    )
    for column, task in enumerate(ENVIRONMENTS):
        for place, method in enumerate(FF.values()):
            clean = by_seed(studies, "classic-ff", task, method, CLEAN)
            rule = studies.published_rule("classic-ff", task, method[0])
            for row, metric in enumerate(METRICS):
                panel = panels[row][column]
                panel.plot([place - 0.2] * len(clean[row]), clean[row], ".", color="C0", markersize=4)
                panel.plot(place - 0.2, fmean(clean[row]), "_", color="C0", markersize=12, label="clean rule")
                mean, low, high = rule[row]
                panel.plot([place] * 2, [low, high], "-", color="C1")
                panel.plot(place, mean, "s", color="C1", markersize=4, label="paper's rule")
                middle, deviation = studies.paper(task, method, metric)
                panel.errorbar(
                    place + 0.2, middle, deviation, fmt="D", color="black", mfc="white", markersize=4, label="paper"
                )
        for row, metric in enumerate(METRICS):
            panel = panels[row][column]
            reference_rates.draw(panel, studies, task, metric)
            panel.set_ylim(-5, 105)
            panel.set_xlim(-0.6, len(FF) - 0.4)
            panel.set_xticks(range(len(FF)), [NAMES[name].replace("-", "-\n") for name in FF], fontsize=8)
            panel.grid(axis="y", alpha=0.3)
            if column == 0:
                panel.set_ylabel(f"{metric}, %")
        panels[0][column].set_title(task)
    handles, labels = panels[0][1].get_legend_handles_labels()
    shown = dict(zip(labels, handles, strict=True))
    figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=len(shown), frameon=False)
    figure.savefig("results/figures/classic-ff.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
