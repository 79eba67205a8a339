"""Comparison of conditions, such as training methods, over several seeds and in the same test episodes."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from . import _native, requests
from .assessment import Assessment
from .client import TIMEOUT
from .compared import Comparison
from .comparison_results import ConditionDifference, ConditionMean
from .errors import InvalidArgumentError
from .evaluation import evaluate, plain_sets
from .policy import Policy, load_policy, native
from .sets import Set

if TYPE_CHECKING:
    from .requests import Version
    from .success_rules import SuccessRule

# Default number of episodes of each test, and default seed of the tests. If there are saved assessments, the number and
# the seed of the first one are the defaults instead.
EPISODES, SEED = 1000, 1
# The file by which the folder of an assessment is recognised.
_ASSESSMENT = "assessment.json"
# The columns of a results table that a comparison needs.
_COLUMNS = (
    "study",
    "cell",
    "environment",
    "revision",
    "model_hash",
    "trained_on",
    "tested_on",
    "seed",
    "after_episodes",
    "episodes",
    "successes",
    "mean_return",
    "mean_length",
    "settings",
)

Score = Literal["success", "return", "length"]


def compare(
    conditions: Mapping[str, Any],
    environment: str | None = None,
    *,
    versions: Sequence[Version | Set] | None = None,
    episodes: int | None = None,
    seed: int | None = None,
    parameters: requests.Parameters | None = None,
    contexts: Sequence[Mapping[str, float]] | None = None,
    base: Version = "D",
    score: Score = "success",
    baseline: str | None = None,
    success: SuccessRule | None = None,
    observe: str | None = None,
    deterministic: bool | None = None,
    normalizer: Literal[False] | None = None,
    server: str | None = None,
    task: str | os.PathLike[str] | None = None,
    timeout: float = TIMEOUT,
    progress: bool | None = None,
) -> Comparison:
    """Compare conditions, such as training methods, by testing their policies in the same episodes.

        comparison = perturb.compare({"no DR": [m1, m2, m3], "DR": [m4, m5, m6]}, "Hopper", episodes=1000)
        print(comparison.verdict)

    Each condition consists of one or several policies that were trained with different seeds. The mean score of a
    condition has two 95 % intervals. The interval over policies estimates what other training seeds would give. The
    interval over episodes estimates what the same policies would give in other episodes.

    If two conditions have the same keys, their policies are compared in pairs with equal keys. Otherwise the policies
    are unpaired, and Welch's test compares the conditions.

    Args:
        conditions: the policies of each condition, by a name of your choice: one policy, a list, or a mapping by keys
            such as training seeds. If perturb trained all policies of a list and their training seeds differ, the keys
            are these seeds. Otherwise the keys are the positions in the list, from 1. A policy is one that `evaluate`
            accepts, an `Assessment`, or the path of a saved assessment or of a checkpoint. Instead of policies, each
            condition may have rows of `read_results`, such as `dict(list(rows.groupby("algorithm")))`. Rows have
            numbers of successes but no episodes, so only success rates have an interval over episodes.
        environment: as in `evaluate`. Leave it out if all policies are assessments or rows.
        versions: as in `evaluate`. For assessments and rows, the tests to compare, by default all tests that they have
            in common. For rows, a set may be given by its name. For rows of several studies, the default includes only
            versions, because two studies may give the same name to different sets.
        episodes: as in `evaluate`. By default the number of the first assessment, or 1000 without assessments.
        seed: seed of all tests. By default the seed of the first assessment, or 1 without assessments.
        parameters: as in `evaluate`.
        contexts: as in `evaluate`.
        base: as in `evaluate`.
        score: the score to compare: `success` (rates in %), `return` or `length` (steps).
        baseline: the condition that all others are compared with. By default all pairs of conditions are compared.
        success: as in `evaluate`. Episodes of assessments are judged again by this rule.
        observe: as in `evaluate`.
        deterministic: as in `evaluate`.
        normalizer: False for models whose observations were not normalised. By default each model's own VecNormalize.
        server: as in `evaluate`.
        task: as in `evaluate`.
        timeout: as in `evaluate`.
        progress: as in `evaluate`.

    Raises:
        InvalidArgumentError: if a condition has no policy, or if the environments, tests or success rules of the
            policies differ.
        PolicyError: as in `evaluate`.
        UnknownNameError: as in `evaluate`.
        ServerConnectionError: as in `evaluate`.
        ServerTimeoutError: as in `evaluate`.
        ServerStartError: as in `evaluate`.
    """
    if rows := _rows(conditions):
        of_tests = (environment, episodes, seed, parameters, contexts, success, observe, deterministic, normalizer)
        if task is not None or any(option is not None for option in of_tests):
            raise InvalidArgumentError(
                "rows of a results table are not tested again; only versions, score and baseline may be given"
            )
        names = None if versions is None else [it.name if isinstance(it, Set) else it for it in versions]
        return _comparison(
            native(_native.compare_rows, rows, names, score, baseline),
            score,
            environment=next(row["environment"] for _, own in rows for row in own),
        )
    given = _conditions(conditions)
    saved = [one for policies in given.values() for one in policies.values() if isinstance(one, Assessment)]
    if environment is None:
        if not saved:
            raise InvalidArgumentError("environment is missing; name the environment that policies are tested in")
        environment = saved[0].environment
    if saved and versions is None and parameters is None and contexts is None:
        tests = _common_tests(saved)
    else:
        tests = plain_sets(versions, parameters, contexts, base)
    first = saved[0]._assessed[0].known if saved else None
    episodes = (EPISODES if first is None else first.episodes) if episodes is None else episodes
    seed = (SEED if first is None else first.seed) if seed is None else seed
    evaluations: dict[str, dict[str, Assessment]] = {}
    for name, policies in given.items():
        evaluations[name] = {}
        for key, policy in policies.items():
            if isinstance(policy, Assessment):
                evaluations[name][key] = policy if success is None else policy.judged_by(success)
                continue
            evaluations[name][key] = evaluate(
                policy,
                environment,
                versions=[
                    Set(it[0], requests.version(it[1]), it[2], None if it[3] is None else tuple(it[3])) for it in tests
                ],
                episodes=episodes,
                seed=seed,
                success=success,
                observe=observe,
                deterministic=deterministic,
                normalizer=None if isinstance(policy, Policy) else normalizer,
                server=server,
                task=task,
                timeout=timeout,
                progress=progress,
            )
    return _compared(evaluations, [test[0] for test in tests], score, baseline)


def _compared(
    evaluations: Mapping[str, Mapping[str, Assessment]], tests: Sequence[str], score: Score, baseline: str | None
) -> Comparison:
    plain = [
        (name, [(key, one._assessed[0].records) for key, one in policies.items()])
        for name, policies in evaluations.items()
    ]
    return _comparison(native(_native.compare, plain, list(tests), score, baseline), score, evaluations)


def _comparison(
    compared: str,
    score: Score,
    evaluations: Mapping[str, Mapping[str, Assessment]] | None = None,
    environment: str | None = None,
) -> Comparison:
    # The native module computes all numbers, and returns them as JSON.
    found: Mapping[str, Any] = json.loads(compared)
    means = tuple(
        ConditionMean(
            it["condition"],
            it["tested_on"],
            tuple(it["by_seed"]),
            it["mean"],
            _interval(it["seeds_95"]),
            it["episodes"],
            _interval(it["episodes_95"]),
        )
        for it in found["means"]
    )
    differences = tuple(
        ConditionDifference(
            it["x"],
            it["y"],
            it["tested_on"],
            (it["seeds"][0], it["seeds"][1]),
            it["paired"],
            tuple(it["by_seed"]),
            it["difference"],
            _interval(it["seeds_95"]),
            _interval(it["episodes_95"]),
            it["same_episodes"],
            it["improvement"],
            it["p"],
            it["p_holm"],
            it["verdict"],
        )
        for it in found["differences"]
    )
    return Comparison(score, means, differences, found["verdict"], evaluations or {}, environment)


def _rows(conditions: Any) -> list[tuple[str, list[dict[str, Any]]]] | None:
    """Return the rows of a results table for each condition, or None if no condition is a DataFrame."""
    if not isinstance(conditions, Mapping) or not any(hasattr(frame, "groupby") for frame in conditions.values()):
        return None
    found = []
    for name, frame in conditions.items():
        if not hasattr(frame, "groupby"):
            raise InvalidArgumentError(
                f"the condition {name!r} is not a DataFrame of `read_results`; expected rows for all or for none"
            )
        missing = [column for column in _COLUMNS if column not in frame.columns]
        if missing:
            raise InvalidArgumentError(
                f"the rows of {name!r} have no column {missing[0]}; expected all columns of `read_results`"
            )
        records = frame[list(_COLUMNS)].astype(object)
        rows = records.where(records.notna(), None).to_dict("records")
        found.append((" ".join(map(str, name)) if isinstance(name, tuple) else str(name), rows))
    return found


def _interval(ends: Sequence[float] | None) -> tuple[float, float] | None:
    return None if ends is None else (ends[0], ends[1])


def _conditions(conditions: Any) -> dict[str, dict[str, Any]]:
    """Return the policies of each condition, by condition and key. Paths are replaced by the loaded policies."""
    if not isinstance(conditions, Mapping) or not conditions:
        raise InvalidArgumentError(
            f"conditions is {conditions!r}; expected a dict of policies by names, such as "
            "{'no DR': [m1, m2], 'DR': [m3, m4]}"
        )
    found: dict[str, dict[str, Any]] = {}
    for name, policies in conditions.items():
        if not isinstance(name, str) or not name:
            raise InvalidArgumentError(f"conditions has the key {name!r}; expected a name")
        if isinstance(policies, Mapping):
            keyed = {str(key): _policy(name, policy) for key, policy in policies.items()}
        else:
            several = policies if isinstance(policies, list | tuple) else [policies]
            loaded = [_policy(name, policy) for policy in several]
            seeds = [str(policy.seed) for policy in loaded if isinstance(policy, Policy)]
            distinct = len(seeds) == len(loaded) == len(set(seeds))
            keyed = dict(zip(seeds if distinct else map(str, range(1, len(loaded) + 1)), loaded, strict=True))
        if not keyed:
            raise InvalidArgumentError(f"the condition {name!r} has no policy; expected one or several")
        found[name] = keyed
    return found


def _policy(condition: str, policy: Any) -> Any:
    if isinstance(policy, str | os.PathLike):
        is_assessment = (Path(policy) / _ASSESSMENT).is_file()
        policy = Assessment.load(policy) if is_assessment else load_policy(policy)
    if isinstance(policy, Assessment) and len(policy._assessed) > 1:
        trained = ", ".join(str(one.trained_on) for one in policy._assessed)
        raise InvalidArgumentError(
            f"the condition {condition!r} has an assessment of {len(policy._assessed)} policies, trained on {trained}; "
            "expected one policy for each seed: evaluate each by itself"
        )
    return policy


def _common_tests(saved: Sequence[Assessment]) -> list[_native.Set]:
    """Return the tests that all assessments have in common, in the order of the first assessment."""
    names = [set(one._assessed[0].records.sets) for one in saved]
    common = set.intersection(*names)
    if not common:
        raise InvalidArgumentError("the assessments have no test in common: evaluate all on the same versions or sets")
    return [test for test in saved[0]._assessed[0].records.tests() if test[0] in common]
