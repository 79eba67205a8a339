"""Assessments: records of every episode of tests, and the figures that follow from them."""

from __future__ import annotations

import html
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from . import _native, plots, requests, success_rules
from .contents import read_folder, write_folder
from .errors import InvalidArgumentError, UnknownNameError
from .policy import native
from .results import Audit, Bin, Bin2D, Context, PolicyMetadata, PolicyRecords, Result
from .tables import ACTIONS, METRICS, as_html, tables, text
from .testing import replay

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .success_rules import SuccessRule


class Assessment:
    """Recorded tests of an agent's policies in one environment. Shown as a table, in a notebook too.

    Attributes:
        agent: what reports call it: the `name` of the tests, or the policies' kind.
        environment: its name.
        success: what counted as a success, such as `steps at least 195`.
        parameters: the environment's parameters and their units.
        results: the figures of each test, in the order of training and test versions.
    """

    def __init__(self, agent: str, assessed: Sequence[PolicyRecords]) -> None:
        self._assessed = tuple(assessed)
        self._native = native(_native.Assessment, agent, [(one.known.plain(), one.records) for one in assessed])
        self.agent = agent
        first = self._assessed[0].records
        self.environment: str = first.environment
        self.success: str | None = first.success
        self.parameters: dict[str, str] = dict(first.parameters)
        self.results: tuple[Result, ...] = tuple(
            Result(
                one.trained_on,
                tested_on,
                one.records.policy,
                *one.records.result(tested_on),
                deterministic=one.known.deterministic,
            )
            for one in self._assessed
            for tested_on in one.records.sets
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what `save` writes."""
        with tempfile.TemporaryDirectory(prefix="perturb-") as folder:
            native(self._native.write, folder, False)
            return _unpickled_assessment, (read_folder(folder),)

    def __getitem__(self, scenario: str) -> Result:
        """The figures of a scenario, such as `DR` or `D on corners`, or of a test, such as `corners`."""
        for result in self.results:
            if result.scenario == scenario:
                return result
        tested = [result for result in self.results if result.tested_on == scenario]
        if len(tested) == 1:
            return tested[0]
        known = ", ".join(result.scenario for result in self.results)
        raise UnknownNameError(f"there is no scenario {scenario!r}; there are {known}")

    @property
    def metrics(self) -> dict[str, float | None]:
        """The paper's three numbers, %. A number is None if a scenario that it needs was not tested.

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

    def success_by_parameter(self, scenario: str, parameter: str) -> tuple[Bin, ...]:
        """Success over a parameter in a test: in tenths of the range of its values, in the parameter's unit.

        Parts have gaps where a tenth of the range has no values, as between E's two intervals. The result is empty if
        the parameter does not vary.

        Raises:
            UnknownNameError: for a scenario that was not tested.
            InvalidArgumentError: for another parameter than the environment's.
        """
        result, records = self._find(scenario)
        parts = native(records.success_by_parameter, result.tested_on, parameter)
        return tuple(
            Bin(
                part_low,
                part_high,
                successes,
                episodes,
                100 * successes / episodes if episodes else None,
                (low, high) if episodes else None,
            )
            for part_low, part_high, successes, episodes, low, high in parts
        )

    def success_by_parameters(self, scenario: str, x: str, y: str) -> tuple[Bin2D, ...]:
        """Success over two parameters in a test: in the parts of `success_by_parameter` of either, by y, then x.

        Nothing if one of them does not vary.

        Raises:
            UnknownNameError: for a scenario that was not tested.
            InvalidArgumentError: for another parameter than the environment's.
        """
        result, records = self._find(scenario)
        cells = native(records.success_by_parameters, result.tested_on, x, y)
        return tuple(
            Bin2D(in_x, in_y, successes, episodes, 100 * successes / episodes if episodes else None)
            for in_x, in_y, successes, episodes in cells
        )

    def worst_contexts(self, scenario: str, count: int = 10) -> tuple[Context, ...]:
        """Give the contexts of a test with the lowest success rates, the worst first; of equal ones the lowest return.

        For a list, contexts are its own. If parameters are drawn, contexts are parts of the parameter space with some
        40 episodes each. The same episodes choose the worst parts and say how bad they are, so these parts look worse
        than they are. A result's `worst_contexts_percent` does not have this bias.

        Raises:
            UnknownNameError: for a scenario that was not tested.
        """
        result, records = self._find(scenario)
        every = records.columns()
        tested = np.array(every["set"]) == result.tested_on
        columns = {name: np.asarray(values)[tested] for name, values in every.items()}
        parts = np.array(records.parts(result.tested_on))
        varying = self.varying_parameters(scenario)
        contexts = []
        for part in np.unique(parts):
            rows = parts == part
            values = {name: columns[f"requested_{name}"][rows] for name in varying}
            successes, episodes = int(columns["success"][rows].sum()), int(rows.sum())
            low, high = _native.wilson(successes, episodes)
            contexts.append(
                Context(
                    {name: (float(it.min()), float(it.max())) for name, it in values.items()},
                    successes,
                    episodes,
                    100 * successes / episodes,
                    (100 * low, 100 * high),
                    float(columns["return"][rows].mean()),
                )
            )
        contexts.sort(key=lambda context: (context.success_percent, context.mean_return))
        return tuple(contexts[: requests.count(count, "count", 1)])

    def varying_parameters(self, scenario: str) -> tuple[str, ...]:
        """Give the names of the parameters that vary in a test.

        Raises:
            UnknownNameError: for a scenario that was not tested.
        """
        result, records = self._find(scenario)
        columns = records.columns()
        tested = np.array(columns["set"]) == result.tested_on
        return tuple(name for name in self.parameters if len(set(columns[f"requested_{name}"][tested].tolist())) > 1)

    def judged_by(self, success: SuccessRule) -> Assessment:
        """Give the same episodes with another rule of success.

        Args:
            success: as in `evaluate`; a threshold must be of a quantity that was recorded.

        Raises:
            InvalidArgumentError: if the rule is malformed, or needs a quantity that was not recorded.
        """
        text, own = success_rules.parse(success)

        def judge(records: _native.Records) -> _native.Records:
            return records.judged_by(text) if text is not None else own.judge(records) if own is not None else records

        return Assessment(self.agent, [PolicyRecords(one.known, native(judge, one.records)) for one in self._assessed])

    def plot_curves(
        self, parameter: str, scenarios: Sequence[str] | None = None, *, title: str | None = None, axes: Any = None
    ) -> Any:
        """Draw success over a parameter, with 95 % Wilson intervals: a line for each scenario where it varies.

        Args:
            parameter: its name.
            scenarios: names of scenarios; by default all.
            title: by default the environment and the rule of success.
            axes: matplotlib's axes to draw on; by default new ones.

        Returns the axes. Needs matplotlib: `pip install 'perturb-rl[plot]'`.

        Raises:
            ImportError: if matplotlib is not installed.
            UnknownNameError, InvalidArgumentError: for an unknown scenario or parameter, or one that does not vary.
        """
        named = [result.scenario for result in self.results] if scenarios is None else list(scenarios)
        lines = {name: self.success_by_parameter(name, parameter) for name in named}
        return plots.curves(lines, parameter, self.parameters, title or self._title(), axes)

    def plot_heatmap(
        self, scenario: str, x: str, y: str, *, title: str | None = None, cbar: bool = True, axes: Any = None
    ) -> Any:
        """Draw success over two parameters of a test as a heatmap.

        Args:
            scenario: such as `DE`.
            x: the parameter along x.
            y: the parameter along y.
            title: by default the environment, the rule of success and the scenario.
            cbar: whether there is a colour bar.
            axes: matplotlib's axes to draw on; by default new ones.

        Returns the axes. Needs matplotlib: `pip install 'perturb-rl[plot]'`.

        Raises:
            ImportError: if matplotlib is not installed.
            UnknownNameError, InvalidArgumentError: for an unknown scenario or parameter, or one that does not vary.
        """
        cells = self.success_by_parameters(scenario, x, y)
        title = title or f"{self._title()}: {scenario}"
        return plots.heatmap(cells, x, y, self.parameters, title, axes, cbar)

    def columns(self) -> dict[str, Any]:
        """Every episode, as arrays [episodes] by name: those of `perturb evaluate --records`, after `trained_on`.

        `trained_on`, `set`, `model_hash` and `ending` are arrays of text. `achieved` is NaN where an episode achieved
        nothing.
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
        """Write `assessment.json`, and for each policy a file such as `perturb evaluate --records` writes.

        `perturb report` shows such a folder beside an experiment, and `to_html` beside other assessments.
        `perturb audit` replays the tests of perturb's policies.

        Args:
            folder: it must be new or empty, unless an assessment in it may be overwritten.
            overwrite: whether it may.

        Raises:
            InvalidArgumentError: if it holds something else.
            OSError: if it cannot be written.
        """
        native(self._native.write, os.fspath(folder), overwrite)
        self._native = native(_native.Assessment.read, os.fspath(folder))  # which knows its folder's name

    @staticmethod
    def load(folder: str | os.PathLike[str]) -> Assessment:
        """Read what `save` wrote.

        Raises:
            InvalidArgumentError: if there is no assessment, or one that is damaged or of a later version of perturb.
        """
        read = native(_native.Assessment.read, os.fspath(folder))
        assessment = _assessment(read)
        assessment._native = read  # which knows its folder's name
        return assessment

    def to_html(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        beside: Sequence[str | os.PathLike[str] | Assessment] = (),
    ) -> str:
        """Make the page of `perturb report`: tables and figures in one file that needs nothing else.

        Args:
            path: a file to write it to, too.
            beside: what else is on the page: other assessments, or their folders, and at most one experiment (the
                `--out` of `perturb run`, or the study of a results table, `FILE.parquet/STUDY`), whose rule of success
                then judges all.

        Returns the page, HTML.

        Raises:
            InvalidArgumentError: for a folder that is neither, or is damaged.
            OSError: if a file cannot be read or written.
        """
        if isinstance(beside, str | os.PathLike | Assessment):
            raise InvalidArgumentError(f"beside is {beside!r}; expected a list of folders and assessments")
        others = [one for one in beside if isinstance(one, Assessment)]
        folders = [os.fspath(one) for one in beside if not isinstance(one, Assessment)]
        page: str = native(_native.report_page, [self._native, *(one._native for one in others)], folders)
        if path is not None:
            Path(path).write_text(page, "utf-8")
        return page

    def audit(
        self,
        policy: Any,
        *,
        normalizer: Any = None,
        server: str | None = None,
        task: str | os.PathLike[str] | None = None,
        timeout: float = 60.0,
    ) -> Audit:
        """Test the same policy again in all recorded episodes, and compare all results.

        Use it for policies that only Python can load; `perturb audit` replays those of perturb, on any machine. A
        policy that samples with torch or NumPy gives equal results on the same kind of machine with the same packages.

        Args:
            policy: what was tested: a policy, or a mapping of all by what they were trained on.
            normalizer: as in `evaluate`.
            server: as in `evaluate`.
            task: as in `evaluate`. A folder whose files changed gives other episodes.
            timeout: as in `evaluate`.

        Raises:
            PolicyError: for another policy than the recorded one, or one that fails.
            InvalidArgumentError: for a mapping with other keys than what was trained on.
            ServerConnectionError, ServerTimeoutError, ServerStartError: as in `evaluate`.
        """
        return replay(self._assessed, self.agent, policy, normalizer, server, task, timeout)

    def _find(self, scenario: str) -> tuple[Result, _native.Records]:
        result = self[scenario]
        return result, next(one.records for one in self._assessed if one.trained_on == result.trained_on)

    def __str__(self) -> str:
        return "\n\n".join([self._title(), *map(text, self._tables())])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return f"<p>{html.escape(self._title())}</p>{''.join(map(as_html, self._tables()))}"

    def _tables(self) -> list[list[list[str]]]:
        return tables(self.results, self.metrics, self.published)

    def _title(self) -> str:
        how = {ACTIONS[result.deterministic] for result in self.results} - {""}
        actions = f"; actions are {' or '.join(sorted(how))}" if how else ""
        return f"{self.environment}, a success is {self.success or 'what the server says'}{actions}"


def _unpickled_assessment(files: dict[str, bytes]) -> Assessment:
    with tempfile.TemporaryDirectory(prefix="perturb-") as folder:
        write_folder(folder, files)
        return _assessment(native(_native.Assessment.read, folder))


def _assessment(read: _native.Assessment) -> Assessment:
    return Assessment(
        read.agent, [PolicyRecords(PolicyMetadata(*known), records) for known, records in read.policies()]
    )
