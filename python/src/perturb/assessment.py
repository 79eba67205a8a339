"""Assessments: recorded test episodes of policies, and the statistics that are computed from them."""

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
    """The recorded tests of one policy, or of several related policies, in one environment.

    `print` and notebooks show an assessment as a table.

    Attributes:
        agent: the name of the policies in reports: the argument `name` of `evaluate`, or else the kind of the policies,
            such as `ppo ff`.
        environment: the name of the environment.
        success: the success rule as a phrase, such as `steps at least 195`. None if the server decided about success
            and stated no rule.
        parameters: the unit of each parameter of the environment, by the parameter's name.
        results: the statistics of each test, ordered by training version and then by test set.
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
        """Pickle the files that `save` writes."""
        with tempfile.TemporaryDirectory(prefix="perturb-") as folder:
            native(self._native.write, folder, False)
            return _unpickled_assessment, (read_folder(folder),)

    def __getitem__(self, scenario: str) -> Result:
        """Return the result of a scenario, such as `DR` or `D on corners`.

        The name of a test set, such as `corners`, is enough if only one policy was tested on that set.

        Raises:
            UnknownNameError: if there is no such scenario. The message lists the known ones.
        """
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
        """The three metrics of Packer et al. (2018, arXiv:1810.12282), in %, by name.

        In a scenario such as DR, the policy was trained on D and tested on R. `Default` is the success rate of DD, and
        `Interpolation` that of RR. `Extrapolation` is the geometric mean of the success rates of DR, DE and RE. A
        metric is None if one of its scenarios was not tested.
        """
        rates = {result.scenario: result.success_percent for result in self.results if result.trained_on is not None}
        return dict(zip(METRICS, _native.metrics(rates), strict=True))

    @property
    def published(self) -> dict[str, dict[str, tuple[float, float | None] | None]]:
        """The metrics that Packer et al. (2018) published for this environment, in %, by method and metric.

        Each value is the mean and the standard deviation over five runs. It is None if the paper does not have it.
        """
        return {
            method: dict(zip(METRICS, numbers, strict=True)) for method, numbers in _native.published(self.environment)
        }

    def success_by_parameter(self, scenario: str, parameter: str) -> tuple[Bin, ...]:
        """Return the success rate of a scenario in each bin of a parameter's range.

        The range of the parameter's values is divided into about ten equal bins. Bin edges are in the parameter's unit.
        If two neighbouring values differ by a tenth of the range or more, no bin covers the gap between them, such as
        the gap between E's two intervals. The points of a coarse grid thus have one bin each, of width 0. The result is
        empty if the parameter does not vary in this scenario.

        Raises:
            UnknownNameError: if the scenario was not tested.
            InvalidArgumentError: if the environment has no such parameter.
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
        """Return the success rate of a scenario in each cell of a grid over two parameters.

        The grid combines the bins that `success_by_parameter` returns for x and for y. Cells are ordered by y, then by
        x. The result is empty if one of the two parameters does not vary in this scenario.

        Raises:
            UnknownNameError: if the scenario was not tested.
            InvalidArgumentError: if the environment has no such parameter.
        """
        result, records = self._find(scenario)
        cells = native(records.success_by_parameters, result.tested_on, x, y)
        return tuple(
            Bin2D(in_x, in_y, successes, episodes, 100 * successes / episodes if episodes else None)
            for in_x, in_y, successes, episodes in cells
        )

    def worst_contexts(self, scenario: str, count: int = 10) -> tuple[Context, ...]:
        """Return the contexts of a scenario with the lowest success rates, worst first.

        Contexts with equal success rates are ordered by mean return, lowest first. If the test set is a list or a grid,
        the contexts are those of the list or grid. If parameters are drawn, each context is a region of the parameter
        space with about 40 episodes. In all three cases the same episodes both select the worst contexts and measure
        them, so these contexts look worse than they are. `Result.worst_contexts_percent` does not have this bias.

        Args:
            scenario: such as `DE`.
            count: maximum number of contexts to return.

        Raises:
            UnknownNameError: if the scenario was not tested.
        """
        result, records = self._find(scenario)
        # The rows of this test, and for each of its episodes the number of its context, from 0.
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
        """Return the names of the parameters that vary between the episodes of a scenario.

        Raises:
            UnknownNameError: if the scenario was not tested.
        """
        result, records = self._find(scenario)
        columns = records.columns()
        tested = np.array(columns["set"]) == result.tested_on
        return tuple(name for name in self.parameters if len(set(columns[f"requested_{name}"][tested].tolist())) > 1)

    def judged_by(self, success: SuccessRule) -> Assessment:
        """Return an assessment of the same episodes, judged by another success rule.

        Args:
            success: the success rule, as in `evaluate`. A threshold can only use a quantity that was recorded.

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
        """Plot the success rate over a parameter, with 95 % Wilson intervals.

        Each scenario in which the parameter varies has one line. Needs matplotlib: `pip install 'perturb-rl[plot]'`.

        Args:
            parameter: name of the parameter.
            scenarios: names of scenarios. By default all.
            title: title of the plot. By default the environment and the success rule.
            axes: matplotlib's axes to draw on. By default new ones.

        Returns:
            The axes.

        Raises:
            ImportError: if matplotlib is not installed.
            UnknownNameError: if a scenario was not tested.
            InvalidArgumentError: if the parameter is unknown, or varies in none of the scenarios.
        """
        named = [result.scenario for result in self.results] if scenarios is None else list(scenarios)
        lines = {name: self.success_by_parameter(name, parameter) for name in named}
        return plots.curves(lines, parameter, self.parameters, title or self._title(), axes)

    def plot_heatmap(
        self, scenario: str, x: str, y: str, *, title: str | None = None, cbar: bool = True, axes: Any = None
    ) -> Any:
        """Plot the success rate of a scenario over two parameters as a heatmap.

        Needs matplotlib: `pip install 'perturb-rl[plot]'`.

        Args:
            scenario: such as `DE`.
            x: the parameter on the x axis.
            y: the parameter on the y axis.
            title: title of the plot. By default the environment, the success rule and the scenario.
            cbar: whether to draw a colour bar.
            axes: matplotlib's axes to draw on. By default new ones.

        Returns:
            The axes.

        Raises:
            ImportError: if matplotlib is not installed.
            UnknownNameError: if the scenario was not tested.
            InvalidArgumentError: if a parameter is unknown, or does not vary in this scenario.
        """
        cells = self.success_by_parameters(scenario, x, y)
        title = title or f"{self._title()}: {scenario}"
        return plots.heatmap(cells, x, y, self.parameters, title, axes, cbar)

    def columns(self) -> dict[str, Any]:
        """Return all recorded episodes as columns: arrays [episodes] by column name.

        The first column, `trained_on`, is the version that the policy was trained on; empty if unknown. The others are
        the columns of `perturb evaluate --records`. `trained_on`, `set`, `model_hash` and `ending` are arrays of text.
        `achieved` is NaN where an episode has no value of the quantity that the success rule compares.
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
        """Return all recorded episodes as a pandas DataFrame, with the columns of `columns`.

        Raises:
            ImportError: if pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise ImportError(
                "to_pandas() needs pandas, which perturb does not install: pip install pandas; columns() needs nothing"
            ) from error
        return pd.DataFrame(self.columns())

    def save(self, folder: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Save the assessment to a folder.

        The folder gets a file `assessment.json` and, for each policy, a file of records as `perturb evaluate --records`
        writes it. Pass the folder to `perturb report` to show the assessment beside an experiment, or to `to_html` to
        show it beside other assessments. `perturb audit` replays the tests if the policies were trained by perturb.

        Args:
            folder: path of the folder. It must be new or empty. With `overwrite` it may also contain an assessment.
            overwrite: whether to replace an assessment that is in the folder.

        Raises:
            InvalidArgumentError: if the folder is not empty and must not be overwritten.
            OSError: if a file cannot be written.
        """
        native(self._native.write, os.fspath(folder), overwrite)
        self._native = native(_native.Assessment.read, os.fspath(folder))  # reads the folder's name, too

    @staticmethod
    def load(folder: str | os.PathLike[str]) -> Assessment:
        """Load an assessment from a folder that `save` wrote.

        Raises:
            InvalidArgumentError: if the folder has no assessment, or if the assessment is damaged or was written by a
                later version of perturb.
        """
        read = native(_native.Assessment.read, os.fspath(folder))
        assessment = _assessment(read)
        assessment._native = read  # knows the folder's name
        return assessment

    def to_html(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        beside: Sequence[str | os.PathLike[str] | Assessment] = (),
    ) -> str:
        """Make the report page of `perturb report`: a self-contained HTML page with tables and figures.

        Args:
            path: a file to write the page to. By default the page is only returned.
            beside: other assessments, or their folders, to show on the same page. At most one entry may be an
                experiment: the `--out` folder of `perturb run`, or a study of a results table, `FILE.parquet/STUDY`.
                The success rule of the experiment then judges all assessments.

        Returns:
            The page as HTML.

        Raises:
            InvalidArgumentError: if a folder is damaged, or holds neither an assessment nor an experiment.
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
        """Repeat all recorded episodes with the same policy, and compare the outcomes with the records.

        Use this method for policies that only Python can load. For policies that perturb trained, `perturb audit` does
        the same on any machine. A policy that samples with torch or NumPy gives equal outcomes only on the same kind of
        machine with the same packages.

        Args:
            policy: the tested policy. If several policies were tested, a mapping from training versions to policies.
            normalizer: as in `evaluate`.
            server: as in `evaluate`.
            task: as in `evaluate`. If its files have changed since the recorded tests, the episodes differ.
            timeout: as in `evaluate`.

        Raises:
            PolicyError: if this is not the recorded policy, or if the policy fails.
            InvalidArgumentError: if the keys of the mapping are not the versions that the policies were trained on.
            ServerConnectionError: as in `evaluate`.
            ServerTimeoutError: as in `evaluate`.
            ServerStartError: as in `evaluate`.
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
        success = f"a success is {self.success}" if self.success else "the server decides about success"
        return f"{self.environment}, {success}{actions}"


def _unpickled_assessment(files: dict[str, bytes]) -> Assessment:
    with tempfile.TemporaryDirectory(prefix="perturb-") as folder:
        write_folder(folder, files)
        return _assessment(native(_native.Assessment.read, folder))


def _assessment(read: _native.Assessment) -> Assessment:
    return Assessment(
        read.agent, [PolicyRecords(PolicyMetadata(*known), records) for known, records in read.policies()]
    )
