"""Ctrl-C during a step takes effect at once. A later request never receives the reply to the interrupted step."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import threading
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import perturb
from perturb import session

from .processes import SECONDS, freeze, output_of, wait_until, within

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

# Number of interrupts. `make interrupts-test` sets it to 1000.
TIMES = int(os.environ.get("PERTURB_TEST_INTERRUPTS", "50"))


@contextlib.contextmanager
def interrupting(envs: perturb.PerturbVectorEnv) -> Iterator[None]:
    """Interrupt the step in the `with` block while it waits, with a signal that pytest does not handle."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    def interrupt_the_step() -> None:
        wait_until(lambda: envs._client.session.waits)
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGUSR1)

    before = signal.signal(signal.SIGUSR1, interrupt)
    interrupter = threading.Thread(target=interrupt_the_step, daemon=True)
    try:
        interrupter.start()
        with within(SECONDS), pytest.raises(KeyboardInterrupt):
            yield
    finally:
        interrupter.join()
        signal.signal(signal.SIGUSR1, before)


def test_reset_does_not_receive_the_reply_to_an_interrupted_step(start_server: Callable[..., Any]) -> None:
    running = start_server()
    envs = perturb.PerturbVectorEnv("Hopper", 4, server=running.address)
    expected = envs.reset(seed=2)[0].tobytes()
    actions = np.zeros((4, 3), dtype=np.float32)
    freeze(running.process.pid)  # the step must still be waiting when the interrupt comes
    with interrupting(envs):
        envs.step(actions)
    with pytest.raises(perturb.OutOfOrderError, match="interrupted"):
        envs.step(actions)
    running.process.send_signal(signal.SIGCONT)
    assert envs.reset(seed=2)[0].tobytes() == expected
    envs.close()


def test_a_reset_works_after_a_second_interrupt(
    start_server: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the second interrupt prevents the session from being marked as lost, a reset still opens a new session."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    running = start_server()
    envs = perturb.PerturbVectorEnv("CartPole", 4, server=running.address)
    expected = envs.reset(seed=2)[0].tobytes()
    actions = np.zeros(4, dtype=np.int64)
    freeze(running.process.pid)
    with monkeypatch.context() as patched, interrupting(envs):
        patched.setattr(session.Session, "_failed", interrupt)
        envs.step(actions)
    with pytest.raises(perturb.OutOfOrderError, match=r"call reset\(\) to open a new one.* interrupted"):
        envs.step(actions)
    running.process.send_signal(signal.SIGCONT)
    assert envs.reset(seed=2)[0].tobytes() == expected
    envs.close()


INTERRUPTED = """
import os, signal, threading, time, numpy as np, perturb
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have started the tests with SIGINT ignored
envs = perturb.PerturbVectorEnv("CartPole", 4, server={address!r}, timeout=float("inf"))
envs.reset(seed=1)
os.kill({server}, signal.SIGSTOP)
tasks = "/proc/{server}/task"
while any(open(f"{{tasks}}/{{task}}/stat").read().rsplit(")", 1)[1].split()[0] != "T" for task in os.listdir(tasks)):
    time.sleep(0.01)  # until all its threads are stopped, the server may still answer

def interrupt():
    while not envs._client.session.waits:
        time.sleep(0.01)
    os.kill(os.getpid(), signal.SIGINT)
    sent.append(time.monotonic())

sent = []
threading.Thread(target=interrupt).start()
try:
    envs.step(np.zeros(4, dtype=np.int64))
except KeyboardInterrupt:
    print("interrupted", time.monotonic() - sent[0] < 10)
"""


def test_ctrl_c_interrupts_a_step_at_once_and_the_process_ends(start_server: Callable[..., Any]) -> None:
    running = start_server()
    code = INTERRUPTED.format(address=running.address, server=running.process.pid)
    with within(SECONDS):
        out, errors = output_of("-c", code)
        assert (out, errors) == ("interrupted True\n", ""), errors


def test_many_interrupts_never_hang_or_mix_replies(start_server: Callable[..., Any]) -> None:
    running = start_server("--max-sessions", "8")  # sessions that are not closed would exceed this limit
    arguments = (running.address, str(running.process.pid), str(TIMES))
    out, errors = output_of("-m", "tests.interrupted", *arguments, seconds=SECONDS + TIMES)
    assert errors == "", errors
    print(out)
    counts = json.loads(out)
    assert counts["went on"] > 0, counts
    assert counts["gone"] > 0, counts
    assert counts["went on"] + counts["gone"] == TIMES, counts
    assert counts["slowest"] < 10, counts
