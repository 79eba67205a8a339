"""Disturbances, such as delayed observations. An environment has disturbances only if its settings name one."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import DelayObservation, StickyAction
from numpy.typing import NDArray

import perturb
from perturb.catalogue import CATALOGUE


def observations(steps: int, **settings: Any) -> NDArray[np.float32]:
    environment = gym.make("perturb/Pendulum-v1", disable_env_checker=True, **settings)
    first, _ = environment.reset(seed=5)
    rows = [first]
    for step in range(steps):
        rows.append(environment.step(np.array([np.sin(step)], dtype=np.float32))[0])
    environment.close()
    return np.stack(rows)


def test_sensor_delay_returns_the_observations_of_earlier_steps(server: str) -> None:
    exact = observations(20, server=server)
    late = observations(20, server=server, parameters={"sensor_delay": 3})
    np.testing.assert_array_equal(late[3:], exact[:-3])
    np.testing.assert_array_equal(late[:3], np.repeat(exact[:1], 3, axis=0))


def test_sensor_delay_agrees_with_gymnasiums_wrapper(server: str) -> None:
    wrapped = DelayObservation(gym.make("perturb/Pendulum-v1", server=server, disable_env_checker=True), delay=4)
    first, _ = wrapped.reset(seed=5)
    rows = [first] + [wrapped.step(np.array([np.sin(step)], dtype=np.float32))[0] for step in range(30)]
    wrapped.close()
    own = observations(30, server=server, parameters={"sensor_delay": 4})
    # Leave out the first four steps, in which Gymnasium's wrapper returns zeros.
    np.testing.assert_array_equal(np.stack(rows)[4:], own[4:])


class StickyActionOfPerturb(StickyAction[np.ndarray, np.ndarray]):
    """Gymnasium's `StickyAction`, but with perturb's random numbers for `action_hold` (docs/disturbances.md)."""

    def __init__(self, environment: gym.Env[np.ndarray, np.ndarray], probability: float, seed: int) -> None:
        super().__init__(environment, probability)
        self._generator = ActionHoldGenerator(seed)

    @property  # type: ignore[misc]
    def np_random(self) -> "ActionHoldGenerator":  # type: ignore[override]
        """The generator of the wrapper's random numbers."""
        return self._generator


class ActionHoldGenerator:
    """A generator that returns the random numbers of `action_hold` in episode 0 of environment 0, from step 1 on."""

    def __init__(self, seed: int) -> None:
        self._key, self._step = np.array([seed, 0], dtype=np.uint64), 0

    def uniform(self) -> float:
        """Return the random number of the next step."""
        self._step += 1
        counter = np.array([0, 0, 2, self._step], dtype=np.uint64)
        return float(np.random.Generator(np.random.Philox(key=self._key, counter=counter)).random())

    def integers(self, low: int, _high: int) -> int:
        """Return `low`, the minimum number of repetitions, instead of a random number."""
        return low


@pytest.mark.parametrize("identifier", ["perturb/Pendulum-v1", "perturb/Acrobot-v1"])
def test_action_hold_agrees_with_gymnasiums_sticky_actions(server: str, identifier: str) -> None:
    def play(environment: gym.Env[np.ndarray, Any]) -> list[NDArray[np.float32]]:
        rows = [environment.reset(seed=7)[0]]
        actions = np.random.default_rng(3)
        for _ in range(150):
            drawn = actions.uniform(-2, 2)
            action = int(drawn + 2) % 3 if "Acrobot" in identifier else np.array([drawn], dtype=np.float32)
            rows.append(environment.step(action)[0])
        environment.close()
        return rows

    plain = gym.make(identifier, server=server, disable_env_checker=True)
    held = gym.make(identifier, server=server, disable_env_checker=True, parameters={"action_hold": 0.4})
    np.testing.assert_array_equal(play(StickyActionOfPerturb(plain, 0.4, 7)), play(held))


def test_numpy_computes_the_same_sensor_noise(server: str) -> None:
    exact = observations(20, server=server)
    noisy = observations(20, server=server, parameters={"sensor_noise": 0.01})
    ends = np.array([[-1, -1, -8], [1, 1, 8]], dtype=np.float32)
    for step, (row, seen) in enumerate(zip(exact.astype(np.float64), noisy, strict=True)):
        key = np.array([5, 0], dtype=np.uint64)
        counter = np.array([0, 0, 4, step], dtype=np.uint64)
        normal = np.random.Generator(np.random.Philox(key=key, counter=counter)).standard_normal(3)
        expected = np.clip(row + 0.01 * np.array([1, 1, 8]) * normal, *ends)
        np.testing.assert_allclose(seen, expected, rtol=0, atol=1e-6)  # float32 rounding of numbers up to 8


def test_physics_change_within_an_episode(server: str) -> None:
    before = observations(30, server=server)
    after = observations(30, server=server, parameters={"change_at": 10, "changed_length": 1.2})
    np.testing.assert_array_equal(after[:11], before[:11])
    assert (after[11:] != before[11:]).any(axis=1).all()


def test_infos_and_observations_contain_disturbances(server: str) -> None:
    contexts = [{"action_delay": 2}, {"length": 1.2}]
    environment = gym.make_vec(
        "perturb/Pendulum-v1", num_envs=2, server=server, contexts=contexts, observe="parameters"
    )
    observed, infos = environment.reset(seed=1)
    description = CATALOGUE["Pendulum"]
    assert observed.shape == (2, 3 + len(description.parameters) + len(description.disturbances))
    assert observed[:, 5].tolist() == [2, 0]
    assert infos["parameters"]["action_delay"].tolist() == [2, 0]
    environment.close()


def test_adding_disturbances_to_an_environment_is_refused(server: str) -> None:
    environment: Any = gym.make("perturb/Pendulum-v1", server=server).unwrapped
    with pytest.raises(perturb.InvalidArgumentError, match="where it is made"):
        environment.set_parameters({"action_delay": 1})
    environment.close()


def test_records_of_several_sets_have_the_same_columns(server: str) -> None:
    def still(seen: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.zeros((len(seen), 1), dtype=np.float32)

    tested = perturb.evaluate(
        still, "Pendulum", versions=["D", "R"], parameters={"sensor_noise": (0, 0.1)}, episodes=4, server=server
    )
    columns = tested.columns()
    assert set(columns["set"]) == {"D", "R", "parameters"}
    noise = np.asarray(columns["requested_sensor_noise"])
    drawn = np.asarray(columns["set"]) == "parameters"
    assert (noise[drawn] > 0).all()
    assert (noise[~drawn] == 0).all()
    assert tested.audit(still, server=server).different == ()
