"""Clusters that a map is without and may follow, with their first-order distances from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from solvers.robust.distances import FirstOrder
from solvers.robust.edge_sets import QUANTILE, EdgeSets
from solvers.robust.revision import Fit, inlier_problem


@dataclass(frozen=True, eq=False)
class Candidates:
    """Clusters without the edges kept: their names, edges, and thresholds (k,) of T.

    `farthest` (k,) is the edge of every cluster that is farthest from the map to first order,
    `first_order` what knows its distance, `largest` (k,) the quantile of this in chi^2. `order` are
    those that may fit, the one of most promise first.
    """

    names: list[int]
    groups: list[IntArray]
    thresholds: Array
    first_order: FirstOrder
    farthest: IntArray
    largest: Array
    order: IntArray

    @classmethod
    def of(cls, sets: EdgeSets, clusters: Sequence[IntArray], fit: Fit, most: float) -> Candidates:
        """Rejected parts of clusters, those of `order` within `most` times their thresholds.

        That is to first order, and at least. A cluster promises its thresholds in the truncated
        cost, less its T.
        """
        rejected = [cluster[~fit.kept[cluster]] for cluster in clusters]
        names = [name for name, cluster in enumerate(rejected) if len(cluster)]
        groups = [rejected[name] for name in names]
        thresholds = sets.scale * sets.right_costs.thresholds(groups, QUANTILE)
        first_order = FirstOrder(sets.chains, inlier_problem(sets.problem, fit.kept), fit.poses)
        sizes = np.array([len(group) for group in groups], dtype=int)
        quantiles = scipy.special.chdtri(sizes * sets.motion_dimension, 1.0 - QUANTILE)
        largest = np.asarray(sets.scale * quantiles, dtype=float)
        farthest, ratio = np.zeros(0, dtype=int), np.zeros(0)
        if groups:
            edges = np.concatenate(groups)
            distances = first_order.least_distances(edges)
            beginnings = np.cumsum(sizes) - sizes
            ratio = np.maximum.reduceat(distances, beginnings) / largest
            by_cluster = np.repeat(np.arange(len(groups)), sizes)
            last = np.lexsort([distances, by_cluster])[beginnings + sizes - 1]
            farthest = edges[last]
        allowed = np.array([sets.allowed[group].sum() for group in groups])
        order = np.argsort(ratio * thresholds - allowed, kind="stable")
        order = order[ratio[order] <= most]
        return cls(names, groups, thresholds, first_order, farthest, largest, order)

    def ratio(self, k: int) -> float:
        """First-order distance of a cluster's farthest edge, over its quantile."""
        return self.first_order.distance(int(self.farthest[k])) / float(self.largest[k])
