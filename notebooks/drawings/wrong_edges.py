"""Maps with right and wrong closures, the weights of closures by iteration, and a shifted run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np

import pgo_models as pgo
import solvers
from drawings.traces import GRID
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, QUIET_COLOUR
from solvers.robust.consistency import odometry

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

Trace = dict[str, object]
Panel = tuple[str, PoseGraph, Poses, BoolArray]
Step = tuple[float, Array, Array, Poses]  # mu, r^2 / c^2 and weights of the closures, poses

ODOMETRY_COLOUR = COLOURS[0]
RIGHT_COLOUR = "#666666"
# Weights above these limits are drawn with these opacities; a weight of zero is hardly visible.
OPACITIES = ((0.75, 1.0), (0.35, 0.6), (0.0, 0.3), (-1.0, 0.08))
RATIOS = (-1.7, 2.2)  # of the axis of r / c, as powers of ten


def draw_maps(panels: Sequence[Panel], truth: Poses) -> None:
    """Draw maps side by side: odometry blue, closures grey, wrong ones vermilion."""
    size = (2.6 * len(panels), 2.6)
    columns = plt.subplots(1, len(panels), figsize=size, layout="constrained", squeeze=False)[1][0]
    for axes, (title, graph, poses, is_wrong) in zip(columns, panels, strict=True):
        t = poses.aligned_to(truth).t
        is_known = odometry(graph)
        for e in range(graph.num_edges):
            colour = ODOMETRY_COLOUR if is_known[e] else QUIET_COLOUR
            style = "-"
            if is_wrong[e]:
                colour = ALARM_COLOUR
                style = "o-"
            ends = t[[graph.i[e], graph.j[e]]]
            axes.plot(*ends.T, style, color=colour, markersize=3, lw=1.2)
        metres = pgo.absolute_trajectory_error(poses, truth)
        axes.set_title(f"{title}, {metres:.2f} m off", fontsize=8)
        axes.set_aspect("equal")
        axes.tick_params(labelsize=6)


def draw_surrogates(values: Sequence[float]) -> None:
    """Draw the surrogate of the truncated cost for values of mu, and the square beside it."""
    _, axes = plt.subplots(figsize=(3.6, 2.4), layout="constrained")
    r = np.linspace(0.0, 3.0, 200)
    for mu in values:
        axes.plot(r, solvers.RobustLoss.TRUNCATED.surrogate(r**2, mu), label=f"mu = {mu:g}")
    axes.plot(r, r**2, ":", color=QUIET_COLOUR, label="least squares")
    axes.set(xlabel="r / c", ylabel="surrogate / c^2", ylim=(0.0, 3.0))
    axes.legend(fontsize=7)


def weights_film(graph: PoseGraph, steps: Sequence[Step], is_wrong: BoolArray) -> Figure:
    """Film of GNC: above the map, whose closures fade with their weights, below the weights."""
    is_closure = ~odometry(graph)
    is_bad = is_wrong[is_closure]
    frames = []
    labels = []
    places = [poses.aligned_to(steps[-1][3]).t for _, _, _, poses in steps]
    for k, (mu, ratio, weights, _) in enumerate(steps):
        labels.append(f"solve {k + 1}, mu = {mu:.2g}")
        above = _map_traces(graph, places[k], weights, is_bad)
        frames.append([*above, _weight_curve(mu), *_weight_points(ratio, weights, is_bad)])
    first, last = steps[0][2], steps[-1][2]
    num_right = int((last[~is_bad] == 1.0).sum())
    num_wrong = int((last[is_bad] == 0.0).sum())
    description = (
        f"The map of {graph.num_poses} poses and, below it, a point for each of {len(is_bad)} "
        f"closures with its residual and its weight, in {len(steps)} solves. At first every weight "
        f"is at most {first.max():.2f}. At the end the weight of {num_right} right closures is 1; "
        f"that of the wrong ones, in vermilion, is 0 ({num_wrong} of {int(is_bad.sum())}), and "
        "their edges have faded from the map."
    )
    layout = _two_panels(np.concatenate(places))
    return pgo.animate(_changes(frames), labels, layout=layout, description=description)


def _changes(frames: Sequence[Sequence[Trace]]) -> list[list[Trace]]:
    """The first frame, and of the others what changes, which plotly puts into the first."""
    first, *others = frames
    changing = [[{name: trace[name] for name in ("x", "y")} for trace in frame] for frame in others]
    return [list(first), *changing]


def _map_traces(graph: PoseGraph, t: Array, weights: Array, is_bad: BoolArray) -> list[Trace]:
    """Odometry, and the closures of each kind in four opacities."""
    is_known = odometry(graph)
    closures = np.flatnonzero(~is_known)
    traces = [_lines(graph, t, np.flatnonzero(is_known), ODOMETRY_COLOUR, 1.0, 1.2)]
    for chosen, colour, width in ((~is_bad, RIGHT_COLOUR, 1.5), (is_bad, ALARM_COLOUR, 2.0)):
        upper = np.inf
        for lower, opacity in OPACITIES:
            shown = chosen & (weights > lower) & (weights <= upper)
            traces.append(_lines(graph, t, closures[shown], colour, opacity, width))
            upper = lower
    return traces


def _lines(
    graph: PoseGraph, t: Array, edges: Array, colour: str, opacity: float, width: float
) -> Trace:
    """A trace of edges, drawn from end to end; consecutive ones without a gap."""
    x: list[float | None] = []
    y: list[float | None] = []
    end = -1
    for e in edges.tolist():
        a, b = int(graph.i[e]), int(graph.j[e])
        points = [b] if a == end else [a, b]
        if x and a != end:
            x.append(None)
            y.append(None)
        x += t[points, 0].round(2).tolist()
        y += t[points, 1].round(2).tolist()
        end = b
    line = {"color": colour, "width": width}
    return {"x": x, "y": y, "mode": "lines", "line": line, "opacity": opacity, "showlegend": False}


def _weight_curve(mu: float) -> Trace:
    """The weight as a function of r / c."""
    lower = np.sqrt(mu / (mu + 1.0))  # below it the weight is 1, above its inverse it is 0
    r = np.geomspace(lower, 1.0 / lower, 12)
    weights = np.sqrt(mu * (mu + 1.0)) / r - mu
    low, high = 10.0 ** np.array(RATIOS)
    x = np.concatenate([[low], r, [high]]).clip(low, high)
    y = np.concatenate([[1.0], weights.clip(0.0, 1.0), [0.0]])
    line = {"color": "#444444", "width": 1}
    return {**_rounded(x, y), "mode": "lines", "line": line, "showlegend": False, **_BELOW}


def _weight_points(ratio: Array, weights: Array, is_bad: BoolArray) -> list[Trace]:
    """A point for each closure at its r / c and its weight, right ones first."""
    r = np.sqrt(ratio)
    return [
        {
            **_rounded(r[chosen], weights[chosen]),
            "mode": "markers",
            "name": name,
            "marker": {"color": colour, "size": 8, "symbol": symbol},
            **_BELOW,
        }
        for chosen, name, colour, symbol in (
            (~is_bad, "right closures", RIGHT_COLOUR, "circle-open"),
            (is_bad, "wrong closures", ALARM_COLOUR, "diamond"),
        )
    ]


_BELOW = {"xaxis": "x2", "yaxis": "y2"}
_AXIS = {**GRID, "title": {"standoff": 2}}


def _rounded(x: Array, y: Array) -> Trace:
    """Coordinates to three digits."""
    return {"x": [float(f"{value:.3g}") for value in x], "y": y.round(3).tolist()}


def _two_panels(t: Array) -> dict[str, object]:
    """Layout with a map, of equal scales, above a panel of weights."""
    return {
        "height": 640,
        **_map_axes(t),
        "xaxis2": {
            **_AXIS,
            "type": "log",
            "range": list(RATIOS),
            "dtick": 1,
            "anchor": "y2",
            "title": {"text": "r / c", "standoff": 2},
        },
        "yaxis2": {
            **_AXIS,
            "range": [-0.06, 1.06],
            "domain": [0.06, 0.32],
            "anchor": "x2",
            "title": {"text": "weight", "standoff": 4},
        },
        "legend": {"orientation": "h", "x": 0.0, "y": 0.34, "yanchor": "bottom"},
    }


def _map_axes(t: Array) -> dict[str, object]:
    """Axes of the map, around all positions."""
    lower = t.min(axis=0) - 0.4
    upper = t.max(axis=0) + 0.4
    x, y = np.stack([lower, upper], axis=1).round(2).tolist()
    return {
        "xaxis": {**_AXIS, "range": x, "anchor": "y", "title": {"text": "x (m)", "standoff": 2}},
        "yaxis": {
            **_AXIS,
            "range": y,
            "domain": [0.48, 1.0],
            "scaleanchor": "x",
            "title": {"text": "y (m)", "standoff": 4},
        },
    }


def shift_film(
    shifts: Sequence[float],
    answers: Sequence[solvers.Solution],
    costs: Array,
    is_wrong: BoolArray,
    truth: Poses,
) -> Figure:
    """Film over the shift of a run: above the answer, below the truncated costs (l, 2).

    The columns of the costs are those of the answer and of the right map.
    """
    places = [answer.poses.aligned_to(truth).t for answer in answers]
    frames = []
    labels = []
    for k, answer in enumerate(answers):
        labels.append(f"shift {shifts[k]:g} m: {answer.verdict.name}")
        graph = answer.robust.problem.graph
        marks = {
            **_rounded(np.full(2, shifts[k]), costs[k]),
            "mode": "markers",
            "marker": {"color": [ALARM_COLOUR, ODOMETRY_COLOUR], "size": 11},
            "showlegend": False,
            **_BELOW,
        }
        kept = answer.robust.kept[~odometry(graph)].astype(float)
        frames.append([*_map_traces(graph, places[k], kept, is_wrong[~odometry(graph)]), marks])
    still = [
        {
            **_rounded(np.array(shifts), costs[:, column]),
            "mode": "lines",
            "name": name,
            "line": {"color": colour, "width": 1.5, "dash": dash},
            **_BELOW,
        }
        for column, name, colour, dash in (
            (0, "answer", ALARM_COLOUR, "solid"),
            (1, "right map", ODOMETRY_COLOUR, "dash"),
        )
    ]
    layout = _two_panels(np.concatenate(places))
    layout["xaxis2"] = {
        **_AXIS,
        "range": [0.0, 1.05 * max(shifts)],
        "anchor": "y2",
        "title": {"text": "shift of the run (m)", "standoff": 2},
    }
    layout["yaxis2"] = {
        **_AXIS,
        "range": [0.0, 1.15 * float(costs.max())],
        "domain": [0.06, 0.32],
        "anchor": "x2",
        "title": {"text": "truncated cost", "standoff": 4},
    }
    words = _words(shifts, answers, is_wrong)
    return pgo.animate(_changes(frames), labels, still=still, layout=layout, description=words)


def _words(
    shifts: Sequence[float], answers: Sequence[solvers.Solution], is_wrong: BoolArray
) -> str:
    """What the film over the shift shows."""
    kept = [int(answer.robust.kept[is_wrong].sum()) for answer in answers]
    followed = max(shift for shift, number in zip(shifts, kept, strict=True) if number)
    warned = [
        shift for shift, answer in zip(shifts, answers, strict=True) if not answer.is_certified
    ]
    return (
        f"The answer of GNC for a run of {int(is_wrong.sum())} wrong closures that are shifted by "
        f"{shifts[0]:g} to {shifts[-1]:g} m. Up to {followed:g} m the map bends and follows them, "
        "at a lower truncated cost than that of the right map; beyond, they are rejected. Of "
        f"these shifts, the verdict warns at {min(warned):g} to {max(warned):g} m only."
    )
