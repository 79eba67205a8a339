"""Draws every environment with default and with extreme physics, into one PNG file per environment. Needs Pillow.

Run: python gallery.py [--out pictures] [--server unix:/path]
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

import perturb
from perturb.catalogue import CATALOGUE

STEPS = 12
VERSIONS: tuple[perturb.Version, ...] = ("D", "E")


def picture(name: str, version: perturb.Version, server: str | None) -> np.ndarray:
    """Return a picture of the environment after some random actions, which are the same in every version."""
    env = perturb.PerturbEnv(name, version=version, server=server, render_mode="rgb_array")
    env.action_space.seed(1)
    env.reset(seed=1)
    for _ in range(STEPS):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            break
    frame = env.render()
    env.close()
    return np.asarray(frame)


def main() -> None:
    """Write a picture file for each environment, with version D on the left and version E on the right."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("pictures"), help="the folder for the files")
    parser.add_argument("--server", help="unix:/path or host:port; by default a private server")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for name in CATALOGUE:
        both = np.hstack([picture(name, version, args.server) for version in VERSIONS])
        file = args.out / f"{name}.png"
        Image.fromarray(both).save(file)
        print(file)


if __name__ == "__main__":
    main()
