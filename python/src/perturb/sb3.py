"""A batch of environments as a stable-baselines3 VecEnv, with one round trip to the server for each step.

from stable_baselines3 import PPO
import perturb.sb3

model = PPO("MlpPolicy", perturb.sb3.make_vec_env("CartPole", 16, version="R", seed=1)).learn(100_000)
"""

from __future__ import annotations

import operator
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.vector import AutoresetMode

from .attributes import CheckedAttributes, refuse_assignment
from .errors import InvalidArgumentError
from .vector import PerturbVectorEnv

try:
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env.base_vec_env import VecEnv
except ImportError as error:
    raise ImportError(
        "perturb.sb3 needs stable-baselines3, which perturb does not install: pip install stable-baselines3"
    ) from error

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from .requests import Parameters

# Methods that `env_method` accepts, with their number of arguments.
_METHODS = {"snapshot": 0, "restore": 1, "render": 0, "set_parameters": 1}
# Settings of PerturbVectorEnv that `make_vec_env` does not accept.
_FIXED = ("autoreset_mode", "copy")


def make_vec_env(
    environment: str | None = None, num_envs: int = 1, *, seed: int | None = None, **settings: Any
) -> PerturbVecEnv:
    """Make a stable-baselines3 VecEnv of N environments in one session.

    Args:
        environment: the environment's name in docs/environments.md, such as `CartPole`. With `task`, the name of the
            task or None.
        num_envs: the number N of environments.
        seed: a seed s; environment i begins with the seed s + i. By default seeds are random.
        **settings: settings of `PerturbVectorEnv`, such as `version`, `parameters`, `contexts`, `server` and `task`,
            except `autoreset_mode` and `copy`. The default of `receipts` is False here.

    Raises:
        InvalidArgumentError: if a setting is wrong or unknown.
    """
    for name in _FIXED:
        if name in settings:
            raise InvalidArgumentError(
                f"{name}= cannot be set here, because stable-baselines3 needs one value; leave it out"
            )
    settings.setdefault("receipts", False)
    batch = PerturbVectorEnv(environment, num_envs, autoreset_mode=AutoresetMode.SAME_STEP, **settings)
    return PerturbVecEnv(batch, seed)


