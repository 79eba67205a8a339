"""Trains with PureJaxRL's unchanged ppo.py on all cores. It is compiled before the measurement.

with_purejaxrl.py CONTEST CLONE: the contest's index, and a clone of github.com/luchris429/purejaxrl.
"""

import sys
import time
from pathlib import Path
from types import ModuleType

from contests import CONTESTS, PPO, Training, serve

contest = CONTESTS[int(sys.argv[1])]
sys.path.insert(0, str(Path(sys.argv[2]) / "purejaxrl"))
# PureJaxRL imports these large packages for environments that are not measured here. Empty modules replace them.
for name in ("brax", "brax.envs", "brax.envs.wrappers", "brax.envs.wrappers.training", "navix"):
    sys.modules[name] = ModuleType(name)
sys.modules["brax.envs.wrappers.training"].EpisodeWrapper = None
sys.modules["brax.envs.wrappers.training"].AutoResetWrapper = None

import jax  # noqa: E402
import ppo  # noqa: E402

assert contest.algorithm == "ppo"
assert PPO["clip_range"] == PPO["clip_range_vf"], "PureJaxRL has one range for both"
assert PPO["adam_eps"] == 1e-5, "PureJaxRL has this value fixed"
compiled = jax.jit(
    ppo.make_train(
        {
            "ENV_NAME": f"{contest.environment}-v1",
            "NUM_ENVS": contest.num_envs,
            "NUM_STEPS": contest.n_steps,
            "TOTAL_TIMESTEPS": contest.steps,
            "UPDATE_EPOCHS": PPO["n_epochs"],
            "NUM_MINIBATCHES": PPO["n_minibatches"],
            "LR": PPO["learning_rate"],
            "ANNEAL_LR": False,
            "GAMMA": PPO["gamma"],
            "GAE_LAMBDA": PPO["gae_lambda"],
            "CLIP_EPS": PPO["clip_range"],
            "ENT_COEF": PPO["ent_coef"],
            "VF_COEF": PPO["vf_coef"],
            "MAX_GRAD_NORM": PPO["max_grad_norm"],
            "ACTIVATION": "tanh",
            "DEBUG": False,
        }
    )
)


def train(seed: int) -> Training:
    """Train once. The first call also compiles the training."""
    key = jax.random.PRNGKey(seed)
    start = time.perf_counter()
    outcome = jax.block_until_ready(compiled(key))
    seconds = time.perf_counter() - start
    # Length of the last finished episode, for each iteration, step and environment.
    lengths = outcome["metrics"]["returned_episode_lengths"]
    return Training(
        steps=lengths.size,
        updates=int(outcome["runner_state"][0].step),
        episode_length=float(lengths[-1, -1].mean()),
        seconds=seconds,
    )


train(0)
serve(f"JAX {jax.__version__}, {jax.devices()[0].platform}", train)
