"""Figures and films of notebook 6: robots, their messages, and what happens if some fail."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np

import pgo_models as pgo
from drawings.traces import GRID
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, QUIET_COLOUR

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray
    from plotly.graph_objects import Figure

Trace = dict[str, object]

_ARRIVED_COLOUR = "#444444"
_BESIDE = 0.07  # metres between a line of a meeting and the arrow of a message along it
_SMALLEST_GAP = 1e-12  # below it, the gap is rounding


def draw_figure_1(graph: pgo.PoseGraph) -> None:
    """Draw four robots as in the paper's figure 1, and what robots 0 and 1 of them exchange."""
    _, (left, right) = plt.subplots(
        1, 2, figsize=(7.5, 3.2), layout="constrained", width_ratios=[1, 1.25]
    )
    t = graph.truth.t
    _draw_robots(left, graph, t)
    left.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=4, handlelength=1)
    left.set_title("four robots, after the paper's figure 1", fontsize=8)
    right.set_title("robots 0 and 1, further apart", fontsize=8)
    pair = graph.subgraph(np.flatnonzero(graph.robots < 2))
    t = pair.truth.t + np.where(pair.robots == 1, 1.3, 0.0)[:, None] * np.array([1.0, 0.0])
    _draw_robots(right, pair, t)
    for i, j in _meetings(pair):
        for holder, held, towards in ((i, j, 0.42), (j, i, -0.42)):
            place = t[holder] + [towards, 0.2]
            colour = COLOURS[pair.robots[held]]
            right.plot(*place, "o", color=colour, markersize=9, markerfacecolor="white")
            right.text(place[0], place[1] + 0.14, f"copy of {held}", ha="center", fontsize=6)
    for pose, place in enumerate(t):
        right.text(*place, str(pose), color="white", ha="center", va="center", fontsize=5.5)
    middle = t[_meetings(pair)].mean(axis=(0, 1))
    for shift, sense, sender in ((0.09, 1, 0), (-0.09, -1, 1)):
        ends = middle + np.array([[-0.5 * sense, shift], [0.5 * sense, shift]])
        arrow = {"arrowstyle": "->", "color": COLOURS[sender]}
        right.annotate("", ends[1], ends[0], arrowprops=arrow)
    right.margins(0.06, 0.25)
    right.text(middle[0], middle[1] + 0.2, "x + u of what both hold", ha="center", fontsize=7)


def _draw_robots(axes: Axes, graph: pgo.PoseGraph, t: NDArray[np.float64]) -> None:
    """Draw the trajectory of every robot, and dotted lines where two have met."""
    for robot in range(graph.num_robots):
        line = t[graph.robots == robot]
        axes.plot(*line.T, "o-", color=COLOURS[robot], markersize=9, label=f"robot {robot}")
    for meeting in _meetings(graph):
        axes.plot(*t[meeting].T, ":", color="#555555", linewidth=1.6, zorder=0)
    axes.set_aspect("equal")
    axes.margins(0.06, 0.1)
    axes.axis("off")


def _meetings(graph: pgo.PoseGraph) -> NDArray[np.int64]:
    """Pairs of poses, (l, 2), of the edges between two robots."""
    is_meeting = graph.robots[graph.i] != graph.robots[graph.j]
    return np.stack([graph.i, graph.j], axis=1)[is_meeting]


def film_of_messages(
    graph: pgo.PoseGraph,
    rounds: Sequence[tuple[pgo.Poses, NDArray[np.float64]]],
    arrived: NDArray[np.bool_],
    gaps: Sequence[float],
    lossless: Sequence[float],
) -> Figure:
    """Film of the rounds: poses, copies, messages that arrive or are lost, and the gap below.

    Every round has the poses as their owners have them and the positions of the copies, (c, 2);
    `arrived`, (rounds, robots, robots), says of every message of its round whether it arrives.
    Round 0 is the start, before which no message was sent.
    """
    frames = []
    labels = []
    lost_in_all = 0
    ordered = _ordered_pairs(graph)
    for k, (poses, copies) in enumerate(rounds):
        lost = [pair for pair in ordered if k > 0 and not arrived[k - 1][pair]]
        lost_in_all += len(lost)
        labels.append("start" if k == 0 else f"round {k}: {len(lost)} of {len(ordered)} lost")
        frames.append(
            [
                *(_trajectory(graph, poses.t, robot) for robot in range(graph.num_robots)),
                _rings(copies),
                *(_messages(graph, poses.t, k > 0, lost, is_lost) for is_lost in (False, True)),
                _curve(gaps[: k + 1]),
            ]
        )
    frames = [frames[0], *([_coordinates(trace) for trace in frame] for frame in frames[1:])]
    num_rounds = len(rounds) - 1
    description = (
        f"Four robots with four poses each exchange messages for {num_rounds} rounds, of which "
        f"{lost_in_all} of {num_rounds * len(ordered)} are lost; their poses move into place, and "
        f"the gap below falls from {gaps[0]:.0e} to {gaps[-1]:.0e}, where it would be "
        f"{lossless[-1]:.0e} without losses."
    )
    still = [_curve_without_losses(lossless)]
    layout = _layout_of_messages(rounds, [*gaps, *lossless])
    return pgo.animate(frames, labels, still=still, layout=layout, description=description)


