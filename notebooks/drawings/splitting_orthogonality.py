"""Pictures of notebook 4: the flow chart, films on the circle of rotations, a slider over rho."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import matplotlib.pyplot as plt
import numpy as np

import pgo_models as pgo
from pgo_models.geometry.rotations import Array
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, QUIET_COLOUR

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

BLUE, ORANGE, GREEN = COLOURS[:3]
LEGEND_ABOVE = {"orientation": "h", "x": 0.0, "y": 1.0, "xanchor": "left", "yanchor": "bottom"}
REACH = 1.6  # of the plane that is shown
NOWHERE = np.full((1, 2), np.nan)  # keeps the place of a trace in the legend

Trace = dict[str, object]


class CircleStep(NamedTuple):
    """One iteration of SOC on the circle: what it began with, and what its three steps returned."""

    omega_before: Array
    B_before: Array
    R: Array
    omega: Array
    B: Array


def draw_flow_chart() -> None:
    """Draw the steps of Algorithm 1 in boxes, one below the other, with the loop beside them."""
    boxes = [
        ("start", "R = omega, B = 0, rho > 0"),
        ("(a)", "R: convex quadratic program,\npulled to omega - B"),
        ("(b)", "omega: nearest rotation to R + B,\nby one SVD a pose"),
        ("(c)", "B: add R - omega"),
        ("done?", "||R - omega|| small,\nomega moves no more"),
        ("then", "Gauss-Newton on all poses,\ncertificate"),
    ]
    _, axes = plt.subplots(figsize=(5.4, 3.9), layout="constrained")
    axes.set(xlim=(-1.0, 6.0), ylim=(-0.5, 5.5))
    axes.axis("off")
    centred = {"ha": "center", "va": "center", "fontsize": 8}
    for row, (name, text) in zip(range(5, -1, -1), boxes, strict=True):
        colour = "#FDE9D9" if name == "done?" else "#DCEBF7"
        box = {"boxstyle": "round,pad=0.45", "fc": colour}
        axes.text(3.0, row, text, bbox=box, **centred)
        axes.text(-0.9, row, name, va="center", fontsize=9, weight="bold")
        if row > 0:
            axes.annotate("", (3.0, row - 0.67), (3.0, row - 0.33), arrowprops={"arrowstyle": "->"})
    axes.text(3.15, 0.5, "yes", fontsize=8, va="center")
    axes.plot([4.1, 5.4, 5.4], [1.0, 1.0, 4.0], color="black", linewidth=0.9)
    axes.annotate("", (4.3, 4.0), (5.44, 4.0), arrowprops={"arrowstyle": "->"})
    axes.text(5.5, 2.5, "no: next k", fontsize=8, rotation=90, va="center")


def three_step_film(steps: Sequence[CircleStep], A: Array, middle: Array, optimum: Array) -> Figure:
    """Film of SOC on the circle with a picture for each of the three steps of an iteration."""
    frames, labels = [], []
    for k, step in enumerate(steps, start=1):
        target = step.omega_before - step.B_before
        frames.append(
            _picture(step.R, step.omega_before, pulled_to=target, way=[step.omega_before, step.R])
        )
        shifted = step.R + step.B_before
        frames.append(
            _picture(step.R, step.omega, arrow=[step.R, shifted], way=[shifted, step.omega])
        )
        frames.append(_picture(step.R, step.omega, arrow=[step.omega, step.omega + step.B]))
        labels += [f"k = {k} (a) R", f"k = {k} (b) omega", f"k = {k} (c) B"]
    last = steps[-1]
    description = (
        f"In step (a) R leaves the circle of rotations towards the middle of the level lines, in "
        f"step (b) omega returns to the circle, and in step (c) the arrow B becomes what (b) cut "
        f"off. After {len(steps)} iterations omega is within {_degrees(last.omega, optimum):.1f} "
        f"degrees of the optimum and R within {np.linalg.norm(last.R - last.omega):.2f} of omega."
    )
    return _circle_film(frames, labels, A, middle, optimum, description)


def runaway_film(steps: Sequence[CircleStep], A: Array, middle: Array, optimum: Array) -> Figure:
    """Film of SOC on the circle with a picture for each iteration, and the way that omega takes."""
    omegas = [steps[0].omega_before, *(step.omega for step in steps)]
    frames = [
        _picture(
            step.R,
            step.omega,
            arrow=[step.omega, step.omega + step.B],
            way=_along_circle(omegas[k], omegas[k + 1]),
            has_target=False,
        )
        for k, step in enumerate(steps)
    ]
    angles = [_degrees(step.omega, optimum) for step in steps]
    description = (
        f"With rho below the threshold omega comes within {min(angles):.1f} degrees of the optimum "
        f"in iteration {int(np.argmin(angles)) + 1}, and then jumps around the circle, up to "
        f"{max(angles):.0f} degrees away. After {len(steps)} iterations R and omega are still "
        f"{np.linalg.norm(steps[-1].R - steps[-1].omega):.1f} apart."
    )
    labels = [f"k = {k + 1}" for k in range(len(steps))]
    return _circle_film(frames, labels, A, middle, optimum, description)


def gap_slider(curves: Mapping[float, Array]) -> Figure:
    """Slider over rho: the gap of one run over the iterations, the others in grey behind it."""
    iterations = list(range(1, len(next(iter(curves.values()))) + 1))
    behind = [
        {**_gap_curve(iterations, gap, QUIET_COLOUR, 0.8), "opacity": 0.5, "showlegend": False}
        for gap in curves.values()
    ]
    frames = [
        [_gap_curve(iterations, gap, BLUE if gap[-1] < 1e-2 else ALARM_COLOUR, 3.0)]
        for gap in curves.values()
    ]
    fastest = min(curves, key=lambda factor: _first_below(curves[factor], 1e-8))
    lost = [factor for factor, gap in curves.items() if gap[-1] > 1e-2]
    return pgo.animate(
        frames,
        [f"rho = {factor:g} (lambda_1 + lambda_2)" for factor in curves],
        still=behind,
        layout={
            "xaxis": {"range": [0, len(iterations)], "title": {"text": "iteration", "standoff": 2}},
            "yaxis": {
                "type": "log",
                "range": [-14.3, 2.0],
                "dtick": 2,
                "exponentformat": "power",
                "title": {"text": "F(omega) / F* - 1"},
            },
            "showlegend": False,
            "height": 500,
            "margin": {"l": 65, "r": 10, "t": 20, "b": 20},
        },
        description=(
            f"The gap to the optimum over the iterations, for {len(curves)} values of rho. Up to "
            f"rho = {max(lost):g} (lambda_1 + lambda_2) the curve, drawn in red, does not come to "
            f"the optimum. With {fastest:g} it is the first below 1e-8, after "
            f"{_first_below(curves[fastest], 1e-8)} iterations, and with every larger rho it takes "
            f"longer."
        ),
    )


def _first_below(gap: Array, level: float) -> int:
    """Iteration from which on a gap stays below a level, or its length."""
    above = np.flatnonzero(gap >= level)
    return int(above[-1]) + 1 if len(above) else 0


def _gap_curve(iterations: list[int], gap: Array, colour: str, width: float) -> Trace:
    """Trace of a gap over the iterations."""
    return {
        "x": iterations,
        "y": [float(f"{value:.2e}") for value in gap],
        "mode": "lines",
        "line": {"color": colour, "width": width},
        "hoverinfo": "skip",
    }


def _circle_film(
    frames: Sequence[Sequence[Trace]],
    labels: Sequence[str],
    A: Array,
    middle: Array,
    optimum: Array,
    description: str,
) -> Figure:
    """Film over the circle and the level lines of the cost."""
    angles = np.linspace(0.0, 2.0 * np.pi, 73)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    root = np.linalg.inv(np.linalg.cholesky(A)).T
    ellipses = [
        np.vstack([middle + size * circle[::2] @ root.T, [[np.nan, np.nan]]])
        for size in (0.4, 0.8, 1.2, 1.6, 2.0)
    ]
    still = [
        {**_trace(np.vstack(ellipses), QUIET_COLOUR, "f = const"), "opacity": 0.6},
        _trace(circle, COLOURS[-1], "rotations", width=2.0),
        {
            **_trace(optimum[None], COLOURS[-1], "optimum", mode="markers"),
            "marker": {"symbol": "star-open", "size": 17, "color": COLOURS[-1]},
        },
    ]
    axis = {"range": [-REACH, REACH], "zeroline": False}
    return pgo.animate(
        frames,
        labels,
        still=still,
        layout={
            "xaxis": {**axis, "title": {"text": "cosine", "standoff": 2}},
            "yaxis": {**axis, "title": {"text": "sine"}, "scaleanchor": "x"},
            "legend": LEGEND_ABOVE,
            "margin": {"l": 45, "r": 10, "t": 75, "b": 20},
            "height": 580,
        },
        description=description,
    )


def _picture(
    R: Array,
    omega: Array,
    *,
    arrow: Sequence[Array] = (),
    pulled_to: Array | None = None,
    way: Sequence[Array] = (),
    has_target: bool = True,
) -> list[Trace]:
    """Traces of one picture, empty where there is nothing to see.

    `has_target` says whether the legend of the film explains what R is pulled to.
    """
    target = NOWHERE if pulled_to is None else pulled_to[None]
    tip = {"symbol": "arrow", "angleref": "previous", "size": [0, 13], "color": ORANGE}
    return [
        {**_trace(_rows(way), QUIET_COLOUR, "move", width=1.5), "showlegend": False},
        {
            **_trace(target, BLUE, "omega - B", mode="markers"),
            "marker": {"symbol": "circle-open", "size": 11, "color": BLUE},
            "showlegend": has_target,
        },
        {**_trace(_rows(arrow), ORANGE, "B", mode="lines+markers", width=3.0), "marker": tip},
        {
            **_trace(omega[None], GREEN, "omega", mode="markers"),
            "marker": {"symbol": "diamond", "size": 14, "color": GREEN},
        },
        {
            **_trace(R[None], BLUE, "R", mode="markers"),
            "marker": {"size": 11, "color": BLUE},
        },
    ]


def _rows(points: Sequence[Array]) -> Array:
    """Points below each other, (k, 2); nothing where there are none or all are the same."""
    rows = np.array(points) if len(points) else NOWHERE
    return rows if np.ptp(rows, axis=0).max() > 1e-6 else NOWHERE


def _along_circle(start: Array, end: Array) -> list[Array]:
    """Points on the shorter arc between two points of the circle, slightly outside it."""
    first = np.arctan2(start[1], start[0])
    turn = np.arctan2(start[0] * end[1] - start[1] * end[0], start @ end)
    angles = first + turn * np.linspace(0.0, 1.0, 13)
    return [1.06 * np.array([np.cos(angle), np.sin(angle)]) for angle in angles]


def _degrees(omega: Array, optimum: Array) -> float:
    """Angle between two points of the circle."""
    return float(np.rad2deg(np.arccos(np.clip(omega @ optimum, -1.0, 1.0))))


def _trace(points: Array, colour: str, name: str, mode: str = "lines", width: float = 1.0) -> Trace:
    """Trace through points, (k, 2), with a gap at nan."""
    rounded = np.round(points, 3)
    x, y = ([None if np.isnan(v) else float(v) for v in column] for column in rounded.T)
    return {
        "x": x,
        "y": y,
        "mode": mode,
        "line": {"color": colour, "width": width},
        "name": name,
        "hoverinfo": "skip",
    }
