"""Reference lines for figures: the success of the heuristic policies, and the upper bounds.

The scripts that draw figures import this module. docs/findings/reference-lines.md explains the lines.
"""

import csv
from pathlib import Path

BOUNDS = Path("experiments/references/upper_bound.csv")
# A grey that differs from the colours of other lines.
GREY = "0.35"
STYLES = {"heuristic policy": "--", "upper bound": ":"}


def heuristic(results, task, version):
    """Return the mean success of the heuristic policy over all seeds, %. `results` is the results table."""
    rows = results[(results.study == "heuristic") & (results.algorithm == "heuristic")]
    rows = rows[(rows.environment == task) & (rows.tested_on == version)]
    assert len(rows) == 5, f"the table has {len(rows)} tests of the heuristic policy on {version} of {task}"
    return rows.success_percent.mean()


def upper_bound(task, version):
    """Return the share of episodes that can be solved, %. None if it is unknown."""
    with BOUNDS.open() as file:
        for row in csv.DictReader(file):
            if (row["environment"], row["version"], row["part"]) == (task, version, "all"):
                return 100 * (int(row["solved"]) + int(row["undecided"])) / int(row["episodes"])
    return None


def both(results, task, version):
    """Return the success of both reference lines, %, by label."""
    return {"heuristic policy": heuristic(results, task, version), "upper bound": upper_bound(task, version)}


def draw_rates(panel, rates, color):
    return {
        label: panel.axhline(rate, color=color, linestyle=STYLES[label], linewidth=1.2, label=label)
        for label, rate in rates.items()
        if rate is not None
    }


def draw(panel, results, task, version, color=GREY):
    """Draw the known reference lines of a task and a version across a panel of success in %. Return them by label."""
    return draw_rates(panel, both(results, task, version), color)


def draw_metric(panel, results, task, metric, color=GREY):
    """Draw the known reference lines of a task for Default, Interpolation or Extrapolation. Return them by label."""
    if metric != "Extrapolation":
        return draw(panel, results, task, {"Default": "D", "Interpolation": "R"}[metric], color)
    on_r, on_e = (both(results, task, version) for version in "RE")
    # A reference line does not depend on the training, so success on E counts twice.
    rates = {label: None if on_r[label] is None else (on_r[label] * on_e[label] ** 2) ** (1 / 3) for label in STYLES}
    return draw_rates(panel, rates, color)
