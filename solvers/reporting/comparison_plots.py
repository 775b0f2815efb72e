"""Figures that compare methods: the gap over rounds, bytes and seconds, one panel for each."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.figures import rounded_up
from pgo_models.geometry.rotations import Array
from pgo_models.plots.interactive_plots import lay_out
from pgo_models.plots.style import MARKERS, METHOD_COLOURS, column_figure, plotly
from solvers.reporting.convergence_plots import LINES, LOGARITHMIC, Curve, Effort

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from plotly.graph_objects import Figure as PlotlyFigure

_DASHES = ("solid", "dash", "dot", "dashdot")
_MARKER_DISTANCE = 0.08  # of the diagonal of a panel
_MAX_POINTS = 400  # of a curve in a page: thousands of sweeps would make it slow


def plot_efforts(curves: Sequence[Curve]) -> "Figure":
    """Figure of the gap of several methods over their effort, with a panel for each effort.

    A panel shows the methods whose effort was counted. Axes are logarithmic. Raises a SettingError
    if no method has a gap above zero.
    """
    panels = _panels(curves)
    styles = _styles(curves, LINES)
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


def explore_efforts(curves: Sequence[Curve], title: str = "") -> "PlotlyFigure":
    """Plotly figure of the curves of `plot_efforts`.

    An entry of the legend shows and hides a method in all panels.
    """
    panels = _panels(curves)
    styles = _styles(curves, _DASHES)
    figure = plotly("subplots").make_subplots(
        1, len(panels), shared_yaxes=True, horizontal_spacing=0.03
    )
    named: set[str] = set()
    for column, (effort, shown) in enumerate(panels, 1):
        for curve in shown:
            colour, _, dash = styles[curve.name]
            x, y = _subsampled(*_visible_points(curve, effort))
            figure.add_scatter(
                x=[float(f"{value:.5g}") for value in x],
                y=[float(rounded_up(value, 5)) for value in y],
                name=curve.name,
                legendgroup=curve.name,
                showlegend=curve.name not in named,
                line={"color": colour, "dash": dash},
                mode="lines",
                row=1,
                col=column,
            )
            named.add(curve.name)
        figure.update_xaxes(title_text=effort.value, row=1, col=column)
    figure.update_xaxes(**LOGARITHMIC, dtick=1)
    figure.update_yaxes(**LOGARITHMIC, dtick=1)
    figure.update_yaxes(title_text="relative gap", row=1, col=1)
    lay_out(figure, title, legend_y=-0.16)
    return figure


def _subsampled(x: Array, y: Array) -> tuple[Array, Array]:
    """At most `_MAX_POINTS` points of a curve, evenly spread, with first and last."""
    places = np.linspace(0, len(x) - 1, min(len(x), _MAX_POINTS))
    kept = np.unique(places.round().astype(int))
    return x[kept], y[kept]


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


def _styles(curves: Sequence[Curve], lines: Sequence[str]) -> dict[str, tuple[str, str, str]]:
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
        line = lines[repetition % len(lines)]
        styles[curve.name] = colour, marker, line
    return styles
