"""Bounds on chi2 of information matrices that are too far from isotropic for the tangent at its minimum.

For smaller information matrices, I' <= I, the cost is below chi2 at all poses, so that a bound on it is one on chi2.
Two things stand in the way of the tangent. Where the largest eigenvalue of I_rr is above the sum of the others, W is
indefinite, and a reflection, which the relaxation cannot tell from a rotation, costs less than nothing: the largest
eigenvalue of I'_rr is at most the second and half the smallest. And the tangent leaves of I_tt but its smallest
eigenvalue: those of I'_tt are at most `cap` times that. The largest cap is sought with which the tangent at the minimum
gives a bound without a shift.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pgo_models.certificates.dual_variables import multipliers
from pgo_models.certificates.lower_bound import NO_BOUND, LowerBound, prove_at
from pgo_models.certificates.newton_polish import polish
from pgo_models.errors import GraphError, NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import are_definite, filled, proper_information, uncoupled_share
from pgo_models.problem.problem import PGOProblem

BISECTIONS = 5
_SHOWN = 2.0**-45  # smallest eigenvalue of a matrix with ones on its diagonal that is not rounding
_MARGIN = 2.0**-40  # of the trace: above the rounding of a block, so that I' is below I all the same


def soften(graph: PoseGraph, cap: float) -> PoseGraph:
    """Return the graph with information matrices below its own: condition of I_tt at most `cap`, W convex.

    Coupling blocks are taken out first, with what they can take from the others: with C = I_tt^-1/2 I_tr I_rr^-1/2,
    I >= (1 - ||C||) blockdiag(I_tt, I_rr), or a smaller share where rounding hides that.
    """
    information, d = proper_information(graph), graph.d
    I_tt, I_tr, I_rr = information[:, :d, :d], information[:, :d, d:], information[:, d:, d:]
    share, limit = uncoupled_share(information, d) - 2.0**-20, np.array([0.5, 1.0]) if d == 3 else np.ones(1)
    share, is_below = np.where(I_tr.any(axis=(1, 2)), np.maximum(share, 0.0), 1.0), ~I_tr.any(axis=(1, 2))
    while True:
        smaller = np.zeros_like(information)
        smaller[:, :d, :d] = _clipped(share[:, None, None] * I_tt, lambda values: cap * values[:, 0])
        smaller[:, d:, d:] = _clipped(share[:, None, None] * I_rr, lambda values: values[:, :2] @ limit)
        is_below = is_below | are_definite(information - smaller, _SHOWN)
        if is_below.all():
            return replace(graph, information=smaller)
        share = np.where(is_below, share, 0.5 * share)  # was rounded


def softened_bound(problem: PGOProblem, poses: Poses) -> tuple[LowerBound, Poses, Array]:
    """Bound on chi2 with the largest cap found, and the poses and multipliers that it was found at.

    The search for the minima of the smaller costs begins at the poses given.
    """
    best = NO_BOUND, poses, np.zeros_like(poses.R)

    def attempt(log_cap: float) -> bool:
        nonlocal best, poses
        cap = math.exp(log_cap)
        try:
            softer = PGOProblem(soften(problem.graph, cap), problem.backend, problem.weighting)
            there = polish(softer, poses)
        except (GraphError, NotPositiveDefiniteError):
            return False
        Lambda = multipliers(softer, there)
        bound = prove_at(softer.tangent_at(there), Lambda, there)
        if bound is None or bound.value <= best[0].value:
            return bound is not None
        best, poses = (replace(bound, cap=cap), there, Lambda), there
        return True

    d = problem.d
    low, high = 0.0, math.log(1.0 + float(np.linalg.cond(filled(proper_information(problem.graph)[:, :d, :d])).max()))
    if attempt(low):
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if attempt(middle) else (low, middle)
    return best


def _clipped(block: Array, limit: Callable[[Array], Array]) -> Array:
    """Blocks with their eigenvalues, ascending, cut to a limit; below them for all rounding."""
    values, axes = np.linalg.eigh(block)
    margin = _MARGIN * np.einsum("mkk->m", block)[:, None]
    smaller = np.minimum(values, limit(values)[:, None]) - margin
    found = (axes * smaller[:, None, :]) @ np.swapaxes(axes, 1, 2)
    return np.asarray(0.5 * (found + np.swapaxes(found, 1, 2)))
