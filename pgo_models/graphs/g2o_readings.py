"""Other meanings that the lines of a g2o file may have, as people write them.

Nothing in a file says from which end an edge is measured, where the w of a quaternion stands, or
what the unit of an angle is. A `Reading` is one such meaning for all lines of a file.
"""

import enum

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.g2o_tags import Noise, Tag
from pgo_models.graphs.pose_graph import WORLD_ID, IntArray

_MILLIMETRE = 1e-3  # metres


class Reading(enum.Enum):
    """What the lines of a g2o file are taken to mean; all but the first differ from g2o's format.

    Odometry are the edges between poses whose ids follow each other in the file; closures are all
    other edges between poses. Priors and edges to landmarks are not reversed. Lengths in
    millimetres and angles in degrees become metres and radians, and the information matrices are
    then left as they are.
    """

    AS_WRITTEN = "as-written"
    CLOSURES_REVERSED = "closures-reversed"
    ODOMETRY_REVERSED = "odometry-reversed"
    REVERSED = "reversed"
    W_FIRST = "w-first"
    DEGREES = "degrees"
    TORO_ORDER = "toro-order"
    ROTATION_FIRST = "rotation-first"
    COVARIANCES = "covariances"
    SQUARE_ROOTS = "square-roots"
    CLOSURES_IN_MILLIMETRES = "closures-in-millimetres"
    ODOMETRY_IN_MILLIMETRES = "odometry-in-millimetres"
    REVERSED_ROTATION_FIRST = "reversed-rotation-first"
    CLOSURES_REVERSED_ROTATION_FIRST = "closures-reversed-rotation-first"
    REVERSED_W_FIRST = "reversed-w-first"
    CLOSURES_REVERSED_W_FIRST = "closures-reversed-w-first"

    @classmethod
    def of(cls, given: object) -> "Reading":
        """Return a reading that is given itself, or by its value or name in any case.

        A SettingError says which readings there are where the word is that of none.
        """
        word = given.lower().replace("_", "-") if isinstance(given, str) else given
        try:
            return cls(word)
        except ValueError:
            words = ", ".join(reading.value for reading in cls)
            raise SettingError(f"the reading is {given!r:.60}; give one of {words}") from None

    @property
    def text(self) -> str:
        """The reading in words."""
        first, *others = (_TEXTS[part] for part in self.parts)
        return " and ".join([first, *(text.removeprefix("with ") for text in others)])

    @property
    def dimension(self) -> int | None:
        """The dimension, 2 or 3, of the files that can be read like this; None for both."""
        dimensions = {Reading.W_FIRST: 3, Reading.DEGREES: 2, Reading.TORO_ORDER: 2}
        return dimensions.get(self.parts[-1])

    @property
    def parts(self) -> "tuple[Reading, ...]":
        """The readings that it consists of: the reading itself, or the two of a pair."""
        return _PAIRS.get(self, (self,))

    @property
    def is_pair(self) -> bool:
        """Whether two things differ from what is written."""
        return self in _PAIRS

    @property
    def converts_units(self) -> bool:
        """Whether measured numbers are multiplied, so that their last digits have other units."""
        return self is Reading.DEGREES or self in _IN_MILLIMETRES


_TEXTS = {
    Reading.AS_WRITTEN: "as written",
    Reading.CLOSURES_REVERSED: "with the closures reversed",
    Reading.ODOMETRY_REVERSED: "with the odometry reversed",
    Reading.REVERSED: "with all edges reversed",
    Reading.W_FIRST: "with w first in quaternions",
    Reading.DEGREES: "with angles in degrees",
    Reading.TORO_ORDER: "with matrices in TORO's order, ff fs ss rr fr sr",
    Reading.ROTATION_FIRST: "with the rotation first in matrices",
    Reading.COVARIANCES: "with covariances in place of information matrices",
    Reading.SQUARE_ROOTS: "with square roots U of information matrices U^T U",
    Reading.CLOSURES_IN_MILLIMETRES: "with the closures in millimetres",
    Reading.ODOMETRY_IN_MILLIMETRES: "with the odometry in millimetres",
}
_PAIRS = {
    Reading.REVERSED_ROTATION_FIRST: (Reading.REVERSED, Reading.ROTATION_FIRST),
    Reading.CLOSURES_REVERSED_ROTATION_FIRST: (Reading.CLOSURES_REVERSED, Reading.ROTATION_FIRST),
    Reading.REVERSED_W_FIRST: (Reading.REVERSED, Reading.W_FIRST),
    Reading.CLOSURES_REVERSED_W_FIRST: (Reading.CLOSURES_REVERSED, Reading.W_FIRST),
}
ROTATION_FIRST = {reading for reading in Reading if Reading.ROTATION_FIRST in reading.parts}
_REVERSED = {Reading.REVERSED, Reading.CLOSURES_REVERSED, Reading.ODOMETRY_REVERSED}
_IN_MILLIMETRES = {Reading.CLOSURES_IN_MILLIMETRES, Reading.ODOMETRY_IN_MILLIMETRES}


def noise_as(reading: Reading, tag: Tag) -> Noise:
    """What the matrices on lines of a tag are."""
    if tag.has_matrix and reading is Reading.SQUARE_ROOTS:
        return Noise.SQUARE_ROOT
    if tag.has_matrix and reading is Reading.COVARIANCES:
        return Noise.COVARIANCE
    return tag.noise


def numbers_as(reading: Reading, tag: Tag, numbers: Array) -> Array:
    """Numbers on lines of a tag, (n, num_numbers), with quaternions and angles as g2o has them."""
    if reading in ROTATION_FIRST and tag.has_matrix and not tag.is_toro:
        numbers = tag.with_translation_first(numbers)
    if Reading.W_FIRST in reading.parts and tag.has_quaternion:
        w_last = [*range(3), 4, 5, 6, 3, *range(7, numbers.shape[1])]
        return np.asarray(numbers[:, w_last])
    has_heading = tag.d == 2 and not tag.is_point
    if reading is Reading.DEGREES and has_heading:
        numbers = numbers.copy()
        numbers[:, 2] = np.deg2rad(numbers[:, 2])
    return numbers


def edges_as(
    reading: Reading, ids: IntArray, rows: Array, d: int, to_landmark: BoolArray
) -> tuple[IntArray, Array]:
    """Ids, (m, 2), and rows of all EDGE lines of a file, read as `reading` says.

    `to_landmark`, (m,), says which edges end at a landmark.
    """
    which = reading.parts[0]
    if which not in _REVERSED | _IN_MILLIMETRES:
        return ids, rows
    between_poses = (ids[:, 0] != WORLD_ID) & ~to_landmark
    chosen = between_poses
    if which is not Reading.REVERSED:
        is_odometry = _joins_neighbours(ids, between_poses)
        of_odometry = which in (Reading.ODOMETRY_REVERSED, Reading.ODOMETRY_IN_MILLIMETRES)
        chosen = between_poses & (is_odometry == of_odometry)
    if which in _REVERSED:
        return np.where(chosen[:, None], ids[:, ::-1], ids), rows
    rows = rows.copy()
    rows[chosen, :d] *= _MILLIMETRE
    return ids, rows


def _joins_neighbours(ids: IntArray, between_poses: BoolArray) -> BoolArray:
    """Whether edges join poses whose ids follow each other among those that edges name, (m,)."""
    known = np.unique(ids[between_poses])
    places = np.searchsorted(known, ids)
    return np.asarray(np.abs(places[:, 0] - places[:, 1]) == 1)
