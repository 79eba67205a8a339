"""Policies are loaded from checkpoints and choose actions. The checkpoints are from a shipped experiment."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import perturb

from .conftest import ROOT

POLICIES = ROOT / "results/policies"
CART_POLE = POLICIES / "CartPole-ppo-ff-D-9bd6546b-s7.safetensors"
PENDULUM = POLICIES / "Pendulum-ppo-ff-R-9bd6546b-s8.safetensors"


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """Return a copy of a checkpoint, which the test may damage."""
    perturb.load_policy(CART_POLE)._native.save(str(tmp_path / "checkpoint"))
    return tmp_path / "checkpoint"


def spoil(folder: Path, old: str, new: str) -> None:
    document = (folder / "checkpoint.json").read_text()
    assert old in document
    (folder / "checkpoint.json").write_text(document.replace(old, new, 1))


def test_the_attributes_of_a_policy_describe_it(tmp_path: Path) -> None:
    policy = perturb.load_policy(PENDULUM)
    assert (policy.environment, policy.version, policy.trained_on) == ("Pendulum", "R", "R")
    assert (policy.method, policy.observe, policy.seed) == ("ppo ff", "state", 8)
    assert (policy.episodes_per_trial, policy.has_memory, policy.sees_rewards) == (1, False, False)
    assert policy.observation_size == 3
    assert repr(policy) == f"<perturb policy {policy.id}: ppo ff in Pendulum, trained on R>"
    policy._native.save(str(tmp_path))
    assert f"weights-{policy.id}.safetensors" in [path.name for path in tmp_path.iterdir()]
    assert perturb.load_policy(str(tmp_path)).id == policy.id


@pytest.mark.parametrize(("path", "shape", "kind"), [(CART_POLE, (3,), np.int64), (PENDULUM, (3, 1), np.float32)])
def test_the_actions_of_an_actor_depend_on_its_seed_and_indices(path: Path, shape: tuple[int, ...], kind: type) -> None:
    policy = perturb.load_policy(path)
    rng = np.random.default_rng(1)
    # Observations for which no action has a probability near 1.
    rows = [rng.normal(0, 0.02, (3, policy.observation_size)).astype(np.float32) for _ in range(20)]
    starts = [np.array([step == 5, False, step == 9]) for step in range(20)]

    def act(actor: perturb.Actor, slots: slice = slice(None)) -> Any:
        return np.array([actor(row[slots], starts=start[slots]) for row, start in zip(rows, starts, strict=True)])

    actor = policy.actor(3, seed=5)
    first = act(actor)
    assert first[0].shape == shape
    assert first.dtype == kind
    actor.reset()
    np.testing.assert_array_equal(act(actor), first)
    np.testing.assert_array_equal(act(policy.actor(1, seed=5, first_environment_index=2), slice(2, 3)), first[:, 2:])
    assert (act(policy.actor(3, seed=6)) != first).any()


def test_an_actor_refuses_wrong_inputs(copied: Path) -> None:
    policy = perturb.load_policy(copied)
    actor = policy.actor(2)
    wrongs: list[tuple[Any, str]] = [
        (np.zeros((2, 3), np.float32), r"observations have the shape \[2, 3\]; expected \[2, 4\]"),
        (np.zeros(4), r"observations have the shape \(4,\); expected \[N, O\]"),
        ([["a", "b"]], "observations have the type"),
    ]
    for wrong, words in wrongs:
        with pytest.raises(perturb.PolicyError, match=words):
            actor(wrong)
    actor(np.zeros((2, 4)))
    with pytest.raises(perturb.PolicyError, match="starts have the type int64; expected bool"):
        actor(np.zeros((2, 4)), starts=[0, 1])
    with pytest.raises(perturb.PolicyError, match="rewards"):
        actor(np.zeros((2, 4)), rewards=[0.0])
    with pytest.raises(perturb.PolicyError):
        actor(np.full((2, 4), np.nan))
    for count in (0, True, 10**9):
        with pytest.raises(perturb.InvalidArgumentError, match=f"num_envs={count}; .* to 1048576"):
            policy.actor(count)


def test_a_shipped_policy_is_loaded_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    results = Path(__file__).parents[2] / "results"
    monkeypatch.setenv("PERTURB_RESULTS", str(results))
    policy = perturb.load_policy("CartPole-ppo-ff-R-9bd6546b-s7")
    file = results / "policies/CartPole-ppo-ff-R-9bd6546b-s7.safetensors"
    assert (policy.environment, policy.trained_on) == ("CartPole", "R")
    assert policy.id == perturb.load_policy(file).id
    with pytest.raises(perturb.PolicyError, match=r"could be any of these policies .*-s10\.safetensors, .*-R-\w+-s11"):
        perturb.load_policy("CartPole-ppo-ff-R")


def test_errors_about_wrong_checkpoints_say_what_is_wrong(copied: Path, tmp_path: Path) -> None:
    with pytest.raises(perturb.PolicyError, match=r"holds no checkpoint: expected checkpoint\.json"):
        perturb.load_policy(tmp_path / "nothing")
    with pytest.raises(perturb.InvalidArgumentError, match="path is 7"):
        perturb.load_policy(7)  # type: ignore[arg-type]
    spoil(copied, '"format_version": 3', '"format_version": 9')
    with pytest.raises(perturb.PolicyError, match="has format 9, and this program reads 1 to 3"):
        perturb.load_policy(copied)


def test_errors_name_damaged_files_of_a_checkpoint(copied: Path) -> None:
    weights = copied / json.loads((copied / "checkpoint.json").read_text())["weights"]["file"]
    content = weights.read_bytes()
    weights.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    broken = f"{weights.name} is not a usable checkpoint: .*the checksum does not match"
    with pytest.raises(perturb.PolicyError, match=broken):
        perturb.load_policy(copied)
    weights.unlink()
    with pytest.raises(perturb.PolicyError, match=weights.name):
        perturb.load_policy(copied)
    weights.write_bytes(content)
    spoil(copied, '"observation_normaliser": {', '"observation_normaliser": null, "left": {')
    with pytest.raises(perturb.PolicyError, match="the checksum does not match"):
        perturb.load_policy(copied)
