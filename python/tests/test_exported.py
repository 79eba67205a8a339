"""Exported networks choose the same actions as the policies. `make python-acceptance` installs torch and onnx."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import perturb
from perturb import exported_networks

from .test_assess import run
from .test_policy import CART_POLE, PENDULUM

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

N = 1000


def observations(policy: perturb.Policy) -> NDArray[np.float32]:
    return np.random.default_rng(1).normal(0, 0.5, (N, policy.observation_size)).astype(np.float32)


def sampled(policy: perturb.Policy, rows: NDArray[np.float32]) -> NDArray[Any]:
    """Sample an action for each observation, each time with the same random number."""
    return np.concatenate([policy.actor(seed=1)(row[None]) for row in rows])


def same_actions(outputs: NDArray[Any], actions: NDArray[Any]) -> None:
    """Check that the actions can be sampled from the logits or means with the same random number for all rows."""
    if actions.dtype == np.float32:
        noise = actions - outputs
        assert np.ptp(noise, axis=0).max() < 2e-6, "larger than the rounding of float32"
        return
    logits = outputs.astype(np.float64)
    probabilities = np.exp(logits - logits.max(axis=1, keepdims=True))
    first = (probabilities / probabilities.sum(axis=1, keepdims=True)).cumsum(axis=1)
    # The chosen action is the first whose cumulative probability is above the random number. So the random number lies
    # between these bounds.
    rows = np.arange(len(actions))
    above = first[rows, actions].min()
    below = np.where(actions > 0, first[rows, np.maximum(actions - 1, 0)], 0).max()
    assert below < above + 1e-7, "no random number explains all choices"
    assert len(set(actions.tolist())) > 1


def onnx_outputs(path: Path, inputs: dict[str, Any]) -> list[Any]:
    runtime = pytest.importorskip("onnxruntime")
    outputs: list[Any] = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"]).run(None, inputs)
    return outputs


@pytest.mark.parametrize("path", [CART_POLE, PENDULUM])
def test_torch_acts_as_the_policy(path: Path) -> None:
    torch = pytest.importorskip("torch")
    policy = perturb.load_policy(path)
    rows = observations(policy)
    with torch.no_grad():
        outputs = policy.to_torch()(torch.from_numpy(rows)).numpy()
    same_actions(outputs, sampled(policy, rows))


@pytest.mark.parametrize("path", [CART_POLE, PENDULUM])
def test_onnx_acts_as_the_policy(path: Path, tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    policy = perturb.load_policy(path)
    rows = observations(policy)
    policy.to_onnx(tmp_path / "policy.onnx")
    (outputs,) = onnx_outputs(tmp_path / "policy.onnx", {"observations": rows})
    same_actions(outputs, sampled(policy, rows))


def recurrent(environment: str, folder: Path, server: str) -> perturb.Policy:
    """Train a recurrent policy for a few episodes, so that its weights differ from the initial ones."""
    settings = ["--architecture", "rc", "--episodes", "40", "--set", "learning_rate=1e-2"]
    run("train", "--env", environment, *settings, "--server", server, "--out", str(folder))
    return perturb.load_policy(folder)


@pytest.mark.parametrize("environment", ["CartPole", "Pendulum"])
def test_recurrent_exports_have_the_memory_of_the_policy(environment: str, tmp_path: Path, server: str) -> None:
    """The torch and ONNX models agree with each other and with the policy over a thousand steps.

    The policy samples its actions, but the exported network returns only logits or means. To compare them, two actors
    with the same seed, and therefore the same random numbers, get different observations. The test checks that the same
    random numbers explain the actions of both actors.
    """
    torch = pytest.importorskip("torch")
    pytest.importorskip("onnx")
    policy = recurrent(environment, tmp_path / "run", server)
    rows = observations(policy)
    starts = np.arange(N) % 100 == 0
    actor, other = policy.actor(seed=1), policy.actor(seed=1)
    actions, others = [], []
    for place in range(N):
        begun = None if place == 0 else starts[place : place + 1]
        actions.append(actor(rows[place : place + 1], starts=begun))
        others.append(other(rows[N - 1 - place : N - place], starts=begun))
    module, memory, of_torch, of_other, before = policy.to_torch(), None, [], [], None
    policy.to_onnx(tmp_path / "policy.onnx")
    runtime = pytest.importorskip("onnxruntime")
    session = runtime.InferenceSession(str(tmp_path / "policy.onnx"), providers=["CPUExecutionProvider"])
    size = exported_networks.read(policy._native).head[0].shape[1]
    h = c = np.zeros((1, size), np.float32)
    of_onnx = []
    for place in range(N):
        with torch.no_grad():
            began = torch.from_numpy(starts[place : place + 1])
            outputs, memory = module(torch.from_numpy(rows[place : place + 1]), memory, began)
            backwards, before = module(torch.from_numpy(rows[N - 1 - place : N - place]), before, began)
        of_torch.append(outputs.numpy())
        of_other.append(backwards.numpy())
        if starts[place]:
            h = c = np.zeros((1, size), np.float32)
        out, h, c = session.run(None, {"observations": rows[place : place + 1], "h": h, "c": c})
        of_onnx.append(out)
    network, second = np.concatenate(of_torch), np.concatenate(of_other)
    assert np.abs(network - np.concatenate(of_onnx)).max() < 1e-5, "larger than rounding to float32 in a hundred steps"
    acted, acted_second = np.concatenate(actions), np.concatenate(others)
    if acted.dtype == np.float32:
        assert np.abs((acted - network) - (acted_second - second)).max() < 1e-5
        return
    first = 1 / (1 + np.exp(network[:, 1].astype(np.float64) - network[:, 0]))
    first_second = 1 / (1 + np.exp(second[:, 1].astype(np.float64) - second[:, 0]))
    # In each step both actors compare the same random number with their probability of the first action.
    higher = first > first_second
    contradictions = np.where(higher, (acted == 1) & (acted_second == 0), (acted == 0) & (acted_second == 1))
    assert not contradictions[np.abs(first - first_second) > 1e-6].any()
    assert (acted != acted_second).any()


def test_evaluate_accepts_an_exported_torch_module(server: str) -> None:
    pytest.importorskip("torch")
    module = perturb.load_policy(CART_POLE).to_torch()
    assessment = perturb.evaluate(module, "CartPole", versions=("D",), episodes=20, server=server)
    assert assessment["D"].success_percent > 90


def test_errors_name_the_missing_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    policy = perturb.load_policy(CART_POLE)
    for module, call in (("torch", policy.to_torch), ("onnx", lambda: policy.to_onnx(tmp_path / "policy.onnx"))):
        with monkeypatch.context() as without:
            without.setitem(__import__("sys").modules, module, None)
            with pytest.raises(ImportError, match=f"pip install {module}"):
                call()
