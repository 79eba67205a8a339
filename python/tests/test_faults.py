"""Clients and servers that die or hang, and processes that fork.

Errors are raised within seconds, and no session, server process or temporary folder is left behind.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import pytest

import perturb
from perturb import local_server, session

from .processes import SECONDS, freeze, output_of, python, runs, wait_until, within

if TYPE_CHECKING:
    from collections.abc import Callable


def step_forever(envs: perturb.PerturbVectorEnv, actions: Any) -> None:
    while True:
        envs.step(actions)


STEPPING = """
import perturb, numpy as np
envs = perturb.PerturbVectorEnv("Hopper", 64, server={address!r}, autoreset_mode="SameStep")
envs.reset(seed=1)
actions = np.zeros((64, 3), dtype=np.float32)
print("stepping", flush=True)
while True:
    envs.step(actions)
"""


def test_a_client_killed_in_mid_step_frees_its_environments(start_server: Callable[..., Any]) -> None:
    address = start_server("--max-envs", "64").address
    client = python("-c", STEPPING.format(address=address))
    assert client.stdout is not None
    assert client.stdout.readline() == "stepping\n"
    envs = perturb.PerturbVectorEnv("Hopper", 64, server=address)
    with pytest.raises(perturb.ServerFullError):
        envs.reset()
    client.kill()
    client.communicate()

    def free() -> bool:
        try:
            envs.reset()
        except perturb.ServerFullError:
            return False
        return True

    wait_until(free)


@pytest.mark.parametrize("listen", [None, "tcp://127.0.0.1:0"])
def test_a_server_killed_in_mid_step_is_reported_at_once(listen: str | None, start_server: Callable[..., Any]) -> None:
    running = start_server(listen=listen)
    envs = perturb.PerturbVectorEnv("Hopper", 256, server=running.address)
    envs.reset(seed=1)
    actions = np.zeros((256, 3), dtype=np.float32)
    threading.Timer(0.3, running.process.kill).start()
    with within(SECONDS), pytest.raises(perturb.ServerConnectionError, match=r"lost the server at .* during step"):
        step_forever(envs, actions)
    with pytest.raises(perturb.OutOfOrderError, match=r"reset\(\) .* lost the server"):
        envs.step(actions)
    with (
        within(SECONDS),
        pytest.raises(perturb.ServerConnectionError, match=r"no server answers at .*perturb-server --l"),
    ):
        envs.reset()


def test_a_reset_connects_to_a_restarted_server(start_server: Callable[..., Any]) -> None:
    with tempfile.TemporaryDirectory() as directory:
        listen = f"unix:{directory}/server.sock"
        running = start_server(listen=listen)
        env = perturb.PerturbEnv("CartPole", version="R", server=listen)
        first, info = env.reset(seed=1, options={"parameters": {"mass": 0.3}})
        running.process.kill()
        running.process.wait()
        with pytest.raises(perturb.ServerConnectionError):
            env.step(0)
        start_server(listen=listen)
        again, same = env.reset(seed=1)
        assert again.tobytes() == first.tobytes()
        assert same == info
        assert info["parameters"]["mass"] == 0.3
        env.close()


def test_parameters_of_some_environments_survive_a_lost_server(start_server: Callable[..., Any]) -> None:
    with tempfile.TemporaryDirectory() as directory:
        listen = f"unix:{directory}/server.sock"
        running = start_server(listen=listen)
        envs = perturb.PerturbVectorEnv("CartPole", 3, version="R", parameters={"mass": 0.1}, server=listen)
        envs.reset(seed=1)
        for mass, mask in ((0.3, [True, False, False]), (0.4, [False, False, True])):
            envs.reset(options={"parameters": {"mass": mass}, "reset_mask": np.array(mask)})
        expected, infos = envs.reset(seed=1)
        running.process.kill()
        running.process.wait()
        start_server(listen=listen)
        with pytest.raises(perturb.ServerConnectionError):
            envs.step(np.zeros(3, dtype=np.int64))
        observations, again = envs.reset(seed=1)
        assert again["parameters"]["mass"].tolist() == [0.3, 0.1, 0.4]
        np.testing.assert_array_equal(observations, expected)
        np.testing.assert_array_equal(again["parameters"]["length"], infos["parameters"]["length"])


def test_loss_of_a_snapshots_parameters_is_reported(start_server: Callable[..., Any]) -> None:
    with tempfile.TemporaryDirectory() as directory:
        listen = f"unix:{directory}/server.sock"
        running = start_server(listen=listen)
        envs = perturb.PerturbVectorEnv("CartPole", 2, server=listen)
        envs.reset(seed=1)
        envs.restore(envs.snapshot())
        running.process.kill()
        running.process.wait()
        start_server(listen=listen)
        with pytest.raises(perturb.ServerConnectionError):
            envs.step(np.zeros(2, dtype=np.int64))
        with pytest.raises(perturb.OutOfOrderError, match="make the environments again"):
            envs.reset(seed=1)


@pytest.mark.parametrize("how", ["refused", "lost"])
def test_a_restore_that_is_refused_changes_nothing(how: str, start_server: Callable[..., Any]) -> None:
    """If the server is instead lost during a restore, the client no longer knows the parameters."""
    with tempfile.TemporaryDirectory() as directory:
        listen = f"unix:{directory}/server.sock"
        running = start_server(listen=listen)
        env = perturb.PerturbEnv("CartPole", server=listen)
        expected, _ = env.reset(seed=1)
        if how == "refused":
            with pytest.raises(perturb.InvalidArgumentError):
                env.restore(b"no snapshot")
        running.process.kill()
        running.process.wait()
        with pytest.raises(perturb.ServerConnectionError):
            env.step(0) if how == "refused" else env.restore(b"no snapshot")
        start_server(listen=listen)
        if how == "refused":
            assert env.reset(seed=1)[0].tobytes() == expected.tobytes()
        else:
            with pytest.raises(perturb.OutOfOrderError, match="make the environments again"):
                env.reset(seed=1)


def test_a_server_that_hangs_is_reported_after_the_timeout(start_server: Callable[..., Any]) -> None:
    running = start_server()
    env = perturb.PerturbEnv("CartPole", server=running.address)
    env.reset(seed=1)
    freeze(running.process.pid)
    usual, env._client._timeout, env._client.session._timeout = env._client._timeout, 1.0, 1.0
    with within(SECONDS), pytest.raises(perturb.ServerTimeoutError, match="did not answer step within 1 s") as caught:
        env.step(0)
    assert isinstance(caught.value, TimeoutError)
    with within(SECONDS), pytest.raises(perturb.ServerTimeoutError, match="open"):
        env.reset()
    running.process.send_signal(signal.SIGCONT)
    env._client._timeout = usual
    env.reset()


def test_a_server_that_answers_no_pings_is_reported(
    start_server: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A client sends pings to detect a dead server before the timeout of replies.

    The test shortens the keepalive interval and limit, because their defaults add up to half a minute.
    """
    monkeypatch.setattr(session, "KEEPALIVE_INTERVAL", 1.0)
    monkeypatch.setattr(session, "KEEPALIVE_LIMIT", 5.0)  # also applies to the reset, and is long enough for it
    running = start_server(listen="tcp://127.0.0.1:0")
    env = perturb.PerturbEnv("CartPole", server=running.address)
    env.reset(seed=1)
    freeze(running.process.pid)
    with within(SECONDS), pytest.raises(perturb.ServerConnectionError, match="lost the server"):
        env.step(0)


