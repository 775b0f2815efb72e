"""Wrong closures proven wrong, one by one, and how far a robust answer is from the best one.

What follows from lower bounds on the cost of closures beside the known inliers, d_e of one and d_ef
of two, against the allowance s, is in `proven_closures`; here such bounds are sought. Most come in
closed form, for all closures and pairs at once (`cycle_bounds`). Where they do not suffice
certificates prove more (`closure_costs`), if first-order distances on the known inliers
(`solvers.robust.chains`) say that it is worth it. Guaranteed outlier removal does step 1 for
registration (Parra Bustos & Chin, "Guaranteed outlier removal for point cloud registration with
correspondences", IEEE TPAMI 2018).
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace

import numpy as np

from pgo_models.certificates.rounding_errors import objective_rounding
from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import chi2_thresholds
from solvers.robust.chains import Chains, cycle_distances, is_whole, squared_distances
from solvers.robust.weighted_edges import held_together
from solvers.robust_solves.chain_sums import ChainSums
from solvers.robust_solves.closure_costs import ClosureCosts, precisions_below
from solvers.robust_solves.cycle_bounds import CycleBounds
from solvers.robust_solves.proven_closures import ProvenClosures
from solvers.solution import Solution


@dataclass(frozen=True)
class _Effort:
    """How hard proofs are tried, and for which closures and pairs.

    First-order distances and the bounds that are known have to be so many times s.
    """

    distance: float
    bound: float


# Proofs that are easy and likely to succeed come first, as s falls with each success.
_EFFORTS = (
    _Effort(1.5, 0.4),
    _Effort(1.0, 0.1),
    _Effort(1.2, 0.0),
)
# Proofs after which s is computed again.
_MOST_PROOFS = 64
# Closures of which all pairs are compared within seconds.
_MOST_PAIRED = 2000
_LEAST = float(np.finfo(float).tiny)


def prove_outliers(solution: Solution, time_limit: float = math.inf) -> Solution:
    """Prove closures wrong, for all maps that are as good as that of a robust solve.

    Known inliers, odometry unless others were given, count in full. What is proven is exact for the
    thresholds of the truncated cost: closures that no map at least as good keeps, which are wrong
    if the right map is at least as good, how many closures such a map keeps at most, and a lower
    bound on the truncated cost of every map.

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
        When the solution is not of a robust solve, or an edge has a negative cost, as it can where
        terms of one's own were added.

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
    if (problem.edge_costs(solution.all_poses) < 0.0).any():
        raise SettingError("an edge has a negative cost, so that nothing can be proven; use F")
    thresholds = rejection.threshold_scale * chi2_thresholds(problem, rejection.quantile)
    deadline = time.perf_counter() + time_limit
    search = _Search.of(problem, rejection.known, thresholds, solution.all_poses, deadline)
    search.run()
    return replace(
        solution, robust=replace(rejection, proof=search.proven.proof(search.is_complete))
    )


