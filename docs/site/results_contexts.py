"""The numbers of docs/findings/training-contexts.md, from the results table."""

from statistics import fmean

from results_numbers import t_interval
from results_words import NAMES, about, fill, spread

TASKS = ("CartPole", "Pendulum", "Acrobot", "MountainCar")
CONTEXT_COUNTS = (1, 4, 16, 64, 256)
SEEDS = range(31, 36)


def numbers(studies):
    """Return a number for each seed's policy, by task, algorithm, number of contexts and kind of number.

    The kinds are the tests `own`, the contexts of the training, `R` and `E`, with success in %, and `episodes`, the
    number of training episodes.
    """
    found = {}
    for task in TASKS:
        for algorithm in ("ppo", "a2c"):
            for count in CONTEXT_COUNTS:
                own = f"contexts{count}"
                cells = studies.finished("contexts", environment=task, algorithm=algorithm, trained_on=own)
                cells = sorted((cell for cell in cells if cell.seed in SEEDS), key=lambda cell: cell.seed)
                assert len(cells) == len(SEEDS), f"{len(cells)} cells of {algorithm} on {count} contexts of {task}"
                for test, name in {"own": own, "R": "R", "E": "E"}.items():
                    found[task, algorithm, count, test] = [cell.success(name) for cell in cells]
                found[task, algorithm, count, "episodes"] = [cell.episodes for cell in cells]
    return found


def training_contexts(studies):
    """Return the texts with numbers that the page must contain."""
    found = numbers(studies)
    texts = []
    for task, algorithm, count, test in found:
        if test == "own":
            runs = [found[task, algorithm, count, each] for each in ("own", "R", "E")]
            gained = zip(runs[1], found[task, algorithm, 1, "R"], strict=True)
            gain = "–"
            if count > 1:
                gain = fill("{:.1f} [{:.1f}, {:.1f}]", *t_interval([[rate - single for rate, single in gained]]))
            episodes = about(fmean(found[task, algorithm, count, "episodes"]))
            row = " | ".join([*map(spread, runs), gain, episodes])
            texts.append(f"| {task}, {NAMES[algorithm]} | {count} | {row} |")

    def mean(*key):
        return fmean(found[key])

    pendulum = zip(found["Pendulum", "ppo", 256, "R"], found["Pendulum", "ppo", 1, "R"], strict=True)
    quarter = [mean("MountainCar", algorithm, 4, "own") for algorithm in ("ppo", "a2c")]
    assert all(abs(rate - 75) < 1 for rate in quarter), quarter
    done, _ = studies.planned("contexts")
    return [
        *texts,
        f"{done} of 400 cells are finished",
        fill("On Pendulum, PPO gains {:.1f} points", fmean(rate - single for rate, single in pendulum)),
        fill(
            "one context gives {:.1f} % on R with PPO and {:.1f} % with A2C",
            mean("CartPole", "ppo", 1, "R"),
            mean("CartPole", "a2c", 1, "R"),
        ),
        fill(
            "from {:.1f} to {:.1f} % with PPO and from {:.1f} to {:.1f} % with A2C",
            *(mean("MountainCar", algorithm, count, "R") for algorithm in ("ppo", "a2c") for count in (1, 256)),
        ),
    ]
