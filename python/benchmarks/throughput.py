"""Steps per second of 256 CartPoles: perturb's over a Unix socket, EnvPool's and Gymnasium's in this process.

All in one run, in turns, so that whatever else the machine does falls on all of them. Printed are the median and the
best of the rounds. Every contender takes random actions, whose episodes last some 20 steps, and must end some.
Run: python throughput.py [--batch 256] [--rounds 5] [--seconds 2] [--server unix:/path]
EnvPool is left out if it is not installed.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.classic_control.cartpole import CartPoleVectorEnv
from gymnasium.vector import SyncVectorEnv

import perturb  # noqa: F401  (registers the environments)

Step = Callable[[Any], Any]


def contenders(batch: int, server: str | None) -> dict[str, Any]:
    """The batches, by name; all autoreset in the next step, as is Gymnasium's and EnvPool's way."""
    found: dict[str, Any] = {
        "perturb": gymnasium.make_vec("perturb/CartPole-v1", num_envs=batch, server=server),
        "perturb, receipts=False": gymnasium.make_vec(
            "perturb/CartPole-v1", num_envs=batch, server=server, receipts=False
        ),
        "Gymnasium's CartPoleVectorEnv": CartPoleVectorEnv(num_envs=batch, max_episode_steps=200),
        "Gymnasium's SyncVectorEnv": SyncVectorEnv(
            [lambda: gymnasium.make("CartPole-v1", max_episode_steps=200)] * batch
        ),
    }
    try:
        import envpool
    except ImportError:
        print("EnvPool is not installed: pip install envpool")
    else:
        found["EnvPool"] = envpool.make("CartPole-v0", env_type="gymnasium", num_envs=batch, seed=1)
    return found


def rate(step: Step, actions: np.ndarray[Any, Any], seconds: float) -> tuple[float, int]:
    """Steps of single environments a second, and how many episodes ended."""
    steps = ended = 0
    start = time.perf_counter()
    while (elapsed := time.perf_counter() - start) < seconds:
        _, _, terminated, truncated, _ = step(actions[steps // actions.shape[1] % len(actions)])
        ended += int(np.count_nonzero(terminated | truncated))
        steps += actions.shape[1]
    return steps / elapsed, ended


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--server", help="unix:/path or host:port; at first a server of its own")
    arguments = parser.parse_args()

    batches = contenders(arguments.batch, arguments.server)
    actions = np.random.default_rng(1).integers(2, size=(1000, arguments.batch)).astype(np.int32)
    rates: dict[str, list[float]] = {name: [] for name in batches}
    for envs in batches.values():
        envs.reset()
        rate(envs.step, actions, 0.2)
    for _ in range(arguments.rounds):
        for name, envs in batches.items():
            measured, ended = rate(envs.step, actions, arguments.seconds)
            assert ended > 0, f"{name} ended no episode"
            rates[name].append(measured)
    for envs in batches.values():
        envs.close()

    reference = statistics.median(rates.get("EnvPool", rates["Gymnasium's SyncVectorEnv"]))
    against = "EnvPool" if "EnvPool" in rates else "SyncVectorEnv"
    print(f"{'batch of ' + str(arguments.batch):30} {'median steps/s':>14} {'best':>12} {'/ ' + against:>15}")
    for name, results in rates.items():
        median = statistics.median(results)
        print(f"{name:30} {median:14,.0f} {max(results):12,.0f} {median / reference:15.3f}")


if __name__ == "__main__":
    main()
