"""One run at a time on a file: an advisory lock of the operating system, which goes with its process however that ends.

The lock is on a file beside it (NAME.lock), since the file itself is replaced. One that a killed run left is free.
"""

import os
import sys
from contextlib import suppress
from pathlib import Path

from pgo_models.errors import FileFormatError, SettingError


class RunLock:
    """Lock of this run on a file."""

    def __init__(self, path: Path) -> None:
        """Take the lock.

        A SettingError when another run has it, a FileFormatError when the lock's file cannot be written.
        """
        path = path.resolve()  # as the file is replaced: a link stays one
        self._path = path.with_name(f"{path.name}.lock")
        try:
            while True:
                self._file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o666)
                is_taken = _lock(self._file)
                if is_taken and _is_same(self._file, self._path):
                    return
                os.close(self._file)
                if not is_taken:
                    raise SettingError(f"{path} is in use by another run; wait until that has ended, or name another")
        except OSError as error:
            problem = f"cannot be written ({error.strerror}); choose a place that can be written"
            raise FileFormatError(path, None, problem) from error

    def release(self) -> None:
        """Let other runs have it."""
        if sys.platform == "win32":
            os.close(self._file)  # an open file cannot be removed there, so nobody can have opened what is
        with suppress(OSError):  # somebody else's by now, or in a folder that became read-only: it does no harm
            self._path.unlink()
        if sys.platform != "win32":
            os.close(self._file)


def _lock(file: int) -> bool:
    """Whether an open file could be locked."""
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    return True


def _is_same(file: int, path: Path) -> bool:
    """Whether an open file is the one of that name: a run that ended may have removed it before we had the lock."""
    try:
        return os.path.samestat(os.fstat(file), path.stat())
    except FileNotFoundError:
        return False
