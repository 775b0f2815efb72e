"""Interior-point method for handedness terms of small graphs.

It solves the semidefinite program

    max t  subject to  Q_r - sum_e B_e^T W(P_e) B_e - t I >= 0,   P_e >= 0

by its barrier: the maximum over (P, t) of t / mu + log det(Q_r(P) - t I) + sum_e log det P_e moves
towards the solution as mu falls (Boyd & Vandenberghe 2004, chapter 11). Each step is one of damped
Newton, whose matrix has six rows a pair. It ends as soon as the smallest eigenvalue is positive, or
the duality gap shows that no P makes it so.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from pgo_models.certificates.handedness import weights_of
from pgo_models.errors import check_settings
from pgo_models.geometry.rotations import Array
from pgo_models.problem.stationarity import rotation_scale
from solvers.handedness.ascent import POSITIVE, measured
from solvers.handedness.certificate_spectrum import HandedMatrix
from solvers.result import Measurement, Status

MOST_PAIRS = 350  # Newton's matrix has six times as many rows
_FIRST_P = 0.05  # of the scale
_FIRST_MU = 0.1  # of the scale
_CUT = 0.2  # of mu from one centre to the next
_CENTRED = 1.0  # Newton decrement, squared, at which a point counts as a centre
_BACKTRACK = 0.7
_WITHIN = 0.9  # of a step that had to be cut to stay inside
_RIDGE = 1e-12  # relative, of the diagonal of Newton's matrix
_SAFETY = 1.5  # on the duality gap, which holds at exact centres
_LAST = 1e-4  # of the scale: a duality gap below which nothing is left to gain


def _basis() -> Array:
    """Orthonormal basis of the symmetric 3 x 3 matrices, (6, 3, 3)."""
    basis = np.zeros((6, 3, 3))
    for k in range(3):
        basis[k, k, k] = 1.0
    for k, (a, b) in enumerate(((0, 1), (0, 2), (1, 2)), start=3):
        basis[k, a, b] = basis[k, b, a] = np.sqrt(0.5)
    return basis


BASIS = _basis()
CHANGES = -weights_of(BASIS)  # of the matrix of a pair, for a change of P along the basis


@dataclass(frozen=True, eq=False)
class BarrierState:
    """State k: the point (P, t), the barrier's weight mu, and the smallest eigenvalue there."""

    k: int
    P: Array  # (pairs, 3, 3)
    t: float
    mu: float
    smallest: float
    scale: float  # mean diagonal of M over the rotations
    is_beyond_reach: bool = False  # whether the largest t is negative, or hardly above this one


@dataclass(frozen=True)
class HandednessBarrier:
    """The semidefinite program of the smallest eigenvalue; CONVERGED where it is positive.

    It ends with STALLED where no P on these pairs makes it positive. `dual_residual` is as of
    `HandednessAscent`.

    Parameters
    ----------
    max_iterations : int
        Most Newton steps.

    Raises
    ------
    SettingError
        If the steps are negative.
    """

    max_iterations: int = 100

    def __post_init__(self) -> None:
        check_settings(self, not_negative=["max_iterations"])

    def init(self, matrix: HandedMatrix, start: Array | None) -> BarrierState:
        """State 0: multiples of the identity, whatever P are in `start`, (pairs, 3, 3)."""
        scale = float(rotation_scale(matrix.problem).mean())
        P = np.tile(_FIRST_P * scale * np.eye(3), (len(matrix.i), 1, 1))
        smallest = _smallest(matrix, P)
        return BarrierState(0, P, smallest - _FIRST_MU * scale, _FIRST_MU * scale, smallest, scale)

    def step(self, matrix: HandedMatrix, state: BarrierState) -> BarrierState:
        """One Newton step; at a centre of the barrier mu falls."""
        P_step, t_step, decrement = _newton_step(matrix, state)
        length = 1.0
        while not _is_inside(matrix, state.P + length * P_step, state.t + length * t_step):
            length *= _BACKTRACK
        is_centred = decrement < _CENTRED and length == 1.0
        if length < 1.0:
            length *= _WITHIN
        P = state.P + length * P_step
        t = state.t + length * t_step
        found = replace(state, k=state.k + 1, P=P, t=t, smallest=_smallest(matrix, P))
        if not is_centred:
            return found
        num_constraints = 3 * (len(matrix.free) + len(P))
        duality_gap = state.mu * num_constraints
        is_beyond_reach = t + _SAFETY * duality_gap < 0.0 or duality_gap < _LAST * state.scale
        return replace(found, mu=_CUT * state.mu, is_beyond_reach=is_beyond_reach)

    def measure(self, matrix: HandedMatrix, state: BarrierState) -> Measurement:
        """The cost of the poses, and what the smallest eigenvalue lacks."""
        return measured(matrix, state.smallest, state.scale)

    def converged(self, state: BarrierState, measurement: Measurement) -> Status | None:
        """CONVERGED with a positive eigenvalue, STALLED where none is within reach."""
        if state.smallest > POSITIVE * state.scale:
            return Status.CONVERGED
        return Status.STALLED if state.is_beyond_reach else None


