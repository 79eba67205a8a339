"""Custom test sets, in addition to D, R, E and R+E: drawn parameters, grids and lists, as in experiment files.

    corners = perturb.sets.grid("corners", {"length": [0.1, 1.0], "mass": "0.05..0.5/4"})
    long = perturb.sets.drawn("long_poles", {"length": (0.7, 0.8)}, base="R")
    perturb.evaluate(policy, "CartPole", versions=["D", long, corners])

Grids and lists can also be trained on. Pass them as `contexts` to PerturbVectorEnv or `perturb.sb3.make_vec_env`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from . import _native, requests
from .environments import Environment, environments
from .errors import InvalidArgumentError, UnknownNameError
from .policy import native
from .task_folder import describe, find_folder

__all__ = ["Set", "drawn", "grid", "heatmap", "listed", "read", "read_csv", "sampled"]


@dataclass(frozen=True)
class Set:
    """A custom set of parameter values to test policies on. The functions of this module make sets.

    Attributes:
        name: the set's name in results.
        base: the version that all other parameters come from.
        parameters: for each parameter, the intervals [(low, high), …] from which it is drawn for each episode. A fixed
            value is an interval of length 0. Empty for grids and lists.
        contexts: the contexts of a grid or a list. A context is a mapping from names of parameters to values. All
            contexts get the same number of episodes. None if parameters are drawn.
    """

    name: str
    base: requests.Version
    parameters: Mapping[str, Sequence[tuple[float, float]]] = field(default_factory=dict)
    contexts: tuple[Mapping[str, float], ...] | None = None

    def _plain(self) -> _native.Set:
        contexts = None if self.contexts is None else [dict(context) for context in self.contexts]
        return self.name, self.base, {name: list(values) for name, values in self.parameters.items()}, contexts


def drawn(name: str, parameters: Mapping[str, requests.ParameterSet], *, base: requests.Version = "D") -> Set:
    """Make a set whose parameters are drawn for each episode.

    Args:
        name: the set's name, of letters, digits and _.
        parameters: the values of each parameter, in its unit: a number, an interval `(low, high)`, several intervals
            `[(low, high), …]`, or a text as in experiment files, such as `"0.3..0.4,0.8..0.9"`.
        base: the version that all other parameters come from.

    Raises:
        InvalidArgumentError: if an argument is malformed.
    """
    made = _made(name, base, {key: _drawn(key, values) for key, values in _mapping(parameters).items()})
    if made.contexts is not None:
        raise InvalidArgumentError(f"the set {name!r} has points: give them to perturb.sets.grid()")
    return made


def grid(name: str, points: Mapping[str, float | Sequence[float] | str], *, base: requests.Version = "D") -> Set:
    """Make a grid: a set with one context for every combination of the points. The first parameter varies fastest.

    All contexts get the same number of episodes.

    Args:
        name: the set's name, of letters, digits and _.
        points: the points of each parameter, in its unit: a number, a list such as `[0.1, 0.2]`, or a text as in
            experiment files. `"0.1..1.0/10"` means ten points from 0.1 to 1.0. At most 16 384 combinations.
        base: the version that all other parameters come from.

    Raises:
        InvalidArgumentError: if an argument is malformed.
    """
    made = _made(name, base, {key: _points(key, values) for key, values in _mapping(points).items()})
    return made if made.contexts is not None else listed(name, [_values(made.parameters)], base=base)


def listed(name: str, contexts: Sequence[Mapping[str, float]], *, base: requests.Version = "D") -> Set:
    """Make a set of the given contexts. All contexts get the same number of episodes.

    Args:
        name: the set's name, of letters, digits and _.
        contexts: the contexts. Each is a mapping from parameters to values, in the parameter's unit.
        base: the version that all other parameters come from.

    Raises:
        InvalidArgumentError: if an argument is malformed.
    """
    return Set(_name(name), requests.version(base, "base"), {}, tuple(requests.contexts(contexts)))


def sampled(
    name: str,
    environment: str,
    count: int,
    *,
    version: requests.Version = "R",
    seed: int = 1,
    task: str | os.PathLike[str] | None = None,
) -> Set:
    """Make a set of contexts that are drawn once from R or E.

    Use it to train on a limited number of contexts, or to test on the same contexts again. Each parameter is drawn
    uniformly from its intervals. The same seed gives the same contexts. A smaller count gives the first contexts of a
    larger count.

    Args:
        name: the set's name, of letters, digits and _.
        environment: the environment's name.
        count: the number of contexts, 1 … 16 384.
        version: the version to draw from, `R` or `E`.
        seed: fixes the contexts, 0 … 2^64 - 1.
        task: the folder of the environment's task, if it is a task from a folder.

    Raises:
        InvalidArgumentError: if the environment is unknown, the version is neither R nor E, or the count is out of its
            range.
    """
    parameters = _environment(environment, task).parameters
    version = requests.version(version)
    if version not in ("R", "E"):
        raise InvalidArgumentError(f"version={version!r}; expected 'R' or 'E', which contexts are drawn from")
    generator = np.random.Generator(np.random.PCG64(requests.seed(seed)))
    contexts: list[dict[str, float]] = []
    for _ in range(requests.count(count, "count", 1, _native.MAX_CONTEXTS)):
        context = {}
        for parameter in parameters.values():
            intervals = parameter.random if version == "R" else parameter.extreme
            # Draw a position, uniform on all intervals laid end to end, and find the value at that position.
            place = generator.random() * sum(high - low for low, high in intervals)
            for low, high in intervals:
                if place <= high - low:
                    break
                place -= high - low
            context[parameter.name] = min(low + place, high)
        contexts.append(context)
    return listed(name, contexts)


def heatmap(
    environment: str,
    x: str | None = None,
    y: str | None = None,
    *,
    points: int = 10,
    base: requests.Version = "D",
    fixed: Mapping[str, float] | None = None,
    task: str | os.PathLike[str] | None = None,
) -> Set:
    """Make a grid over two parameters for a heatmap. Reports draw a heatmap for each policy that was tested on it.

    The set is named `heatmap` and equals the set of `perturb heatmap`. Along each axis, the range that R and E cover
    together is divided into `points` equal bins, and the grid points are the centres of the bins.

    Args:
        environment: the environment's name.
        x: the parameter on the x axis. By default the first of the environment's `heatmap_axes`.
        y: the parameter on the y axis. By default the second of the environment's `heatmap_axes`.
        points: the number of points along each axis, 2 … 100. All points get the same number of episodes, at least 1.
        base: the version that all other parameters come from.
        fixed: fixed values of other parameters, by name.
        task: the folder of the environment's task, if it is a task from a folder.

    Raises:
        UnknownNameError: if x or y is not a parameter of the environment.
        InvalidArgumentError: if the environment is unknown, if the number of points is out of range, if a parameter is
            given twice, or if x or y is left out and the environment has no default axes.
    """
    # The range of each axis is from the lowest to the highest value that R and E draw.
    known = _environment(environment, task)
    usual = known.heatmap_axes or (None, None)
    axes = (usual[0] if x is None else x, usual[1] if y is None else y)
    ranges = []
    for name in axes:
        if name is None:
            raise InvalidArgumentError(f"give x= and y=: {known.name} has no default heatmap axes")
        if name not in known.parameters:
            raise UnknownNameError(f"{known.name} has no parameter {name!r}, only {', '.join(known.parameters)}")
        intervals = known.parameters[name].random + known.parameters[name].extreme
        ranges.append((name, min(low for low, _ in intervals), max(high for _, high in intervals)))
    wrong = [name for name in axes if name in (fixed or {})]
    if axes[0] == axes[1] or wrong:
        raise InvalidArgumentError(
            f"{wrong[0] if wrong else axes[0]} is given twice; an axis cannot also be the other axis or in fixed"
        )
    points = requests.count(points, "points", 2, _native.MAX_HEATMAP_POINTS)
    contexts = native(_native.heatmap_contexts, ranges, points, dict(fixed or {}))
    return listed(_native.HEATMAP_SET, contexts, base=base)


def read_csv(name: str, path: str | os.PathLike[str], *, base: requests.Version = "D") -> Set:
    """Read a set of contexts from a CSV file.

    The header has the names of the parameters. Each further row is a context.

    Raises:
        OSError: if the file cannot be read.
        InvalidArgumentError: if the file is malformed. The message names the line.
    """
    return _set(native(_native.read_csv_set, _name(name), requests.version(base, "base"), os.fspath(path)))


def read(path: str | os.PathLike[str]) -> dict[str, Set]:
    """Read the sets of an experiment file, which are its tables `[sets.NAME]`. Return them by name.

    Raises:
        InvalidArgumentError: if the file is malformed or cannot be read. The message names the table and the key.
    """
    return {made[0]: _set(made) for made in native(_native.read_sets, os.fspath(path))}


def contexts_of(
    chosen: Set, version: requests.Version, parameters: requests.Parameters | None
) -> Sequence[Mapping[str, float]]:
    """Return the contexts of a set, for environments whose constructor also gets `version` and `parameters`.

    Raises:
        InvalidArgumentError: if the set has no contexts, if its base is not `version`, or if `parameters` is not None.
    """
    if chosen.contexts is None:
        raise InvalidArgumentError(
            f"the set {chosen.name!r} is drawn for each episode and has no contexts: give "
            f"parameters={dict(chosen.parameters)}"
        )
    version = requests.version(version)
    if requests.version(chosen.base, "base") != version or parameters is not None:
        raise InvalidArgumentError(
            f"the set {chosen.name!r} takes parameters that it does not name from {chosen.base!r}, the environments "
            f"take them from version={version!r} and parameters={parameters!r}: give the same version, no parameters"
        )
    return chosen.contexts


def _environment(name: str, task: str | os.PathLike[str] | None) -> Environment:
    return environments(task=task)[describe(name, find_folder(task)).name]


def _made(name: str, base: str, texts: Mapping[str, str]) -> Set:
    if not texts:
        expected = "name at least one, or test on the version itself"
        raise InvalidArgumentError(f"the set {name!r} names no parameter; {expected}")
    return _set(requests.parse_set(_name(name), requests.version(base, "base"), list(texts.items())))


def _set(made: _native.Set) -> Set:
    name, version, parameters, contexts = made
    return Set(name, requests.version(version), parameters, None if contexts is None else tuple(contexts))


def _name(name: Any) -> str:
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9_]+", name) or name.upper() in requests.VERSIONS:
        raise InvalidArgumentError(
            f"the name of a set is {name!r}; expected letters, digits and _, and none of D, R, E in either case"
        )
    return name


def _mapping(values: Any) -> Mapping[str, Any]:
    if not isinstance(values, Mapping):
        raise InvalidArgumentError(f"a set's parameters are {values!r}; expected a dict by their names")
    return values


def _drawn(name: str, values: Any) -> str:
    if isinstance(values, str):
        return values
    return ",".join(
        repr(low) if low == high else f"{low!r}..{high!r}" for low, high in requests.distributions({name: values})[name]
    )


def _points(name: str, values: Any) -> str:
    if isinstance(values, str):
        return values
    if isinstance(values, tuple) and len(values) == 2:
        raise InvalidArgumentError(
            f"the points of {name!r} are {values!r}, which may be an interval or two points; write {list(values)!r} "
            "for two points, and '0.1..1.0/10' for ten from 0.1 to 1.0"
        )
    numbers = np.asarray(values)
    if numbers.dtype.kind not in "iuf" or numbers.ndim > 1 or numbers.size == 0:
        raise InvalidArgumentError(
            f"the points of {name!r} are {values!r}; expected a number, several, or '0.1..1.0/10'"
        )
    return ",".join(repr(float(number)) for number in np.atleast_1d(numbers))


def _values(parameters: Mapping[str, Sequence[tuple[float, float]]]) -> dict[str, float]:
    """Return the values of a grid that has a single point.

    Raises:
        InvalidArgumentError: if a parameter has an interval instead of a point.
    """
    wrong = [
        name for name, intervals in parameters.items() if len(intervals) != 1 or intervals[0][0] != intervals[0][1]
    ]
    if wrong:
        raise InvalidArgumentError(f"the grid has an interval of {wrong[0]}; expected points, such as '0.1..1.0/10'")
    return {name: intervals[0][0] for name, intervals in parameters.items()}
