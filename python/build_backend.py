"""Build backend for pip. It writes the server's catalogue to a file, and then calls maturin.

The file is src/perturb/catalogue.json, which is not in git. It has the environments and limits that the program
perturb-server prints. The program is the one that the environment variable PERTURB_SERVER names, or else the one that
cargo built in the clone, or else the first on PATH.
"""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import maturin
from maturin import (  # noqa: F401  (maturin does the other steps of a build)
    get_requires_for_build_editable,
    get_requires_for_build_wheel,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)

ROOT = Path(__file__).resolve().parent
PROGRAM = "perturb-server"
REMEDY = f"build it with `make build` in the clone, or set PERTURB_SERVER to a {PROGRAM} of this version"


def build_wheel(
    directory: str, config_settings: dict[str, Any] | None = None, metadata_directory: str | None = None
) -> str:
    """Make a wheel with the package and the native module. `make wheel` adds the programs."""
    write_catalogue()
    return str(maturin.build_wheel(directory, config_settings, metadata_directory))


def build_editable(
    directory: str, config_settings: dict[str, Any] | None = None, metadata_directory: str | None = None
) -> str:
    """Make the wheel of an editable installation."""
    write_catalogue()
    return str(maturin.build_editable(directory, config_settings, metadata_directory))


def build_sdist(directory: str, config_settings: dict[str, Any] | None = None) -> str:  # noqa: ARG001
    """Raise an error, because the native module needs crates outside of this folder."""
    raise RuntimeError(
        "there is no source distribution: build a wheel in a clone, `make wheel` or `pip install ./python`"
    )


def write_catalogue() -> None:
    """Write the catalogue of perturb-server to src/perturb/catalogue.json."""
    catalogue = ask_catalogue(find_server(ROOT.parent), version(ROOT))
    (ROOT / "src/perturb/catalogue.json").write_text(catalogue, encoding="utf-8")


def version(project: Path) -> str:
    """Return the package's version from pyproject.toml, without a TOML parser, which Python 3.10 does not have."""
    found = re.search(r'^version = "(.+)"$', (project / "pyproject.toml").read_text("utf-8"), re.MULTILINE)
    if found is None:
        raise RuntimeError(f"{project}/pyproject.toml has no version")
    return found[1]


def find_server(clone: Path) -> str:
    """Return the path of the program perturb-server."""
    target = Path(os.environ.get("CARGO_TARGET_DIR") or clone / "target")
    named, built = os.environ.get("PERTURB_SERVER"), target / "release" / PROGRAM
    found = shutil.which(named) if named else shutil.which(built) or shutil.which(PROGRAM)
    if found is None:
        where = f"PERTURB_SERVER={named} is not a program" if named else f"{PROGRAM} is neither {built} nor on PATH"
        raise FileNotFoundError(f"the package's environments are read from {PROGRAM}, but {where}; {REMEDY}")
    return found


def ask_catalogue(server: str, version: str) -> str:
    """Return the JSON text with environments and limits that perturb-server prints. Check the server's version."""
    finished = subprocess.run([server, "--catalogue"], capture_output=True, text=True, check=False)
    if finished.returncode != 0:
        raise RuntimeError(f"{server} --catalogue ended with status {finished.returncode}: {finished.stderr}; {REMEDY}")
    try:
        served = json.loads(finished.stdout)["server_version"]
    except (ValueError, KeyError) as error:
        raise RuntimeError(f"{server} --catalogue printed no catalogue; {REMEDY}") from error
    if served != version:
        raise RuntimeError(f"{server} has the version {served}, this package {version}; {REMEDY}")
    return finished.stdout
