"""Reference lines for figures: the success of the heuristic policies, and the upper bounds.

The scripts that draw figures import this module. docs/findings/reference-lines.md explains the lines.
"""

import results_lines

# A shade of grey that is visible on white and beside the colours of other lines.
GREY = "0.35"
STYLES = {"heuristic policy": "--", "upper bound": ":"}
# The index of each version and metric in the lists of results_lines.
PLACES = {"D": 0, "R": 1, "E": 2, "Default": 0, "Interpolation": 1, "Extrapolation": 3}


def draw(panel, studies, task, name, color=GREY):
    """Draw the known reference lines of a task across a panel of success in %. Return them by label.

    `name` is the version of the tests, or Default, Interpolation or Extrapolation.
    """
    known = {"heuristic policy": results_lines.heuristic(studies, task), "upper bound": results_lines.upper_bound(task)}
    return {
        label: panel.axhline(rates[PLACES[name]], color=color, linestyle=STYLES[label], linewidth=1.2, label=label)
        for label, rates in known.items()
        if rates is not None
    }
