"""What a single environment and a batch have in common: settings, and the session that they are sent to."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from . import catalogue, local_server, requests
from .address import parse_address
from .errors import InvalidArgumentError, OutOfOrderError, ProtocolError
from .session import Session

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from gymnasium.vector import AutoresetMode
    from numpy.typing import NDArray

    from ._native import Events, Opened

# How long a reply may take unless told otherwise, s.
TIMEOUT = 60.0


class Begun(NamedTuple):
    """What opening a session gave: observations [N, O] and the first episodes."""

    opened: Opened
    observations: NDArray[np.float32]
    events: Events


class Client:
    """N environments of a server. The session is opened by the first reset, in the process that calls it."""

    def __init__(
        self,
        *,
        environment: str,
        version: requests.Version,
        num_envs: int,
        server: str | None,
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
        self._drawn = render_mode is not None
        self._width, self._height = requests.pixels(width, "width"), requests.pixels(height, "height")
        self.description = catalogue.find(environment)
        observe_parameters = requests.observes_parameters(observe)
        if observe_parameters:
            self.description = self.description.observing_parameters()
        self.num_envs = requests.count(num_envs, "num_envs", 1)
        self._server = None if server is None else parse_address(server)
        if server is None:
            local_server.find_program()  # better now than at the first reset
        self._timeout = requests.seconds(timeout, "timeout")
        self._single = single
        self._parameters = requests.distributions(parameters)
        self._contexts = [] if contexts is None else requests.contexts(contexts)
        if len(self._contexts) > self.num_envs:
            raise InvalidArgumentError(
                f"there are {len(self._contexts)} contexts for num_envs={self.num_envs}: each environment has one, so "
                "give at least as many environments"
            )
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
        self._partly_changed = False
        self._session: Session | None = None
        self._closed = False

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the session: a copy, here or in another process, has to be reset."""
        if self._partly_changed:
            raise OutOfOrderError(
                "the environments do not all have the parameters that the batch was made with, which a copy would not "
                "know: copy them before parameters are given to some, or a snapshot is restored"
            )
        return {**self.__dict__, "_session": None}

    @property
    def session(self) -> Session:
        """The open session.

        Raises:
            OutOfOrderError: if there is none, or it is gone.
        """
        self._require_not_closed()
        if self._session is None:
            raise OutOfOrderError("call reset() first: no episode has begun")
        return self._session

    def open(self, seeds: Sequence[int], generator: np.random.Generator) -> Begun | None:
        """Open a session, unless one is open. Without seeds, which a reset is to give, the generator draws one.

        Environment i then has context i modulo their number, if there are contexts.

        Raises:
            OutOfOrderError: if a session is gone whose environments did not all have the same parameters.
        """
        self._require_not_closed()
        if self._session is not None:
            if self._session.usable():
                return None
            if self._partly_changed:
                raise OutOfOrderError(
                    "the session is gone, and earlier resets gave parameters to some of its environments: "
                    "make the environments anew, and give them again"
                )
            self._session.close()
            self._session = None
        session = Session(self._server, self._timeout, self.description, self.num_envs, single=self._single)
        try:
            seed = seeds[0] if seeds else int(generator.integers(2**63))
            opened = session.open(**self._request, parameters=self._parameters, seed=seed)
            if opened.observes_parameters != self._request["observe_parameters"]:
                raise ProtocolError(
                    "the server does not know observe='parameters': it is older than this package; "
                    "run the perturb-server of the package's version, or leave it out"
                )
            self.description.require_equal(catalogue.Description.read(json.loads(opened.environment)))
            begun = Begun(opened, opened.observations, opened.events)
            if self._contexts:
                begun = self._give_contexts(session, opened, seed)
        except BaseException:
            session.close()
            raise
        self._session = session
        return begun

    def _give_contexts(self, session: Session, opened: Opened, seed: int) -> Begun:
        count = len(self._contexts)
        for place, context in enumerate(self._contexts):
            mask = np.arange(self.num_envs) % count == place
            values = {name: [(value, value)] for name, value in context.items()}
            session.reset(mask.tobytes(), [seed] * int(mask.sum()), values, b"")
        # The same episodes once more, all together.
        return Begun(opened, *session.reset(b"", [seed] * self.num_envs, {}, b""))

    def reset(
        self,
        mask: NDArray[np.bool_] | None,
        seeds: Sequence[int],
        parameters: requests.Intervals,
        states: bytes,
    ) -> tuple[NDArray[np.float32], Events]:
        """Begin new episodes. Parameters stay, also if the session has to be opened again."""
        done = self.session.reset(_bytes(mask), seeds, parameters, states)
        if parameters and mask is not None and not mask.all():
            self._partly_changed = True
        else:
            self._parameters |= parameters
            self._contexts = [
                {name: value for name, value in context.items() if name not in parameters} for context in self._contexts
            ]
        return done

    def snapshot(self, mask: NDArray[np.bool_] | None) -> list[bytes]:
        """Save the selected environments."""
        return self.session.snapshot(_bytes(mask))

    def restore(self, snapshots: Sequence[bytes], mask: NDArray[np.bool_] | None) -> NDArray[np.float32]:
        """Bring saved environments back: observations [M, O]."""
        if not all(isinstance(snapshot, bytes) for snapshot in snapshots):
            raise InvalidArgumentError("a snapshot is not of the type bytes; expected what snapshot() returned")
        session = self.session
        try:
            restored = session.restore(_bytes(mask), snapshots)
        except BaseException:
            # A refusal, after which the session is usable, has changed nothing.
            self._partly_changed = self._partly_changed or not session.usable()
            raise
        self._partly_changed = True  # from here on nobody but the server knows the parameters
        return restored

    def render(self, slot: int) -> NDArray[np.uint8]:
        """Draw an environment: a read-only array [height, width, 3]."""
        if not self._drawn:
            raise OutOfOrderError("render() is for environments that were made with render_mode='rgb_array'")
        return self.session.render(slot, self._width, self._height)

    def close(self) -> None:
        """Close the session; this process's own server ends with its last session."""
        self._closed = True
        if self._session is not None:
            self._session.close()
            self._session = None

    def _require_not_closed(self) -> None:
        if self._closed:
            raise OutOfOrderError("the environment was closed; make it anew")


def _bytes(mask: NDArray[np.bool_] | None) -> bytes:
    return b"" if mask is None else mask.tobytes()
