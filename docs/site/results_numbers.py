"""Numbers of studies, computed from rows of the results table: metrics, selection, intervals and tests."""

import csv
import itertools
import json
import math
import random
from collections import defaultdict
from pathlib import Path
from statistics import fmean

import perturb

TABLE = Path("results/results.parquet")
PAPER = Path("crates/records/data/paper_results.csv")
ENVIRONMENTS = ("CartPole", "Pendulum", "Acrobot", "MountainCar")
METRICS = ("Default", "Interpolation", "Extrapolation")
# A sign-flip test of up to EXACT_PAIRS pairs uses all choices of signs. A test of more pairs draws CHOICES random
# choices. The report uses the same two numbers.
CHOICES = 100_000
EXACT_PAIRS = 16
Z = 1.959963984540054  # of a 95 % interval


def cube_root(product):
    return product ** (1 / 3)


def metrics(rate):
    """Return Default, Interpolation and Extrapolation by `rate(trained_on, tested_on)`, %; None if one is missing."""
    rates = {pair: rate(*pair) for pair in ("DD", "RR", "DR", "DE", "RE")}
    needed = [rates["DR"], rates["DE"], rates["RE"]]
    extrapolation = None if None in needed else cube_root(math.prod(needed))
    return [rates["DD"], rates["RR"], extrapolation]


def std(numbers):
    """Return the deviation with n in the denominator."""
    middle = fmean(numbers)
    return math.sqrt(fmean((number - middle) ** 2 for number in numbers))


class Cell:
    """A finished cell: its settings, and the figures of the tests of its final and intermediate policies."""

    def __init__(self, rows):
        first, last = rows[0], rows[-1]
        for name in (
            "study",
            "cell",
            "environment",
            "algorithm",
            "architecture",
            "trained_on",
            "run",
            "seed",
            "seconds",
        ):
            setattr(self, name, first[name])
        self.settings = json.loads(first["settings"])
        self.failed = first["failure"] is not None
        self.episodes, self.timesteps = last["after_episodes"], last["timesteps"]
        self.configuration = first["cell"].split("-")[-2]
        self.tests, self.marks = {}, defaultdict(dict)
        # Whether the episodes of the final policy have checksums.
        self.checked = last.get("checksum") is not None
        # Rows of intermediate policies come first, and rows of the final policy last.
        for row in rows if not self.failed else []:
            test = (100 * row["successes"] / row["episodes"], row["mean_return"], row["episodes"])
            self.marks[row["after_episodes"]][row["tested_on"]] = test
            if row["after_episodes"] == self.episodes:
                self.tests[row["tested_on"]] = test

    @property
    def method(self):
        trials = self.settings.get("episodes_per_trial")
        return (self.algorithm, self.architecture, trials)

    def success(self, tested_on, after=None):
        tests = self.tests if after is None else self.marks[after]
        return tests[tested_on][0] if tested_on in tests else None


class Studies:
    """The cells of all studies in the results table, and the numbers of the paper."""

    def __init__(self, rows):
        blocks = defaultdict(list)
        for row in rows:
            blocks[row["study"], row["cell"]].append(row)
        self.cells = [Cell(block) for block in blocks.values()]
        with PAPER.open() as file:
            self.paper_rows = list(csv.DictReader(line for line in file if not line.startswith("#")))

    def finished(self, study, **wanted):
        """Return the finished cells of a study whose settings or attributes are `wanted`, ordered by seed."""

        def fits(cell, name, value):
            return value == (getattr(cell, name) if hasattr(cell, name) else cell.settings.get(name))

        cells = [cell for cell in self.cells if cell.study == study and not cell.failed]
        chosen = (cell for cell in cells if all(fits(cell, *pair) for pair in wanted.items()))
        return sorted(chosen, key=lambda cell: cell.seed)

    def planned(self, study):
        """Return the number of finished cells and the number of failed cells."""
        cells = [cell for cell in self.cells if cell.study == study]
        return sum(not cell.failed for cell in cells), sum(cell.failed for cell in cells)

    def hours(self, *studies):
        return sum(cell.seconds or 0 for cell in self.cells if cell.study in studies) / 3600

    def paper(self, environment, method, metric):
        """Return the paper's mean and deviation, %."""
        algorithm, architecture, trials = method
        for row in self.paper_rows:
            known = (row["algorithm"].lower(), row["architecture"].lower(), row["episodes_per_trial"])
            same = known == (algorithm, architecture, str(trials or ""))
            if same and row["environment"] == environment and row["metric"] == metric.lower():
                return float(row["mean_percent"]), float(row["std_percent"])
        return None

    def paper_mean(self, method, metric, environments=ENVIRONMENTS):
        return fmean(self.paper(environment, method, metric)[0] for environment in environments)

    def by_seed(self, study, environment, method, **wanted):
        """Return the three metrics of each seed of a method with one configuration for each training version."""
        algorithm, architecture, trials = method
        cells = self.finished(study, environment=environment, algorithm=algorithm, architecture=architecture, **wanted)
        cells = [cell for cell in cells if cell.method[2] == trials]
        found = {(cell.seed, cell.trained_on): cell for cell in cells}
        seeds = sorted({seed for seed, _ in found})

        def rate(seed):
            return lambda trained, tested: found[seed, trained].success(tested) if (seed, trained) in found else None

        return {seed: metrics(rate(seed)) for seed in seeds}

    def tied(self, study, environment, algorithm, trained_on, seed=1):
        """Return the cells that share the best result under the paper's rule: the same success and mean return."""
        cells = self.finished(study, environment=environment, algorithm=algorithm, trained_on=trained_on, seed=seed)
        best = max(cell.tests[trained_on][:2] for cell in cells)
        return [cell for cell in cells if cell.tests[trained_on][:2] == best]

    def published_rule(self, study, environment, algorithm):
        """Return each metric by the paper's rule on seed 1: mean, lowest and highest over tied configurations."""
        tied = {version: self.tied(study, environment, algorithm, version) for version in "DR"}
        values = []
        for on_d, on_r in itertools.product(tied["D"], tied["R"]):
            chosen = {"D": on_d, "R": on_r}
            values.append(metrics(lambda trained, tested, chosen=chosen: chosen[trained].success(tested)))
        default = [cell.success("D") for cell in tied["D"]]
        interpolation = [cell.success("R") for cell in tied["R"]]
        every = [default, interpolation, [value[2] for value in values]]
        return [(fmean(numbers), min(numbers), max(numbers)) for numbers in every]


