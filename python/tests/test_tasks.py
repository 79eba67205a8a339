"""`perturb.tasks` writes task folders for tasks of Gymnasium and dm_control."""

from pathlib import Path

import pytest

import perturb.tasks
from perturb.tasks import DM_CONTROL_TASKS, GYMNASIUM_TASKS, from_dm_control, from_gymnasium


@pytest.mark.parametrize("name", GYMNASIUM_TASKS)
def test_a_folder_has_the_task_the_model_and_the_licence(name: str, tmp_path: Path) -> None:
    folder = from_gymnasium(name, tmp_path / "new" / "folder")
    task = (folder / "task.toml").read_text(encoding="utf-8")
    model = next(line.split('"')[1] for line in task.splitlines() if line.startswith("model = "))
    assert "<mujoco" in (folder / model).read_text(encoding="utf-8")
    assert "MIT" in (folder / "LICENSE.gymnasium").read_text(encoding="utf-8")
    assert f'name = "{name.replace("-v5", "V5")}"' in task


@pytest.mark.parametrize("name", DM_CONTROL_TASKS)
def test_a_folder_of_dm_control_has_model_and_includes(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The package dm_control is not a dependency of the tests, so dummy files replace its files."""
    package = tmp_path / "dm_control"
    (package / "suite/common").mkdir(parents=True)
    model = name.split("-")[0] + ".xml"
    for file in (model, "common/visual.xml", "common/skybox.xml", "common/materials.xml"):
        (package / "suite" / file).write_text(f"<mujoco><!-- {file} --></mujoco>")
    monkeypatch.setattr(perturb.tasks, "_package", lambda _: package)
    folder = from_dm_control(name, tmp_path / "task")
    assert model in (folder / model).read_text()
    assert "skybox" in (folder / "common/skybox.xml").read_text()
    assert "Apache" in (folder / "LICENSE.dm_control").read_text()
    own = "".join(part.capitalize() for part in name.replace("-", "_").split("_"))
    assert f'name = "{own}"' in (folder / "task.toml").read_text()
    (package / "suite" / model).unlink()
    with pytest.raises(FileNotFoundError, match=f"{model} is missing; install dm_control 1.0, which has {name}"):
        from_dm_control(name, tmp_path / "another")
    with pytest.raises(ValueError, match="cheetah-run"):
        from_dm_control("walker-walk", tmp_path)


def test_the_refusal_of_an_unknown_id_lists_the_known_ids(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="Walker2d-v5"):
        from_gymnasium("Walker2d-v4", tmp_path)


def test_a_missing_model_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(perturb.tasks, "_assets", lambda: tmp_path)
    with pytest.raises(FileNotFoundError, match="install gymnasium"):
        from_gymnasium("Ant-v5", tmp_path / "ant")
