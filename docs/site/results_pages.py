"""The numbers of README.md, results/README.md and docs/findings.

For each page a function computes, from the results table, the texts that the page must contain.
"""

import re
from collections import defaultdict
from statistics import fmean

import results_lines
import results_texts
from results_numbers import ENVIRONMENTS, METRICS, bootstrap_interval, cube_root, holm, sign_flip_p, t_interval
from results_words import CLEAN, FF, NAMES, Near, Pattern, about, fill, fixed, spread, triple


def by_seed(studies, study, environment, method, seeds, **wanted):
    """Return a list for each of `METRICS`, with one number for each of `seeds`."""
    found = studies.by_seed(study, environment, method, **wanted)
    return list(zip(*(found[seed] for seed in seeds), strict=True))


def averages(studies, study, method, seeds):
    """Return the three metrics of each seed, averaged over the four tasks."""
    tasks = [by_seed(studies, study, task, method, seeds) for task in ENVIRONMENTS]
    return [[fmean(numbers) for numbers in zip(*(task[i] for task in tasks), strict=True)] for i in range(3)]


def headline(studies):
    """Return the metrics of each algorithm by the paper's rule, by the clean rule, and in the paper."""
    rows = {}
    for name, method in FF.items():
        rules = [studies.published_rule("classic-ff", task, name) for task in ENVIRONMENTS]
        published = [tuple(fmean(task[i][end] for task in rules) for end in range(3)) for i in range(3)]
        clean = averages(studies, "classic-ff", method, CLEAN)
        paper = [studies.paper_mean(method, metric) for metric in METRICS]
        rows[name] = published, clean, paper
    return rows


def by_task(studies, study, seeds, methods=FF):
    """Return the rows of a table of methods and tasks, with reference lines.

    A row of the paper's numbers follows each method's row.
    """
    lines = []
    for name, method in methods.items():
        cells, papers = [], []
        for task in ENVIRONMENTS:
            cells.append(triple(by_seed(studies, study, task, method, seeds)))
            papers.append(" / ".join(fixed(studies.paper(task, method, metric)[0], 0) for metric in METRICS))
        lines += [f"| {NAMES[name]} | " + " | ".join(cells) + " |", "| (paper) | " + " | ".join(papers) + " |"]
    return lines + results_lines.task_rows(studies)


def gains(studies, study, method, seeds, tasks=ENVIRONMENTS, **wanted):
    """Return success on E of policies trained on R minus that of policies trained on D, by task and seed."""
    algorithm, architecture, trials = method
    strata = []
    for task in tasks:
        cells = studies.finished(study, environment=task, algorithm=algorithm, architecture=architecture, **wanted)
        cells = {(cell.seed, cell.trained_on): cell for cell in cells if cell.method[2] == trials}
        strata.append([cells[seed, "R"].success("E") - cells[seed, "D"].success("E") for seed in seeds])
    return strata


def p_of(strata):
    return sign_flip_p([number for stratum in strata for number in stratum])


def readme(studies):
    texts = []
    for name, (published, clean, paper) in headline(studies).items():
        texts += [
            f"| {NAMES[name]} | paper's rule | " + " | ".join(fixed(value[0]) for value in published) + " |",
            "| | new trainings | " + " | ".join(map(spread, clean)) + " |",
            "| | paper | " + " | ".join(fixed(value) for value in paper) + " |",
        ]
    _, low, high = headline(studies)["a2c"][0][2]
    tied = len(studies.tied("classic-ff", "CartPole", "a2c", "R"))
    grid = len(studies.finished("classic-ff", environment="CartPole", algorithm="a2c", trained_on="R", seed=1))
    texts += [
        f"{tied} of {grid} A2C configurations reach 100 % on R",
        f"A2C's average Extrapolation varies from {fixed(low)} to {fixed(high)}.",
    ]
    return texts + results_lines.average_row(studies)


