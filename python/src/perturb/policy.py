"""Trained policies of perturb, which act by the learner's arithmetic, to the same bytes."""

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


def load_policy(path: str | os.PathLike[str]) -> Policy:
    """Load what `perturb train` made: the `--out` of a training, or the checkpoint folder in it.

    Raises:
        PolicyError: if there is no checkpoint, or one that is damaged or of a later program; it names the file.
    """
    if not isinstance(path, str | os.PathLike):
        raise InvalidArgumentError(f"path is {path!r}; expected the folder of a training")
    return Policy(native(_native.Policy.load, os.fspath(path)))


class Policy:
    """A trained policy, with its normalisers, which stay as training left them.

    Attributes:
        id: names the policy: the iterations of its training, and a checksum of its weights.
        environment: the name of the environment that it was trained in.
        version: where parameters came from in training: `D`, `R`, `E` or `R+E`.
        trained_on: the same with the sets that replaced the version's, such as `D with length [0.3, 0.4]`.
        method: what trained it, such as `ppo ff` or `rl2-ppo rc N=2`.
        episodes_per_trial: episodes over which it remembers; 1 without trials.
        has_memory: whether it is recurrent.
        sees_rewards: whether it also sees the rewards and ends of a trial's episodes (RL²).
        observe: what it sees: `state`, or `parameters` for the environment's parameters beside it.
        seed: that of its training.
        observation_size: O.
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
        """Pickle the whole checkpoint, so that a process on another machine has it, too."""
        with tempfile.TemporaryDirectory(prefix="perturb-") as folder:
            native(self._native.save, folder)
            return _unpickled_policy, (read_folder(folder),)

    def __repr__(self) -> str:
        return f"<perturb policy {self.id}: {self.method} in {self.environment}, trained on {self.trained_on}>"

    def actor(self, num_envs: int = 1, seed: int = 0, first_environment_index: int = 0) -> Actor:
        """Act in N environments.

        Args:
            num_envs: N.
            seed: fixes the sampled actions, together with each environment's index and the number of its trial.
            first_environment_index: the index of the first environment.
        """
        count = requests.count(num_envs, "num_envs", 1)
        first = requests.count(first_environment_index, "first_environment_index", 0)
        if first + count > 2**32:
            raise InvalidArgumentError(
                f"first_environment_index={first} with num_envs={count}: indices end at 2^32 - 1"
            )
        return Actor(self, count, requests.seed(seed), first)

    def to_torch(self) -> Any:
        """Return the policy as a torch module, with its normalisation, for deployment or further training.

        The module of a feed-forward policy maps observations [N, O] to logits [N, n] of choices or means [N, A] of
        numbers. The module of a recurrent policy maps (observations, memory, starts) to (outputs, memory). Pass the
        memory None first, and then the memory that the last call returned. Rows where `starts`, bool [N], is true begin
        with an empty memory.

        Raises:
            ImportError: if torch is not installed.
            PolicyError: for a policy of RL², which also sees rewards.
        """
        return exported_networks.to_torch(exported_networks.read(self._native))

    def to_onnx(self, path: str | os.PathLike[str]) -> None:
        """Write the policy as an ONNX model, with its normalisation.

        The input is `observations`, float32 [N, O]. The output is `outputs`, logits [N, n] or means [N, A]. A recurrent
        policy also has its memory as inputs `h` and `c` [N, H], which are 0 at the start of an episode, and as outputs
        `next_h` and `next_c`.

        Raises:
            ImportError: if onnx is not installed.
            PolicyError: for a policy of RL², which also sees rewards.
        """
        exported_networks.to_onnx(exported_networks.read(self._native), os.fspath(path))


def _unpickled_policy(files: dict[str, bytes]) -> Policy:
    with tempfile.TemporaryDirectory(prefix="perturb-") as folder:
        write_folder(folder, files)
        return load_policy(folder)


class Actor:
    """A policy that acts in N environments. It samples actions and keeps the policy's memory.

        actor = policy.actor(num_envs=8, seed=1)
        actions = actor(observations)
        while True:
            observations, rewards, terminated, truncated, infos = envs.step(actions)
            actions = actor(observations, starts=terminated | truncated, rewards=rewards)

    The environments must be reset in the step that ends an episode (`autoreset_mode="SameStep"`). An actor can be
    pickled before its first action.
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

        Numbers may lie outside the range of actions; environments clip them.

        Args:
            observations: [N, O], not normalised. The first call begins a trial in every environment.
            starts: bool [N], true where the observation is the first one of an episode; by default nowhere. Where the
                last episode ended a trial, the policy forgets the trial.
            rewards: [N], rewards of the last actions, not normalised; for policies that see them (RL²).

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
        """Forget everything: the next call begins the first trial again, with the same random numbers."""
        self._begun = False


def _array(values: ArrayLike, dtype: type[np.generic], name: str) -> NDArray[Any]:
    """Convert values to an array. Refuse text, flags in place of numbers, and numbers in place of flags."""
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
    """Call the native module, and raise its failures as errors of this package."""
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
