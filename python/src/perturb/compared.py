"""The result of a comparison, as tables, files and plots."""

from __future__ import annotations

import csv
import html
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from . import plots
from .errors import InvalidArgumentError, UnknownNameError
from .tables import as_html, as_latex, text

if TYPE_CHECKING:
    from .assessment import Assessment
    from .comparison_results import ConditionDifference, ConditionMean, Interval

Table = Literal["means", "differences", "episodes"]

# For each compared score: the heading of its column, and the heading of the column with differences.
_HEADINGS = {"success": ("success, %", "points"), "return": ("return", "difference"), "length": ("length", "steps")}
_INTERVALS = (
    "All intervals are 95 % confidence intervals. Intervals over seeds estimate what other training seeds would give. "
    "They are t intervals, and need at least three seeds. If the means of seeds are normally distributed, they cover "
    "the true mean in 95 % of cases even with three seeds; a bootstrap would cover it in 73 % (84 % with five seeds). "
    "Intervals over episodes estimate what the same policies would give in other episodes. p is from t tests over "
    "seeds, with Holm's correction for all differences."
)
_COUNTS = (
    "Rows of a results table have no episodes. Intervals of success rates over episodes are computed from the numbers "
    "of successes, as if all policies had played different episodes. Returns and lengths have no such interval."
)


