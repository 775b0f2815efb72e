"""Solves of graphs whose priors are far from zero: in the local problem, and what becomes of it."""

from dataclasses import replace

import numpy as np

from pgo_models.certificates.certificate import certificate_of_whole, judge
from pgo_models.problem.local_world import LocalWorld
from solvers.request import SolveRequest
from solvers.robust.revision import inlier_problem
from solvers.solution import Solution


def local_request(local: LocalWorld, request: SolveRequest) -> SolveRequest:
    """The same request of the local problem; a GraphError where the start does not fit it."""
    start = request.start
    if start is not None:
        request.problem.stacked(start)  # raises unless the poses fit
        start = local.local_poses(start)
    return replace(request, problem=local.problem, start=start)


def solution_of_whole(local: LocalWorld, solution: Solution) -> Solution:
    """The solution of the local problem, or of the edges of it that were kept, for the whole one.

    The certificate is of the poses that are returned, whose coordinates are rounded to doubles.
    """
    problem = local.whole
    robust = solution.robust
    if robust is not None and not robust.kept.all():
        problem = inlier_problem(local.whole, robust.kept)
    of_kept = LocalWorld(problem, solution.problem, local.point)
    poses = of_kept.poses_of_file(solution.poses)
    rounded = judge(solution.problem, of_kept.local_poses(poses), solution.certificate)
    certificate = certificate_of_whole(of_kept, poses, rounded)
    if robust is not None:
        robust = replace(robust, problem=local.whole, verdict=certificate.verdict)
    half_a_digit = np.spacing(np.abs(poses.t).max()) / 2.0
    known_to = f"doubles have coordinates so far from zero to {half_a_digit:.1e} m"
    return replace(
        solution,
        problem=problem,
        poses=poses,
        objective=certificate.objective,
        certificate=certificate,
        frame=f"{solution.frame}; {known_to}",
        robust=robust,
    )
