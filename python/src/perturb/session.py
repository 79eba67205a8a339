"""A session is one stream to a server, and owns a batch of environments. Replies come in the order of the requests.

The native module implements the stream. This module starts the private server if one is needed, and converts the
stream's failures to errors with messages. A session belongs to the process that opened it. The first reset opens it, so
a process that is forked before the first reset opens its own session.
"""

from __future__ import annotations

import atexit
import collections
import contextlib
import os
import subprocess
import threading
import time
import weakref
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from . import _native, embedded_server, local_server
from .address import EMBEDDED
from .embedded_server import EmbeddedServer
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
from .local_server import LocalServer
from .threads import start_thread

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from .address import Address
    from .catalogue import Description
    from .local_server import TaskFolder

    Intervals: TypeAlias = dict[str, list[tuple[float, float]]]

Reply = TypeVar("Reply")

# Interval of keepalive pings to a silent server, and maximum time to wait for their answer, s. The maximum is long, so
# that environments are not lost while a machine is busy. When a server's process ends, its clients notice at once,
# because the operating system closes the process's sockets.
KEEPALIVE_INTERVAL, KEEPALIVE_LIMIT = 10.0, 20.0
# Interval at which idle sessions answer the server's keepalive pings, s.
POLL_INTERVAL = 0.25
# Error messages name a recent pause of this process, such as Ctrl-Z, as the likely reason for a lost connection.
# Minimum length of such a pause, and maximum time since its end, s.
PAUSE_LIMIT, PAUSE_MEMORY = 2.0, 60.0
# gRPC status codes with which a server ends a stream.
DEADLINE_EXCEEDED, RESOURCE_EXHAUSTED, OUT_OF_RANGE, UNIMPLEMENTED, UNAUTHENTICATED = 4, 8, 11, 12, 16


