"""Options of environments and resets: parameters, states, masks, receipts, snapshots; and ownership of arrays."""

from __future__ import annotations

import copy
import json
import re
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import perturb
from perturb import _native
from perturb.catalogue import CATALOGUE, Description
from perturb.registration import register_all

from .conftest import ROOT, identifier


def make(name: str = "CartPole", **settings: Any) -> perturb.PerturbEnv:
    env = gymnasium.make(identifier(name), **settings).unwrapped
    assert isinstance(env, perturb.PerturbEnv)
    return env


def make_vec(name: str = "CartPole", **settings: Any) -> perturb.PerturbVectorEnv:
    envs = gymnasium.make_vec(identifier(name), **settings)
    assert isinstance(envs, perturb.PerturbVectorEnv)
    return envs


def test_the_package_has_the_version_of_the_server() -> None:
    version = re.search(r'\[workspace\.package\]\nversion = "(.*)"', (ROOT / "Cargo.toml").read_text())
    assert version is not None
    assert perturb.__version__ == version[1]


@pytest.mark.socket
def test_the_catalogue_equals_that_of_the_server(server: str) -> None:
    served = json.loads(_native.catalogue(server, 10.0))["environments"]
    assert [environment["name"] for environment in served] == list(CATALOGUE)
    for environment in served:
        CATALOGUE[environment["name"]].require_equal(Description.read(environment))
        other = {**environment, "revision": environment["revision"] + 1}
        with pytest.raises(perturb.ProtocolError, match=f"has revision {other['revision']} of {other['name']}"):
            CATALOGUE[environment["name"]].require_equal(Description.read(other))
        environment["observation"][0]["low"] = -7
        with pytest.raises(perturb.ProtocolError, match=r"-7\b"):
            CATALOGUE[environment["name"]].require_equal(Description.read(environment))


def test_new_environment_needs_no_change_of_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    success = {"description": "", "quantity": "steps", "unit": "1", "comparison": "at_most", "threshold": 9.0}
    toy = {
        "name": "Toy",
        "revision": 3,
        "observation": [{"low": None, "high": 2.0}, {"low": -1.0, "high": None}],
        "action": {"continuous": [{"low": -0.5, "high": 0.5}]},
        "control_timestep": 0.25,
        "success": success,
    }
    monkeypatch.setitem(CATALOGUE, "Toy", Description.read(toy))
    monkeypatch.setattr(gymnasium.envs.registration, "registry", {})
    monkeypatch.setattr(gymnasium, "registry", gymnasium.envs.registration.registry)
    register_all()
    env = gymnasium.make("perturb/Toy-v3", server="unix:/nowhere")
    low, high = np.array([[-np.inf, -1], [2, np.inf]], np.float32)
    assert env.observation_space == gymnasium.spaces.Box(low, high)
    assert env.action_space == gymnasium.spaces.Box(-0.5, 0.5, (1,))
    assert env.metadata == {"render_modes": ["rgb_array"], "render_fps": 4, "success": success}


@pytest.mark.parametrize("kind", [np.int64, np.uint8, np.array])
def test_seeds_may_be_numpy_integers_or_arrays(kind: Any, server: str) -> None:
    env, envs = make(server=server), make_vec(num_envs=3, server=server)
    expected, _ = env.reset(seed=11)
    assert env.reset(seed=kind(11))[0].tobytes() == expected.tobytes()
    assert env.np_random_seed == 11
    batch, _ = envs.reset(seed=11)
    assert batch[0].tobytes() == expected.tobytes()
    assert envs.reset(seed=kind(11))[0].tobytes() == batch.tobytes()
    assert envs.reset(seed=np.array([11, 12, 13], dtype=np.int32))[0].tobytes() == batch.tobytes()  # type: ignore[arg-type]
    assert envs.reset(seed=[kind(11), kind(12), kind(13)])[0].tobytes() == batch.tobytes()
    assert envs.np_random_seed == 11


@pytest.mark.parametrize(
    ("given", "intervals"),
    [
        (12, [(12, 12)]),
        (np.float32(0.5), [(0.5, 0.5)]),
        ((1, 2), [(1, 2)]),
        ("3..4", [(3, 4)]),
        ([(1, 2), (3, 4)], [(1, 2), (3, 4)]),
        (np.array([[5.0, 6.0], [8.0, 9.0]]), [(5, 6), (8, 9)]),
    ],
)
def test_a_parameter_is_a_value_an_interval_or_several_intervals(
    given: Any, intervals: list[tuple[float, float]], server: str
) -> None:
    at_make = make(parameters={"force": given}, server=server)
    at_reset = make(server=server)
    seen = []
    for i in range(30):
        _, info = at_make.reset(seed=i)
        _, same = at_reset.reset(seed=i, options={"parameters": {"force": given}})
        assert info == same
        seen.append(info["parameters"]["force"])
        assert info["receipt"]["applied"]["force"] == seen[-1]
        assert info["parameters"]["length"] == 0.5
    for low, high in intervals:
        assert any(low <= force <= high for force in seen)
    assert all(any(low <= force <= high for low, high in intervals) for force in seen)


