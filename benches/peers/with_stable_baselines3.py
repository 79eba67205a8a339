"""Trains with stable-baselines3's A2C or PPO in one process, with the fastest number of PyTorch threads.

The environments run in the same process. This is the library's default, and faster than separate processes.
with_stable_baselines3.py CONTEST: the contest's index.
"""

import os
import sys
import time
from dataclasses import replace
from typing import Any

# Gymnax installs the old package gym. This line prevents stable-baselines3 from importing gym, which would print a
# warning about its age.
sys.modules["gym"] = None  # type: ignore[assignment]

import stable_baselines3  # noqa: E402
import torch  # noqa: E402
from contests import CONTESTS, Contest, Training, serve  # noqa: E402
from stable_baselines3.common.env_util import make_vec_env  # noqa: E402
from stable_baselines3.common.vec_env import VecNormalize  # noqa: E402

# Gymnasium's environments with perturb's time limits.
ENVIRONMENTS = {"CartPole": ("CartPole-v1", 200), "HalfCheetah": ("HalfCheetah-v5", 1000)}


def algorithm(contest: Contest, env: VecNormalize, seed: int) -> Any:
    """Return a new model. By default its networks have 64 × 64 tanh units, and its learning rate is constant."""
    settings = dict(contest.settings)
    own: dict[str, Any] = {"policy": "MlpPolicy", "env": env, "n_steps": contest.n_steps, "seed": seed, "device": "cpu"}
    if contest.algorithm == "a2c":
        alpha, eps = settings.pop("rms_alpha"), settings.pop("rms_eps")
        policy = {"optimizer_kwargs": {"alpha": alpha, "eps": eps, "weight_decay": 0}}
        return stable_baselines3.A2C(**own, **settings, rms_prop_eps=eps, policy_kwargs=policy)
    policy = {"optimizer_kwargs": {"eps": settings.pop("adam_eps")}}
    batch_size = contest.num_envs * contest.n_steps // int(settings.pop("n_minibatches"))
    return stable_baselines3.PPO(**own, **settings, batch_size=batch_size, policy_kwargs=policy)


def train(contest: Contest, seed: int) -> Training:
    """Train once, with observations and rewards normalised like perturb's."""
    name, limit = ENVIRONMENTS[contest.environment]
    env = VecNormalize(
        make_vec_env(name, n_envs=contest.num_envs, seed=seed, env_kwargs={"max_episode_steps": limit}),
        gamma=contest.settings["gamma"],
    )
    model = algorithm(contest, env, seed)
    start = time.perf_counter()
    model.learn(contest.steps)
    seconds = time.perf_counter() - start
    lengths = [episode["l"] for episode in model.ep_info_buffer]
    env.close()
    return Training(
        steps=model.num_timesteps,
        updates=model._n_updates,
        episode_length=sum(lengths) / max(len(lengths), 1),
        seconds=seconds,
    )


def fastest(contest: Contest) -> int:
    """Return the number of PyTorch threads, one or the number of cores, with which a short training is faster."""
    short = replace(contest, iterations=contest.iterations // 20)
    seconds = {}
    for threads in [1, len(os.sched_getaffinity(0))] * 2:
        torch.set_num_threads(threads)
        seconds[threads] = min(train(short, 0).seconds, seconds.get(threads, float("inf")))
    return min(seconds, key=lambda threads: seconds[threads])


contest = CONTESTS[int(sys.argv[1])]
threads = fastest(contest)
torch.set_num_threads(threads)
serve(f"PyTorch {torch.__version__}, threads: {threads}", lambda seed: train(contest, seed))
