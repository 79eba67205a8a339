"""Train with stable-baselines3 on one version, and test on all three: does the policy generalise?

Run: python sb3_generalization.py [--environment Pendulum] [--train D] [--steps 50000]
"""

import argparse

import torch
from stable_baselines3 import PPO

import perturb

EPISODES = 100


def success_rate(model: PPO, environment: str, version: perturb.Version) -> float:
    """Return the share of successful episodes in percent."""
    env = perturb.PerturbEnv(environment, version=version)
    successes = 0
    for episode in range(EPISODES):
        observation, _ = env.reset(seed=10_000 + episode)
        ended = False
        while not ended:
            action, _ = model.predict(observation, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
        successes += info["is_success"]
    env.close()
    return 100 * successes / EPISODES


def main() -> None:
    """Train a policy, and test it on all versions."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--environment", default="CartPole")
    parser.add_argument("--train", choices=["D", "R", "E"], default="D")
    parser.add_argument("--steps", type=int, default=50_000)
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # for networks this small, a second thread costs more time than it saves

    env = perturb.PerturbEnv(arguments.environment, version=arguments.train)
    model = PPO("MlpPolicy", env, seed=1, device="cpu").learn(arguments.steps)
    env.close()
    versions: tuple[perturb.Version, ...] = ("D", "R", "E")
    for version in versions:
        rate = success_rate(model, arguments.environment, version)
        print(f"trained on {arguments.train}, tested on {version}: {rate:.0f} % of {EPISODES} episodes succeeded")


if __name__ == "__main__":
    main()
