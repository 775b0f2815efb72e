"""Figure and film of notebook 11: how machines approach the answer of one that has all data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np

import pgo_models as pgo
from drawings.traces import GRID, line
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, METHOD_COLOURS

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from plotly.graph_objects import Figure


def film_of_plans(
    plans: Sequence[NDArray[np.float64]],
    demand: NDArray[np.float64],
    central: NDArray[np.float64],
) -> Figure:
    """Film of the plans of all stations, (stations, hours) in each round, one above the other.

    The demand and the sum of the central plan stand in every picture.
    """
    num_stations, num_hours = plans[0].shape
    hours = list(range(num_hours))
    frames: list[list[dict[str, object]]] = []
    for k, plan in enumerate(plans):
        layers = [{"y": row.round(2).tolist()} for row in plan]
        if k == 0:
            for a, layer in enumerate(layers):
                opacity = 0.75 if a % 2 else 0.5  # so that neighbours can be told apart
                layer |= {
                    "x": hours,
                    "stackgroup": "plans",
                    "mode": "lines",
                    "line": {"width": 0.5, "color": COLOURS[0]},
                    "fillcolor": f"rgba(0,114,178,{opacity})",
                    "name": f"{num_stations} plans",
                    "showlegend": a == 0,
                    "hoverinfo": "skip",
                }
        frames.append(layers)
    still = [
        line(hours, demand.round(2), "#000000", "demand", dash="dot"),
        line(hours, central.sum(axis=0).round(2), ALARM_COLOUR, "central plan"),
    ]
    highest = 1.1 * float(max(demand.max(), *(plan.sum(axis=0).max() for plan in plans)))
    layout = {
        "height": 460,
        "xaxis": {**GRID, "range": [0, num_hours - 1], "title": {"text": "hour"}, "dtick": 6},
        "yaxis": {**GRID, "range": [0, highest], "title": {"text": "power, all stations"}},
        "legend": {"orientation": "h", "x": 0.0, "y": 1.02, "yanchor": "bottom"},
        "margin": {"l": 50, "r": 10, "t": 40, "b": 20},
    }
    distances = [float(np.abs(plan - central).max()) for plan in plans]
    description = (
        f"The plans of {num_stations} power stations for {num_hours} hours, one above the other: "
        f"in {len(plans) - 1} rounds their sum grows from nothing to that of the central plan, a "
        f"little below the demand; the largest difference of a plan falls from {distances[0]:.1g} "
        f"to {distances[-1]:.0e}."
    )
    labels = [f"round {k}" for k in range(len(plans))]
    return pgo.animate(frames, labels, still=still, layout=layout, description=description)


def draw_distances_and_prices(
    distances: Mapping[str, Sequence[float]],
    prices: NDArray[np.float64],
    multipliers: NDArray[np.float64],
) -> None:
    """Draw distances to central answers, and prices over the rounds with their limits dotted."""
    _, (left, right) = plt.subplots(1, 2, figsize=(7.5, 2.6), layout="constrained")
    for (name, values), colour in zip(distances.items(), METHOD_COLOURS, strict=False):
        left.semilogy(np.arange(1, len(values) + 1), values, label=name, color=colour)
    left.set(xlabel="round", ylabel="distance to the central answer")
    left.legend(fontsize=8)
    for good, (price, limit) in enumerate(zip(prices.T, multipliers, strict=True)):
        right.plot(np.arange(1, len(price) + 1), price, color=COLOURS[good])
        right.axhline(limit, linestyle=":", color=COLOURS[good])
    lowest, highest = multipliers.min() - 0.5, multipliers.max() + 0.5
    right.set(xlabel="round", ylabel="price", title="dotted: cvxpy's multiplier")
    right.set_ylim(min(lowest, prices.min() - 0.1), max(highest, prices.max() + 0.1))
