"""A batch of environments, as `gymnasium.vector.VectorEnv`: one round trip a step, whatever their number."""

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
# Beyond so many environments the server is asked whether it takes them before arrays are made for them.
CHECKED_ENVIRONMENTS = 100_000


class PerturbVectorEnv(CheckedAttributes, VectorEnv[NDArray[np.float32], Any, NDArray[Any]]):
    """N environments of a perturb-server.

    Args:
        environment: a name of docs/environments.md, such as `CartPole`; with `task` its name, or None.
        num_envs: N.
        version: where parameters come from: `D` their defaults, `R` random, `E` extreme, `R+E` one of
            both, each in half of the trials.
        server: `unix:/path`, `host:port`, or `embedded` for one in this process; None starts a private server.
        task: the folder of a task, which the private or the embedded server then serves; see docs/tasks.md. The
            environment is that of the folder.
        parameters: replaces the version's set of the named parameters: a value, an interval `(low, high)`, or several
            `[(low, high), …]`.
        autoreset_mode: Gymnasium's mode, which decides what happens to environments whose episode has ended.
        first_environment_index: the index of the first environment. A batch that is split gives the same bytes as a
            whole one if each part has its place here, and seeds to match.
        episodes_per_trial: parameters are drawn anew after so many episodes.
        observe: `state`, or `parameters` for observations that have the episode's parameters at their end, scaled to
            -1 … 1 over the range of R and E.
        receipts: whether infos have parameters and receipt.
        reward_terms: whether every step's infos have the terms of the reward.
        copy: has no effect, and is accepted because Gymnasium's own vector environments have it. Observations and
            pictures are always the caller's own to keep and to change.
        timeout: how long a reply may take, s.
        render_mode: `rgb_array` lets `render` draw; None.
        width: width of pictures, in pixels.
        height: height of pictures, in pixels.
        contexts: a list of at most N contexts, values of parameters by name, or a grid or list of `perturb.sets`.
            Environment i has context i modulo their number in all its episodes. The version and `parameters` decide
            about parameters that a context does not name. A reset's parameters replace those of contexts.
        max_episode_steps: no other than the server's step limit; `make_vec` passes it on.

    The connection is made by the first `reset`. Rewards are float32 [N], flags bool [N].
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
        # Parameters that act from the next episode on, by slot.
        self._next_parameters: dict[int, requests.Intervals] = {}
        # In next-step mode: environments whose next step is an autoreset, which has no reward and no reward terms. Kept
        # only if something depends on it.
        self._resetting = np.zeros(self.num_envs, dtype=np.bool_)
        self._keeps_resetting = reward_terms
        self._is_made = True

    @property
    def spec(self) -> EnvSpec | None:
        """The specification from which Gymnasium made the batch, with the server's step limit."""
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
            seed: environment i begins the first episode of the seed s + i, or of the i-th of N seeds; without it, or
                where that is None, the next episode of its last seed (at the first reset a random seed).
            options: `parameters`, as at `make`, from now on; `state`, exact initial states [M, S] for this episode;
                `reset_mask`, bool [N], which environments are reset, by default all.

        Raises:
            InvalidArgumentError: and nothing has changed.
            ServerConnectionError, ServerTimeoutError, ServerStartError: and the environments are gone; a later reset
                opens another session.
        """
        given = requests.options(options, OPTIONS)
        mask = None
        if given.get("reset_mask") is not None:
            mask = requests.mask(given["reset_mask"], self.num_envs, "options['reset_mask']")
            self._client.session.require_usable()  # a new one would hold other episodes than the mask leaves alone
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
        """Begin the next episodes of the selected environments: one request for all that are reset alike."""
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
        """Change the physics from the next episode of each environment on.

        The running episode of an environment keeps its parameters. When the episode has ended, its environment is reset
        once more, so one episode index is passed over. While several steps are under way, the change waits.

        Args:
            parameters: as at `make`. Other parameters stay as they are.
            mask: bool [N], the environments; by default all.

        Raises:
            UnknownNameError, InvalidArgumentError: for wrong names and values; nothing has changed.
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
        """Advance every environment by one step. Actions beyond the range of a Box are clipped by the environment.

        Raises:
            InvalidArgumentError: and no environment has moved.
            OutOfOrderError: before the first reset; with autoreset disabled, if an episode has ended and was not reset.
            ServerConnectionError, ServerTimeoutError: and the environments are gone.
        """
        return self._outcome(self._client.session.step(actions, self._encode))

    def send(self, actions: Any) -> None:
        """Send the actions of a step without waiting for its outcome, which `recv` returns.

        Several batches can step at the same time in this way, each in a session of its own. One batch can have up to 64
        steps under way, if the actions do not depend on the outcomes of these steps.

        Raises:
            InvalidArgumentError: for a wrong shape or kind of numbers; `recv` raises it for wrong values.
            OutOfOrderError: before the first reset, or if 64 steps are under way.
            ServerConnectionError, ServerTimeoutError: and the environments are gone.
        """
        self._client.session.send(actions, self._encode)

    def recv(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Receive the oldest step that was sent and not received, as `step` returns it.

        Until all are received, nothing but `send` and `recv` may be called.

        Raises:
            InvalidArgumentError: if an action is wrong. No environment moves in this step; later steps are still made.
            OutOfOrderError: if no step is under way; with autoreset disabled, if an episode has ended.
            ServerConnectionError, ServerTimeoutError: and the environments are gone.
        """
        return self._outcome(self._client.session.recv())

    def snapshot(self, mask: NDArray[np.bool_] | None = None) -> list[bytes]:
        """Save the M environments that the mask [N] selects, by default all, as M bytes objects in order."""
        return self._client.snapshot(None if mask is None else requests.mask(mask, self.num_envs, "mask"))

    def restore(self, snapshots: Sequence[bytes], mask: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
        """Restore saved environments into the M slots that the mask [N] selects, by default all.

        Returns the observations [N, O]. Restored environments have the observations at which they were saved, and the
        others have their last ones. The same actions then give the same bytes as after the snapshot. If one environment
        cannot be restored, none is.
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

        In same-step mode the environment of an ended episode is at the start of the next one already.

        Raises:
            OutOfOrderError: before the first reset, or without `render_mode="rgb_array"`.
            RenderError: if the server cannot draw; it says what is missing.
            ServerConnectionError, ServerTimeoutError: and the environments are gone.
        """
        return tuple(self._client.render(slot) for slot in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:  # noqa: ARG002
        """Free the environments on the server."""
        # An environment whose settings were refused has no client. Older Gymnasiums close it all the same.
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
