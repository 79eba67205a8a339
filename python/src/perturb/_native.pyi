"""Types of the native module, python/native."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

class Failure(Exception):  # noqa: N818
    """A failure of the native module. Its arguments are the kind of failure, a gRPC status code or 0, and a message."""

class Events:
    """The episodes that began or ended in one request."""

    def single(self) -> dict[str, Any]:
        """Return the info of a single environment."""

    def batch(self, moved: NDArray[np.bool_] | None, same_step: bool) -> dict[str, Any]:
        """Return the infos of a batch. `moved` is the mask of environments that took a step; None means all."""

class Opened:
    """The reply to opening a session."""

    @property
    def environment(self) -> str: ...
    @property
    def observes_parameters(self) -> bool: ...
    @property
    def observations(self) -> NDArray[np.float32]: ...
    @property
    def events(self) -> Events: ...

# The outcome of a step: observations, rewards, terminated flags, truncated flags, and episodes that began or ended.
Stepped: TypeAlias = tuple[
    NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_], Events | None
]

class NativeServer:
    """An embedded server. Its threads end when the server and all its sessions are closed."""

    def __init__(self, task: tuple[Path, str, str] | None = None) -> None: ...
    def close(self) -> None: ...

class Session:
    """A session: one stream to a server. The session owns a batch of environments."""

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
    @property
    def restored(self) -> bool: ...
    def restore(self, mask: bytes, snapshots: Sequence[bytes]) -> NDArray[np.float32]: ...
    def render(self, slot: int, width: int, height: int) -> NDArray[np.uint8]: ...
    def poll_io(self) -> None: ...
    def close(self) -> None: ...

def note_fork() -> None: ...
def catalogue(address: str, timeout: float) -> str:
    """Return a server's catalogue as JSON."""

class Policy:
    """A policy, loaded from a checkpoint."""

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
    """Chooses actions in N environments with a policy, and stores the policy's memory."""

    def begin(self, observations: NDArray[np.float32]) -> None: ...
    def act(self) -> NDArray[Any]: ...
    def observe(
        self, observations: NDArray[np.float32], rewards: NDArray[np.float32], starts: NDArray[np.bool_]
    ) -> None: ...

# The fields of results.PolicyMetadata: training version, training steps, seed and episodes of the tests, what the
# policy observed (`state` or `parameters`), and whether the policy was deterministic.
PolicyMetadata: TypeAlias = tuple[str | None, int | None, int, int, str, bool | None]

class Assessment:
    """The recorded tests of related policies in one environment."""

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
    """Compare conditions in the tests on these sets. Return JSON."""

def compare_rows(
    conditions: list[tuple[str, list[dict[str, Any]]]], sets: list[str] | None, score: str, baseline: str | None
) -> str:
    """Compare conditions that consist of rows of a results table. Return JSON.

    `sets` names the test sets to compare on. None stands for all sets that every policy was tested on. If the rows are
    from several studies, None stands only for the versions among these sets.
    """

def report_page(assessments: list[Assessment], beside: list[str]) -> str:
    """Return the report page, as HTML, of assessments and of the experiments and assessments in folders `beside`."""

# A test set: its name, its version, the intervals that replace those of the version (by parameter), and the contexts of
# a grid or a list, or None.
Set: TypeAlias = tuple[str, str, dict[str, list[tuple[float, float]]], list[dict[str, float]] | None]

def make_set(name: str, version: str, values: list[tuple[str, str]]) -> Set:
    """Make a test set from values in the syntax of experiment files."""

def read_csv_set(name: str, version: str, path: str) -> Set:
    """Read a test set from a CSV file with one context per row."""

def read_sets(path: str) -> list[Set]:
    """Read the test sets of an experiment file."""

HEATMAP_SET: str
MAX_CONTEXTS: int
MAX_HEATMAP_POINTS: int

def heatmap_contexts(
    axes: Sequence[tuple[str, float, float]], points: int, fixed: dict[str, float]
) -> list[dict[str, float]]:
    """Return the contexts of a heatmap over two parameters. `axes` has the name and the range of each parameter."""

class Tests:
    """Records the tests of a policy on one set after the other."""

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
    """Read a results table. Return its columns by name, and the name and experiment file of each study."""

def wilson(successes: int, episodes: int) -> tuple[float, float]:
    """Return the 95 % Wilson interval of a success rate, 0 … 1."""

def metrics(rates: dict[str, float]) -> tuple[float | None, float | None, float | None]:
    """Return Default, Interpolation and Extrapolation, %, from success rates, %, by scenario such as `DR`."""

def published(environment: str) -> list[tuple[str, list[tuple[float, float | None] | None]]]:
    """Return the paper's results: for each method, the mean and standard deviation of its three metrics, %."""
