"""Chi-square tests of the costs of the edges, each on its own and all together.

They are made for either weighting, F or chi2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.errors import check_quantile, door
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, tangent_dimension
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.graphs.precisions import LEAST_SCALED, gaussian_information, scaled_blocks
from pgo_models.graphs.residuals import edge_errors
from pgo_models.problem.edge_cost import isotropic_cost
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from pgo_models.summaries import Summarised

# Probability of any misfit when all measurement errors have the covariances of their matrices.
FALSE_ALARM = 0.01


@dataclass(frozen=True, eq=False)
class EdgeResiduals(Summarised):
    """Residuals and costs of every edge at some poses, with the thresholds of chi-square tests.

    Parameters
    ----------
    translation : Array, (m,)
        ||t_j - t_i - R_i t_ij||, metres; zeros in a problem of rotations alone.
    rotation : Array, (m,)
        Angle of R_ij^T R_i^T R_j, radians.
    cost : Array, (m,)
        Summand of F, or of chi2.
    allowed : Array, (m,)
        Threshold of the cost: `chi2_thresholds` at 1 - FALSE_ALARM / m (Bonferroni), times `scale`.
    scale : float
        Median of the cost over its threshold at one half, at least 1. It is larger than 1 where the
        information matrices are too large for the errors of most edges.
    overall : float
        Sum of the costs over its expectation, about 1 where errors have the covariances of the
        matrices; 0 without redundancy. It is large where one wrong loop closure among few deforms
        the odometry, so that no edge exceeds its own threshold.
    overall_allowed : float
        Bound that `overall` exceeds with probability FALSE_ALARM.
    freedom : float
        Degrees of freedom of the chi-square distribution that is taken for `overall`.
    """

    translation: Array
    rotation: Array
    cost: Array
    allowed: Array
    scale: float
    overall: float
    overall_allowed: float
    freedom: float

    @property
    def share(self) -> Array:
        """Share of the cost, (m,); zeros where it is zero."""
        total = max(float(self.cost.sum()), np.finfo(float).tiny)
        return np.asarray(self.cost / total)

    @property
    def is_misfit(self) -> BoolArray:
        """Whether the cost of an edge exceeds its threshold, (m,)."""
        return self.cost > self.allowed

    @property
    def is_overall_misfit(self) -> bool:
        """Whether the sum of the costs exceeds its threshold."""
        return self.overall > self.overall_allowed

    @property
    def overall_least(self) -> float:
        """Bound that `overall` falls below with probability FALSE_ALARM."""
        return float(scipy.special.chdtri(self.freedom, 1.0 - FALSE_ALARM) / self.freedom)

    @property
    def is_doubtful(self) -> bool:
        """Whether an edge is a misfit, or all edges together are."""
        return bool(self.is_misfit.any()) or self.is_overall_misfit


@door
def edge_residuals(problem: PGOProblem | PoseGraph, poses: Poses) -> EdgeResiduals:
    """Compute and test the residuals and the cost of every edge at poses.

    The costs are the summands of the paper's equation (16). The expectation of their sum is sum_e
    sum w (1 - u / r), with r the rank of all information, u the number of unknowns, and w as in
    `chi2_thresholds`.

    Parameters
    ----------
    problem : PGOProblem or PoseGraph
        The problem; for a graph the cost is F.
    poses : Poses
        One pose for every pose of the graph.

    Returns
    -------
    EdgeResiduals
        Residuals, costs and thresholds.

    Raises
    ------
    GraphError
        When the poses are not those of the graph.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import circle
    >>> graph = circle(np.random.default_rng(0))
    >>> residuals = edge_residuals(graph, graph.truth)
    >>> residuals.translation.shape, bool(residuals.is_misfit.any())
    ((300,), False)
    """
    graph = problem if isinstance(problem, PoseGraph) else problem.graph
    translation, rotation, cost = edge_errors(graph, poses)
    has_translations = True
    if isinstance(problem, PGOProblem):
        cost = problem.edge_costs(poses)
        has_translations = problem.has_translations
    if not has_translations:
        translation = np.zeros_like(translation)
    w = _chi2_weights(problem)
    scale = _median_ratio(cost, w)
    quantile = 1.0 - FALSE_ALARM / max(graph.num_edges, 1)
    allowed = scale * _quantiles(w, quantile)
    # All edges together: the sum is taken for a scaled chi^2 with the same mean and variance.
    redundancy = _redundancy(graph, w, has_translations)
    mean = redundancy * np.sum(w)
    half_variance = redundancy * np.sum(w**2)
    overall = 0.0
    dof = 1.0
    if mean > 0.0:
        overall = float(cost.sum() / mean)
        dof = mean**2 / half_variance
    overall_allowed = float(scipy.special.chdtri(dof, FALSE_ALARM) / dof)
    return EdgeResiduals(
        translation, rotation, cost, allowed, scale, overall, overall_allowed, float(dof)
    )


def _median_ratio(cost: Array, w: Array) -> float:
    """Median over the edges of the cost over its median, at least 1."""
    median_cost = _quantiles(w, 0.5)
    is_counted = median_cost > 0.0
    if not is_counted.any():
        return 1.0
    ratios = cost[is_counted] / median_cost[is_counted]
    return max(1.0, float(np.median(ratios)))


def _redundancy(graph: PoseGraph, w: Array, has_translations: bool) -> float:
    """1 - u / r for u unknowns and measurements of rank r."""
    d = graph.d if has_translations else 0
    p = tangent_dimension(graph.d)
    num_points = len(graph.landmarks)
    num_other_poses = graph.num_poses - num_points
    # One pose is fixed.
    unknowns = (d + p) * (num_other_poses - 1) + d * num_points
    rank = int(np.sum(w > 0.0))
    return 1.0 - unknowns / max(rank, 1)


@door
def chi2_thresholds(problem: PGOProblem, quantile: float = 0.99) -> Array:
    """Compute thresholds that edge costs at the true poses exceed with probability 1 - quantile.

    Measurement errors r = (r_t, r_r) are N(0, Sigma), Sigma the inverse of the edge's information
    matrix I (of kappa and tau where the graph has none). The cost with these matrices, r^T I r, is
    then chi^2 with rank(I) degrees of freedom: 3 in the plane, 6 in space, d of a position. F and
    other quadratic costs are tau ||r_t||^2 + r_r^T V r_r to second order, V = tr(W) I - W, or 2
    kappa: a sum of chi^2_1 weighted with the eigenvalues w of Sigma^1/2 blockdiag(tau I, V)
    Sigma^1/2. Its quantile is that of the shifted and scaled chi^2 with the same first three
    cumulants (Hall-Buckley-Eagleson; Liu, Tang & Zhang 2009 find the same where no mean is
    shifted):

        c_1 + c_3 / c_2 (chi^2_l - l),  c_k = sum w^k,  l = c_2^3 / c_3^2,

    It is exact where the w are equal. Otherwise the probability of exceeding it differs from 1 -
    quantile by at most 7 % at the quantile 0.99, and by at most a factor of 2.5 at 1 - 2e-6. For F
    with the kappa of SE-Sync in the plane, the w of the angle is 2. Least squares fits the poses to
    the errors, so that the costs at an optimum are smaller than these where there is little
    redundancy.

    Parameters
    ----------
    problem : PGOProblem
        The problem.
    quantile : float
        Between 0 and 1.

    Returns
    -------
    (m,) array
        Thresholds for `problem.edge_costs`.

    Raises
    ------
    SettingError
        Unless 0 < quantile < 1.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import circle
    >>> problem = PGOProblem(circle(np.random.default_rng(0)))
    >>> bool((problem.edge_costs(problem.graph.truth) > chi2_thresholds(problem)).mean() < 0.02)
    True
    """
    check_quantile(quantile)
    return _quantiles(_chi2_weights(problem), quantile)


@dataclass(frozen=True, eq=False)
class RightCosts:
    """Distribution of what right edges cost together: sums of the w of `chi2_thresholds`.

    Parameters
    ----------
    sums : Array, (m, 3)
        sum w, sum w^2 and sum w^3 of every edge.
    """

    sums: Array

    @classmethod
    def of(cls, problem: PGOProblem) -> RightCosts:
        """Distribution of the costs of a problem's edges, which are taken for independent."""
        return cls(_power_sums(_chi2_weights(problem)))

    def thresholds(self, groups: Sequence[IntArray], quantile: float) -> Array:
        """Quantiles of the costs that groups of right edges have together, (k,).

        For k edges with matrices of full rank it is that of chi^2 with k d (d + 1) / 2 degrees of
        freedom. Adding the edges of a group to the right map raises the least cost by no more with
        this probability, however far the map moves.
        """
        sums = np.array([self.sums[group].sum(axis=0) for group in groups]).reshape(-1, 3)
        return _quantiles_of_sums(sums, quantile)


