"""A session: one stream to a server, which owns a batch of environments. Requests go out, replies come back in order.

The native module has the stream; here are its errors' sentences and the private server. A session belongs to the
process that opened it, and is opened when it is first needed, not when an environment is made: a process that is forked
in between opens its own.
"""

from __future__ import annotations

import atexit
import collections
import contextlib
import os
import subprocess
import threading
import weakref
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from . import _native, local_server
from .errors import (
    InvalidArgumentError,
    OutOfOrderError,
    PerturbError,
    ProtocolError,
    ServerConnectionError,
    ServerDefectError,
    ServerFullError,
    ServerTimeoutError,
    refusal,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from .address import Address
    from .catalogue import Description

    Intervals: TypeAlias = dict[str, list[tuple[float, float]]]

Reply = TypeVar("Reply")

# How often a silent server is asked whether it lives, and how long it may take to answer, s. A very busy machine is no
# reason to lose environments; the sockets of a server that ended are closed by its system at once.
KEEPALIVE_INTERVAL, KEEPALIVE_LIMIT = 10.0, 20.0
# How often a session that nobody waits in answers the server's question whether it lives, s.
TEND_INTERVAL = 0.25
# gRPC's codes of streams that a server ended.
RESOURCE_EXHAUSTED, OUT_OF_RANGE, UNIMPLEMENTED, UNAUTHENTICATED = 8, 11, 12, 16


class Session:
    """The stream. `server` is an address, or None for this process's own server.

    A session that is lost (the server died, a reply took too long, the wait for it was interrupted) stays lost.
    """

    def __init__(
        self, server: Address | None, timeout: float, description: Description, num_envs: int, *, single: bool
    ) -> None:
        _close_forgotten()
        self._local: local_server.LocalServer | None = None
        if server is None:
            self._local = local_server.acquire()
            server = self._local.address
        self.address: Address = server
        self._owner = os.getpid()
        self._limit = timeout
        self._lost: str | None = None
        self._opened = False
        self._native = _native.Session(
            str(server),
            timeout,
            (KEEPALIVE_INTERVAL, KEEPALIVE_LIMIT),
            num_envs,
            len(description.observation),
            None if isinstance(description.actions, int) else len(description.actions),
            single,
        )
        self._parts: _Parts = (self._native, self._local, self._owner)
        # Wherever Python happens to collect a forgotten session, also where a lock is held: so nothing but this.
        self._forget = weakref.finalize(self, _forgotten.append, self._parts)
        self._forget.atexit = False  # _at_exit closes what is left
        _keeper.keep(self)

    @property
    def waits(self) -> bool:
        """Whether a thread waits for a reply."""
        return self._native.waits

    @property
    def _timeout(self) -> float:
        return self._limit

    @_timeout.setter
    def _timeout(self, seconds: float) -> None:
        self._limit = self._native.timeout = seconds

    def usable(self) -> bool:
        """Whether requests can be sent: it is neither lost nor another process's."""
        return os.getpid() == self._owner and self._gone() is None

    def require_usable(self) -> None:
        """Raise, unless requests can be sent.

        Raises:
            OutOfOrderError: with what happened, and that a reset begins anew.
        """
        if os.getpid() != self._owner:
            raise OutOfOrderError(
                f"process {self._owner} opened this environment's session, and process {os.getpid()} was forked from "
                "it: call reset() to open one here, or make the environment after the fork"
            )
        gone = self._gone()
        if gone is not None:
            raise OutOfOrderError(f"call reset() to begin anew, this environment is gone: {gone}")

    def _gone(self) -> str | None:
        """Why it is of no more use, if so. A second Ctrl-C may have come before the first was noted."""
        return self._lost or ("it was interrupted, or its connection ended" if self._native.ended else None)

    def open(self, **request: Any) -> _native.Opened:
        """Create the environments and begin their first episodes."""
        opened = self._call("open", self._native.open, **request)
        self._opened = True
        return opened

    def step(self, actions: Any, encode: Callable[[Any], bytes]) -> _native.Stepped:
        """Advance every environment."""
        return self._call("step", self._native.step, actions, encode)

    def send(self, actions: Any, encode: Callable[[Any], bytes]) -> None:
        """Ask for a step, whose outcome `recv` gives."""
        self._call("step", self._native.send, actions, encode)

    def recv(self) -> _native.Stepped:
        """Wait for the oldest step that was sent."""
        return self._call("step", self._native.recv)

    def reset(
        self, mask: bytes, seeds: Sequence[int], parameters: Intervals, states: bytes
    ) -> tuple[NDArray[np.float32], _native.Events]:
        """Begin new episodes: observations [M, O], and the episodes."""
        return self._call("reset", self._native.reset, mask, seeds, parameters, states)

    def snapshot(self, mask: bytes) -> list[bytes]:
        """Save environments."""
        return self._call("snapshot", self._native.snapshot, mask)

    def restore(self, mask: bytes, snapshots: Sequence[bytes]) -> NDArray[np.float32]:
        """Bring saved environments back: observations [M, O]."""
        return self._call("restore", self._native.restore, mask, snapshots)

    def render(self, slot: int, width: int, height: int) -> NDArray[np.uint8]:
        """Draw an environment: [height, width, 3]."""
        return self._call("render", self._native.render, slot, width, height)

    def tend(self) -> None:
        """Answer the server's question whether this side lives; called by the keeper."""
        self._native.tend()

    def close(self) -> None:
        """End the session; the server frees its environments."""
        self._lost = self._lost or "it was closed"
        self._close()
        _close_forgotten()

    def _close(self) -> None:
        if self._forget.detach() is not None:
            _close(*self._parts)

    def _call(self, kind: str, call: Callable[..., Reply], *arguments: Any, **fields: Any) -> Reply:
        try:
            return call(*arguments, **fields)
        except BaseException as error:  # noqa: BLE001  (Ctrl-C ends a session, too)
            raise self._failed(kind, error) from None

    def _failed(self, kind: str, error: BaseException) -> BaseException:
        """What to raise in place of an error; nearly all cost the session."""
        if not isinstance(error, _native.Failure):
            if not self._native.ended:
                return error  # the actions' shape or kind: nothing was sent
            # Ctrl-C: the reply to come would have been taken for that to the next request.
            self._lost = self._lost or f"the wait for the reply to {kind} was interrupted"
            self._close()
            return error
        what, code, words = error.args
        if what == "refused":
            if code == UNAUTHENTICATED:  # a token that is missing, wrong or revoked ends the stream
                return self._fail(self._explain(kind, what, code, words))
            refused = refusal(kind, code, words)
            # A refusal changes nothing; a defect of the server costs the environments.
            return self._fail(refused) if isinstance(refused, ServerDefectError) else refused
        if what == "malformed":
            return ProtocolError(words)
        if what == "invalid":
            return InvalidArgumentError(words)
        if what == "unusable":
            try:
                self.require_usable()
            except OutOfOrderError as unusable:
                return unusable
            return OutOfOrderError(words)
        return self._fail(self._explain(kind, what, code, words))

    def _fail(self, error: PerturbError) -> PerturbError:
        self._lost = self._lost or str(error)
        self._close()
        return error

    def _explain(self, kind: str, what: str, code: int, words: str) -> PerturbError:
        """Say what ended the stream and what to do."""
        lost = f"lost the server at {self.address} during {kind}"
        if what == "timed out":
            return ServerTimeoutError(
                f"the server at {self.address} did not answer {kind} within {self._limit:g} s; "
                "look at its log, or give slow environments more time with timeout="
            )
        if what == "mismatch":
            return ProtocolError(f"the server at {self.address} answered {kind} with {words}: are both of one version?")
        if code == RESOURCE_EXHAUSTED:
            return ServerFullError(f"the server at {self.address} refused {kind}: {words}")
        if code == OUT_OF_RANGE:
            return InvalidArgumentError(
                f"the server at {self.address} refused {kind}, which is too large for it: {words}; "
                "start it with a larger --max-message-bytes, or use fewer environments"
            )
        if code == UNAUTHENTICATED and what == "unreachable":  # certificates, or the files that variables name
            return ServerConnectionError(f"no safe connection to the server at {self.address}: {words}")
        if code == UNAUTHENTICATED:
            return ServerConnectionError(f"the server at {self.address} does not let this process in: {words}")
        if code == UNIMPLEMENTED:
            return ProtocolError(f"what answers at {self.address} is no perturb-server: {words}")
        if self._local is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                status = self._local.process.wait(1)
                return ServerConnectionError(
                    f"{lost}: this process's perturb-server ended with status {status}; reset() starts another"
                )
        if not self._opened:
            return ServerConnectionError(
                f"no server answers at {self.address}: {words}; "
                f"start one with `perturb-server --listen {_listen(self.address)}`, or correct server="
            )
        return ServerConnectionError(f"{lost}: {words}; reset() begins anew when it runs again")


def _listen(address: Address) -> str:
    """What starts a server there, as flags; whom it lets in is its owner's to say."""
    text = str(address)
    if text.startswith("unix:"):
        return text
    rest = text.removeprefix("https://")
    guards = " --tls-cert FILE --tls-key FILE" if rest != text else ""
    return f"tcp://{rest}{guards}"


# What of a session has to be closed: the stream, the private server, the process that opened it.
_Parts: TypeAlias = "tuple[_native.Session, local_server.LocalServer | None, int]"
# Of sessions that nobody closed. The next session that is opened or closed closes them, or the keeper.
_forgotten: collections.deque[_Parts] = collections.deque()


def _close_forgotten() -> None:
    with contextlib.suppress(IndexError):  # another thread may be at it, too
        while True:
            _close(*_forgotten.popleft())


def _close(native: _native.Session, local: local_server.LocalServer | None, owner: int) -> None:
    if os.getpid() != owner:
        return  # what a forked process inherited is the parent's
    native.close()
    if local is not None:
        local_server.release(local)


class _Keeper:
    """One thread that looks after the sessions that nobody waits in: a connection has no thread of its own."""

    def __init__(self) -> None:
        self._sessions: weakref.WeakSet[Session] = weakref.WeakSet()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()

    def keep(self, session: Session) -> None:
        with self._lock:
            self._sessions.add(session)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="perturb-keeper", daemon=True)
                self._thread.start()

    def end(self) -> None:
        """End the thread: where Python ends it, it must not be in the native module."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()

    def sessions(self) -> list[Session]:
        """All that somebody holds."""
        with self._lock:
            return list(self._sessions)

    def _run(self) -> None:
        while not self._ended.wait(TEND_INTERVAL):
            self._look()  # in a frame of its own: a sleeping keeper keeps no session alive
            _close_forgotten()

    def _look(self) -> None:
        for session in self.sessions():
            session.tend()


_keeper = _Keeper()


def _after_fork_in_child() -> None:
    global _keeper
    _keeper = _Keeper()


def _at_exit() -> None:
    _keeper.end()
    for session in _keeper.sessions():
        session.close()
    _close_forgotten()


os.register_at_fork(after_in_child=_after_fork_in_child)
atexit.register(_at_exit)  # runs before the private server is ended, which was registered before