# For the beginning of each row: the study's name, and the number of planned cells if some cells are missing.
STUDIES = {
    "[classic-ff] |": ("classic-ff", None),
    "[classic-rc] |": ("classic-rc", 360),
    "[questions/cart-pole] |": ("questions/cart-pole", None),
    "[questions/pendulum] |": ("questions/pendulum", None),
    "[questions/acrobot] |": ("questions/acrobot", None),
    "[questions/findings] |": ("questions/findings", None),
    "[questions/stability] |": ("questions/stability", 180),
    "[beyond], [nine studies] |": ("beyond/", None),
    "[locomotion] |": ("locomotion", 72),
    "[heuristic] |": ("heuristic", None),
    "[references] |": ("references", None),
    "[contexts] |": ("contexts", None),
    "[changes] |": ("changes", 42),
    "locomotion-rate |": ("locomotion-rate", None),
    "classic |": ("classic", 72),
}
HOURS = ("classic-ff", "classic-rc", "locomotion", "questions/acrobot", "questions/cart-pole", "questions/findings")
HOURS += ("questions/pendulum", "questions/stability", "references", "contexts", "beyond/search-*", "beyond/confirm-2")


def named(studies, name):
    """Return the studies called `name`. If `name` ends with `/` or `*`, return the studies that begin with it."""
    known = sorted({cell.study for cell in studies.cells})
    start = name.removesuffix("*")
    return [study for study in known if study == name or (name[-1] in "/*" and study.startswith(start))]


def results(studies):
    texts = []
    missing = {}
    listed = {study for name, _ in STUDIES.values() for study in named(studies, name)}
    unlisted = {cell.study for cell in studies.cells} - listed
    assert not unlisted, f"results/README.md has no row for {unlisted}"
    for start, (name, planned) in STUDIES.items():
        counts = [studies.planned(study) for study in named(studies, name)]
        done, failed = sum(count[0] for count in counts), sum(count[1] for count in counts)
        planned = planned or done + failed
        missing[name] = planned - done - failed
        text = f"{done} of {planned}" + (f", {failed} failed" if failed else "")
        texts.append(Pattern(rf"\| {re.escape(start)} [^|]* \| {text} \|"))
    for name, (published, clean, paper) in headline(studies).items():
        texts += [
            f"| {NAMES[name]} | paper's rule | " + " | ".join(fixed(value[0]) for value in published) + " |",
            "| | clean rule | " + " | ".join(map(spread, clean)) + " |",
            "| | paper | " + " | ".join(fixed(value) for value in paper) + " |",
        ]
    for name in HOURS:
        found = named(studies, name)
        cells = sum(sum(studies.planned(study)) for study in found)
        if name == "classic-ff":
            cells = studies.planned(name)[0]
        texts.append(f"| {name} | {cells} | {fixed(studies.hours(*found))} |")
    stored = {cell.cell for cell in studies.cells if cell.checked}
    of = {
        study: sum(cell.study == study and cell.cell in stored for cell in studies.cells)
        for study in ("beyond/confirm-2", "classic-ff")
    }
    selected = len(studies.finished("classic-ff", seed=2))
    share = f"all {selected}" if of["classic-ff"] == selected else f"{of['classic-ff']} of the {selected}"
    return [
        *texts,
        *results_lines.average_row(studies),
        f"This folder has the {of['beyond/confirm-2']} policies of beyond/confirm-2",
        f"{share} selected configurations of classic-ff",
        f"classic-rc: {missing['classic-rc']} cells",
        f"locomotion: {missing['locomotion']} cells",
        f"questions/stability: {missing['questions/stability']} cells",
    ]


