"""What proven bounds on closures say of all maps that are as good as a robust answer.

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

All claims are made here, of bounds alone: which of them to seek is decided elsewhere
(`outlier_proof`), by distances that prove nothing and that this file does not see.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from solvers.robust.outlier_record import OutlierProof

# Share of U + C by which U is raised, and the bound on the truncated cost lowered. Sums of a
# million positive terms are off by 1e-10 at most; ten times as much costs no proof.
_MARGIN = 1e-9


@dataclass(eq=False)
class ProvenClosures:
    """Closures `edges` (k,) that are not proven wrong, and what is proven of them.

    `cost` is U, an upper bound, and `total` C; `most_cost` (k,) is s_e of each closure, and
    `class_of` (k,) its class. `singles` (k,) are proven lower bounds of d_e, and `pairs` (k, k)
    those of d_ef, None where nothing is known of them.
    """

    known: BoolArray
    cost: float
    total: float
    edges: IntArray
    thresholds: Array
    is_kept: BoolArray
    class_of: IntArray
    most_cost: Array
    singles: Array
    pairs: Array | None = None

    @classmethod
    def of(
        cls, known: BoolArray, kept: BoolArray, thresholds: Array, cost: float, singles: Array
    ) -> ProvenClosures:
        """Of an answer at this cost that keeps some edges, (m,), with thresholds, (m,)."""
        edges = np.flatnonzero(~known)
        total = float(thresholds[edges].sum())
        return cls(
            known,
            cost=cost + _MARGIN * (cost + total),
            total=total,
            edges=edges,
            thresholds=thresholds[edges],
            is_kept=kept[edges],
            class_of=np.arange(len(edges)),
            most_cost=np.full(len(edges), math.inf),
            singles=singles,
        )

    def raise_single(self, e: int, bound: float) -> None:
        """Take note of a lower bound of d_e."""
        self.singles[e] = max(self.singles[e], bound)

    def raise_pair(self, e: int, f: int, bound: float) -> None:
        """Take note of a lower bound of d_ef."""
        assert self.pairs is not None
        self.pairs[e, f] = self.pairs[f, e] = max(self.pairs[e, f], bound)

    def use_bounds(self) -> None:
        """Lower s by the bounds that are known, until nothing changes."""
        before = math.inf
        self.leave_out_wrong()
        while self.most_cost.sum() < before:
            before = self.most_cost.sum()
            self.join_classes()
            self.leave_out_wrong()

    def leave_out_wrong(self) -> None:
        """Steps 1 and 3: leave out closures that cost more than s_e, until nothing changes.

        No cost is below zero, so that s_e is not, either, for those that are left.
        """
        while len(self.edges):
            before = self.most_cost
            self.most_cost = np.minimum(before, self._costs_beside())
            right = self.singles <= self.most_cost
            if right.all() and not (self.most_cost < before).any():
                return
            self.edges = self.edges[right]
            self.thresholds = self.thresholds[right]
            self.is_kept = self.is_kept[right]
            self.class_of = np.unique(self.class_of[right], return_inverse=True)[1]
            self.most_cost = self.most_cost[right]
            self.singles = self.singles[right]
            self.pairs = None if self.pairs is None else self.pairs[np.ix_(right, right)]

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
        return np.asarray(self.pairs > self.most_costs_of_pairs())

    def most_costs_of_pairs(self) -> Array:
        """The smaller of s_e and s_f for all pairs, (k, k)."""
        return np.minimum.outer(self.most_cost, self.most_cost)

    def are_inconsistent(self, e: int, others: IntArray) -> BoolArray:
        """Whether no map as good as the answer keeps a closure and each of others, (q,)."""
        assert self.pairs is not None
        s = np.minimum(self.most_cost[e], self.most_cost[others])
        return np.asarray(self.pairs[e, others] > s)

    def join_classes(
        self,
        hopeful: BoolArray | None = None,
        prove: Callable[[int, IntArray], None] | None = None,
    ) -> None:
        """Step 2: classes of inconsistent closures, if they are better than those there are.

        A closure goes to the first class with every member of which it is inconsistent: those that
        the answer keeps first, then those that are consistent with the most others. Of pairs that
        are `hopeful`, (k, k), `prove` may raise bounds beforehand.
        """
        if self.pairs is None:
            return
        inconsistent = self.is_inconsistent()
        may_join = inconsistent if hopeful is None else inconsistent | hopeful
        k = len(self.edges)
        takes = np.ones((k, k), dtype=bool)  # whether a class may take a closure
        classes: list[list[int]] = []
        class_of = np.zeros(k, dtype=np.int64)
        for e in np.lexsort([inconsistent.sum(axis=1), ~self.is_kept]).tolist():
            for q in np.flatnonzero(takes[: len(classes), e]).tolist():
                members = np.array(classes[q])
                if prove is not None:
                    prove(e, members)
                if self.are_inconsistent(e, members).all():
                    break
            else:  # no class takes it
                q = len(classes)
                classes.append([])
            classes[q].append(e)
            takes[q] &= may_join[e]
            class_of[e] = q
        if self._sum_of_largest(class_of) < self._sum_of_largest(self.class_of):
            self.class_of = class_of

    def _sum_of_largest(self, class_of: IntArray) -> float:
        """Sum of the largest c_e^2 of each class."""
        largest = np.zeros(len(class_of))
        np.maximum.at(largest, class_of, self.thresholds)
        return float(largest.sum())

    def proof(self, is_complete: bool) -> OutlierProof:
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
            is_complete=is_complete,
        )
