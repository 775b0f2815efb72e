"""The errors of the project: one tree, each message with what was wrong, where, the value and the way out."""

from __future__ import annotations

from pathlib import Path


class PGOError(Exception):
    """Root of every error that a wrong input or a missing piece raises here."""


class GraphError(PGOError):
    """A pose graph, or poses, that cannot be what they claim to be."""


class SettingError(PGOError, ValueError):
    """A setting of a solver, a model or a scene that is out of its range."""


class FileFormatError(PGOError):
    """A file that cannot be read; the message opens with `file:line`."""

    def __init__(self, path: Path | str, line: int | None, problem: str) -> None:
        """Say where (`path`, 1-based `line`) and what (`problem`, with the value and the way out)."""
        where = f"{path}" if line is None else f"{path}:{line}"
        super().__init__(f"{where}: {problem}")
        self.path = Path(path)
        self.line = line


class DatasetError(PGOError):
    """A named data set that is nowhere to be found, or whose checksum does not fit."""


class NotPositiveDefiniteError(PGOError):
    """A matrix that should have a Cholesky factorisation has none."""


class MissingExtraError(PGOError):
    """An optional dependency is not installed; the message names the extra."""

    def __init__(self, package: str, extra: str) -> None:
        """Name the missing `package` and the `extra` that brings it."""
        super().__init__(f"{package} is not installed; run: pip install 'pgo-splitting[{extra}]'")
        self.extra = extra
