"""`send` and `recv`, the two halves of a step."""

from __future__ import annotations

import statistics
import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode

import perturb

if TYPE_CHECKING:
    from collections.abc import Callable

ACTIONS = np.random.default_rng(3).integers(2, size=(100, 4))


def make(server: str, **settings: Any) -> perturb.PerturbVectorEnv:
    envs = perturb.PerturbVectorEnv("CartPole", **{"num_envs": 4, "version": "R", "server": server, **settings})
    envs.reset(seed=5)
    return envs


@pytest.mark.parametrize("ahead", [1, 7, 64])
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_send_and_recv_return_what_step_returns(mode: AutoresetMode, ahead: int, server: str) -> None:
    whole, halves = (make(server, autoreset_mode=mode, reward_terms=True) for _ in range(2))
    sent, ended = 0, 0
    for step in range(len(ACTIONS)):
        while sent < len(ACTIONS) and sent - step < ahead:
            halves.send(ACTIONS[sent])
            sent += 1
        expected, got = whole.step(ACTIONS[step]), halves.recv()
        assert all(data_equivalence(a, b, exact=True) for a, b in zip(expected, got, strict=True)), step
        ended += int((got[2] | got[3]).sum())
    assert ended > 3
    assert halves.reset(seed=9)[0].tobytes() == whole.reset(seed=9)[0].tobytes()


def test_sent_step_is_computed_before_recv_is_called(start_server: Callable[..., Any]) -> None:
    address = start_server("--workers", "1").address
    envs = [perturb.PerturbVectorEnv("HalfCheetah", 256, server=address) for _ in range(2)]
    actions = np.zeros((256, 6), dtype=np.float32)
    for batch in envs:
        batch.reset(seed=1)

    def seconds(think: float) -> list[float]:
        """Measure five times how long `recv` takes for both batches, `think` seconds after `send`."""
        taken = []
        for _ in range(5):
            for batch in envs:
                batch.send(actions)
            time.sleep(think)
            start = time.perf_counter()
            for batch in envs:
                batch.recv()
            taken.append(time.perf_counter() - start)
        return taken

    computing = statistics.median(seconds(0.0))
    assert min(seconds(0.1 + 4 * computing)) < computing / 2


def test_recv_raises_the_error_of_its_own_step(server: str) -> None:
    envs, twin = (perturb.PerturbVectorEnv("Pendulum", 2, server=server) for _ in range(2))
    envs.reset(seed=1)
    twin.reset(seed=1)
    good, bad = np.zeros((2, 1), dtype=np.float32), np.full((2, 1), np.nan, dtype=np.float32)
    for actions in (good, bad, good):
        envs.send(actions)
    with pytest.raises(perturb.InvalidArgumentError, match=r"shape \(1, 1\); expected \(2, 1\)"):
        envs.send(good[:1])
    assert envs.recv()[0].tobytes() == twin.step(good)[0].tobytes()
    with pytest.raises(perturb.InvalidArgumentError, match="NaN"):
        envs.recv()
    assert envs.recv()[0].tobytes() == twin.step(good)[0].tobytes()
    assert envs.step(good)[0].tobytes() == twin.step(good)[0].tobytes()


def test_send_and_recv_out_of_order_change_nothing(server: str) -> None:
    envs = perturb.PerturbVectorEnv("CartPole", 4, server=server)
    calls: list[Callable[[], object]] = [envs.recv, lambda: envs.send(ACTIONS[0])]
    for call in calls:
        with pytest.raises(perturb.OutOfOrderError, match=r"reset\(\) first"):
            call()
    envs.reset(seed=1)
    with pytest.raises(perturb.OutOfOrderError, match=r"no step is under way: send\(\) first"):
        envs.recv()
    envs.send(ACTIONS[0])
    calls = [lambda: envs.step(ACTIONS[0]), envs.reset, envs.snapshot]
    for call in calls:
        with pytest.raises(perturb.OutOfOrderError, match=r"1 step is under way: call recv\(\) first"):
            call()
    for _ in range(63):
        envs.send(ACTIONS[0])
    with pytest.raises(perturb.OutOfOrderError, match="64 steps are under way"):
        envs.send(ACTIONS[0])
    for _ in range(64):
        envs.recv()
    envs.step(ACTIONS[0])


def test_replies_that_fill_the_buffers_do_not_block_requests(start_server: Callable[..., Any]) -> None:
    """64 requests of 320 kB and 64 replies of 1.8 MB are more than the buffers of a connection hold."""
    n = 80_000
    running = start_server("--max-envs", str(n))
    envs = perturb.PerturbVectorEnv("CartPole", n, server=running.address, receipts=False, timeout=10)
    envs.reset(seed=1)
    actions = np.zeros(n, dtype=np.int32)
    for _ in range(64):
        envs.send(actions)
    for _ in range(64):
        assert envs.recv()[0].shape == (n, 4)
    envs.close()


def step_in_halves(envs: perturb.PerturbVectorEnv) -> None:
    envs.send(ACTIONS[1])
    envs.recv()


def test_send_and_recv_report_a_server_that_died(start_server: Callable[..., Any]) -> None:
    running = start_server()
    envs = make(running.address)
    envs.send(ACTIONS[0])
    envs.recv()
    running.process.kill()
    running.process.wait()
    with pytest.raises(perturb.ServerConnectionError, match="lost the server"):
        step_in_halves(envs)
    with pytest.raises(perturb.OutOfOrderError, match="lost the server"):
        envs.recv()


def test_batches_in_threads_do_not_wait_for_each_other(server: str) -> None:
    whole = make(server)
    expected = [whole.step(actions)[0].tobytes() for actions in ACTIONS]
    results: list[list[bytes]] = []

    def run() -> None:
        envs = make(server)
        results.append([envs.step(actions)[0].tobytes() for actions in ACTIONS])

    threads = [threading.Thread(target=run) for _ in range(24)]  # more sessions than Tokio runtimes
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == [expected] * 24
