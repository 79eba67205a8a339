"""The numbers of docs/findings/reference-lines.md, from the results table and from upper_bound.csv."""

import csv
from collections import defaultdict
from pathlib import Path
from statistics import fmean

from results_numbers import ENVIRONMENTS, METRICS, cube_root, holm, sign_flip_p, t_interval
from results_words import NAMES, fill, fixed, spread

BOUNDS = Path("experiments/references/upper_bound.csv")
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


def reference_lines(studies):
    """Return the texts with numbers that docs/findings/reference-lines.md must contain."""
    known = bounds()
    rows, texts = {}, []
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
            solved = (share(each, "solved", "undecided") for each in counts)
            shown["upper bound"] = with_extrapolation(*solved)
        texts.append(f"| {environment} | | | | |")
        texts += [line(name, rates) for name, rates in shown.items()]
        rows[environment] = shown
    return [*texts, *answer(rows), *learned(studies), *mountain_car(studies, rows["MountainCar"], known)]


def answer(rows):
    rules, learned = (
        [rows[task][name][2] for task in ("CartPole", "Pendulum")] for name in ("heuristic", "best learned")
    )
    bound, paper = rows["MountainCar"]["upper bound"], rows["MountainCar"][PAPER_BEST]
    return [
        fill("succeeds in {:.0f} % of the episodes on E of CartPole and in {:.0f} % on E of Pendulum.", *rules),
        fill("The best learned policies succeed in {:.0f} and {:.0f} %", *learned),
        fill("no policy can solve more than {:.0f} % of R and {:.0f} % of E", *bound[1:3]),
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
                cells.sort(key=lambda cell: cell.seed)
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
        fill("can be solved in {:.1f} % of the episodes, and E in {:.1f} %", *bound[1:3]),
        f"are {fixed(share(known['MountainCar', 'R', 'all'], 'undecided'))} % of the episodes",
        f"Interpolation is at most {fixed(bound[1])} % and Extrapolation at most {fixed(bound[3])} %",
    ]
