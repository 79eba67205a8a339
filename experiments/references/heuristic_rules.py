"""Test the heuristic policies by the success rules of the paper's text and of the paper's code.

Usage: python experiments/references/heuristic_rules.py > experiments/references/heuristic_rules.csv, with the Python
package, in the project's folder; under a minute

The episodes are those of the study experiments/heuristic.toml. The study's results have only the rule of the code. The
file has the number of successes by each rule, in the columns `text` and `code`.
"""

import csv
import sys

import perturb

TASKS = ("CartPole", "Pendulum", "Acrobot", "MountainCar")
SEEDS = range(7, 12)
EPISODES = 1000


def main():
    rows = csv.writer(sys.stdout, lineterminator="\n")
    rows.writerow(["environment", "seed", "version", "episodes", "text", "code"])
    for task in TASKS:
        # A heuristic policy has no random weights, so the policies of all seeds are equal.
        policy = perturb.load_policy(f"results/policies/{task}-heuristic-ff-D-d3af88ff-s7.safetensors")
        for seed in SEEDS:
            assessment = perturb.evaluate(
                policy, task, versions=list("DRE"), episodes=EPISODES, seed=seed, progress=False
            )
            judged = {rule: assessment.judged_by(rule) for rule in ("text", "code")}
            for version in "DRE":
                tests = [judged[rule][version] for rule in ("text", "code")]
                successes = [round(test.success_percent * test.episodes / 100) for test in tests]
                rows.writerow([task, seed, version, tests[0].episodes, *successes])


if __name__ == "__main__":
    main()
