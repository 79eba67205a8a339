"""The catalogue of environments, and the parameters of their physics that can be changed."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from .catalogue import CATALOGUE, CATALOGUE_ENTRIES, Description
from .task_folder import entry, find_folder

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Any

    from gymnasium import spaces

    from .catalogue import Range, Success


@dataclass(frozen=True)
class Parameter:
    """A number of an environment's physics that can be set.

    Attributes:
        name: such as `length`.
        unit: SI, `1` if dimensionless.
        description: what it is.
        low: the least value that is accepted, in the unit, as all that follow.
        high: the greatest.
        default: its value on D.
        random: the intervals that R draws from, [(low, high), …].
        extreme: those of E.
    """

    name: str
    unit: str
    description: str
    low: float
    high: float
    default: float
    random: tuple[Range, ...]
    extreme: tuple[Range, ...]


@dataclass(frozen=True)
class Environment:
    """An environment of the catalogue.

    Attributes:
        name: as `evaluate` and the servers call it, such as `CartPole`.
        id: as `gymnasium.make` calls it, such as `perturb/CartPole-v1`.
        revision: raised by every change of dynamics, reward or observation.
        description: what it is.
        step_limit: an episode is truncated after so many steps.
        control_timestep: simulated time in one step, s.
        observation: names of an observation's entries, [O].
        parameters: by their names, in the order of receipts.
        success: the rule of success; None if there is none.
        model_hash: SHA-256 of the model in hexadecimal digits; empty without a model.
        heatmap_axes: the two parameters of usual heatmaps, or none.
    """

    name: str
    id: str
    revision: int
    description: str
    step_limit: int
    control_timestep: float
    observation: tuple[str, ...]
    parameters: dict[str, Parameter]
    success: Success | None
    model_hash: str = ""
    heatmap_axes: tuple[str, ...] = ()
    _description: Description | None = field(default=None, repr=False, compare=False)

    @property
    def observation_space(self) -> spaces.Box:
        """A float32 Box [O]."""
        return (self._description or CATALOGUE[self.name]).observation_space()

    @property
    def action_space(self) -> spaces.Discrete | spaces.Box:
        """Discrete from 0, or a float32 Box [A]."""
        return (self._description or CATALOGUE[self.name]).action_space()


def environments(*, task: str | os.PathLike[str] | None = None) -> dict[str, Environment]:
    """Every environment that this package knows, by name: those of the server that it was built with.

    They are compared with a server's whenever a session opens.

    Args:
        task: the folder of a task, whose environment is then the last one; see docs/tasks.md.

    Raises:
        InvalidArgumentError: if it is not a folder of a task. The message has the reason.
    """
    folder = find_folder(task)
    entries = CATALOGUE_ENTRIES if folder is None else (*CATALOGUE_ENTRIES, entry(folder))
    return {known["name"]: _environment(known) for known in entries}


def _environment(entry: Mapping[str, Any]) -> Environment:
    description = CATALOGUE.get(entry["name"]) or Description.read(entry)
    parameters = {parameter["name"]: _parameter(parameter) for parameter in entry["parameters"]}
    return Environment(
        name=description.name,
        id=f"perturb/{description.name}-v{description.revision}",
        revision=description.revision,
        description=entry["description"],
        step_limit=entry["step_limit"],
        control_timestep=description.control_timestep,
        observation=tuple(channel["name"] for channel in entry["observation"]),
        parameters=parameters,
        success=description.success,
        model_hash=entry.get("model_hash", ""),
        heatmap_axes=tuple(entry.get("heatmap_axes") or ()),
        _description=description,
    )


def _parameter(entry: Mapping[str, Any]) -> Parameter:
    def intervals(listed: list[list[float]]) -> tuple[Range, ...]:
        return tuple((low, high) for low, high in listed)

    return Parameter(
        name=entry["name"],
        unit=entry["unit"],
        description=entry["description"],
        low=entry["low"],
        high=entry["high"],
        default=entry["D"],
        random=intervals(entry["R"]),
        extreme=intervals(entry["E"]),
    )
