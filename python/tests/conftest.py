"""Fixtures and helpers that tests share: servers, programs, and the protocol's messages."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import grpc
import pytest

from perturb import local_server
from perturb.catalogue import CATALOGUE

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

ROOT = Path(__file__).parents[2]


def messages() -> Any:
    """Compile the protocol's messages with gRPC's own tools, so that tests do not depend on perturb's own code."""
    folder = str(ROOT / "proto/perturb")  # its parent folder would provide a second package named perturb
    if folder not in sys.path:
        sys.path.append(folder)
    return grpc.protos("v1/perturb.proto")


def identifier(name: str) -> str:
    """Return the environment's id in Gymnasium."""
    return f"perturb/{name}-v{CATALOGUE[name].revision}"


class Server:
    """A running perturb-server process that listens on a Unix socket or a free TCP port."""

    def __init__(self, *flags: str, listen: str | None = None) -> None:
        self._directory = tempfile.TemporaryDirectory(prefix="perturb-test-")
        listen = listen or f"unix:{self._directory.name}/server.sock"
        command = [str(local_server.find_program()), "--listen", listen, "--log", "error", "--exit-with-stdin", *flags]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.address = self.process.stdout.readline().strip().removeprefix("listening on ")

    def end(self) -> None:
        self.process.kill()
        self.process.communicate()
        self._directory.cleanup()


@pytest.fixture(scope="session", autouse=True)
def _program() -> None:
    """Use the perturb-server that cargo built, unless PERTURB_SERVER names another one."""
    os.environ.setdefault(local_server.VARIABLE, str(ROOT / "target/release/perturb-server"))


@pytest.fixture(scope="session")
def server(request: pytest.FixtureRequest, _program: None) -> Iterator[str]:
    """Return the address of a server that all tests share, or `embedded`."""
    if getattr(request, "param", None) == "embedded":
        yield "embedded"
        return
    running = Server()
    yield running.address
    running.end()


# Test modules that run twice: with a server on a socket, and with the embedded server.
BOTH_WAYS = {"bad_input", "changes", "disturbances", "faults", "halves", "infos", "observing", "options", "render"}


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run each test of the modules in BOTH_WAYS with both kinds of server, unless the test is marked `socket`."""
    runs_twice = metafunc.module.__name__.rpartition("test_")[2] in BOTH_WAYS
    if "server" in metafunc.fixturenames and runs_twice and not metafunc.definition.get_closest_marker("socket"):
        metafunc.parametrize("server", ["socket", "embedded"], indirect=True, scope="session")


@pytest.fixture
def start_server(_program: None) -> Iterator[Callable[..., Server]]:
    """Return a function that starts a server for the test alone."""
    running: list[Server] = []

    def start(*flags: str, listen: str | None = None) -> Server:
        running.append(Server(*flags, listen=listen))
        return running[-1]

    yield start
    for one in running:
        one.end()
