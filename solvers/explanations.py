"""Endings explained by the graph: which weight cannot be factored or leaves no bound, what took the memory."""

import functools
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import ParamSpec, TypeVar, cast

import numpy as np

from pgo_models.certificates.certificate import Certificate
from pgo_models.certificates.newton_polish import polish
from pgo_models.errors import GraphWarning, NotPositiveDefiniteError, PGOError
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.datasets import locate
from pgo_models.graphs.precisions import extreme_weight
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.cli_inputs import Dropped, kept_edges, load_graph
from solvers.solution import Solution, note_of_weights

WORTH_SAYING = 1.01  # times its minimum: what chi2 has to be for a hint
P = ParamSpec("P")
T = TypeVar("T")


def explained_by_its_graph(command: Callable[P, T]) -> Callable[P, T]:
    """Wrap a command with an argument `graph`: errors that speak of no file are raised as ones that do."""

    @functools.wraps(command)
    def explained(*args: P.args, **kwargs: P.kwargs) -> T:
        graph, dropped = str(kwargs["graph"]), cast("Dropped", kwargs.get("drop_edge"))
        try:
            return command(*args, **kwargs)
        except NotPositiveDefiniteError as error:
            raise NotPositiveDefiniteError(f"{place_of_weight(graph, dropped)} ({error})") from error
        except MemoryError as error:
            way_out = "share it among machines: pgo solve --robots K --address HOST:PORT"
            raise PGOError(f"{graph} takes more memory than there is; raise the limit, or {way_out}") from error

    return explained


def warn_of_weights(graph: str, problem: PGOProblem, certificate: Certificate, dropped: Dropped = None) -> None:
    """Say where the weight of `note_of_weights` is, if there is one."""
    if note_of_weights(problem.graph, certificate):
        warnings.warn(place_of_weight(graph, dropped), GraphWarning, stacklevel=2)


def hint_of_chi2(problem: PGOProblem, poses: Poses) -> list[str]:
    """A line that names `--information` where F was asked for, and chi2 can be lowered by more than it is worth."""
    graph = problem.graph
    if problem.weighting is not Weighting.ISOTROPIC or graph.information is None:
        return []
    whole = PGOProblem(graph, problem.backend, Weighting.INFORMATION)
    here = whole.objective(poses)
    if abs(here - problem.objective(poses)) <= 1e-9 * here:  # chi2 is F: no factorisation to find that out
        return []
    try:
        below = whole.objective(polish(whole, poses, max_steps=1))  # a bound from above on its minimum
    except NotPositiveDefiniteError:
        return []
    if not here > WORTH_SAYING * below:
        return []
    return [f"the file's own cost: chi2 {here:.4g} here; its minimum is at most {below:.4g}: --information"]


def hint_of_misfits(solution: Solution, graph: str, dropped: Dropped) -> list[str]:
    """Where the edges cost more than their information matrices lead to expect: `--robust gnc`, and the worst edge."""
    residuals = solution.edge_residuals
    if solution.robust is not None or not residuals.is_doubtful:
        return []
    cost, misfits = f"the edges cost {residuals.overall:.3g} times what is expected", int(residuals.is_misfit.sum())
    hint = "if loop closures may be wrong: --robust gnc"
    if not misfits or not (locate(graph).is_file() or locate(graph).is_dir()):
        return [f"{cost}; {hint}"]
    worst = kept_edges(graph, dropped)[1][int((residuals.cost / residuals.allowed).argmax())]
    name = worst.rpartition("/")[2]
    return [f"{cost}, {misfits} of them alone more than they may, {worst} most; {hint}, --drop-edge {name}"]


def with_places(solution: Solution, graph: str, dropped: Dropped = None) -> Solution:
    """The solution; a robust one with `file:line` of every edge of the graph that was asked for."""
    if solution.robust is None:
        return solution
    return replace(solution, robust=replace(solution.robust, places=tuple(kept_edges(graph, dropped)[1])))


def place_of_weight(graph: str, dropped: Dropped = None) -> str:
    """Sentence on the weight that is too far from the others: file and line, edge, value, and the way out."""
    path = locate(graph)
    if not (path.is_file() or path.is_dir()):
        return f"{graph}: weights too far apart for doubles; give it as a file to be told which"
    with warnings.catch_warnings(action="ignore"):
        loaded = load_graph(graph, False, True, dropped)
    _, edge, text = extreme_weight(loaded)
    place = kept_edges(graph, dropped)[1][edge]
    weights, length = np.concatenate([loaded.kappa, loaded.tau]), np.abs(loaded.t_ij).max()
    range_of = f"weights from {weights.min():.3g} to {weights.max():.3g} and lengths up to {length:.3g} m"
    way_out = "correct the information matrix, or use --unit-weights"
    return f"{place}: {text}; {range_of} are too far apart for doubles; {way_out}"
