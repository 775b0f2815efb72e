"""Chi-square tests: what edges may cost before their measurements are doubted.

They are made for every edge and for all of them, in either weighting.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.errors import check_quantile
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, tangent_dimension
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import LEAST_SCALED, gaussian_information, scaled_blocks
from pgo_models.graphs.residuals import edge_errors
from pgo_models.problem.edge_cost import isotropic_cost
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting

# probability that right measurements with errors as their matrices say give a misfit at all
FALSE_ALARM = 0.01


@dataclass(frozen=True, eq=False)
class EdgeResiduals:
    """How well every edge fits some poses, and whether its errors may be so large.

    Parameters
    ----------
    translation : Array, (m,)
        ||t_j - t_i - R_i t_ij||, metres.
    rotation : Array, (m,)
        Angle of R_ij^T R_i^T R_j, radians.
    cost : Array, (m,)
        Summand of F, or of chi2.
    allowed : Array, (m,)
        What an edge may cost: `chi2_thresholds` at 1 - FALSE_ALARM / m (Bonferroni), times `scale`.
    scale : float
        Median of the cost over its threshold at one half, at least 1: where the median edge costs
        too much, the matrices are to blame, and not the edges.
    overall : float
        Sum of the costs over the expected one, about 1 where errors are as the matrices say; 0
        without redundancy. It is large where one wrong loop closure among few bends the odometry,
        so that no edge exceeds its own threshold.
    overall_allowed : float
        Bound that `overall` exceeds with probability FALSE_ALARM.
    """

    translation: Array
    rotation: Array
    cost: Array
    allowed: Array
    scale: float
    overall: float
    overall_allowed: float

    @property
    def share(self) -> Array:
        """Share of the cost, (m,); zeros where it is zero."""
        return np.asarray(self.cost / max(float(self.cost.sum()), np.finfo(float).tiny))

    @property
    def is_misfit(self) -> BoolArray:
        """Whether an edge costs more than it may, (m,)."""
        return self.cost > self.allowed

    @property
    def is_overall_misfit(self) -> bool:
        """Whether all edges together cost more than they may."""
        return self.overall > self.overall_allowed

    @property
    def is_doubtful(self) -> bool:
        """Whether there is a misfit, or all edges together cost more than they may."""
        return bool(self.is_misfit.any()) or self.is_overall_misfit


def edge_residuals(problem: PGOProblem | PoseGraph, poses: Poses) -> EdgeResiduals:
    """Compute and test the residuals and the cost of every edge at poses.

    The costs are the summands of `min overall` in the paper. Expected of their sum is sum_e sum w
    (1 - u / r), with r the rank of all information and u the number of unknowns (`chi2_thresholds`
    has the w).

    Parameters
    ----------
    problem : PGOProblem or PoseGraph
        The problem; of a graph it is F.
    poses : Poses
        One pose for every pose of the graph.

    Returns
    -------
    EdgeResiduals
        Residuals, costs, and what these may be.

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
    w = _chi2_weights(problem)
    if isinstance(problem, PGOProblem):
        cost = problem.edge_costs(poses)
    d = graph.d
    p = tangent_dimension(graph.d)
    points = len(graph.landmarks)
    unknowns = (d + p) * (graph.num_poses - points - 1) + d * points
    redundancy = 1.0 - unknowns / max(int(np.sum(w > 0.0)), 1)
    mean = redundancy * np.sum(w)
    square = redundancy * np.sum(w**2)
    overall, dof = (float(cost.sum() / mean), mean**2 / square) if mean > 0.0 else (0.0, 1.0)
    typical = _quantiles(w, 0.5)
    counted = typical > 0.0
    scale = max(1.0, float(np.median(cost[counted] / typical[counted]))) if counted.any() else 1.0
    allowed = scale * _quantiles(w, 1.0 - FALSE_ALARM / max(graph.num_edges, 1))
    overall_allowed = float(scipy.special.chdtri(dof, FALSE_ALARM) / dof)
    return EdgeResiduals(translation, rotation, cost, allowed, scale, overall, overall_allowed)


def chi2_thresholds(problem: PGOProblem, quantile: float = 0.99) -> Array:
    """Compute what the edges' costs at the true poses exceed with probability 1 - quantile.

    Measurement errors r = (r_t, r_r) are N(0, Sigma), Sigma the inverse of the edge's information
    matrix I (of kappa and tau where the graph has none). The cost with these matrices, r^T I r, is
    then chi^2 with rank(I) degrees of freedom: 3 in the plane, 6 in space, d of a position. F and
    other quadratic costs are tau ||r_t||^2 + r_r^T V r_r to second order, V = tr(W) I - W, or 2
    kappa: a sum of chi^2_1 weighted with the eigenvalues w of Sigma^1/2 blockdiag(tau I, V)
    Sigma^1/2. Its quantile is that of the shifted and scaled chi^2 with the same first three
    cumulants (Hall-Buckley-Eagleson; Liu, Tang & Zhang 2009 find the same where no mean is
    shifted):

        c_1 + c_3 / c_2 (chi^2_l - l),  c_k = sum w^k,  l = c_2^3 / c_3^2,

    exact where the w are equal; else at the quantile 0.99 within 7 %, at 1 - 2e-6 within 2.5 times,
    of 1 - quantile. F of SE-Sync's kappa in the plane has w = 2 of the angle. Least squares fits
    the poses to the errors, so that the residuals of an optimum are smaller than these where few
    edges say the same.

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


def _quantiles(w: Array, quantile: float) -> Array:
    """Quantiles of sums of w chi^2_1, (m,)."""
    c_1, c_2, c_3 = (np.sum(w**k, axis=1) for k in (1, 2, 3))
    ratio = c_3 / np.where(c_2 > 0.0, c_2, 1.0)  # of an edge without weight all are zero
    dof = c_2 / np.where(ratio > 0.0, ratio, 1.0) ** 2
    return np.asarray(
        c_1 + ratio * (scipy.special.chdtri(np.maximum(dof, 1.0), 1.0 - quantile) - dof)
    )


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
    information = gaussian_information(graph)
    if len(graph.first_sights):  # what ties a landmark's rotation measures nothing
        information = information.copy()
        information[graph.first_sights, d:] = 0.0
        information[graph.first_sights, :, d:] = 0.0
    scaled, scale = scaled_blocks(information)
    values, axes = np.linalg.eigh(scaled)
    is_known = values > LEAST_SCALED
    if is_chi2:
        return is_known.astype(float)
    half = (
        scale[:, :, None] * axes * (is_known / np.sqrt(np.where(is_known, values, 1.0)))[:, None, :]
    )
    W = weights.W(d)
    trace = np.einsum("mkk->m", W)[:, None, None]
    V = trace if d == 2 else trace * np.eye(3) - W
    r_t = half[:, :d]
    r_r = half[:, d:]
    form = (
        weights.tau[:, None, None] * np.swapaxes(r_t, 1, 2) @ r_t + np.swapaxes(r_r, 1, 2) @ V @ r_r
    )
    w = np.linalg.eigvalsh(form)
    return np.where(w > LEAST_SCALED * w[:, -1:], w, 0.0)
