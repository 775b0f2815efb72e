"""The cost of one edge less a handedness term, and the spectrum of S while terms are sought."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

import pgo_models as pgo
from pgo_models.geometry.rotations import Array
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, QUIET_COLOUR

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

Trace = dict[str, object]
# p, and the costs on the way along both axes: of rotations and towards mirror images
Setting = tuple[float, list[Array], list[Array]]

AXES_OF_EDGE = (("stiff axis", COLOURS[0]), ("another axis", COLOURS[1]))
GRID = {"gridcolor": "#eeeeee", "zerolinecolor": "#888888"}
NUM_EIGENVALUES = 8


def edge_film(settings: Sequence[Setting], angles: Array, shares: Array) -> Figure:
    """Slider over p: the cost of an edge less the term, for rotations above, for mirrors below."""
    frames = []
    labels = []
    fits = []
    for p, of_rotations, of_mirrors in settings:
        frames.append(
            [
                *_edge_curves(np.rad2deg(angles), of_rotations, ""),
                *_edge_curves(shares, of_mirrors, "2"),
            ]
        )
        is_valid = min(costs.min() for costs in of_rotations) > -1e-9
        is_enough = min(costs.min() for costs in of_mirrors) > -1e-9
        if is_valid and is_enough:
            fits.append(p)
        labels.append(f"p = {p:g}: {_verdict(is_valid, is_enough)}")
    description = (
        "The cost of one edge along a rotation about two axes, above, and on the way to the mirror "
        f"image, below, less a term of size p from {settings[0][0]:g} to {settings[-1][0]:g}. "
        f"For p from {min(fits):g} to {max(fits):g} no curve is below zero. Below that the mirror "
        "image in the stiff axis costs less than zero, above it a rotation about this axis does."
    )
    return pgo.animate(
        frames,
        labels,
        layout=_edge_axes(settings),
        title="rotations above, mirror images below",
        description=description,
    )


def _verdict(is_valid: bool, is_enough: bool) -> str:
    if is_valid and is_enough:
        return "no curve below zero"
    return "a mirror costs less than 0" if is_valid else "a rotation costs less than 0"


def _edge_curves(x: Array, costs: Sequence[Array], panel: str) -> list[Trace]:
    """Curves of both axes in one panel."""
    return [
        {
            "x": x.round(2).tolist(),
            "y": values.round(2).tolist(),
            "mode": "lines",
            "name": name,
            "line": {"color": colour, "width": 3},
            "xaxis": f"x{panel}",
            "yaxis": f"y{panel}",
            "showlegend": panel == "",
        }
        for values, (name, colour) in zip(costs, AXES_OF_EDGE, strict=True)
    ]


def _edge_axes(settings: Sequence[Setting]) -> dict[str, object]:
    """Two panels, one above the other, whose limits hold every setting."""
    every_rotation = np.concatenate([costs for _, costs, _ in settings])
    every_mirror = np.concatenate([costs for _, _, costs in settings])
    return {
        "height": 560,
        "margin": {"l": 50, "r": 12, "t": 40, "b": 20},
        "xaxis": {
            "anchor": "y",
            "range": [0.0, 180.0],
            "dtick": 45,
            "title": {"text": "rotation about the axis (degrees)", "standoff": 4},
        },
        "yaxis": {**GRID, "domain": [0.58, 1.0], "range": _limits(every_rotation)},
        "xaxis2": {
            "anchor": "y2",
            "range": [0.0, 1.0],
            "title": {"text": "share of the way to the mirror image", "standoff": 4},
        },
        "yaxis2": {**GRID, "domain": [0.0, 0.4], "range": _limits(every_mirror)},
        "legend": {"x": 0.02, "y": 1.0},
    }


def _limits(values: Array) -> list[float]:
    """Limits of an axis with some room around values."""
    room = 0.06 * float(np.ptp(values))
    return [round(float(values.min()) - room, 2), round(float(values.max()) + room, 2)]


def ascent_film(spectra: Sequence[Array]) -> Figure:
    """Film of the smallest eigenvalues of S without one pose, step by step."""
    frames = []
    labels = []
    lowest = [float(values[0]) for values in spectra]
    for k, values in enumerate(spectra):
        shown = values[:NUM_EIGENVALUES].round(4)
        colours = [ALARM_COLOUR if value < 0.0 else COLOURS[0] for value in shown]
        frames.append([_eigenvalues(shown, colours)])
        labels.append(f"step {k}: smallest eigenvalue {lowest[k]:.2g}")
    description = (
        f"The {NUM_EIGENVALUES} smallest eigenvalues of the certificate matrix in "
        f"{len(spectra)} steps. The smallest rises from {lowest[0]:.2g} to {lowest[-1]:.2g}: "
        "the matrix becomes positive definite."
    )
    every = np.concatenate([values[:NUM_EIGENVALUES] for values in spectra])
    return pgo.animate(
        frames,
        labels,
        still=[_start(spectra[0][:NUM_EIGENVALUES])],
        layout={
            "height": 420,
            "margin": {"l": 56, "r": 12, "t": 40, "b": 20},
            "xaxis": {
                "range": [0.4, NUM_EIGENVALUES + 0.6],
                "dtick": 1,
                "title": {"text": "k-th smallest eigenvalue", "standoff": 4},
            },
            "yaxis": {**GRID, "range": _limits(every), "title": {"text": "eigenvalue"}},
            "legend": {"x": 0.02, "y": 1.0},
        },
        title="S less the terms, one pose grounded",
        description=description,
    )


def _eigenvalues(values: Array, colours: list[str]) -> Trace:
    return {
        "x": list(range(1, len(values) + 1)),
        "y": values.tolist(),
        "mode": "markers",
        "name": "less the terms",
        "marker": {"color": colours, "size": 11},
    }


def _start(values: Array) -> Trace:
    """The eigenvalues before the first step, in every picture."""
    return {
        "x": list(range(1, len(values) + 1)),
        "y": values.round(4).tolist(),
        "mode": "markers",
        "name": "without terms",
        "marker": {"color": QUIET_COLOUR, "size": 11, "symbol": "circle-open"},
    }
