"""Settings that hold an array and compare by value all the same."""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import numpy as np


class ValueEquality:
    """Base of frozen dataclasses with arrays, declared with `eq=False`: equal where all fields are.

    A dataclass generates an equality that asks for the truth of an array, and a hash that asks for
    its hash. Arrays have neither.
    """

    __slots__ = ()

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return _values(self) == _values(other)

    def __hash__(self) -> int:
        return hash(_values(self))


def _values(settings: object) -> tuple[object, ...]:
    """Values of all fields in order, where arrays are replaced by what compares."""
    fields = dataclasses.fields(cast(Any, settings))
    return tuple(_comparable(getattr(settings, field.name)) for field in fields)


def _comparable(value: object) -> object:
    """Shape, type and bytes of an array; other values as they are."""
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, value.tobytes()
    return value
