"""Folders of Gymnasium's tasks."""

from pathlib import Path

import pytest

import perturb.tasks
from perturb.tasks import GYMNASIUM_TASKS, from_gymnasium


@pytest.mark.parametrize("name", GYMNASIUM_TASKS)
def test_a_folder_has_the_task_the_model_and_the_licence(name: str, tmp_path: Path) -> None:
    folder = from_gymnasium(name, tmp_path / "new" / "folder")
    task = (folder / "task.toml").read_text(encoding="utf-8")
    model = next(line.split('"')[1] for line in task.splitlines() if line.startswith("model = "))
    assert "<mujoco" in (folder / model).read_text(encoding="utf-8")
    assert "MIT" in (folder / "LICENSE.gymnasium").read_text(encoding="utf-8")
    assert f'name = "{name.replace("-v5", "V5")}"' in task


def test_an_unknown_id_is_refused_with_those_that_there_are(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="Walker2d-v5"):
        from_gymnasium("Walker2d-v4", tmp_path)


def test_a_missing_model_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(perturb.tasks, "_assets", lambda: tmp_path)
    with pytest.raises(FileNotFoundError, match="install gymnasium"):
        from_gymnasium("Ant-v5", tmp_path / "ant")
