"""What closures cost beside the known inliers, at least: proofs by certificates.

The known inliers between the ends of closures, and the closures, are a problem of their own; what
is left out costs nothing at least. A certificate bounds its least cost from below, whatever poses
were found, and so does one of an F below chi2.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.certificates.shrunk_information import shrink_information
from pgo_models.errors import FAILURES
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.graphs.precisions import proper_information
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.here import Here
from solvers.loop import RunMonitor
from solvers.plan import solve_at
from solvers.request import Pipeline
from solvers.result import StageTable
from solvers.robust.chains import Chains, is_whole

# Relative gap of the first certificate: of most wrong closures the cost is many times s.
_WIDE_GAP = 0.5
# Poses are not improved: what counts is the bound.
_FOR_BOUNDS = Pipeline(soc=None, handedness=None, growing=None, other_starts=False)


@dataclass(frozen=True, eq=False)
class ClosureCosts:
    """Lower bounds on the least cost of known inliers and a few closures."""

    problem: PGOProblem
    known: BoolArray
    chains: Chains

    def lower_bound(self, edges: tuple[int, ...], s: float) -> float:
        """Proven lower bound, as far as it is above s.

        The tangent of a chi2 that is not quadratic proves little of the large cost of a wrong
        closure. The bound is then that of an F below chi2.
        """
        subgraph = self._between_ends(edges)
        if subgraph is None:
            return 0.0
        bound = 0.0
        for problem in _easier_problems(subgraph):
            bound = max(bound, _bound_above(problem, s))
            if bound > s:
                break
        return bound

    def _between_ends(self, edges: Sequence[int]) -> PGOProblem | None:
        """The problem of known inliers and closures between the ends of these; None if apart."""
        graph = self.problem.graph
        ends = np.concatenate([graph.i[list(edges)], graph.j[list(edges)]])
        chain = self.chains.chain
        poses = [
            np.arange(ends[chain[ends] == c].min(), ends[chain[ends] == c].max() + 1)
            for c in np.unique(chain[ends])
        ]
        chosen = self.known.copy()
        chosen[list(edges)] = True
        inside = np.zeros(graph.num_poses, dtype=bool)
        inside[np.concatenate(poses)] = True
        chosen &= inside[graph.i] & inside[graph.j]
        subgraph = graph.edge_subgraph(np.flatnonzero(chosen))
        if len(subgraph.components()) > 1:
            return None
        return PGOProblem(subgraph, self.problem.backend, self.problem.weighting)


def _easier_problems(problem: PGOProblem) -> Iterator[PGOProblem]:
    """Problems whose cost is at most that of a problem, the easiest to bound first."""
    if not problem.is_quadratic:
        with suppress(*FAILURES):  # of matrices that rounding hides
            yield isotropic_below(problem)
    yield problem


def isotropic_below(problem: PGOProblem) -> PGOProblem:
    """F with precisions so small that it is below chi2 at all poses."""
    weighted = _isotropic_graph_below(problem.graph)
    return PGOProblem(weighted, problem.backend, Weighting.ISOTROPIC)


def _isotropic_graph_below(graph: PoseGraph) -> PoseGraph:
    """The graph with precisions whose F is below chi2 at all poses.

    Of matrices without coupling, below those of the graph (`shrink_information`), the smallest
    eigenvalues are taken. With the turn theta of an edge, chi2 has at least 2 (1 - cos theta) times
    that of I_rr, and F 4 (1 - cos theta) kappa.
    """
    d = graph.d
    graph = shrink_information(graph, cap=1.0)
    information = proper_information(graph)
    tau = _least_eigenvalues(information[:, :d, :d])
    kappa = 0.5 * _least_eigenvalues(information[:, d:, d:])
    return replace(graph.with_weights(kappa, tau), information=None)


def precisions_below(problem: PGOProblem) -> tuple[Array, Array]:
    """Return kappa and tau, (m,), of an F below the cost at all poses.

    They are zero if the cost is neither F nor chi2. They are also zero for single edges: those with
    singular matrices, those that rounding hides, and those that measure no whole motion.
    """
    graph = problem.graph
    kappa = np.zeros(graph.num_edges)
    tau = np.zeros(graph.num_edges)
    motions = np.flatnonzero(is_whole(graph))
    if problem.weighting is Weighting.ISOTROPIC:
        kappa[motions] = graph.kappa[motions]
        tau[motions] = graph.tau[motions]
    elif problem.weighting is Weighting.INFORMATION:
        _set_precisions_below(graph, motions, kappa, tau)
    return kappa, tau


def _set_precisions_below(graph: PoseGraph, edges: IntArray, kappa: Array, tau: Array) -> None:
    """Set the precisions of edges, (k,); where that fails, of each half of them."""
    if not len(edges):
        return
    below = None
    with suppress(*FAILURES):
        below = _isotropic_graph_below(graph.edge_subgraph(edges))
    if below is not None and below.num_edges == len(edges):
        kappa[edges] = below.kappa
        tau[edges] = below.tau
    elif len(edges) > 1:
        for half in np.array_split(edges, 2):
            _set_precisions_below(graph, half, kappa, tau)


def _least_eigenvalues(blocks: Array) -> Array:
    """Smallest eigenvalues, (m,), of blocks of `shrink_information`, zero where that hides them.

    It makes blocks smaller by more than the rounding of their eigenvalues.
    """
    return np.asarray(np.maximum(np.linalg.eigvalsh(blocks)[:, 0], 0.0))


def _bound_above(problem: PGOProblem, s: float) -> float:
    """Proven lower bound on a cost, with a gap that suffices where its minimum is above s."""
    bound = 0.0
    gap = _WIDE_GAP
    for _ in range(2):
        place = Here(RunMonitor(progress=False), StageTable(), problem, gap)
        try:
            attempt = solve_at(place, replace(_FOR_BOUNDS, gap=gap), None)
        except FAILURES:
            break
        bound = max(bound, attempt.proof.lower_bound)
        least = attempt.proof.objective
        if bound > s or least <= s:
            break
        gap = 0.5 * (least - s) / least
    return bound
