"""SO(d), d = 2 or 3, for many poses at once: projection, exponential, logarithm, random draws.

The projection is step (b) of the paper's Algorithm 1, with det = +1 enforced.
"""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pgo_models.errors import SettingError

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
# In a union: None is possible, as the docstring says, and type checkers do not ask for a test.
MaybeNone: TypeAlias = Any

# The polar iteration converges quadratically: a last change below this leaves an error below 1e-15.
# Where so many iterations are not enough, the SVD is used.
_POLAR_TOLERANCE = 1e-8
_POLAR_ITERATIONS = 10
# Below this determinant, of a matrix scaled to Frobenius norm sqrt(3), the SVD is used.
_POLAR_MIN_DETERMINANT = 1e-2
_FEWEST_FOR_POLAR = 20  # below this number of matrices the SVD is faster
_BATCH = 4000  # about this number of matrices fit into the cache during the polar iteration

# Row and column of the entries of a 3 x 3 matrix that is stored row by row.
_ROW, _COLUMN = np.divmod(np.arange(9), 3)


def _entries(row_shift: int, column_shift: int) -> NDArray[np.int64]:
    """Index of the entry so many rows and columns further, cyclically, for every entry, (9,)."""
    row = (_ROW + row_shift) % 3
    column = (_COLUMN + column_shift) % 3
    return np.asarray(3 * row + column)


# The cofactor of an entry is X[next row, next column] X[row after next, column after next] - X[next
# row, column after next] X[row after next, next column].
_NEXT_NEXT = _entries(1, 1)
_AFTER_AFTER = _entries(2, 2)
_NEXT_AFTER = _entries(1, 2)
_AFTER_NEXT = _entries(2, 1)


def project_to_rotations(A: Array) -> Array:
    """Project matrices to the nearest rotations: argmin over omega in SO(d) of ||omega - A_i||_F.

    With the SVD A = U D V^T the projection is U diag(1, .., 1, det(U V^T)) V^T. Many well
    conditioned 3 x 3 matrices of positive determinant are projected by Newton's polar iteration X
    <- (X + cof(X) / det X) / 2, which has the same limit. Where several rotations are nearest, the
    result is one of them.

    A has shape (n, d, d) with d = 2 or 3, as the result has; else a SettingError is raised.

    References
    ----------
    Ebrahimi & Deghat, Algorithm 1, lines 4 and 5; Higham, Functions of Matrices, 2008, section 8.3.

    Examples
    --------
    >>> project_to_rotations(np.array([[[0.0, -2.0], [2.0, 0.0]]]))[0].round(3).tolist()
    [[0.0, -1.0], [1.0, 0.0]]
    """
    _check_ends(A, (2, 2), (3, 3))
    if A.shape[-1] == 2:
        return _project_2d(A)
    if len(A) < _FEWEST_FOR_POLAR:
        return project_by_svd(A)
    if len(A) < 2 * _BATCH:
        return _project_3d(A)
    num_batches = len(A) // _BATCH
    batches = np.array_split(A, num_batches)
    return np.concatenate([project_to_rotations(batch) for batch in batches])


def _project_3d(A: Array) -> Array:
    """Projection of 3 x 3 matrices by the polar iteration where it converges, else by the SVD."""
    X = np.ascontiguousarray(A.reshape(-1, 9).T)
    norm = np.sqrt(np.einsum("en,en->n", X, X) / 3.0)
    X /= np.where(norm > 0, norm, 1.0)
    cofactors, determinant = _cofactors(X)
    is_regular = determinant > _POLAR_MIN_DETERMINANT
    # A slice makes views, where a mask makes copies.
    chosen = slice(None) if is_regular.all() else is_regular
    polar, converged = _polar(X[:, chosen], cofactors[:, chosen], determinant[chosen])
    has_converged = np.zeros(len(A), dtype=bool)
    has_converged[chosen] = converged
    X[:, chosen] = polar
    omega = np.ascontiguousarray(X.T).reshape(A.shape)
    if not has_converged.all():
        has_failed = ~has_converged
        omega[has_failed] = project_by_svd(A[has_failed])
    return omega


