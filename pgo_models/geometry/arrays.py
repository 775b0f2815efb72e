"""Numbers as frozen objects hold them: checked, never cast silently, in read-only arrays of their own."""

import operator
from contextlib import suppress
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array

from pgo_models.errors import GraphError, PGOError
from pgo_models.geometry.rotations import Array

T = TypeVar("T", bound="NDArray[Any] | csc_array | csr_array")

_EXACT = 2.0**53  # from here on a float may stand for another whole number than the one that was meant


class ReadOnly:
    """Base of frozen objects with arrays: out of a pickle or a deep copy, these come back read-only, too."""

    def __setstate__(self, state: dict[str, object]) -> None:
        for value in state.values():
            if isinstance(value, np.ndarray):
                read_only(value)
        self.__dict__.update(state)


def read_only(values: T) -> T:
    """The same array or sparse matrix, whose entries cannot be changed from now on."""
    arrays = (values,) if isinstance(values, np.ndarray) else (values.data, values.indices, values.indptr)
    for array in arrays:
        array.flags.writeable = False
    return values


def real_array(values: object, name: str, error: type[PGOError] = GraphError) -> Array:
    """Real numbers as doubles, in a read-only array of their own; one that is such an array already is not copied.

    Raises `error` when they are complex, booleans or words, or are no array.
    """
    array = _numbers(values, name, "real numbers", error)
    return read_only(np.array(array, dtype=np.float64, order="C")) if _is_shared(array, np.float64) else array


def whole_array(values: object, name: str, error: type[PGOError] = GraphError) -> NDArray[np.int64]:
    """Whole numbers of 64 bits, in a read-only array of their own; floats must hold them exactly.

    Raises `error` as `real_array`; also for a fraction, nan, or a float so large that it may stand for several numbers.
    """
    array = _numbers(values, name, "whole numbers", error)
    if not array.ndim:
        raise error(f"{name} is the number {array}; give an array")
    with np.errstate(invalid="ignore"):
        wrong = array.astype(np.int64) != array
    if array.dtype.kind == "f":
        wrong |= ~(np.abs(array) < _EXACT)
    if wrong.any():
        raise error(f"{name} has {array[wrong][0]!s} among them; give whole numbers, as integers of 64 bits")
    return read_only(np.array(array, dtype=np.int64, order="C")) if _is_shared(array, np.int64) else array


def whole_number(value: object, name: str, error: type[PGOError] = GraphError) -> int:
    """Whole number that is given as an integer; raises `error` for a float, even a whole one, True, and all else."""
    with suppress(TypeError):  # which is the check
        if not isinstance(value, bool | np.bool_):
            return operator.index(value)  # type: ignore[arg-type]
    raise error(f"{name} is {value!r:.60}; give a whole number")


def triangle_places(side: int) -> NDArray[np.int64]:
    """Place of every entry of a symmetric matrix in its upper triangle, row by row, (side, side)."""
    place = np.zeros((side, side), dtype=np.int64)
    rows, columns = np.triu_indices(side)
    place[rows, columns] = place[columns, rows] = np.arange(len(rows))
    return place


def _numbers(values: object, name: str, wanted: str, error: type[PGOError]) -> NDArray[Any]:
    try:
        array = np.asarray(values)
    except ValueError as reason:  # rows of several lengths
        raise error(f"{name} is no array: {reason}") from reason
    if array.dtype.kind not in "fiu":
        raise error(f"{name} must be {wanted}, got type {array.dtype}")
    return array


def _is_shared(array: NDArray[Any], dtype: type[np.generic]) -> bool:
    """Whether an array must be copied: someone else may write to it, or it has another type."""
    return array.dtype != dtype or array.flags.writeable or not array.flags.owndata
