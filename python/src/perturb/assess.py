"""Test any policy as `perturb evaluate` tests perturb's own: the same episodes, recorded the same way."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.vector import AutoresetMode

from . import _native, catalogue, players, requests
from .assessment import Assessment
from .catalogue import USUAL_PIXELS
from .client import TIMEOUT, Client
from .errors import InvalidArgumentError, PolicyError
from .policy import Policy, native
from .results import Assessed, Audit, Known
from .sets import Set

if TYPE_CHECKING:
    from .requests import Version

# What perturb calls sets that are typed.
DRAWN, LISTED = "parameters", "contexts"


def assess(
    policy: Any,
    environment: str,
    *,
    versions: Sequence[Version | Set] | None = None,
    episodes: int = 1000,
    seed: int | None = None,
    parameters: requests.Parameters | None = None,
    contexts: Sequence[Mapping[str, float]] | None = None,
    base: Version = "D",
    trained_on: Version | None = None,
    success: str | None = None,
    observe: str | None = None,
    deterministic: bool = False,
    normalizer: Any = None,
    name: str | None = None,
    server: str | None = None,
    timeout: float = TIMEOUT,
) -> Assessment:
    """Test a policy, or policies trained on D, R and E, in episodes that no training has seen.

    The episodes are those of `perturb evaluate` with the same environment, seed and number: environments, indices,
    parameters and initial states. A loaded policy also samples the same actions, so its records are the same bytes.

    Args:
        policy: one of

            - what `load_policy` gave;
            - a function `actions = f(observations)` of float32 [N, O], which are its own to change. Actions are
              integers [N] from 0, or numbers [N, A], which environments clip to their range;
            - a function with memory, `actions, memory = f(observations, memory, starts)`. `memory` is None in the first
              call of a test, later what the function returned; where `starts`, bool [N], an episode begins, and the
              function must take what it remembers of that row for nothing. N, and which row is which environment,
              stays the same in a test. Which of the two it is, is told by the number of arguments that it must be
              given;
            - a stable-baselines3 model, or one of sb3_contrib with memory, with the VecNormalize that it has;
            - a torch module of float32 [N, O] in evaluation mode, without gradients: of choices the greatest of its
              outputs [N, n] counts, or they are integers [N]; otherwise numbers [N, A];
            - a mapping of such by the version that each was trained on, `{"D": …, "R": …, "E": …}`: all pairs are
              tested, with all three the paper's nine scenarios.
        environment: a name of docs/environments.md, such as `CartPole`.
        versions: to test on, `D`, `R`, `E` and `R+E`, and sets of `perturb.sets`; at first the paper's three; none if
            parameters or contexts are given.
        episodes: of each test, at least 1. Of a policy trained over trials these are trials, of each of which the last
            episode counts. A list of contexts has equally many in each, at least 1.
        seed: fixes all randomness, 0 … 2^64 - 1; at first that of the loaded policy's training, or 1.
        parameters: a further test, called `parameters`, on sets of one's own in place of those of the version `base`:
            by name a value, an interval `(low, high)`, or several.
        contexts: a further test, called `contexts`, on each of these values of parameters.
        base: where parameters come from of which these two say nothing.
        trained_on: where the policy's training had its parameters from, which names its scenarios; of a loaded policy
            it is known.
        success: what decides about success: `text` (the environment's rule, the paper's text; so at first), `code` (the
            paper's published code), or a threshold such as `steps=90`.
        observe: `state` (at first), or `parameters` for observations that have the parameters at their end; of a loaded
            policy it is known.
        deterministic: of a stable-baselines3 model: whether it takes the mode instead of sampling.
        normalizer: of a stable-baselines3 model: a VecNormalize, which is only read; at first the model's own, which a
            model that was loaded without its environment no longer has. With a mapping of policies, a mapping, too.
        name: what records and reports call the policy; at first records have its id, its kind with a checksum of its
            weights, or its function, and reports its kind.
        server: `unix:/path` or `host:port`; None starts a server of this process's own.
        timeout: how long a reply may take, s.

    While a policy that is not perturb's acts, NumPy's global random numbers and torch's are seeded by the test;
    afterwards they are what they were. So a model that samples with torch gives the same bytes again, on the same
    machine.

    Raises:
        PolicyError: if the policy does not fit the environment, or fails; nothing was recorded.
        InvalidArgumentError, UnknownNameError: for wrong names, sets or numbers, before anything is played; for actions
            of a wrong shape or kind.
        ProtocolError: if episodes ran with other parameters than they were to run with.
        ServerConnectionError, ServerTimeoutError, ServerStartError: and nothing was recorded.
    """
    environment = catalogue.find(environment).name
    requests.count(episodes, "episodes", 1)
    policies = _policies(policy, trained_on, normalizer)
    sets = _sets(versions, parameters, contexts, base)
    assessed, agents = [], []
    for trained, one, own_normalizer in policies:
        settings = Settings(environment, sets, episodes, seed, success, observe, deterministic, server, timeout)
        agent, tested = play(one, settings, trained, own_normalizer, name)
        agents.append(agent)
        assessed.append(tested)
    return Assessment(", ".join(dict.fromkeys(agents)), assessed)


@dataclass(frozen=True)
class Settings:
    """How a policy is tested."""

    environment: str
    sets: list[_native.Set]
    episodes: int
    seed: int | None
    success: str | None
    observe: str | None
    deterministic: bool
    server: str | None
    timeout: float


def again(
    recorded: Sequence[Assessed], agent: str, policy: Any, normalizer: Any, server: str | None, timeout: float
) -> Audit:
    """Play all recorded tests again; see `Assessment.audit`."""
    given = {trained: (one, own) for trained, one, own in _policies(policy, None, normalizer)}
    keys = [one.trained_on for one in recorded]
    if not isinstance(policy, Mapping) and len(keys) == 1:
        given = {keys[0]: given[None]}
    if set(given) != set(keys):
        expected = "one policy" if keys == [None] else f"a mapping with the keys {', '.join(map(repr, keys))}"
        raise InvalidArgumentError(
            f"the recorded tests are of other policies than those that are given; expected {expected}"
        )
    episodes, different = 0, []
    for one in recorded:
        known, records = one.known, one.records
        acts, own_normalizer = given[one.trained_on]
        name = agent if records.policy == agent and not isinstance(acts, Policy) else None
        settings = Settings(
            records.environment,
            records.tests(),
            known.episodes,
            known.seed,
            records.rule,
            known.observe,
            bool(known.deterministic),
            server,
            timeout,
        )
        _, tested = play(acts, settings, known.trained_on, own_normalizer, name, records.policy)
        episodes += len(records.columns()["seed"])
        different += _differences(records.columns(), tested.records.columns())
    return Audit(episodes, tuple(different))


def _differences(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """A sentence for each episode in which something came out otherwise."""
    same: dict[str, Any] = {}
    for name, values in before.items():
        a, b = np.asarray(values), np.asarray(after[name])
        same[name] = (a == b) | ((a != a) & (b != b)) if a.dtype.kind == "f" else a == b
    wrong = np.flatnonzero(~np.logical_and.reduce(list(same.values())))
    sentences = []
    for row in wrong.tolist():
        tested_on, *address = (before[name][row] for name in ("set", "environment_index", "episode_index"))
        where = f"{tested_on}, environment {address[0]}, episode {address[1]}"
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
) -> tuple[str, Assessed]:
    """Test one policy, which records call as expected: what reports call the agent, and its records."""
    environment, observe = settings.environment, settings.observe
    description = catalogue.find(environment)
    seen = observe or "state"
    if isinstance(policy, Policy):
        seen = _of_loaded(policy, environment, trained_on, observe)
        trained_on = trained_on or (policy.version if policy.trained_on == policy.version else None)
    fits = description.observing_parameters() if requests.observes_parameters(seen) else description
    tested = players.tested(policy, fits, deterministic=settings.deterministic, normalizer=normalizer, name=name)
    if expected not in (None, tested.name):
        raise PolicyError(
            f"the tests were recorded of {expected}, this is {tested.name}: give the policy that was tested"
        )
    seed = requests.seed(
        (1 if tested.loaded is None else tested.loaded.seed) if settings.seed is None else settings.seed
    )
    trials = 1 if tested.loaded is None else tested.loaded.episodes_per_trial
    tests = native(_native.Tests, settings.sets, settings.episodes, seed, settings.success, tested.name, trials)
    for place, one_set in enumerate(settings.sets):
        client = {"environment": environment, "server": settings.server, "observe": seen, "timeout": settings.timeout}
        _test(tests, place, one_set, tested, client, trials)
    known = Known(trained_on, tested.timesteps, seed, settings.episodes, seen, tested.deterministic)
    return tested.agent, Assessed(known, tests.records())


def _policies(policy: Any, trained_on: str | None, normalizer: Any) -> list[tuple[str | None, Any, Any]]:
    """Of each policy what it was trained on, itself, and its normaliser."""
    if not isinstance(policy, Mapping):
        return [(None if trained_on is None else requests.version(trained_on, "trained_on"), policy, normalizer)]
    if trained_on is not None:
        raise InvalidArgumentError("trained_on= is said by the keys of a mapping of policies; leave it out")
    if not policy:
        raise InvalidArgumentError("policy is an empty mapping; expected policies by the versions they were trained on")
    normalizers = {} if normalizer is None else normalizer
    if not isinstance(normalizers, Mapping) or set(normalizers) - set(policy):
        raise InvalidArgumentError("normalizer must be a mapping with keys of the mapping of policies")
    keys = {requests.version(key, "a key of the mapping of policies"): key for key in policy}
    if len(keys) < len(policy):
        raise InvalidArgumentError(f"the mapping of policies has a version twice: {', '.join(map(repr, policy))}")
    in_order = [version for version in requests.VERSIONS if version in keys]
    return [(version, policy[keys[version]], normalizers.get(keys[version])) for version in in_order]


def _of_loaded(policy: Policy, environment: str, trained: str | None, observe: str | None) -> str:
    """What a loaded policy observes; it must be one of this environment."""
    if policy.environment != environment:
        raise PolicyError(f"the policy {policy.id} was trained in {policy.environment}, not in {environment}")
    if trained is not None and trained != policy.trained_on:
        raise PolicyError(f"the policy {policy.id} was trained on {policy.trained_on}, not on {trained}")
    if observe is not None and observe != policy.observe:
        raise PolicyError(f"the policy {policy.id} observes {policy.observe!r}, not {observe!r}; leave observe= out")
    return policy.observe


def _sets(
    versions: Sequence[Any] | None,
    parameters: requests.Parameters | None,
    contexts: Sequence[Mapping[str, float]] | None,
    base: str,
) -> list[_native.Set]:
    base = requests.version(base, "base")
    own = parameters is not None or contexts is not None
    named: Sequence[Any] = (() if own else ("D", "R", "E")) if versions is None else versions
    if isinstance(named, str) or not isinstance(named, Sequence):
        raise InvalidArgumentError(f"versions={versions!r}; expected several, such as ('D', 'R', 'E')")
    chosen = [one for one in named if isinstance(one, Set)]
    plain = [requests.version(one) for one in named if not isinstance(one, Set)]
    sets: list[_native.Set] = [(version, version, {}, None) for version in requests.VERSIONS if version in plain]
    sets += [one._plain() for one in chosen]
    if parameters is not None:
        sets.append((DRAWN, base, requests.distributions(parameters), None))
    if contexts is not None:
        sets.append((LISTED, base, {}, requests.contexts(contexts)))
    if not sets:
        raise InvalidArgumentError("there is nothing to test on: give versions, parameters or contexts")
    return sets


def _test(
    tests: _native.Tests,
    place: int,
    one_set: _native.Set,
    tested: players.Tested,
    settings: dict[str, Any],
    episodes_per_trial: int,
) -> None:
    """Play one set's episodes."""
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
        width=USUAL_PIXELS,
        height=USUAL_PIXELS,
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
            done, wanted = 0, 1
            while done < wanted:
                stepped = client.session.step(native(player.act), encode)
                observations, rewards, terminated, truncated, events = stepped
                done, wanted = native(tests.take, events, terminated)
                native(player.observe, observations, rewards, terminated | truncated)
        native(tests.finish)
    finally:
        client.close()
