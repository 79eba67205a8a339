"""What users write, turned into what the protocol wants: versions, distributions, seeds, actions, states, masks.

Only what would be lost or changed on the way is checked here: shapes, kinds of numbers. Values are for the server to
judge, whose sentences are better.
"""

from __future__ import annotations

import math
import numbers
import operator
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

import numpy as np
from gymnasium.vector import AutoresetMode

from .catalogue import LEAST_PIXELS, MOST_PIXELS
from .errors import InvalidArgumentError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .catalogue import Description

# A value, an interval (low, high), or a union of intervals [(low, high), …].
ParameterSet: TypeAlias = float | tuple[float, float] | Sequence[tuple[float, float]]
Parameters: TypeAlias = Mapping[str, ParameterSet]

# The same by name, as the protocol has it.
Intervals: TypeAlias = dict[str, list[tuple[float, float]]]

# Where parameters come from.
Version: TypeAlias = Literal["D", "R", "E", "R+E"]
VERSIONS: tuple[Version, ...] = get_args(Version)

_INT32 = np.iinfo(np.int32)


def version(name: Any, what: str = "version") -> Version:
    """D, R, E or R+E, in large letters or small ones."""
    for known in VERSIONS:
        if isinstance(name, str) and name.upper() == known:
            return known
    raise InvalidArgumentError(
        f"{what}={name!r} is none of 'D' (default physics), 'R' (random), 'E' (extreme) and 'R+E' (each in half "
        "of the trials)"
    )


def observes_parameters(observe: Any) -> bool:
    """Whether observations have the parameters at their end."""
    if observe not in ("state", "parameters"):
        raise InvalidArgumentError(f"observe={observe!r} is none of 'state' and 'parameters' (both, state first)")
    return bool(observe == "parameters")


def autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
    """Gymnasium's mode, given as such or as its value."""
    try:
        return AutoresetMode(mode)
    except ValueError as error:
        known = ", ".join(repr(mode.value) for mode in AutoresetMode)
        raise InvalidArgumentError(f"autoreset_mode={mode!r} is none of gymnasium's AutoresetMode ({known})") from error


def distributions(parameters: Parameters | None) -> Intervals:
    """The sets that replace those of the version."""
    if parameters is None:
        return {}
    if not isinstance(parameters, Mapping):
        raise InvalidArgumentError(
            f"parameters is {parameters!r}; expected a dict of names, such as {{'length': 0.7, 'mass': (0.1, 0.2)}}"
        )
    return {_name(name): _distribution(name, value) for name, value in parameters.items()}


def contexts(listed: Any) -> list[dict[str, float]]:
    """Values of parameters by name, in each context those that it has: at least one context."""
    if isinstance(listed, str | Mapping) or not isinstance(listed, Sequence):
        raise InvalidArgumentError(
            f"contexts is {listed!r}; expected a list such as [{{'length': 0.3}}, {{'length': 0.5}}]"
        )
    if not listed:
        raise InvalidArgumentError("there are no contexts; expected at least one")
    return [_context(context) for context in listed]


def _context(context: Any) -> dict[str, float]:
    values = distributions(context)
    if not all(math.isfinite(end) for intervals in values.values() for interval in intervals for end in interval):
        raise InvalidArgumentError(f"the context {context!r} has values that are no finite numbers")
    if any(len(intervals) != 1 or intervals[0][0] != intervals[0][1] for intervals in values.values()):
        raise InvalidArgumentError(f"the context {context!r} has intervals; expected a value of each parameter")
    return {name: intervals[0][0] for name, intervals in values.items()}


def _name(name: Any) -> str:
    if not isinstance(name, str):
        raise InvalidArgumentError(f"parameters has the key {name!r}; expected a parameter's name")
    return name


def _distribution(name: str, value: ParameterSet) -> list[tuple[float, float]]:
    wrong = InvalidArgumentError(
        f"parameters[{name!r}] is {value!r}; expected a number, an interval (low, high), "
        "or several intervals [(low, high), …]"
    )
    numbers = _numbers(value, wrong)
    if numbers.ndim == 0:
        numbers = np.array([[numbers, numbers]])
    elif numbers.ndim == 1:
        numbers = numbers[np.newaxis]
    if numbers.ndim != 2 or numbers.shape[1] != 2:
        raise wrong
    return [(low, high) for low, high in numbers.tolist()]


