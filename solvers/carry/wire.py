"""Messages as bytes: versioned arrays without pickle, sealed with the key of a team.

A message is a record (`solvers.carry.serialization`): a tree in JSON, and the arrays in it. Its
bytes are a mark, a version, the HMAC-SHA256 of what follows (RFC 2104), and the record,
compressed. Who does not have the key can neither make a message nor change one. What both ends know
of a message need not be sent: the seal is of it, too. Messages are not encrypted: a transport may
do that.
"""

from __future__ import annotations

import dataclasses
import hashlib
import hmac
import json
import math
import zlib
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pgo_models.errors import PGOError
from solvers.carry.registry import VERSION, name_of_order, order_named, record
from solvers.carry.serialization import deserialize

MARK = b"PGO"
_VERSION = VERSION.to_bytes(1, "big")
_SEAL_BYTES = 16  # of HMAC-SHA256, the first 128 bits
_SHORT_SEAL_BYTES = 12  # where the ends are implied, as in IPsec (RFC 2404)
_IMPLIED = b"END"  # in place of the mark, which is not sent
_HINT = 0x80  # bit of the first byte of messages whose ends are implied
MOST_BITS = 63  # of a number
_LENGTH_BYTES = 4  # of the length of the description, which precedes it
_LEVEL = 1  # of the compression: numbers hardly shrink, trees do
_NO_HEADER = -15  # of the compression: the seal has a checksum already
# What most messages begin with, for their compression; a change of it is one of `VERSION`.
_COMMON = (
    b'[["tree", "text", [600]], ["0", "|u1", [100]], ["1", "<f8", [3, 3]], ["2", "<i8", [2]]]'
    b'{"record": "Hello", "fields": {"revision": {"record": "Revision", "fields": {"num_lines": 1, '
    b'"digest": ""}}, "term": {"record": "Term", "fields": {"number": 1, "driver": ""}}, "known": '
    b'{"record": "Term", "fields": {"number": 0, "driver": ""}}, "computing": -1, "twins": '
    b'{"items": []}}}'
)
# A message may not unpack to more, nor its description, each byte of which may become an object:
# whoever has the key could else fill the memory of the others, and hold their calls up. The
# description of the outcome of 16 robots has 4 kB, and 6 kB where edges are tested (GNC).
MOST_BYTES = 1 << 27
_MOST_DESCRIBED = 1 << 17
K = TypeVar("K")


class WireError(PGOError):
    """Bytes that are no message of this team and version."""


@record("Order")
@dataclasses.dataclass(frozen=True, eq=False)
class Order:
    """An order by its name, with the arguments that it has already."""

    name: str
    arguments: tuple[Any, ...] = ()

    @classmethod
    def of(cls, order: Callable[..., Any]) -> Order:
        """Name an order, which may be partial."""
        if isinstance(order, partial):
            function = cls.of(order.func)
            given = tuple(cls.of(value) if callable(value) else value for value in order.args)
            return cls(function.name, (*function.arguments, *given))
        return cls(name_of_order(order))

    def function(self) -> Callable[..., Any]:
        """Return the order; a WireError unless it is one that robots have."""
        try:
            function = order_named(self.name)
        except ValueError as error:
            raise WireError(str(error)) from error
        given = [
            value.function() if isinstance(value, Order) else value for value in self.arguments
        ]
        return partial(function, *given) if given else function


def deflated(data: bytes) -> bytes:
    """Bytes, compressed (RFC 1951) by what they have in common with every message, too."""
    packer = zlib.compressobj(_LEVEL, zlib.DEFLATED, _NO_HEADER, zdict=_COMMON)
    return packer.compress(data) + packer.flush()


def inflated(data: bytes, most_bytes: int) -> bytes | None:
    """Bytes that were `deflated`; None for more than so many, and a WireError for others."""
    if most_bytes <= 0:  # which zlib takes for no limit
        return None
    unpacker = zlib.decompressobj(_NO_HEADER, _COMMON)
    try:
        plain = unpacker.decompress(data, most_bytes)
    except zlib.error as error:
        raise WireError(f"a message that cannot be read: {error}") from error
    if unpacker.eof:
        return plain
    if len(plain) < most_bytes:
        raise WireError("a message that is cut")
    return None


def from_plain(plain: bytes, kind: type[K]) -> K:
    """The message of which `packed` made the bytes, one of the given kinds; else a WireError."""
    try:
        message = deserialize(unpacked(plain, _MOST_DESCRIBED))
    except ValueError as error:
        raise WireError(f"a message that cannot be read: {error}") from error
    if not isinstance(message, kind):
        raise WireError(f"a {type(message).__name__} is no message")
    return message


