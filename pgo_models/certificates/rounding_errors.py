"""Rounding errors, bounded: what the sums behind a certificate can be off by in IEEE double precision.

Every bound holds for any order of summation and with or without fused multiply-add (Higham 2002, *Accuracy and
Stability of Numerical Algorithms*, sections 3.1 and 4.2): a sum of k products is off by at most gamma_k times the sum
of their absolute values, gamma_k = k u / (1 - k u), u = 2^-53. Bounds are rounded up by `OUTWARD`; underflow is kept
out by `has_safe_scale`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, orthogonality_error
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.floating_point import OUTWARD, UNIT_ROUNDOFF, gamma
from pgo_models.problem.problem import PGOProblem

_SUMMED = 80  # roundings of a weighted square and of numpy's sum in pairs: blocks of 128, then halves of 2^60 at most
_SMALLEST, _LARGEST = 1e-100, 1e100  # of weights: products of four stay far from underflow and overflow


def has_safe_scale(graph: PoseGraph) -> bool:
    """Whether weights, and tau ||t_ij||^2, are between 1e-100 and 1e100, where no product underflows or overflows."""
    longest = np.maximum(1.0, np.sum(graph.t_ij**2, axis=1))
    smallest = min(graph.kappa.min(), graph.tau.min())
    return bool(smallest >= _SMALLEST and max(graph.kappa.max(), (graph.tau * longest).max()) <= _LARGEST)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """tr(X^T S X) + tr(Lambda) and S X at some X, as computed, and how far from exact they can be.

    Attributes
    ----------
    value, value_error : float
        The exact value is at least value - value_error.
    product : (N, d)
        S X.
    product_error : (N, d)
        Bound on its error, entry by entry.
    """

    value: float
    value_error: float
    product: Array
    product_error: Array


def evaluate_edges(problem: PGOProblem, X: Array, low: Array) -> Evaluation:
    """tr(X^T M X) and M X, edge by edge: as accurate as the residuals, however large t is.

    A residual t_j - t_i - R_i t_ij is computed in this order, so that its error is in proportion to the edge, not to
    the coordinates: u |t_j - t_i| + gamma_d |R_i| |t_ij| + u |residual|. The last bits of coordinates in kilometres
    would move it by more; hence `low`.

    Parameters
    ----------
    problem : PGOProblem
    X : (N, d)
    low : (n, d)
        To be added to the translations of X, exactly.
    """
    graph, n, d = problem.graph, problem.num_poses, problem.d
    t, P = X[:n], X[n:].reshape(n, d, d)
    P_i, transposed = P[graph.i], np.swapaxes(graph.R_ij, 1, 2)
    high_difference, low_difference = t[graph.j] - t[graph.i], low[graph.j] - low[graph.i]
    difference = high_difference + low_difference
    moved, turned = graph.t_ij[:, None, :] @ P_i, transposed @ P_i
    residuals = np.concatenate([difference - moved[:, 0], (P[graph.j] - turned).reshape(-1, d)])
    absolute = np.abs(P_i)
    product_sizes = np.concatenate(
        [(np.abs(graph.t_ij)[:, None, :] @ absolute)[:, 0], (np.abs(transposed) @ absolute).reshape(-1, d)]
    )
    errors = gamma(d) * product_sizes + UNIT_ROUNDOFF * np.abs(residuals)
    errors[: graph.num_edges] += UNIT_ROUNDOFF * (np.abs(high_difference) + np.abs(low_difference) + np.abs(difference))
    A, w = problem.residual_matrix
    weighted = w[:, None] * residuals
    costs = weighted * residuals
    of_edges = np.concatenate(
        [costs[: graph.num_edges].sum(axis=1), costs[graph.num_edges :].reshape(-1, d * d).sum(axis=1)]
    )
    value = math.fsum(of_edges)
    value_error = 2.0 * float(np.sum(np.abs(weighted) * errors)) + gamma(d * d + 4) * value
    most = int(np.bincount(A.indices, minlength=1).max()) + 2
    sizes = w[:, None] * (errors + gamma(most) * np.abs(residuals))
    return Evaluation(
        value=value,
        value_error=OUTWARD * value_error,
        product=np.asarray(A.T @ weighted),
        product_error=OUTWARD * np.asarray(abs(A).T @ sizes),
    )


def evaluate_multipliers(Lambda: Array, P: Array) -> Evaluation:
    """sum_i <Lambda_i, I - P_i P_i^T> and the rows -Lambda_i P_i, (d n, d), for symmetric Lambda and P_i = R_i^T."""
    d = P.shape[-1]
    transposed = np.swapaxes(P, 1, 2)
    defect = np.eye(d) - P @ transposed
    sizes = gamma(d) * (np.abs(P) @ np.abs(transposed)) + UNIT_ROUNDOFF * np.abs(defect)
    absolute = np.abs(Lambda)
    terms = Lambda * defect
    value_error = float(np.sum(absolute * sizes)) + gamma(d * d + 3) * float(np.sum(np.abs(terms)))
    return Evaluation(
        value=math.fsum(terms.reshape(-1, d * d).sum(axis=1)),
        value_error=OUTWARD * value_error,
        product=-(Lambda @ P).reshape(-1, d),
        product_error=OUTWARD * gamma(d) * (absolute @ np.abs(P)).reshape(-1, d),
    )


def evaluate_certificate(problem: PGOProblem, Lambda: Array, X: Array, low: Array) -> Evaluation:
    """tr(X^T S X) + tr(Lambda) and S X, with S = M - blockdiag(0, Lambda), for any X; `low` as in `evaluate_edges`.

    As tr(X^T S X) + tr(Lambda) = tr(X^T M X) + sum_i <Lambda_i, I - P_i P_i^T>, it is F where X is feasible, and
    nothing cancels near there.
    """
    n, d = problem.num_poses, problem.d
    edges, blocks = evaluate_edges(problem, X, low), evaluate_multipliers(Lambda, X[n:].reshape(n, d, d))
    product, product_error = edges.product, edges.product_error
    product[n:] += blocks.product
    product_error[n:] += blocks.product_error + UNIT_ROUNDOFF * np.abs(product[n:])
    value = edges.value + blocks.value
    value_error = edges.value_error + blocks.value_error + UNIT_ROUNDOFF * abs(value)
    return Evaluation(value, OUTWARD * value_error, product, OUTWARD * product_error)


def matrix_error(graph: PoseGraph) -> float:
    """Share epsilon of its diagonal by which the stored S is off: |Z^T (S_stored - S) Z| <= epsilon Z^T diag Z.

    S is that of the exact A^T diag(w) A and Lambda. The terms of an entry are products of three numbers, and at most as
    many as edges meet at a pose; |A|^T diag(w) |A| is at most d + 2 times its own diagonal, a row of A for the
    translations having d + 2 entries and one for the rotations d + 1 (Cauchy-Schwarz). The stored M has kappa I for
    kappa R_ij R_ij^T. Subtracting Lambda, adding eta and subtracting a share of the diagonal round three more times in
    blocks of side d, whose entries are at most the geometric mean of the diagonal entries when it is definite.
    """
    d = graph.d
    most = int(np.bincount(np.concatenate([graph.i, graph.j])).max())
    slant = float(orthogonality_error(graph.R_ij).max()) + d * gamma(d + 2)
    return float(OUTWARD * ((d + 2) * gamma(most + 4.0) * (1.0 + slant) + slant + 4 * d * UNIT_ROUNDOFF))


@dataclass(frozen=True)
class ObjectiveRounding:
    """How well F of given poses is known.

    Attributes
    ----------
    level : float
        F of poses whose residuals are nothing but rounding: F below it cannot be told from zero.
    error : float
        Bound on the distance of F as computed from F at the exact rotations nearest to the poses.
    """

    level: float
    error: float


def objective_rounding(problem: PGOProblem, poses: Poses) -> ObjectiveRounding:
    """Rounding level of F at poses, and a bound on its error there.

    As computed, a residual is off by its evaluation and by how far the stored R are from rotations
    (`orthogonality_error`), at most

        e_t = (2 d + 3) u (||t_j - t_i|| + ||t_ij||) + omega ||t_ij||,   e_R = 2 sqrt(d) (2 d + 3) u + 2 omega

    in the Euclidean norm of its d, or d^2, numbers; the error is sum tau (2 ||r_t|| e_t + e_t^2) + kappa (2 ||r_R|| e_R
    + e_R^2) and the rounding of the sum. The level is sum tau e_t^2 + kappa e_R^2 with ||t_i|| + ||t_j||, seen from the
    first pose, for ||t_j - t_i||: no poses can do better than the last bits of their coordinates.
    """
    graph, d, m = problem.graph, problem.d, problem.graph.num_edges
    e_t, e_R = _residual_errors(problem, poses, np.linalg.norm(poses.t[graph.j] - poses.t[graph.i], axis=1))
    squares = np.sum(problem.residuals(problem.stacked(poses)) ** 2, axis=1)
    r_t, r_R = squares[:m], squares[m:].reshape(m, d).sum(axis=1)
    cross = float(np.sum(graph.tau * np.sqrt(r_t) * e_t)) + e_R * float(np.sum(graph.kappa * np.sqrt(r_R)))
    F = float(graph.tau @ r_t + graph.kappa @ r_R)
    error = _sum_of_squares(graph, e_t, e_R) + 2.0 * cross + _SUMMED * UNIT_ROUNDOFF * F
    return ObjectiveRounding(rounding_level(problem, poses), OUTWARD * error)


def rounding_level(problem: PGOProblem, poses: Poses) -> float:
    """Level of `objective_rounding`."""
    graph, size = problem.graph, np.linalg.norm(poses.t - poses.t[:1], axis=1)
    return _sum_of_squares(graph, *_residual_errors(problem, poses, size[graph.i] + size[graph.j]))


def _residual_errors(problem: PGOProblem, poses: Poses, distance: Array) -> tuple[Array, float]:
    d = problem.d
    share = (2 * d + 3) * UNIT_ROUNDOFF
    omega = poses.orthogonality_error + d * gamma(d + 2)
    length = np.linalg.norm(problem.graph.t_ij, axis=1)
    return share * (distance + length) + omega * length, 2.0 * math.sqrt(d) * share + 2.0 * omega


def _sum_of_squares(graph: PoseGraph, e_t: Array, e_R: float) -> float:
    return OUTWARD * (float(np.sum(graph.tau * e_t**2)) + float(np.sum(graph.kappa)) * e_R**2)
