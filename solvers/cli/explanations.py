"""Errors and results of a command, explained by lines of its graph's file.

A weight too far from the others makes the factorisation fail or leaves no bound. It is named by
file and line, and so are edges that do not fit.
"""

import functools
import shlex
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ParamSpec, TypeVar, cast

import numpy as np
import typer

from pgo_models.certificates.certificate import Certificate
from pgo_models.errors import GraphWarning, NotPositiveDefiniteError, PGOError
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.datasets import locate
from pgo_models.graphs.g2o import name_of
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import extreme_weight
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import EdgeResiduals
from solvers.cli.inputs import Dropped, GraphOptions, indefinite_matrices, kept_edges, load_graph
from solvers.cli.shell import command_to_type, wrapped
from solvers.reporting.edge_fit import Advice, EdgeFit, judge_edges
from solvers.reporting.notes import note_of_weights
from solvers.solution import Solution

if TYPE_CHECKING:  # what commands that solve nothing do not need
    from solvers.studies.readings import ReadingComparison

# Ratios of the cost to the expected one. Other readings of a file are tried above the first and
# below the second, if the graph has few edges: that takes hardly longer than the solve.
_FAR_ABOVE = 10.0
_BELOW = 0.1
_FEW_EDGES = 500
_FEW_FOR_NOISE = 5000  # edges up to which the noise is estimated in a few seconds
P = ParamSpec("P")
T = TypeVar("T")


def explained_by_its_graph(command: Callable[P, T]) -> Callable[P, T]:
    """Wrap a command with an argument `graph`, so that its errors name that graph and its lines."""

    @functools.wraps(command)
    def explained(*args: P.args, **kwargs: P.kwargs) -> T:
        graph = str(kwargs["graph"])
        dropped = cast("Dropped", kwargs.get("drop_edge"))
        try:
            return command(*args, **kwargs)
        except NotPositiveDefiniteError as error:
            place = place_of_weight(graph, dropped)
            raise NotPositiveDefiniteError(f"{place} ({error})") from error

    return explained


def warn_of_weights(
    graph: str, problem: PGOProblem, certificate: Certificate, dropped: Dropped = None
) -> None:
    """Warn of the weight that `note_of_weights` speaks of, with its file and line."""
    if note_of_weights(problem.graph, certificate):
        # The file may have changed since it was read.
        with suppress(PGOError):
            warnings.warn(place_of_weight(graph, dropped), GraphWarning, stacklevel=2)


def places_of_edges(graph: str, dropped: Dropped, num_edges: int) -> tuple[str, ...]:
    """`file:line` of every edge; empty if the graph cannot be read again.

    A pipe cannot be read again, and a file may have changed.
    """
    try:
        if not _can_be_read_again(graph):
            return ()
        _, places = kept_edges(graph, dropped)
    except PGOError:
        return ()
    return tuple(places) if len(places) == num_edges else ()


def _can_be_read_again(graph: str) -> bool:
    """Whether a graph is a file or a folder, not a pipe."""
    path = locate(graph)
    return path.is_file() or path.is_dir()


def edge_fit(
    problem: PGOProblem,
    poses: Poses,
    graph: str,
    dropped: Dropped,
    residuals: EdgeResiduals | None = None,
) -> EdgeFit:
    """How well the edges fit, with `file:line` of the first indefinite matrix."""
    fit = judge_edges(problem, poses, residuals)
    if fit.no_chi2:
        # The file may have changed since it was read.
        with suppress(PGOError):
            return replace(fit, no_chi2=indefinite_matrices(problem.graph, graph, dropped))
    return fit


def edge_fit_of_solution(solution: Solution, graph: str, dropped: Dropped) -> EdgeFit:
    """How well the edges fit, with `file:line` of every edge if the advice is to leave one out."""
    residuals = solution.edge_residuals  # which the printed row of the fit has, too
    fit = edge_fit(solution.problem, solution.all_poses, graph, dropped, residuals)
    if solution.robust is not None or not fit.suspected.is_misfit.any():
        return fit
    num_edges = len(fit.residuals.cost)
    return replace(fit, places=places_of_edges(graph, dropped, num_edges))


def advice_on_reading(comparison: "ReadingComparison", graph: str) -> Advice:
    """What a file seems to mean, and the command that writes it so."""
    reading = comparison.proposed[0].reading.value
    name = name_of(Path(graph))
    command = ["pgo", "info", graph, "--reading", reading, "--out", f"{name}.{reading}.g2o"]
    return Advice(comparison.sentence(), shlex.join(command))


