"""Tables of results as text for terminals, as HTML for notebooks, and as LaTeX."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from .results import Result

METRICS = ("Default", "Interpolation", "Extrapolation")
# The words in tables that say how actions were chosen. The keys are values of `Result.deterministic`.
ACTIONS = {True: "the mode", False: "sampled", None: ""}


def tables(
    results: Sequence[Result],
    metrics: Mapping[str, float | None],
    published: Mapping[str, Mapping[str, tuple[float, float | None] | None]],
) -> list[list[list[str]]]:
    """Return the tables of an assessment. A table is a list of rows of cells, and its first row has the headings.

    The first table has the statistics of each test. The second one compares the three metrics with the paper's. It is
    left out if there are no metrics, or if the paper has none for the environment.
    """
    known = any(result.trained_on is not None for result in results)
    head = ["scenario" if known else "tested on", "episodes", "success, %", "95 %", "worst contexts, %"]
    tests = [[*head, "return", "CVaR 10 %", "length", "actions", "policy"]]
    for it in results:
        low, high = it.success_interval
        worst = "" if it.worst_contexts_percent is None else f"{it.worst_contexts_percent:.1f}"
        figures = [it.scenario, str(it.episodes), f"{it.success_percent:.1f}", f"[{low:.1f}, {high:.1f}]", worst]
        numbers = [it.mean_return, it.cvar_return, it.mean_length]
        actions = ACTIONS[it.deterministic]
        tests.append([*figures, *(f"{number:.1f}" for number in numbers), actions, it.policy])
    if all(number is None for number in metrics.values()) or not published:
        return [tests]
    comparison = [["%", *METRICS]]
    comparison.append(["here", *("" if number is None else f"{number:.1f}" for number in metrics.values())])
    comparison += [[f"paper: {method}", *map(_spread, its.values())] for method, its in published.items()]
    return [tests, comparison]


def _spread(number: tuple[float, float | None] | None) -> str:
    if number is None:
        return ""
    mean, std = number
    return f"{mean:.1f}" if std is None else f"{mean:.1f} ± {std:.1f}"


def text(table: list[list[str]]) -> str:
    """Return a table as text. The first column is aligned to the left and the others to the right."""
    widths = [max(len(row[column]) for row in table) for column in range(len(table[0]))]
    lines = (
        [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        for row in table
    )
    return "\n".join("  ".join(line).rstrip() for line in lines)


def as_html(table: list[list[str]]) -> str:
    """Return a table as an HTML element."""

    def row(cells: list[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    return "<table>" + row(table[0], "th") + "".join(row(cells, "td") for cells in table[1:]) + "</table>"


def as_latex(table: list[list[str]]) -> str:
    """Return a table as a LaTeX `tabular` environment. It uses the commands of the package booktabs."""
    special = {"%": r"\%", "&": r"\&", "_": r"\_", "#": r"\#", "$": r"\$", "−": "$-$", ">": "$>$", "<": "$<$"}

    def row(cells: list[str]) -> str:
        return " & ".join("".join(special.get(letter, letter) for letter in cell) for cell in cells) + r" \\"

    columns = "l" * 2 + "r" * (len(table[0]) - 2)
    lines = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", row(table[0]), r"\midrule", *map(row, table[1:])]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])
