"""Draw results/figures/reference-lines.svg: random and heuristic policies, learned policies, and upper bounds.

Usage: PYTHONPATH=docs/site python experiments/references/reference_lines_figure.py, with the Python package and
matplotlib, in the project's folder.
"""

import matplotlib
import matplotlib.pyplot as plt
from results_lines import rates_by_task
from results_numbers import read_studies

matplotlib.rcParams.update({"svg.hashsalt": "perturb", "svg.fonttype": "none"})  # the same bytes at each run

COLUMNS = ("D", "R", "E", "Extrapolation")
MARKERS = {
    "random": ("x", "C7"),
    "always right": (">", "C1"),
    "heuristic": ("s", "C1"),
    "best learned": ("o", "C0"),
    "paper's best": ("D", "black"),
    "upper bound": ("_", "C3"),
}


def main():
    _, studies = read_studies()
    found = rates_by_task(studies)
    figure, panels = plt.subplots(1, len(found), figsize=(9, 3.4), sharey=True, layout="constrained")
    lines = {}
    for panel, (task, shown) in zip(panels, found.items(), strict=True):
        for order, (name, rates) in enumerate(shown.items()):
            marker, color = MARKERS[name]
            known = [(place, rate) for place, rate in enumerate(rates) if rate is not None]
            # Equal rates would hide each other, so the markers stand side by side.
            places = [place + (order - 2) * 0.12 for place, _ in known]
            size = 9 if marker == "_" else 5
            (lines[name],) = panel.plot(
                places, [rate for _, rate in known], marker, color=color, mfc="none", markersize=size, label=name
            )
        panel.set_xticks(range(len(COLUMNS)), ["D", "R", "E", "Extra-\npolation"])
        panel.set_xlim(-0.6, len(COLUMNS) - 0.4)
        panel.set_title(task)
        panel.grid(axis="y", alpha=0.3)
    panels[0].set_ylabel("success, %")
    shown = [lines[name] for name in MARKERS]
    figure.legend(handles=shown, loc="outside lower center", ncols=len(shown), frameon=False, fontsize=9)
    figure.savefig("results/figures/reference-lines.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
