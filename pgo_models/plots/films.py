"""Films: plotly figures with a slider and a play button over the iterates of a method.

A film is a picture for every iterate, all of them in one figure, so that it also works on a page
without Python behind it. It is kept small: a notebook with some films has to open on a telephone.
"""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pgo_models.errors import GraphError, SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.graphs.residuals import check_poses
from pgo_models.plots import graph_plots
from pgo_models.plots.interactive_plots import Trace, layout_around
from pgo_models.plots.style import COLOURS, QUIET_COLOUR, plotly

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

MOST_BYTES = 300_000  # of a film in a page, which stays quick to open with a few of them
MOST_FRAMES = 24  # six seconds at `_FRAME_MILLISECONDS`
_BYTES_OF_LINES = 0.85 * MOST_BYTES  # the rest is for the layout and for other traces
_SHARE_OF_PATHS = 0.7  # of these
_FRAME_MILLISECONDS = 250
_POINTS_ACROSS = 1000  # coordinates are rounded to this part of the extent


def animate(
    frames: Sequence[Sequence[Mapping[str, object]]],
    labels: Sequence[str],
    *,
    still: Sequence[Mapping[str, object]] = (),
    layout: Mapping[str, object] | None = None,
    title: str = "",
    description: str = "",
) -> Figure:
    """Film of pictures that are drawn by plotly traces, with a slider and a play button.

    In a page of `save_page` the arrow keys step and the space bar plays.

    A film of more than 300 kB is refused.

    Parameters
    ----------
    frames : sequence of sequences of dict
        What each picture draws: the same number of plotly traces in each, for example
        `{"x": [0.0, 1.0], "y": [1.0, 0.0], "mode": "lines"}`.
    labels : sequence of str
        What the slider says of each picture; no two alike.
    still : sequence of dict
        Traces that stand in every picture, below the others.
    layout : dict, optional
        Further properties of the layout, as of `plotly.graph_objects.Layout`.
    title : str
        Title of the figure.
    description : str
        What is to be seen, in words, for those who cannot see it.

    Examples
    --------
    A point on its way along a line:

    >>> points = [[{"x": [k], "y": [2 * k], "mode": "markers"}] for k in range(5)]
    >>> film = animate(points, [f"k = {k}" for k in range(5)], description="A point moves up.")
    >>> [frame.name for frame in film.frames]
    ['k = 0', 'k = 1', 'k = 2', 'k = 3', 'k = 4']
    """
    go = plotly("graph_objects")
    _check_frames(frames, labels)
    moving = list(range(len(still), len(still) + len(frames[0])))
    pictures = [
        go.Frame(data=list(frame), name=label, traces=moving)
        for frame, label in zip(frames, labels, strict=True)
    ]
    figure = go.Figure(data=[*still, *frames[0]], frames=pictures)
    figure.update_layout(
        template="none",
        title={"text": html.escape(title), "font": {"size": 14}, "x": 0.02, "xanchor": "left"},
        margin={"l": 50, "r": 10, "t": 40 if title else 10, "b": 20},
        meta={"description": description},
        sliders=[_slider(labels)],
        updatemenus=[_play_buttons()],
    )
    figure.update_layout(**dict(layout or {}))
    num_bytes = len(figure.to_json())
    if num_bytes > MOST_BYTES:
        most = len(frames) * MOST_BYTES // num_bytes
        raise SettingError(
            f"the film has {num_bytes / 1e3:.0f} kB in {len(frames)} frames, 300 are for a film; "
            f"show at most {most} of them, or less in each"
        )
    return figure


def _check_frames(frames: Sequence[Sequence[object]], labels: Sequence[str]) -> None:
    if not frames:
        raise SettingError("a film has no frames; give at least one")
    if len(labels) != len(frames):
        raise SettingError(f"{len(labels)} labels for {len(frames)} frames; give one each")
    if len(set(labels)) < len(labels):
        raise SettingError("two frames have the same label; give each its own")
    sizes = sorted({len(frame) for frame in frames})
    if len(sizes) > 1:
        raise SettingError(
            f"frames have {sizes[0]} to {sizes[-1]} traces; draw the same ones in each, "
            "empty where there is nothing to see"
        )


