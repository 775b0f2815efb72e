"""Rounding errors, bounded: what the sums behind a certificate can be off by in IEEE double precision.

Every bound holds for any order of summation and with or without fused multiply-add (Higham 2002, *Accuracy and
Stability of Numerical Algorithms*, sections 3.1 and 4.2): a sum of k products is off by at most gamma_k times the sum
of their absolute values, gamma_k = k u / (1 - k u), u = 2^-53. `OUTWARD` rounds up, `has_safe_scale` bars underflow.
"""

import math
from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, orthogonality_error
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.floating_point import OUTWARD, UNIT_ROUNDOFF, gamma
from pgo_models.problem.incidence import blocks_of_rows, rows_of_blocks
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Tangent

_SUMMED = 80  # roundings of a weighted square and of numpy's sum in pairs: blocks of 128, then halves of 2^60 at most
_SMALLEST, _LARGEST = 1e-100, 1e100  # of weights: products of four stay far from underflow and overflow


def has_safe_scale(problem: PGOProblem) -> bool:
    """Whether weights, and tau ||t_ij||^2, are between 1e-100 and 1e100, where no product underflows or overflows.

    In size; a weight of zero does no harm.
    """
    weights = problem.weights
    longest = np.maximum(1.0, np.sum(problem.graph.t_ij**2, axis=1))
    used = [np.abs(weights.kappa).ravel(), weights.tau, weights.tau * longest]
    if weights.tangent is not None:
        used.append(np.abs(weights.tangent.C).max(axis=(1, 2)) * longest)
    sizes = np.concatenate(used)
    return bool(sizes[sizes > 0.0].min() >= _SMALLEST and sizes.max() <= _LARGEST)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """tr(X^T S X) + tr(Lambda) and S X at some X, as computed, and how far from exact they can be."""

    value: float
    value_error: float  # the exact value is at least value - value_error
    product: Array  # S X, (N, d)
    product_error: Array  # bound on its error, entry by entry


def evaluate_edges(problem: PGOProblem, X: Array, low: Array) -> Evaluation:
    """tr(X^T M X) and M X, edge by edge: as accurate as the residuals, however large t is.

    A residual t_j - t_i - R_i t_ij is computed in this order, so that its error is in proportion to the edge, not to
    the coordinates: u |t_j - t_i| + gamma_d |R_i| |t_ij| + u |residual|. The last bits of coordinates in kilometres
    would move it by more; hence `low`, (n, d), to be added to the translations of X, exactly.
    """
    graph, n, d, weights = problem.graph, problem.num_poses, problem.d, problem.weights
    t, P = X[:n], X[n:].reshape(n, d, d)
    P_i, transposed = P[graph.i], np.swapaxes(graph.R_ij, 1, 2)
    high_difference, low_difference = t[graph.j] - t[graph.i], low[graph.j] - low[graph.i]
    difference = high_difference + low_difference
    moved, turned = graph.t_ij[:, None, :] @ P_i, transposed @ P_i
    rho = np.concatenate([difference[:, None] - moved, P[graph.j] - turned], axis=1)
    absolute = np.abs(P_i)
    product_sizes = np.concatenate([np.abs(graph.t_ij)[:, None, :] @ absolute, np.abs(transposed) @ absolute], axis=1)
    errors = gamma(d) * product_sizes + UNIT_ROUNDOFF * np.abs(rho)
    errors[:, 0] += UNIT_ROUNDOFF * (np.abs(high_difference) + np.abs(low_difference) + np.abs(difference))
    G, sizes, off = weights.weigh(rho), weights.weigh(np.abs(rho), sizes=True), weights.weigh(errors, sizes=True)
    of_edges = np.sum(G * rho, axis=(1, 2))
    value_error = float(np.sum((2.0 * sizes + off) * errors))
    value_error += gamma(d * d + 2 * d + 2) * float(np.sum(sizes * np.abs(rho)))
    if weights.W_error is not None:
        turning = np.linalg.norm(np.abs(rho[:, 1:]) + errors[:, 1:], axis=(1, 2))
        value_error += OUTWARD * float(np.sum(weights.W_error * turning**2))
        off[:, 1:] += OUTWARD * (weights.W_error * turning)[:, None, None]
    A = problem.plain_residual_matrix
    most = int(np.bincount(A.indices, minlength=1).max()) + d + 2
    bent = None
    if weights.tangent is not None:
        bent = _evaluate_tangents(weights.tangent, rho, errors, P_i)
        of_edges, value_error = of_edges + bent.value, value_error + bent.value_error
        G, off, sizes = G + bent.G, off + bent.G_error, sizes + np.abs(bent.G)
    off += gamma(most) * sizes
    product, product_error = A.T @ rows_of_blocks(G), abs(A).T @ rows_of_blocks(off)
    if bent is not None:
        product[n:] += problem.incidence.at_beginning(bent.own)
        product_error[n:] += problem.incidence.at_beginning(bent.own_error + gamma(most) * np.abs(bent.own))
        product_error += UNIT_ROUNDOFF * np.abs(product)
    return Evaluation(math.fsum(of_edges), OUTWARD * value_error, product, OUTWARD * product_error)


