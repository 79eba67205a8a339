"""Folders of tasks for `perturb-server --task`."""

from __future__ import annotations

import shutil
from importlib import metadata, resources, util
from pathlib import Path
from typing import Final

#: The tasks of Gymnasium that this package has task files for: ids and files.
GYMNASIUM_TASKS: Final[dict[str, str]] = {
    "Ant-v5": "ant_v5.toml",
    "HalfCheetah-v5": "half_cheetah_v5.toml",
    "Hopper-v5": "hopper_v5.toml",
    "Humanoid-v5": "humanoid_v5.toml",
    "HumanoidStandup-v5": "humanoid_standup_v5.toml",
    "InvertedDoublePendulum-v5": "inverted_double_pendulum_v5.toml",
    "InvertedPendulum-v5": "inverted_pendulum_v5.toml",
    "Pusher-v5": "pusher_v5.toml",
    "Reacher-v5": "reacher_v5.toml",
    "Swimmer-v5": "swimmer_v5.toml",
    "Walker2d-v5": "walker2d_v5.toml",
}


def from_gymnasium(id: str, folder: str | Path) -> Path:  # noqa: A002 - Gymnasium calls it so
    """Writes a folder of one of Gymnasium's MuJoCo tasks: the task file, Gymnasium's model and Gymnasium's licence.

    The model comes from the installed package gymnasium. MuJoCo and Gymnasium's own dependencies on it are not needed.

    Args:
        id: the id in Gymnasium, such as "Walker2d-v5"; see `GYMNASIUM_TASKS`.
        folder: where to write; it is made if need be. Files of the same names are overwritten.

    Returns:
        The folder, for `perturb-server --task`.

    Raises:
        ValueError: there is no task file for this id.
        FileNotFoundError: the installed gymnasium has no such model, or none is installed.
    """
    if id not in GYMNASIUM_TASKS:
        raise ValueError(f"there is no task file for {id!r}; there are {', '.join(GYMNASIUM_TASKS)}")
    task = (resources.files("perturb") / "task_files" / GYMNASIUM_TASKS[id]).read_text(encoding="utf-8")
    model = _assets() / _model(task)
    if not model.is_file():
        raise FileNotFoundError(f"{model} is missing; install gymnasium 1.1 or later, which has the model of {id}")
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    (target / "task.toml").write_text(task, encoding="utf-8")
    shutil.copyfile(model, target / model.name)
    (target / "LICENSE.gymnasium").write_text(_licence(), encoding="utf-8")
    return target


def _model(task: str) -> str:
    """The file name that a task file has as its model."""
    line = next(line for line in task.splitlines() if line.startswith("model = "))
    return line.split('"')[1]


def _assets() -> Path:
    """The folder of Gymnasium's models. Importing its MuJoCo environments would need MuJoCo."""
    found = util.find_spec("gymnasium")
    if found is None or not found.submodule_search_locations:
        raise FileNotFoundError("the package gymnasium is missing; install it with: pip install gymnasium")
    return Path(found.submodule_search_locations[0]) / "envs" / "mujoco" / "assets"


def _licence() -> str:
    """The licence of the installed package gymnasium."""
    for file in metadata.files("gymnasium") or []:
        if file.name.upper().startswith("LICENSE"):
            return file.read_text(encoding="utf-8")
    return (
        "This model is a part of Gymnasium, which has the MIT licence: https://github.com/Farama-Foundation/Gymnasium\n"
    )
