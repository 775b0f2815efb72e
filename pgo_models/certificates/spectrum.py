"""Where Q - Lambda is not positive semidefinite: a direction that shows it, by inverse Lanczos on a proven shift."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.sparse.linalg import LinearOperator, eigsh

from pgo_models.certificates.dual_variables import factorize_certificate
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array
from pgo_models.problem.cholesky import CholeskyFactor
from pgo_models.problem.matrices import inner
from pgo_models.problem.problem import PGOProblem

_GROWTH, _BISECTIONS = 10.0, 3
_ACCURACY = 1e-3  # relative, of the eigenvalue: any direction that goes down will do, a steep one is better


@dataclass(frozen=True, eq=False)
class NegativeCurvature:
    """Smallest eigenvalue of Q - blockdiag(Lambda), which is negative.

    Attributes
    ----------
    value : float
        v^T (Q - blockdiag(Lambda)) v: an upper bound on the eigenvalue, evidence but no proof.
    v : (n, d)
        Of norm 1.
    shift : float
        A little more than the eigenvalue is below zero.
    factor : CholeskyFactor
        Of S + shift blockdiag(0, I), positive definite.
    """

    value: float
    v: Array
    shift: float
    factor: CholeskyFactor


def negative_curvature(problem: PGOProblem, Lambda: Array, eta: float, rng: np.random.Generator) -> NegativeCurvature:
    """Smallest eigenvalue of Q - blockdiag(Lambda), where it is below -eta < 0, with its eigenvector.

    The shift eta grows until S + eta blockdiag(0, I) has a Cholesky factor, and is bisected to within a third of the
    smallest that has. Its solves are those with Q - Lambda + eta I (`factorize_certificate`), whose inverse has the
    wanted eigenvalue far above all others, so that Lanczos needs a handful of them.

    Parameters
    ----------
    problem : PGOProblem
    Lambda : (n, d, d), symmetric
    eta : float
        A shift, positive, that does not make the matrix positive definite.
    rng : np.random.Generator
        Draws the first Lanczos vector.
    """
    n, d = problem.num_poses, problem.d
    shift, factor = _smallest_definite_shift(problem, Lambda, eta)
    right_hand_side = np.zeros(problem.side)

    def inverse(y: Array) -> Array:
        right_hand_side[n:] = y.ravel()
        return factor.solve(right_hand_side)[n:]

    operator = LinearOperator((n * d, n * d), matvec=inverse, dtype=float)
    first = rng.standard_normal(n * d)
    _, vectors = eigsh(operator, k=1, which="LA", v0=first, tol=_ACCURACY)
    v = vectors[:, 0] / np.linalg.norm(vectors[:, 0])
    blocks = v.reshape(n, d)
    curvature = inner(v, problem.apply_Q(v[:, None])[:, 0])
    curvature -= float(np.einsum("na,nab,nb->", blocks, Lambda, blocks))
    return NegativeCurvature(curvature, blocks, shift, factor)


def _smallest_definite_shift(problem: PGOProblem, Lambda: Array, eta: float) -> tuple[float, CholeskyFactor]:
    too_small, factor = eta, None
    while factor is None:
        eta *= _GROWTH
        factor = _factor_or_none(problem, Lambda, eta)
        too_small = eta if factor is None else too_small
    for _ in range(_BISECTIONS):
        middle = math.sqrt(too_small * eta)
        better = _factor_or_none(problem, Lambda, middle)
        if better is None:
            too_small = middle
        else:
            eta, factor = middle, better
    return eta, factor


def _factor_or_none(problem: PGOProblem, Lambda: Array, eta: float) -> CholeskyFactor | None:
    try:
        return factorize_certificate(problem, Lambda, eta)
    except NotPositiveDefiniteError:
        return None
