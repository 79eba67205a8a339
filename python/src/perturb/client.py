"""The client of a server. It is the part that `PerturbEnv` and `PerturbVectorEnv` have in common."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from . import catalogue, local_server, requests
from .address import parse_address
from .errors import InvalidArgumentError, OutOfOrderError, ProtocolError
from .session import Session
from .task_folder import describe, find_folder

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from gymnasium.vector import AutoresetMode
    from numpy.typing import NDArray

    from ._native import Events, Opened

# Default maximum time to wait for a reply, s.
TIMEOUT = 60.0


class OpenedSession(NamedTuple):
    """The reply to opening a session, with the first observations [N, O] and the first episodes."""

    opened: Opened
    observations: NDArray[np.float32]
    events: Events


class ResetRequest(NamedTuple):
    """A request to reset M of the N environments."""

    # Bool [N], true for the M environments to reset; None resets all.
    mask: NDArray[np.bool_] | None
    # M seeds. If empty, each environment continues with the next episode of its last seed.
    seeds: Sequence[int]
    # Intervals that replace earlier ones, by parameter.
    parameters: requests.Intervals
    # Exact initial states, float64 [M, S] as bytes, or empty.
    states: bytes


class Client:
    """N environments of a server. The first reset opens the session, in the process that calls reset."""

    def __init__(
        self,
        *,
        environment: str | None,
        version: requests.Version,
        num_envs: int,
        server: str | None,
        task: str | os.PathLike[str] | None = None,
        parameters: requests.Parameters | None,
        first_environment_index: int,
        episodes_per_trial: int,
        autoreset_mode: AutoresetMode,
        observe: str,
        receipts: bool,
        reward_terms: bool,
        timeout: float,
        render_mode: str | None,
        width: int,
        height: int,
        single: bool,
        contexts: Sequence[Mapping[str, float]] | None = None,
    ) -> None:
        requests.render_mode(render_mode)
        self._can_render = render_mode is not None
        self._width, self._height = requests.pixels(width, "width"), requests.pixels(height, "height")
        self._timeout = requests.seconds(timeout, "timeout")
        self._server = None if server is None else parse_address(server)
        self._task = find_folder(task, server)
        self.description = describe(environment, self._task, self._server, self._timeout)
        observe_parameters = requests.observes_parameters(observe)
        self.num_envs = requests.count(num_envs, "num_envs", 1)
        if server is None:
            local_server.find_program()  # so that a missing program is reported now, not at the first reset
        self._single = single
        self._parameters = requests.distributions(parameters)
        # For each environment, the parameters that replace the parameters of the batch. The list is empty if no
        # environment has parameters of its own.
        self._own_parameters: list[requests.Intervals] = []
        if contexts is not None:
            self._set_contexts(requests.contexts(contexts))
        named = {*self._parameters, *(name for own in self._own_parameters for name in own)}
        self.description = self.description.with_parameters(named)
        if self.description.is_disturbed:
            # A session has disturbances only if the request that opens it names a disturbance. Contexts are sent later,
            # so add a disturbance to the opening request, with the value that has no effect.
            first, value = next(iter(self.description.undisturbed.items()))
            self._parameters = {first: [(value, value)], **self._parameters}
        if observe_parameters:
            self.description = self.description.observing_parameters()
        self._request: dict[str, Any] = {
            "environment": self.description.name,
            "version": requests.version(version),
            "first_environment_index": requests.count(first_environment_index, "first_environment_index", 0),
            "episodes_per_trial": requests.count(episodes_per_trial, "episodes_per_trial", 1),
            "autoreset_mode": autoreset_mode.value,
            "receipts": bool(receipts),
            "reward_terms": bool(reward_terms),
            "observe_parameters": observe_parameters,
        }
        self._was_restored = False
        self._session: Session | None = None
        self._closed = False

    def __getstate__(self) -> dict[str, Any]:
        """Return the settings without the session. The caller must reset a copy before its first step."""
        if self._was_restored:
            raise OutOfOrderError(
                "environments cannot be copied after a snapshot was restored, because a copy would not know its "
                "parameters: copy them before the restore"
            )
        return {**self.__dict__, "_session": None}

    @property
    def session(self) -> Session:
        """The open session.

        Raises:
            OutOfOrderError: if no session was opened, or if the client was closed.
        """
        self._require_not_closed()
        if self._session is None:
            raise OutOfOrderError("call reset() first: no episode has begun")
        return self._session

    def open(self, seeds: Sequence[int], generator: np.random.Generator) -> OpenedSession | None:
        """Open a session and begin the first episodes. If a session is open already, return None and do nothing.

        `seeds[0]` is the seed of the batch. If `seeds` is empty, the generator draws the seed. An environment starts
        with the parameters of its context, if it has one. Parameters that were set by an earlier reset take precedence.

        Raises:
            OutOfOrderError: if a snapshot was restored in the last session, and that session was lost. The parameters
                in the snapshot are not known, so a new session cannot have them.
        """
        self._require_not_closed()
        if self._session is not None:
            if self._session.usable():
                return None
            if self._was_restored:
                raise OutOfOrderError(
                    "the session is gone, and the parameters of the snapshot that was restored in it are not known: "
                    "make the environments again, and restore the snapshot again"
                )
            self._session.close()
            self._session = None
        session = Session(
            self._server, self._timeout, self.description, self.num_envs, single=self._single, task=self._task
        )
        try:
            seed = seeds[0] if seeds else int(generator.integers(2**63))
            opened = session.open(**self._request, parameters=self._parameters, seed=seed)
            if opened.observes_parameters != self._request["observe_parameters"]:
                raise ProtocolError(
                    "the server does not know observe='parameters': it is older than this package; "
                    "run the perturb-server of the package's version, or leave observe= out"
                )
            served = catalogue.Description.read(json.loads(opened.environment))
            self.description.require_equal(served)
            if self._task is not None:
                self.description.require_same_model(served)
            begun = OpenedSession(opened, opened.observations, opened.events)
            if any(self._own_parameters):  # `session.open` sets only the parameters that all environments share
                begun = self._set_own_parameters(session, opened, seed)
        except BaseException:
            session.close()
            raise
        self._session = session
        return begun

    def check_size(self) -> None:
        """Open and close a session, to find out whether the server accepts a batch of this size."""
        self.open([0], np.random.default_rng())
        self.session.close()
        self._session = None

    def _set_contexts(self, contexts: Sequence[Mapping[str, float]]) -> None:
        count = len(contexts)
        if count > self.num_envs:
            raise InvalidArgumentError(
                f"{count} contexts need at least {count} environments; num_envs is {self.num_envs}"
            )
        fixed = [{name: [(value, value)] for name, value in context.items()} for context in contexts]
        self._own_parameters = [fixed[slot % count] for slot in range(self.num_envs)]

    def _set_own_parameters(self, session: Session, opened: Opened, seed: int) -> OpenedSession:
        """Set the environments' own parameters by resets, one for each group of environments with equal parameters."""
        slots: dict[Any, list[int]] = {}
        for slot, own in enumerate(self._own_parameters):
            if own:
                slots.setdefault(requests.frozen(own), []).append(slot)
        for alike in slots.values():
            mask = np.zeros(self.num_envs, np.bool_)
            mask[alike] = True
            session.reset(mask.tobytes(), [seed] * len(alike), self._own_parameters[alike[0]], b"")
        # Begin the first episodes once more, all in one reset, so that one reply has all observations and episodes.
        return OpenedSession(opened, *session.reset(b"", [seed] * self.num_envs, {}, b""))

    def reset(self, groups: Sequence[ResetRequest]) -> tuple[NDArray[np.float32], list[Events]]:
        """Begin new episodes. Return observations [N, O], and the episodes that each request began.

        The client remembers the parameters, so that they also apply after the session is opened again.
        """
        events = []
        for mask, seeds, parameters, states in groups:
            observations, begun = self.session.reset(_bytes(mask), seeds, parameters, states)
            events.append(begun)
            if parameters:
                self._store_parameters(mask, parameters)
        return observations, events

    def _store_parameters(self, mask: NDArray[np.bool_] | None, parameters: requests.Intervals) -> None:
        """Store parameters that the selected environments keep for later episodes. `mask` None selects all."""
        if mask is None or mask.all():
            self._parameters = {**self._parameters, **parameters}
            self._own_parameters = [
                {name: it for name, it in own.items() if name not in parameters} for own in self._own_parameters
            ]
            return
        self._own_parameters = self._own_parameters or [{} for _ in range(self.num_envs)]
        for slot in np.flatnonzero(mask).tolist():
            self._own_parameters[slot] = {**self._own_parameters[slot], **parameters}

    def last_ended(self) -> NDArray[np.bool_]:
        """Return a mask [N] of the environments whose episode ended in the last step.

        Environments that were reset or restored since are left out.
        """
        if self._session is None or not self._session.usable():
            return np.zeros(self.num_envs, np.bool_)
        return self._session.last_ended()

    def snapshot(self, mask: NDArray[np.bool_] | None) -> list[bytes]:
        """Save the environments that the mask selects, one snapshot each. None selects all."""
        return self.session.snapshot(_bytes(mask))

    def restore(self, snapshots: Sequence[bytes], mask: NDArray[np.bool_] | None) -> NDArray[np.float32]:
        """Restore snapshots into the environments that the mask selects. None selects all.

        Returns the observations [N, O] of all environments. The rows of the other environments are their last
        observations.
        """
        if not all(isinstance(snapshot, bytes) for snapshot in snapshots):
            raise InvalidArgumentError("a snapshot is not of the type bytes; expected what snapshot() returned")
        session = self.session
        try:
            return session.restore(_bytes(mask), snapshots)
        finally:
            # If the session was lost during the restore, the server may have restored the snapshots.
            self._was_restored = self._was_restored or session.restored() or not session.usable()

    def render(self, slot: int) -> NDArray[np.uint8]:
        """Draw the environment in a slot of the batch. Return a picture, uint8 [height, width, 3]."""
        if not self._can_render:
            raise OutOfOrderError("render() is for environments that were made with render_mode='rgb_array'")
        return self.session.render(slot, self._width, self._height)

    def close(self) -> None:
        """Close the session. A private server ends when its last session is closed."""
        self._closed = True
        if self._session is not None:
            self._session.close()
            self._session = None

    def _require_not_closed(self) -> None:
        if self._closed:
            raise OutOfOrderError("the environment was closed; make it again")


def _bytes(mask: NDArray[np.bool_] | None) -> bytes:
    return b"" if mask is None else mask.tobytes()
