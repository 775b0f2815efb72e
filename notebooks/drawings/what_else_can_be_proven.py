"""Picture, film and slider of notebook 10: how equations close a relaxation, and under noise."""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from plotly.graph_objects import Figure

import pgo_models as pgo
from drawings.traces import GRID, Trace
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, QUIET_COLOUR

Array = NDArray[np.float64]

_LEGEND = {"orientation": "h", "x": 0.0, "y": 1.02, "yanchor": "bottom"}
_MARGIN = {"l": 58, "r": 12, "t": 70, "b": 20}


def draw_bounds(bounds: Mapping[str, float], costs: Sequence[float]) -> None:
    """Draw what each relaxation rules out as a bar, and below them the costs at which runs end."""
    _, panel = plt.subplots(figsize=(7.2, 2.3), layout="constrained")
    names = list(bounds)
    panel.barh(names, list(bounds.values()), color=COLOURS[1], height=0.5)
    panel.axvline(min(costs), color=COLOURS[0], linestyle="--", linewidth=1.5)
    panel.scatter(costs, ["runs end at"] * len(costs), color=COLOURS[0], zorder=3)
    panel.set_xlim(0.0, 1.05 * max(costs))
    panel.set_xlabel("cost; bars: what no rotation can have")
    panel.invert_yaxis()


def film_of_constraints(
    groups: Sequence[tuple[str, int]], bounds: Array, spectra: Array, least: float
) -> Figure:
    """Film of a bound with one equation more a frame, and of the eigenvalues of Z below it."""
    names = [name for name, number in groups for _ in range(number)]
    labels = ["no equation: the bound is 0"]
    for k, name in enumerate(names, start=1):
        labels.append(f"{k}, {name}: the bound is {max(bounds[k], 0.0) / least:.1%} of J")
    frames: list[list[Trace]] = []
    for k in range(len(bounds)):
        is_one = spectra[k, 1] < 1e-4 * spectra[k, 0]
        curve = {
            "x": list(range(k + 1)),
            "y": bounds[: k + 1].round(4).tolist(),
            "mode": "lines+markers",
            "line": {"color": COLOURS[1], "width": 3},
            "name": "bound",
        }
        bars = {
            "type": "bar",
            "x": list(range(1, spectra.shape[1] + 1)),
            "y": (spectra[k] / spectra[k].sum()).round(4).tolist(),
            "marker": {"color": COLOURS[2] if is_one else ALARM_COLOUR},
            "showlegend": False,
            "xaxis": "x2",
            "yaxis": "y2",
        }
        frames.append([curve, bars])
    last = len(bounds) - 1
    still: list[Trace] = [
        {
            "x": [-0.5, last + 0.5],
            "y": [round(least, 4)] * 2,
            "mode": "lines",
            "line": {"color": COLOURS[0], "width": 2, "dash": "dash"},
            "name": "J of the best rotation found",
        }
    ]
    ends = np.cumsum([number for _, number in groups])
    for end in ends[:-1]:
        still.append(
            {
                "x": [end + 0.5] * 2,
                "y": [0.0, 1.1 * least],
                "mode": "lines",
                "line": {"color": QUIET_COLOUR, "width": 1},
                "showlegend": False,
            }
        )
    heads = [
        {
            "x": float(end - number / 2 + 0.5),
            "y": 1.16 * least,
            "text": name,
            "showarrow": False,
            "font": {"size": 12},
        }
        for (name, number), end in zip(groups, ends, strict=True)
    ]
    description = (
        "A lower bound, and the shares of the eigenvalues of Z, while equations are added one by "
        f"one. The bound rises from 0 to {bounds[ends[1]] / least:.0%} of the cost with all "
        f"{ends[1]} equations of orthonormality, where several eigenvalues are not zero, and to "
        f"{bounds[-1] / least:.1%} with those of handedness, where one eigenvalue is left."
    )
    return pgo.animate(
        frames,
        labels,
        still=still,
        title="A bound that closes in as equations are added",
        description=description,
        layout={
            "height": 620,
            "legend": _LEGEND,
            "margin": _MARGIN,
            "annotations": heads,
            "xaxis": {
                **GRID,
                "range": [-0.5, last + 0.5],
                "title": {"text": "number of equations", "standoff": 4},
            },
            "yaxis": {
                **GRID,
                "range": [-0.02 * least, 1.22 * least],
                "domain": [0.46, 1.0],
                "title": {"text": "cost"},
            },
            "xaxis2": {
                "anchor": "y2",
                "dtick": 1,
                "title": {"text": "k-th largest eigenvalue of Z", "standoff": 4},
            },
            "yaxis2": {
                **GRID,
                "anchor": "x2",
                "domain": [0.0, 0.3],
                "range": [0.0, 1.05],
                "title": {"text": "share"},
                "tickformat": ".0%",
            },
        },
    )


def slider_of_noise(gaps: Mapping[float, Mapping[str, Array]]) -> Figure:
    """Slider over the noise: the gaps of several draws, a row of dots for every relaxation."""
    frames: list[list[Trace]] = []
    labels = []
    for noise, by_relaxation in gaps.items():
        traces: list[Trace] = []
        for place, (name, values) in enumerate(by_relaxation.items()):
            traces.append(
                {
                    "x": list(range(1, len(values) + 1)),
                    "y": np.sort(np.maximum(values, 0.0)).round(4).tolist(),
                    "mode": "lines+markers",
                    "line": {"color": COLOURS[place + 1], "width": 2},
                    "marker": {"size": 9},
                    "name": name,
                }
            )
        frames.append(traces)
        open_ones = [int((values > 1e-3).sum()) for values in by_relaxation.values()]
        counts = [
            f"{count} with {name}" for name, count in zip(by_relaxation, open_ones, strict=True)
        ]
        labels.append(f"noise {noise:.0%}: of {len(values)} open {', '.join(counts)}")
    names = list(gaps[max(gaps)])
    worst = gaps[max(gaps)]
    description = (
        f"Gaps of {len(worst[names[0]])} draws, sorted, while the noise grows from {min(gaps):.0%} "
        f"to {max(gaps):.0%} of the scene. With {names[0]} the mean gap at the most noise is "
        f"{worst[names[0]].mean():.0%}; with {names[1]} it is {worst[names[1]].mean():.1%}."
    )
    return pgo.animate(
        frames,
        labels,
        title="What noise does to both relaxations",
        description=description,
        layout={
            "height": 430,
            "legend": _LEGEND,
            "margin": _MARGIN,
            "xaxis": {**GRID, "title": {"text": "draw, from the smallest gap", "standoff": 4}},
            "yaxis": {
                **GRID,
                "range": [-0.03, 1.03],
                "tickformat": ".0%",
                "title": {"text": "gap"},
            },
        },
    )