def project_by_svd(A: Array) -> Array:
    """Nearest rotations of (n, d, d) matrices through the SVD, whatever their determinant."""
    U, _, Vt = np.linalg.svd(A)
    is_reflection = np.linalg.det(U @ Vt) < 0
    sign = np.where(is_reflection, -1.0, 1.0)
    U[..., :, -1] *= sign[..., None]
    return np.asarray(U @ Vt)


def _project_2d(A: Array) -> Array:
    """Nearest rotations of (.., 2, 2) matrices; the identity where every rotation is nearest."""
    cosine = A[..., 0, 0] + A[..., 1, 1]
    sine = A[..., 1, 0] - A[..., 0, 1]
    norm = np.hypot(cosine, sine)
    is_degenerate = norm == 0.0
    norm = np.where(is_degenerate, 1.0, norm)
    cosine = np.where(is_degenerate, 1.0, cosine / norm)
    return _from_cosine_sine(cosine, sine / norm)


def _from_cosine_sine(cosine: Array, sine: Array) -> Array:
    """Matrices [c, -s; s, c], (.., 2, 2), of cosines and sines, (..)."""
    matrices = np.empty((*cosine.shape, 2, 2))
    matrices[..., 0, 0] = cosine
    matrices[..., 0, 1] = -sine
    matrices[..., 1, 0] = sine
    matrices[..., 1, 1] = cosine
    return matrices


def _polar(X: Array, cofactors: Array, determinant: Array) -> tuple[Array, BoolArray]:
    """Newton's polar iteration on matrices (9, n) of positive determinant.

    Returned are the last iterates, and which of them have converged, (n,).
    """
    change = np.full(X.shape[1], np.inf)
    for _ in range(_POLAR_ITERATIONS):
        next_X = 0.5 * (X + cofactors / determinant)
        change = np.abs(next_X - X).max(axis=0, initial=0.0)
        X = next_X
        if change.max(initial=0.0) < _POLAR_TOLERANCE:
            break
        cofactors, determinant = _cofactors(X)
    return X, change < _POLAR_TOLERANCE


def _determinants(X: Array) -> Array:
    """Determinants of (.., d, d) matrices, expanded along the first row."""
    if X.shape[-1] == 2:
        a, b = _columns(X[..., 0, :])
        c, d = _columns(X[..., 1, :])
        return np.asarray(a * d - b * c)
    u_0, u_1, u_2 = _columns(X[..., 0, :])
    v_0, v_1, v_2 = _columns(X[..., 1, :])
    w_0, w_1, w_2 = _columns(X[..., 2, :])
    # The cross product of v and w, in half the time of numpy's.
    minor_0 = v_1 * w_2 - v_2 * w_1
    minor_1 = v_2 * w_0 - v_0 * w_2
    minor_2 = v_0 * w_1 - v_1 * w_0
    return np.asarray(u_0 * minor_0 + u_1 * minor_1 + u_2 * minor_2)


def _columns(rows: Array) -> Array:
    """Views of the columns of rows (.., k), k of them."""
    return rows.transpose(-1, *range(rows.ndim - 1))


def _cofactors(X: Array) -> tuple[Array, Array]:
    """Cofactor matrices, (9, n), and determinants, (n,), of n matrices X, (9, n)."""
    C = X[_NEXT_NEXT] * X[_AFTER_AFTER] - X[_NEXT_AFTER] * X[_AFTER_NEXT]
    determinant = X[0] * C[0] + X[1] * C[1] + X[2] * C[2]
    return C, determinant


def tangent_dimension(d: int) -> int:
    """Dimension d (d - 1) / 2 of SO(d): 1 in the plane, 3 in space."""
    return d * (d - 1) // 2


