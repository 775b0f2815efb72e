"""Wrong closures proven wrong, one by one, and how far a robust answer is from the best one.

Known inliers are edges that every map has to fit. For poses X let

    TLS(X) = sum over known inliers of r_e^2 + sum over closures of min(r_e^2, c_e^2)

be the truncated cost, U its value at the answer, and C the sum of all c_e^2. A map X with TLS(X) at
most U keeps a set K of closures, those with r_e^2 <= c_e^2. The cost of known inliers and K is then

    F_K(X) = TLS(X) - C + sum over K of c_e^2  <=  s,   s = U - C + largest possible sum over K.

Let F_e be the cost of known inliers and closure e, F_ef that with closures e and f. Each closure of
K, and each pair, costs at most s at least: d_e = min F_e <= s and d_ef = min F_ef <= s.

1. A closure whose proven lower bound of d_e is above s is wrong in every map that is as good as
   the answer. Two closures with d_ef > s are inconsistent: no such map keeps both.
2. Closures are divided into classes of which any two are inconsistent. K has at most one of a
   class, so that the sum over K is at most that of the largest c_e^2 of each class.
3. Of the maps that keep a closure e more is known: they keep none that is inconsistent with e.
   Their s_e = U - C + c_e^2 + the largest c_f^2 that is left in each other class takes the place
   of s for e, and the smaller of s_e and s_f for e with a closure f.

Each closure that is left out, and each pair, lowers s or s_e, so that more can be. What is proven
is about maps with TLS(X) <= U; a closure that none of them keeps is wrong if the right map is one
of them. In the end K has at most as many closures as there are classes, and TLS(X) is at least C
less the sum of the largest c_e^2 of each class, for all X: for those worse than the answer it is
above U.

Most bounds come in closed form, for all closures and pairs at once (`cycle_bounds`). Where they do
not suffice certificates prove more (`closure_costs`), if first-order distances on the known inliers
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
from solvers.robust.outlier_record import OutlierProof
from solvers.robust.weighted_edges import held_together
from solvers.robust_solves.chain_sums import ChainSums
from solvers.robust_solves.closure_costs import ClosureCosts, precisions_below
from solvers.robust_solves.cycle_bounds import CycleBounds
from solvers.solution import Solution


@dataclass(frozen=True)
class _Effort:
    """How hard proofs are tried, and for which closures and pairs.

    First-order distances and the bounds that are known have to be so many times s. `num_steps` are
    those that chains are made of (`CoarseChains`); None for chains as they are.
    """

    distance: float
    bound: float
    num_steps: int | None


# Proofs that are easy and likely to succeed come first, as s falls with each success.
_EFFORTS = (
    _Effort(1.5, 0.4, 24),
    _Effort(1.5, 0.25, 24),
    _Effort(1.2, 0.2, 96),
    _Effort(1.0, 0.1, None),
    _Effort(1.2, 0.0, None),
)
# Proofs after which s is computed again.
_MOST_PROOFS = 64
# Closures of which all pairs are compared within seconds.
_MOST_PAIRED = 2000
# Share of U + C by which U is raised, and the bound on the truncated cost lowered. Sums of a
# million positive terms are off by 1e-10 at most; ten times as much costs no proof.
_MARGIN = 1e-9
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
    if (problem.edge_costs(solution.poses) < 0.0).any():
        raise SettingError("an edge has a negative cost, so that nothing can be proven; use F")
    thresholds = rejection.threshold_scale * chi2_thresholds(problem, rejection.quantile)
    deadline = time.perf_counter() + time_limit
    search = _Search.of(problem, rejection.known, thresholds, solution.poses, deadline)
    search.run()
    return replace(solution, robust=replace(rejection, proof=search.proof()))


@dataclass(eq=False)
class _Pairs:
    """Proven lower bounds of d_ef, (k, k), and first-order distances, (k, k)."""

    bound: Array
    distance: Array

    @classmethod
    def of(cls, cycles: CycleBounds, edges: IntArray) -> _Pairs:
        return cls(cycles.of_pairs(edges), _pair_distances(cycles.sums.chains, edges))

    def __getitem__(self, chosen: BoolArray) -> _Pairs:
        both = np.ix_(chosen, chosen)
        return _Pairs(self.bound[both], self.distance[both])


@dataclass(eq=False)
class _Search:
    """A search under way, among the closures `edges` (k,) that are not proven wrong.

    `cost` is U, an upper bound, and `total` C; `most_cost` (k,) is s_e of each closure, and
    `class_of` (k,) its class. `bound` (k,) are proven lower bounds of d_e, `distance` (k,)
    first-order distances. There are no `pairs` as long as closures are too many. `tried` are edges
    with the number of steps that chains were made of; the search is complete unless the time did
    not suffice for a proof.
    """

    known: BoolArray
    cycles: CycleBounds
    costs: ClosureCosts
    deadline: float
    cost: float
    total: float
    edges: IntArray
    thresholds: Array
    is_kept: BoolArray
    class_of: IntArray
    most_cost: Array
    bound: Array
    distance: Array
    pairs: _Pairs | None = None
    tried: set[tuple[tuple[int, ...], int | None]] = field(default_factory=set)
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
        edges = np.flatnonzero(~known)
        total = float(thresholds[edges].sum())
        chains = Chains.of(graph, known)
        cycles = CycleBounds(ChainSums(chains, *precisions_below(problem)))
        return cls(
            known,
            cycles,
            ClosureCosts(problem, known, cycles.sums),
            deadline,
            cost=cost + _MARGIN * (cost + total),
            total=total,
            edges=edges,
            thresholds=thresholds[edges],
            is_kept=kept[edges],
            class_of=np.arange(len(edges)),
            most_cost=np.full(len(edges), math.inf),
            bound=cycles.of_singles(edges),
            distance=_single_distances(chains, edges),
        )

    def run(self) -> None:
        """Prove closures wrong and pairs inconsistent, until nothing changes."""
        self.use_bounds()
        level = 0
        while level < len(_EFFORTS):
            before = self.most_cost.sum()
            self.try_singles(_EFFORTS[level])
            self.join_classes(_EFFORTS[level])
            self.use_bounds()
            level = 0 if self.most_cost.sum() < before else level + 1

    def has_time(self) -> bool:
        """Whether there is time for a further proof."""
        if time.perf_counter() > self.deadline:
            self.is_complete = False
        return self.is_complete

    def use_bounds(self) -> None:
        """Lower s by the bounds that are known, until nothing changes."""
        before = math.inf
        while True:
            self.leave_out_wrong()
            if self.pairs is None and len(self.edges) <= _MOST_PAIRED and self.has_time():
                self.pairs = _Pairs.of(self.cycles, self.edges)
            if self.most_cost.sum() >= before:
                return
            before = self.most_cost.sum()
            self.join_classes()

    def leave_out_wrong(self) -> None:
        """Steps 1 and 3: leave out closures that cost more than s_e, until nothing changes.

        No cost is below zero, so that s_e is not, either, for those that are left.
        """
        while len(self.edges):
            before = self.most_cost
            self.most_cost = np.minimum(before, self._costs_beside())
            right = self.bound <= self.most_cost
            if right.all() and not (self.most_cost < before).any():
                return
            self.edges = self.edges[right]
            self.thresholds = self.thresholds[right]
            self.is_kept = self.is_kept[right]
            self.class_of = np.unique(self.class_of[right], return_inverse=True)[1]
            self.most_cost = self.most_cost[right]
            self.bound = self.bound[right]
            self.distance = self.distance[right]
            self.pairs = None if self.pairs is None else self.pairs[right]

    def _costs_beside(self) -> Array:
        """s_e, (k,): U - C, c_e^2, and the largest c_f^2 of each other class that may go with e."""
        in_order = np.argsort(self.class_of, kind="stable")
        begins = np.flatnonzero(np.diff(self.class_of[in_order], prepend=-1))
        beside = np.where(self.is_inconsistent(), 0.0, self.thresholds)[:, in_order]
        sums = np.maximum.reduceat(beside, begins, axis=1).sum(axis=1)
        return np.asarray(self.cost - self.total + sums)

    def is_inconsistent(self) -> BoolArray:
        """Pairs, (k, k), of which no map as good as the answer keeps both."""
        if self.pairs is None:
            # Nothing is known of pairs: one row serves all closures.
            return np.zeros((1, len(self.edges)), dtype=bool)
        return np.asarray(self.pairs.bound > self._most_costs_of_pairs())

    def _most_costs_of_pairs(self) -> Array:
        return np.minimum.outer(self.most_cost, self.most_cost)

    def try_singles(self, effort: _Effort) -> None:
        """Step 1: try to prove closures wrong, those with the largest bounds first."""
        s = self.most_cost
        hopeful = (self.bound >= effort.bound * s) & (self.distance > effort.distance * s)
        tried = np.flatnonzero(hopeful & ~self.is_kept)
        ratio = self.bound[tried] / np.maximum(s[tried], _LEAST)
        for e in tried[np.argsort(-ratio, kind="stable")].tolist():
            self.bound[e] = max(self.bound[e], self._prove((e,), s[e], effort))
        self.leave_out_wrong()

    def join_classes(self, effort: _Effort | None = None) -> None:
        """Step 2: classes of inconsistent closures, if they are better than those there are.

        A closure goes to the first class with every member of which it is inconsistent: those that
        the answer keeps first, then those that are consistent with the most others. With an effort
        pairs that are hopeful are tried, up to a number.
        """
        if self.pairs is None:
            return
        inconsistent = self.is_inconsistent()
        may_join = inconsistent if effort is None else inconsistent | self._is_hopeful(effort)
        k = len(self.edges)
        takes = np.ones((k, k), dtype=bool)  # whether a class may take a closure
        classes: list[list[int]] = []
        class_of = np.zeros(k, dtype=np.int64)
        most_tried = len(self.tried) + _MOST_PROOFS
        for e in np.lexsort([inconsistent.sum(axis=1), ~self.is_kept]).tolist():
            for q in np.flatnonzero(takes[: len(classes), e]).tolist():
                if self._excludes(classes[q], e, effort, most_tried):
                    break
            else:  # no class takes it
                q = len(classes)
                classes.append([])
            classes[q].append(e)
            takes[q] &= may_join[e]
            class_of[e] = q
        if self._sum_of_largest(class_of) < self._sum_of_largest(self.class_of):
            self.class_of = class_of

    def _is_hopeful(self, effort: _Effort) -> BoolArray:
        """Pairs, (k, k), that are worth an effort; not those that the answer keeps."""
        assert self.pairs is not None
        s = self._most_costs_of_pairs()
        bound = np.maximum(self.pairs.bound, np.maximum.outer(self.bound, self.bound))
        hopeful = (bound >= effort.bound * s) & (self.pairs.distance > effort.distance * s)
        return np.asarray(hopeful & ~np.logical_and.outer(self.is_kept, self.is_kept))

    def _excludes(
        self, members: list[int], e: int, effort: _Effort | None, most_tried: int
    ) -> bool:
        """Whether closures are inconsistent with another; the hardest are tried first."""
        assert self.pairs is not None
        others = np.array(members)
        s = np.minimum(self.most_cost[e], self.most_cost[others])
        is_open = self.pairs.bound[e, others] <= s
        others = others[is_open]
        s = s[is_open]
        ratio = self.pairs.bound[e, others] / np.maximum(s, _LEAST)
        for place in np.argsort(ratio, kind="stable").tolist():
            if effort is None or len(self.tried) >= most_tried:
                return False
            f = int(others[place])
            bound = max(self.pairs.bound[e, f], self._prove((e, f), s[place], effort))
            self.pairs.bound[e, f] = self.pairs.bound[f, e] = bound
            if bound <= s[place]:
                return False
        return True

    def _prove(self, closures: tuple[int, ...], s: float, effort: _Effort) -> float:
        """Lower bound that an effort proves; zero if it was made before."""
        edges = tuple(sorted(self.edges[list(closures)].tolist()))
        if (edges, effort.num_steps) in self.tried or not self.has_time():
            return 0.0
        self.tried.add((edges, effort.num_steps))
        return self.costs.lower_bound(edges, s, effort.num_steps)

    def _sum_of_largest(self, class_of: IntArray) -> float:
        """Sum of the largest c_e^2 of each class."""
        largest = np.zeros(len(class_of))
        np.maximum.at(largest, class_of, self.thresholds)
        return float(largest.sum())

    def proof(self) -> OutlierProof:
        """What has been proven so far."""
        proven_wrong = ~self.known
        proven_wrong[self.edges] = False
        bound = self.total - self._sum_of_largest(self.class_of) - _MARGIN * self.total
        return OutlierProof(
            proven_wrong,
            num_kept=int(self.is_kept.sum()),
            num_closures=int((~self.known).sum()),
            most_closures=len(np.unique(self.class_of)),
            truncated_cost=self.cost,
            truncated_cost_bound=max(0.0, bound),
            is_complete=self.is_complete,
        )


def _single_distances(chains: Chains, edges: IntArray) -> Array:
    """First-order distances, (k,), of edges from the chain between their ends; zero elsewhere."""
    graph = chains.graph
    distances = np.zeros(len(edges))
    whole = np.flatnonzero(is_whole(graph)[edges])
    closures = chains.closures(edges[whole])
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
    a, b = chains.pairs(closures)
    distances[whole[a], whole[b]] = cycle_distances(closures, chains.covariance, a, b)
    return distances + distances.T
