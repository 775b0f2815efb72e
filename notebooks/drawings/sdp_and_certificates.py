"""Films of proven bounds: closing in during a run, and opening again as the noise grows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

import pgo_models as pgo
from pgo_models.certificates.certificate import Certificate
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


def bounds_film(runs: Mapping[str, Sequence[Certificate]], optima: Mapping[str, float]) -> Figure:
    """Film of what is proven in every iterate of some runs: an interval that holds the optimum."""
    shares = {name: _shares(certificates, optima[name]) for name, certificates in runs.items()}
    num_iterates = len(next(iter(runs.values())))
    frames = []
    labels = []
    for k in range(num_iterates):
        frames.append(
            [
                trace
                for (name, (above, below)), colour in zip(shares.items(), COLOURS, strict=False)
                for trace in _interval(name, above[: k + 1], below[: k + 1], colour)
            ]
        )
        gaps = " and ".join(f"{certificates[k].gap:.0e}" for certificates in runs.values())
        labels.append(f"iteration {k}: gaps {gaps}")
    falls = "; ".join(
        f"{name} from {certificates[0].gap:.0e} to {certificates[-1].gap:.0e}"
        for name, certificates in runs.items()
    )
    description = (
        f"For every iteration from 0 to {num_iterates - 1} of SOC, an upper curve with the cost of "
        "the iterate and a lower one with the bound that is proven there, both relative to the "
        f"optimum, on a logarithmic scale on either side of zero. The gap falls: {falls}."
    )
    return pgo.animate(
        frames,
        labels,
        still=[_line_at_zero(num_iterates)],
        layout=_axes_of_shares(num_iterates),
        title="cost above, proven bound below the optimum",
        description=description,
    )


def _shares(certificates: Sequence[Certificate], optimum: float) -> tuple[Array, Array]:
    """How far costs are above the optimum and bounds below it, on the scale that is drawn."""
    above = np.array([certificate.objective for certificate in certificates]) / optimum - 1.0
    below = np.array([certificate.lower_bound for certificate in certificates]) / optimum - 1.0
    return _scaled(above), _scaled(below)


def _scaled(shares: Array) -> Array:
    """Decades by which a share is above `SMALLEST`, with the sign of the share."""
    decades = np.log10(np.maximum(np.abs(shares), SMALLEST) / SMALLEST)
    return np.asarray(np.sign(shares) * decades).round(2)


def _interval(name: str, above: Array, below: Array, colour: str) -> list[Trace]:
    """Curve of the bound, and that of the cost with the area between them."""
    iterations = list(range(len(above)))
    line = {
        "mode": "lines+markers",
        "line": {"color": colour, "width": 2},
        "marker": {"size": 4},
        "hoverinfo": "skip",
    }
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    area = {"fill": "tonexty", "fillcolor": f"rgba({red},{green},{blue},0.25)"}
    lower = {"x": iterations, "y": below.tolist(), "showlegend": False, **line}
    return [lower, {"x": iterations, "y": above.tolist(), "name": name, **line, **area}]


def _line_at_zero(num_iterates: int) -> Trace:
    return {
        "x": [0, num_iterates - 1],
        "y": [0.0, 0.0],
        "mode": "lines",
        "line": {"color": QUIET_COLOUR, "width": 1, "dash": "dot"},
        "showlegend": False,
        "hoverinfo": "skip",
    }


def _axes_of_shares(num_iterates: int) -> dict[str, object]:
    """Axes of the iteration and of shares, whose ticks are powers of ten with a sign."""
    heights = [power - np.log10(SMALLEST) for power in POWERS]
    ticks = [(-height, f"-1e{power}") for height, power in zip(heights, POWERS, strict=True)]
    ticks += [(height, f"1e{power}") for height, power in zip(heights, POWERS, strict=True)]
    ticks.append((0.0, "optimum"))
    highest = 1.1 * max(heights)
    return {
        "height": 470,
        "margin": {"l": 66, "r": 12, "t": 40, "b": 20},
        "xaxis": {
            "range": [-0.3, num_iterates - 0.7],
            "title": {"text": "iteration of SOC", "standoff": 5},
            "zeroline": False,
        },
        "yaxis": {
            "range": [-highest, highest],
            "tickvals": [height for height, _ in ticks],
            "ticktext": [text for _, text in ticks],
            "gridcolor": "#eeeeee",
            "zeroline": False,
        },
        "legend": LEGEND,
    }


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
    grid = {"gridcolor": "#eeeeee", "zeroline": False}
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
        "yaxis": {**grid, "domain": [0.58, 1.0], "range": [0.0, 1.08 * largest]},
        "xaxis2": {
            "anchor": "y2",
            "range": [min(degrees) - 3.0, max(degrees) + 3.0],
            "title": {"text": "rotation noise (degrees)", "standoff": 4},
            "zeroline": False,
        },
        "yaxis2": {
            **grid,
            "domain": [0.0, 0.4],
            "type": "log",
            "range": [-15.5, 0.0],
            "tickvals": [10.0**power for power in (-15, -10, -5, 0)],
            "ticktext": ["1e-15", "1e-10", "1e-5", "1"],
            "title": {"text": "proven gap"},
        },
    }
