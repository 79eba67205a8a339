"""Draw results/figures/intervals.svg: how often intervals contain the true mean.

Usage: PYTHONPATH=docs/site python experiments/references/intervals_figure.py, with the Python package and matplotlib,
in the project's folder; a minute
"""

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from results_intervals import LABELS, SAMPLES, coverages, mostly_equal
from results_numbers import read_studies

matplotlib.rcParams.update({"svg.hashsalt": "perturb", "svg.fonttype": "none"})  # the same bytes at each run


def main():
    _, studies = read_studies()
    found, rows = coverages(studies)
    figure, panels = plt.subplots(1, len(LABELS), figsize=(9, 3), sharey=True, layout="constrained")
    generator = np.random.default_rng(1)
    for panel, ((interval, kind), label) in zip(panels, LABELS.items(), strict=True):
        equal = np.array([kind != "over_tasks" and mostly_equal(each) for each in found[kind]])
        # The dots of a column lie side by side, so that more of them are visible.
        offsets = generator.uniform(-0.25, 0.25, len(equal))
        for place, number in enumerate(SAMPLES):
            coverage = np.array(rows.get((interval, kind, number), []))
            if not len(coverage):
                continue
            for chosen, color, text in (
                (~equal, "C0", "at most six equal results"),
                (equal, "C1", "seven or more equal results"),
            ):
                panel.plot(place + offsets[chosen], coverage[chosen], ".", color=color, markersize=4, label=text)
        panel.axhline(95, color="0.35", linestyle="--", linewidth=1)
        panel.set_xticks(range(len(SAMPLES)), SAMPLES)
        panel.set_xlim(-0.5, len(SAMPLES) - 0.5)
        panel.set_xlabel("seeds")
        panel.set_title(label.replace(" over", "\nover"), fontsize=9)
        panel.grid(axis="y", alpha=0.3)
    panels[0].set_ylabel("coverage, %")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles[:2], labels[:2], loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    figure.savefig("results/figures/intervals.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