def test_an_address_without_a_perturb_server_is_reported() -> None:
    with within(SECONDS), pytest.raises(perturb.ServerConnectionError, match="no server answers at unix:/nowhere"):
        perturb.PerturbEnv("CartPole", server="unix:/nowhere").reset()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        silent = perturb.PerturbEnv("CartPole", server=f"127.0.0.1:{port}", timeout=2.0)
        with within(SECONDS), pytest.raises(perturb.ServerTimeoutError):
            silent.reset()


def test_shutdown_of_a_server_is_reported_as_a_lost_server(start_server: Callable[..., Any]) -> None:
    running = start_server("--grace-seconds", "0")
    env = perturb.PerturbEnv("CartPole", server=running.address)
    env.reset()
    running.process.terminate()
    running.process.wait()
    with within(SECONDS), pytest.raises(perturb.ServerConnectionError, match="lost the server"):
        env.step(0)


def test_idle_session_answers_keepalive_pings(start_server: Callable[..., Any]) -> None:
    env = perturb.PerturbEnv("CartPole", server=start_server("--keepalive-seconds", "1").address)
    env.reset(seed=1)
    time.sleep(5)
    env.step(0)
    env.close()


SEVERAL_MACHINES = """
import os, sys
import perturb
statuses = []
for _ in range(6):  # different processes may try the machines in different orders
    child = os.fork()
    if child == 0:
        env = perturb.PerturbEnv("CartPole", server=sys.argv[1])
        env.reset(seed=1)
        env.close()
        os._exit(0)
    statuses.append(os.waitpid(child, 0)[1])
print(statuses)
"""


