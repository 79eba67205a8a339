"""A batch of environments, as `gymnasium.vector.VectorEnv`. A step of the batch takes one round trip to the server."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from . import requests
from .attributes import CheckedAttributes
from .catalogue import DEFAULT_PIXELS
from .client import TIMEOUT, Client, ResetRequest
from .infos import merge
from .sets import Set, contexts_of

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec

    from ._native import Stepped

OPTIONS = ("parameters", "state", "reset_mask")
# The constructor of a batch with more environments first asks the server whether it accepts so many. It allocates large
# arrays only afterwards.
CHECKED_ENVIRONMENTS = 100_000


class PerturbVectorEnv(CheckedAttributes, VectorEnv[NDArray[np.float32], Any, NDArray[Any]]):
    """A batch of N environments of a perturb-server.

    Args:
        environment: the environment's name in docs/environments.md, such as `CartPole`. With `task`, the name of the
            task or None.
        num_envs: the number N of environments.
        version: the distribution of the parameters: `D` (the defaults), `R` (random), `E` (extreme), or `R+E`
            (R or E, with probability ½ in each trial).
        server: the server's address, `unix:/path` or `host:port`, or `embedded` for a server in this process. None
            starts a private server.
        task: the folder of a task to serve; see docs/tasks.md. It needs a private or an embedded server.
        parameters: values that replace those of the version, by parameter: a number, an interval `(low, high)`, or
            several intervals `[(low, high), …]`.
        autoreset_mode: Gymnasium's AutoresetMode, which decides what happens to environments whose episode has ended.
        first_environment_index: the index k of the first environment; environment i has index k + i. To split a batch
            into parts that give the same bytes, pass the index and the seed of each part's first environment.
        episodes_per_trial: the number of episodes after which parameters are drawn again.
        observe: `state`, or `parameters` to append the episode's parameters to observations. They are scaled so that
            the range of R and E together becomes -1 … 1.
        receipts: whether infos have the keys `parameters`, `receipt` and `context_id`.
        reward_terms: whether the infos of each step have the terms of the reward.
        copy: has no effect. It exists because Gymnasium's own vector environments have it. Callers may always keep and
            change observations and pictures.
        timeout: maximum time to wait for a reply, s.
        render_mode: `rgb_array` to make `render` available, or None.
        width: width of pictures, in pixels.
        height: height of pictures, in pixels.
        contexts: a list of C contexts, at most N, or a grid or list of `perturb.sets`. A context is a mapping from
            names of parameters to values. Environment i has context i modulo C in all episodes. Other parameters come
            from the version and `parameters`. Parameters of a reset replace those of contexts.
        max_episode_steps: must be None or the server's step limit. `gymnasium.make_vec` passes it.

    The first `reset` connects to the server. Rewards are float32 [N]; terminated and truncated flags are bool [N].
    """

    _spec: EnvSpec | None = None

    def __init__(
        self,
        environment: str | None = None,
        num_envs: int = 1,
        *,
        version: requests.Version = "D",
        server: str | None = None,
        task: str | os.PathLike[str] | None = None,
        parameters: requests.Parameters | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        first_environment_index: int = 0,
        episodes_per_trial: int = 1,
        observe: str = "state",
        receipts: bool = True,
        reward_terms: bool = False,
        copy: bool = False,  # noqa: ARG002  (Gymnasium's own have it)
        timeout: float = TIMEOUT,
        render_mode: str | None = None,
        width: int = DEFAULT_PIXELS,
        height: int = DEFAULT_PIXELS,
        contexts: Sequence[Mapping[str, float]] | Set | None = None,
        max_episode_steps: int | None = None,
        **unknown: Any,
    ) -> None:
        requests.no_unknown(unknown, SETTINGS)
        if isinstance(contexts, Set):
            contexts = contexts_of(contexts, version, parameters)
        self._mode = requests.autoreset_mode(autoreset_mode)
        self._client = Client(
            environment=environment,
            version=version,
            num_envs=num_envs,
            server=server,
            task=task,
            parameters=parameters,
            first_environment_index=first_environment_index,
            episodes_per_trial=episodes_per_trial,
            autoreset_mode=self._mode,
            observe=observe,
            receipts=receipts,
            reward_terms=reward_terms,
            timeout=timeout,
            render_mode=render_mode,
            width=width,
            height=height,
            single=False,
            contexts=contexts,
        )
        self.render_mode = render_mode
        self._description = description = self._client.description
        requests.step_limit(max_episode_steps, description)
        if self._client.num_envs > CHECKED_ENVIRONMENTS:
            self._client.check_size()
        self.num_envs = self._client.num_envs
        self.metadata = {**description.metadata(), "autoreset_mode": self._mode}
        self.single_observation_space = description.observation_space()
        self.single_action_space = description.action_space()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._encode = partial(requests.actions, description=description, shape=self.action_space.shape or ())
        self._reward_terms = reward_terms
        # The parameters that `set_parameters` set for an environment's next episode, by slot.
        self._next_parameters: dict[int, requests.Intervals] = {}
        # In next-step mode, the mask of environments whose next step is an autoreset, which has no reward and no reward
        # terms. Steps update the mask only if `_keeps_resetting` is true: with reward terms, or after a call of
        # `set_parameters`. Otherwise the mask is not needed.
        self._resetting = np.zeros(self.num_envs, dtype=np.bool_)
        self._keeps_resetting = reward_terms
        self._is_made = True

    @property
    def spec(self) -> EnvSpec | None:
        """The specification from which `gymnasium.make_vec` made the batch, with the server's step limit."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = requests.with_step_limit(spec, self._description)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin the next episodes.

        Args:
            seed: a seed s, or a list of N seeds. With s, environment i begins the first episode of the seed s + i.
                Without a seed, or where the list has None, an environment begins the next episode of its last seed. At
                the first reset the default seed is random.
            options: the key `reset_mask`, bool [N], selects the M environments to reset, by default all. The key
                `parameters` changes parameters from now on, as in the constructor. The key `state` sets exact initial
                states [M, S] for this episode.

        Raises:
            InvalidArgumentError: if an argument is wrong. Nothing has changed. Exception: if seeds or new parameters
                are given for some environments only, a wrong `state` may be refused after others were reset.
            ServerConnectionError: if the server cannot be reached, or the connection broke. The environments are lost;
                a later reset opens another session.
            ServerTimeoutError: if the server did not reply in time. The environments are lost, too.
            ServerStartError: if the private server did not start.
        """
        given = requests.options(options, OPTIONS)
        mask = None
        if given.get("reset_mask") is not None:
            mask = requests.mask(given["reset_mask"], self.num_envs, "options['reset_mask']")
            self._client.session.require_usable()  # a new session would also reset environments outside the mask
        selected = range(self.num_envs) if mask is None else np.flatnonzero(mask).tolist()
        seeds = requests.seeds(seed, self.num_envs)
        parameters = requests.distributions(given.get("parameters"))
        state = given.get("state")
        states = b"" if state is None else requests.states(state, len(selected), batched=True)
        first = next((one for one in seeds if one is not None), None)
        super().reset(seed=first)

        opened = self._client.open([] if first is None else [first], self.np_random)
        if mask is None:
            self._resetting[:] = False
        else:
            self._resetting &= ~mask
        # A new session has begun its first episodes. They are the result of this reset, unless the reset has a seed or
        # states, or changes parameters.
        waiting = any(slot in self._next_parameters for slot in selected)
        if opened is not None and first is None and not (parameters or states or waiting):
            return opened.observations, opened.events.batch(None, False)
        return self._begin(mask, selected, seeds, parameters, states)

    def _begin(
        self,
        mask: NDArray[np.bool_] | None,
        selected: Sequence[int],
        seeds: Sequence[int | None],
        parameters: requests.Intervals,
        states: bytes,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin the next episodes of the selected environments, with one request for each group of similar resets."""
        # Positions in `selected`, in groups. The environments of a group all have a seed or all have none, and change
        # the same parameters.
        alike: dict[Any, list[int]] = {}
        for place, slot in enumerate(selected):
            own = self._next_parameters.get(slot)
            alike.setdefault((seeds[slot] is None, own and requests.frozen(own)), []).append(place)
        groups, row = [], len(states) // max(len(selected), 1)
        for places in alike.values():
            slots = [selected[place] for place in places]
            own_mask = mask
            if len(alike) > 1:
                own_mask = np.zeros(self.num_envs, np.bool_)
                own_mask[slots] = True
            groups.append(
                ResetRequest(
                    own_mask,
                    [one for one in (seeds[slot] for slot in slots) if one is not None],
                    {**self._next_parameters.get(slots[0], {}), **parameters},
                    b"".join(states[place * row : (place + 1) * row] for place in places),
                )
            )
        observations, begun = self._client.reset(groups)
        for slot in selected:
            self._next_parameters.pop(slot, None)
        infos = begun[0].batch(None, False)
        for events in begun[1:]:
            merge(infos, events.batch(None, False))
        return observations, infos

    def set_parameters(self, parameters: requests.Parameters, mask: NDArray[np.bool_] | None = None) -> None:
        """Change parameters of the physics from the next episode of each environment on.

        The current episode of an environment keeps its parameters. After an autoreset, the environment is reset a
        second time with the new parameters, so one episode index is skipped. If there are unreceived steps at that
        time, the change waits for a later episode.

        Args:
            parameters: values by parameter, as in the constructor. Other parameters keep their distribution.
            mask: bool [N], selects the environments to change, by default all.

        Raises:
            UnknownNameError: if there is no such parameter. Nothing has changed.
            InvalidArgumentError: if a value is malformed or out of bounds. Nothing has changed.
        """
        values = requests.parameter_values(parameters, self._description)
        slots = range(self.num_envs) if mask is None else np.flatnonzero(requests.mask(mask, self.num_envs, "mask"))
        for slot in slots:
            self._next_parameters[int(slot)] = {**self._next_parameters.get(int(slot), {}), **values}
        if not self._keeps_resetting and self._mode is AutoresetMode.NEXT_STEP:
            self._keeps_resetting = True
            self._resetting = self._client.last_ended()

    def step(
        self, actions: Any
    ) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Advance every environment by one step. Environments clip continuous actions to the range of the action space.

        Raises:
            InvalidArgumentError: if an action is wrong. No environment has moved.
            OutOfOrderError: before the first reset; with autoreset disabled, also if an environment whose episode has
                ended was not reset.
            ServerConnectionError: if the connection broke. The environments are lost.
            ServerTimeoutError: if the server did not reply in time. The environments are lost.
        """
        return self._outcome(self._client.session.step(actions, self._encode))

    def send(self, actions: Any) -> None:
        """Send the actions of a step without waiting for the reply. `recv` returns the step's outcome.

        Several batches can thus step at the same time, each in its own session. One batch can have up to 64 unreceived
        steps. This is useful if actions do not depend on the outcomes of these steps.

        Raises:
            InvalidArgumentError: if the actions have a wrong shape or type. For wrong values, `recv` raises it.
            OutOfOrderError: before the first reset, or if there are 64 unreceived steps.
            ServerConnectionError: if the connection broke. The environments are lost.
            ServerTimeoutError: if the request could not be sent in time. The environments are lost.
        """
        self._client.session.send(actions, self._encode)

    def recv(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Wait for the oldest step that `send` sent, and return its outcome in the form of `step`.

        While there are unreceived steps, only `send` and `recv` may be called.

        Raises:
            InvalidArgumentError: if an action is wrong. No environment moves in this step. Later steps still run.
            OutOfOrderError: if there is no unreceived step; with autoreset disabled, also if an environment whose
                episode has ended was not reset.
            ServerConnectionError: if the connection broke. The environments are lost.
            ServerTimeoutError: if the server did not reply in time. The environments are lost.
        """
        return self._outcome(self._client.session.recv())

    def snapshot(self, mask: NDArray[np.bool_] | None = None) -> list[bytes]:
        """Save the M environments that the mask [N] selects, by default all. Return M snapshots, ordered by slot."""
        return self._client.snapshot(None if mask is None else requests.mask(mask, self.num_envs, "mask"))

    def restore(self, snapshots: Sequence[bytes], mask: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
        """Restore M snapshots into the environments that the mask [N] selects, by default all.

        Returns the observations [N, O] of all environments. The rows of restored environments are the observations at
        which they were saved. The rows of the other environments are their last observations. After the restore, the
        same actions give the same bytes as after the snapshot was saved.

        If the snapshots have at most 2 MiB in total, either all are restored or none. Otherwise they are sent in parts.
        If one part is refused, the snapshots of the parts before it stay restored.
        """
        selected = None
        if mask is not None:
            selected = requests.mask(mask, self.num_envs, "mask")
            self._client.session.require_usable()
        self._client.open([], self.np_random)
        restored = self._client.restore(snapshots, selected)
        self._resetting &= False if selected is None else ~selected
        return restored

    def render(self) -> tuple[NDArray[np.uint8], ...]:
        """Draw the present state of each environment, as an RGB picture, uint8 [height, width, 3].

        In same-step mode, an environment whose episode just ended shows the start of its next episode.

        Raises:
            OutOfOrderError: before the first reset, or without `render_mode="rgb_array"`.
            RenderError: if the server cannot draw. The message has the reason.
            ServerConnectionError: if the connection broke. The environments are lost.
            ServerTimeoutError: if the server did not reply in time. The environments are lost.
        """
        return tuple(self._client.render(slot) for slot in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:  # noqa: ARG002
        """Free the environments on the server."""
        # Older versions of Gymnasium close the batch even if its constructor raised an error. Then there is no client.
        if hasattr(self, "_client"):
            self._client.close()

    def _outcome(
        self, stepped: Stepped
    ) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        observations, rewards, terminated, truncated, events = stepped
        infos: dict[str, Any] = {}
        if events is not None:
            moved = ~self._resetting if self._reward_terms else None
            infos = events.batch(moved, self._mode is AutoresetMode.SAME_STEP)
        begun = self._resetting
        if self._keeps_resetting and self._mode is AutoresetMode.NEXT_STEP:
            self._resetting = terminated | truncated
        if self._next_parameters and self._mode is not AutoresetMode.DISABLED:
            if self._mode is AutoresetMode.SAME_STEP:
                begun = terminated | truncated
            observations = self._change_parameters(begun, observations, infos)
        return observations, rewards, terminated, truncated, infos

    def _change_parameters(
        self, begun: NDArray[np.bool_], observations: NDArray[np.float32], infos: dict[str, Any]
    ) -> NDArray[np.float32]:
        """Reset environments whose episodes just began and whose parameters `set_parameters` changed."""
        slots = [slot for slot in np.flatnonzero(begun).tolist() if slot in self._next_parameters]
        if not slots or self._client.session.under_way:
            return observations
        mask = np.zeros(self.num_envs, np.bool_)
        mask[slots] = True
        observations, later = self._begin(mask, slots, [None] * self.num_envs, {}, b"")
        merge(infos, later)
        return observations


# Names of the settings of batches.
SETTINGS = requests.settings(PerturbVectorEnv.__init__)
