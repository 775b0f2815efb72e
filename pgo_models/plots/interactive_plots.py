"""A graph to turn and to explore, by plotly (extra `plot`)."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.g2o import pose_names
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.graphs.residuals import check_poses
from pgo_models.plots import graph_plots
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, QUIET_COLOUR, plotly
from pgo_models.problem.thresholds import EdgeResiduals, edge_residuals

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

Trace = dict[str, object]  # a plotly trace is plain data

_MOST_NAMED_ROBOTS = 12  # in the legend
MOST_DOTS = 20_000  # poses that show their names
_MOST_LINES_BEFORE = 10_000  # lines between the poses before


class _Line(NamedTuple):
    """How lines are drawn."""

    colour: str
    width: float
    dash: str = "solid"


# Edges that are not one robot's own, in the order in which they are drawn.
_LINES_OF_KINDS = {
    graph_plots.SIGHTING: _Line(QUIET_COLOUR, 0.3),
    graph_plots.BETWEEN: _Line(QUIET_COLOUR, 1.0),
    graph_plots.UNCERTAIN: _Line(QUIET_COLOUR, 1.5, "dot"),
    graph_plots.MISFIT: _Line(ALARM_COLOUR, 5.0),
}


def explore_graph(
    graph: PoseGraph,
    poses: Poses,
    title: str = "",
    covariances: Array | None = None,
    residuals: EdgeResiduals | None = None,
    before: Poses | None = None,
) -> Figure:
    """Plot a graph with plotly, its robots in colours, to turn and to explore with the pointer.

    Poses and misfitting edges show their names under the pointer. Of a large graph, the lines that
    `lines_to_draw` leaves and some of the poses are drawn; one of a single robot is parted by time.
    Positions are drawn to seven digits (float32). Graph, poses, title, covariances and residuals
    are as for `plot_graph`; `before` are other poses, such as the start of a solve, drawn in grey
    and aligned to the poses.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> graph = grid(np.random.default_rng(0))
    >>> [trace.name for trace in explore_graph(graph, graph.truth).data]
    ['edges and poses', 'edges and poses', 'misfit']
    """
    drawn = graph_plots.covariances_to_draw(covariances, graph)
    poses = check_poses(graph, poses)
    go = plotly("graph_objects")
    if residuals is None:
        residuals = edge_residuals(graph, poses)
    kind = graph_plots.edge_kinds(graph, poses, residuals=residuals)
    traces: list[Trace] = []
    if before is not None:
        aligned = check_poses(graph, before).aligned_to(poses)
        traces.append(_lines_before(graph, aligned, kind))
    ends, line_kind = graph_plots.lines_to_draw(graph, kind)
    own_ends = ends[line_kind == graph_plots.OWN]
    traces += _traces_of_parts(graph, poses, own_ends)
    for this_kind, line in _LINES_OF_KINDS.items():
        ends_of_kind = ends[line_kind == this_kind]
        if len(ends_of_kind):
            label = graph_plots.KIND_LABELS[this_kind]
            traces.append(_lines(poses.t, ends_of_kind, label, line))
    traces.append(_misfit_dots(graph, poses, kind, residuals))
    shown = graph.in_files
    if drawn is not None:
        traces.append(_ellipses(poses[shown], drawn))
    figure = go.Figure(traces)
    lay_out(figure, title, legend_y=-0.12 if graph.d == 2 else 0.0)
    figure.update_layout(**layout_around(poses.t[shown].min(axis=0), poses.t[shown].max(axis=0)))
    return figure


def _lines_before(graph: PoseGraph, before: Poses, kind: IntArray) -> Trace:
    """Grey lines between other poses of the graph."""
    as_own = np.where(graph.is_prior, kind, graph_plots.OWN)
    ends, _ = graph_plots.lines_to_draw(graph, as_own, _MOST_LINES_BEFORE)
    return _lines(before.t, ends, "before", _Line(QUIET_COLOUR, 0.7))


def _traces_of_parts(graph: PoseGraph, poses: Poses, ends: IntArray) -> list[Trace]:
    """Lines between poses of one robot, (l, 2), and dots at poses, part by part (`_parts`)."""
    names = np.array(pose_names(graph))
    part, labels = _parts(graph, names)
    poses_in_files = graph.in_files
    step = graph_plots.thinning_step(len(poses_in_files), MOST_DOTS)
    dots = poses_in_files[::step]
    traces = []
    for a, label in enumerate(labels):
        colour = COLOURS[a % len(COLOURS)]
        own_dots = dots[part[dots] == a]
        texts = [f"pose {names[pose]}" for pose in own_dots]
        if graph.num_robots > 1:
            texts = [f"pose {names[pose]}, robot {graph.robots[pose]}" for pose in own_dots]
        is_own = part[ends[:, 0]] == a
        line = _Line(colour, 1.0)
        lines = _lines(poses.t, ends[is_own], label, line)
        positions = poses.t[own_dots]
        points = _dots(positions, texts, label, colour, 4.0)
        # One entry of the legend shows and hides both. It is that of the dots: a robot has poses,
        # but perhaps no edge of its own.
        traces.append({**lines, "legendgroup": label, "showlegend": False})
        traces.append({**points, "legendgroup": label, "showlegend": True})
    return traces


def _misfit_dots(graph: PoseGraph, poses: Poses, kind: IntArray, residuals: EdgeResiduals) -> Trace:
    """Dots in the middle of misfits, which show what is known of them."""
    misfits = np.flatnonzero(kind == graph_plots.MISFIT)
    step = graph_plots.thinning_step(len(misfits), MOST_DOTS)
    misfits = misfits[::step]
    t_i = poses.t[graph.i[misfits]]
    t_j = poses.t[graph.j[misfits]]
    middles = 0.5 * (t_i + t_j)
    texts = _misfit_texts(graph, misfits, residuals)
    return _dots(middles, texts, "misfit", ALARM_COLOUR, 6.0)


def _ellipses(poses: Poses, covariances: Array) -> Trace:
    """Outlines of ellipses as one trace, with gaps between them."""
    ellipses = graph_plots.confidence_ellipses(poses, covariances)
    one_point_behind = ((0, 0), (0, 1), (0, 0))
    with_gaps = np.pad(ellipses, one_point_behind, constant_values=np.nan)
    outlines = with_gaps.reshape(-1, poses.d)
    return {
        **_points(outlines),
        "mode": "lines",
        "line": {"color": QUIET_COLOUR, "width": 1.0},
        "name": "95 % of x, y",
        "hoverinfo": "skip",
    }


def lay_out(figure: Figure, title: str, legend_y: float) -> None:
    """Set a white ground and narrow margins, and put the legend in a row at a height.

    The height is in heights of the axes, 0 at their foot.
    """
    figure.update_layout(
        template="none",
        title={"text": html.escape(title), "font": {"size": 14}},
        margin={"l": 80, "r": 10, "t": 40 if title else 10, "b": 50},
        legend={"itemsizing": "constant", "orientation": "h", "y": legend_y},
        hovermode="closest",
    )


def _parts(graph: PoseGraph, names: NDArray[np.str_]) -> tuple[IntArray, list[str]]:
    """Part of every pose, (n,), that an entry of the legend shows and hides, and the entries.

    Parts are robots, or groups of successive robots where these are many. A large graph of one
    robot is parted by time.
    """
    if graph.num_robots > 1:
        num_robots = int(graph.robots.max()) + 1
        robot_names = np.arange(num_robots).astype(str)
        return _grouped(graph.robots, _MOST_NAMED_ROBOTS, "robot", robot_names)
    if graph.num_edges <= graph_plots.MOST_LINES:
        return graph.robots, ["edges and poses"]
    poses = np.arange(graph.num_poses)
    return _grouped(poses, len(COLOURS), "pose", names)


def _grouped(
    member: IntArray, most: int, what: str, names: NDArray[np.str_]
) -> tuple[IntArray, list[str]]:
    """Group of every entry, (n,), of which there are at most `most`, and the labels of the groups.

    `member` is the robot or pose that an entry belongs to.
    """
    count = int(member.max()) + 1
    num_groups = min(count, most)
    group = member * num_groups // count
    labels = []
    for a in range(num_groups):
        members = member[group == a]
        first = int(members.min())
        last = int(members.max())
        label = f"{what} {names[first]}"
        if first != last:
            label = f"{what}s {names[first]} to {names[last]}"
        labels.append(label)
    return group, labels


def _points(points: Array) -> Trace:
    """Trace at points, (k, d), which plotly packs as float32 in base64."""
    coordinates = np.ascontiguousarray(points.T, dtype=np.float32)
    if len(coordinates) == 2:
        x, y = coordinates
        return {"type": "scattergl", "x": x, "y": y}
    x, y, z = coordinates
    return {"type": "scatter3d", "x": x, "y": y, "z": z}


def _lines(t: Array, ends: IntArray, name: str, line: _Line) -> Trace:
    """One trace for many lines between poses, (l, 2): start, end, and a gap."""
    d = t.shape[1]
    points = np.full((len(ends), 3, d), np.nan)
    points[:, :2] = t[ends]
    width = line.width if d == 2 else 2.0 * line.width
    return {
        **_points(points.reshape(-1, d)),
        "mode": "lines",
        "line": {"color": line.colour, "width": width, "dash": line.dash},
        "name": name,
        "hoverinfo": "skip",
        "showlegend": True,
    }


def _dots(points: Array, texts: list[str], name: str, colour: str, size: float) -> Trace:
    """Dots at points, (k, d), which show their texts under the pointer."""
    in_plane = points.shape[1] == 2
    return {
        **_points(points),
        "mode": "markers",
        "marker": {"color": colour, "size": size if in_plane else 0.6 * size},
        "text": texts,
        "hovertemplate": "%{text}<extra></extra>",
        "name": name,
        "showlegend": False,
    }


def _misfit_texts(graph: PoseGraph, edges: IntArray, residuals: EdgeResiduals) -> list[str]:
    """Poses, cost and errors of some edges, (k,)."""
    names = pose_names(graph)
    allowed = np.where(residuals.allowed > 0.0, residuals.allowed, 1.0)
    times_allowed = residuals.cost / allowed
    texts = []
    for e in edges:
        text = (
            f"edge {e}: {names[graph.i[e]]} to {names[graph.j[e]]}<br>"
            f"{times_allowed[e]:.3g} times what it may cost, "
            f"{100 * residuals.share[e]:.3g} % of all<br>{residuals.translation[e]:.3g} m"
        )
        if graph.kappa[e] > 0:
            text += f", {np.rad2deg(residuals.rotation[e]):.3g} deg"
        texts.append(text)
    return texts


def layout_around(lower: Array, upper: Array) -> dict[str, object]:
    """Axes with equal scales and their unit, from the lowest to the highest coordinates, (d,)."""
    extent = float((upper - lower).max())
    if len(lower) == 2:
        margin = 0.04 * extent
        x, y = np.stack([lower - margin, upper + margin], axis=1).tolist()
        axis = {"zeroline": False, "gridcolor": "#eeeeee"}
        return {
            "xaxis": {**axis, "range": x, "title": {"text": "x (m)"}},
            "yaxis": {**axis, "range": y, "scaleanchor": "x", "title": {"text": "y (m)"}},
        }
    middle = 0.5 * (lower + upper)
    half = max(0.52 * extent, 1e-9)
    # Seen from a little below the default, so that the titles of the axes are not cut off.
    scene: dict[str, object] = {"aspectmode": "cube", "camera": {"center": {"z": -0.2}}}
    for letter, centre in zip("xyz", middle.tolist(), strict=True):
        limits = [centre - half, centre + half]
        scene[f"{letter}axis"] = {"title": {"text": f"{letter} (m)"}, "range": limits}
    return {"scene": scene}
