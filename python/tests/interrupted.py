"""A program that steps environments and interrupts itself with SIGINT many times; test_interrupts.py runs it.

    python -m tests.interrupted ADDRESS PID TIMES

The arguments are the address of a server, the id of the server's process, and the number of interrupts. Before two of
three interrupts, the program stops the server with SIGSTOP, so that a step is waiting when the signal comes. Later it
continues the server. After an interrupt, the session either still exists, or the next step raises OutOfOrderError and
the program resets the environments. Any other outcome ends the program with an error. An interrupt that is not handled
within SECONDS is also an error. The program prints as JSON how often the session still existed ("went on"), how often
it was lost ("gone"), and the longest time from a signal to its KeyboardInterrupt, in seconds ("slowest").
"""

from __future__ import annotations

import faulthandler
import json
import os
import random
import re
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np

import perturb

from .processes import SECONDS, freeze, wait_until

# The actions are always the same, so that observations depend only on the number of steps.
ACTIONS = np.zeros(4, dtype=np.int64)
# Number of steps after which the environments are reset.
STEPS = 500


class Stepping:
    """Environments that are stepped, and the observations that they must return."""

    def __init__(self, address: str) -> None:
        self.envs = perturb.PerturbVectorEnv(
            "CartPole", len(ACTIONS), server=address, autoreset_mode="SameStep", timeout=float("inf")
        )
        # The observations after 0, 1, 2, … steps. More than STEPS steps happen only if an interrupt prevents a reset.
        self.truth = [self.envs.reset(seed=1)[0].tobytes()]
        self.truth += [self._step() for _ in range(STEPS + 5)]
        self.place = 0
        self._begin()

    def go(self) -> None:
        """Step until an interrupt comes."""
        while True:
            if self.place >= STEPS:
                self._begin()
            observed = self._step()
            self.place += 1
            assert observed == self.truth[self.place]

    def goes_on(self) -> bool:
        """Step once after an interrupt. Return whether the session still exists. If not, reset the environments."""
        try:
            observed = self._step()
        except perturb.OutOfOrderError as gone:
            if not re.search(r"call reset\(\) to open a new one.* interrupted", str(gone)):
                raise
            self._begin()
            return False
        place = self.truth.index(observed)
        # The interrupt may have come after a reply was received and before it was counted, or before a reset was sent.
        assert place - self.place in (1, 2) or (self.place == 0 and place > STEPS), (self.place, place)
        self.place = place
        return True

    def _begin(self) -> None:
        self.place = 0
        assert self.envs.reset(seed=1)[0].tobytes() == self.truth[0]

    def _step(self) -> bytes:
        return self.envs.step(ACTIONS)[0].tobytes()


def interrupt(way: str, envs: perturb.PerturbVectorEnv, server: int, chance: random.Random, sent: list[float]) -> None:
    """Send SIGINT, as Ctrl-C does, to this process. `way` selects the moment."""
    time.sleep(chance.uniform(0, 0.005))
    if way != "anywhere":
        freeze(server)
        wait_until(lambda: envs._client.session.waits)
    sent.append(time.monotonic())
    os.kill(os.getpid(), signal.SIGINT)
    if way == "as the reply comes":  # at random times, because the waiting thread checks for signals every 20 ms
        time.sleep(chance.uniform(0, 0.03))
        os.kill(server, signal.SIGCONT)


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def main(address: str, server: int, times: int) -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have started the tests with SIGINT ignored
    stepping = Stepping(address)
    chance, sent, went_on, slowest = random.Random(times), list[float](), 0, 0.0
    before = descriptors()
    for number in range(times):
        faulthandler.dump_traceback_later(SECONDS, exit=True)
        way = ("anywhere", "in a wait", "as the reply comes")[number % 3]
        sender = threading.Thread(target=interrupt, args=(way, stepping.envs, server, chance, sent), daemon=True)
        try:
            sender.start()
            stepping.go()
        except KeyboardInterrupt:
            slowest = max(slowest, time.monotonic() - sent[-1])
        sender.join()
        os.kill(server, signal.SIGCONT)
        went_on += stepping.goes_on()
    assert len(sent) == times
    assert descriptors() <= before + 4, "sessions were left behind"
    stepping.envs.close()
    faulthandler.cancel_dump_traceback_later()
    print(json.dumps({"went on": went_on, "gone": times - went_on, "slowest": round(slowest, 4)}))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