def classic_ff(studies):
    rows = headline(studies)
    texts = []
    for name, (published, clean, paper) in rows.items():
        mean, low, high = published[2]
        ties = f" ({fixed(low)} … {fixed(high)})" if high - low > 0.5 else ""
        texts += [
            f"| {NAMES[name]} | paper's rule | {fixed(published[0][0])} | {fixed(published[1][0])} | "
            f"{fixed(mean)}{ties} |",
            "| | clean rule | " + " | ".join(map(spread, clean)) + " |",
            "| | paper | " + " | ".join(fixed(value) for value in paper) + " |",
        ]
    texts += by_task(studies, "classic-ff", CLEAN)
    tied = {name: len(studies.tied("classic-ff", "CartPole", name, "R")) for name in ("a2c", "ppo")}
    grid = {
        name: len(studies.finished("classic-ff", environment="CartPole", algorithm=name, trained_on="R", seed=1))
        for name in ("a2c", "ppo")
    }
    cart_pole = {name: studies.published_rule("classic-ff", "CartPole", name)[2] for name in ("a2c", "ppo")}
    shown = {
        name: fill("{:.1f} % on average, {:.1f} % with the worst choice and {:.1f} % with the best", *numbers)
        for name, numbers in cart_pole.items()
    }
    paper = {name: fill("{:.1f} ± {:.1f}", *studies.paper("CartPole", FF[name], "Extrapolation")) for name in shown}
    texts += [
        f"Of {grid['a2c']} A2C configurations trained on R with seed 1, {tied['a2c']} reach 100 %",
        f"{tied['ppo']} of {grid['ppo']} PPO configurations tie",
        f"for A2C it is {shown['a2c']}; the paper has {paper['a2c']} %",
        f"for PPO it is {shown['ppo']}; the paper has {paper['ppo']} %",
        f"belong to one of {tied['a2c']} tied configurations",
    ]
    differences = {name: gains(studies, "classic-ff", method, CLEAN) for name, method in FF.items()}
    p = [p_of(strata) for strata in differences.values()]
    for (name, strata), one, corrected in zip(differences.items(), p, holm(p), strict=True):
        middle, low, high = t_interval(strata)
        interval = f"{fixed(middle)} | [{fixed(low)}, {fixed(high)}]"
        texts.append(Near(f"| {NAMES[name]} | {interval} | @ | @ |", [one, corrected], 0.008))
    clean = {name: averages(studies, "classic-ff", method, CLEAN) for name, method in FF.items()}
    lead = [fmean(clean["a2c"][i]) - fmean(clean["epopt-a2c"][i]) for i in range(3)]
    behind = [fmean(clean["ppo"][i]) - fmean(clean["epopt-ppo"][i]) for i in range(3)]
    papers = [studies.paper_mean(FF["epopt-ppo"], metric) - studies.paper_mean(FF["ppo"], metric) for metric in METRICS]
    texts += [
        fill("A2C is {:.0f}, {:.0f} and {:.0f} points above EPOpt-A2C", *lead),
        fill("EPOpt-PPO is {:.1f} points behind PPO in Default", behind[0]),
        fill("and {:.1f} and {:.1f} points ahead in Interpolation and Extrapolation", -behind[1], -behind[2]),
        fill("EPOpt-PPO is {:.1f}, {:.1f} and {:.1f} points ahead", *papers),
    ]
    gap = {name: [published[i][0] - paper[i] for i in range(3)] for name, (published, _, paper) in rows.items()}
    near = [max(abs(gap["a2c"][i]), abs(gap["ppo"][i])) for i in range(3)]
    default, *others = gap["epopt-ppo"]
    texts += [
        fill(
            "A2C and PPO differ from the paper's four-task averages by at most {:.1f} points in [Default], {:.1f} in "
            "Interpolation and {:.1f} in Extrapolation",
            *near,
        ),
        fill("EPOpt-PPO is {:.0f} points below the paper in Default", -default),
        fill("and {:.0f} and {:.0f} points above it in Interpolation and Extrapolation", *others),
        f"A2C's Interpolation falls from {fixed(rows['a2c'][0][1][0], 0)} to {fixed(fmean(rows['a2c'][1][1]), 0)} %",
    ]
    return texts + results_lines.average_row(studies)


