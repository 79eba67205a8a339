"""Results of tests of policies, as data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from . import requests

if TYPE_CHECKING:
    from collections.abc import Mapping

    from . import _native


@dataclass(frozen=True)
class PolicyMetadata:
    """Facts about a policy that its records do not have."""

    # The version that the policy was trained on; None if it is not known, or if it was no version.
    trained_on: str | None
    # Steps of its training, of all environments together; None if not known.
    timesteps: int | None
    # The seed from which the seeds of its tests follow, and the requested episodes of each test.
    seed: int
    episodes: int
    # `state` or `parameters`.
    observe: str
    # Whether the policy took the mode of its actions' distribution; None if that is not known.
    deterministic: bool | None

    def plain(self) -> _native.PolicyMetadata:
        """Return the facts in the native module's form."""
        return (self.trained_on, self.timesteps, self.seed, self.episodes, self.observe, self.deterministic)


@dataclass(frozen=True)
class PolicyRecords:
    """The recorded tests of one policy."""

    known: PolicyMetadata
    records: _native.Records

    @property
    def trained_on(self) -> str | None:
        """The version that the policy was trained on, if it is known."""
        return self.known.trained_on


@dataclass(frozen=True)
class Result:
    """The figures of one test. Rates are in %, their intervals hold with 95 % confidence (Wilson, 1927)."""

    # The version that the policy was trained on, if that is known, and the set that it was tested on.
    trained_on: str | None
    tested_on: str
    # The policy's name in records.
    policy: str
    episodes: int
    success_percent: float
    success_interval: tuple[float, float]
    # Undiscounted, never normalised; its interval is a bootstrap's over episodes (percentiles of 1000 resamples, 95 %).
    mean_return: float
    return_interval: tuple[float, float]
    # Mean length of episodes, in steps.
    mean_length: float
    # CVaR 10 %: the mean of the worst tenth of returns, rounded up (Rockafellar and Uryasev, 2000), and its interval.
    cvar_return: float
    cvar_interval: tuple[float, float]
    # The success rate in the worst tenth of contexts: parts of the parameter space of some 40 episodes each, chosen by
    # one half of the episodes and judged by the other. None where there are fewer than ten parts, as on D.
    worst_contexts_percent: float | None
    # Whether actions were the mode of the policy's distribution, and not sampled; None if that is not known.
    deterministic: bool | None = None

    @property
    def scenario(self) -> str:
        """Training and test versions, such as `DR` or `D on corners`; the test alone if the training is not known."""
        if self.trained_on is None:
            return self.tested_on
        named = self.tested_on in requests.VERSIONS
        return f"{self.trained_on}{self.tested_on}" if named else f"{self.trained_on} on {self.tested_on}"


@dataclass(frozen=True)
class Bin:
    """Success in a part of a parameter's range, `low` to `high`. Rates are in %, None without episodes."""

    low: float
    high: float
    successes: int
    episodes: int
    success_percent: float | None
    success_interval: tuple[float, float] | None


@dataclass(frozen=True)
class Bin2D:
    """Success in a part of two parameters' ranges, each `(low, high)`. The rate is in %, None without episodes."""

    x: tuple[float, float]
    y: tuple[float, float]
    successes: int
    episodes: int
    success_percent: float | None


@dataclass(frozen=True)
class Context:
    """Success in a context, or in a part of the parameter space. Rates are in %, the interval is Wilson's, 95 %."""

    # Least and greatest value in its episodes of each parameter that varies, by name; equal in a context of a list.
    parameters: Mapping[str, tuple[float, float]]
    successes: int
    episodes: int
    success_percent: float
    success_interval: tuple[float, float]
    mean_return: float


@dataclass(frozen=True)
class Audit:
    """Comparison of a repeated test with its records. `different` has a sentence for each episode that differs."""

    episodes: int
    different: tuple[str, ...]
