"""What came of testing policies: records of every episode, and the figures that follow from them."""

from __future__ import annotations

import html
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from . import _native, requests
from .errors import InvalidArgumentError, UnknownNameError
from .policy import native

if TYPE_CHECKING:
    from collections.abc import Sequence

# What a folder says of the files beside it.
MANIFEST = "assessment.json"
FORMAT_VERSION = 1
METRICS = ("Default", "Interpolation", "Extrapolation")


@dataclass(frozen=True)
class Assessed:
    """The recorded tests of one policy, and what it was trained on, if that is known."""

    trained_on: str | None
    records: _native.Records


@dataclass(frozen=True)
class Result:
    """The figures of one test. Rates are in %, their intervals hold with 95 % confidence (Wilson, 1927)."""

    # The version that the policy was trained on, if that is known, and the set that it was tested on.
    trained_on: str | None
    tested_on: str
    # What records call the policy.
    policy: str
    episodes: int
    success_percent: float
    success_interval: tuple[float, float]
    # Undiscounted, never normalised; lengths in steps.
    mean_return: float
    mean_length: float
    # CVaR 10 %: the mean of the worst tenth of returns, rounded up (Rockafellar and Uryasev, 2000).
    cvar_return: float
    # The success rate in the worst tenth of contexts: parts of the parameter space of some 40 episodes each, chosen by
    # one half of the episodes and judged by the other. None where there are fewer than ten parts, as on D.
    worst_contexts_percent: float | None

    @property
    def scenario(self) -> str:
        """Training and test, such as `DR`; `D on parameters` of one's own set; the test alone if no more is known."""
        if self.trained_on is None:
            return self.tested_on
        named = self.tested_on in requests.VERSIONS
        return f"{self.trained_on}{self.tested_on}" if named else f"{self.trained_on} on {self.tested_on}"


@dataclass(frozen=True)
class Part:
    """Success in a part of a parameter's range, `low` to `high`. Rates are in %, None without episodes."""

    low: float
    high: float
    successes: int
    episodes: int
    success_percent: float | None
    success_interval: tuple[float, float] | None