def is_small_enough(matrix: HandedMatrix) -> bool:
    """Whether the matrices of the method are of moderate size."""
    return matrix.is_dense and len(matrix.i) <= MOST_PAIRS


def _smallest(matrix: HandedMatrix, P: Array) -> float:
    values = scipy.linalg.eigvalsh(matrix.dense(P), subset_by_index=[0, 0], overwrite_a=True)
    return float(values[0])


def _is_inside(matrix: HandedMatrix, P: Array, t: float) -> bool:
    """Whether a point has positive definite P and Q_r(P) - t I."""
    slack = matrix.dense(P)
    np.fill_diagonal(slack, slack.diagonal() - t)
    try:
        np.linalg.cholesky(P)
        np.linalg.cholesky(slack)
    except np.linalg.LinAlgError:
        return False
    return True


def _newton_step(matrix: HandedMatrix, state: BarrierState) -> tuple[Array, float, float]:
    """Newton step of the barrier in P, (k, 3, 3), and in t, and the squared Newton decrement."""
    k = len(state.P)
    slack = matrix.dense(state.P)
    side = len(slack)
    np.fill_diagonal(slack, slack.diagonal() - state.t)
    factor = scipy.linalg.cho_factor(slack, lower=True)
    inverse = scipy.linalg.cho_solve(factor, np.eye(side))
    # B Z B^T and B Z^2 B^T in blocks of pairs, with Z the inverse
    whole = np.zeros((matrix.problem.num_poses, 3, side))
    whole[matrix.free] = inverse.reshape(-1, 3, side)
    BZ = matrix.differences(whole)
    rows = np.zeros((matrix.problem.num_poses, 3, 3 * k))
    rows[matrix.free] = BZ.reshape(3 * k, side).T.reshape(-1, 3, 3 * k)
    G = matrix.differences(rows).reshape(k, 3, k, 3).transpose(0, 2, 1, 3)
    own_square = np.einsum("eas,ebs->eab", BZ, BZ)
    own = G[np.arange(k), np.arange(k)]
    P_inverse = np.asarray(np.linalg.inv(state.P), dtype=float)
    gradient = np.empty(6 * k + 1)
    of_matrix = np.einsum("qab,eab->eq", CHANGES, own)
    of_P = np.einsum("qab,eab->eq", BASIS, P_inverse)
    gradient[:-1] = -(of_matrix + of_P).ravel()
    gradient[-1] = np.trace(inverse) - 1.0 / state.mu
    hessian = np.empty((6 * k + 1, 6 * k + 1))
    hessian[:-1, :-1] = _curvature(G, P_inverse)
    cross = -np.einsum("qab,eab->eq", CHANGES, own_square).ravel()
    hessian[-1, :-1] = cross
    hessian[:-1, -1] = cross
    hessian[-1, -1] = np.sum(inverse**2)
    np.fill_diagonal(hessian, hessian.diagonal() * (1.0 + _RIDGE))
    solved = scipy.linalg.cho_factor(hessian, lower=True, overwrite_a=True)
    step = -scipy.linalg.cho_solve(solved, gradient)
    P_step = np.einsum("eq,qab->eab", step[:-1].reshape(k, 6), BASIS)
    return P_step, float(step[-1]), float(-gradient @ step)


def _curvature(G: Array, P_inverse: Array) -> Array:
    """Second derivatives of the barrier in P along the basis, (6 k, 6 k).

    For pairs e and f and changes A and A' of their matrices it is tr(A G_ef A' G_ef^T), and where
    e = f that of log det P_e comes on top.
    """
    k = len(P_inverse)
    left = np.einsum("qab,efbc->efqac", CHANGES, G, optimize=True)
    right = np.einsum("efac,rcd->efrad", G, CHANGES, optimize=True)
    products = left.reshape(k, k, 6, 9) @ right.reshape(k, k, 6, 9).transpose(0, 1, 3, 2)
    hessian: Array = products.transpose(0, 2, 1, 3).reshape(6 * k, 6 * k)
    changed = P_inverse[:, None] @ BASIS
    of_P = np.einsum("eqab,erba->eqr", changed, changed)
    rows = np.arange(6 * k).reshape(k, 6)
    hessian[rows[:, :, None], rows[:, None, :]] += of_P
    return hessian