class Comparison:
    """The result of `compare`: the conditions' mean scores in the same tests, and the differences between them.

    `print` and notebooks show a comparison as tables.

    Attributes:
        environment: the name of the environment.
        score: the compared score: `success`, `return` or `length`.
        success: the success rule as a phrase. None if the server decided about success and stated no rule,
            and for rows of a results table.
        means: the mean score of each condition in each test, ordered by test.
        differences: the difference of each compared pair of conditions in each test, ordered by test.
        verdict: a sentence with the conclusion from these numbers.
        evaluations: the assessment of each policy, by condition and then by the policy's key. Empty for rows of a
            results table.
    """

    def __init__(
        self,
        score: str,
        means: Sequence[ConditionMean],
        differences: Sequence[ConditionDifference],
        verdict: str,
        evaluations: Mapping[str, Mapping[str, Assessment]],
        environment: str | None = None,
    ) -> None:
        self.score = score
        self.means = tuple(means)
        self.differences = tuple(differences)
        self.verdict = verdict
        self.evaluations = evaluations
        self.environment = environment or self._assessments()[0].environment
        self.success = self._assessments()[0].success if evaluations else None

    def mean(self, condition: str, tested_on: str) -> ConditionMean:
        """Return the mean score of a condition in a test.

        Raises:
            UnknownNameError: if there is no such condition or test. The message lists the known ones.
        """
        for it in self.means:
            if (it.condition, it.tested_on) == (condition, tested_on):
                return it
        known = ", ".join(f"{it.condition!r} on {it.tested_on}" for it in self.means)
        raise UnknownNameError(f"there is no {condition!r} on {tested_on}; there are {known}")

    def rows(self, table: Table = "means") -> list[dict[str, Any]]:
        """Return a table as a list of rows. Each row is a dictionary by column name, and a missing number is None.

        Args:
            table: `means`, `differences`, or `episodes` for one row per episode of every policy.
        """
        if table == "means":
            return [
                {
                    "condition": it.condition,
                    "tested_on": it.tested_on,
                    "seeds": it.seeds,
                    "mean": it.mean,
                    **_ends("seeds", it.seeds_interval),
                    "episodes": it.episodes,
                    **_ends("episodes", it.episodes_interval),
                }
                for it in self.means
            ]
        if table == "differences":
            return [
                {
                    "x": it.x,
                    "y": it.y,
                    "tested_on": it.tested_on,
                    "seeds_x": it.seeds[0],
                    "seeds_y": it.seeds[1],
                    "paired": it.paired,
                    "difference": it.difference,
                    **_ends("seeds", it.seeds_interval),
                    **_ends("episodes", it.episodes_interval),
                    "improvement": it.improvement,
                    "p": it.p,
                    "p_holm": it.p_holm,
                    "verdict": it.verdict,
                }
                for it in self.differences
            ]
        if table != "episodes":
            raise InvalidArgumentError(f"table={table!r}; expected 'means', 'differences' or 'episodes'")
        columns = self.columns()
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]

    def columns(self) -> dict[str, Any]:
        """Return all recorded episodes of all policies as columns: arrays [episodes] by column name.

        The columns are `condition`, `key` (the policy's key in its condition) and those of `Assessment.columns`.

        Raises:
            InvalidArgumentError: for rows of a results table, which have no episodes.
        """
        self._assessments()
        parts = [
            {"condition": condition, "key": key, **assessment.columns()}
            for condition, policies in self.evaluations.items()
            for key, assessment in policies.items()
        ]
        columns: dict[str, Any] = {}
        for name in parts[0]:
            values = [
                np.full(len(part["seed"]), part[name], dtype=object) if isinstance(part[name], str) else part[name]
                for part in parts
            ]
            columns[name] = np.concatenate(values)
        return columns

    def to_pandas(self, table: Table = "means") -> Any:
        """Return one of the tables of `rows` as a pandas DataFrame.

        Raises:
            ImportError: if pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise ImportError(
                "to_pandas() needs pandas, which perturb does not install: pip install pandas; rows() needs nothing"
            ) from error
        return pd.DataFrame(self.columns() if table == "episodes" else self.rows(table))

    def to_csv(self, path: str | os.PathLike[str] | None = None, table: Table = "means") -> str:
        """Return one of the tables of `rows` as CSV text, and write it to `path` if that is not None.

        Raises:
            OSError: if the file cannot be written.
        """
        rows = self.rows(table)
        written = io.StringIO()
        writer = csv.DictWriter(written, list(rows[0]) if rows else [], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        if path is not None:
            Path(path).write_text(written.getvalue(), "utf-8")
        return written.getvalue()

    def to_latex(self, table: Literal["means", "differences"] = "means") -> str:
        """Return a table as a LaTeX `tabular` environment. It uses the commands of the package booktabs."""
        if table not in ("means", "differences"):
            raise InvalidArgumentError(f"table={table!r}; expected 'means' or 'differences'")
        return as_latex(self._means_table() if table == "means" else self._differences_table())

    def to_html(self, path: str | os.PathLike[str] | None = None) -> str:
        """Return a self-contained HTML page with the verdict and the tables. Write it to `path` if that is not None.

        Raises:
            OSError: if the file cannot be written.
        """
        style = (
            "body{font:16px/1.5 system-ui,sans-serif;max-width:60em;margin:2em auto;padding:0 1em;color:#222}"
            "div{overflow-x:auto}table{border-collapse:collapse;margin:1em 0;white-space:nowrap}"
            "th,td{padding:.3em .8em;border-bottom:1px solid #ddd;text-align:right}"
            "th:first-child,td:first-child{text-align:left}"
        )
        conditions = dict.fromkeys(it.condition for it in self.means)
        title = html.escape(f"{' and '.join(conditions)} in {self.environment}")
        page = (
            '<!doctype html><html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{title}</title><style>{style}</style></head><body><h1>{title}</h1>{self._repr_html_()}</body></html>\n"
        )
        if path is not None:
            Path(path).write_text(page, "utf-8")
        return page

    def plot(
        self,
        tested_on: str | None = None,
        x: str | None = None,
        y: str | None = None,
        *,
        title: str | None = None,
        cbar: bool = True,
        axes: Any = None,
    ) -> Any:
        """Plot the success rate of each condition over the parameters that vary in a test.

        Success rates are over the episodes of all policies of a condition. If two parameters vary, each condition has a
        heatmap, and all heatmaps share one colour scale. If one parameter varies, each condition has a curve. Needs
        matplotlib: `pip install 'perturb-rl[plot]'`.

        Args:
            tested_on: the test. By default the last one in which a parameter varies.
            x: the parameter on the x axis. By default the first that varies.
            y: the parameter on the y axis. By default the next that varies.
            title: title of the plot. By default the environment, the success rule and the test.
            cbar: whether to draw a colour bar beside heatmaps.
            axes: matplotlib's axes to draw on, one for each heatmap. By default new ones.

        Returns:
            The axes of the curves, or an array with the axes of each heatmap.

        Raises:
            ImportError: if matplotlib is not installed.
            UnknownNameError: if there is no such test.
            InvalidArgumentError: if a parameter is unknown, or if none varies in the test.
        """
        # Choose the test and the parameters that are not given.
        first = self._assessments()[0]
        tests = list(dict.fromkeys(it.tested_on for it in self.means))
        if tested_on is None:
            varying = [test for test in tests if first.varying_parameters(test)]
            tested_on = varying[-1] if varying else tests[-1]
        elif tested_on not in tests:
            raise UnknownNameError(f"there is no test on {tested_on!r}; there are {', '.join(tests)}")
        unused = [name for name in first.varying_parameters(tested_on) if name not in (x, y)]
        x = x or (unused.pop(0) if unused else None)
        if x is None:
            raise InvalidArgumentError(f"no parameter varies in the test on {tested_on}: there is nothing to draw over")
        y = y or (unused.pop(0) if unused else None)
        title = title or f"{self._title()}: tested on {tested_on}"
        if y is None:  # one varying parameter: a curve for each condition
            lines = {
                name: plots.pooled([one.success_by_parameter(tested_on, x) for one in policies.values()])
                for name, policies in self.evaluations.items()
            }
            return plots.curves(lines, x, first.parameters, title, axes)
        panels = {
            name: plots.pooled_2d([one.success_by_parameters(tested_on, x, y) for one in policies.values()])
            for name, policies in self.evaluations.items()
        }
        return plots.heatmaps(panels, x, y, first.parameters, title, cbar, axes)

    def _assessments(self) -> list[Assessment]:
        if not self.evaluations:
            raise InvalidArgumentError("rows of a results table have no episodes; compare policies or assessments")
        return [one for policies in self.evaluations.values() for one in policies.values()]

    def __str__(self) -> str:
        tables = [self._means_table(), *([self._differences_table()] if self.differences else [])]
        return "\n\n".join([self._title(), *map(text, tables), f"{self.verdict}.", self._note()])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        tables = [self._means_table(), *([self._differences_table()] if self.differences else [])]
        shown = "".join(f"<div>{as_html(table)}</div>" for table in tables)
        first = f"<p>{html.escape(self._title())}</p><p><b>{html.escape(self.verdict)}.</b></p>"
        return f"{first}{shown}<p>{html.escape(self._note())}</p>"

    def _note(self) -> str:
        return _INTERVALS if self.evaluations else f"{_INTERVALS} {_COUNTS}"

    def _title(self) -> str:
        if not self.evaluations:
            return f"{self.environment}, rows of a results table"
        success = f"a success is {self.success}" if self.success else "the server decides about success"
        return f"{self.environment}, {success}"

    def _means_table(self) -> list[list[str]]:
        heading = _HEADINGS[self.score][0]
        head = ["condition", "tested on", "seeds", heading, "95 % over seeds", "episodes", "95 % over episodes"]
        rows = [
            [
                it.condition,
                it.tested_on,
                str(it.seeds),
                f"{it.mean:.1f}",
                _shown(it.seeds_interval),
                str(it.episodes),
                _shown(it.episodes_interval),
            ]
            for it in self.means
        ]
        return [head, *rows]

    def _differences_table(self) -> list[list[str]]:
        unit = _HEADINGS[self.score][1]
        head = [
            "difference",
            "tested on",
            unit,
            "by seed",
            "95 % over seeds",
            "95 % over episodes",
            "P(x > y)",
            "p, Holm",
        ]
        rows = [
            [
                f"{it.x} − {it.y}",
                it.tested_on,
                f"{it.difference:+.1f}",
                ", ".join(f"{one:+.1f}" for one in it.by_seed) if it.paired else "unpaired",
                _shown(it.seeds_interval, "+"),
                _shown(it.episodes_interval, "+"),
                f"{it.improvement:.2f}",
                "" if it.p_holm is None else f"{it.p_holm:.3f}",
            ]
            for it in self.differences
        ]
        return [head, *rows]


def _ends(of: str, interval: Interval | None) -> dict[str, float | None]:
    low, high = interval or (None, None)
    return {f"{of}_low_95": low, f"{of}_high_95": high}


def _shown(interval: Interval | None, sign: str = "") -> str:
    return "" if interval is None else f"[{interval[0]:{sign}.1f}, {interval[1]:{sign}.1f}]"
