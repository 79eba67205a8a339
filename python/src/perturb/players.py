"""Adapters through which `evaluate` plays perturb's policies, functions, stable-baselines3's and torch's models.

This module imports neither stable-baselines3 nor torch: an object can be an instance of their classes only if its owner
imported them.
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
    """Plays in N environments that are reset in the step that ends an episode."""

    def begin(self, observations: NDArray[np.float32]) -> None:
        """Begin an episode everywhere, with observations [N, O]."""

    def act(self) -> Any:
        """Return the next actions: integers [N] from 0, or numbers [N, A]."""

    def observe(
        self, observations: NDArray[np.float32], rewards: NDArray[np.float32], starts: NDArray[np.bool_]
    ) -> None:
        """Take observations [N, O], rewards [N], and flags [N] of observations that are the first of an episode."""


@dataclass(frozen=True)
class PolicyUnderTest:
    """A policy, prepared for a test."""

    # The policy's name in records.
    name: str
    # Makes a player from the number of environments N and the seed of a test.
    player: Callable[[int, int], Player]
    # The agent's name in reports, which is the same for policies that were trained alike.
    agent: str = ""
    # The loaded policy, if it is perturb's own.
    loaded: Policy | None = None
    # Steps of its training, if known.
    timesteps: int | None = None
    # Whether it takes the mode of its actions' distribution; None if that is not known.
    deterministic: bool | None = None


def prepare(
    policy: Any, description: Description, *, deterministic: bool | None, normalizer: Any, name: str | None
) -> PolicyUnderTest:
    """Prepare a policy of any kind for a test.

    `deterministic` is True, False, or None for the default of the policy's kind.

    Raises:
        PolicyError: for what is no policy, or none of this environment.
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
    if _is(policy, "stable_baselines3.common.base_class", "BaseAlgorithm"):
        # The mode is the default of stable-baselines3's evaluate_policy.
        return _stable_baselines(policy, description, deterministic is not False, normalizer, name)
    if deterministic:
        raise PolicyError("deterministic=True is for stable-baselines3's models: make the policy itself deterministic")
    if normalizer not in (None, False):
        raise PolicyError("normalizer= is for stable-baselines3's models: let the policy itself normalise")
    if _is(policy, "torch.nn", "Module"):
        digest = _digest(_tensors(policy.state_dict()))
        player = lambda _num_envs, _seed: _Module(policy, description)  # noqa: E731
        called = type(policy).__name__
        return PolicyUnderTest(name or f"{called} {digest}", player, name or called)
    if callable(policy):
        remembers = _remembers(policy)
        called = getattr(policy, "__qualname__", type(policy).__qualname__)
        named = name or f"function {called}"
        return PolicyUnderTest(named, lambda _num_envs, _seed: _Function(policy, remembers), named)
    raise PolicyError(
        f"policy is {policy!r}; expected one of load_policy(), a function of a batch of observations, a "
        "stable-baselines3 model, a torch module, or a mapping of such by the versions that they were trained on"
    )


def _is(policy: Any, module: str, name: str) -> bool:
    known = getattr(sys.modules.get(module), name, None)
    return isinstance(known, type) and isinstance(policy, known)


def _remembers(function: Callable[..., Any]) -> bool:
    """Whether a function requires three arguments, which means that it has memory."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # some compiled functions have no signature
        return False
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    needed = [it for it in parameters if it.default is it.empty and it.kind in positional]
    keywords = [it for it in parameters if it.default is it.empty and it.kind is inspect.Parameter.KEYWORD_ONLY]
    if len(needed) not in (0, 1, 3) or keywords or (not needed and not list(parameters)):
        raise PolicyError(
            f"the function {getattr(function, '__qualname__', function)} must be given "
            f"{', '.join(it.name for it in [*needed, *keywords]) or 'nothing'}; expected actions = f(observations), or "
            "with memory actions, memory = f(observations, memory, starts)"
        )
    return len(needed) == 3


class _Function:
    """actions = f(observations), or with memory actions, memory = f(observations, memory, starts)."""

    def __init__(self, function: Callable[..., Any], remembers: bool) -> None:
        self._function = function
        self._remembers = remembers
        self._memory: Any = None

    def begin(self, observations: NDArray[np.float32]) -> None:
        self._memory = None
        self._observations, self._starts = observations, np.ones(len(observations), np.bool_)

    def act(self) -> Any:
        observations = self._observations.copy()  # a copy, which the function may change
        if not self._remembers:
            return self._function(observations)
        came = self._function(observations, self._memory, self._starts)
        if not isinstance(came, tuple) or len(came) != 2:
            raise PolicyError(f"a function with memory gave {type(came).__name__}; expected a pair (actions, memory)")
        actions, self._memory = came
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

    For discrete actions the module returns a number for each choice, [N, n], and the choice with the greatest number is
    taken. It may instead return the choices, integers [N]. For continuous actions it returns numbers [N, A].
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
        self._module.eval()  # ends dropout and updates of batch normalisation
        try:
            with torch.no_grad():
                seen = torch.from_numpy(self._observations.copy()).to(self._device, self._dtype)
                came = self._module(seen)
        finally:
            self._module.train(training)
        if not isinstance(came, torch.Tensor):
            raise PolicyError(f"the torch module gave {type(came).__name__}; expected a tensor: wrap it in a function")
        actions = came.cpu().numpy()
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
    """Return a checksum of a module's weights as a name, so that equal weights have equal names."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest.hexdigest()[:8]


@contextlib.contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed NumPy's global generator within a `with` block, and torch's if it is loaded; then restore both."""
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