def acrobot(studies):
    texts = []
    for rate in ("7e-4", "7e-3"):
        for environments, length in ((1, 5), (1, 15), (16, 5), (16, 15)):
            wanted = {"num_envs": environments, "n_steps": length, "learning_rate": float(rate)}
            cells = studies.finished("questions/acrobot", **wanted)
            d, r, e = ([cell.success(version) for cell in cells] for version in "DRE")
            low, high = bootstrap_interval(d)
            updates = [cell.timesteps / environments / length for cell in cells]
            shown = about(fmean(updates))
            if max(updates) > 2 * min(updates):
                shown = f"{round(min(updates), -4):,.0f} to {round(max(updates), -5):,.0f}".replace(",", " ")
            # Episodes for the columns of 80 steps are not stored.
            texts.append(
                Near(
                    f"| {environments} × {length} | {rate} | {shown} | @ ± @ | "
                    f"{spread(d)} [{fixed(low)}, {fixed(high)}] | @ ± @ | {spread(r)} | @ ± @ | {spread(e)} |",
                    [None] * 6,
                    0,
                )
            )
    best = studies.paper("Acrobot", FF["a2c"], "Default")
    on_r = studies.paper("Acrobot", FF["a2c"], "Interpolation")
    best, on_r = fill("{:.1f} ± {:.1f}", *best), fill("{:.1f} ± {:.1f}", *on_r)
    texts.append(f"| the paper, trained on D | | | | {best} | | | | |")
    texts.append(f"| the paper, trained on R | | | | | | {on_r} | | |")
    texts.append(f"reports a success rate of {best} % for A2C on Acrobot")
    texts.append(results_lines.both_rules_row(studies))
    return texts + results_texts.acrobot(studies)


def pendulum(studies):
    texts = []
    label = {
        (1, False): "| 1 | terminal state (as in the paper) |",
        (1, True): "| 1 | bootstrapped |",
        (8, False): "| 8 | terminal state |",
        (8, True): "| 8 | bootstrapped (our default) |",
    }
    for (environments, bootstrap), text in label.items():
        cells = studies.finished("questions/pendulum", num_envs=environments, bootstrap_truncation=bootstrap)
        early = [cell.success("D", 2000) for cell in cells]
        end = {version: [cell.success(version) for cell in cells] for version in "DRE"}

        def interval(numbers):
            return fill("{:.1f} [{:.0f}, {:.0f}]", fmean(numbers), *bootstrap_interval(numbers))

        row = [interval(early), interval(end["D"]), fixed(fmean(end["R"])), interval(end["E"])]
        texts.append(f"{text} " + " | ".join(row) + " |")
    texts += results_lines.version_rows(studies, "Pendulum", "| ", "D")
    return texts + results_texts.pendulum(studies)


def cart_pole(studies):
    texts = []
    for algorithm, rate, normalised, weight in (
        *(("a2c", 7e-4, True, weight) for weight in (1e-2, 1e-3, 1e-4, 1e-5)),
        ("a2c", 7e-4, False, 1e-4),
        ("a2c", 7e-3, True, 1e-3),
        ("a2c", 7e-3, True, 1e-4),
        ("ppo", 3e-4, True, None),
        ("ppo", 3e-4, False, None),
        ("ppo", 3e-3, True, None),
    ):
        wanted = {
            "algorithm": algorithm,
            "learning_rate": rate,
            "normalize_observations": normalised,
            "trained_on": "D",
        }
        if weight is not None:
            wanted["ent_coef"] = weight
        cells = studies.finished("questions/cart-pole", **wanted)
        assert len(cells) == 5, (wanted, len(cells))
        row = []
        for after in (1000, None):
            row += [fixed(fmean([cell.success(version, after) for cell in cells])) for version in "DR"]
            on_e = [cell.success("E", after) for cell in cells]
            row.append(fill("{:.1f} [{:.0f}, {:.0f}]", fmean(on_e), *bootstrap_interval(on_e)))
        texts.append("| " + " | ".join(row) + " |")
    texts += results_lines.version_rows(studies, "CartPole", "| | | ", "DRE")
    return texts + results_texts.cart_pole(studies)


