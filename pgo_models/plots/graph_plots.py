"""Figures of pose graphs with matplotlib (extra `plot`).

Robots have colours, doubtful edges are marked, and estimates are compared with the truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pgo_models.errors import GraphError
from pgo_models.geometry.arrays import check_shape
from pgo_models.geometry.poses import Poses, absolute_trajectory_error
from pgo_models.geometry.rotations import Array, BoolArray, log_map
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

# Kinds of edges, in the order in which they are drawn: a landmark that is seen, one robot's own
# edges, those between robots, and the two kinds of marked edges.
SIGHTING, OWN, BETWEEN, UNCERTAIN, MISFIT = range(5)
NOT_DRAWN = -1  # kind of priors: below those that are drawn
_WIDTHS = np.array([0.15, 0.6, 0.5, 0.5, 1.8])  # points, of every kind
KIND_LABELS = {
    SIGHTING: "a landmark seen",
    BETWEEN: "between robots",
    UNCERTAIN: "uncertain: precision under a tenth of the median",
    MISFIT: "misfit: costs more than its information allows",
}
MOST_LINES = 40_000  # of a figure
_MOST_ELLIPSES = 100  # more of them hide the map
_ELLIPSE_POINTS = 49  # the first is the last
_ZOOM = 0.82  # leaves room for the labels of axes in space, which the layout does not see
_MOST_NAMED_ROBOTS = len(COLOURS)


def edge_kinds(
    graph: PoseGraph, poses: Poses, mark: bool = True, residuals: EdgeResiduals | None = None
) -> IntArray:
    """Kind of every edge, (m,): SIGHTING, OWN, BETWEEN, UNCERTAIN or MISFIT.

    With `mark`, UNCERTAIN and MISFIT take precedence over the others. Misfits are of F unless
    `residuals` are given. Priors, which are not drawn, are -1. A GraphError if sizes differ.
    """
    poses = check_poses(graph, poses)
    robot_i = graph.robots[graph.i]
    robot_j = graph.robots[graph.j]
    kind = np.where(robot_i == robot_j, OWN, BETWEEN)
    kind[np.isin(graph.j, graph.landmarks)] = SIGHTING
    if mark:
        if residuals is None:
            residuals = edge_residuals(graph, poses)
        kind[uncertain_edges(graph)] = UNCERTAIN
        kind[residuals.is_misfit] = MISFIT
    kind[graph.is_prior] = NOT_DRAWN
    return kind


def lines_to_draw(
    graph: PoseGraph, kind: IntArray, most: int = MOST_LINES
) -> tuple[IntArray, IntArray]:
    """Pairs of poses to join by lines, (l, 2), and the kinds of the lines, (l,).

    `kind`, (m,), is that of every edge. The lines are all edges but priors while these are at most
    `most`. Otherwise, with k = `thinning_step`, they are the paths of consecutive edges through
    every k-th pose, every k-th of the other edges, and the misfits. Lines that should stand out are
    the last.
    """
    ends = np.stack([graph.i, graph.j], axis=1)
    step = thinning_step(graph.num_edges, most)
    if step > 1:
        is_consecutive = graph.j == graph.i + 1
        is_on_path = (kind == OWN) & is_consecutive
        paths = _thinned_paths(graph, is_on_path, step)
        is_misfit = kind == MISFIT
        is_other = (kind != NOT_DRAWN) & ~is_misfit & ~is_on_path
        misfits = np.flatnonzero(is_misfit)
        others = np.flatnonzero(is_other)
        drawn_misfits = misfits[:: thinning_step(len(misfits), most)]
        drawn = np.append(others[::step], drawn_misfits)
        kind_of_paths = np.full(len(paths), OWN)
        ends = np.concatenate([paths, ends[drawn]])
        kind = np.append(kind_of_paths, kind[drawn])
    order = np.argsort(kind, kind="stable")
    num_not_drawn = int(np.sum(kind == NOT_DRAWN))  # their kind is the lowest
    order = order[num_not_drawn:]
    return ends[order], kind[order]


def _thinned_paths(graph: PoseGraph, is_on_path: BoolArray, step: int) -> IntArray:
    """Lines, (l, 2), along paths of edges (k, k + 1), through every `step`-th pose of a path.

    The last pose of a path is kept, too.
    """
    pose = np.arange(graph.num_poses)
    has_edge_before = np.zeros(graph.num_poses + 1, dtype=bool)
    has_edge_before[graph.j[is_on_path]] = True
    is_first = ~has_edge_before[:-1]
    is_last = ~has_edge_before[1:]
    first_so_far = np.where(is_first, pose, 0)
    first_of_path = np.maximum.accumulate(first_so_far)
    place_in_path = pose - first_of_path
    kept = np.flatnonzero((place_in_path % step == 0) | is_last)
    before = kept[:-1]
    after = kept[1:]
    lines = np.stack([before, after], axis=1)
    same_path = first_of_path[before] == first_of_path[after]
    return np.asarray(lines[same_path])


def thinning_step(count: int, most: int) -> int:
    """Step k for which every k-th of `count` things are at most `most`."""
    return max(1, -(-count // most))


def covariances_to_draw(covariances: Array | None, graph: PoseGraph) -> Array | None:
    """Covariances, (n, p, p), without that of the world pose; a SettingError for other shapes."""
    if covariances is None:
        return None
    shown = graph.in_files
    p = graph.d * (graph.d + 1) // 2
    drawn = covariances[shown] if len(covariances) == graph.num_poses else covariances
    check_shape(drawn, (len(shown), p, p), "covariances")
    return drawn


def confidence_ellipses(poses: Poses, covariances: Array) -> Array:
    """Outlines, (k, 49, d) points, of ellipses that hold the true x and y with 95 %.

    In space they are at the height of the pose. The covariances, (n, p, p), are those of
    `Marginals`, with moves along the axes of the world first. At most 100 poses have an ellipse,
    evenly chosen.
    """
    num_ellipses = min(poses.num_poses, _MOST_ELLIPSES)
    evenly = np.linspace(0, poses.num_poses - 1, num_ellipses)
    chosen = evenly.astype(int)
    angle = np.linspace(0.0, 2.0 * np.pi, _ELLIPSE_POINTS)
    x = np.cos(angle)
    y = np.sin(angle)
    circle = np.stack([x, y], axis=1)
    covariances_of_xy = covariances[chosen, :2, :2]
    variances, axes = np.linalg.eigh(covariances_of_xy)
    variances = np.maximum(variances, 0.0)
    # The squared radius is exponential, with mean 2 in units of the variance.
    radii = np.sqrt(-2.0 * np.log(0.05) * variances)
    scaled_axes = axes * radii[:, None]
    outlines = np.repeat(poses.t[chosen, None], _ELLIPSE_POINTS, axis=1)
    outlines[:, :, :2] += circle @ np.swapaxes(scaled_axes, 1, 2)
    return outlines


def draw_graph(
    graph: PoseGraph,
    poses: Poses,
    axes: Axes,
    mark_edges: bool = True,
    residuals: EdgeResiduals | None = None,
) -> None:
    """Draw edges between positions: each robot's own in its colour, those between robots in grey.

    The axes have projection "3d" for graphs in space. With `mark_edges`, edges with a low precision
    are dotted, and those that cost more than they may (`residuals`, those of F unless given) are
    thick and vermilion.
    """
    from matplotlib.colors import to_rgb

    poses = check_poses(graph, poses)
    kind_of_edge = edge_kinds(graph, poses, mark_edges, residuals)
    ends, kind = lines_to_draw(graph, kind_of_edge)
    names = (*COLOURS, QUIET_COLOUR, ALARM_COLOUR)
    palette = np.array([to_rgb(name) for name in names])
    quiet = len(COLOURS)
    alarm = quiet + 1
    robot_i, robot_j = graph.robots[ends].T
    colour_of_robot = robot_i % len(COLOURS)
    colour = np.where(robot_i == robot_j, colour_of_robot, quiet)
    colour[kind == SIGHTING] = quiet
    colour[kind == MISFIT] = alarm
    dotted = (0, (1, 1.5))
    dashes = [dotted if is_dotted else "solid" for is_dotted in kind == UNCERTAIN]
    collection = _line_collection(graph.d)
    lines = collection(
        list(poses.t[ends]),
        colors=palette[colour],
        linewidths=_WIDTHS[kind],
        linestyles=dashes,
        rasterized=graph.num_edges > MOST_LINES,
    )
    axes.add_collection(lines)
    _frame(axes, poses.t[graph.in_files])


def plot_graph(
    graph: PoseGraph,
    poses: Poses,
    title: str = "",
    covariances: Array | None = None,
    residuals: EdgeResiduals | None = None,
) -> Figure:
    """Plot a graph with matplotlib, its robots in colours, with a legend.

    Edges with a low precision are dotted, and misfits, which cost more than they may, are thick and
    vermilion.

    Parameters
    ----------
    graph, poses : PoseGraph, Poses
        Graph to draw, and a pose for every pose of it.
    title : str
        Title of the figure; the name of the graph unless given.
    covariances : Array, (n, p, p), optional
        Covariances of the poses (`marginals`), drawn as ellipses that hold x and y with 95 %.
    residuals : EdgeResiduals, optional
        Residuals that decide which edges are misfits; those of F unless given.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> graph = grid(np.random.default_rng(0))
    >>> plot_graph(graph, graph.truth, "27 poses").axes[0].get_title()
    '27 poses'
    """
    poses = check_poses(graph, poses)
    drawn = covariances_to_draw(covariances, graph)
    with column_figure(height=1.15) as figure:
        axes = _add_axes(figure, graph)
        draw_graph(graph, poses, axes, residuals=residuals)
        axes.set_title(title or graph.name)
        kind = edge_kinds(graph, poses, residuals=residuals)
        handles: list[Artist] = list(_legend(graph, kind))
        if drawn is not None:
            shown = graph.in_files
            outlines = confidence_ellipses(poses[shown], drawn)
            collection = _line_collection(graph.d)
            ellipses = collection(
                list(outlines),
                colors=QUIET_COLOUR,
                linewidths=0.3,
                zorder=1,
                label="95 % of x, y",
            )
            handles.append(axes.add_collection(ellipses))
            outlined = np.concatenate([poses.t[shown], outlines.reshape(-1, graph.d)])
            _frame(axes, outlined)  # no ellipse is cut off
        if handles:
            num_columns = 3 if graph.num_robots > 1 else 1
            figure.legend(handles=handles, loc="outside lower center", ncols=num_columns)
    return figure


def compare_poses(
    graph: PoseGraph,
    panels: Sequence[tuple[str, Poses]] | Poses,
    residuals: EdgeResiduals | None = None,
) -> Figure:
    """Plot several sets of poses of one graph side by side with matplotlib.

    Parameters
    ----------
    graph : PoseGraph
        Graph to draw.
    panels : list of (str, Poses), or Poses
        Title and poses of every panel; poses alone are one panel without a title.
    residuals : EdgeResiduals, optional
        Residuals at the poses of the last panel, in which edges are marked by them.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> graph = grid(np.random.default_rng(0))
    >>> figure = compare_poses(graph, [("truth", graph.truth), ("start", graph.initial)])
    >>> [axes.get_title() for axes in figure.axes]
    ['truth', 'start']
    """
    titled = [("", panels)] if isinstance(panels, Poses) else panels
    with column_figure(height=1.0, width=len(titled)) as figure:
        for column, (title, poses) in enumerate(titled, 1):
            axes = _add_axes(figure, graph, 1, len(titled), column)
            is_marked = residuals is not None and column == len(titled)
            draw_graph(graph, poses, axes, is_marked, residuals if is_marked else None)
            axes.set_title(title)
        if residuals is not None:
            handles = _legend(graph, edge_kinds(graph, titled[-1][1], residuals=residuals))
            if handles:
                figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def plot_against_truth(graph: PoseGraph, poses: Poses, truth: Poses | None = None) -> Figure:
    """Figure of an estimate on top of the truth, and of its errors pose by pose.

    The errors are in metres and degrees. The estimate is aligned to the truth, which is the graph's
    own unless given. A GraphError if there is none, or sizes differ.
    """
    if truth is None:
        truth = graph.truth
    if truth is None:
        raise GraphError(f"{graph!r} came without a ground truth; give one as truth=")
    poses = check_poses(graph, poses)
    truth = check_poses(graph, truth)
    poses = poses[graph.bodies]
    truth = truth[graph.bodies]
    aligned = poses.aligned_to(truth)
    t_error = aligned.t - truth.t
    metres = np.linalg.norm(t_error, axis=1)
    R_error = np.swapaxes(truth.R, 1, 2) @ aligned.R
    radians = np.linalg.norm(log_map(R_error), axis=1)
    degrees = np.rad2deg(radians)
    ate = absolute_trajectory_error(poses, truth)
    rotation_rms = np.sqrt(np.mean(degrees**2))
    with column_figure(height=1.6) as figure:
        from matplotlib.gridspec import GridSpec

        layout = GridSpec(3, 1, figure=figure, height_ratios=[3.2, 1, 1])
        axes = _add_axes(figure, graph, layout[0])
        _draw_errors(axes, aligned, truth)
        axes.set_title(f"{graph.name}: ATE {ate:.3g} m, rotation {rotation_rms:.3g} deg (rms)")
        upper = figure.add_subplot(layout[1])
        lower = figure.add_subplot(layout[2], sharex=upper)
        _draw_error_curve(upper, metres, "position (m)")
        _draw_error_curve(lower, degrees, "rotation (deg)")
        lower.set_xlabel("pose")
        count_along_x(lower)
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def _draw_errors(axes: Axes, estimate: Poses, truth: Poses) -> None:
    """Draw two trajectories, and a line between the two positions of every pose."""
    axes.plot(*truth.t.T, color="black", linewidth=0.8, label="truth")
    axes.plot(*estimate.t.T, color=COLOURS[0], linewidth=0.8, label="estimate, aligned")
    collection = _line_collection(truth.d)
    errors = np.stack([estimate.t, truth.t], axis=1)
    lines = collection(list(errors), colors=ALARM_COLOUR, linewidths=0.5, label="error")
    axes.add_collection(lines)
    all_points = np.concatenate([estimate.t, truth.t])
    _frame(axes, all_points)


def _draw_error_curve(axes: Axes, errors: Array, label: str) -> None:
    """Draw an error, (n,), over the poses."""
    axes.plot(errors, color=ALARM_COLOUR, linewidth=0.7)
    axes.set_ylabel(label)
    axes.set_ylim(bottom=0.0)
    axes.label_outer()


def _add_axes(figure: Figure, graph: PoseGraph, *place: object) -> Axes:
    """Axes in the plane or in space, at a place of the figure."""
    projection = "3d" if graph.d == 3 else None
    return figure.add_subplot(*place, projection=projection)


def _frame(axes: Axes, points: Array) -> None:
    """Set equal scales, limits around points, (k, d), and labels with the unit."""
    from mpl_toolkits.mplot3d import Axes3D

    lower = points.min(axis=0)
    upper = points.max(axis=0)
    extent = float((upper - lower).max())
    is_in_space = points.shape[1] == 3
    margin = 1.0 if is_in_space else 1.04  # in space the axes have a margin of their own
    middle = (lower + upper) / 2
    half = max(margin * extent / 2, 1e-9)
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
    """Entries of the legend: robots, if their colours are all different, and kinds of edges."""
    from matplotlib.lines import Line2D

    handles = []
    if 1 < graph.num_robots <= _MOST_NAMED_ROBOTS:
        for robot in range(graph.num_robots):
            line = Line2D([], [], color=COLOURS[robot], label=f"robot {robot}")
            handles.append(line)
    styles = {
        SIGHTING: (QUIET_COLOUR, "solid"),
        BETWEEN: (QUIET_COLOUR, "solid"),
        UNCERTAIN: (COLOURS[0], "dotted"),
        MISFIT: (ALARM_COLOUR, "solid"),
    }
    for this_kind, label in KIND_LABELS.items():
        if (kind == this_kind).any():
            colour, dash = styles[this_kind]
            width = 2 * _WIDTHS[this_kind]
            line = Line2D([], [], color=colour, linestyle=dash, linewidth=width, label=label)
            handles.append(line)
    return handles
