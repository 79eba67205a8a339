"""A session: one stream to a server, which owns a batch of environments. Requests go out, replies come back in order.

gRPC's threads do not survive a fork. So a session belongs to the process that opened it, and is opened when it is first
needed, not when an environment is made: a process that is forked in between opens its own.
"""

from __future__ import annotations

import atexit
import collections
import contextlib
import os
import queue
import subprocess
import sys
import threading
import time
import weakref
from typing import TYPE_CHECKING, Any, TypeAlias

# gRPC reads this once, when it is first imported. Without it a process that is forked from one with open channels hangs
# in its first call.
GRPC_WAS_IMPORTED = "grpc" in sys.modules
os.environ.setdefault("GRPC_ENABLE_FORK_SUPPORT", "1")

import grpc  # noqa: E402

from . import local_server  # noqa: E402
from ._proto import perturb_pb2 as pb  # noqa: E402
from .errors import (  # noqa: E402
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
    from .address import Address

SERVICE = pb.DESCRIPTOR.services_by_name["Perturb"].full_name
# Which reply each request gets.
REPLIES = {
    "open": "opened",
    "step": "stepped",
    "reset": "reset",
    "snapshot": "snapshot",
    "restore": "restore",
    "render": "render",
}
# How long a connection may take to be made, s.
CONNECT_LIMIT = 10
# How often a silent server is asked whether it lives, and how long it may take to answer, s. A very busy machine is no
# reason to lose environments; the sockets of a server that ended are closed by its system at once.
KEEPALIVE_INTERVAL, KEEPALIVE_LIMIT = 10, 20
# How often the watchdog looks for requests that are overdue, s.
WATCH_INTERVAL = 0.25


class Session:
    """The stream. `server` is an address, or None for this process's own server.

    A session that is lost (the server died, a reply took too long, the wait for it was interrupted) stays lost.
    """

    def __init__(self, server: Address | None, timeout: float) -> None:
        _close_forgotten()
        self._local: local_server.LocalServer | None = None
        if server is None:
            self._local = local_server.acquire()
            server = self._local.address
        self.address: Address = server
        self._owner = os.getpid()
        self._timeout = timeout
        self._lost: str | None = None
        self._opened = False
        # When the reply that is waited for is overdue. Under the lock the watchdog sees that of the present call, or
        # none: it cannot blame the next one.
        self.deadline: float | None = None
        self._overdue = False
        self._watched = threading.Lock()
        self._requests: queue.SimpleQueue[pb.SessionRequest | None] = queue.SimpleQueue()
        self._channel = grpc.insecure_channel(str(self.address), options=_channel_options(self.address))
        self._responses: Any = self._channel.stream_stream(
            f"/{SERVICE}/Session",
            request_serializer=pb.SessionRequest.SerializeToString,
            response_deserializer=pb.SessionResponse.FromString,
        )(iter(self._requests.get, None))
        self._parts: _Parts = (self._requests, self._responses, self._channel, self._local, self._owner)
        # Wherever Python happens to collect a forgotten session, also where a lock is held: so nothing but this.
        self._forget = weakref.finalize(self, _forgotten.append, self._parts)
        self._forget.atexit = False  # _at_exit closes what is left
        _watchdog.watch(self)

    def usable(self) -> bool:
        """Whether requests can be sent: it is neither lost nor another process's."""
        return self._lost is None and os.getpid() == self._owner

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
        if self._lost is not None:
            raise OutOfOrderError(f"call reset() to begin anew, this environment is gone: {self._lost}")

    def open(self, request: pb.Open) -> pb.Opened:
        """Create the environments and begin their first episodes."""
        opened: pb.Opened = self._call("open", pb.SessionRequest(open=request))
        self._opened = True
        return opened

    def step(self, actions: bytes) -> pb.Stepped:
        """Advance every environment."""
        stepped: pb.Stepped = self._call("step", pb.SessionRequest(step=pb.Step(actions=actions)))
        return stepped

    def reset(self, request: pb.Reset) -> pb.ResetDone:
        """Begin new episodes."""
        done: pb.ResetDone = self._call("reset", pb.SessionRequest(reset=request))
        return done

    def snapshot(self, request: pb.Snapshot) -> pb.Snapshotted:
        """Save environments."""
        saved: pb.Snapshotted = self._call("snapshot", pb.SessionRequest(snapshot=request))
        return saved

    def restore(self, request: pb.Restore) -> pb.Restored:
        """Bring saved environments back."""
        restored: pb.Restored = self._call("restore", pb.SessionRequest(restore=request))
        return restored

    def render(self, request: pb.Render) -> pb.Rendered:
        """Draw an environment."""
        rendered: pb.Rendered = self._call("render", pb.SessionRequest(render=request))
        return rendered

    def close(self) -> None:
        """End the session; the server frees its environments."""
        self._lost = self._lost or "it was closed"
        self._close()
        _close_forgotten()

    def _close(self) -> None:
        if self._forget.detach() is not None:
            _close(*self._parts)

    def expire(self, now: float) -> None:
        """Give up waiting for the reply, if it is overdue; called by the watchdog."""
        with self._watched:
            if self.deadline is not None and now > self.deadline:
                self.deadline = None
                self._overdue = True
                self._responses.cancel()

    def _call(self, kind: str, request: pb.SessionRequest) -> Any:
        self.require_usable()
        self._lost = f"the wait for the reply to {kind} was interrupted"  # unless it comes, or fails otherwise
        try:
            with self._watched:
                self.deadline = time.monotonic() + self._timeout
            self._requests.put(request)
            response = next(self._responses)
        except grpc.RpcError as error:
            raise self._fail(self._explain(kind, error)) from error
        except StopIteration:
            raise self._fail(ServerConnectionError(f"{self._lost_during(kind)}: it ended the stream")) from None
        except BaseException:  # Ctrl-C: the reply to come would be taken for that to the next request
            self._close()
            raise
        finally:
            with self._watched:
                self.deadline = None
        if self._overdue:  # the reply and the end of the wait for it crossed: the stream is cancelled
            raise self._fail(self._timed_out(kind))
        self._lost = None
        answered = response.WhichOneof("response")
        if answered == "error":
            refused = refusal(kind, response.error.code, response.error.message)
            # A refusal changes nothing; a defect of the server costs the environments.
            raise self._fail(refused) if isinstance(refused, ServerDefectError) else refused
        if answered != REPLIES[kind]:
            what = f"the server at {self.address} answered {kind} with {answered}: are both of one version?"
            raise self._fail(ProtocolError(what))
        return getattr(response, answered)

    def _fail(self, error: PerturbError) -> PerturbError:
        self._lost = str(error)
        self._close()
        return error

    def _lost_during(self, kind: str) -> str:
        return f"lost the server at {self.address} during {kind}"

    def _timed_out(self, kind: str) -> ServerTimeoutError:
        forked = (
            " (gRPC was imported before perturb, and cannot be used in forked processes then: import perturb first)"
        )
        hint = forked if GRPC_WAS_IMPORTED and not self._opened else ""
        return ServerTimeoutError(
            f"the server at {self.address} did not answer {kind} within {self._timeout:g} s{hint}; "
            "look at its log, or give slow environments more time with timeout="
        )

    def _explain(self, kind: str, error: grpc.RpcError) -> PerturbError:
        """Turn the status that ended the stream into what happened and what to do."""
        status, details = error.code(), error.details()
        if self._overdue:
            return self._timed_out(kind)
        if status is grpc.StatusCode.RESOURCE_EXHAUSTED:
            return ServerFullError(f"the server at {self.address} refused {kind}: {details}")
        if status is grpc.StatusCode.OUT_OF_RANGE:
            return InvalidArgumentError(
                f"the server at {self.address} refused {kind}, which is too large for it: {details}; "
                "start it with a larger --max-message-bytes, or use fewer environments"
            )
        if status is grpc.StatusCode.UNIMPLEMENTED:
            return ProtocolError(f"what answers at {self.address} is no perturb-server: {details}")
        if self._local is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = self._local.process.wait(1)
                return ServerConnectionError(
                    f"{self._lost_during(kind)}: this process's perturb-server ended with status {code}; "
                    "reset() starts another"
                )
        if not self._opened:
            return ServerConnectionError(
                f"no server answers at {self.address}: {details}; "
                f"start one with `perturb-server --listen {_listen(self.address)}`, or correct server="
            )
        return ServerConnectionError(f"{self._lost_during(kind)}: {details}; reset() begins anew when it runs again")


def _listen(address: Address) -> str:
    return str(address) if str(address).startswith("unix:") else f"tcp://{address}"


def _channel_options(address: Address) -> list[tuple[str, int | str]]:
    options: list[tuple[str, int | str]] = [
        ("grpc.max_receive_message_length", -1),
        ("grpc.max_send_message_length", -1),
        # A channel of one's own has no memory of a server that was at this address before.
        ("grpc.use_local_subchannel_pool", 1),
        ("grpc.min_reconnect_backoff_ms", CONNECT_LIMIT * 1000),  # this is also the limit of the first attempt
        ("grpc.keepalive_time_ms", KEEPALIVE_INTERVAL * 1000),
        ("grpc.keepalive_timeout_ms", KEEPALIVE_LIMIT * 1000),
        # Pings of other purposes, which hold back those of keepalive, would be waited for for a minute.
        ("grpc.http2.ping_timeout_ms", (KEEPALIVE_INTERVAL + KEEPALIVE_LIMIT) * 1000),
        ("grpc.http2.max_pings_without_data", 0),
    ]
    if address.local:
        options.append(("grpc.enable_http_proxy", 0))
    if str(address).startswith("unix:"):
        # Otherwise the socket's path is sent as the host's name, which the server refuses.
        options.append(("grpc.default_authority", "localhost"))
    return options


# What of a session has to be closed: requests, responses, channel, the private server, the process that opened it.
_Parts: TypeAlias = tuple[
    "queue.SimpleQueue[pb.SessionRequest | None]", Any, grpc.Channel, "local_server.LocalServer | None", int
]
# Of sessions that nobody closed. The next session that is opened or closed closes them, or the watchdog.
_forgotten: collections.deque[_Parts] = collections.deque()


def _close_forgotten() -> None:
    with contextlib.suppress(IndexError):  # another thread may be at it, too
        while True:
            _close(*_forgotten.popleft())


def _close(
    requests: queue.SimpleQueue[pb.SessionRequest | None],
    responses: Any,
    channel: grpc.Channel,
    local: local_server.LocalServer | None,
    owner: int,
) -> None:
    if os.getpid() != owner:
        _abandoned.append((responses, channel))
        return
    requests.put(None)
    responses.cancel()
    channel.close()
    if local is not None:
        local_server.release(local)


# What a forked process inherited: to destroy another process's channel can hang, so it is kept.
_abandoned: list[object] = []


class _Watchdog:
    """One thread that cancels calls whose reply is overdue: gRPC has deadlines for streams, not for messages."""

    def __init__(self) -> None:
        self._sessions: weakref.WeakSet[Session] = weakref.WeakSet()
        self._lock = threading.Lock()
        self._started = False

    def watch(self, session: Session) -> None:
        with self._lock:
            self._sessions.add(session)
            if not self._started:
                threading.Thread(target=self._run, name="perturb-watchdog", daemon=True).start()
                self._started = True

    def _run(self) -> None:
        while True:
            time.sleep(WATCH_INTERVAL)
            self._look()  # in a frame of its own: a sleeping watchdog keeps no session alive
            _close_forgotten()

    def sessions(self) -> list[Session]:
        """All that somebody holds."""
        with self._lock:
            return list(self._sessions)

    def _look(self) -> None:
        now = time.monotonic()
        for session in self.sessions():
            session.expire(now)


_watchdog = _Watchdog()


def _after_fork_in_child() -> None:
    global _watchdog
    _watchdog = _Watchdog()


def _at_exit() -> None:
    for session in _watchdog.sessions():
        session.close()
    _close_forgotten()


os.register_at_fork(after_in_child=_after_fork_in_child)
atexit.register(_at_exit)  # runs before the private server is ended, which was registered before
