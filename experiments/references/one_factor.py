"""Test PPO policies and heuristic policies with one, some or all parameters outside the intervals of R.

Usage: python experiments/references/one_factor.py > experiments/references/one_factor.csv, with the Python package, in
the project's folder; some minutes

The PPO policies are those of the study beyond/confirm-2 in results/policies: five seeds trained on D and five trained
on R. The heuristic policy of each task, which is not trained, is tested with the same five seeds. Each parameter is
drawn from its interval of R, from the lower or from the upper interval of E. Every combination is tested with each
policy. The column `parameters` lists the choice for each parameter in the catalogue's order. The column `trained_on` is
empty for heuristic policies.
"""

import csv
import itertools
import sys

import perturb

TASKS = ("CartPole", "MountainCar", "Acrobot", "Pendulum")
SEEDS = range(7, 12)
# The name of a policy's file by its training version. A heuristic policy has the version "".
NAMES = {
    "D": "{task}-ppo-ff-D-9bd6546b-s{seed}",
    "R": "{task}-ppo-ff-R-9bd6546b-s{seed}",
    "": "{task}-heuristic-ff-D-d3af88ff-s7",
}
EPISODES = 200


def sets(environment):
    """Return a set for each combination of the parameters' intervals, by the combination's name."""
    choices = {
        name: {"R": parameter.random[0], "low": parameter.extreme[0], "high": parameter.extreme[1]}
        for name, parameter in environment.parameters.items()
        if len(parameter.extreme) == 2
    }
    found = {}
    for regions in itertools.product(("R", "low", "high"), repeat=len(choices)):
        drawn = {name: choices[name][region] for name, region in zip(choices, regions, strict=True) if region != "R"}
        label = " ".join(f"{name}={region}" for name, region in zip(choices, regions, strict=True))
        # A set's name is one word. The set without extreme parameters is version R.
        name = "_".join(f"{name}_{region}" for name, region in zip(choices, regions, strict=True))
        found[label] = perturb.sets.drawn(name, drawn, base="R") if drawn else "R"
    return found


def main():
    catalogue = perturb.environments()
    rows = csv.writer(sys.stdout, lineterminator="\n")
    rows.writerow(["environment", "trained_on", "seed", "parameters", "episodes", "successes"])
    for task in TASKS:
        tested = sets(catalogue[task])
        for trained, seed in itertools.product(NAMES, SEEDS):
            name = NAMES[trained].format(task=task, seed=seed)
            policy = perturb.load_policy(f"results/policies/{name}.safetensors")
            assessment = perturb.evaluate(
                policy,
                task,
                versions=list(tested.values()),
                episodes=EPISODES,
                seed=seed,
                success="code",
                progress=False,
            )
            for label, each in tested.items():
                result = assessment[each if each == "R" else each.name]
                rows.writerow(
                    [task, trained, seed, label, result.episodes, round(result.success_percent * result.episodes / 100)]
                )


if __name__ == "__main__":
    main()
