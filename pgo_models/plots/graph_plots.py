"""Pictures of pose graphs with matplotlib (extra `plot`): by robot, doubtful edges marked, truth against estimate."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pgo_models.errors import GraphError
from pgo_models.geometry.poses import Poses, absolute_trajectory_error
from pgo_models.geometry.rotations import Array, log_map
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.graphs.residuals import check_poses, uncertain_edges
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, QUIET_COLOUR, column_figure, count_along_x
from pgo_models.problem.thresholds import EdgeResiduals, edge_residuals

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

SIGHTING, OWN, BETWEEN, UNCERTAIN, MISFIT = range(5)
_WIDTHS = np.array([0.15, 0.6, 0.5, 0.5, 1.8])
KIND_LABELS = {
    SIGHTING: "a landmark seen",
    BETWEEN: "between robots",
    UNCERTAIN: "uncertain: precision under a tenth of the median",
    MISFIT: "misfit: costs more than its information allows",
}
MOST_LINES = 40_000  # of a picture
_ZOOM = 0.82  # leaves room for the labels of axes in space, which the layout does not see
_MOST_NAMED_ROBOTS = len(COLOURS)


def edge_kinds(graph: PoseGraph, poses: Poses, mark: bool = True, residuals: EdgeResiduals | None = None) -> IntArray:
    """How every edge is drawn, (m,): OWN, BETWEEN (two robots), SIGHTING (a landmark's), marked UNCERTAIN or MISFIT.

    The last that fits; priors are -1. Misfits are of F unless `residuals` are given. A GraphError if sizes differ.
    """
    check_poses(graph, poses)
    kind = np.where(graph.robots[graph.i] == graph.robots[graph.j], OWN, BETWEEN)
    kind[np.isin(graph.j, graph.landmarks)] = SIGHTING
    if mark:
        kind[uncertain_edges(graph)] = UNCERTAIN
        kind[(residuals or edge_residuals(graph, poses)).is_misfit] = MISFIT
    kind[graph.is_prior] = -1
    return kind


def lines_to_draw(graph: PoseGraph, kind: IntArray, most: int = MOST_LINES) -> tuple[IntArray, IntArray]:
    """Poses (l, 2) to join by lines, and the kinds of these, (l,), for edges of some kinds (m,): what stands out last.

    They are all edges but priors while `most` are as many. Else, k = `thinning_step`, they are misfits, paths through
    every k-th pose that consecutive edges join, and every k-th of the other edges.
    """
    ends, step = np.stack([graph.i, graph.j], axis=1), thinning_step(graph.num_edges, most)
    if step > 1:
        pose, on_path = np.arange(graph.num_poses), (kind == OWN) & (graph.j == graph.i + 1)
        goes_on = np.zeros(graph.num_poses + 1, dtype=bool)
        goes_on[graph.j[on_path]] = True
        first = np.maximum.accumulate(np.where(goes_on[:-1], 0, pose))
        path = np.flatnonzero(((pose - first) % step == 0) | ~goes_on[1:])
        paths = np.stack([path[:-1], path[1:]], axis=1)[first[path[1:]] == first[path[:-1]]]
        misfits = np.flatnonzero(kind == MISFIT)
        others = np.flatnonzero((kind >= 0) & (kind != MISFIT) & ~on_path)[::step]
        kept = np.append(others, misfits[:: thinning_step(len(misfits), most)])
        ends, kind = np.concatenate([paths, ends[kept]]), np.append(np.full(len(paths), OWN), kind[kept])
    order = np.argsort(kind, kind="stable")[int(np.sum(kind < 0)) :]
    return ends[order], kind[order]


def thinning_step(count: int, most: int) -> int:
    """Every how many of `count` things are drawn, of which there may be `most`."""
    return max(1, -(-count // most))


def confidence_ellipses(poses: Poses, covariances: Array) -> Array:
    """Outlines, (k, 49, d) points, that hold the true x and y with 95 %, in space at the height of the pose.

    Of covariances (n, p, p) of moves along the axes of the world first (`Marginals`), at most 100 poses, evenly chosen.
    """
    chosen = np.linspace(0, poses.num_poses - 1, min(poses.num_poses, 100)).astype(int)
    angle = np.linspace(0.0, 2.0 * np.pi, 49)
    variances, axes = np.linalg.eigh(covariances[chosen, :2, :2])
    radii = np.sqrt(-2.0 * np.log(0.05) * np.maximum(variances, 0.0))
    outlines = np.repeat(poses.t[chosen, None], len(angle), axis=1)
    outlines[:, :, :2] += np.stack([np.cos(angle), np.sin(angle)], axis=1) @ np.swapaxes(axes * radii[:, None], 1, 2)
    return outlines


def draw_graph(
    graph: PoseGraph, poses: Poses, axes: Axes, mark_edges: bool = True, residuals: EdgeResiduals | None = None
) -> None:
    """Draw positions and edges: each robot's own edges in its colour, those between robots in grey.

    The axes are of projection "3d" for graphs in space. With `mark_edges`, edges with a low precision are dotted, and
    those that cost more than they may (`residuals`, those of F unless given) thick and vermilion.
    """
    from matplotlib.colors import to_rgb

    kind = edge_kinds(graph, poses, mark_edges, residuals)
    ends, kind = lines_to_draw(graph, kind)
    i, j = ends.T
    palette = np.array([to_rgb(name) for name in (*COLOURS, QUIET_COLOUR, ALARM_COLOUR)])
    colour = np.where(graph.robots[i] == graph.robots[j], graph.robots[i] % len(COLOURS), len(COLOURS))
    colour[kind == SIGHTING], colour[kind == MISFIT] = len(COLOURS), len(COLOURS) + 1
    widths, dashes = _WIDTHS[kind], [(0, (1, 1.5)) if one == UNCERTAIN else "solid" for one in kind]
    drawn, many = _line_collection(graph.d), graph.num_edges > MOST_LINES
    lines = drawn(list(poses.t[ends]), colors=palette[colour], linewidths=widths, linestyles=dashes, rasterized=many)
    axes.add_collection(lines)
    _frame(axes, poses.t[graph.in_files])


def plot_graph(
    graph: PoseGraph,
    poses: Poses,
    title: str = "",
    covariances: Array | None = None,
    residuals: EdgeResiduals | None = None,
) -> Figure:
    """Figure of a graph by robot, with a legend (`draw_graph`); of covariances (n, p, p), `confidence_ellipses`.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> graph = grid(np.random.default_rng(0))
    >>> plot_graph(graph, graph.truth, "27 poses").axes[0].get_title()
    '27 poses'
    """
    with column_figure(height=1.15) as figure:
        axes = figure.add_subplot(projection="3d" if graph.d == 3 else None)
        draw_graph(graph, poses, axes, residuals=residuals)
        axes.set_title(title or graph.name)
        handles: list[Artist] = list(_legend(graph, edge_kinds(graph, poses, residuals=residuals)))
        if covariances is not None:
            named, style = graph.in_files, {"colors": QUIET_COLOUR, "linewidths": 0.3}
            outlines = list(confidence_ellipses(poses[named], covariances[named]))
            ellipses = _line_collection(graph.d)(outlines, **style, zorder=1, label="95 % of x, y")
            handles.append(axes.add_collection(ellipses))
        if handles:
            figure.legend(handles=handles, loc="outside lower center", ncols=3 if graph.num_robots > 1 else 1)
    return figure


def compare_poses(graph: PoseGraph, panels: list[tuple[str, Poses]], residuals: EdgeResiduals | None = None) -> Figure:
    """Figure with one panel for every (title, poses), side by side; edges are marked by `residuals` of the last.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> graph = grid(np.random.default_rng(0))
    >>> figure = compare_poses(graph, [("truth", graph.truth), ("start", graph.initial)])
    >>> [axes.get_title() for axes in figure.axes]
    ['truth', 'start']
    """
    return plot_panels([[(title, graph, poses) for title, poses in panels]], residuals)


def plot_panels(panels: list[list[tuple[str, PoseGraph, Poses]]], residuals: EdgeResiduals | None = None) -> Figure:
    """Figure with a row of pictures for every list of (title, graph, poses); `residuals` are of the last picture."""
    columns, marked = max(len(row) for row in panels), None
    with column_figure(height=1.0 * len(panels), width=columns) as figure:
        for r, row in enumerate(panels):
            for place, (title, graph, poses) in enumerate(row, r * columns + 1):
                axes = figure.add_subplot(len(panels), columns, place, projection="3d" if graph.d == 3 else None)
                marked = residuals if (r, place) == (len(panels) - 1, r * columns + len(row)) else None
                draw_graph(graph, poses, axes, marked is not None, marked)
                axes.set_title(title)
        if marked is not None and (handles := _legend(graph, edge_kinds(graph, poses, residuals=marked))):
            figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def plot_against_truth(graph: PoseGraph, poses: Poses, truth: Poses | None = None) -> Figure:
    """Figure of an estimate on top of the truth, and of its errors pose by pose, in metres and degrees.

    The estimate is aligned to the truth, the graph's own unless given. A GraphError if there is none, or sizes differ.
    """
    truth = graph.truth if truth is None else truth
    if truth is None:
        raise GraphError(f"{graph!r} came without a ground truth; give one as truth=")
    for given in (poses, truth):
        check_poses(graph, given)
    poses, truth = poses[graph.bodies], truth[graph.bodies]
    aligned = poses.aligned_to(truth)
    metres = np.linalg.norm(aligned.t - truth.t, axis=1)
    degrees = np.rad2deg(np.linalg.norm(log_map(np.swapaxes(truth.R, 1, 2) @ aligned.R), axis=1))
    with column_figure(height=1.6) as figure:
        from matplotlib.gridspec import GridSpec

        grid = GridSpec(3, 1, figure=figure, height_ratios=[3.2, 1, 1])
        axes = figure.add_subplot(grid[0], projection="3d" if graph.d == 3 else None)
        axes.plot(*truth.t.T, color="black", linewidth=0.8, label="truth")
        axes.plot(*aligned.t.T, color=COLOURS[0], linewidth=0.8, label="estimate, aligned")
        errors = list(np.stack([aligned.t, truth.t], axis=1))
        axes.add_collection(_line_collection(graph.d)(errors, colors=ALARM_COLOUR, linewidths=0.5, label="error"))
        _frame(axes, np.concatenate([aligned.t, truth.t]))
        ate = absolute_trajectory_error(poses, truth)
        axes.set_title(f"{graph.name}: ATE {ate:.3g} m, rotation {np.sqrt(np.mean(degrees**2)):.3g} deg (rms)")
        above = figure.add_subplot(grid[1])
        below = figure.add_subplot(grid[2], sharex=above)
        for panel, error, label in ((above, metres, "position (m)"), (below, degrees, "rotation (deg)")):
            panel.plot(error, color=ALARM_COLOUR, linewidth=0.7)
            panel.set_ylabel(label)
            panel.set_ylim(bottom=0.0)
            panel.label_outer()
        below.set_xlabel("pose")
        count_along_x(below)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def _frame(axes: Axes, points: Array) -> None:
    """Equal scales, limits around points, (k, d), and labels with the unit."""
    from mpl_toolkits.mplot3d import Axes3D

    lower, upper = points.min(axis=0), points.max(axis=0)
    margin = 1.0 if points.shape[1] == 3 else 1.04  # in space the axes have a margin of their own
    middle, half = (lower + upper) / 2, max(margin * float((upper - lower).max()) / 2, 1e-9)
    for letter, centre in zip("xyz", middle, strict=False):
        getattr(axes, f"set_{letter}lim")(centre - half, centre + half)
        getattr(axes, f"set_{letter}label")(f"{letter} (m)")
    if isinstance(axes, Axes3D):
        axes.set_box_aspect((1, 1, 1), zoom=_ZOOM)
    else:
        axes.set_aspect("equal")


def _line_collection(d: int) -> type[LineCollection]:
    from matplotlib.collections import LineCollection
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    return LineCollection if d == 2 else Line3DCollection


def _legend(graph: PoseGraph, kind: IntArray) -> list[Line2D]:
    from matplotlib.lines import Line2D

    handles = []
    if 1 < graph.num_robots <= _MOST_NAMED_ROBOTS:
        handles = [Line2D([], [], color=COLOURS[a], label=f"robot {a}") for a in range(graph.num_robots)]
    style = {one: (QUIET_COLOUR, "solid") for one in (SIGHTING, BETWEEN)}
    style |= {UNCERTAIN: (COLOURS[0], "dotted"), MISFIT: (ALARM_COLOUR, "solid")}
    for one, label in KIND_LABELS.items():
        if (kind == one).any():
            colour, line = style[one]
            handles.append(Line2D([], [], color=colour, linestyle=line, linewidth=2 * _WIDTHS[one], label=label))
    return handles
