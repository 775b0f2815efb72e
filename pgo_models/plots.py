"""Pictures of pose graphs with matplotlib (extra `plot`), colour-blind safe and with units."""

from __future__ import annotations

from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pgo_models.errors import GraphError, MissingExtraError
from pgo_models.files import replace_when_done
from pgo_models.pose_graph import PoseGraph
from pgo_models.poses import Poses
from pgo_models.rotations import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe & Ito 2008: told apart by readers with any of the common colour blindnesses.
_ROBOT_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_BETWEEN_COLOUR = "#999999"
_PICTURE_SUFFIXES = (".png", ".svg", ".pdf")
_PANEL_INCHES = 4.2


def draw_graph(graph: PoseGraph, poses: Poses, axes: Axes) -> None:
    """Draw positions and edges: each robot's own edges in its colour, those between robots in grey.

    Parameters
    ----------
    graph : PoseGraph
    poses : Poses
    axes : matplotlib Axes
        Of projection "3d" for graphs in space.

    Raises
    ------
    GraphError
        When the poses are not those of the graph.
    """
    if poses.t.shape != (graph.num_poses, graph.d):
        raise GraphError(f"{poses} beside {graph!r}; give one pose for every pose of the graph")
    from matplotlib.collections import LineCollection
    from mpl_toolkits.mplot3d import Axes3D
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    segments = np.stack([poses.t[graph.i], poses.t[graph.j]], axis=1)
    owner = np.where(graph.robots[graph.i] == graph.robots[graph.j], graph.robots[graph.i], -1)
    palette = np.array([*_ROBOT_COLOURS, _BETWEEN_COLOUR])
    colours = palette[np.where(owner >= 0, owner % len(_ROBOT_COLOURS), len(_ROBOT_COLOURS))]
    collection = LineCollection if graph.d == 2 else Line3DCollection
    axes.add_collection(collection(list(segments), colors=colours.tolist(), linewidths=0.6))
    lower, upper = poses.t.min(axis=0), poses.t.max(axis=0)
    middle, half = (lower + upper) / 2, max(float((upper - lower).max()) / 2, 1e-9)
    for letter, centre in zip("xyz", middle, strict=False):
        getattr(axes, f"set_{letter}lim")(centre - half, centre + half)
        getattr(axes, f"set_{letter}label")(f"{letter} (m)")
    if isinstance(axes, Axes3D):
        axes.set_box_aspect((1, 1, 1), zoom=0.88)  # the limits are a cube; the zoom leaves room for the labels
    else:
        axes.set_aspect("equal")


def compare_poses(graph: PoseGraph, panels: list[tuple[str, Poses]]) -> Figure:
    """Figure with one panel for every (title, poses), side by side.

    Raises
    ------
    MissingExtraError
        Without matplotlib.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("matplotlib", "plot") from error
    figure = Figure(figsize=(_PANEL_INCHES * len(panels), _PANEL_INCHES), layout="constrained")
    for place, (title, poses) in enumerate(panels, 1):
        axes = figure.add_subplot(1, len(panels), place, projection="3d" if graph.d == 3 else None)
        draw_graph(graph, poses, axes)
        axes.set_title(title, fontsize=10)
    return figure


def plot_tightness(curves: list[tuple[str, Array, Array]]) -> Figure:
    """Figure of how many graphs are certified at which rotation noise.

    Parameters
    ----------
    curves : list of (label, rotation_std, fraction)
        Noise in radians, (levels,), and the certified share there, (levels,), in [0, 1].

    Raises
    ------
    MissingExtraError
        Without matplotlib.
    """
    figure = _single_panel()
    (axes,) = figure.axes
    for (label, rotation_std, fraction), colour, marker in zip(
        curves, cycle(_ROBOT_COLOURS), cycle("osD^v"), strict=False
    ):
        axes.plot(np.rad2deg(rotation_std), 100.0 * fraction, color=colour, marker=marker, label=label)
    axes.set_xlabel("rotation noise, standard deviation (degrees)")
    axes.set_ylabel("graphs certified (%)")
    axes.set_ylim(-5, 105)
    axes.legend()
    return figure


def plot_decay(curves: list[tuple[str, Array]], quantity: str) -> Figure:
    """Figure of positive quantities over the iterations, on a logarithmic axis.

    Parameters
    ----------
    curves : list of (label, values)
        Values from iterate 0 on.
    quantity : str
        What they are, with the unit, for the axis.

    Raises
    ------
    MissingExtraError
        Without matplotlib.
    """
    figure = _single_panel()
    (axes,) = figure.axes
    for (label, values), colour, marker in zip(curves, cycle(_ROBOT_COLOURS), cycle("osD^v"), strict=False):
        axes.semilogy(np.arange(len(values)), values, color=colour, marker=marker, markersize=4, label=label)
    axes.set_xlabel("iteration")
    axes.set_ylabel(quantity)
    figure.legend(loc="outside upper center")
    return figure


def _single_panel() -> Figure:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("matplotlib", "plot") from error
    figure = Figure(figsize=(1.4 * _PANEL_INCHES, _PANEL_INCHES), layout="constrained")
    figure.add_subplot()
    return figure


def is_picture(path: Path) -> bool:
    """Whether the suffix names a picture format that `save_figure` writes."""
    return path.suffix.lower() in _PICTURE_SUFFIXES


def save_figure(figure: Figure, path: Path | str) -> None:
    """Write a figure as .png, .svg or .pdf, whole or not at all.

    Raises
    ------
    PGOError
        When the file cannot be written.
    """
    path = Path(path)
    with replace_when_done(path) as temporary:
        figure.savefig(temporary, format=path.suffix.lower().lstrip("."), dpi=120)
