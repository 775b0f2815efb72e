"""SO(d), d = 2 or 3, vectorised over poses: projection, exponential, logarithm, random draws, stacking.

The projection is step (b) of the paper's Algorithm 1 (`algo1: SOC`), with det = +1 enforced.
"""

import numpy as np
import scipy  # and scipy.spatial when it is used
from numpy.typing import NDArray

from pgo_models.errors import SettingError

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_POLAR_TOLERANCE = 1e-8  # the iteration is quadratic: a last change below this leaves an error below 1e-15
_POLAR_ITERATIONS = 10
_POLAR_MIN_DETERMINANT = 1e-2  # of the matrix scaled to Frobenius norm sqrt(3); below, the SVD is used
_FEW, _MANY = 20, 4000  # matrices for which the SVD is faster, and of which the iteration stays in the cache
_ROW, _COLUMN = np.divmod(np.arange(9), 3)  # of the entries of a 3 x 3 matrix, and those after them, cyclically:
_UP, _DOWN, _AHEAD, _BACK = (3 * ((_ROW + a) % 3) + (_COLUMN + b) % 3 for a, b in ((1, 1), (2, 2), (1, 2), (2, 1)))


def project_to_rotations(A: Array) -> Array:
    """Nearest rotations: argmin over omega in SO(d) of ||omega - A_i||_F for every A_i of A, (n, d, d).

    With the SVD A = U D V^T it is U diag(1, .., 1, det(U V^T)) V^T. Many well conditioned 3 x 3 matrices of positive
    determinant take Newton's polar iteration X <- (X + cof(X) / det X) / 2, to the same limit. Where several are
    nearest, one of them (Ebrahimi & Deghat, Algorithm 1, steps 4 and 5; Higham, Functions of Matrices, section 8.3).

    Examples
    --------
    >>> project_to_rotations(np.array([[[0.0, -2.0], [2.0, 0.0]]]))[0].round(3).tolist()
    [[0.0, -1.0], [1.0, 0.0]]
    """
    _check_ends(A, (2, 2), (3, 3))
    if A.shape[-1] == 2:
        return _project_2d(A)
    if len(A) < _FEW:
        return project_by_svd(A)
    if len(A) >= 2 * _MANY:
        return np.concatenate([project_to_rotations(some) for some in np.array_split(A, len(A) // _MANY)])
    X = np.ascontiguousarray(A.reshape(-1, 9).T)
    norm = np.sqrt(np.einsum("en,en->n", X, X) / 3.0)
    X /= np.where(norm > 0, norm, 1.0)
    cofactors, determinant = _cofactors(X)
    good = determinant > _POLAR_MIN_DETERMINANT
    taken = slice(None) if good.all() else good  # a slice copies nothing
    settled = np.zeros(len(A), dtype=bool)
    X[:, taken], settled[taken] = _polar(X[:, taken], cofactors[:, taken], determinant[taken])
    omega = np.ascontiguousarray(X.T).reshape(A.shape)
    if not settled.all():
        omega[~settled] = project_by_svd(A[~settled])
    return omega


def project_by_svd(A: Array) -> Array:
    """Nearest rotations of (n, d, d) matrices through the SVD, whatever their determinant."""
    U, _, Vt = np.linalg.svd(A)
    U[..., :, -1] *= np.where(np.linalg.det(U @ Vt) < 0, -1.0, 1.0)[..., None]
    return np.asarray(U @ Vt)


def _project_2d(A: Array) -> Array:
    cosine, sine = A[..., 0, 0] + A[..., 1, 1], A[..., 1, 0] - A[..., 0, 1]
    norm = np.hypot(cosine, sine)
    degenerate = norm == 0.0
    norm = np.where(degenerate, 1.0, norm)
    return _from_cosine_sine(np.where(degenerate, 1.0, cosine / norm), sine / norm)


def _from_cosine_sine(cosine: Array, sine: Array) -> Array:
    return np.stack([np.stack([cosine, -sine], -1), np.stack([sine, cosine], -1)], -2)


def _polar(X: Array, cofactors: Array, determinant: Array) -> tuple[Array, BoolArray]:
    """Newton's polar iteration on matrices (9, n) of positive determinant; second, which of them have settled."""
    change = np.full(X.shape[1], np.inf)
    for _ in range(_POLAR_ITERATIONS):
        following = 0.5 * (X + cofactors / determinant)
        change = np.abs(following - X).max(axis=0, initial=0.0)
        X = following
        if change.max(initial=0.0) < _POLAR_TOLERANCE:
            break
        cofactors, determinant = _cofactors(X)
    return X, change < _POLAR_TOLERANCE


def _determinants(X: Array) -> Array:
    if X.shape[-1] == 2:
        return np.asarray(X[..., 0, 0] * X[..., 1, 1] - X[..., 0, 1] * X[..., 1, 0])
    u, v, w = np.moveaxis(X, -2, 0)  # rows; numpy's cross product takes twice as long
    first = u[..., 0] * (v[..., 1] * w[..., 2] - v[..., 2] * w[..., 1])
    second = u[..., 1] * (v[..., 2] * w[..., 0] - v[..., 0] * w[..., 2])
    return np.asarray(first + second + u[..., 2] * (v[..., 0] * w[..., 1] - v[..., 1] * w[..., 0]))


def _cofactors(X: Array) -> tuple[Array, Array]:
    """Cofactor matrices and determinants, (9, n) and (n,), of n matrices, the nine entries of all behind each other."""
    C = X[_UP] * X[_DOWN] - X[_AHEAD] * X[_BACK]
    return C, X[0] * C[0] + X[1] * C[1] + X[2] * C[2]


def tangent_dimension(d: int) -> int:
    """Dimension d (d - 1) / 2 of SO(d): 1 in the plane, 3 in space."""
    return d * (d - 1) // 2


def hat(w: Array) -> Array:
    """Skew matrices of (n, 1) or (n, 3) tangent vectors: hat(w) v = w x v in space, the turn by w in the plane."""
    if w.shape[-1] == 1:
        return _from_cosine_sine(np.zeros_like(w[..., 0]), w[..., 0])
    W = np.zeros((*w.shape, 3))
    W[..., 2, 1], W[..., 0, 2], W[..., 1, 0] = w[..., 0], w[..., 1], w[..., 2]
    W[..., 1, 2], W[..., 2, 0], W[..., 0, 1] = -w[..., 0], -w[..., 1], -w[..., 2]
    return W


def vee(W: Array) -> Array:
    """Tangent vectors (n, 1) or (n, 3) of the skew part of (n, d, d) matrices; vee(hat(w)) = w."""
    if W.shape[-1] == 2:
        return 0.5 * (W[..., 1, 0] - W[..., 0, 1])[..., None]
    return 0.5 * np.stack([W[..., 2, 1] - W[..., 1, 2], W[..., 0, 2] - W[..., 2, 0], W[..., 1, 0] - W[..., 0, 1]], -1)


def exp_map(w: Array) -> Array:
    """Rotations Exp(hat(w)) of tangent vectors w, (n, 1) or (n, 3), in radians.

    Examples
    --------
    >>> exp_map(np.array([[np.pi / 2]])).round(6).tolist()
    [[[0.0, -1.0], [1.0, 0.0]]]
    """
    _check_ends(w, (1,), (3,))
    if w.shape[-1] == 1:
        return _from_cosine_sine(np.cos(w[..., 0]), np.sin(w[..., 0]))
    return np.asarray(scipy.spatial.transform.Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix()).reshape((*w.shape, 3))


def log_map(R: Array) -> Array:
    """Tangent vectors w, (n, 1) or (n, 3), in radians, with Exp(hat(w)) = R, (n, d, d), and ||w|| <= pi.

    Examples
    --------
    >>> log_map(exp_map(np.array([[0.1, 0.2, 0.3]]))).round(6).tolist()
    [[0.1, 0.2, 0.3]]
    """
    _check_ends(R, (2, 2), (3, 3))
    if R.shape[-1] == 2:
        return np.arctan2(R[..., 1, 0] - R[..., 0, 1], R[..., 0, 0] + R[..., 1, 1])[..., None]
    turns = scipy.spatial.transform.Rotation.from_matrix(R.reshape(-1, 3, 3))
    return np.asarray(turns.as_rotvec()).reshape(R.shape[:-1])


def _check_ends(A: Array, *ends: tuple[int, ...]) -> None:
    if not isinstance(A, np.ndarray) or A.shape[-len(ends[0]) :] not in ends:
        raise SettingError(f"{type(A).__name__} of shape {np.shape(A)}; give an array whose last axes are {ends}")


def random_rotations(count: int, d: int, rng: np.random.Generator) -> Array:
    """Rotations (count, d, d) drawn uniformly (by the Haar measure) from SO(d).

    Examples
    --------
    >>> R = random_rotations(4, 3, np.random.default_rng(0))
    >>> R.shape, bool(np.linalg.det(R).min() > 0.999)
    ((4, 3, 3), True)
    """
    if d == 2:
        return exp_map(rng.uniform(-np.pi, np.pi, (count, 1)))
    return rotations_from_quaternions(rng.standard_normal((count, 4)))


def rotations_from_quaternions(quaternions: Array) -> Array:
    """Rotations of (n, 4) quaternions (x, y, z, w), normalised first; none may be zero."""
    return np.asarray(scipy.spatial.transform.Rotation.from_quat(quaternions).as_matrix()).reshape(-1, 3, 3)


def quaternions_from_rotations(R: Array) -> Array:
    """Unit quaternions (n, 4), ordered (x, y, z, w) with w >= 0, of (n, 3, 3) rotations."""
    return np.asarray(scipy.spatial.transform.Rotation.from_matrix(R).as_quat(canonical=True)).reshape(-1, 4)


def orthogonality_error(R: Array) -> Array:
    """max(||R_i^T R_i - I||_F, 1 - det R_i) of every (n, d, d) matrix; nan or inf stay what they are."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.asarray(np.maximum(np.sqrt(_squared_defect(R)), 1.0 - _determinants(R)))


def _squared_defect(R: Array) -> Array:
    """||R^T R - I||_F^2, by entries of all matrices: of thousands much faster than a product of stacked ones."""
    d = R.shape[-1]
    X = np.ascontiguousarray(np.moveaxis(R.reshape(-1, d, d), 0, -1))
    E = X[0, :, None] * X[0]
    for row in X[1:]:
        E += row[:, None] * row
    E.reshape(d * d, -1)[:: d + 1] -= 1.0
    return np.asarray(np.einsum("abn,abn->n", E, E)).reshape(R.shape[:-2])


def stack_transposes(R: Array) -> Array:
    """The (d n, d) matrix whose rows d i .. d i + d - 1 are R_i^T."""
    return np.swapaxes(R, -1, -2).reshape(-1, R.shape[-2])


def unstack_transposes(Y: Array) -> Array:
    """The (n, d, d) matrices R of `stack_transposes`."""
    d = Y.shape[-1]
    return np.swapaxes(Y.reshape(-1, d, d), -1, -2)
