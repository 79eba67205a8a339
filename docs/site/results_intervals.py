"""The numbers of docs/findings/intervals.md: how often intervals contain the true mean.

The ten results of a training with ten seeds serve as a population, whose mean is known. The coverage is the probability
that the interval of n results, drawn from the population with replacement, contains this mean. It is computed from all
possible samples. Only the coverage over four tasks is computed from random samples. Populations of ten normally
distributed numbers serve as a control, because the method itself lowers the coverage: a sample may have the same result
twice.
"""

import itertools
import math
from functools import cache
from statistics import median

import numpy as np
from results_contexts import CONTEXT_COUNTS
from results_numbers import ENVIRONMENTS, quantile_t, wilson
from results_words import fill, fixed

# The number of results in a population.
POPULATION = 10
SAMPLES = {3: "three", 5: "five", 10: "ten"}
# The number of random samples of an interval over several tasks, whose possible samples are too many.
DRAWS = 20_000
# The number of normally distributed populations. Four of them are a population over four tasks.
CONTROLS = 100
# The page counts populations with a coverage below this number, %.
LOW = 80
# The number of equal results from which a population is `mostly_equal`.
MOSTLY = 7
# The true coverage of t intervals of normally distributed results, and that of bootstrap intervals as in
# docs/reports.md, %.
NORMAL = {"t": {3: 95, 5: 95, 10: 95}, "bootstrap": {3: 73, 5: 84}}
LABELS = {
    ("t", "success"): "t, success",
    ("t", "difference"): "t, difference",
    ("t", "over_tasks"): "t, difference over four tasks",
    ("bootstrap", "success"): "bootstrap, success",
}
# True success rates, as fractions, and numbers of episodes for which Wilson intervals are computed.
RATES = np.linspace(0.01, 0.99, 197)
HIGH_RATES = np.linspace(0.99, 0.9999, 200)
EPISODES = (200, 1_000, 3_000)
# The sentences on coverage that a page must have: kind of interval, kind of result, number of seeds.
PAGES = {
    "acrobot-steps": [("bootstrap", "success", 5)],
    "beyond": [("t", "success", 5)],
    "cart-pole-ties": [("bootstrap", "success", 5)],
    "changing-physics": [("t", "success", 3)],
    "classic-ff": [("t", "success", 5), ("t", "over_tasks", 5)],
    "locomotion": [("t", "success", 3)],
    "one-factor": [("t", "success", 5)],
    "paper-claims": [("t", "difference", 5), ("t", "over_tasks", 5), ("t", "over_tasks", 3)],
    "pendulum-ppo": [("bootstrap", "success", 5)],
    "recurrent": [("t", "success", 3)],
    "reference-lines": [("t", "difference", 10)],
    "rl2-trials": [("t", "success", 3)],
    "stability": [("t", "success", 5)],
    "training-contexts": [("t", "difference", 10)],
}


def counts(draws, values):
    """Return how often each of `values` values can occur in `draws` draws, int [samples, values]."""
    if values == 1:
        return np.array([[draws]])
    parts = [np.insert(counts(draws - first, values - 1), 0, first, axis=1) for first in range(draws + 1)]
    return np.concatenate(parts)


@cache
def samples(draws, values):
    """Return all samples as `counts`, and their probabilities with equally likely values, float [samples]."""
    found = counts(draws, values)
    factorials = np.array([float(math.factorial(number)) for number in range(draws + 1)])
    return found, factorials[draws] / factorials[found].prod(axis=1) / float(values) ** draws


@cache
def quantiles(low, high):
    """Return degrees of freedom from `low` to `high`, and the quantile of Student's t distribution for each."""
    freedom = np.linspace(low, high, 40)
    return freedom, np.array([quantile_t(each) for each in freedom])


def contains(middle, low, high):
    """Return whether intervals contain the mean `middle`. Rounding errors do not count."""
    return (low <= middle + 1e-9) & (middle - 1e-9 <= high)


def t_coverage(population, draws):
    """Return the coverage of the 95 % t interval of `draws` results, %."""
    found, probability = samples(draws, len(population))
    means = found @ population / draws
    squares = np.maximum(found @ population**2 - draws * means**2, 0)
    half = quantiles(draws - 1, draws)[1][0] * np.sqrt(squares / (draws - 1) / draws)
    return 100 * probability[contains(population.mean(), means - half, means + half)].sum()


