"""Search for the closures to keep by the linear theory, where few of them hold the map.

Each choice (`LinearChoice`) is made at the map of the one before, which is not linear: the choice
that is best in theory is settled, and judged by the truncated cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import BoolArray, tangent_dimension
from pgo_models.graphs.pose_graph import IntArray
from solvers.robust.chains import is_whole, measured_covariances
from solvers.robust.edge_sets import EdgeSets, with_edges
from solvers.robust.linear_choice import LinearChoice
from solvers.robust.revision import Fit, inlier_problem, is_held

# Probability with which a right closure costs no more than its threshold.
_QUANTILE = 0.99
# Closures among which the theory chooses, at most, as its matrix is dense; and closures that a map
# keeps: one that more of them hold hardly bends.
_MOST_CLOSURES = 400
_MOST_KEPT = 40
# Choices in a row, as long as the truncated cost has not fallen.
_MOST_CHOICES = 6
# Choices in a row where a closure is left out.
_MOST_CHOICES_WITHOUT = 3


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
        """A better fit, with any of the closures in place of any others."""
        return self._chosen(fit, None, _MOST_CHOICES) if self._can_choose(fit) else None

    def without_one(self, fit: Fit) -> Fit | None:
        """A better fit, without one of the closures kept, to which the map may have been bent."""
        if not self._can_choose(fit):
            return None
        try:
            model = self._model(fit, self._staying(fit))
            suspects = model.suspects(np.flatnonzero(fit.kept[self.closures]))
        except (NotPositiveDefiniteError, np.linalg.LinAlgError):
            return None
        for suspect in suspects.tolist():
            other = self._chosen(fit, suspect, _MOST_CHOICES_WITHOUT)
            if other is not None:
                return other
        return None

    def _can_choose(self, fit: Fit) -> bool:
        """Whether there are closures to choose from, not too many, and other edges hold the map."""
        num_kept = int(fit.kept[self.closures].sum())
        are_few = 0 < len(self.closures) <= _MOST_CLOSURES and num_kept <= _MOST_KEPT
        return are_few and is_held(self.sets.problem.graph, self._staying(fit))

    def _staying(self, fit: Fit) -> BoolArray:
        """Edges that are not chosen among, (m,)."""
        staying = fit.kept.copy()
        staying[self.closures] = False
        return staying

    def _chosen(self, fit: Fit, excluded: int | None, most_choices: int) -> Fit | None:
        """A better fit by choices in a row, the first of which may be worse."""
        staying = self._staying(fit)
        current = fit
        for _ in range(most_choices):
            if not self.sets.has_time():
                return None
            kept = np.flatnonzero(current.kept[self.closures])
            try:
                chosen = self._model(current, staying).best(kept, excluded)
            except (NotPositiveDefiniteError, np.linalg.LinAlgError):
                return None
            if np.isin(chosen, kept).all():
                # Nothing comes in: whether edges have to go is for other tests to say.
                return None
            edges = with_edges(staying, self.closures[chosen])
            current = self.sets.settled(edges, current.poses)
            if self.sets.is_better(current, fit):
                return current
        return None

    def _model(self, fit: Fit, staying: BoolArray) -> LinearChoice:
        problem = self.sets.problem
        d = problem.d
        dof = d + tangent_dimension(d)
        allowed = self.sets.scale * float(scipy.special.chdtri(dof, 1.0 - _QUANTILE))
        return LinearChoice.of(
            inlier_problem(problem, staying),
            problem.graph,
            (self.closures, measured_covariances(problem.graph)[self.closures]),
            np.flatnonzero(fit.kept[self.closures]),
            fit.poses,
            allowed,
        )
