"""A simple policy on poles of many lengths, in one batch with a different length in each environment.

A reset with a mask sets the parameters of the selected environments only. All poles begin in the same state.
Needs only the package. Run: python sweep.py [--server unix:/path]
"""

import argparse

import gymnasium
import numpy as np

import perturb  # noqa: F401  (registers the environments)


def main() -> None:
    """Print the number of steps for which each pole stays up."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--server", help="unix:/path or host:port; by default a private server")
    lengths = np.array([0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 2.0, 5.0])
    n = len(lengths)

    server = parser.parse_args().server
    envs = gymnasium.make_vec("perturb/CartPole-v1", num_envs=n, autoreset_mode="Disabled", server=server)
    envs.reset(seed=1)
    for i, length in enumerate(lengths):
        options = {
            "reset_mask": np.arange(n) == i,
            "parameters": {"length": length},
            "state": [[0, 0, 0.03, 0]],
        }
        observations, _ = envs.reset(options=options)

    steps = np.zeros(n, dtype=int)
    up = np.ones(n, dtype=bool)
    while up.any():
        actions = (observations[:, 2] + 0.3 * observations[:, 3] > 0).astype(np.int64)
        observations, _, terminated, truncated, _ = envs.step(actions)
        steps += up
        ended = terminated | truncated
        up &= ~ended
        if ended.any():  # environments whose episode ended are reset, and their later steps are not counted
            observations, _ = envs.reset(options={"reset_mask": ended})
    envs.close()
    for length, count in zip(lengths, steps, strict=True):
        print(f"half length {length:4.2f} m: {count:3} steps {'#' * (count // 5)}")


if __name__ == "__main__":
    main()
