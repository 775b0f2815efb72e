"""The tags of g2o files, and what stands on their lines.

The tags are those of g2o, GTSAM, TORO and iSAM, and of two packages that extend g2o: Vertigo and
hdl_graph_slam. Numbers are brought into the order of EDGE_SE2 and EDGE_SE3:QUAT. The sources are

- g2o (Kuemmerle et al. 2011): `types_slam2d.cpp`, `types_slam3d.cpp`, and every `read` and
  `computeError` there. Errors are of (measurement)^-1 x. So the information of a prior is in the
  measured frame, that of a position in the frame of the world, that of a landmark in the frame of
  the pose.
- TORO: its page (Grisetti et al. 2007). Its code and GTSAM differ from the page: they take the
  first vertex of an edge for the one that observes.
- GTSAM: `load2D`, for ODOMETRY, LANDMARK and BR.
- iSAM (Kaess et al. 2012): `Loader.cpp`. Its matrices are upper triangular square roots U of the
  information U^T U, by rows. EDGE3 without a matrix has the identity.
- Vertigo (Suenderhauf & Protzel 2012): switches.
- hdl_graph_slam (Koide et al. 2019): `edge_se3_priorquat.hpp`. Its error is the difference of the
  vector parts of two quaternions. To first order this is half the rotation vector, like the error
  of EDGE_SE3:QUAT. `edge_se3_priorvec.hpp`: a direction of the world and what the pose has measured
  of it, both of length one. Its error is their difference in the frame of the pose.
- g2o, `edge_se3_expmap.cpp` and `types_seven_dof_expmap.cpp`: poses and measurements of a camera
  are inverted in reading, so that files have poses from camera to world, as VERTEX_SE3:QUAT.
  Errors are logarithms, the rotation first. Similarities have logarithms, and that of their scale.
"""

import enum
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.files import LARGEST
from pgo_models.geometry.arrays import triangle_places
from pgo_models.geometry.rotations import (
    Array,
    BoolArray,
    exp_map,
    hat,
    quaternions_from_rotations,
)
from pgo_models.graphs.precisions import are_definite
from pgo_models.graphs.weight_errors import (
    SINGULAR,
    both,
    congruence_error,
    entry_error,
    inverse_error,
    precision_error,
    scaled_inverse,
)

# Difference of two entries, beside the largest, by which a complete matrix is not symmetric.
_ASYMMETRY = 1e-6
_SCALE = 1e-6  # logarithm of a scale that is 1 to the digits that programs write
# Of the squares and products of measured directions of length one, which are scaled to it.
_DIRECTION_ERROR = 2.0**-44


class Noise(enum.Enum):
    """How an EDGE line says how precise it is."""

    INFORMATION = "upper triangle of the information matrix"
    COVARIANCE = "upper triangle of the covariance matrix, row by row"
    DEVIATIONS = "standard deviations of bearing and range"
    SQUARE_ROOT = "upper triangular matrix U, row by row, with the information U^T U"
    MISSING = "nothing; the identity is taken for the information matrix"


