"""Smaller information matrices, whose chi2 is below that of the file and easier to bound.

For I' <= I the cost is below chi2 at all poses, so that a bound on it is one on chi2. Two things
stand in the way of the tangent at the minimum of chi2. Where the largest eigenvalue of I_rr is
above the sum of the others, W is indefinite, and a reflection, which the relaxation cannot tell
from a rotation, costs less than nothing: the largest eigenvalue of I'_rr is at most the second and
half the smallest. And the tangent leaves of I_tt but its smallest eigenvalue: those of I'_tt are at
most `cap` times that. `solvers.riemannian.shrunk_bound` seeks the cap.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pgo_models.errors import GraphError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import (
    LEAST_SCALED,
    are_definite,
    proper_information,
    uncoupled_share,
)

_SHOWN = 2.0**-45  # smallest eigenvalue of a matrix with ones on its diagonal that is not rounding
_HALVINGS = 60  # of a share that rounding makes too large: nothing is left of the matrix then
# of the trace: above the rounding of a block, so that I' is below I all the same
_MARGIN = 2.0**-40


def shrink_information(graph: PoseGraph, cap: float) -> PoseGraph:
    """Return the graph with information matrices below its own that are easier to bound.

    The condition of their I_tt is at most `cap`, and their W is convex.

    Coupling blocks are taken out first, with what they can take from the others: with C = I_tt^-1/2
    I_tr I_rr^-1/2, I >= (1 - ||C||) blockdiag(I_tt, I_rr), or a smaller share where rounding hides
    that. Edges whose coupled matrix is only semidefinite, where that share is zero, are left out:
    they cost zero or more. A GraphError where rounding hides it for every share.
    """
    information = proper_information(graph)
    d = graph.d
    I_tt = information[:, :d, :d]
    I_tr = information[:, :d, d:]
    I_rr = information[:, d:, d:]
    is_singular = I_tr.any(axis=(1, 2)) & ~are_definite(information, LEAST_SCALED)
    share = uncoupled_share(information, d) - 2.0**-20
    # W is convex if the largest eigenvalue of I_rr is at most the second and half the smallest.
    limit = np.array([0.5, 1.0]) if d == 3 else np.ones(1)
    share = np.where(I_tr.any(axis=(1, 2)), np.maximum(share, 0.0), 1.0)
    is_below = ~I_tr.any(axis=(1, 2))
    for _ in range(_HALVINGS):
        smaller = np.zeros_like(information)
        smaller[:, :d, :d] = _clipped(
            share[:, None, None] * I_tt, lambda values: cap * values[:, 0]
        )
        smaller[:, d:, d:] = _clipped(
            share[:, None, None] * I_rr, lambda values: values[:, :2] @ limit
        )
        is_below = is_below | are_definite(information - smaller, _SHOWN) | is_singular
        if is_below.all():
            shrunk = replace(graph, information=smaller)
            return shrunk.without_edges(is_singular) if is_singular.any() else shrunk
        share = np.where(is_below, share, 0.5 * share)  # was rounded
    raise GraphError("rounding hides that smaller information matrices are below the graph's own")


def _clipped(block: Array, limit: Callable[[Array], Array]) -> Array:
    """Blocks with their eigenvalues, ascending, cut to a limit; below them for all rounding."""
    values, axes = np.linalg.eigh(block)
    margin = _MARGIN * np.einsum("mkk->m", block)[:, None]
    smaller = np.minimum(values, limit(values)[:, None]) - margin
    product = (axes * smaller[:, None, :]) @ np.swapaxes(axes, 1, 2)
    return np.asarray(0.5 * (product + np.swapaxes(product, 1, 2)))
