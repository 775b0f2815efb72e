"""Films of notebook 2: a curve above its tangent, and level lines of the 1-norm that tilt."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

import pgo_models as pgo
from drawings.traces import line, numbers
from pgo_models.geometry.rotations import Array
from pgo_models.plots.style import COLOURS, QUIET_COLOUR

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

BLUE, ORANGE, GREEN, _, LIGHT_BLUE, BLACK = COLOURS
LEGEND_BELOW = {"orientation": "h", "x": 0.0, "y": 1.0, "xanchor": "left", "yanchor": "bottom"}
LEVELS = (0.3, 0.6, 0.9, 1.2)
FAR = 5000.0  # where a level line ends that has no end


def tangent_film(iterates: Array, slopes: Array, target: float, penalty: float) -> Figure:
    """Film of J(x) = exp(x) - x, its tangent at every iterate, and what the next step minimises."""
    grid = np.linspace(-0.8, 2.5, 45)
    curve = np.exp(grid) - grid
    at_target = np.exp(target) - target
    heights = np.exp(iterates) - iterates
    distances = at_target - heights - slopes * (target - iterates)
    frames = []
    for x, slope, height, distance in zip(iterates, slopes, heights, distances, strict=True):
        tangent = height + slope * (grid - x)
        next_cost = curve - tangent + 0.5 * penalty * (grid - target) ** 2
        frames.append(
            [
                line(grid, tangent, BLUE, "tangent"),
                line([target] * 2, [at_target - distance, at_target], ORANGE, "distance", 5),
                line(grid, next_cost, GREEN, "distance + penalty"),
                _points([x], [height], BLUE, "iterate", 11),
            ]
        )
    still = [
        line([target] * 2, [-1.0, 8.0], QUIET_COLOUR, "x = f", 1),
        line(grid, curve, BLACK, "J"),
    ]
    return pgo.animate(
        frames,
        [f"k = {k}" for k in range(len(frames))],
        still=still,
        layout={
            "xaxis": {
                "range": [-0.8, 2.5],
                "title": {"text": "x", "standoff": 2},
                "zeroline": False,
            },
            "yaxis": {"range": [-0.6, 8.0], "zeroline": False},
            "legend": LEGEND_BELOW,
            "margin": {"l": 35, "r": 10, "t": 70, "b": 20},
            "height": 520,
        },
        description=(
            f"The iterate climbs along the convex curve J from x = 0 to x = {iterates[-1]:.2f}, "
            f"next to the constraint x = {target:g}. Its tangent turns with it, and the height of "
            f"J above the tangent at the constraint, which is the Bregman distance, falls from "
            f"{distances[0]:.2f} to {distances[-1]:.4f}."
        ),
    )


def tilting_film(
    iterates: Array,
    subgradients: Array,
    row: Array,
    value: float,
    penalty_alone: Array,
) -> Figure:
    """Film of the level lines of the Bregman distance of the 1-norm, and the path in the plane."""
    frames = []
    for k, p in enumerate(subgradients):
        x, y = _level_lines(p)
        path = iterates[: k + 1]
        frames.append(
            [
                {**line([], [], LIGHT_BLUE, "distance = const", 1.5), "x": x, "y": y},
                {**_points(*path.T, BLUE, "iterates", 8), "mode": "lines+markers"},
                {**_points(*iterates[k : k + 1].T, BLUE, "now", 14), "showlegend": False},
            ]
        )
    ends = np.array([-2.0, 3.0])
    still = [
        line(ends, (value - row[0] * ends) / row[1], BLACK, "K x = f"),
        _points(*penalty_alone.T, ORANGE, "penalty alone", 9, "diamond"),
    ]
    return pgo.animate(
        frames,
        [f"k = {k}" for k in range(len(frames))],
        still=still,
        layout={
            "xaxis": {"range": [-1.2, 1.3], "title": {"text": "x_1", "standoff": 2}, "dtick": 0.5},
            "yaxis": {
                "range": [-0.8, 1.6],
                "title": {"text": "x_2"},
                "dtick": 0.5,
                "scaleanchor": "x",
            },
            "legend": LEGEND_BELOW,
            "margin": {"l": 45, "r": 10, "t": 70, "b": 20},
            "height": 560,
        },
        description=(
            "The level lines of the Bregman distance begin as squares on their tips and stretch "
            "along the second axis until they no longer close. The iterate stays at zero for "
            f"{np.count_nonzero(np.abs(iterates).max(axis=1) < 1e-3) - 1} steps, and is on the "
            f"constraint after {len(iterates) - 2}, beyond all "
            f"{len(penalty_alone)} solutions of the penalty alone."
        ),
    )


def _level_lines(p: Array) -> tuple[list[float | None], list[float | None]]:
    """Corners of |x_1| + |x_2| - p @ x = level for every level, with a gap after each line."""
    x: list[float | None] = []
    y: list[float | None] = []
    for level in LEVELS:
        right, up = np.minimum(level / np.maximum(1.0 - p, 1e-6), FAR)
        left, down = -np.minimum(level / np.maximum(1.0 + p, 1e-6), FAR)
        x += [*numbers(np.array([right, 0.0, left, 0.0, right])), None]
        y += [*numbers(np.array([0.0, up, 0.0, down, 0.0])), None]
    return x, y


def _points(
    x: Sequence[float] | Array,
    y: Sequence[float] | Array,
    colour: str,
    name: str,
    size: float,
    symbol: str = "circle",
) -> dict[str, object]:
    """Return a plotly trace of markers."""
    return {
        "x": numbers(x),
        "y": numbers(y),
        "mode": "markers",
        "marker": {"color": colour, "size": size, "symbol": symbol},
        "line": {"color": colour, "width": 1.5},
        "name": name,
    }
