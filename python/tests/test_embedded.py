"""The embedded server behaves like a private server."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode

import perturb
from perturb import _native, local_server
from perturb.embedded_server import EmbeddedServer, loading

from .conftest import ROOT
from .processes import SECONDS, output_of, wait_until, within
from .test_interrupts import interrupting

STEPS = 60


def same(a: Any, b: Any) -> bool:
    """Whether two results of a reset or step have the same types and the same bits."""
    return all(data_equivalence(one, other, exact=True) for one, other in zip(a, b, strict=True))


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_batch_equals_that_of_a_private_server_to_the_last_bit(mode: AutoresetMode) -> None:
    batches = [
        perturb.PerturbVectorEnv("CartPole", 5, version="R", server=server, autoreset_mode=mode, reward_terms=True)
        for server in (None, "embedded")
    ]
    assert same(*(batch.reset(seed=[3, None, 2, 1, 9]) for batch in batches))
    actions = np.random.default_rng(1).integers(2, size=(STEPS, 5))
    ended = np.zeros(5, np.bool_)
    for action in actions:
        if mode is AutoresetMode.DISABLED and ended.any():
            assert same(*(batch.reset(options={"reset_mask": ended}) for batch in batches))
        private, embedded = (batch.step(action) for batch in batches)
        assert same(private, embedded)
        ended = private[2] | private[3]
    assert same(*([batch.snapshot()] for batch in batches))
    for batch in batches:
        batch.close()


def test_environment_equals_that_of_a_private_server() -> None:
    environments = [perturb.PerturbEnv("CartPole", version="E", server=server) for server in (None, "embedded")]
    for episode in range(3):
        assert same(*(one.reset(seed=7 if episode == 0 else None) for one in environments))
        for step in range(500):
            private, embedded = (one.step(step % 2) for one in environments)
            assert same(private, embedded)
            if private[2] or private[3]:
                break
    for one in environments:
        one.close()


@pytest.mark.parametrize("name", ["Hopper", "ReachingArm"])
def test_robots_equal_those_of_a_private_server_to_the_last_bit(name: str) -> None:
    settings: Any = {"version": "R", "task": ROOT / "examples/tasks/reaching_arm" if name == "ReachingArm" else None}
    batches = [perturb.PerturbVectorEnv(name, 3, server=server, **settings) for server in (None, "embedded")]
    assert same(*(batch.reset(seed=2) for batch in batches))
    batches[0].action_space.seed(2)
    for _ in range(STEPS):
        actions = batches[0].action_space.sample()
        assert same(*(batch.step(actions) for batch in batches))
    for batch in batches:
        batch.close()


def physics_threads() -> int:
    """Return the number of threads of embedded servers in this process."""
    names = (task / "comm" for task in Path("/proc/self/task").iterdir())
    return sum(name.read_text().startswith("physics-") for name in names)


def test_threads_of_embedded_servers_end_with_last_environment() -> None:
    environments = [perturb.PerturbEnv("CartPole", server="embedded") for _ in range(2)]
    assert physics_threads() == 0, "nothing is started before a reset"
    for one in environments:
        one.reset()
    wait_until(lambda: physics_threads() == os.cpu_count())  # a thread has its name only after its start
    environments[0].close()
    environments[1].step(0)
    environments[1].close()
    wait_until(lambda: physics_threads() == 0)
    assert (EmbeddedServer, None) not in local_server._shared


# A step of this many environments takes long enough to be interrupted.
MANY = 4096


def many() -> tuple[perturb.PerturbVectorEnv, Any]:
    envs = perturb.PerturbVectorEnv("HalfCheetah", MANY, server="embedded", receipts=False)
    return envs, np.zeros((MANY, 6), np.float32)


def test_interrupt_ends_a_session_and_a_reset_opens_another() -> None:
    envs, actions = many()
    expected = envs.reset(seed=2)[0].tobytes()
    with interrupting(envs):
        envs.step(actions)
    with pytest.raises(perturb.OutOfOrderError, match="interrupted"):
        envs.step(actions)
    assert envs.reset(seed=2)[0].tobytes() == expected
    envs.close()


def test_wait_ends_when_another_thread_closes_the_environment() -> None:
    """The step releases Python's global interpreter lock, so another thread can close the environment."""
    envs, actions = many()
    envs.reset(seed=2)
    caught: list[BaseException] = []

    def step() -> None:
        try:
            while True:
                envs.step(actions)
        except perturb.PerturbError as error:
            caught.append(error)

    stepping = threading.Thread(target=step, daemon=True)
    stepping.start()
    wait_until(lambda: envs._client.session.waits)
    with within(SECONDS):
        envs.close()
        stepping.join()
    assert "closed" in str(caught[0])


