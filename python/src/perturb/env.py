"""A single environment, as `gymnasium.Env`."""

from __future__ import annotations

import os
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from . import requests
from .attributes import CheckedAttributes
from .catalogue import DEFAULT_PIXELS
from .client import TIMEOUT, Client, ResetRequest

if TYPE_CHECKING:
    from collections.abc import Mapping

    from gymnasium import spaces
    from gymnasium.envs.registration import EnvSpec

OPTIONS = ("parameters", "state")


class PerturbEnv(CheckedAttributes, gymnasium.Env[NDArray[np.float32], Any]):
    """A single environment of a perturb-server.

    Args:
        environment: a name of docs/environments.md, such as `CartPole`; with `task` its name, or None.
        version: where parameters come from: `D` their defaults, `R` random, `E` extreme, `R+E` one of
            both, each in half of the trials.
        server: `unix:/path`, `host:port`, or `embedded` for one in this process; None starts a private server.
        task: the folder of a task, which the server of this process's own then serves; see docs/tasks.md. The
            environment is that of the folder.
        parameters: replaces the version's set of the named parameters: a value, an interval `(low, high)`, or several
            `[(low, high), …]`.
        environment_index: fixes all randomness, together with the seed. Environment i of a vector with the same
            first index and seed gives the same bytes as this one with the index and the seed i higher.
        episodes_per_trial: parameters are drawn anew after so many episodes.
        observe: `state`, or `parameters` for observations that have the episode's parameters at their end, scaled to
            -1 … 1 over the range of R and E.
        receipts: whether infos have parameters and receipt.
        reward_terms: whether every step's info has the terms of the reward.
        timeout: how long a reply may take, s.
        render_mode: `rgb_array` lets `render` draw; None.
        width: width of pictures, in pixels.
        height: height of pictures, in pixels.

    The connection is made by the first `reset`. Observations, float32 [O], and pictures are the caller's own to
    keep and to change.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012  (each environment adds its render_fps)
    action_space: spaces.Discrete | spaces.Box
    _spec: EnvSpec | None = None

    def __init__(
        self,
        environment: str | None = None,
        *,
        version: requests.Version = "D",
        server: str | None = None,
        task: str | os.PathLike[str] | None = None,
        parameters: requests.Parameters | None = None,
        environment_index: int = 0,
        episodes_per_trial: int = 1,
        observe: str = "state",
        receipts: bool = True,
        reward_terms: bool = False,
        timeout: float = TIMEOUT,
        render_mode: str | None = None,
        width: int = DEFAULT_PIXELS,
        height: int = DEFAULT_PIXELS,
        **unknown: Any,
    ) -> None:
        requests.no_unknown(unknown, SETTINGS)
        self._client = Client(
            environment=environment,
            version=version,
            num_envs=1,
            server=server,
            task=task,
            parameters=parameters,
            first_environment_index=environment_index,
            episodes_per_trial=episodes_per_trial,
            autoreset_mode=AutoresetMode.DISABLED,
            observe=observe,
            receipts=receipts,
            reward_terms=reward_terms,
            timeout=timeout,
            render_mode=render_mode,
            width=width,
            height=height,
            single=True,
        )
        self.render_mode = render_mode
        self.metadata = self._client.description.metadata()
        self.observation_space = cast("spaces.Space[NDArray[np.float32]]", self._client.description.observation_space())
        self.action_space = self._client.description.action_space()
        self._encode = partial(
            requests.actions, description=self._client.description, shape=self.action_space.shape or ()
        )
        self._description = self._client.description
        # The parameters that act at the next reset.
        self._next_parameters: requests.Intervals = {}
        self._is_made = True

    @property
    def spec(self) -> EnvSpec | None:
        """The specification from which Gymnasium made the environment, with the server's step limit."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = requests.with_step_limit(spec, self._description)

    def set_parameters(self, parameters: requests.Parameters) -> None:
        """Change the physics from the next reset on.

        Args:
            parameters: as at `make`. Other parameters stay as they are.

        Raises:
            UnknownNameError, InvalidArgumentError: for wrong names and values; nothing has changed.
        """
        self._next_parameters |= requests.parameter_values(parameters, self._description)

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin the next episode.

        Args:
            seed: begins the seed's first episode; without it, the next episode of the last seed (at the first reset a
                random seed).
            options: `parameters`, as at `make`, from now on; `state`, an exact initial state [S] for this episode.

        Raises:
            InvalidArgumentError: and nothing has changed.
            ServerConnectionError, ServerTimeoutError, ServerStartError: and the environment is gone; a later reset
                opens another session.
        """
        seeds = [] if seed is None else [requests.seed(seed)]
        given = requests.options(options, OPTIONS)
        parameters = self._next_parameters | requests.distributions(given.get("parameters"))
        state = given.get("state")
        states = b"" if state is None else requests.states(state, 1, batched=False)
        super().reset(seed=seeds[0] if seeds else None)

        opened = self._client.open(seeds, self.np_random)
        if opened is None or seeds or parameters or states:
            observations, (events,) = self._client.reset([ResetRequest(None, seeds, parameters, states)])
        else:
            observations, events = opened.observations, opened.events
        self._next_parameters = {}
        return observations[0], events.single()

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Advance by one step. Actions beyond the range of a Box are clipped by the environment.

        Raises:
            InvalidArgumentError: and the environment has not moved.
            OutOfOrderError: before the first reset, and after the end of an episode.
            ServerConnectionError, ServerTimeoutError: and the environment is gone.
        """
        client = self._client
        return (client._session or client.session).step_single(action, self._encode)

    def snapshot(self) -> bytes:
        """Save the environment whole: physics, parameters, counters, random streams."""
        return self._client.snapshot(None)[0]

    def restore(self, snapshot: bytes) -> NDArray[np.float32]:
        """Bring a saved environment back, also one of another process; returns the observation at which it was saved.

        What follows is what followed the snapshot, byte for byte.
        """
        self._client.open([], self.np_random)
        observation: NDArray[np.float32] = self._client.restore([snapshot], None)[0]
        return observation

    def render(self) -> NDArray[np.uint8]:
        """Draw the environment as it is now: red, green and blue, uint8 [height, width, 3]. Changes nothing.

        Raises:
            OutOfOrderError: before the first reset, or without `render_mode="rgb_array"`.
            RenderError: if the server cannot draw; it says what is missing.
            ServerConnectionError, ServerTimeoutError: and the environment is gone.
        """
        return self._client.render(0)

    def close(self) -> None:
        """Free the environment on the server."""
        self._client.close()


# Names of the settings of single environments.
SETTINGS = requests.settings(PerturbEnv.__init__)
