"""The tags of g2o files, as g2o, GTSAM, TORO and iSAM write them, and what stands on their lines.

Numbers are brought into the order of EDGE_SE2 and EDGE_SE3:QUAT.

Sources: `types_slam2d.cpp`, `types_slam3d.cpp` and every `read` and `computeError` there, in g2o
(Kuemmerle et al. 2011). Errors are of (measurement)^-1 x, so that the information of a prior is in
the frame that was measured, that of a position in the frame of the world, and that of a landmark in
the frame of the pose. TORO's page (Grisetti et al. 2007), except that its code and GTSAM take the
first vertex of an edge for the one that observes. `load2D` of GTSAM, for ODOMETRY, LANDMARK and BR.
`Loader.cpp` of iSAM (Kaess et al. 2012), whose matrices are upper triangular square roots U of the
information U^T U, by rows, and which takes the identity where EDGE3 has none.
"""

import enum
from dataclasses import dataclass

import numpy as np

from pgo_models.files import LARGEST
from pgo_models.geometry.arrays import triangle_places
from pgo_models.geometry.rotations import Array, BoolArray, exp_map, quaternions_from_rotations
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

# Places of the numbers of an EDGE2 line of TORO: x y theta, then the triangle as ff fs ss rr fr sr.
_TORO = [0, 1, 2, 3, 4, 7, 5, 8, 6]


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
    otherwise. A point has d numbers, or bearing and range with DEVIATIONS, and its matrix is d x d.
    The ids of PARAMS_SE2OFFSET or PARAMS_SE3OFFSET lines, `num_offsets` of them, may stand between
    ids and numbers. Poses of TORO in space have roll, pitch and yaw in place of a quaternion.
    """

    d: int
    num_ids: int
    is_edge: bool = True
    is_point: bool = False
    to_landmark: bool = False
    num_offsets: int = 0
    is_toro: bool = False
    noise: Noise = Noise.INFORMATION

    @property
    def num_numbers(self) -> int:
        """How many numbers stand behind the ids."""
        if self.noise is Noise.DEVIATIONS:
            return 4
        has_triangle = self.is_edge and self.noise is not Noise.MISSING
        num_in_triangle = self._side * (self._side + 1) // 2 if has_triangle else 0
        return self.num_measured + num_in_triangle

    @property
    def has_matrix(self) -> bool:
        """Whether a line has the triangle of a matrix."""
        return self.is_edge and self.noise in (Noise.INFORMATION, Noise.COVARIANCE)

    @property
    def is_position(self) -> bool:
        """Whether a line measures a position in the frame of the world."""
        return self.is_point and self.num_ids == 1

    def problem(self, numbers: Array) -> tuple[BoolArray, str]:
        """Return which lines, (n, num_numbers), have a noise that is none, (n,), and why."""
        if self.noise is Noise.DEVIATIONS:
            is_wrong = np.asarray((numbers[:, 1:] <= 0.0).any(axis=1))
            problem = "range and standard deviations are not all positive; correct or remove it"
            return is_wrong, problem
        if self.noise is Noise.COVARIANCE:
            covariances = numbers[:, self.num_measured + triangle_places(self._side)]
            is_covariance = are_definite(covariances, SINGULAR)
            problem = "the covariance matrix is not positive definite; correct or remove it"
            return ~is_covariance, problem
        return np.zeros(len(numbers), dtype=bool), ""

    def weights_error(self, numbers: Array) -> Array:
        """Errors of the weights that `rows` makes of lines, (n,) (`weight_errors`).

        They are 0 where the lines have the information itself, and inf where rounding hides it.
        """
        if not self.is_edge or self.noise in (Noise.INFORMATION, Noise.MISSING):
            return np.zeros(len(numbers))
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
        return both(error, precision_error(information, self.d))

    def rows(self, numbers: Array) -> Array:
        """Numbers of lines, (n, num_numbers), as rows of `G2OLines`."""
        numbers = self._with_information(numbers)
        if self.is_point:
            return self._rows_of_points(numbers)
        if not self.is_toro:
            return numbers
        if self.d == 3:
            return _with_quaternions(numbers)
        if self.is_edge:
            return numbers[:, _TORO]
        return numbers

    @property
    def _side(self) -> int:
        """Rows of the information matrix."""
        return self.d if self.is_point else 3 * self.d - 3

    @property
    def num_measured(self) -> int:
        """How many numbers the measurement has."""
        has_quaternion = self._side == 6 and not self.is_toro
        return 7 if has_quaternion else self._side

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
        rows[:, :d] = numbers[:, :d]
        rows[:, num_measured - 1] = d - 2  # the angle 0, or the w of the quaternion 0 0 0 1
        # Entries of the pose's triangle that belong to the d x d block of the translation. Row by
        # row they are in the order of the point's own triangle.
        _, column = np.triu_indices(k)
        in_block = np.flatnonzero(column < d)
        if self.is_edge:
            rows[:, num_measured + in_block] = numbers[:, d:]
        return rows


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


def _cartesian(numbers: Array) -> Array:
    """Points (x, y) and the triangles of their information, (n, 5), of points in polar coordinates.

    A row has bearing, range and their standard deviations. To first order the error of the point is
    that of the range along the line of sight, and range times that of the bearing across it. The
    information is therefore R(bearing) diag(1 / std_range^2, 1 / (range std_bearing)^2)
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
}
# What a line of the tag is when it ends behind the measurement. The blanks keep these names apart
# from all tags in files.
SHORT_TAGS = {"EDGE3": "EDGE3 without a matrix"}
TAGS = {
    **G2O_TAGS,
    **OTHER_TAGS,
    SHORT_TAGS["EDGE3"]: Tag(3, 2, is_toro=True, noise=Noise.MISSING),
}
ALIASES = {
    "EDGE_SE2_PRIOR": "EDGE_PRIOR_SE2",
    "EDGE_PRIOR_SE3": "EDGE_SE3_PRIOR",
    "LANDMARK2": "EDGE_SE2_XY",
}
TAGS_IN_FILES = (*G2O_TAGS, *OTHER_TAGS, *ALIASES, "FIX", "EQUIV")
# Tags of the poses of sensors in the frames of their poses.
OFFSET_TAGS = {2: "PARAMS_SE2OFFSET", 3: "PARAMS_SE3OFFSET"}
# Tags of measurements that are neither poses nor points relative to a pose.
REFUSED_TAGS = {"EDGE_RANGE": "a range without a bearing, which no edge of a pose graph has"}