def test_a_client_connects_to_a_machine_that_accepts_sessions(start_server: Callable[..., Any], tmp_path: Path) -> None:
    draining = start_server(listen="tcp://127.0.0.1:0")
    port = draining.address.rpartition(":")[2]
    start_server(listen=f"tcp://127.0.0.2:{port}")
    env = perturb.PerturbEnv("CartPole", server=draining.address)
    env.reset()
    draining.process.terminate()  # the open session keeps the draining server running
    hosts = tmp_path / "hosts"
    hosts.write_text("127.0.0.1 localhost machines.test\n127.0.0.2 machines.test\n")
    script = 'mount --bind "$0" /etc/hosts && exec "$@"'
    mounted = ["unshare", "--map-root-user", "--mount", "sh", "-c", script, str(hosts)]
    if subprocess.run([*mounted, "true"], stderr=subprocess.DEVNULL, check=False).returncode != 0:
        pytest.skip("this user may not mount files")
    command = [*mounted, sys.executable, "-c", SEVERAL_MACHINES, f"machines.test:{port}"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert ended.stdout == f"{[0] * 6}\n", ended.stderr
    env.close()


OPENING_AND_CLOSING = """
import perturb
from perturb import session
session.POLL_INTERVAL = 1e-6
for seed in range(40):
    envs = [perturb.PerturbEnv("CartPole", server={address!r}) for _ in range(20)]
    for env in envs:
        env.reset(seed=seed)
        env.step(0)
    for env in envs:
        env.close()
print("went on")
"""


def test_the_keepalive_thread_disturbs_no_session(server: str) -> None:
    assert output_of("-c", OPENING_AND_CLOSING.format(address=server)) == ("went on\n", "")


def test_a_wait_ends_when_another_thread_closes_the_environment(start_server: Callable[..., Any]) -> None:
    running = start_server()
    envs = perturb.PerturbVectorEnv("CartPole", 4, server=running.address)
    envs.reset(seed=1)
    freeze(running.process.pid)
    caught: list[BaseException] = []

    def step() -> None:
        try:
            envs.step(np.zeros(4, dtype=np.int64))
        except perturb.PerturbError as error:
            caught.append(error)

    stepping = threading.Thread(target=step, daemon=True)
    stepping.start()
    wait_until(lambda: envs._client.session.waits)
    with pytest.raises(perturb.OutOfOrderError, match="another thread waits for a reply"):
        envs.step(np.zeros(4, dtype=np.int64))
    with within(SECONDS):
        envs.close()
        stepping.join()
    assert isinstance(caught[0], perturb.OutOfOrderError)
    assert "it was closed" in str(caught[0])


def test_many_environments_of_a_process_share_file_descriptors(server: str) -> None:
    def descriptors() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    envs = [perturb.PerturbEnv("CartPole", server=server) for _ in range(64)]
    before = descriptors()
    for env in envs:
        env.reset(seed=1)
    assert descriptors() - before <= 64 + 16 * 4 + 8
    expected = envs[0].step(0)[0].tobytes()
    assert all(env.step(0)[0].tobytes() == expected for env in envs[1:])
    for env in envs:
        env.close()
    assert descriptors() <= before + 8


ENDING = """
import perturb, threading, time, numpy as np
envs = perturb.PerturbVectorEnv("CartPole", 4, server={address!r})
envs.reset(seed=1)

def run():
    try:
        while True:
            envs.step(np.zeros(4, dtype=np.int64))
    except perturb.PerturbError:
        pass

threading.Thread(target=run, daemon=True).start()
time.sleep(0.3)
print("ends")
"""


def test_a_process_may_end_while_one_of_its_threads_steps(server: str) -> None:
    for _ in range(3):
        process = python("-c", ENDING.format(address=server))
        assert process.communicate(timeout=60) == ("ends\n", "")
        assert process.returncode == 0


def test_proxy_variables_do_not_affect_loopback_and_sockets(
    start_server: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("http_proxy", "HTTP_PROXY", "https_proxy", "grpc_proxy", "all_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")  # no program listens at this port
    for name in ("no_proxy", "NO_PROXY", "no_grpc_proxy"):
        monkeypatch.delenv(name, raising=False)
    for listen in (None, "tcp://127.0.0.1:0"):
        env = perturb.PerturbEnv("CartPole", server=start_server(listen=listen).address)
        env.reset()
        env.close()


# Tests of private servers.


def private() -> local_server.LocalServer | None:
    return local_server._shared.get((local_server.LocalServer, None))


def test_private_server_ends_with_last_environment() -> None:
    one, other = perturb.PerturbEnv("CartPole"), perturb.PerturbVectorEnv("Pendulum", 3)
    assert private() is None, "nothing is started before a reset"
    one.reset(seed=1)
    shared = private()
    assert shared is not None
    assert os.getpgid(shared.process.pid) != os.getpgid(0), "Ctrl-C would also end the server"
    other.reset(seed=1)
    assert private() is shared
    one.close()
    assert runs(shared.process.pid)
    other.step(np.zeros((3, 1), dtype=np.float32))
    directory = Path(str(shared.address).removeprefix("unix:")).parent
    assert directory.stat().st_mode & 0o777 == 0o700
    with within(SECONDS):
        other.close()
    assert not runs(shared.process.pid)
    assert not directory.exists()


def test_private_server_ends_if_environment_is_garbage_collected() -> None:
    env = perturb.PerturbEnv("CartPole")
    env.reset()
    shared = private()
    assert shared is not None
    del env
    wait_until(lambda: not runs(shared.process.pid))


FORGETTING = """
import gc, perturb
from perturb import local_server

gc.disable()
cycle = [perturb.PerturbEnv("CartPole")]
cycle[0].reset(seed=1)
cycle.append(cycle)
del cycle
ask = local_server.LocalServer.exit_status
collected = []

def collect_and_ask(server):
    assert local_server._lock.locked()
    collected.append(gc.collect())
    return ask(server)

local_server.LocalServer.exit_status = collect_and_ask
env = perturb.PerturbEnv("CartPole")
env.reset(seed=1)
assert collected[0] > 0
env.close()
assert not local_server._shared, "the forgotten environment's share is kept"
print("went on")
"""


def test_garbage_collection_while_a_private_server_is_acquired() -> None:
    assert output_of("-c", FORGETTING) == ("went on\n", "")


def test_process_closes_sessions_before_its_server() -> None:
    """If the sessions were still open, the server would wait a second for them."""
    ending = """
from pathlib import Path
import perturb
from perturb import local_server
env = perturb.PerturbEnv("CartPole")
env.reset(seed=1)
end = local_server.LocalServer.end

def say_and_end(server):
    print(env._client._session._lost, server.exit_status())
    end(server)
    print(server.exit_status(), Path(server._directory).exists())

local_server.LocalServer.end = say_and_end
"""
    assert output_of("-c", ending) == ("it was closed None\n0 False\n" + "it was closed 0\n0 False\n", "")


def test_a_killed_private_server_is_reported_and_replaced() -> None:
    env, other = perturb.PerturbEnv("CartPole"), perturb.PerturbEnv("CartPole")
    env.reset(seed=1)
    other.reset(seed=1)
    shared = private()
    assert shared is not None
    shared.process.kill()
    with within(SECONDS), pytest.raises(perturb.ServerConnectionError, match="ended with status -9"):
        env.step(0)
    env.reset(seed=1)
    env.step(0)
    assert private() is not shared
    with within(SECONDS), pytest.raises(perturb.ServerConnectionError, match="ended with status -9"):
        other.step(0)
    env.step(0)  # closing `other`, whose server is gone, does not affect this server
    env.close()
    assert private() is None


OWNING = """
import perturb, sys, os, time
from perturb import local_server
env = perturb.PerturbEnv("CartPole")
env.reset(seed=1)
if {fork}:
    if os.fork() == 0:
        time.sleep(60)
print(local_server._shared[local_server.LocalServer, None].process.pid, flush=True)
sys.stdin.readline() if {wait} else None
"""


@pytest.mark.parametrize("fork", [False, True])
@pytest.mark.parametrize("ending", ["exit", signal.SIGTERM, signal.SIGKILL])
def test_private_server_ends_with_its_process(ending: Any, fork: bool) -> None:
    """The server ends even if a process that was forked from its owner still runs."""
    client = subprocess.Popen(
        [sys.executable, "-c", OWNING.format(wait=ending != "exit", fork=fork)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert client.stdout is not None
    try:
        server = int(client.stdout.readline())
        if ending != "exit":
            assert runs(server)
            client.send_signal(ending)
        assert client.wait(SECONDS) == (0 if ending == "exit" else -ending)
        wait_until(lambda: not runs(server))
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(client.pid, signal.SIGKILL)
        client.communicate()


def test_without_the_program_the_error_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(local_server.VARIABLE, "/nowhere/perturb-server")
    with pytest.raises(perturb.ServerStartError, match=r"/nowhere/perturb-server.*make build"):
        perturb.PerturbEnv("CartPole")
    monkeypatch.delenv(local_server.VARIABLE)
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(perturb.ServerStartError, match=r"not on PATH.*server='unix:"):
        gymnasium.make("perturb/CartPole-v1")


def test_the_packages_own_program_is_preferred_to_that_on_path(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    own, other = tmp_path / "own", tmp_path / "bin" / local_server.PROGRAM
    other.parent.mkdir()
    for program in (own, other):
        program.write_text("#!/bin/sh")
        program.chmod(0o755)
    monkeypatch.setattr(local_server, "BUNDLED", own)
    monkeypatch.setenv("PATH", str(other.parent))
    monkeypatch.delenv(local_server.VARIABLE)
    assert local_server.find_program() == own
    own.unlink()
    assert local_server.find_program() == other
    monkeypatch.setenv(local_server.VARIABLE, str(other))
    own.touch(0o755)
    assert local_server.find_program() == other


def test_a_program_that_is_not_a_server_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(local_server.VARIABLE, "/bin/false")
    with within(SECONDS), pytest.raises(perturb.ServerStartError, match="ended with status 1 before it listened"):
        perturb.PerturbEnv("CartPole").reset()


def test_private_servers_ignore_variables_for_other_servers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PERTURB_SERVER_WORKERS", "0")  # a server with this setting does not start
    envs = perturb.PerturbVectorEnv("CartPole", 20_000)  # more environments than the default limit of a server
    envs.reset()
    envs.close()


# Tests of forks.


def in_fork(function: Callable[[], Any]) -> Any:
    """Call the function in a forked process. Return its result, or the text of its error."""
    receiver, sender = multiprocessing.Pipe(duplex=False)

    def child() -> None:
        try:
            sender.send(function())
        except BaseException as error:  # noqa: BLE001
            sender.send(f"{type(error).__name__}: {error}")

    process = multiprocessing.get_context("fork").Process(target=child, daemon=True)
    process.start()
    try:
        assert receiver.poll(SECONDS), "the forked process hangs"
        result = receiver.recv()
        process.join(SECONDS)
        assert process.exitcode == 0, "the forked process does not end"
    finally:
        process.kill()
        process.join()
    return result


@pytest.mark.parametrize("own", [False, True])
def test_session_opens_in_the_process_that_uses_it(own: bool, server: str) -> None:
    address = None if own else server
    used, unused = (perturb.PerturbEnv("CartPole", server=address) for _ in range(2))
    used.reset(seed=1)
    expected = used.step(1)[0].tobytes()

    def both() -> list[bytes]:
        results = []
        for env in (unused, used):
            env.reset(seed=1)
            results.append(env.step(1)[0].tobytes())
            env.close()
        return results

    used.reset(seed=1)
    assert in_fork(lambda: used.step(1)).startswith("OutOfOrderError: process")
    assert in_fork(both) == [expected, expected]
    assert used.step(1)[0].tobytes() == expected, "the fork does not affect the parent's session"
    used.close()


FORKING = """
import os, perturb
env = perturb.PerturbEnv("CartPole", server={address!r})
env.reset(seed=1)
child = os.fork()
env.reset(seed=1)
env.step(0)
if child:
    assert os.waitpid(child, 0)[1] == 0
    print("both went on")
"""


def test_a_parent_and_its_forked_child_both_continue(server: str) -> None:
    assert output_of("-c", FORKING.format(address=server)) == ("both went on\n", "")


@pytest.mark.parametrize("own", [False, True])
def test_gymnasiums_asynchronous_batches_work(own: bool, server: str) -> None:
    """An AsyncVectorEnv makes an environment in the parent process to read its spaces, and then forks."""
    settings: dict[str, Any] = {} if own else {"server": server}
    parent = perturb.PerturbEnv("Pendulum", **settings)
    parent.reset()
    envs: Any = gymnasium.make_vec("perturb/Pendulum-v1", num_envs=2, vectorization_mode="async", **settings)
    with within(SECONDS):
        observations, infos = envs.reset(seed=5)
        envs.step(np.zeros((2, 1), dtype=np.float32))
    assert observations.shape == (2, 3)
    assert infos["parameters"]["mass"].tolist() == [1, 1]
    envs.close()
    parent.step(np.zeros(1, dtype=np.float32))
    parent.close()


@pytest.mark.parametrize("n_started", [0, 1])
def test_a_limit_of_threads_is_reported(monkeypatch: pytest.MonkeyPatch, n_started: int) -> None:
    """A simulated limit of threads prevents the start of the first or second thread of a session.

    The first thread reads the output of the private server, and the second answers keepalive pings.
    """
    start = threading.Thread.start
    monkeypatch.setattr(session, "_keepalive", session._KeepaliveThread())
    started: list[threading.Thread] = []

    def limited(thread: threading.Thread) -> None:
        if len(started) == n_started:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        start(thread)

    monkeypatch.setattr(local_server, "_shared", {})
    monkeypatch.setattr(threading.Thread, "start", limited)
    running = sum(server.exit_status() is None for server in local_server._running)
    env = perturb.PerturbEnv("CartPole")
    with pytest.raises(perturb.PerturbError, match=r"cannot start another thread or process .*; raise the limit"):
        env.reset()
    assert sum(server.exit_status() is None for server in local_server._running) == running
    monkeypatch.setattr(threading.Thread, "start", start)
    env.reset(seed=1)
    env.close()
    session._keepalive.end()
