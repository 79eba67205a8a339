"""The contests: trainings that do the same work in perturb and in other libraries (peers)."""

import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace

# Settings with perturb's names and defaults. The program of each peer translates them to the peer's names. Learning
# rates are constant.
PPO = {
    "learning_rate": 3e-4,
    "n_epochs": 10,
    "n_minibatches": 1,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "clip_range_vf": 0.2,
    "ent_coef": 0.0,
    "vf_coef": 0.5,
    "max_grad_norm": 0.5,
    "adam_eps": 1e-5,
}
A2C = {
    "learning_rate": 7e-4,
    "gamma": 0.99,
    "ent_coef": 0.01,
    "vf_coef": 0.5,
    "max_grad_norm": 0.5,
    "rms_alpha": 0.99,
    "rms_eps": 1e-5,
}


@dataclass(frozen=True)
class Peer:
    """A library to compare with. `script` is a program of this folder that takes the index of a contest."""

    name: str
    script: str
    # Environment variables of the peer's process, in addition to those of this process.
    environ: dict[str, str] = field(default_factory=dict)


PUREJAXRL = Peer("PureJaxRL", "with_purejaxrl.py")
# PureJaxRL with XLA's older CPU runtime. JAX uses the newer runtime by default, but it is slower for small networks.
PUREJAXRL_WITHOUT_THUNKS = replace(
    PUREJAXRL,
    name="PureJaxRL, thunk runtime off",
    environ={"XLA_FLAGS": "--xla_cpu_use_thunk_runtime=false"},
)
STABLE_BASELINES3 = Peer("stable-baselines3", "with_stable_baselines3.py")


@dataclass(frozen=True)
class Contest:
    """A training of `steps` steps from new weights, with separate policy and value networks of 64 × 64 tanh units."""

    algorithm: str
    environment: str
    num_envs: int
    n_steps: int
    iterations: int
    peers: tuple[Peer, ...]
    # Minimum mean length of the last episodes, in steps, which shows that the training learned. CartPole's episodes
    # last about 20 steps without learning. Episodes of HalfCheetah end early in perturb if the robot falls. In
    # Gymnasium they never end early.
    min_length: float

    @property
    def name(self) -> str:
        """The id of the contest, in the same format as the ids of `benches/serving`."""
        return f"{self.algorithm}_ff/{self.environment}/{self.num_envs}x{self.n_steps}"

    @property
    def settings(self) -> dict[str, float]:
        """The settings of the algorithm."""
        return PPO if self.algorithm == "ppo" else A2C

    @property
    def steps(self) -> int:
        """The number of steps in one training, summed over all environments."""
        return self.iterations * self.num_envs * self.n_steps

    @property
    def updates(self) -> int:
        """The number of optimiser steps in one training."""
        return self.iterations * (PPO["n_epochs"] * PPO["n_minibatches"] if self.algorithm == "ppo" else 1)


CONTESTS = [
    Contest("ppo", "CartPole", 8, 128, iterations=200, peers=(PUREJAXRL, PUREJAXRL_WITHOUT_THUNKS), min_length=60),
    # The number of iterations is a multiple of 100, because perturb logs only every 100th iteration of A2C.
    Contest("a2c", "CartPole", 16, 5, iterations=1500, peers=(STABLE_BASELINES3,), min_length=60),
    Contest("ppo", "HalfCheetah", 8, 128, iterations=60, peers=(STABLE_BASELINES3,), min_length=100),
]


@dataclass(frozen=True)
class Training:
    """The result of a training."""

    steps: int
    updates: int
    # Mean length of the last episodes, in steps.
    episode_length: float
    seconds: float

    def rate(self, contest: Contest) -> float:
        """Return environment steps per second. Fail if the training did different work or did not learn."""
        assert self.steps == contest.steps, f"{self.steps} steps in place of {contest.steps}"
        assert self.updates == contest.updates, f"{self.updates} updates in place of {contest.updates}"
        assert self.episode_length >= contest.min_length, (
            f"episodes last {self.episode_length} steps, expected {contest.min_length} or more"
        )
        return self.steps / self.seconds


def serve(remark: str, train: Callable[[int], Training]) -> None:
    """Train once for every seed read from standard input. Imports and compilation happen only once for all rounds."""
    print(remark, flush=True)
    for seed in sys.stdin:
        print(json.dumps(asdict(train(int(seed)))), flush=True)
