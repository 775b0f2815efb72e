import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from graphs import LOUD_NOISE, varied_graph

import pgo_models as pgo
import solvers
from pgo_models.errors import FileFormatError, SettingError
from pgo_models.partition import partition
from solvers.checkpoint import Checkpoint
from solvers.choices import BackEnd, Method, chosen_partition, chosen_pipeline
from solvers.engine import InProcess

PGO = [sys.executable, "-c", "from solvers.cli import main; main()"]


class Killed(BaseException):
    """Ends a solve as a kill does: nothing of ours catches it."""


def killed_after(steps):
    """Callback that ends the run at the given state, counted over all stages."""
    seen = []

    def callback(state, record):
        seen.append(record.k)
        if len(seen) > steps:
            raise Killed

    return callback


def pipeline(coupling, robots, gap=1e-6):
    chosen = solvers.Pipeline(gap=gap, staircase=None)
    return replace(chosen, soc=replace(chosen.soc, coupling=coupling, robots=robots, tolerance=1e-6))


def assert_same(found, expected):
    np.testing.assert_array_equal(found.poses.R, expected.poses.R)
    np.testing.assert_array_equal(found.poses.t, expected.poses.t)
    assert (found.lower_bound, found.status) == (expected.lower_bound, expected.status)
    assert found.ledger.rounds == expected.ledger.rounds
    assert found.ledger.all_reduces == expected.ledger.all_reduces
    assert [stage.name for stage in found.stages] == [stage.name for stage in expected.stages]
    for one, other in zip(found.stages, expected.stages, strict=True):
        assert (one.iterations, one.status, one.objective) == (other.iterations, other.status, other.objective)
        assert repr(one.method) == repr(other.method)
        np.testing.assert_array_equal(one.history.objective, other.history.objective)
        assert (np.diff(one.history.seconds) >= 0).all()


@pytest.mark.parametrize("coupling", [solvers.Coupling.SUBSTRUCTURED, solvers.Coupling.CONSENSUS])
@pytest.mark.parametrize("part", [0.0, 0.3, 0.7, 1.0])
def test_a_run_that_was_broken_off_goes_on_to_the_same_numbers(coupling, part, tmp_path):
    graph = varied_graph(int(10 * part), 50, 3)
    robots = partition(graph, 4)
    settings = pipeline(coupling, robots)
    expected = solvers.solve(graph, settings, robots=robots)
    steps = sum(len(stage.history) for stage in expected.stages)
    checkpoint = Checkpoint(tmp_path / "run.ckpt", rounds=3)
    after = round(part * (steps - 1))
    with pytest.raises(Killed):
        solvers.solve(graph, settings, robots=robots, checkpoint=checkpoint, callback=killed_after(after))
    seen = []
    found = solvers.solve(
        graph,
        settings,
        robots=robots,
        checkpoint=checkpoint,
        engine=InProcess(threads=2),
        callback=lambda state, record: seen.append(record.k),
    )
    assert_same(found, expected)
    assert steps - after <= len(seen) <= steps - after + 3  # three rounds are three steps at most
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("part", [0.3, 0.8])
def test_a_second_attempt_goes_on_too(part, tmp_path):
    graph = varied_graph(5, 14, 2, LOUD_NOISE)
    settings = pipeline(solvers.Coupling.SUBSTRUCTURED, None, gap=1e-300)
    settings = replace(settings, soc=replace(settings.soc, tolerance=1e-2))
    expected = solvers.solve(graph, settings, robots=3)
    assert [stage.name for stage in expected.stages] == 2 * ["chordal start", "SOC", "Newton"]
    first = sum(len(stage.history) for stage in expected.stages[:3])
    second = sum(len(stage.history) for stage in expected.stages[3:])
    checkpoint, after = Checkpoint(tmp_path / "run.ckpt", rounds=1), first + round(part * (second - 1))
    with pytest.raises(Killed):
        solvers.solve(graph, settings, robots=3, checkpoint=checkpoint, callback=killed_after(after))
    seen = []
    found = solvers.solve(
        graph, settings, robots=3, checkpoint=checkpoint, callback=lambda state, record: seen.append(record.k)
    )
    assert_same(found, expected)
    assert len(seen) <= first + second - after + 1


def test_without_soc_newton_goes_on(tmp_path):
    graph = varied_graph(7, 60, 3)
    settings = solvers.Pipeline(soc=None)
    expected = solvers.solve(graph, settings, robots=3)
    checkpoint = Checkpoint(tmp_path / "run.ckpt", rounds=1)
    with pytest.raises(Killed):
        solvers.solve(graph, settings, robots=3, checkpoint=checkpoint, callback=killed_after(1))
    assert_same(solvers.solve(graph, settings, robots=3, checkpoint=checkpoint), expected)