def _numbers(value: Any, wrong: InvalidArgumentError) -> NDArray[np.float64]:
    """Convert to float64, but not from text."""
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "iuf":
            raise wrong
        return array.astype(np.float64)
    except (ValueError, TypeError) as error:  # lists of unequal lengths
        raise wrong from error


def seed(value: Any, name: str = "seed") -> int:
    """A number that the protocol can carry."""
    try:
        number = operator.index(value)
    except TypeError:
        number = -1
    if not 0 <= number < 2**64:
        raise InvalidArgumentError(f"{name}={value!r}; expected an integer from 0 to 2^64 - 1")
    return number


def count(value: Any, name: str, least: int) -> int:
    """An integer that fits into the protocol's uint32."""
    try:
        number = operator.index(value)
    except TypeError:
        number = -1
    if not least <= number < 2**32:
        raise InvalidArgumentError(f"{name}={value!r}; expected an integer from {least} to 2^32 - 1")
    return number


def pixels(value: Any, name: str) -> int:
    """The width or height of a picture that a server draws."""
    try:
        number = operator.index(value)
    except TypeError:
        number = 0
    if not LEAST_PIXELS <= number <= MOST_PIXELS:
        raise InvalidArgumentError(f"{name}={value!r}; expected an integer from {LEAST_PIXELS} to {MOST_PIXELS}")
    return number


def render_mode(value: Any) -> None:
    """The one way in which environments are drawn, or none."""
    if value == "human":
        raise InvalidArgumentError(
            "render_mode='human' needs a window, which gymnasium.wrappers.HumanRendering opens: give it an environment "
            "with render_mode='rgb_array'"
        )
    if value not in (None, "rgb_array"):
        raise InvalidArgumentError(f"render_mode={value!r}; expected 'rgb_array' or None")


def seconds(value: Any, name: str) -> float:
    """A span of time, more than nothing; infinity is one."""
    try:
        number = float(value) if isinstance(value, numbers.Real) and not isinstance(value, bool) else 0.0
    except OverflowError:
        number = 0.0
    if not number > 0:
        raise InvalidArgumentError(f"{name}={value!r}; expected a number of seconds, more than 0")
    return number


def actions(values: Any, description: Description, shape: tuple[int, ...]) -> bytes:
    """The actions of all environments: int32 [N] or float32 [N, A], in the shape that the user knows."""
    array = np.asarray(values)
    if array.shape != shape:
        raise InvalidArgumentError(f"the action has the shape {array.shape}; expected {shape}")
    if not description.discrete:
        if array.dtype.kind not in "iuf":
            raise InvalidArgumentError(f"the action has the type {array.dtype}; expected numbers")
        with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, and is refused
            return array.astype("<f4").tobytes()
    if array.dtype.kind not in "iub":
        raise InvalidArgumentError(f"the action has the type {array.dtype}; expected integers")
    if not np.can_cast(array.dtype, np.int32) and (array.min() < _INT32.min or array.max() > _INT32.max):
        raise InvalidArgumentError(f"the actions lie between {array.min()} and {array.max()}; expected choices from 0")
    return array.astype("<i4").tobytes()


def states(values: Any, num_envs: int, *, batched: bool) -> bytes:
    """Exact initial states, float64: [S] of a single environment, [M, S] of M selected ones."""
    expected = f"{num_envs} rows of numbers, one for each reset environment" if batched else "a row of numbers"
    wrong = InvalidArgumentError(f"options['state'] is {values!r}; expected {expected}")
    array = _numbers(values, wrong)
    if array.ndim != (2 if batched else 1) or (batched and array.shape[0] != num_envs):
        raise wrong
    return array.astype("<f8").tobytes()


def mask(value: Any, num_envs: int, name: str) -> NDArray[np.bool_]:
    """A boolean array [N] that selects at least one environment, as Gymnasium's `reset_mask`."""
    is_mask = isinstance(value, np.ndarray) and value.dtype == np.bool_ and value.shape == (num_envs,)
    if not is_mask or not value.any():
        raise InvalidArgumentError(
            f"{name} is {value!r}; expected a numpy array of bool of the shape ({num_envs},) with at least one True"
        )
    selected: NDArray[np.bool_] = value
    return selected


def options(given: Mapping[str, Any] | None, known: Sequence[str]) -> Mapping[str, Any]:
    """The options of a reset, none of which is ignored."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise InvalidArgumentError(f"options is {given!r}; expected a dict with keys of {', '.join(known)}")
    unknown = [key for key in given if key not in known]
    if unknown:
        raise InvalidArgumentError(f"options has the unknown keys {unknown}; known are {', '.join(known)}")
    return given
