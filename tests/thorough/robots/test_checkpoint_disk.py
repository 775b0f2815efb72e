import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from graphs import varied_graph
from robots import Killed

import pgo_models as pgo
import solvers
from pgo_models import PGOError
from pgo_models.errors import EngineError
from solvers import Checkpoint

pytestmark = pytest.mark.slow  # solves by robots from end to end

SUBSTRUCTURED = solvers.Pipeline(
    soc=solvers.SOC(coupling=solvers.Coupling.SUBSTRUCTURED, tolerance=1e-300)
)


@contextmanager
def full_disk_later() -> Iterator[Callable[[int], None]]:
    """What is called fills the disk: from then on a write beyond so many bytes of a file fails."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # an error, as on a full disk
    try:
        yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.skipif(sys.platform == "win32", reason="limits of the size of files are POSIX")
@pytest.mark.parametrize("size", [0, 5000])
@pytest.mark.parametrize("full_after", [20])
def test_a_full_disk_is_told_once_and_the_last_checkpoint_stays(size, full_after, tmp_path, caplog):
    path = tmp_path / "run.ckpt"
    graph = pgo.load("circle")
    seen = []

    def fill(state, record):
        seen.append(record.k)
        if len(seen) == full_after:
            fill_disk(size)
        if len(seen) == 40:
            raise Killed

    with full_disk_later() as fill_disk, pytest.raises(Killed):
        solvers.solve(
            graph,
            SUBSTRUCTURED,
            robots=solvers.Robots(3, checkpoint=Checkpoint(path, rounds=3)),
            callback=fill,
        )
    assert caplog.messages == [
        f"the solve goes on without a new checkpoint: cannot write {path}: File too large;"
        " choose a place that can be written"
    ]
    assert [one.name for one in tmp_path.iterdir()] == ["run.ckpt"]
    seen.clear()

    def look(state, record):
        seen.append(record.k)
        return True

    solvers.solve(
        graph, SUBSTRUCTURED, robots=solvers.Robots(3, checkpoint=Checkpoint(path)), callback=look
    )
    # it goes on from the last one before the disk was full
    assert full_after - 4 <= seen[0] < full_after


def test_where_nothing_can_be_written_is_told_before_the_solve(tmp_path):
    with pytest.raises(
        PGOError,
        match=r"cannot write .*missing/run\.ckpt: No such file or directory; choose a place",
    ):
        solvers.solve(
            varied_graph(9, 30, 2),
            robots=solvers.Robots(3, checkpoint=Checkpoint(tmp_path / "missing" / "run.ckpt")),
        )


def test_nothing_is_left_behind_when_the_robots_cannot_start(tmp_path):
    class Nowhere:
        def open(self, make, shares):
            raise EngineError("nowhere")

    with pytest.raises(EngineError, match="nowhere"):
        solvers.solve(
            varied_graph(9, 30, 2),
            robots=solvers.Robots(
                3, engine=Nowhere(), checkpoint=Checkpoint(tmp_path / "run.ckpt")
            ),
        )
    assert list(tmp_path.iterdir()) == []
