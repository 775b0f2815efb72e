"""Films of proven bounds: closing in during a run, and opening again as the noise grows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import pgo_models as pgo
from drawings.traces import GRID
from pgo_models.geometry.rotations import Array
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, QUIET_COLOUR

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

Trace = dict[str, object]
Level = tuple[float, Array, float]  # noise in degrees, eigenvalues of Z, gap

SMALLEST = 1e-15  # of a share that is drawn: what is below it is rounding
POWERS = (-12, -8, -4, 0)  # of ten, that the axis of shares names
NUM_EIGENVALUES = 6
LEGEND = {"x": 1.0, "xanchor": "right", "y": 1.0, "traceorder": "reversed"}


def noise_film(levels: Sequence[Level], d: int) -> Figure:
    """Slider over the noise: above the largest eigenvalues of Z, below the gap that is proven."""
    degrees = [noise for noise, _, _ in levels]
    gaps = [float(f"{max(gap, SMALLEST):.2e}") for _, _, gap in levels]
    ranks = [_rank(eigenvalues) for _, eigenvalues, _ in levels]
    frames = []
    labels = []
    for k, (noise, eigenvalues, gap) in enumerate(levels):
        frames.append([_bars(eigenvalues, d), _point(noise, gaps[k])])
        labels.append(f"{noise:g} degrees: rank of Z {ranks[k]}, gap {gap:.1e}")
    last_tight = max(noise for noise, rank in zip(degrees, ranks, strict=True) if rank == d)
    description = (
        f"The largest eigenvalues of Z and the proven gap of one graph, with {len(levels)} levels "
        f"of noise. Up to {last_tight:g} degrees {d} eigenvalues are not zero and the gap is only "
        f"rounding; at {degrees[-1]:g} degrees {ranks[-1]} are not zero, and the gap is "
        f"{gaps[-1]:.1%}."
    )
    return pgo.animate(
        frames,
        labels,
        still=[_gap_curve(degrees, gaps)],
        layout=_axes_of_noise(degrees, max(values[0] for _, values, _ in levels)),
        title="eigenvalues of Z, and the gap below them",
        description=description,
    )


def _rank(eigenvalues: Array) -> int:
    """Number of eigenvalues that are not zero to the accuracy of a solver."""
    return int((eigenvalues > 1e-4 * eigenvalues[0]).sum())


def _bars(eigenvalues: Array, d: int) -> Trace:
    """Bars of the largest eigenvalues, those beyond the first d in the colour of an alarm."""
    return {
        "type": "bar",
        "x": list(range(1, NUM_EIGENVALUES + 1)),
        "y": eigenvalues[:NUM_EIGENVALUES].round(2).tolist(),
        "marker": {"color": [COLOURS[0]] * d + [ALARM_COLOUR] * (NUM_EIGENVALUES - d)},
    }


def _gap_curve(degrees: Sequence[float], gaps: Sequence[float]) -> Trace:
    return {
        "x": list(degrees),
        "y": list(gaps),
        "mode": "lines+markers",
        "line": {"color": QUIET_COLOUR, "width": 2},
        "marker": {"size": 5},
        "xaxis": "x2",
        "yaxis": "y2",
    }


def _point(noise: float, gap: float) -> Trace:
    """The current level on the curve of the gap."""
    return {
        "x": [noise],
        "y": [gap],
        "mode": "markers",
        "marker": {"color": ALARM_COLOUR, "size": 12},
        "xaxis": "x2",
        "yaxis": "y2",
    }


def _axes_of_noise(degrees: Sequence[float], largest: float) -> dict[str, object]:
    """Two panels, one above the other."""
    return {
        "height": 540,
        "showlegend": False,
        "margin": {"l": 62, "r": 12, "t": 40, "b": 20},
        "xaxis": {
            "anchor": "y",
            "dtick": 1,
            "range": [0.4, NUM_EIGENVALUES + 0.6],
            "title": {"text": "k-th largest eigenvalue of Z", "standoff": 4},
        },
        "yaxis": {**GRID, "domain": [0.58, 1.0], "range": [0.0, 1.08 * largest]},
        "xaxis2": {
            "anchor": "y2",
            "range": [min(degrees) - 3.0, max(degrees) + 3.0],
            "title": {"text": "rotation noise (degrees)", "standoff": 4},
            "zeroline": False,
        },
        "yaxis2": {
            **GRID,
            "domain": [0.0, 0.4],
            "type": "log",
            "range": [-15.5, 0.0],
            "tickvals": [10.0**power for power in (-15, -10, -5, 0)],
            "ticktext": ["1e-15", "1e-10", "1e-5", "1"],
            "title": {"text": "proven gap"},
        },
    }
