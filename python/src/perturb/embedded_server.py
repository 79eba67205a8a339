"""The embedded server, which runs the same environments as perturb-server in this process, without a connection."""

from __future__ import annotations

import os
import threading
from typing import TYPE_CHECKING

from . import _native
from .address import EMBEDDED
from .errors import InvalidArgumentError, ServerStartError
from .local_server import find_program

if TYPE_CHECKING:
    from .local_server import TaskFolder

# A lock that is held while models are loaded, compiled or drawn, and during a fork. A fork thus waits for this work.
# Otherwise the forked process could inherit locks that the work holds and that no thread releases. A thread that holds
# the lock of `local_server` must not wait for this lock.
loading = threading.RLock()


class EmbeddedServer:
    """A server that runs in this process until `end` is called."""

    address = EMBEDDED

    def __init__(self, task: TaskFolder | None = None) -> None:
        self.task = task
        self.users = 0
        try:
            with loading:
                # A broken model can kill the process that loads it, so a perturb-server process loads the model first.
                self.native = _native.NativeServer(None if task is None else (find_program(), task.path, task.files))
        except _native.Failure as error:
            kind, _, words = error.args
            if kind == "invalid":
                raise InvalidArgumentError(words) from None
            raise ServerStartError(f"the embedded server did not start: {words}") from None

    def end(self) -> None:
        """End the server's threads. The caller must close all sessions of the server first."""
        self.native.close()

    def exit_status(self) -> int | None:
        """Return None, because the server does not end before `end` is called."""
        return None


os.register_at_fork(before=loading.acquire, after_in_parent=loading.release, after_in_child=loading.release)