def test_parameters_of_a_reset_also_apply_to_later_resets(server: str) -> None:
    env = make(version="R", server=server)
    env.reset(options={"parameters": {"mass": 0.25}})
    _, first = env.reset()
    _, second = env.reset(seed=9)
    assert first["parameters"]["mass"] == second["parameters"]["mass"] == 0.25
    assert first["parameters"]["force"] != second["parameters"]["force"]


def test_trial_of_r_plus_e_draws_parameters_from_one_version(server: str) -> None:
    envs = make_vec(num_envs=60, version="R+E", server=server)
    parameters = envs.reset(seed=4)[1]["parameters"]
    of_r = [
        (low <= parameters[name]) & (parameters[name] < high)
        for name, low, high in [("force", 5, 15), ("mass", 0.05, 0.5)]
    ]
    assert (of_r[0] == of_r[1]).all()
    assert 15 <= of_r[0].sum() <= 45


def test_trials_keep_parameters(server: str) -> None:
    env = make(version="R", episodes_per_trial=2, server=server)
    infos = [env.reset(seed=4)[1], env.reset()[1], env.reset()[1]]
    assert [info["context_id"] for info in infos] == [0, 0, 1]
    assert [info["receipt"]["episode_index"] for info in infos] == [0, 1, 2]
    assert infos[0]["parameters"] == infos[1]["parameters"] != infos[2]["parameters"]


def test_an_episode_begins_in_the_state_of_the_reset(server: str) -> None:
    state = [1.25, -0.5, 0.125, 0.75]
    observation, _ = make(server=server).reset(options={"state": state})
    assert observation.tolist() == state
    envs = make_vec(num_envs=2, server=server)
    states = np.array([state, [0, 0, 0, 0]])
    assert envs.reset(options={"state": states})[0].tolist() == states.tolist()


def test_a_mask_selects_the_environments_to_reset(server: str) -> None:
    envs = make_vec(num_envs=3, autoreset_mode=AutoresetMode.DISABLED, version="R", server=server)
    before, _ = envs.reset(seed=1)
    mask = np.array([False, True, False])
    options = {"reset_mask": mask, "parameters": {"force": 7}, "state": [[0.5, 0, 0, 0]]}
    after, infos = envs.reset(seed=50, options=options)
    assert "reset_mask" in options
    assert after[[0, 2]].tolist() == before[[0, 2]].tolist()
    assert after[1].tolist() == [0.5, 0, 0, 0]
    assert infos["_parameters"].tolist() == mask.tolist()
    assert infos["parameters"]["force"].tolist() == [0, 7, 0]
    # The environment that was reset has seed 51 and index 1.
    same = make(version="R", parameters={"force": 7}, environment_index=1, server=server)
    assert same.reset(seed=51)[1]["parameters"]["mass"] == infos["parameters"]["mass"][1]


def test_receipts_and_reward_terms_are_optional(server: str) -> None:
    env = make("Hopper", receipts=False, reward_terms=True, server=server)
    assert env.reset(seed=1)[1] == {}
    _, reward, _, _, info = env.step(np.full(3, 0.5, dtype=np.float32))
    assert list(info) == ["reward_terms"]
    assert list(info["reward_terms"]) == ["alive", "progress", "electricity", "stall_torque", "joint_limits"]
    assert reward == pytest.approx(sum(info["reward_terms"].values()), abs=1e-6)  # float32 rounding of small numbers
    env = make(server=server)
    env.reset(seed=1)
    assert env.step(0)[4] == {}


def test_steps_from_a_restored_snapshot_give_the_same_bytes(server: str) -> None:
    env, other = make("Hopper", version="E", server=server), make("Hopper", server=server)
    env.reset(seed=3)
    actions = np.random.default_rng(0).uniform(-0.2, 0.2, (20, 3)).astype(np.float32)
    for action in actions[:10]:
        observation = env.step(action)[0]
    saved = env.snapshot()
    expected = [env.step(action)[0].tobytes() for action in actions[10:20]]
    for somewhere in (env, other):
        assert somewhere.restore(saved).tobytes() == observation.tobytes()
        assert [somewhere.step(action)[0].tobytes() for action in actions[10:20]] == expected