@dataclass(frozen=True)
class Tag:
    """What stands on a line behind its tag: ids, a measurement and, on EDGE lines, its noise.

    The noise is the upper triangle of an information matrix, row by row, unless `noise` says
    otherwise; with `is_complete` it is the whole matrix. A point has d numbers, or bearing and
    range with DEVIATIONS, and its matrix is d x d; with `is_level` its height is missing in both.
    A rotation in space is a quaternion, its w
    first, and its matrix is 3 x 3. So is that of a direction, which is one of the world, then the
    measured one. With `is_rotation_first` the rows of the rotation in the matrix are before
    those of the translation. A similarity has rotation vector, translation and scale of a
    logarithm, in this order in the matrix, too, and a vertex the four numbers of a camera. The ids
    of PARAMS_SE2OFFSET or PARAMS_SE3OFFSET lines,
    `num_offsets` of them, or those of switches, `num_switches`, may stand between ids and numbers.
    Poses of TORO in space have roll, pitch and yaw in place of a quaternion. The triangle of EDGE2
    is in another order, which `g2o_dialects` settles.
    """

    d: int
    num_ids: int
    is_edge: bool = True
    is_point: bool = False
    to_landmark: bool = False
    num_offsets: int = 0
    num_switches: int = 0
    is_toro: bool = False
    is_rotation: bool = False
    is_direction: bool = False
    is_level: bool = False
    is_rotation_first: bool = False
    is_similarity: bool = False
    is_complete: bool = False
    noise: Noise = Noise.INFORMATION

    @property
    def num_numbers(self) -> int:
        """How many numbers stand behind the ids."""
        if self.noise is Noise.DEVIATIONS:
            return 4
        if not self.is_edge or self.noise is Noise.MISSING:
            return self.num_measured
        size = self._side**2 if self.is_complete else self._side * (self._side + 1) // 2
        return self.num_measured + size

    @property
    def num_other_ids(self) -> int:
        """How many ids may stand behind those of the poses."""
        return self.num_offsets + self.num_switches

    @property
    def has_matrix(self) -> bool:
        """Whether a line has the triangle of a matrix."""
        return self.is_edge and self.noise in (Noise.INFORMATION, Noise.COVARIANCE)

    @property
    def is_position(self) -> bool:
        """Whether a line measures a position in the frame of the world."""
        return self.is_edge and self.is_point and self.num_ids == 1

    def problem(self, numbers: Array) -> tuple[BoolArray, str]:
        """Return which lines, (n, num_numbers), have a noise that is none, (n,), and why."""
        if self.noise is Noise.DEVIATIONS:
            is_wrong = np.asarray((numbers[:, 1:] <= 0.0).any(axis=1))
            problem = "range and standard deviations are not all positive; correct or remove it"
            return is_wrong, problem
        if self.is_direction:
            is_wrong = np.asarray(~numbers[:, :3].any(axis=1) | ~numbers[:, 3:6].any(axis=1))
            return is_wrong, "a direction of length zero is none; correct or remove it"
        if self.is_similarity:
            is_scaled = np.abs(numbers[:, 6]) > _SCALE
            return is_scaled, "a similarity with a scale other than 1; give the poses without scale"
        if self.noise is Noise.COVARIANCE:
            covariances = numbers[:, self.num_measured + triangle_places(self._side)]
            is_covariance = are_definite(covariances, SINGULAR)
            problem = (
                "the covariance matrix is not positive definite, and no sensor is without error: "
                "give its variances, or remove it"
            )
            return ~is_covariance, problem
        return np.zeros(len(numbers), dtype=bool), ""

    def weights_error(self, numbers: Array) -> Array:
        """Errors of the weights that `rows` makes of lines, (n,) (`weight_errors`).

        They are 0 where the lines have the information itself, and inf where rounding hides it.
        """
        of_direction = np.full(len(numbers), _DIRECTION_ERROR if self.is_direction else 0.0)
        if not self.is_edge or self.noise in (Noise.INFORMATION, Noise.MISSING):
            return of_direction
        places = triangle_places(self._side)
        information = self._with_information(numbers)[:, self.num_measured + places]
        if self.noise is Noise.COVARIANCE:
            covariances = numbers[:, self.num_measured + places]
            error = inverse_error(covariances, information)
        elif self.noise is Noise.SQUARE_ROOT:
            U = np.triu(numbers[:, self.num_measured + places])
            identity = np.tile(np.eye(self._side), (len(U), 1, 1))
            error = entry_error(information, congruence_error(np.abs(U), identity))
        else:
            _, precisions = _polar_precisions(numbers)
            largest = precisions[:, :, None] * np.eye(2)
            everywhere = np.ones((len(numbers), 2, 2))
            error = entry_error(information, congruence_error(everywhere, largest))
        of_blocks = precision_error(information, min(self.d, self._side))
        return both(both(error, of_blocks), of_direction)

    def with_translation_first(self, numbers: Array) -> Array:
        """Numbers on lines whose matrices have the rotation first, with the translation first.

        Matrices of points and of rotations alone stay as they are.
        """
        side = 3 * self.d - 3
        if numbers.shape[1] != self.num_measured + side * (side + 1) // 2:
            return numbers
        return with_translation_first(numbers, self.num_measured, side)

    def triangles_of_complete(self, numbers: Array) -> tuple[Array, BoolArray]:
        """Numbers with the upper triangle of a complete matrix, and whether that is symmetric."""
        side = self._side
        matrices = numbers[:, self.num_measured :].reshape(-1, side, side)
        largest = np.abs(matrices).max(axis=(1, 2), keepdims=True)
        is_same = np.abs(matrices - matrices.mT) <= _ASYMMETRY * largest
        triangles = matrices[:, *np.triu_indices(side)]
        with_triangles = np.concatenate([numbers[:, : self.num_measured], triangles], axis=1)
        return with_triangles, np.asarray(is_same.all(axis=(1, 2)))

    def rows(self, numbers: Array) -> Array:
        """Numbers of lines, (n, num_numbers), as rows of `G2OLines`."""
        numbers = self._with_information(numbers)
        if self.is_similarity:
            numbers = _with_poses(numbers, self.is_edge)
        if self.is_rotation_first:
            numbers = with_translation_first(numbers, 7, 6)
        if self.is_point:
            return self._rows_of_points(numbers)
        if self.is_rotation:
            return _rows_of_rotations(numbers)
        if self.is_direction:
            return _rows_of_directions(numbers)
        if not self.is_toro:
            return numbers
        return _with_quaternions(numbers) if self.d == 3 else numbers

    @property
    def _side(self) -> int:
        """Rows of the information matrix."""
        if self.is_similarity:
            return 7
        if self.is_level:
            return 2
        is_small = self.is_point or self.is_rotation or self.is_direction
        return self.d if is_small else 3 * self.d - 3

    @property
    def num_measured(self) -> int:
        """How many numbers the measurement has."""
        if self.is_rotation:
            return 4
        if self.is_direction:
            return 6
        if self.is_similarity:
            return 7 if self.is_edge else 11
        return 7 if self.has_quaternion else self._side

    @property
    def has_quaternion(self) -> bool:
        """Whether a position and a quaternion, its w last, are measured."""
        return self._side == 6 and not self.is_toro

    def _with_information(self, numbers: Array) -> Array:
        """Numbers with the triangle of an information matrix in place of another noise."""
        if self.noise is Noise.INFORMATION:
            return numbers
        if self.noise is Noise.DEVIATIONS:
            return _cartesian(numbers)
        measured = numbers[:, : self.num_measured]
        if self.noise is Noise.SQUARE_ROOT:
            U = np.triu(numbers[:, self.num_measured + triangle_places(self._side)])
            information = U.mT @ U
        elif self.noise is Noise.MISSING:
            information = np.tile(np.eye(self._side), (len(numbers), 1, 1))
        else:
            covariances = numbers[:, self.num_measured + triangle_places(self._side)]
            information = scaled_inverse(covariances)
        triangles = information[:, *np.triu_indices(self._side)]
        return np.concatenate([measured, triangles], axis=1)

    def _rows_of_points(self, numbers: Array) -> Array:
        """Points as poses that are not turned, with no information on their rotation."""
        d = self.d
        k = 3 * d - 3
        num_measured = 4 * d - 5  # x y theta, or x y z and a quaternion
        num_in_triangle = k * (k + 1) // 2 if self.is_edge else 0
        rows = np.zeros((len(numbers), num_measured + num_in_triangle))
        side = self._side
        rows[:, :side] = numbers[:, :side]
        rows[:, num_measured - 1] = d - 2  # the angle 0, or the w of the quaternion 0 0 0 1
        # Entries of the pose's triangle that belong to the block of the translation. Row by row
        # they are in the order of the point's own triangle.
        _, column = np.triu_indices(k)
        in_block = np.flatnonzero(column < side)
        if self.is_edge:
            rows[:, num_measured + in_block] = numbers[:, side:]
        return rows


