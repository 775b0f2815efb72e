"""Wrong closures proven wrong, one by one, and how far a robust answer is from the best one.

The known inliers are taken to be right, which is the only assumption. For poses X let

    TLS(X) = sum over known inliers of r_e^2 + sum over closures of min(r_e^2, c_e^2)

be the truncated cost, U its value at the answer, and C the sum of all c_e^2. A map X with TLS(X) at
most U keeps a set K of closures, those with r_e^2 <= c_e^2. The cost of known inliers and K is then

    F_K(X) = TLS(X) - C + sum over K of c_e^2  <=  s,   s = U - C + largest possible sum over K.

So each closure of K, and each pair, fits the known inliers at a cost of at most s:
d_e = min F_e <= s and d_ef = min F_ef <= s.

1. A closure whose proven lower bound of d_e is above s is wrong in every map that is as good as the
   answer. Without it the sum over K is smaller, and so is s: the others are tried again.
2. Closures are divided into classes of which any two are proven inconsistent, d_ef > s. K has at
   most one of a class, so that the sum over K is at most that of the largest c_e^2 of each class;
   with this s more closures may be wrong, and more pairs inconsistent.

In the end K has at most as many closures as there are classes, and TLS(X) is at least C less the
sum of the largest c_e^2 of each class, for all X: for those worse than the answer it is above U.

Which closures and pairs are tried is decided by first-order distances on the known inliers
(`solvers.robust.chains`); what is claimed rests on certificates alone. Guaranteed outlier removal
does this for registration (Parra Bustos & Chin, "Guaranteed outlier removal for point cloud
registration with correspondences", IEEE TPAMI 2018).
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np

from pgo_models.certificates.rounding_errors import objective_rounding
from pgo_models.certificates.shrunk_information import shrink_information
from pgo_models.errors import FAILURES, SettingError, door
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.graphs.precisions import proper_information
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import chi2_thresholds
from pgo_models.problem.weighting import Weighting
from solvers.here import Here
from solvers.loop import RunMonitor, iterate
from solvers.plan import solve_at
from solvers.request import Pipeline
from solvers.riemannian.staircase import Staircase
from solvers.robust.chains import Chains, cycle_distances, is_whole, squared_distances
from solvers.robust.outlier_record import OutlierProof
from solvers.robust_solves.coarse_chains import CoarseChains
from solvers.solution import Solution


@dataclass(frozen=True)
class _Effort:
    """How hard proofs are tried, and what first-order distances have to be for it, in units of s.

    `num_steps` are those that chains are made of (`CoarseChains`); None for chains as they are.
    """

    of_single: float
    of_pair: float
    num_steps: int | None


# Proofs that are easy and likely to succeed come first, as s falls with each success.
_EFFORTS = (
    _Effort(2.0, 4.0, 24),
    _Effort(1.2, 2.0, 24),
    _Effort(1.2, 1.5, 96),
    _Effort(1.2, 1.2, None),
)
# Relative gap of the first certificate: of most wrong closures the cost is many times s.
_WIDE_GAP = 0.5
# Closures of which all pairs are compared within seconds.
_MOST_PAIRED = 2000
# Poses are not improved: what counts is the bound.
_FOR_BOUNDS = Pipeline(soc=None, handedness=None, growing=None, second_try=False)
# A wide gap can be proven far from a stationary point.
_COARSE_STAIRCASE = Staircase(tolerance=1e-2, gap=_WIDE_GAP)
_MOST_STEPS = 100
_OUTWARD = 1.0 + 1e-12  # for sums of up to a million positive terms
_ROUNDING = 2.0**-40  # of an eigenvalue, over the trace


@door
def prove_outliers(solution: Solution, time_limit: float = math.inf) -> Solution:
    """Prove closures wrong, for all maps that are as good as that of a robust solve.

    Known inliers, odometry unless others were given, are taken to be right. What is proven is exact
    for the thresholds of the truncated cost: closures that no map at least as good keeps, how many
    closures such a map keeps at most, and a lower bound on the truncated cost of every map.

    Parameters
    ----------
    solution : Solution
        Of a robust solve.
    time_limit : float, optional
        Seconds after which no further proof is tried; unlimited unless given.

    Returns
    -------
    Solution
        The same, with `solution.robust.proof`.

    Raises
    ------
    SettingError
        When the solution is not of a robust solve, or an edge has a negative cost, as chi2 of an
        indefinite information matrix can.

    References
    ----------
    A. Parra Bustos and T.-J. Chin, "Guaranteed outlier removal for point cloud registration with
    correspondences", IEEE TPAMI 2018, for the idea.

    Examples
    --------
    A chain of odometry with a closure that it contradicts:

    >>> import pgo_models as pgo, solvers
    >>> chain = pgo.grid_world(1, 30, np.random.default_rng(0), d=2)
    >>> far = pgo.Poses(np.eye(2)[None], np.array([[30.0, 40.0]]))
    >>> graph = chain.with_edges(np.array([2]), np.array([25]), far, 1e4, 1e4)
    >>> solution = prove_outliers(solvers.solve(graph, robust=solvers.GNC()))
    >>> np.flatnonzero(solution.robust.proof.proven_wrong).tolist() == [chain.num_edges]
    True
    """
    rejection = solution.robust
    if rejection is None:
        raise SettingError("outliers are proven of a robust solve; give solve(.., robust=GNC())")
    problem = rejection.problem
    if (problem.edge_costs(solution.poses) < 0.0).any():
        raise SettingError("an edge has a negative cost, so that nothing can be proven; use F")
    thresholds = rejection.threshold_scale * chi2_thresholds(problem, rejection.quantile)
    deadline = time.perf_counter() + time_limit
    search = _Search.of(problem, rejection.known, thresholds, solution.poses, deadline)
    search.run()
    return replace(solution, robust=replace(rejection, proof=search.proof()))


@dataclass(eq=False)
class _Search:
    """A search under way.

    `cost` is U, an upper bound. `classes` has the closures that are not proven wrong; any two of a
    class are proven inconsistent. `single` are first-order distances of all edges, (m,), and
    `proven` the lower bound of each closure or pair that was `tried`, with so many steps of
    `coarse` chains. `level` is the place of the current effort. `pairs` are closures and
    the first-order distances of all pairs of these, once they are computed.
    """

    problem: PGOProblem
    known: BoolArray
    thresholds: Array
    chains: Chains
    coarse: CoarseChains
    kept: BoolArray
    cost: float
    classes: list[list[int]]
    single: Array
    deadline: float
    level: int = 0
    proven: dict[tuple[int, ...], float] = field(default_factory=dict)
    tried: set[tuple[tuple[int, ...], int | None]] = field(default_factory=set)
    pairs: tuple[IntArray, Array] | None = None

    @classmethod
    def of(
        cls, problem: PGOProblem, known: BoolArray, thresholds: Array, poses: Poses, deadline: float
    ) -> _Search:
        graph = problem.graph
        kept = known | (problem.edge_costs(poses) <= thresholds)
        inliers = PGOProblem(graph.without_edges(~kept), problem.backend, problem.weighting)
        error = objective_rounding(inliers, poses).error
        cost = inliers.objective(poses) + error + float(thresholds[~kept].sum())
        chains = Chains.of(graph, known)
        single = _single_distances(chains, np.flatnonzero(~known))
        classes = [[e] for e in np.flatnonzero(~known).tolist()]
        coarse = CoarseChains(chains, *precisions_below(problem))
        bound = _OUTWARD * cost
        return cls(
            problem, known, thresholds, chains, coarse, kept, bound, classes, single, deadline
        )

    @property
    def most_cost(self) -> float:
        """s: what known inliers and closures of a map as good as this one cost at most.

        It is U less the thresholds of the closures that no such map keeps: of each class all but
        the largest, and of those proven wrong all.
        """
        is_left_out = ~self.known
        for members in self.classes:
            largest = max(members, key=lambda e: self.thresholds[e])
            is_left_out[largest] = False
        return max(0.0, self.cost - math.fsum(self.thresholds[is_left_out]) / _OUTWARD)

    def run(self) -> None:
        """Prove single closures wrong, then pairs inconsistent, until nothing changes."""
        for self.level in range(len(_EFFORTS)):
            before = math.inf
            while self.most_cost < before and not self.is_out_of_time():
                before = self.most_cost
                self.exclude_single_closures()
                self.join_classes()

    def is_out_of_time(self) -> bool:
        """Whether no further proof is to be tried."""
        return time.perf_counter() > self.deadline

    def exclude_single_closures(self) -> None:
        """Step 1: closures that cost more than s beside the known inliers, the farthest first."""
        while not self.is_out_of_time():
            s = self.most_cost
            doubted = [e for members in self.classes for e in members]
            far = [e for e in doubted if self.single[e] > _EFFORTS[self.level].of_single * s]
            far.sort(key=lambda e: -self.single[e])
            wrong = set()
            for e in far:
                if self.is_proven((e,), s):
                    wrong.add(e)
            if not wrong:
                return
            members = [[e for e in of_class if e not in wrong] for of_class in self.classes]
            self.classes = [of_class for of_class in members if of_class]

    def join_classes(self) -> None:
        """Step 2: join classes whose closures are inconsistent, pair by pair.

        Closures that the answer keeps stand in different classes; others join one of them.
        """
        doubted = np.array(sorted(e for members in self.classes for e in members), dtype=np.int64)
        if not 1 < len(doubted) <= _MOST_PAIRED:
            return
        distance = self.distances_between(doubted)
        s = self.most_cost
        is_near = distance <= _EFFORTS[self.level].of_pair * s
        ordered = sorted(self.classes, key=lambda members: not self.kept[members].any())
        joined: list[list[int]] = []
        class_of = np.full(len(doubted), -1)
        for members in ordered:
            rows = np.searchsorted(doubted, members)
            near_classes = class_of[is_near[rows].any(axis=0)]
            number = len(joined)
            for other in np.setdiff1d(np.arange(len(joined)), near_classes):
                pairs = [(e, f) for e in members for f in joined[other]]
                e, f = np.searchsorted(doubted, np.array(pairs).T)
                # The hardest come first, so that little is proven in vain.
                in_order = np.argsort(distance[e, f], kind="stable")
                if all(self.is_proven(pairs[k], s) for k in in_order):
                    number = int(other)
                    break
            if number == len(joined):
                joined.append([])
            joined[number] += members
            class_of[rows] = number
        self.classes = joined

    def distances_between(self, edges: IntArray) -> Array:
        """First-order distances, (k, k), of pairs of edges, ascending; computed the first time.

        Later calls ask for some of the edges of the first one.
        """
        if self.pairs is None:
            self.pairs = edges, _pair_distances(self.chains, edges)
        paired, distances = self.pairs
        places = np.searchsorted(paired, edges)
        return distances[np.ix_(places, places)]

    def is_proven(self, edges: tuple[int, ...], s: float) -> bool:
        """Whether known inliers and these closures are proven to cost more than s.

        Those that the answer keeps do not, as its poses show.
        """
        edges = tuple(sorted(edges))
        if self.kept[list(edges)].all():
            return False
        for effort in _EFFORTS[: self.level + 1]:
            if self.proven.get(edges, 0.0) > s:
                return True
            if (edges, effort.num_steps) not in self.tried and not self.is_out_of_time():
                self.tried.add((edges, effort.num_steps))
                bound = self._lower_bound(edges, s, effort.num_steps)
                self.proven[edges] = max(self.proven.get(edges, 0.0), bound)
        return self.proven.get(edges, 0.0) > s

    def _lower_bound(self, edges: tuple[int, ...], s: float, num_steps: int | None) -> float:
        """Proven lower bound on the cost of known inliers and closures, as far as it is above s.

        It is that of the subgraph between the ends of the closures: what is left out costs nothing
        at least. With `num_steps` it is that of an F below it on chains with few steps. Where chi2
        is not quadratic its tangent proves little of a cost as large as that of a wrong closure,
        and the bound is that of an F below it.
        """
        if num_steps is not None:
            found = self.coarse.with_closures(edges, num_steps)
            if found is None:
                return 0.0
            coarse, rounding = found
            problem = PGOProblem(coarse, self.problem.backend, Weighting.ISOTROPIC)
            return _relaxed_bound(problem, s + rounding) - rounding
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
        subgraph = graph.without_edges(~chosen).subgraph(np.concatenate(poses))
        if len(subgraph.components()) > 1:
            return None
        return PGOProblem(subgraph, self.problem.backend, self.problem.weighting)

    def proof(self) -> OutlierProof:
        """What has been proven so far."""
        doubted = [e for members in self.classes for e in members]
        proven_wrong = ~self.known
        proven_wrong[doubted] = False
        largest = math.fsum(max(self.thresholds[members]) for members in self.classes)
        bound = math.fsum(self.thresholds[~self.known]) / _OUTWARD - _OUTWARD * largest
        return OutlierProof(
            proven_wrong,
            num_kept=int((self.kept & ~self.known).sum()),
            num_closures=int((~self.known).sum()),
            most_closures=len(self.classes),
            truncated_cost=self.cost,
            truncated_cost_bound=min(max(0.0, bound), self.cost),
            is_complete=not self.is_out_of_time(),
        )


def _easier_problems(problem: PGOProblem) -> Iterator[PGOProblem]:
    """Problems whose cost is at most that of a problem, the easiest to bound first."""
    if not problem.is_quadratic:
        with suppress(*FAILURES):  # of matrices that rounding hides
            yield isotropic_below(problem)
    yield problem


def isotropic_below(problem: PGOProblem) -> PGOProblem:
    """F with precisions so small that it is below chi2 at all poses.

    Of matrices without coupling, below those of the graph (`shrink_information`), the smallest
    eigenvalues are taken. With the turn theta of an edge, chi2 has at least 2 (1 - cos theta) times
    that of I_rr, and F 4 (1 - cos theta) kappa.
    """
    d = problem.d
    graph = shrink_information(problem.graph, cap=1.0)
    information = proper_information(graph)
    tau = _least_eigenvalues(information[:, :d, :d])
    kappa = 0.5 * _least_eigenvalues(information[:, d:, d:])
    weighted = replace(graph.with_weights(kappa, tau), information=None)
    return PGOProblem(weighted, problem.backend, Weighting.ISOTROPIC)


def precisions_below(problem: PGOProblem) -> tuple[Array, Array]:
    """Return kappa and tau, (m,), of an F below the cost at all poses.

    They are zero for all edges where the cost is neither F nor chi2, and where no such F is known:
    of matrices that are singular, or that rounding hides.
    """
    graph = problem.graph
    below = None
    if problem.weighting is Weighting.ISOTROPIC:
        below = graph
    elif problem.weighting is Weighting.INFORMATION:
        with suppress(*FAILURES):
            below = isotropic_below(problem).graph
    if below is None or below.num_edges != graph.num_edges:
        return np.zeros(graph.num_edges), np.zeros(graph.num_edges)
    return below.kappa, below.tau


def _least_eigenvalues(blocks: Array) -> Array:
    """Smallest eigenvalues, (m,), rounded down, and zero where rounding hides them."""
    traces = np.einsum("mkk->m", blocks)
    least = np.linalg.eigvalsh(blocks)[:, 0]
    return np.asarray(np.maximum(least - _ROUNDING * traces, 0.0))


def _relaxed_bound(problem: PGOProblem, s: float) -> float:
    """Proven lower bound on a cost from its relaxation; the search ends where it is above s."""
    bound = 0.0
    try:
        for state in islice(iterate(_COARSE_STAIRCASE, problem), _MOST_STEPS):
            if state.bound is not None:
                bound = max(bound, state.bound.lower_bound)
            if bound > s or state.is_solved or state.stalled:
                break
    except FAILURES:
        pass
    return bound


def _bound_above(problem: PGOProblem, s: float) -> float:
    """Proven lower bound on a cost, with a gap that suffices where its minimum is above s."""
    bound = 0.0
    gap = _WIDE_GAP
    for _ in range(2):
        place = Here(RunMonitor(progress=False), [], problem, gap)
        try:
            found = solve_at(place, replace(_FOR_BOUNDS, gap=gap), None)
        except FAILURES:
            break
        bound = max(bound, found.proof.lower_bound)
        least = found.proof.objective
        if bound > s or least <= s:
            break
        gap = 0.5 * (least - s) / least
    return bound


def _single_distances(chains: Chains, edges: IntArray) -> Array:
    """First-order distances, (m,), of edges from the chain between their ends; zero elsewhere."""
    graph = chains.graph
    distances = np.zeros(graph.num_edges)
    whole = edges[is_whole(graph)[edges]]
    closures = chains.closures(whole)
    own = chains.chain[closures.i] == chains.chain[closures.j]
    along = chains.covariance[closures.j[own]] - chains.covariance[closures.i[own]]
    covariance = closures.covariance[own] + along
    distances[whole[own]] = squared_distances(
        (closures.cycle[0][own], closures.cycle[1][own]), covariance
    )
    return distances


def _pair_distances(chains: Chains, edges: IntArray) -> Array:
    """First-order distances, (k, k), of the cycles of two edges and the chains between their ends.

    They are zero where the ends are not in the same two chains.
    """
    k = len(edges)
    distances = np.zeros((k, k))
    whole = np.flatnonzero(is_whole(chains.graph)[edges])
    closures = chains.closures(edges[whole])
    a, b = np.triu_indices(len(whole), 1)
    in_first = chains.chain[closures.i[a]] == chains.chain[closures.i[b]]
    in_second = chains.chain[closures.j[a]] == chains.chain[closures.j[b]]
    a = a[in_first & in_second]
    b = b[in_first & in_second]
    distances[whole[a], whole[b]] = cycle_distances(closures, chains.covariance, a, b)
    return distances + distances.T
