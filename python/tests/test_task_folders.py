"""Environments can be made from task folders."""

from __future__ import annotations

import copy
import pickle
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import pytest

import perturb
import perturb.sets
import perturb.tasks
from perturb import local_server

from .conftest import ROOT

if TYPE_CHECKING:
    from collections.abc import Callable

    from .conftest import Server

ARM = ROOT / "examples/tasks/reaching_arm"


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    """Return a copy of the task folder of ReachingArm, which the test may change."""
    return Path(shutil.copytree(ARM, tmp_path / "arm"))


def steps(env: Any, count: int = 5) -> list[bytes]:
    """Step with a fixed action, and return the bytes of the observations."""
    observation, _ = env.reset(seed=3)
    observed = [observation.tobytes()]
    action = np.full(env.action_space.shape, 0.5, np.float32)
    return observed + [env.step(action)[0].tobytes() for _ in range(count)]


def test_environment_is_made_by_id_by_name_or_from_the_folder(tmp_path: Path) -> None:
    walker = perturb.tasks.from_gymnasium("Walker2d-v5", tmp_path / "walker2d")
    env = gymnasium.make("perturb/Walker2dV5-v0", task=walker, version="R")
    assert env.observation_space.shape == (17,)
    expected = steps(env)
    env.close()
    for made in (
        gymnasium.make("perturb/Task-v0", task=str(walker), version="R"),
        gymnasium.make(perturb.tasks.register(walker), version="R"),
        perturb.PerturbEnv(task=walker, version="R"),
        perturb.PerturbEnv("walker2d_v5", task=walker, version="R"),
    ):
        assert steps(made) == expected
        made.close()
    assert not local_server._shared, "each server ends with its last environment"


def test_copies_of_a_batch_have_the_task_of_its_folder(arm: Path) -> None:
    envs = gymnasium.make_vec("perturb/Task-v0", num_envs=3, task=arm)
    assert isinstance(envs, perturb.PerturbVectorEnv)
    expected = steps(envs)
    for other in (copy.deepcopy(envs), pickle.loads(pickle.dumps(envs))):
        assert steps(other) == expected
        other.close()
    envs.close()


def test_environments_and_sets_know_a_folders_parameters() -> None:
    known = perturb.environments(task=ARM)
    assert list(known)[-1] == "ReachingArm"
    arm = known["ReachingArm"]
    assert (arm.id, len(arm.model_hash), arm.step_limit) == ("perturb/ReachingArm-v0", 64, 150)
    assert arm.observation_space.shape == (len(arm.observation),)
    assert arm.parameters["gravity"].random == ((8.0, 12.0),)
    grid = perturb.sets.heatmap("ReachingArm", task=ARM, points=2)
    assert grid.contexts is not None
    assert set(grid.contexts[0]) == {"lower_mass", "gravity"}
    assert len(perturb.sets.sampled("some", "reaching-arm", 3, task=ARM).contexts or ()) == 3


def test_an_audit_finds_changes_of_a_task_folder(arm: Path) -> None:
    def still(observations: Any) -> Any:
        return np.zeros((len(observations), 2), np.float32)

    assessed = perturb.evaluate(still, task=arm, episodes=6)
    assert assessed.environment == "ReachingArm"
    assert assessed.audit(still, task=arm).different == ()
    text = (arm / "arm.xml").read_text()
    (arm / "arm.xml").write_text(text.replace('damping="0.2"', 'damping="0.3"'))
    different = assessed.audit(still, task=arm).different
    assert len(different) == 18
    assert "model_hash was" in different[0]


def test_a_changed_folder_is_noticed_when_a_session_opens(arm: Path) -> None:
    env = perturb.PerturbEnv(task=arm)
    (arm / "arm.xml").write_text((arm / "arm.xml").read_text() + "<!-- changed -->")
    with pytest.raises(perturb.ProtocolError, match="the files of ReachingArm changed since it was made: "):
        env.reset(seed=1)
    again = perturb.PerturbEnv(task=arm)
    again.reset(seed=1)
    again.close()


def test_running_environments_keep_the_files_they_opened(arm: Path) -> None:
    env = perturb.PerturbEnv(task=arm)
    before = steps(env)
    text = (arm / "arm.xml").read_text()
    (arm / "arm.xml").write_text(text.replace('damping="0.2"', 'damping="0.4"'))
    changed = perturb.PerturbEnv(task=arm)
    assert steps(changed) != before
    assert steps(env) == before
    env.close()
    changed.close()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"server": "unix:/nowhere"}, "leave server= out, or start that server with `perturb-server --task DIR`"),
        ({"task": "/nowhere/at/all"}, "/nowhere/at/all does not exist; docs/tasks.md describes folders of tasks"),
        ({"task": ARM / "task.toml"}, "task.toml is not a folder"),
        ({"task": ROOT}, "has no file task.toml"),
        ({"task": 7}, "task=7; expected the path of a folder"),
        ({"environment": "Hopper"}, "environment='Hopper' is not the task in .*, which is 'ReachingArm'"),
        ({"task": None}, "there is neither environment= nor task="),
        (
            {"task": None, "environment": "Walker2dV5"},
            "a task of a folder needs task='DIR', or a server",
        ),
    ],
)
def test_a_wrong_task_is_refused_with_a_remedy(settings: dict[str, Any], words: str) -> None:
    made: list[Callable[..., Any]] = [
        perturb.PerturbEnv,
        perturb.PerturbVectorEnv,
        lambda **settings: perturb.evaluate(lambda observations: observations, **settings),
    ]
    for make in made:
        with pytest.raises(perturb.InvalidArgumentError, match=words):
            make(**{"task": ARM, **settings})


def test_a_wrong_folder_is_refused_with_the_servers_message(arm: Path) -> None:
    text = (arm / "task.toml").read_text()
    (arm / "task.toml").write_text(text.replace("step_limit", "steps_limit", 1))
    with pytest.raises(perturb.InvalidArgumentError, match=r"task.toml, line 6: unknown key \"steps_limit\""):
        gymnasium.make("perturb/Task-v0", task=arm)


def test_the_tasks_of_a_running_server_need_no_folder(start_server: Callable[..., Server]) -> None:
    running = start_server("--task", str(ARM))
    env = perturb.PerturbEnv("reaching-arm", server=running.address)
    local = perturb.PerturbEnv(task=ARM)
    assert steps(env) == steps(local)
    env.close()
    local.close()
    with pytest.raises(perturb.InvalidArgumentError, match="a server that serves it"):
        perturb.PerturbEnv("Walker2dV5", server=running.address)


def test_example_equals_the_tutorials_arm_and_has_policies() -> None:
    """The example's files equal those in the tutorial, so the tutorial's result tables also hold for the example."""
    example = ROOT / "examples/tasks/my_arm"
    tutorial = (ROOT / "docs/tutorials/your-robot.md").read_text()
    for name in ("arm.xml", "task.toml"):
        assert f"cat > my_arm/{name} <<'END'\n{(example / name).read_text()}END\n" in tutorial
    for version in ("D", "R"):
        policy = perturb.load_policy(example / "policies" / f"on_{version.lower()}")
        assert policy.version == version
        assert perturb.evaluate(policy, task=example, versions=["D"], episodes=40).results[0].success_percent > 60
