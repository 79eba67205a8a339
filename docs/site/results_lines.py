"""The numbers of docs/findings/reference-lines.md, from the results table, upper_bound.csv and heuristic_rules.csv.

Other pages have rows with reference lines. The functions of the first half compute these rows.
"""

import csv
from collections import defaultdict
from pathlib import Path
from statistics import fmean

from results_numbers import ENVIRONMENTS, METRICS, cube_root, holm, sign_flip_p, t_interval
from results_words import FF, NAMES, fill, fixed, spread

BOUNDS = Path("experiments/references/upper_bound.csv")
# Successes of the heuristic policies by the success rules of the paper's text and of its code.
RULES = Path("experiments/references/heuristic_rules.csv")
# Indices of D, R and E, and of Default, Interpolation and Extrapolation, in the list of `with_extrapolation`.
TESTS = (0, 1, 2)
METRIC_PLACES = (0, 1, 3)
PAPER_BEST = "paper's best"
# Policies with fewer seeds do not count as learned policies.
MIN_SEEDS = 3
# Studies with other physics in training or in tests than the paper's, and studies of untrained policies.
EXCLUDED = ("classic", "heuristic", "references", "changes", "contexts")
# The setting `observe`, which is missing if policies see only the state.
OBSERVED = {"parameters": "seen", None: "not seen"}
# The number of seeds of the study references.
LEARNED_SEEDS = 10


def line(name, rates):
    return f"| {name} | " + " | ".join("–" if rate is None else fixed(rate) for rate in rates) + " |"


def with_extrapolation(d, r, e):
    """Return the rates, and Extrapolation of a policy whose success does not depend on its training."""
    return [d, r, e, cube_root(r * e * e)]


def bounds():
    """Return the counts of upper_bound.csv by environment, version and part, as numbers."""
    with BOUNDS.open() as file:
        rows = list(csv.DictReader(file))
    names = ("episodes", "always_right", "heuristic", "solved", "undecided")
    return {(row["environment"], row["version"], row["part"]): {name: int(row[name]) for name in names} for row in rows}


def share(counts, *names):
    return 100 * sum(counts[name] for name in names) / counts["episodes"]


def fixed_policy(studies, environment, algorithm):
    cells = studies.finished("heuristic", environment=environment, algorithm=algorithm)
    assert len(cells) == 5, f"the table has {len(cells)} cells of {algorithm} on {environment}"
    return with_extrapolation(*(fmean(cell.success(version) for cell in cells) for version in "DRE"))


def heuristic(studies, environment, rule="code"):
    """Return success of the heuristic policy on D, R and E, and its Extrapolation. `rule` is `code` or `text`."""
    known = fixed_policy(studies, environment, "heuristic")
    if rule == "code":
        return known
    with RULES.open() as file:
        rows = [row for row in csv.DictReader(file) if row["environment"] == environment]

    def rates(name):
        tests = ([row for row in rows if row["version"] == version] for version in "DRE")
        return with_extrapolation(
            *(fmean(100 * int(row[name]) / int(row["episodes"]) for row in test) for test in tests)
        )

    for rate, again in zip(known, rates("code"), strict=True):
        assert abs(rate - again) < 1e-6, f"{environment}: {rate} in the table, {again} in {RULES}"
    return rates(rule)


def upper_bound(environment):
    """Return the shares of episodes on D, R and E that can be solved, and their Extrapolation. None if unknown."""
    known = bounds()
    if (environment, "D", "all") not in known:
        return None
    return with_extrapolation(*(share(known[environment, version, "all"], "solved", "undecided") for version in "DRE"))


def averages(studies, rule="code"):
    """Return the numbers of `heuristic`, averaged over the four tasks."""
    return [fmean(numbers) for numbers in zip(*(heuristic(studies, task, rule) for task in ENVIRONMENTS), strict=True)]


