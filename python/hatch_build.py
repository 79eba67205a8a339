"""Writes what the package takes from the repository, and git does not keep.

- src/perturb/_proto/perturb_pb2.py and .pyi: the protocol's messages, from perturb/v1/perturb.proto;
- src/perturb/catalogue.json: the environments and limits, as the program perturb-server prints them.

A source distribution has both already.
"""

import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from grpc_tools import protoc
from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PROTO = "perturb/v1/perturb.proto"
PROGRAM = "perturb-server"
REMEDY = f"build it with `make build` in the clone, or set PERTURB_SERVER to a {PROGRAM} of this version"


class ContractBuildHook(BuildHookInterface):  # type: ignore[misc]
    """Runs before every wheel, source distribution and editable installation."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: ARG002
        """Write the messages and the catalogue."""
        root = Path(self.root)
        if (root / "PKG-INFO").is_file():
            return
        package = root / "src" / "perturb"
        write_messages(root.parent / "proto", package / "_proto")
        catalogue = ask_catalogue(find_server(root.parent), self.metadata.version)
        (package / "catalogue.json").write_text(catalogue, encoding="utf-8")


def write_messages(proto: Path, package: Path) -> None:
    """Compile the protocol."""
    if not (proto / PROTO).is_file():
        raise FileNotFoundError(f"{PROTO} is not in {proto}; build in a full clone")
    with tempfile.TemporaryDirectory() as out:
        if protoc.main(["protoc", f"-I{proto}", f"--python_out={out}", f"--pyi_out={out}", PROTO]) != 0:
            raise RuntimeError(f"protoc refused {proto / PROTO}; its words are above")
        for name in ("perturb_pb2.py", "perturb_pb2.pyi"):
            shutil.copyfile(Path(out, "perturb", "v1", name), package / name)


def find_server(clone: Path) -> str:
    """Find the program: PERTURB_SERVER, else what cargo built in the clone, else what is on PATH."""
    named, built = os.environ.get("PERTURB_SERVER"), clone / "target" / "release" / PROGRAM
    found = shutil.which(named) if named else shutil.which(built) or shutil.which(PROGRAM)
    if found is None:
        where = f"PERTURB_SERVER={named} is no program" if named else f"{PROGRAM} is neither {built} nor on PATH"
        raise FileNotFoundError(f"the package's environments are asked of {PROGRAM}, but {where}; {REMEDY}")
    return found


def ask_catalogue(server: str, version: str) -> str:
    """Ask the program for its environments and limits, as JSON."""
    asked = subprocess.run([server, "--catalogue"], capture_output=True, text=True, check=False)
    if asked.returncode != 0:
        raise RuntimeError(f"{server} --catalogue ended with status {asked.returncode}: {asked.stderr}; {REMEDY}")
    try:
        served = json.loads(asked.stdout)["server_version"]
    except (ValueError, KeyError) as error:
        raise RuntimeError(f"{server} --catalogue printed no catalogue; {REMEDY}") from error
    if served != version:
        raise RuntimeError(f"{server} has the version {served}, this package {version}; {REMEDY}")
    return asked.stdout
