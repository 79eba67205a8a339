"""Numbers in the sentences of docs/findings. `results_pages` computes the numbers in the tables."""

from collections import defaultdict
from statistics import fmean

from results_numbers import cube_root, std
from results_words import CLEAN, FF, about, fill, fixed, spread


def spaced(number):
    return f"{number:,.0f}".replace(",", " ")


def acrobot(studies):
    """Return the texts with numbers that docs/findings/acrobot-steps.md must contain."""
    updates, deviations = [], []
    for environments, steps in ((1, 5), (1, 15), (16, 5), (16, 15)):
        cells = studies.finished("questions/acrobot", num_envs=environments, n_steps=steps, learning_rate=7e-4)
        updates.append(about(fmean(cell.timesteps / environments / steps for cell in cells)))
        fast = studies.finished("questions/acrobot", num_envs=environments, n_steps=steps, learning_rate=7e-3)
        deviations.append(std([cell.success("D") for cell in fast]))
    # With one environment and five steps, most seeds fail.
    low, high = min(deviations[1:]), max(deviations[1:])
    return [
        f"about the same with {updates[0]} updates (rollouts of five steps) and with {updates[1]} updates (fifteen "
        f"steps). With {updates[2]} updates it is one point lower. With {updates[3]} updates (",
        f"the standard deviation over seeds is {fixed(low, 0)} to {fixed(high, 0)} points",
    ]


def pendulum(studies):
    updates = {}
    for number in (1, 8):
        cells = studies.finished("questions/pendulum", num_envs=number)
        updates[number] = fmean(cell.timesteps / number / cell.settings["n_steps"] for cell in cells)
    solved = studies.finished("questions/pendulum", num_envs=8, bootstrap_truncation=False)
    return [
        f"{len(studies.finished('questions/pendulum'))} trainings",
        f"{spaced(updates[8])} updates instead of {spaced(updates[1])}",
        f"all five seeds reach {int(min(cell.success('D') for cell in solved))} % or more",
    ]


def claims(studies):
    return [f"{sum(cell.study == 'questions/findings' for cell in studies.cells)} trainings"]


def beyond(studies, confirm, first):
    """Return the texts. `confirm` has confirm-2's metrics by seed, `first` the metrics in the search's first row."""
    searched = [cell for cell in studies.cells if cell.study.startswith("beyond/search-")]
    slower = sum(cell.settings["learning_rate"] != 1e-3 for cell in searched)
    gained = [fmean(numbers) - before for numbers, before in zip(confirm, first, strict=True)]
    ends = []
    for task, wanted in (("CartPole", {}), ("Pendulum", {}), ("MountainCar", {"trained_on": "D"})):
        episodes = [cell.episodes for cell in studies.finished("beyond/confirm-2", environment=task, **wanted)]
        ends += [min(episodes), max(episodes)]
    shown = [spaced(round(number, -1)) for number in ends[:4]] + [spaced(round(number, -2)) for number in ends[4:]]
    bad = bad_on_mountain_car(searched)
    return [
        f"{len(searched)} trainings",
        f"except in {slower} trainings",
        f"{slower} trainings start at 5e-4",
        "ended after {} to {} episodes on CartPole, {} to {} on Pendulum, and {} to {} on MountainCar".format(*shown),
        f"ends at {fixed(min(bad), 0)} to {fixed(max(bad), 0)} %",
        fill("is {:.1f} points better than in this table in Default", gained[0]),
        fill("and {:.1f} and {:.1f} points worse in Interpolation and Extrapolation", -gained[1], -gained[2]),
        f"reaches up to {fixed(best_on_pendulum(studies), 0)} % in Extrapolation",
    ]


def bad_on_mountain_car(searched):
    """Return the success of the search's bad policies on D of MountainCar, among those that the page's table has."""
    cells = [cell for cell in searched if (cell.environment, cell.trained_on) == ("MountainCar", "D")]
    cells = [cell for cell in cells if cell.settings["normalize_observations"]]
    rates = [cell.success("D") for cell in cells if cell.study != "beyond/search-regularisation"]
    return [rate for rate in rates if rate < 60]


def best_on_pendulum(studies):
    """Return the best mean Extrapolation over seeds among the configurations with γ of 0.95."""
    names = ("n_minibatches", "ent_coef", "num_envs", "n_steps")
    found = defaultdict(dict)
    for cell in studies.finished("beyond/search-pendulum", gamma=0.95):
        found[tuple(cell.settings[name] for name in names)][cell.seed, cell.trained_on] = cell
    best = 0
    for cells in found.values():
        numbers = []
        for seed in {seed for seed, _ in cells}:
            d, r = cells[seed, "D"], cells[seed, "R"]
            numbers.append(cube_root(d.success("R") * d.success("E") * r.success("E")))
        best = max(best, fmean(numbers))
    return best


def cells_on_d(studies, algorithm, rate, weight=None, **wanted):
    wanted = {"algorithm": algorithm, "learning_rate": rate, "trained_on": "D", **wanted}
    return studies.finished("questions/cart-pole", **wanted, **({"ent_coef": weight} if weight else {}))


