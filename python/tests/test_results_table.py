"""`read_results` reads the published results table as a pandas DataFrame."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import perturb

from .conftest import ROOT

TABLE = ROOT / "results/results.parquet"


def test_the_published_table_has_every_study_with_its_plan() -> None:
    pytest.importorskip("pandas")
    results = perturb.read_results(TABLE, settings=["learning_rate", "no_such_setting"])
    assert set(results.study) == set(results.attrs["plans"])
    assert "[[algorithm]]" in results.attrs["plans"]["classic-ff"]
    row = results[(results.study == "classic-ff") & (results.cell == "CartPole-ppo-ff-R-35f87fe3-s2")].iloc[0]
    assert (row.tested_on, row.episodes, row.learning_rate, row.no_such_setting) == ("D", 1000, 3e-4, None)
    assert row.success_percent == 100 * row.successes / row.episodes
    failed = results[results.failure.notna()]
    assert len(failed) == 6
    assert failed.episodes.isna().all()


def test_files_that_are_not_a_results_table_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pandas")
    (tmp_path / "other.parquet").write_text("text")
    with pytest.raises(perturb.InvalidArgumentError, match="is not a results table: it is not a Parquet file"):
        perturb.read_results(tmp_path / "other.parquet")
    with pytest.raises(perturb.InvalidArgumentError, match="there is no results table"):
        perturb.read_results(tmp_path / "none.parquet")
    with pytest.raises(perturb.InvalidArgumentError, match="path is 7"):
        perturb.read_results(7)  # type: ignore[arg-type]
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pip install pandas"):
        perturb.read_results(TABLE)
