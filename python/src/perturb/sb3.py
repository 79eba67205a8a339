"""A batch of environments as stable-baselines3 has them: one round trip a step, and nothing to be wrapped around it.

from stable_baselines3 import PPO
import perturb.sb3

model = PPO("MlpPolicy", perturb.sb3.make_vec_env("CartPole", 16, version="R", seed=1)).learn(100_000)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.vector import AutoresetMode

from .errors import InvalidArgumentError
from .vector import PerturbVectorEnv

try:
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env.base_vec_env import VecEnv
except ImportError as error:
    raise ImportError(
        "perturb.sb3 needs stable-baselines3, which perturb does not bring: pip install stable-baselines3"
    ) from error

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

# What can be asked of each environment by its name.
_METHODS = ("snapshot", "restore", "render")
# What decides how environments are reset, which is stable-baselines3's own.
_FIXED = ("autoreset_mode", "copy")


def make_vec_env(environment: str, num_envs: int = 1, *, seed: int | None = None, **settings: Any) -> PerturbVecEnv:
    """Make N environments of one session, as a stable-baselines3 VecEnv.

    Args:
        environment: a name of docs/environments.md, such as `CartPole`.
        num_envs: N.
        seed: environment i begins with the seed s + i; at first random ones.
        **settings: those of `PerturbVectorEnv`, such as `version`, `parameters`, `contexts` and `server`, but for
            `autoreset_mode` and `copy`.

    Raises:
        InvalidArgumentError: for settings that are wrong or not known.
    """
    for name in _FIXED:
        if name in settings:
            raise InvalidArgumentError(f"{name}= is what stable-baselines3 needs it to be; leave it out")
    settings.setdefault("receipts", False)
    # Arrays of their own: PyTorch warns of such as it must not write to.
    batch = PerturbVectorEnv(environment, num_envs, autoreset_mode=AutoresetMode.SAME_STEP, copy=True, **settings)
    return PerturbVecEnv(batch, seed)


class PerturbVecEnv(VecEnv):  # type: ignore[misc]  # stable-baselines3 is not there for every check
    """N environments of a session. `batch` is the session's PerturbVectorEnv.

    The info of an episode's last step has `terminal_observation` [O], `TimeLimit.truncated` (the step limit ended it,
    and not the task), `episode` with its undiscounted return `r` and its length `l`, as Monitor gives them but for the
    time, and `is_success`, `diverged`, `achieved`; with `receipts=True` also `parameters`, `receipt` and `context_id`.
    Other infos are empty, but for `reward_terms` on request. A reset's are `reset_infos`.
    """

    def __init__(self, batch: PerturbVectorEnv, seed: int | None = None) -> None:
        self.batch = batch
        self._returns = np.zeros(batch.num_envs, np.float64)
        self._lengths = np.zeros(batch.num_envs, np.int64)
        super().__init__(batch.num_envs, batch.single_observation_space, batch.single_action_space)
        if seed is not None:
            self.seed(seed)

    def reset(self) -> NDArray[np.float32]:
        """Begin the next episodes: observations float32 [N, O].

        `seed(s)` before it begins with the seeds s + i. `set_options` before it gives the options of
        `PerturbEnv.reset`, `parameters` and `state`, to each environment: one dictionary for all, or a list of N. If
        those differ, environments are reset one by one after all of them, and without seeds begin the episode after the
        next.
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
        """The first half of a step: the server computes, and nobody waits for it."""
        self.batch.send(actions)

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], list[dict[str, Any]]]:
        """The second: observations float32 [N, O], after an end the first of the next episode; rewards float32 [N]."""
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
        """What all environments have in common, such as `metadata`, for each of those that are asked."""
        spaces = {"observation_space": "single_observation_space", "action_space": "single_action_space"}
        value = getattr(self.batch, spaces.get(attr_name, attr_name))
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Refuse: environments have nothing that can be set but what `set_options` and a reset give them.

        Raises:
            AttributeError: always.
        """
        del value, indices
        raise AttributeError(
            f"{attr_name!r} cannot be set: give parameters to set_options({{'parameters': …}}) and reset()"
        )

    def env_method(
        self, method_name: str, *method_args: Any, indices: int | Iterable[int] | None = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call `snapshot`, `restore` (the same snapshot in each) or `render` of each environment that is asked.

        Raises:
            AttributeError: for another method.
        """
        slots = list(self._get_indices(indices))
        if method_name not in _METHODS or method_kwargs or len(method_args) != (method_name == "restore"):
            raise AttributeError(
                f"{method_name!r} cannot be called so; there are snapshot(), restore(snapshot), render()"
            )
        if method_name == "render":
            pictures = self.batch.render()
            return [pictures[slot] for slot in slots]
        mask = np.zeros(self.num_envs, np.bool_)
        mask[slots] = True
        if method_name == "snapshot":
            saved = dict(zip(np.flatnonzero(mask).tolist(), self.batch.snapshot(mask), strict=True))
            return [saved[slot] for slot in slots]
        rows = self.batch.restore([method_args[0]] * int(mask.sum()), mask)
        self._returns[mask] = 0
        self._lengths[mask] = 0
        return [rows[slot].copy() for slot in slots]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: int | Iterable[int] | None = None) -> list[bool]:
        """True of Monitor, whose `episode` infos have; nothing else is around an environment."""
        return [wrapper_class is Monitor for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """A picture of each environment, with `render_mode="rgb_array"`."""
        return list(self.batch.render())


def _of(infos: dict[str, Any], slot: int) -> dict[str, Any]:
    """One environment's part of a batch's infos."""
    info: dict[str, Any] = {}
    for key, values in infos.items():
        if not key.startswith("_") and infos[f"_{key}"][slot]:
            value = _of(values, slot) if isinstance(values, dict) else values[slot]
            info[key] = value.item() if isinstance(value, np.generic) else value
    return info
