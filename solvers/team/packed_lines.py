"""Lines of measurements as few bytes, of which lines of the same form come again.

A line is its form, in which marks stand for ids and for numbers of many digits, and these. Forms
that have come before, changes of ids, and exponents, signs and first four bits of numbers are
symbols. They are as probable as they were so far, and one integer has many (asymmetric numeral
systems, Duda 2013). The rest of a mantissa is as it is; all are after the integers, the first one
last. The last number of a unit quaternion is the root that the other three leave, up to a few units
in its last place. Other forms are compressed (RFC 1951) with those before as a dictionary.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from collections import defaultdict
from collections.abc import Hashable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from solvers.carry.wire import WireError, leb128, read_leb128

MOST_LINES = 1024  # that are packed at once
_IN_AN_INTEGER = 512  # symbols, as each takes a division of the integer
_BEFORE, _MOST_BEFORE = 128, 1 << 15  # how many lines before, and bytes, tell what is probable
# Steps after which the lines that are packed at once end, as all of them are read in one call. A
# symbol takes one for each that it may be, and as long as so many for itself.
_MOST_STEPS, _STEPS_A_SYMBOL = 1 << 18, 64
_FEWEST_LETTERS = 12  # of a number that is taken out: text has about half a byte a digit
_NUMBER, _ID, _TEXT = "\0", "\1", "\2"  # begin words in place of numbers and ids, and any like them
_FIRST_ID, _SECOND_ID = 2, 4  # places of words and spaces in a line
_LONGEST_ID = 19  # digits
_SPACE = re.compile(r"(\s)")
# What most forms have in common, for their compression; a change of it is one of `VERSION`.
_COMMON = (
    "EDGE_SE2 \1 \1 \0 \0 \0 1.0 0.0 0.0 1.0 0.0 1.0\n"
    "EDGE_SE3:QUAT \1 \1 \0 \0 \0 \0 \0 \0 \0 "
    "1.0 0.0 0.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 1.0 0.0 0.0 1.0 0.0 1.0\n"
    "POSE \1\n"
)
_DOUBLE, _BITS = struct.Struct("<d"), struct.Struct("<Q")
_MANTISSA_BYTES = 6  # of a mantissa without its first four bits
_FIRST_BITS = 1 << 8 * _MANTISSA_BYTES
_ONE = 1 << 52  # of the bits of an exponent, which are before the mantissa
_LARGE = 1022  # exponent of a half: the first bits of larger numbers are often those near one
_NEGATIVE = 1 << 63
_ROOT = 1 << 11  # in place of an exponent
_MOST_UNITS = 1 << 24  # in the last place, between a number and a root
_MOST_BITS = 128  # of a symbol


class PackedLines(NamedTuple):
    """How many lines, forms that have not come before, and symbols and mantissas."""

    num_lines: int
    forms: bytes
    numbers: bytes


def packed_lines(lines: Sequence[str], before: Sequence[str]) -> PackedLines:
    """Lines as bytes; those before, which the receiver has, help.

    Where they are too many to be read in one call, it is the first ones.
    """
    coder = _Coder(before)
    dictionary = _dictionary(coder)
    num_forms = len(coder.forms)
    num_lines = 0
    while num_lines < len(lines) and coder.symbols.num_steps <= _MOST_STEPS:
        coder.write(lines[num_lines])
        num_lines += 1
    packer = zlib.compressobj(9, zlib.DEFLATED, -15, zdict=dictionary)
    text = coder.text_of_forms(num_forms)
    forms = packer.compress(text) + packer.flush() if text else b""
    mantissas = reversed(coder.mantissas)
    return PackedLines(num_lines, forms, b"".join([coder.symbols.as_bytes(), *mantissas]))


def unpacked_lines(packed: PackedLines, before: Sequence[str], most_bytes: int) -> list[str]:
    """The lines that were packed; a WireError for bytes that are none, or more than so many."""
    if packed.num_lines > MOST_LINES or max(map(len, packed[1:])) > most_bytes:
        raise WireError(f"{packed.num_lines} lines of {sum(map(len, packed[1:]))} bytes")
    coder = _Coder(before)
    coder.symbols.unread = packed.numbers
    places = range(len(packed.numbers) % _MANTISSA_BYTES, len(packed.numbers), _MANTISSA_BYTES)
    coder.mantissas = [packed.numbers[place : place + _MANTISSA_BYTES] for place in places]
    lines: list[str] = []
    coder.symbols.most_steps = 2 * _MOST_STEPS  # the last line may have many
    try:
        new_forms = _forms(packed.forms, _dictionary(coder), most_bytes)
        for _ in range(packed.num_lines):
            lines.append(coder.read(new_forms))
            most_bytes -= len(lines[-1])
            if most_bytes < 0:
                raise WireError("lines of too many bytes")
    except (zlib.error, struct.error, ValueError, LookupError, StopIteration) as error:
        raise WireError(f"lines that cannot be read: {error}") from error
    num_read = len(places) - len(coder.mantissas)
    if coder.symbols.state != 1 or len(coder.symbols.unread) != num_read * _MANTISSA_BYTES:
        raise WireError("lines that go on after their end")
    return lines


def _dictionary(coder: _Coder) -> bytes:
    """What new forms have in common with those before, and most have with each other."""
    return _COMMON.encode("utf-8") + coder.text_of_forms(0)


def _forms(data: bytes, dictionary: bytes, most_bytes: int) -> Iterator[str]:
    """New forms, which were compressed."""
    if not data:
        return iter(())
    unpacker: Any = zlib.decompressobj(-15, dictionary)
    text = unpacker.decompress(data, most_bytes).decode("utf-8")
    if not unpacker.eof or not text.endswith("\n"):
        raise WireError("lines without an end")
    return iter(text.splitlines(keepends=True))


class _Symbols:
    """Natural numbers in integers, each with its probability among those before in a context.

    One that is new in its context has the probability of an escape, which grows with the number of
    different ones, and its bits follow. What is read leaves the integer `state`; others follow in
    `unread`.
    """

    def __init__(self) -> None:
        self._counts: defaultdict[Hashable, dict[int, int]] = defaultdict(dict)
        self.is_begun = False  # before, symbols are counted alone
        self.most_steps = math.inf
        self.num_steps = 0
        self.state = 1
        self.unread = b""
        self._num_symbols = 0
        # For each integer, intervals: begin, width, and width of all.
        self._steps: list[list[tuple[int, int, int]]] = []

    def as_bytes(self) -> bytes:
        """The integers of what was written, each with its length before it."""
        parts = []
        for steps in self._steps:
            state = 1
            for begins, width, total in reversed(steps):
                state = state // width * total + begins + state % width
            num_bytes = (state.bit_length() + 7) // 8
            parts += [leb128(num_bytes), state.to_bytes(num_bytes, "little")]
        return b"".join(parts)

    def _next_integer(self, is_read: bool) -> None:
        """Begin an integer, where one is full or none is begun."""
        if not is_read:
            self._steps.append([])
            return
        if self.state != 1:
            raise WireError("symbols that go on after their end")
        num_bytes, begins = read_leb128(self.unread, 0)
        self.state = int.from_bytes(self.unread[begins : begins + num_bytes], "little")
        self.unread = self.unread[begins + num_bytes :]

    def code(self, context: Hashable, symbol: int | None) -> int:
        """Write a symbol, or read it where there is None."""
        counts = self._counts[context]
        if symbol is not None and not self.is_begun:
            if symbol not in counts:
                self._count(self._counts["bits", context], symbol.bit_length())
            self._count(counts, symbol)
            return symbol
        if self._num_symbols % _IN_AN_INTEGER == 0:
            self._next_integer(symbol is None)
        self._num_symbols += 1
        coded = self._among(counts, symbol)
        if coded is None:
            sizes = self._counts["bits", context]
            size = None if symbol is None else symbol.bit_length()
            num_bits = self._among(sizes, size)
            if num_bits is None:
                num_bits = self._plain(size, _MOST_BITS)
            self._count(sizes, num_bits)
            least = 1 << num_bits >> 1
            more = self._plain(None if symbol is None else symbol - least, max(1, least))
            coded = least + more
        self._count(counts, coded)
        return coded

    def _count(self, counts: dict[int, int], symbol: int) -> None:
        counts[symbol] = counts.get(symbol, 0) + 1

    def _among(self, counts: Mapping[int, int], symbol: int | None) -> int | None:
        """Code a symbol that has come before; else an escape, which is None."""
        self.num_steps += _STEPS_A_SYMBOL + len(counts)
        if self.num_steps > self.most_steps:
            raise WireError("lines of too many symbols")
        num_known = sum(counts.values())
        total = num_known + max(1, len(counts))
        place = total if symbol is not None else self.state % total
        if place >= num_known and symbol not in counts:
            self._pass(num_known, total - num_known, total, symbol is None)
            return None
        begins = 0
        for known, count in counts.items():
            if known == symbol or place < begins + count:
                break
            begins += count
        self._pass(begins, count, total, symbol is None)
        return known

    def _plain(self, number: int | None, total: int) -> int:
        """Code a number below `total`, all of which are as probable."""
        coded = self.state % total if number is None else number
        self._pass(coded, 1, total, number is None)
        return coded

    def _pass(self, begins: int, width: int, total: int, is_read: bool) -> None:
        """Write an interval, or leave it behind."""
        if is_read:
            self.state = self.state // total * width + self.state % total - begins
        else:
            self._steps[-1].append((begins, width, total))


class _Coder:
    """Writes lines as symbols and mantissas, and reads them, after lines that both sides have."""

    def __init__(self, before: Sequence[str]) -> None:
        self.symbols = _Symbols()
        self.mantissas: list[bytes] = []  # those that were written, or the last is the next to read
        self.forms: dict[str, int] = {}
        self._last_form = 0
        self._last_id = 0
        self._first_ids: dict[str, int] = {}  # of the last line, by its first word
        self._seen: set[str] = set()
        for line in _last(before):
            self.write(line)
        self.symbols.is_begun = True
        self.mantissas.clear()

    def text_of_forms(self, first: int) -> bytes:
        """Forms from a number on, in UTF-8."""
        return "".join([*self.forms][first:]).encode("utf-8")

    def write(self, line: str) -> None:
        """Write a line."""
        words = _SPACE.split(line)
        marks = words.copy()
        for place in range(0, len(words), 2):  # spaces are between them
            marks[place] = self._mark(words[place], place in (_FIRST_ID, _SECOND_ID))
        form = "".join(marks)
        self.symbols.code(("form", self._last_form), self.forms.get(form, 0))
        self._fill(form, marks, words)

    def read(self, new_forms: Iterator[str]) -> str:
        """Read a line, which may have the next new form."""
        number = self.symbols.code(("form", self._last_form), None)
        form = [*self.forms][number - 1] if number else next(new_forms)
        words = _SPACE.split(form)
        self._fill(form, words, None)
        return "".join(words)

    def _mark(self, word: str, may_be_id: bool) -> str:
        """What stands for a word in a form; numbers that have come before stay."""
        if may_be_id and len(word) <= _LONGEST_ID and word.isdecimal() and str(int(word)) == word:
            return _ID
        if len(word) >= _FEWEST_LETTERS and word not in self._seen:
            self._seen.add(word)
            if _is_number(word):
                return _NUMBER
        return _TEXT + word if word.startswith((_NUMBER, _ID, _TEXT)) else word

    def _fill(self, form: str, words: list[str], written: Sequence[str] | None) -> None:
        """Put words in place of marks: those that are written, or else those that are read."""
        self._last_form = self.forms.setdefault(form, len(self.forms) + 1)
        for place in range(0, len(words), 2):
            word = None if written is None else written[place]
            if words[place] == _ID:
                words[place] = self._id(words[0], place, word)
            elif words[place] == _NUMBER:
                before = words[max(0, place - 6) : place : 2]
                words[place] = self._number((words[0], place), word, _root(before))
            else:
                words[place] = words[place].removeprefix(_TEXT)

    def _id(self, tag: str, place: int, word: str | None) -> str:
        """An id as its change: a second one from the first, that from the line before."""
        before = self._last_id if place == _SECOND_ID else self._first_ids.get(tag, 0)
        change = None if word is None else int(word) - before
        symbol = None if change is None else 2 * abs(change) + (change < 0)
        coded = self.symbols.code((tag, place), symbol)
        self._last_id = before + (-(coded // 2) if coded % 2 else coded // 2)
        if place == _FIRST_ID:
            self._first_ids[tag] = self._last_id
        return str(self._last_id)

    def _number(self, context: Hashable, word: str | None, root: int) -> str:
        """A number as sign, exponent and mantissa, or as its distance to the bits of a root."""
        exponent = distance = sign = mantissa = None
        if word is not None:
            (bits,) = _BITS.unpack(_DOUBLE.pack(float(word)))
            sign, size = divmod(bits, _NEGATIVE)
            units = size - root
            distance = 4 * abs(units) + 2 * (units < 0) + sign
            exponent, mantissa = divmod(size, _ONE)
            if abs(units) < _MOST_UNITS:
                exponent = _ROOT
        exponent = self.symbols.code(context, exponent)
        if exponent == _ROOT:
            distance = self.symbols.code(("units", root // _ONE), distance)
            units = -(distance // 4) if distance & 2 else distance // 4
            bits = root + units + (distance & 1) * _NEGATIVE
        else:
            sign = self.symbols.code(("sign", context), sign)
            digit = None if mantissa is None else mantissa // _FIRST_BITS
            digit = self.symbols.code(exponent if exponent >= _LARGE else 0, digit)
            if mantissa is None:
                mantissa = digit * _FIRST_BITS + int.from_bytes(self.mantissas.pop(), "little")
            else:
                rest = mantissa % _FIRST_BITS
                self.mantissas.append(rest.to_bytes(_MANTISSA_BYTES, "little"))
            bits = sign * _NEGATIVE + exponent * _ONE + mantissa
        return word if word is not None else repr(_DOUBLE.unpack(_BITS.pack(bits))[0])


def _last(before: Sequence[str]) -> Sequence[str]:
    """The last lines, as many as tell what is probable."""
    begins = len(before)
    num_bytes = 0
    while begins > max(0, len(before) - _BEFORE):
        num_bytes += len(before[begins - 1])
        if num_bytes > _MOST_BEFORE:
            break
        begins -= 1
    return before[begins:]


def _root(words: Sequence[str]) -> int:
    """Bits of the number whose square and those of three others are one; 0 where there is none."""
    try:
        a, b, c = map(float, words)
    except ValueError:
        return 0
    rest = 1.0 - (a * a + b * b + c * c)
    (bits,) = _BITS.unpack(_DOUBLE.pack(math.sqrt(rest) if rest > 0.0 else 0.0))
    return int(bits)


def _is_number(word: str) -> bool:
    """Whether a word is that which Python writes for a finite double."""
    try:
        number = float(word)
    except ValueError:
        return False
    return math.isfinite(number) and repr(number) == word