def claims(studies):
    texts = results_texts.claims(studies) + by_task(studies, "questions/findings", CLEAN)
    seeds = list(CLEAN)
    clean = {name: averages(studies, "questions/findings", method, seeds) for name, method in FF.items()}
    behind = [fmean(clean["epopt-ppo"][i]) - fmean(clean["ppo"][i]) for i in range(3)]
    papers = [studies.paper_mean(FF["epopt-ppo"], metric) - studies.paper_mean(FF["ppo"], metric) for metric in METRICS]
    texts.append(
        f"EPOpt-PPO is ahead of PPO by {fixed(behind[1])} points in Interpolation and {fixed(behind[2])} points in "
        "Extrapolation. Neither difference is significant after Holm's correction. "
        f"The paper's own numbers also have EPOpt-PPO ahead, by {fixed(papers[1])} and {fixed(papers[2])} points"
    )
    strata = {name: gains(studies, "questions/findings", method, seeds) for name, method in FF.items()}
    corrected = holm([p_of(each) for each in strata.values()])
    for (name, each), p in zip(strata.items(), corrected, strict=True):
        shown = [signed_interval([runs]) for runs in each]
        row = " | ".join([NAMES[name], *shown, signed_interval(each)])
        texts.append(Near(f"| {row} | @ |", [p], 0.012))
    ours = {"A2C FF": FF["a2c"], "PPO FF": FF["ppo"], "A2C RC": ("a2c", "rc", None), "RL²-A2C RC": ("rl2-a2c", "rc", 2)}
    strata = {name: gains(studies, "classic-rc", method, range(2, 5)) for name, method in ours.items()}
    p = holm([p_of(each) for each in strata.values()])
    for (name, each), one in zip(strata.items(), p, strict=True):
        middle, low, high = t_interval(each)
        texts.append(Near(f"| {name} | {fixed(middle)} [{fixed(low)}, {fixed(high)}] | @ |", [one], 0.002))
    mean = {name: [fmean(runs) for runs in each] for name, each in strata.items()}
    texts += [
        fill("A2C FF gains {:.0f} points on CartPole and {:.0f} points on Pendulum", *mean["A2C FF"][:2]),
        fill("PPO FF gains {:.0f} points on CartPole and {:.0f} points on Pendulum", *mean["PPO FF"][:2]),
        fill("RL²-A2C RC gains {:.0f} points on MountainCar", mean["RL²-A2C RC"][3]),
    ]
    lead = lead_of(studies, FF["a2c"], ("rl2-a2c", "rc", 2))
    texts.append(
        fill(
            "A2C FF is ahead of RL²-A2C by {:.1f} points in Default, {:.1f} in Interpolation and {:.1f} in "
            "Extrapolation",
            *lead,
        )
    )
    return texts


def signed_interval(strata):
    return fill("{:.1f} [{:.1f}, {:.1f}]", *t_interval(strata))


def lead_of(studies, method, other, study="classic-rc", seeds=range(2, 5)):
    """Return the differences of the four-task averages of two methods, in the three metrics."""
    pair = [averages(studies, study, one, seeds) for one in (method, other)]
    return [fmean(pair[0][i]) - fmean(pair[1][i]) for i in range(3)]


RECURRENT = {"A2C FF": FF["a2c"], "A2C RC": ("a2c", "rc", None), "PPO FF": FF["ppo"]}


def one_seed(studies, task, method, digits=1, seed=2, trained_on=None):
    """Return a seed's three metrics in the study classic-rc as text: "Default / Interpolation / Extrapolation".

    With `trained_on`, return the success on D, R and E of the policy that was trained on this version. Missing numbers
    are left out. Return "" if the study has no such cell.
    """
    if trained_on is None:
        found = studies.by_seed("classic-rc", task, method).get(seed)
    else:
        cells = studies.finished("classic-rc", environment=task, algorithm=method[0], architecture=method[1], seed=seed)
        cells = [cell for cell in cells if cell.trained_on == trained_on and cell.method[2] == method[2]]
        found = [cells[0].success(version) for version in "DRE"] if cells else None
    if found is None:
        return ""
    text = " / ".join("" if number is None else fixed(number, digits) for number in found)
    return re.sub(r"( / )+$", " /", text)  # missing numbers at the end leave a single slash


def papers(studies, task, method):
    return " / ".join(fixed(studies.paper(task, method, metric)[0]) for metric in METRICS)


