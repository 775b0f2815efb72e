"""Pictures to explore with plotly (extra `plot`): a graph to turn and hover over, and a film of iterates."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pgo_models.errors import GraphError
from pgo_models.files import replace_when_done
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

_MOST_NAMED_ROBOTS = 12
MOST_DOTS, _MOST_BEHIND = 20_000, 10_000  # poses that say their names, and lines of where they were before
_FILM_BYTES = 8_000_000
_BYTES_PER_NUMBER = 7.5  # a float32 in base64, of which plotly writes every / as six characters
_FRAME_MILLISECONDS = 150
# Nothing on a page leaves it: plotly's button to share a chart uploads it.
PAGE_CONFIG: dict[str, object] = {"displaylogo": False, "showSendToCloud": False, "responsive": True}
PAGE_CONFIG |= {"modeBarButtonsToRemove": ["sendChartToCloud"]}


def explore_graph(
    graph: PoseGraph,
    poses: Poses,
    title: str = "",
    covariances: Array | None = None,
    residuals: EdgeResiduals | None = None,
    before: Poses | None = None,
) -> Figure:
    """Plotly figure of a graph by robot; poses and misfitting edges say who they are under the pointer.

    Of a large graph, what `lines_to_draw` leaves, and some of the poses; one of a single robot is parted by time.
    Positions are drawn to seven digits (float32); covariances, (n, p, p), as `confidence_ellipses`; poses `before` in
    grey, moved to fit. `residuals` are those of F unless given: give those of the problem that was solved.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> graph = grid(np.random.default_rng(0))
    >>> [trace.name for trace in explore_graph(graph, graph.truth).data]
    ['edges and poses', 'edges and poses', 'misfit']
    """
    go = plotly("graph_objects")
    residuals = residuals or edge_residuals(graph, poses)
    kind = graph_plots.edge_kinds(graph, poses, residuals=residuals)
    names, several, named = np.array(pose_names(graph)), graph.num_robots > 1, graph.in_files
    ends, kinds = graph_plots.lines_to_draw(graph, kind)
    traces = []
    if before is not None:
        behind, _ = graph_plots.lines_to_draw(graph, np.where(kind < 0, kind, graph_plots.OWN), _MOST_BEHIND)
        traces.append(_lines(before.aligned_to(poses).t, behind, "before", QUIET_COLOUR, 0.7, "solid", True))
    part, labels = _parts(graph, names)
    dots = named[:: graph_plots.thinning_step(len(named), MOST_DOTS)]
    for a, name in enumerate(labels):
        mine, colour = dots[part[dots] == a], COLOURS[a % len(COLOURS)]
        own = (kinds == graph_plots.OWN) & (part[ends[:, 0]] == a)
        own_lines = _lines(poses.t, ends[own], name, colour, 1.0, "solid", False)
        text = [f"pose {names[k]}, robot {graph.robots[k]}" if several else f"pose {names[k]}" for k in mine]
        # One entry of the legend shows and hides both; a robot may have no edge of its own, but has poses.
        for trace, shown in ((own_lines, False), (_dots(poses.t[mine], text, name, colour, 4.0), True)):
            traces.append({**trace, "legendgroup": name, "showlegend": shown})
    for one, colour, width, dash in (
        (graph_plots.SIGHTING, QUIET_COLOUR, 0.3, "solid"),
        (graph_plots.BETWEEN, QUIET_COLOUR, 1.0, "solid"),
        (graph_plots.UNCERTAIN, QUIET_COLOUR, 1.5, "dot"),
        (graph_plots.MISFIT, ALARM_COLOUR, 5.0, "solid"),
    ):
        if (kinds == one).any():
            traces.append(_lines(poses.t, ends[kinds == one], graph_plots.KIND_LABELS[one], colour, width, dash, True))
    misfits = np.flatnonzero(kind == graph_plots.MISFIT)
    misfits = misfits[:: graph_plots.thinning_step(len(misfits), MOST_DOTS)]
    middles = 0.5 * (poses.t[graph.i[misfits]] + poses.t[graph.j[misfits]])
    traces.append(_dots(middles, _misfit_text(graph, misfits, residuals), "misfit", ALARM_COLOUR, 6.0))
    if covariances is not None:
        ellipses = graph_plots.confidence_ellipses(poses[named], covariances[named])
        outlines = np.pad(ellipses, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan)
        gaps, line = outlines.reshape(-1, graph.d), {"color": QUIET_COLOUR, "width": 1.0}
        traces.append({**_points(gaps), "mode": "lines", "line": line, "name": "95 % of x, y", "hoverinfo": "skip"})
    figure = go.Figure(traces)
    _arrange(figure, poses.t[named], title)
    return figure


def animate_poses(graph: PoseGraph, iterates: Sequence[Poses], labels: Sequence[str] | None = None) -> Figure:
    """Plotly film of iterates with a slider and a play button, to step through.

    Edges are drawn straight between the positions of every iterate; the colours are the robots'. A film of a large
    graph is thinned evenly to about 8 MB, first and last iterate kept.

    Iterates, for example `[soc.poses(problem, state) for state in itertools.islice(iterate(soc, problem), 30)]`, are
    aligned with the last one, so that only what changes moves. The slider shows `labels`; `k = 0`, `k = 1`, .. unless
    given. A GraphError when there are no iterates, their labels are not as many, or they are not poses of the graph.
    """
    go = plotly("graph_objects")
    if not iterates:
        raise GraphError("there are no iterates; give at least one set of poses")
    names = [f"k = {k}" for k in range(len(iterates))] if labels is None else list(labels)
    if len(names) != len(iterates):
        raise GraphError(f"{len(names)} labels for {len(iterates)} iterates; give one each")
    for poses in iterates:
        check_poses(graph, poses)
    most = max(2, int(_FILM_BYTES / (3 * graph.d * graph.num_edges * _BYTES_PER_NUMBER)))
    shown = np.unique(np.linspace(0, len(iterates) - 1, min(len(iterates), most)).round().astype(int)).tolist()
    positions = [iterates[k].aligned_to(iterates[-1]).t for k in shown]
    names = [names[k] for k in shown]
    owner = np.where(graph.robots[graph.i] == graph.robots[graph.j], graph.robots[graph.i], -1)
    owner[graph.is_prior] = -2  # not drawn

    def traces(t: Array) -> list[Trace]:
        drawn = []
        for a in [*range(graph.num_robots), -1]:
            if (owner == a).any():
                ends = np.stack([graph.i, graph.j], axis=1)[owner == a]
                name = "between robots" if a < 0 else f"robot {a}"
                colour = QUIET_COLOUR if a < 0 else COLOURS[a % len(COLOURS)]
                in_legend = graph.num_robots > 1 and a < _MOST_NAMED_ROBOTS
                drawn.append(_lines(t, ends, name, colour, 1.0, "solid", in_legend))
        return drawn

    frames = [go.Frame(data=traces(t), name=name) for t, name in zip(positions, names, strict=True)]
    figure = go.Figure(data=traces(positions[0]), frames=frames)
    _arrange(figure, np.concatenate(positions), f"{graph.name}: {len(iterates)} iterates")
    _add_controls(figure, names)
    return figure


def lay_out(figure: Figure, title: str, legend_y: float) -> None:
    """White ground, narrow margins, the legend in a row at a height in figure heights, 0 at the foot of the axes."""
    head = {"text": html.escape(title), "font": {"size": 14}}
    margin = {"l": 80, "r": 10, "t": 40 if title else 10, "b": 50}
    legend = {"itemsizing": "constant", "orientation": "h", "y": legend_y}
    figure.update_layout(template="none", title=head, margin=margin, legend=legend, hovermode="closest")


def save_page(figure: Figure, path: Path | str) -> None:
    """Write a plotly figure as an HTML page that opens offline, about 5 MB more; errors as `replace_when_done`."""
    page = figure.to_html(include_plotlyjs=True, config=PAGE_CONFIG, auto_play=False, default_height="96vh")
    with replace_when_done(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _parts(graph: PoseGraph, names: NDArray[np.str_]) -> tuple[IntArray, list[str]]:
    """Part of every pose, (n,), that an entry of the legend shows and hides, and the entries: robots, or times."""
    if graph.num_robots == 1 and graph.num_edges <= graph_plots.MOST_LINES:
        return graph.robots, ["edges and poses"]
    owner, what = (graph.robots, "robot") if graph.num_robots > 1 else (np.arange(graph.num_poses), "pose")
    count = int(owner.max()) + 1
    parts = min(count, _MOST_NAMED_ROBOTS if what == "robot" else len(COLOURS))
    part = owner * parts // count
    of_part = [owner[part == a] for a in range(parts)]
    spans = [(int(own.min()), int(own.max())) for own in of_part]
    called = names if what == "pose" else np.arange(count).astype(str)
    said = [f"{what} {called[a]}" if a == b else f"{what}s {called[a]} to {called[b]}" for a, b in spans]
    return part, said


def _points(points: Array) -> Trace:
    """Trace at points, (k, d), which plotly packs as float32 in base64."""
    x, y, *z = np.ascontiguousarray(points.T, dtype=np.float32)
    return {"type": "scatter3d", "x": x, "y": y, "z": z[0]} if z else {"type": "scattergl", "x": x, "y": y}


def _lines(t: Array, ends: IntArray, name: str, colour: str, width: float, dash: str, in_legend: bool) -> Trace:
    """One trace for many lines between poses, (l, 2): start, end, and a gap."""
    d = t.shape[1]
    points = np.full((len(ends), 3, d), np.nan)
    points[:, :2] = t[ends]
    line = {"color": colour, "width": width if d == 2 else 2.0 * width, "dash": dash}
    shown = {"name": name, "hoverinfo": "skip", "showlegend": in_legend}
    return {**_points(points.reshape(-1, d)), "mode": "lines", "line": line, **shown}


def _dots(points: Array, text: list[str], name: str, colour: str, size: float) -> Trace:
    marker = {"color": colour, "size": size if points.shape[1] == 2 else 0.6 * size}
    said = {"text": text, "hovertemplate": "%{text}<extra></extra>", "name": name, "showlegend": False}
    return {**_points(points), "mode": "markers", "marker": marker, **said}


def _misfit_text(graph: PoseGraph, edges: IntArray, residuals: EdgeResiduals) -> list[str]:
    names, share = pose_names(graph), residuals.share
    times = residuals.cost / np.where(residuals.allowed > 0.0, residuals.allowed, 1.0)
    return [
        f"edge {e}: {names[graph.i[e]]} to {names[graph.j[e]]}<br>{times[e]:.3g} times what it may cost, "
        f"{100 * share[e]:.3g} % of all<br>"
        f"{residuals.translation[e]:.3g} m"
        + (f", {np.rad2deg(residuals.rotation[e]):.3g} deg" if graph.kappa[e] > 0 else "")
        for e in edges
    ]


def _arrange(figure: Figure, points: Array, title: str) -> None:
    lay_out(figure, title, legend_y=-0.12 if points.shape[1] == 2 else 0.0)
    lower, upper = points.min(axis=0), points.max(axis=0)
    if points.shape[1] == 2:
        margin = 0.04 * float((upper - lower).max())
        (left, low), (right, high) = lower - margin, upper + margin
        plain = {"zeroline": False, "gridcolor": "#eeeeee"}
        figure.update_xaxes(title_text="x (m)", range=[left, right], **plain)
        figure.update_yaxes(title_text="y (m)", range=[low, high], scaleanchor="x", **plain)
        return
    middle, half = (lower + upper) / 2, max(0.52 * float((upper - lower).max()), 1e-9)
    for letter, centre in zip("xyz", middle.tolist(), strict=True):
        axis = {"title": {"text": f"{letter} (m)"}, "range": [centre - half, centre + half]}
        figure.update_scenes({f"{letter}axis": axis})
    figure.update_scenes(aspectmode="cube")


def _add_controls(figure: Figure, names: list[str]) -> None:
    def shown(milliseconds: int) -> dict[str, object]:
        return {"frame": {"duration": milliseconds, "redraw": True}, "mode": "immediate", "transition": {"duration": 0}}

    steps = [{"args": [[name], shown(0)], "label": name, "method": "animate"} for name in names]
    presses = {"play": [None, {**shown(_FRAME_MILLISECONDS), "fromcurrent": True}], "pause": [[None], shown(0)]}
    buttons = [{"label": label, "method": "animate", "args": args} for label, args in presses.items()]
    figure.update_layout(
        margin={"b": 20},
        legend={"orientation": "v", "x": 0.0, "y": 1.0, "yanchor": "top"},
        sliders=[{"steps": steps, "x": 0.16, "len": 0.84, "pad": {"t": 45}, "currentvalue": {"prefix": ""}}],
        updatemenus=[{"type": "buttons", "direction": "left", "buttons": buttons, "x": 0.13, "y": 0, "pad": {"t": 60}}],
    )
