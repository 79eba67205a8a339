"""Checks that a real Prometheus has numbers for every expression of the Grafana dashboard.

    check.py PROGRAMS

PROGRAMS is the folder of `perturb` and `perturb-server`. The script starts a server with tokens, and a `prometheus`
that scrapes it. Clients train, film and send requests without a token until the end. Each expression of
perturb-server.json must have a finite value, and promtool must accept the server's page of metrics. Otherwise the
script prints the faults and ends with status 1.
"""

import contextlib
import json
import math
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
LIMIT = 240  # seconds for each wait, much more than on an idle machine
TOKEN = "correct-horse-battery-staple"
CONFIG = """
global: { scrape_interval: 1s }
scrape_configs:
  - job_name: perturb-server
    static_configs: [{ targets: ["127.0.0.1:PORT"] }]
"""
# Grafana's variables in the expressions, with the values that replace them here.
VARIABLES = {"$__rate_interval": "30s", "$instance": ".*"}
# A complaint of promtool that is ignored. promtool reads the page as the older text format, in which a counter's help
# text belongs to its name with `_total`, so it finds none.
KNOWN = "no help text"


def free_port() -> int:
    """Returns a port of the loopback interface that was free a moment ago."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


@contextlib.contextmanager
def running(command: list, **options: Any) -> Iterator[subprocess.Popen]:
    """Starts a process, and ends it at the end of the `with` block."""
    process = subprocess.Popen([str(part) for part in command], **options)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def use(programs: Path, folder: Path, server: str, stop: threading.Event) -> None:
    """Trains, films, and sends a request without a token, which must be refused. Repeats this until `stop` is set."""
    known = dict(os.environ, PERTURB_TOKEN_FILE=str(folder / "token"))
    (folder / "token").write_text(TOKEN)
    stranger = {name: value for name, value in os.environ.items() if name != "PERTURB_TOKEN_FILE"}
    own = [programs / "perturb", "--quiet"]
    train = [*own, "train", "--server", server, "--env", "CartPole", "--episodes", "300", "--out", folder / "run"]
    film = [*own, "video", "--server", server, "--checkpoint", folder / "run", "--episodes", "1"]
    film += ["--out", folder / "a.gif"]
    while not stop.is_set():
        subprocess.run([*train, "--overwrite"], env=known, check=True, stdout=subprocess.DEVNULL)
        subprocess.run(film, env=known, check=True, stdout=subprocess.DEVNULL)
        if subprocess.run([*train, "--overwrite"], env=stranger, stderr=subprocess.DEVNULL).returncode == 0:
            raise SystemExit("a stranger was let in")


def numbers(prometheus: str, expression: str) -> list[float]:
    """Returns the current values of an expression, one for each time series."""
    for name, value in VARIABLES.items():
        expression = expression.replace(name, value)
    query = urllib.parse.urlencode({"query": expression})
    with urllib.request.urlopen(f"{prometheus}/api/v1/query?{query}", timeout=10) as reply:
        return [float(series["value"][1]) for series in json.load(reply)["data"]["result"]]


def wait(what: str, done: Callable[[], object]) -> None:
    """Waits until `done` returns a true value. Ends the script after `LIMIT` seconds."""
    end = time.monotonic() + LIMIT
    while True:
        with contextlib.suppress(OSError):
            if done():
                return
        if time.monotonic() > end:
            raise SystemExit(f"{what} took more than {LIMIT} s")
        time.sleep(0.5)


def check(programs: Path, folder: Path) -> None:
    """Runs the server, its clients and Prometheus until every expression has a finite value."""
    ports = [free_port() for _ in range(3)]
    server, metrics, prometheus = (f"127.0.0.1:{port}" for port in ports)
    (folder / "tokens.toml").write_text(f'[[token]]\nname = "ann"\ntoken = "{TOKEN}"\n')
    (folder / "prometheus.yml").write_text(CONFIG.replace("PORT", str(ports[1])))
    dashboard = json.loads((HERE / "perturb-server.json").read_text())
    targets = [(panel["title"], target["expr"]) for panel in dashboard["panels"] for target in panel["targets"]]
    watched = [programs / "perturb-server", "--listen", f"tcp://{server}", "--metrics", f"tcp://{metrics}"]
    guarded = ["--tokens", folder / "tokens.toml", "--log", "warn"]
    watcher = ["prometheus", f"--config.file={folder}/prometheus.yml", f"--storage.tsdb.path={folder}/data"]
    served = [f"--web.listen-address={prometheus}", "--log.level=error"]
    with running([*watched, *guarded], stdout=subprocess.DEVNULL), running([*watcher, *served]):

        def page() -> bytes:
            with urllib.request.urlopen(f"http://{metrics}/metrics", timeout=10) as reply:
                return reply.read()

        wait("the server", page)
        stop = threading.Event()
        user = threading.Thread(target=use, args=(programs, folder, server, stop))
        user.start()
        left = dict.fromkeys(targets)

        def all_have_numbers() -> bool:
            if not user.is_alive():
                raise SystemExit("the clients failed")
            for target in list(left):
                found = numbers(f"http://{prometheus}", target[1])
                if any(math.isfinite(number) for number in found):
                    del left[target]
                    print(f"{target[0]}: {len(found)} series: {target[1]}")
            return not left

        try:
            wait("numbers for every expression", all_have_numbers)
        except SystemExit:
            for title, expression in left:
                print(f"no numbers: {title}: {expression}", file=sys.stderr)
            raise
        finally:
            said = subprocess.run(["promtool", "check", "metrics"], input=page(), capture_output=True).stderr.decode()
            stop.set()
            user.join()
    wrong = [line for line in said.splitlines() if KNOWN not in line]
    if wrong:
        raise SystemExit("promtool says of the page:\n" + "\n".join(wrong))
    print(f"all {len(targets)} expressions of {len(dashboard['panels'])} panels have numbers")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        check(Path(sys.argv[1]).resolve(), Path(folder))