def test_reply_that_takes_too_long_ends_a_session() -> None:
    envs, actions = many()
    envs.reset(seed=2)
    envs._client.session._timeout = 0.001
    with pytest.raises(perturb.ServerTimeoutError, match="the embedded server did not answer step within"):
        envs.step(actions)
    envs.close()


class BrokenNative:
    """A fake native session that fails during `render`, while another thread starts an embedded server."""

    ended = False

    def __init__(self) -> None:
        self.started = threading.Event()
        self.thread = threading.Thread(target=self.start_server, daemon=True)

    def start_server(self) -> None:
        with local_server._lock:
            self.started.set()
            with loading:
                pass

    def render(self, *_: Any) -> None:
        self.thread.start()
        self.started.wait()
        raise _native.Failure("ended", 0, "as the test wants")

    def poll_io(self) -> None:
        """Do nothing, because there are no pings to answer."""


def test_a_lost_session_does_not_wait_for_a_server_that_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    environment = perturb.PerturbVectorEnv("CartPole", 1, server="embedded")
    environment.reset()
    session, broken = environment._client.session, BrokenNative()
    monkeypatch.setattr(session, "_native", broken)
    with within(SECONDS):
        with pytest.raises(perturb.ServerConnectionError, match="as the test wants"):
            session.render(0, 8, 8)
        broken.thread.join()
    environment.close()


def test_release_without_wait_does_nothing_while_lock_is_held() -> None:
    server = local_server.acquire(EmbeddedServer)
    users = server.users
    with local_server._lock:
        assert not local_server.release(server, wait=False)
    assert server.users == users
    assert local_server.release(server, wait=False)


def rewards(seed: int) -> list[float]:
    env = gymnasium.make("perturb/Hopper-v0", server="embedded", version="R")
    env.reset(seed=seed)
    found = [float(env.step(np.zeros(3, np.float32))[1]) for _ in range(5)]
    env.close()
    return found


@pytest.mark.parametrize("method", ["spawn", "fork", "forkserver"])
def test_each_process_has_its_own_embedded_server(method: Any) -> None:
    with perturb.PerturbEnv("CartPole", server="embedded") as parent:
        parent.reset(seed=1)
        with multiprocessing.get_context(method).Pool(2) as pool:
            assert pool.map(rewards, [1, 2]) == [rewards(1), rewards(2)]
        parent.step(0)


FORKING = """
import os, threading, numpy as np, perturb
stop = False

def open_robots():
    while not stop:
        env = perturb.PerturbEnv("Hopper", server="embedded", render_mode="rgb_array", width=16, height=16)
        env.reset(seed=1)
        env.step(np.zeros(3, np.float32))
        env.close()

opening = threading.Thread(target=open_robots)
opening.start()
for _ in range(20):
    child = os.fork()
    if not child:
        env = perturb.PerturbEnv("Hopper", server="embedded")
        env.reset(seed=1)
        env.step(np.zeros(3, np.float32))
        env.close()
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
stop = True
opening.join()
print("all ended")
"""


def test_a_fork_while_a_thread_loads_models_does_not_hang() -> None:
    assert output_of("-c", FORKING) == ("all ended\n", "")


def test_threads_step_their_own_environments_independently() -> None:
    def play(seed: int, into: dict[int, bytes]) -> None:
        with perturb.PerturbEnv("CartPole", server="embedded", version="R") as env:
            env.reset(seed=seed)
            into[seed] = b"".join(env.step(step % 2)[0].tobytes() for step in range(8))

    alone: dict[int, bytes] = {}
    together: dict[int, bytes] = {}
    for seed in range(4):
        play(seed, alone)
    threads = [threading.Thread(target=play, args=(seed, together)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert together == alone


def test_embedded_server_needs_no_program(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(local_server.VARIABLE, "/nowhere/perturb-server")
    assert len(rewards(1)) == 5


def test_small_step_is_computed_by_the_calling_thread() -> None:
    """The calling thread does all the work, so the other threads use no processor time."""
    with perturb.PerturbEnv("CartPole", server="embedded") as env:
        env.reset(seed=1)
        time.sleep(0.2)  # afterwards the worker threads are blocked
        before = time.process_time() - time.thread_time()
        for step in range(2000):
            _, _, terminated, truncated, _ = env.step(step % 2)
            if terminated or truncated:
                env.reset()
        assert time.process_time() - time.thread_time() - before < 0.05


def test_train_refuses_the_embedded_server() -> None:
    with pytest.raises(perturb.InvalidArgumentError, match="leave server= out"):
        perturb.train("CartPole", server="embedded")
