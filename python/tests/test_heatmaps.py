"""Heatmaps of policies that were tested over two parameters."""

from __future__ import annotations

from pathlib import Path

import pytest

import perturb

from .test_assess import run, saved, upright
from .test_policy import CART_POLE, PENDULUM


@pytest.mark.parametrize("checkpoint", [CART_POLE, PENDULUM])
def test_python_and_the_program_record_the_same_heatmap(checkpoint: Path, tmp_path: Path, server: str) -> None:
    made = str(tmp_path / "made")
    arguments = (
        "--grid",
        "3",
        "--episodes",
        "2",
        "--seed",
        "5",
        "--base-version",
        "R",
        "--out",
        made,
        "--server",
        server,
    )
    run("heatmap", "--checkpoint", str(checkpoint), *arguments)
    policy = perturb.load_policy(checkpoint)
    over = perturb.sets.heatmap(policy.environment, points=3, base="R")
    assessment = perturb.evaluate(policy, policy.environment, versions=[over], episodes=18, seed=5, server=server)
    assert saved(assessment, tmp_path / "saved") == Path(made + ".parquet").read_bytes()


def test_reports_show_the_heatmap_of_an_assessment(tmp_path: Path, server: str) -> None:
    over = perturb.sets.heatmap("CartPole", "length", "force", points=4, fixed={"mass": 0.2})
    policies = {"D": upright, "E": upright}
    assessment = perturb.evaluate(policies, "CartPole", versions=["D", over], episodes=32, server=server, name="pushes")
    assessment.save(tmp_path / "saved")
    page = assessment.to_html()
    assert "pushes (trained elsewhere): mean return and success over length and force" in page
    assert page == perturb.Assessment.load(tmp_path / "saved").to_html()
    run("report", str(tmp_path / "saved"), "--out", str(tmp_path / "out"))
    (figures,) = (tmp_path / "out").glob("CartPole-*-heatmap-length-force.csv")
    lines = figures.read_text("utf-8").splitlines()
    assert lines[0] == "train,runs,length,force,mean_return,success_percent"
    assert len(lines) == 1 + 2 * 16
    without = perturb.evaluate(upright, "CartPole", versions=["D"], episodes=10, server=server, name="pushes")
    assert "mean return and success over" not in without.to_html()


def test_wrong_axes_and_numbers_of_points_are_refused() -> None:
    assert len(perturb.sets.heatmap("Hopper").contexts or ()) == 100
    with pytest.raises(perturb.UnknownNameError, match="no parameter 'width'"):
        perturb.sets.heatmap("CartPole", "width")
    with pytest.raises(perturb.InvalidArgumentError, match="force is given twice"):
        perturb.sets.heatmap("CartPole", "force", "force")
    with pytest.raises(perturb.InvalidArgumentError, match="length is given twice"):
        perturb.sets.heatmap("CartPole", "length", "force", fixed={"length": 0.5})
    for points in (1, 101):
        with pytest.raises(perturb.InvalidArgumentError, match="points"):
            perturb.sets.heatmap("CartPole", points=points)
