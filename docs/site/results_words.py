"""Formatting of numbers as on the pages."""

import re
from dataclasses import dataclass
from statistics import fmean

from results_numbers import std

FF = {name: (name, "ff", None) for name in ("a2c", "ppo", "epopt-a2c", "epopt-ppo")}
NAMES = {
    "a2c": "A2C",
    "ppo": "PPO",
    "epopt-a2c": "EPOpt-A2C",
    "epopt-ppo": "EPOpt-PPO",
    "rl2-a2c": "RL²-A2C",
    "rl2-ppo": "RL²-PPO",
}
CLEAN = range(2, 7)


def fixed(number, digits=1):
    """Return a number rounded to `digits` decimals.

    If the number is halfway between two rounded numbers, return both, for example ⟨0.2|0.3⟩, because rounding errors
    would decide between them.
    """
    texts = [f"{end:.{digits}f}" for end in (number - 1e-9, number + 1e-9)]
    texts = [text.removeprefix("-") if float(text) == 0 else text for text in texts]
    return texts[0] if texts[0] == texts[1] else f"⟨{texts[0]}|{texts[1]}⟩"


def fill(text, *values):
    """Return text with values in the places of `{:.1f}`, `{:.0f}` and `{}`. `fixed` rounds the numbers."""
    values = iter(values)
    return re.sub(r"\{(?::\.(\d)f)?\}", lambda place: shown_value(next(values), place.group(1)), text)


def shown_value(value, digits):
    return str(value) if digits is None else fixed(value, int(digits))


def spread(numbers, digits=1):
    return f"{fixed(fmean(numbers), digits)} ± {fixed(std(numbers), digits)}"


@dataclass
class Near:
    """A text in which each `@` stands for a number. The page's numbers may differ from `values` by `tolerance`."""

    text: str
    values: list
    tolerance: float


@dataclass
class Pattern:
    """A regular expression that a page must match."""

    expression: str


def triple(metrics):
    """Return mean ± deviation of the three metrics in whole percent, or plain zeros if the method never succeeds."""
    if not any(any(numbers) for numbers in metrics):
        return "0 / 0 / 0"
    return " / ".join(spread(numbers, 0) for numbers in metrics)


def listed(names):
    """Return names as text: "A, B and C", or "none" without names."""
    *others, last = names or ["none"]
    return f"{', '.join(others)} and {last}" if others else last


def about(number):
    """Return a number rounded to thousands, or below 10 000 to hundreds. A space separates the thousands."""
    unit = 1000 if number >= 10_000 else 100
    return f"{round(number / unit) * unit:,}".replace(",", " ")
