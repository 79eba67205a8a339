"""The ids by which `gymnasium.make` and `make_vec` find the environments."""

from __future__ import annotations

import gymnasium

from .catalogue import CATALOGUE

# The paper's names of the versions.
_OLD_SUFFIXES = {"D": "", "R": "RandomNormal", "E": "RandomExtreme"}


def register_all() -> None:
    """Register `perturb/CartPole-v1` and so on and the paper's ids, such as `SunblazeCartPoleRandomNormal-v0`.

    The ids have no step limit, because the server has it: a limit here would be wrong after a snapshot is restored.
    """
    for name, description in CATALOGUE.items():
        register_id(f"perturb/{name}-v{description.revision}", environment=name)
        for version, suffix in _OLD_SUFFIXES.items():
            register_id(f"Sunblaze{name}{suffix}-v0", environment=name, version=version)


def register_id(identifier: str, **settings: str) -> None:
    """Register an id with the settings of its environments, unless the id is registered already."""
    if identifier not in gymnasium.registry:
        gymnasium.register(
            identifier,
            entry_point="perturb.env:PerturbEnv",
            vector_entry_point="perturb.vector:PerturbVectorEnv",
            kwargs=settings,
        )
