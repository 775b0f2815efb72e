"""Objects of ours as arrays, and back: what a robot or a driver remembers, to be sent or written without pickle.

A tree in JSON says what the object is made of, and names the arrays in it by number.
"""

import dataclasses
import enum
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TREE = "tree"


def serialize(value: object) -> dict[str, NDArray[Any]]:
    """Arrays that `deserialize` makes an equal object of.

    The object is None, a number, a string, an array, an enum's member, a dataclass, a sequence of such, or a mapping of
    strings or integers to such; a sequence comes back as a tuple. A TypeError when there is something else in it.
    """
    arrays: list[NDArray[Any]] = []
    tree = json.dumps(_tree(value, arrays))
    return {_TREE: np.array(tree), **{str(number): array for number, array in enumerate(arrays)}}


def deserialize(arrays: Mapping[str, NDArray[Any]], classes: Sequence[type]) -> Any:  # noqa: ANN401 - whatever was serialized
    """Object that `serialize` made the arrays of, of these dataclasses and enums; nothing else is ever made.

    A ValueError when the arrays are not those of `serialize`, or hold a class that is not among `classes`.
    """
    known = {one.__name__: one for one in classes}
    try:
        return _value(json.loads(str(arrays[_TREE])), arrays, known)
    except (KeyError, TypeError, IndexError) as error:
        raise ValueError(f"arrays that were not serialized here: {error!r}") from error


def _tree(value: object, arrays: list[NDArray[Any]]) -> object:
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray):
        arrays.append(value.copy())
        return {"array": len(arrays) - 1}
    if isinstance(value, enum.Enum):
        return {"enum": type(value).__name__, "member": value.name}
    if dataclasses.is_dataclass(value):
        fields = {one.name: _tree(getattr(value, one.name), arrays) for one in dataclasses.fields(value)}
        return {"class": type(value).__name__, "fields": fields}
    if isinstance(value, Mapping):
        if not all(isinstance(key, str | int) for key in value):
            raise TypeError(f"cannot serialize the keys {list(value)!r}")
        return {"keys": list(value), "values": [_tree(item, arrays) for item in value.values()]}
    if isinstance(value, Sequence):
        return {"items": [_tree(item, arrays) for item in value]}
    raise TypeError(f"cannot serialize {value!r}")


def _value(tree: Any, arrays: Mapping[str, NDArray[Any]], known: Mapping[str, type]) -> Any:  # noqa: ANN401
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return np.array(arrays[str(tree["array"])])  # a copy, which may be written to
    if "enum" in tree:
        return known[tree["enum"]][tree["member"]]  # type: ignore[index] # an enum's class
    if "class" in tree:
        fields = {name: _value(item, arrays, known) for name, item in tree["fields"].items()}
        return known[tree["class"]](**fields)
    if "keys" in tree:
        return dict(zip(tree["keys"], (_value(item, arrays, known) for item in tree["values"]), strict=True))
    return tuple(_value(item, arrays, known) for item in tree["items"])
