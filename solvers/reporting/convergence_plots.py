"""Figures of a run: residuals and gap over the iterations, beside the gap of the paper."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np

from pgo_models.certificates.certificate import relative_gap
from pgo_models.errors import SettingError
from pgo_models.figures import rounded_up
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.published_results import PublishedRun
from pgo_models.plots.interactive_plots import lay_out
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, plotly
from solvers.result import History

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

Stages = Sequence[tuple[str, History]]
# Settings of an axis of plotly.
LOGARITHMIC = {"type": "log", "exponentformat": "power", "gridcolor": "#eeeeee", "zeroline": False}


class Effort(enum.Enum):
    """Effort over which methods are compared; the value is the label of the axis."""

    ROUNDS = "communication rounds"
    BYTES = "communication (bytes)"
    SECONDS = "time in steps (s)"


@dataclass(frozen=True, eq=False)
class Curve:
    """A run to be compared: its history, the bound for its gap, and its effort."""

    name: str
    history: History
    lower_bound: float  # proven for the graph, or the best value known
    # Communication up to every record, (len(history),).
    rounds: Array | None = None
    num_bytes: Array | None = None
    place: int | None = None  # number of its colour; its position in the figure unless given

    @property
    def gap(self) -> Array:
        """(objective - lower_bound) / objective of every record."""
        gaps = [relative_gap(cost, self.lower_bound) for cost in self.history.objective]
        return np.array(gaps)

    def effort(self, effort: Effort) -> Array | None:
        """Effort up to every record, (len(history),); None where it was not counted."""
        efforts = {
            Effort.ROUNDS: self.rounds,
            Effort.BYTES: self.num_bytes,
            Effort.SECONDS: self.history.seconds,
        }
        return efforts[effort]


def explore_convergence(
    stages: Stages, lower_bound: float, published: PublishedRun | None = None
) -> Figure:
    """Plotly figure of the gap (F - lower_bound) / F over iterations, and of residuals below.

    Stages are for example `[(stage.name, stage.history) for stage in solution.stages]`; each of
    them begins where the one before ends. A published gap is a line that names its iterations.
    Values are shown under the pointer. Raises a SettingError if no stage has a record.
    """
    run = _with_records(stages)
    begin = 0.0
    figure = plotly("graph_objects").Figure()
    for (name, history), colour in zip(run, cycle(COLOURS), strict=False):
        k = begin + history.k
        gap = Curve(name, history, lower_bound).gap
        for values, what, axis, dash, symbol in (
            (gap, "gap", "y", "solid", "circle"),
            (history.primal_residual, "primal residual", "y2", "solid", "square"),
            (history.dual_residual, "dual residual", "y2", "dash", "diamond"),
        ):
            is_visible = np.isfinite(values) & (values > 0)
            if is_visible.any():
                figure.add_scatter(
                    x=k[is_visible].tolist(),
                    y=[float(rounded_up(value, 5)) for value in values[is_visible]],
                    name=f"{name}: {what}",
                    yaxis=axis,
                    line={"color": colour, "dash": dash},
                    marker={"symbol": symbol, "size": 6},
                    mode="lines+markers",
                )
        begin = float(k[-1])
    if published is not None and published.gap > 0:
        figure.add_scatter(
            x=[0.0, max(begin, 1.0)],
            y=[published.gap, published.gap],
            name=f"paper's SOC: {published.gap:.1e} after {published.iterations} iterations",
            mode="lines",
            line={"color": ALARM_COLOUR, "dash": "dot"},
        )
    lay_out(figure, "", legend_y=-0.14)
    # Without this plotly would put ticks between few iterations.
    ticks = {"dtick": 1} if begin < 10 else {}
    figure.update_layout(
        xaxis={
            "title": {"text": "iteration"},
            "anchor": "y2",
            "gridcolor": "#eeeeee",
            "zeroline": False,
            **ticks,
        },
        yaxis={**LOGARITHMIC, "title": {"text": "relative gap"}, "domain": [0.54, 1.0]},
        yaxis2={**LOGARITHMIC, "title": {"text": "relative residual"}, "domain": [0.0, 0.46]},
    )
    return figure


def _with_records(stages: Stages) -> list[tuple[str, History]]:
    """Stages that have a record; a SettingError if there is none."""
    run = [(name, history) for name, history in stages if len(history)]
    if not run:
        raise SettingError(
            "no stage has a record; give histories of runs that took at least their start"
        )
    return run