@dataclass(eq=False)
class _Search:
    """A search for bounds under way.

    `distance` (m,) are first-order distances of closures, and `pair_distance` those of pairs among
    the closures `paired` (q,); there are none as long as closures are too many. `tried` are edges
    whose cost was bounded; the search is complete unless the time did not suffice for a proof.
    """

    proven: ProvenClosures
    cycles: CycleBounds
    costs: ClosureCosts
    deadline: float
    distance: Array
    paired: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    pair_distance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    tried: set[tuple[int, ...]] = field(default_factory=set)
    is_complete: bool = True

    @classmethod
    def of(
        cls, problem: PGOProblem, known: BoolArray, thresholds: Array, poses: Poses, deadline: float
    ) -> _Search:
        graph = problem.graph
        costs = problem.edge_costs(poses)
        kept = known | (costs <= thresholds)
        # Edges that the poses need beside these count in full: U is an upper bound.
        counted = held_together(graph, kept, costs / thresholds)
        inliers = PGOProblem(graph.without_edges(~counted), problem.backend, problem.weighting)
        error = objective_rounding(inliers, poses).error
        cost = inliers.objective(poses) + error + float(thresholds[~counted].sum())
        chains = Chains.of(graph, known)
        cycles = CycleBounds(ChainSums(chains, *precisions_below(problem)))
        closures = np.flatnonzero(~known)
        distance = np.zeros(graph.num_edges)
        distance[closures] = _single_distances(chains, closures)
        return cls(
            ProvenClosures.of(known, kept, thresholds, cost, cycles.of_singles(closures)),
            cycles,
            ClosureCosts(problem, known, chains),
            deadline,
            distance,
        )

    def run(self) -> None:
        """Prove closures wrong and pairs inconsistent, until nothing changes."""
        self.use_bounds()
        level = 0
        while level < len(_EFFORTS):
            before = self.proven.most_cost.sum()
            self.try_singles(_EFFORTS[level])
            self.try_pairs(_EFFORTS[level])
            self.use_bounds()
            level = 0 if self.proven.most_cost.sum() < before else level + 1

    def has_time(self) -> bool:
        """Whether there is time for a further proof."""
        if time.perf_counter() > self.deadline:
            self.is_complete = False
        return self.is_complete

    def use_bounds(self) -> None:
        """Use the bounds that are known; those of pairs as soon as closures are few enough."""
        proven = self.proven
        proven.leave_out_wrong()
        if proven.pairs is None and len(proven.edges) <= _MOST_PAIRED and self.has_time():
            proven.pairs = self.cycles.of_pairs(proven.edges)
            self.paired = proven.edges
            self.pair_distance = _pair_distances(self.cycles.sums.chains, proven.edges)
        proven.use_bounds()

    def try_singles(self, effort: _Effort) -> None:
        """Try to prove closures wrong, those with the largest bounds first."""
        proven = self.proven
        s = proven.most_cost
        hopeful = self.distance[proven.edges] > effort.distance * s
        hopeful &= proven.singles >= effort.bound * s
        tried = np.flatnonzero(hopeful & ~proven.is_kept)
        ratio = proven.singles[tried] / np.maximum(s[tried], _LEAST)
        for e in tried[np.argsort(-ratio, kind="stable")].tolist():
            proven.raise_single(e, self._prove((e,), s[e]))
        proven.leave_out_wrong()

    def try_pairs(self, effort: _Effort) -> None:
        """Try to prove pairs inconsistent, up to a number, where that would join classes."""
        if self.proven.pairs is None:
            return
        most_tried = len(self.tried) + _MOST_PROOFS

        def prove(e: int, members: IntArray) -> None:
            self._try_pairs_of(e, members, most_tried)

        self.proven.join_classes(self._is_hopeful(effort), prove)

    def _is_hopeful(self, effort: _Effort) -> BoolArray:
        """Pairs, (k, k), that are worth an effort; not those that the answer keeps."""
        proven = self.proven
        assert proven.pairs is not None
        s = proven.most_costs_of_pairs()
        bound = np.maximum(proven.pairs, np.maximum.outer(proven.singles, proven.singles))
        place = np.searchsorted(self.paired, proven.edges)
        distance = self.pair_distance[np.ix_(place, place)]
        hopeful = (bound >= effort.bound * s) & (distance > effort.distance * s)
        return np.asarray(hopeful & ~np.logical_and.outer(proven.is_kept, proven.is_kept))

    def _try_pairs_of(self, e: int, members: IntArray, most_tried: int) -> None:
        """Try to prove a closure inconsistent with others, the hardest first, until one fails."""
        proven = self.proven
        assert proven.pairs is not None
        others = members[~proven.are_inconsistent(e, members)]
        s = np.minimum(proven.most_cost[e], proven.most_cost[others])
        ratio = proven.pairs[e, others] / np.maximum(s, _LEAST)
        for place in np.argsort(ratio, kind="stable").tolist():
            if len(self.tried) >= most_tried:
                return
            f = int(others[place])
            proven.raise_pair(e, f, self._prove((e, f), s[place]))
            if not proven.are_inconsistent(e, others[[place]]).all():
                return

    def _prove(self, closures: tuple[int, ...], s: float) -> float:
        """Lower bound by a certificate; zero if it was tried before."""
        edges = tuple(sorted(self.proven.edges[list(closures)].tolist()))
        if edges in self.tried or not self.has_time():
            return 0.0
        self.tried.add(edges)
        return self.costs.lower_bound(edges, s)


def _single_distances(chains: Chains, edges: IntArray) -> Array:
    """First-order distances, (k,), of edges from the chain between their ends; zero elsewhere."""
    graph = chains.graph
    distances = np.zeros(len(edges))
    motions = np.flatnonzero(is_whole(graph)[edges])
    closures = chains.closures(edges[motions])
    is_on_one_chain = chains.chain[closures.i] == chains.chain[closures.j]
    of_one_chain = closures[is_on_one_chain]
    along = chains.covariance[of_one_chain.j] - chains.covariance[of_one_chain.i]
    covariance = of_one_chain.covariance + along
    distances[motions[is_on_one_chain]] = squared_distances(of_one_chain.cycle, covariance)
    return distances


def _pair_distances(chains: Chains, edges: IntArray) -> Array:
    """First-order distances, (k, k), of the cycles of two edges and the chains between their ends.

    They are zero where the ends are not in the same two chains.
    """
    k = len(edges)
    distances = np.zeros((k, k))
    motions = np.flatnonzero(is_whole(chains.graph)[edges])
    closures = chains.closures(edges[motions])
    a, b = chains.pairs(closures)
    distances[motions[a], motions[b]] = cycle_distances(closures, chains.covariance, a, b)
    return distances + distances.T
