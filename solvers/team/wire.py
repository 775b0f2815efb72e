"""Messages as bytes: versioned arrays without pickle, sealed with the key of a team.

A message is a record (`solvers.carry.serialization`): a tree in JSON, and the arrays in it. Its
bytes are a mark and version, the HMAC-SHA256 of what follows (RFC 2104), and the record,
compressed. Who does not have the key can neither make a message nor change one. Messages are not
encrypted: a transport may do that.
"""

from __future__ import annotations

import dataclasses
import enum
import hashlib
import hmac
import importlib
import inspect
import json
import pkgutil
import zlib
from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pgo_models.errors import PGOError
from solvers.carry.serialization import deserialize, serialize

_MARK = b"PGO2"  # the last character is the version
_SEAL_BYTES = 32  # of HMAC-SHA256
_LENGTH_BYTES = 4  # of the length of the description, which precedes it
_LEVEL = 1  # of the compression: numbers hardly shrink, trees do
# A message may not unpack to more: whoever has the key could else fill the memory of the others.
MOST_BYTES = 1 << 30
# Rooms and modules whose records are sent, and modules whose functions robots are ordered to call.
_ROOMS = (
    "pgo_models.certificates",
    "pgo_models.geometry",
    "pgo_models.graphs",
    "pgo_models.problem",
    "pgo_models.relaxations",
    "solvers.robots",
    "solvers.carry",
    "solvers.riemannian",
    "solvers.robust.weighted_edges",
    "solvers.soc",
)
_MODULES_OF_ORDERS = (
    "solvers.robots.",
    "solvers.carry.moments",
    "solvers.soc.",
    "solvers.team.sharing",
)


class WireError(PGOError):
    """Bytes that are no message of this team and version."""


@dataclasses.dataclass(frozen=True, eq=False)
class Order:
    """An order by its name, `module:function`, with the arguments that it has already."""

    name: str
    arguments: tuple[Any, ...] = ()

    @classmethod
    def of(cls, order: Callable[..., Any]) -> Order:
        """Name an order, which may be partial."""
        if isinstance(order, partial):
            function = cls.of(order.func)
            given = tuple(cls.of(value) if callable(value) else value for value in order.args)
            return cls(function.name, (*function.arguments, *given))
        return cls(f"{order.__module__}:{order.__qualname__}")

    def function(self) -> Callable[..., Any]:
        """Return the order; a WireError unless it is one that robots have."""
        module, _, path = self.name.partition(":")
        if not module.startswith(_MODULES_OF_ORDERS):
            raise WireError(f"{self.name!r:.80} is no order")
        function: Any = importlib.import_module(module)
        for part in path.split("."):
            if part.startswith("_"):
                raise WireError(f"{self.name!r:.80} is no order")
            function = getattr(function, part, None)
        if not inspect.isfunction(function) or function.__module__ != module:
            raise WireError(f"{self.name!r:.80} is no order")
        given = [
            value.function() if isinstance(value, Order) else value for value in self.arguments
        ]
        return partial(function, *given) if given else function


@cache
def records_of_rooms() -> tuple[type, ...]:
    """Dataclasses, named tuples and enums of the rooms whose records are sent."""
    records: dict[str, type] = {}
    for room in _ROOMS:
        package = importlib.import_module(room)
        within = pkgutil.iter_modules(getattr(package, "__path__", []), f"{room}.")
        for module in [room, *(inside.name for inside in within)]:
            for name, value in vars(importlib.import_module(module)).items():
                if inspect.isclass(value) and value.__module__ == module and _is_record(value):
                    assert name not in records, f"two records are called {name}"
                    records[name] = value
    return tuple(records.values())


def _is_record(value: type) -> bool:
    is_tuple = issubclass(value, tuple) and hasattr(value, "_fields")
    return dataclasses.is_dataclass(value) or is_tuple or issubclass(value, enum.Enum)


def sealed(key: bytes, message: object) -> bytes:
    """Bytes of a message, which only holders of the key can make."""
    body = zlib.compress(packed(serialize(message)), _LEVEL)
    return _MARK + hmac.digest(key, _MARK + body, hashlib.sha256) + body


def opened(key: bytes, data: bytes, kinds: tuple[type, ...]) -> Any:  # noqa: ANN401 - one of kinds
    """The message that the bytes are, one of the given kinds.

    A WireError for bytes of another version, key or kind, and for those that were changed.
    """
    mark, seal, body = _cut(data, len(_MARK), _SEAL_BYTES)
    if mark != _MARK:
        raise WireError("bytes of another program or version")
    if not hmac.compare_digest(seal, hmac.digest(key, _MARK + body, hashlib.sha256)):
        raise WireError("a message that was not sealed with the key of the team")
    try:
        unpacker = zlib.decompressobj()
        plain = unpacker.decompress(body, MOST_BYTES)
        if not unpacker.eof:
            raise WireError("a message that is too long")
        message = deserialize(unpacked(plain), (*records_of_rooms(), Order, *kinds))
    except (zlib.error, ValueError) as error:
        raise WireError(f"a message that cannot be read: {error}") from error
    if not isinstance(message, kinds):
        raise WireError(f"a {type(message).__name__} is no message")
    return message


def _cut(data: bytes, *lengths: int) -> list[bytes]:
    """Pieces of these lengths, and the rest."""
    pieces = []
    for length in lengths:
        pieces.append(data[:length])
        data = data[length:]
    return [*pieces, data]


def packed(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Bytes of arrays: the length of a head in JSON, the head, and the numbers."""
    head: list[tuple[str, str, tuple[int, ...]]] = []
    parts = []
    for name, array in arrays.items():
        if array.dtype.kind == "U":  # a text, which has four bytes a letter
            text = str(array).encode("utf-8")
            head.append((name, "text", (len(text),)))
            parts.append(text)
            continue
        if array.dtype.kind not in "biuf":
            raise TypeError(f"cannot send an array of {array.dtype}")
        little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        head.append((name, little.dtype.str, array.shape))
        parts.append(little.tobytes())
    described = json.dumps(head).encode("utf-8")
    return len(described).to_bytes(_LENGTH_BYTES, "little") + described + b"".join(parts)


def unpacked(data: bytes) -> dict[str, NDArray[Any]]:
    """Arrays of which `packed` made the bytes; a ValueError for others."""
    length = int.from_bytes(data[:_LENGTH_BYTES], "little")
    begins = _LENGTH_BYTES + length
    arrays = {}
    try:
        head = json.loads(data[_LENGTH_BYTES:begins])
        for name, kind, shape in head:
            dtype = np.dtype("u1" if kind == "text" else kind)
            if dtype.kind not in "biuf":
                raise ValueError(f"an array of {dtype}")
            count = int(np.prod(shape, dtype=np.int64))
            values = np.frombuffer(data, dtype, count, begins).reshape(shape)
            begins += values.nbytes
            if kind == "text":
                values = np.array(values.tobytes().decode("utf-8"))
            arrays[name] = values
    except (TypeError, KeyError) as error:
        raise ValueError(f"no arrays: {error!r}") from error
    return arrays
