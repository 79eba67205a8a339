"""Conversion of users' arguments to the protocol's values: versions, parameters, seeds, actions, states, masks.

This module checks types and shapes, because the conversion would otherwise lose or change data. Most values are left to
the server to check.
"""

from __future__ import annotations

import copy
import difflib
import inspect
import math
import numbers
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

import numpy as np
from gymnasium.vector import AutoresetMode

from . import _native
from .catalogue import MAX_PIXELS, MIN_PIXELS
from .errors import InvalidArgumentError, UnknownNameError

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec
    from numpy.typing import NDArray

    from .catalogue import Description

# The values of a parameter: a number, an interval (low, high), or several intervals [(low, high), …]. Each can also be
# a text as in experiment files and program options: "0.7", "0.5..1.1", "0.1..0.2,0.8..1.0".
ParameterSet: TypeAlias = float | str | tuple[float, float] | Sequence[tuple[float, float]]
Parameters: TypeAlias = Mapping[str, ParameterSet]

# The intervals [(low, high), …] of each parameter, by the parameter's name.
Intervals: TypeAlias = dict[str, list[tuple[float, float]]]

# Names of the versions that parameters come from.
Version: TypeAlias = Literal["D", "R", "E", "R+E"]
VERSIONS: tuple[Version, ...] = get_args(Version)

_INT32 = np.iinfo(np.int32)


def version(name: Any, what: str = "version") -> Version:
    """Return a version's name in upper case: D, R, E or R+E.

    Raises:
        InvalidArgumentError: if it is not the name of a version.
    """
    for known in VERSIONS:
        if isinstance(name, str) and name.upper() == known:
            return known
    raise InvalidArgumentError(
        f"{what}={name!r} is none of 'D' (default physics), 'R' (random), 'E' (extreme) and 'R+E' (each in half "
        "of the trials)"
    )


def observes_parameters(observe: Any) -> bool:
    """Whether the option `observe` appends the parameters to observations."""
    if observe not in ("state", "parameters"):
        raise InvalidArgumentError(
            f"observe={observe!r}; expected 'state' or 'parameters' (the state followed by the parameters)"
        )
    return bool(observe == "parameters")


def autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
    """Return Gymnasium's AutoresetMode for a mode or its text value."""
    try:
        return AutoresetMode(mode)
    except ValueError as error:
        known = ", ".join(repr(mode.value) for mode in AutoresetMode)
        raise InvalidArgumentError(f"autoreset_mode={mode!r} is none of gymnasium's AutoresetMode ({known})") from error


def distributions(parameters: Parameters | None) -> Intervals:
    """Convert the option `parameters` to intervals by parameter. None gives no intervals."""
    if parameters is None:
        return {}
    if not isinstance(parameters, Mapping):
        raise InvalidArgumentError(
            f"parameters is {parameters!r}; expected a dict of names, such as {{'length': 0.7, 'mass': (0.1, 0.2)}}"
        )
    return {_name(name): _distribution(name, value) for name, value in parameters.items()}


def frozen(intervals: Intervals) -> tuple[Any, ...]:
    """Return intervals as a hashable value. Equal intervals give equal values."""
    return tuple(sorted((name, tuple(values)) for name, values in intervals.items()))


def contexts(listed: Any) -> list[dict[str, float]]:
    """Convert the option `contexts` to a list of contexts. A context maps names of parameters to numbers."""
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
        raise InvalidArgumentError(f"the context {context!r} has values that are not finite numbers")
    if any(len(intervals) != 1 or intervals[0][0] != intervals[0][1] for intervals in values.values()):
        raise InvalidArgumentError(f"the context {context!r} has intervals; expected a value of each parameter")
    return {name: intervals[0][0] for name, intervals in values.items()}


def _name(name: Any) -> str:
    if not isinstance(name, str):
        raise InvalidArgumentError(f"parameters has the key {name!r}; expected a parameter's name")
    return name


def parse_set(name: str, version: str, texts: Sequence[tuple[str, str]]) -> _native.Set:
    """Make a test set from the text values of its parameters, in the syntax of experiment files.

    `texts` has pairs of a parameter's name and its values.

    Raises:
        InvalidArgumentError: if a text is malformed. The message says what is expected.
    """
    try:
        return _native.make_set(name, version, list(texts))
    except _native.Failure as failure:
        raise InvalidArgumentError(failure.args[2]) from None