def sealed(key: bytes, body: bytes) -> bytes:
    """Bytes with a mark, a version and a seal, which only holders of the key can make."""
    seal = hmac.digest(key, MARK + _VERSION + body, hashlib.sha256)
    return MARK + _VERSION + seal[:_SEAL_BYTES] + body


def opened(key: bytes, data: bytes) -> bytes:
    """The bytes under a seal.

    A WireError for bytes of another version or key, and for those that were changed.
    """
    mark, version, seal, body = _cut(data, len(MARK), len(_VERSION), _SEAL_BYTES)
    if mark != MARK:
        raise WireError("bytes of another program")
    if version != _VERSION:
        raise WireError(
            f"a message of version {int.from_bytes(version, 'big')}, and this robot has version "
            f"{VERSION}; install one version on all robots"
        )
    expected = hmac.digest(key, mark + version + body, hashlib.sha256)
    if not hmac.compare_digest(seal, expected[:_SEAL_BYTES]):
        raise WireError("a message that was not sealed with the key of the team")
    return body


def implied_ends(description: bytes) -> bytes:
    """What stands for two ends of a line in the seals of what goes from one to the other."""
    return hashlib.sha256(description).digest()


def hint_of(ends: bytes) -> int:
    """First byte of messages between two ends, which tells them from most others."""
    return _HINT | ends[0]


def sealed_between(key: bytes, ends: bytes, body: bytes) -> bytes:
    """Bytes with a hint at the ends that their seal implies, and the seal."""
    seal = hmac.digest(key, _IMPLIED + _VERSION + ends + body, hashlib.sha256)
    return bytes([hint_of(ends)]) + seal[:_SHORT_SEAL_BYTES] + body


def opened_between(key: bytes, ends: bytes, data: bytes) -> bytes | None:
    """The bytes under a seal that implies these ends; None where it does not."""
    _, seal, body = _cut(data, 1, _SHORT_SEAL_BYTES)
    expected = hmac.digest(key, _IMPLIED + _VERSION + ends + body, hashlib.sha256)
    return body if hmac.compare_digest(seal, expected[:_SHORT_SEAL_BYTES]) else None


def leb128(number: int) -> bytes:
    """A natural number, seven bits a byte, the lowest first; all bytes but the last have bit 8."""
    data = bytearray()
    while number > 127:
        data.append(128 | number & 127)
        number >>= 7
    return bytes([*data, number])


def read_leb128(data: bytes, begins: int) -> tuple[int, int]:
    """The number that begins at a place, and where it ends.

    An IndexError where the bytes end before, a ValueError for a number of more than 63 bits.
    """
    number = 0
    for shift in range(0, MOST_BITS, 7):
        byte = data[begins]
        begins += 1
        number |= (byte & 127) << shift
        if byte < 128:
            return number, begins
    raise ValueError("a number of too many bytes")


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
    parts: list[bytes | memoryview] = []
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
        parts.append(little.data)
    described = json.dumps(head).encode("utf-8")
    return len(described).to_bytes(_LENGTH_BYTES, "little") + described + b"".join(parts)


def unpacked(data: bytes, most_described: float = math.inf) -> dict[str, NDArray[Any]]:
    """Arrays of which `packed` made the bytes; a ValueError for others.

    Neither their head nor a text among them may have more bytes than `most_described`.
    """
    length = int.from_bytes(data[:_LENGTH_BYTES], "little")
    if length > most_described:
        raise ValueError(f"a head of {length} bytes")
    begins = _LENGTH_BYTES + length
    arrays = {}
    try:
        head = json.loads(data[_LENGTH_BYTES:begins])
        for name, kind, shape in head:
            dtype = np.dtype("u1" if kind == "text" else kind)
            if dtype.kind not in "biuf":
                raise ValueError(f"an array of {dtype}")
            count = math.prod(shape)
            if not 0 <= count <= len(data) or (kind == "text" and count > most_described):
                raise ValueError(f"an array of {count} numbers")
            values = np.frombuffer(data, dtype, count, begins).reshape(shape)
            begins += values.nbytes
            if kind == "text":
                values = np.array(values.tobytes().decode("utf-8"))
            arrays[name] = values
    except (TypeError, KeyError, OverflowError, RecursionError) as error:
        raise ValueError(f"no arrays: {error!r:.200}") from error
    return arrays
