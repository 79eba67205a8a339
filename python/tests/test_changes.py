"""`set_parameters` changes parameters while a training runs.

Assignments to an environment that would have no effect, such as `env.length = 1.0`, are refused.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import perturb

from .conftest import identifier

LEFT = np.zeros(3, np.int64)


def batch(server: str, mode: AutoresetMode = AutoresetMode.SAME_STEP, **settings: Any) -> perturb.PerturbVectorEnv:
    return perturb.PerturbVectorEnv("CartPole", 3, version="R", autoreset_mode=mode, server=server, **settings)


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_parameters_apply_from_the_next_episode_of_each_slot(mode: AutoresetMode, server: str) -> None:
    envs, plain = batch(server, mode), batch(server, mode)
    (observations, _), (expected, _) = envs.reset(seed=1), plain.reset(seed=1)
    for _ in range(3):
        observations, expected = envs.step(LEFT)[0], plain.step(LEFT)[0]
    envs.set_parameters({"length": 0.7})
    envs.set_parameters({"mass": "0.2"}, np.array([True, False, True]))
    changed: dict[int, float] = {}
    untouched, ended = np.ones(3, bool), np.zeros(3, bool)
    for _ in range(60):
        before = ended
        observations, rewards, terminated, truncated, infos = envs.step(LEFT)
        expected, expected_rewards, expected_terminated, *_ = plain.step(LEFT)
        np.testing.assert_array_equal(rewards[untouched], expected_rewards[untouched])
        np.testing.assert_array_equal(terminated[untouched], expected_terminated[untouched])
        ended = terminated | truncated
        if mode is AutoresetMode.SAME_STEP and ended.any():
            for slot in np.flatnonzero(ended & untouched).tolist():  # the ended episode had the old parameters
                assert infos["final_info"]["parameters"]["length"][slot] != 0.7
        begun = ended if mode is AutoresetMode.SAME_STEP else before
        for slot in np.flatnonzero(begun).tolist():
            assert infos["_parameters"][slot]
            assert infos["parameters"]["length"][slot] == 0.7
            assert infos["receipt"]["applied"]["length"][slot] == pytest.approx(0.7)
            changed.setdefault(slot, infos["parameters"]["mass"][slot])
            untouched[slot] = False
        np.testing.assert_array_equal(observations[untouched], expected[untouched])
    assert changed[0] == changed[2] == 0.2
    assert changed[1] != 0.2
    assert not untouched.any()
    envs.close()
    plain.close()


def test_parameters_apply_from_the_next_reset(server: str) -> None:
    envs = batch(server, AutoresetMode.DISABLED)
    envs.set_parameters({"length": 0.7})
    assert envs.reset(seed=1)[1]["parameters"]["length"].tolist() == [0.7] * 3
    mask = np.array([True, False, False])
    envs.set_parameters({"length": 0.9}, np.array([True, True, False]))
    _, infos = envs.reset(options={"reset_mask": mask})
    assert infos["_parameters"].tolist() == mask.tolist()
    assert infos["parameters"]["length"][0] == 0.9
    assert envs.reset()[1]["parameters"]["length"].tolist() == [0.9, 0.9, 0.7]
    assert envs.reset(seed=1)[1]["parameters"]["length"].tolist() == [0.9, 0.9, 0.7]
    envs.close()
    env = perturb.PerturbEnv("CartPole", version="R", server=server)
    env.reset(seed=1)
    env.set_parameters({"length": "0.7"})
    assert env.reset()[1]["parameters"]["length"] == 0.7
    assert env.reset()[1]["parameters"]["length"] == 0.7
    env.close()


def test_parameters_are_not_applied_while_steps_are_unreceived(server: str) -> None:
    envs = batch(server)
    envs.reset(seed=1)
    envs.set_parameters({"length": 0.7})
    for _ in range(20):
        envs.send(LEFT)
    for _ in range(19):
        *_, infos = envs.recv()
        assert "parameters" not in infos or 0.7 not in infos["parameters"]["length"]
    envs.recv()
    seen = 0
    for _ in range(40):
        *_, infos = envs.step(LEFT)
        if "parameters" in infos:
            seen += int((infos["parameters"]["length"][infos["_parameters"]] == 0.7).sum())
    assert seen >= 3
    envs.close()


@pytest.mark.parametrize(
    ("parameters", "error", "says"),
    [
        ({"lenght": 1}, perturb.UnknownNameError, "CartPole has no parameter 'lenght', only"),
        ({"length": 1e9}, perturb.InvalidArgumentError, "expected values from"),
        ({"length": float("nan")}, perturb.InvalidArgumentError, "expected values from"),
        ({"length": [0.5, 1.0]}, perturb.InvalidArgumentError, "may be an interval or two values"),
        ([0.5], perturb.InvalidArgumentError, "expected a dict"),
    ],
)
def test_wrong_parameters_are_refused_at_once(parameters: Any, error: type[Exception], says: str, server: str) -> None:
    for env in (perturb.PerturbEnv("CartPole", server=server), batch(server)):
        with pytest.raises(error, match=says):
            env.set_parameters(parameters)
        env.reset(seed=1)
        env.close()


@pytest.mark.parametrize("name", ["length", "mass", "force", "masspole", "gravity", "Length"])
def test_assigning_a_parameter_is_refused(name: str, server: str) -> None:
    single = gymnasium.make(identifier("CartPole"), server=server)
    for env in (single.unwrapped, batch(server)):
        with pytest.raises(
            perturb.AssignmentError, match=rf"'{name}' cannot be assigned: .*set_parameters\("
        ) as caught:
            setattr(env, name, 1.0)
        assert isinstance(caught.value, AttributeError)
        assert not hasattr(env, name)


def test_attributes_that_exist_can_be_assigned(server: str) -> None:
    class Own(perturb.PerturbEnv):
        def __init__(self, **settings: Any) -> None:
            super().__init__("CartPole", **settings)
            self.count = 0

    env = Own(server=server)
    env.count += 1
    env.render_mode = None
    env.metadata = {**env.metadata, "mine": 1}
    env.spec = None
    with pytest.raises(perturb.AssignmentError):
        env.length = 1.0
    assert env.count == 1


def test_parameter_values_have_the_same_forms_everywhere(server: str) -> None:
    """A number, an interval and several intervals can be written as Python values and as text."""
    pairs: list[tuple[Any, str]] = [
        (0.7, "0.7"),
        ((0.5, 0.6), "0.5..0.6"),
        ([(0.3, 0.4), (0.8, 0.9)], "0.3..0.4,0.8..0.9"),
        ([[0.3, 0.4], [0.8, 0.9]], " 0.3 .. 0.4 , 0.8 .. 0.9 "),
    ]
    for one, other in pairs:
        made = [batch(server, parameters={"length": values}) for values in (one, other)]
        first, second = (envs.reset(seed=1)[1]["parameters"]["length"].tolist() for envs in made)
        assert first == second
        as_set = perturb.sets.drawn("mine", {"length": one})
        assert as_set == perturb.sets.drawn("mine", {"length": other})
        for envs in made:
            envs.close()


def test_seeds_may_contain_none_as_in_gymnasiums_batches(server: str) -> None:
    envs, single = batch(server), perturb.PerturbEnv("CartPole", version="R", environment_index=1, server=server)
    envs.reset(seed=1)
    single.reset(seed=2)
    observations, infos = envs.reset(seed=[4, None, 6])
    row, info = single.reset()
    np.testing.assert_array_equal(observations[1], row)
    assert infos["parameters"]["length"][1] == info["parameters"]["length"]
    assert infos["_parameters"].all()
    assert infos["context_id"].tolist() == [0, 1, 0]
    again = batch(server).reset(seed=[4, 5, 6])[0]
    np.testing.assert_array_equal(observations[[0, 2]], again[[0, 2]])
    states = np.array([[0.1, 0, 0, 0], [0.2, 0, 0, 0], [0.3, 0, 0, 0]])
    observations, _ = envs.reset(seed=[None, 5, None], options={"state": states, "parameters": {"length": 0.7}})
    np.testing.assert_array_equal(observations, states.astype(np.float32))
    fresh = batch(server)
    observations, infos = fresh.reset(seed=[None, 5, None])
    np.testing.assert_array_equal(observations[1], again[1])
    assert infos["_parameters"].all()


@pytest.mark.socket
def test_a_batch_above_the_servers_limit_is_refused_at_once(server: str) -> None:
    for num_envs in (10**7, 10**9, 2**32 - 1):
        with pytest.raises(perturb.PerturbError, match=r"environments|num_envs|batch") as caught:
            perturb.PerturbVectorEnv("CartPole", num_envs, server=server)
        assert not isinstance(caught.value, MemoryError)


def test_wrappers_find_the_step_limit(server: str) -> None:
    env = gymnasium.make(identifier("CartPole"), server=server)
    assert env.spec is not None
    assert env.spec.max_episode_steps == 200
    aware = gymnasium.wrappers.TimeAwareObservation(env)
    aware.reset(seed=1)
    envs = gymnasium.make_vec(identifier("CartPole"), num_envs=2, server=server)
    assert envs.spec is not None
    assert envs.spec.max_episode_steps == 200
    again = gymnasium.make_vec(envs.spec, num_envs=2)
    again.reset(seed=1)
    with pytest.raises(perturb.InvalidArgumentError, match="the step limit of the server, 200"):
        gymnasium.make_vec(identifier("CartPole"), num_envs=2, server=server, max_episode_steps=50)
