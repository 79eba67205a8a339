"""Assessments can be shown in reports, replayed and plotted."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import perturb

from .conftest import ROOT
from .test_assess import run, same_episodes, upright
from .test_policy import CART_POLE, POLICIES

EXPERIMENT = ROOT / "results/results.parquet/beyond/confirm-2"


@pytest.fixture(scope="module")
def assessment(server: str) -> perturb.Assessment:
    """Return an assessment with successes and failures."""
    return perturb.evaluate({"D": upright, "R": upright}, "CartPole", episodes=100, server=server, name="pushes")


def rows(page: str, part: str) -> list[str]:
    """Return the table rows of an HTML page that contain the text `part`."""
    return [row for row in re.findall(r"<tr[^>]*>.*?</tr>", page, re.DOTALL) if part in row]


def test_a_report_without_an_experiment_shows_only_the_agent(assessment: perturb.Assessment, tmp_path: Path) -> None:
    page = assessment.to_html(tmp_path / "page.html")
    assert (tmp_path / "page.html").read_text("utf-8") == page
    assert page == assessment.to_html()
    assert "cells are done" not in page
    assert page.count("<svg") == 4, "1 figure of the finding, 2 over parameters (trained on D and R), 1 of profiles"
    metrics = rows(page, "pushes (trained elsewhere)")[0]
    assert f">{assessment['DD'].success_percent:.1f}<" in metrics
    assert page.count("training steps: not known") == 2


def test_report_with_an_experiment_has_the_agent_in_its_tables(
    assessment: perturb.Assessment, tmp_path: Path, server: str
) -> None:
    assessment.save(tmp_path / "saved")
    other = perturb.evaluate(upright, "CartPole", episodes=20, server=server, name="other")
    page = assessment.to_html(beside=[EXPERIMENT, other])
    assert "cells are done" in page
    assert "2 agents were trained elsewhere" in page
    assert rows(page, "other (trained elsewhere)")
    environment_rows = rows(page, "pushes (trained elsewhere)")
    assert len(environment_rows) == len(
        rows(perturb.Assessment.load(tmp_path / "saved").to_html(beside=[EXPERIMENT]), "pushes (t")
    )
    run(
        "report",
        str(EXPERIMENT),
        str(tmp_path / "saved"),
        "--out",
        str(tmp_path / "out"),
        "--html",
        str(tmp_path / "page"),
    )
    alone = perturb.Assessment.load(tmp_path / "saved").to_html(beside=[EXPERIMENT])
    assert (tmp_path / "page").read_text("utf-8") == alone, "the program writes the same page"
    assert "pushes,,,true,Default" in (tmp_path / "out/metrics.csv").read_text("utf-8")
    assert "saved as <code>saved</code>" in alone


def test_wrong_arguments_of_reports_are_refused(assessment: perturb.Assessment, tmp_path: Path) -> None:
    with pytest.raises(perturb.InvalidArgumentError, match="neither an experiment"):
        assessment.to_html(beside=[tmp_path])
    with pytest.raises(perturb.InvalidArgumentError, match="expected a list"):
        assessment.to_html(beside=str(EXPERIMENT))
    with pytest.raises(perturb.InvalidArgumentError, match="are both experiments"):
        assessment.to_html(beside=[EXPERIMENT, EXPERIMENT])
    with pytest.raises(OSError, match="cannot"):
        assessment.save("/proc/nowhere")


def test_audit_accepts_the_same_policy_and_finds_another(tmp_path: Path, server: str) -> None:
    sets: list[Any] = ["D", perturb.sets.grid("corners", {"length": [0.3, 0.9]}, base="R")]
    assessment = perturb.evaluate(
        upright, "CartPole", versions=sets, episodes=30, seed=9, success="steps=90", server=server, name="pushes"
    )
    assessment.save(tmp_path / "saved")
    loaded = perturb.Assessment.load(tmp_path / "saved")
    assert loaded.audit(upright, server=server) == perturb.Audit(60, ())

    def lazy(observations: Any) -> Any:
        return np.zeros(len(observations), np.int64)

    audit = loaded.audit(lazy, server=server)
    assert audit.episodes == 60
    assert len(audit.different) > 50
    assert re.match(r"D, environment 0, episode 0: .*length was \d+, is \d+", audit.different[0])
    with pytest.raises(perturb.InvalidArgumentError, match="expected one policy"):
        loaded.audit({"D": upright}, server=server)
    loaded = perturb.evaluate(perturb.load_policy(CART_POLE), "CartPole", episodes=5, server=server)
    with pytest.raises(perturb.PolicyError, match=r"with \d{8}-[0-9a-f]{8}, but this policy is function upright: give"):
        loaded.audit({"D": upright}, server=server)


def test_python_and_the_program_audit_checkpoints(tmp_path: Path, server: str) -> None:
    other = POLICIES / "CartPole-ppo-ff-R-9bd6546b-s7.safetensors"
    trained = {"D": perturb.load_policy(CART_POLE), "E": upright, "R": perturb.load_policy(other)}
    assessment = perturb.evaluate(trained, "CartPole", episodes=20, server=server)
    assert assessment.audit(trained, server=server) == perturb.Audit(180, ())
    swapped = {"D": trained["R"], "R": trained["D"], "E": upright}
    with pytest.raises(perturb.PolicyError, match="was trained on R, not on D"):
        assessment.audit(swapped, server=server)
    saved = tmp_path / "saved"
    assessment.save(saved)
    output = run(
        "audit", str(saved), "--checkpoint", str(CART_POLE), str(other), "--server", server, "--episodes", "10"
    )
    assert "20 of 20 episodes of 2 policies have the same bytes" in output
    assert "trained on E: no --checkpoint has the id function upright; Assessment.audit" in output
    output = run("audit", str(saved), "--server", server, status=2)
    assert "no policy of" in output


def test_worst_contexts_are_those_with_the_lowest_success_rates(server: str) -> None:
    sets: list[Any] = [perturb.sets.listed("poles", [{"length": length} for length in (0.05, 0.5, 1.0)]), "E"]
    assessment = perturb.evaluate(upright, "CartPole", versions=sets, episodes=90, server=server)
    worst = assessment.worst_contexts("poles")
    assert [context.episodes for context in worst] == [30, 30, 30]
    assert [context.success_percent for context in worst] == sorted(context.success_percent for context in worst)
    assert {context.parameters["length"] for context in worst} == {(0.05, 0.05), (0.5, 0.5), (1.0, 1.0)}
    assert sum(context.successes for context in worst) == round(0.9 * assessment["poles"].success_percent)
    low, high = worst[0].success_interval
    assert low <= worst[0].success_percent <= high
    parts = assessment.worst_contexts("E", 1000)
    assert sum(part.episodes for part in parts) == 90
    assert len(assessment.worst_contexts("E", 1)) == 1
    with pytest.raises(perturb.UnknownNameError, match="no scenario 'R'"):
        assessment.worst_contexts("R")


def test_bootstrap_intervals_match_spread_of_episodes(assessment: perturb.Assessment) -> None:
    assert assessment["DD"].return_interval == (200.0, 200.0), "all episodes have the same return"
    columns = assessment.columns()
    for scenario in ("DE", "RE"):
        result = assessment[scenario]
        returns = columns["return"][(columns["trained_on"] == scenario[0]) & (columns["set"] == "E")]
        low, high = result.return_interval
        assert low < result.mean_return < high
        # The mean of 100 episodes is nearly normal. 1000 resamples estimate its quantiles with an error of about 5 %.
        assert high - low == pytest.approx(2 * 1.96 * returns.std() / 10, rel=0.2)
        low, high = result.cvar_interval
        assert low <= result.cvar_return <= high
        assert low < high


def test_success_over_two_parameters_counts_every_episode(assessment: perturb.Assessment) -> None:
    cells = assessment.success_by_parameters("DE", "length", "mass")
    columns = assessment.columns()
    tested = (columns["trained_on"] == "D") & (columns["set"] == "E")
    assert sum(cell.episodes for cell in cells) == 100
    assert sum(cell.successes for cell in cells) == columns["success"][tested].sum()
    full = max(cells, key=lambda cell: cell.episodes)
    within = [
        (columns[f"requested_{name}"] >= low) & (columns[f"requested_{name}"] <= high)
        for name, (low, high) in (("length", full.x), ("mass", full.y))
    ]
    assert (tested & within[0] & within[1]).sum() == full.episodes > 0
    by_x = {part.low: part.episodes for part in assessment.success_by_parameter("DE", "length")}
    for low, episodes in by_x.items():
        assert sum(cell.episodes for cell in cells if cell.x[0] == low) == episodes
    assert assessment.success_by_parameters("DD", "length", "mass") == ()


def test_plots_are_drawn_if_matplotlib_is_installed(
    assessment: perturb.Assessment, server: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "matplotlib.pyplot", None)
        with pytest.raises(ImportError, match=r"pip install 'perturb-rl\[plot\]'"):
            assessment.plot_curves("length")
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    axes = assessment.plot_curves("length")
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["DR", "DE", "RR", "RE"], "on D the length does not vary"
    assert axes.get_xlabel() == "length, m"
    gaps = axes.get_lines()[1].get_ydata()
    assert np.isnan(gaps).sum() >= 1, "there is a gap between the two intervals of E"
    axes = assessment.plot_heatmap("DE", "length", "mass")
    drawn = [cell for cell in assessment.success_by_parameters("DE", "length", "mass") if cell.episodes]
    assert len(axes.patches) == len(drawn)
    corners = perturb.sets.grid("corners", {"length": [0.3, 0.6, 0.9], "mass": "0.1..0.3/2"})
    grid = perturb.evaluate(upright, "CartPole", versions=[corners], episodes=12, server=server)
    axes = grid.plot_heatmap("corners", "length", "mass")
    assert axes.get_xlim() == pytest.approx((0.15, 1.05))
    assert len(axes.patches) == 6
    with pytest.raises(perturb.InvalidArgumentError, match="does not vary"):
        assessment.plot_curves("length", ["DD"])
    with pytest.raises(perturb.InvalidArgumentError, match="does not vary"):
        assessment.plot_heatmap("DD", "length", "mass")


def test_a_saved_assessment_can_be_loaded_from_another_place(assessment: perturb.Assessment, tmp_path: Path) -> None:
    assessment.save(tmp_path / "one")
    assert ">one<" in assessment.to_html(), "reports name the folder"
    shutil.move(tmp_path / "one", tmp_path / "two")
    loaded = perturb.Assessment.load(tmp_path / "two")
    same_episodes(loaded, assessment)
    loaded.save(tmp_path / "three")
    for file in (tmp_path / "two").iterdir():
        assert file.read_bytes() == (tmp_path / "three" / file.name).read_bytes()