def _distribution(name: str, value: ParameterSet) -> list[tuple[float, float]]:
    if isinstance(value, str):
        _, _, drawn, contexts = parse_set("parameters", "D", [(name, value)])
        if contexts is not None:
            raise InvalidArgumentError(
                f"parameters[{name!r}] is {value!r}, which are points; expected a value or intervals, such as '0.7' or "
                "'0.5..1.1': give points to perturb.sets.grid()"
            )
        return drawn[name]
    wrong = InvalidArgumentError(
        f"parameters[{name!r}] is {value!r}; expected a number, an interval (low, high), "
        "several intervals [(low, high), …], or a text such as '0.5..1.1'"
    )
    numbers = _numbers(value, wrong)
    if numbers.shape == (2,) and not isinstance(value, tuple):
        raise InvalidArgumentError(
            f"parameters[{name!r}] is {value!r}, which may be an interval or two values; write "
            f"({numbers[0]:g}, {numbers[1]:g}) or '{numbers[0]:g}..{numbers[1]:g}' for the interval, and "
            "perturb.sets.grid() for values"
        )
    if numbers.ndim == 0:
        numbers = np.array([[numbers, numbers]])
    elif numbers.ndim == 1:
        numbers = numbers[np.newaxis]
    if numbers.ndim != 2 or numbers.shape[1] != 2:
        raise wrong
    return [(low, high) for low, high in numbers.tolist()]


def _numbers(value: Any, wrong: InvalidArgumentError) -> NDArray[np.float64]:
    """Convert numbers to a float64 array. Raise `wrong` for anything else, such as text."""
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "iuf":
            raise wrong
        return array.astype(np.float64)
    except (ValueError, TypeError) as error:  # lists of unequal lengths
        raise wrong from error


def seed(value: Any, name: str = "seed") -> int:
    """Check a seed, an integer from 0 to 2^64 - 1, and return it as an int."""
    try:
        number = operator.index(value)
    except TypeError:
        number = -1
    if not 0 <= number < 2**64:
        raise InvalidArgumentError(f"{name}={value!r}; expected an integer from 0 to 2^64 - 1")
    return number


def seeds(value: Any, num_envs: int) -> list[int | None]:
    """Return the seeds of N environments.

    One seed s gives environment i the seed s + i. A list has a seed for each environment. None in the list lets an
    environment continue with its last seed.
    """
    if value is None:
        return [None] * num_envs
    if not isinstance(value, Sequence | np.ndarray) or getattr(value, "ndim", 1) == 0:
        first = seed(value)
        return [seed(first + i) for i in range(num_envs)]
    if len(value) != num_envs:
        raise InvalidArgumentError(f"seed has {len(value)} numbers; expected one, or {num_envs}")
    return [None if one is None else seed(one) for one in value]


def step_limit(value: Any, description: Description) -> None:
    """Check the argument `max_episode_steps`, which `gymnasium.make_vec` passes to a batch.

    Raises:
        InvalidArgumentError: if it differs from the server's step limit.
    """
    if value not in (None, -1, description.step_limit):
        raise InvalidArgumentError(
            f"max_episode_steps={value!r}: a batch has the step limit of the server, {description.step_limit}; leave "
            "it out, or make_vec(…, vectorization_mode='sync') wraps a TimeLimit around each environment"
        )


def with_step_limit(spec: EnvSpec | None, description: Description) -> EnvSpec | None:
    """Return a copy of a specification with the server's step limit, because some wrappers read it there.

    A specification that has a step limit is returned unchanged.
    """
    if spec is None or spec.max_episode_steps is not None:
        return spec
    limited = copy.copy(spec)
    limited.max_episode_steps = description.step_limit
    return limited


def settings(initialiser: Callable[..., None]) -> list[str]:
    """Return the names of the parameters of a constructor, without `self` and `**kwargs`."""
    parameters = inspect.signature(initialiser).parameters.values()
    return [it.name for it in parameters if it.name != "self" and it.kind is not it.VAR_KEYWORD]


def no_unknown(unknown: Mapping[str, Any], known: Sequence[str]) -> None:
    """Check that a constructor got no unknown keyword arguments.

    Raises:
        InvalidArgumentError: if there is one. The message suggests the known name that is closest.
    """
    if unknown:
        name = next(iter(unknown))
        meant = difflib.get_close_matches(name, known, n=1)
        hint = f" (did you mean {meant[0]}=?)" if meant else ""
        raise InvalidArgumentError(f"{name}= is not a setting of environments{hint}; there are {', '.join(known)}")


def parameter_values(parameters: Parameters, description: Description) -> Intervals:
    """Convert parameters to intervals, and check names and bounds.

    The function `distributions` leaves these checks to the server. Use `parameter_values` if the values are sent to the
    server only later, so that wrong values are refused at once.

    Raises:
        UnknownNameError: if the environment has no such parameter.
        InvalidArgumentError: if a value is malformed or out of bounds.
    """
    values = distributions(parameters)
    for name, intervals in values.items():
        if name not in description.parameters and name in description.disturbances:
            raise InvalidArgumentError(
                f"{name!r} is a disturbance, and this environment was made without disturbances; pass "
                f"parameters={{{name!r}: {description.undisturbed[name]:g}}} where it is made"
            )
        if name not in description.parameters:
            raise UnknownNameError(
                f"{description.name} has no parameter {name!r}, only {', '.join(description.parameters)}"
            )
        low, high = description.parameters[name]
        if not all(low <= least <= greatest <= high for least, greatest in intervals):
            raise InvalidArgumentError(
                f"parameters[{name!r}] is {parameters[name]!r}; expected values from {low:g} to {high:g}"
            )
    return values