@dataclass(frozen=True, eq=False)
class _Bent:
    """What tangents add to the cost of every edge, to its gradient in rho, (m, d + 1, d), and in P_i, (m, d, d)."""

    value: Array
    value_error: float
    G: Array
    G_error: Array
    own: Array
    own_error: Array


def _evaluate_tangents(tangent: Tangent, rho: Array, errors: Array, P_i: Array) -> _Bent:
    """Tangents, value + 2 <C, rho P_i^T - Z*> - loss, C P_i and C^T rho, for rho known to errors."""
    C, d = tangent.C, rho.shape[2]
    C_size, rho_size, P_size = np.abs(C), np.abs(rho), np.abs(np.swapaxes(P_i, 1, 2))
    apart = rho @ np.swapaxes(P_i, 1, 2) - tangent.Z
    apart_error = (errors + gamma(d + 1) * rho_size) @ P_size + gamma(d * d + d + 4) * np.abs(apart)
    constant = tangent.value - tangent.loss
    return _Bent(
        value=2.0 * np.sum(C * apart, axis=(1, 2)) + constant,
        value_error=float(np.sum(2.0 * C_size * apart_error))
        + float(np.sum(tangent.value_error + 4.0 * UNIT_ROUNDOFF * (np.abs(constant) + np.abs(tangent.loss)))),
        G=C @ P_i,
        G_error=gamma(d) * C_size @ np.swapaxes(P_size, 1, 2),
        own=np.swapaxes(C, 1, 2) @ rho,
        own_error=np.swapaxes(C_size, 1, 2) @ (errors + gamma(d + 1) * rho_size),
    )


def evaluate_multipliers(Lambda: Array, P: Array) -> Evaluation:
    """sum_i <Lambda_i, I - P_i P_i^T> and the rows -Lambda_i P_i, (d n, d), for symmetric Lambda and P_i = R_i^T."""
    d = P.shape[-1]
    transposed = np.swapaxes(P, 1, 2)
    defect = np.eye(d) - P @ transposed
    sizes = gamma(d) * (np.abs(P) @ np.abs(transposed)) + UNIT_ROUNDOFF * np.abs(defect)
    absolute, terms = np.abs(Lambda), Lambda * defect
    value = math.fsum(terms.reshape(-1, d * d).sum(axis=1))
    value_error = float(np.sum(absolute * sizes)) + gamma(d * d + 3) * float(np.sum(np.abs(terms)))
    product, product_error = -(Lambda @ P), OUTWARD * gamma(d) * (absolute @ np.abs(P))
    return Evaluation(value, OUTWARD * value_error, product.reshape(-1, d), product_error.reshape(-1, d))


