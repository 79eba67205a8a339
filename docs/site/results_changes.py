"""The numbers of docs/findings/changing-physics.md, from the results table."""

from statistics import fmean

from results_numbers import wilson
from results_words import fill, fixed, spread

METHODS = {"PPO FF": ("ppo", "ff"), "PPO RC": ("ppo", "rc"), "RL²-PPO RC": ("rl2-ppo", "rc")}
TESTS = ("R", "changing", "earlier")
SEEDS = 3


def changing_physics(studies):
    """Return the texts with numbers that the page must contain."""
    texts, changed, heuristic = [], {}, {}
    for task in ("CartPole", "Pendulum"):
        for name, (algorithm, architecture) in METHODS.items():
            wanted = {"environment": task, "algorithm": algorithm, "architecture": architecture}
            cells = studies.finished("changes", trained_on="changing", **wanted)
            assert len(cells) == SEEDS, f"the table has {len(cells)} cells of {name} on {task}"
            fields = []
            for test in TESTS:
                rates = [cell.success(test) for cell in cells]
                ends = wilson(sum(rates) / SEEDS, sum(cell.tests[test][2] for cell in cells))
                fields.append(f"{spread(rates)} [{', '.join(map(fixed, ends))}]")
                changed[task, name, test] = sum(rates) / SEEDS
            lengths = sorted(cell.episodes for cell in cells)
            fields.append(f"{lengths[0]:,} to {lengths[-1]:,}".replace(",", " "))
            texts.append(f"| {name} | " + " | ".join(fields) + " |")
        rules = studies.finished("changes", environment=task, algorithm="heuristic")
        assert len(rules) == SEEDS, f"the table has {len(rules)} cells of the heuristic policy on {task}"
        heuristic[task] = [fmean(cell.success(test) for cell in rules) for test in TESTS]
        texts.append("| heuristic | " + " | ".join(map(fixed, heuristic[task])) + " | 0 |")
    rates = [rate for (_, _, test), rate in changed.items() if test != "R"]
    gain = changed["Pendulum", "RL²-PPO RC", "changing"] - changed["Pendulum", "PPO FF", "changing"]
    return [
        *texts,
        fill("succeed in {:.1f} to {:.1f} % of the episodes with a change", min(rates), max(rates)),
        fill("RL²-PPO is {:.1f} points better than PPO without memory", gain),
        fill("at least {:.1f} % of the episodes with a change", min(min(rates[1:]) for rates in heuristic.values())),
    ]
