"""Pictures of methods beside each other: the gap against rounds, bytes and seconds, one panel for each."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.plots.interactive_plots import lay_out
from pgo_models.plots.style import MARKERS, METHOD_COLOURS, column_figure, count_along_x, plotly
from solvers.reporting.convergence_plots import LINES, LOGARITHMIC, Curve, Effort

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from plotly.graph_objects import Figure as PlotlyFigure

_PANELS = (Effort.ROUNDS, Effort.BYTES, Effort.SECONDS)
_DASHES = ("solid", "dash", "dot", "dashdot")
_MARKER_DISTANCE = 0.08  # of the diagonal of a panel
_MOST_POINTS = 400  # of a curve in a page: sweeps by the thousand would make it slow


def plot_efforts(curves: Sequence[Curve], efforts: Sequence[Effort] = _PANELS) -> "Figure":
    """Figure of the gap of several methods over what they spent; a panel holds those whose effort is counted.

    Each effort has a panel, all but that of iterations with a logarithmic axis. A SettingError without gaps above zero.
    """
    panels, styles = _panels(curves, efforts), _styles(curves, LINES)
    with column_figure(height=0.95, width=max(1.0, 0.9 * len(panels))) as figure:
        handles = {}
        grid = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (effort, shown) in zip(grid, panels, strict=True):
            for curve in shown:
                colour, marker, line = styles[curve.name]
                x, y = _points(curve, effort)
                draw = axes.semilogy if effort is Effort.ITERATIONS else axes.loglog
                (handles[curve.name],) = draw(x, y, f"{marker}{line}", color=colour, markevery=_MARKER_DISTANCE)
            axes.set_xlabel(effort.value)
            if effort is Effort.ITERATIONS:
                count_along_x(axes)
        grid[0].set_ylabel("relative gap")
        names = [curve.name for curve in curves if curve.name in handles]
        columns = min(len(names), 2 * len(panels))
        figure.legend([handles[name] for name in names], names, loc="outside upper center", ncols=columns)
    return figure


def explore_efforts(curves: Sequence[Curve], title: str = "") -> "PlotlyFigure":
    """Plotly figure of what `plot_efforts` shows; an entry of the legend shows and hides a method in all panels."""
    panels, styles = _panels(curves, _PANELS), _styles(curves, _DASHES)
    figure = plotly("subplots").make_subplots(1, len(panels), shared_yaxes=True, horizontal_spacing=0.03)
    named: set[str] = set()
    for column, (effort, shown) in enumerate(panels, 1):
        for curve in shown:
            colour, _, dash = styles[curve.name]
            x, y = _points(curve, effort)
            kept = np.unique(np.linspace(0, len(x) - 1, min(len(x), _MOST_POINTS)).round().astype(int))
            across, up = ([float(f"{value:.5g}") for value in values[kept]] for values in (x, y))
            entry = {"name": curve.name, "legendgroup": curve.name, "showlegend": curve.name not in named}
            line = {"color": colour, "dash": dash}
            figure.add_scatter(x=across, y=up, **entry, line=line, mode="lines", row=1, col=column)
            named.add(curve.name)
        figure.update_xaxes(title_text=effort.value, row=1, col=column)
    figure.update_xaxes(**LOGARITHMIC, dtick=1)
    figure.update_yaxes(**LOGARITHMIC, dtick=1)
    figure.update_yaxes(title_text="relative gap", row=1, col=1)
    lay_out(figure, title, legend_y=-0.16)
    return figure


def _panels(curves: Sequence[Curve], efforts: Sequence[Effort]) -> list[tuple[Effort, list[Curve]]]:
    panels = []
    for effort in efforts:
        if shown := [curve for curve in curves if curve.counts(effort) and len(_points(curve, effort)[0])]:
            panels.append((effort, shown))
    if not panels:
        raise SettingError("no method has a gap above zero to be drawn; give runs that took at least a step")
    return panels


def _points(curve: Curve, effort: Effort) -> tuple[Array, Array]:
    """What the axes can show of a curve."""
    x, y = curve.effort(effort), curve.gap
    shown = ((x > 0) | (effort is Effort.ITERATIONS)) & np.isfinite(y) & (y > 0)
    return x[shown], y[shown]


def _styles(curves: Sequence[Curve], lines: Sequence[str]) -> dict[str, tuple[str, str, str]]:
    """Colour, marker and line of every method, in all panels the same."""
    number, found = len(METHOD_COLOURS), {}
    for place, curve in enumerate(curves):
        k = place if curve.place is None else curve.place
        marker, line = MARKERS[(k + k // number) % len(MARKERS)], lines[k // number % len(lines)]
        found[curve.name] = METHOD_COLOURS[k % number], marker, line
    return found
