"""Search for the closures to keep by the linear theory, where few of them hold the map.

Each choice (`LinearChoice`) is made at the map of the one before, which is not linear: the choice
that is best in theory is settled, and judged by the truncated cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.pose_graph import IntArray
from solvers.robust.chains import QUANTILE, is_whole
from solvers.robust.edge_sets import EdgeSets, with_edges
from solvers.robust.linear_choice import LinearChoice
from solvers.robust.revision import Fit, inlier_problem, is_held

# Closures among which the theory chooses, at most, as its matrix is dense; and closures that a map
# keeps at most: more make it too stiff to bend.
_MOST_CLOSURES = 400
_MOST_KEPT = 40
_MOST_CHOICES = 6  # in a row before the search gives up
# Where the edges that stay leave poses loose, or rounding makes a matrix singular.
_NO_MODEL = (NotPositiveDefiniteError, np.linalg.LinAlgError)


@dataclass(frozen=True, eq=False)
class LinearSearch:
    """Search among the whole closures of a graph that the other edges hold."""

    sets: EdgeSets
    closures: IntArray

    @classmethod
    def of(cls, sets: EdgeSets) -> LinearSearch:
        """Search among the edges that are not known and measure whole motions."""
        return cls(sets, np.flatnonzero(~sets.known & is_whole(sets.problem.graph)))

    def exchanged(self, fit: Fit) -> Fit | None:
        """A better fit, with any closures in place of any of those kept.

        It is made by choices in a row, of which all but the last may be worse.
        """
        if not self._has_few(fit):
            return None
        current = fit
        for _ in range(_MOST_CHOICES):
            if not self.sets.has_time():
                return None
            kept = self._kept(current)
            try:
                chosen = self._model(current).best(kept, self.sets.has_time)
            except _NO_MODEL:
                return None
            if np.isin(chosen, kept).all():
                # Nothing comes in: whether edges have to go is for other tests to say.
                return None
            edges = with_edges(self._staying(fit), self.closures[chosen])
            current = self.sets.settled(edges, current.poses)
            if self.sets.is_better(current, fit):
                return current
        return None

    def _kept(self, fit: Fit) -> IntArray:
        """Places in `closures` of those that a fit keeps."""
        return np.flatnonzero(fit.kept[self.closures])

    def _staying(self, fit: Fit) -> BoolArray:
        """Edges that are not chosen among, (m,)."""
        staying = fit.kept.copy()
        staying[self.closures] = False
        return staying

    def _has_few(self, fit: Fit) -> bool:
        """Whether there is something to choose from and not too much.

        The edges that are not chosen among have to hold the poses.
        """
        are_few = 0 < len(self.closures) <= _MOST_CLOSURES and len(self._kept(fit)) <= _MOST_KEPT
        return are_few and is_held(self.sets.problem.graph, self._staying(fit))

    def _model(self, fit: Fit) -> LinearChoice:
        sets = self.sets
        return LinearChoice.of(
            inlier_problem(sets.problem, self._staying(fit)),
            sets.problem.graph,
            (self.closures, sets.chains.measured[self.closures]),
            self._kept(fit),
            fit.poses,
            sets.scale * float(scipy.special.chdtri(sets.motion_dimension, 1.0 - QUANTILE)),
        )