class Assessment:
    """Recorded tests of policies in one environment. Shown as a table, in a notebook too.

    Attributes:
        environment: its name.
        success: what counted as a success, such as `steps at least 195`.
        parameters: the environment's parameters and their units.
        results: the figures of each test, in the order of training and test versions.
    """

    def __init__(self, assessed: Sequence[Assessed]) -> None:
        self._assessed = tuple(assessed)
        first = self._assessed[0].records
        self.environment: str = first.environment
        self.success: str | None = first.success
        self.parameters: dict[str, str] = dict(first.parameters)
        self.results: tuple[Result, ...] = tuple(
            Result(one.trained_on, tested_on, one.records.policy, *one.records.result(tested_on))
            for one in self._assessed
            for tested_on in one.records.sets
        )

    def __getitem__(self, scenario: str) -> Result:
        """The figures of a scenario, such as `DR`; of a test, such as `R`, if it is not known what was trained on."""
        for result in self.results:
            if result.scenario == scenario:
                return result
        known = ", ".join(result.scenario for result in self.results)
        raise UnknownNameError(f"there is no scenario {scenario!r}; there are {known}")

    @property
    def metrics(self) -> dict[str, float | None]:
        """The paper's three numbers, %: None where a scenario that one needs is not there.

        Default is the success rate of DD, Interpolation of RR, Extrapolation the geometric mean of DR, DE and RE
        (Packer et al., 2018, arXiv:1810.12282).
        """
        rates = {result.scenario: result.success_percent for result in self.results if result.trained_on is not None}
        return dict(zip(METRICS, _native.metrics(rates), strict=True))

    @property
    def published(self) -> dict[str, dict[str, tuple[float, float | None] | None]]:
        """The paper's numbers in this environment, %, by method and metric: mean and deviation over five runs."""
        return {
            method: dict(zip(METRICS, numbers, strict=True)) for method, numbers in _native.published(self.environment)
        }

    def success_by_parameter(self, scenario: str, parameter: str) -> tuple[Part, ...]:
        """Success over a parameter in a test: in tenths of the range of its values, in the parameter's unit.

        Where a tenth of the range has no values, as between E's two intervals, a part ends and another begins. Nothing
        if the parameter does not vary.

        Raises:
            UnknownNameError: for a scenario that was not tested.
            InvalidArgumentError: for another parameter than the environment's.
        """
        result = self[scenario]
        records = next(one.records for one in self._assessed if one.trained_on == result.trained_on)
        parts = native(records.success_by_parameter, result.tested_on, parameter)
        return tuple(
            Part(
                part_low,
                part_high,
                successes,
                episodes,
                100 * successes / episodes if episodes else None,
                (low, high) if episodes else None,
            )
            for part_low, part_high, successes, episodes, low, high in parts
        )

    def columns(self) -> dict[str, Any]:
        """Every episode, as arrays [episodes] by name: those of `perturb evaluate --records`, after `trained_on`.

        `trained_on`, `set`, `model_hash` and `ending` are arrays of text; where an episode achieved nothing, `achieved`
        is NaN.
        """
        tables = [(one.trained_on, one.records.columns()) for one in self._assessed]
        names = list(tables[0][1])
        counts = [len(table["seed"]) for _, table in tables]
        trained = np.repeat(np.array([trained or "" for trained, _ in tables], dtype=object), counts)
        columns = {"trained_on": trained}
        for name in names:
            parts = [
                np.array(table[name], dtype=object if isinstance(table[name], list) else None) for _, table in tables
            ]
            columns[name] = np.concatenate(parts)
        return columns

    def to_pandas(self) -> Any:
        """Every episode, as a pandas DataFrame of `columns`.

        Raises:
            ImportError: if pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise ImportError(
                "to_pandas() needs pandas, which perturb does not bring: pip install pandas; columns() needs nothing"
            ) from error
        return pd.DataFrame(self.columns())

    def save(self, folder: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write every record: of each policy a Parquet file, as `perturb evaluate --records` writes it.

        Args:
            folder: it must be new or empty, unless an assessment in it may be overwritten.
            overwrite: whether it may.

        Raises:
            InvalidArgumentError: if it holds something else.
            OSError: if it cannot be written.
        """
        path = Path(folder)
        if path.is_dir() and any(path.iterdir()):
            if not overwrite or not (path / MANIFEST).is_file():
                instead = "overwrite=True replaces it" if (path / MANIFEST).is_file() else "name another folder"
                raise InvalidArgumentError(f"{path} is not empty; {instead}")
            (path / MANIFEST).unlink()  # what is half overwritten is no assessment
            for earlier in path.glob("episodes*.parquet"):
                earlier.unlink()
        path.mkdir(parents=True, exist_ok=True)
        policies = []
        for one in self._assessed:
            file = "episodes.parquet" if one.trained_on is None else f"episodes-{one.trained_on}.parquet"
            native(one.records.write, str(path / file))
            policies.append({"trained_on": one.trained_on, "file": file})
        written = path / f".{MANIFEST}.tmp"
        document = {"format_version": FORMAT_VERSION, "environment": self.environment, "policies": policies}
        written.write_text(json.dumps(document, indent=2) + "\n", "utf-8")
        written.replace(path / MANIFEST)

    @staticmethod
    def load(folder: str | os.PathLike[str]) -> Assessment:
        """Read what `save` wrote.

        Raises:
            InvalidArgumentError: if there is no assessment, or one that is damaged or of a later version of perturb.
        """
        path = Path(folder)
        try:
            document = json.loads((path / MANIFEST).read_text("utf-8"))
            version = document["format_version"]
            entries = [(policy["trained_on"], policy["file"]) for policy in document["policies"]]
        except FileNotFoundError as error:
            raise InvalidArgumentError(f"{path} holds no assessment: {MANIFEST} is not there") from error
        except (ValueError, KeyError, TypeError) as error:
            raise InvalidArgumentError(f"{path / MANIFEST} is damaged: {error!r}") from error
        if version != FORMAT_VERSION:
            raise InvalidArgumentError(f"{path / MANIFEST} has format {version!r}; this package reads {FORMAT_VERSION}")
        assessed = []
        for trained_on, file in entries:  # a file's name is that of one beside this, whatever is said of its folder
            if trained_on is not None:
                requests.version(trained_on, f"{path / MANIFEST}: trained_on")
            assessed.append(Assessed(trained_on, native(_native.Records.read, str(path / Path(str(file)).name))))
        if len({one.records.environment for one in assessed}) != 1:
            raise InvalidArgumentError(f"{path / MANIFEST} names policies of no environment, or of several")
        return Assessment(assessed)

    def __str__(self) -> str:
        tests, comparison = self._tables()
        return "\n\n".join([self._title(), _text(tests), *([_text(comparison)] if comparison else [])])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        tests, comparison = self._tables()
        tables = "".join(_html(table) for table in (tests, comparison) if table)
        return f"<p>{html.escape(self._title())}</p>{tables}"

    def _title(self) -> str:
        return f"{self.environment}, a success is {self.success or 'what the server says'}"

    def _tables(self) -> tuple[list[list[str]], list[list[str]]]:
        """The tests' figures; and the paper's three numbers beside the paper's, if there are any."""
        known = any(result.trained_on is not None for result in self.results)
        head = ["scenario" if known else "tested on", "episodes", "success, %", "95 %", "worst contexts, %"]
        tests = [[*head, "return", "CVaR 10 %", "length", "policy"]]
        for it in self.results:
            low, high = it.success_interval
            worst = "" if it.worst_contexts_percent is None else f"{it.worst_contexts_percent:.1f}"
            figures = [it.scenario, str(it.episodes), f"{it.success_percent:.1f}", f"[{low:.1f}, {high:.1f}]", worst]
            numbers = [it.mean_return, it.cvar_return, it.mean_length]
            tests.append([*figures, *(f"{number:.1f}" for number in numbers), it.policy])
        metrics = self.metrics
        if all(number is None for number in metrics.values()) or not self.published:
            return tests, []
        comparison = [["%", *METRICS]]
        comparison.append(["here", *("" if number is None else f"{number:.1f}" for number in metrics.values())])
        comparison += [[f"paper: {method}", *map(_spread, its.values())] for method, its in self.published.items()]
        return tests, comparison


def _spread(number: tuple[float, float | None] | None) -> str:
    if number is None:
        return ""
    mean, std = number
    return f"{mean:.1f}" if std is None else f"{mean:.1f} ± {std:.1f}"


def _text(table: list[list[str]]) -> str:
    """Columns under each other, the first to the left."""
    widths = [max(len(row[column]) for row in table) for column in range(len(table[0]))]
    lines = (
        [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        for row in table
    )
    return "\n".join("  ".join(line).rstrip() for line in lines)


def _html(table: list[list[str]]) -> str:
    def row(cells: list[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    return "<table>" + row(table[0], "th") + "".join(row(cells, "td") for cells in table[1:]) + "</table>"
