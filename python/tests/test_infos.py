"""The infos of a batch are plain dictionaries, which other libraries can read and convert."""

from __future__ import annotations

import json
import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import perturb
from perturb.infos import merge

from .conftest import identifier


def every_dictionary(infos: dict[str, Any]) -> list[dict[str, Any]]:
    return [infos, *(inner for value in infos.values() if isinstance(value, dict) for inner in every_dictionary(value))]


@pytest.mark.parametrize("mode", AutoresetMode)
def test_infos_are_plain_dictionaries_of_arrays(mode: AutoresetMode, server: str) -> None:
    envs = perturb.PerturbVectorEnv("CartPole", 16, version="R", autoreset_mode=mode, server=server)
    _, infos = envs.reset(seed=1)
    seen = 0
    for _ in range(60):
        for one in every_dictionary(infos):
            assert type(one) is dict
            for key, value in one.items():
                assert isinstance(value, dict | np.ndarray), key
                assert one[f"_{key.removeprefix('_')}"].shape == (16,)
        if "parameters" in infos:
            begun = infos["_parameters"]
            for name, values in infos["receipt"]["applied"].items():
                if not name.startswith("_") and name in infos["parameters"]:
                    np.testing.assert_allclose(values[begun], infos["parameters"][name][begun], rtol=1e-9)
                    seen += int(begun.sum())
            assert infos["context_id"][begun].tolist() == infos["receipt"]["trial_index"][begun].tolist()
            assert infos["receipt"]["model_hash"].shape == (16, 32)
            assert not infos["receipt"]["model_hash"].any(), "CartPole has no model"
        *_, terminated, truncated, infos = envs.step(np.ones(16, dtype=np.int64))
        if mode is AutoresetMode.DISABLED and (terminated | truncated).any():
            _, infos = envs.reset(options={"reset_mask": terminated | truncated})
    assert seen > 30
    envs.close()


def test_json_pickle_and_dict_read_all_of_infos(server: str) -> None:
    envs = perturb.PerturbVectorEnv("CartPole", 3, version="R", server=server)
    _, infos = envs.reset(seed=1)
    read = json.loads(json.dumps(infos["parameters"], default=lambda array: array.tolist()))
    assert read == {name: values.tolist() for name, values in infos["parameters"].items()}
    assert list(pickle.loads(pickle.dumps(infos))) == list(infos)
    rebuilt = type(infos["receipt"])(infos["receipt"].items())
    assert list(rebuilt) == list(infos["receipt"])


def test_infos_contain_only_numbers(server: str) -> None:
    """Wrappers that convert arrays, such as Gymnasium's NumpyToTorch, cannot convert text or objects."""
    expected = bytes.fromhex(perturb.environments()["Hopper"].model_hash)
    assert len(expected) == 32
    single = perturb.PerturbEnv("Hopper", server=server)
    _, info = single.reset(seed=1)
    assert bytes(info["receipt"]["model_hash"]) == expected
    assert single.reset(seed=1)[1] == info, "infos of one environment can be compared"
    envs = perturb.PerturbVectorEnv("Hopper", 2, server=server, autoreset_mode="Disabled")
    _, infos = envs.reset(seed=1)
    assert [row.tobytes() for row in infos["receipt"]["model_hash"]] == [expected] * 2
    _, infos = envs.reset(options={"reset_mask": np.array([True, False])})
    assert [row.tobytes() for row in infos["receipt"]["model_hash"]] == [expected, bytes(32)]
    for one in [*every_dictionary(info), *every_dictionary(infos)]:
        for value in one.values():
            if not isinstance(value, dict):
                assert np.asarray(value).dtype.kind in "biuf"
    single.close()
    envs.close()


def test_infos_have_achieved_at_the_end_of_each_episode(server: str) -> None:
    """Without a value, `achieved` is NaN instead of absent, because stable-baselines3's Monitor requires the key."""
    env = gymnasium.make(identifier("MountainCar"), server=server)
    env.reset(seed=1)
    info: dict[str, Any] = {}
    while not info:
        *_, info = env.step(1)
    assert np.isnan(info["achieved"])
    envs = perturb.PerturbVectorEnv("MountainCar", 2, server=server)
    envs.reset(seed=1)
    infos: dict[str, Any] = {}
    while "is_success" not in infos:
        *_, infos = envs.step(np.ones(2, np.int64))
    assert np.isnan(infos["achieved"]).all()
    assert infos["_achieved"].all()


def test_merge_prefers_later_infos() -> None:
    mask, other = np.array([True, False, True]), np.array([False, True, True])
    infos: dict[str, Any] = {
        "a": np.array([1, 0, 3]),
        "_a": mask,
        "in": {"b": np.array([1, 0, 3]), "_b": mask},
        "_in": mask,
    }
    later: dict[str, Any] = {
        "a": np.array([0, 5, 6]),
        "_a": other,
        "in": {"b": np.array([0, 5, 6]), "_b": other},
        "_in": other,
        "c": np.array([0, 7, 8]),
        "_c": other,
    }
    merge(infos, later)
    for one, key in ((infos, "a"), (infos["in"], "b")):
        assert one[key].tolist() == [1, 5, 6]
        assert one[f"_{key}"].all()
    assert infos["c"].tolist() == [0, 7, 8]
    assert mask.tolist() == [True, False, True]
