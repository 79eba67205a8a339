"""PPO in one file, in the manner of CleanRL, on a batch of environments in same-step autoreset mode. Needs PyTorch.

The return of a truncated episode is bootstrapped with the value of its final observation, which is in the infos of the
episode's last step.
Run: python cleanrl_ppo.py [--version R] [--steps 100000] [--server unix:/path]
"""

import argparse

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torch import nn
from torch.distributions import Categorical

import perturb  # noqa: F401  (registers the environments)

NUM_ENVS, N_STEPS, N_EPOCHS, MINIBATCH = 32, 64, 4, 256
GAMMA, GAE_LAMBDA, CLIP_RANGE, ENT_COEF, VF_COEF = 0.98, 0.95, 0.2, 0.0, 0.5
LEARNING_RATE, MAX_GRAD_NORM = 1e-3, 0.5


class Agent(nn.Module):  # type: ignore[misc]
    """A policy network and a value network, each with two hidden layers of 64 units."""

    def __init__(self, observations: int, actions: int) -> None:
        super().__init__()

        def network(outputs: int) -> nn.Sequential:
            return nn.Sequential(
                nn.Linear(observations, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs)
            )

        self.policy, self.value = network(actions), network(1)


def main() -> None:
    """Train a policy, and print the mean return of the last 100 episodes after every fifth update."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--version", choices=["D", "R", "E"], default="D")
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--server", help="unix:/path or host:port; by default a private server")
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)
    torch.set_num_threads(1)

    envs = RecordEpisodeStatistics(
        gymnasium.make_vec(
            "perturb/CartPole-v1",
            num_envs=NUM_ENVS,
            version=arguments.version,
            server=arguments.server,
            autoreset_mode="SameStep",
            copy=True,  # without effect here: arrays are always writable copies
        )
    )
    assert isinstance(envs.single_action_space, gymnasium.spaces.Discrete)
    now, _ = envs.reset(seed=arguments.seed)
    size = now.shape[1]
    agent = Agent(size, int(envs.single_action_space.n))
    optimizer = torch.optim.Adam(agent.parameters(), lr=LEARNING_RATE, eps=1e-5)

    observations = torch.zeros(N_STEPS, NUM_ENVS, size)
    actions = torch.zeros(N_STEPS, NUM_ENVS, dtype=torch.int64)
    log_probs, rewards, values, next_values, ended = (torch.zeros(N_STEPS, NUM_ENVS) for _ in range(5))

    for update in range(arguments.steps // (NUM_ENVS * N_STEPS)):
        for t in range(N_STEPS):
            observations[t] = torch.from_numpy(now)
            with torch.no_grad():
                distribution = Categorical(logits=agent.policy(observations[t]))
                actions[t] = distribution.sample()
                log_probs[t] = distribution.log_prob(actions[t])
                values[t] = agent.value(observations[t]).squeeze(-1)
            now, reward, terminated, truncated, infos = envs.step(actions[t].numpy())
            following = now.copy()
            if "final_obs" in infos:
                mask = infos["_final_obs"]
                following[mask] = np.stack(list(infos["final_obs"][mask]))
            with torch.no_grad():
                next_values[t] = agent.value(torch.from_numpy(following)).squeeze(-1)
            next_values[t][torch.from_numpy(terminated)] = 0.0
            rewards[t] = torch.from_numpy(reward)
            ended[t] = torch.from_numpy(terminated | truncated)

        advantages = torch.zeros(N_STEPS, NUM_ENVS)
        advantage = torch.zeros(NUM_ENVS)
        for t in reversed(range(N_STEPS)):
            delta = rewards[t] + GAMMA * next_values[t] - values[t]
            advantage = delta + GAMMA * GAE_LAMBDA * (1 - ended[t]) * advantage
            advantages[t] = advantage
        returns = (advantages + values).flatten()
        flat = observations.flatten(0, 1), actions.flatten(), log_probs.flatten(), advantages.flatten()

        for _ in range(N_EPOCHS):
            for indices in torch.randperm(NUM_ENVS * N_STEPS).split(MINIBATCH):
                seen, chosen, old, advantage = (array[indices] for array in flat)
                distribution = Categorical(logits=agent.policy(seen))
                ratio = (distribution.log_prob(chosen) - old).exp()
                advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
                clipped = ratio.clamp(1 - CLIP_RANGE, 1 + CLIP_RANGE)
                policy_loss = -torch.min(ratio * advantage, clipped * advantage).mean()
                value_loss = (agent.value(seen).squeeze(-1) - returns[indices]).pow(2).mean()
                loss = policy_loss + VF_COEF * value_loss - ENT_COEF * distribution.entropy().mean()
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), MAX_GRAD_NORM)
                optimizer.step()

        if update % 5 == 4:
            steps = (update + 1) * NUM_ENVS * N_STEPS
            print(f"{steps:7} steps, mean return of the last 100 episodes {np.mean(envs.return_queue):6.1f}")
    envs.close()


if __name__ == "__main__":
    main()