def with_translation_first(numbers: Array, num_measured: int, side: int) -> Array:
    """Numbers, (k, num_measured + side (side + 1) / 2), with the translation first in matrices."""
    places = triangle_places(side)
    num_turns = 1 if side == 3 else 3
    order = [*range(num_turns, side), *range(num_turns)]
    rows, columns = np.triu_indices(side)
    moved = num_measured + places[np.ix_(order, order)][rows, columns]
    return np.concatenate([numbers[:, :num_measured], numbers[:, moved]], axis=1)


def _with_poses(numbers: Array, is_edge: bool) -> Array:
    """Numbers of poses, (k, 7 or 28), for logarithms of similarities of scale 1.

    The translation is V u of its logarithm u, V = I + (1 - cos a) / a^2 hat(w) + (a - sin a) / a^3
    hat(w)^2 for the angle a of w. What the matrix says of the scale, which is known, is left out.
    """
    w, u = numbers[:, :3], numbers[:, 3:6]
    angle = np.linalg.norm(w, axis=1)[:, None]
    is_small = angle < 1e-4
    safe = np.where(is_small, 1.0, angle)
    first = np.where(is_small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(is_small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    once = np.cross(w, u)
    t = u + first * once + second * np.cross(w, once)
    poses = np.concatenate([t, quaternions_from_rotations(exp_map(w))], axis=1)
    if not is_edge:
        return poses
    in_pose = triangle_places(7)[:6, :6][np.triu_indices(6)]
    return np.concatenate([poses, numbers[:, 7 + in_pose]], axis=1)


def _with_quaternions(numbers: Array) -> Array:
    """Rows of TORO in space, with a quaternion in place of roll, pitch and yaw."""
    x_axis, y_axis, z_axis = np.eye(3)
    roll = exp_map(numbers[:, 3, None] * x_axis)
    pitch = exp_map(numbers[:, 4, None] * y_axis)
    yaw = exp_map(numbers[:, 5, None] * z_axis)
    R = yaw @ pitch @ roll
    quaternions = quaternions_from_rotations(R)
    translations = numbers[:, :3]
    triangles = numbers[:, 6:]
    return np.concatenate([translations, quaternions, triangles], axis=1)


def _rows_of_rotations(numbers: Array) -> Array:
    """Rotations w x y z as rows of poses, with no information on their positions."""
    rows = np.zeros((len(numbers), 28))
    rows[:, 3:7] = numbers[:, [1, 2, 3, 0]]
    row_of_triangle, _ = np.triu_indices(6)
    in_block = np.flatnonzero(row_of_triangle >= 3)
    rows[:, 7 + in_block] = numbers[:, 4:]
    return rows


def _rows_of_directions(numbers: Array) -> Array:
    """Directions n of the world, measured as b, as rows of poses, (k, 28).

    The rotation of a row takes b to n along the shortest way. For R this rotation times
    exp(hat(w)), R^T n - b is b x w to first order, so that I_rr = hat(b)^T I hat(b). Where I is a
    multiple of the identity, chi2 of a rotation with this I_rr is that of the direction.
    """
    n = numbers[:, :3] / np.linalg.norm(numbers[:, :3], axis=1, keepdims=True)
    b = numbers[:, 3:6] / np.linalg.norm(numbers[:, 3:6], axis=1, keepdims=True)
    I = np.zeros((len(numbers), 3, 3))  # noqa: E741 - the name of information matrices
    rows, columns = np.triu_indices(3)
    I[:, rows, columns] = numbers[:, 6:]
    I[:, columns, rows] = numbers[:, 6:]
    across = hat(b)
    information = across.mT @ I @ across
    quaternions = np.concatenate([np.cross(b, n), 1.0 + np.sum(b * n, axis=1)[:, None]], axis=1)
    # Opposite directions: half a turn about any axis across b.
    is_opposite = np.linalg.norm(quaternions, axis=1) < 1e-7
    axes = across[np.arange(len(b)), :, np.argmin(np.abs(b), axis=1)]
    quaternions[is_opposite, :3] = axes[is_opposite]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    triangle = information[:, rows, columns]
    return _rows_of_rotations(np.concatenate([quaternions[:, [3, 0, 1, 2]], triangle], axis=1))


def _cartesian(numbers: Array) -> Array:
    """Points (x, y) and the triangles of their information, (n, 5), of points in polar coordinates.

    A row has bearing, range and their standard deviations. To first order the point errs along the
    line of sight by the error of the range, and across it by the range times that of the bearing.
    The information is therefore R(bearing) diag(1 / std_range^2, 1 / (range std_bearing)^2)
    R(bearing)^T, in the axes of the pose. This is an approximation: the exact density is bent.
    """
    to_pose, precisions = _polar_precisions(numbers)
    distance = numbers[:, 1]
    points = distance[:, None] * to_pose[:, :, 0]
    information = (to_pose * precisions[:, None, :]) @ to_pose.mT
    triangle = information[:, *np.triu_indices(2)]
    return np.concatenate([points, triangle], axis=1)


def _polar_precisions(numbers: Array) -> tuple[Array, Array]:
    """Rotations from the line of sight to the pose, (n, 2, 2), and precisions along it, (n, 2)."""
    bearing, distance, bearing_std, range_std = numbers.T
    deviations = np.stack([range_std, distance * bearing_std], axis=1)
    with np.errstate(over="ignore", divide="ignore"):
        precisions = np.minimum(deviations**-2.0, LARGEST)
    return exp_map(bearing[:, None]), precisions


# Tags that are read and written. EDGE_SE3_XYZ_PRIOR is a position of the pose itself.
G2O_TAGS = {
    "VERTEX_SE2": Tag(2, 1, is_edge=False),
    "VERTEX_SE3:QUAT": Tag(3, 1, is_edge=False),
    "EDGE_SE2": Tag(2, 2),
    "EDGE_SE3:QUAT": Tag(3, 2),
    "VERTEX_XY": Tag(2, 1, is_edge=False, is_point=True, to_landmark=True),
    "VERTEX_TRACKXYZ": Tag(3, 1, is_edge=False, is_point=True, to_landmark=True),
    "EDGE_SE2_XY": Tag(2, 2, is_point=True, to_landmark=True),
    "EDGE_SE3_TRACKXYZ": Tag(3, 2, is_point=True, to_landmark=True, num_offsets=1),
    "EDGE_PRIOR_SE2": Tag(2, 1),
    "EDGE_SE3_PRIOR": Tag(3, 1, num_offsets=1),
    "EDGE_PRIOR_SE2_XY": Tag(2, 1, is_point=True),
    "EDGE_SE3_XYZ_PRIOR": Tag(3, 1, is_point=True, num_offsets=1),
    "EDGE_PRIOR_XY": Tag(2, 1, is_point=True, to_landmark=True),
    "EDGE_POINTXYZ_PRIOR": Tag(3, 1, is_point=True, to_landmark=True),
}
# Tags that are only read.
OTHER_TAGS = {
    "EDGE_SE2_OFFSET": Tag(2, 2, num_offsets=2),
    "EDGE_SE3_OFFSET": Tag(3, 2, num_offsets=2),
    "EDGE_SE2_POINTXY_OFFSET": Tag(2, 2, is_point=True, to_landmark=True, num_offsets=1),
    "VERTEX2": Tag(2, 1, is_edge=False, is_toro=True),
    "VERTEX3": Tag(3, 1, is_edge=False, is_toro=True),
    "EDGE2": Tag(2, 2, is_toro=True),
    "EDGE3": Tag(3, 2, is_toro=True),
    "ODOMETRY": Tag(2, 2, noise=Noise.COVARIANCE),
    "LANDMARK": Tag(2, 2, is_point=True, to_landmark=True, noise=Noise.COVARIANCE),
    "BR": Tag(2, 2, is_point=True, to_landmark=True, noise=Noise.DEVIATIONS),
    "EDGE_SE2_SWITCHABLE": Tag(2, 2, num_switches=1),
    "EDGE_SE3_SWITCHABLE": Tag(3, 2, num_switches=1),
    "EDGE_SE3_PRIORQUAT": Tag(3, 1, is_rotation=True),
    "EDGE_SE3_PRIORVEC": Tag(3, 1, is_direction=True),
    "EDGE_SE3_PRIORXY": Tag(3, 1, is_point=True, is_level=True),
    "EDGE_SE3:EXPMAP": Tag(3, 2, is_rotation_first=True),
    "VERTEX_SIM3:EXPMAP": Tag(3, 1, is_edge=False, is_similarity=True),
    "EDGE_SIM3:EXPMAP": Tag(3, 2, is_similarity=True, is_rotation_first=True),
}
_PLAIN_TAGS = {**G2O_TAGS, **OTHER_TAGS}


def _with_variants() -> list[str]:
    """Tags whose lines may end behind the measurement, or have the complete matrix."""
    names = []
    for name, tag in _PLAIN_TAGS.items():
        is_plain = tag.is_edge and tag.noise is Noise.INFORMATION and tag.num_other_ids == 0
        if is_plain and (name == "EDGE3" or not tag.is_toro):
            names.append(name)
    return names


# What such a line is. The blanks keep these names apart from all tags in files.
SHORT_TAGS = {name: f"{name} without a matrix" for name in _with_variants()}
COMPLETE_TAGS = {name: f"{name} with a complete matrix" for name in _with_variants()}
# Tags of the lines of tables that have covariance matrices.
COVARIANCE_TAGS = {
    "EDGE_SE2": "EDGE_SE2:COVARIANCE",
    "EDGE_SE3:QUAT": "EDGE_SE3:QUAT:COVARIANCE",
    "EDGE_SE3:EULER": "EDGE_SE3:EULER:COVARIANCE",
}
TAGS = {
    **_PLAIN_TAGS,
    "EDGE_SE2:COVARIANCE": Tag(2, 2, noise=Noise.COVARIANCE),
    "EDGE_SE3:QUAT:COVARIANCE": Tag(3, 2, noise=Noise.COVARIANCE),
    "EDGE_SE3:EULER:COVARIANCE": Tag(3, 2, is_toro=True, noise=Noise.COVARIANCE),
    **{SHORT_TAGS[name]: replace(_PLAIN_TAGS[name], noise=Noise.MISSING) for name in SHORT_TAGS},
    **{COMPLETE_TAGS[name]: replace(_PLAIN_TAGS[name], is_complete=True) for name in COMPLETE_TAGS},
}
ALIASES = {
    "EDGE_SE2_PRIOR": "EDGE_PRIOR_SE2",
    "EDGE_PRIOR_SE3": "EDGE_SE3_PRIOR",
    "LANDMARK2": "EDGE_SE2_XY",
    "VERTEX_SE3": "VERTEX_SE3:QUAT",
    "EDGE_SE3": "EDGE_SE3:QUAT",
    "VERTEX_SE3:EXPMAP": "VERTEX_SE3:QUAT",
    "VERTEX_SE3:EULER": "VERTEX3",
    "EDGE_SE3:EULER": "EDGE3",
    "ONLINE_VERTEX_SE2": "VERTEX_SE2",
    "ONLINE_EDGE_SE2": "EDGE_SE2",
    "ONLINE_VERTEX_SE3:QUAT": "VERTEX_SE3:QUAT",
    "ONLINE_EDGE_SE3:QUAT": "EDGE_SE3:QUAT",
    "TUTORIAL_VERTEX_SE2": "VERTEX_SE2",
    "TUTORIAL_EDGE_SE2": "EDGE_SE2",
    "TUTORIAL_VERTEX_POINT_XY": "VERTEX_XY",
    "TUTORIAL_EDGE_SE2_POINT_XY": "EDGE_SE2_POINTXY_OFFSET",
    "TUTORIAL_PARAMS_SE2_OFFSET": "PARAMS_SE2OFFSET",
    "EDGE_SE3:QUAT_SWITCHABLE": "EDGE_SE3_SWITCHABLE",
    "EDGE_SE3_PRIORXYZ": "EDGE_SE3_XYZ_PRIOR",
    "EDGE_SE3_PRIOR_XYZ": "EDGE_SE3_XYZ_PRIOR",
    "EDGE_SE3_PRIOR_XY": "EDGE_SE3_PRIORXY",
    "EDGE_SE3_PRIOR_QUAT": "EDGE_SE3_PRIORQUAT",
    "EDGE_SE2_PRIOR_XY": "EDGE_PRIOR_SE2_XY",
    "EDGE_SE2_XY_PRIOR": "EDGE_PRIOR_SE2_XY",
}
# What lines of these tags are if they have three angles, as many words tell.
WITH_ANGLES = {"VERTEX_SE3": "VERTEX3", "EDGE_SE3": "EDGE3"}
# Tags of the poses of sensors in the frames of their poses.
OFFSET_TAGS = {2: "PARAMS_SE2OFFSET", 3: "PARAMS_SE3OFFSET"}
# Tags of lines that are counted and skipped: what they hold is no measurement between poses.
SKIPPED_TAGS = {
    **dict.fromkeys(("EQUIV",), "they name edges that TORO may contract, and measure nothing"),
    **dict.fromkeys(("VERTEX_SWITCH", "EDGE_SWITCH_PRIOR"), "switches are not used"),
    **dict.fromkeys(("KERNEL", "ROBUST_KERNEL"), "robust kernels are not used"),
    **dict.fromkeys(
        (
            "ROBOTLASER1",
            "ROBOTLASER2",
            "RAWLASER1",
            "FLASER",
            "RLASER",
            "ODOM",
            "PARAM",
            "SYNC",
            "VERTEX_TAG",
            "VERTEX_ELLIPSE",
        ),
        "the data of sensors are not used",
    ),
}
# Tags of measurements that no edge of a pose graph has.
REFUSED_TAGS = {
    "EDGE_RANGE": "a range without a bearing",
    "EDGE_SE3_PLANE": "a plane",
}


def supported_tags() -> str:
    """All tags that are read, in groups and without their aliases, for messages."""
    groups: dict[str, list[str]] = {}
    for name, tag in _PLAIN_TAGS.items():
        groups.setdefault(_group(tag), []).append(name)
    groups["other"] = ["FIX"]
    return "; ".join(f"{group}: {', '.join(names)}" for group, names in groups.items())


def _group(tag: Tag) -> str:
    if not tag.is_edge:
        return "landmarks" if tag.to_landmark else "poses"
    if tag.num_ids == 1:
        return "priors"
    return "edges to landmarks" if tag.to_landmark else "edges"
