"""A perturb-server of this process's own, on a private Unix socket, and how environments share it.

All environments that were made without `server=` share one server; those of each `task=` share another one. A server
starts with its first environment and ends with its last. It also ends with this process, however that ends, because
this process holds the other end of its standard input. Environments with `server="embedded"` share embedded servers in
the same way.
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

PROGRAM = "perturb-server"
# Variable that names the program.
VARIABLE = "PERTURB_SERVER"
# The program inside a wheel, if the wheel has it.
BUNDLED = Path(__file__).with_name("_programs") / PROGRAM
# Limit for the start of a server, s.
START_LIMIT = 20.0
# Further limit for the start of a server that loads a task's folder, s.
TASK_LIMIT = 120.0
# Limit for the end of a server, after which it is killed, s.
END_LIMIT = 5.0


def find_program() -> Path:
    """Find the program perturb-server: what PERTURB_SERVER names, else the package's own, else that on PATH.

    Raises:
        ServerStartError: with how to get it.
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
    """A folder with a task.toml, and the state of its files. Environments of equal task folders share a server."""

    # Absolute path.
    path: str
    # Digest of the names, sizes and times of the files that a task can have read.
    files: str


class LocalServer:
    """A running server. It lives no longer than this object, and no longer than this process."""

    def __init__(self, task: TaskFolder | None = None) -> None:
        self.task = task
        self.users = 0
        program = find_program()
        self._owner = os.getpid()
        try:
            directory = tempfile.mkdtemp(prefix="perturb-")  # only its owner may enter
        except OSError as error:
            raise ServerStartError(
                f"the private server {program} did not start: there is no folder for its socket ({error}); "
                "set TMPDIR to a folder that can be written"
            ) from error
        socket = f"{directory}/server.sock"
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
        self._unended.atexit = False  # _at_exit ends what is left, after the sessions
        _running.add(self)
        self._wait_until_ready(program)

    def end(self) -> None:
        """End the server and wait until it has ended. Close its sessions first."""
        # Not by a call of the finalizer: finalizers do nothing any more when _at_exit runs.
        if self._unended.detach() is not None:
            _end(self.process, self._directory, self._owner)

    def exit_status(self) -> int | None:
        """Return the exit status, as `subprocess` does, or None while the server runs."""
        return self.process.poll()

    def forget_in_child(self) -> None:
        """In a forked process: let go of the pipe, so that the server ends with the parent alone."""
        if self.process.stdin is not None:
            self.process.stdin.close()

    def _wait_until_ready(self, program: Path) -> None:
        lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        # Reads to the end of the output, so that the server never waits for a reader.
        threading.Thread(target=_read, args=(self.process.stdout, lines), daemon=True).start()
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
                reason = f"it ended with status {self.process.wait()} before it listened; its messages are above"
            self.end()
            raise ServerStartError(f"the private server {program} did not start: {reason}")


class OwnServer(Protocol):
    """A server of this process's own, which environments share."""

    task: TaskFolder | None
    users: int

    def __init__(self, task: TaskFolder | None = None) -> None: ...

    def end(self) -> None:
        """End the server. Close its sessions first."""

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
        start_new_session=True,  # Ctrl-C is for the learner, which may still want its environments
    )


def _read(output: IO[bytes], lines: queue.SimpleQueue[str | None]) -> None:
    with output:
        for line in output:
            lines.put(line.decode(errors="replace"))
    lines.put(None)


def _end(process: subprocess.Popen[bytes], directory: str, owner: int) -> None:
    if os.getpid() != owner:
        return  # the parent's server is not a forked process's to end
    if process.stdin is not None:
        with contextlib.suppress(OSError):
            process.stdin.close()
    try:
        process.wait(END_LIMIT)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    shutil.rmtree(directory, ignore_errors=True)


# Every server whose pipe this process holds.
_running: weakref.WeakSet[LocalServer] = weakref.WeakSet()
_lock = threading.Lock()
# The servers that run, by their kind and their task's folder; None for the server without one.
_shared: dict[tuple[type[OwnServer], TaskFolder | None], Any] = {}


def acquire(kind: type[Server], task: TaskFolder | None = None) -> Server:
    """Share this process's server of a kind for a task, or for none; start it if it does not run.

    Raises:
        ServerStartError: if there is no program, or it does not start.
    """
    with _lock:
        server: Server | None = _shared.get((kind, task))
        if server is None or server.exit_status() is not None:
            server = kind(task)
            _shared[kind, task] = server
        server.users += 1
        return server


def release(server: OwnServer, *, wait: bool = True) -> bool:
    """Give up a share of a server. The last release ends the server.

    Without `wait`, return False and do nothing if another thread holds the lock, for instance to start a server.
    """
    lock = _lock
    if not lock.acquire(blocking=wait):
        return False
    try:
        key = type(server), server.task
        if server is not _shared.get(key):
            return True  # it died and was replaced
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
