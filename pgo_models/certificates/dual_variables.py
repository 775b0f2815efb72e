"""Multipliers Lambda of the orthogonality constraints, and the certificate matrix S they give."""

import numpy as np
from scipy.sparse import csc_array

from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.problem.cholesky import CholeskyFactor
from pgo_models.problem.matrices import ground
from pgo_models.problem.problem import EvaluatedPoses, PGOProblem


def multipliers(problem: PGOProblem, poses: Poses) -> Array:
    """Return the multipliers of R_i R_i^T = I at poses, Lambda_i = sym((M X)_i R_i).

    At a stationary point (M X)_i = Lambda_i R_i^T exactly, and tr(Lambda) = F. M is that of the
    tangent for chi2.

    Parameters
    ----------
    problem : PGOProblem
        The problem.
    poses : Poses
        One pose for every pose of the graph.

    Returns
    -------
    (n, d, d) array
        Symmetric blocks Lambda_i.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> multipliers(problem, problem.graph.truth).shape
    (27, 3, 3)
    """
    return multipliers_at(problem.at(poses))


def multipliers_at(here: EvaluatedPoses) -> Array:
    """`multipliers` of poses whose gradient may be known."""
    R = here.poses.R
    n, _, d = R.shape
    rotation_blocks = here.half_gradient[n:].reshape(n, d, -1)
    product = rotation_blocks @ R
    transposed = np.swapaxes(product, 1, 2)
    return 0.5 * (product + transposed)


def check_multipliers(problem: PGOProblem, Lambda: Array) -> None:
    """Raise a SettingError unless there is one block for every pose, (n, d, d)."""
    d = problem.d
    shape = (problem.num_poses, d, d)
    if Lambda.shape != shape:
        raise SettingError(
            f"Lambda has shape {Lambda.shape}; give one block for every pose, {shape}"
        )


def scalar_multipliers(Lambda: Array) -> Array:
    """Multiples of the identity with the traces of Lambda, (n, d, d), to rounding."""
    d = Lambda.shape[1]
    means = np.einsum("naa->n", Lambda) / d
    return np.asarray(means[:, None, None] * np.eye(d))


def multiplier_norms(Lambda: Array) -> Array:
    """||Lambda_i||_2, (n,), of symmetric (n, d, d)."""
    eigenvalues = np.linalg.eigvalsh(Lambda)
    sizes = np.abs(eigenvalues)
    return np.asarray(sizes.max(axis=1, initial=0.0))


def certificate_matrix(problem: PGOProblem, Lambda: Array, eta: float = 0.0) -> csc_array:
    """Return S + eta blockdiag(0, I), with S = M - blockdiag(0, Lambda).

    Parameters
    ----------
    problem : PGOProblem
        The problem.
    Lambda : (n, d, d) array
        Multipliers of R_i R_i^T = I.
    eta : float
        Shift of the rows of rotations.

    Returns
    -------
    (N, N) csc_array
        It has the pattern of M.

    Raises
    ------
    SettingError
        When there is not one block of Lambda for every pose.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> S = certificate_matrix(problem, multipliers(problem, problem.graph.truth))
    >>> bool(abs(S - S.T).max() < 1e-12)
    True
    """
    check_multipliers(problem, Lambda)
    rotation_rows = slice(problem.num_poses, None)
    data = problem.M.data.copy()
    data[problem.block_positions] -= Lambda
    data[problem.diagonal_positions[rotation_rows]] += eta
    return problem.with_pattern_of_M(data)


def factorize_certificate(problem: PGOProblem, Lambda: Array, eta: float) -> CholeskyFactor:
    """Cholesky factor of S + eta blockdiag(0, I) with t_0 grounded.

    Grounding loses nothing: S maps a common shift of all translations to zero, so the matrix is
    positive semidefinite if it is positive definite with its (t_0, t_0) entry doubled. For a
    right-hand side that is zero on translations, the rotation part of the solution is that of (Q -
    blockdiag(Lambda) + eta I) y = b: elimination marginalises them. A NotPositiveDefiniteError when
    it has a negative eigenvalue, or a zero one beside that of the common shift.
    """
    shifted = certificate_matrix(problem, Lambda, eta)
    ground(shifted, [0])
    return problem.analysis.factorize(shifted)
