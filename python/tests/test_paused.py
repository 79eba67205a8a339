"""A client process that was stopped for too long loses its session, and the error says why."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable

CHILD = """
import sys
import gymnasium, numpy as np, perturb
envs = perturb.PerturbVectorEnv("CartPole", 4, server=sys.argv[1])
envs.reset(seed=1)
print("ready", flush=True)
for line in sys.stdin:
    try:
        envs.step(np.zeros(4, np.int64))
        print("stepped", flush=True)
    except perturb.PerturbError as error:
        print(type(error).__name__, error, flush=True)
        envs.reset(seed=1)
        print("again", flush=True)
"""


def paused(address: str, seconds: float) -> list[str]:
    """Stop a client process for some seconds, and return the lines that it prints afterwards."""
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, address], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert child.stdin is not None
    assert child.stdout is not None
    assert child.stdout.readline() == "ready\n"
    os.kill(child.pid, signal.SIGSTOP)
    time.sleep(seconds)
    os.kill(child.pid, signal.SIGCONT)
    child.stdin.write("\n")
    child.stdin.close()
    said = child.stdout.read().splitlines()
    assert child.wait(30) == 0
    return said


@pytest.mark.parametrize(
    ("flag", "says"),
    [
        (
            "--keepalive-seconds",
            "This process did not run for 5 s .* start the server with a longer --keepalive-seconds",
        ),
        ("--idle-seconds", "the session was idle for 1 s"),
    ],
)
def test_error_after_a_pause_names_its_cause(flag: str, says: str, start_server: Callable[..., Any]) -> None:
    address = start_server(flag, "1", listen="tcp://127.0.0.1:0").address
    lost, again = paused(address, 5)
    assert lost.startswith("ServerConnectionError lost the server at")
    assert re.search(says, lost), lost
    assert again == "again"
    assert ("did not run" in lost) == (flag == "--keepalive-seconds")


def test_short_pause_does_not_end_the_session(start_server: Callable[..., Any]) -> None:
    assert paused(start_server(listen="tcp://127.0.0.1:0").address, 1.5) == ["stepped"]
