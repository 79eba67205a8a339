"""Trained policies that come with the package, so that users can test a policy before they have trained one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .policy import Policy, load_policy

if TYPE_CHECKING:
    from .requests import Version

# Copies from results/policies: Hopper, PPO, feed-forward, configuration 348d15d9, run 2.
_FOLDER = Path(__file__).with_name("example_policies")


def example_policies() -> dict[Version, Policy]:
    """Load two trained policies for Hopper, by the version that they were trained on: D and R.

        print(perturb.evaluate(perturb.example_policies(), "Hopper", episodes=300))

    On D, the default physics, both policies run 20 m in more than nine of ten episodes. On R, where power, torso mass
    and friction are random, the policy that was trained on D falls in most episodes. The policy that was trained on R
    runs 20 m in two thirds of its episodes.
    """
    return {"D": load_policy(_FOLDER / "Hopper-D.safetensors"), "R": load_policy(_FOLDER / "Hopper-R.safetensors")}
