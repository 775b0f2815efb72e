"""Film of methods at work on a graph: its picture, its cost and the proven bound, closing in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pgo_models.certificates.certificate import certify_at
from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.plots.films import GraphFrames, animate, frames_to_show
from pgo_models.plots.interactive_plots import Trace
from pgo_models.plots.style import COLOURS
from pgo_models.problem.initialization import spanning_tree_start
from pgo_models.problem.problem import PGOProblem, as_problem
from solvers.loop import Solver, run
from solvers.result import Record
from solvers.riemannian.newton import Newton
from solvers.soc.soc import SOC

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

S = TypeVar("S")
# SOC of a film ends where Newton can take over, which it shows in a few frames.
_SOC = SOC(tolerance=1e-3)
_MOST_ITERATES = 200  # of each method
_LEAST_SHARE = 1e-14  # of the cost: what is drawn of a distance that is lost in rounding
_MOST_FRAMES = 16  # of a film, each with all poses: a page of a large graph stays small
_PICTURE = [0.38, 1.0]  # heights of the picture and of the curves below it
_CURVES = [0.0, 0.24]


@dataclass(frozen=True, eq=False)
class FilmedIterate:
    """An iterate: its name, its poses, their cost, and the best bound that was proven up to it."""

    name: str
    poses: Poses
    objective: float
    lower_bound: float


def film(
    problem: PGOProblem | PoseGraph,
    methods: Sequence[Solver[Any]] | None = None,
    start: Poses | None = None,
) -> Figure:
    """Film methods at work on a graph, one after the other, with the bound that is proven of each.

    The picture shows the graph at the poses of an iterate. The curves below show on a logarithmic
    axis how far its cost is above the least cost of the film, and how far the best lower bound so
    far is below it. A bound is proven at the poses of the iterate (`certify_at`), and holds for all
    poses, so that the best one counts from then on. The figure, of plotly, has at most 16 iterates,
    and a notebook shows it by itself. Pictures of one's own are filmed by `pgo_models.animate`.

    Parameters
    ----------
    problem : PGOProblem or PoseGraph
        What to film; of a graph its own cost, as `solve` minimises it.
    methods : sequence of Solver
        What is run: SOC to a coarse tolerance, and then Newton, unless given. SOC is left out for a
        chi2 that is not convex and quadratic.
    start : Poses, optional
        Where the first method starts; along a spanning tree unless given.

    Examples
    --------
    >>> from pgo_models import load
    >>> frames = film(load("grid")).frames
    >>> frames[0].name.partition(":")[0], frames[-1].name.partition(":")[0]
    ('start', 'Newton 1')
    """
    problem = as_problem(problem)
    if methods is None:
        is_for_soc = problem.convex_part is problem
        methods = (_SOC, Newton()) if is_for_soc else (Newton(),)
    if not methods:
        raise SettingError("a film has no methods; give at least one, such as SOC()")
    if not problem.has_translations:
        raise SettingError("a film draws translations, and of rotations alone there are none")
    iterates = filmed_iterates(problem, methods, start)
    return _film_of(problem, iterates)


def filmed_iterates(
    problem: PGOProblem, methods: Sequence[Solver[Any]], start: Poses | None
) -> list[FilmedIterate]:
    """The iterates that a film shows, with their costs and bounds."""
    poses = problem.check_poses(start if start is not None else spanning_tree_start(problem.graph))
    named = [("start", poses)]
    for method in methods:
        reached = _poses_on_the_way(problem, method, named[-1][1])
        named += [(f"{type(method).__name__} {k}", poses) for k, poses in enumerate(reached, 1)]
    bound = 0.0
    iterates = []
    for k in frames_to_show(len(named), _MOST_FRAMES):
        name, poses = named[k]
        certificate = certify_at(problem, poses)
        bound = max(bound, certificate.lower_bound)
        iterates.append(FilmedIterate(name, poses, certificate.objective, bound))
    return iterates


def _poses_on_the_way(problem: PGOProblem, method: Solver[S], start: Poses) -> list[Poses]:
    """Poses of the states of a run after its start; the states go, as that of SOC has a factor."""
    reached: list[Poses] = []

    def remember(state: S, record: Record) -> bool:
        reached.append(method.poses(problem, state))
        return record.k >= _MOST_ITERATES

    run(method, problem, start, callback=remember)
    return reached[1:]


def _film_of(problem: PGOProblem, iterates: Sequence[FilmedIterate]) -> Figure:
    graph = problem.graph
    drawn = GraphFrames.of(graph, [iterate.poses for iterate in iterates])
    costs = np.array([iterate.objective for iterate in iterates])
    bounds = np.array([iterate.lower_bound for iterate in iterates])
    least = costs.min()
    above, below = (_shares(distance, least) for distance in (costs - least, least - bounds))
    frames = [
        [*drawn.traces(k), _marker(k, above[k], COLOURS[0]), _marker(k, below[k], COLOURS[1])]
        for k in range(len(iterates))
    ]
    still = [
        _curve(above, "cost above the least", COLOURS[0]),
        _curve(below, "proven bound below it", COLOURS[1]),
    ]
    labels = [
        f"{iterate.name}: {problem.cost_name} {iterate.objective:.4g}, at least "
        f"{iterate.lower_bound:.4g}"
        for iterate in iterates
    ]
    description = (
        f"{graph.name} from {iterates[0].name} to {iterates[-1].name}. "
        f"{problem.cost_name} {_course(costs)}, and the proven lower bound {_course(bounds)}."
    )
    return animate(
        frames,
        labels,
        still=still,
        layout=_layout(drawn.layout(), len(iterates)),
        title=f"{graph.name}: {problem.cost_name} and what is proven of it",
        description=description,
    )


def _course(values: Array) -> str:
    """Where values go from the first to the last, in words."""
    first = f"{values[0]:.6g}"
    last = f"{values[-1]:.6g}"
    if first == last:
        return f"stays at {last}"
    return f"{'falls' if values[-1] < values[0] else 'rises'} from {first} to {last}"


def _shares(distance: Array, least: float) -> Array:
    """Distances as shares of the least cost, which a logarithmic axis can show."""
    scale = least if least > 0.0 else 1.0
    return np.maximum(distance / scale, _LEAST_SHARE)


def _curve(shares: Array, name: str, colour: str) -> Trace:
    return {
        "x": list(range(len(shares))),
        "y": [float(f"{share:.3g}") for share in shares],
        "xaxis": "x2",
        "yaxis": "y2",
        "mode": "lines",
        "line": {"color": colour, "width": 2},
        "name": name,
    }


def _marker(k: int, share: float, colour: str) -> Trace:
    """The point of the current iterate on a curve."""
    return {
        "x": [k],
        "y": [float(f"{share:.3g}")],
        "xaxis": "x2",
        "yaxis": "y2",
        "mode": "markers",
        "marker": {"color": colour, "size": 9},
        "showlegend": False,
        "hoverinfo": "skip",
    }


def _layout(of_graph: dict[str, Any], num_frames: int) -> dict[str, object]:
    """The graph above, the curves of all frames below, and a legend of these between them."""
    layout = dict(of_graph)
    if "scene" in layout:
        layout["scene"] = {**layout["scene"], "domain": {"x": [0.0, 1.0], "y": _PICTURE}}
    else:
        layout["yaxis"] = {**layout["yaxis"], "domain": _PICTURE}
        layout["xaxis"] = {**layout["xaxis"], "anchor": "y", "title": None}
    layout["xaxis2"] = {
        "anchor": "y2",
        "range": [-0.5, num_frames - 0.5],
        "dtick": 5,
        "zeroline": False,
    }
    layout["yaxis2"] = {
        "domain": _CURVES,
        "anchor": "x2",
        "type": "log",
        "dtick": 4,
        "exponentformat": "power",
        "title": {"text": "share of the cost"},
        "gridcolor": "#eeeeee",
    }
    layout["legend"] = {"orientation": "h", "x": 0.0, "y": 0.30, "yanchor": "middle"}
    layout["margin"] = {"l": 75}
    layout["height"] = 640
    return layout
