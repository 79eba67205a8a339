"""Writes the protocol's messages: src/perturb/_proto/perturb_pb2.py and .pyi, from perturb/v1/perturb.proto."""

import shutil
import tempfile
from pathlib import Path
from typing import Any

from grpc_tools import protoc
from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PROTO = "perturb/v1/perturb.proto"


class ProtocolBuildHook(BuildHookInterface):  # type: ignore[misc]
    """Runs before every wheel, source distribution and editable installation."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: ARG002
        """Compile the protocol of the repository, or that of the source distribution."""
        root = Path(self.root)
        places = (root / "proto", root.parent / "proto")
        proto = next((place for place in places if (place / PROTO).is_file()), None)
        if proto is None:
            raise FileNotFoundError(f"{PROTO} is in neither {places[0]} nor {places[1]}; build in a full clone")
        with tempfile.TemporaryDirectory() as out:
            if protoc.main(["protoc", f"-I{proto}", f"--python_out={out}", f"--pyi_out={out}", PROTO]) != 0:
                raise RuntimeError(f"protoc refused {proto / PROTO}; its words are above")
            for name in ("perturb_pb2.py", "perturb_pb2.pyi"):
                shutil.copyfile(Path(out, "perturb", "v1", name), root / "src" / "perturb" / "_proto" / name)
        if self.target_name == "sdist":
            build_data["force_include"][str(proto / PROTO)] = f"proto/{PROTO}"
