"""Text and tables that are read with our errors, and files that are written whole or not at all."""

import gzip
import io
import json
import os
import re
import secrets
import stat
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from pgo_models.errors import FileFormatError, PGOError, printable

LARGEST = 1e100  # beyond it squares and determinants would overflow; no measured number is near
FARTHEST = 1e15  # metres: beyond it neighbouring doubles are more than 0.1 m apart
LONGEST = 10_000  # characters of a line of numbers; an edge in space with all its digits has 750
LONGEST_OF_ALL = 2**16  # bytes of any line, comments included
_EQUAL_LINES = 3  # with a problem of one kind, each of which is named
_NUMBER = re.compile(r"(?<!\w)[-+]?\d[\w.,+-]*")  # of a problem, which is of a kind without it
_NAMED_LINES = 20  # wrong lines of a file that an error names
_ZERO_QUATERNION = 1e-9  # a norm below this gives no direction: files hold about six digits
BLOCK = 2**24  # bytes of a file that are split into lines at a time
_SHOWN = 40  # characters of a wrong word that a message shows
_LF, _CR = b"\n\r"
_GZIP = b"\x1f\x8b"  # first bytes of a file that is compressed by gzip

Problem = tuple[int, str]  # a line of a file, from 1, and what is wrong with it
Lines = Sequence[int] | NDArray[np.integer[Any]]


def read_text(path: Path | str, block: int = BLOCK) -> str:
    """Text of a UTF-8 file, a pipe or a device, with lines that end with LF.

    Lines of the file may end with CR LF or CR, too. A FileFormatError when the file is missing,
    cannot be opened, or is not text.
    """
    return "".join(read_blocks(path, block))


def read_blocks(path: Path | str, block: int = BLOCK) -> Iterator[str]:
    """Yield what `read_text` reads in blocks of whole lines, so that no large file is held as text.

    A file that is compressed by gzip is unpacked. Errors are those of `read_text`. A
    FileFormatError, too, where a line is longer than `LONGEST_OF_ALL`, as no line of a text file
    is.
    """
    path = Path(path)
    encoding = "utf-8-sig"  # the first block may open with a byte order mark
    num_lines = 0  # lines of the blocks so far
    try:
        with path.open("rb") as file:
            for data in _whole_lines(_unpacked(file), path, block):
                _check_lines(path, num_lines, data)
                try:
                    text = data.decode(encoding)
                except UnicodeDecodeError as error:
                    raise _no_text(path, num_lines, data[: error.start]) from None
                encoding = "utf-8"
                num_lines += _count_lines(data)
                if "\r" in text:
                    text = text.replace("\r\n", "\n").replace("\r", "\n")
                yield text
    except FileNotFoundError:
        raise FileFormatError(path, None, "no such file; check the path") from None
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        problem = "gzip cannot unpack it, as it is cut off or damaged; compress it again"
        raise FileFormatError(path, None, problem) from error
    except OSError as error:
        raise FileFormatError(
            path, None, f"cannot be read: {error.strerror}; give a readable file"
        ) from error


def _unpacked(file: io.BufferedReader) -> BinaryIO:
    """The file itself, or what it unpacks to if it is compressed by gzip."""
    is_compressed = file.peek(len(_GZIP)).startswith(_GZIP)
    return cast(BinaryIO, gzip.GzipFile(fileobj=file)) if is_compressed else file


def _whole_lines(file: BinaryIO, path: Path, block: int) -> Iterator[bytes]:
    """Yield blocks of a file that end where a line ends, except perhaps the last one.

    Little more than one block is held at a time.
    """
    begun_line = b""
    num_lines = 0  # lines of the blocks so far
    while chunk := file.read(block):
        data = begun_line + chunk
        # A CR at the very end may be the first half of CR LF.
        end = max(data.rfind(b"\n"), data.rfind(b"\r", 0, len(data) - 1)) + 1
        whole_lines = data[:end]
        begun_line = data[end:]
        if len(begun_line) > LONGEST_OF_ALL:
            _check_lines(path, num_lines, data)  # raises the error of the first wrong line
        num_lines += _count_lines(whole_lines)
        if whole_lines:
            yield whole_lines
    if begun_line:
        yield begun_line