def animate_poses(
    graph: PoseGraph, iterates: Sequence[Poses], labels: Sequence[str] | None = None
) -> Figure:
    """Film of the poses of iterates.

    Edges are drawn straight between the positions of every iterate, in the colours of their robots.
    The film has the first and the last iterate and at most 22 of those between them, as many from
    the early ones as from the late. Of a large graph some lines are drawn (`lines_to_draw`).
    Iterates are aligned with the last one, so that only what changes moves.

    Parameters
    ----------
    graph : PoseGraph
        Graph whose edges are drawn.
    iterates : sequence of Poses
        For example `[soc.poses(problem, state) for state in islice(iterate(soc, problem), 30)]`.
    labels : sequence of str, optional
        What the slider says of each; `k = 0`, `k = 1`, .. unless given.

    Examples
    --------
    >>> from pgo_models import spanning_tree_start
    >>> from pgo_models.graphs.scenes import grid
    >>> graph = grid(np.random.default_rng(0))
    >>> film = animate_poses(graph, [spanning_tree_start(graph), graph.truth], ["tree", "truth"])
    >>> len(film.frames)
    2
    """
    if not iterates:
        raise GraphError("there are no iterates; give at least one set of poses")
    if labels is None:
        labels = [f"k = {k}" for k in range(len(iterates))]
    if len(labels) != len(iterates):
        raise GraphError(f"{len(labels)} labels for {len(iterates)} iterates; give one each")
    iterates = [check_poses(graph, poses) for poses in iterates]
    shown = frames_to_show(len(iterates))
    drawn = GraphFrames.of(graph, [iterates[k] for k in shown])
    frames = [drawn.traces(k) for k in range(len(shown))]
    title = f"{graph.name}: {len(iterates)} iterates"
    description = (
        f"The poses of {graph.name} in {len(shown)} of {len(iterates)} iterates, "
        f"from {labels[0]} to {labels[-1]}."
    )
    return animate(
        frames,
        [labels[k] for k in shown],
        layout=drawn.layout(),
        title=title,
        description=description,
    )


def frames_to_show(count: int, most: int = MOST_FRAMES) -> list[int]:
    """At most so many of `count` iterates: the first, the last, and early ones more densely.

    Their numbers k + 1 are in geometric progression, as most that is to be seen happens early.
    """
    spaced = np.geomspace(1.0, count, min(count, most)) - 1.0
    return [int(k) for k in np.unique(spaced.round())]


class GraphFrames:
    """Pictures of one graph at several poses, all on the same scale."""

    def __init__(self, positions: list[Array], lines: list[tuple[str, str, IntArray]]) -> None:
        """Positions, (n, d) each, and the lines: name, colour, and ends (l, 2) of each kind."""
        self.positions = positions
        self.lines = lines
        every = np.concatenate(positions)
        self.lower = every.min(axis=0)
        self.upper = every.max(axis=0)

    @classmethod
    def of(cls, graph: PoseGraph, iterates: Sequence[Poses]) -> GraphFrames:
        """Pictures of iterates, aligned with the last, with as many lines as there is room for."""
        positions = [poses.aligned_to(iterates[-1]).t for poses in iterates]
        every = np.concatenate(positions)
        extent = max(float(np.ptp(every, axis=0).max()), 1e-9)
        digits = int(np.ceil(np.log10(_POINTS_ACROSS / extent)))
        positions = [t.round(digits) for t in positions]
        ends = _lines_that_fit(graph, positions[0], len(positions))
        return cls(positions, _lines_of_robots(graph, ends))

    def traces(self, k: int) -> list[Trace]:
        """What picture k draws: a trace for the lines of every robot."""
        t = self.positions[k]
        return [
            {
                **_polyline(t, ends),
                "name": name,
                "line": {"color": colour, "width": 1.5},
                "showlegend": len(self.lines) > 1,
            }
            for name, colour, ends in self.lines
        ]

    def layout(self) -> dict[str, object]:
        """Axes around all pictures, with equal scales."""
        return layout_around(self.lower, self.upper)


