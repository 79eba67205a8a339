"""Compute how many test episodes of MountainCar and Pendulum can be solved by a policy that knows the physics.

Usage: upper_bound.py > upper_bound.csv; some minutes

The episodes are those of the study experiments/heuristic.toml: 1 000 on each of D, R and E with each of five seeds.
Each episode is first tried with the rule of the heuristic policy, and with the policy that always pushes to the right
(on Pendulum by 1 N m). For the other episodes, a dynamic programme computes the best margin that any policy can reach:
on MountainCar the highest position within 110 steps, on Pendulum the smallest distance from the angle π/3 in the last
100 steps. The policy of this programme then plays the episode. If it succeeds, the episode can be solved.

The programme knows the best margin at the points of a grid of states, and interpolates it linearly between them. So the
margin of an episode that was not solved has an error, and is neither an upper nor a lower bound. Episodes that miss
narrowly are tried again on grids with two and four times as many points along each axis. If they still miss by less
than a tolerance, they count as undecided. The file has the smallest miss among the other episodes. The standard error
stream has the smallest misses on the finest grid, with the change since the grid before.
"""

import csv
import itertools
import sys
import time
from functools import partial

import numpy as np

# Seeds of the test environments with the seeds 7 to 11: the column `seed` of recorded episodes.
SEEDS = {
    "D": (
        12716886768273581270,
        7470873291888764096,
        10517729269783266248,
        16059053879772891223,
        17396220840303598548,
    ),
    "R": (
        14585303940335716017,
        1435467525959111267,
        15110740166100210654,
        18242262912926430238,
        8022537723503912309,
    ),
    "E": (
        12935305821743546878,
        9123134039867423320,
        1014185302794962546,
        11599957038145334944,
        15470894099037850862,
    ),
}
ENVIRONMENTS, EPISODES = 100, 10
PARAMETERS = {
    "MountainCar": {
        "D": ([(0.001, 0.001)], [(0.0025, 0.0025)]),
        "R": ([(0.0005, 0.005)], [(0.001, 0.005)]),
        "E": ([(0.0001, 0.0005), (0.005, 0.01)], [(0.0005, 0.001), (0.005, 0.01)]),
    },
    "Pendulum": {
        "D": ([(1, 1)], [(1, 1)]),
        "R": ([(0.75, 1.25)], [(0.75, 1.25)]),
        "E": ([(0.5, 0.75), (1.25, 1.5)], [(0.5, 0.75), (1.25, 1.5)]),
    },
}
GOAL, CAR_LIMIT, BOTTOM = 0.5, 110, -np.pi / 6
UPRIGHT, HOLD, STEPS = np.pi / 3, 100, 200
# An episode is tried on a finer grid if it misses by less than this, in m or rad.
NARROW = 0.1
# An episode counts as undecided if it misses by less than this on the finest grid, in m or rad.
TOLERANCE = 0.02


def stream(seed, environment_index, purpose, count):
    """Return the random numbers of docs/random-streams.md."""
    key = np.array([seed, environment_index], dtype=np.uint64)
    counter = np.array([0, count, purpose, 0], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=counter))


def draw(u, intervals):
    rest = u * sum(high - low for low, high in intervals)
    for low, high in intervals:
        if rest < high - low:
            return low + rest
        rest -= high - low
    return intervals[-1][1]


def episodes(task, version):
    """Return the parameters [n, 2] and the initial states [n, 2] of the n = 5 000 test episodes."""
    parameters, states = [], []
    for seed, index, count in itertools.product(SEEDS[version], range(ENVIRONMENTS), range(EPISODES)):
        u = stream(seed, index, 0, count).random(2)
        parameters.append([draw(*pair) for pair in zip(u, PARAMETERS[task][version], strict=True)])
        u = stream(seed, index, 1, count).random(2)
        low, high = {"MountainCar": ((-0.6, 0), (-0.4, 0)), "Pendulum": ((-np.pi, -1), (np.pi, 1))}[task]
        states.append([low[i] + (high[i] - low[i]) * u[i] for i in range(2)])
    return np.array(parameters), np.array(states)


