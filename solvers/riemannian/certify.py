"""certify: a proven bound for anybody's poses, found at a stationary point near them.

`pgo_models.certificates` bounds at given poses. Here it is decided at which: the poses given, the
stationary points that Newton reaches from them and from the chordal start, and for chi2 the minimum
of a smaller cost.
"""

from dataclasses import replace

from pgo_models.certificates.certificate import (
    DEFAULT_GAP,
    BoundSource,
    Certificate,
    certificate_of_whole,
    certify_at,
    judge,
    judge_cost,
)
from pgo_models.certificates.rounding_errors import ObjectiveRounding
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.residuals import check_poses
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.local_world import LocalWorld
from pgo_models.problem.problem import PGOProblem, as_problem
from pgo_models.problem.stationarity import STATIONARY_DECREMENT
from pgo_models.problem.weighting import Weighting
from solvers.riemannian.polish import polish, relative_decrement
from solvers.riemannian.shrunk_bound import bound_by_shrinking


def certify(problem: PGOProblem | PoseGraph, poses: Poses, gap: float = DEFAULT_GAP) -> Certificate:
    """Judge anybody's poses by a proven lower bound on the global optimum.

    The bound is found at a stationary point. Poses that are not stationary are polished first
    (damped Newton, `polish`); where that point does not give the gap, the one that the chordal
    start polishes to is tried, and the better bound is taken. `source` says what was done; the gap
    is always that of the poses given. `certify_at` bounds at the poses as they are. Of a problem
    with `Weighting.INFORMATION` all of this is chi2 instead of F, bounded by its tangent at the
    stationary point, and where that fails by smaller information matrices (`bound_by_shrinking`).

    Parameters
    ----------
    problem : PGOProblem or PoseGraph
        The problem; of a graph it is F.
    poses : Poses
        The poses to judge.
    gap : float
        The relative gap to certify.

    Returns
    -------
    Certificate
        The bound, and how far the cost of the poses is above it.

    Raises
    ------
    SettingError
        Unless the gap is positive and finite.
    GraphError
        When the poses do not fit the graph.

    Examples
    --------
    >>> import numpy as np
    >>> from pgo_models.graphs.scenes import grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> certificate = certify(problem, chordal_start(problem))
    >>> certificate
    Certificate(F=118.6633298, gap=0.183, NOT_CERTIFIED)
    >>> certificate.source.name, bool(0 < certificate.lower_bound <= certificate.poses_objective)
    ('POLISHED', True)
    """
    problem = as_problem(problem)
    local = LocalWorld.of(problem)
    if local is not None:
        check_poses(problem.graph, poses)
        local_certificate = certify(local.problem, local.local_poses(poses), gap)
        return certificate_of_whole(local, poses, local_certificate)
    stationarity = relative_decrement(problem, poses)
    is_stationary = stationarity <= STATIONARY_DECREMENT
    if is_stationary and problem.is_quadratic:
        certificate = certify_at(problem, poses, gap, stationarity)
    else:
        polished = certify_at(problem, polish(problem, poses), gap, stationarity)
        source = BoundSource.REFINED if is_stationary else BoundSource.POLISHED
        certificate = judge(problem, poses, replace(polished, source=source))
    if not _bound_is_tight(problem, certificate):
        start = polish(problem.convex_part, chordal_start(problem.convex_part))
        other = certify_at(problem, polish(problem, start), gap, stationarity)
        # Of equal bounds, as two zeros, the one with the better poses.
        if (other.lower_bound, -other.poses_objective) > (
            certificate.lower_bound,
            -certificate.poses_objective,
        ):
            certificate = judge(problem, poses, replace(other, source=BoundSource.CHORDAL))
        certificate = with_shrunk_information(problem, certificate)
    return certificate


def with_shrunk_information(problem: PGOProblem, certificate: Certificate) -> Certificate:
    """The certificate, or a better one by `bound_by_shrinking` where its bound on chi2 is loose."""
    if problem.weighting is not Weighting.INFORMATION or _bound_is_tight(problem, certificate):
        return certificate
    shrunk = bound_by_shrinking(problem, certificate.poses)
    if shrunk.bound.value <= certificate.bound.value:
        return certificate
    by_smaller_cost = replace(certificate, Lambda=shrunk.Lambda, source=BoundSource.SOFTENED)
    # Of the poses given, which need not be those that the bound was found at.
    rounding = ObjectiveRounding(
        certificate.rounding_level,
        certificate.objective_error,
        certificate.fit,
        certificate.weights_error,
    )
    judgement = judge_cost(
        repr(problem), certificate.objective, rounding, shrunk.bound, certificate.wanted_gap
    )
    return judgement.of(by_smaller_cost)


def _bound_is_tight(problem: PGOProblem, certificate: Certificate) -> bool:
    """Whether the poses that the bound was found at have the gap asked for, but for rounding."""
    judged = judge(problem, certificate.poses, certificate)
    return judged.is_certified or judged.is_hidden_by_rounding