def joined(rates, digits=1, between=" | ", places=METRIC_PLACES):
    """Return the rates at `places` as text, or – if `rates` is None."""
    return "–" if rates is None else between.join(fixed(rates[place], digits) for place in places)


def task_rows(studies, digits=0, rule="code", between=" / ", places=METRIC_PLACES, mean=False):
    """Return the rows `heuristic` and `upper bound` of a table with a column for each task.

    With `mean`, a last column has the averages over the tasks.
    """
    rows = {
        "heuristic": [heuristic(studies, task, rule) for task in ENVIRONMENTS],
        "upper bound": [upper_bound(task) for task in ENVIRONMENTS],
    }
    last = {"heuristic": averages(studies, rule), "upper bound": None}
    texts = []
    for name, tasks in rows.items():
        fields = [joined(rates, digits, between, places) for rates in tasks]
        fields += [joined(last[name], 1, between, places)] if mean else []
        texts.append(f"| {name} | " + " | ".join(fields) + " |")
    return texts


def average_row(studies):
    """Return the row `heuristic` of a table of four-task averages, and its lead over the paper's A2C."""
    means = averages(studies)
    papers = [studies.paper_mean(FF["a2c"], metric) for metric in METRICS]
    lead = [means[place] - paper for place, paper in zip(METRIC_PLACES, papers, strict=True)]
    text = "{:.1f} points lower in Default, {:.1f} lower in Interpolation and {:.1f} higher in Extrapolation"
    return [f"| heuristic | | {joined(means)} |", fill(text, -lead[0], -lead[1], lead[2])]


def version_rows(studies, environment, start, early):
    """Return the rows of a table with success on D, R and E. `early` has the versions of the columns before these.

    `start` follows the row's name: the fields that are empty.
    """
    rows = {"heuristic": heuristic(studies, environment), "upper bound": upper_bound(environment)}
    places = [*("DRE".index(version) for version in early), *TESTS]
    return [f"| {name} {start}| {joined(rates, places=places)} |" for name, rates in rows.items() if rates]


def both_rules_row(studies):
    """Return the row of Acrobot's heuristic policy: D, R and E, each within 80 steps and within 90 steps."""
    by_text, by_code = heuristic(studies, "Acrobot", "text"), heuristic(studies, "Acrobot")
    pairs = (f"{fixed(by_text[place])} | {fixed(by_code[place])}" for place in TESTS)
    return "| heuristic | | | " + " | ".join(pairs) + " |"


def trial_rows(studies):
    """Return the rows of the tables of docs/findings/rl2-trials.md, by the rules of the paper's text."""
    rows = {
        "heuristic": {task: heuristic(studies, task, "text") for task in ENVIRONMENTS},
        "upper bound": {task: upper_bound(task) for task in ENVIRONMENTS},
    }
    texts = []
    for name, tasks in rows.items():
        shown = {task: joined(rates, between=" / ") for task, rates in tasks.items()}
        texts += [f"| {name} | | | | {shown[task]} |" for task, rates in tasks.items() if rates]
        texts.append(f"| {name} | {shown['CartPole']} | | {shown['Pendulum']} | |")
    return texts


def margin(studies, numbers):
    """Return the least difference of the metrics from the averages of the paper's feed-forward A2C."""
    return min(number - studies.paper_mean(FF["a2c"], metric) for number, metric in zip(numbers, METRICS, strict=True))


def search_rows(studies):
    """Return the rows of the tables of docs/findings/beyond.md."""
    rows = [f"| {task}, heuristic | {joined(heuristic(studies, task))} |" for task in ENVIRONMENTS]
    limits = {task: upper_bound(task) for task in ENVIRONMENTS}
    rows += [f"| {task}, upper bound | {joined(rates)} |" for task, rates in limits.items() if rates]
    means = averages(studies)
    fields = [joined(means), fixed(margin(studies, [means[place] for place in METRIC_PLACES]))]
    tasks = [joined(heuristic(studies, task), 0, "/") for task in ENVIRONMENTS]
    last = " | ".join([*fields, *tasks])
    lead = average_row(studies)[1]
    return [*rows, f"| heuristic | {joined(means)} |", f"| heuristic | | | | {last} |", f"| heuristic | {last} |", lead]


