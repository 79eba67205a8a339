"""Draw results/figures/paper-items.svg: for how many numbers of the paper there are how many seeds.

Usage: PYTHONPATH=docs/site python experiments/references/paper_items_figure.py, with the Python package and matplotlib,
in the project's folder.
"""

from collections import Counter

import matplotlib
import matplotlib.pyplot as plt
from results_numbers import ENVIRONMENTS, read_studies
from results_paper import KINDS, kind, seeds

matplotlib.rcParams.update({"svg.hashsalt": "perturb", "svg.fonttype": "none"})  # the same bytes at each run

LABELS = {"five": "five or more seeds", "three": "three or four", "fewer": "one or two", "none": "none"}
COLORS = {"five": "#08519c", "three": "#3182bd", "fewer": "#9ecae1", "none": "0.9"}


def main():
    _, studies = read_studies()
    known = seeds(studies)
    rows = (*ENVIRONMENTS, "Hopper", "HalfCheetah")
    figure, panel = plt.subplots(figsize=(7, 2.8), layout="constrained")
    left = [0] * len(rows)
    for name in KINDS:
        counts = [Counter(kind(count) for key, count in known.items() if key[0] == row)[name] for row in rows]
        panel.barh(rows, counts, left=left, color=COLORS[name], label=LABELS[name])
        left = [start + count for start, count in zip(left, counts, strict=True)]
    panel.invert_yaxis()
    panel.set_xlabel("numbers in the paper")
    figure.legend(loc="outside lower center", ncols=len(KINDS), frameon=False, fontsize=9)
    figure.savefig("results/figures/paper-items.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
