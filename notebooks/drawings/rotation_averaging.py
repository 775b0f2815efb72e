"""Pictures of notebook 15: rotations in the plane as arrows, and what noise does to eigenvalues."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

import pgo_models as pgo
from pgo_models.geometry.rotations import Array
from pgo_models.plots.films import frames_to_show
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, QUIET_COLOUR

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture
    from plotly.graph_objects import Figure

Trace = dict[str, object]

_LENGTH = 0.22  # of an arrow; the poses stand on the unit circle
_MOST_FRAMES = 16


def film_of_arrows(
    graph: pgo.PoseGraph, iterates: Sequence[Array], costs: Sequence[float], wanted: Array
) -> Figure:
    """Film of rotations in the plane, (n, 2, 2) each, as arrows at poses on a circle.

    The iterates are turned as a whole so that the last one is as close as possible to the `wanted`
    rotations, which are drawn in grey.
    """
    n = graph.num_poses
    around = 2 * np.pi * np.arange(n) / n
    places = np.column_stack([np.cos(around), np.sin(around)])
    common = pgo.project_to_rotations(np.sum(wanted @ np.swapaxes(iterates[-1], 1, 2), axis=0))
    shown = frames_to_show(len(iterates), _MOST_FRAMES)
    frames: list[list[Trace]] = [
        [_arrows(places, common @ iterates[k], COLOURS[0], 2.5, "rotations")] for k in shown
    ]
    edges = np.stack([places[graph.i], places[graph.j], np.full((graph.num_edges, 2), np.nan)], 1)
    still = [
        _polyline(edges.reshape(-1, 2), "#dddddd", 1.0, "measured pairs"),
        _arrows(places, wanted, QUIET_COLOUR, 1.5, "what is sought"),
    ]
    turns = common @ iterates[-1] @ np.swapaxes(wanted, 1, 2)
    away = np.rad2deg(np.abs(pgo.log_map(turns))).max()
    description = (
        f"{n} arrows on a circle, one for the rotation of every pose, turn from sweep to sweep. "
        f"The cost falls from {costs[0]:.3g} to {costs[-1]:.3g} in {len(iterates) - 1} sweeps, and "
        f"in the end the worst arrow is {away:.0f} degrees away from the one that is sought."
    )
    axis = {"range": [-1.35, 1.35], "visible": False}
    return pgo.animate(
        frames,
        [f"sweep {k}: F = {costs[k]:.4g}" for k in shown],
        still=still,
        title="Rotations from sweep to sweep",
        description=description,
        layout={
            "height": 560,
            "xaxis": axis,
            "yaxis": {**axis, "scaleanchor": "x"},
            "legend": {"orientation": "h", "x": 0.0, "y": 1.01, "yanchor": "bottom"},
            "margin": {"l": 10, "r": 10, "t": 80, "b": 20},
        },
    )


def plot_noise(degrees: Array, smallest_of_L: Array, next_of_S: Array, certified: Array) -> Picture:
    """Eigenvalues of L and of S, and the share of graphs with a certificate, for growing noise."""
    import matplotlib.pyplot as plt

    figure, (upper, lower) = plt.subplots(2, 1, figsize=(5.2, 5.0), sharex=True)
    d = smallest_of_L.shape[1] - 1
    upper.plot(degrees, smallest_of_L[:, :d], color=COLOURS[0])
    upper.plot(degrees, smallest_of_L[:, d], color=COLOURS[1])
    upper.plot([], [], color=COLOURS[0], label=f"the {d} smallest of L")
    upper.plot([], [], color=COLOURS[1], label="the next one of L")
    upper.plot(degrees, next_of_S, color=COLOURS[2], label=f"smallest of S but for {d} zeros")
    upper.axhline(0.0, color=QUIET_COLOUR, linewidth=0.8)
    upper.set_ylabel("eigenvalue")
    upper.legend(fontsize="small", frameon=False)
    lower.plot(degrees, certified, "o-", color=ALARM_COLOUR, markersize=4)
    lower.set_ylabel("share certified")
    lower.set_xlabel("noise of a measured rotation (degrees)")
    figure.tight_layout()
    return figure


def _arrows(places: Array, R: Array, colour: str, width: float, name: str) -> Trace:
    """Arrows at places, (n, 2), along the first axes of rotations, with heads, as one line."""
    along = _LENGTH * R[:, :, 0]
    across = _LENGTH * R[:, :, 1]
    tip = places + along
    left = tip - 0.35 * along + 0.2 * across
    right = tip - 0.35 * along - 0.2 * across
    gap = np.full_like(tip, np.nan)
    points = np.stack([places, tip, left, tip, right, gap], axis=1)
    return _polyline(points.reshape(-1, 2), colour, width, name)


def _polyline(points: Array, colour: str, width: float, name: str) -> Trace:
    """A line through points, (m, 2), with gaps at nan."""
    x, y = (
        [None if np.isnan(value) else round(float(value), 3) for value in column]
        for column in points.T
    )
    return {
        "x": x,
        "y": y,
        "type": "scatter",
        "mode": "lines",
        "line": {"color": colour, "width": width},
        "name": name,
        "hoverinfo": "skip",
    }
