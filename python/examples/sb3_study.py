"""A study of domain randomisation: Hopper, PPO of stable-baselines3, two conditions with three seeds each."""

import sys

from stable_baselines3 import PPO

import perturb
import perturb.sb3

steps, episodes, out = sys.argv[1:] if len(sys.argv) > 1 else ("250000", "1000", "study.csv")


def train(version: perturb.Version, seed: int) -> PPO:  # noqa: D103
    envs = perturb.sb3.make_vec_env("Hopper", 16, version=version, seed=seed)
    return PPO("MlpPolicy", envs, n_steps=128, batch_size=256, seed=seed, device="cpu").learn(int(steps))


conditions = {"no DR": [train("D", seed) for seed in (1, 2, 3)], "DR": [train("R", seed) for seed in (1, 2, 3)]}
comparison = perturb.compare(conditions, "Hopper", episodes=int(episodes), seed=1, score="return")
comparison.to_pandas("episodes").to_csv(out, index=False)
print(comparison)