def best_learned(studies, environment):
    """Return the highest mean success of a configuration on D, R and E, and the highest mean Extrapolation."""
    groups = defaultdict(dict)
    for cell in studies.cells:
        if cell.environment == environment and not cell.failed and cell.study not in EXCLUDED:
            groups[cell.study, cell.method, cell.configuration][cell.trained_on, cell.seed] = cell
    found = defaultdict(list)
    for cells in groups.values():
        for trained in "DRE":
            own = [cell for (name, _), cell in cells.items() if name == trained]
            for tested in "DRE":
                numbers = [cell.success(tested) for cell in own if tested in cell.tests]
                if len(numbers) >= MIN_SEEDS:
                    found[tested].append(fmean(numbers))
        pairs = [(cells["D", seed], cells["R", seed]) for name, seed in cells if name == "D" and ("R", seed) in cells]
        numbers = [cube_root(d.success("R") * d.success("E") * r.success("E")) for d, r in pairs if "E" in d.tests]
        if len(numbers) >= MIN_SEEDS:
            found["Extrapolation"].append(fmean(numbers))
    return [max(found[name]) for name in ("D", "R", "E", "Extrapolation")]


def paper_best(studies, environment):
    """Return the paper's highest Default, Interpolation and Extrapolation, in the columns D, R and Extrapolation."""
    rows = [row for row in studies.paper_rows if row["environment"] == environment]

    def best(metric):
        return max(float(row["mean_percent"]) for row in rows if row["metric"] == metric)

    return [best("default"), best("interpolation"), None, best("extrapolation")]


def rates_by_task(studies):
    """Return the rates on D, R and E, and Extrapolation, by task and name of the reference line."""
    known = bounds()
    rows = {}
    for environment in ENVIRONMENTS:
        shown = {name: fixed_policy(studies, environment, name) for name in ("random", "heuristic")}
        counts = [known.get((environment, version, "all")) for version in "DRE"]
        if environment == "MountainCar":
            shown["always right"] = with_extrapolation(*(share(each, "always_right") for each in counts))
        shown |= {"best learned": best_learned(studies, environment), PAPER_BEST: paper_best(studies, environment)}
        if counts[0]:
            # The script simulates the rule of the heuristic policy in the same episodes.
            for rate, each in zip(shown["heuristic"], counts, strict=False):
                assert abs(rate - share(each, "heuristic")) < 0.1, f"{environment}: {rate}, {each}"
            shown["upper bound"] = upper_bound(environment)
        rows[environment] = shown
    return rows


def reference_lines(studies):
    """Return the texts with numbers that docs/findings/reference-lines.md must contain."""
    rows, texts = rates_by_task(studies), []
    for environment, shown in rows.items():
        texts.append(f"| {environment} | | | | |")
        texts += [line(name, rates) for name, rates in shown.items()]
    return [*texts, *answer(rows), *learned(studies), *mountain_car(studies, rows["MountainCar"], bounds())]


def answer(rows):
    rules, learned = (
        [rows[task][name][2] for task in ("CartPole", "Pendulum")] for name in ("heuristic", "best learned")
    )
    bound, paper = rows["MountainCar"]["upper bound"], rows["MountainCar"][PAPER_BEST]
    best, rule = (rows["Acrobot"][name][:3] for name in ("best learned", "heuristic"))
    acrobot = [rate - other for rate, other in zip(best, rule, strict=True)]
    return [
        fill("succeeds in {:.0f} % of the episodes on E of CartPole and in {:.0f} % on E of Pendulum.", *rules),
        fill("trained on D, R or E succeed in {:.0f} and {:.0f} %", *learned),
        fill("more than {:.0f} % of our test episodes on R and {:.0f} % of those on E", *bound[1:3]),
        fill("{:.0f} to {:.0f} points better on Acrobot", min(acrobot), max(acrobot)),
        fill("best Extrapolation is {:.1f} %, and the upper bound {:.1f} %", paper[3], bound[3]),
    ]


