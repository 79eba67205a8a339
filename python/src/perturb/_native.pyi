"""Types of the native module, python/native."""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

class Failure(Exception):  # noqa: N818
    """Arguments: the kind of failure, a gRPC code or 0, and the other side's or the transport's words."""

class Events:
    """What began and ended in a request."""

    def single(self) -> dict[str, Any]:
        """Info of one environment by itself."""

    def batch(self, moved: NDArray[np.bool_] | None, same_step: bool) -> dict[str, Any]:
        """Infos of a batch."""

class Opened:
    """What opening a session gave."""

    @property
    def environment(self) -> str: ...
    @property
    def observes_parameters(self) -> bool: ...
    @property
    def observations(self) -> NDArray[np.float32]: ...
    @property
    def events(self) -> Events: ...

# Observations, rewards, terminated, truncated, and what began or ended.
Stepped: TypeAlias = tuple[
    NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_], Events | None
]

class Session:
    """One stream to a server, which owns a batch of environments."""

    timeout: float
    @property
    def waits(self) -> bool: ...
    @property
    def ended(self) -> bool: ...
    def __init__(
        self,
        address: str,
        timeout: float,
        keepalive: tuple[float, float],
        num_envs: int,
        observation_size: int,
        action_size: int | None,
        single: bool,
    ) -> None: ...
    def open(
        self,
        *,
        environment: str,
        version: str,
        parameters: dict[str, list[tuple[float, float]]],
        seed: int,
        first_environment_index: int,
        episodes_per_trial: int,
        autoreset_mode: str,
        receipts: bool,
        reward_terms: bool,
        observe_parameters: bool,
    ) -> Opened: ...
    def step(self, actions: Any, encode: Callable[[Any], bytes]) -> Stepped: ...
    def send(self, actions: Any, encode: Callable[[Any], bytes]) -> None: ...
    def recv(self) -> Stepped: ...
    def reset(
        self, mask: bytes, seeds: Sequence[int], parameters: dict[str, list[tuple[float, float]]], states: bytes
    ) -> tuple[NDArray[np.float32], Events]: ...
    def snapshot(self, mask: bytes) -> list[bytes]: ...
    def restore(self, mask: bytes, snapshots: Sequence[bytes]) -> NDArray[np.float32]: ...
    def render(self, slot: int, width: int, height: int) -> NDArray[np.uint8]: ...
    def tend(self) -> None: ...
    def close(self) -> None: ...

def catalogue(address: str, timeout: float) -> str:
    """What a server can run, as JSON."""

class Policy:
    """A checkpoint that was read."""

    @staticmethod
    def load(path: str) -> Policy: ...
    @property
    def id(self) -> str: ...
    @property
    def environment(self) -> str: ...
    @property
    def version(self) -> str: ...
    @property
    def trained_on(self) -> str: ...
    @property
    def method(self) -> str: ...
    @property
    def episodes_per_trial(self) -> int: ...
    @property
    def sees_rewards(self) -> bool: ...
    @property
    def has_memory(self) -> bool: ...
    @property
    def observe(self) -> str: ...
    @property
    def seed(self) -> int: ...
    @property
    def observation_size(self) -> int: ...
    def player(self, num_envs: int, seed: int, first_environment_index: int) -> Player: ...

class Player:
    """Acts in N environments, and remembers."""

    def begin(self, observations: NDArray[np.float32]) -> None: ...
    def act(self) -> NDArray[Any]: ...
    def observe(
        self, observations: NDArray[np.float32], rewards: NDArray[np.float32], starts: NDArray[np.bool_]
    ) -> None: ...
