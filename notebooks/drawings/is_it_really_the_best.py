"""Films of notebook 14: a bound that rises to the least cost, and the way between two answers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

import pgo_models as pgo
from drawings.traces import GRID, Trace, line
from pgo_models.geometry.rotations import Array
from pgo_models.plots.films import GraphFrames
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, QUIET_COLOUR

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

_FIRST_ANGLE = -20.0  # degrees: what the curve shows
_LAST_ANGLE = 180.0


def film_of_multipliers(
    angles: Array,
    weights: Array,
    cost: Callable[[Array], Array],
    multipliers: Sequence[float],
    cheapest_points: Array,
    bounds: Array,
) -> Figure:
    """Film of the bound for every multiplier, above the plane in which its cheapest point moves."""
    theta = np.linspace(_FIRST_ANGLE, _LAST_ANGLE, 61)
    costs = cost(np.deg2rad(theta))
    labels = [
        f"lambda = {lam:.2f}: none costs less than {bound:.2f}"
        for lam, bound in zip(multipliers, bounds, strict=True)
    ]
    frames: list[list[Trace]] = [
        [
            line([_FIRST_ANGLE, _LAST_ANGLE], [bound, bound], COLOURS[1], "lower bound", width=3),
            _dot(point, COLOURS[1]),
        ]
        for point, bound in zip(cheapest_points.round(3), bounds.round(3), strict=True)
    ]
    arrows = [
        line([0, np.cos(a).round(3)], [0, np.sin(a).round(3)], QUIET_COLOUR, "", 1.5 * w, "x2")
        for a, w in zip(angles, weights, strict=True)
    ]
    around = np.linspace(0.0, 2 * np.pi, 61)
    still = [
        line(theta, costs.round(3), COLOURS[0], "cost F of the answer"),
        line(np.cos(around).round(3), np.sin(around).round(3), COLOURS[0], "", 2, "x2"),
        *arrows,
    ]
    best = int(np.argmax(bounds))
    description = (
        f"Above, the cost of the angles around the best one and a horizontal line below it, "
        f"the lower bound. Below, the point of the plane that the bound is computed at. With "
        f"growing lambda the line rises from {bounds[0]:.2f} to {bounds[best]:.2f}, where it "
        f"touches the curve and the point reaches the circle, and then falls to {bounds[-1]:.2f}."
    )
    return pgo.animate(
        frames,
        labels,
        still=still,
        title="A lower bound and its multiplier",
        description=description,
        layout={
            "height": 640,
            "legend": {"orientation": "h", "x": 0.0, "y": 1.02, "yanchor": "bottom"},
            "margin": {"l": 50, "r": 10, "t": 80, "b": 20},
            "xaxis": _axis([_FIRST_ANGLE, _LAST_ANGLE], "angle of the answer (degrees)"),
            "yaxis": {**_axis([0, 1.05 * costs.max()], "cost"), "domain": [0.58, 1.0]},
            "xaxis2": {**_axis([-1.9, 1.9], ""), "anchor": "y2"},
            "yaxis2": {
                **_axis([-1.25, 1.75], ""),
                "anchor": "x2",
                "domain": [0.0, 0.42],
                "scaleanchor": "x2",
            },
        },
    )


def film_of_the_way(
    graph: pgo.PoseGraph,
    candidates: Sequence[pgo.Poses],
    shares: Array,
    costs: Array,
    lower_bound: float,
) -> Figure:
    """Film of a graph on the way from one answer to another, with cost and bound below it."""
    drawn = GraphFrames.of(graph, candidates)
    labels = [
        f"{share:.0%} of the way: F = {objective:.1f}, gap {1 - lower_bound / objective:.2f}"
        for share, objective in zip(shares, costs, strict=True)
    ]
    frames: list[list[Trace]] = [
        [
            *({**trace, "showlegend": False} for trace in drawn.traces(k)),
            line([share, share], [lower_bound, objective], ALARM_COLOUR, "", 3, "x2"),
            _dot((share, objective), COLOURS[0]),
        ]
        for k, (share, objective) in enumerate(zip(shares, costs.round(2), strict=True))
    ]
    bound = round(lower_bound, 2)
    still = [
        line(shares, costs.round(2), COLOURS[0], "cost F", 2, "x2"),
        line([0, 1], [bound, bound], COLOURS[1], "lower bound", 2, "x2"),
    ]
    highest = float(costs.max())
    description = (
        f"The poses of {graph.name} move from the answer, whose cost is {costs[0]:.1f}, to the "
        f"best poses, whose cost is {costs[-1]:.1f}. On the way the cost first rises to "
        f"{highest:.1f}. The lower bound, {lower_bound:.1f}, is the same everywhere."
    )
    layout: dict[str, Any] = drawn.layout()
    for name in ("xaxis", "yaxis"):
        layout[name] = {**layout[name], "title": {"text": ""}}
    return pgo.animate(
        frames,
        labels,
        still=still,
        title="From one answer to another",
        description=description,
        layout={
            **layout,
            "height": 680,
            "legend": {"orientation": "h", "x": 0.0, "y": 1.01, "yanchor": "bottom"},
            "margin": {"l": 50, "r": 10, "t": 80, "b": 20},
            "yaxis": {**layout["yaxis"], "domain": [0.42, 1.0]},
            "xaxis2": {**_axis([-0.03, 1.03], ""), "anchor": "y2"},
            "yaxis2": {**_axis([0, 1.08 * highest], "F"), "anchor": "x2", "domain": [0.0, 0.32]},
        },
    )


def _axis(limits: Sequence[float], title: str, **properties: object) -> dict[str, object]:
    """Axis with a fixed range."""
    return {**GRID, "range": list(limits), "title": {"text": title}, **properties}


def _dot(point: Sequence[float] | Array, colour: str) -> Trace:
    """A large dot in the second panel."""
    x, y = np.asarray(point, dtype=float).tolist()
    return {
        "x": [x],
        "y": [y],
        "type": "scatter",
        "mode": "markers",
        "marker": {"color": colour, "size": 13},
        "showlegend": False,
        "xaxis": "x2",
        "yaxis": "y2",
        "hoverinfo": "skip",
    }
