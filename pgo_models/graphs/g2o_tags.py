"""The tags of g2o files, as g2o, GTSAM and TORO write them, and their numbers in the order of EDGE_SE2, EDGE_SE3:QUAT.

Sources: `types_slam2d.cpp`, `types_slam3d.cpp` and every `read` and `computeError` there, in g2o (Kuemmerle et al.
2011): errors are of (measurement)^-1 x, so that the information of a prior is in the frame measured, that of a position
in the world's, that of a landmark in the pose's. TORO's page (Grisetti et al. 2007), but that its code and GTSAM take
the first vertex of an edge for the one that observes.
"""

from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.rotations import Array, exp_map, quaternions_from_rotations

_TORO = [0, 1, 2, 3, 4, 7, 5, 8, 6]  # of EDGE2: x y theta, then the triangle as ff fs ss rr fr sr


@dataclass(frozen=True)
class Tag:
    """What stands on a line behind its tag: `num_ids` ids, the measurement, and on EDGE lines a triangle.

    A point is d numbers, and its information d x d. Between ids and numbers may stand the id of an offset, of a
    PARAMS_SE3OFFSET line. TORO has roll, pitch and yaw in space.
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
        return (7 if k == 6 and not self.is_toro else k) + self.is_edge * k * (k + 1) // 2

    def rows(self, numbers: Array) -> Array:
        """Numbers of lines, (n, num_numbers), as rows of `G2OLines`."""
        d, k = self.d, 3 * self.d - 3
        if self.is_toro and d == 3:
            roll, pitch, yaw = (exp_map(numbers[:, 3 + a, None] * np.eye(3)[a]) for a in range(3))
            q = quaternions_from_rotations(yaw @ pitch @ roll)
            return np.concatenate([numbers[:, :3], q, numbers[:, 6:]], axis=1)
        if not self.is_point:
            return numbers[:, _TORO] if self.is_toro and self.is_edge else numbers
        triangle = np.flatnonzero(np.triu_indices(k)[1] < d)
        found = np.zeros((len(numbers), 4 * d - 5 + self.is_edge * k * (k + 1) // 2))
        found[:, 4 * d - 6] = d - 2  # the angle 0, or the quaternion 0 0 0 1
        found[:, np.append(np.arange(d), 4 * d - 5 + triangle[: numbers.shape[1] - d])] = numbers
        return found


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