def recurrent(studies):
    texts = []
    seeds = range(2, 5)
    for name, method in RECURRENT.items():
        row = [triple(by_seed(studies, "classic-rc", task, method, seeds)) for task in ENVIRONMENTS]
        row.append(" / ".join(fixed(fmean(numbers)) for numbers in averages(studies, "classic-rc", method, seeds)))
        texts.append(f"| {name} | " + " | ".join(row) + " |")
        row = [" / ".join(fixed(studies.paper(task, method, m)[0], 0) for m in METRICS) for task in ENVIRONMENTS]
        row.append(" / ".join(fixed(studies.paper_mean(method, metric)) for metric in METRICS))
        texts.append("| (paper) | " + " | ".join(row) + " |")
    lead = lead_of(studies, RECURRENT["A2C RC"], RECURRENT["A2C FF"])
    paper = [
        studies.paper_mean(RECURRENT["A2C RC"], metric) - studies.paper_mean(RECURRENT["A2C FF"], metric)
        for metric in METRICS
    ]
    texts.append(
        fill(
            "A2C RC minus A2C FF is {:.1f} points in Default, {:.1f} in Interpolation and {:.1f} in Extrapolation. "
            "No difference is significant. In the paper the differences are {:.1f}, {:.1f} and {:.1f} points",
            *lead,
            *paper,
        )
    )
    on_cart_pole = [
        by_seed(studies, "classic-rc", "CartPole", RECURRENT[name], seeds)[2] for name in ("A2C RC", "A2C FF")
    ]
    gain = fmean(on_cart_pole[0]) - fmean(on_cart_pole[1])
    texts.append(f"A2C with memory extrapolates better by {fixed(gain)} points")
    texts.append(f"Default ({fixed(lead_of(studies, RECURRENT['PPO FF'], RECURRENT['A2C FF'])[0])} points)")
    single = {
        "PPO FF": FF["ppo"],
        "PPO RC": ("ppo", "rc", None),
        "RL²-PPO RC": ("rl2-ppo", "rc", 2),
        "EPOpt-PPO RC": ("epopt-ppo", "rc", None),
        "EPOpt-A2C RC": ("epopt-a2c", "rc", None),
    }
    for name, method in single.items():
        texts.append(f"| {name} | " + " | ".join(one_seed(studies, task, method) for task in ENVIRONMENTS) + " |")
        if name != "PPO FF":
            texts.append(
                "| (paper, five seeds) | " + " | ".join(papers(studies, task, method) for task in ENVIRONMENTS) + " |"
            )
    on_e = {
        "A2C FF": FF["a2c"],
        "A2C RC": ("a2c", "rc", None),
        "RL²-A2C RC": ("rl2-a2c", "rc", 2),
        **single,
    }
    for name, method in on_e.items():
        row = [one_seed(studies, task, method, trained_on="E") for task in ENVIRONMENTS]
        texts.append(f"| {name} | " + " | ".join(row) + " |")
    texts += results_lines.task_rows(studies, rule="text", mean=True)
    texts += results_lines.task_rows(studies, 1, "text")
    texts += results_lines.task_rows(studies, 1, "text", places=results_lines.TESTS)
    done, _ = studies.planned("classic-rc")
    return [*texts, f"**{done} of 360 cells**"]