def evaluate_certificate(problem: PGOProblem, Lambda: Array, X: Array, low: Array) -> Evaluation:
    """tr(X^T S X) + tr(Lambda) and S X, with S = M - blockdiag(0, Lambda), for any X; `low` as in `evaluate_edges`.

    The value, tr(X^T M X) + sum_i <Lambda_i, I - P_i P_i^T>, is F where X is feasible; nothing cancels near there.
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


def matrix_errors(problem: PGOProblem, diagonal: Array) -> Array:
    """Shares of a diagonal, (N,), by which the stored S is off: |Z^T (S_stored - S) Z| <= Z^T diag(shares diagonal) Z.

    That of `matrix_error` for F. With information matrices the terms of an entry can be larger than the diagonal is:
    E = gamma_k (|A|^T |W| |A| + ..), entry by entry, k the factors of a term and the terms of an entry, and
    v^T E v <= sum_a v_a^2 (E u)_a / u_a for any positive u; here u = diagonal^-1/2. The rest is as in `matrix_error`.
    """
    graph, weights, n, m, d = problem.graph, problem.weights, problem.num_poses, problem.graph.num_edges, problem.d
    if weights.W_error is None and weights.tangent is None:
        return np.full(problem.side, matrix_error(graph))
    A = abs(problem.plain_residual_matrix)
    u = 1.0 / np.sqrt(diagonal)
    rho = blocks_of_rows((A @ u)[:, None], m)
    G = weights.weigh(rho, sizes=True)
    W_error = np.zeros(m) if weights.W_error is None else weights.W_error
    most = int(np.bincount(np.concatenate([graph.i, graph.j])).max())
    count = gamma(most + 3.0 * d + 6.0) + float(orthogonality_error(graph.R_ij).max()) + d * gamma(d + 2)
    E = count * (A.T @ rows_of_blocks(G))[:, 0]
    G = np.zeros_like(G)
    G[:, 1:] = (W_error * rho[:, 1:, 0].sum(axis=1))[:, None, None]
    E += (A.T @ rows_of_blocks(G))[:, 0]
    if weights.tangent is not None:
        C = np.abs(weights.tangent.C)
        E += count * (A.T @ rows_of_blocks(C @ u[n:].reshape(n, d, 1)[graph.i]))[:, 0]
        E[n:] += count * problem.incidence.at_beginning(np.swapaxes(C, 1, 2) @ rho)[:, 0]
    return np.asarray(OUTWARD * (E * u + 4 * d * UNIT_ROUNDOFF))


@dataclass(frozen=True)
class ObjectiveRounding:
    """How well F of given poses is known."""

    level: float  # F of poses whose residuals are nothing but rounding: F below it cannot be told from zero
    error: float  # bound on the distance of F as computed from F at the exact rotations nearest to the poses


def objective_rounding(problem: PGOProblem, poses: Poses) -> ObjectiveRounding:
    """Rounding level of F at poses, and a bound on its error there.

    As computed, a residual is off by its evaluation and by the `orthogonality_error` of the stored R, at most

        e_t = (2 d + 3) u (||t_j - t_i|| + ||t_ij||) + omega ||t_ij||,   e_R = 2 sqrt(d) (2 d + 3) u + 2 omega

    in the Euclidean norm of its d, or d^2, numbers; the error is sum tau (2 ||r_t|| e_t + e_t^2) + kappa (2 ||r_R|| e_R
    + e_R^2) and the rounding of the sum. The level is sum tau e_t^2 + kappa e_R^2 with ||t_i|| + ||t_j||, seen from the
    first pose, for ||t_j - t_i||: no poses can do better than the last bits of their coordinates. In chi2, kappa r_R is
    W r_R, and its excess, whose half gradient is C, adds 2 <|C|, errors> + (size_t e_t + size_R e_R)^2.
    """
    graph, d, m, weights = problem.graph, problem.d, problem.graph.num_edges, problem.weights
    e_t, e_R = _residual_errors(problem, poses, np.linalg.norm(poses.t[graph.j] - poses.t[graph.i], axis=1))
    (X, residuals), (_, w) = problem.evaluated(poses), problem.residual_matrix
    # Along the axes of W, which turn no norm, kappa weighs row by row.
    weighted = np.sum((w[:, None] * residuals) ** 2, axis=1)
    cross = float(np.sum(np.sqrt(weighted[:m]) * e_t))
    cross += e_R * float(np.sum(np.sqrt(weighted[m:].reshape(m, d).sum(axis=1))))
    F = float(np.sum(np.abs(w) * np.sum(residuals**2, axis=1)))
    error = _sum_of_squares(problem, e_t, e_R) + 2.0 * cross + _SUMMED * UNIT_ROUNDOFF * F
    if weights.W_error is not None:
        turning = np.sum(residuals[m:] ** 2, axis=1).reshape(m, d).sum(axis=1)
        of_axes = 0.0 if weights.axes is None else gamma(4.0 * d) * np.abs(weights.kappa).max(axis=1)
        error += float(np.sum((weights.W_error + of_axes) * turning))
    if weights.excess is not None:
        touched = weights.excess.tangent(problem.edge_products(residuals, X))
        C, moved = touched.C, np.linalg.norm(touched.Z, axis=2)
        slant = poses.orthogonality_error + d * gamma(d + 2)
        error += 2.0 * float(np.sum(np.linalg.norm(C[:, 0], axis=1) * (e_t + slant * moved[:, 0])))
        error += 2.0 * float(np.sum(np.linalg.norm(C[:, 1:], axis=(1, 2)) * (e_R + slant * moved[:, 1:].sum(axis=1))))
        error += float(np.sum(touched.value_error + _SUMMED * UNIT_ROUNDOFF * np.abs(touched.value)))
    return ObjectiveRounding(rounding_level(problem, poses), OUTWARD * error)


def rounding_level(problem: PGOProblem, poses: Poses) -> float:
    """Level of `objective_rounding`."""
    graph, size = problem.graph, np.linalg.norm(poses.t - poses.t[:1], axis=1)
    return _sum_of_squares(problem, *_residual_errors(problem, poses, size[graph.i] + size[graph.j]))


def _residual_errors(problem: PGOProblem, poses: Poses, distance: Array) -> tuple[Array, float]:
    d = problem.d
    share = (2 * d + 3) * UNIT_ROUNDOFF
    omega = poses.orthogonality_error + d * gamma(d + 2)
    length = np.linalg.norm(problem.graph.t_ij, axis=1)
    return share * (distance + length) + omega * length, 2.0 * math.sqrt(d) * share + 2.0 * omega


def _sum_of_squares(problem: PGOProblem, e_t: Array, e_R: float) -> float:
    weights, kappa = problem.weights, np.abs(problem.weights.kappa)
    size = np.zeros((1, 2)) if weights.excess is None else weights.excess.size
    of_excess = float(np.sum((size[:, 0] * e_t + size[:, 1] * e_R) ** 2))
    of_rotation = float(np.sum(kappa if weights.axes is None else kappa.max(axis=1)))
    return OUTWARD * (float(np.sum(weights.tau * e_t**2)) + of_rotation * e_R**2 + of_excess)