def hat(w: Array) -> Array:
    """Skew matrices of (n, 1) or (n, 3) tangent vectors.

    In space hat(w) v = w x v; in the plane hat(w) is w times the rotation by 90 degrees.
    """
    if w.shape[-1] == 1:
        angle = w[..., 0]
        return _from_cosine_sine(np.zeros_like(angle), angle)
    x, y, z = _columns(w)
    W = np.zeros((*w.shape, 3))
    W[..., 2, 1] = x
    W[..., 0, 2] = y
    W[..., 1, 0] = z
    W[..., 1, 2] = -x
    W[..., 2, 0] = -y
    W[..., 0, 1] = -z
    return W


def vee(W: Array) -> Array:
    """Tangent vectors (n, 1) or (n, 3) of the skew part of (n, d, d) matrices; vee(hat(w)) = w."""
    z = W[..., 1, 0] - W[..., 0, 1]
    if W.shape[-1] == 2:
        return 0.5 * z[..., None]
    x = W[..., 2, 1] - W[..., 1, 2]
    y = W[..., 0, 2] - W[..., 2, 0]
    return 0.5 * np.stack([x, y, z], -1)


def exp_map(w: Array) -> Array:
    """Compute the rotations Exp(hat(w)), (n, d, d), of tangent vectors.

    They are angles in the plane, (n, 1), or rotation vectors in space, (n, 3), in radians; for
    another shape a SettingError is raised.

    Examples
    --------
    >>> exp_map(np.array([[np.pi / 2]])).round(6).tolist()
    [[[0.0, -1.0], [1.0, 0.0]]]
    """
    _check_ends(w, (1,), (3,))
    if w.shape[-1] == 1:
        angle = w[..., 0]
        return _from_cosine_sine(np.cos(angle), np.sin(angle))
    # Rodrigues' formula, with a the angle: cos(a) I + sin(a) / a hat(w) + (1 - cos(a)) / a^2 w w^T.
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    first_order = np.sinc(angle / np.pi)
    second_order = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    outer = w[..., :, None] * w[..., None, :]
    return np.asarray(np.cos(angle) * np.eye(3) + first_order * hat(w) + second_order * outer)


def log_map(R: Array) -> Array:
    """Compute the tangent vectors w of rotations, with Exp(hat(w)) = R and ||w|| <= pi.

    Of rotations (n, 2, 2) they are angles, (n, 1), and of (n, 3, 3) rotation vectors, (n, 3), in
    radians; for another shape a SettingError is raised.

    Examples
    --------
    >>> log_map(exp_map(np.array([[0.1, 0.2, 0.3]]))).round(6).tolist()
    [[0.1, 0.2, 0.3]]
    """
    _check_ends(R, (2, 2), (3, 3))
    if R.shape[-1] == 2:
        sine = R[..., 1, 0] - R[..., 0, 1]
        cosine = R[..., 0, 0] + R[..., 1, 1]
        angle = np.arctan2(sine, cosine)
        return angle[..., None]
    quaternions = quaternions_from_rotations(R.reshape(-1, 3, 3))
    vector = quaternions[:, :3]
    sine = np.linalg.norm(vector, axis=1)  # of half the angle, as w >= 0
    half_angle = np.arctan2(sine, quaternions[:, 3])
    is_zero = sine == 0.0
    angle_by_sine = np.where(is_zero, 2.0, 2.0 * half_angle / np.where(is_zero, 1.0, sine))
    return np.asarray(angle_by_sine[:, None] * vector).reshape(R.shape[:-1])


def _check_ends(A: Array, *ends: tuple[int, ...]) -> None:
    """Raise a SettingError unless the shape of an array ends in one of these."""
    num_axes = len(ends[0])
    if not isinstance(A, np.ndarray) or A.shape[-num_axes:] not in ends:
        raise SettingError(
            f"{type(A).__name__} of shape {np.shape(A)}; give an array whose last axes are {ends}"
        )


def as_generator(rng: np.random.Generator | int) -> np.random.Generator:
    """The generator that is given, or a new one from the seed that is given."""
    if isinstance(rng, np.random.Generator):
        return rng
    if rng < 0:
        raise SettingError(f"the seed is {rng}; give a whole number that is not negative")
    return np.random.default_rng(rng)


