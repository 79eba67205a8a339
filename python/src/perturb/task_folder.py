"""Finds the description of an environment: a built-in one, a task in a folder, or a task of a running server."""

from __future__ import annotations

import functools
import hashlib
import json
import os
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import _native, catalogue, local_server
from .address import EMBEDDED
from .catalogue import Description
from .errors import InvalidArgumentError, ServerStartError
from .local_server import TaskFolder

if TYPE_CHECKING:
    from collections.abc import Mapping

    from .address import Address

# Suffixes of files that a task may read.
_SUFFIXES = {".toml", ".xml", ".mjcf", ".stl", ".obj", ".msh", ".png", ".skn", ".bin", ".hf"}
# Maximum time for perturb-server to describe a task folder, s. Loading the folder may take up to a minute of CPU time.
_LIMIT = 120.0


def find_folder(task: str | os.PathLike[str] | None, server: object = None) -> TaskFolder | None:
    """Return the task folder that the argument `task` names, or None if `task` is None.

    Raises:
        InvalidArgumentError: if `task` is not a task folder, or if `server` is the address of a running server. Such a
            server serves only the tasks that it was started with.
    """
    if task is None:
        return None
    if not isinstance(task, str | os.PathLike):
        raise InvalidArgumentError(f"task={task!r}; expected the path of a folder with a task.toml")
    if server is not None and str(server) != EMBEDDED.target:
        raise InvalidArgumentError(
            f"task={os.fspath(task)!r} needs a private or embedded server, but server={str(server)!r} is the address "
            "of another: leave server= out, or start that server with `perturb-server --task DIR` and leave task= out"
        )
    path = Path(task).absolute()
    if not (path / "task.toml").is_file():
        wrong = "has no file task.toml" if path.is_dir() else "is not a folder" if path.exists() else "does not exist"
        raise InvalidArgumentError(
            f"task={os.fspath(task)!r}: {path} {wrong}; docs/tasks.md describes folders of tasks, and "
            "perturb.tasks.from_gymnasium writes some"
        )
    return TaskFolder(str(path), _fingerprint(path))


@functools.lru_cache(maxsize=64)
def entry(task: TaskFolder) -> Mapping[str, Any]:
    """Run perturb-server to load a task folder. Return the task's description in the JSON format of catalogue.json.

    Raises:
        InvalidArgumentError: if perturb-server refuses the folder. The error has perturb-server's message.
        ServerStartError: if perturb-server was not found, or fails.
    """
    program = local_server.find_program()
    command = [str(program), "--private", "--log", "error", "--catalogue", "--task", task.path]
    try:
        finished = subprocess.run(command, capture_output=True, timeout=_LIMIT, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ServerStartError(f"{program} does not describe task={task.path!r}: {error}") from error
    words = finished.stderr.decode(errors="replace").strip().removeprefix("perturb-server: --task ")
    if finished.returncode == 2:
        raise InvalidArgumentError(f"task={words}")
    if finished.returncode != 0:
        raise ServerStartError(f"{program} does not describe task={task.path!r}: status {finished.returncode}, {words}")
    known = {known["name"] for known in catalogue.CATALOGUE_ENTRIES}
    entries = json.loads(finished.stdout)["environments"]
    own: Mapping[str, Any] = next(own for own in reversed(entries) if own["name"] not in known)
    return own


def _fingerprint(path: Path) -> str:
    digest = hashlib.sha256()
    for folder, subfolders, names in os.walk(path):
        subfolders.sort()
        for name in sorted(names):
            if Path(name).suffix.lower() in _SUFFIXES:
                file = Path(folder, name)
                status = file.stat() if file.exists() else None
                digest.update(repr((str(file), status and (status.st_size, status.st_mtime_ns))).encode())
    return digest.hexdigest()


def describe(
    environment: str | None, task: TaskFolder | None, server: Address | None = None, timeout: float = 60.0
) -> Description:
    """Return the description of an environment.

    With `task`, the environment is the task in that folder. Otherwise the name is looked up among the built-in
    environments first, and then among the environments of the server.

    Args:
        environment: the environment's name. It may be None with `task`.
        task: the task folder, or None.
        server: the address of a running server, or None.
        timeout: maximum time to wait for the server's reply, s.

    Raises:
        InvalidArgumentError: if the name is unknown, or is not the name of the task.
    """
    if task is not None:
        known = Description.read(entry(task))
        if environment is not None and not catalogue.is_spelled(environment, known):
            raise InvalidArgumentError(
                f"environment={environment!r} is not the task in {task.path}, which is {known.name!r}: leave one "
                "of the two out"
            )
        return known
    if environment is None:
        raise InvalidArgumentError("there is neither environment= nor task=: give the name of an environment")
    try:
        return catalogue.find(environment)
    except InvalidArgumentError:
        # The name may belong to a task that only the running server knows.
        if server is None or server == EMBEDDED or not isinstance(environment, str):
            raise
        served = _served(server, timeout)
        for description in served:
            if catalogue.is_spelled(environment, description):
                return description
        raise


def _served(server: Address, timeout: float) -> list[Description]:
    """Return the descriptions of a server's environments.

    The list is empty if the server does not answer. The first request of a session then raises the error.
    """
    try:
        listed = _native.catalogue(str(server), timeout)
    except _native.Failure:
        return []
    return [Description.read(served) for served in json.loads(listed)["environments"]]