def rl2(studies):
    texts = []
    seeds = range(2, 5)
    methods = {"A2C FF": FF["a2c"], "A2C RC": ("a2c", "rc", None), "RL²-A2C RC": ("rl2-a2c", "rc", 2)}
    extrapolation = {}
    for task in ENVIRONMENTS:
        for name, method in methods.items():
            runs = by_seed(studies, "classic-rc", task, method, seeds)
            extrapolation[task, name] = runs
            row = [" / ".join(fixed(number) for number in run) for run in zip(*runs, strict=True)]
            row.append(" / ".join(map(spread, runs)))
            texts.append(f"| {name} | " + " | ".join(row) + " |")
        texts.append(f"| (paper, five seeds) | | | | {papers(studies, task, methods['RL²-A2C RC'])} |")

    def ahead(task, other, metric=2):
        pair = zip(extrapolation[task, "RL²-A2C RC"][metric], extrapolation[task, other][metric], strict=True)
        return [mine - theirs for mine, theirs in pair]

    better, worse = ahead("CartPole", "A2C FF"), ahead("CartPole", "A2C RC")
    texts.append(f"better than A2C FF with every seed, by {fixed(min(better))} to {fixed(max(better))} points")
    texts.append(
        f"better than A2C RC by {fixed(fmean(worse))} points, but not with every seed ({fixed(min(worse))} to "
        f"{fixed(max(worse))} points)"
    )
    behind = [[-number for number in ahead("Pendulum", other)] for other in ("A2C FF", "A2C RC")]
    texts.append(
        f"It is {fixed(min(behind[0]))} to {fixed(max(behind[0]))} points behind A2C FF, and "
        f"{fixed(min(behind[1]))} to {fixed(max(behind[1]))} points behind A2C RC"
    )
    on_acrobot = [-number for number in ahead("Acrobot", "A2C FF")]
    texts.append(f"In Extrapolation it is {fixed(min(on_acrobot))} to {fixed(max(on_acrobot))} points behind A2C FF")
    for label, name in (("RL²", "RL²-A2C RC"), ("A2C FF", "A2C FF")):
        on_r = studies.finished("classic-rc", environment="MountainCar", trained_on="R")
        on_r = [cell for cell in on_r if cell.method == methods[name] and cell.seed in seeds]
        shown = [fmean([cell.success(version) for cell in on_r]) for version in "RE"]
        texts.append(fill(label + " has {:.1f} on R and {:.1f} on E", *shown))
    for name, label in (("rl2-a2c", "RL²-A2C, "), ("rl2-ppo", "RL²-PPO, ")):
        for trials in (1, 2, 5):
            method = (name, "rc", trials)
            row = []
            for task in ("CartPole", "Pendulum"):
                row += [one_seed(studies, task, method), papers(studies, task, method)]
            texts.append(f"| {label}{trials} | " + " | ".join(row) + " |")
    return texts + results_lines.trial_rows(studies)


def locomotion(studies):
    """Return the texts and tables of docs/findings/locomotion.md."""
    texts = []
    table = {}
    for trained in "DRE":
        cells = studies.finished("locomotion", environment="Hopper", algorithm="ppo", trained_on=trained)
        row = []
        for tested in "DRE":
            numbers = [cell.success(tested) for cell in cells]
            table[trained + tested] = numbers
            row.append(f"{spread(numbers)} ({', '.join(f'{fixed(number, 0)}' for number in numbers)})")
        texts.append(f"| PPO trained on {trained} | " + " | ".join(row) + " |")
    extrapolation = [cube_root(a * b * c) for a, b, c in zip(table["DR"], table["DE"], table["RE"], strict=True)]
    texts.append(
        f"Default is {spread(table['DD'])}, Interpolation {spread(table['RR'])}, Extrapolation {spread(extrapolation)}"
    )
    texts.append(
        f"PPO trained on D succeeds in {fixed(fmean(table['DD']), 0)} % of the episodes on D, "
        f"in {fixed(fmean(table['DR']), 0)} % on R "
        f"and in {fixed(fmean(table['DE']), 0)} % on E. Trained on E it reaches {fixed(fmean(table['EE']), 0)} % on E"
    )
    random_policy = studies.finished("locomotion", environment="Hopper", algorithm="random", trained_on="D")
    mean_return = fmean([cell.tests["D"][1] for cell in random_policy])
    texts.append("| random policy | 0.0 | 0.0 | 0.0 |")
    texts.append(f"below the random policy's mean return of {fixed(mean_return, 0)}")
    rates = {cell.settings["learning_rate"]: cell.tests["D"][1] for cell in studies.finished("locomotion-rate")}
    pairs = zip(table["RR"], table["DR"], strict=True)
    (exception,) = [fill("{:.0f} % trained on R, {:.0f} % trained on D", *pair) for pair in pairs if pair[0] < pair[1]]
    texts.append(f"With the third seed they are worse ({exception})")
    texts.append(
        f"The mean return was {fixed(rates[2e-3], 0)} with a rate of 2e-3, {fixed(rates[7e-4], 0)} with a rate of 7e-4 "
        f"and {fixed(rates[2e-4], 0)} with a rate of 2e-4"
    )
    a2c = [cell.success("D") for cell in studies.finished("locomotion", algorithm="a2c")]
    texts.append(fill("have {:.1f} and {:.1f} %", *a2c))
    cheetah = studies.finished("locomotion", environment="HalfCheetah", algorithm="ppo")
    shown = [
        fill("{:.1f} and {:.1f} % on {}", *(cell.success(version) for cell in cheetah), version) for version in "DRE"
    ]
    texts.append("succeed in " + ", ".join(shown))
    done, _ = studies.planned("locomotion")
    return [*texts, f"**{done} of 72 cells**"]


