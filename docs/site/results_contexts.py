"""The numbers of docs/findings/training-contexts.md, from the results table."""

from statistics import fmean

import results_lines
from results_numbers import ENVIRONMENTS, holm, sign_flip_p, t_interval
from results_words import NAMES, about, fill, listed, spread

CONTEXT_COUNTS = (1, 4, 16, 64, 256)
SEED_COUNT = 10


def numbers(studies):
    """Return a number for each seed's policy, by task, algorithm, number of contexts and kind of number.

    The kinds are the tests `own`, the contexts of the training, `R` and `E`, with success in %, and `episodes`, the
    number of training episodes.
    """
    found = {}
    for task in ENVIRONMENTS:
        for algorithm in ("ppo", "a2c"):
            for count in CONTEXT_COUNTS:
                own = f"contexts{count}"
                cells = studies.finished("contexts", environment=task, algorithm=algorithm, trained_on=own)
                assert len(cells) == SEED_COUNT, f"{len(cells)} cells of {algorithm} on {count} contexts of {task}"
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

    for task in ENVIRONMENTS:
        rates = {"heuristic": results_lines.heuristic(studies, task), "upper bound": results_lines.upper_bound(task)}
        for name, known in rates.items():
            if known:
                texts.append(f"| {task}, {name} | | | {results_lines.joined(known, places=(1, 2))} | | |")

    def mean(*key):
        return fmean(found[key])

    gains = {}
    for task in ENVIRONMENTS:
        for algorithm in ("ppo", "a2c"):
            pairs = zip(found[task, algorithm, 256, "R"], found[task, algorithm, 1, "R"], strict=True)
            gains[f"{NAMES[algorithm]} on {task}"] = [rate - single for rate, single in pairs]
    corrected = dict(zip(gains, holm([sign_flip_p(gain) for gain in gains.values()]), strict=True))
    significant = [name for name, p in corrected.items() if p < 0.05]

    for algorithm in ("ppo", "a2c"):  # on MountainCar, 4 to 16 contexts give most of the gain
        single, four, sixteen, _, most = (mean("MountainCar", algorithm, count, "R") for count in CONTEXT_COUNTS)
        assert min(four, sixteen) - single > (most - single) / 2, f"{algorithm}: {single}, {four}, {sixteen}, {most}"
    on_pendulum = [mean("Pendulum", "ppo", count, "R") - mean("Pendulum", "ppo", 1, "R") for count in (256, 64)]
    quarter = [mean("MountainCar", algorithm, 4, "own") for algorithm in ("ppo", "a2c")]
    assert all(abs(rate - 75) < 1 for rate in quarter), quarter
    return [
        *texts,
        f"the gain with 256 contexts is significant for {listed(significant)}",
        fill("On Pendulum, PPO gains {:.1f} points with 256 contexts and {:.1f} with 64", *on_pendulum),
        fill("A2C on CartPole improves from {:.1f} to {:.1f} %", *(mean("CartPole", "a2c", n, "E") for n in (1, 256))),
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
