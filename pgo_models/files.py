"""Text and tables read with our errors; files written whole or not at all, through a temporary one."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pgo_models.errors import FileFormatError, PGOError

LARGEST = 1e100  # beyond it squares and determinants would overflow; no measured number is near


def read_text(path: Path | str) -> str:
    """Text of a UTF-8 file.

    Raises
    ------
    FileFormatError
        When the file is missing, cannot be opened, or is not text.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise FileFormatError(path, None, "no such file; check the path") from None
    except OSError as error:
        raise FileFormatError(path, None, f"cannot be read: {error.strerror}; give a readable file") from error
    line = data.count(b"\n", 0, data.find(b"\0")) + 1 if b"\0" in data else None
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
    if line is not None:
        raise FileFormatError(path, line, "bytes that are no text; give a text file, unpacked if it was compressed")
    return text


def finite_number(path: Path | str, line: int, word: str) -> float:
    """Value of a word like -1.5e-3.

    Raises
    ------
    FileFormatError
        When the word is no number, or is nan, inf or beyond `LARGEST`.
    """
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

    Blank lines and comments (#) are skipped.

    Raises
    ------
    FileFormatError
        With file:line, when a line has too few or too many numbers or is not all numbers; when there is no row.
    """
    rows, lines = [], []
    for number, line in enumerate(read_text(path).split("\n"), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        rows.append([finite_number(path, number, word) for word in words])
        lines.append(number)
        if len(words) != columns:
            raise FileFormatError(path, number, f"{len(words)} numbers where {columns} belong; complete or remove it")
    if not rows:
        raise FileFormatError(path, None, f"no rows; give lines of {columns} numbers")
    return np.array(rows), lines


@contextmanager
def replace_when_done(path: Path | str) -> Iterator[Path]:
    """Lend a temporary path in the same folder, and move it over `path` when the block ends without an error.

    A reader sees the old file or the whole new one, never a part; after an error nothing is left behind.

    Raises
    ------
    PGOError
        When the folder or the file cannot be written, or `path` is there and is no regular file.

    Examples
    --------
    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> with replace_when_done(folder / "one.txt") as temporary:
    ...     _ = temporary.write_text("1")
    >>> [file.name for file in folder.iterdir()]
    ['one.txt']
    """
    target = Path(path).resolve()
    if target.exists() and not target.is_file():
        raise PGOError(f"cannot write {path}: it is not a regular file; choose another name")
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
    try:
        try:
            yield temporary
            os.replace(temporary, target)
        finally:
            # An error of clearing up would hide the one that brought us here.
            if temporary.exists():
                temporary.unlink()
    except OSError as error:
        raise PGOError(f"cannot write {path}: {error.strerror}; choose a place that can be written") from error
