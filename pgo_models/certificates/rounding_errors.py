"""Rounding errors, bounded: how far the sums behind a certificate can be from exact.

The arithmetic is IEEE double precision.

Every bound holds for any order of summation and with or without fused multiply-add (Higham 2002,
*Accuracy and Stability of Numerical Algorithms*, sections 3.1 and 4.2): a sum of k products is off
by at most gamma_k times the sum of their absolute values, gamma_k = k u / (1 - k u), u = 2^-53.
`OUTWARD` rounds up, `has_safe_scale` bars underflow.
"""

from dataclasses import dataclass

import numpy as np

from pgo_models.certificates.fit import Fit, edge_roundings, fit_at, residual_errors
from pgo_models.geometry.arrays import block_norms, inner_products
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, orthogonality_error
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.floating_point import (
    OUTWARD,
    PAIRWISE_SUM,
    UNIT_ROUNDOFF,
    exact_sum,
    gamma,
)
from pgo_models.problem.incidence import blocks_of_rows, rows_of_blocks
from pgo_models.problem.problem import EvaluatedPoses, PGOProblem

# of weights: products of four stay far from underflow and overflow
_SMALLEST = 1e-100
_LARGEST = 1e100


def has_safe_scale(problem: PGOProblem) -> bool:
    """Whether no product of weights and lengths can underflow or overflow.

    The sizes of weights, and tau ||t_ij||^2, have to be between 1e-100 and 1e100. A weight of zero
    does no harm.
    """
    offsets = problem.weights.seen_offsets(problem.graph.t_ij)
    squared_lengths = inner_products(offsets, offsets)
    longest = np.maximum(1.0, squared_lengths)
    sizes = problem.weights.weight_sizes(longest)
    smallest = sizes[sizes > 0.0].min(initial=np.inf)
    return bool(smallest >= _SMALLEST and sizes.max() <= _LARGEST)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """tr(X^T S X) + tr(Lambda) and S X at some X, as computed, with bounds on their errors."""

    value: float
    value_error: float  # the exact value is at least value - value_error
    product: Array  # S X, (N, d)
    product_error: Array  # bound on its error, entry by entry

    def plus(self, other: "Evaluation") -> "Evaluation":
        """The sum of both, whose errors add up; every sum is rounded once more."""
        value = self.value + other.value
        value_error = self.value_error + other.value_error + UNIT_ROUNDOFF * abs(value)
        product = self.product + other.product
        product_error = self.product_error + other.product_error
        product_error += UNIT_ROUNDOFF * np.abs(product)
        return Evaluation(value, OUTWARD * value_error, product, OUTWARD * product_error)


def evaluate_edges(problem: PGOProblem, X: Array, low: Array) -> Evaluation:
    """tr(X^T M X) and M X, edge by edge: as accurate as the residuals, however large t is.

    A residual t_j - t_i - R_i t_ij is computed in this order, so that its error is in proportion to
    the edge, not to the coordinates: u |t_j - t_i| + gamma_d |R_i| |t_ij| + u |residual|. The last
    bits of coordinates in kilometres would move it by more; hence `low`, (n, d), to be added to the
    translations of X, exactly.
    """
    graph = problem.graph
    n = problem.num_poses
    d = problem.d
    weights = problem.weights
    t = X[:n]
    P = X[n:].reshape(n, d, d)
    P_i = P.take(graph.i, axis=0)
    P_j = P.take(graph.j, axis=0)
    # Residuals: what is at j, less the rows t_ij^T and R_ij^T times R_i^T.
    offsets = weights.seen_offsets(graph.t_ij)[:, None, :]
    measured_rows = np.concatenate([offsets, np.swapaxes(graph.R_ij, 1, 2)], axis=1)
    high_difference = t.take(graph.j, axis=0) - t.take(graph.i, axis=0)
    low_difference = low.take(graph.j, axis=0) - low.take(graph.i, axis=0)
    difference = high_difference + low_difference
    delta = np.concatenate([difference[:, None], P_j], axis=1)
    delta -= measured_rows @ P_i
    # Bounds on their errors: a product is a sum of d products, and every difference is rounded once
    # more.
    product_sizes = np.abs(measured_rows) @ np.abs(P_i)
    errors = gamma(d) * product_sizes + UNIT_ROUNDOFF * np.abs(delta)
    # The translations take two more differences and their sum.
    difference_sizes = np.abs(high_difference) + np.abs(low_difference) + np.abs(difference)
    errors[:, 0] += UNIT_ROUNDOFF * difference_sizes
    terms = weights.evaluate_edges(delta, errors, P_i)
    # M X = A^T G: an entry is a sum over the edges of a pose of products of an entry of A and G,
    # which is itself a sum of at most d + 1 terms.
    A = problem.A
    most_entries = int(np.bincount(A.indices, minlength=1).max())
    count = most_entries + d + 2
    G_error = terms.G_error + gamma(count) * terms.G_size
    product = A.T @ rows_of_blocks(terms.G)
    product_error = abs(A).T @ rows_of_blocks(G_error)
    if terms.in_P_i is not None and terms.in_P_i_error is not None:
        # The half gradient in R_i^T itself: one more sum over the edges of a pose, and an addition.
        at_beginning = problem.incidence.at_beginning
        product[n:] += at_beginning(terms.in_P_i)
        product_error[n:] += at_beginning(terms.in_P_i_error + gamma(count) * np.abs(terms.in_P_i))
        product_error += UNIT_ROUNDOFF * np.abs(product)
    value = exact_sum(terms.value)
    value_error = OUTWARD * terms.value_error
    return Evaluation(value, value_error, product, OUTWARD * product_error)


