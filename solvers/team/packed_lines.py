"""Lines of measurements as few bytes, of which the same lines come again.

Numbers of many digits are taken out, and packed in 59 bits each: a double without exponents that no
measurement has. Ids are written as the difference to the one before. What is left of a line is that
of many others, and compressed (RFC 1951) with the lines before as a dictionary.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solvers.carry.wire import WireError

_BEFORE = 64  # how many lines before are the dictionary
_FEWEST_LETTERS = 12  # of a number that is taken out: text has about half a byte a digit
_NUMBER, _ID, _TEXT = "\0", "\1", "\2"  # begin words in place of numbers and ids, and any like them
_ID_PLACES = (2, 4)  # of words and spaces in a line
_LONGEST_ID = 19  # digits
_SPACE = re.compile(r"(\s)")
# Exponents of doubles from 2^-32 to 2^32, of 6 bits.
_LEAST_EXPONENT, _EXPONENT_BITS = 1023 - 32, 6
_MANTISSA_BITS = 52
_BITS = 1 + _EXPONENT_BITS + _MANTISSA_BITS


def packed_lines(lines: Sequence[str], before: Sequence[str]) -> tuple[bytes, bytes]:
    """Lines as two bytes, what is left of them, and numbers; those before help."""
    writer = _Writer()
    dictionary = writer.text_of(before[-_BEFORE:])
    num_before = len(writer.numbers)
    text = writer.text_of(lines)
    packer = zlib.compressobj(9, zlib.DEFLATED, -15, zdict=dictionary)
    return packer.compress(text) + packer.flush(), _packed(writer.numbers[num_before:])


def unpacked_lines(
    text: bytes, numbers: bytes, before: Sequence[str], most_bytes: int
) -> list[str]:
    """The lines that were packed; a WireError for bytes that are none, or more than so many."""
    writer = _Writer()
    if len(numbers) > most_bytes:
        raise WireError(f"{len(numbers)} bytes of numbers")
    unpacker: Any = zlib.decompressobj(-15, writer.text_of(before[-_BEFORE:]))
    try:
        plain = unpacker.decompress(text, most_bytes).decode("utf-8")
        rest = iter(_unpacked(numbers))
        words = [_word(word, rest, writer) for word in _SPACE.split(plain)]
    except (zlib.error, ValueError, StopIteration) as error:
        raise WireError(f"lines that cannot be read: {error}") from error
    if not unpacker.eof or (plain and not plain.endswith("\n")):
        raise WireError("lines without an end")
    return "".join(words).splitlines(keepends=True)


def _word(word: str, numbers: Iterator[float], writer: _Writer) -> str:
    """The word that one stands for."""
    if word == _NUMBER:
        return repr(next(numbers))
    if word.startswith(_ID):
        writer.last_id += int(word[1:])
        return str(writer.last_id)
    return word.removeprefix(_TEXT)


class _Writer:
    """Takes numbers and ids out of lines, one after the other.

    Numbers that have come before stay, as the dictionary has them.
    """

    def __init__(self) -> None:
        self.numbers: list[float] = []
        self.last_id = 0
        self._seen: set[str] = set()

    def text_of(self, lines: Sequence[str]) -> bytes:
        """What is left of lines, in UTF-8."""
        words = []
        for line in lines:
            for place, word in enumerate(_SPACE.split(line)):
                words.append(self._word_for(word, place in _ID_PLACES))
        return "".join(words).encode("utf-8")

    def _word_for(self, word: str, may_be_id: bool) -> str:
        if may_be_id and len(word) <= _LONGEST_ID and word.isdecimal() and str(int(word)) == word:
            before, self.last_id = self.last_id, int(word)
            return f"{_ID}{self.last_id - before}"
        if len(word) >= _FEWEST_LETTERS and word not in self._seen:
            self._seen.add(word)
            if _is_number(word):
                self.numbers.append(float(word))
                return _NUMBER
        return _TEXT + word if word.startswith((_NUMBER, _ID, _TEXT)) else word


def _is_number(word: str) -> bool:
    """Whether a word is that which Python writes for a double of usual size."""
    try:
        number = float(word)
    except ValueError:
        return False
    return 2.0**-32 <= abs(number) < 2.0**32 and repr(number) == word


def _packed(numbers: Sequence[float]) -> bytes:
    """Doubles of usual size in 59 bits each."""
    bits = np.array(numbers, dtype=np.float64).view(np.uint64)
    sign = bits >> np.uint64(63)
    size = (bits << np.uint64(1)) >> np.uint64(1)
    size -= np.uint64(_LEAST_EXPONENT << _MANTISSA_BITS)
    codes = sign << np.uint64(_BITS - 1) | size
    columns = np.unpackbits(codes.astype(">u8").view(np.uint8)).reshape(-1, 64)[:, -_BITS:]
    return np.packbits(columns).tobytes()


def _unpacked(data: bytes) -> list[float]:
    """The doubles in bytes."""
    count = 8 * len(data) // _BITS
    bits = np.unpackbits(np.frombuffer(data, np.uint8), count=count * _BITS)
    columns: NDArray[np.uint8] = np.zeros((count, 64), dtype=np.uint8)
    columns[:, -_BITS:] = bits.reshape(count, _BITS)
    codes = np.packbits(columns).view(">u8").astype(np.uint64)
    sign = codes >> np.uint64(_BITS - 1)
    size = codes & np.uint64((1 << (_BITS - 1)) - 1)
    size += np.uint64(_LEAST_EXPONENT << _MANTISSA_BITS)
    numbers: list[float] = (sign << np.uint64(63) | size).view(np.float64).tolist()
    return numbers