def _ordered_pairs(graph: pgo.PoseGraph) -> list[tuple[int, int]]:
    """Sender and receiver of all messages of a round: neighbours, in both directions."""
    robots = graph.robots[_meetings(graph)]
    return sorted({(int(a), int(b)) for a, b in np.concatenate([robots, robots[:, ::-1]])})


def _trajectory(graph: pgo.PoseGraph, t: NDArray[np.float64], robot: int) -> Trace:
    """Poses of a robot, as it has them itself."""
    x, y = t[graph.robots == robot].T.round(3).tolist()
    return {
        "x": x,
        "y": y,
        "mode": "lines+markers",
        "name": f"robot {robot}",
        "line": {"color": COLOURS[robot], "width": 2},
        "marker": {"size": 9},
        "hoverinfo": "skip",
    }


def _rings(copies: NDArray[np.float64]) -> Trace:
    """Copies of shared poses, where their holders have them."""
    x, y = copies.T.round(3).tolist()
    return {
        "x": x,
        "y": y,
        "mode": "markers",
        "name": "copy",
        "marker": {"size": 14, "color": "rgba(0,0,0,0)", "line": {"color": "#000000", "width": 1}},
        "hoverinfo": "skip",
    }


def _messages(
    graph: pgo.PoseGraph,
    t: NDArray[np.float64],
    is_sent: bool,
    lost: list[tuple[int, int]],
    is_lost: bool,
) -> Trace:
    """Arrows along all meetings of two robots for every message that arrived, or that was lost.

    A lost message ends with a cross in the middle.
    """
    x: list[float | None] = []
    y: list[float | None] = []
    for i, j in np.concatenate([_meetings(graph), _meetings(graph)[:, ::-1]]):
        pair = (int(graph.robots[i]), int(graph.robots[j]))
        if is_sent and (pair in lost) == is_lost:
            along = t[j] - t[i]
            right = np.array([along[1], -along[0]]) / np.linalg.norm(along)
            first = t[i] + 0.14 * along + _BESIDE * right
            last = t[i] + (0.5 if is_lost else 0.86) * along + _BESIDE * right
            x += [round(float(first[0]), 2), round(float(last[0]), 2), None]
            y += [round(float(first[1]), 2), round(float(last[1]), 2), None]
    colour = ALARM_COLOUR if is_lost else _ARRIVED_COLOUR
    marker = {"symbol": "x" if is_lost else "arrow", "angleref": "previous", "color": colour}
    return {
        "x": x or [None],
        "y": y or [None],
        "mode": "lines+markers",
        "name": "lost" if is_lost else "arrived",
        "line": {"color": colour, "width": 1.5, "dash": "dot" if is_lost else "solid"},
        "marker": marker | {"size": [0, 10, 0] * 2 * len(_meetings(graph))},
        "hoverinfo": "skip",
    }


def _curve(gaps: Sequence[float]) -> Trace:
    """Gap of the rounds so far."""
    return {
        "x": list(range(len(gaps))),
        "y": [float(f"{value:.2e}") for value in gaps],
        "xaxis": "x2",
        "yaxis": "y2",
        "mode": "lines+markers",
        "line": {"color": ALARM_COLOUR, "width": 2},
        "marker": {"size": 4},
        "showlegend": False,
        "hoverinfo": "skip",
    }


def _curve_without_losses(gaps: Sequence[float]) -> Trace:
    """Gap of all rounds of a run whose messages all arrive."""
    curve = _curve(gaps)
    line = {"color": QUIET_COLOUR, "width": 2}
    return {**curve, "mode": "lines", "line": line, "name": "no losses", "showlegend": True}


def _coordinates(trace: Trace) -> Trace:
    """The coordinates of a trace; all else stays as in the first frame."""
    return {name: trace[name] for name in ("x", "y")}


