"""Draw results/figures/training-contexts.svg: success over the number of training contexts, with reference lines.

Usage: PYTHONPATH=docs/site python experiments/references/contexts_figure.py, with the Python package and matplotlib, in
the project's folder.
"""

import matplotlib
import matplotlib.pyplot as plt
import reference_rates
from matplotlib.lines import Line2D
from results_contexts import CONTEXT_COUNTS, SEED_COUNT
from results_numbers import ENVIRONMENTS, read_studies

matplotlib.rcParams.update({"svg.hashsalt": "perturb", "svg.fonttype": "none"})  # the same bytes at each run

ALGORITHMS = {"ppo": "PPO", "a2c": "A2C"}
TESTS = {"own": "tested on the contexts of the training", "R": "tested on R", "E": "tested on E"}


def main():
    table, studies = read_studies()
    results = table[table.study == "contexts"]
    figure, panels = plt.subplots(
        len(ALGORITHMS), len(ENVIRONMENTS), figsize=(9, 4.5), sharex=True, sharey=True, layout="constrained"
    )
    lines = {}
    for row, (algorithm, name) in zip(panels, ALGORITHMS.items(), strict=True):
        for panel, task in zip(row, ENVIRONMENTS, strict=True):
            rows = results[(results.environment == task) & (results.algorithm == algorithm)]
            for test, label in TESTS.items():
                columns = []
                for count in CONTEXT_COUNTS:
                    own = f"contexts{count}"
                    chosen = rows[(rows.trained_on == own) & (rows.tested_on == (own if test == "own" else test))]
                    assert len(chosen) == SEED_COUNT, f"{len(chosen)} tests of {algorithm} on {own} of {task}"
                    columns.append(chosen.success_percent)
                means = [column.mean() for column in columns]
                line = panel.plot(CONTEXT_COUNTS, means, ".-")[0]
                lines[label] = line
                low, high = ([getattr(column, end)() for column in columns] for end in ("min", "max"))
                panel.fill_between(CONTEXT_COUNTS, low, high, color=line.get_color(), alpha=0.15, linewidth=0)
                if test != "own":
                    reference_rates.draw(panel, studies, task, test, line.get_color())
            panel.set_xscale("log", base=4)
            panel.set_xticks(CONTEXT_COUNTS, CONTEXT_COUNTS)
            panel.grid(alpha=0.3)
            panel.set_title(f"{task}, {name}", fontsize=9)
        row[0].set_ylabel("success, %")
    for panel in panels[-1]:
        panel.set_xlabel("contexts")
    for label, style in reference_rates.STYLES.items():
        # A reference line has the colour of its test.
        lines[label] = Line2D([], [], color=reference_rates.GREY, linestyle=style)
    figure.legend(lines.values(), lines, loc="outside lower center", ncols=len(lines), frameon=False, fontsize=8)
    figure.savefig("results/figures/training-contexts.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
