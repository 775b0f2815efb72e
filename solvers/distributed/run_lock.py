"""Lock that admits one run at a time to a file.

It is an advisory lock of the operating system, which is released when its process ends, in whatever
way. The lock is on a file beside it (NAME.lock), since the file itself is replaced. A lock file
that a killed run has left behind is free.
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

        Raises a SettingError if another run has it, and a FileFormatError if the lock file cannot
        be written.
        """
        path = path.resolve()  # the lock is beside the file, not beside a link to it
        self._path = path.with_name(f"{path.name}.lock")
        try:
            while True:
                self._file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o666)
                is_taken = _lock(self._file)
                if is_taken and _is_same(self._file, self._path):
                    return
                os.close(self._file)
                if not is_taken:
                    raise SettingError(
                        f"{path} is in use by another run; "
                        "wait until that has ended, or name another"
                    )
        except OSError as error:
            problem = f"cannot be written ({error.strerror}); choose a place that can be written"
            raise FileFormatError(path, None, problem) from error

    def release(self) -> None:
        """Release the lock for other runs."""
        if sys.platform == "win32":
            # Windows cannot remove an open file, so that no other run can have opened a file that
            # it removes.
            os.close(self._file)
        # The file may belong to another run by now, or its folder be read-only: neither does harm.
        with suppress(OSError):
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
    """Whether an open file still has this name.

    A run that ended may have removed it before this run took the lock.
    """
    try:
        return os.path.samestat(os.fstat(file), path.stat())
    except FileNotFoundError:
        return False
