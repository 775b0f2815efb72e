"""Pictures of runs: residuals and gap over the iterations with the paper's mark; what methods spent."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np

from pgo_models.certificates.certificate import relative_gap
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.published_results import PublishedRun
from pgo_models.plots.interactive_plots import lay_out
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, column_figure, count_along_x, plotly
from solvers.result import History

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from plotly.graph_objects import Figure as PlotlyFigure

Stages = Sequence[tuple[str, History]]
_MOST_MARKERS = 12
_STAR_WITHIN = 3.0  # times our own iterations; a mark farther out is a line with its figures, lest it squeeze the rest
LINES = ("-", "--", ":", "-.")
LOGARITHMIC = {"type": "log", "exponentformat": "power", "gridcolor": "#eeeeee", "zeroline": False}  # plotly's axis


class Effort(enum.Enum):
    """What the progress of methods is held against; the value is the label of the axis."""

    ITERATIONS = "iterations"
    ROUNDS = "communication rounds"
    BYTES = "communication (bytes)"
    SECONDS = "time in steps (s)"


@dataclass(frozen=True, eq=False)
class Curve:
    """A run to be compared: its history, the bound it is held against, and what it cost."""

    name: str
    history: History
    lower_bound: float  # proven for the graph, or the best value known
    # rounds, num_bytes: (len(history),); communication up to every record.
    rounds: Array | None = None
    num_bytes: Array | None = None
    place: int | None = None  # of its colour; its place in the figure unless given

    def __post_init__(self) -> None:
        for label in ("rounds", "num_bytes"):
            given: Array | None = getattr(self, label)
            if given is not None and len(given) != len(self.history):
                entries = f"{len(given)} entries for {len(self.history)} records"
                raise SettingError(f"{label} of {self.name} has {entries}; give one each")

    @property
    def gap(self) -> Array:
        """(objective - lower_bound) / objective of every record."""
        return np.array([relative_gap(objective, self.lower_bound) for objective in self.history.objective])

    def counts(self, effort: Effort) -> bool:
        """Whether it is known what was spent."""
        return self._efforts[effort] is not None

    def effort(self, effort: Effort) -> Array:
        """What was spent up to every record; a SettingError when the curve does not know its communication."""
        if not self.counts(effort):
            raise SettingError(f"{self.name} has no count of {effort.value}; give it to the Curve, or leave it out")
        return np.asarray(self._efforts[effort], dtype=float)

    @property
    def _efforts(self) -> dict[Effort, Array | None]:
        sent = {Effort.ROUNDS: self.rounds, Effort.BYTES: self.num_bytes}
        return {Effort.ITERATIONS: self.history.k, Effort.SECONDS: self.history.seconds, **sent}


def plot_convergence(stages: Stages, lower_bound: float, published: PublishedRun | None = None) -> Figure:
    """Figure of primal and dual residual, and of the gap (F - lower_bound) / F, over the iterations of stages in a row.

    Stages are for example `[(stage.name, stage.history) for stage in solution.stages]`; the later ones go on where the
    earlier ones end. The paper's gap and iterations, if given, are a star; a line with the figures where these are far
    to the right. A SettingError when no stage has a record.
    """
    run, begin = _with_records(stages), 0.0
    with column_figure(height=1.3) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        for (name, history), colour, line in zip(run, cycle(COLOURS), cycle(LINES), strict=False):
            curve = Curve(name, history, lower_bound)
            k, every = begin + history.k, max(1, len(history) // _MOST_MARKERS)
            style = {"color": colour, "markevery": every}
            _semilogy(above, k, history.primal_residual, f"{name}, primal", "o-", style)
            _semilogy(above, k, history.dual_residual, f"{name}, dual", "s--", style)
            _semilogy(below, k, curve.gap, f"{name}, gap", f"^{line}", style)
            begin = float(k[-1])
        above.set_ylabel("relative residual")
        below.set_ylabel("relative gap")
        below.set_xlabel("iteration")
        count_along_x(below)
        if published is not None:
            _mark(below, published, begin)
        figure.legend(loc="outside lower center", ncols=2)
    return figure


def explore_convergence(stages: Stages, lower_bound: float, published: PublishedRun | None = None) -> PlotlyFigure:
    """Plotly figure of what `plot_convergence` shows: gap above, residuals below, figures under the pointer."""
    run, begin = _with_records(stages), 0.0
    figure = plotly("graph_objects").Figure()
    for (name, history), colour in zip(run, cycle(COLOURS), strict=False):
        k = begin + history.k
        for values, what, axis, dash, symbol in (
            (Curve(name, history, lower_bound).gap, "gap", "y", "solid", "circle"),
            (history.primal_residual, "primal residual", "y2", "solid", "square"),
            (history.dual_residual, "dual residual", "y2", "dash", "diamond"),
        ):
            shown = np.isfinite(values) & (values > 0)
            if shown.any():
                line, marker = {"color": colour, "dash": dash}, {"symbol": symbol, "size": 6}
                points = {"x": k[shown].tolist(), "y": [float(f"{value:.5g}") for value in values[shown]]}
                label, mode = f"{name}: {what}", "lines+markers"
                figure.add_scatter(**points, name=label, yaxis=axis, line=line, marker=marker, mode=mode)
        begin = float(k[-1])
    if published is not None and published.gap > 0:
        text = f"paper's SOC: {published.gap:.1e} after {published.iterations} iterations"
        ends, line = [0.0, max(begin, 1.0)], {"color": ALARM_COLOUR, "dash": "dot"}
        figure.add_scatter(x=ends, y=[published.gap, published.gap], name=text, mode="lines", line=line)
    lay_out(figure, "", legend_y=-0.14)
    counted = {"dtick": 1} if begin < 10 else {}  # else plotly puts ticks between iterations
    figure.update_layout(
        xaxis={"title": {"text": "iteration"}, "anchor": "y2", "gridcolor": "#eeeeee", "zeroline": False, **counted},
        yaxis={**LOGARITHMIC, "title": {"text": "relative gap"}, "domain": [0.54, 1.0]},
        yaxis2={**LOGARITHMIC, "title": {"text": "relative residual"}, "domain": [0.0, 0.46]},
    )
    return figure


def _with_records(stages: Stages) -> list[tuple[str, History]]:
    run = [(name, history) for name, history in stages if len(history)]
    if not run:
        raise SettingError("no stage has a record; give histories of runs that took at least their start")
    return run


def _semilogy(axes: Axes, k: Array, values: Array, label: str, form: str, style: dict[str, object]) -> None:
    """Draw what a logarithmic axis can show: zeros, nan and inf are left out."""
    shown = np.isfinite(values) & (values > 0)
    if shown.any():
        axes.semilogy(k[shown], values[shown], form, label=label, **style)


def _mark(axes: Axes, published: PublishedRun, last: float) -> None:
    if published.gap <= 0:
        return
    text = f"paper's SOC: {published.gap:.1e} after {published.iterations}"
    if published.iterations <= _STAR_WITHIN * max(last, 1.0):
        axes.plot(published.iterations, published.gap, "*", color=ALARM_COLOUR, markersize=8, label=text)
    else:
        axes.axhline(published.gap, color=ALARM_COLOUR, linestyle=":", label=text)
