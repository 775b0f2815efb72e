"""Smaller information matrices, whose chi2 is below that of the file and easier to bound.

For I' <= I the cost is below chi2 at all poses, so that a bound on it is one on chi2. Two
properties of I can leave the tangent at the minimum of chi2 without a bound.

- The largest eigenvalue of I_rr may exceed the sum of the others. Then W is indefinite, and a
  reflection has a negative cost, and the relaxation cannot tell it from a rotation. So the
  largest eigenvalue of I'_rr is at most the second one plus half the smallest.
- The tangent keeps the smallest eigenvalue of I_tt alone. So the eigenvalues of I'_tt are at most
  `cap` times the smallest one. `solvers.riemannian.shrunk_bound` seeks the cap.
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
    are_singular,
    proper_information,
    uncoupled_share,
)
from pgo_models.problem.weighting import least_rotation_part

_SHOWN = 2.0**-45  # smallest eigenvalue of a matrix with ones on its diagonal that is not rounding
_SHARE_ROUNDING = 2.0**-20  # taken off the share that the coupling leaves, as it is rounded
_HALVINGS = 60  # of a share that rounding makes too large; the matrix is then about zero
# of the trace: above the rounding of a block, so that I' is below I all the same
_MARGIN = 2.0**-40


def shrink_information(graph: PoseGraph, cap: float) -> PoseGraph:
    """Return the graph with information matrices below its own that are easier to bound.

    The condition of their I_tt is at most `cap`, and their W is convex.

    Coupling blocks are removed first. With C = I_tt^-1/2 I_tr I_rr^-1/2 the rest keeps the share
    1 - ||C||, since I >= (1 - ||C||) blockdiag(I_tt, I_rr). Rounding may ask for a smaller share.
    An edge whose coupled matrix is only semidefinite has a share of zero. Such an edge costs zero
    or more, and is removed; so is a singular block. A GraphError is raised if rounding hides the
    inequality for every share, or if the other edges do not connect the graph.
    """
    information = without_singular_blocks(proper_information(graph), graph.d)
    d = graph.d
    I_tt = information[:, :d, :d]
    I_tr = information[:, :d, d:]
    I_rr = information[:, d:, d:]
    is_coupled = I_tr.any(axis=(1, 2))
    is_singular = is_coupled & ~are_definite(information, LEAST_SCALED)
    is_singular |= ~information.any(axis=(1, 2))
    # Weights of the two smallest eigenvalues of I_rr in the limit of the largest: W is convex if
    # the largest is at most the second and half the smallest.
    limit_weights = np.array([0.5, 1.0]) if d == 3 else np.ones(1)

    def largest_of_tt(values: Array) -> Array:
        return np.asarray(cap * values[:, 0])

    def largest_of_rr(values: Array) -> Array:
        return np.asarray(values[:, :2] @ limit_weights)

    coupled_share = uncoupled_share(information, d) - _SHARE_ROUNDING
    share = np.where(is_coupled, np.maximum(coupled_share, 0.0), 1.0)
    is_below = ~is_coupled
    for _ in range(_HALVINGS):
        shares = share[:, None, None]
        smaller = np.zeros_like(information)
        smaller[:, :d, :d] = _clipped(shares * I_tt, largest_of_tt)
        smaller[:, d:, d:] = _clipped(shares * I_rr, largest_of_rr)
        is_below = is_below | are_definite(information - smaller, _SHOWN) | is_singular
        if is_below.all():
            shrunk = replace(graph, information=smaller)
            return shrunk.without_edges(is_singular) if is_singular.any() else shrunk
        # Rounding hides that the others are below; half of them is tried.
        share = np.where(is_below, share, 0.5 * share)
    raise GraphError("rounding hides that smaller information matrices are below the graph's own")


def without_singular_blocks(information: Array, d: int) -> Array:
    """Matrices, (m, k, k), below the given ones, whose blocks measure every direction or none.

    A block that does not measure every direction goes, and the coupling with it. Of the other block
    stays what is left once the residuals of the first are the best ones: the Schur complement.
    """
    singular_t = are_singular(information[:, :d, :d])
    singular_R = are_singular(information[:, d:, d:])
    if not (singular_t | singular_R).any():
        return information
    kept = information.copy()
    rotations_first = np.roll(information, -d, axis=(1, 2))
    p = information.shape[1] - d
    kept[singular_t, d:, d:] = _least_of_second_block(information[singular_t], d)
    kept[singular_R, :d, :d] = _least_of_second_block(rotations_first[singular_R], p)
    kept[singular_t, :d] = 0.0
    kept[singular_t, :, :d] = 0.0
    kept[singular_R, d:] = 0.0
    kept[singular_R, :, d:] = 0.0
    return kept


def _least_of_second_block(information: Array, size: int) -> Array:
    """Blocks B, (k, q, q), with diag(0, B) below matrices whose first block is singular.

    It is zero where the second block leaves no direction measured on its own.
    """
    block = information[:, size:, size:].copy()
    is_coupled = information[:, :size, size:].any(axis=(1, 2))
    coupled = information[is_coupled]
    rest = block[is_coupled] - least_rotation_part(coupled, size)
    traces = np.einsum("kaa->k", block[is_coupled])
    rest -= _MARGIN * traces[:, None, None] * np.eye(block.shape[1])
    is_definite = are_definite(rest, LEAST_SCALED)
    block[is_coupled] = np.where(is_definite[:, None, None], rest, 0.0)
    return block


def _clipped(block: Array, limit: Callable[[Array], Array]) -> Array:
    """Blocks with their eigenvalues, ascending, cut to a limit; below them for all rounding."""
    values, axes = np.linalg.eigh(block)
    traces = np.einsum("mkk->m", block)
    margin = _MARGIN * traces[:, None]
    largest = limit(values)[:, None]
    smaller = np.minimum(values, largest) - margin
    scaled_axes = axes * smaller[:, None, :]
    product = scaled_axes @ np.swapaxes(axes, 1, 2)
    return np.asarray(0.5 * (product + np.swapaxes(product, 1, 2)))