def car_step(state, action, force, mass):
    """Return position and velocity after a step; `action` is -1, 0 or 1."""
    position, velocity = state
    velocity = np.clip(velocity + action * force - mass * np.cos(3 * position), -0.07, 0.07)
    position = np.clip(position + velocity, -1.2, 0.6)
    return position, np.where((position == -1.2) & (velocity < 0), 0, velocity)


def pendulum_step(state, torque, length, mass):
    """Return angle and velocity after a step. The angle is not wrapped."""
    angle, velocity = state
    change = 15 / length * np.sin(angle) + 3 / (mass * length**2) * torque
    velocity = np.clip(velocity + 0.05 * change, -8, 8)
    return angle + 0.05 * velocity, velocity


def car_solved(policy, parameters, states):
    """Return for each episode whether a policy reaches the goal in time."""
    state, solved = states.T, np.zeros(len(states), bool)
    for number in range(CAR_LIMIT):
        state = car_step(state, policy(number, state), *parameters.T)
        solved |= (state[0] >= GOAL) & (state[1] >= 0)
    return solved


def pendulum_solved(policy, parameters, states):
    """Return for each episode whether a policy holds the rod upright after each of the last 100 steps."""
    state, solved = states.T, np.ones(len(states), bool)
    for number in range(STEPS):
        state = pendulum_step(state, np.clip(policy(number, state), -2, 2), *parameters.T)
        upright = abs((state[0] + np.pi) % (2 * np.pi) - np.pi) < UPRIGHT
        solved &= upright | (number < STEPS - HOLD)
    return solved


def push_right(_number, state):
    return np.ones_like(state[0])


def push_along(_number, state):
    """Push in the direction of the velocity, and at rest downhill."""
    position, velocity = state
    return np.where(velocity - 0.001 * (position - BOTTOM) >= 0, 1, -1)


def swing_up(_number, state):
    """Gain energy below the height -0.1, and hold the rod above it."""
    angle, velocity = state
    hold = 2 * np.tanh(5 * np.tanh(-2 * np.sin(angle) - 0.5 * velocity))
    return np.where(np.cos(angle) > -0.1, hold, np.where(velocity >= 0, 2, -2))


class Grid:
    """A grid of states [2, n], and the interpolation of functions on it. An angle is wrapped."""

    def __init__(self, low, high, points, step, actions):
        axes = [np.linspace(*ends) for ends in zip(low, high, points, strict=True)]
        self.low, self.width, self.points = low, [axis[1] - axis[0] for axis in axes], points
        self.states = np.stack(np.meshgrid(*axes, indexing="ij")).reshape(2, -1)
        self.step, self.actions = step, actions
        self.next_places = [self.places(step(self.states, action)) for action in actions]

    def places(self, states):
        """Return the four grid points around each state, as indices [4, n] with weights [4, n]."""
        parts = []
        for axis, values in enumerate(states):
            place, cells = (values - self.low[axis]) / self.width[axis], self.points[axis] - 1
            place = place % cells if self.low[axis] == -np.pi else np.clip(place, 0, cells)
            index = np.minimum(place.astype(np.int32), cells - 1)
            parts.append((index, (place - index).astype(np.float32)))
        (i, x), (j, y) = parts
        corner = i * self.points[1] + j
        indices = np.stack([corner, corner + 1, corner + self.points[1], corner + self.points[1] + 1])
        return indices, np.stack([(1 - x) * (1 - y), (1 - x) * y, x * (1 - y), x * y])

    def best(self, values):
        """Return for each grid point the best value after a step."""
        return np.max([(values.take(i) * weights).sum(axis=0) for i, weights in self.next_places], axis=0)

    def at(self, values, states):
        indices, weights = self.places(states)
        return (values.take(indices) * weights).sum(axis=0)

    def policy(self, values):
        """Return the policy whose action in step k has the best next state by `values[k + 1]`."""

        def act(number, state):
            found = [self.at(values[number + 1], self.step(state, action)) for action in self.actions]
            return np.array(self.actions)[np.argmax(found, axis=0)]

        return act


