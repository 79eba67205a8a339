"""Test any policy as `perturb evaluate` tests perturb's own: the same episodes, recorded the same way."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from . import requests, success_rules
from .address import parse_address
from .assessment import Assessment
from .client import TIMEOUT
from .errors import InvalidArgumentError
from .sets import Set
from .task_folder import describe, find_folder
from .testing import Settings, play, policies

if TYPE_CHECKING:
    from . import _native
    from .requests import Version
    from .success_rules import SuccessRule

# Names of the sets that `parameters=` and `contexts=` make.
DRAWN, LISTED = "parameters", "contexts"


def evaluate(
    policy: Any,
    environment: str | None = None,
    *,
    versions: Sequence[Version | Set] | None = None,
    episodes: int = 1000,
    seed: int | None = None,
    parameters: requests.Parameters | None = None,
    contexts: Sequence[Mapping[str, float]] | None = None,
    base: Version = "D",
    trained_on: Version | None = None,
    success: SuccessRule | None = None,
    observe: str | None = None,
    deterministic: bool | None = None,
    normalizer: Any = None,
    name: str | None = None,
    server: str | None = None,
    task: str | os.PathLike[str] | None = None,
    timeout: float = TIMEOUT,
    progress: bool | None = None,
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
              call of a test, later what the function returned. Where `starts`, bool [N], is true, an episode begins,
              and the function must forget that row. N, and the environment of each row, stay the same in a test.
              The number of required arguments tells whether a function has memory;
            - a stable-baselines3 model, or one of sb3_contrib with memory, with the VecNormalize that it has;
            - a torch module of float32 [N, O], which runs in evaluation mode without gradients. For choices it returns
              numbers [N, n], of which the greatest counts, or integers [N]; otherwise numbers [N, A];
            - a mapping of such by the version that each was trained on, `{"D": …, "R": …, "E": …}`: all pairs are
              tested, with all three the paper's nine scenarios.
        environment: a name of docs/environments.md, such as `CartPole`; with `task` its name, or None.
        versions: the versions to test on, `D`, `R`, `E` and `R+E`, and sets of `perturb.sets`. By default D, R and E,
            or none if parameters or contexts are given.
        episodes: episodes of each test, at least 1. A policy that was trained over trials plays so many trials, and the
            last episode of each counts. Each context of a list has equally many, at least 1.
        seed: fixes all randomness, 0 … 2^64 - 1. By default the seed of the loaded policy's training, or 1.
        parameters: a further test, called `parameters`, in which these values replace those of the version `base`: by
            name a number, an interval `(low, high)` or `"low..high"`, or several.
        contexts: a further test, called `contexts`, on each of these values of parameters.
        base: the version of the parameters that these two do not name.
        trained_on: the version that the policy was trained on, which names its scenarios. Leave it out for a loaded
            policy, which knows it.
        success: the rule of success: `text` (the environment's rule, as the paper's text has it; the default), `code`
            (as the paper's published code has it), or a threshold such as `steps=90`, `return>=300` or `length<=90`; or
            a function of the columns of `Assessment.columns`, arrays [episodes] by name, that returns bool [episodes].
        observe: `state` (default), or `parameters` for observations that have the parameters at their end. Leave it out
            for a loaded policy, which knows it.
        deterministic: of a stable-baselines3 model: whether it takes the mode of its actions' distribution instead of
            sampling. True by default, as in stable-baselines3's `evaluate_policy`. A loaded policy of perturb samples.
        normalizer: of a stable-baselines3 model: a VecNormalize, which is only read, or the path that its `save` wrote;
            False for none. By default the model's own. A model that was loaded without its environment no longer has
            it, and is refused if it was trained under one. With a mapping of policies, a mapping, too.
        name: the policy's name in records and reports. By default records have its id, its kind with a checksum of its
            weights, or its function, and reports have its kind.
        server: `unix:/path`, `host:port`, or `embedded` for one in this process; None starts a private server.
        task: the folder of a task, which the server of this process's own then serves; see docs/tasks.md.
        timeout: how long a reply may take, s.
        progress: whether to show on standard error how many episodes were played; by default on a terminal only.

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
    requests.seconds(timeout, "timeout")
    address = None if server is None else parse_address(server)
    environment = describe(environment, find_folder(task, server), address, timeout).name
    requests.count(episodes, "episodes", 1)
    tested = policies(policy, trained_on, normalizer)
    sets = plain_sets(versions, parameters, contexts, base)
    assessed, agents = [], []
    rule, own_rule = success_rules.parse(success)
    for trained, one, own_normalizer in tested:
        settings = Settings(
            environment, sets, episodes, seed, rule, observe, deterministic, server, task, timeout, progress
        )
        agent, recorded = play(one, settings, trained, own_normalizer, name)
        if own_rule is not None:
            recorded = replace(recorded, records=own_rule.judge(recorded.records))
        agents.append(agent)
        assessed.append(recorded)
    return Assessment(", ".join(dict.fromkeys(agents)), assessed)


def plain_sets(
    versions: Sequence[Any] | None,
    parameters: requests.Parameters | None,
    contexts: Sequence[Mapping[str, float]] | None,
    base: str,
) -> list[_native.Set]:
    """Return the sets that the arguments of `evaluate` name.

    Raises:
        InvalidArgumentError: if there are none, or for what is no set.
    """
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
