"""Records as arrays, and back: the state of a robot or a driver, sent or written without pickle.

A tree in JSON describes the record, and refers to its arrays by number.
"""

import dataclasses
import enum
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pgo_models.errors import PGOError
from solvers.carry.field_types import check_fields
from solvers.carry.messages import Messages
from solvers.carry.registry import name_of_record, record_named

_TREE = "tree"
# Numbers and arrays by the identity of the arrays: one that a record has twice is stored once.
_Arrays = dict[int, tuple[int, NDArray[Any]]]
# Metadata of a field that is left out, and takes its default: what it holds is computed again.
COMPUTED_AGAIN = {"is_computed_again": True}


def serialize(value: object) -> dict[str, NDArray[Any]]:
    """Arrays of which `deserialize` makes an equal record.

    The value is None, a number, a string, an array, a record that has a name, a sequence of such,
    or a mapping of strings or integers to such. A sequence comes back as a tuple, and a mapping as
    a dict unless it is `Messages`. Raises a TypeError if it contains anything else. The arrays are
    those of the value, and no copies.
    """
    arrays: _Arrays = {}
    tree = json.dumps(_describe(value, arrays))
    numbered = {str(number): array for number, array in arrays.values()}
    return {_TREE: np.array(tree), **numbered}


def deserialize(arrays: Mapping[str, NDArray[Any]]) -> Any:  # noqa: ANN401 - whatever was serialized
    """Record of which `serialize` made the arrays.

    Only records that have a name (`solvers.carry.registry`) are ever constructed, of fields of the
    types that they declare. An array that a record has twice is one array again. Raises a
    ValueError if the arrays are not those of `serialize`, or name no record.
    """
    try:
        tree = json.loads(str(arrays[_TREE]))
        return _rebuild(tree, {name: np.array(array) for name, array in arrays.items()})
    except (LookupError, TypeError, AttributeError, RecursionError, PGOError) as error:
        raise ValueError(f"arrays that were not serialized here: {error!r:.200}") from error


def _describe(value: object, arrays: _Arrays) -> object:
    """Describe a value as JSON; its arrays are put into `arrays`."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray):
        number, _ = arrays.setdefault(id(value), (len(arrays), value))
        return {"array": number}
    if isinstance(value, enum.Enum):
        return {"enum": name_of_record(type(value)), "member": value.name}
    names = _names_of_fields(value)
    if names is not None:
        fields = {name: _describe(getattr(value, name), arrays) for name in names}
        return {"record": name_of_record(type(value)), "fields": fields}
    if isinstance(value, Mapping):
        if not all(isinstance(key, str | int) for key in value):
            raise TypeError(f"cannot serialize the keys {list(value)!r}")
        items = [_describe(item, arrays) for item in value.values()]
        kind = {"is_messages": True} if isinstance(value, Messages) else {}
        return {"keys": list(value), "values": items, **kind}
    if isinstance(value, Sequence):
        return {"items": [_describe(item, arrays) for item in value]}
    raise TypeError(f"cannot serialize {value!r}")


def _names_of_fields(value: object) -> list[str] | None:
    """Names of what a dataclass or a named tuple is made of; None of anything else."""
    if dataclasses.is_dataclass(value):
        fields = dataclasses.fields(value)
        return [field.name for field in fields if not field.metadata.get("is_computed_again")]
    return list(getattr(value, "_fields", ())) or None


def _rebuild(tree: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:  # noqa: ANN401 - JSON
    """Rebuild the value that `_describe` has described."""
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return arrays[str(tree["array"])]
    if "enum" in tree:
        return record_named(tree["enum"])[tree["member"]]
    if "record" in tree:
        fields = {name: _rebuild(item, arrays) for name, item in tree["fields"].items()}
        kind = record_named(tree["record"])
        check_fields(kind, fields)
        return kind(**fields)
    if "keys" in tree:
        values = [_rebuild(item, arrays) for item in tree["values"]]
        items = dict(zip(tree["keys"], values, strict=True))
        return Messages(items) if "is_messages" in tree else items
    return tuple(_rebuild(item, arrays) for item in tree["items"])