def evaluate_multipliers(Lambda: Array, P: Array) -> Evaluation:
    """sum_i <Lambda_i, I - P_i P_i^T> and the rows -Lambda_i P_i, (d n, d), with errors.

    Lambda is symmetric, and P_i = R_i^T.
    """
    d = P.shape[-1]
    # a copy: products of stacked matrices take twice as long with a view
    transposed = np.ascontiguousarray(np.swapaxes(P, 1, 2))
    P_size = np.abs(P)
    Lambda_size = np.abs(Lambda)
    defect = np.eye(d) - P @ transposed
    # Errors of the defect: a product of sums of d, and one subtraction.
    product_size = P_size @ np.abs(transposed)
    defect_error = gamma(d) * product_size + UNIT_ROUNDOFF * np.abs(defect)
    value = exact_sum(inner_products(Lambda, defect))
    # They enter with the weights |Lambda|; the products and the sum of d^2 of them round, too.
    of_defects = float(np.sum(Lambda_size * defect_error))
    size_of_terms = float(np.sum(Lambda_size * np.abs(defect)))
    value_error = of_defects + gamma(d * d + 3) * size_of_terms
    product = -(Lambda @ P)
    product_error = OUTWARD * gamma(d) * (Lambda_size @ P_size)
    rows = product.reshape(-1, d)
    row_errors = product_error.reshape(-1, d)
    return Evaluation(value, OUTWARD * value_error, rows, row_errors)


def evaluate_certificate(problem: PGOProblem, Lambda: Array, X: Array, low: Array) -> Evaluation:
    """tr(X^T S X) + tr(Lambda) and S X, S = M - blockdiag(0, Lambda), for any X.

    The argument `low` is as of `evaluate_edges`.

    The value, tr(X^T M X) + sum_i <Lambda_i, I - P_i P_i^T>, is F where X is feasible; nothing
    cancels near there.
    """
    n = problem.num_poses
    d = problem.d
    P = X[n:].reshape(n, d, d)
    edges = evaluate_edges(problem, X, low)
    blocks = evaluate_multipliers(Lambda, P)
    product = edges.product
    product_error = edges.product_error
    product[n:] += blocks.product
    # Errors add up, and the two sums are rounded once more.
    product_error[n:] += blocks.product_error + UNIT_ROUNDOFF * np.abs(product[n:])
    value = edges.value + blocks.value
    value_error = edges.value_error + blocks.value_error + UNIT_ROUNDOFF * abs(value)
    return Evaluation(value, OUTWARD * value_error, product, OUTWARD * product_error)


def matrix_error(graph: PoseGraph) -> float:
    """Share epsilon of its diagonal by which the stored S of F is off at most.

    In exact arithmetic |Z^T (S_stored - S) Z| <= epsilon Z^T diag Z for all Z.

    S is that of the exact A^T diag(w) A and Lambda. The terms of an entry are products of three
    numbers, and at most as many as edges meet at a pose; |A|^T diag(w) |A| is at most d + 2 times
    its own diagonal, a row of A for the translations having d + 2 entries and one for the rotations
    d + 1 (Cauchy-Schwarz). The stored M has kappa I for kappa R_ij R_ij^T. Subtracting Lambda,
    adding eta and subtracting a share of the diagonal round three more times in blocks of side d,
    whose entries are at most the geometric mean of the diagonal entries when it is definite.
    """
    d = graph.d
    most = _most_edges(graph)
    slant = float(orthogonality_error(graph.R_ij).max()) + d * gamma(d + 2)
    of_terms = (d + 2) * gamma(most + 4.0) * (1.0 + slant)
    of_blocks = 4 * d * UNIT_ROUNDOFF
    return float(OUTWARD * (of_terms + slant + of_blocks))


def _most_edges(graph: PoseGraph) -> int:
    """Largest number of edges that meet at a pose."""
    ends = np.concatenate([graph.i, graph.j])
    return int(np.bincount(ends).max())


