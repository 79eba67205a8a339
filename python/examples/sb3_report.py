"""Train stable-baselines3's PPO on D and R, test it on D, R and E, and write a report.

The report also shows the results of the paper's agents and of a study in this repository.
Run: python sb3_report.py STEPS EPISODES FOLDER, e.g. 200000 1000 /tmp/sb3-report
"""

import sys
from pathlib import Path

from stable_baselines3 import PPO

import perturb.sb3

steps, episodes, folder = int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])
# Our agents: the study beyond/confirm-2 in the results table results.parquet. Instead of a study, the path may also be
# any --out folder of `perturb run`.
ours = Path(__file__).parents[2] / "results/results.parquet/beyond/confirm-2"
assessments = []
for environment in ("CartPole", "Hopper"):
    for version in ("D", "R"):
        envs = perturb.sb3.make_vec_env(environment, 8, version=version, seed=1)
        PPO("MlpPolicy", envs, n_steps=256, seed=1, device="cpu").learn(steps).save(folder / f"{environment}-{version}")
        envs.close()
    models = {version: PPO.load(folder / f"{environment}-{version}", device="cpu") for version in ("D", "R")}
    assessments.append(perturb.evaluate(models, environment, episodes=episodes, seed=1, name="SB3 PPO"))
    assessments[-1].save(folder / environment)
    print(assessments[-1])
assessments[0].to_html(folder / "report.html", beside=[assessments[1], ours])
