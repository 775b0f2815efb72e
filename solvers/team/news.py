"""What robots that share measurements send each other, and its bytes.

Numbers are of seven bits a byte, the lowest first; all but the last byte of a number have the
highest bit set (LEB128). A text has its length before it, and a set of names is a number whose bits
choose.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from solvers.carry.wire import WireError
from solvers.team.measurements import Revision
from solvers.team.packed_lines import PackedLines

_MOST_BITS = 63  # of a number


@dataclass(frozen=True, eq=False)
class Piece:
    """Lines of measurements of the robot `owner`, after those of the revision `before`.

    `is_last` says that there are no more.
    """

    owner: str
    before: Revision
    lines: PackedLines
    is_last: bool


@dataclass(frozen=True, eq=False)
class News:
    """A robot is there; it has measurements of these revisions, by robot, and gives pieces of some.

    `hears` are robots that it has heard of lately, which send it what they measure themselves.
    `takes_back` says that it comes from what was saved, and lacks what it has measured since;
    `twins` are names that two robots have. `sent` is when pieces were sent, by the clock of `Pace`,
    and `answers` that number of those that have come last, or -1. `is_short` says that all it does
    not tell is as it was told before; whom it hears and twins are not told.
    """

    has: Mapping[str, Revision]
    hears: tuple[str, ...]
    pieces: tuple[Piece, ...] = ()
    takes_back: bool = False
    twins: tuple[str, ...] = ()
    sent: int = -1
    answers: int = -1
    is_short: bool = False

    def as_bytes(self) -> bytes:
        """Bytes of which `from_bytes` makes the message: they are the most of what teams send."""
        owners = [piece.owner for piece in self.pieces]
        names = sorted({*self.has, *self.hears, *self.twins, *owners})
        parts = [_number(len(names))]
        for name in names:
            parts += [_text(name.encode("utf-8")), _revision(self.has.get(name, Revision()))]
        parts.append(_number(self.takes_back + 2 * self.is_short))
        if not self.is_short:
            parts += [_chosen(names, self.hears), _chosen(names, self.twins)]
        parts += map(_number, (self.sent + 1, self.answers + 1, len(owners)))
        for piece in self.pieces:
            parts += [_number(names.index(piece.owner)), _revision(piece.before)]
            parts += [_number(piece.lines.num_lines), *map(_text, piece.lines[1:])]
            parts.append(_number(piece.is_last))
        return b"".join(parts)

    @classmethod
    def from_bytes(cls, data: bytes) -> News:
        """Return the message that bytes are; a WireError for others."""
        reader = _Reader(data)
        try:
            known = {reader.text().decode("utf-8"): reader.revision() for _ in reader.items()}
            names = list(known)
            flags = reader.number()
            takes_back, is_short = bool(flags & 1), bool(flags & 2)
            hears, twins = [() if is_short else reader.chosen(names) for _ in range(2)]
            sent, answers = reader.number() - 1, reader.number() - 1
            pieces = []
            for _ in reader.items():
                owner, before = names[reader.number()], reader.revision()
                lines = PackedLines(reader.number(), *(reader.text() for _ in range(3)))
                pieces.append(Piece(owner, before, lines, bool(reader.number())))
        except (IndexError, ValueError) as error:
            raise WireError(f"a message that cannot be read: {error}") from error
        has = {name: revision for name, revision in known.items() if revision.num_lines}
        return cls(has, hears, tuple(pieces), takes_back, twins, sent, answers, is_short)


def _number(number: int) -> bytes:
    data = bytearray()
    while number > 127:
        data.append(128 | number & 127)
        number >>= 7
    return bytes([*data, number])


def _text(text: bytes) -> bytes:
    return _number(len(text)) + text


def _revision(revision: Revision) -> bytes:
    return _number(revision.num_lines) + _text(bytes.fromhex(revision.digest))


def _chosen(names: Sequence[str], chosen: Collection[str]) -> bytes:
    return _number(sum(1 << k for k, name in enumerate(names) if name in chosen))


class _Reader:
    """Reads bytes from the first on; an IndexError at their end."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def number(self) -> int:
        number = 0
        for shift in range(0, _MOST_BITS, 7):
            byte = self._data[self._at]
            self._at += 1
            number |= (byte & 127) << shift
            if byte < 128:
                return number
        raise ValueError("a number of too many bytes")

    def text(self) -> bytes:
        length = self.number()
        text = self._data[self._at : self._at + length]
        if len(text) < length:
            raise IndexError("a text that is cut")
        self._at += length
        return text

    def revision(self) -> Revision:
        return Revision(self.number(), self.text().hex())

    def chosen(self, names: Sequence[str]) -> tuple[str, ...]:
        number = self.number()
        return tuple(name for k, name in enumerate(names) if number >> k & 1)

    def items(self) -> range:
        """As many numbers as there are items: robots, which a number chooses, or their pieces."""
        count = self.number()
        if count > _MOST_BITS:
            raise ValueError(f"{count} items")
        return range(count)
