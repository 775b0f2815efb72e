"""Lines and axes of films, as plotly takes them; several notebooks draw with these."""

from collections.abc import Sequence

import numpy as np

from pgo_models.geometry.rotations import Array

Trace = dict[str, object]
GRID: Trace = {"gridcolor": "#eeeeee", "zeroline": False}  # of an axis


def numbers(values: Sequence[float] | Array) -> list[float]:
    """Values with few digits, so that a film stays small."""
    return np.round(np.asarray(values, dtype=float), 3).tolist()


def line(
    x: Sequence[float] | Array,
    y: Sequence[float] | Array,
    colour: str,
    name: str,
    width: float = 2.0,
    axis: str = "x",
    dash: str = "solid",
) -> Trace:
    """A line, in the legend if it has a name."""
    return {
        "x": numbers(x),
        "y": numbers(y),
        "mode": "lines",
        "line": {"color": colour, "width": width, "dash": dash},
        "name": name,
        "showlegend": bool(name),
        "xaxis": axis,
        "yaxis": axis.replace("x", "y"),
        "hoverinfo": "skip",
    }
