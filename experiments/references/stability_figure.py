"""Draw results/figures/stability.svg: training curves on D, R and E.

Usage: PYTHONPATH=docs/site python experiments/references/stability_figure.py, with the Python package and matplotlib,
in the project's folder. The curves are a part of those that `perturb curves` writes for the study questions/stability.
"""

import matplotlib
import matplotlib.pyplot as plt
import pandas as pd
from results_lines import heuristic
from results_numbers import read_studies
from results_stability import CURVES

matplotlib.rcParams.update({"svg.hashsalt": "perturb", "svg.fonttype": "none"})  # the same bytes at each run

NAMES = {"a2c": "A2C", "ppo": "PPO", "epopt-ppo": "EPOpt-PPO"}
TASKS = ("CartPole", "Pendulum", "Acrobot", "MountainCar")
# The task and algorithm of each panel, by row. The place for the legend is empty.
PANELS = ([*((task, "a2c") for task in TASKS), ("CartPole", "epopt-ppo")], [*((task, "ppo") for task in TASKS), None])


def draw(panel, task, algorithm, curves, studies):
    """Draw the training curves of a task and an algorithm, and the success of the heuristic policy."""
    points = curves[(curves.environment == task) & (curves.algorithm == algorithm)]
    for place, version in enumerate("DRE"):
        color, own = f"C{place}", points[points.train == version]
        assert len(own), f"there is no curve of {algorithm} on {version} of {task}"
        low, high = (own.success_mean + sign * own.success_std for sign in (-1, 1))
        panel.plot(own.progress, own.success_mean, color=color, linewidth=1.2, label=f"trained on {version}")
        panel.fill_between(own.progress, low, high, color=color, alpha=0.15, linewidth=0)
        rate = heuristic(studies, task, "text")[place]  # as in the training
        panel.axhline(rate, color=color, linestyle="--", linewidth=0.8, label=f"heuristic policy on {version}")
    panel.set_title(f"{task}, {NAMES[algorithm]}", fontsize=9)
    # EPOpt generates more episodes than the others.
    last = round(points.progress.max(), -3)
    panel.set_xticks(
        [0, last / 2, last], ["0", *(f"{tick:,.0f}".replace(",", " ") for tick in (last / 2, last))], fontsize=8
    )
    panel.set_xlabel("training episodes", fontsize=9)
    panel.grid(alpha=0.3)


def main():
    curves = pd.read_csv(CURVES)
    _, studies = read_studies()
    figure, rows = plt.subplots(2, len(PANELS[0]), figsize=(10, 4.6), sharey=True, layout="constrained")
    for row, known in zip(rows, PANELS, strict=True):
        for panel, shown in zip(row, known, strict=True):
            if shown is None:
                panel.set_axis_off()
                handles, labels = row[0].get_legend_handles_labels()
                panel.legend(handles, labels, loc="center", frameon=False, fontsize=8)
            else:
                draw(panel, *shown, curves, studies)
        row[0].set_ylabel("success, %")
    rows[0][0].set_ylim(-3, 103)
    figure.savefig("results/figures/stability.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