def _lines_that_fit(graph: PoseGraph, t: Array, num_frames: int) -> IntArray:
    """Pairs of poses to join by lines, (l, 2), at positions t, for all edges if these are not many.

    Else there are paths of consecutive poses, which take few numbers and show the shape, through
    every k-th pose, and every k'-th of the other edges as far as there is room for them.
    """
    drawn = np.where(graph.is_prior, graph_plots.NOT_DRAWN, graph_plots.OWN)
    is_consecutive = graph.j == graph.i + 1
    paths = np.where(is_consecutive, drawn, graph_plots.NOT_DRAWN)
    others = np.stack([graph.i, graph.j], axis=1)[~is_consecutive & ~graph.is_prior]
    most = graph.num_edges
    while True:
        along_paths, _ = graph_plots.lines_to_draw(graph, paths, most)
        if num_frames * _num_bytes(t, along_paths) <= _SHARE_OF_PATHS * _BYTES_OF_LINES:
            break
        most = int(0.8 * most)
    step = 1
    while True:
        ends = np.concatenate([along_paths, others[::step]])
        if num_frames * _num_bytes(t, ends) <= _BYTES_OF_LINES:
            return ends
        step += 1 + step // 4


def _num_bytes(t: Array, ends: IntArray) -> int:
    """Size of the lines in a page."""
    return len(json.dumps(_polyline(t, ends), separators=(",", ":")))


def _lines_of_robots(graph: PoseGraph, ends: IntArray) -> list[tuple[str, str, IntArray]]:
    """Lines of every robot, then those between robots: name, colour, and ends (l, 2)."""
    robot_i, robot_j = graph.robots[ends].T
    lines = []
    for robot in range(graph.num_robots):
        inside = ends[(robot_i == robot) & (robot_j == robot)]
        if len(inside):
            lines.append((f"robot {robot}", COLOURS[robot % len(COLOURS)], inside))
    between = ends[robot_i != robot_j]
    if len(between):
        lines.append(("between robots", QUIET_COLOUR, between))
    return lines


def _polyline(t: Array, ends: IntArray) -> Trace:
    """A trace for many lines between positions, (l, 2), with None for a gap, as plotly has it."""
    path = _path_along(ends)
    coordinates = []
    for column in t.T:
        values: list[float | None] = column[path].tolist()
        for place in np.flatnonzero(path < 0):
            values[place] = None
        coordinates.append(values)
    names = ("x", "y", "z")[: len(coordinates)]
    trace: Trace = dict(zip(names, coordinates, strict=True))
    kind = "scatter" if len(coordinates) == 2 else "scatter3d"
    return {**trace, "type": kind, "mode": "lines", "hoverinfo": "skip"}


def _path_along(ends: IntArray) -> IntArray:
    """Poses along lines, (l, 2), one after the other, with -1 for a gap between two of them.

    A line that begins where the one before has ended goes on from there.
    """
    begins_anew = np.append(True, ends[1:, 0] != ends[:-1, 1])
    stops = np.stack([np.full(len(ends), -1), ends[:, 0], ends[:, 1]], axis=1)
    is_used = np.stack([begins_anew, begins_anew, np.ones_like(begins_anew)], axis=1)
    return np.asarray(stops[is_used][1:])  # no gap before the first line


def _slider(labels: Sequence[str]) -> dict[str, object]:
    """Slider with a step for every frame."""
    at_once = _frame_options(0)
    return {
        "steps": [_button(label, [[label], at_once]) for label in labels],
        "x": 0.0,
        "len": 1.0,
        "pad": {"t": 70},
        "currentvalue": {"prefix": "", "font": {"size": 13, "color": "#444444"}},
        # The label of the current frame stands above; those of all would overlap.
        "font": {"color": "rgba(0,0,0,0)"},
    }


def _play_buttons() -> dict[str, object]:
    """Buttons to play from the current frame on, and to pause."""
    play = {**_frame_options(_FRAME_MILLISECONDS), "fromcurrent": True}
    return {
        "type": "buttons",
        "direction": "left",
        "buttons": [_button("play", [None, play]), _button("pause", [[None], _frame_options(0)])],
        "x": 0.0,
        "xanchor": "left",
        "y": 0.0,
        "yanchor": "top",
        "pad": {"t": 30},
    }


def _frame_options(milliseconds: int) -> dict[str, object]:
    """Options of plotly's `animate`: how long a frame is shown."""
    return {
        "frame": {"duration": milliseconds, "redraw": True},
        "mode": "immediate",
        "transition": {"duration": 0},
    }


def _button(label: str, args: list[object]) -> dict[str, object]:
    """Button that calls plotly's `animate`."""
    return {"label": label, "method": "animate", "args": args}