def advice_on_wrong_edges(comparison: "ReadingComparison", graph: str) -> Advice:
    """What to do about a file that means what it says, and whose edges do not fit together."""
    text = f"{comparison.sentence()} Wrong edges are likelier: look for them."
    return Advice(text, shlex.join(["pgo", "solve", graph, "--robust", "gnc"]))


def advice_on_file(fit: EdgeFit, graph: PoseGraph, source: GraphOptions) -> list[Advice]:
    """Advice where the cost is far from what is expected: what the file may mean instead.

    Where all matrices are the identity, the noise is estimated that they say nothing of.
    """
    if not source.is_as_written:
        return []
    advice = _advice_on_noise(graph, source)
    residuals = fit.suspected
    if advice or not _is_far_off(residuals):
        return advice
    doctor = shlex.join(["pgo", "doctor", source.graph])
    if residuals.overall > _FAR_ABOVE:
        text = (
            f"{fit.cost} is {residuals.overall:.3g} times what is expected. Ask whether the file "
            "means something else than it says."
        )
        return [Advice(text, doctor)] if len(residuals.cost) > _FEW_EDGES else []
    return fit.advice_on_scale(doctor)


def reading_that_is_meant(fit: EdgeFit, source: GraphOptions) -> list[Advice]:
    """The other reading of a small file that is likely meant, where the cost is far off."""
    is_small = len(fit.residuals.cost) <= _FEW_EDGES
    if not (is_small and _is_far_off(fit.suspected) and source.is_as_written):
        return []
    if not _can_be_read_again(source.graph):
        return []
    from solvers.studies.readings import compare_readings

    # The reader has warned before, and the file may have changed since.
    with warnings.catch_warnings(action="ignore"), suppress(PGOError):
        comparison = compare_readings(source.graph, trust_folder=source.trust_folder)
        if comparison.proposed:
            return [advice_on_reading(comparison, source.graph)]
    return []


def _is_far_off(residuals: EdgeResiduals) -> bool:
    """Whether the cost is far above or below what is expected, beyond chance."""
    is_far_above = residuals.overall > max(_FAR_ABOVE, residuals.overall_allowed)
    return is_far_above or 0.0 < residuals.overall < min(_BELOW, residuals.overall_least)


def _advice_on_noise(graph: PoseGraph, source: GraphOptions) -> list[Advice]:
    """Advice to take the noise of the edges for weights, where the file has no other ones."""
    information = graph.information
    if information is None or len(information) > _FEW_FOR_NOISE:
        return []
    if not (information == np.eye(information.shape[1])).all():
        return []
    from solvers.studies.noise import estimate_noise

    try:
        estimate = estimate_noise(graph.unit_weights())
    except PGOError:  # nothing tells the noise
        return []
    text = (
        "All information matrices are the identity. The errors are another noise: of "
        f"{estimate}. Solve with it."
    )
    return [Advice(text, f"pgo solve {source.in_commands} --estimate-noise")]


def show_advice(advice: list[Advice]) -> None:
    """Print every piece of advice, and below it the command to type."""
    for piece in advice:
        typer.echo(f"\n{wrapped(piece.text)}\n{command_to_type(piece.command)}")


def with_places(solution: Solution, graph: str, dropped: Dropped = None) -> Solution:
    """The solution, where a robust one is given `file:line` of every edge of the graph."""
    if solution.robust is None:
        return solution
    num_edges = len(solution.robust.rejected)
    places = places_of_edges(graph, dropped, num_edges)
    return replace(solution, robust=replace(solution.robust, places=places))


def with_covariances(solution: Solution) -> Solution:
    """The solution with the marginal covariances of its poses, if they can be computed."""
    with suppress(NotPositiveDefiniteError, MemoryError):
        return replace(solution, covariances=solution.marginals())
    return solution


def place_of_weight(graph: str, dropped: Dropped = None) -> str:
    """Sentence on the weight that is too far from the others.

    It has file and line, edge, value, and the way out.
    """
    if not _can_be_read_again(graph):
        return f"{graph}: weights too far apart for doubles; give it as a file to see which"
    with warnings.catch_warnings(action="ignore"):
        loaded = load_graph(graph, False, True, dropped, trust_folder=True)
    _, edge, problem = extreme_weight(loaded)
    _, places = kept_edges(graph, dropped)
    weights = np.concatenate([loaded.kappa, loaded.tau])
    length = np.abs(loaded.t_ij).max()
    ranges = (
        f"weights from {weights.min():.3g} to {weights.max():.3g} and lengths up to {length:.3g} m"
    )
    way_out = "correct the information matrix, or use --cost unit"
    return f"{places[edge]}: {problem}; {ranges} are too far apart for doubles; {way_out}"
