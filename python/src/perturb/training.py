"""Trainings with perturb's learner, run by the program `perturb` in a process of its own."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from . import requests
from .address import EMBEDDED
from .errors import InvalidArgumentError, PerturbError, ServerStartError
from .local_server import find_program as find_server
from .policy import Policy, load_policy
from .progress import Progress

PROGRAM = "perturb"
# Environment variable with the path of the program `perturb`.
VARIABLE = "PERTURB_PROGRAM"
# Path of `perturb` inside an installed wheel. Some wheels do not contain it.
BUNDLED = Path(__file__).with_name("_programs") / PROGRAM
# Interval at which the log of a training is read to show the training's progress, s.
_POLL_INTERVAL = 0.2
# Exit status with which `perturb` reports a wrong argument.
_USAGE = 2


@dataclass(frozen=True)
class Training:
    """The result of a finished training."""

    # The trained policy.
    policy: Policy
    # The folder of the training: configuration, logs, TensorBoard scalars, checkpoint. `perturb train --resume`
    # continues the training in this folder.
    folder: Path
    # The columns of progress.csv by name, float64 [iterations]. Missing numbers are NaN.
    progress: Mapping[str, Any]
    # The content of the file that `perturb train --json` writes.
    result: Mapping[str, Any]


def train(
    environment: str,
    *,
    version: requests.Version = "D",
    parameters: Mapping[str, str | float] | None = None,
    algorithm: str = "ppo",
    architecture: str | None = None,
    observe: str | None = None,
    episodes: int | None = None,
    seed: int = 1,
    settings: Mapping[str, Any] | None = None,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    server: str | None = None,
    progress: bool | None = None,
) -> Training:
    """Train a policy with perturb's learner, as `perturb train` does, and wait until the training has finished.

    Args:
        environment: the environment's name in docs/environments.md, such as `CartPole`.
        version: the distribution of the parameters: `D` (the defaults), `R` (random), `E` (extreme), or `R+E`.
        parameters: values that replace those of the version, by parameter: numbers, or texts such as `"0.3..0.4"`.
        algorithm: `ppo`, `a2c`, `epopt-ppo`, `epopt-a2c`, `rl2-ppo` or `rl2-a2c`.
        architecture: the policy network: `ff` (feed-forward) or `rc` (recurrent). `rc` needs `perturb-recurrent`, which
            `make install-recurrent` installs.
        observe: `state`, or `parameters` to append the parameters to observations.
        episodes: number of training episodes. By default 15 000.
        seed: fixes all randomness. The same seed gives the same policy, byte for byte.
        settings: other settings of docs/algorithms.md, such as `{"learning_rate": 3e-3}`.
        out: the folder of the training, which must be new or empty. By default
            `runs/<environment>-<algorithm>-<time>`.
        overwrite: whether to delete a training that is in the folder.
        server: the server's address, `unix:/path` or `host:port`. None starts a private server.
        progress: whether to show the number of finished episodes on standard error. By default only on a terminal. The
            number is shown only if `out` and `episodes` are given.

    Raises:
        InvalidArgumentError: if the program refuses an argument. The error has the program's message.
        ServerStartError: if the program was not found.
        PerturbError: if the training fails. The error has the program's message.
    """
    if server is not None and str(server) == EMBEDDED.target:
        raise InvalidArgumentError(
            f"server={server!r} is for environments and tests in this process, and another program trains: leave "
            "server= out, which starts a private server"
        )
    # Each argument becomes an option of `perturb train`.
    program = _find_program()
    command = [program, "--quiet", "train", "--env", str(environment), "--version", requests.version(version)]
    command += ["--algorithm", str(algorithm), "--seed", str(requests.seed(seed))]
    for option, value in (("--architecture", architecture), ("--observe", observe), ("--episodes", episodes)):
        command += [] if value is None else [option, str(value)]
    command += [] if server is None else ["--server", str(server)]
    for name, value in (settings or {}).items():
        written = json.dumps(value) if isinstance(value, bool | str) else str(value)
        command += ["--set", f"{name}={written}"]
    command += ["--parameters", *(f"{name}={value}" for name, value in parameters.items())] if parameters else []
    with tempfile.TemporaryDirectory(prefix="perturb-") as temporary:
        document = Path(temporary) / "result.json"
        command += ["--overwrite"] if overwrite else []
        command += ["--out", os.fspath(out)] if out is not None else []
        _run([*command, "--json", str(document)], Path(out) if out is not None else None, episodes, progress)
        result: Mapping[str, Any] = json.loads(document.read_text("utf-8"))
    folder = Path(out) if out is not None else Path(result["out"])
    return Training(load_policy(folder), folder, _columns(folder / "progress.csv"), result)


def _run(command: list[str], folder: Path | None, episodes: int | None, progress: bool | None) -> None:
    """Run `perturb train` as another process until it ends.

    Meanwhile, show how many of the `episodes` are finished, from the log `progress.csv` in `folder`. If `episodes` or
    `folder` is None, show nothing.

    Raises:
        InvalidArgumentError: if `perturb train` refuses an argument.
        PerturbError: if the training fails.
    """
    # If no server is named, the program starts a perturb-server: the one in PERTURB_SERVER, else the one beside itself,
    # else the first on PATH. PATH therefore begins with the folder of this package's server.
    environment = {**os.environ, "PATH": os.pathsep.join([str(find_server().parent), os.environ.get("PATH", "")])}
    shown = Progress(progress)
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment)
    try:
        while True:
            try:
                _, words = process.communicate(timeout=_POLL_INTERVAL)
                break
            except subprocess.TimeoutExpired:
                done = 0 if folder is None else _episodes_so_far(folder / "progress.csv")
                if done and episodes:
                    shown.update(f"training in {folder}", min(done, episodes), episodes)
    except BaseException:  # after Ctrl-C, the program writes a checkpoint and ends
        process.send_signal(signal.SIGINT)
        process.communicate()
        raise
    finally:
        shown.finish()
    if process.returncode != 0:
        sentence = words.strip().removeprefix("perturb: ") or f"perturb train ended with status {process.returncode}"
        raise (InvalidArgumentError if process.returncode == _USAGE else PerturbError)(sentence)


def _episodes_so_far(log: Path) -> int:
    try:
        lines = log.read_text("utf-8").splitlines()
        return int(dict(zip(lines[0].split(","), lines[-1].split(","), strict=True))["rollout/episodes"])
    except (OSError, ValueError, IndexError, KeyError):  # nothing is in the log yet
        return 0


def _columns(log: Path) -> dict[str, Any]:
    with log.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([_number(row[name]) for row in rows]) for name in (rows[0] if rows else {})}


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _find_program() -> str:
    named = os.environ.get(VARIABLE)
    found = shutil.which(named) if named else shutil.which(BUNDLED) or shutil.which(PROGRAM)
    if found is None:
        raise ServerStartError(
            f"the program {PROGRAM} was not found: install a wheel that has it (`make wheel`), or build it with `make "
            f"build` in a clone of perturb and set {VARIABLE} to target/release/{PROGRAM}"
        )
    return found