def bootstrap_coverage(population, draws):
    """Return the coverage of the 95 % interval of percentiles of all resamples of `draws` results, %."""
    found, probability = samples(draws, len(population))
    resamples, weights = samples(draws, draws)
    results = np.array([np.repeat(population, row) for row in found])
    means = results @ resamples.T / draws
    order = means.argsort(axis=1)
    means = np.take_along_axis(means, order, axis=1)
    # The last place of each mean in the sorted list of all draws ** draws resamples.
    last = np.rint(weights[order] * draws**draws).cumsum(axis=1) - 1

    def percentile(share):
        place = share * (draws**draws - 1)
        low, high = (
            np.take_along_axis(means, (last < step(place)).sum(axis=1)[:, None], axis=1)[:, 0]
            for step in (math.floor, math.ceil)
        )
        return low + (place - math.floor(place)) * (high - low)

    return 100 * probability[contains(population.mean(), percentile(0.025), percentile(0.975))].sum()


def over_tasks_coverage(tasks, draws):
    """Return the coverage of the 95 % t interval of the mean over the populations of several tasks, %.

    The interval is that of `results_numbers.t_interval`, with a quantile that is interpolated.
    """
    tasks = np.asarray(tasks)
    places = np.random.default_rng(1).integers(0, tasks.shape[1], (DRAWS, len(tasks), draws))
    drawn = np.take_along_axis(tasks[None], places.reshape(DRAWS, len(tasks), -1), axis=2)
    means, variances = drawn.mean(axis=(1, 2)), drawn.var(axis=2, ddof=1) / draws / len(tasks) ** 2
    variance, by_freedom = variances.sum(axis=1), (variances**2).sum(axis=1) / (draws - 1)
    freedom = np.divide(variance**2, by_freedom, out=np.full(DRAWS, float(draws - 1)), where=by_freedom > 0)
    half = np.interp(freedom, *quantiles(draws - 1, len(tasks) * (draws - 1))) * np.sqrt(variance)
    return 100 * contains(tasks.mean(), means - half, means + half).mean()


def wilson_coverages(rates, episodes):
    """Return the coverage of the 95 % Wilson interval of a success rate, %, for each of the true `rates`, fractions."""
    successes = np.arange(episodes + 1)
    logs = np.array([math.lgamma(number + 1) for number in successes])
    ends = np.array([wilson(100 * number / episodes, episodes) for number in successes]).T

    def coverage(rate):
        chances = successes * math.log(rate) + (episodes - successes) * math.log1p(-rate)
        return 100 * np.exp(logs[-1] - logs - logs[::-1] + chances)[contains(100 * rate, *ends)].sum()

    return [coverage(rate) for rate in rates]


def populations(studies):
    """Return the populations of ten results, by kind.

    The kinds are `success`, the success of a training in a test, `difference`, the difference of two trainings of the
    same seed, and `over_tasks`, one such difference for each of the four tasks. Successes and differences that are
    equal for all ten seeds are left out.
    """
    rates = {}
    for study, kinds in (("references", ("parameters", None)), ("contexts", CONTEXT_COUNTS)):
        for kind, task, algorithm in itertools.product(kinds, ENVIRONMENTS, ("ppo", "a2c")):
            wanted = {"observe": kind} if study == "references" else {"trained_on": f"contexts{kind}"}
            cells = studies.finished(study, environment=task, algorithm=algorithm, **wanted)
            assert len(cells) == POPULATION, f"{study}, {kind}, {task}, {algorithm}: {len(cells)} seeds"
            for test in "DRE" if study == "references" else (f"contexts{kind}", "R", "E"):
                rates[study, kind, task, algorithm, test] = np.array([cell.success(test) for cell in cells])
    pairs = [("references", "parameters", None, test) for test in "DRE"]
    pairs += [("contexts", count, 1, "R") for count in CONTEXT_COUNTS[1:]]
    differences = [
        [
            rates[study, kind, task, algorithm, test] - rates[study, other, task, algorithm, test]
            for task in ENVIRONMENTS
        ]
        for study, kind, other, test in pairs
        for algorithm in ("ppo", "a2c")
    ]
    return {
        "success": [each for each in rates.values() if np.ptp(each) > 0],
        "difference": [each for tasks in differences for each in tasks if np.ptp(each) > 0],
        "over_tasks": differences,
    }


def mostly_equal(population):
    """Return whether at least seven of a population's ten results are equal."""
    return np.unique(np.round(population, 6), return_counts=True)[1].max() >= MOSTLY


@cache
def coverages(studies):
    """Return the populations by kind of result, and the coverages of each kind of interval by number of results, %.

    The coverages of the control have the key (interval, kind of result, number of results, "control").
    """
    found = populations(studies)
    normal = np.random.default_rng(1).normal(size=(CONTROLS, POPULATION))
    normal_tasks = normal.reshape(-1, len(ENVIRONMENTS), POPULATION)
    rows = {}
    for interval, kind in LABELS:
        coverage = {"t": t_coverage, "bootstrap": bootstrap_coverage}[interval]
        control = normal
        if kind == "over_tasks":
            coverage, control = over_tasks_coverage, normal_tasks
        for number in NORMAL[interval]:
            rows[interval, kind, number] = [coverage(each, number) for each in found[kind]]
            if kind != "difference":  # it has the same control as `success`
                rows[interval, kind, number, "control"] = [coverage(each, number) for each in control]
    return found, rows


