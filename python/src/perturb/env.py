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
        environment: the environment's name in docs/environments.md, such as `CartPole`. With `task`, the name of the
            task or None.
        version: the distribution of the parameters: `D` (the defaults), `R` (random), `E` (extreme), or `R+E`
            (R or E, with probability ½ in each trial).
        server: the server's address, `unix:/path` or `host:port`, or `embedded` for a server in this process. None
            starts a private server.
        task: the folder of a task to serve; see docs/tasks.md. It needs a private or an embedded server.
        parameters: values that replace those of the version, by parameter: a number, an interval `(low, high)`, or
            several intervals `[(low, high), …]`.
        environment_index: the index of the environment. It fixes all randomness, together with the seed. An environment
            with index k + i and seed s + i gives the same bytes as environment i of a batch with the first index k and
            seed s.
        episodes_per_trial: the number of episodes after which parameters are drawn again.
        observe: `state`, or `parameters` to append the episode's parameters to observations. They are scaled so that
            the range of R and E together becomes -1 … 1.
        receipts: whether infos have the keys `parameters`, `receipt` and `context_id`.
        reward_terms: whether the info of each step has the terms of the reward.
        timeout: maximum time to wait for a reply, s.
        render_mode: `rgb_array` to make `render` available, or None.
        width: width of pictures, in pixels.
        height: height of pictures, in pixels.

    The first `reset` connects to the server. The caller may keep and change observations, float32 [O], and pictures.
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
        # Parameters that the next reset sends to the server.
        self._next_parameters: requests.Intervals = {}
        self._is_made = True

    @property
    def spec(self) -> EnvSpec | None:
        """The specification from which `gymnasium.make` made the environment, with the server's step limit."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = requests.with_step_limit(spec, self._description)

    def set_parameters(self, parameters: requests.Parameters) -> None:
        """Change parameters of the physics from the next reset on.

        Args:
            parameters: values by parameter, as in the constructor. Other parameters keep their distribution.

        Raises:
            UnknownNameError: if there is no such parameter. Nothing has changed.
            InvalidArgumentError: if a value is malformed or out of bounds. Nothing has changed.
        """
        self._next_parameters |= requests.parameter_values(parameters, self._description)

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin the next episode.

        Args:
            seed: the seed whose first episode begins. Without it, the next episode of the last seed begins. At the
                first reset the default seed is random.
            options: the key `parameters` changes parameters from now on, as in the constructor. The key `state` sets an
                exact initial state [S] for this episode.

        Raises:
            InvalidArgumentError: if an argument is wrong. Nothing has changed.
            ServerConnectionError: if the server cannot be reached, or the connection broke. The environment is lost; a
                later reset opens another session.
            ServerTimeoutError: if the server did not reply in time. The environment is lost, too.
            ServerStartError: if the private server did not start.
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
        """Advance by one step. The environment clips continuous actions to the range of its action space.

        Raises:
            InvalidArgumentError: if the action is wrong. The environment has not moved.
            OutOfOrderError: before the first reset, and after the end of an episode.
            ServerConnectionError: if the connection broke. The environment is lost.
            ServerTimeoutError: if the server did not reply in time. The environment is lost.
        """
        client = self._client
        return (client._session or client.session).step_single(action, self._encode)

    def snapshot(self) -> bytes:
        """Save the whole environment: physics, parameters, counters and random streams."""
        return self._client.snapshot(None)[0]

    def restore(self, snapshot: bytes) -> NDArray[np.float32]:
        """Restore a snapshot, which may be from another process. Return the observation at which it was saved.

        From then on, the same actions give the same bytes as after the snapshot was saved.
        """
        self._client.open([], self.np_random)
        observation: NDArray[np.float32] = self._client.restore([snapshot], None)[0]
        return observation

    def render(self) -> NDArray[np.uint8]:
        """Draw the present state as an RGB picture, uint8 [height, width, 3]. The environment does not change.

        Raises:
            OutOfOrderError: before the first reset, or without `render_mode="rgb_array"`.
            RenderError: if the server cannot draw. The message has the reason.
            ServerConnectionError: if the connection broke. The environment is lost.
            ServerTimeoutError: if the server did not reply in time. The environment is lost.
        """
        return self._client.render(0)

    def close(self) -> None:
        """Free the environment on the server."""
        self._client.close()


# Names of the settings of single environments.
SETTINGS = requests.settings(PerturbEnv.__init__)
