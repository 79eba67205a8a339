"""Results of comparisons, as data."""

from __future__ import annotations

from dataclasses import dataclass

Interval = tuple[float, float]


@dataclass(frozen=True)
class ConditionMean:
    """The mean score of a condition in one test.

    Scores are success rates in %, undiscounted returns, or episode lengths in steps.
    """

    condition: str
    # The name of the test set.
    tested_on: str
    # The mean score of each policy.
    by_seed: tuple[float, ...]
    # The mean of `by_seed`.
    mean: float
    # The 95 % t interval over policies. It estimates what other training seeds would give. None with fewer than three
    # policies.
    seeds_interval: Interval | None
    # The number of episodes of each policy; the smallest number if the numbers differ.
    episodes: int
    # The 95 % interval over episodes. It estimates what the same policies would give in other episodes. For returns and
    # lengths it is a t interval. For success rates it is a Wilson interval with an effective number of episodes,
    # because the results of policies in the same episodes are correlated. None for returns and lengths of rows of a
    # results table.
    episodes_interval: Interval | None

    @property
    def seeds(self) -> int:
        """The number of policies."""
        return len(self.by_seed)


@dataclass(frozen=True)
class ConditionDifference:
    """The difference between two conditions in one test: the mean score of x minus the mean score of y.

    Differences of success rates are in percentage points.
    """

    # The names of the two conditions.
    x: str
    y: str
    # The name of the test set.
    tested_on: str
    # The number of policies of x, and the number of policies of y.
    seeds: tuple[int, int]
    # Whether policies of x and y with the same key are compared as pairs.
    paired: bool
    # The difference of each pair; empty without pairs.
    by_seed: tuple[float, ...]
    # The difference of the mean scores.
    difference: float
    # The 95 % t interval of the difference over pairs, or Welch's interval without pairs. None if x or y has fewer than
    # three policies.
    seeds_interval: Interval | None
    # The 95 % interval of the difference over episodes. It is computed from the differences within each episode if both
    # conditions played the same episodes.
    episodes_interval: Interval | None
    # Whether both conditions played the same episodes.
    same_episodes: bool
    # The probability, 0 … 1, that a policy of x has a higher mean score than a policy of y (Mann and Whitney, 1947).
    improvement: float
    # The p-value of the paired t test, or of Welch's test without pairs. None if `seeds_interval` is None.
    p: float | None
    # The p-value after Holm's correction for all differences of the comparison.
    p_holm: float | None
    # A sentence with the conclusion from these numbers.
    verdict: str
