"""Figures that compare methods: the gap over rounds, bytes and seconds, one panel for each."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.plots.style import MARKERS, METHOD_COLOURS, column_figure
from solvers.reporting.convergence_plots import Curve, Effort

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LINES = ("-", "--", ":", "-.")
_MARKER_DISTANCE = 0.08  # of the diagonal of a panel


def plot_efforts(curves: Sequence[Curve]) -> "Figure":
    """Figure of the gap of several methods over their effort, with a panel for each effort.

    A panel shows the methods whose effort was counted. Axes are logarithmic. Raises a SettingError
    if no method has a gap above zero.
    """
    panels = _panels(curves)
    styles = _styles(curves)
    with column_figure(height=0.95, width=max(1.0, 0.9 * len(panels))) as figure:
        handles = {}
        grid = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (effort, shown) in zip(grid, panels, strict=True):
            for curve in shown:
                colour, marker, line = styles[curve.name]
                x, y = _visible_points(curve, effort)
                (handles[curve.name],) = axes.loglog(
                    x, y, f"{marker}{line}", color=colour, markevery=_MARKER_DISTANCE
                )
            axes.set_xlabel(effort.value)
        grid[0].set_ylabel("relative gap")
        names = [curve.name for curve in curves if curve.name in handles]
        entries = [handles[name] for name in names]
        columns = min(len(names), 2 * len(panels))
        figure.legend(entries, names, loc="outside upper center", ncols=columns)
    return figure


def _panels(curves: Sequence[Curve]) -> list[tuple[Effort, list[Curve]]]:
    """Efforts that were counted, each with the curves that can be drawn over it."""
    panels = []
    for effort in Effort:
        shown = [curve for curve in curves if len(_visible_points(curve, effort)[0])]
        if shown:
            panels.append((effort, shown))
    if not panels:
        raise SettingError(
            "no method has a gap above zero to be drawn; give runs that took at least a step"
        )
    return panels


def _visible_points(curve: Curve, effort: Effort) -> tuple[Array, Array]:
    """Points of a curve that logarithmic axes can show; none where the effort was not counted."""
    x = curve.effort(effort)
    if x is None:
        return np.zeros(0), np.zeros(0)
    y = curve.gap
    is_visible = np.isfinite(y) & (y > 0) & (x > 0)
    return np.asarray(x[is_visible], dtype=float), y[is_visible]


def _styles(curves: Sequence[Curve]) -> dict[str, tuple[str, str, str]]:
    """Colour, marker and line of every method, the same in all panels.

    The colours come again after `num_colours` methods, with other markers and lines.
    """
    num_colours = len(METHOD_COLOURS)
    styles = {}
    for position, curve in enumerate(curves):
        k = position if curve.place is None else curve.place
        repetition = k // num_colours
        colour = METHOD_COLOURS[k % num_colours]
        marker = MARKERS[(k + repetition) % len(MARKERS)]
        line = _LINES[repetition % len(_LINES)]
        styles[curve.name] = colour, marker, line
    return styles
