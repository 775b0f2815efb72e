"""What a single line of a g2o file leaves open, and all lines of the file decide.

Three things are open: the order of the matrix on lines in the plane, the frame of a sensor that is
not at its pose, and an id that stands for a pose and a landmark.
"""

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
NEGATIVE = -1e-10


def fitting_orders(lines: Sequence[Array], least: float) -> tuple[bool, bool]:
    """Whether all matrices on lines in the plane, (n, 9), fit TORO's order, and whether by rows.

    In TORO's order, ff fs ss rr fr sr, they are to be positive definite. By rows, xx xy xt yy yt
    tt, as g2o and iSAM write them, their eigenvalues beside ones on the diagonals are to be above
    `least`. A few matrices may fit both by chance.
    """
    numbers = np.concatenate(lines)
    by_rows = _matrices(numbers)
    of_toro = _matrices(from_toro_order(numbers))
    may_be_toro = bool((np.einsum("mkk->mk", of_toro) > 0.0).all()) and _have_minors(of_toro)
    is_toro = may_be_toro and bool(are_definite(of_toro, SINGULAR).all())
    is_by_rows = _have_minors(by_rows) and bool(are_definite(by_rows, least).all())
    return is_toro, is_by_rows


def from_toro_order(numbers: Array) -> Array:
    """Numbers of lines in the plane, (n, 9), their matrices by rows instead of in TORO's order."""
    return np.asarray(numbers[:, _TORO])


def _matrices(rows: Array) -> Array:
    """The matrices on EDGE rows in the plane, (n, 9)."""
    return np.asarray(rows[:, 3 + triangle_places(3)])


def _have_minors(matrices: Array) -> bool:
    """Whether no entry is larger than those on the diagonal allow: |a_ij|^2 <= a_ii a_jj.

    Nothing overflows then where the matrices are scaled to ones on their diagonals.
    """
    root = np.sqrt(np.maximum(np.einsum("mkk->mk", matrices), 0.0))
    most = root[:, :, None] * root[:, None, :]
    return bool((np.abs(matrices) <= (1.0 - NEGATIVE) * most).all())


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
