"""Steps per second of perturb's embedded and private servers, compared with Gymnasium and EnvPool.

A contender is one implementation of an environment. One run measures all contenders in turn, for several rounds, so
that other load on the machine affects all of them. The table has the median over the rounds for each contender, and
ratios of medians, each with its target. All contenders take the same random actions. A single environment is made by
`gymnasium.make`, and is reset when its episode ends. A batch is made by `make_vec`. In the column `send, recv`, two
batches of half the size step alternately. The column of a package that is not installed is empty.
Run: python throughput.py [--rounds 5] [--seconds 0.5] [--server unix:/path] [CartPole …]
"""

import argparse
import contextlib
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

# A function that steps all environments of a contender with given actions. Returns the number of ended episodes.
Step = Callable[[Any], int]


@dataclass(frozen=True)
class Contender:
    """An implementation that is measured. Its environments have already been reset."""

    step: Step
    close: Callable[[], None]
    # The NumPy type of the actions.
    kind: Any


@dataclass(frozen=True)
class Case:
    """An environment and a batch size that are measured, with target ratios."""

    name: str
    # The environment's id in Gymnasium.
    gymnasium: str
    # The environment's id in EnvPool.
    envpool: str
    num_envs: int
    # Target for the rate of the private server divided by the rate of EnvPool.
    private: float
    # Target for the rate of the embedded server divided by the rate of Gymnasium.
    embedded: float | None = None
    # Whether random actions are expected to end at least one episode in all rounds together.
    ends: bool = True


CASES = [
    Case("CartPole", "CartPole-v1", "CartPole-v1", 1, 1.0, embedded=4.0),
    Case("CartPole", "CartPole-v1", "CartPole-v1", 16, 1.5),
    Case("CartPole", "CartPole-v1", "CartPole-v1", 256, 4.0),
    Case("CartPole", "CartPole-v1", "CartPole-v1", 1024, 6.0),
    Case("Acrobot", "Acrobot-v1", "Acrobot-v1", 256, 4.0),
    Case("MountainCar", "MountainCar-v0", "MountainCar-v0", 256, 4.0),
    Case("Pendulum", "Pendulum-v1", "Pendulum-v1", 256, 4.0),
    Case("Hopper", "Hopper-v5", "Hopper-v4", 1, 1.0, embedded=1.5),
    Case("Hopper", "Hopper-v5", "Hopper-v4", 64, 3.0),
    Case("HalfCheetah", "HalfCheetah-v5", "HalfCheetah-v4", 256, 1.3, ends=False),
]


def batch(envs: Any, kind: Any) -> Contender:
    """Return a contender that steps a batch of environments. The caller has reset them."""

    def step(actions: Any) -> int:
        _, _, terminated, truncated, _ = envs.step(actions)
        return int(np.count_nonzero(terminated | truncated))

    return Contender(step, envs.close, kind)


def single(env: Any, kind: Any) -> Contender:
    """Return a contender that steps a single environment. The caller has reset it."""

    def step(actions: Any) -> int:
        _, _, terminated, truncated, _ = env.step(actions[0])
        if terminated or truncated:
            env.reset()
            return 1
        return 0

    return Contender(step, env.close, kind)


def made(name: str, case: Case, **settings: Any) -> Contender:
    """Make environments from the Gymnasium id `name`, reset them, and return a contender that steps them."""
    kind = np.int64 if CATALOGUE[case.name].discrete else np.float32
    if case.num_envs == 1:
        env = gymnasium.make(name, **settings)
        env.reset(seed=1)
        return single(env, kind)
    envs = gymnasium.make_vec(name, num_envs=case.num_envs, **settings)
    envs.reset(seed=1)
    return batch(envs, kind)


