"""Plays and records the tests of a policy, and repeats recorded tests."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from . import _native, players, requests, success_rules
from .address import parse_address
from .catalogue import DEFAULT_PIXELS
from .client import Client
from .errors import InvalidArgumentError, PolicyError
from .policy import Policy, native
from .progress import Progress
from .results import Audit, PolicyMetadata, PolicyRecords
from .task_folder import describe, find_folder


@dataclass(frozen=True)
class Settings:
    """Settings of a policy's tests; see `evaluate`."""

    environment: str
    sets: list[_native.Set]
    episodes: int
    seed: int | None
    success: str | None
    observe: str | None
    deterministic: bool | None
    server: str | None
    task: str | os.PathLike[str] | None
    timeout: float
    progress: bool | None = False


def replay(
    recorded: Sequence[PolicyRecords],
    agent: str,
    policy: Any,
    normalizer: Any,
    server: str | None,
    task: str | os.PathLike[str] | None,
    timeout: float,
) -> Audit:
    """Play all recorded tests again; see `Assessment.audit`."""
    given = {trained: (one, own) for trained, one, own in policies(policy, None, normalizer)}
    keys = [one.trained_on for one in recorded]
    if not isinstance(policy, Mapping) and len(keys) == 1:
        given = {keys[0]: given[None]}
    if set(given) != set(keys):
        expected = "one policy" if keys == [None] else f"a mapping with the keys {', '.join(map(repr, keys))}"
        raise InvalidArgumentError(f"the given policies are not those of the recorded tests; expected {expected}")
    episodes, different = 0, []
    for one in recorded:
        known, records = one.known, one.records
        acts, own_normalizer = given[one.trained_on]
        name = agent if records.policy == agent and not isinstance(acts, Policy) else None
        # If Python judged these records, do not compare the columns `success` and `achieved`. The success rule may have
        # been a function, which the records do not contain.
        own = success_rules.is_own(records.rule)
        settings = Settings(
            records.environment,
            records.tests(),
            known.episodes,
            known.seed,
            None if own else records.rule,
            known.observe,
            known.deterministic,
            server,
            task,
            timeout,
        )
        _, tested = play(acts, settings, known.trained_on, own_normalizer, name, records.policy)
        episodes += len(records.columns()["seed"])
        before, after = records.columns(), tested.records.columns()
        if own:
            before = {name: values for name, values in before.items() if name not in ("success", "achieved")}
        different += _differences(before, after)
    return Audit(episodes, tuple(different))


