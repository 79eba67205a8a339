"""stable-baselines3's PPO, with its default settings, on CartPole.

Trains until the mean return of the last 100 episodes is 195, or for 60 000 steps, and tests the policy. Needs
stable-baselines3. Run: python sb3_ppo.py [--seed 1] [--version D] [--server unix:/path]
"""

import argparse

import gymnasium
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

import perturb  # noqa: F401  (registers the environments)

GOAL, STEPS = 195.0, 60_000


class StopAtGoal(BaseCallback):  # type: ignore[misc]
    """Ends the training when the last 100 episodes are good enough."""

    def _on_step(self) -> bool:
        episodes = self.model.ep_info_buffer
        return len(episodes) < 100 or sum(episode["r"] for episode in episodes) / len(episodes) < GOAL


def main() -> None:
    """Train a policy, and test it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--version", choices=["D", "R", "E"], default="D")
    parser.add_argument("--server", help="unix:/path or host:port; by default a private server")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # for networks this small, a second thread costs more time than it saves

    env = Monitor(gymnasium.make("perturb/CartPole-v1", version=arguments.version, server=arguments.server))
    model = PPO("MlpPolicy", env, seed=arguments.seed, device="cpu")
    model.learn(STEPS, callback=StopAtGoal())
    last = [episode["r"] for episode in model.ep_info_buffer]
    mean, _ = evaluate_policy(model, env, n_eval_episodes=100)
    env.close()
    print(f"{model.num_timesteps} steps, mean return of the last {len(last)} episodes {sum(last) / len(last):.1f}")
    print(f"mean return of 100 test episodes {mean:.1f}")


if __name__ == "__main__":
    main()
