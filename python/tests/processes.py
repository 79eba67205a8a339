"""Other processes: programs in Python that run beside the tests, and servers that are stopped."""

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

# What "within seconds" means here: the rest is for a machine that is busy. Less than a reply may take unless told
# otherwise, a minute.
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
    """Whether there is such a process that has not ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


def python(*arguments: str) -> subprocess.Popen[str]:
    """Run another Python, which finds these tests, in a group of its own, for it may fork."""
    # Python 3.12 and later warn of every fork beside threads.
    return subprocess.Popen(
        [sys.executable, "-W", "ignore::DeprecationWarning", *arguments],
        cwd=Path(__file__).parents[1],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def output_of(*arguments: str, seconds: float = 60) -> tuple[str, str]:
    """Return the output and the errors of another Python, if it ends in time."""
    process = python(*arguments)
    try:
        return process.communicate(timeout=seconds)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def freeze(pid: int) -> None:
    """Stop the process and wait until every thread stands. SIGCONT continues it."""
    os.kill(pid, signal.SIGSTOP)
    threads = [thread / "stat" for thread in Path(f"/proc/{pid}/task").iterdir()]
    wait_until(lambda: all(thread.read_text().rpartition(")")[2].split()[0] == "T" for thread in threads))
