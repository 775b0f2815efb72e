"""Chi-square tests of the costs of the edges, each on its own and all together.

They are made for either weighting, F or chi2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.errors import check_quantile
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, tangent_dimension
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.residuals import edge_errors
from pgo_models.problem.costs import isotropic_cost
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.right_costs import RightCosts
from pgo_models.summaries import Summarised

# Probability of any misfit when all measurement errors have the covariances of their matrices.
FALSE_ALARM = 0.01


@dataclass(frozen=True, eq=False)
class EdgeResiduals(Summarised):
    """Residuals and costs of every edge at some poses, with the thresholds of chi-square tests."""

    # (m,): ||t_j - t_i - R_i t_ij||, metres; zeros in a problem of rotations alone
    translation: Array
    rotation: Array  # (m,): angle of R_ij^T R_i^T R_j, radians
    cost: Array  # (m,): summand of F, or of chi2
    # (m,): threshold of the cost: `chi2_thresholds` at 1 - FALSE_ALARM / m (Bonferroni), times
    # `scale`.
    allowed: Array
    # Median of the cost over its threshold at one half, at least 1. It is larger than 1 where the
    # information matrices are too large for the errors of most edges.
    scale: float
    # Sum of the costs over its expectation, about 1 where errors have the covariances of the
    # matrices; 0 without redundancy. It is large where one wrong loop closure among few deforms the
    # odometry, so that no edge exceeds its own threshold.
    overall: float
    overall_allowed: float  # bound that `overall` exceeds with probability FALSE_ALARM
    freedom: float  # degrees of freedom of the chi-square distribution that is taken for `overall`

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


def edge_residuals(problem: PGOProblem | PoseGraph, poses: Poses) -> EdgeResiduals:
    """Compute and test the residuals and the cost of every edge at poses.

    The costs are the summands of the paper's equation (16). The expectation of their sum is sum_e
    sum w (1 - u / r), with r the rank of all information, u the number of unknowns, and w as in
    `chi2_thresholds`. For a graph the cost is F.

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
    right_costs = _right_costs_of(problem)
    scale = _median_ratio(cost, right_costs)
    quantile = 1.0 - FALSE_ALARM / max(graph.num_edges, 1)
    allowed = scale * right_costs.quantiles(quantile)
    sums = right_costs.sums.sum(axis=0)[:2]
    unknowns = num_unknowns(graph, has_translations)
    fit = overall_fit(float(cost.sum()), sums, unknowns, right_costs.rank)
    return EdgeResiduals(translation, rotation, cost, allowed, scale, *fit)


class OverallFit(NamedTuple):
    """`overall`, `overall_allowed` and `freedom` of `EdgeResiduals`."""

    overall: float
    allowed: float
    freedom: float

    @property
    def is_misfit(self) -> bool:
        """Whether the sum of the costs exceeds its threshold."""
        return self.overall > self.allowed


def overall_fit(cost: float, sums: Array, unknowns: int, rank: int) -> OverallFit:
    """How all edges fit together, by their cost, and sums of w and w^2 of `RightCosts`, (2,).

    The cost is taken for a scaled chi^2 with the same mean and variance.
    """
    redundancy = 1.0 - unknowns / max(rank, 1)
    mean, half_variance = redundancy * sums
    overall = 0.0
    dof = 1.0
    if mean > 0.0:
        overall = float(cost / mean)
        dof = float(mean**2 / half_variance)
    return OverallFit(overall, float(scipy.special.chdtri(dof, FALSE_ALARM) / dof), dof)


def _right_costs_of(problem: PGOProblem | PoseGraph) -> RightCosts:
    """Distribution of the costs of right edges; for a graph the cost is F."""
    if isinstance(problem, PGOProblem):
        return problem.right_costs
    return RightCosts.of(problem, isotropic_cost(problem.tau, problem.kappa, problem.d))


def _median_ratio(cost: Array, right_costs: RightCosts) -> float:
    """Median over the edges of the cost over its median, at least 1."""
    median_cost = right_costs.quantiles(0.5)
    is_counted = median_cost > 0.0
    if not is_counted.any():
        return 1.0
    ratios = cost[is_counted] / median_cost[is_counted]
    return max(1.0, float(np.median(ratios)))


def num_unknowns(graph: PoseGraph, has_translations: bool) -> int:
    """Count the numbers of all poses but one, which is fixed."""
    d = graph.d if has_translations else 0
    p = tangent_dimension(graph.d)
    num_points = len(graph.landmarks)
    num_other_poses = graph.num_poses - num_points
    return (d + p) * (num_other_poses - 1) + d * num_points


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
    the errors, so that the costs at an optimum of chi2 are smaller than these where there is little
    redundancy. An optimum of F may put the error of a loosely measured edge on a precise one: of
    right maps with coupled matrices of condition 1e4, 29 % in the plane and 5 % in space have an
    edge beyond its threshold at 1 - 0.01 / m, and 0 % at condition 100. In chi2 1 % are doubted.

    The thresholds, (m,), are for `problem.edge_costs`. A SettingError unless 0 < quantile < 1.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import circle
    >>> problem = PGOProblem(circle(np.random.default_rng(0)))
    >>> bool((problem.edge_costs(problem.graph.truth) > chi2_thresholds(problem)).mean() < 0.02)
    True
    """
    check_quantile(quantile)
    return problem.right_costs.quantiles(quantile)
