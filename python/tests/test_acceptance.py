"""stable-baselines3 accepts the environments, and the example trainings give the expected results.

`make python-acceptance` runs these tests; they take minutes and download gigabytes of PyTorch."""

from __future__ import annotations

import faulthandler
import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest

import perturb
from perturb.catalogue import CATALOGUE

from .conftest import ROOT, identifier

EXAMPLES = ROOT / "python/examples"

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _takes_longer() -> None:
    """Remove the time limit that other tests have."""
    faulthandler.cancel_dump_traceback_later()


def run(*command: str) -> str:
    ended = subprocess.run(
        [sys.executable, *command], capture_output=True, text=True, cwd=EXAMPLES, check=False, timeout=3600
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


@pytest.mark.filterwarnings("ignore:We recommend")  # a warning about Pendulum's action range of ±2
@pytest.mark.parametrize("version", ["D", "R", "E"])
@pytest.mark.parametrize("name", list(CATALOGUE))
def test_stable_baselines3s_checker_accepts_all_environments(name: str, version: str, server: str) -> None:
    from stable_baselines3.common.env_checker import check_env

    env = gymnasium.make(identifier(name), version=version, server=server)
    check_env(env)
    env.close()


def test_stable_baselines3s_ppo_learns_cart_pole(server: str) -> None:
    """With default settings, PPO reaches a mean return of 195 within 60 000 steps."""
    output = run("sb3_ppo.py", "--server", server)
    match = re.search(r"(\d+) steps, mean return of the last 100 episodes ([\d.]+)\n.*test episodes ([\d.]+)", output)
    assert match is not None, output
    assert int(match[1]) <= 60_000 + 2048, output  # trainings end after a complete rollout of 2048 steps
    assert max(float(match[2]), float(match[3])) >= 195, output


def test_ppo_in_one_file_learns_cart_pole(server: str) -> None:
    """The example's number of steps is twice what the training needed when this test was written."""
    returns = [float(value) for value in re.findall(r"episodes +([\d.]+)", run("cleanrl_ppo.py", "--server", server))]
    assert returns[-1] >= 195, returns
    assert returns[0] < 100, returns


def test_report_shows_the_agent_and_checkpoint_gives_same_bytes(server: str, tmp_path: Path) -> None:
    from stable_baselines3 import PPO

    lines = [line for line in (EXAMPLES / "sb3_report.py").read_text().splitlines() if line]
    assert len(lines) <= 25
    output = run("sb3_report.py", "2048", "20", str(tmp_path))
    assert output.count("paper: ppo ff") == 2, "CartPole and Hopper"
    page = (tmp_path / "report.html").read_text("utf-8")
    for row in ("SB3 PPO (trained elsewhere)", "ppo ff", "CartPole", "Hopper"):
        assert row in page
    models = {version: PPO.load(tmp_path / f"CartPole-{version}", device="cpu") for version in ("D", "R")}
    again = perturb.evaluate(models, "CartPole", episodes=20, seed=1, name="SB3 PPO", server=server)
    again.save(tmp_path / "again")
    files = sorted(path.name for path in (tmp_path / "again").iterdir())
    assert files == ["assessment.json", "episodes-D.parquet", "episodes-R.parquet"]
    for name in files:
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "CartPole" / name).read_bytes()
    other = perturb.evaluate(models, "CartPole", episodes=20, seed=2, name="SB3 PPO", server=server)
    other.save(tmp_path / "other")
    assert (tmp_path / "other" / files[1]).read_bytes() != (tmp_path / "again" / files[1]).read_bytes()
    known = '"timesteps": 2048'
    assert known in (tmp_path / "again/assessment.json").read_text("utf-8")


def test_a_study_of_two_conditions_takes_twenty_lines(tmp_path: Path) -> None:
    """The printed numbers equal those that pandas computes from the recorded episodes."""
    import pandas as pd

    lines = [line for line in (EXAMPLES / "sb3_study.py").read_text().splitlines() if line]
    assert len(lines) <= 20
    output = run("sb3_study.py", "4096", "60", str(tmp_path / "study.csv"))
    episodes = pd.read_csv(tmp_path / "study.csv")
    assert len(episodes) == 6 * 3 * 60
    by_seed = episodes.groupby(["condition", "set", "key"])["return"].mean()
    rows = {tuple(row[:2]): row[2:] for row in (re.split(r"  +", line) for line in output.splitlines()) if len(row) > 2}
    for tested_on in ("D", "R", "E"):
        seeds = {name: by_seed[name, tested_on] for name in ("no DR", "DR")}
        for condition, means in seeds.items():
            half = 4.302653 * means.sem()  # 97.5 % quantile of Student's t with 2 degrees of freedom
            interval = f"[{means.mean() - half:.1f}, {means.mean() + half:.1f}]"
            assert rows[condition, tested_on][:3] == ["3", f"{means.mean():.1f}", interval], output
        pairs = (seeds["DR"] - seeds["no DR"]).tolist()
        difference = f"{sum(pairs) / 3:+.1f}"
        assert rows["DR − no DR", tested_on][:2] == [difference, ", ".join(f"{it:+.1f}" for it in pairs)], output
    assert "comparisons" in output.splitlines()[-3], "the verdict"
