"""Data classes with the results of tests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from . import requests

if TYPE_CHECKING:
    from collections.abc import Mapping

    from . import _native


@dataclass(frozen=True)
class PolicyMetadata:
    """Metadata of a tested policy that its records do not contain."""

    # The version that the policy was trained on. None if unknown, or if it was trained on a custom set.
    trained_on: str | None
    # Number of training steps, of all environments together. None if unknown.
    timesteps: int | None
    # The seed that the seeds of all tests are derived from.
    seed: int
    # The requested number of episodes of each test.
    episodes: int
    # The contents of the policy's observations: `state` or `parameters`.
    observe: str
    # Whether the policy took the mode of its action distribution instead of sampling. None if unknown.
    deterministic: bool | None

    def plain(self) -> _native.PolicyMetadata:
        """Return the metadata as a tuple for the native module."""
        return (self.trained_on, self.timesteps, self.seed, self.episodes, self.observe, self.deterministic)


@dataclass(frozen=True)
class PolicyRecords:
    """The recorded tests of one policy, with the policy's metadata."""

    known: PolicyMetadata
    records: _native.Records

    @property
    def trained_on(self) -> str | None:
        """The version that the policy was trained on. None if unknown, or if it was trained on a custom set."""
        return self.known.trained_on


@dataclass(frozen=True)
class Result:
    """The statistics of one test: a policy on one test set. All intervals are 95 % confidence intervals."""

    # The version that the policy was trained on. None if unknown, or if it was trained on a custom set.
    trained_on: str | None
    # The name of the test set.
    tested_on: str
    # The policy's name in records.
    policy: str
    # The number of episodes.
    episodes: int
    # The success rate, %.
    success_percent: float
    # The Wilson interval (1927) of the success rate, %.
    success_interval: tuple[float, float]
    # The mean return, undiscounted and not normalised.
    mean_return: float
    # The bootstrap interval of the mean return: percentiles of 1000 resamples of the episodes.
    return_interval: tuple[float, float]
    # The mean length of episodes, in steps.
    mean_length: float
    # CVaR 10 % (Rockafellar and Uryasev, 2000): the mean of the lowest tenth of returns. If a tenth of the
    # episodes is not a whole number, it is rounded up.
    cvar_return: float
    # The bootstrap interval of `cvar_return`, from 1000 resamples of the episodes.
    cvar_interval: tuple[float, float]
    # The success rate, %, in the worst tenth of contexts. Contexts are those of a grid or list, or regions of the
    # parameter space with about 40 episodes each. One half of the episodes selects the worst contexts, and the other
    # half measures the success rate. The value is the average over both assignments of the halves. None if fewer than
    # ten contexts have at least two episodes, as on D.
    worst_contexts_percent: float | None
    # Whether the policy took the mode of its action distribution instead of sampling. None if unknown.
    deterministic: bool | None = None

    @property
    def scenario(self) -> str:
        """The training version and the test set, such as `DR` or `D on corners`.

        Only the test set if `trained_on` is None.
        """
        if self.trained_on is None:
            return self.tested_on
        named = self.tested_on in requests.VERSIONS
        return f"{self.trained_on}{self.tested_on}" if named else f"{self.trained_on} on {self.tested_on}"


@dataclass(frozen=True)
class Bin:
    """Success in one bin of a parameter's range, from `low` to `high` in the parameter's unit."""

    low: float
    high: float
    successes: int
    episodes: int
    # The success rate, %. None without episodes.
    success_percent: float | None
    # The 95 % Wilson interval of the success rate, %. None without episodes.
    success_interval: tuple[float, float] | None


@dataclass(frozen=True)
class Bin2D:
    """Success in one cell of a grid over two parameters."""

    # The range (low, high) of the first parameter.
    x: tuple[float, float]
    # The range (low, high) of the second parameter.
    y: tuple[float, float]
    successes: int
    episodes: int
    # The success rate, %. None without episodes.
    success_percent: float | None


@dataclass(frozen=True)
class Context:
    """Success in one context of a list, or in one region of the parameter space if parameters are drawn."""

    # The lowest and the highest value of each varying parameter in the context's episodes, by name. They are equal if
    # the context is one of a list.
    parameters: Mapping[str, tuple[float, float]]
    successes: int
    episodes: int
    # The success rate, %.
    success_percent: float
    # The 95 % Wilson interval of the success rate, %.
    success_interval: tuple[float, float]
    mean_return: float


@dataclass(frozen=True)
class Audit:
    """The result of repeating recorded tests: the differences between the new episodes and the records."""

    # The number of compared episodes.
    episodes: int
    # A sentence for each episode that differs.
    different: tuple[str, ...]