def search_row(studies, cells):
    """Return the averages over tasks, the margin, and the tasks' metrics of one configuration."""
    tasks = []
    for task in ENVIRONMENTS:
        found = {(cell.seed, cell.trained_on): cell for cell in cells if cell.environment == task}
        runs = []
        for seed in sorted({seed for seed, _ in found}):
            d, r = found[seed, "D"], found[seed, "R"]
            runs.append((d.success("D"), r.success("R"), cube_root(d.success("R") * d.success("E") * r.success("E"))))
        tasks.append([fmean(numbers) for numbers in zip(*runs, strict=True)])
    means = [fmean(task[i] for task in tasks) for i in range(3)]
    shown = ["/".join(fixed(number, 0) for number in task) for task in tasks]
    return means, results_lines.margin(studies, means), shown


def beyond(studies):
    texts = []
    confirm = averages(studies, "beyond/confirm-2", FF["ppo"], range(7, 12))
    numbers = [spread(numbers) for numbers in confirm]
    texts.append(f"| PPO, one configuration | **{numbers[0]}** | {numbers[1]} | {numbers[2]} |")
    for name in ("a2c", "ppo"):
        shown = " | ".join(fixed(studies.paper_mean(FF[name], metric)) for metric in METRICS)
        texts.append(f"| the paper's {NAMES[name]} | {shown} |")
    for task in ENVIRONMENTS:
        runs = by_seed(studies, "beyond/confirm-2", task, FF["ppo"], range(7, 12))
        texts.append(f"| {task} | " + " | ".join(map(spread, runs)) + " |")
    groups = defaultdict(list)
    for study in ("gamma", "batch", "last", "others", "updates", "pendulum", "normalisation"):
        for cell in studies.finished(f"beyond/search-{study}"):
            known = cell.settings
            key = (known["num_envs"], known["n_minibatches"], known["gamma"], known["ent_coef"], known["learning_rate"])
            groups[(*key, known["normalize_observations"])].append(cell)
    rows = {}
    for key, cells in groups.items():
        unique = {cell.cell: cell for cell in cells}.values()
        if {cell.environment for cell in unique} == set(ENVIRONMENTS):
            rows[key] = search_row(studies, unique)
    for key, (means, least, tasks) in rows.items():
        environments, minibatches, gamma, entropy, rate, normalised = key
        if rate == 1e-3 and normalised:
            label = f"| {environments} | {minibatches} | {gamma} | {entropy} | "
            texts.append(label + " | ".join([*map(fixed, means), fixed(least), *tasks]) + " |")
    first = rows[16, 4, 0.99, 0.01, 1e-3, True][0]
    texts += results_texts.beyond(studies, confirm, first)
    least = [least for key, (_, least, _) in rows.items() if not key[5]]
    texts.append(f"have margins from {fixed(max(least))} to {fixed(min(least))}")
    added = defaultdict(list)
    for cell in studies.finished("beyond/search-regularisation"):
        added[cell.settings.get("weight_decay", 0), cell.settings.get("observation_noise", 0)].append(cell)
    for (decay, noise), cells in added.items():
        means, least, tasks = search_row(studies, cells)
        label = f"{decay or noise:g} | " if decay or noise else "| neither | "
        texts.append(label + " | ".join([*map(fixed, means), fixed(least), *tasks]) + " |")
    return texts + results_lines.search_rows(studies)
