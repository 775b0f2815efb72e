"""Whether what arrives has the types that the fields of a record declare.

The annotations of a record are what its methods rely on. Numbers of arrays are not looked at.
"""

from __future__ import annotations

import types
import typing
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, Protocol

import numpy as np


def check_fields(kind: type, fields: Mapping[str, object]) -> None:
    """Raise a TypeError for a value that is not of the type that its field of a record declares."""
    declared = _declared(kind)
    for name, value in fields.items():
        if name in declared and not _is_of(value, declared[name]):
            raise TypeError(f"{kind.__name__}.{name} is a {type(value).__name__}")


@cache
def _declared(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind)


def _is_of(value: object, declared: Any) -> bool:  # noqa: ANN401 - an annotation
    """Whether a value is of an annotation; where that is a protocol, any value is."""
    origin = typing.get_origin(declared)
    arguments = typing.get_args(declared)
    if origin in (typing.Union, types.UnionType):
        return any(_is_of(value, each) for each in arguments)
    if origin is tuple:
        return isinstance(value, tuple) and _items_are_of(value, arguments)
    if origin is np.ndarray:
        return isinstance(value, np.ndarray)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return isinstance(value, origin) and all(
            _is_of(key, arguments[0]) and _is_of(item, arguments[-1])
            for key, item in (value.items() if len(arguments) == 2 else ())
        )
    if isinstance(origin, type) and issubclass(origin, Sequence):
        return isinstance(value, tuple) and all(_is_of(item, arguments[0]) for item in value)
    if declared is float:
        return isinstance(value, float | int) and not isinstance(value, bool)
    if declared is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if declared in (None, type(None)):
        return value is None
    if declared is Any or not isinstance(declared, type) or Protocol in declared.__mro__:
        return True
    return isinstance(value, declared)


def _items_are_of(items: tuple[Any, ...], arguments: tuple[Any, ...]) -> bool:
    """Whether the items of a tuple are of its annotation."""
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        return all(_is_of(item, arguments[0]) for item in items)
    return len(items) == len(arguments) and all(map(_is_of, items, arguments))
