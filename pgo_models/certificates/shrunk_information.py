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
from scipy.sparse.csgraph import connected_components

from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray, PoseGraph, edge_counts, least_tree
from pgo_models.graphs.precisions import (
    LEAST_SCALED,
    UNMEASURED_SHARE,
    are_definite,
    are_singular,
    proper_information,
    uncoupled_share,
)
from pgo_models.problem.weighting import least_rotation_part

_SHOWN = 2.0**-45  # smallest eigenvalue of a matrix with ones on its diagonal that is not rounding
_SHARE_ROUNDING = 2.0**-20  # taken off the share that the coupling leaves, as it is rounded
# of the trace: above the rounding of a block, so that I' is below I all the same
_MARGIN = 2.0**-40


def shrink_information(graph: PoseGraph, cap: float) -> PoseGraph:
    """Return the graph with information matrices below its own that are easier to bound.

    The condition of their I_tt is at most `cap`, and their W is convex.

    Coupling blocks are removed first. With C = I_tt^-1/2 I_tr I_rr^-1/2 the rest keeps the share
    1 - ||C||, since I >= (1 - ||C||) blockdiag(I_tt, I_rr). An edge whose coupled matrix is only
    semidefinite, or whose inequality rounding hides, costs zero or more, and is removed; so is a
    singular block. A GraphError is raised if no edge is left.
    """
    whole = without_singular_blocks(proper_information(graph), graph.d)
    return _without_empty_edges(graph, _smaller_information(whole, graph.d, cap))


def shrink_and_join(
    graph: PoseGraph, whole: Array, cap: float, by_positions: bool = True
) -> PoseGraph:
    """The graph of `shrink_information`, with its parts joined by edges that cost nothing.

    `whole`, (m, k, k), are the matrices of the graph without singular blocks.

    Parts that no edge joins can be moved, each as a whole, and those that no translation joins can
    be shifted. So edges that join them, without a cycle, fit at the least cost, which they leave as
    it is, whatever they measure and weigh. They make the minimum a single one. An edge that all but
    leaves a direction out joins no parts, and is dropped between them. So is an edge between poses
    that measures positions alone, unless `by_positions`: too few of them leave the turn of a part
    free.
    """
    d = graph.d
    smaller = _smaller_information(whole, d, cap)
    tau, joins_t = _joining_weights(whole[:, :d, :d], smaller[:, :d, :d])
    kappa, joins_R = _joining_weights(whole[:, d:, d:], smaller[:, d:, d:])
    to_landmark = np.isin(graph.j, graph.landmarks)
    usual = np.diag(np.repeat([tau, kappa], [d, smaller.shape[1] - d]))
    joins = joins_R | (joins_t if by_positions else joins_t & to_landmark)
    is_between, tree = _between_parts(graph, joins)
    smaller[is_between] = 0.0
    smaller[tree] = usual
    joins_t &= ~is_between
    joins_t[tree] = True
    is_between, tree = _between_parts(graph, joins_t)
    smaller[is_between, :d, :d] = 0.0
    smaller[tree, :d, :d] = usual[:d, :d]
    smaller[to_landmark, d:, d:] = 0.0
    return _without_empty_edges(graph, smaller)


def _without_empty_edges(graph: PoseGraph, information: Array) -> PoseGraph:
    """The graph with other matrices, (m, k, k), without edges that have zeros."""
    is_empty: BoolArray = np.all(information == 0.0, axis=(1, 2))
    changed = replace(graph, information=information)
    return changed.without_edges(is_empty) if is_empty.any() else changed


def _joining_weights(blocks: Array, smaller: Array) -> tuple[float, BoolArray]:
    """A usual weight of smaller blocks, and which edges, (m,), measure every direction enough.

    Their smallest eigenvalue is not below `UNMEASURED_SHARE` of the trace of the block itself.
    """
    least = np.linalg.eigvalsh(smaller)[:, 0]
    joins = (least > 0.0) & (least >= UNMEASURED_SHARE * np.einsum("mkk->m", blocks))
    usual = float(np.median(least[joins])) if joins.any() else 1.0
    return usual, joins


def _between_parts(graph: PoseGraph, joins: BoolArray) -> tuple[BoolArray, IntArray]:
    """Which edges, (m,), are between parts that other edges join, and some of them, a tree."""
    links = edge_counts(graph.i[joins], graph.j[joins], graph.num_poses)
    count, part = connected_components(links, directed=False)
    ends_i = part[graph.i]
    ends_j = part[graph.j]
    # A landmark has no rotation, so that an edge to it leaves a part free to turn.
    to_landmark = np.isin(graph.j, graph.landmarks).astype(float)
    return ends_i != ends_j, least_tree(ends_i, ends_j, count, to_landmark)


def _smaller_information(information: Array, d: int, cap: float) -> Array:
    """Matrices, (m, k, k), of `shrink_information`; zeros of edges that it removes."""
    I_tt = information[:, :d, :d]
    I_tr = information[:, :d, d:]
    I_rr = information[:, d:, d:]
    is_coupled = I_tr.any(axis=(1, 2))
    is_empty = is_coupled & ~are_definite(information, LEAST_SCALED)
    is_empty |= ~information.any(axis=(1, 2))
    # Weights of the two smallest eigenvalues of I_rr in the limit of the largest: W is convex if
    # the largest is at most the second and half the smallest.
    limit_weights = np.array([0.5, 1.0]) if d == 3 else np.ones(1)

    def largest_of_tt(values: Array) -> Array:
        return np.asarray(cap * values[:, 0])

    def largest_of_rr(values: Array) -> Array:
        return np.asarray(values[:, :2] @ limit_weights)

    coupled_share = uncoupled_share(information, d) - _SHARE_ROUNDING
    share = np.where(is_coupled, np.maximum(coupled_share, 0.0), 1.0)
    shares = share[:, None, None]
    smaller = np.zeros_like(information)
    smaller[:, :d, :d] = _clipped(shares * I_tt, largest_of_tt)
    smaller[:, d:, d:] = _clipped(shares * I_rr, largest_of_rr)
    is_below = ~is_coupled | are_definite(information - smaller, _SHOWN)
    smaller[is_empty | ~is_below] = 0.0
    return smaller


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
    """Blocks with their eigenvalues, ascending, cut to a limit; below them for all rounding.

    They are zero where rounding hides the smallest eigenvalue.
    """
    values, axes = np.linalg.eigh(block)
    traces = np.einsum("mkk->m", block)
    margin = _MARGIN * traces[:, None]
    largest = limit(values)[:, None]
    smaller = np.minimum(values, largest) - margin
    smaller = np.where(smaller[:, :1] > 0.0, smaller, 0.0)
    scaled_axes = axes * smaller[:, None, :]
    product = scaled_axes @ np.swapaxes(axes, 1, 2)
    return np.asarray(0.5 * (product + np.swapaxes(product, 1, 2)))
