"""The environments follow Gymnasium's rules, and work with its checker, its wrappers and its vector environments."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import vector as wrappers

from perturb.catalogue import CATALOGUE

from .conftest import identifier

NAMES = list(CATALOGUE)
MODES = list(AutoresetMode)


def equal(a: object, b: object) -> bool:
    return data_equivalence(a, b, exact=True)


def with_hashes_as_rows(infos: dict[str, Any]) -> dict[str, Any]:
    """Convert each `model_hash` in infos of Gymnasium's vector environment from a tuple to a row of uint8."""
    rows = dict(infos)
    for key, value in infos.items():
        if isinstance(value, dict):
            rows[key] = with_hashes_as_rows(value)
        elif key == "model_hash":
            rows[key] = np.array([hash_ or (0,) * 32 for hash_ in value], dtype=np.uint8)
    return rows


@pytest.mark.filterwarnings("ignore")  # warnings about CartPole's unbounded observations and Pendulum's action range
@pytest.mark.parametrize("version", ["D", "R", "E", "R+E"])
@pytest.mark.parametrize("name", NAMES)
def test_gymnasiums_checker_accepts_all_environments(name: str, version: str, server: str) -> None:
    env = gymnasium.make(identifier(name), version=version, server=server)
    check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize("name", NAMES)
def test_the_papers_ids_select_the_versions(name: str, server: str) -> None:
    for version, suffix in {"D": "", "R": "RandomNormal", "E": "RandomExtreme"}.items():
        old = gymnasium.make(f"Sunblaze{name}{suffix}-v0", server=server)
        new = gymnasium.make(identifier(name), version=version, server=server)
        (a, a_info), (b, b_info) = old.reset(seed=3), new.reset(seed=3)
        assert equal(a, b)
        assert a_info["parameters"] == b_info["parameters"]
        assert (a_info["parameters"] == gymnasium.make(identifier(name)).reset()[1]["parameters"]) == (version == "D")
        old.close()
        new.close()


def run(envs: gymnasium.vector.VectorEnv[Any, Any, Any], steps: int) -> list[Any]:
    """Reset and step the environments. In the mode Disabled, also reset environments whose episode has ended."""
    envs.action_space.seed(1)
    results: list[Any] = [envs.reset(seed=100)]
    for _ in range(steps):
        results.append(envs.step(envs.action_space.sample()))
        ended = results[-1][2] | results[-1][3]
        if envs.metadata["autoreset_mode"] is AutoresetMode.DISABLED and ended.any():
            results.append(envs.reset(options={"reset_mask": ended}))
    return results


@pytest.mark.parametrize("receipts", [True, False])
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", ["CartPole", "Hopper"])
def test_batch_equals_gymnasiums_vector_of_singles(name: str, mode: AutoresetMode, receipts: bool, server: str) -> None:
    """The observations, rewards, flags and infos are equal, with their structure, types and masks.

    Two types differ: rewards are float32 in the batch and float64 in Gymnasium's environment, and `model_hash` has rows
    of uint8 instead of tuples.
    """
    n, steps = 5, 150
    settings: dict[str, Any] = {"version": "E", "server": server, "receipts": receipts, "reward_terms": True}
    settings["episodes_per_trial"] = 2
    ours = gymnasium.make_vec(identifier(name), num_envs=n, autoreset_mode=mode, **settings)

    def single(i: int) -> gymnasium.Env[Any, Any]:
        return gymnasium.make(identifier(name), environment_index=i, **settings)

    theirs = SyncVectorEnv([lambda i=i: single(i) for i in range(n)], autoreset_mode=mode)  # type: ignore[misc]
    assert ours.metadata["autoreset_mode"] is mode
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space

    ended = 0
    for step, (a, b) in enumerate(zip(run(ours, steps), run(theirs, steps), strict=True)):
        assert equal(a[0], b[0]), step
        assert equal(a[-1], with_hashes_as_rows(b[-1])), (step, a[-1], b[-1])
        if len(a) == 5:
            assert equal(a[1].astype(np.float64), b[1]), step
            assert equal(a[2], b[2]), step
            assert equal(a[3], b[3]), step
            ended += int((a[2] | a[3]).sum())
    assert ended > 3, "too few episodes ended"
    ours.close()
    theirs.close()


