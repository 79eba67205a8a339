"""Descriptions of the built-in environments, read from the file catalogue.json.

With a description, an environment can be constructed without a server, for example in a process that is forked later.
The build of the package writes the output of `perturb-server --catalogue` to catalogue.json. When a session opens, its
environment's description is compared with the server's. A difference is an error.
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

# Namespace of the environments' ids in Gymnasium.
NAMESPACE = "perturb/"


@dataclass(frozen=True)
class Success:
    """A success rule: compares a quantity that an episode achieved with a threshold."""

    description: str
    # The compared quantity, such as "steps".
    quantity: str
    # The unit of the quantity and of the threshold.
    unit: str
    # "at_least" or "at_most".
    comparison: str
    threshold: float


@dataclass(frozen=True)
class Description:
    """The description of an environment.

    Two descriptions are equal if their names, revisions, spaces and timesteps are equal.
    """

    name: str
    revision: int
    # The range of each number of an observation, [O].
    observation: tuple[Range, ...]
    # The number of choices of a discrete action, or the range of each number of a continuous action.
    actions: int | tuple[Range, ...]
    # Simulated time in one step, s.
    control_timestep: float
    # The ranges of the parameters at the end of an observation, for sessions that observe parameters.
    parameter_observations: tuple[Range, ...] = field(default=(), compare=False)
    # The success rule in this package's version. The server that decides `is_success` may have a different rule.
    success: Success | None = field(default=None, compare=False)
    # The lowest and the highest accepted value of each parameter of the physics, by name.
    parameters: Mapping[str, Range] = field(default_factory=dict, compare=False)
    # The lowest and the highest accepted value of each disturbance, by name. A session has disturbances only if its
    # parameters name at least one disturbance.
    disturbances: Mapping[str, Range] = field(default_factory=dict, compare=False)
    # For each disturbance, by name, the value at which it has no effect.
    undisturbed: Mapping[str, float] = field(default_factory=dict, compare=False)
    # The range of each disturbance's entry in observations, by name.
    disturbance_observations: Mapping[str, Range] = field(default_factory=dict, compare=False)
    # Number of steps after which an episode is truncated. None if unknown.
    step_limit: int | None = field(default=None, compare=False)
    # SHA-256 of the model in hexadecimal digits; empty without a model.
    model_hash: str = field(default="", compare=False)

    @classmethod
    def read(cls, entry: Mapping[str, Any]) -> Description:
        """Parse the JSON description of an environment from catalogue.json or from a server.

        A null at an end of a range means that the range is unbounded there.
        """

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
        """Return the description for a session whose parameters have these names.

        If one of the names is a disturbance, all disturbances become parameters of the returned description.
        """
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
        """Whether the parameters include the disturbances."""
        return not self.disturbances.keys().isdisjoint(self.parameters)

    def observing_parameters(self) -> Description:
        """Return the description for a session that appends the parameters to its observations."""
        return replace(self, observation=self.observation + self.parameter_observations)

    @property
    def discrete(self) -> bool:
        """Whether actions are discrete."""
        return isinstance(self.actions, int)

    def metadata(self) -> dict[str, Any]:
        """Return the `metadata` of a Gymnasium environment, with the success rule as the additional key `success`.

        `render_fps` is the number of pictures per second at which a film of one picture per step runs in real time.
        """
        pictures = {"render_modes": ["rgb_array"], "render_fps": 1 / self.control_timestep}
        return pictures if self.success is None else {**pictures, "success": asdict(self.success)}

    def observation_space(self) -> spaces.Box:
        """Return the observation space, a float32 Box [O]."""
        return _box(self.observation)

    def action_space(self) -> spaces.Discrete | spaces.Box:
        """Return the action space: a Discrete that starts at 0, or a float32 Box [A]."""
        return spaces.Discrete(self.actions) if isinstance(self.actions, int) else _box(self.actions)

    def require_equal(self, served: Description) -> None:
        """Check that the server's environment has this description.

        Raises:
            ProtocolError: if the revision, the spaces or the timestep differ.
        """
        if served.revision != self.revision:
            raise ProtocolError(
                f"the server has revision {served.revision} of {self.name}, this package has {self.revision}: "
                "install the package perturb of the server's version"
            )
        if served != self:
            raise ProtocolError(f"the server describes {self.name} as {served}, this package as {self}")

    def require_same_model(self, served: Description) -> None:
        """Check that the server loaded the same files of the task folder.

        Raises:
            ProtocolError: if the hash of the server's model differs.
        """
        if served.model_hash != self.model_hash:
            raise ProtocolError(
                f"the files of {self.name} changed since it was made: its model was {self.model_hash}, the server's is "
                f"{served.model_hash}; make it again"
            )


def _observed(disturbance: Mapping[str, Any]) -> Range:
    """Return the range of a disturbance's entry in observations.

    The entry is scaled so that the lowest and the highest value that R and E draw become -1 and 1.
    """
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

# The environments' descriptions as dictionaries, in the JSON format of `perturb-server --catalogue`.
CATALOGUE_ENTRIES: tuple[Mapping[str, Any], ...] = tuple(_WRITTEN["environments"])
CATALOGUE: dict[str, Description] = {
    description.name: description for description in map(Description.read, CATALOGUE_ENTRIES)
}
# Limits for the width and for the height of a picture, in pixels.
MIN_PIXELS, MAX_PIXELS = _LIMITS["picture_pixels"]
# The default width and height of a picture, in pixels.
DEFAULT_PIXELS: int = _LIMITS["usual_picture_pixels"]
# The maximum length of a Unix socket's path, in bytes.
MAX_SOCKET_PATH_BYTES: int = _LIMITS["longest_socket_path"]


def find(name: str) -> Description:
    """Find a built-in environment by its name or id. Case and the characters `-` and `_` are ignored.

    Raises:
        InvalidArgumentError: if there is no such environment. The message lists the known ones.
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
    """Whether a name or id means this environment. Case and the characters `-` and `_` are ignored.

    Raises:
        InvalidArgumentError: if the id has another revision than the environment.
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