def count(value: Any, name: str, minimum: int, maximum: int = 2**32 - 1) -> int:
    """Check an integer from `minimum` to `maximum`, and return it as an int."""
    try:
        number = -1 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = -1
    if not minimum <= number <= maximum:
        limit = "2^32 - 1" if maximum == 2**32 - 1 else maximum
        raise InvalidArgumentError(f"{name}={value!r}; expected an integer from {minimum} to {limit}")
    return number


def pixels(value: Any, name: str) -> int:
    """Check the width or height of a picture, in pixels, and return it as an int."""
    return count(value, name, MIN_PIXELS, MAX_PIXELS)


def render_mode(value: Any) -> None:
    """Check the option `render_mode`: `rgb_array`, the only mode that draws, or None."""
    if value == "human":
        raise InvalidArgumentError(
            "render_mode='human' needs a window, which gymnasium.wrappers.HumanRendering opens: give it an environment "
            "with render_mode='rgb_array'"
        )
    if value not in (None, "rgb_array"):
        raise InvalidArgumentError(f"render_mode={value!r}; expected 'rgb_array' or None")


def seconds(value: Any, name: str) -> float:
    """Check a number of seconds, which is positive and may be infinite, and return it as a float."""
    try:
        number = float(value) if isinstance(value, numbers.Real) and not isinstance(value, bool) else 0.0
    except OverflowError:
        number = 0.0
    if not number > 0:
        raise InvalidArgumentError(f"{name}={value!r}; expected a number of seconds, more than 0")
    return number


def actions(values: Any, description: Description, shape: tuple[int, ...]) -> bytes:
    """Convert the actions of all environments to the protocol's bytes: int32 [N] or float32 [N, A].

    `shape` is the expected shape of `values`.

    Raises:
        InvalidArgumentError: if the shape or the type is wrong. The message states the shape that the user passed.
    """
    array = np.asarray(values)
    if array.shape != shape:
        raise InvalidArgumentError(f"the action has the shape {array.shape}; expected {shape}")
    if not description.discrete:
        if array.dtype.kind not in "iuf":
            raise InvalidArgumentError(f"the action has the type {array.dtype}; expected numbers")
        with np.errstate(over="ignore"):  # numbers too large for float32 become infinite, which the server refuses
            return array.astype("<f4").tobytes()
    if array.dtype.kind not in "iub":
        raise InvalidArgumentError(f"the action has the type {array.dtype}; expected integers")
    if not np.can_cast(array.dtype, np.int32) and (array.min() < _INT32.min or array.max() > _INT32.max):
        raise InvalidArgumentError(f"the actions lie between {array.min()} and {array.max()}; expected choices from 0")
    return array.astype("<i4").tobytes()


def states(values: Any, num_envs: int, *, batched: bool) -> bytes:
    """Convert exact initial states to the protocol's bytes, float64.

    `values` are [S] for a single environment, or [M, S] if `batched`, for the M environments to reset.
    """
    expected = f"{num_envs} rows of numbers, one for each reset environment" if batched else "a row of numbers"
    wrong = InvalidArgumentError(f"options['state'] is {values!r}; expected {expected}")
    array = _numbers(values, wrong)
    if array.ndim != (2 if batched else 1) or (batched and array.shape[0] != num_envs):
        raise wrong
    return array.astype("<f8").tobytes()


def mask(value: Any, num_envs: int, name: str) -> NDArray[np.bool_]:
    """Check that a mask is a bool array [N] and selects at least one environment. Return the mask.

    Gymnasium's own batches require the same of `reset_mask`.
    """
    is_mask = isinstance(value, np.ndarray) and value.dtype == np.bool_ and value.shape == (num_envs,)
    if not is_mask or not value.any():
        raise InvalidArgumentError(
            f"{name} is {value!r}; expected a numpy array of bool of the shape ({num_envs},) with at least one True"
        )
    selected: NDArray[np.bool_] = value
    return selected


def options(given: Mapping[str, Any] | None, known: Sequence[str]) -> Mapping[str, Any]:
    """Check the argument `options` of `reset` for unknown keys, and return it. None becomes an empty dictionary."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise InvalidArgumentError(f"options is {given!r}; expected a dict with keys of {', '.join(known)}")
    unknown = [key for key in given if key not in known]
    if unknown:
        raise InvalidArgumentError(f"options has the unknown keys {unknown}; known are {', '.join(known)}")
    return given