def _check_lines(path: Path, num_lines: int, data: bytes) -> None:
    """Raise a FileFormatError when bytes of a file are no text, or a line is too long.

    `num_lines` is how many lines of the file come before them.
    """
    zero = data.find(b"\0")
    if zero >= 0:
        raise _no_text(path, num_lines, data[:zero])
    codes = np.frombuffer(data, dtype=np.uint8)
    line_ends = np.flatnonzero((codes == _LF) | (codes == _CR))
    ends = np.concatenate([[-1], line_ends, [len(codes)]])
    lengths = np.diff(ends) - 1
    if lengths.max() > LONGEST_OF_ALL:
        start = int(ends[np.argmax(lengths > LONGEST_OF_ALL)]) + 1
        line = num_lines + _count_lines(data[:start]) + 1
        raise FileFormatError(
            path,
            line,
            f"a line of more than {LONGEST_OF_ALL} bytes; give a text file, with its line ends",
        )


def _no_text(path: Path, num_lines: int, bytes_before: bytes) -> FileFormatError:
    """Error of a byte that is no text, with the lines and bytes that come before it."""
    problem = "bytes that are no text; give a text file, unpacked if it was compressed"
    return FileFormatError(path, num_lines + _count_lines(bytes_before) + 1, problem)


def _count_lines(data: bytes) -> int:
    """How many lines end in the data: with LF, CR or both."""
    num_lines = data.count(b"\n")
    if b"\r" in data:  # to look for both in a row takes ten times as long
        num_lines += data.count(b"\r") - data.count(b"\r\n")
    return num_lines


def json_of(path: Path | str, text: str | None, what: str) -> Any:  # noqa: ANN401
    """Value of JSON text, of the file unless given, whose lines may be of any length.

    A FileFormatError where the file cannot be read or is no JSON; `what` it should be ends it.
    """
    path = Path(path)
    try:
        return json.loads(path.read_bytes() if text is None else text)
    except FileNotFoundError:
        raise FileFormatError(path, None, "no such file; check the path") from None
    except OSError as error:
        problem = f"cannot be read: {error.strerror}; give a readable file"
        raise FileFormatError(path, None, problem) from error
    except UnicodeDecodeError:
        raise FileFormatError(path, None, f"bytes that are no text; give {what}") from None
    except (json.JSONDecodeError, RecursionError) as error:
        line = error.lineno if isinstance(error, json.JSONDecodeError) else None
        raise FileFormatError(path, line, f"no JSON ({error}); give {what}") from None


def check_lines(
    path: Path | str, problems: Sequence[Problem], unit: str = "lines", hint: str = ""
) -> None:
    """Raise a FileFormatError when there are problems in the lines of a file.

    It has `file:line: problem` for each of the first 20 wrong lines, and their number. Problems
    that differ in their numbers alone are of one kind, and where more than three lines have one,
    it is said of the first, with a count. Of several problems of a line the first is named. `unit`
    is what is counted in place of lines, and `hint` ends the message.
    """
    if not problems:
        return
    problem_of_line: dict[int, str] = {}
    for line, problem in problems:
        problem_of_line.setdefault(line, problem)
    lines_of_kind: dict[str, list[int]] = {}
    for line in sorted(problem_of_line):
        kind = _NUMBER.sub("", problem_of_line[line])
        lines_of_kind.setdefault(kind, []).append(line)
    place = printable(str(path))
    text_of_line: dict[int, str] = {}
    for lines in lines_of_kind.values():
        if len(lines) > _EQUAL_LINES:
            text = f"{problem_of_line[lines[0]]}\nso are {len(lines) - 1} more {unit}, "
            text_of_line[lines[0]] = f"{text}up to {place}:{lines[-1]}"
        else:
            text_of_line |= {line: problem_of_line[line] for line in lines}
    first, *named = sorted(text_of_line)[:_NAMED_LINES]
    texts = [text_of_line[first], *(f"{place}:{line}: {text_of_line[line]}" for line in named)]
    if len(text_of_line) > _NAMED_LINES:
        texts.append(f"{len(problem_of_line)} {unit} are wrong; the first {len(texts)} are named")
    elif named:
        texts.append(f"{len(problem_of_line)} {unit} are wrong")
    raise FileFormatError(path, first, "\n".join(texts) + hint)


def check_length(path: Path | str, line: int, text: str) -> None:
    """Raise a FileFormatError when a line of numbers is longer than `LONGEST`.

    Minutes pass before a line of some megabytes is split into numbers.
    """
    if len(text) > LONGEST:
        problem = (
            f"{len(text)} characters, and no line of numbers has over {LONGEST}; break or remove it"
        )
        raise FileFormatError(path, line, problem)


def far_lines(lines: Lines, t: NDArray[np.float64]) -> list[Problem]:
    """Problems of positions or translations, (n, d), that are beyond `FARTHEST`.

    Row k of t stands on line `lines[k]`.
    """
    distance = np.abs(t).max(axis=1, initial=0.0)
    problems = []
    for row in np.flatnonzero(distance > FARTHEST).tolist():
        problem = (
            f"{distance[row]:.3g} m is beyond {FARTHEST:g} m, "
            "where doubles tell no metres apart; correct the line"
        )
        problems.append((int(lines[row]), problem))
    return problems