def random_rotations(count: int, d: int, rng: np.random.Generator | int) -> Array:
    """Draw rotations, (count, d, d), uniformly (by the Haar measure) from SO(d), d = 2 or 3.

    Examples
    --------
    >>> R = random_rotations(4, 3, np.random.default_rng(0))
    >>> R.shape, bool(np.linalg.det(R).min() > 0.999)
    ((4, 3, 3), True)
    """
    rng = as_generator(rng)
    if count < 0 or d not in (2, 3):
        raise SettingError(f"count is {count} and d is {d}; give at least 0, and d = 2 or 3")
    if d == 2:
        angles = rng.uniform(-np.pi, np.pi, (count, 1))
        return exp_map(angles)
    # The direction of a normal vector is uniform on the sphere of unit quaternions.
    quaternions = rng.standard_normal((count, 4))
    return rotations_from_quaternions(quaternions)


def rotations_from_quaternions(quaternions: Array) -> Array:
    """Rotations of (n, 4) quaternions (x, y, z, w), normalised first; none may be zero."""
    norm = np.linalg.norm(quaternions, axis=1, keepdims=True)
    x, y, z, w = _columns(quaternions / norm)
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
        (2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
        (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, -1) for row in rows], -2)


def quaternions_from_rotations(R: Array) -> Array:
    """Unit quaternions (n, 4), ordered (x, y, z, w) with w >= 0, of (n, 3, 3) rotations.

    All of them are rows of 4 q q^T, whose entries are sums of those of R. The row with the largest
    diagonal entry has the smallest rounding errors (Shepperd 1978).
    """
    products = np.empty((len(R), 4, 4))
    diagonal = np.einsum("naa->na", R)
    trace = diagonal.sum(axis=1)
    products[:, range(3), range(3)] = 1.0 - trace[:, None] + 2.0 * diagonal
    products[:, 3, 3] = 1.0 + trace
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        products[:, a, b] = products[:, b, a] = R[:, b, a] + R[:, a, b]
        products[:, c, 3] = products[:, 3, c] = R[:, b, a] - R[:, a, b]
    largest = np.argmax(np.einsum("naa->na", products), axis=1)
    quaternions: Array = products[np.arange(len(R)), largest]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    quaternions *= np.where(quaternions[:, 3:] < 0.0, -1.0, 1.0)
    return quaternions


def orthogonality_error(R: Array) -> Array:
    """max(||R_i^T R_i - I||_F, 1 - det R_i) of every (n, d, d) matrix, (n,).

    The error of a matrix with nan or inf is nan or inf.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        defect = np.sqrt(_squared_defect(R))
        determinant_error = 1.0 - _determinants(R)
        return np.asarray(np.maximum(defect, determinant_error))


def _squared_defect(R: Array) -> Array:
    """||R^T R - I||_F^2 of every matrix.

    Every entry of R^T R is computed for all matrices at once. For thousands of matrices this is
    much faster than a product of stacked matrices.
    """
    d = R.shape[-1]
    matrices = R.reshape(-1, d, d)
    entries = np.ascontiguousarray(np.moveaxis(matrices, 0, -1))
    # E = R^T R - I, (d, d, n), as a sum of outer products of the rows of R.
    E = entries[0, :, None] * entries[0]
    for row in entries[1:]:
        E += row[:, None] * row
    diagonal = E.reshape(d * d, -1)[:: d + 1]
    diagonal -= 1.0
    squares = np.asarray(np.einsum("abn,abn->n", E, E))
    return squares.reshape(R.shape[:-2])


def stack_transposes(R: Array) -> Array:
    """The (d n, d) matrix whose rows d i .. d i + d - 1 are R_i^T."""
    d = R.shape[-2]
    return np.swapaxes(R, -1, -2).reshape(-1, d)


def unstack_transposes(Y: Array) -> Array:
    """The (n, d, d) matrices R of `stack_transposes`."""
    d = Y.shape[-1]
    transposed = Y.reshape(-1, d, d)
    return np.swapaxes(transposed, -1, -2)
