"""Results of comparisons, as data."""

from __future__ import annotations

from dataclasses import dataclass

Interval = tuple[float, float]


@dataclass(frozen=True)
class ConditionMean:
    """A condition in a test: the mean of its policies' scores, success rates in % unless another score is compared."""

    condition: str
    tested_on: str
    # The mean score of each policy.
    by_seed: tuple[float, ...]
    # The mean over policies.
    mean: float
    # The 95 % t interval over policies, which speaks of other seeds. None with fewer than three.
    seeds_interval: Interval | None
    # Episodes of each policy.
    episodes: int
    # The 95 % interval over episodes, which speaks of these policies in other episodes: Wilson's of success rates, with
    # the effective number of the episodes that all policies play; else a t interval.
    episodes_interval: Interval | None

    @property
    def seeds(self) -> int:
        """The number of policies."""
        return len(self.by_seed)


@dataclass(frozen=True)
class ConditionDifference:
    """Two conditions in a test: the difference x - y, in percentage points unless another score is compared."""

    x: str
    y: str
    tested_on: str
    # Numbers of policies of x and y.
    seeds: tuple[int, int]
    # Whether policies of x and y with the same key are pairs; and the difference of each pair.
    paired: bool
    by_seed: tuple[float, ...]
    difference: float
    # The 95 % t interval over pairs; without pairs Welch's. None with fewer than three policies of either.
    seeds_interval: Interval | None
    # The 95 % interval over episodes, of differences of the same episode if both played the same.
    episodes_interval: Interval | None
    same_episodes: bool
    # The probability, 0 … 1, that a policy of x has a higher mean than one of y (Mann and Whitney, 1947).
    improvement: float
    # The p-value of the t test over pairs, or of Welch's, and corrected after Holm for all that is compared.
    p: float | None
    p_holm: float | None
    # A sentence that says no more than these numbers.
    verdict: str
