"""Makes task folders, for the argument `task` and for `perturb-server --task`, and registers their ids."""

from __future__ import annotations

import contextlib
import os
import shutil
from importlib import metadata, resources, util
from pathlib import Path
from typing import Final

import gymnasium

from .registration import register_id
from .task_folder import entry, find_folder

#: The task file of each Gymnasium task that this package can convert, by Gymnasium's id.
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

#: The task file of each task of dm_control's suite that this package can convert, by domain and task.
DM_CONTROL_TASKS: Final[dict[str, str]] = {
    "acrobot-swingup": "dm_acrobot_swingup.toml",
    "acrobot-swingup_sparse": "dm_acrobot_swingup_sparse.toml",
    "ball_in_cup-catch": "dm_ball_in_cup_catch.toml",
    "cheetah-run": "dm_cheetah_run.toml",
    "pendulum-swingup": "dm_pendulum_swingup.toml",
}


def from_gymnasium(id: str, folder: str | Path) -> Path:  # noqa: A002 - Gymnasium calls it so
    """Write a task folder for one of Gymnasium's MuJoCo tasks: the task file, the model, and Gymnasium's licence.

    The model is copied from the installed package gymnasium. The Python package mujoco is not needed.

    Args:
        id: the id in Gymnasium, such as "Walker2d-v5"; see `GYMNASIUM_TASKS`.
        folder: the folder to write. It is created if necessary, and files of the same names are overwritten.

    Returns:
        The folder, for `task` and `perturb-server --task`.

    Raises:
        ValueError: if there is no task file for this id.
        FileNotFoundError: if gymnasium is not installed, or its version has no such model.
    """
    if id not in GYMNASIUM_TASKS:
        raise ValueError(f"there is no task file for {id!r}; there are {', '.join(GYMNASIUM_TASKS)}")
    return _write(
        GYMNASIUM_TASKS[id], _assets(), Path(folder), "gymnasium", [], f"gymnasium 1.1 or later, which has {id}"
    )


def from_dm_control(task: str, folder: str | os.PathLike[str]) -> Path:
    """Write a task folder for a task of dm_control's suite: the task file, the model, and dm_control's licence.

    The model is copied from the installed package dm_control. Its dependencies are not needed, so `pip install
    --no-deps dm_control` is enough. Observations and rewards equal those of dm_control. Comments in the task file list
    everything that differs.

    Args:
        task: domain and task, such as "cheetah-run"; see `DM_CONTROL_TASKS`.
        folder: the folder to write. It is created if necessary, and files of the same names are overwritten.

    Returns:
        The folder, for `task` and `perturb-server --task`.

    Raises:
        ValueError: if there is no task file for this task.
        FileNotFoundError: if dm_control is not installed, or its version has no such model.
    """
    if task not in DM_CONTROL_TASKS:
        raise ValueError(f"there is no task file for {task!r}; there are {', '.join(DM_CONTROL_TASKS)}")
    common = ["common/visual.xml", "common/skybox.xml", "common/materials.xml"]
    suite = _package("dm_control") / "suite"
    return _write(
        DM_CONTROL_TASKS[task], suite, Path(folder), "dm_control", common, f"dm_control 1.0, which has {task}"
    )


def register(folder: str | os.PathLike[str]) -> str:
    """Register the task in a folder with Gymnasium. Return its id, such as `perturb/MyRobot-v0`.

    Afterwards `gymnasium.make` accepts this id. Without registration, use
    `gymnasium.make("perturb/Task-v0", task=folder)`.

    Raises:
        InvalidArgumentError: if the folder is not a task folder. The message has the reason.
    """
    task = find_folder(folder)
    assert task is not None
    described = entry(task)
    identifier = f"perturb/{described['name']}-v{described['revision']}"
    gymnasium.registry.pop(identifier, None)  # an earlier call may have registered the id for another folder
    register_id(identifier, environment=described["name"], task=task.path)
    return identifier


def register_ids() -> None:
    """Register ids that `gymnasium.make` accepts together with the argument `task`, the folder of a task.

    The id `perturb/Task-v0` accepts a folder with any task. Each task that `from_gymnasium` or `from_dm_control` writes
    has an id of its own, such as `perturb/Walker2dV5-v0`, which accepts a folder with that task only.
    """
    register_id("perturb/Task-v0")
    for name in GYMNASIUM_TASKS:
        own = name.replace("-v5", "V5")
        register_id(f"perturb/{own}-v0", environment=own)
    for name in DM_CONTROL_TASKS:
        own = "".join(part.capitalize() for part in name.replace("-", "_").split("_"))
        register_id(f"perturb/{own}-v0", environment=own)


def _write(file: str, models: Path, target: Path, package: str, included: list[str], remedy: str) -> Path:
    """Write a task file, its model with the files that the model includes, and the licence of their package."""
    task = (resources.files("perturb") / "task_files" / file).read_text(encoding="utf-8")
    model = _model(task)
    for name in [model, *included]:
        if not (models / name).is_file():
            raise FileNotFoundError(f"{models / name} is missing; install {remedy}")
    for name in [model, *included]:
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(models / name, target / name)
    (target / "task.toml").write_text(task, encoding="utf-8")
    (target / f"LICENSE.{package}").write_text(_licence(package), encoding="utf-8")
    return target


def _model(task: str) -> str:
    """Return the name of the model file that a task file states."""
    line = next(line for line in task.splitlines() if line.startswith("model = "))
    return line.split('"')[1]


def _assets() -> Path:
    """Return the folder of Gymnasium's models."""
    return _package("gymnasium") / "envs" / "mujoco" / "assets"


def _package(name: str) -> Path:
    """Return the folder of an installed package. Do not import the package, because the import may need MuJoCo."""
    found = util.find_spec(name)
    if found is None or not found.submodule_search_locations:
        raise FileNotFoundError(f"the package {name} is missing; install it with: pip install {name}")
    return Path(found.submodule_search_locations[0])


def _licence(package: str) -> str:
    """Return the licence text of an installed package."""
    with contextlib.suppress(metadata.PackageNotFoundError):
        for file in metadata.files(package) or []:
            if file.name.upper().startswith("LICENSE"):
                return file.read_text(encoding="utf-8")
    return f"This model is a part of {package}, which has {_LICENCES[package]}\n"


# The name and address of each package's licence, used if the installed package has no licence file.
_LICENCES = {
    "gymnasium": "the MIT licence: https://github.com/Farama-Foundation/Gymnasium",
    "dm_control": "the Apache License 2.0: https://github.com/google-deepmind/dm_control",
}
