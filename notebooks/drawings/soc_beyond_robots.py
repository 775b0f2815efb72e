"""Pictures and the film of notebook 10, orthogonality constraints in other fields."""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from plotly.graph_objects import Figure

import pgo_models as pgo
from pgo_models.plots.style import COLOURS, QUIET_COLOUR

Array = NDArray[np.float64]

_INCHES = 7.2  # width of a figure
_LEVELS = 99  # of a mode in the film, on either side of zero
_FRAME: dict[str, object] = {  # an axis that is no more than the edge of a panel
    "ticks": "",
    "showticklabels": False,
    "showgrid": False,
    "zeroline": False,
    "showline": True,
    "mirror": True,
    "linecolor": QUIET_COLOUR,
    "fixedrange": True,
    "constrain": "domain",
}


def draw_modes(side: int, rows: Sequence[tuple[str, Array]]) -> None:
    """Draw four columns of matrices as fields on a square plate, one row of panels for a matrix."""
    _, panels = plt.subplots(
        len(rows), 4, figsize=(_INCHES, 1.95 * len(rows)), layout="constrained"
    )
    for row, (name, columns) in zip(panels, rows, strict=True):
        for k, panel in enumerate(row):
            field = columns[:, k].reshape(side, side)
            largest = np.abs(field).max()
            panel.imshow(field, cmap="RdBu", vmin=-largest, vmax=largest)
            panel.set_title(f"{name} {k + 1}", fontsize=9)
            panel.axis("off")


def film_of_modes(side: int, modes: Mapping[float, Array], shares: Sequence[float]) -> Figure:
    """Film of four modes on a plate, with a frame for each weight of the 1-norm."""
    weights = list(modes)
    frames = [
        [_heatmap(columns[:, k].reshape(side, side), k) for k in range(4)]
        for columns in modes.values()
    ]
    layout: dict[str, object] = {"height": 680, "margin": {"l": 10, "r": 10, "t": 40, "b": 20}}
    for k in range(4):
        below, right = divmod(k, 2)
        number = "" if k == 0 else k + 1
        layout[f"xaxis{number}"] = {
            **_FRAME,
            "range": [-0.5, side - 0.5],
            "domain": [0.51, 1.0] if right else [0.0, 0.49],
            "constraintoward": "left" if right else "right",
            "anchor": f"y{number}",
        }
        layout[f"yaxis{number}"] = {
            **_FRAME,
            "range": [side - 0.5, -0.5],
            "domain": [0.0, 0.49] if below else [0.51, 1.0],
            "constraintoward": "top" if below else "bottom",
            "anchor": f"x{number}",
            "scaleanchor": f"x{number}",
        }
    description = (
        f"Four orthonormal modes of a plate while the weight w of the 1-norm falls from "
        f"{weights[0]:g} to {weights[-1]:g}. They begin as small spots, which grow and wander into "
        f"the corners, and end as smooth waves over the whole plate; the share of them in the span "
        f"of the first four eigenvectors rises from {shares[0]:.0%} to {shares[-1]:.1%}."
    )
    return pgo.animate(
        frames,
        [f"w = {weight:g}" for weight in weights],
        layout=layout,
        title="Four compressed modes of a plate",
        description=description,
    )


def _heatmap(field: Array, k: int) -> dict[str, object]:
    """Trace of a field in panel k, as fractions of its largest value; bytes take little room."""
    number = "" if k == 0 else k + 1
    return {
        "type": "heatmap",
        "z": np.rint(_LEVELS * field / np.abs(field).max()).astype(np.int8),
        "zmin": -_LEVELS,
        "zmax": _LEVELS,
        "colorscale": "RdBu",
        "showscale": False,
        "hoverinfo": "skip",
        "xaxis": f"x{number}",
        "yaxis": f"y{number}",
    }


def draw_components(panels: Sequence[tuple[str, Array]]) -> None:
    """Draw the columns of matrices as strips of colour, one panel for a matrix."""
    _, axes = plt.subplots(
        1, len(panels), figsize=(_INCHES, 1.9), layout="constrained", sharey=True
    )
    for panel, (title, X) in zip(axes, panels, strict=True):
        panel.imshow(X.T, cmap="RdBu", vmin=-0.5, vmax=0.5, aspect="auto")
        panel.set(title=title, xlabel="sensor", yticks=range(X.shape[1]))
    axes[0].set_ylabel("component")


def draw_errors(
    nonzeros: Sequence[int], curves: Mapping[str, Sequence[float]], full: float
) -> None:
    """Draw relative errors over the number of nonzeros, above that of the full matrix."""
    _, axes = plt.subplots(figsize=(_INCHES, 3.2), layout="constrained")
    for (name, errors), marker, colour in zip(curves.items(), "os", COLOURS, strict=False):
        axes.plot(nonzeros, errors, f"{marker}-", label=name, color=colour)
    axes.axhline(full, color=QUIET_COLOUR, linestyle=":", label="SVD, all entries")
    axes.set(xlabel="nonzeros of B", ylabel="relative error")
    axes.legend(fontsize=8)


def draw_paths(paths: Array, decoded: Array) -> None:
    """Draw positions over time, (time, robots), and over them what was restored."""
    _, axes = plt.subplots(figsize=(_INCHES, 2.8), layout="constrained")
    axes.plot(paths, color=QUIET_COLOUR, linewidth=3.0)
    axes.plot(decoded, color=COLOURS[0], linewidth=1.0)
    axes.plot([], color=QUIET_COLOUR, linewidth=3.0, label="path")
    axes.plot([], color=COLOURS[0], linewidth=1.0, label="restored")
    axes.set(xlabel="time", ylabel="position")
    axes.legend(fontsize=8)
