"""The numbers of docs/findings/training-contexts.md, from the results table."""

from statistics import fmean

from results_numbers import ENVIRONMENTS, t_interval
from results_words import NAMES, fill, fixed, spread

COUNTS = (1, 4, 16, 64, 256)
ALGORITHMS = ("ppo", "a2c")
SEEDS = 10


def rates(studies):
    """Return the success of each seed's policy by task, algorithm, number of contexts and test, %.

    The tests are `own`, the contexts of the training, R and E.
    """
    found = {}
    for task in ENVIRONMENTS:
        for algorithm in ALGORITHMS:
            for count in COUNTS:
                own = f"contexts{count}"
                cells = studies.finished("contexts", environment=task, algorithm=algorithm, trained_on=own)
                assert len(cells) == SEEDS, f"the table has {len(cells)} cells of {algorithm} on {count} of {task}"
                cells.sort(key=lambda cell: cell.seed)
                for test, name in {"own": own, "R": "R", "E": "E"}.items():
                    found[task, algorithm, count, test] = [cell.success(name) for cell in cells]
    return found


def gap(found, task, algorithm, count):
    """Return success on the training's own contexts minus success on R, for each seed."""
    pairs = zip(found[task, algorithm, count, "own"], found[task, algorithm, count, "R"], strict=True)
    return [own - on_r for own, on_r in pairs]


def training_contexts(studies):
    """Return the texts with numbers that the page must contain."""
    found = rates(studies)
    texts = []
    for task in ENVIRONMENTS:
        for algorithm in ALGORITHMS:
            for count in COUNTS:
                row = [spread(found[task, algorithm, count, test]) for test in ("own", "R", "E")]
                middle, low, high = t_interval([gap(found, task, algorithm, count)])
                row.append(fill("{:.1f} [{:.1f}, {:.1f}]", middle, low, high))
                texts.append(f"| {NAMES[algorithm]}, {count} | " + " | ".join(row) + " |")
    return texts


__all__ = ["fixed", "fmean", "training_contexts"]