def first_of_tied(studies, algorithm, seed, order=None):
    """Return Extrapolation if ties are broken by the grid's order.

    For D and for R, the rule takes the first of the best configurations in this order.
    """

    def first(version):
        wanted = {"algorithm": algorithm, "normalize_observations": True, "trained_on": version, "seed": seed}
        cells = studies.finished("questions/cart-pole", **wanted)
        best = max(cell.tests[version][:2] for cell in cells)
        tied = [cell for cell in cells if cell.tests[version][:2] == best]
        return sorted(tied, key=order)[0] if order else tied[0]

    on_d, on_r = first("D"), first("R")
    return cube_root(on_d.success("R") * on_d.success("E") * on_r.success("E"))


def orders(studies):
    """Return A2C's values of Extrapolation under all orders of the grid.

    An order sorts learning rates up or down, entropy weights up or down, and either of these two settings first.
    """
    numbers = set()
    for rates in (1, -1):
        for weights in (1, -1):
            for first in (0, 1):

                def order(cell, rates=rates, weights=weights, first=first):
                    key = (rates * cell.settings["learning_rate"], weights * cell.settings["ent_coef"])
                    return key[first:] + key[:first]

                numbers.add(round(fmean(first_of_tied(studies, "a2c", seed, order) for seed in CLEAN), 9))
    return [fixed(number) for number in sorted(numbers)]


def cart_pole(studies):
    def mean(cells, version, after=None):
        return fmean(cell.success(version, after) for cell in cells)

    first = {name: [first_of_tied(studies, name, seed) for seed in CLEAN] for name in ("a2c", "ppo")}
    paper = {name: fill("{:.1f} ± {:.1f}", *studies.paper("CartPole", FF[name], "Extrapolation")) for name in first}
    normalised = studies.finished("questions/cart-pole", algorithm="a2c", normalize_observations=True, trained_on="D")
    on_e = [cell.success("E") for cell in normalised if cell.success("D") == 100]
    weights = {w: cells_on_d(studies, "a2c", 7e-4, w, normalize_observations=True) for w in (1e-2, 1e-3, 1e-4, 1e-5)}
    ppo = {rate: cells_on_d(studies, "ppo", rate, normalize_observations=True) for rate in (3e-4, 3e-3)}
    bare = {rate: cells_on_d(studies, "ppo", rate, normalize_observations=False) for rate in (3e-4, 3e-3)}
    kept = [*weights.values(), *ppo.values()]
    falls = {version: [mean(cells, version, 1000) - mean(cells, version) for cells in kept] for version in "DE"}
    early = [mean(cells, "E", 1000) for cells in kept]
    plain = studies.finished("questions/cart-pole", algorithm="a2c", normalize_observations=False, trained_on="D")
    late = [fmean(mean(cells, "E") for cells in each.values()) for each in (ppo, bare)]
    seeds = [sorted(cell.success("E") for cell in weights[weight]) for weight in (1e-4, 1e-5)]
    failed, least, most = (
        min(each[0] for each in seeds),
        min(each[1] for each in seeds),
        max(each[-1] for each in seeds),
    )
    shown = {weight: fixed(mean(cells, "E"), 0) for weight, cells in weights.items()}
    *some, last = orders(studies)
    return [
        f"{len({cell.cell for cell in studies.cells if cell.study == 'questions/cart-pole'})} trainings",
        f"Extrapolation on CartPole: {paper['a2c']} % for A2C and {paper['ppo']} % for PPO",
        "With the order of our experiment file, Extrapolation is "
        f"{spread(first['a2c'])} for A2C and {spread(first['ppo'])} for PPO",
        "have 100.0 % on D",
        f"Their success on E ranges from {fixed(min(on_e), 0)} to {fixed(max(on_e), 0)} %",
        f"A2C's Extrapolation is {', '.join(some)} or {last}",
        f"The paper's {paper['a2c'].split()[0]} lies among these numbers",
        f"On E they succeed in {fixed(min(early), 0)} to {fixed(max(early), 0)} %",
        f"success on E falls by {fixed(min(falls['E']), 0)} to {fixed(max(falls['E']), 0)} points, and on D by up to "
        f"{fixed(max(falls['D']), 0)} points",
        f"PPO's success on E rises from {fixed(mean(bare[3e-4], 'E', 1000), 0)} to {fixed(mean(bare[3e-4], 'E'), 0)} % "
        f"at a rate of 3e-4, and changes from {fixed(mean(bare[3e-3], 'E', 1000), 0)} to "
        f"{fixed(mean(bare[3e-3], 'E'), 0)} % at a rate of 3e-3",
        f"A2C's success on E is {fixed(mean(normalised, 'E', 1000), 0)} % with normalisation and "
        f"{fixed(mean(plain, 'E', 1000), 0)} % without it",
        f"its success on E is {fixed(late[0], 0)} % with normalisation and {fixed(late[1], 0)} % without it",
        f"success on E is about {shown[1e-5]} % with a weight of 1e-4 or of 1e-5. With each of these two weights, four "
        f"seeds have {fixed(least, 0)} to {fixed(most, 0)} %, and the fifth has about {fixed(failed, 0)} %. Success on "
        f"E is {shown[1e-3]} % with a weight of 1e-3, our default, and {shown[1e-2]} % with a weight of 1e-2",
        "seeds end at 0 % on D",
    ]
