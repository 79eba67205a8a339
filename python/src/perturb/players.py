"""Adapters with which `evaluate` runs policies of any kind: perturb's, functions, and models of other libraries.

Importing this module does not import stable-baselines3 or torch. If a policy is an object of one of their classes, the
caller has already imported the library.
"""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import itertools
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from .errors import PolicyError
from .normalizers import find_normalizer
from .policy import Policy, native

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from .catalogue import Description


class Player(Protocol):
    """Chooses actions in N environments that reset in the same step in which an episode ends."""

    def begin(self, observations: NDArray[np.float32]) -> None:
        """Begin an episode in every environment, with observations [N, O]."""

    def act(self) -> Any:
        """Return the next actions: integers [N] from 0, or numbers [N, A]."""

    def observe(
        self, observations: NDArray[np.float32], rewards: NDArray[np.float32], starts: NDArray[np.bool_]
    ) -> None:
        """Record the outcome of the last actions: observations [N, O] and rewards [N].

        `starts` [N] is true where the observation is the first one of an episode.
        """


@dataclass(frozen=True)
class PolicyUnderTest:
    """A policy, prepared for a test."""

    # The policy's name in records.
    name: str
    # Makes a player from the number of environments N and the seed of a test.
    player: Callable[[int, int], Player]
    # The name in reports, which policies of one training method share.
    agent: str = ""
    # The policy, if it is one of `load_policy`.
    loaded: Policy | None = None
    # Number of training steps, if known.
    timesteps: int | None = None
    # Whether the policy takes the mode of its action distribution instead of sampling. None if unknown.
    deterministic: bool | None = None


def prepare(
    policy: Any, description: Description, *, deterministic: bool | None, normalizer: Any, name: str | None
) -> PolicyUnderTest:
    """Prepare a policy of any kind for a test.

    `deterministic` is True, False, or None for the default of the policy's kind.

    Raises:
        PolicyError: if the object is not a policy, does not fit the environment, or does not support a given option.
    """
    if isinstance(policy, Policy):
        if deterministic or normalizer not in (None, False) or name is not None:
            raise PolicyError(
                "a loaded policy samples its actions, normalises by itself and has its id for a name, as in `perturb "
                "evaluate`: leave deterministic=, normalizer= and name= out"
            )
        loaded = policy._native
        player = lambda num_envs, seed: native(loaded.player, num_envs, seed, 0)  # noqa: E731
        return PolicyUnderTest(policy.id, player, policy.method, policy, loaded.timesteps, False)
    if _is_instance_of(policy, "stable_baselines3.common.base_class", "BaseAlgorithm"):
        # The default is the mode of the action distribution, as in stable-baselines3's evaluate_policy.
        return _stable_baselines(policy, description, deterministic is not False, normalizer, name)
    if deterministic:
        raise PolicyError("deterministic=True is for stable-baselines3's models: make the policy itself deterministic")
    if normalizer not in (None, False):
        raise PolicyError("normalizer= is for stable-baselines3's models: let the policy itself normalise")
    if _is_instance_of(policy, "torch.nn", "Module"):
        digest = _digest(_tensors(policy.state_dict()))
        player = lambda _num_envs, _seed: _Module(policy, description)  # noqa: E731
        called = type(policy).__name__
        return PolicyUnderTest(name or f"{called} {digest}", player, name or called)
    if callable(policy):
        remembers = _has_memory(policy)
        called = getattr(policy, "__qualname__", type(policy).__qualname__)
        named = name or f"function {called}"
        return PolicyUnderTest(named, lambda _num_envs, _seed: _Function(policy, remembers), named)
    raise PolicyError(
        f"policy is {policy!r}; expected a policy of load_policy(), a function of a batch of observations, a "
        "stable-baselines3 model, a torch module, or a mapping of such by the versions that they were trained on"
    )


def _is_instance_of(policy: Any, module: str, name: str) -> bool:
    known = getattr(sys.modules.get(module), name, None)
    return isinstance(known, type) and isinstance(policy, known)


def _has_memory(function: Callable[..., Any]) -> bool:
    """Whether a function has memory. A function with memory requires three arguments.

    Raises:
        PolicyError: if the function requires two arguments, more than three, or keyword arguments; or if it takes no
            argument.
    """
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # some compiled functions have no signature
        return False
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    needed = [it for it in parameters if it.default is it.empty and it.kind in positional]
    keywords = [it for it in parameters if it.default is it.empty and it.kind is inspect.Parameter.KEYWORD_ONLY]
    if len(needed) not in (0, 1, 3) or keywords or (not needed and not list(parameters)):
        names = ", ".join(it.name for it in [*needed, *keywords])
        raise PolicyError(
            f"the function {getattr(function, '__qualname__', function)} requires "
            f"{f'the arguments {names}' if names else 'no arguments'}; expected actions = f(observations), or with "
            "memory actions, memory = f(observations, memory, starts)"
        )
    return len(needed) == 3


