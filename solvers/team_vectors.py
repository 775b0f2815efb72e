"""Team vectors of SOC: agreement of the copies, the norms of the residuals, and multipliers in balance."""

from __future__ import annotations

import numpy as np

from pgo_models.multipliers import multipliers
from pgo_models.poses import Poses
from pgo_models.problem import PGOProblem
from pgo_models.rotations import Array, project_to_rotations, stack_transposes, unstack_transposes
from solvers.penalty import translation_scale
from solvers.rotation_block import stationary_B
from solvers.stiffness import adapted_penalty, travel
from solvers.team import Team


def stationary_mean(problem: PGOProblem, poses: Poses, rho: Array) -> Array:
    """B of a stationary point, (N, d); zero for translations."""
    rotations = stationary_B(poses.R, multipliers(problem, poses), rho)
    return np.concatenate([np.zeros((problem.num_poses, problem.d)), rotations])


def balanced(team: Team, X: Array, mean: Array) -> Array:
    """B, (rows, d), whose mean over the copies is `mean`, (N, d), and which holds every robot's forces in balance at X.

    At a stationary point 2 M_a x + rho_a B_a = 0 for every robot a. One robot alone has B = mean.
    """
    assert team.penalty is not None
    B = -team.gradients(X) / team.penalty[:, None]
    return B + (mean - team.average(B))[team.row]


def agree(team: Team, s: Array, problem: PGOProblem) -> tuple[Array, Array]:
    """Step (b): omega from the mean of the copies, and omega and the mean separator translations handed out again."""
    mean = team.average(s)
    omega = project_to_rotations(unstack_transposes(mean[problem.num_poses :]))
    mean[problem.num_poses :] = stack_transposes(omega)
    return omega, mean[team.row]


def norm_of_omega(team: Team) -> float:
    """||omega||_rho over all copies: the translations, which depend on the origin of the world, are left out."""
    assert team.penalty is not None
    rotations = team.row >= team.problem.num_poses
    return float(np.sqrt(team.penalty[rotations].sum()))


def norm_weight(team: Team) -> Array:
    """Square roots of the penalties: ||v||_rho is the norm of weight * v."""
    assert team.penalty is not None
    return np.sqrt(team.penalty)[:, None]


def stationarity_weight(team: Team) -> Array:
    """Root of the penalty, times penalty over the diagonal of M where it is above that."""
    assert team.penalty is not None
    problem = team.problem
    diagonal = problem.M.data[problem.diagonal_positions][team.row] / team.copies[team.row]
    return np.asarray(norm_weight(team) * np.maximum(1.0, team.penalty / diagonal)[:, None])


def adapted(
    problem: PGOProblem, team: Team, penalty: float, origin: tuple[Array, Array] | None, now: tuple[Array, Array]
) -> float:
    """Translation penalty, times the diagonal of M, after the way with `penalty` from the first z, s to those now."""
    assert origin is not None
    assert team.penalty is not None
    at, scale = team.row < problem.num_poses, translation_scale(problem)
    moved, change = now[0] - origin[0], now[1] - origin[1]
    pulled = team.penalty[at, None] * (change - moved)[at]  # of B = s - z
    sums = travel(moved[at], pulled, scale[team.row[at]] / team.copies[team.row[at]])
    return adapted_penalty(penalty, sums)
