"""A batch of environments, as `gymnasium.vector.VectorEnv`: one round trip a step, whatever their number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from . import requests
from .catalogue import USUAL_PIXELS
from .client import TIMEOUT, Client
from .errors import InvalidArgumentError
from .sets import Set, contexts_of

if TYPE_CHECKING:
    from ._native import Stepped

OPTIONS = ("parameters", "state", "reset_mask")


class PerturbVectorEnv(VectorEnv[NDArray[np.float32], Any, NDArray[Any]]):
    """N environments of a perturb-server.

    Args:
        environment: a name of docs/environments.md, such as `CartPole`.
        num_envs: N.
        version: where parameters come from: `D` their defaults, `R` random, `E` extreme, `R+E` one of
            both, each in half of the trials.
        server: `unix:/path` or `host:port`; None starts a server of this process's own.
        parameters: replaces the version's set of the named parameters: a value, an interval `(low, high)`, or several
            `[(low, high), …]`.
        autoreset_mode: Gymnasium's; what happens to environments whose episode has ended.
        first_environment_index: the index of the first environment. A batch that is split gives the same bytes as a
            whole one if each part has its place here, and seeds to match.
        episodes_per_trial: parameters are drawn anew after so many episodes.
        observe: `state`, or `parameters` for observations that have the episode's parameters at their end, scaled to
            -1 … 1 over the range of R and E.
        receipts: whether infos have parameters and receipt.
        reward_terms: whether every step's infos have the terms of the reward.
        copy: False returns observations and pictures as they came, read-only arrays without a copy; True returns
            copies, which can be changed and which PyTorch takes without a warning. Either way the next step leaves them
            as they are.
        timeout: how long a reply may take, s.
        render_mode: `rgb_array` lets `render` draw; None.
        width: of pictures, in pixels.
        height: likewise.
        contexts: a list of values of parameters by name: environment i has context i modulo their number in all its
            episodes. At most N, or a grid or list of `perturb.sets`. Of parameters that a context does not name the
            version and `parameters` decide; a reset's parameters replace those of contexts.

    The connection is made by the first `reset`. Rewards are float32 [N], flags bool [N].
    """

    def __init__(
        self,
        environment: str,
        num_envs: int = 1,
        *,
        version: requests.Version = "D",
        server: str | None = None,
        parameters: requests.Parameters | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        first_environment_index: int = 0,
        episodes_per_trial: int = 1,
        observe: str = "state",
        receipts: bool = True,
        reward_terms: bool = False,
        copy: bool = False,
        timeout: float = TIMEOUT,
        render_mode: str | None = None,
        width: int = USUAL_PIXELS,
        height: int = USUAL_PIXELS,
        contexts: Sequence[Mapping[str, float]] | Set | None = None,
    ) -> None:
        if isinstance(contexts, Set):
            contexts = contexts_of(contexts, version, parameters)
        self._mode = requests.autoreset_mode(autoreset_mode)
        self._client = Client(
            environment=environment,
            version=version,
            num_envs=num_envs,
            server=server,
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
        description = self._client.description
        self.num_envs = self._client.num_envs
        self.metadata = {**description.metadata(), "autoreset_mode": self._mode}
        self.single_observation_space = description.observation_space()
        self.single_action_space = description.action_space()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._encode = partial(requests.actions, description=description, shape=self.action_space.shape or ())
        self._reward_terms = reward_terms
        self._copy = copy
        # What was last returned: a masked reset or restore leaves the other environments as they are.
        self._observations: NDArray[np.float32] | None = None
        # Whose next step is an autoreset, in next-step mode: it has no reward, and no terms of one.
        self._resetting = np.zeros(self.num_envs, dtype=np.bool_)

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin the next episodes.

        Args:
            seed: environment i begins the first episode of the seed s + i, or of the i-th of N seeds; without it, the
                next episode of its seed before (at first a random one).
            options: `parameters`, as at `make`, from now on; `state`, exact initial states [M, S] for this episode;
                `reset_mask`, bool [N], which environments are reset, at first all.

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
        seeds = self._seeds(seed)
        parameters = requests.distributions(given.get("parameters"))
        state = given.get("state")
        states = b"" if state is None else requests.states(state, len(selected), batched=True)
        super().reset(seed=seeds[0] if seeds else None)

        opened = self._client.open(seeds, self.np_random)
        if opened is None or seeds or parameters or states:
            rows, events = self._client.reset(mask, [seeds[i] for i in selected] if seeds else [], parameters, states)
        else:
            rows, events = opened.observations, opened.events
        return self._merge(rows, mask), events.batch(None, False)

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
        """The first half of `step`: the server computes, and nobody waits for it.

        So several batches, each with a session of its own, can be under way together. The same batch can have up to 64
        steps under way, with actions that do not depend on what they lead to.

        Raises:
            InvalidArgumentError: for a wrong shape or kind of numbers; wrong values are told by `recv`.
            OutOfOrderError: before the first reset, or if 64 steps are under way.
            ServerConnectionError, ServerTimeoutError: and the environments are gone.
        """
        self._client.session.send(actions, self._encode)

    def recv(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """The second half: what `step` returns, of the oldest step that was sent and not received.

        Until all are received, nothing but `send` and `recv` may be called.

        Raises:
            InvalidArgumentError: no environment has moved in this step; those that were sent after it count.
            OutOfOrderError: if no step is under way; with autoreset disabled, if an episode has ended.
            ServerConnectionError, ServerTimeoutError: and the environments are gone.
        """
        return self._outcome(self._client.session.recv())

    def snapshot(self, mask: NDArray[np.bool_] | None = None) -> list[bytes]:
        """Save the environments that the mask [N] selects, at first all: M pieces of bytes, in order."""
        return self._client.snapshot(None if mask is None else requests.mask(mask, self.num_envs, "mask"))

    def restore(self, snapshots: Sequence[bytes], mask: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
        """Bring saved environments back into the M slots that the mask [N] selects, at first all.

        Returns the observations [N, O]: of restored environments those at which they were saved, of others the last.
        What follows is what followed the snapshot, byte for byte. All are restored, or none.
        """
        selected = None
        if mask is not None:
            selected = requests.mask(mask, self.num_envs, "mask")
            self._client.session.require_usable()
        self._client.open([], self.np_random)
        restored = self._client.restore(snapshots, selected)
        return self._merge(restored, selected)

    def render(self) -> tuple[NDArray[np.uint8], ...]:
        """Draw the environments as they are now: of each, red, green and blue, uint8 [height, width, 3].

        In same-step mode the environment of an ended episode is at the start of the next one already.

        Raises:
            OutOfOrderError: before the first reset, or without `render_mode="rgb_array"`.
            RenderError: if the server cannot draw; it says what is missing.
            ServerConnectionError, ServerTimeoutError: and the environments are gone.
        """
        frames = (self._client.render(slot) for slot in range(self.num_envs))
        return tuple(frame.copy() if self._copy else frame for frame in frames)

    def close_extras(self, **kwargs: Any) -> None:  # noqa: ARG002
        """Free the environments on the server."""
        # An environment whose settings were refused has no client. Older Gymnasiums close it all the same.
        if hasattr(self, "_client"):
            self._client.close()

    def _seeds(self, seed: int | Sequence[int] | None) -> list[int]:
        if seed is None:
            return []
        if not isinstance(seed, Sequence | np.ndarray) or getattr(seed, "ndim", 1) == 0:
            first = requests.seed(seed)
            return [requests.seed(first + i) for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise InvalidArgumentError(f"seed has {len(seed)} numbers; expected one, or {self.num_envs}")
        return [requests.seed(value) for value in seed]

    def _store(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        self._observations = observations
        return observations.copy() if self._copy else observations

    def _merge(self, rows: NDArray[np.float32], mask: NDArray[np.bool_] | None) -> NDArray[np.float32]:
        """The observations [N, O] after M rows have changed."""
        if mask is None:
            self._resetting[:] = False
            return self._store(rows)
        self._resetting &= ~mask
        if self._observations is None:
            return self._store(rows)
        merged = self._observations.copy()
        merged[mask] = rows
        merged.flags.writeable = False
        return self._store(merged.view())

    def _outcome(
        self, stepped: Stepped
    ) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        observations, rewards, terminated, truncated, events = stepped
        infos: dict[str, Any] = {}
        if events is not None:
            moved = ~self._resetting if self._reward_terms else None
            infos = events.batch(moved, self._mode is AutoresetMode.SAME_STEP)
        if self._reward_terms and self._mode is AutoresetMode.NEXT_STEP:
            self._resetting = terminated | truncated
        return self._store(observations), rewards, terminated, truncated, infos
