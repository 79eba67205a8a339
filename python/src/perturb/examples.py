"""Trained policies in the package, so that users can test a policy before they have trained one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .policy import Policy, load_policy

if TYPE_CHECKING:
    from .requests import Version

# Policies of results/policies: Hopper, PPO, feed-forward, configuration 348d15d9, run 2.
_FOLDER = Path(__file__).with_name("example_policies")


def example_policies() -> dict[Version, Policy]:
    """Load two Hoppers that run, by the version that they were trained on: D and R.

        print(perturb.evaluate(perturb.example_policies(), "Hopper", episodes=300))

    Both run 20 m on default physics in more than nine of ten episodes. The one that was trained on default physics
    falls in most episodes where power, torso and friction are random. The other one runs in two thirds of them.
    """
    return {"D": load_policy(_FOLDER / "Hopper-D.safetensors"), "R": load_policy(_FOLDER / "Hopper-R.safetensors")}
