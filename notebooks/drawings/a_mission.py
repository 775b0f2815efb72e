"""Figures and the film of notebook 17: a mission of four robots, what each knows, and its bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.patches import Patch

import pgo_models as pgo
from drawings.traces import GRID
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, QUIET_COLOUR

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from plotly.graph_objects import Figure

    from solvers.team.messages import Ended, Term

Trace = dict[str, object]
Places = dict[int, "NDArray[np.float64]"]

SECONDS = 10  # of a picture of the film
_PALE = 0.6  # share of white in the colour of a certificate that is older than a failed solve
_DARK = 0.55  # share of the largest number above which the letters on it are white


class Known(Protocol):
    """What a robot knows at a moment: outcome, why a later solve failed, and its poses by id."""

    outcome: Ended | None
    failure: str
    poses: Mapping[int, tuple[NDArray[np.float64], NDArray[np.float64]]]


Log = Sequence[Mapping[str, Known]]


def draw_world(world: pgo.PoseGraph, names: Sequence[str]) -> None:
    """Draw where the robots will drive, and all edges that are not along a trajectory."""
    figure, axes = plt.subplots(figsize=(4.6, 4.2), layout="constrained")
    t = world.truth.t + _lanes(world)
    for e in np.flatnonzero(_is_closure(world)):
        ends = t[[world.i[e], world.j[e]]]
        axes.plot(*ends.T, color="#333333", linewidth=1.4, zorder=3)
    for robot, name in enumerate(names):
        line = t[world.robots == robot]
        axes.plot(*line.T, ".-", color=COLOURS[robot], markersize=4, linewidth=1, label=name)
        axes.plot(*line[0], "o", color=COLOURS[robot], markersize=7)
    axes.set_aspect("equal")
    axes.axis("off")
    figure.legend(fontsize=8, loc="outside lower center", ncols=4)


def _is_closure(world: pgo.PoseGraph) -> NDArray[np.bool_]:
    """Whether an edge is none of odometry, (m,)."""
    is_other_robot = world.robots[world.i] != world.robots[world.j]
    return (world.j != world.i + 1) | is_other_robot


def _lanes(world: pgo.PoseGraph) -> NDArray[np.float64]:
    """Offsets that keep robots apart which drive through the same cells, (n, 2), metres."""
    corners = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])
    return 0.09 * corners[world.robots % 4]


def draw_drivers(log: Log, away: tuple[str, int, int]) -> None:
    """Draw, for every robot and second, whose solve its latest certificate is from."""
    names = list(log[0])
    colours = {"no certificate": to_rgb("#e4e4e4")}
    for name, colour in zip(names, COLOURS, strict=False):
        rgb = np.array(to_rgb(colour))
        colours[f"{name} drove"] = tuple(rgb)
        colours[f"{name} drove, later failed"] = tuple((1.0 - _PALE) * rgb + _PALE)
    rows = [[_driven(known[name]) for known in log] for name in names]
    figure, axes = plt.subplots(figsize=(6.2, 1.9), layout="constrained")
    pixels = np.array([[colours[text] for text in row] for row in rows])
    axes.imshow(pixels, aspect="auto", extent=(0, len(log), len(names) - 0.5, -0.5))
    axes.hlines(np.arange(len(names) - 1) + 0.5, 0, len(log), color="white", linewidth=3)
    for moment in away[1:]:
        axes.axvline(moment, color="black", linestyle="--", linewidth=1)
    axes.set_yticks(range(len(names)), names)
    axes.set_xlabel("seconds")
    shown = {text for row in rows for text in row}
    patches = [Patch(color=rgb, label=text) for text, rgb in colours.items() if text in shown]
    figure.legend(handles=patches, fontsize=8, loc="outside upper center", ncols=4)


def _driven(known: Known) -> str:
    """Who drove the latest outcome, and whether a later solve has failed."""
    if known.outcome is None:
        return "no certificate"
    later = ", later failed" if known.failure else ""
    return f"{known.outcome.term.driver} drove{later}"


def mission_film(
    world: pgo.PoseGraph,
    log: Log,
    away: tuple[str, int, int],
    measured_in: NDArray[np.int64],
    optima: Sequence[float],
) -> Figure:
    """Film of a mission, ten seconds a picture: the maps that robots have, and the bounds below.

    Maps are laid on the truth, each group of robots that was solved together by itself.
    `measured_in`, (m,), are the tens of seconds in which the edges were measured, and `optima` the
    least cost of all that was measured, at the end of every ten seconds.
    """
    names = list(log[0])
    frames = []
    labels = []
    everywhere = [world.truth.t]
    bounds: list[dict[str, float | None]] = []
    together: list[float] = []
    for ten in range(len(log) // SECONDS):
        now = log[SECONDS * (ten + 1) - 1]
        places, groups, old = _places(world, now)
        everywhere += list(places.values())
        pair = (away[0], _other(names, away[0]))
        bounds.append({name: _bound(now[name]) for name in pair})
        together.append(_proven_together(now[pair[0]], now[pair[1]]))
        is_away = away[1] < SECONDS * (ten + 1) <= away[2]
        dashed = (*old, away[0]) if is_away else old
        lines = [_line(world, places, robot, names, dashed) for robot in range(len(names))]
        new = np.flatnonzero(_is_closure(world) & (measured_in == ten))
        frames.append(
            [*lines, _closures(world, places, new), *_bounds(bounds, together, away, names)]
        )
        texts = [", ".join(group) for group in groups]
        texts += [f"old map: {', '.join(old)}"] if old else []
        labels.append(f"{SECONDS * (ten + 1)} s: {' | '.join(texts) or 'no certificate'}")
    still = [_optimum(optima)]
    description = (
        f"The maps of {len(names)} robots grow for {len(log)} seconds, and join when the robots "
        f"have met. {away[0].capitalize()} is out of reach from second {away[1]} to {away[2]}, and "
        "drawn dotted, as are maps older than a solve that failed. Below, the bounds of the two "
        "parts and what they prove together never exceed the least cost of all measurements, "
        "which ends at "
        f"{optima[-1]:.0f}."
    )
    layout = _layout(
        np.vstack(everywhere), len(log), max(value for value in optima if np.isfinite(value))
    )
    return pgo.animate(frames, labels, still=still, layout=layout, description=description)


def _other(names: Sequence[str], away: str) -> str:
    """The first robot that is not the one out of reach."""
    return next(name for name in names if name != away)


def _places(
    world: pgo.PoseGraph, now: Mapping[str, Known]
) -> tuple[Places, list[tuple[str, ...]], tuple[str, ...]]:
    """Positions of all poses that are known, by id; groups solved together; who has an old map."""
    groups: dict[Term, list[str]] = {}
    for name, known in now.items():
        if known.outcome is not None:
            groups.setdefault(known.outcome.term, []).append(name)
    places: Places = {}
    for group in groups.values():
        poses = {pose: value for name in group for pose, value in now[name].poses.items()}
        ids = np.array(sorted(poses))
        R, t = (np.stack([poses[pose][part] for pose in ids.tolist()]) for part in (0, 1))
        aligned = pgo.Poses(R, t).aligned_to(world.truth[ids])
        places.update(zip(ids.tolist(), aligned.t, strict=True))
    old = tuple(name for name, known in now.items() if known.failure and known.outcome is not None)
    certified = sorted(tuple(group) for group in groups.values() if group[0] not in old)
    return places, certified, old


def _bound(known: Known) -> float | None:
    """Lower bound that a robot knows."""
    if known.outcome is None or known.outcome.solution is None:
        return None
    return float(f"{known.outcome.solution.lower_bound:.4g}")


def _proven_together(one: Known, other: Known) -> float:
    """Sum of the bounds of two robots, or the larger one if they cover the same robot."""
    bounds = [_bound(one) or 0.0, _bound(other) or 0.0]
    covered = [() if known.outcome is None else known.outcome.covered for known in (one, other)]
    is_apart = set(covered[0]).isdisjoint(covered[1])
    return round(sum(bounds) if is_apart else max(bounds), 2)


def _line(
    world: pgo.PoseGraph,
    places: Places,
    robot: int,
    names: Sequence[str],
    dashed: Sequence[str],
) -> Trace:
    """Trajectory of a robot as it knows it, dashed for some."""
    ids = [pose for pose in np.flatnonzero(world.robots == robot).tolist() if pose in places]
    return {
        "x": [round(float(places[pose][0]), 2) for pose in ids] or [None],
        "y": [round(float(places[pose][1]), 2) for pose in ids] or [None],
        "mode": "lines",
        "name": names[robot],
        "line": {
            "color": COLOURS[robot],
            "width": 2.5,
            "dash": "dot" if names[robot] in dashed else "solid",
        },
        "hoverinfo": "skip",
    }


def _closures(world: pgo.PoseGraph, places: Places, edges: NDArray[np.int64]) -> Trace:
    """Closures of the last ten seconds, between poses whose places are known."""
    x: list[float | None] = []
    y: list[float | None] = []
    for i, j in zip(world.i[edges].tolist(), world.j[edges].tolist(), strict=True):
        if i in places and j in places:
            for pose in (i, j):
                x.append(round(float(places[pose][0]), 2))
                y.append(round(float(places[pose][1]), 2))
            x.append(None)
            y.append(None)
    return {
        "x": x or [None],
        "y": y or [None],
        "mode": "lines+markers",
        "name": "closures",
        "line": {"color": ALARM_COLOUR, "width": 3},
        "marker": {"size": 5},
        "hoverinfo": "skip",
    }


def _bounds(
    bounds: Sequence[Mapping[str, float | None]],
    together: Sequence[float],
    away: tuple[str, int, int],
    names: Sequence[str],
) -> list[Trace]:
    """Bounds so far of the robot out of reach and of the others, and both while they are apart."""
    seconds = [SECONDS * (k + 1) for k in range(len(bounds))]
    other = _other(names, away[0])
    curves = []
    for name in (other, away[0]):
        values = [row[name] for row in bounds]
        curve = _curve(f"bound of {name}", seconds, values, COLOURS[names.index(name)])
        curves.append({**curve, "showlegend": False})
    apart = [k for k, second in enumerate(seconds) if away[1] < second <= away[2]]
    total = [together[k] for k in apart]
    curves.append(_curve("both bounds", [seconds[k] for k in apart], total, "#000000"))
    return curves


def _curve(name: str, seconds: Sequence[int], values: Sequence[float | None], colour: str) -> Trace:
    """A curve over the seconds, in the lower picture."""
    return {
        "x": list(seconds) or [None],
        "y": list(values) or [None],
        "xaxis": "x2",
        "yaxis": "y2",
        "mode": "lines+markers",
        "name": name,
        "line": {"color": colour, "width": 2},
        "marker": {"size": 5},
        "hoverinfo": "skip",
    }


def _optimum(optima: Sequence[float]) -> Trace:
    """Least cost of all measurements, where they hang together."""
    seconds = [SECONDS * (k + 1) for k in range(len(optima))]
    values = [None if np.isnan(value) else round(value, 2) for value in optima]
    curve = _curve("least cost", seconds, values, QUIET_COLOUR)
    line = {"color": QUIET_COLOUR, "width": 6}
    return {**curve, "mode": "lines", "line": line}


def _layout(t: NDArray[np.float64], seconds: int, largest: float) -> dict[str, object]:
    """Map above, with equal scales, and bounds below."""
    lower, upper = t.min(axis=0) - 0.3, t.max(axis=0) + 0.3
    hidden = {"visible": False}
    return {
        "height": 740,
        "xaxis": {**hidden, "range": [lower[0], upper[0]], "constrain": "domain"},
        "yaxis": {
            **hidden,
            "range": [lower[1], upper[1]],
            "scaleanchor": "x",
            "domain": [0.44, 1.0],
        },
        "xaxis2": {
            **GRID,
            "range": [0, seconds + 4],
            "anchor": "y2",
            "title": {"text": "seconds"},
        },
        "yaxis2": {
            **GRID,
            "range": [-0.04 * largest, 1.08 * largest],
            "domain": [0.0, 0.25],
            "anchor": "x2",
            "title": {"text": "cost F"},
        },
        "legend": {
            "orientation": "h",
            "x": 0.0,
            "y": 0.42,
            "yanchor": "top",
            "font": {"size": 11},
            "entrywidth": 68,
        },
        "margin": {"l": 55, "r": 10, "t": 10, "b": 20},
    }
