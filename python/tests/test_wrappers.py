"""Gymnasium's vector wrappers work: a wrapped batch returns the values of an unwrapped batch, changed as expected."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers as single
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector as wrappers

from .conftest import identifier

Change = Callable[[Any], Any]


def same(values: Any) -> Any:
    return values


def plus_one(values: Any) -> Any:
    return values + np.float32(1)


def rescaled(values: Any) -> Any:
    low, high = np.array([-1, -1, -8], np.float32), np.array([1, 1, 8], np.float32)
    return (values - low) / (high - low)


WRAPPERS: dict[str, tuple[Change, Change]] = {
    "FlattenObservation": (wrappers.FlattenObservation, same),
    "VectorizeTransformObservation": (
        lambda envs: wrappers.VectorizeTransformObservation(
            envs, wrapper=single.TransformObservation, func=plus_one, observation_space=None
        ),
        plus_one,
    ),
    "TransformObservation": (lambda envs: wrappers.TransformObservation(envs, plus_one), plus_one),
    "DtypeObservation": (lambda envs: wrappers.DtypeObservation(envs, np.float64), lambda it: it.astype(np.float64)),
    "ReshapeObservation": (lambda envs: wrappers.ReshapeObservation(envs, (1, 3)), lambda it: it.reshape(-1, 1, 3)),
    "RescaleObservation": (lambda envs: wrappers.RescaleObservation(envs, np.float32(0), np.float32(1)), rescaled),
    "ClipAction": (wrappers.ClipAction, same),
    "RescaleAction": (lambda envs: wrappers.RescaleAction(envs, -2.0, 2.0), same),
    "RecordEpisodeStatistics": (wrappers.RecordEpisodeStatistics, same),
    "DictInfoToList": (wrappers.DictInfoToList, same),
}


def make(mode: AutoresetMode, server: str) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
    return gymnasium.make_vec(identifier("Pendulum"), num_envs=3, version="R", autoreset_mode=mode, server=server)


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("name", WRAPPERS)
def test_wrapped_batches_return_the_expected_values(name: str, mode: AutoresetMode, server: str) -> None:
    wrap, change = WRAPPERS[name]
    plain = make(mode, server)
    try:
        wrapped = wrap(make(mode, server))
    except ValueError as error:
        if "autoreset_mode" not in str(error):
            raise
        pytest.skip("Gymnasium's wrapper does not support this autoreset mode")
    observations, got = plain.reset(seed=5)[0], wrapped.reset(seed=5)[0]
    kept = []
    for step in range(410):  # two episodes of 200 steps, and the start of a third
        np.testing.assert_allclose(got, change(observations), rtol=1e-6, atol=1e-6)
        if step < 5:
            kept.append((got, np.array(got)))
        actions = np.zeros((3, 1), np.float32)
        observations, _, terminated, truncated, infos = plain.step(actions)
        got, _, _, _, got_infos = wrapped.step(actions)
        ended = terminated | truncated
        if mode is AutoresetMode.SAME_STEP and ended.any() and not isinstance(got_infos, list):
            for slot in np.flatnonzero(ended):
                expected = change(infos["final_obs"][slot][np.newaxis])[0]
                np.testing.assert_allclose(got_infos["final_obs"][slot], expected, rtol=1e-6, atol=1e-6)
        if mode is AutoresetMode.DISABLED and ended.any():
            observations, got = (it.reset(options={"reset_mask": ended})[0] for it in (plain, wrapped))
    for now, then in kept:
        np.testing.assert_array_equal(now, then)
    plain.close()
    wrapped.close()