def _layout_of_messages(
    rounds: Sequence[tuple[pgo.Poses, NDArray[np.float64]]], gaps: Sequence[float]
) -> dict[str, object]:
    """Map above, gap below, and a legend between them."""
    every = np.concatenate([poses.t for poses, _ in rounds])
    lower, upper = every.min(axis=0) - 0.25, every.max(axis=0) + 0.25
    decades = [float(np.log10(min(gaps))) - 0.2, float(np.log10(max(gaps))) + 0.2]
    hidden = {"visible": False}
    return {
        "height": 720,
        "xaxis": {**hidden, "range": [lower[0], upper[0]], "constrain": "domain"},
        "yaxis": {
            **hidden,
            "range": [lower[1], upper[1]],
            "scaleanchor": "x",
            "domain": [0.4, 1.0],
        },
        "xaxis2": {
            "range": [-0.5, len(rounds) - 0.5],
            "anchor": "y2",
            "title": {"text": "round"},
            "gridcolor": "#eeeeee",
            "zeroline": False,
        },
        "yaxis2": {
            "type": "log",
            "range": decades,
            "domain": [0.0, 0.24],
            "anchor": "x2",
            "title": {"text": "F / F* - 1"},
            "dtick": 1,
            "exponentformat": "power",
            "gridcolor": "#eeeeee",
        },
        "legend": {"orientation": "h", "x": 0.0, "y": 0.38, "yanchor": "top", "font": {"size": 11}},
    }


def slider_of_losses(
    shares: Sequence[float],
    newest: Sequence[NDArray[np.float64]],
    only_what_arrived: Sequence[NDArray[np.float64]],
) -> Figure:
    """Film over the share of lost messages: gaps of two runs over the rounds, for every share."""
    frames = []
    for row, other in zip(newest, only_what_arrived, strict=True):
        frames.append(
            [
                _gap_curve("newest rows", row, COLOURS[0]),
                _gap_curve("only what arrived", other, ALARM_COLOUR),
            ]
        )
    still = [_gap_curve("no losses", newest[0], QUIET_COLOUR) | {"line": {"color": QUIET_COLOUR}}]
    frames = [frames[0], *([{"y": trace["y"]} for trace in frame] for frame in frames[1:])]
    everything = np.maximum(np.concatenate([*newest, *only_what_arrived]), _SMALLEST_GAP)
    decades = [np.log10(everything.min()) - 0.3, np.log10(everything.max()) + 0.3]
    layout = {
        "height": 460,
        "xaxis": {**GRID, "range": [0, len(newest[0])], "title": {"text": "round"}},
        "yaxis": {
            **GRID,
            "type": "log",
            "range": decades,
            "exponentformat": "power",
            "dtick": 2,
            "title": {"text": "F / F* - 1"},
        },
        "legend": {"orientation": "h", "x": 0.0, "y": 1.02, "yanchor": "bottom"},
        "margin": {"l": 60, "r": 10, "t": 40, "b": 20},
    }
    description = (
        f"The gap over {len(newest[0])} rounds while the share of lost messages goes from "
        f"{100 * shares[0]:.0f} to {100 * shares[-1]:.0f} %. With the newest rows it ends at "
        f"{newest[0][-1]:.0e} and {newest[-1][-1]:.0e}; with only what arrived, at "
        f"{only_what_arrived[1][-1]:.0e} as soon as {100 * shares[1]:.0f} % are lost."
    )
    labels = [f"{100 * share:.0f} % lost" for share in shares]
    return pgo.animate(frames, labels, still=still, layout=layout, description=description)


def _gap_curve(name: str, gaps: NDArray[np.float64], colour: str) -> Trace:
    """Gap over the rounds, with two digits."""
    return {
        "x": list(range(1, len(gaps) + 1)),
        "y": [float(f"{value:.1e}") for value in np.maximum(gaps, _SMALLEST_GAP)],
        "mode": "lines",
        "name": name,
        "line": {"color": colour, "width": 2},
        "hoverinfo": "skip",
    }


def draw_absence(
    runs: Mapping[str, Sequence[float]], robot: int, absent_from: int, absent_until: int
) -> None:
    """Draw the gaps of runs in which a robot is away for some rounds, which are grey."""
    figure, axes = plt.subplots(figsize=(5.0, 2.8), layout="constrained")
    axes.axvspan(absent_from, absent_until, color="#dddddd", label=f"robot {robot} is dead")
    for (name, gaps), colour in zip(runs.items(), (QUIET_COLOUR, *COLOURS), strict=False):
        rounds = np.arange(1, len(gaps) + 1)
        axes.semilogy(rounds, gaps, color=colour, label=name)
    axes.set(xlabel="round", ylabel="F / F* - 1")
    figure.legend(fontsize=8, loc="outside right upper")


def draw_faults(
    curves: Mapping[str, tuple[Sequence[int], Sequence[float]]], silent: tuple[int, int]
) -> None:
    """Draw primal residuals over the rounds; the rounds in which a robot is silent are grey."""
    figure, axes = plt.subplots(figsize=(5.4, 2.8), layout="constrained")
    axes.axvspan(*silent, color="#eeeeee", zorder=0)
    for (label, (rounds, residuals)), colour in zip(curves.items(), COLOURS, strict=False):
        axes.semilogy(rounds, residuals, color=colour, label=label)
    axes.set(xlabel="round of SOC", ylabel="primal residual")
    axes.set_title("grey: robot 2 silent, in one of them", fontsize=9)
    figure.legend(fontsize=8, loc="outside lower center", ncols=2)
