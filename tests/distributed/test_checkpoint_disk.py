import os
import subprocess
import sys
from pathlib import Path

import pytest
from graphs import varied_graph

import pgo_models as pgo
import solvers
from pgo_models.errors import EngineError, FileFormatError
from solvers.distributed.checkpoint import Checkpoint

pytestmark = pytest.mark.slow  # solves by robots from end to end

LIMITED = """
import resource, signal, sys
import pgo_models as pgo, solvers
# A write beyond the limit is an error, as on a full disk.
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
graph, seen = pgo.load("circle"), []
def fill(state, record):
    seen.append(record.k)
    if len(seen) == int(sys.argv[2]):
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]), resource.RLIM_INFINITY))
    if len(seen) == 40:
        raise SystemExit(7)
soc = solvers.SOC(coupling=solvers.Coupling.SUBSTRUCTURED, tolerance=1e-300)
checkpoint = solvers.Checkpoint(sys.argv[1], rounds=3)
solvers.solve(graph, solvers.Pipeline(soc=soc), robots=3, checkpoint=checkpoint, callback=fill)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="limits of the size of files are POSIX")
@pytest.mark.parametrize("size", [0, 60, 5000, 30_000])
@pytest.mark.parametrize("full_after", [1, 20])
def test_a_full_disk_is_told_once_and_the_last_checkpoint_stays(size, full_after, tmp_path):
    path = tmp_path / "run.ckpt"
    command = [sys.executable, "-c", LIMITED, str(path), str(full_after), str(size)]
    environment = {**os.environ, "PYTHONPATH": str(Path(solvers.__file__).parent.parent)}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 7, ended.stderr
    assert (
        ended.stderr
        == f"the solve goes on without a new checkpoint: cannot write {path}: File too large;"
        " choose a place that can be written\n"
    )
    assert [one.name for one in tmp_path.iterdir()] == ["run.ckpt"]
    graph = pgo.load("circle")
    seen = []
    soc = solvers.SOC(coupling=solvers.Coupling.SUBSTRUCTURED, tolerance=1e-300)

    def look(state, record):
        seen.append(record.k)
        return True

    solvers.solve(
        graph, solvers.Pipeline(soc=soc), robots=3, checkpoint=Checkpoint(path), callback=look
    )
    # it goes on from the last one before the disk was full
    assert full_after - 4 <= seen[0] < full_after


def test_where_nothing_can_be_written_is_told_before_the_solve(tmp_path):
    with pytest.raises(
        FileFormatError, match=r"missing/run\.ckpt: cannot be written \(No such file or directory\)"
    ):
        solvers.solve(
            varied_graph(9, 30, 2),
            robots=3,
            checkpoint=Checkpoint(tmp_path / "missing" / "run.ckpt"),
        )


def test_the_lock_is_let_go_when_the_robots_cannot_start(tmp_path):
    class Nowhere:
        def open(self, make, shares):
            raise EngineError("nowhere")

    with pytest.raises(EngineError, match="nowhere"):
        solvers.solve(
            varied_graph(9, 30, 2),
            robots=3,
            engine=Nowhere(),
            checkpoint=Checkpoint(tmp_path / "run.ckpt"),
        )
    assert list(tmp_path.iterdir()) == []
