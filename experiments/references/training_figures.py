"""Draw the figures of success over the training of the studies questions/acrobot, cart-pole and pendulum.

Usage: PYTHONPATH=docs/site python experiments/references/training_figures.py, with the Python package and matplotlib,
in the project's folder. It writes three files to results/figures.

Each row of a figure compares the values of a setting. A thick line is the mean of all trainings with a value. A thin
line is the mean of one configuration over its seeds. All policies were trained on D.
"""

from dataclasses import dataclass

import matplotlib
import matplotlib.pyplot as plt
import perturb
import reference_rates
from results_numbers import TABLE, read_studies

matplotlib.rcParams.update({"svg.hashsalt": "perturb", "svg.fonttype": "none"})  # the same bytes at each run

EPISODES = 15_000
TICKS = (0, 5_000, 10_000, 15_000)


@dataclass
class Row:
    """A row of panels: the algorithm, and the names of the values of a setting that the row compares."""

    algorithm: str
    setting: str
    values: dict


ENVIRONMENTS = {1: "1 environment", 8: "8 environments", 16: "16 environments"}
# The rows of each figure, by the figure's file name. The study has the same name after `questions/`.
FIGURES = {
    ("acrobot", "Acrobot"): (
        Row("a2c", "num_envs", {number: ENVIRONMENTS[number] for number in (1, 16)}),
        Row("a2c", "learning_rate", {7e-4: "learning rate of 7e-4", 7e-3: "learning rate of 7e-3"}),
    ),
    ("cart-pole", "CartPole"): (
        Row("a2c", "ent_coef", {10.0**power: f"entropy weight of 1e{power}" for power in (-2, -3, -4, -5)}),
        Row("ppo", "normalize_observations", {True: "normalised observations", False: "observations not normalised"}),
    ),
    ("pendulum", "Pendulum"): (
        Row("ppo", "num_envs", {number: ENVIRONMENTS[number] for number in (1, 8)}),
        Row(
            "ppo",
            "bootstrap_truncation",
            {False: "time limit as a terminal state", True: "bootstrapped at the time limit"},
        ),
    ),
}


def draw_row(panels, row, task, studies, chosen):
    """Draw a row of panels from the rows `chosen` of the table, and its legend to the right."""
    unknown = set(chosen[row.setting]) - set(row.values)
    assert not unknown, f"{task}: no name for {row.setting} of {unknown}"
    for panel, version in zip(panels, "DRE", strict=True):
        # The reference lines lie below the others.
        lines = reference_rates.draw(panel, studies, task, version)
        tests = chosen[chosen.tested_on == version]
        for place, (value, label) in enumerate(row.values.items()):
            rows = tests[tests[row.setting] == value]
            for _, configuration in rows.groupby("configuration"):
                means = configuration.groupby("mark").success_percent.mean()
                panel.plot(means.index, means, color=f"C{place}", linewidth=0.8, alpha=0.5)
            means = rows.groupby("mark").success_percent.mean()
            lines[label] = panel.plot(means.index, means, ".-", color=f"C{place}", linewidth=2.5, markersize=9)[0]
        panel.set_xlim(0, 1.02 * EPISODES)
        panel.set_ylim(-3, 103)
        panel.grid(alpha=0.3)
    panels[0].set_ylabel(f"{row.algorithm.upper()}: success, %")
    # Settings come first in the legend.
    labels = [*row.values.values(), *(label for label in reference_rates.STYLES if label in lines)]
    handles = [lines[label] for label in labels]
    panels[-1].legend(handles, labels, loc="center left", bbox_to_anchor=(1, 0.5), frameon=False, fontsize=8)


def draw(name, task, rows, results, studies):
    figure, panels = plt.subplots(
        len(rows), 3, figsize=(9, 2.6 * len(rows)), sharex=True, sharey=True, layout="constrained"
    )
    for row, line in zip(rows, panels, strict=True):
        chosen = results[(results.study == f"questions/{name}") & (results.algorithm == row.algorithm)]
        draw_row(line, row, task, studies, chosen[chosen.trained_on == "D"])
    for panel, version in zip(panels[0], "DRE", strict=True):
        panel.set_title(f"tested on {version}", fontsize=10)
    for panel in panels[-1]:
        panel.set_xticks(TICKS, [f"{tick:,}".replace(",", " ") for tick in TICKS], fontsize=8)
        panel.set_xlabel("training episodes")
    figure.savefig(f"results/figures/{name}-training.svg", metadata={"Date": None})


def main():
    settings = {row.setting for rows in FIGURES.values() for row in rows}
    results = perturb.read_results(TABLE, settings=settings)
    _, studies = read_studies()
    # The last episodes of a training end together, so some trainings have up to five more than the budget.
    results["mark"] = results.after_episodes.clip(upper=EPISODES).astype(float)
    results["configuration"] = results.cell.str.rsplit("-", n=1).str[0]
    for (name, task), rows in FIGURES.items():
        draw(name, task, rows, results, studies)


if __name__ == "__main__":
    main()
