"""Where Q - Lambda is not positive semidefinite: a direction that shows it.

It is found by inverse Lanczos on a proven shift.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse.linalg import LinearOperator, eigsh

from pgo_models.certificates.definiteness import ETA_GROWTH, smallest_eta
from pgo_models.certificates.dual_variables import factorize_certificate
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array
from pgo_models.problem.cholesky import CholeskyFactor
from pgo_models.problem.matrices import inner
from pgo_models.problem.problem import PGOProblem

# relative, of the eigenvalue: any direction that goes down will do, a steep one is better
_ACCURACY = 1e-3


@dataclass(frozen=True, eq=False)
class NegativeCurvature:
    """Smallest eigenvalue of Q - blockdiag(Lambda), which is negative."""

    # v^T (Q - blockdiag(Lambda)) v: an upper bound on the eigenvalue, evidence but no proof
    value: float
    v: Array  # (n, d), of norm 1
    shift: float  # a little more than the eigenvalue is below zero
    factor: CholeskyFactor  # of S + shift blockdiag(0, I), positive definite


def negative_curvature(
    problem: PGOProblem, Lambda: Array, eta: float, rng: np.random.Generator
) -> NegativeCurvature:
    """Smallest eigenvalue of Q - blockdiag(Lambda), below -eta < 0, with its eigenvector.

    With eta about the smallest for which S + eta blockdiag(0, I) has a Cholesky factor, the inverse
    of Q - Lambda + eta I has the wanted eigenvalue far above all others, so that Lanczos needs a
    handful of solves. The eta given does not make the matrix positive definite; `rng` draws the
    first Lanczos vector.
    """
    n = problem.num_poses
    d = problem.d
    shift, factor = smallest_definite_shift(problem, Lambda, ETA_GROWTH * eta, too_small=eta)
    first = rng.standard_normal(n * d)
    inverse = rotation_inverse(problem, factor)
    _, vectors = eigsh(inverse, k=1, which="LA", v0=first, tol=_ACCURACY)
    direction = vectors[:, 0]
    v = direction / np.linalg.norm(direction)
    blocks = v.reshape(n, d)
    Qv = problem.translations.apply_Q(v[:, None])[:, 0]
    curvature = inner(v, Qv)
    curvature -= float(np.einsum("na,nab,nb->", blocks, Lambda, blocks))
    return NegativeCurvature(curvature, blocks, shift, factor)


def smallest_definite_shift(
    problem: PGOProblem, Lambda: Array, eta: float, too_small: float | None = None
) -> tuple[float, CholeskyFactor]:
    """About the smallest shift from eta on that gives a positive definite matrix, and its factor.

    The matrix is that of `factorize_certificate`.
    """

    def attempt(shift: float) -> CholeskyFactor | None:
        try:
            return factorize_certificate(problem, Lambda, shift)
        except NotPositiveDefiniteError:
            return None

    shift_and_factor = smallest_eta(attempt, eta, too_small=too_small)
    if shift_and_factor is None:
        raise NotPositiveDefiniteError(
            "no shift makes the certificate matrix positive definite; check Lambda for nan"
        )
    return shift_and_factor


def rotation_inverse(problem: PGOProblem, factor: CholeskyFactor) -> LinearOperator:
    """Inverse of Q - blockdiag(Lambda) + eta I, (dn, dn), as an operator.

    Each product is a solve with a factor of `factorize_certificate`.
    """
    n = problem.num_poses
    side = problem.num_poses * problem.d

    def invert(vectors: Array) -> Array:
        padded = np.zeros((problem.side, *vectors.shape[1:]))
        padded[n:] = vectors
        return factor.solve(padded)[n:]

    return LinearOperator((side, side), matvec=invert, matmat=invert, dtype=float)
