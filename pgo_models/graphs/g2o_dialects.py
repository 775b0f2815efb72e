"""What a single line of a g2o file leaves open, and all lines of the file decide.

Three things are open: the order of the matrix on lines in the plane, the frame of a sensor that is
not at its pose, and an id that stands for a pose and a landmark.
"""

import enum
from collections.abc import Mapping, Sequence

import numpy as np

from pgo_models.geometry.arrays import triangle_places
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.g2o_rows import information_of, numbers_of, poses_of
from pgo_models.graphs.g2o_tags import Tag
from pgo_models.graphs.pose_graph import WORLD_ID, IntArray
from pgo_models.graphs.precisions import are_definite
from pgo_models.graphs.weight_errors import SINGULAR, congruence_error, entry_error

# In place of the id of an offset, on lines that name none: the sensor is at its pose.
NO_OFFSET = -(2**63)


# Places of the numbers of a line in TORO's order: x y theta, then the triangle, ff fs ss rr fr sr.
_TORO = [0, 1, 2, 3, 4, 7, 5, 8, 6]
# An eigenvalue below this, of a matrix with ones on its diagonal, is negative beyond rounding.
_NEGATIVE = -1e-10
_NO_CHANCE = 8  # lines in g2o's order that are hardly all definite in TORO's, too


class MatrixOrder(enum.Enum):
    """Order of the matrices on EDGE2 lines, and on those of EDGE_SE2."""

    TORO = "ff fs ss rr fr sr"
    ROWS = "xx xy xt yy yt tt, as iSAM writes them"
    EITHER = "all matrices are positive definite in both orders"


def order_of_edge2(lines: Sequence[Array]) -> MatrixOrder:
    """Order in which all matrices of EDGE2 lines, arrays (n, 9), are positive definite.

    TORO's page defines this tag, so that TORO is returned, too, where neither order fits.
    """
    numbers = np.concatenate(lines)
    is_toro = _all_are_definite(from_toro_order(numbers))
    is_by_rows = _all_are_definite(numbers)
    if is_toro and is_by_rows:
        return MatrixOrder.EITHER
    return MatrixOrder.ROWS if is_by_rows else MatrixOrder.TORO


def order_of_edge_se2(lines: Sequence[Array]) -> MatrixOrder:
    """Order of the matrices on EDGE_SE2 lines, arrays (n, 9): by rows, as g2o has them, or TORO's.

    It is TORO's where some matrix has a negative eigenvalue by rows, beyond rounding, and all are
    positive definite in TORO's order. A few matrices may be definite in both by chance.
    """
    numbers = np.concatenate(lines)
    # The second entry on the diagonal, which is the coupling of x and theta by rows.
    may_be_toro = bool((numbers[:, 5] > 0.0).all())
    if not may_be_toro or not _all_are_definite(from_toro_order(numbers)):
        return MatrixOrder.ROWS
    matrices = _matrices(numbers)
    is_by_rows = _have_minors(matrices) and bool(are_definite(matrices, _NEGATIVE).all())
    if not is_by_rows:
        return MatrixOrder.TORO
    return MatrixOrder.EITHER if len(numbers) >= _NO_CHANCE else MatrixOrder.ROWS


def from_toro_order(numbers: Array) -> Array:
    """Numbers of lines in the plane, (n, 9), their matrices by rows instead of in TORO's order."""
    return np.asarray(numbers[:, _TORO])


def _matrices(rows: Array) -> Array:
    """The matrices on EDGE rows in the plane, (n, 9)."""
    return np.asarray(rows[:, 3 + triangle_places(3)])


def _all_are_definite(rows: Array) -> bool:
    """Whether the whole matrices on EDGE rows in the plane, (n, 9), are positive definite."""
    matrices = _matrices(rows)
    diagonals = np.einsum("mkk->mk", matrices)
    may_be_definite = bool((diagonals > 0.0).all()) and _have_minors(matrices)
    return may_be_definite and bool(are_definite(matrices, SINGULAR).all())


def _have_minors(matrices: Array) -> bool:
    """Whether no entry is larger than those on the diagonal allow: |a_ij|^2 <= a_ii a_jj.

    Nothing overflows then where the matrices are scaled to ones on their diagonals.
    """
    root = np.sqrt(np.maximum(np.einsum("mkk->mk", matrices), 0.0))
    most = root[:, :, None] * root[:, None, :]
    return bool((np.abs(matrices) <= (1.0 - _NEGATIVE) * most).all())


