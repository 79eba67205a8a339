"""Steps per second beside EnvPool: perturb's through its private server, EnvPool's in this process, both as they come.

All in one run, in turns, so that whatever else the machine does falls on all of them. Printed are medians of the
rounds; `target` is what perturb should at least reach, as a multiple of EnvPool. Everybody takes the same random
actions. In the column `send, recv` two batches of half the size take turns. Where EnvPool is not installed,
its column is empty.
Run: python throughput.py [--rounds 5] [--seconds 0.5] [--server unix:/path] [CartPole …]
"""

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

import perturb
from perturb.catalogue import CATALOGUE

try:
    import envpool
except ImportError:
    envpool = None

# A contender's step, which gives back its flags.
Step = Callable[[Any], Any]


@dataclass(frozen=True)
class Case:
    """A case: the environment, EnvPool's name for it, the batch size, and the target ratio."""

    name: str
    peer: str
    num_envs: int
    target: float
    # Whether random actions end episodes within a round.
    ends: bool = True


CASES = [
    Case("CartPole", "CartPole-v1", 1, 1.0),
    Case("CartPole", "CartPole-v1", 16, 1.5),
    Case("CartPole", "CartPole-v1", 256, 4.0),
    Case("CartPole", "CartPole-v1", 1024, 6.0),
    Case("Acrobot", "Acrobot-v1", 256, 4.0),
    Case("MountainCar", "MountainCar-v0", 256, 4.0),
    Case("Pendulum", "Pendulum-v1", 256, 4.0),
    Case("Hopper", "Hopper-v4", 64, 3.0),
    Case("HalfCheetah", "HalfCheetah-v4", 256, 1.3, ends=False),
]


def ours(case: Case, server: str | None, **settings: Any) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
    """A batch of perturb's, at its first observations."""
    envs = gymnasium.make_vec(
        f"perturb/{case.name}-v{CATALOGUE[case.name].revision}", num_envs=case.num_envs, server=server, **settings
    )
    envs.reset(seed=1)
    return envs


def in_halves(case: Case, server: str | None) -> tuple[Step, Callable[[], None]]:
    """Two batches of half the size that take turns."""
    halves = [perturb.PerturbVectorEnv(case.name, case.num_envs // 2, server=server) for _ in range(2)]
    for i, half in enumerate(halves):
        half.reset(seed=1 + i * case.num_envs // 2)
        half.send(np.zeros(half.action_space.shape or (), half.action_space.dtype))

    def step(actions: Any) -> Any:
        got = []
        for half, part in zip(halves, np.split(actions, 2), strict=True):
            got.append(half.recv())
            half.send(part)
        return None, None, *(np.concatenate([one[i] for one in got]) for i in (2, 3)), {}

    def close() -> None:
        for half in halves:
            half.close()

    return step, close


def contenders(case: Case, server: str | None) -> dict[str, tuple[Step, Callable[[], None], Any]]:
    """By name: how it steps, how it ends, and the type of its actions."""
    found: dict[str, tuple[Step, Callable[[], None], Any]] = {}
    for name, settings in {"perturb": {}, "receipts=False": {"receipts": False}}.items():
        envs = ours(case, server, **settings)
        kind = np.int64 if CATALOGUE[case.name].discrete else np.float32
        found[name] = (envs.step, envs.close, kind)
    if case.num_envs > 1:
        step, close = in_halves(case, server)
        found["send, recv"] = (step, close, kind)
    if envpool is not None:
        peer = envpool.make(case.peer, env_type="gymnasium", num_envs=case.num_envs, seed=1)
        peer.reset()
        found["EnvPool"] = (peer.step, peer.close, peer.action_space.dtype)
    return found


def rate(step: Step, actions: list[Any], seconds: float) -> tuple[float, int]:
    """Steps of single environments a second, and how many episodes ended."""
    steps = ended = 0
    start = time.perf_counter()
    while (elapsed := time.perf_counter() - start) < seconds:
        for _ in range(8):
            _, _, terminated, truncated, _ = step(actions[steps % len(actions)])
            ended += int(np.count_nonzero(terminated | truncated))
            steps += 1
    return steps * len(actions[0]) / elapsed, ended


def measure(case: Case, server: str | None, rounds: int, seconds: float) -> dict[str, float]:
    """Medians by contender."""
    description, rng = CATALOGUE[case.name], np.random.default_rng(1)
    drawn: Any
    if isinstance(description.actions, int):
        drawn = rng.integers(description.actions, size=(64, case.num_envs))
    else:
        low, high = np.array(description.actions).T
        drawn = rng.uniform(low, high, size=(64, case.num_envs, len(low)))
    rates: dict[str, list[float]] = {}
    batches = contenders(case, server)
    endings = dict.fromkeys(batches, 0)
    for step, _, kind in batches.values():
        rate(step, list(drawn.astype(kind)), seconds / 4)
    for _ in range(rounds):
        for name, (step, _, kind) in batches.items():
            measured, ended = rate(step, list(drawn.astype(kind)), seconds)
            rates.setdefault(name, []).append(measured)
            endings[name] += ended
    for _, close, _ in batches.values():
        close()
    for name, ended in endings.items():
        assert ended > 0 or not case.ends, f"{name} ended no episode of {case.name}"
    return {name: statistics.median(results) for name, results in rates.items()}


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="environments; at first all")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=0.5)
    parser.add_argument("--server", help="unix:/path or host:port; at first a server of its own")
    arguments = parser.parse_args()

    print("EnvPool is not installed: pip install envpool" if envpool is None else f"EnvPool {envpool.__version__}")
    columns = ["EnvPool", "perturb", "receipts=False", "send, recv"]
    print(f"{'steps/s':18} {''.join(f'{column:>15}' for column in columns)} {'perturb/EnvPool':>16} {'target':>7}")
    for case in CASES:
        if arguments.names and case.name not in arguments.names:
            continue
        medians = measure(case, arguments.server, arguments.rounds, arguments.seconds)
        numbers = "".join(f"{medians[column]:15,.0f}" if column in medians else f"{'':15}" for column in columns)
        ratio = f"{medians['perturb'] / medians['EnvPool']:16.2f}" if "EnvPool" in medians else f"{'':16}"
        print(f"{case.name:12}{case.num_envs:6} {numbers} {ratio} {case.target:7.1f}", flush=True)


if __name__ == "__main__":
    main()
