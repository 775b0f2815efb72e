"""The tags of g2o files, as g2o, GTSAM and TORO write them, and what stands on their lines.

Numbers are brought into the order of EDGE_SE2 and EDGE_SE3:QUAT.

Sources: `types_slam2d.cpp`, `types_slam3d.cpp` and every `read` and `computeError` there, in g2o
(Kuemmerle et al. 2011). Errors are of (measurement)^-1 x, so that the information of a prior is in
the frame that was measured, that of a position in the frame of the world, and that of a landmark in
the frame of the pose. TORO's page (Grisetti et al. 2007), except that its code and GTSAM take the
first vertex of an edge for the one that observes.
"""

from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.rotations import Array, exp_map, quaternions_from_rotations

# Places of the numbers of an EDGE2 line of TORO: x y theta, then the triangle as ff fs ss rr fr sr.
_TORO = [0, 1, 2, 3, 4, 7, 5, 8, 6]


@dataclass(frozen=True)
class Tag:
    """What stands on a line behind its tag: ids, a measurement and, on EDGE lines, a triangle.

    The triangle is the upper one of an information matrix, row by row. A point has d numbers, and
    its matrix is d x d. An id of a PARAMS_SE3OFFSET line may stand between ids and numbers. Poses
    of TORO in space have roll, pitch and yaw in place of a quaternion.
    """

    d: int
    num_ids: int
    is_edge: bool = True
    is_point: bool = False
    to_landmark: bool = False
    has_offset: bool = False
    is_toro: bool = False

    @property
    def num_numbers(self) -> int:
        """How many numbers stand behind the ids."""
        k = self.d if self.is_point else 3 * self.d - 3
        has_quaternion = k == 6 and not self.is_toro
        num_measured = 7 if has_quaternion else k
        num_in_triangle = k * (k + 1) // 2 if self.is_edge else 0
        return num_measured + num_in_triangle

    def rows(self, numbers: Array) -> Array:
        """Numbers of lines, (n, num_numbers), as rows of `G2OLines`."""
        if self.is_point:
            return self._rows_of_points(numbers)
        if not self.is_toro:
            return numbers
        if self.d == 3:
            return _with_quaternions(numbers)
        if self.is_edge:
            return numbers[:, _TORO]
        return numbers

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


TAGS = {
    "VERTEX_SE2": Tag(2, 1, is_edge=False),
    "VERTEX_SE3:QUAT": Tag(3, 1, is_edge=False),
    "EDGE_SE2": Tag(2, 2),
    "EDGE_SE3:QUAT": Tag(3, 2),
    "VERTEX_XY": Tag(2, 1, is_edge=False, is_point=True, to_landmark=True),
    "VERTEX_TRACKXYZ": Tag(3, 1, is_edge=False, is_point=True, to_landmark=True),
    "EDGE_SE2_XY": Tag(2, 2, is_point=True, to_landmark=True),
    "EDGE_SE3_TRACKXYZ": Tag(3, 2, is_point=True, to_landmark=True, has_offset=True),
    "EDGE_PRIOR_SE2": Tag(2, 1),
    "EDGE_SE3_PRIOR": Tag(3, 1, has_offset=True),
    "EDGE_PRIOR_SE2_XY": Tag(2, 1, is_point=True),
    "EDGE_SE3_XYZ_PRIOR": Tag(3, 1, is_point=True, has_offset=True),
    "EDGE_PRIOR_XY": Tag(2, 1, is_point=True, to_landmark=True),
    "EDGE_POINTXYZ_PRIOR": Tag(3, 1, is_point=True, to_landmark=True),
    "VERTEX2": Tag(2, 1, is_edge=False, is_toro=True),
    "VERTEX3": Tag(3, 1, is_edge=False, is_toro=True),
    "EDGE2": Tag(2, 2, is_toro=True),
    "EDGE3": Tag(3, 2, is_toro=True),
}
ALIASES = {"EDGE_SE2_PRIOR": "EDGE_PRIOR_SE2", "EDGE_PRIOR_SE3": "EDGE_SE3_PRIOR"}