class PerturbVecEnv(CheckedAttributes, VecEnv):  # type: ignore[misc]  # type checks may run without stable-baselines3
    """N environments of one session as a stable-baselines3 VecEnv. `batch` is the session's PerturbVectorEnv.

    The info of an episode's last step has these keys:

    - `terminal_observation` [O];
    - `TimeLimit.truncated`: whether only the step limit ended the episode;
    - `episode`: the undiscounted return `r` and the length `l` in steps, as from Monitor, but without the time `t`;
    - `is_success`, `diverged` and `achieved`;
    - `parameters`, `receipt` and `context_id`, with `receipts=True`.

    The infos of all other steps are empty. With `reward_terms=True`, the infos of all steps also have `reward_terms`.
    The attribute `reset_infos` has the infos of the last reset.

    Call `env_method("set_parameters", {"length": 0.7})` to change the physics from each environment's next episode on.
    """

    def __init__(self, batch: PerturbVectorEnv, seed: int | None = None) -> None:
        self.batch = batch
        self._returns = np.zeros(batch.num_envs, np.float64)
        self._lengths = np.zeros(batch.num_envs, np.int64)
        super().__init__(batch.num_envs, batch.single_observation_space, batch.single_action_space)
        self.metadata = dict(batch.metadata)  # VecVideoRecorder reads render_fps from it
        self._description = batch._description
        self._is_made = True
        if seed is not None:
            self.seed(seed)

    def reset(self) -> NDArray[np.float32]:
        """Begin the next episodes. Return observations float32 [N, O].

        stable-baselines3 calls `reset` once, when a training begins. To change the physics later, call
        `env_method("set_parameters", …)`. Call `seed(s)` before `reset` to begin with the seeds s + i. Call
        `set_options` before `reset` to pass the options `parameters` and `state` of `PerturbEnv.reset`, as one
        dictionary for all environments or as a list of N dictionaries.

        If the options of the environments differ, all environments are first reset together. Each environment with
        options is then reset again. If `seed` was not called, these environments thus skip one episode.
        """
        seeds = None if all(seed is None for seed in self._seeds) else self._seeds
        first, *others = self._options
        alike = {**first, "state": [first["state"]] * self.num_envs} if "state" in first else first
        together = all(options is first or not (options or first) for options in others)
        observations, infos = self.batch.reset(seed=seeds, options=alike if together else None)
        self.reset_infos = [_of(infos, slot) for slot in range(self.num_envs)]
        for slot, options in enumerate([] if together else self._options):
            if options:
                observations = self._reset_one(slot, options)
        self._returns[:] = 0
        self._lengths[:] = 0
        self._reset_seeds()
        self._reset_options()
        return observations

    def _reset_one(self, slot: int, options: dict[str, Any]) -> NDArray[np.float32]:
        mask = np.zeros(self.num_envs, np.bool_)
        mask[slot] = True
        batched = {**options, "reset_mask": mask}
        if "state" in batched:
            batched["state"] = [batched["state"]]
        seeds = None if self._seeds[slot] is None else [seed or 0 for seed in self._seeds]
        observations, infos = self.batch.reset(seed=seeds, options=batched)
        self.reset_infos[slot] = _of(infos, slot)
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Send the actions of a step without waiting for the reply."""
        self.batch.send(actions)

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], list[dict[str, Any]]]:
        """Receive the outcome of a step: observations float32 [N, O], rewards float32 [N], dones bool [N], and infos.

        If an episode ended, the environment's observation is the first one of the next episode.
        """
        observations, rewards, terminated, truncated, batched = self.batch.recv()
        dones = terminated | truncated
        self._returns += rewards
        self._lengths += 1
        ongoing: dict[str, Any] = {key: batched[key] for key in ("reward_terms", "_reward_terms") if key in batched}
        infos = [_of(ongoing, slot) for slot in range(self.num_envs)] if ongoing else [{} for _ in range(self.num_envs)]
        for slot in np.flatnonzero(dones).tolist():
            info = _of(batched["final_info"], slot)
            info["terminal_observation"] = batched["final_obs"][slot]
            info["TimeLimit.truncated"] = bool(truncated[slot] and not terminated[slot])
            info["episode"] = {"r": float(self._returns[slot]), "l": int(self._lengths[slot])}
            infos[slot] = info
        self._returns[dones] = 0
        self._lengths[dones] = 0
        return observations, rewards, dones, infos

    def close(self) -> None:
        """Free the environments on the server."""
        self.batch.close()

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Return an attribute of the batch, such as `metadata`, once for each selected environment."""
        spaces = {"observation_space": "single_observation_space", "action_space": "single_action_space"}
        value = getattr(self.batch, spaces.get(attr_name, attr_name))
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Raise an error, because no attribute of the environments can be assigned.

        Raises:
            AssignmentError: always. The message names the calls that change parameters.
        """
        del value, indices
        raise refuse_assignment(attr_name, self._description)

    def env_method(
        self, method_name: str, *method_args: Any, indices: int | Iterable[int] | None = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of each selected environment, and return the list of results.

        The methods are `snapshot()`, `restore(snapshot)`, `render()` and `set_parameters(parameters)`. `restore`
        restores the same snapshot in each selected environment. `set_parameters` takes effect in each environment's
        next episode.

        Raises:
            AttributeError: for any other method or number of arguments.
        """
        slots = list(self._get_indices(indices))  # in the caller's order, which may repeat a slot
        if method_name not in _METHODS or method_kwargs or len(method_args) != _METHODS[method_name]:
            raise AttributeError(
                f"{method_name!r} cannot be called like this; there are snapshot(), restore(snapshot), render(), "
                "set_parameters(parameters)"
            )
        if method_name == "render":
            pictures = self.batch.render()
            return [pictures[slot] for slot in slots]
        mask = np.zeros(self.num_envs, np.bool_)
        mask[slots] = True
        if method_name == "set_parameters":
            self.batch.set_parameters(method_args[0], mask)
            return [None for _ in slots]
        if method_name == "snapshot":
            saved = dict(zip(np.flatnonzero(mask).tolist(), self.batch.snapshot(mask), strict=True))
            return [saved[slot] for slot in slots]
        rows = self.batch.restore([method_args[0]] * int(mask.sum()), mask)
        self._returns[mask] = 0
        self._lengths[mask] = 0
        return [rows[slot].copy() for slot in slots]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: int | Iterable[int] | None = None) -> list[bool]:
        """Return True for Monitor, because infos have Monitor's key `episode`, and False for all other wrappers."""
        return [wrapper_class is Monitor for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return an RGB picture of each environment. Needs `render_mode="rgb_array"`."""
        return list(self.batch.render())


class CurriculumCallback(BaseCallback):  # type: ignore[misc]  # type checks may run without stable-baselines3
    """A stable-baselines3 callback that changes the physics on a schedule while a model learns.

        schedule = {0: {"length": "0.4..0.6"}, 50_000: {"length": "0.2..0.8"}}
        model.learn(100_000, callback=perturb.sb3.CurriculumCallback(schedule))

    The schedule is read at the start of a training and of each rollout. A change takes effect in each environment's
    next episode.

    Args:
        schedule: a mapping from numbers of steps, counted over all environments together, to the parameters that apply
            from that number on. Instead, it may be a function that gets the number of steps, and returns parameters or
            None for no change.
        verbose: 1 prints each change of parameters.
    """

    def __init__(
        self, schedule: Mapping[int, Parameters] | Callable[[int], Parameters | None], verbose: int = 0
    ) -> None:
        super().__init__(verbose)
        if not callable(schedule) and min((operator.index(start) for start in schedule), default=0) < 0:
            raise InvalidArgumentError(
                f"schedule has the keys {list(schedule)}; expected numbers of steps from 0 on, such as 50_000"
            )
        self._schedule = schedule
        self._current: Parameters | None = None

    def _on_training_start(self) -> None:
        self._current = None  # an earlier training may have had other environments
        self._update()

    def _on_rollout_start(self) -> None:
        self._update()

    def _on_step(self) -> bool:
        return True

    def _update(self) -> None:
        """Set the schedule's parameters for the present number of steps, if they changed."""
        if callable(self._schedule):
            parameters = self._schedule(self.num_timesteps)
        else:
            started = [start for start in self._schedule if start <= self.num_timesteps]
            parameters = self._schedule[max(started)] if started else None
        if parameters is None or parameters == self._current:
            return
        self.training_env.env_method("set_parameters", parameters)
        self._current = parameters
        if self.verbose:
            print(f"{self.num_timesteps} steps: parameters become {parameters}")


def _of(infos: dict[str, Any], slot: int) -> dict[str, Any]:
    """Return the info of one environment, taken from a batch's infos."""
    info: dict[str, Any] = {}
    for key, values in infos.items():
        if not key.startswith("_") and infos[f"_{key}"][slot]:
            value = _of(values, slot) if isinstance(values, dict) else values[slot]
            info[key] = value.item() if isinstance(value, np.generic) else value
    return info
