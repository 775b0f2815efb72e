"""Numbers as frozen objects hold them: checked, never cast silently, in read-only arrays."""

import math
import operator
from contextlib import suppress
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array

from pgo_models.errors import GraphError, PGOError, SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.summaries import Summarised

T = TypeVar("T", bound="NDArray[Any] | csc_array | csr_array")

# From here on a float may stand for another whole number than the one that was meant.
_EXACT = 2.0**53


class ReadOnly(Summarised):
    """Base of frozen objects with arrays, which stay read-only in a pickle or a deep copy.

    Cached properties are not copied: the copy computes them when they are asked for.
    """

    def __getstate__(self) -> dict[str, object]:
        owner = type(self)
        state = {}
        for name, value in self.__dict__.items():
            if not isinstance(getattr(owner, name, None), cached_property):
                state[name] = value
        return state

    def __setstate__(self, state: dict[str, object]) -> None:
        for value in state.values():
            if isinstance(value, np.ndarray):
                read_only(value)
        self.__dict__.update(state)


def read_only(values: T) -> T:
    """Return the array or sparse matrix, whose entries cannot be changed from now on."""
    if isinstance(values, np.ndarray):
        values.flags.writeable = False
        return values
    for array in (values.data, values.indices, values.indptr):
        array.flags.writeable = False
    return values


def real_array(values: object, name: str, error: type[PGOError] = GraphError) -> Array:
    """Real numbers as doubles, in a read-only array of their own.

    An array that is so already is not copied. Raises `error` when the numbers are complex, booleans
    or words, or are no array.
    """
    array = _numbers(values, name, "real numbers", error)
    if not _needs_copy(array, np.float64):
        return array
    return read_only(np.array(array, dtype=np.float64, order="C"))


def whole_array(values: object, name: str, error: type[PGOError] = GraphError) -> NDArray[np.int64]:
    """Whole numbers of 64 bits, in a read-only array of their own; floats must hold them exactly.

    Raises `error` as `real_array`; also for a fraction, nan, or a float so large that it may stand
    for several numbers.
    """
    array = _numbers(values, name, "whole numbers", error)
    if not array.ndim:
        raise error(f"{name} is the number {array}; give an array")
    with np.errstate(invalid="ignore"):
        is_wrong = array.astype(np.int64) != array
    if array.dtype.kind == "f":
        is_wrong |= ~(np.abs(array) < _EXACT)
    if is_wrong.any():
        wrong = array[is_wrong][0]
        raise error(f"{name} has {wrong!s} among them; give whole numbers, as integers of 64 bits")
    if not _needs_copy(array, np.int64):
        return array
    return read_only(np.array(array, dtype=np.int64, order="C"))


def check_shape(values: NDArray[Any], shape: tuple[int, ...], name: str) -> None:
    """Raise a SettingError unless an array has this shape."""
    if values.shape != shape:
        raise SettingError(f"{name} has shape {values.shape}; give {shape}")


def whole_number(value: object, name: str, error: type[PGOError] = GraphError) -> int:
    """Whole number that is given as an integer.

    Raises `error` for a float, even a whole one, for True and False, and for all else.
    """
    with suppress(TypeError):  # which operator.index raises for what is no integer
        if not isinstance(value, bool | np.bool_):
            return operator.index(value)  # type: ignore[arg-type]
    raise error(f"{name} is {value!r:.60}; give a whole number")


def triangle_places(side: int) -> NDArray[np.int64]:
    """Place of every entry of a symmetric matrix in its upper triangle, read row by row.

    The places are a symmetric matrix, (side, side).
    """
    rows, columns = np.triu_indices(side)
    numbers = np.arange(len(rows))
    place = np.zeros((side, side), dtype=np.int64)
    place[rows, columns] = numbers
    place[columns, rows] = numbers
    return place


def _numbers(values: object, name: str, wanted: str, error: type[PGOError]) -> NDArray[Any]:
    """Array of integers or real numbers; raises `error` for others.

    What has `as_matrix`, as `Rotation` of scipy, stands for its matrices.
    """
    if callable(as_matrix := getattr(values, "as_matrix", None)):
        values = as_matrix()
    try:
        array = np.asarray(values)
    except ValueError as reason:  # rows of several lengths
        raise error(f"{name} is no array: {reason}") from reason
    if array.dtype.kind not in "fiu":
        raise error(f"{name} must be {wanted}, got type {array.dtype}")
    return array


def _needs_copy(array: NDArray[Any], dtype: type[np.generic]) -> bool:
    """Whether an array has another type, or others may write to it."""
    return array.dtype != dtype or array.flags.writeable or not array.flags.owndata


def inner_products(A: Array, B: Array) -> Array:
    """Inner products <A_e, B_e>, (m,), of arrays (m, ..) of one shape.

    For many small blocks this takes a fraction of the time of a product and a sum over axes.
    """
    shape = (len(A), math.prod(A.shape[1:]))  # there may be no block
    return np.asarray(np.einsum("mk,mk->m", A.reshape(shape), B.reshape(shape)))


def block_norms(A: Array) -> Array:
    """Frobenius norms ||A_e||, (m,), of blocks (m, ..)."""
    return np.asarray(np.sqrt(inner_products(A, A)))
