"""The examples run, and print the expected results."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from PIL import Image

from perturb.catalogue import CATALOGUE

from .conftest import ROOT

EXAMPLES = ROOT / "python/examples"


def run(*command: str) -> str:
    ended = subprocess.run(
        [sys.executable, *command], capture_output=True, text=True, cwd=EXAMPLES, check=False, timeout=100
    )
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr == ""
    return ended.stdout


def test_example_of_ten_lines_runs_and_equals_the_readme() -> None:
    output = run("ten_lines.py")
    assert output.startswith("frictions: [")
    assert "ended:" in output
    example = (EXAMPLES / "ten_lines.py").read_text()
    loop = example[example.index("envs = ") :]
    assert loop in (ROOT / "python/README.md").read_text()


def test_the_sweep_shows_which_poles_stay_up(server: str) -> None:
    steps = [int(value) for value in re.findall(r": +(\d+) steps", run("sweep.py", "--server", server))]
    assert len(steps) == 9
    assert steps[0] < 100
    assert steps[4] == 200


def test_server_plays_the_policy_that_numpy_computes(server: str) -> None:
    output = run("act.py", "--server", server)
    assert output.startswith("200 steps of 8 environments, finished: True\n")
    assert int(re.findall(r"(\d+) episodes ended", output)[0]) >= 8
    # The tolerance allows for float32 rounding of sums of 64 numbers, and for the server's different tanh.
    assert float(re.findall(r"at most (\S+)", output)[0]) < 1e-5


def test_the_gallery_has_a_picture_of_every_environment(server: str, tmp_path: Path) -> None:
    files = run("gallery.py", "--server", server, "--out", str(tmp_path)).split()
    assert [Path(file).name for file in files] == [f"{name}.png" for name in CATALOGUE]
    for file in files:
        with Image.open(file) as picture:
            assert picture.size == (960, 480)
            assert (picture.getcolors(2**19) or [])[2:], "a drawing has colours"
