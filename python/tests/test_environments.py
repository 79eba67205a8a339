"""The catalogue as Python objects, copies of environments, and versions."""

from __future__ import annotations

import copy
import pickle
from typing import Any, get_args

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import perturb
from perturb.catalogue import CATALOGUE, CATALOGUE_ENTRIES

from .conftest import identifier


def test_every_environment_lists_its_parameters() -> None:
    environments = perturb.environments()
    assert list(environments) == list(CATALOGUE)
    for (name, environment), entry in zip(environments.items(), CATALOGUE_ENTRIES, strict=True):
        env = gymnasium.make(environment.id)
        assert (env.observation_space, env.action_space) == (environment.observation_space, environment.action_space)
        assert environment.observation_space.shape == (len(environment.observation),)
        assert environment.step_limit == entry["step_limit"]
        assert environment.success is not None
        assert environment.parameters
        for key, parameter in environment.parameters.items():
            assert key == parameter.name
            assert parameter.low <= parameter.default <= parameter.high, (name, key)
            assert all(parameter.low <= low < high <= parameter.high for low, high in parameter.random)
            lows, highs = zip(*parameter.extreme, strict=True)
            assert min(lows) <= min(low for low, _ in parameter.random)
            assert max(highs) >= max(high for _, high in parameter.random)
        assert pickle.loads(pickle.dumps(environment)) == environment


def test_the_lengths_of_cart_pole_are_those_of_the_paper() -> None:
    length = perturb.environments()["CartPole"].parameters["length"]
    assert (length.unit, length.default) == ("m", 0.5)
    assert length.random == ((0.25, 0.75),)
    assert length.extreme == ((0.05, 0.25), (0.75, 1.0))


def test_r_and_e_draw_parameters_from_their_intervals(server: str) -> None:
    versions: tuple[perturb.Version, ...] = ("R", "E")
    for version in versions:
        envs = perturb.PerturbVectorEnv("CartPole", 200, version=version, server=server)
        _, infos = envs.reset(seed=1)
        for name, parameter in perturb.environments()["CartPole"].parameters.items():
            intervals = parameter.random if version == "R" else parameter.extreme
            drawn = infos["parameters"][name]
            within = np.any([(low <= drawn) & (drawn <= high) for low, high in intervals], axis=0)
            assert within.all(), (version, name)
        envs.close()


@pytest.mark.parametrize("again", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
def test_copied_environment_plays_same_episodes(again: Any, server: str) -> None:
    env = gymnasium.make(identifier("CartPole"), version="R", server=server, environment_index=3)
    env.reset(seed=4, options={"parameters": {"length": 0.7}})
    env.step(1)
    other = again(env)
    assert other.spec is not None
    assert other.spec.id == identifier("CartPole")
    with pytest.raises((perturb.OutOfOrderError, gymnasium.error.ResetNeeded)):
        other.unwrapped.step(1)
    (one, info), (two, other_info) = env.reset(seed=9), other.reset(seed=9)
    np.testing.assert_array_equal(one, two)
    assert info == other_info
    assert info["parameters"]["length"] == 0.7
    np.testing.assert_array_equal(env.step(0)[0], other.step(0)[0])
    env.close()
    other.close()


def test_a_copied_batch_plays_the_same_episodes_after_a_reset(server: str) -> None:
    batch = perturb.PerturbVectorEnv("Pendulum", 5, version="E", server=server, autoreset_mode="SameStep")
    batch.reset(seed=1)
    other = pickle.loads(pickle.dumps(batch))
    assert other.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    with pytest.raises(perturb.OutOfOrderError, match=r"call reset\(\) first"):
        other.step(np.zeros((5, 1)))
    np.testing.assert_array_equal(batch.reset(seed=2)[0], other.reset(seed=2)[0])
    for _ in range(3):
        np.testing.assert_array_equal(batch.step(np.ones((5, 1)))[0], other.step(np.ones((5, 1)))[0])
    batch.reset(options={"parameters": {"mass": 1.2}, "reset_mask": np.array([True, False, False, False, False])})
    third = pickle.loads(pickle.dumps(batch))
    (one, infos), (two, other_infos) = batch.reset(seed=2), third.reset(seed=2)
    np.testing.assert_array_equal(one, two)
    assert infos["parameters"]["mass"].tolist() == other_infos["parameters"]["mass"].tolist()
    assert infos["parameters"]["mass"][0] == 1.2
    third.close()
    batch.restore(batch.snapshot())
    with pytest.raises(perturb.OutOfOrderError, match="after a snapshot was restored"):
        pickle.dumps(batch)
    batch.close()
    other.close()


@pytest.mark.parametrize("version", ["x", "RE", "", None, 1, ["R"]])
def test_wrong_versions_have_the_same_error_everywhere(version: Any) -> None:
    words = "none of 'D'"
    with pytest.raises(perturb.InvalidArgumentError, match=words):
        perturb.PerturbEnv("CartPole", version=version)
    with pytest.raises(perturb.InvalidArgumentError, match=words):
        gymnasium.make_vec(identifier("CartPole"), version=version)
    for settings in ({"versions": [version]}, {"base": version}):
        with pytest.raises(perturb.InvalidArgumentError, match=words):
            perturb.evaluate(lambda observations: observations, "CartPole", **settings)
    if version is not None:
        with pytest.raises(perturb.InvalidArgumentError, match=words):
            perturb.evaluate(lambda observations: observations, "CartPole", trained_on=version)


def test_the_type_of_versions_lists_all_versions() -> None:
    assert get_args(perturb.Version) == ("D", "R", "E", "R+E")


@pytest.mark.parametrize("name", ["CartPole", "cartpole", "cart-pole", "perturb/CartPole-v1", "Perturb/cart_pole"])
def test_several_spellings_of_names_are_accepted(name: str, server: str) -> None:
    env = perturb.PerturbEnv(name, version="r", server=server)  # type: ignore[arg-type]
    _, infos = env.reset(seed=1)
    expected = perturb.PerturbEnv("CartPole", version="R", server=server).reset(seed=1)[1]
    assert infos["parameters"] == expected["parameters"]


def test_errors_about_wrong_names_suggest_the_right_one() -> None:
    with pytest.raises(perturb.InvalidArgumentError, match=r"did you mean 'CartPole'\?"):
        perturb.PerturbEnv("CartPol")
    with pytest.raises(perturb.InvalidArgumentError, match="another revision than this package's perturb/CartPole-v1"):
        perturb.PerturbEnv("perturb/CartPole-v0")
