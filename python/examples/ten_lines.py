"""A loop of ten lines: random actions on hoppers of random physics, on a server that starts and ends with the loop."""

import gymnasium

import perturb  # noqa: F401  (registers the environments)

envs = gymnasium.make_vec("perturb/Hopper-v0", num_envs=8, version="R")
observations, infos = envs.reset(seed=1)
print("frictions:", infos["parameters"]["friction"].round(2))
for _ in range(200):
    observations, rewards, terminated, truncated, infos = envs.step(envs.action_space.sample())
    if "is_success" in infos:
        print("ended:", (terminated | truncated).nonzero()[0], "succeeded:", infos["is_success"].sum())
envs.close()
