"""Types of the native module, python/native."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

class Failure(Exception):  # noqa: N818
    """Arguments: the kind of failure, a gRPC code or 0, and the other side's or the transport's words."""

class Events:
    """Episodes that began and ended in a request."""

    def single(self) -> dict[str, Any]:
        """Info of one environment by itself."""

    def batch(self, moved: NDArray[np.bool_] | None, same_step: bool) -> dict[str, Any]:
        """Infos of a batch."""

class Opened:
    """The reply that opened a session."""

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

class NativeServer:
    """A server of this process. Sessions end with it."""

    def __init__(self, task: tuple[Path, str, str] | None = None) -> None: ...
    def close(self) -> None: ...

class Session:
    """A stream to a server, which owns a batch of environments."""

    timeout: float
    @property
    def waits(self) -> bool: ...
    @property
    def ended(self) -> bool: ...
    @property
    def under_way(self) -> int: ...
    def last_ended(self) -> NDArray[np.bool_]: ...
    def __init__(
        self,
        server: str | NativeServer,
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
    def step_single(
        self, action: Any, encode: Callable[[Any], bytes]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]: ...
    def send(self, actions: Any, encode: Callable[[Any], bytes]) -> None: ...
    def recv(self) -> Stepped: ...
    def reset(
        self, mask: bytes, seeds: Sequence[int], parameters: dict[str, list[tuple[float, float]]], states: bytes
    ) -> tuple[NDArray[np.float32], Events]: ...
    def snapshot(self, mask: bytes) -> list[bytes]: ...
    def restore(self, mask: bytes, snapshots: Sequence[bytes]) -> NDArray[np.float32]: ...
    def render(self, slot: int, width: int, height: int) -> NDArray[np.uint8]: ...
    def poll_io(self) -> None: ...
    def close(self) -> None: ...

def note_fork() -> None: ...
def catalogue(address: str, timeout: float) -> str:
    """Return a server's catalogue as JSON."""

class Policy:
    """A checkpoint that was read."""

    @staticmethod
    def load(path: str) -> Policy: ...
    def save(self, path: str) -> None: ...
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
    @property
    def timesteps(self) -> int: ...
    def player(self, num_envs: int, seed: int, first_environment_index: int) -> Player: ...

class Player:
    """Acts in N environments, and remembers."""

    def begin(self, observations: NDArray[np.float32]) -> None: ...
    def act(self) -> NDArray[Any]: ...
    def observe(
        self, observations: NDArray[np.float32], rewards: NDArray[np.float32], starts: NDArray[np.bool_]
    ) -> None: ...

# Facts about a policy: the version that it was trained on, steps of its training, the seed of its tests, their
# episodes, # what it observed, and whether it was deterministic.
PolicyMetadata: TypeAlias = tuple[str | None, int | None, int, int, str, bool | None]

class Assessment:
    """The tests of an agent in one environment."""

    def __init__(self, agent: str, policies: list[tuple[PolicyMetadata, Records]]) -> None: ...
    @staticmethod
    def read(path: str) -> Assessment: ...
    def write(self, path: str, overwrite: bool) -> None: ...
    @property
    def agent(self) -> str: ...
    def policies(self) -> list[tuple[PolicyMetadata, Records]]: ...

def compare(
    conditions: list[tuple[str, list[tuple[str, Records]]]], sets: list[str], score: str, baseline: str | None
) -> str:
    """Compare conditions in the tests on these sets, as JSON."""

def report_page(assessments: list[Assessment], beside: list[str]) -> str:
    """The report page, HTML."""

# A set of a test: its name, its version, values that are drawn in place of the version's, and contexts if it has a
# list.
Set: TypeAlias = tuple[str, str, dict[str, list[tuple[float, float]]], list[dict[str, float]] | None]

def make_set(name: str, version: str, values: list[tuple[str, str]]) -> Set:
    """The set that texts of experiment files make."""

def read_csv_set(name: str, version: str, path: str) -> Set:
    """The set of the rows of a CSV file."""

def read_sets(path: str) -> list[Set]:
    """The sets of an experiment file."""

HEATMAP_SET: str
MAX_HEATMAP_POINTS: int

def heatmap_contexts(
    axes: Sequence[tuple[str, float, float]], points: int, fixed: dict[str, float]
) -> list[dict[str, float]]:
    """The contexts of a heatmap over two parameters, each with its range."""

class Tests:
    """The tests of a policy, one set after the other."""

    def __init__(
        self, sets: list[Set], episodes: int, seed: int, success: str | None, policy: str, episodes_per_trial: int
    ) -> None: ...
    def plan(self, place: int) -> tuple[int, int]: ...
    def opened(self, opened: Opened, policy: Policy | None) -> None: ...
    def take(self, events: Events | None, terminated: NDArray[np.bool_]) -> tuple[int, int]: ...
    def finish(self) -> None: ...
    def records(self) -> Records: ...

class Records:
    """The recorded tests of a policy."""

    @staticmethod
    def read(path: str) -> Records: ...
    def write(self, path: str) -> None: ...
    @property
    def environment(self) -> str: ...
    @property
    def policy(self) -> str: ...
    @property
    def success(self) -> str | None: ...
    @property
    def parameters(self) -> list[tuple[str, str]]: ...
    @property
    def sets(self) -> list[str]: ...
    def columns(self) -> dict[str, Any]: ...
    @property
    def rule(self) -> str | None: ...
    def judged(self, quantity: str, at_least: bool, threshold: float, values: NDArray[np.float64]) -> Records: ...
    def judged_by(self, rule: str) -> Records: ...
    def tests(self) -> list[Set]: ...
    def parts(self, name: str) -> list[int]: ...
    def result(
        self, name: str
    ) -> tuple[
        int,
        float,
        tuple[float, float],
        float,
        tuple[float, float],
        float,
        float,
        tuple[float, float],
        float | None,
    ]: ...
    def success_by_parameters(
        self, name: str, x: str, y: str
    ) -> list[tuple[tuple[float, float], tuple[float, float], int, int]]: ...
    def success_by_parameter(self, name: str, parameter: str) -> list[tuple[float, float, int, int, float, float]]: ...

def read_results(path: str) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """A results table's columns by their names, and the plans of its studies."""

def wilson(successes: int, episodes: int) -> tuple[float, float]:
    """The 95 % interval of a rate, 0 … 1."""

def metrics(rates: dict[str, float]) -> tuple[float | None, float | None, float | None]:
    """The paper's three numbers of success rates by scenario."""

def published(environment: str) -> list[tuple[str, list[tuple[float, float | None] | None]]]:
    """The paper's methods with the mean and deviation of their three numbers."""