def estimate(studies, interval, kind, number):
    """Return the estimated coverage of populations whose results are not mostly equal, %.

    The estimate is their median, plus the number of percentage points by which the control falls short of the true
    coverage for normally distributed results.
    """
    found, rows = coverages(studies)
    control = rows[interval, "success" if kind == "difference" else kind, number, "control"]
    differ = [kind == "over_tasks" or not mostly_equal(each) for each in found[kind]]
    known = median(itertools.compress(rows[interval, kind, number], differ))
    return known + NORMAL[interval][number] - median(control)


def sentences(page, studies):
    """Return the sentences on coverage that a page of findings must contain."""
    name = page.removeprefix("docs/findings/").removesuffix(".md")
    texts = []
    for interval, kind, number in PAGES.get(name, []):
        what = {"over_tasks": "over four tasks", "difference": "of a difference", "success": "of a mean"}[kind]
        label = "bootstrap intervals" if interval == "bootstrap" else "t intervals"
        share = fixed(estimate(studies, interval, kind, number), 0)
        if kind == "success" and interval == "t":
            extent = f"the mean ± {fixed(width(number))} standard deviations"
            texts.append(f"A 95 % t interval of the mean of {SAMPLES[number]} seeds is {extent}.")
        texts.append(f"[Such {label} {what}] contain the true mean in some {share} % of the cases")
    return texts


def width(number):
    """Return half the length of a 95 % t interval of `number` results, in standard deviations with n as denominator."""
    return quantile_t(number - 1) / math.sqrt(number - 1)


def field(coverage):
    """Return the median and the lowest of coverages as text."""
    return fill("{:.0f} ({:.0f})", median(coverage), min(coverage)) if coverage else ""


def answer(studies):
    """Return the texts of the answer."""
    shares = [estimate(studies, "t", kind, number) for kind in ("success", "difference") for number in SAMPLES]
    # If nine of ten results are equal, the samples without the tenth have intervals of length zero.
    missed = [100 * (1 - 1 / POPULATION) ** number for number in SAMPLES]
    return [
        fill("a t interval does so in an estimated {:.0f} to {:.0f} % of the cases", min(shares), max(shares)),
        fill("misses the mean in {:.0f} % of the cases with three seeds, and in {:.0f} % with five", *missed[:2]),
        fill("they contain the true mean in some {:.0f} % of the cases", estimate(studies, "bootstrap", "success", 5)),
    ]


def intervals(studies):
    """Return the texts with numbers that the page must contain."""
    found, rows = coverages(studies)
    texts = []
    for (interval, kind), label in LABELS.items():
        groups = {"": [True] * len(found[kind])}
        if kind != "over_tasks":
            equal = [mostly_equal(each) for each in found[kind]]
            groups = {"": [not each for each in equal], ", mostly equal": equal}
        for suffix, chosen in groups.items():
            known = [rows.get((interval, kind, number), []) for number in SAMPLES]
            fields = [field([*itertools.compress(coverage, chosen)]) for coverage in known]
            texts.append(f"| {label}{suffix} | {sum(chosen)} | " + " | ".join(fields) + " |")
    for interval, kind in LABELS:
        controls = [rows.get((interval, kind, number, "control"), []) for number in SAMPLES]
        if any(controls):
            over = " over four tasks" if kind == "over_tasks" else ""
            fields = " | ".join(map(field, controls))
            texts.append(f"| {interval}, normal numbers{over} | {len(controls[0])} | {fields} |")
        # The page says that differences that are mostly equal vary by less than one point.
    assert all(np.ptp(each) < 1 for each in found["difference"] if mostly_equal(each))
    usual = [coverage for episodes in EPISODES for coverage in wilson_coverages(RATES, episodes)]
    extreme = [min(wilson_coverages(HIGH_RATES, episodes)) for episodes in EPISODES[:2]]
    low = [
        coverage < LOW
        for coverage in itertools.compress(
            rows["t", "success", 3], (not mostly_equal(each) for each in found["success"])
        )
    ]
    return [
        *texts,
        *answer(studies),
        "| " + " | ".join(fixed(width(number)) for number in SAMPLES) + " |",
        f"with three seeds, {sum(low)} of {len(low)} populations have a measured coverage below {LOW} %",
        fill("If the true rate is between 1 and 99 %, it is {:.0f} to {:.0f} %", min(usual), max(usual)),
        fill("it falls to {:.0f} % with 200 episodes and to {:.0f} % with 1 000", *extreme),
        fill(
            "the estimates are {:.0f} % with three seeds and {:.0f} % with five",
            *(estimate(studies, "t", "over_tasks", number) for number in (3, 5)),
        ),
    ]
