"""What robots that share measurements send each other, and its bytes.

Numbers are those of LEB128. A text has its length before it, and a set of names is a number whose
bits choose.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from solvers.carry.wire import MOST_BITS, WireError, leb128, read_leb128
from solvers.team.measurements import Revision
from solvers.team.packed_lines import PackedLines

# Bits of the first byte.
_TAKES_BACK, _IS_SHORT, _IS_PROMPT, _HAS_ALL, _HAS_PIECE, _HAS_FORMS = (1 << k for k in range(6))
_END_OF_FLAGS = 1 << 6


@dataclass(frozen=True, eq=False)
class Piece:
    """Lines of measurements of the robot `owner`, after those of the revision `before`.

    Where this has no digest, it is that of the run of the owner. `is_last` says that there are no
    more, or others than the receiver has said to have: those that it has after these do not stand.
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
    `twins` are names that two robots have. `sent` is a number, of which `answers` names the last
    that was heard, or -1; `is_prompt` where that is told at once, and `has_all` where the robot has
    the lines of the other by then, and no more. `is_short` says that all it does not tell is as it
    was told before: it has a last piece of its own, or none, and tells whom it hears and twins not.
    """

    has: Mapping[str, Revision]
    hears: tuple[str, ...]
    pieces: tuple[Piece, ...] = ()
    takes_back: bool = False
    twins: tuple[str, ...] = ()
    sent: int = -1
    answers: int = -1
    is_prompt: bool = False
    has_all: bool = False
    is_short: bool = False

    def as_bytes(self) -> bytes:
        """Bytes of which `from_bytes` makes the message: they are the most of what teams send."""
        flags = _IS_PROMPT * self.is_prompt + _HAS_ALL * self.has_all
        return self._short(flags | _IS_SHORT) if self.is_short else self._long(flags)

    def _long(self, flags: int) -> bytes:
        flags |= _TAKES_BACK * self.takes_back
        owners = [piece.owner for piece in self.pieces]
        names = sorted({*self.has, *self.hears, *self.twins, *owners})
        parts = [bytes([flags]), leb128(len(names))]
        for name in names:
            parts += [_text(name.encode("utf-8")), _revision(self.has.get(name, Revision()))]
        parts += [_chosen(names, self.hears), _chosen(names, self.twins)]
        parts += map(leb128, (self.sent + 1, self.answers + 1, len(owners)))
        for piece in self.pieces:
            parts += [leb128(names.index(piece.owner)), _revision(piece.before)]
            parts += [leb128(piece.lines.num_lines), *map(_text, piece.lines[1:])]
            parts.append(leb128(piece.is_last))
        return b"".join(parts)

    def _short(self, flags: int) -> bytes:
        parts = [leb128(self.answers + 1)]
        if not self.has_all:
            parts.append(_revision(next(iter(self.has.values()), Revision())))
        for piece in self.pieces:
            num_lines, forms, numbers = piece.lines
            flags |= _HAS_PIECE + _HAS_FORMS * bool(forms)
            parts += map(leb128, (self.sent + 1, piece.before.num_lines, num_lines))
            parts += [_text(forms) if forms else b"", numbers]
        return b"".join([bytes([flags]), *parts])

    @classmethod
    def from_bytes(cls, data: bytes, sender: str, receiver: str) -> News:
        """Return the message that bytes are; a WireError for others."""
        try:
            if data[0] >= _END_OF_FLAGS:
                raise ValueError("a byte of other flags")
            reader = _Reader(data)
            if data[0] & _IS_SHORT:
                return cls._from_short(reader, data[0], sender, receiver)
            return cls._from_long(reader, data[0])
        except (IndexError, ValueError) as error:
            raise WireError(f"a message that cannot be read: {error}") from error

    @classmethod
    def _from_long(cls, reader: _Reader, flags: int) -> News:
        known = {reader.text().decode("utf-8"): reader.revision() for _ in reader.items()}
        names = list(known)
        hears, twins = reader.chosen(names), reader.chosen(names)
        sent, answers = reader.number() - 1, reader.number() - 1
        pieces = []
        for _ in reader.items():
            owner, before = names[reader.number()], reader.revision()
            lines = PackedLines(reader.number(), reader.text(), reader.text())
            pieces.append(Piece(owner, before, lines, bool(reader.number())))
        has = {name: revision for name, revision in known.items() if revision.num_lines}
        takes_back, is_prompt = bool(flags & _TAKES_BACK), bool(flags & _IS_PROMPT)
        has_all = bool(flags & _HAS_ALL)
        return cls(has, hears, tuple(pieces), takes_back, twins, sent, answers, is_prompt, has_all)

    @classmethod
    def _from_short(cls, reader: _Reader, flags: int, sender: str, receiver: str) -> News:
        answers = reader.number() - 1
        revision = Revision() if flags & _HAS_ALL else reader.revision()
        news = cls(
            {receiver: revision} if revision.num_lines else {},
            (),
            answers=answers,
            is_prompt=bool(flags & _IS_PROMPT),
            has_all=bool(flags & _HAS_ALL),
            is_short=True,
        )
        if not flags & _HAS_PIECE:
            return news
        sent, before, num_lines = reader.number() - 1, reader.number(), reader.number()
        forms = reader.text() if flags & _HAS_FORMS else b""
        lines = PackedLines(num_lines, forms, reader.rest())
        return replace(news, pieces=(Piece(sender, Revision(before), lines, True),), sent=sent)


def _text(text: bytes) -> bytes:
    return leb128(len(text)) + text


def _revision(revision: Revision) -> bytes:
    return leb128(revision.num_lines) + _text(bytes.fromhex(revision.digest))


def _chosen(names: Sequence[str], chosen: Collection[str]) -> bytes:
    return leb128(sum(1 << k for k, name in enumerate(names) if name in chosen))


class _Reader:
    """Reads bytes from the second on; an IndexError at their end."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 1

    def number(self) -> int:
        number, self._at = read_leb128(self._data, self._at)
        return number

    def rest(self) -> bytes:
        return self._data[self._at :]

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
        if count > MOST_BITS:
            raise ValueError(f"{count} items")
        return range(count)
