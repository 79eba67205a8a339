"""Invalid input is refused and changes nothing. Errors name the invalid value and the expected values."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import pytest

import perturb
from perturb.address import parse_address

from .conftest import ROOT, identifier

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("name", "action", "says"),
    [
        ("CartPole", 2, "2"),
        ("CartPole", -1, "-1"),
        ("CartPole", 0.5, "integers"),
        ("CartPole", "1", "integers"),
        ("CartPole", None, "integers"),
        ("CartPole", [1], r"shape \(1,\); expected \(\)"),
        ("CartPole", 2**32, "4294967296"),
        ("Pendulum", [NAN], "NaN"),
        ("Pendulum", [INF], "inf"),
        ("Pendulum", [1e300], "inf"),
        ("Pendulum", 0.5, r"shape \(\); expected \(1,\)"),
        ("Pendulum", [0.5, 0.5], r"shape \(2,\)"),
        ("Pendulum", ["up"], "numbers"),
    ],
)
def test_an_invalid_action_changes_nothing(name: str, action: Any, says: str, server: str) -> None:
    env, twin = (gymnasium.make(identifier(name), server=server).unwrapped for _ in range(2))
    good = env.action_space.sample()
    env.reset(seed=1)
    twin.reset(seed=1)
    with pytest.raises(perturb.InvalidArgumentError, match=says) as caught:
        env.step(action)
    assert isinstance(caught.value, ValueError)
    assert env.step(good)[0].tobytes() == twin.step(good)[0].tobytes()


@pytest.mark.parametrize(
    ("actions", "says"),
    [
        (np.zeros(2, dtype=np.int64), r"shape \(2,\); expected \(3,\)"),
        (np.zeros((3, 1), dtype=np.int64), r"shape \(3, 1\)"),
        (np.array([0, 1, 2]), "2"),
        (np.array([0, 1, 2**40]), str(2**40)),
        (np.array([0, 1, 2**32 - 1], dtype=np.uint32), str(2**32 - 1)),
        (np.zeros(3), "integers"),
    ],
)
def test_invalid_actions_of_a_batch_change_nothing(actions: Any, says: str, server: str) -> None:
    envs = gymnasium.make_vec("perturb/CartPole-v1", num_envs=3, server=server)
    envs.reset(seed=1)
    saved = envs.unwrapped.snapshot()  # type: ignore[attr-defined]
    with pytest.raises(perturb.InvalidArgumentError, match=says):
        envs.step(actions)
    assert envs.unwrapped.snapshot() == saved  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("settings", "error", "says"),
    [
        ({"environment": "CartPool"}, perturb.InvalidArgumentError, "did you mean 'CartPole'"),
        ({"version": "X"}, perturb.InvalidArgumentError, "'D'"),
        ({"observe": "everything"}, perturb.InvalidArgumentError, "observe='everything'; expected 'state'"),
        ({"observe": True}, perturb.InvalidArgumentError, "observe=True"),
        ({"server": "nowhere"}, perturb.InvalidArgumentError, "port is missing"),
        ({"server": 7}, perturb.InvalidArgumentError, "not a string"),
        ({"parameters": ["force"]}, perturb.InvalidArgumentError, "expected a dict"),
        ({"parameters": {"force": "strong"}}, perturb.InvalidArgumentError, "`strong`, but must be a value"),
        ({"parameters": {"force": "7,5"}}, perturb.InvalidArgumentError, "7.5 for one number, or `7, 5` for two"),
        ({"parameters": {"force": "7.5,8.5"}}, perturb.InvalidArgumentError, "which are points"),
        ({"parameters": {"force": "5..9/3"}}, perturb.InvalidArgumentError, "perturb.sets.grid"),
        (
            {"parameters": {"force": [5, 9]}},
            perturb.InvalidArgumentError,
            r"may be an interval or two values; write \(5, 9\)",
        ),
        ({"parameters": {"force": np.array([5, 9])}}, perturb.InvalidArgumentError, "may be an interval or two values"),
        ({"max_episode_steps": 5, "forse": 1}, perturb.InvalidArgumentError, "max_episode_steps= is not a setting"),
        (
            {"versions": "R"},
            perturb.InvalidArgumentError,
            r"versions= is not a setting of environments \(did you mean version=",
        ),
        ({"parameters": {"force": (1, 2, 3)}}, perturb.InvalidArgumentError, r"\(1, 2, 3\)"),
        ({"parameters": {"force": [(1, 2), 3]}}, perturb.InvalidArgumentError, "several intervals"),
        ({"parameters": {7: 7}}, perturb.InvalidArgumentError, "key 7"),
        ({"parameters": {"force": NAN}}, perturb.InvalidArgumentError, "NaN"),
        ({"parameters": {"force": 1e9}}, perturb.InvalidArgumentError, "1000"),
        ({"parameters": {"force": (2, 1)}}, perturb.InvalidArgumentError, "force"),
        ({"parameters": {"forse": 1}}, perturb.UnknownNameError, "forse"),
        ({"environment_index": -1}, perturb.InvalidArgumentError, "-1"),
        ({"episodes_per_trial": 0}, perturb.InvalidArgumentError, "episodes_per_trial=0"),
        ({"timeout": 0}, perturb.InvalidArgumentError, "timeout=0"),
        ({"timeout": NAN}, perturb.InvalidArgumentError, "timeout=nan"),
        ({"timeout": None}, perturb.InvalidArgumentError, "timeout=None; expected a number of seconds"),
        ({"timeout": "5"}, perturb.InvalidArgumentError, "timeout='5'"),
        ({"timeout": True}, perturb.InvalidArgumentError, "timeout=True"),
        ({"timeout": [5.0]}, perturb.InvalidArgumentError, r"timeout=\[5\.0\]"),
        ({"timeout": 10**400}, perturb.InvalidArgumentError, "timeout=1000"),
        ({"render_mode": "human"}, perturb.InvalidArgumentError, r"gymnasium\.wrappers\.HumanRendering"),
        ({"render_mode": "ansi"}, perturb.InvalidArgumentError, "'ansi'; expected 'rgb_array'"),
        ({"width": 15}, perturb.InvalidArgumentError, "width=15; expected an integer from 16 to 2048"),
        ({"height": 2049}, perturb.InvalidArgumentError, "height=2049"),
        ({"height": 480.0}, perturb.InvalidArgumentError, r"height=480\.0"),
    ],
)
def test_wrong_settings_are_refused(settings: dict[str, Any], error: type[Exception], says: str, server: str) -> None:
    with pytest.raises(error, match=says):
        perturb.PerturbEnv(**{"environment": "CartPole", "server": server, **settings}).reset()


def test_unknown_names_raise_key_errors_with_unquoted_messages(server: str) -> None:
    env = perturb.PerturbEnv("CartPole", server=server)
    env.reset()
    with pytest.raises(KeyError) as caught:
        env.reset(options={"parameters": {"forse": 1}})
    assert isinstance(caught.value, perturb.PerturbError)
    assert not str(caught.value).startswith(("'", '"'))


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"num_envs": 0}, "num_envs=0"),
        ({"num_envs": 2.5}, "num_envs=2.5"),
        ({"num_envs": True}, "num_envs=True"),
        ({"episodes_per_trial": 10**9 * 10}, "from 1 to 2\\^32 - 1"),
        ({"num_envs": 2**32}, "4294967296"),
        ({"autoreset_mode": "Sometimes"}, "'SameStep'"),
        ({"first_environment_index": "first"}, "'first'"),
        ({"max_episode_steps": 50}, "the step limit of the server, 200"),
        ({"daemon": True}, "daemon= is not a setting of environments; there are"),
    ],
)
def test_wrong_settings_of_a_batch_are_refused(settings: dict[str, Any], says: str, server: str) -> None:
    with pytest.raises(perturb.InvalidArgumentError, match=says):
        perturb.PerturbVectorEnv("CartPole", **{"server": server, **settings}).reset()


@pytest.mark.parametrize(
    ("seed", "options", "says"),
    [
        (-1, None, "seed=-1"),
        (2**64, None, "2\\^64"),
        (1.5, None, "1.5"),
        (2**64 - 2, None, "2\\^64"),  # the seed of the third environment would be 2^64
        ([1, 2], None, "2 numbers"),
        (np.array([1, 2]), None, "2 numbers"),
        (np.array([1.0, 2.0, 3.0]), None, "1.0"),
        (np.array([[1], [2], [3]]), None, "integer"),
        ([1, 2, "x"], None, "'x'"),
        (None, ["state"], "expected a dict"),
        (None, {"states": [[0] * 4] * 3}, "unknown keys"),
        (None, {"state": [0] * 4}, "3 rows"),
        (None, {"state": [[0] * 4] * 2}, "3 rows"),
        (None, {"state": [[0] * 5] * 3}, "state"),
        (None, {"state": [[NAN] * 4] * 3}, "NaN"),
        (None, {"state": [[99] * 4] * 3}, "99"),
        (None, {"reset_mask": [True] * 3}, "numpy array of bool"),
        (None, {"reset_mask": np.ones(3)}, "numpy array of bool"),
        (None, {"reset_mask": np.ones(2, dtype=bool)}, r"\(3,\)"),
        (None, {"reset_mask": np.zeros(3, dtype=bool)}, "at least one True"),
        (None, {"parameters": {"force": None}}, "None"),
    ],
)
def test_a_wrong_reset_changes_nothing(seed: Any, options: Any, says: str, server: str) -> None:
    envs = perturb.PerturbVectorEnv("CartPole", 3, server=server)
    envs.reset(seed=1)
    saved = envs.snapshot()
    with pytest.raises(perturb.InvalidArgumentError, match=says):
        envs.reset(seed=seed, options=options)
    assert envs.snapshot() == saved


@pytest.mark.parametrize(
    ("snapshots", "mask", "says"),
    [
        ([b"nonsense"] * 2, None, "snapshot"),
        ([], None, "snapshot"),
        (["text"] * 2, None, "bytes"),
        ([b"nonsense"], np.array([1, 0]), "numpy array of bool"),
    ],
)
def test_wrong_snapshots_change_nothing(snapshots: Any, mask: Any, says: str, server: str) -> None:
    envs = perturb.PerturbVectorEnv("CartPole", 2, server=server)
    envs.reset(seed=1)
    saved = envs.snapshot()
    with pytest.raises(perturb.InvalidArgumentError, match=says):
        envs.restore(snapshots, mask)
    assert envs.snapshot() == saved


def test_calls_out_of_order_are_refused(server: str) -> None:
    env = perturb.PerturbEnv("CartPole", server=server)
    for call in (lambda: env.step(0), env.snapshot):
        with pytest.raises(perturb.OutOfOrderError, match=r"reset\(\) first"):
            call()
    env.reset(seed=1)
    while not env.step(1)[2]:
        pass
    with pytest.raises(perturb.OutOfOrderError, match="reset"):
        env.step(1)
    env.reset()
    env.step(1)
    env.close()
    env.close()
    with pytest.raises(perturb.OutOfOrderError, match="closed"):
        env.reset()

    envs = perturb.PerturbVectorEnv("CartPole", 2, server=server)
    with pytest.raises(perturb.OutOfOrderError, match=r"reset\(\) first"):
        envs.reset(options={"reset_mask": np.array([True, False])})


def test_a_full_server_names_its_limit(start_server: Callable[..., Any]) -> None:
    address = start_server("--max-envs", "10", "--max-sessions", "1").address
    with pytest.raises(perturb.ServerFullError, match="10"):
        perturb.PerturbVectorEnv("CartPole", 11, server=address).reset()
    envs = perturb.PerturbVectorEnv("CartPole", 10, server=address)
    envs.reset()
    with pytest.raises(perturb.ServerFullError, match="sessions"):
        perturb.PerturbEnv("CartPole", server=address).reset()


def test_error_of_a_too_large_message_names_the_limits_flag(start_server: Callable[..., Any]) -> None:
    address = start_server("--max-message-bytes", "1024").address
    envs = perturb.PerturbVectorEnv("CartPole", 500, server=address)
    envs.reset()
    with pytest.raises(perturb.InvalidArgumentError, match="--max-message-bytes"):
        envs.step(np.zeros(500, dtype=np.int32))


ADDRESSES = json.loads((ROOT / "crates/protocol/tests/addresses.json").read_text())


@pytest.mark.parametrize(("text", "target"), ADDRESSES["understood"].items())
def test_addresses_are_parsed_as_in_rust(text: str, target: str) -> None:
    assert parse_address(text).target == target


def test_relative_path_of_a_socket_becomes_absolute(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    assert parse_address("unix:my.sock").target == f"unix:{tmp_path}/my.sock"


@pytest.mark.parametrize("text", ADDRESSES["refused"])
def test_addresses_are_refused_as_in_rust(text: str) -> None:
    with pytest.raises(perturb.InvalidArgumentError, match="is not a server's address"):
        parse_address(text)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "port is missing"),
        ("unix://relative", "absolute"),
        ("unix:", "missing"),
        ("unix:/" + "x" * 200, "107"),
        ("https://host", "port is missing"),
        ("ftp://host:1", "not a host name"),
        ("host:99999", "'99999' is not a port"),
        ("host:0", "'0' is not a port"),
        (":80", "not a host name"),
        ("::1:80", "brackets"),
        ("[nonsense]:80", "not an IPv6"),
    ],
)
def test_error_of_a_wrong_address_says_what_is_wrong(text: str, says: str) -> None:
    with pytest.raises(perturb.InvalidArgumentError, match=says):
        parse_address(text)
