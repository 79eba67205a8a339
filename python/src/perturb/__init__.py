"""Gymnasium environments whose physics can be changed, served by perturb-server.

Importing this package registers its environments:

    import gymnasium
    import perturb

    env = gymnasium.make("perturb/Hopper-v0", version="R", server="unix:/tmp/perturb.sock")
    envs = gymnasium.make_vec("perturb/CartPole-v1", num_envs=64, version="E")
"""

from importlib.metadata import version as _version

from . import sets
from .assess import assess
from .assessment import Assessment
from .env import PerturbEnv
from .environments import Environment, Parameter, environments
from .errors import (
    InvalidArgumentError,
    NotAllowedError,
    OutOfOrderError,
    PerturbError,
    PolicyError,
    ProtocolError,
    RenderError,
    ServerConnectionError,
    ServerDefectError,
    ServerFullError,
    ServerStartError,
    ServerTimeoutError,
    ServerUnavailableError,
    UnknownNameError,
)
from .policy import Actor, Policy, load_policy
from .registration import register_all as _register_all
from .requests import Version
from .results import Audit, Cell, Context, Part, Result
from .vector import PerturbVectorEnv

__version__ = _version("perturb")

__all__ = [
    "Actor",
    "Assessment",
    "Audit",
    "Cell",
    "Context",
    "Environment",
    "InvalidArgumentError",
    "NotAllowedError",
    "OutOfOrderError",
    "Parameter",
    "Part",
    "PerturbEnv",
    "PerturbError",
    "PerturbVectorEnv",
    "Policy",
    "PolicyError",
    "ProtocolError",
    "RenderError",
    "Result",
    "ServerConnectionError",
    "ServerDefectError",
    "ServerFullError",
    "ServerStartError",
    "ServerTimeoutError",
    "ServerUnavailableError",
    "UnknownNameError",
    "Version",
    "assess",
    "environments",
    "load_policy",
    "sets",
]

_register_all()
