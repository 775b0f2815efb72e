import os
import subprocess
import sys
from pathlib import Path

import pytest

import solvers
from pgo_models.errors import FileFormatError, SettingError
from solvers.distributed import run_lock
from solvers.distributed.run_lock import RunLock


def test_the_next_run_has_it_after_the_first_and_nothing_stays_behind(tmp_path):
    first = RunLock(tmp_path / "a")
    other = RunLock(tmp_path / "b")
    with pytest.raises(SettingError, match=r"a is in use by another run; wait until"):
        RunLock(tmp_path / "a")
    first.release()
    RunLock(tmp_path / "a").release()
    other.release()
    assert list(tmp_path.iterdir()) == []


def next_descriptor():
    descriptor = os.open(os.devnull, os.O_RDONLY)
    os.close(descriptor)
    return descriptor


def test_refusals_and_releases_leave_no_file_open(tmp_path):
    before = next_descriptor()
    lock = RunLock(tmp_path / "a")
    held = next_descriptor()
    with pytest.raises(SettingError, match="in use"):
        RunLock(tmp_path / "a")
    assert next_descriptor() == held
    lock.release()
    assert next_descriptor() == before


def test_a_lock_that_is_removed_before_it_is_had_is_none(tmp_path, monkeypatch):
    first = RunLock(tmp_path / "a")
    taken = []
    lock = run_lock._lock

    def slow(file):
        monkeypatch.setattr(run_lock, "_lock", lock)
        first.release()
        # a third run, on a new file; `file` is of the one that was removed
        taken.append(RunLock(tmp_path / "a"))
        return lock(file)

    monkeypatch.setattr(run_lock, "_lock", slow)
    with pytest.raises(SettingError, match="in use"):
        RunLock(tmp_path / "a")
    taken[0].release()
    assert list(tmp_path.iterdir()) == []


def test_it_goes_with_a_process_that_dies(tmp_path):
    program = f"""
import os
from pathlib import Path
from solvers.distributed.run_lock import RunLock
RunLock(Path({str(tmp_path / "a")!r}))
os._exit(9)
"""
    environment = {**os.environ, "PYTHONPATH": str(Path(solvers.__file__).parent.parent)}
    assert (
        subprocess.run([sys.executable, "-c", program], env=environment, check=False).returncode
        == 9
    )
    assert [file.name for file in tmp_path.iterdir()] == ["a.lock"]
    RunLock(tmp_path / "a").release()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_none_is_named(tmp_path):
    (tmp_path / "file").touch()
    for folder, reason in (("missing", "No such file or directory"), ("file", "Not a directory")):
        with pytest.raises(FileFormatError, match=rf"{folder}/a: cannot be written \({reason}\)"):
            RunLock(tmp_path / folder / "a")
