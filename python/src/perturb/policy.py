"""Policies that perturb's learner trained. They choose the same actions as in the learner, byte for byte."""

from __future__ import annotations

import os
import tempfile
from typing import TYPE_CHECKING, Any

import numpy as np

from . import _native, exported_networks, requests
from .contents import read_folder, write_folder
from .errors import InvalidArgumentError, OutOfOrderError, PerturbError, PolicyError, ProtocolError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike, NDArray

# Maximum number of environments of an actor. The limit exists because the actor allocates memory for all of them at
# once.
MAX_ENVIRONMENTS = 1 << 20


def load_policy(path: str | os.PathLike[str]) -> Policy:
    """Load a policy that perturb's learner trained.

    `path` is the `--out` folder of the training, its checkpoint folder, or a policy file (`.safetensors`). It may also
    be the id of an experiment's cell. Cells are looked up in the folder that the environment variable PERTURB_RESULTS
    names, by default `results`.

    Raises:
        PolicyError: if there is no checkpoint, or if the checkpoint is damaged or was written by a later version of
            perturb. The message names the file.
    """
    if not isinstance(path, str | os.PathLike):
        raise InvalidArgumentError(f"path is {path!r}; expected the path of a training, a checkpoint or a policy file")
    return Policy(native(_native.Policy.load, os.fspath(path)))


