"""The convex hull of SO(3): its linear matrix inequality, and what its multipliers prove.

For a rotation E with the unit quaternion q, A(E) = 4 q q^T, which is linear in E: the matrices E
with A(E) PSD are the mixtures of rotations (Saunderson, Parrilo & Willsky 2015). A relaxation that
asks A(Z_ij) PSD of Z_ij = R_i^T R_j at every pair (i, j) of poses that share an edge has a
multiplier Pi >= 0, (4, 4), of every pair. With N(Pi) the symmetric matrix that has

    tr(X^T N(Pi) X) = <Pi, A(R_i^T R_j)> - tr(Pi),

the matrix M - blockdiag(0, Lambda) - sum_e N(Pi_e) PSD proves that no poses cost less than
sum_i tr(Lambda_i) - sum_e tr(Pi_e).

A multiplier Pi that is zero on some unit quaternion, as it is where A(Z_ij) is not zero, is a
handedness term: q^T Pi q = v^T P v / 4 with v the vector part of the quaternion of T^T E, where T
is the rotation of that quaternion (`pgo_models.certificates.handedness`).
"""

import numpy as np

from pgo_models.certificates.handedness import HandednessTerms, distinct_pairs
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import (
    Array,
    quaternions_from_rotations,
    rotations_from_quaternions,
)
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.problem import PGOProblem


def _quaternion_products() -> Array:
    """The matrices C_ab, (3, 3, 4, 4), with A(E) = I + sum_ab E_ab C_ab, q = (w, x, y, z)."""
    C = np.zeros((3, 3, 4, 4))
    signs = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    for k in range(4):
        for a in range(3):
            C[a, a, k, k] = signs[k, a]
    for a in range(3):
        b = (a + 1) % 3
        c = (a + 2) % 3
        # 4 w x_a = E_cb - E_bc, and 4 x_b x_c = E_bc + E_cb
        for row, column in ((0, a + 1), (a + 1, 0)):
            C[c, b, row, column] = 1.0
            C[b, c, row, column] = -1.0
        for row, column in ((b + 1, c + 1), (c + 1, b + 1)):
            C[b, c, row, column] = 1.0
            C[c, b, row, column] = 1.0
    return C


PRODUCTS = _quaternion_products()


def hull_matrices(E: Array) -> Array:
    """A(E), (k, 4, 4), of matrices E, (k, 3, 3): 4 q q^T for rotations, PSD for their mixtures."""
    return np.asarray(np.eye(4) + hull_changes(E))


def hull_changes(E: Array) -> Array:
    """A(E) - I, (k, 4, 4), the linear part of A, of matrices E, (k, 3, 3)."""
    return np.asarray((E.reshape(-1, 9) @ PRODUCTS.reshape(9, 16)).reshape(-1, 4, 4))


def hull_gradients(Pi: Array) -> Array:
    """Matrices C(Pi), (k, 3, 3), with <Pi, A(E)> = tr(Pi) + <C(Pi), E>, of Pi, (k, 4, 4)."""
    return np.asarray((Pi.reshape(-1, 16) @ PRODUCTS.reshape(9, 16).T).reshape(-1, 3, 3))


def edges_of(problem: PGOProblem) -> IntArray:
    """Pairs of poses that share an edge, (k, 2), each once; a SettingError in the plane."""
    if problem.d == 2:
        raise SettingError(
            "the hulls of rotations are for space; take another RelaxationForm. In the plane "
            "certify takes rotations as complex numbers, which is all that the hull would add"
        )
    return distinct_pairs(problem.graph)


def terms_of(edges: IntArray, Pi: Array) -> HandednessTerms:
    """Handedness terms that are zero on the softest quaternion of every Pi, (k, 4, 4).

    That is the eigenvector of its smallest eigenvalue, and T is its rotation.
    """
    symmetric = 0.5 * (Pi + np.swapaxes(Pi, 1, 2))
    _, vectors = np.linalg.eigh(symmetric)
    w, x, y, z = vectors[:, :, 0].T
    quaternions = np.stack([x, y, z, w], axis=1)
    T = rotations_from_quaternions(quaternions)
    P = _vector_form(symmetric, quaternions)
    return HandednessTerms.with_rotations(edges[:, 0], edges[:, 1], T, P)


def matrices_at(T: Array, Pi: Array) -> Array:
    """The P, (k, 3, 3), that multipliers Pi, (k, 4, 4), have at rotations T, (k, 3, 3).

    They are those of Pi as a form of quaternions, restricted to those orthogonal to that of T.
    """
    symmetric = 0.5 * (Pi + np.swapaxes(Pi, 1, 2))
    return _vector_form(symmetric, quaternions_from_rotations(T))


def _vector_form(Pi: Array, quaternions: Array) -> Array:
    """P = 4 L Pi L^T, (k, 3, 3), where L q is the vector part of conj(tau) q.

    The quaternions tau, (k, 4), are ordered (x, y, z, w), as those of
    `rotations_from_quaternions`.
    """
    x, y, z, w = quaternions.T
    L = np.stack(
        [
            np.stack([-x, w, z, -y], axis=1),
            np.stack([-y, -z, w, x], axis=1),
            np.stack([-z, y, -x, w], axis=1),
        ],
        axis=1,
    )
    return np.asarray(4.0 * L @ Pi @ np.swapaxes(L, 1, 2))


def less_diagonal_blocks(Lambda: Array, terms: HandednessTerms) -> Array:
    """Lambda, (n, 3, 3), less what a term has on the diagonal of B^T W B: T W T^T and W.

    N(Pi) has nothing there, and a constant in its place.
    """
    reduced = Lambda.copy()
    turned = terms.T @ terms.W @ np.swapaxes(terms.T, 1, 2)
    np.subtract.at(reduced, terms.i, turned)
    np.subtract.at(reduced, terms.j, terms.W)
    return reduced
