"""Interior-point method for handedness terms of small graphs.

Q_r is the certificate matrix reduced to the rotations of all poses but pose r, which is fixed so
that the matrix can be positive definite. For every pair e = (i, j) of poses, B_e takes the
difference R_j^T - T_e^T R_i^T of their rows, and W is the linear function of P_e of
`pgo_models.certificates.handedness`. With Q_r(P) = Q_r - sum_e B_e^T W(P_e) B_e it solves

    max t over t and P  subject to  Q_r(P) - t I >= 0,  P_e >= 0  (positive semidefinite),

whose optimum is the largest smallest eigenvalue that Q_r(P) can have. Minimisers of

    f(P, t) = -t / mu - log det(Q_r(P) - t I) - sum_e log det P_e

move towards the solution as mu falls (Boyd & Vandenberghe 2004, chapter 11). A step is a Newton
step, shortened only where it would leave the feasible set: f itself is not tested for decrease.
Newton's matrix has six rows a pair. The method ends as soon as the smallest eigenvalue is positive,
or the duality gap shows that no P makes it so, or the gap is too small to matter.
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
_CUT = 0.2  # factor on mu after each centre
_CENTRED = 1.0  # squared Newton decrement below which a full step leads to a centre
_BACKTRACK = 0.7
_WITHIN = 0.9  # of a step that had to be cut to stay inside
_RIDGE = 1e-12  # relative, of the diagonal of Newton's matrix
_SAFETY = 1.5  # on the duality gap, against rounding and the ridge
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
    """State k: the point (P, t), the weight mu of f, and the smallest eigenvalue of Q_r(P)."""

    k: int
    P: Array  # (pairs, 3, 3)
    t: float
    mu: float
    smallest: float
    scale: float  # mean diagonal of M over the rotations
    is_beyond_reach: bool = False  # whether the largest t is negative, or hardly above this one


@dataclass(frozen=True)
class HandednessBarrier:
    """Maximise the smallest eigenvalue of Q_r(P) over P; CONVERGED once it is positive.

    Positive means above `POSITIVE` of the scale. It ends with STALLED where the duality gap shows
    that no P on these pairs makes the eigenvalue positive, or is so small that too little is left
    to gain; the second case proves nothing about the sign. The `dual_residual` of its measurements
    is that of `HandednessAscent`.

    Parameters
    ----------
    max_iterations : int
        Largest number of Newton steps.

    Raises
    ------
    SettingError
        If `max_iterations` is negative.
    """

    max_iterations: int = 100

    def __post_init__(self) -> None:
        check_settings(self, not_negative=["max_iterations"])

    def init(self, matrix: HandedMatrix, start: Array | None) -> BarrierState:
        """State 0: every P_e is the same multiple of the identity, and t below the eigenvalues.

        `start`, (pairs, 3, 3), is ignored: a barrier begins well inside of its cones.
        """
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
        # Below 1 the full step stays inside in exact arithmetic; the length is for rounding.
        is_centred = decrement < _CENTRED and length == 1.0
        if length < 1.0:
            length *= _WITHIN
        P = state.P + length * P_step
        t = state.t + length * t_step
        found = replace(state, k=state.k + 1, P=P, t=t, smallest=_smallest(matrix, P))
        if not is_centred:
            return found
        # After a full Newton step from a squared decrement below 1, mu (Z - Z dS Z) is dual
        # feasible, Z the inverse of Q_r(P) - t I and dS its change: the duality gap at the new
        # point is at most mu times the degree of the barrier.
        degree = 3 * (len(matrix.free) + len(P))  # rows of Q_r(P) and of all P_e
        duality_gap = state.mu * degree
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
    """Newton step of f in P, (pairs, 3, 3), and in t, and the squared Newton decrement."""
    num_pairs = len(state.P)
    num_poses = matrix.problem.num_poses
    every = np.arange(num_pairs)
    slack = matrix.dense(state.P)
    side = len(slack)
    np.fill_diagonal(slack, slack.diagonal() - state.t)
    factor = scipy.linalg.cho_factor(slack, lower=True)
    Z = scipy.linalg.cho_solve(factor, np.eye(side))
    # `differences` applies B to the rows of all poses; those of pose r are zero.
    Z_rows = np.zeros((num_poses, 3, side))
    Z_rows[matrix.free] = Z.reshape(-1, 3, side)
    BZ = matrix.differences(Z_rows)  # (pairs, 3, side)
    ZB_rows = np.zeros((num_poses, 3, 3 * num_pairs))
    ZB_rows[matrix.free] = BZ.reshape(3 * num_pairs, side).T.reshape(-1, 3, 3 * num_pairs)
    BZB = matrix.differences(ZB_rows).reshape(num_pairs, 3, num_pairs, 3)
    G = BZB.transpose(0, 2, 1, 3)  # G[e, f] = B_e Z B_f^T
    G_diagonal = G[every, every]
    BZZB = np.einsum("eas,ebs->eab", BZ, BZ)  # B_e Z^2 B_e^T
    P_inverse = np.asarray(np.linalg.inv(state.P), dtype=float)
    gradient = np.empty(6 * num_pairs + 1)
    of_slack = np.einsum("qab,eab->eq", CHANGES, G_diagonal)
    of_P = np.einsum("qab,eab->eq", BASIS, P_inverse)
    gradient[:-1] = -(of_slack + of_P).ravel()
    gradient[-1] = np.trace(Z) - 1.0 / state.mu
    hessian = np.empty((6 * num_pairs + 1, 6 * num_pairs + 1))
    hessian[:-1, :-1] = _curvature(G, P_inverse)
    cross = -np.einsum("qab,eab->eq", CHANGES, BZZB).ravel()
    hessian[-1, :-1] = cross
    hessian[:-1, -1] = cross
    hessian[-1, -1] = np.sum(Z**2)
    np.fill_diagonal(hessian, hessian.diagonal() * (1.0 + _RIDGE))
    solved = scipy.linalg.cho_factor(hessian, lower=True, overwrite_a=True)
    step = -scipy.linalg.cho_solve(solved, gradient)
    P_step = np.einsum("eq,qab->eab", step[:-1].reshape(num_pairs, 6), BASIS)
    return P_step, float(step[-1]), float(-gradient @ step)


def _curvature(G: Array, P_inverse: Array) -> Array:
    """Second derivatives of f in P along the basis, (6 pairs, 6 pairs).

    The entry for a change C of the matrix of pair e and C' of that of pair f is
    tr(C G_ef C' G_ef^T); where e = f the second derivative of -log det P_e is added.
    """
    num_pairs = len(P_inverse)
    left = np.einsum("qab,efbc->efqac", CHANGES, G, optimize=True)
    right = np.einsum("efac,rcd->efrad", G, CHANGES, optimize=True)
    # The sum of (C G)_ac (G C')_ac is tr(C G C' G^T), as C' is symmetric.
    left_rows = left.reshape(num_pairs, num_pairs, 6, 9)
    right_rows = right.reshape(num_pairs, num_pairs, 6, 9)
    products = left_rows @ right_rows.transpose(0, 1, 3, 2)
    hessian: Array = products.transpose(0, 2, 1, 3).reshape(6 * num_pairs, 6 * num_pairs)
    changed = P_inverse[:, None] @ BASIS
    of_P = np.einsum("eqab,erba->eqr", changed, changed)
    rows = np.arange(6 * num_pairs).reshape(num_pairs, 6)
    hessian[rows[:, :, None], rows[:, None, :]] += of_P
    return hessian