def learned(studies):
    """Return the rows of the table of policies trained on R+E, and the texts that compare them."""
    texts, differences, p = [], {}, {}
    for environment in ENVIRONMENTS:
        for algorithm in ("ppo", "a2c"):
            found = {}
            for observed, label in OBSERVED.items():
                cells = studies.finished("references", environment=environment, algorithm=algorithm, observe=observed)
                assert len(cells) == LEARNED_SEEDS, f"{environment}, {algorithm}, {observed}: {len(cells)} seeds"
                found[observed] = {version: [cell.success(version) for cell in cells] for version in "DRE"}
                row = " | ".join(map(spread, found[observed].values()))
                texts.append(f"| {environment}, {NAMES[algorithm]} | {label} | {row} |")
            for version in "DRE":
                pairs = zip(found["parameters"][version], found[None][version], strict=True)
                differences[environment, algorithm, version] = [with_them - without for with_them, without in pairs]
                p[environment, algorithm, version] = sign_flip_p(differences[environment, algorithm, version])
    corrected = dict(zip(p, holm(list(p.values())), strict=True))
    significant = [key for key, value in corrected.items() if value < 0.05]
    assert significant == [("MountainCar", "a2c", "R")], significant
    largest = max(differences, key=lambda key: fmean(differences[key]))
    assert largest == ("MountainCar", "a2c", "D"), largest
    return [
        *texts,
        fill("{:.1f} points better on D [{:.1f}, {:.1f}]", *t_interval([differences[largest]])),
        fill("{:.1f} points worse on R", -fmean(differences[significant[0]])),
        f"of the gain is {fixed(corrected[largest], 2)}, and that of the loss {fixed(corrected[significant[0]], 3)}",
        f"the largest of {len(p)} differences",
    ]


def mountain_car(studies, rows, known):
    whole = known["MountainCar", "E", "all"]["episodes"]
    texts, shares = [], {}
    for part in ("strong, heavy", "strong, light", "weak, heavy", "weak, light"):
        each = known["MountainCar", "E", part]
        shares[part] = 100 * each["episodes"] / whole
        rates = [
            shares[part],
            share(each, "always_right"),
            share(each, "heuristic"),
            share(each, "solved", "undecided"),
        ]
        texts.append(line(part, rates))
    for name, method in (
        ("A2C FF", ("a2c", "ff", None)),
        ("A2C RC", ("a2c", "rc", None)),
        ("PPO FF", ("ppo", "ff", None)),
    ):
        numbers = [studies.paper("MountainCar", method, metric)[0] for metric in METRICS]
        texts.append(line(name, numbers))
    strong = shares["strong, heavy"] + shares["strong, light"]
    heavy = shares["strong, heavy"] + shares["weak, heavy"]
    right, bound = rows["always right"], rows["upper bound"]
    return [
        *texts,
        fill("the push is strong in {:.0f} % of the episodes on E, and gravity is strong in {:.0f} %", strong, heavy),
        fill("solves {:.0f} % of R, {:.0f} % of E and nothing of D", *right[1:3]),
        fill("the heuristic policy solves {:.1f} of {:.1f} %", rows["heuristic"][1], bound[1]),
        fill("can be solved in {:.1f} % of the episodes, and E in {:.1f} %", *bound[1:3]),
        f"are {fixed(share(known['MountainCar', 'R', 'all'], 'undecided'))} % of the episodes",
        f"Interpolation is at most {fixed(bound[1])} % and Extrapolation at most {fixed(bound[3])} %",
    ]