def test_final_observations_and_infos_follow_gymnasium(server: str) -> None:
    envs = gymnasium.make_vec("perturb/CartPole-v1", num_envs=3, autoreset_mode="SameStep", server=server)
    envs.reset(seed=1)
    for _ in range(200):
        observations, _, terminated, _, infos = envs.step(np.ones(3, dtype=np.int64))
        if terminated.any():
            break
    i = int(np.flatnonzero(terminated)[0])
    assert equal(infos["_final_obs"], terminated)
    assert equal(infos["_final_info"], terminated)
    assert abs(infos["final_obs"][i][2]) > np.deg2rad(12)
    assert abs(observations[i][2]) <= 0.05  # an observation of the next episode
    assert equal(infos["final_info"]["is_success"], np.zeros(3, dtype=np.bool_))
    assert infos["parameters"]["force"][i] == 10.0
    assert "is_success" not in infos
    envs.close()


def test_success_is_reported_only_at_the_end(server: str) -> None:
    env = gymnasium.make("perturb/CartPole-v1", server=server)
    observation, info = env.reset(seed=1)
    assert "is_success" not in info
    truncated = False
    while not truncated:
        action = int(observation[2] + observation[3] > 0)
        observation, _, terminated, truncated, info = env.step(action)
        assert not terminated
        assert ("is_success" in info) == ("achieved" in info) == truncated
    assert info["is_success"] is True
    rule = env.metadata["success"]
    assert (rule["quantity"], rule["comparison"]) == ("steps", "at_least")
    assert info["achieved"] == 200 >= rule["threshold"]
    env.close()


@pytest.mark.parametrize("mode", MODES)
def test_gymnasiums_wrappers_work_on_batches(mode: AutoresetMode, server: str) -> None:
    envs = gymnasium.make_vec("perturb/CartPole-v1", num_envs=4, autoreset_mode=mode, server=server)
    wrapped: Any = wrappers.RecordEpisodeStatistics(envs)
    wrapped = wrappers.ClipReward(wrapped, min_reward=0.0, max_reward=0.5)
    wrapped.reset(seed=1)
    lengths = []
    for _ in range(60):
        _, rewards, terminated, truncated, infos = wrapped.step(np.ones(4, dtype=np.int64))
        assert (rewards <= 0.5).all()
        ended = terminated | truncated
        lengths += list(infos["episode"]["l"][ended]) if ended.any() else []
        if mode is AutoresetMode.DISABLED and ended.any():
            wrapped.reset(options={"reset_mask": ended})
    assert len(lengths) >= 16
    assert all(8 <= length <= 11 for length in lengths)  # the episodes are short, because all pushes go to one side
    wrapped.close()


def test_environments_with_the_same_seed_match(server: str) -> None:
    from gymnasium.utils.env_match import check_environments_match

    a = gymnasium.make("perturb/Hopper-v0", version="E", server=server)
    b = gymnasium.make("SunblazeHopperRandomExtreme-v0", server=server)
    check_environments_match(a, b, num_steps=300, seed=5, info_comparison="equivalence")
    a.close()
    b.close()


def test_random_numbers_equal_those_in_the_documentation(server: str) -> None:
    """The example in docs/random-streams.md has seed 7, environment 3 and trial 2 of CartPole E."""
    env = gymnasium.make("perturb/CartPole-v1", version="E", environment_index=3, server=server)
    env.reset(seed=7)
    env.reset()
    observation, info = env.reset()
    stream = np.random.Philox(key=np.array([7, 3], np.uint64), counter=np.array([0, 2, 1, 0], np.uint64))
    state = -0.05 + 0.1 * np.random.Generator(stream).random(4)
    assert info["parameters"]["force"] == 18.11554580481264
    assert info["context_id"] == 2
    assert info["receipt"]["environment_index"] == 3
    assert equal(observation, state.astype(np.float32))
    env.close()


def test_seeds_of_a_batch_follow_gymnasiums_rules(server: str) -> None:
    envs = gymnasium.make_vec("perturb/Pendulum-v1", num_envs=3, version="R", server=server)
    by_number, _ = envs.reset(seed=10)
    by_list, _ = envs.reset(seed=[10, 11, 12])  # type: ignore[arg-type]
    others, _ = envs.reset(seed=11)
    assert equal(by_number, by_list)
    assert not np.any(by_number == others, axis=1).any()
    envs.close()


def test_without_a_seed_episodes_differ(server: str) -> None:
    first = [gymnasium.make("perturb/Pendulum-v1", server=server).reset()[0].tobytes() for _ in range(3)]
    assert len(set(first)) == 3