def in_frames_of_poses(kind: Tag, rows: Array, offsets: Sequence[Poses]) -> tuple[Array, Array]:
    """EDGE rows, measured by sensors that are not at their poses, in the frames of the poses.

    The errors, (n,), of the information matrices (`weight_errors`) are returned with the rows.

    O_i and O_j are the poses of the sensors in the frames of x_i and x_j. A tag with one offset has
    O_i = I. The measurement Z is one of (x_i O_i)^-1 x_j O_j (`computeError` of g2o's edges with
    offsets), so that O_i Z O_j^-1 is one of x_i^-1 x_j. A point z becomes O_i z.

    The information of a point is turned with it. The information of a pose becomes A^T I A. Here A
    takes an error e' of x_i^-1 x_j to the error e = O_j^-1 e' O_j of Z. It is exact where the
    sensor is at its pose x_j, and of first order in the rotation error elsewhere.
    """
    d = kind.d
    Z = Poses(*poses_of(d, rows))
    information = information_of(d, rows)
    identity = Poses.identity(len(rows), d)
    if kind.is_point:
        (first,) = offsets
        points = first.t + np.einsum("nab,nb->na", first.R, Z.t)
        measured = Poses(identity.R, points)
        A = np.zeros_like(information)
        A[:, :d, :d] = first.R.mT
    else:
        first, second = offsets if kind.num_offsets == 2 else (identity, offsets[0])
        R = first.R @ Z.R @ second.R.mT
        t = first.t + np.einsum("nab,nb->na", first.R, Z.t) - np.einsum("nab,nb->na", R, second.t)
        measured = Poses(R, t)
        A = _adjoint_of_inverse(second)
    side = d if kind.is_point else len(A[0])
    of_sensor = information[:, :side, :side]
    # An entry of a rotation is at most 1, and one of R^T [t]x at most ||t||.
    sizes = np.ones((len(rows), side, side))
    if not kind.is_point:
        sizes[:, :d, d:] = np.linalg.norm(second.t, axis=1)[:, None, None]
        sizes[:, d:, :d] = 0.0
    information = A.mT @ information @ A
    of_pose = information[:, :side, :side]
    error = entry_error(of_pose, congruence_error(sizes, of_sensor))
    triangle = np.triu_indices(information.shape[1])
    turned = np.concatenate([numbers_of(measured.R, measured.t), information[:, *triangle]], axis=1)
    return turned, error


def _adjoint_of_inverse(poses: Poses) -> Array:
    """Matrices, (n, k, k), that take small errors (t, w) of E to those of O^-1 E O.

    They are [[R^T, -R^T [t]x], [0, R^T]] in space, and in the plane the same with w along z.
    """
    R_T = poses.R.mT
    n, d = poses.t.shape
    if d == 2:
        turned = np.stack([-poses.t[:, 1], poses.t[:, 0]], axis=1)  # -[t]x w for w = 1 along z
        A = np.zeros((n, 3, 3))
        A[:, :2, :2] = R_T
        A[:, :2, 2] = np.einsum("nab,nb->na", R_T, turned)
        A[:, 2, 2] = 1.0
        return A
    x, y, z = poses.t.T
    zero = np.zeros(n)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(n, 3, 3)
    A = np.zeros((n, 6, 6))
    A[:, :3, :3] = R_T
    A[:, :3, 3:] = -R_T @ cross
    A[:, 3:, 3:] = R_T
    return A


def landmark_shift(poses: IntArray, landmarks: IntArray) -> int:
    """Return the number that is added to the ids of landmarks to keep them apart from poses.

    It is the least power of ten that puts them above all poses: landmark 7 becomes 1007. 0 where
    ids of 64 bits have no room for that.
    """
    largest_pose = int(poses.max())
    lowest_landmark = int(landmarks.min())
    shift = 10
    while shift + min(lowest_landmark, 0) <= largest_pose:
        shift *= 10
    has_room = int(landmarks.max()) + shift < WORLD_ID
    return shift if has_room else 0


def offsets_named(ids: IntArray, d: int, offset_of: Mapping[int, Array]) -> Poses:
    """Poses of sensors, one for each of the ids, (n,), of offsets; numbers are rows of vertices."""
    identity = numbers_of(np.eye(d)[None], np.zeros((1, d)))[0]
    rows = [offset_of.get(offset_id, identity) for offset_id in ids.tolist()]
    return Poses(*poses_of(d, np.array(rows)))
