"""Descriptions of the environments, so that an environment can be made without a server, and before a fork.

The build of the package asked a server for them and wrote catalogue.json. Whenever a session opens, they are compared
with those of the server in use; a difference is an error.
"""

from __future__ import annotations

import difflib
import json
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from .errors import InvalidArgumentError, ProtocolError

if TYPE_CHECKING:
    from collections.abc import Iterable

Range = tuple[float, float]

# Namespace of the ids in Gymnasium.
NAMESPACE = "perturb/"


@dataclass(frozen=True)
class Success:
    """The rule of success: a comparison of what an episode achieved with a threshold."""

    description: str
    # The quantity that is compared, such as "steps", and its unit.
    quantity: str
    unit: str
    # "at_least" or "at_most".
    comparison: str
    threshold: float


@dataclass(frozen=True)
class Description:
    """An environment's name, revision and spaces. `actions` is the number of choices, or the range of each number.

    `control_timestep` is the simulated time in one step, s.
    """

    name: str
    revision: int
    observation: tuple[Range, ...]
    actions: int | tuple[Range, ...]
    control_timestep: float
    # Ranges of the parameters that follow the observation if parameters are observed.
    parameter_observations: tuple[Range, ...] = field(default=(), compare=False)
    # The rule of this package's version; the server's, whose word is `is_success`, may be another.
    success: Success | None = field(default=None, compare=False)
    # By name the least and the greatest value of each parameter of the physics that is accepted.
    parameters: Mapping[str, Range] = field(default_factory=dict, compare=False)
    # The same of each disturbance, which a session has only if it names one.
    disturbances: Mapping[str, Range] = field(default_factory=dict, compare=False)
    # By name the value of each disturbance that disturbs nothing.
    undisturbed: Mapping[str, float] = field(default_factory=dict, compare=False)
    # By name the range in which each disturbance is observed.
    disturbance_observations: Mapping[str, Range] = field(default_factory=dict, compare=False)
    # An episode is truncated after so many steps; None if that is not known.
    step_limit: int | None = field(default=None, compare=False)
    # SHA-256 of the model in hexadecimal digits; empty without a model.
    model_hash: str = field(default="", compare=False)

    @classmethod
    def read(cls, entry: Mapping[str, Any]) -> Description:
        """Parse an environment of catalogue.json, or of a server. An open end of a range is null."""

        def ranges(channels: Iterable[Mapping[str, float | None]]) -> tuple[Range, ...]:
            ends = ((channel["low"], channel["high"]) for channel in channels)
            return tuple((-math.inf if low is None else low, math.inf if high is None else high) for low, high in ends)

        action, success = entry["action"] or {"continuous": []}, entry.get("success")
        return cls(
            name=entry["name"],
            revision=entry["revision"],
            observation=ranges(entry["observation"]),
            actions=len(action["discrete"]) if "discrete" in action else ranges(action["continuous"]),
            control_timestep=entry["control_timestep"],
            parameter_observations=ranges(seen["entry"] for seen in entry.get("parameter_observations", [])),
            success=None if success is None else Success(**success),
            parameters={it["name"]: (it["low"], it["high"]) for it in entry.get("parameters", [])},
            disturbances={it["name"]: (it["low"], it["high"]) for it in entry.get("disturbances", [])},
            undisturbed={it["name"]: it["D"] for it in entry.get("disturbances", [])},
            disturbance_observations={it["name"]: _observed(it) for it in entry.get("disturbances", [])},
            step_limit=entry.get("step_limit"),
            model_hash=entry.get("model_hash", ""),
        )

    def with_parameters(self, names: Iterable[str]) -> Description:
        """Return the description for a session with these parameters. One disturbance among them adds all others."""
        added = {name: ends for name, ends in self.disturbances.items() if name not in self.parameters}
        if added.keys().isdisjoint(names):
            return self
        seen = tuple(self.disturbance_observations[name] for name in added)
        return replace(
            self,
            parameters={**self.parameters, **added},
            parameter_observations=self.parameter_observations + seen,
        )

    @property
    def is_disturbed(self) -> bool:
        """Whether the disturbances are among the parameters."""
        return not self.disturbances.keys().isdisjoint(self.parameters)

    def observing_parameters(self) -> Description:
        """Return the description for a session whose observations end with the parameters."""
        return replace(self, observation=self.observation + self.parameter_observations)

    @property
    def discrete(self) -> bool:
        """Whether actions are discrete."""
        return isinstance(self.actions, int)

    def metadata(self) -> dict[str, Any]:
        """Gymnasium's metadata: modes of rendering, pictures per second of real time; and the rule of success."""
        pictures = {"render_modes": ["rgb_array"], "render_fps": 1 / self.control_timestep}
        return pictures if self.success is None else {**pictures, "success": asdict(self.success)}

    def observation_space(self) -> spaces.Box:
        """A float32 Box [O]."""
        return _box(self.observation)

    def action_space(self) -> spaces.Discrete | spaces.Box:
        """Discrete from 0, or a float32 Box [A]."""
        return spaces.Discrete(self.actions) if isinstance(self.actions, int) else _box(self.actions)

    def require_equal(self, served: Description) -> None:
        """Raise ProtocolError if the server's environment is not this one."""
        if served.revision != self.revision:
            raise ProtocolError(
                f"the server has revision {served.revision} of {self.name}, this package has {self.revision}: "
                "install the package perturb of the server's version"
            )
        if served != self:
            raise ProtocolError(f"the server describes {self.name} as {served}, this package as {self}")

    def require_same_model(self, served: Description) -> None:
        """Raise ProtocolError if the server's model is not this one."""
        if served.model_hash != self.model_hash:
            raise ProtocolError(
                f"the files of {self.name} changed since it was made: its model was {self.model_hash}, the server's is "
                f"{served.model_hash}; make it anew"
            )


