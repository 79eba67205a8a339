"""Helpers for other processes: Python programs that the tests start, and servers that they stop."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

# Time limit, in seconds, for events that should take a few seconds. The limit is long because the machine may be busy.
# It is shorter than the default timeout of replies, 60 s.
SECONDS = 30.0


@contextlib.contextmanager
def within(seconds: float) -> Iterator[None]:
    start = time.monotonic()
    yield
    assert time.monotonic() - start < seconds


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + SECONDS
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def runs(pid: int) -> bool:
    """Whether the process with this id is running."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


def python(*arguments: str) -> subprocess.Popen[str]:
    """Start another Python process that can import these tests. It has its own process group, because it may fork."""
    # Python 3.12 and later warn of every fork of a process with threads.
    return subprocess.Popen(
        [sys.executable, "-W", "ignore::DeprecationWarning", *arguments],
        cwd=Path(__file__).parents[1],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def output_of(*arguments: str, seconds: float = 60) -> tuple[str, str]:
    """Run another Python process. Return its output and errors. Raise TimeoutExpired if it does not end in time."""
    process = python(*arguments)
    try:
        return process.communicate(timeout=seconds)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def freeze(pid: int) -> None:
    """Stop the process with SIGSTOP, and wait until all its threads are stopped. SIGCONT continues it."""
    os.kill(pid, signal.SIGSTOP)
    threads = [thread / "stat" for thread in Path(f"/proc/{pid}/task").iterdir()]
    wait_until(lambda: all(thread.read_text().rpartition(")")[2].split()[0] == "T" for thread in threads))