def zero_quaternion_lines(lines: Lines, q: NDArray[np.float64]) -> list[Problem]:
    """Problems of quaternions, (n, 4), that are zero; row k of q stands on line `lines[k]`."""
    is_zero = np.linalg.norm(q, axis=1) < _ZERO_QUATERNION
    problem = "zero quaternion; it is no rotation: 0 0 0 1 is the unrotated one"
    return [(int(lines[row]), problem) for row in np.flatnonzero(is_zero).tolist()]


def finite_number(path: Path | str, line: int, word: str) -> float:
    """Value of a word like -1.5e-3.

    A FileFormatError when it is no number, or is nan, inf or beyond `LARGEST`.
    """
    way_out = "correct or remove the line"
    shown = word[:_SHOWN]
    try:
        # float() also takes 1_000 and the digits of other scripts; number files do not.
        value = float(word if word.isascii() and "_" not in word else "")
    except ValueError:
        if "," in word:
            way_out = "write it with a decimal point, and separate numbers by blanks, not by commas"
        raise FileFormatError(path, line, f"{shown!r} is no number; {way_out}") from None
    if not np.isfinite(value):
        raise FileFormatError(path, line, f"{shown} is not finite; {way_out}")
    if abs(value) > LARGEST:
        raise FileFormatError(path, line, f"{shown} is beyond {LARGEST:g}; {way_out}")
    return value


def read_table(path: Path | str, columns: int) -> tuple[NDArray[np.float64], list[int]]:
    """Numbers (n, columns) of a text file with one row a line, and the line of every row, from 1.

    Blank lines and comments (#) are skipped. A FileFormatError names the lines that have too few or
    too many numbers or are not all numbers; also when there is no row.
    """
    lines = read_text(path).removesuffix("\n").split("\n")
    rows = []
    row_lines = []
    problems: list[Problem] = []
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            check_length(path, number, line)
            row = [finite_number(path, number, word) for word in words]
        except FileFormatError as error:
            problems.append((number, error.problem))
            continue
        if len(row) != columns:
            problem = f"{len(row)} numbers where {columns} belong; complete or remove it"
            problems.append((number, problem))
        rows.append(row)
        row_lines.append(number)
    check_lines(path, problems)
    if not rows:
        raise FileFormatError(path, None, f"no rows; give lines of {columns} numbers")
    return np.array(rows), row_lines


@contextmanager
def replace_when_done(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path, and move its file over `path` when the block ends without an error.

    A reader sees the old file or the whole new one, never a part; after an error nothing is left
    behind. A PGOError when the folder or the file cannot be written, or `path` exists and is no
    regular file. A file that exists keeps its mode; of a link, what it points to is written.
    """
    with _temporary_beside(path) as (temporary, target):
        yield temporary
        with suppress(FileNotFoundError):
            temporary.chmod(stat.S_IMODE(target.stat().st_mode))
        os.replace(temporary, target)


def check_writable(path: Path | str) -> None:
    """Raise what `replace_when_done` would for this path, before there is anything to write."""
    with _temporary_beside(path) as (temporary, _):
        temporary.touch()


def _without_links(path: Path | str) -> Path:
    """Where a path leads; a PGOError where links lead in a circle."""
    try:
        return Path(path).resolve()
    except RuntimeError as error:  # of Python before 3.13
        raise PGOError(
            f"cannot write {path}: its links lead in a circle; choose another name"
        ) from error


@contextmanager
def _temporary_beside(path: Path | str) -> Iterator[tuple[Path, Path]]:
    """Yield a new name in the folder of `path`, and `path` without links; errors become ours.

    A file of the new name is removed when the block ends.
    """
    try:
        target = _without_links(path)
        with suppress(FileNotFoundError):
            if not stat.S_ISREG(target.stat().st_mode):
                raise PGOError(
                    f"cannot write {path}: it is not a regular file; choose another name"
                )
        # A long name is cut, so that a name as long as the system allows can be written.
        temporary = target.with_name(f".{target.name[:40]}.{secrets.token_hex(4)}.part")
        try:
            yield temporary, target
        finally:
            # unlink() of a missing file would raise, and hide an error of the block.
            if temporary.exists():
                temporary.unlink()
    except OSError as error:
        raise PGOError(
            f"cannot write {path}: {error.strerror}; choose a place that can be written"
        ) from error
