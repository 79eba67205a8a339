"""The private server's socket needs a temporary folder. Errors about this folder name the variable TMPDIR."""

from __future__ import annotations

import os
import tempfile
from typing import TYPE_CHECKING

import pytest

import perturb

if TYPE_CHECKING:
    from pathlib import Path


def test_error_of_a_too_long_temporary_folder_names_tmpdir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / ("x" * 100)
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    with pytest.raises(
        perturb.ServerStartError, match=r"longer than the 107 bytes.*; set TMPDIR to a folder"
    ) as caught:
        perturb.PerturbEnv("CartPole").reset()
    assert "server=" not in str(caught.value)
    assert list(folder.iterdir()) == []


def test_error_of_a_non_utf8_temporary_folder_names_tmpdir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / os.fsdecode(b"latin\xfc")
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    with pytest.raises(perturb.ServerStartError, match="is not UTF-8; set TMPDIR to another folder"):
        perturb.PerturbEnv("CartPole").reset()
    assert list(folder.iterdir()) == []


def test_error_of_a_missing_temporary_folder_names_tmpdir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    with pytest.raises(perturb.ServerStartError, match=r"there is no folder for its socket .*; set TMPDIR"):
        perturb.PerturbEnv("CartPole").reset()
