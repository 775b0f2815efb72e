"""Rows of the numbers on VERTEX and EDGE lines of g2o: poses and information matrices of them."""

from collections.abc import Iterator

import numpy as np

from pgo_models.geometry.arrays import triangle_places
from pgo_models.geometry.rotations import (
    Array,
    exp_map,
    log_map,
    quaternions_from_rotations,
    rotations_from_quaternions,
)
from pgo_models.graphs.origin import decimal_sums
from pgo_models.graphs.pose_graph import IntArray

_ROWS_AT_A_TIME = 2**14  # rows of numbers that are turned into text at a time


def poses_of(d: int, numbers: Array) -> tuple[Array, Array]:
    """Rotations (n, d, d) and translations (n, d) of rows of `G2OLines`.

    The rows open with x y theta, or x y z qx qy qz qw.
    """
    t = numbers[:, :d].copy()
    if d == 2:
        angles = numbers[:, 2:3]
        return exp_map(angles), t
    quaternions = numbers[:, 3:7]
    return rotations_from_quaternions(quaternions), t


def measurements_of(d: int, edges: Array) -> Array:
    """The measured numbers of EDGE rows, which are like rows of vertices."""
    return edges[:, : _num_measured(d)]


def information_of(d: int, edges: Array) -> Array:
    """Information matrices (m, k, k) of EDGE rows, k = 3 in the plane and 6 in space."""
    k = 3 if d == 2 else 6
    columns = _num_measured(d) + triangle_places(k)
    return np.asarray(edges[:, columns])


def numbers_of(R: Array, t: Array) -> Array:
    """Rows x y theta, or x y z qx qy qz qw, of rotations and translations: `poses_of` backwards."""
    rotations = log_map(R) if t.shape[1] == 2 else quaternions_from_rotations(R)
    return np.concatenate([t, rotations], axis=1)


def lines_of(
    tag: str, ids: IntArray, numbers: Array, offset: str = "", origin: Array | None = None
) -> Iterator[str]:
    """Lines `tag ids offset numbers`; `repr` of a double gives the digits that bring it back.

    An origin, (d,), is added to the first numbers, in decimals.
    """
    far = [] if origin is None else origin.tolist()
    for first in range(0, len(ids), _ROWS_AT_A_TIME):
        rows = slice(first, first + _ROWS_AT_A_TIME)
        ids_of_rows = ids[rows].tolist()
        numbers_of_rows = numbers[rows].tolist()
        for row_ids, row in zip(ids_of_rows, numbers_of_rows, strict=True):
            words_of_ids = " ".join(map(str, row_ids))
            sums = decimal_sums(row[: len(far)], far)
            words = " ".join([*sums, *map(repr, row[len(far) :])])
            yield f"{tag} {words_of_ids} {offset}{words}\n"


def _num_measured(d: int) -> int:
    """How many numbers stand for a pose."""
    return 3 if d == 2 else 7