def _differences(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """Compare the columns of two records of the same episodes. Return a sentence for each episode that differs."""
    same: dict[str, Any] = {}
    for name, values in before.items():
        a, b = np.asarray(values), np.asarray(after[name])
        same[name] = (a == b) | ((a != a) & (b != b)) if a.dtype.kind == "f" else a == b  # NaN equals NaN
    wrong = np.flatnonzero(~np.logical_and.reduce(list(same.values())))
    sentences = []
    for row in wrong.tolist():
        tested_on, *indices = (before[name][row] for name in ("set", "environment_index", "episode_index"))
        where = f"{tested_on}, environment {indices[0]}, episode {indices[1]}"
        parts = [f"{name} was {before[name][row]}, is {after[name][row]}" for name in same if not same[name][row]]
        sentences.append(f"{where}: {'; '.join(parts)}")
    return sentences


def play(
    policy: Any,
    settings: Settings,
    trained_on: str | None,
    normalizer: Any,
    name: str | None,
    expected: str | None = None,
) -> tuple[str, PolicyRecords]:
    """Test one policy on all sets. Return the policy's name in reports, and the records of the tests.

    If recorded tests are repeated, `expected` is the policy's name in the records. It is None for new tests.

    Raises:
        PolicyError: if the policy does not fit the environment, or if its name is not the expected one.
    """
    # Describe the environment, including the disturbances if a set names a disturbance. Then prepare the policy for
    # this environment.
    environment, observe = settings.environment, settings.observe
    names = [name for _, _, drawn, contexts in settings.sets for named in (drawn, *(contexts or ())) for name in named]
    address = None if settings.server is None else parse_address(settings.server)
    described = describe(environment, find_folder(settings.task, settings.server), address, settings.timeout)
    description = described.with_parameters(names)
    seen = observe or "state"
    if isinstance(policy, Policy):
        seen = _of_loaded(policy, environment, trained_on, observe)
        trained_on = trained_on or (policy.version if policy.trained_on == policy.version else None)
    fits = description.observing_parameters() if requests.observes_parameters(seen) else description
    tested = players.prepare(policy, fits, deterministic=settings.deterministic, normalizer=normalizer, name=name)
    if expected not in (None, tested.name):
        raise PolicyError(
            f"the tests were recorded with {expected}, but this policy is {tested.name}: give the policy that was "
            "tested"
        )
    seed = requests.seed(
        (1 if tested.loaded is None else tested.loaded.seed) if settings.seed is None else settings.seed
    )
    trials = 1 if tested.loaded is None else tested.loaded.episodes_per_trial
    tests = native(_native.Tests, settings.sets, settings.episodes, seed, settings.success, tested.name, trials)
    for place, one_set in enumerate(settings.sets):
        client = {
            "environment": environment,
            "server": settings.server,
            "task": settings.task,
            "observe": seen,
            "timeout": settings.timeout,
        }
        # All sets share one table of records with the same columns. If any set names a disturbance, the sessions of all
        # sets must have disturbances, so add one that has no effect to a set that names none.
        set_name, version, drawn, contexts = one_set
        if description.is_disturbed and not description.undisturbed.keys() & drawn.keys():
            first, value = next(iter(description.undisturbed.items()))
            drawn = {first: [(value, value)], **drawn}
        shown = Progress(settings.progress)
        trained = "" if trained_on is None else f"trained on {trained_on}, "
        what = f"{environment}, {tested.name}: {trained}testing on {set_name}"
        _test(tests, place, (set_name, version, drawn, contexts), tested, client, trials, partial(shown.update, what))
        shown.finish()
    known = PolicyMetadata(trained_on, tested.timesteps, seed, settings.episodes, seen, tested.deterministic)
    return tested.agent, PolicyRecords(known, tests.records())


def policies(policy: Any, trained_on: str | None, normalizer: Any) -> list[tuple[str | None, Any, Any]]:
    """Return a tuple for each policy: its training version (None if unknown), the policy, and its normaliser."""
    if not isinstance(policy, Mapping):
        return [(None if trained_on is None else requests.version(trained_on, "trained_on"), policy, normalizer)]
    if trained_on is not None:
        raise InvalidArgumentError(
            "the keys of the mapping of policies already state the training versions; leave trained_on= out"
        )
    if not policy:
        raise InvalidArgumentError("policy is an empty mapping; expected policies by the versions they were trained on")
    if normalizer is False:
        normalizer = dict.fromkeys(policy, False)
    normalizers = {} if normalizer is None else normalizer
    if not isinstance(normalizers, Mapping) or set(normalizers) - set(policy):
        raise InvalidArgumentError("normalizer must be False, or a mapping with keys of the mapping of policies")
    keys = {requests.version(key, "a key of the mapping of policies"): key for key in policy}
    if len(keys) < len(policy):
        raise InvalidArgumentError(f"the mapping of policies has a version twice: {', '.join(map(repr, policy))}")
    in_order = [version for version in requests.VERSIONS if version in keys]
    return [(version, policy[keys[version]], normalizers.get(keys[version])) for version in in_order]


def _of_loaded(policy: Policy, environment: str, trained: str | None, observe: str | None) -> str:
    """Return what a policy of `load_policy` observes: `state` or `parameters`.

    Raises:
        PolicyError: if its environment, training version or observations differ from the arguments.
    """
    if policy.environment != environment:
        raise PolicyError(f"the policy {policy.id} was trained in {policy.environment}, not in {environment}")
    if trained is not None and trained != policy.trained_on:
        raise PolicyError(f"the policy {policy.id} was trained on {policy.trained_on}, not on {trained}")
    if observe is not None and observe != policy.observe:
        raise PolicyError(f"the policy {policy.id} observes {policy.observe!r}, not {observe!r}; leave observe= out")
    return policy.observe


def _test(
    tests: _native.Tests,
    place: int,
    one_set: _native.Set,
    tested: players.PolicyUnderTest,
    settings: dict[str, Any],
    episodes_per_trial: int,
    show: Callable[[int, int], None],
) -> None:
    """Play and record the episodes of the test on one set. `place` is the set's position in the list of all sets."""
    _, version, drawn, contexts = one_set
    seed, num_envs = native(tests.plan, place)
    client = Client(
        **settings,
        version=requests.version(version),
        num_envs=num_envs,
        parameters=drawn,
        first_environment_index=0,
        episodes_per_trial=episodes_per_trial,
        autoreset_mode=AutoresetMode.SAME_STEP,
        receipts=True,
        reward_terms=False,
        render_mode=None,
        width=DEFAULT_PIXELS,
        height=DEFAULT_PIXELS,
        single=False,
        contexts=contexts,
    )
    description = client.description
    shape = (num_envs,) if description.discrete else (num_envs, *(description.action_space().shape or ()))
    encode = partial(requests.actions, description=description, shape=shape)
    try:
        begun = client.open([seed], np.random.default_rng())
        assert begun is not None
        native(tests.opened, begun.opened, None if tested.loaded is None else tested.loaded._native)
        observations = begun.observations
        with players.seeded(seed) if tested.loaded is None else contextlib.nullcontext():
            player = tested.player(num_envs, seed)
            native(player.begin, observations)
            # Step all environments until the test has enough finished episodes.
            done, wanted = 0, 1
            while done < wanted:
                stepped = client.session.step(native(player.act), encode)
                observations, rewards, terminated, truncated, events = stepped
                done, wanted = native(tests.take, events, terminated)
                show(done, wanted)
                native(player.observe, observations, rewards, terminated | truncated)
        native(tests.finish)
    finally:
        client.close()
