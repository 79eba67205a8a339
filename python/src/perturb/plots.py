"""Plots of assessments, drawn with matplotlib."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from . import _native
from .errors import InvalidArgumentError
from .results import Bin, Bin2D

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


def curves(lines: Mapping[str, Sequence[Bin]], parameter: str, units: Mapping[str, str], title: str, axes: Any) -> Any:
    """Plot success rates, %, over a parameter. Each named line has a point per bin, and a band for the intervals.

    A line has a gap where two bins are not adjacent.

    Raises:
        InvalidArgumentError: if no line has bins.
    """
    axes = _axes(axes)
    drawn = {name: parts for name, parts in lines.items() if parts}
    if not drawn:
        raise InvalidArgumentError(f"{parameter} does not vary in {', '.join(lines)}: there is no curve over it")
    for name, parts in drawn.items():
        x: list[float] = []
        rate: list[float] = []
        low: list[float] = []
        high: list[float] = []
        for part, before in zip(parts, [None, *parts[:-1]], strict=True):
            if before is not None and before.high != part.low:
                x, rate = [*x, np.nan], [*rate, np.nan]
                low, high = [*low, np.nan], [*high, np.nan]
            ends = part.success_interval or (np.nan, np.nan)
            x.append((part.low + part.high) / 2)
            rate.append(np.nan if part.success_percent is None else part.success_percent)
            low.append(ends[0])
            high.append(ends[1])
        (line,) = axes.plot(x, rate, marker="o", markersize=3, label=name)
        axes.fill_between(x, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
    axes.set(title=title, xlabel=_named(parameter, units), ylabel="success, %", ylim=(-2, 102))
    axes.legend()
    return axes


def heatmap(
    cells: Sequence[Bin2D], x: str, y: str, units: Mapping[str, str], title: str, axes: Any, cbar: bool = True
) -> Any:
    """Plot success rates, %, over two parameters as a heatmap. Cells without episodes stay white."""
    axes = _axes(axes)
    if not cells:
        raise InvalidArgumentError(f"{x} or {y} does not vary in this test: there is no heatmap over them")
    shades = _draw_cells(cells, x, y, units, axes)
    axes.set(title=title)
    if cbar:
        axes.figure.colorbar(shades, ax=axes, label="success, %")
    return axes


def heatmaps(
    panels: Mapping[str, Sequence[Bin2D]],
    x: str,
    y: str,
    units: Mapping[str, str],
    title: str,
    cbar: bool,
    axes: Any,
) -> Any:
    """Plot a row of heatmaps, one for each name, with the same axes and colour scale. Return an array of axes."""
    if axes is None:
        plt = _pyplot()
        size = (3.2 * len(panels) + 0.8, 3.6)
        _, axes = plt.subplots(
            1, len(panels), figsize=size, sharex=True, sharey=True, layout="constrained", squeeze=False
        )
    drawn = np.atleast_1d(np.asarray(axes, dtype=object)).ravel()
    if len(drawn) != len(panels):
        raise InvalidArgumentError(f"axes has {len(drawn)} axes; expected {len(panels)}, one for each condition")
    shades = None
    for place, ((name, cells), one) in enumerate(zip(panels.items(), drawn, strict=True)):
        if not cells:
            raise InvalidArgumentError(f"{x} or {y} does not vary in this test: there is no heatmap over them")
        shades = _draw_cells(cells, x, y, units, one)
        one.set_title(name)
        if place > 0:
            one.set_ylabel("")
    figure = drawn[0].figure
    figure.suptitle(title, fontsize="medium")
    if cbar:
        figure.colorbar(shades, ax=list(drawn), label="success, %")
    return drawn


def pooled(policies: Sequence[Sequence[Bin]]) -> list[Bin]:
    """Pool the bins of several policies: sum successes and episodes in each bin of a parameter's range."""
    counted: dict[tuple[float, float], list[int]] = {}
    for part in (part for parts in policies for part in parts):
        counts = counted.setdefault((part.low, part.high), [0, 0])
        counts[0] += part.successes
        counts[1] += part.episodes
    parts = []
    for (low, high), (successes, episodes) in sorted(counted.items()):
        ends = _native.wilson(successes, episodes) if episodes else None
        rate = 100 * successes / episodes if episodes else None
        interval = None if ends is None else (100 * ends[0], 100 * ends[1])
        parts.append(Bin(low, high, successes, episodes, rate, interval))
    return parts


def pooled_2d(policies: Sequence[Sequence[Bin2D]]) -> list[Bin2D]:
    """Pool the grids of several policies: sum successes and episodes in each cell of two parameters' ranges."""
    counted: dict[tuple[tuple[float, float], tuple[float, float]], list[int]] = {}
    for cell in (cell for cells in policies for cell in cells):
        both = counted.setdefault((cell.x, cell.y), [0, 0])
        both[0] += cell.successes
        both[1] += cell.episodes
    return [
        Bin2D(x, y, successes, episodes, 100 * successes / episodes if episodes else None)
        for (x, y), (successes, episodes) in counted.items()
    ]


def _draw_cells(cells: Sequence[Bin2D], x: str, y: str, units: Mapping[str, str], axes: Any) -> Any:
    """Draw the cells of a heatmap on axes. Return the colour scale, which all panels share."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.patches import Rectangle

    shades = ScalarMappable(Normalize(0, 100), "viridis")
    parts_x, parts_y = _widened({cell.x for cell in cells}), _widened({cell.y for cell in cells})
    for cell in cells:
        if cell.success_percent is not None:
            (left, right), (bottom, top) = parts_x[cell.x], parts_y[cell.y]
            colour = tuple(shades.to_rgba(np.array([cell.success_percent]))[0])
            axes.add_patch(Rectangle((left, bottom), right - left, top - bottom, color=colour, linewidth=0))
    axes.set(xlabel=_named(x, units), ylabel=_named(y, units))
    axes.set_xlim(min(low for low, _ in parts_x.values()), max(high for _, high in parts_x.values()))
    axes.set_ylim(min(low for low, _ in parts_y.values()), max(high for _, high in parts_y.values()))
    return shades


def _widened(parts: set[tuple[float, float]]) -> dict[tuple[float, float], tuple[float, float]]:
    """Return the interval that each bin or grid point of an axis fills in the plot, by its edges (low, high).

    A bin fills its own interval. A grid point has no width, so it fills the interval up to halfway to its neighbours.
    """
    ordered = sorted(parts)
    if any(low != high for low, high in ordered):
        return {part: part for part in ordered}
    points = np.array([low for low, _ in ordered])
    middles = (points[1:] + points[:-1]) / 2
    lows = [2 * points[0] - middles[0], *middles]
    highs = [*middles, 2 * points[-1] - middles[-1]]
    return {part: (float(low), float(high)) for part, low, high in zip(ordered, lows, highs, strict=True)}


def _axes(axes: Any) -> Any:
    return _pyplot().subplots()[1] if axes is None else axes


def _pyplot() -> Any:
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError(
            "pictures need matplotlib, which perturb does not install: pip install 'perturb-rl[plot]', or pip install "
            "matplotlib; success_by_parameter() and success_by_parameters() have the numbers, to_html() has pictures"
        ) from error
    return plt


def _named(parameter: str, units: Mapping[str, str]) -> str:
    return parameter if units[parameter] == "1" else f"{parameter}, {units[parameter]}"
