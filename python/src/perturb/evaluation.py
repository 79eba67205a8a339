"""Tests policies of any kind in the episodes that `perturb evaluate` plays, and records them in the same format."""

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

# Names of the test sets that the arguments `parameters` and `contexts` of `evaluate` make.
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
    """Test a policy, or several policies by their training version, in episodes that no training has seen.

    The episodes are those of `perturb evaluate` with the same environment, seed and number of episodes: they have the
    same environment indices, parameters and initial states. A policy of `load_policy` also samples the same actions, so
    its records have the same bytes.

    Args:
        policy: one of

            - a policy that `load_policy` returned.
            - a function `actions = f(observations)`. Observations are float32 [N, O], and the function may change them.
              Actions are integers [N] counted from 0, or numbers [N, A], which environments clip to their range.
            - a function with memory, `actions, memory = f(observations, memory, starts)`, recognised by its three
              required arguments. `memory` is None in the first call of a test, and then the value that the last call
              returned. `starts`, bool [N], is true where an episode begins; the function must reset the memory of that
              row. N, and the environment of each row, stay the same during a test.
            - a stable-baselines3 model, also a recurrent one of sb3_contrib, with its VecNormalize if it has one.
            - a torch module that maps observations, float32 [N, O]. It runs in evaluation mode without gradients. For
              n discrete actions it returns either logits [N, n], of which the greatest selects the action, or the
              actions themselves, integers [N]. For continuous actions it returns numbers [N, A].
            - a mapping from training versions to policies, `{"D": …, "R": …, "E": …}`. Each policy is tested on each
              version. Three policies thus give the paper's nine scenarios.
        environment: the environment's name in docs/environments.md, such as `CartPole`. With `task`, the name of the
            task or None.
        versions: the versions to test on (`D`, `R`, `E`, `R+E`), and sets of `perturb.sets`. By default D, R and E, or
            none if `parameters` or `contexts` is given.
        episodes: number of episodes of each test, at least 1. An RL² policy plays this number of trials, and only the
            last episode of each trial counts. If a set has a list of contexts, the episodes are divided equally among
            the contexts, and each context has at least one.
        seed: fixes all randomness, 0 … 2^64 - 1. By default the training seed of a policy of `load_policy`, else 1.
        parameters: adds a test called `parameters`, in which these values replace those of the version `base`. A value
            is a number, an interval `(low, high)` or `"low..high"`, or several intervals.
        contexts: adds a test called `contexts`, on this list of contexts. A context is a mapping from names of
            parameters to values.
        base: the version of all parameters that `parameters` or `contexts` do not name.
        trained_on: the version that the policy was trained on. It becomes part of the names of scenarios, such as `DR`.
            Leave it out for a policy of `load_policy`, which knows its version.
        success: the success rule. `text` is the environment's rule, which follows the paper's text (default). `code`
            follows the paper's published code. A threshold is a text such as `steps=90`, `return>=300` or `length<=90`.
            A function gets the columns of `Assessment.columns`, arrays [episodes] by name, and returns bool [episodes].
        observe: `state` (default), or `parameters` to append the parameters to observations. Leave it out for a policy
            of `load_policy`, which knows what it observes.
        deterministic: for a stable-baselines3 model, whether to take the mode of the action distribution instead of
            sampling. True by default, as in stable-baselines3's `evaluate_policy`. Policies of `load_policy` sample.
        normalizer: for a stable-baselines3 model, its VecNormalize, which is only read, or the path of a saved one.
            False for none. By default the VecNormalize of the model's environment. A model that was loaded without its
            environment has no VecNormalize, and is refused if it was, or may have been, trained with one. If `policy`
            is a mapping, pass a mapping with the same keys, or False.
        name: a name for the policy in records and reports. By default records name a function by its own name, and a
            model by its class and a checksum of its weights. Reports leave the checksum out. Do not pass `name` for a
            policy of `load_policy`: records have its id, and reports its method, such as `ppo ff`.
        server: the server's address, `unix:/path` or `host:port`, or `embedded` for a server in this process. None
            starts a private server.
        task: the folder of a task to serve; see docs/tasks.md. It needs a private or an embedded server.
        timeout: maximum time to wait for a reply, s.
        progress: whether to show the number of played episodes on standard error. By default only on a terminal.

    While a function or a model of another library acts, the test seeds the global random generators of NumPy and torch,
    and then restores them. A model that samples with torch therefore gives the same bytes again, on the same machine.

    Raises:
        PolicyError: if the policy does not fit the environment, or fails. Nothing was recorded.
        InvalidArgumentError: if a name, set or number is wrong (before any episode is played), or if actions have a
            wrong shape or type.
        UnknownNameError: if there is no such parameter.
        ProtocolError: if the parameters that the server applied differ from the requested ones.
        ServerConnectionError: if the server cannot be reached, or the connection broke. Nothing was recorded.
        ServerTimeoutError: if the server did not reply in time. Nothing was recorded.
        ServerStartError: if the private server did not start. Nothing was recorded.
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
    """Return the test sets that the arguments of `evaluate` select, as tuples for the native module.

    Raises:
        InvalidArgumentError: if no set is selected, or if an argument is malformed.
    """
    base = requests.version(base, "base")
    own = parameters is not None or contexts is not None
    named: Sequence[Any] = (() if own else ("D", "R", "E")) if versions is None else versions
    if isinstance(named, str) or not isinstance(named, Sequence):
        raise InvalidArgumentError(f"versions={versions!r}; expected a list, such as ['D', 'R', 'E']")
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