class Policy:
    """A trained policy with its normalisers. The normalisers no longer change.

    Attributes:
        id: identifies the policy by the number of its training iterations and a checksum of its weights.
        environment: the name of the environment that it was trained in.
        version: the version that the parameters of its training came from: `D`, `R`, `E` or `R+E`.
        trained_on: the version, and the values that replaced some of its parameters, such as
            `D with length [0.3, 0.4]`.
        method: the algorithm and architecture, such as `ppo ff` or `rl2-ppo rc N=2`.
        episodes_per_trial: the number of episodes after which the memory of an RL² policy is reset; 1 for other
            policies.
        has_memory: whether the policy is recurrent.
        sees_rewards: whether the policy's inputs also include the last action, its reward and whether an episode ended
            (RL²).
        observe: what the policy observes: `state`, or `parameters` for the state and the environment's parameters.
        seed: the seed of its training.
        observation_size: the number O of values in an observation.
    """

    def __init__(self, loaded: _native.Policy) -> None:
        self._native = loaded
        self.id: str = loaded.id
        self.environment: str = loaded.environment
        self.version: str = loaded.version
        self.trained_on: str = loaded.trained_on
        self.method: str = loaded.method
        self.episodes_per_trial: int = loaded.episodes_per_trial
        self.has_memory: bool = loaded.has_memory
        self.sees_rewards: bool = loaded.sees_rewards
        self.observe: str = loaded.observe
        self.seed: int = loaded.seed
        self.observation_size: int = loaded.observation_size

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the whole checkpoint, so that a process on another machine can load it."""
        with tempfile.TemporaryDirectory(prefix="perturb-") as folder:
            native(self._native.save, folder)
            return _unpickled_policy, (read_folder(folder),)

    def __repr__(self) -> str:
        return f"<perturb policy {self.id}: {self.method} in {self.environment}, trained on {self.trained_on}>"

    def actor(self, num_envs: int = 1, seed: int = 0, first_environment_index: int = 0) -> Actor:
        """Return an actor that chooses actions in N environments.

        Args:
            num_envs: the number N of environments, at most 2^20.
            seed: fixes the sampled actions, together with the environment's index and the trial's index.
            first_environment_index: the index of the first environment.
        """
        count = requests.count(num_envs, "num_envs", 1, MAX_ENVIRONMENTS)
        first = requests.count(first_environment_index, "first_environment_index", 0)
        if first + count > 2**32:
            raise InvalidArgumentError(
                f"first_environment_index={first} with num_envs={count}: indices end at 2^32 - 1"
            )
        return Actor(self, count, requests.seed(seed), first)

    def to_torch(self) -> Any:
        """Return the policy as a torch module, with its normalisation, for deployment or further training.

        The module of a feed-forward policy maps observations [N, O] to outputs: logits [N, n] for n discrete actions,
        or means [N, A] for continuous ones. The module of a recurrent policy maps (observations, memory, starts) to
        (outputs, memory). Pass None as the first memory, and later the memory that the last call returned. The memory
        of a row is reset if `starts`, bool [N], is true there.

        Raises:
            ImportError: if torch is not installed.
            PolicyError: if the policy is an RL² policy, because exported networks do not see rewards.
        """
        return exported_networks.to_torch(exported_networks.read(self._native))

    def to_onnx(self, path: str | os.PathLike[str]) -> None:
        """Write the policy to a file as an ONNX model, with its normalisation.

        The input is `observations`, float32 [N, O]. The output is `outputs`: logits [N, n] for n discrete actions, or
        means [N, A] for continuous ones. The model of a recurrent policy also has the state of the LSTM with H units as
        inputs `h` and `c` [N, H], and the next state as outputs `next_h` and `next_c`. Pass zeros at the start of an
        episode.

        Raises:
            ImportError: if onnx is not installed.
            PolicyError: if the policy is an RL² policy, because exported networks do not see rewards.
        """
        exported_networks.to_onnx(exported_networks.read(self._native), os.fspath(path))


def _unpickled_policy(files: dict[str, bytes]) -> Policy:
    with tempfile.TemporaryDirectory(prefix="perturb-") as folder:
        write_folder(folder, files)
        return load_policy(folder)


class Actor:
    """A policy that chooses actions in N environments. It samples the actions and stores the policy's memory.

        actor = policy.actor(num_envs=8, seed=1)
        actions = actor(observations)
        while True:
            observations, rewards, terminated, truncated, infos = envs.step(actions)
            actions = actor(observations, starts=terminated | truncated, rewards=rewards)

    The environments must reset in the same step in which an episode ends (`autoreset_mode="SameStep"`). An actor can be
    pickled only before its first action.
    """

    def __init__(self, policy: Policy, num_envs: int, seed: int, first_environment_index: int) -> None:
        self._policy = policy
        self._settings = (num_envs, seed, first_environment_index)
        self._player: _native.Player = native(policy._native.player, *self._settings)
        self._begun = False

    def __reduce__(self) -> tuple[Any, ...]:
        if self._begun:
            raise PolicyError(
                "an actor in the middle of its episodes cannot be pickled or copied: send its policy, and make an "
                "actor there, policy.actor(num_envs=…, seed=…); or call reset() first, which begins its trials again"
            )
        return Actor, (self._policy, *self._settings)

    def __call__(
        self, observations: ArrayLike, starts: ArrayLike | None = None, rewards: ArrayLike | None = None
    ) -> NDArray[Any]:
        """Sample actions: int64 [N], counted from 0, or float32 [N, A].

        Continuous actions may lie outside the action space. Environments clip them.

        Args:
            observations: observations [N, O], not normalised. The first call begins a trial in every environment.
            starts: bool [N], true where the observation is the first one of an episode. By default false everywhere.
                If that episode is the first of a new trial, the policy's memory is reset.
            rewards: rewards [N] of the last actions, not normalised. Only RL² policies need them.

        Raises:
            PolicyError: if a shape is wrong, or if the policy's outputs are not finite.
        """
        rows = _array(observations, np.float32, "observations")
        if not self._begun:
            native(self._player.begin, rows)
            self._begun = True
        else:
            if rewards is None and self._policy.sees_rewards:
                raise PolicyError("this policy sees rewards; give those of the last step: rewards=")
            count = len(rows) if rows.ndim else 0
            brought = np.zeros(count, np.float32) if rewards is None else _array(rewards, np.float32, "rewards")
            begun = np.zeros(count, np.bool_) if starts is None else _array(starts, np.bool_, "starts")
            native(self._player.observe, rows, brought, begun)
        actions: NDArray[Any] = native(self._player.act)
        return actions

    def reset(self) -> None:
        """Reset the actor. The next call begins the first trial again, with the same random numbers."""
        self._begun = False


def _array(values: ArrayLike, dtype: type[np.generic], name: str) -> NDArray[Any]:
    """Convert values to an array of a type.

    Raises:
        PolicyError: for text, for booleans in place of numbers or numbers in place of booleans, and for a wrong number
            of dimensions.
    """
    array = np.asarray(values)
    kinds = "b" if dtype is np.bool_ else "iuf"
    if array.dtype.kind not in kinds:
        raise PolicyError(f"{name} have the type {array.dtype}; expected {dtype.__name__}")
    rank = 2 if name == "observations" else 1
    if array.ndim != rank:
        expected = "[N, O]" if rank == 2 else "[N]"
        raise PolicyError(f"{name} have the shape {array.shape}; expected {expected}")
    return np.ascontiguousarray(array, dtype=dtype)


def native(call: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function of the native module. Convert the native module's `Failure` to an error of this package."""
    try:
        return call(*arguments)
    except _native.Failure as failure:
        kind, _, words = failure.args
        raise _BY_KIND.get(kind, ProtocolError)(words) from None


_BY_KIND: dict[str, type[PerturbError]] = {
    "policy": PolicyError,
    "invalid": InvalidArgumentError,
    "unusable": OutOfOrderError,
}