def read_studies():
    """Return the results table as a DataFrame and as studies."""
    frame = perturb.read_results(TABLE)
    return frame, Studies(frame.astype(object).where(frame.notna(), None).to_dict("records"))


def quantile_t(freedom, probability=0.975):
    """Return the quantile of Student's t distribution, by bisection of its integral."""
    constant = math.exp(math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2)) / math.sqrt(freedom * math.pi)

    def above(limit, steps=4000):
        # The integral of the density from 0 to the limit, by Simpson's rule.
        width = limit / steps
        density = [constant * (1 + (i * width) ** 2 / freedom) ** (-(freedom + 1) / 2) for i in range(steps + 1)]
        inner = 4 * sum(density[1:-1:2]) + 2 * sum(density[2:-1:2])
        return 0.5 + width / 3 * (density[0] + inner + density[-1])

    low, high = 0.0, 100.0
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if above(middle) < probability else (low, middle)
    return low


def t_interval(strata):
    """Return the mean over strata of equal weight with its 95 % interval (Student, Welch and Satterthwaite)."""
    middle = fmean(fmean(runs) for runs in strata)
    variance = by_freedom = 0.0
    for runs in strata:
        center = fmean(runs)
        squares = sum((run - center) ** 2 for run in runs)
        of_mean = squares / (len(runs) - 1) / len(runs) / len(strata) ** 2
        variance += of_mean
        by_freedom += of_mean**2 / (len(runs) - 1)
    if variance == 0:
        return middle, middle, middle
    half = quantile_t(variance**2 / by_freedom) * math.sqrt(variance)
    return middle, middle - half, middle + half


def bootstrap_interval(runs):
    """Return the 2.5th and 97.5th percentiles of the means of all resamples of up to six runs."""
    means = sorted(fmean(sample) for sample in itertools.product(runs, repeat=len(runs)))
    last = len(means) - 1

    def percentile(share):
        place = share * last
        low = math.floor(place)
        return means[low] + (place - low) * (means[min(low + 1, last)] - means[low])

    return percentile(0.025), percentile(0.975)


def wilson(percent, n):
    """Return the 95 % Wilson interval of a success rate in `n` episodes, %."""
    rate = percent / 100
    middle, width = rate + Z**2 / (2 * n), Z * math.sqrt(rate * (1 - rate) / n + Z**2 / (4 * n**2))
    return [100 * (middle + sign * width) / (1 + Z**2 / n) for sign in (-1, 1)]


def sign_flip_p(differences):
    """Return the p value of Fisher's two-sided randomisation test. More than 16 pairs are tested with random signs."""
    differences = [difference for difference in differences if difference != 0]
    seen = abs(sum(differences)) - 1e-9 * sum(map(abs, differences))
    if len(differences) <= EXACT_PAIRS:
        signs = itertools.product((1, -1), repeat=len(differences))
        sums = [abs(sum(map(lambda sign, value: sign * value, choice, differences))) for choice in signs]
        return sum(value >= seen for value in sums) / len(sums)
    draw = random.Random(1)
    flipped = (sum(value if draw.random() < 0.5 else -value for value in differences) for _ in range(CHOICES))
    return (1 + sum(abs(value) >= seen for value in flipped)) / (1 + CHOICES)


def holm(p):
    """Return the p values after Holm's correction, in the order of `p`."""
    corrected, least = [0.0] * len(p), 0.0
    for rank, place in enumerate(sorted(range(len(p)), key=p.__getitem__)):
        least = min(1.0, max(least, p[place] * (len(p) - rank)))
        corrected[place] = least
    return corrected