def in_halves(case: Case, server: str | None, kind: Any) -> Contender:
    """Return a contender with two batches of half the size, which step alternately with `send` and `recv`."""
    halves = [perturb.PerturbVectorEnv(case.name, case.num_envs // 2, server=server) for _ in range(2)]
    for i, half in enumerate(halves):
        half.reset(seed=1 + i * case.num_envs // 2)
        half.send(np.zeros(half.action_space.shape or (), half.action_space.dtype))

    def step(actions: Any) -> int:
        ended = 0
        for half, part in zip(halves, np.split(actions, 2), strict=True):
            _, _, terminated, truncated, _ = half.recv()
            half.send(part)
            ended += int(np.count_nonzero(terminated | truncated))
        return ended

    def close() -> None:
        for half in halves:
            half.close()

    return Contender(step, close, kind)


def contenders(case: Case, server: str | None) -> dict[str, Contender]:
    """Return the contenders by name. Contenders whose packages are not installed are left out."""
    own = f"perturb/{case.name}-v{CATALOGUE[case.name].revision}"
    found = {
        "embedded": made(own, case, server="embedded"),
        "private": made(own, case, server=server),
        "receipts=False": made(own, case, server=server, receipts=False),
    }
    if case.num_envs > 1:
        found["send, recv"] = in_halves(case, server, found["private"].kind)
    with contextlib.suppress(gymnasium.error.DependencyNotInstalled):
        found["Gymnasium"] = made(case.gymnasium, case)
    if envpool is not None:
        peer = envpool.make(case.envpool, env_type="gymnasium", num_envs=case.num_envs, seed=1)
        peer.reset()
        found["EnvPool"] = batch(peer, peer.action_space.dtype)
    return found


def rate(contender: Contender, actions: Any, seconds: float) -> tuple[float, int]:
    """Step a contender for some seconds, with `actions` of 64 steps, [64, N] or [64, N, A], again and again.

    Return the steps per second, summed over environments, and the number of ended episodes.
    """
    steps = ended = 0
    rows = list(actions.astype(contender.kind))
    start = time.perf_counter()
    while (elapsed := time.perf_counter() - start) < seconds:
        for row in rows:
            ended += contender.step(row)
        steps += len(rows)
    return steps * len(rows[0]) / elapsed, ended


def measure(case: Case, server: str | None, rounds: int, seconds: float) -> dict[str, float]:
    """Return the median rate of each contender, in steps per second, summed over environments."""
    description, rng = CATALOGUE[case.name], np.random.default_rng(1)
    drawn: Any
    if isinstance(description.actions, int):
        drawn = rng.integers(description.actions, size=(64, case.num_envs))
    else:
        low, high = np.array(description.actions).T
        drawn = rng.uniform(low, high, size=(64, case.num_envs, len(low)))
    rates: dict[str, list[float]] = {}
    found = contenders(case, server)
    endings = dict.fromkeys(found, 0)
    for contender in found.values():
        rate(contender, drawn, seconds / 4)
    for _ in range(rounds):
        for name, contender in found.items():
            measured, ended = rate(contender, drawn, seconds)
            rates.setdefault(name, []).append(measured)
            endings[name] += ended
    for contender in found.values():
        contender.close()
    for name, ended in endings.items():
        # Gymnasium's batch may be too slow to end an episode while it is measured. For example, an episode of Acrobot
        # has 500 steps.
        assert ended > 0 or not case.ends or name == "Gymnasium", f"{name} ended no episode of {case.name}"
    return {name: statistics.median(results) for name, results in rates.items()}


def compared(medians: dict[str, float], own: str, other: str, target: float | None) -> str:
    """Return a text with the ratio of two contenders' rates, `own` / `other`, and the ratio's target."""
    if target is None or other not in medians:
        return f"{'':15}"
    return f"{medians[own] / medians[other]:9.2f} ({target:g})"


def main() -> None:
    """Measure all contenders, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="environments to measure; by default all")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=0.5)
    parser.add_argument("--server", help="unix:/path or host:port; by default a private server")
    arguments = parser.parse_args()

    print("EnvPool is not installed: pip install envpool" if envpool is None else f"EnvPool {envpool.__version__}")
    columns = ["Gymnasium", "EnvPool", "embedded", "private", "receipts=False", "send, recv"]
    ratios = f"{'embedded/Gymnasium':>20}{'private/EnvPool':>17}"
    print(f"{'steps/s':18} {''.join(f'{column:>15}' for column in columns)}{ratios}")
    for case in CASES:
        if arguments.names and case.name not in arguments.names:
            continue
        medians = measure(case, arguments.server, arguments.rounds, arguments.seconds)
        numbers = "".join(f"{medians[column]:15,.0f}" if column in medians else f"{'':15}" for column in columns)
        beside_gymnasium = compared(medians, "embedded", "Gymnasium", case.embedded)
        beside_envpool = compared(medians, "private", "EnvPool", case.private)
        print(f"{case.name:12}{case.num_envs:6} {numbers}{beside_gymnasium:>20}{beside_envpool:>17}", flush=True)


if __name__ == "__main__":
    main()