class Session:
    """A session with the server at an address, or with a private server if the address is None.

    `task` is the task folder that the private or embedded server serves.

    A session is lost if the server dies, if a reply takes too long, or if the wait for a reply is interrupted. A lost
    session cannot be used again.
    """

    def __init__(
        self,
        server: Address | None,
        timeout: float,
        description: Description,
        num_envs: int,
        *,
        single: bool,
        task: TaskFolder | None = None,
    ) -> None:
        _close_unclosed()
        self._local: LocalServer | EmbeddedServer | None = None
        if server is None:
            self._local = local_server.acquire(LocalServer, task)
            server = self._local.address
        elif server == EMBEDDED:
            with embedded_server.loading:  # lock order: this lock before the lock of `local_server`
                self._local = local_server.acquire(EmbeddedServer, task)
        self.address: Address = server
        self._owner = os.getpid()
        self._limit = timeout
        self._embedded = server == EMBEDDED
        # Whether resets and steps may compile a model in this process. Only those of a task from a folder may.
        self._compiles = self._embedded and task is not None
        self._lost: str | None = None
        self._opened = False
        self._native = _native.Session(
            self._local.native if isinstance(self._local, EmbeddedServer) else str(server),
            timeout,
            (KEEPALIVE_INTERVAL, KEEPALIVE_LIMIT),
            num_envs,
            len(description.observation),
            None if isinstance(description.actions, int) else len(description.actions),
            single,
        )
        self._resources: _Resources = (self._native, self._local, self._owner)
        # Python may delete a session at any time, also while this thread holds a lock that closing needs. The finalizer
        # therefore only appends the resources to `_unclosed`.
        self._forget = weakref.finalize(self, _unclosed.append, self._resources)
        self._forget.atexit = False  # _at_exit closes the remaining sessions
        try:
            _keepalive.add(self)
        except PerturbError:
            self.close()
            raise

    @property
    def waits(self) -> bool:
        """Whether a thread is waiting for a reply."""
        return self._native.waits

    @property
    def _timeout(self) -> float:
        return self._limit

    @_timeout.setter
    def _timeout(self, seconds: float) -> None:
        self._limit = self._native.timeout = seconds

    def usable(self) -> bool:
        """Whether requests can be sent: the session is not lost, and this process opened it."""
        return os.getpid() == self._owner and self._end_reason() is None

    def require_usable(self) -> None:
        """Check that requests can be sent.

        Raises:
            OutOfOrderError: if they cannot. The message says why, and that `reset()` opens a new session.
        """
        if os.getpid() != self._owner:
            raise OutOfOrderError(
                f"process {self._owner} opened this environment's session, and process {os.getpid()} was forked from "
                "it: call reset() to open one here, or make the environment after the fork"
            )
        gone = self._end_reason()
        if gone is not None:
            raise OutOfOrderError(f"the session of this environment has ended; call reset() to open a new one: {gone}")

    def _end_reason(self) -> str | None:
        """Return the reason why the session has ended, or None if it has not."""
        # `_failed` stores the reason in `_lost`. If a second Ctrl-C interrupts `_failed`, the native session has ended,
        # but no reason is stored.
        return self._lost or ("it was interrupted, or its connection ended" if self._native.ended else None)

    def open(self, **request: Any) -> _native.Opened:
        """Create the environments and begin their first episodes."""
        opened = self._call("open", self._native.open, **request)
        self._opened = True
        return opened

    def step(self, actions: Any, encode: Callable[[Any], bytes]) -> _native.Stepped:
        """Advance every environment by one step. `encode` converts actions of unusual types to bytes."""
        return self._call("step", self._native.step, actions, encode)

    def step_single(
        self, action: Any, encode: Callable[[Any], bytes]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Advance a single environment by one step.

        Return its observation [O], reward, terminated and truncated flags, and info.
        """
        if self._compiles:
            return self._call("step", self._native.step_single, action, encode)
        try:  # without _call, whose time is long compared with a step of an embedded environment
            return self._native.step_single(action, encode)
        except BaseException as error:  # noqa: BLE001
            raise self._failed("step", error) from None

    def send(self, actions: Any, encode: Callable[[Any], bytes]) -> None:
        """Request a step without waiting for the reply. `recv` returns its outcome."""
        self._call("step", self._native.send, actions, encode)

    def recv(self) -> _native.Stepped:
        """Wait for the reply to the oldest step that was sent, and return its outcome."""
        return self._call("step", self._native.recv)

    def reset(
        self, mask: bytes, seeds: Sequence[int], parameters: Intervals, states: bytes
    ) -> tuple[NDArray[np.float32], _native.Events]:
        """Begin new episodes in the environments that the mask selects.

        Returns the observations [N, O] of all environments, and the episodes that began. The rows of the other
        environments are their last observations.
        """
        return self._call("reset", self._native.reset, mask, seeds, parameters, states)

    def last_ended(self) -> NDArray[np.bool_]:
        """Return a mask [N] of the environments whose episode ended in the last step.

        Environments that were reset or restored since are left out.
        """
        return self._native.last_ended()

    @property
    def under_way(self) -> int:
        """The number of steps that were sent and whose reply was not received yet."""
        return self._native.under_way

    def snapshot(self, mask: bytes) -> list[bytes]:
        """Save the environments that the mask selects, one snapshot each. An empty mask selects all."""
        return self._call("snapshot", self._native.snapshot, mask)

    def restore(self, mask: bytes, snapshots: Sequence[bytes]) -> NDArray[np.float32]:
        """Restore snapshots into the environments that the mask selects.

        Returns the observations [N, O] of all environments. The rows of the other environments are their last
        observations.
        """
        return self._call("restore", self._native.restore, mask, snapshots)

    def restored(self) -> bool:
        """Whether the server restored a snapshot in this session. Then only the server knows the parameters."""
        return self._native.restored

    def render(self, slot: int, width: int, height: int) -> NDArray[np.uint8]:
        """Draw the environment in a slot. Return a picture, uint8 [height, width, 3]."""
        return self._call("render", self._native.render, slot, width, height)

    def poll_io(self) -> None:
        """Answer the server's keepalive pings. The keepalive thread calls this method."""
        self._native.poll_io()

    def close(self) -> None:
        """End the session. The server then frees its environments."""
        self._lost = self._lost or "it was closed"
        self._close()
        _close_unclosed()

    def _close(self) -> None:
        if self._forget.detach() is not None:
            _close(*self._resources)

    def _call(self, kind: str, call: Callable[..., Reply], *arguments: Any, **fields: Any) -> Reply:
        loads = self._compiles or (self._embedded and kind in ("open", "render"))
        try:
            if loads:
                # Release this lock before `_failed` closes the session. Closing waits for the lock of `local_server`,
                # which another thread may hold while it starts a server.
                with embedded_server.loading:
                    return call(*arguments, **fields)
            return call(*arguments, **fields)
        except BaseException as error:  # noqa: BLE001  (KeyboardInterrupt also ends a session)
            raise self._failed(kind, error) from None

    def _failed(self, kind: str, error: BaseException) -> BaseException:
        """Return the error to raise in place of one of the native module. Close a session that is no longer usable.

        `kind` is the kind of request, such as `step`.
        """
        if not isinstance(error, _native.Failure):
            if not self._native.ended:
                return error  # the actions had a wrong shape or type, and nothing was sent
            # Ctrl-C interrupted the wait for the reply, so end the session. Otherwise the late reply would be taken for
            # the reply to the next request.
            self._lost = self._lost or f"the wait for the reply to {kind} was interrupted"
            self._close()
            return error
        what, code, words = error.args
        if what == "refused":
            if code == UNAUTHENTICATED:  # a token that is missing, wrong or revoked ends the stream
                return self._fail(self._explain(kind, what, code, words))
            refused = refusal(kind, code, words)
            # A refused request changes nothing, so the session continues. Only a bug in the server ends the session.
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
        """Return an error whose message says what ended the stream, and what to do."""
        where = "the embedded server" if self.address == EMBEDDED else f"the server at {self.address}"
        lost = f"lost {where} during {kind}"
        if what == "timed out":
            return ServerTimeoutError(
                f"{where} did not answer {kind} within {self._limit:g} s; "
                "look at its log, or give slow environments more time with timeout="
            )
        if what == "mismatch":
            remedy = "do the server and this package have the same version?"
            return ProtocolError(f"{where} answered {kind} with {words}: {remedy}")
        if code == RESOURCE_EXHAUSTED:
            return ServerFullError(f"{where} refused {kind}: {words}")
        if code == OUT_OF_RANGE:
            return InvalidArgumentError(
                f"{where} refused {kind}, which is too large for it: {words}; "
                "start it with a larger --max-message-bytes, or use fewer environments"
            )
        if code == UNAUTHENTICATED and what == "unreachable":  # wrong certificate or credentials, or TLS not requested
            return ServerConnectionError(f"no safe connection to {where}: {words}")
        if code == UNAUTHENTICATED:
            return ServerConnectionError(f"{where} refuses this process: {words}")
        if code == UNIMPLEMENTED:
            return ProtocolError(f"the program at {self.address} is not a perturb-server: {words}")
        if isinstance(self._local, LocalServer):
            with contextlib.suppress(subprocess.TimeoutExpired):
                status = self._local.process.wait(1)
                return ServerConnectionError(
                    f"{lost}: this process's perturb-server ended with status {status}; reset() starts another"
                )
        if self.address == EMBEDDED:
            return ServerConnectionError(f"{lost}: {words}; reset() begins anew")
        if not self._opened:
            return ServerConnectionError(
                f"no server answers at {self.address}: {words}; "
                f"start one with `perturb-server --listen {_listen(self.address)}`, or correct server="
            )
        pause = _keepalive.longest_pause()
        if pause >= PAUSE_LIMIT and code != DEADLINE_EXCEEDED:  # this code means that the session was idle
            return ServerConnectionError(
                f"{lost}: {words}. This process did not run for {pause:.0f} s (Ctrl-Z, a debugger, a suspended "
                "computer, or code that holds Python's lock), and did not answer the server's keepalive pings "
                "meanwhile; start the server with a longer --keepalive-seconds; reset() begins anew"
            )
        return ServerConnectionError(f"{lost}: {words}; reset() begins anew when it runs again")


def _listen(address: Address) -> str:
    """Return the text after `--listen` in a command that starts perturb-server at an address.

    With TLS, the text also has the options for the certificate and its key.
    """
    text = str(address)
    if text.startswith("unix:"):
        return text
    rest = text.removeprefix("https://")
    guards = " --tls-cert FILE --tls-key FILE" if rest != text else ""
    return f"tcp://{rest}{guards}"


# Everything needed to close a session: the stream, the private or embedded server (None for another server), and the id
# of the process that opened the session.
_Resources: TypeAlias = "tuple[_native.Session, LocalServer | EmbeddedServer | None, int]"
# The resources of sessions that were deleted without a call of `close`. The keepalive thread closes these sessions, or
# the next call that opens or closes a session does.
_unclosed: collections.deque[_Resources] = collections.deque()


def _close_unclosed(*, wait: bool = True) -> None:
    """Close the sessions that were deleted without a call of `close`.

    Another thread may be starting a server, and then holds a lock that is needed here. If `wait` is false, leave the
    remaining sessions for a later call instead of waiting for that lock.
    """
    with contextlib.suppress(IndexError):  # another thread may have taken the last entry
        while True:
            resources = _unclosed.popleft()
            if not _close(*resources, wait=wait):
                _unclosed.appendleft(resources)
                return


def _close(
    native: _native.Session, local: LocalServer | EmbeddedServer | None, owner: int, *, wait: bool = True
) -> bool:
    """Close a session. Return False if its server could not be released; the caller must then call again later."""
    if os.getpid() != owner:
        return True  # a forked process must not close the session of its parent
    native.close()  # a second call does nothing
    return local is None or local_server.release(local, wait=wait)


def _now() -> float:
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class _KeepaliveThread:
    """A thread that answers keepalive pings for idle sessions, whose connections have no thread of their own."""

    def __init__(self) -> None:
        self._sessions: weakref.WeakSet[Session] = weakref.WeakSet()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()
        # Time of the thread's last run, s. The clock also counts while the computer is suspended.
        self._last_run = _now()
        # The longest recent pause of this process: its length, and the time of its end, s.
        self._pause = (0.0, 0.0)

    def longest_pause(self) -> float:
        """Return the length of the longest pause of this process that ended in the last minute, s.

        Without a pause, the result is near 0: usually a few milliseconds, or negative, but at least -`POLL_INTERVAL`.
        """
        self._note_pause()
        length, end = self._pause
        return length if _now() - end < PAUSE_MEMORY else 0.0

    def _note_pause(self) -> None:
        now = _now()
        length = now - self._last_run - POLL_INTERVAL
        if self._thread is not None and (length >= self._pause[0] or now - self._pause[1] >= PAUSE_MEMORY):
            self._pause = (length, now)

    def add(self, session: Session) -> None:
        with self._lock:
            self._sessions.add(session)
            if self._thread is None:
                self._last_run = _now()
                self._thread = start_thread("perturb-keepalive", self._run)

    def end(self) -> None:
        """End the thread before Python exits. No thread may run in the native module while Python exits."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()

    def sessions(self) -> list[Session]:
        """Return the sessions that `add` was called with and that Python has not deleted."""
        with self._lock:
            return list(self._sessions)

    def _run(self) -> None:
        while not self._ended.wait(POLL_INTERVAL):
            self._note_pause()
            self._last_run = _now()
            # A separate function, so that no local variable keeps a session alive during the wait.
            self._poll_sessions()
            _close_unclosed(wait=False)  # pings must be answered even while another thread starts a server

    def _poll_sessions(self) -> None:
        for session in self.sessions():
            session.poll_io()


_keepalive = _KeepaliveThread()


def _after_fork_in_child() -> None:
    global _keepalive
    _keepalive = _KeepaliveThread()


def _at_exit() -> None:
    _keepalive.end()
    for session in _keepalive.sessions():
        session.close()
    _close_unclosed()


os.register_at_fork(after_in_child=_native.note_fork)
os.register_at_fork(after_in_child=_after_fork_in_child)
# Python calls exit handlers in reverse order, so this one closes the sessions before `local_server` ends its servers.
atexit.register(_at_exit)