def solve_car(parameters, states, fine):
    """Return whether the programme's policy solves episodes with the same parameters, and their margins."""
    step = partial(car_step, force=parameters[0], mass=parameters[1])
    grid = Grid((-1.2, -0.07), (0.6, 0.07), (120 * fine + 1, 70 * fine + 1), step, (-1, 0, 1))
    position = grid.states[0].astype(np.float32)
    # The highest position within k steps from each grid point, for k = 0, 1, …
    highest = [position]
    for _ in range(CAR_LIMIT):
        highest.append(np.maximum(position, grid.best(highest[-1])))
    policy = grid.policy(highest[::-1])
    return car_solved(policy, parameters, states), grid.at(highest[-1], states.T) - GOAL


def solve_pendulum(parameters, states, fine):
    """Return the same for Pendulum."""
    step = partial(pendulum_step, length=parameters[0], mass=parameters[1])
    grid = Grid((-np.pi, -8), (np.pi, 8), (90 * fine + 1, 60 * fine + 1), step, (-2, -1, 0, 1, 2))
    margin = (UPRIGHT - abs(grid.states[0])).astype(np.float32)
    # The smallest distance in the last 100 of k steps from each grid point. The angle counts after a step, so the state
    # before the hundredth step from the end counts only from step 101 on.
    best = [margin]
    for _ in range(HOLD - 1):
        best.append(np.minimum(margin, grid.best(best[-1])))
    for _ in range(STEPS - HOLD + 1):
        best.append(grid.best(best[-1]))
    policy = grid.policy(best[::-1])
    return pendulum_solved(policy, parameters, states), grid.at(best[-1], states.T)


def parts(task, version, parameters):
    """Return groups of episodes: all, and on E of MountainCar by the intervals of both parameters."""
    chosen = {"all": np.ones(len(parameters), bool)}
    if (task, version) == ("MountainCar", "E"):
        strong, heavy = parameters[:, 0] > 0.001, parameters[:, 1] > 0.0025
        chosen |= {"strong, light": strong & ~heavy, "strong, heavy": strong & heavy}
        chosen |= {"weak, light": ~strong & ~heavy, "weak, heavy": ~strong & heavy}
    return chosen


def main():
    out = csv.writer(sys.stdout, lineterminator="\n")
    counted = ["episodes", "always_right", "heuristic", "solved", "undecided"]
    out.writerow(["environment", "version", "part", *counted, "smallest_miss"])
    for task in PARAMETERS:
        play, rule, solve = {
            "MountainCar": (car_solved, push_along, solve_car),
            "Pendulum": (pendulum_solved, swing_up, solve_pendulum),
        }[task]
        for version in SEEDS:
            parameters, states = episodes(task, version)
            heuristic = play(rule, parameters, states)
            right = play(push_right, parameters, states)
            solved, margins = heuristic | right, np.zeros(len(states))
            for fine in (1, 2, 4):
                before = margins.copy()
                tried = ~solved & (margins > -NARROW)
                for same in np.unique(parameters[tried], axis=0):
                    chosen = tried & (parameters == same).all(axis=1)
                    solved[chosen], margins[chosen] = solve(same, states[chosen], fine)
            undecided = ~solved & (margins > -TOLERANCE)
            for part, chosen in parts(task, version, parameters).items():
                counts = [each[chosen].sum() for each in (np.ones_like(solved), right, heuristic, solved, undecided)]
                missed = -margins[chosen & ~solved & ~undecided]
                out.writerow([task, version, part, *counts, f"{missed.min():.4f}" if len(missed) else ""])
            nearest = sorted(zip(-margins[~solved], (margins - before)[~solved], strict=True))[:9]
            shown = ", ".join(f"{miss:.4f} ({change:+.4f})" for miss, change in nearest)
            print(f"{task} {version}: {time.process_time():.0f} s; misses {shown}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