def _observed(disturbance: Mapping[str, Any]) -> Range:
    """The range in which a disturbance is observed: -1 to 1 are its least and its greatest value in R and E."""
    ends = [end for interval in (*disturbance["R"], *disturbance["E"]) for end in interval]
    least, greatest = min(ends), max(ends)

    def seen(value: float) -> float:
        distance = value - least
        return float(np.float32(2 * distance / (greatest - least) - 1 if greatest > least else distance))

    return seen(disturbance["low"]), seen(disturbance["high"])


def _box(ranges: tuple[Range, ...]) -> spaces.Box:
    low, high = np.array(ranges, dtype=np.float32).T
    return spaces.Box(low, high, dtype=np.float32)


_WRITTEN: Mapping[str, Any] = json.loads(resources.files(__package__).joinpath("catalogue.json").read_text("utf-8"))
_LIMITS: Mapping[str, Any] = _WRITTEN["limits"]

# All that the server told of its environments.
CATALOGUE_ENTRIES: tuple[Mapping[str, Any], ...] = tuple(_WRITTEN["environments"])
CATALOGUE: dict[str, Description] = {
    description.name: description for description in map(Description.read, CATALOGUE_ENTRIES)
}
# Width and height of a picture: the least and the most, and unless told otherwise.
MIN_PIXELS, MAX_PIXELS = _LIMITS["picture_pixels"]
DEFAULT_PIXELS: int = _LIMITS["usual_picture_pixels"]
# The longest path that a Unix socket can have, in bytes.
MAX_SOCKET_PATH_BYTES: int = _LIMITS["longest_socket_path"]


def find(name: str) -> Description:
    """Find an environment by its name or id: letters count in either case, `-` and `_` not at all.

    Raises:
        InvalidArgumentError: with the names that there are.
    """
    for description in CATALOGUE.values():
        if is_spelled(name, description):
            return description
    meant = difflib.get_close_matches(_name_and_revision(name)[0], CATALOGUE, n=1)
    hint = (
        f" (did you mean {meant[0]!r}?)"
        if meant
        else "; a task of a folder needs task='DIR', or a server that serves it"
    )
    raise InvalidArgumentError(f"environment={name!r} is none of {', '.join(CATALOGUE)}{hint}")


def is_spelled(name: str, description: Description) -> bool:
    """Whether a name or id stands for this environment.

    Raises:
        InvalidArgumentError: for an id of another revision.
    """
    written, revision = _name_and_revision(name)
    if _letters(description.name) != _letters(written):
        return False
    if revision not in (None, description.revision):
        current = f"{NAMESPACE}{description.name}-v{description.revision}"
        raise InvalidArgumentError(f"environment={name!r} is another revision than this package's {current}")
    return True


def _name_and_revision(name: str) -> tuple[str, int | None]:
    written = str(name)
    if written.lower().startswith(NAMESPACE):
        written = written[len(NAMESPACE) :]
        if matched := re.fullmatch(r"(.*)-v(\d+)", written):
            return matched[1], int(matched[2])
    return written, None


def _letters(name: str) -> str:
    return re.sub("[-_]", "", name).lower()
