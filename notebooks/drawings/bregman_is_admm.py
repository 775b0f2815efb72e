"""Pictures of notebook 3: counts over the penalty, the adaptive penalty, and a film of a spiral."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np

import pgo_models as pgo
from pgo_models.geometry.rotations import Array
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, MARKERS, QUIET_COLOUR

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

BLUE, ORANGE = COLOURS[:2]


def draw_counts(penalties: Sequence[float], counts: Mapping[int, Array]) -> None:
    """Draw outer iterations and passes over the blocks against the penalty, a curve for each T."""
    _, (left, right) = plt.subplots(1, 2, figsize=(7.5, 2.8), layout="constrained", sharey=True)
    for (passes, row), marker in zip(counts.items(), MARKERS, strict=False):
        left.loglog(penalties, row, f"{marker}-", label=f"T = {passes}")
        right.loglog(penalties, passes * row, f"{marker}-", label=f"T = {passes}")
    left.set_ylabel("until 1e-4")
    for axes, title in ((left, "outer iterations"), (right, "passes over the blocks")):
        axes.set_xlabel("penalty alpha")
        axes.set_title(title, fontsize=10)
    left.legend(fontsize=8)


def draw_residuals(residuals: Mapping[float, Array]) -> None:
    """Draw primal and dual residuals, (k, 2), over the iterations, a panel for each penalty."""
    _, panels = plt.subplots(
        1, len(residuals), figsize=(7.5, 2.6), layout="constrained", sharey=True
    )
    for axes, (penalty, pairs) in zip(panels, residuals.items(), strict=True):
        primal, dual = pairs.T
        axes.semilogy(primal, color=BLUE, label="primal")
        axes.semilogy(np.where(dual > 0, dual, np.nan), "--", color=ORANGE, label="dual")
        axes.set_title(f"alpha = {penalty:g}", fontsize=10)
        axes.set_xlabel("iteration")
    panels[0].set_ylabel("residual, T = 1")
    panels[0].set_ylim(1e-5, 10.0)
    panels[0].legend(fontsize=8)


def draw_adaptive(traces: Mapping[tuple[float, bool], Array], shown: int) -> None:
    """Draw penalty and larger residual of runs, (k, 2), over the first iterations of each."""
    figure, (top, bottom) = plt.subplots(
        2, 1, figsize=(6.0, 4.2), layout="constrained", sharex=True
    )
    for (mu, rescale), trace in traces.items():
        penalty, worst = trace[:shown].T
        style = {
            "color": BLUE if rescale else ALARM_COLOUR,
            "linestyle": "-" if mu > 5.0 else ":",
            "linewidth": 1.2,
        }
        label = f"mu = {mu:g}, b {'rescaled' if rescale else 'not rescaled'}"
        top.semilogy(penalty, label=label, **style)
        bottom.semilogy(worst, **style)
    bottom.axhline(1e-4, color=QUIET_COLOUR, linewidth=0.8)
    top.set_ylabel("alpha")
    bottom.set_ylabel("larger residual")
    bottom.set_xlabel("iteration")
    figure.legend(fontsize=8, ncols=2, loc="outside upper center")


def spiral_film(three_blocks: Array, two_blocks: Array, every: int) -> Figure:
    """Film of two paths in a plane, (k, 2) each, of which one leaves and the other arrives."""
    reach = 1.05 * float(np.abs(three_blocks).max())
    lengths = range(0, len(three_blocks), every)
    frames = [
        [
            *_path(three_blocks[: k + 1], ALARM_COLOUR, "three blocks"),
            *_path(two_blocks[: k + 1], BLUE, "two blocks"),
        ]
        for k in lengths
    ]
    start, three_end = np.linalg.norm(three_blocks[[0, -1]], axis=1)
    two_end = np.linalg.norm(two_blocks[-1])
    axis = {"range": [-reach, reach]}
    return pgo.animate(
        frames,
        [f"k = {k}" for k in lengths],
        still=[
            {
                "x": [0.0],
                "y": [0.0],
                "mode": "markers",
                "marker": {"symbol": "cross-thin-open", "size": 14, "color": COLOURS[-1]},
                "name": "solution",
            }
        ],
        layout={
            "xaxis": {**axis, "title": {"text": "x_1", "standoff": 2}},
            "yaxis": {**axis, "title": {"text": "multiplier b_1"}, "scaleanchor": "x"},
            "legend": {"orientation": "h", "x": 0.0, "y": 1.0, "yanchor": "bottom"},
            "margin": {"l": 45, "r": 10, "t": 50, "b": 20},
            "height": 560,
        },
        description=(
            f"Two paths start at a distance of {start:.0f} from the solution. With three blocks "
            f"the path spirals outwards, to {three_end:.0f} in {len(three_blocks) - 1} iterations; "
            f"with two blocks it turns inwards and spirals into the solution, to {two_end:.1g}."
        ),
    )


def _path(points: Array, colour: str, name: str) -> list[dict[str, object]]:
    """Traces of a path, (k, 2), and of its last point."""
    x, y = np.round(points, 2).T.tolist()
    return [
        {
            "x": x,
            "y": y,
            "mode": "lines",
            "line": {"color": colour, "width": 1.5},
            "name": name,
            "hoverinfo": "skip",
        },
        {
            "x": x[-1:],
            "y": y[-1:],
            "mode": "markers",
            "marker": {"color": colour, "size": 11},
            "showlegend": False,
        },
    ]
