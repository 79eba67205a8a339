"""Assessments as tables, for terminals and notebooks."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .assessment import Assessment

METRICS = ("Default", "Interpolation", "Extrapolation")


def tables(assessment: Assessment) -> list[list[list[str]]]:
    """The tests' figures, and the three numbers beside the paper's, if there are any: rows of cells, first the head."""
    known = any(result.trained_on is not None for result in assessment.results)
    head = ["scenario" if known else "tested on", "episodes", "success, %", "95 %", "worst contexts, %"]
    tests = [[*head, "return", "CVaR 10 %", "length", "policy"]]
    for it in assessment.results:
        low, high = it.success_interval
        worst = "" if it.worst_contexts_percent is None else f"{it.worst_contexts_percent:.1f}"
        figures = [it.scenario, str(it.episodes), f"{it.success_percent:.1f}", f"[{low:.1f}, {high:.1f}]", worst]
        numbers = [it.mean_return, it.cvar_return, it.mean_length]
        tests.append([*figures, *(f"{number:.1f}" for number in numbers), it.policy])
    metrics = assessment.metrics
    if all(number is None for number in metrics.values()) or not assessment.published:
        return [tests]
    comparison = [["%", *METRICS]]
    comparison.append(["here", *("" if number is None else f"{number:.1f}" for number in metrics.values())])
    comparison += [[f"paper: {method}", *map(_spread, its.values())] for method, its in assessment.published.items()]
    return [tests, comparison]


def _spread(number: tuple[float, float | None] | None) -> str:
    if number is None:
        return ""
    mean, std = number
    return f"{mean:.1f}" if std is None else f"{mean:.1f} ± {std:.1f}"


def text(table: list[list[str]]) -> str:
    """Columns under each other, the first to the left."""
    widths = [max(len(row[column]) for row in table) for column in range(len(table[0]))]
    lines = (
        [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        for row in table
    )
    return "\n".join("  ".join(line).rstrip() for line in lines)


def as_html(table: list[list[str]]) -> str:
    """For a page."""

    def row(cells: list[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    return "<table>" + row(table[0], "th") + "".join(row(cells, "td") for cells in table[1:]) + "</table>"
