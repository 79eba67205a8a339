"""The public catalogue: the environments, and the parameters of their physics that can be changed."""

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
    """A physical parameter of an environment, whose value can be set.

    Attributes:
        name: the parameter's name, such as `length`.
        unit: the SI unit of all values, or `1` if the parameter is dimensionless.
        description: what the parameter is.
        low: the lowest accepted value.
        high: the highest accepted value.
        default: the value in version D.
        random: the intervals that version R draws from, [(low, high), …].
        extreme: the intervals that version E draws from, [(low, high), …].
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
        name: the name for `evaluate` and servers, such as `CartPole`.
        id: the id for `gymnasium.make`, such as `perturb/CartPole-v1`.
        revision: a number that increases with every change of dynamics, reward or observation.
        description: what the environment is.
        step_limit: the number of steps after which an episode is truncated.
        control_timestep: simulated time in one step, s.
        observation: the names of an observation's entries, [O].
        parameters: the parameters by name, in the order of receipts.
        success: the success rule, or None.
        model_hash: SHA-256 in hexadecimal digits of the model's MJCF text, or of all files of the task folder that the
            server read. Empty without a model.
        heatmap_axes: the default parameters on the x and y axis of heatmaps. Empty if there is no default.
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
        """The observation space, a float32 Box [O]."""
        return (self._description or CATALOGUE[self.name]).observation_space()

    @property
    def action_space(self) -> spaces.Discrete | spaces.Box:
        """The action space: a Discrete that starts at 0, or a float32 Box [A]."""
        return (self._description or CATALOGUE[self.name]).action_space()


def environments(*, task: str | os.PathLike[str] | None = None) -> dict[str, Environment]:
    """Return the environments of this package's catalogue, by name.

    The catalogue is that of the perturb-server with which the package was built. When a session opens, its environment
    is compared with the server's.

    Args:
        task: the folder of a task, whose environment is added at the end; see docs/tasks.md.

    Raises:
        InvalidArgumentError: if `task` is not a task folder. The message has the reason.
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
