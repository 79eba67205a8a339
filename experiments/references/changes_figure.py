"""Draw results/figures/changing-physics.svg: success without and with a change of the physics.

Usage: python experiments/references/changes_figure.py, with the Python package and matplotlib, in the project's folder.
"""

import matplotlib
import matplotlib.pyplot as plt
import perturb

matplotlib.rcParams.update({"svg.hashsalt": "perturb", "svg.fonttype": "none"})  # the same bytes at each run

METHODS = {("ppo", "ff"): "PPO FF", ("ppo", "rc"): "PPO RC", ("rl2-ppo", "rc"): "RL²-PPO RC"}
TESTS = {"R": "no change", "changing": "change after\n100 steps", "earlier": "change after\n50 steps"}


def main():
    results = perturb.read_results("results/results.parquet")
    results = results[results.study == "changes"]
    heuristic, results = results[results.algorithm == "heuristic"], results[results.trained_on == "changing"]
    tasks = ["CartPole", "Pendulum"]
    figure, panels = plt.subplots(1, len(tasks), figsize=(7, 3), sharey=True, layout="constrained")
    for panel, task in zip(panels, tasks, strict=True):
        for offset, (method, name) in zip((-0.15, 0, 0.15), METHODS.items(), strict=True):
            rows = results[(results.environment == task) & (results.algorithm == method[0])]
            rows = rows[rows.architecture == method[1]]
            percents = [rows[rows.tested_on == test].success_percent for test in TESTS]
            places = [place + offset for place in range(len(TESTS))]
            line = panel.plot(places, [each.mean() for each in percents], "_-", markersize=12, label=name)[0]
            for place, each in zip(places, percents, strict=True):
                panel.plot([place] * len(each), each, ".", color=line.get_color())
        rules = heuristic[heuristic.environment == task].groupby("tested_on").success_percent.mean()
        panel.plot(range(len(TESTS)), rules[list(TESTS)], "--", color="grey", linewidth=1, label="heuristic policy")
        panel.set_xticks(range(len(TESTS)), TESTS.values())
        panel.set_title(task)
        panel.grid(axis="y", alpha=0.3)
    panels[0].set_ylabel("success, %")
    panels[0].legend(frameon=False, loc="lower left")
    figure.savefig("results/figures/changing-physics.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