class _Function:
    """A player of a Python function.

    The function is `actions = f(observations)`, or `actions, memory = f(observations, memory, starts)` with memory.
    """

    def __init__(self, function: Callable[..., Any], remembers: bool) -> None:
        self._function = function
        self._has_memory = remembers
        self._memory: Any = None

    def begin(self, observations: NDArray[np.float32]) -> None:
        self._memory = None
        self._observations, self._starts = observations, np.ones(len(observations), np.bool_)

    def act(self) -> Any:
        observations = self._observations.copy()  # the function may change its argument
        if not self._has_memory:
            return self._function(observations)
        result = self._function(observations, self._memory, self._starts)
        if not isinstance(result, tuple) or len(result) != 2:
            raise PolicyError(f"a function with memory gave {type(result).__name__}; expected a pair (actions, memory)")
        actions, self._memory = result
        return actions

    def observe(
        self, observations: NDArray[np.float32], rewards: NDArray[np.float32], starts: NDArray[np.bool_]
    ) -> None:
        del rewards
        self._observations, self._starts = observations, starts


def _stable_baselines(
    model: Any, description: Description, deterministic: bool, normalizer: Any, name: str | None
) -> PolicyUnderTest:
    for what, trained, served in [
        ("observations", model.observation_space, description.observation_space()),
        ("actions", model.action_space, description.action_space()),
    ]:
        same = type(trained) is type(served) and trained.shape == served.shape
        if not same or getattr(trained, "n", None) != getattr(served, "n", None):
            raise PolicyError(f"the model's {what} are {trained}, those of {description.name} {served}")
    normalizer = find_normalizer(model, normalizer, description)
    digest = _digest(itertools.chain(_tensors(model.policy.state_dict()), _statistics(normalizer)))

    def predict(observations: NDArray[np.float32], memory: Any, starts: NDArray[np.bool_]) -> Any:
        seen = observations if normalizer is None else normalizer.normalize_obs(observations)
        return model.predict(seen, state=memory, episode_start=starts, deterministic=deterministic)

    called, steps = type(model).__name__, getattr(model, "num_timesteps", None)
    return PolicyUnderTest(
        name or f"{called} {digest}",
        lambda _num_envs, _seed: _Function(predict, True),
        name or called,
        timesteps=steps if isinstance(steps, int) and steps > 0 else None,
        deterministic=deterministic,
    )


class _Module:
    """A player of a torch module.

    For n discrete actions the module returns logits [N, n], and the player takes the action with the greatest logit.
    The module may also return the actions themselves, integers [N]. For continuous actions it returns numbers [N, A].
    """

    def __init__(self, module: Any, description: Description) -> None:
        self._module = module
        self._choices = description.actions if isinstance(description.actions, int) else None
        weights = next(iter(module.parameters()), None)
        self._device = "cpu" if weights is None else weights.device
        self._dtype = None if weights is None or not weights.is_floating_point() else weights.dtype

    def begin(self, observations: NDArray[np.float32]) -> None:
        self._observations = observations

    def act(self) -> Any:
        import torch

        training = self._module.training
        self._module.eval()  # turns off dropout, and updates of batch normalisation
        try:
            with torch.no_grad():
                seen = torch.from_numpy(self._observations.copy()).to(self._device, self._dtype)
                raw = self._module(seen)
        finally:
            self._module.train(training)
        if not isinstance(raw, torch.Tensor):
            raise PolicyError(f"the torch module gave {type(raw).__name__}; expected a tensor: wrap it in a function")
        actions = raw.cpu().numpy()
        if self._choices is None or actions.dtype.kind in "iu":
            return actions
        expected = (len(self._observations), self._choices)
        if actions.shape != expected:
            raise PolicyError(
                f"the torch module gave the shape {actions.shape}; expected {expected}, a number for each choice, or "
                "integers"
            )
        if np.isnan(actions).any():
            raise PolicyError("the torch module gave NaN")
        return actions.argmax(axis=1)

    def observe(
        self, observations: NDArray[np.float32], rewards: NDArray[np.float32], starts: NDArray[np.bool_]
    ) -> None:
        del rewards, starts
        self._observations = observations


def _tensors(state: Any) -> Iterator[bytes]:
    for name, tensor in state.items():
        yield name.encode()
        if hasattr(tensor, "detach"):
            yield np.ascontiguousarray(tensor.detach().cpu().float().numpy()).tobytes()


def _statistics(normalizer: Any) -> Iterator[bytes]:
    moments = getattr(normalizer, "obs_rms", None)
    for numbers in () if moments is None else (moments.mean, moments.var):
        yield np.asarray(numbers, np.float64).tobytes()


def _digest(parts: Iterator[bytes]) -> str:
    """Return a checksum as eight hexadecimal digits. It is part of the name of a policy without an id."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest.hexdigest()[:8]


@contextlib.contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed the global generator of NumPy, and that of torch if it is loaded, within a `with` block.

    The end of the block restores both generators.
    """
    before = np.random.get_state()
    np.random.seed(seed % 2**32)
    try:
        torch = sys.modules.get("torch")
        if torch is None:
            yield
        else:
            with torch.random.fork_rng():
                torch.manual_seed(seed % 2**63)
                yield
    finally:
        np.random.set_state(before)
