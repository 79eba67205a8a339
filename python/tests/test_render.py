"""Pictures show the state of an environment, drawing does not change it, and Gymnasium's wrappers accept pictures."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import AddRenderObservation, RenderCollection
from numpy.typing import NDArray

import perturb
from perturb.catalogue import CATALOGUE

from .conftest import identifier

if TYPE_CHECKING:
    from collections.abc import Callable

NAMES = list(CATALOGUE)
SMALL: dict[str, Any] = {"render_mode": "rgb_array", "width": 64, "height": 48}

Picture = NDArray[np.uint8]


def make(name: str, server: str, **settings: Any) -> perturb.PerturbEnv:
    return perturb.PerturbEnv(name, server=server, **{**SMALL, **settings})


def differ(a: Picture, b: Picture) -> bool:
    return bool((a != b).any())


@pytest.mark.parametrize("name", NAMES)
def test_gymnasiums_checker_accepts_all_pictures(name: str, server: str) -> None:
    env = gymnasium.make(identifier(name), version="E", server=server, **SMALL)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env.unwrapped)
    # Other warnings are ignored, such as that about CartPole's unbounded observations.
    assert not [warning for warning in caught if "render" in str(warning.message).lower()]
    env.close()


@pytest.mark.parametrize("name", NAMES)
def test_a_picture_depends_only_on_the_state(name: str, server: str) -> None:
    env, twin = make(name, server), make(name, server)
    for one in (env, twin):
        one.reset(seed=1)
    first = env.render()
    assert first.shape == (48, 64, 3)
    assert first.dtype == np.uint8
    assert len(np.unique(first.reshape(-1, 3), axis=0)) >= 3, "a drawing has colours"
    assert not differ(env.render(), first)
    assert not differ(twin.render(), first)
    env.action_space.seed(1)
    for _ in range(8):
        action = env.action_space.sample()
        env.step(action)
        twin.step(action)
    assert differ(env.render(), first)
    assert not differ(env.render(), twin.render())


@pytest.mark.parametrize("name", ["CartPole", "Hopper"])
def test_drawing_changes_nothing(name: str, server: str) -> None:
    drawn, plain = make(name, server), make(name, server)
    drawn.action_space.seed(1)
    drawn.reset(seed=1)
    plain.reset(seed=1)
    for _ in range(5):
        drawn.render()
        assert drawn.snapshot() == plain.snapshot()
        action = drawn.action_space.sample()
        assert drawn.step(action)[0].tobytes() == plain.step(action)[0].tobytes()


def test_pictures_show_parameters(server: str) -> None:
    def picture(length: float) -> Picture:
        env = make("CartPole", server, parameters={"length": length})
        env.reset(seed=1, options={"state": [0, 0, 0.1, 0]})
        return env.render()

    assert differ(picture(0.3), picture(0.7))
    assert not differ(picture(0.3), picture(0.3))


def test_the_end_of_an_episode_can_be_drawn(server: str) -> None:
    env = make("CartPole", server)
    env.reset(seed=1)
    start = env.render()
    while not env.step(1)[2]:
        before = env.render()
    end = env.render()
    assert differ(end, before)
    assert differ(end, start)


def test_pictures_have_the_requested_size(server: str) -> None:
    env = perturb.PerturbEnv("Pendulum", server=server, render_mode="rgb_array")
    env.reset(seed=1)
    assert env.render().shape == (480, 480, 3)
    for width, height in [(16, 16), (33, 77), (2048, 17)]:
        env = make("Pendulum", server, width=width, height=height)
        env.reset(seed=1)
        assert env.render().shape == (height, width, 3)


def test_the_frame_rate_is_that_of_the_simulation(server: str) -> None:
    """The frame rate is the inverse of the control timestep, which docs/environments.md lists for each environment."""
    frames = {"CartPole": 50, "MountainCar": 1, "Acrobot": 5, "Pendulum": 20, "HalfCheetah": 60.6, "Hopper": 60.6}
    for name, expected in frames.items():
        metadata = gymnasium.make(identifier(name), server=server, **SMALL).metadata
        assert metadata["render_modes"] == ["rgb_array"]
        assert metadata["render_fps"] == pytest.approx(expected, abs=0.01)  # 60.606… for the robots
    envs = gymnasium.make_vec("perturb/CartPole-v1", num_envs=2, server=server, **SMALL)
    assert envs.metadata["render_fps"] == 50
    assert envs.render_mode == "rgb_array"


def test_pictures_of_single_environments_are_the_callers_own(server: str) -> None:
    env = make("CartPole", server)
    env.reset(seed=1)
    picture, again = env.render(), env.render()
    picture[:] = 0
    assert again.any()


@pytest.mark.parametrize("copy", [False, True])
def test_a_batch_gives_one_picture_of_each_environment(copy: bool, server: str) -> None:
    envs = perturb.PerturbVectorEnv("CartPole", 3, version="E", server=server, copy=copy, **SMALL)
    envs.reset(seed=10)
    for _ in range(4):
        envs.step(np.ones(3, dtype=np.int64))
    pictures = envs.render()
    assert isinstance(pictures, tuple)
    assert len(pictures) == 3
    for i, picture in enumerate(pictures):
        single = make("CartPole", server, version="E", environment_index=i)
        single.reset(seed=10 + i)
        for _ in range(4):
            single.step(1)
        assert not differ(picture, single.render())
        assert picture.flags.writeable
    assert differ(pictures[0], pictures[1])
    assert differ(pictures[1], pictures[2])


def test_gymnasiums_wrappers_accept_pictures(server: str) -> None:
    collected = gymnasium.make("perturb/CartPole-v1", server=server, **{**SMALL, "render_mode": "rgb_array_list"})
    collected.reset(seed=1)
    for _ in range(3):
        collected.step(0)
    frames: Any = collected.render()
    assert [frame.shape for frame in frames] == [(48, 64, 3)] * 4
    assert differ(frames[0], frames[3])

    base = gymnasium.make("perturb/Pendulum-v1", server=server, **SMALL)
    assert isinstance(RenderCollection(base).reset(seed=1)[0], np.ndarray)
    seen: Any = AddRenderObservation(base, render_only=True)
    observation, _ = seen.reset(seed=1)
    assert seen.observation_space.contains(observation)
    assert observation.shape == (48, 64, 3)


def test_drawing_out_of_order_is_refused(server: str) -> None:
    env = make("CartPole", server)
    with pytest.raises(perturb.OutOfOrderError, match=r"reset\(\) first"):
        env.render()
    envs = perturb.PerturbVectorEnv("CartPole", 2, server=server)
    envs.reset(seed=1)
    with pytest.raises(perturb.OutOfOrderError, match="render_mode='rgb_array'"):
        envs.render()
    env.reset(seed=1)
    env.close()
    with pytest.raises(perturb.OutOfOrderError, match="closed"):
        env.render()


def test_without_opengl_only_classic_tasks_are_drawn(
    start_server: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nowhere.json")  # the server finds no OpenGL driver
    address = start_server().address
    robot = make("Hopper", address)
    robot.reset(seed=1)
    with pytest.raises(perturb.RenderError, match="cannot draw Hopper"):
        robot.render()
    robot.step(robot.action_space.sample())
    classic = make("CartPole", address)
    classic.reset(seed=1)
    assert classic.render().any()


def test_human_mode_is_refused_with_a_hint_at_gymnasiums_wrapper(server: str) -> None:
    with pytest.raises(perturb.InvalidArgumentError, match="HumanRendering"):
        perturb.PerturbVectorEnv("CartPole", 2, server=server, render_mode="human")


def test_a_killed_server_is_reported_by_render(start_server: Callable[..., Any]) -> None:
    running = start_server()
    env = make("CartPole", running.address)
    env.reset(seed=1)
    env.render()
    running.process.kill()
    running.process.wait()
    with pytest.raises(perturb.ServerConnectionError, match=r"lost the server at .* during render"):
        env.render()
