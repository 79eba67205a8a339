"""The environments that this package knows, so that one can be made without a server, and before a fork.

The server has the same in its catalogue. The two are compared whenever a session opens; a difference is an error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from .errors import InvalidArgumentError, ProtocolError

if TYPE_CHECKING:
    from ._proto import perturb_pb2 as pb

Range = tuple[float, float]
ANY: Range = (-math.inf, math.inf)


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

    @property
    def discrete(self) -> bool:
        """Whether actions are choices."""
        return isinstance(self.actions, int)

    def metadata(self) -> dict[str, Any]:
        """What Gymnasium wants to know of pictures; as many in a second as show real time."""
        return {"render_modes": ["rgb_array"], "render_fps": 1 / self.control_timestep}

    def observation_space(self) -> spaces.Box:
        """A float32 Box [O]."""
        return _box(self.observation)

    def action_space(self) -> spaces.Discrete | spaces.Box:
        """Discrete from 0, or a float32 Box [A]."""
        return spaces.Discrete(self.actions) if isinstance(self.actions, int) else _box(self.actions)

    def require_equal(self, served: pb.Environment) -> None:
        """Raise ProtocolError if the server's environment is not this one."""
        action = served.action
        theirs = Description(
            served.name,
            served.revision,
            tuple((channel.low, channel.high) for channel in served.observation),
            len(action.discrete.names)
            if action.WhichOneof("kind") == "discrete"
            else tuple((channel.low, channel.high) for channel in action.continuous.channels),
            served.control_timestep,
        )
        if theirs.revision != self.revision:
            raise ProtocolError(
                f"the server has revision {theirs.revision} of {self.name}, this package has {self.revision}: "
                "install the perturb-client of the server's version"
            )
        if theirs != self:
            raise ProtocolError(f"the server describes {self.name} as {theirs}, this package as {self}")


def _box(ranges: tuple[Range, ...]) -> spaces.Box:
    low, high = np.array(ranges, dtype=np.float32).T
    return spaces.Box(low, high, dtype=np.float32)


def _robot(name: str, joints: int, contacts: int) -> Description:
    torso: tuple[Range, ...] = ((-5, 5), (-1, 1), (-1, 1), *[(-5.0, 5.0)] * 5)
    observation = (*torso, *[(-5.0, 5.0)] * (2 * joints), *[(0.0, 1.0)] * contacts)
    return Description(name, 0, observation, ((-1.0, 1.0),) * joints, 0.0165)


_UNIT: Range = (-1.0, 1.0)

CATALOGUE: dict[str, Description] = {
    description.name: description
    for description in (
        Description("CartPole", 0, (ANY,) * 4, 2, 0.02),
        Description("MountainCar", 0, ((-1.2, 0.6), (-0.07, 0.07)), 3, 1.0),
        Description("Acrobot", 0, (*[_UNIT] * 4, (-4 * math.pi, 4 * math.pi), (-9 * math.pi, 9 * math.pi)), 3, 0.2),
        Description("Pendulum", 0, (_UNIT, _UNIT, (-8.0, 8.0)), ((-2.0, 2.0),), 0.05),
        _robot("HalfCheetah", joints=6, contacts=6),
        _robot("Hopper", joints=3, contacts=1),
    )
}


def find(name: str) -> Description:
    """Find an environment by its name.

    Raises:
        InvalidArgumentError: with the names that there are.
    """
    if name not in CATALOGUE:
        raise InvalidArgumentError(f"environment={name!r} is none of {', '.join(CATALOGUE)}")
    return CATALOGUE[name]
