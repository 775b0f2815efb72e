"""Clusters that a map is without and may follow, with their first-order distances from it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.edge_groups import EdgeGroups
from pgo_models.graphs.pose_graph import IntArray
from solvers.robust.chains import QUANTILE
from solvers.robust.distances import FirstOrder
from solvers.robust.edge_sets import EdgeSets
from solvers.robust.revision import Fit

# Distances that are found together. With more, the fill of wrong closures makes each one slower.
_TOGETHER = 100


@dataclass(frozen=True, eq=False)
class Candidates:
    """Clusters without the edges kept, and thresholds (k,) of T.

    `farthest` (k,) is the edge of every cluster that is farthest from the map to first order,
    `first_order` what knows its distance, `largest` (k,) the quantile of this in chi^2. `order` are
    those that may fit, the one of most promise first.
    """

    groups: EdgeGroups
    thresholds: Array
    first_order: FirstOrder
    farthest: IntArray
    largest: Array
    order: IntArray

    @classmethod
    def of(cls, sets: EdgeSets, clusters: EdgeGroups, fit: Fit, most: float) -> Candidates:
        """Rejected parts of clusters, those of `order` within `most` times their thresholds.

        That is to first order, and at least. A cluster promises its thresholds in the truncated
        cost, less its T.
        """
        groups = clusters.of_edges(~fit.kept)
        thresholds = sets.scale * sets.right_costs.thresholds(groups, QUANTILE)
        first_order = FirstOrder(sets.chains, fit.inliers, fit.poses)
        quantiles = scipy.special.chdtri(groups.sizes * sets.motion_dimension, 1.0 - QUANTILE)
        largest = np.asarray(sets.scale * quantiles, dtype=float)
        distances = first_order.least_distances(groups.edges)
        last = np.lexsort([distances, groups.group_of])[groups.beginnings + groups.sizes - 1]
        ratio = distances[last] / largest
        order = np.argsort(ratio * thresholds - groups.sums(sets.allowed), kind="stable")
        order = order[ratio[order] <= most]
        return cls(groups, thresholds, first_order, groups.edges[last], largest, order)

    def ratios(self, chosen: IntArray) -> Array:
        """First-order distances of the farthest edges of some, over their quantiles."""
        return self.first_order.distances(self.farthest[chosen]) / self.largest[chosen]

    def near(self, chosen: IntArray, most: float, beyond: float = -np.inf) -> Iterator[int]:
        """Those of the `chosen` whose first-order distance is between two multiples of a threshold.

        It is above `beyond` times the threshold, and at most `most` times.
        """
        for first in range(0, len(chosen), _TOGETHER):
            looked_at = chosen[first : first + _TOGETHER]
            ratios = self.ratios(looked_at)
            yield from looked_at[(ratios > beyond) & (ratios <= most)].tolist()
