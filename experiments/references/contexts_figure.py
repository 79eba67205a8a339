"""Draw results/figures/training-contexts.svg: success over the number of training contexts.

Usage: python experiments/references/contexts_figure.py, with the Python package and matplotlib, in the project's
folder.
"""

import matplotlib
import matplotlib.pyplot as plt
import perturb

matplotlib.rcParams.update({"svg.hashsalt": "perturb", "svg.fonttype": "none"})  # the same bytes at each run

TASKS = ("CartPole", "Pendulum", "Acrobot", "MountainCar")
ALGORITHMS = {"ppo": "PPO", "a2c": "A2C"}
COUNTS = (1, 4, 16, 64, 256)
TESTS = {"own": "the contexts of the training", "R": "R", "E": "E"}


def main():
    results = perturb.read_results("results/results.parquet")
    results = results[(results.study == "contexts") & (results.seed <= 35)]
    figure, panels = plt.subplots(
        len(ALGORITHMS), len(TASKS), figsize=(9, 4.5), sharex=True, sharey=True, layout="constrained"
    )
    for row, (algorithm, name) in zip(panels, ALGORITHMS.items(), strict=True):
        for panel, task in zip(row, TASKS, strict=True):
            rows = results[(results.environment == task) & (results.algorithm == algorithm)]
            for test, label in TESTS.items():
                columns = []
                for count in COUNTS:
                    own = f"contexts{count}"
                    chosen = rows[(rows.trained_on == own) & (rows.tested_on == (own if test == "own" else test))]
                    columns.append(chosen.success_percent)
                means = [column.mean() for column in columns]
                line = panel.plot(COUNTS, means, ".-", label=label)[0]
                low, high = ([getattr(column, end)() for column in columns] for end in ("min", "max"))
                panel.fill_between(COUNTS, low, high, color=line.get_color(), alpha=0.15, linewidth=0)
            panel.set_xscale("log", base=4)
            panel.set_xticks(COUNTS, COUNTS)
            panel.grid(alpha=0.3)
            panel.set_title(f"{task}, {name}", fontsize=9)
        row[0].set_ylabel("success, %")
    for panel in panels[-1]:
        panel.set_xlabel("contexts")
    panels[0][-1].legend(frameon=False, fontsize=8)
    figure.savefig("results/figures/training-contexts.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
