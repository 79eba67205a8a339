"""Registers the environments' ids for `gymnasium.make` and `gymnasium.make_vec`."""

from __future__ import annotations

import gymnasium

from .catalogue import CATALOGUE

# The suffix of each version in the ids of the paper's code, such as `SunblazeHopperRandomNormal-v0`.
_OLD_SUFFIXES = {"D": "", "R": "RandomNormal", "E": "RandomExtreme"}


def register_all() -> None:
    """Register an id such as `perturb/CartPole-v1` for each environment.

    The ids of the paper's code, such as `SunblazeCartPoleRandomNormal-v0`, are registered, too. No id has a step limit
    of Gymnasium, because the server counts the steps. Gymnasium's count would be wrong after a snapshot is restored.
    """
    for name, description in CATALOGUE.items():
        register_id(f"perturb/{name}-v{description.revision}", environment=name)
        for version, suffix in _OLD_SUFFIXES.items():
            register_id(f"Sunblaze{name}{suffix}-v0", environment=name, version=version)


def register_id(identifier: str, **settings: str) -> None:
    """Register an id, with the keyword arguments of its environments, unless it is registered already."""
    if identifier not in gymnasium.registry:
        gymnasium.register(
            identifier,
            entry_point="perturb.env:PerturbEnv",
            vector_entry_point="perturb.vector:PerturbVectorEnv",
            kwargs=settings,
        )
