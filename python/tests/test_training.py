"""`perturb.train` trains policies with the program `perturb`."""

from __future__ import annotations

import os
import shutil
from typing import TYPE_CHECKING

import numpy as np
import pytest

import perturb
from perturb import training

from .conftest import ROOT

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(autouse=True)
def _trains(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use the program perturb that cargo built, unless PERTURB_PROGRAM names another one."""
    if training.VARIABLE not in os.environ:
        built = ROOT / "target/release/perturb"
        if shutil.which(built):
            monkeypatch.setenv(training.VARIABLE, str(built))
        elif shutil.which("perturb") is None:
            pytest.skip("the program perturb is neither built nor on PATH")


def test_a_training_gives_policy_log_and_result(tmp_path: Path, server: str) -> None:
    out = tmp_path / "run"
    trained = perturb.train(
        "CartPole", version="R", episodes=40, seed=3, settings={"learning_rate": 1e-3}, out=out, server=server
    )
    assert (trained.policy.seed, trained.policy.trained_on, trained.folder) == (3, "R", out)
    assert trained.progress["rollout/episodes"][-1] >= 40
    assert np.isfinite(trained.progress["rollout/episodes"]).all()
    assert "learning_rate = 0.001" in (out / "config.toml").read_text("utf-8")
    again = perturb.train(
        "CartPole", version="R", episodes=40, seed=3, settings={"learning_rate": 1e-3}, out=tmp_path / "other"
    )
    assert again.policy.id == trained.policy.id, "the same seed, the same weights"


def test_errors_contain_the_reason_of_the_program(tmp_path: Path, server: str) -> None:
    with pytest.raises(perturb.InvalidArgumentError, match="Cart"):
        perturb.train("Cart", episodes=1, out=tmp_path / "run", server=server)
    with pytest.raises(perturb.InvalidArgumentError, match="learning_rat"):
        perturb.train("CartPole", episodes=1, settings={"learning_rat": 1}, out=tmp_path / "run", server=server)
    with pytest.raises(perturb.InvalidArgumentError, match="is none of 'D'"):
        perturb.train("CartPole", version="X", out=tmp_path / "run")  # type: ignore[arg-type]


def test_error_says_how_to_get_a_missing_program(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(training.VARIABLE, "/nowhere/perturb")
    with pytest.raises(perturb.ServerStartError, match="make wheel"):
        perturb.train("CartPole", episodes=1)


def test_example_policies_succeed_on_d_and_one_often_fails_on_r(server: str) -> None:
    assessment = perturb.evaluate(perturb.example_policies(), "Hopper", episodes=100, seed=1, server=server)
    rate = {result.scenario: result.success_percent for result in assessment.results}
    assert min(rate["DD"], rate["RD"]) > 85, rate
    assert rate["DR"] < 40, rate
    assert rate["RR"] > rate["DR"] + 20, rate
