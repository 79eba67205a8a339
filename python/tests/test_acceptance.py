"""stable-baselines3 takes the environments as they are. Minutes, and gigabytes of PyTorch: `make python-acceptance`."""

from __future__ import annotations

import faulthandler
import re
import subprocess
import sys

import gymnasium
import pytest

from perturb.catalogue import CATALOGUE

from .conftest import ROOT, identifier

EXAMPLES = ROOT / "python/examples"

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _takes_longer() -> None:
    """Lift the limit of other tests."""
    faulthandler.cancel_dump_traceback_later()


def run(*command: str) -> str:
    ended = subprocess.run(
        [sys.executable, *command], capture_output=True, text=True, cwd=EXAMPLES, check=False, timeout=3600
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


@pytest.mark.filterwarnings("ignore:We recommend")  # Pendulum's torque of ±2
@pytest.mark.parametrize("version", ["D", "R", "E"])
@pytest.mark.parametrize("name", list(CATALOGUE))
def test_stable_baselines3s_checker_accepts_every_environment_and_version(name: str, version: str, server: str) -> None:
    from stable_baselines3.common.env_checker import check_env

    env = gymnasium.make(identifier(name), version=version, server=server)
    check_env(env)
    env.close()


def test_stable_baselines3s_ppo_learns_cart_pole(server: str) -> None:
    """With its default settings, to a mean return of 195 within 60 000 steps."""
    output = run("sb3_ppo.py", "--server", server)
    match = re.search(r"(\d+) steps, mean return of the last 100 episodes ([\d.]+)\n.*test episodes ([\d.]+)", output)
    assert match is not None, output
    assert int(match[1]) <= 60_000 + 2048, output  # a last rollout is finished
    assert max(float(match[2]), float(match[3])) >= 195, output


def test_ppo_in_one_file_learns_cart_pole(server: str) -> None:
    """Twice as many steps as it took when it was written."""
    returns = [float(value) for value in re.findall(r"episodes +([\d.]+)", run("cleanrl_ppo.py", "--server", server))]
    assert returns[-1] >= 195, returns
    assert returns[0] < 100, returns
