"""Multipliers Lambda of the orthogonality constraints, and the certificate matrix S they give."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_array

from pgo_models.poses import Poses
from pgo_models.problem import PGOProblem
from pgo_models.rotations import Array


def multipliers(problem: PGOProblem, poses: Poses) -> Array:
    """Lambda_i = sym((M X)_i R_i), (n, d, d): the multipliers of R_i R_i^T = I at poses.

    At a stationary point (M X)_i = Lambda_i R_i^T exactly, and tr(Lambda) = F.
    """
    n, d = problem.num_poses, problem.d
    product = problem.apply_M(problem.stacked(poses))[n:].reshape(n, d, d) @ poses.R
    return 0.5 * (product + np.swapaxes(product, 1, 2))


def certificate_matrix(problem: PGOProblem, Lambda: Array, eta: float = 0.0) -> csc_array:
    """S + eta blockdiag(0, I), (N, N), with S = M - blockdiag(0, Lambda); the pattern is that of M."""
    data = problem.M.data.copy()
    data[problem.block_positions] -= Lambda
    data[problem.diagonal_positions[problem.num_poses :]] += eta
    return problem.with_pattern_of_M(data)