def test_snapshots_of_a_batch_move_between_slots(server: str) -> None:
    envs = make_vec("Pendulum", num_envs=3, server=server)
    observations, _ = envs.reset(seed=3)
    saved = envs.snapshot(np.array([False, False, True]))
    assert len(saved) == 1
    moved = envs.restore(saved * 2, np.array([True, True, False]))
    assert moved.tolist() == observations[[2, 2, 2]].tolist()
    stepped = envs.step(np.full((3, 1), 0.5, dtype=np.float32))[0]
    assert stepped[0].tolist() == stepped[1].tolist() == stepped[2].tolist()
    assert len(envs.snapshot()) == 3


def long_snapshots() -> dict[str, list[tuple[float, float]]]:
    """Return distributions of twelve parameters of CartPole, 64 intervals each. A snapshot then takes some 12 kB."""
    ranges = {"force": (5, 10), "length": (0.3, 0.7), "mass": (0.1, 0.2), "push_interval": (10, 90)}
    ranges |= {f"changed_{name}": ranges[name] for name in ("force", "length", "mass")}
    rates = ("action_hold", "change_probability", "push", "sensor_dropout", "sensor_noise")
    ranges |= dict.fromkeys(rates, (0.0, 0.1))
    ends = {name: np.linspace(low, high, 128).reshape(64, 2) for name, (low, high) in ranges.items()}
    return {name: [(low, high) for low, high in pairs.tolist()] for name, pairs in ends.items()}


@pytest.mark.parametrize(
    ("name", "num_envs", "parameters", "limit"),
    [("Hopper", 8500, None, 4 << 20), ("CartPole", 5600, long_snapshots(), 64 << 20)],
    ids=["grpcs_default_limit", "the_limit_of_a_request"],
)
def test_steps_from_restored_long_snapshots_give_the_same_bytes(
    name: str, num_envs: int, parameters: Any, limit: int, server: str
) -> None:
    envs = make_vec(name, num_envs=num_envs, parameters=parameters, server=server)
    envs.reset(seed=3)
    shape = envs.single_action_space.shape or ()
    actions = np.zeros((num_envs, *shape), dtype=envs.single_action_space.dtype)
    observations = envs.step(actions)[0]
    saved = envs.snapshot()
    assert sum(map(len, saved)) > limit
    expected = envs.step(actions)[0].tobytes()
    assert envs.restore(saved).tobytes() == observations.tobytes()
    assert envs.snapshot() == saved
    assert envs.step(actions)[0].tobytes() == expected
    odd = np.arange(num_envs) % 2 == 1
    assert envs.restore(saved[1::2], odd)[odd].tobytes() == observations[odd].tobytes()
    assert envs.snapshot(odd) == saved[1::2]
    assert envs.snapshot(~odd) != saved[::2]
    with pytest.raises(perturb.InvalidArgumentError):
        envs.restore(saved[:-1])
    envs.close()


def test_a_partly_refused_restore_counts_as_a_restore(server: str) -> None:
    """A long restore is sent in several requests. If a later request is refused, the earlier ones have been applied."""
    envs = make_vec("Hopper", num_envs=8192, server=server)
    envs.reset(seed=3)
    saved = envs.snapshot()
    with pytest.raises(perturb.InvalidArgumentError):
        envs.restore([*saved[:-1], b"no snapshot"])
    with pytest.raises(perturb.OutOfOrderError, match="after a snapshot was restored"):
        copy.deepcopy(envs)
    envs.close()


def test_later_steps_do_not_overwrite_observations(server: str) -> None:
    for is_copied in (False, True):
        envs = make_vec(num_envs=4, copy=is_copied, server=server)
        kept = [envs.reset(seed=1)[0]]
        copies = [kept[0].copy()]
        for _ in range(20):
            kept.append(envs.step(np.ones(4, dtype=np.int64))[0])
            copies.append(kept[-1].copy())
        assert all((a == b).all() for a, b in zip(kept, copies, strict=True))
        assert not any(np.shares_memory(a, b) for a in kept for b in kept if a is not b)
        assert all(array.flags.writeable for array in kept)
    env = make(server=server)
    assert env.reset()[0].flags.writeable
    assert env.step(0)[0].flags.writeable


def test_overwritten_observations_do_not_affect_masked_resets(server: str) -> None:
    envs = make_vec(num_envs=2, autoreset_mode=AutoresetMode.DISABLED, server=server)
    observations, _ = envs.reset(seed=1)
    expected = observations[1].tolist()
    observations[:] = 99
    assert envs.reset(options={"reset_mask": np.array([True, False])})[0][1].tolist() == expected