def test_the_file_stays_when_the_run_was_stopped_and_goes_when_it_converged(tmp_path):
    graph, path = varied_graph(8, 40, 2), tmp_path / "run.ckpt"
    stopped = solvers.solve(graph, robots=2, checkpoint=Checkpoint(path), time_limit=1e-9)
    assert stopped.status is solvers.Status.TIME_LIMIT
    assert path.exists()
    found = solvers.solve(graph, robots=2, checkpoint=Checkpoint(path))
    assert_same(found, solvers.solve(graph, robots=2))
    assert not path.exists()


@pytest.fixture
def broken_off(tmp_path):
    """Graph, and path of the checkpoint of a solve of it by three robots."""
    graph, path = varied_graph(9, 30, 2), tmp_path / "run.ckpt"
    with pytest.raises(Killed):
        solvers.solve(graph, robots=3, checkpoint=Checkpoint(path), callback=killed_after(2))
    return graph, path


def test_another_graph_partition_or_setting_is_refused(broken_off):
    graph, path = broken_off
    moved = graph.t_ij.copy()
    moved[0, 0] += 1e-9
    changes = {
        "graph": ({"problem": replace(graph, t_ij=moved)}),
        "partition": ({"robots": 2}),
        "settings": ({"pipeline": solvers.Pipeline(gap=1e-5)}),
    }
    for name, change in changes.items():
        arguments = {"problem": graph, "robots": 3, "checkpoint": Checkpoint(path), **change}
        with pytest.raises(SettingError, match=rf"run with another {name}; go on with the same"):
            solvers.solve(**arguments)
        assert path.exists()


@pytest.mark.parametrize("damage", ["text", "half", "empty", "array", "npz", "directory"])
def test_a_file_that_is_no_checkpoint_is_refused_and_left_alone(damage, broken_off):
    graph, path = broken_off
    whole = path.read_bytes()
    if damage == "npz":
        with path.open("wb") as file:
            np.savez(file, header=np.array(["another", "a", "b", "c"]))
    elif damage == "array":
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    elif damage == "directory":
        path.unlink()
        path.mkdir()
    else:
        path.write_bytes({"text": b"VERTEX_SE2 0 0 0 0\n", "half": whole[: len(whole) // 2], "empty": b""}[damage])
    with pytest.raises(FileFormatError, match=r"run\.ckpt: (no checkpoint|cannot be read)"):
        solvers.solve(graph, robots=3, checkpoint=Checkpoint(path))
    assert path.exists()


def test_a_checkpoint_holds_no_pickle(broken_off):
    with np.load(broken_off[1], allow_pickle=False) as file:
        assert {file[name].dtype.kind for name in file.files} <= set("fiUb")


def test_rounds_are_positive():
    with pytest.raises(SettingError, match="rounds must be at least 1, got 0"):
        Checkpoint("run.ckpt", rounds=0)


def test_a_killed_process_goes_on_where_it_was(tmp_path):
    iterations, path = 250, tmp_path / "run.ckpt"
    options = ["--robots", "3", "--tolerance", "1e-300", "--max-iterations", str(iterations), "--resume", str(path)]
    environment = {**os.environ, "PYTHONPATH": str(Path(solvers.__file__).parent.parent)}
    process = subprocess.Popen([*PGO, "solve", "circle", *options], env=environment, stdout=subprocess.DEVNULL)
    written, deadline = set(), time.monotonic() + 60
    while len(written) < 3:  # checkpoints, each a new file: the run is in the middle of SOC
        assert process.poll() is None, "the run ended before it was killed"
        assert time.monotonic() < deadline, "no checkpoints are written"
        time.sleep(1e-3)
        if path.exists():
            written.add(path.stat().st_mtime_ns)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    graph = pgo.load("circle")
    robots = chosen_partition(graph, 3, None)
    settings = chosen_pipeline(Method.SUBSTRUCTURED, robots, BackEnd.FACTORIZED, 1e-6, iterations, 1e-300)
    expected = solvers.solve(graph, settings, robots=robots)
    seen = []
    found = solvers.solve(
        graph,
        settings,
        robots=robots,
        checkpoint=Checkpoint(path),
        callback=lambda state, record: seen.append(record.k),
    )
    np.testing.assert_allclose(found.objective, expected.objective, rtol=1e-8, atol=0)
    assert found.is_certified
    soc = next(stage for stage in found.stages if stage.name == "SOC")
    assert soc.iterations == iterations
    assert seen[0] >= 10  # the first state after the resume is not the start
    assert len(seen) < len(soc.history)
