"""Private servers: perturb-server processes that this process starts, and that listen on private Unix sockets.

All environments without `server=` and `task=` share one private server. The environments of each task folder share
another one. A private server is started by its first session and ends with its last. It also ends when this process
ends or is killed, because then the pipe to the server's standard input is closed. Sessions with `server="embedded"`
share embedded servers in the same way.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import queue
import shutil
import subprocess
import tempfile
import threading
import time
import weakref
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Protocol, TypeVar

from .address import Address, parse_address
from .catalogue import MAX_SOCKET_PATH_BYTES
from .errors import PerturbError, ServerStartError
from .threads import start_thread

PROGRAM = "perturb-server"
# Environment variable with the path of the program `perturb-server`.
VARIABLE = "PERTURB_SERVER"
# Path of `perturb-server` inside an installed wheel. Some wheels do not contain it.
BUNDLED = Path(__file__).with_name("_programs") / PROGRAM
# Maximum time for a server to start, s.
START_LIMIT = 20.0
# Additional time for a server that loads a task folder, s.
TASK_LIMIT = 120.0
# Maximum time for a server to end, s. Then it is killed.
END_LIMIT = 5.0


def find_program() -> Path:
    """Find the program perturb-server.

    If the environment variable PERTURB_SERVER is set, it names the program. Otherwise the program is the one inside the
    package, or else the first on PATH.

    Raises:
        ServerStartError: if there is no such program. The message says how to install it.
    """
    how = (
        "install a wheel that has it (`make wheel`), build it with `make build` in a clone of perturb and set "
        "PERTURB_SERVER to target/release/perturb-server, "
        "or name a running server: server='unix:/path' or server='host:port'"
    )
    named = os.environ.get(VARIABLE)
    if named:
        found = shutil.which(named)
        if found is None:
            raise ServerStartError(f"{VARIABLE}={named} is not a program that can be run; {how}")
        return Path(found)
    found = shutil.which(BUNDLED) or shutil.which(PROGRAM)
    if found is None:
        raise ServerStartError(
            f"the program {PROGRAM} is not on PATH, {VARIABLE} is not set, and the package was installed without it; "
            f"{how}"
        )
    return Path(found)


@dataclass(frozen=True)
class TaskFolder:
    """A task folder and the state of its files. Environments share a server if their folder and its state are equal."""

    # Absolute path of the folder.
    path: str
    # Digest of the names, sizes and modification times of all files in the folder that a task may read.
    files: str


def _is_utf8(path: str) -> bool:
    try:
        path.encode()
    except UnicodeEncodeError:  # Python represents bytes that are not UTF-8 by characters that cannot be encoded
        return False
    return True


class LocalServer:
    """A running private server. It ends when this object is deleted, or when this process ends."""

    def __init__(self, task: TaskFolder | None = None) -> None:
        self.task = task
        self.users = 0
        program = find_program()
        self._owner = os.getpid()
        try:
            directory = tempfile.mkdtemp(prefix="perturb-")  # only this user may enter it
        except OSError as error:
            raise ServerStartError(
                f"the private server {program} did not start: there is no folder for its socket ({error}); "
                "set TMPDIR to a folder that can be written"
            ) from error
        socket = f"{directory}/server.sock"
        if not _is_utf8(socket):
            shutil.rmtree(directory, ignore_errors=True)
            raise ServerStartError(
                f"the private server {program} did not start: the path of its socket, {socket!r}, is not UTF-8; set "
                "TMPDIR to another folder, such as /tmp"
            )
        if len(socket.encode()) > MAX_SOCKET_PATH_BYTES:
            shutil.rmtree(directory, ignore_errors=True)
            raise ServerStartError(
                f"the private server {program} did not start: the path of its socket, {socket}, is longer than the "
                f"{MAX_SOCKET_PATH_BYTES} bytes that Linux allows; set TMPDIR to a folder with a shorter path, such as "
                "/tmp"
            )
        try:
            self.address: Address = parse_address(f"unix:{socket}")
            self.process = _spawn(program, self.address, task)
        except (PerturbError, OSError) as error:
            shutil.rmtree(directory, ignore_errors=True)
            raise ServerStartError(f"the private server {program} did not start: {error}") from error
        self._directory = directory
        self._unended = weakref.finalize(self, _end, self.process, directory, self._owner)
        self._unended.atexit = False  # _at_exit ends remaining servers, after the sessions were closed
        _running.add(self)
        self._wait_until_ready(program)

    def end(self) -> None:
        """End the server and wait until it has ended. The caller must close all sessions of the server first."""
        # Call the function `_end` directly. A call of the finalizer would do nothing while Python exits, which is when
        # `_at_exit` calls this method.
        if self._unended.detach() is not None:
            _end(self.process, self._directory, self._owner)

    def exit_status(self) -> int | None:
        """Return the exit status in the form of `Popen.returncode`, or None while the server runs."""
        return self.process.poll()

    def forget_in_child(self) -> None:
        """Close a forked process's copy of the pipe, so that the server ends when the parent process ends."""
        if self.process.stdin is not None:
            self.process.stdin.close()

    def _wait_until_ready(self, program: Path) -> None:
        lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        # Start a thread that reads all of the server's output, so that the server never blocks on a full pipe.
        try:
            start_thread("perturb-server-output", _read, self.process.stdout, lines)
        except PerturbError as error:
            self.end()
            raise ServerStartError(f"the private server {program} did not start: {error}") from error
        limit = START_LIMIT if self.task is None else START_LIMIT + TASK_LIMIT
        deadline = time.monotonic() + limit
        while True:
            try:
                line = lines.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                reason = f"it did not listen within {limit:.0f} s"
            else:
                if line is not None and line.startswith("listening on "):
                    return
                if line is not None:
                    continue
                status = self.process.wait()
                reason = f"it ended with status {status} before it listened; its messages are on standard error"
            self.end()
            raise ServerStartError(f"the private server {program} did not start: {reason}")


