"""With observe="parameters", observations end with the episode's parameters."""

from __future__ import annotations

import json
from importlib import resources
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from .conftest import identifier

ENTRIES = json.loads(resources.files("perturb").joinpath("catalogue.json").read_text("utf-8"))["environments"]


def seen(entry: dict[str, Any], applied: dict[str, Any]) -> list[np.float32]:
    """Return the scaled parameters that observations must contain if a receipt has these applied values."""
    scaled = []
    for parameter, rule in zip(entry["parameters"], entry["parameter_observations"], strict=True):
        low, high = rule["at_minus_one"], rule["at_plus_one"]
        scaled.append(np.float32(2 * (applied[parameter["applied"]] - low) / (high - low) - 1))
    return scaled


@pytest.mark.filterwarnings("ignore")  # warnings about spaces, also without observed parameters
@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry["name"])
def test_observed_parameters_are_in_observation_and_space(entry: dict[str, Any], server: str) -> None:
    settings: dict[str, Any] = {"version": "E", "server": server}
    plain = gymnasium.make(identifier(entry["name"]), **settings)
    env = gymnasium.make(identifier(entry["name"]), observe="parameters", **settings)
    own, space = len(entry["observation"]), env.observation_space
    assert isinstance(space, gymnasium.spaces.Box)
    assert space.shape == (own + len(entry["parameters"]),)
    bounds = np.array([[rule["entry"]["low"], rule["entry"]["high"]] for rule in entry["parameter_observations"]])
    assert (np.stack([space.low, space.high], 1)[own:] == bounds.astype(np.float32)).all()
    for seed in range(5):
        observation, info = env.reset(seed=seed)
        assert observation[:own].tolist() == plain.reset(seed=seed)[0].tolist()
        assert observation[own:].tolist() == seen(entry, info["receipt"]["applied"])
        assert (abs(observation[own:]) <= 1).all()
    check_env(env.unwrapped)
    env.close()
    plain.close()


def test_batches_observe_the_parameters_of_each_episode(server: str) -> None:
    entry = ENTRIES[0]
    settings: dict[str, Any] = {"version": "R", "autoreset_mode": "SameStep", "server": server}
    envs = gymnasium.make_vec(identifier(entry["name"]), num_envs=4, observe="parameters", **settings)
    observations, infos = envs.reset(seed=3)
    assert envs.observation_space.shape == observations.shape == (4, 7)
    running = [seen(entry, {k: v[i] for k, v in infos["receipt"]["applied"].items()}) for i in range(4)]
    ended = 0
    for _ in range(120):
        observations, _, _, _, infos = envs.step(np.ones(4, dtype=np.int64))
        for i in np.flatnonzero(infos.get("_final_obs", np.zeros(4, dtype=np.bool_))):
            assert infos["final_obs"][i][4:].tolist() == running[i]
            running[i] = seen(entry, {k: v[i] for k, v in infos["receipt"]["applied"].items()})
            ended += 1
        assert observations[:, 4:].tolist() == running
    assert ended > 10
    envs.close()