def matrix_errors(problem: PGOProblem, diagonal: Array) -> Array:
    """Shares of a diagonal, (N,), by which the stored S is off at most.

    In exact arithmetic |Z^T (S_stored - S) Z| <= Z^T diag(shares diagonal) Z for all Z.

    That of `matrix_error` for F. With information matrices the terms of an entry can be larger than
    the diagonal is: E = gamma_k (|A|^T |W| |A| + ..), entry by entry, k the factors of a term and
    the terms of an entry, and v^T E v <= sum_a v_a^2 (E u)_a / u_a for any positive u; here u =
    diagonal^-1/2. The rest is as in `matrix_error`.
    """
    graph = problem.graph
    d = problem.d
    if problem.weights.diagonal_bounds_terms:
        return np.full(problem.side, matrix_error(graph))
    u = 1.0 / np.sqrt(diagonal)
    most = _most_edges(graph)
    of_terms = gamma(most + 3.0 * d + 6.0)
    of_rotations = float(orthogonality_error(graph.R_ij).max())
    relative_error = of_terms + of_rotations + d * gamma(d + 2)
    # v^T E v <= sum_a v_a^2 (E u)_a / u_a for any positive u; here 1 / u_a = u_a diagonal_a.
    E_u = problem.weights.entry_errors(problem.A, problem.incidence, u, relative_error)
    of_blocks = 4 * d * UNIT_ROUNDOFF
    return np.asarray(OUTWARD * (E_u * u + of_blocks))


@dataclass(frozen=True)
class ObjectiveRounding:
    """How well F of given poses is known."""

    # F of poses whose residuals are as large as rounding can make each of them. Where there are
    # heavy edges F as computed may be below it although light ones do not fit.
    level: float
    # bound on the distance of F as computed from F at the exact rotations nearest to the poses
    error: float
    # how closely every edge fits: where it is to rounding, F is at most 4 level, exactly
    fit: Fit
    # how far the cost of the file can be from F, relatively (`PoseGraph.weights_error`)
    weights_error: float = 0.0


def objective_rounding(problem: PGOProblem, poses: Poses) -> ObjectiveRounding:
    """`rounding_of` poses, which are evaluated for it."""
    return rounding_of(problem.at(poses))


def rounding_of(at: EvaluatedPoses) -> ObjectiveRounding:
    """Rounding level of F at poses, a bound on its error there, and how closely they fit.

    As computed, a residual is off by its evaluation and by the `orthogonality_error` of the stored
    R, at most

        e_t = (2 d + 3) u (||t_j - t_i|| + ||t_ij||) + slant ||t_ij||,
        e_R = 2 sqrt(d) (2 d + 3) u + 2 slant

    in the Euclidean norm of its d, or d^2, numbers (`residual_errors`); the error is sum tau (2
    ||r_t|| e_t + e_t^2) + kappa (2 ||r_R|| e_R + e_R^2) and the rounding of the sum. In chi2, kappa
    r_R is W r_R, and its excess, whose half gradient is C, adds 2 <|C|, errors> + (size_t e_t +
    size_R e_R)^2. The level is the cost of `edge_roundings`.

    Whether the poses are exact is not asked of the level, a sum, but of every edge: `fit_of`.
    """
    problem = at.problem
    poses = problem.seen_poses(at.poses)
    graph = problem.graph
    d = problem.d
    offsets = poses.t.take(graph.j, axis=0) - poses.t.take(graph.i, axis=0)
    errors = residual_errors(problem, block_norms(offsets), poses.orthogonality_error)
    e_t = errors.translation
    e_R = float(errors.rotation[0])  # the same of every edge
    delta = at.point.delta
    weighted = blocks_of_rows(at.point.weighted, d)
    sizes = problem.weights.apply_absolute_weights(np.abs(delta))
    # sum ||D r|| e, the terms that are linear in the errors; a row of W r is a sum of d products.
    norms_t = block_norms(weighted[:, 0])
    norms_R = block_norms(weighted[:, 1:]) + gamma(d) * block_norms(sizes[:, 1:])
    cross = float(np.sum(norms_t * e_t))
    cross += e_R * float(np.sum(norms_R))
    # The terms that are quadratic in the errors, and the rounding of the sum F.
    quadratic = errors.cost(problem)
    sum_of_sizes = float(np.sum(sizes * np.abs(delta)))
    error = quadratic + 2.0 * cross + PAIRWISE_SUM * UNIT_ROUNDOFF * sum_of_sizes
    for of_cost in problem.weights.value_errors(at.point, poses.orthogonality_error, e_t, e_R):
        error += of_cost
    roundings = edge_roundings(problem, poses)
    fit = fit_at(at, roundings)
    return ObjectiveRounding(roundings.cost(problem), OUTWARD * error, fit, graph.weights_error)


def rounding_level(problem: PGOProblem, poses: Poses) -> float:
    """F at which a solve stops, because its residuals may be nothing but rounding.

    It is sum tau e_t^2 + kappa e_R^2 with twice the largest ||t_i||, seen from the first pose, for
    ||t_j - t_i||: after a solve for all translations the error of each is in proportion to the last
    bits of the largest. No proof uses this number: whether poses are exact is asked of every edge
    (`fit_of`).
    """
    poses = problem.seen_poses(poses)
    from_first = poses.t - poses.t[:1]
    extent = 2.0 * block_norms(from_first).max()
    distances = np.full(problem.graph.num_edges, extent)
    return residual_errors(problem, distances, poses.orthogonality_error).cost(problem)