def _quantiles(w: Array, quantile: float) -> Array:
    """Quantiles of sums of w chi^2_1, (m,)."""
    return _quantiles_of_sums(_power_sums(w), quantile)


def _power_sums(w: Array) -> Array:
    """Sums of w, w^2 and w^3, (m, 3)."""
    return np.stack([np.sum(w**k, axis=1) for k in (1, 2, 3)], axis=1)


def _quantiles_of_sums(sums: Array, quantile: float) -> Array:
    """Quantiles of sums of w chi^2_1, (m,), of which the power sums are known, (m, 3)."""
    c_1, c_2, c_3 = sums.T
    # An edge without weight has c_1 = c_2 = c_3 = 0.
    ratio = c_3 / np.where(c_2 > 0.0, c_2, 1.0)
    divisor = np.where(ratio > 0.0, ratio, 1.0)
    dof = c_2 / divisor**2
    chi2_quantile = scipy.special.chdtri(np.maximum(dof, 1.0), 1.0 - quantile)
    return np.asarray(c_1 + ratio * (chi2_quantile - dof))


def _chi2_weights(problem: PGOProblem | PoseGraph) -> Array:
    """Weights w, (m, k), of the chi^2_1 that the edges' costs are sums of.

    Those of chi2 are ones, as many as the rank.
    """
    if isinstance(problem, PoseGraph):
        graph = problem
        weights = isotropic_cost(problem.tau, problem.kappa)
        is_chi2 = False
    else:
        graph = problem.graph
        weights = problem.weights
        is_chi2 = problem.weighting is Weighting.INFORMATION or weights.is_chi2
    d = graph.d
    scaled, scale = scaled_blocks(_measured_information(graph))
    eigenvalues, eigenvectors = np.linalg.eigh(scaled)
    is_known = eigenvalues > LEAST_SCALED
    if is_chi2:
        return is_known.astype(float)
    # A root of Sigma = root root^T, where the information is known.
    inverse_roots = is_known / np.sqrt(np.where(is_known, eigenvalues, 1.0))
    root = scale[:, :, None] * eigenvectors * inverse_roots[:, None, :]
    root_t = root[:, :d]
    root_r = root[:, d:]
    # The matrix root^T blockdiag(tau I, V) root.
    W = weights.W(d)
    trace = np.einsum("mkk->m", W)[:, None, None]
    V = trace if d == 2 else trace * np.eye(3) - W
    is_seen_t, _ = weights.is_seen()
    tau = np.where(is_seen_t, weights.tau, 0.0)
    of_translations = tau[:, None, None] * np.swapaxes(root_t, 1, 2) @ root_t
    of_rotations = np.swapaxes(root_r, 1, 2) @ V @ root_r
    w = np.linalg.eigvalsh(of_translations + of_rotations)
    least = LEAST_SCALED * w[:, -1:]
    return np.where(w > least, w, 0.0)


def _measured_information(graph: PoseGraph) -> Array:
    """Information matrices, (m, d + p, d + p), without those that fix rotations of landmarks.

    A landmark has no rotation; its first edge holds the rotation of its pose, which is no
    measurement.
    """
    d = graph.d
    information = gaussian_information(graph)
    if len(graph.first_sights) == 0:
        return information
    information = information.copy()
    information[graph.first_sights, d:] = 0.0
    information[graph.first_sights, :, d:] = 0.0
    return information
