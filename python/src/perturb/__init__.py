"""Gymnasium environments whose physics can be changed, served by perturb-server.

Importing this package registers its environments:

    import gymnasium
    import perturb

    env = gymnasium.make("perturb/Hopper-v0", version="R", server="unix:/tmp/perturb.sock")
    envs = gymnasium.make_vec("perturb/CartPole-v1", num_envs=64, version="E")
"""

import typing as _typing
import warnings as _warnings
from importlib.metadata import version as _version

from . import sets
from .assessment import Assessment
from .compared import Comparison
from .comparison import compare
from .comparison_results import ConditionDifference, ConditionMean
from .env import PerturbEnv
from .environments import Environment, Parameter, environments
from .errors import (
    AssignmentError,
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
from .evaluation import evaluate
from .examples import example_policies
from .policy import Actor, Policy, load_policy
from .registration import register_all as _register_all
from .requests import Version
from .results import Audit, Bin, Bin2D, Context, Result
from .results_table import read_results
from .tasks import register_ids as _register_tasks
from .training import Training, train
from .vector import PerturbVectorEnv

__version__ = _version("perturb-rl")

__all__ = [
    "Actor",
    "Assessment",
    "AssignmentError",
    "Audit",
    "Bin",
    "Bin2D",
    "Comparison",
    "ConditionDifference",
    "ConditionMean",
    "Context",
    "Environment",
    "InvalidArgumentError",
    "NotAllowedError",
    "OutOfOrderError",
    "Parameter",
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
    "Training",
    "UnknownNameError",
    "Version",
    "compare",
    "environments",
    "evaluate",
    "example_policies",
    "load_policy",
    "read_results",
    "sets",
    "train",
]

_register_all()
_register_tasks()

# The new name of each deprecated name. The names of version 0.1 work until version 0.3.
_DEPRECATED = {"assess": "evaluate", "Part": "Bin", "Cell": "Bin2D"}


if not _typing.TYPE_CHECKING:  # hidden from type checkers, so that they reject deprecated names

    def __getattr__(name: str) -> _typing.Any:
        """Return the object of a deprecated name. Issue a DeprecationWarning that states the new name."""
        if name not in _DEPRECATED:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        new = _DEPRECATED[name]
        _warnings.warn(
            f"perturb.{name} is now perturb.{new}; the old name will be removed in version 0.3", DeprecationWarning, 2
        )
        return globals()[new]
