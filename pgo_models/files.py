"""Text and tables read with our errors; files written whole or not at all, through a temporary one."""

import os
import secrets
import stat
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pgo_models.errors import FileFormatError, PGOError

LARGEST = 1e100  # beyond it squares and determinants would overflow; no measured number is near
FARTHEST = 1e15  # metres: beyond it neighbouring doubles are more than 0.1 m apart
_ZERO_QUATERNION = 1e-9  # a norm below this gives no direction: files hold about six digits
_BLOCK = 2**24  # bytes of a file that are taken apart at a time
LONGEST = 10_000  # characters of a line; an edge in space with all its digits has 750


def read_text(path: Path | str) -> str:
    """Text of a UTF-8 file, a pipe or a device; its lines end with LF, whatever they end with there (CRLF, CR).

    A FileFormatError when the file is missing, cannot be opened, or is not text.
    """
    return "".join(read_blocks(path))


def read_blocks(path: Path | str) -> Iterator[str]:
    """Yield what `read_text` reads, with its errors, in blocks of whole lines: a large file is never held as text."""
    path, before, encoding = Path(path), 0, "utf-8-sig"
    try:
        with path.open("rb") as file:
            while data := file.read(_BLOCK):
                data += file.readline()
                wrong = data.find(b"\0")
                try:
                    text = data.decode(encoding)
                except UnicodeDecodeError as error:
                    wrong = error.start
                if wrong >= 0:
                    problem = "bytes that are no text; give a text file, unpacked if it was compressed"
                    raise FileFormatError(path, before + data.count(b"\n", 0, wrong) + 1, problem)
                before, encoding = before + data.count(b"\n"), "utf-8"
                yield text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text
    except FileNotFoundError:
        raise FileFormatError(path, None, "no such file; check the path") from None
    except OSError as error:
        raise FileFormatError(path, None, f"cannot be read: {error.strerror}; give a readable file") from error


def check_length(path: Path | str, line: int, text: str) -> None:
    """Raise a FileFormatError when a line of numbers is longer than `LONGEST`: to take it apart takes minutes."""
    if len(text) > LONGEST:
        problem = f"{len(text)} characters, and no line of numbers has over {LONGEST}; break or remove it"
        raise FileFormatError(path, line, problem)


def check_metres(path: Path | str, lines: Sequence[int] | NDArray[np.int64], t: NDArray[np.float64]) -> None:
    """Raise a FileFormatError when a position or translation, (n, d), of these lines is beyond `FARTHEST`."""
    far = np.abs(t).max(axis=1, initial=0.0)
    if (far > FARTHEST).any():
        problem = f"{far.max():.3g} m is beyond {FARTHEST:g} m, where doubles tell no metres apart; correct the line"
        raise FileFormatError(path, int(lines[int(np.argmax(far))]), problem)


def check_quaternions(path: Path | str, lines: Sequence[int] | NDArray[np.int64], q: NDArray[np.float64]) -> None:
    """Raise a FileFormatError when a quaternion, (n, 4), of these lines is zero."""
    zero = np.linalg.norm(q, axis=1) < _ZERO_QUATERNION
    if zero.any():
        problem = "zero quaternion; it is no rotation: 0 0 0 1 is the unrotated one"
        raise FileFormatError(path, int(lines[int(np.argmax(zero))]), problem)


def finite_number(path: Path | str, line: int, word: str) -> float:
    """Value of a word like -1.5e-3; a FileFormatError when it is no number, or is nan, inf or beyond `LARGEST`."""
    try:
        # float() also takes 1_000 and the digits of other scripts; number files do not.
        value = float(word if word.isascii() and "_" not in word else "")
    except ValueError:
        raise FileFormatError(path, line, f"{word[:40]!r} is no number; correct or remove the line") from None
    if not np.isfinite(value):
        raise FileFormatError(path, line, f"{word[:40]} is not finite; correct or remove the line")
    if abs(value) > LARGEST:
        raise FileFormatError(path, line, f"{word[:40]} is beyond {LARGEST:g}; correct or remove the line")
    return value


def read_table(path: Path | str, columns: int) -> tuple[NDArray[np.float64], list[int]]:
    """Numbers (n, columns) of a text file with one row a line, and the line of every row, from 1.

    Blank lines and comments (#) are skipped. A FileFormatError with file:line, when a line has too few or too many
    numbers or is not all numbers; when there is no row.
    """
    text, rows, lines = read_text(path).removesuffix("\n").split("\n"), [], []
    if (table := _sound_table(text, columns)) is not None:
        return table, list(range(1, len(text) + 1))
    for number, line in enumerate(text, 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        check_length(path, number, line)
        rows.append([finite_number(path, number, word) for word in words])
        lines.append(number)
        if len(words) != columns:
            raise FileFormatError(path, number, f"{len(words)} numbers where {columns} belong; complete or remove it")
    if not rows:
        raise FileFormatError(path, None, f"no rows; give lines of {columns} numbers")
    return np.array(rows), lines


def _sound_table(lines: list[str], columns: int) -> NDArray[np.float64] | None:
    """Numbers of lines where each is a row of them and nothing else, by one call, or None."""
    if max(map(len, lines)) > LONGEST:
        return None
    try:
        with warnings.catch_warnings(action="error"):  # of lines that are all blank
            table = np.loadtxt(lines, comments=None, ndmin=2)
    except (ValueError, UserWarning):
        return None
    return table if table.shape == (len(lines), columns) and (np.abs(table) <= LARGEST).all() else None


@contextmanager
def replace_when_done(path: Path | str) -> Iterator[Path]:
    """Lend a temporary path in the same folder, and move it over `path` when the block ends without an error.

    A reader sees the old file or the whole new one, never a part; after an error nothing is left behind. A PGOError
    when the folder or the file cannot be written, or `path` is there and is no regular file.
    """
    with _temporary_beside(path) as (temporary, target):
        yield temporary
        os.replace(temporary, target)


def check_writable(path: Path | str) -> None:
    """Raise the PGOError that `replace_when_done` would for this path, before there is anything to write."""
    with _temporary_beside(path) as (temporary, _):
        temporary.touch()


@contextmanager
def _temporary_beside(path: Path | str) -> Iterator[tuple[Path, Path]]:
    """A new name in the folder of `path`, gone when the block ends, and `path` without links; errors become ours."""
    try:
        target = Path(path).resolve()
        with suppress(FileNotFoundError):
            if not stat.S_ISREG(target.stat().st_mode):
                raise PGOError(f"cannot write {path}: it is not a regular file; choose another name")
        # Of a long name the beginning, so that a name as long as the system allows can be written.
        temporary = target.with_name(f".{target.name[:40]}.{secrets.token_hex(4)}.part")
        try:
            yield temporary, target
        finally:
            # An error of clearing up would hide the one that brought us here.
            if temporary.exists():
                temporary.unlink()
    except OSError as error:
        raise PGOError(f"cannot write {path}: {error.strerror}; choose a place that can be written") from error