class OwnServer(Protocol):
    """A private or embedded server of this process, which sessions share. `users` counts these sessions."""

    task: TaskFolder | None
    users: int

    def __init__(self, task: TaskFolder | None = None) -> None: ...

    def end(self) -> None:
        """End the server. The caller must close all sessions of the server first."""

    def exit_status(self) -> int | None:
        """Return the exit status, or None while the server runs."""


Server = TypeVar("Server", bound=OwnServer)


def _spawn(program: Path, address: Address, task: TaskFolder | None) -> subprocess.Popen[bytes]:
    folder = [] if task is None else ["--task", task.path]
    return subprocess.Popen(
        [program, "--private", "--log", "error", "--listen", str(address), *folder],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        bufsize=0,
        start_new_session=True,  # Ctrl-C interrupts only this process, which may still need its environments
    )


def _read(output: IO[bytes], lines: queue.SimpleQueue[str | None]) -> None:
    with output:
        for line in output:
            lines.put(line.decode(errors="replace"))
    lines.put(None)


def _end(process: subprocess.Popen[bytes], directory: str, owner: int) -> None:
    if os.getpid() != owner:
        return  # a forked process must not end the server of its parent
    if process.stdin is not None:
        with contextlib.suppress(OSError):
            process.stdin.close()
    try:
        process.wait(END_LIMIT)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    shutil.rmtree(directory, ignore_errors=True)


# The private servers that this process started and that were not deleted.
_running: weakref.WeakSet[LocalServer] = weakref.WeakSet()
_lock = threading.Lock()
# The shared servers, by class and task folder. The task folder is None for a server of the built-in environments.
_shared: dict[tuple[type[OwnServer], TaskFolder | None], Any] = {}


def acquire(kind: type[Server], task: TaskFolder | None = None) -> Server:
    """Return the server of class `kind` that all sessions of this process with the same task folder share.

    Start the server if it does not run. For each call, `release` must be called once.

    Raises:
        ServerStartError: if the program was not found, or the server did not start.
    """
    with _lock:
        server: Server | None = _shared.get((kind, task))
        if server is None or server.exit_status() is not None:
            server = kind(task)
            _shared[kind, task] = server
        server.users += 1
        return server


def release(server: OwnServer, *, wait: bool = True) -> bool:
    """Release a server that `acquire` returned. End the server if no session uses it any more.

    Return True if the server was released. If `wait` is false and another thread holds the lock, for example to start a
    server, do nothing and return False.
    """
    lock = _lock
    if not lock.acquire(blocking=wait):
        return False
    try:
        key = type(server), server.task
        if server is not _shared.get(key):
            return True  # the server died and another one replaced it
        server.users -= 1
        if server.users > 0:
            return True
        del _shared[key]
    finally:
        lock.release()
    server.end()
    return True


def _after_fork_in_child() -> None:
    global _lock
    _lock = threading.Lock()
    _shared.clear()
    for server in list(_running):
        server.forget_in_child()
    _running.clear()


def _at_exit() -> None:
    for server in list(_running):
        server.end()


os.register_at_fork(after_in_child=_after_fork_in_child)
atexit.register(_at_exit)
