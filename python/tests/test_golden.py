"""The classic tasks agree with trajectories of Gymnasium 1.4 (tests/server/data/classic_control.jsonl)."""

from __future__ import annotations

import json
from typing import Any

import gymnasium
import numpy as np
import pytest

from .conftest import ROOT, identifier

CASES = [json.loads(line) for line in (ROOT / "tests/server/data/classic_control.jsonl").read_text().splitlines()]

# Tolerances of one step: absolute for numbers below 1, relative for larger ones. The server and Gymnasium each round to
# float32, with an error of up to half an ulp. Pendulum's torque, at most 2 N m, is also rounded, with an error of up to
# 2^-24 of the torque. The error of the speed is the torque's error times 3 / (m l²) · 0.05 s. With E's light rods this
# factor is at most 1.2.
SINGLE_STEP = {"CartPole": 1.2e-7, "MountainCar": 1.2e-7, "Acrobot": 1.2e-7, "Pendulum": 4e-7}


def deviation(got: Any, expected: Any) -> float:
    expected = np.asarray(expected)
    return float(np.max(np.abs(got - expected) / np.maximum(np.abs(expected), 1.0)))


@pytest.mark.parametrize("case", CASES, ids=[f"{i}-{case['env']}-{case['version']}" for i, case in enumerate(CASES)])
def test_every_step_of_a_golden_trajectory_agrees(case: dict[str, Any], server: str) -> None:
    """Each environment of a batch starts at one state of the trajectory, and takes one step."""
    states = [case["state0"], *case["states"]]
    # Resets do not accept states after the end of an episode.
    n = next((t + 1 for t, ended in enumerate(case["terminated"]) if ended), len(case["actions"]))
    envs = gymnasium.make_vec(identifier(case["env"]), num_envs=n, autoreset_mode="Disabled", server=server)
    options = {"parameters": case["params"], "state": states[:n]}
    tolerance = SINGLE_STEP[case["env"]]

    observations, infos = envs.reset(seed=0, options=options)
    for name, value in case["params"].items():
        assert (infos["receipt"]["applied"][name] == value).all()
    assert deviation(observations, case["observations"][:n]) <= 1.2e-7

    shape = (n,) if isinstance(envs.single_action_space, gymnasium.spaces.Discrete) else (n, 1)
    kind = np.int64 if len(shape) == 1 else np.float64
    actions = np.array(case["actions"][:n], dtype=kind).reshape(shape)
    observations, rewards, terminated, _, _ = envs.step(actions)
    assert deviation(observations, case["observations"][1 : n + 1]) <= tolerance
    assert deviation(rewards, case["rewards"][:n]) <= tolerance
    assert terminated.tolist() == case["terminated"][:n]
    envs.close()


@pytest.mark.parametrize("case", CASES, ids=[f"{i}-{case['env']}-{case['version']}" for i, case in enumerate(CASES)])
def test_trajectories_from_the_initial_state_agree(case: dict[str, Any], server: str) -> None:
    """States are float64 on both sides, so errors of 1e-9 over 50 steps vanish in the rounding to float32."""
    tolerance = {"Pendulum": 1e-4}.get(case["env"], 1.3e-7)  # Pendulum's torques are rounded to float32 in each step
    env = gymnasium.make(identifier(case["env"]), parameters=case["params"], server=server)
    discrete = isinstance(env.action_space, gymnasium.spaces.Discrete)
    env.reset(options={"state": case["state0"]})
    for t, action in enumerate(case["actions"][:50]):
        observation, reward, terminated, _, _ = env.step(action if discrete else np.array([action]))
        assert deviation(observation, case["observations"][t + 1]) <= tolerance, t
        assert deviation(reward, case["rewards"][t]) <= tolerance, t
        assert terminated == case["terminated"][t], t
        if terminated:
            break
    env.close()
