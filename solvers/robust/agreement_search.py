"""Search without odometry: maps along trees of edges that agree, and the edges that fit these.

A single start ends in a wrong minimum where many edges are wrong. So several starts are made along
trees of edges whose cycles agree (`Agreement`). Most of these trees have no wrong edge.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pgo_models.errors import FAILURES, GraphError
from pgo_models.geometry.poses import Poses
from pgo_models.problem.initialization import chordal_start, spanning_tree_start
from solvers.robust.agreement import Agreement
from solvers.robust.edge_sets import EdgeSets
from solvers.robust.revision import Fit, threshold_scale
from solvers.robust.weighted_edges import held_together

# Thresholds, as multiples of those of the truncated cost, up to which edges are kept in turn.
_SHRINKING = (9.0, 3.0, 1.0, 1.0, 1.0)
# Trees, one of them without noise. The right edges of a view graph of 12 poses, 27 % of whose edges
# are wrong, are found from 10 trees of 32.
_MOST_TREES = 31
_LEAST_TREES = 2  # the one without noise and another
# Scale of the errors below which they are rounding: a tree fits all its edges.
_LEAST_SCALE = 1e-12
# Trees times edges: some seconds on a large graph.
_MOST_WORK = 30_000


def best_by_agreement(sets: EdgeSets) -> Fit:
    """The fit of least truncated cost from all starts.

    Where errors turn out to be smaller than claimed, the search starts again at their scale.
    """
    best = _best_at_scale(sets)
    scale = threshold_scale(best.error_scale)
    if not _LEAST_SCALE <= scale < sets.scale:
        return best
    scaled = replace(sets, allowed=sets.allowed * (scale / sets.scale), scale=scale)
    return min(best, _best_at_scale(scaled), key=scaled.cost)


def _best_at_scale(sets: EdgeSets) -> Fit:
    """The best fit at the scale of the sets. The error of the last start, where all fail."""
    seen: set[bytes] = set()
    fits: list[Fit] = []
    last_failure: Exception = GraphError()
    for start in _starts(sets):
        try:
            fits.append(_shrunk(sets, start, seen))
        except FAILURES as error:
            last_failure = error
        if fits and not sets.has_time():
            break
    if not fits:
        raise last_failure
    return min(fits, key=sets.cost)


def _starts(sets: EdgeSets) -> Iterator[Poses]:
    """Poses along trees of agreement, and those of least squares with all edges."""
    problem = sets.problem
    num_trees = min(_MOST_TREES, max(_LEAST_TREES, _MOST_WORK // problem.graph.num_edges))
    seen = set()
    for weights in Agreement.of(problem, sets.scale).trees(num_trees):
        tree = held_together(problem.graph, sets.known, weights)
        if tree.tobytes() not in seen:
            seen.add(tree.tobytes())
            yield spanning_tree_start(problem.graph.without_edges(~tree))
    try:
        every_edge = np.ones_like(sets.known)
        yield sets.settled(every_edge, chordal_start(problem)).poses
    except FAILURES:
        return


def _shrunk(sets: EdgeSets, poses: Poses, seen: set[bytes]) -> Fit:
    """The fit of the edges kept as thresholds shrink, up to where another start has led to it.

    `seen` has the edges that starts so far have kept at the last threshold.
    """
    fit = sets.settled(sets.within(poses, _SHRINKING[0]), poses)
    for factor in _SHRINKING[1:]:
        kept = sets.within(fit.poses, factor)
        is_last = factor == _SHRINKING[-1]
        if is_last and kept.tobytes() in seen:
            break
        if is_last:
            seen.add(kept.tobytes())
        if not np.array_equal(kept, fit.kept):
            fit = sets.settled(kept, fit.poses)
    return fit
