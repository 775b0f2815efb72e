import hashlib
import io
import os
import pickle
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from graphs import varied_graph
from hypothesis import HealthCheck, given, settings as hypothesis_settings, strategies as st
from processes import long_run
from robots import Killed, Recording

import pgo_models as pgo
import solvers
from pgo_models import partition
from pgo_models.errors import FileFormatError, SettingError
from solvers import Checkpoint, InProcess
from solvers.carry.serialization import deserialize
from solvers.riemannian.prefixes import GrowingStart
from solvers.robots.checkpoint import Journal
from solvers.soc.soc import WARM_START

pytestmark = pytest.mark.slow  # solves by robots from end to end

MEASURED = ("R_ij", "t_ij", "kappa", "tau")


def killed_after(steps):
    """Callback that ends the run at the given state, counted over all stages."""
    seen = []

    def callback(state, record):
        seen.append(record.k)
        if len(seen) > steps:
            raise Killed

    return callback


def pipeline(coupling, robots, gap=1e-6):
    """Settings of SOC with a coupling, or of PaperSOC."""
    if coupling is None:
        soc = solvers.PaperSOC(robots=robots, tolerance=1e-6, max_iterations=60)
    else:
        soc = replace(WARM_START, coupling=coupling, robots=robots, tolerance=1e-6)
    return solvers.Pipeline(soc=soc, gap=gap, growing=None, staircase=None)


def assert_same(found, expected):
    np.testing.assert_array_equal(found.poses.R, expected.poses.R)
    np.testing.assert_array_equal(found.poses.t, expected.poses.t)
    assert (found.lower_bound, found.status) == (expected.lower_bound, expected.status)
    assert found.ledger.rounds == expected.ledger.rounds
    assert found.ledger.all_reduces == expected.ledger.all_reduces
    assert [stage.name for stage in found.stages] == [stage.name for stage in expected.stages]
    for one, other in zip(found.stages, expected.stages, strict=True):
        assert (one.iterations, one.status, one.objective) == (
            other.iterations,
            other.status,
            other.objective,
        )
        assert repr(one.method) == repr(other.method)
        np.testing.assert_array_equal(one.history.objective, other.history.objective)
        assert (np.diff(one.history.seconds) >= 0).all()


@pytest.mark.parametrize("stage", ["SOC", "PaperSOC", "Newton"])
def test_a_robot_in_a_new_process_goes_on_wherever_it_was(stage, tmp_path):
    """The new process has done nothing before: it has imported the robot alone."""
    engine = Recording()
    soc = solvers.PaperSOC() if stage == "PaperSOC" else solvers.SOC()
    calls = {"SOC": 2, "PaperSOC": 2, "Newton": 1}

    def callback(state, record):
        is_newton = "Newton" in type(state).__name__
        return is_newton == (stage == "Newton") and record.k >= calls[stage]

    robots = solvers.Robots(2, engine=engine)
    solvers.solve(pgo.load("grid"), solvers.Pipeline(soc=soc), robots=robots, callback=callback)
    agent = engine.agents[0]
    path = tmp_path / "robot"
    path.write_bytes(pickle.dumps((agent.subgraph, deserialize(agent.snapshot()))))
    code = (
        "import pickle, sys; from solvers.robots.agent import Agent\n"
        "subgraph, record = pickle.load(open(sys.argv[1], 'rb'))\n"
        "agent = Agent(subgraph); agent.restore(record)\n"
        "print(agent.interior.poses.t.tolist(), type(agent.interior.state.session).__name__)"
    )
    ended = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True)
    interior = agent.interior
    expected = f"{interior.poses.t.tolist()} {type(interior.state.session).__name__}"
    assert ended.stdout.strip() == expected, ended.stderr


@pytest.mark.parametrize(
    "coupling", [solvers.Coupling.SUBSTRUCTURED, solvers.Coupling.CONSENSUS, None]
)
@pytest.mark.parametrize("part", [0.3, 1.0])
def test_a_run_that_was_broken_off_goes_on_to_the_same_numbers(coupling, part, tmp_path):
    graph = varied_graph(int(10 * part), 50, 3)
    robots = partition(graph, 4)
    settings = pipeline(coupling, robots)
    expected = solvers.solve(graph, settings, robots=robots)
    steps = sum(len(stage.history) for stage in expected.stages)
    checkpoint = Checkpoint(tmp_path / "run.ckpt", rounds=3)
    after = round(part * (steps - 1))
    with pytest.raises(Killed):
        solvers.solve(
            graph,
            settings,
            robots=solvers.Robots(robots, checkpoint=checkpoint),
            callback=killed_after(after),
        )
    seen = []
    found = solvers.solve(
        graph,
        settings,
        robots=solvers.Robots(robots, engine=InProcess(threads=2), checkpoint=checkpoint),
        callback=lambda state, record: seen.append(record.k),
    )
    assert_same(found, expected)
    assert steps - after <= len(seen) <= steps - after + 3  # three rounds are three steps at most
    assert list(tmp_path.iterdir()) == []


def line_with_closures(seed, n, num_closures):
    """Odometry through n poses in the plane, and closures that fit no map."""
    rng = np.random.default_rng(seed)
    along = np.arange(n - 1)
    far = np.array([rng.choice(n, 2, replace=False) for _ in range(num_closures)])
    ends = np.concatenate([np.stack([along, along + 1], axis=1), far])
    R_ij = pgo.random_rotations(len(ends), 2, rng)
    t_ij = rng.standard_normal((len(ends), 2))
    ones = np.ones(len(ends))
    return pgo.PoseGraph(n, *ends.T, R_ij, t_ij, ones, ones)


def test_a_second_attempt_goes_on_too(tmp_path):
    graph = line_with_closures(1, 14, 12)  # the relaxation is not tight
    settings = pipeline(solvers.Coupling.SUBSTRUCTURED, None)
    settings = replace(
        settings, soc=replace(settings.soc, tolerance=1e-2), growing=GrowingStart(first_size=6)
    )
    expected = solvers.solve(graph, settings, robots=3)
    names = [stage.name for stage in expected.stages]
    assert names[:5] == ["chordal start", "SOC", "Newton", "growing start, in one place", "Newton"]
    assert all("starts, in one place: none is better" in name for name in names[5:])
    first = sum(len(stage.history) for stage in expected.stages[:3])
    second = sum(len(stage.history) for stage in expected.stages[3:])
    checkpoint = Checkpoint(tmp_path / "run.ckpt", rounds=1)
    after = first + (second - 1) // 2
    with pytest.raises(Killed):
        solvers.solve(
            graph,
            settings,
            robots=solvers.Robots(3, checkpoint=checkpoint),
            callback=killed_after(after),
        )
    seen = []
    found = solvers.solve(
        graph,
        settings,
        robots=solvers.Robots(3, checkpoint=checkpoint),
        callback=lambda state, record: seen.append(record.k),
    )
    assert_same(found, expected)
    # Prefixes are solved again where the solve was broken off among them.
    again = len(expected.stages[3].history)
    assert len(seen) <= first + second - after + 1 + again


def test_without_soc_newton_goes_on(tmp_path):
    graph = varied_graph(7, 60, 3)
    settings = solvers.Pipeline(soc=None)
    expected = solvers.solve(graph, settings, robots=3)
    checkpoint = Checkpoint(tmp_path / "run.ckpt", rounds=1)
    with pytest.raises(Killed):
        solvers.solve(
            graph,
            settings,
            robots=solvers.Robots(3, checkpoint=checkpoint),
            callback=killed_after(1),
        )
    assert_same(
        solvers.solve(graph, settings, robots=solvers.Robots(3, checkpoint=checkpoint)), expected
    )


def test_the_file_stays_when_the_run_was_stopped_and_goes_when_it_converged(tmp_path):
    graph = varied_graph(8, 40, 2)
    path = tmp_path / "run.ckpt"
    stopped = solvers.solve(
        graph, robots=solvers.Robots(2, checkpoint=Checkpoint(path)), time_limit=1e-9
    )
    assert stopped.status is solvers.Status.TIME_LIMIT
    assert path.exists()
    found = solvers.solve(graph, robots=solvers.Robots(2, checkpoint=Checkpoint(path)))
    assert_same(found, solvers.solve(graph, robots=2))
    assert not path.exists()


@pytest.fixture
def broken_off(tmp_path):
    """Graph, and path of the checkpoint of a solve of it by three robots."""
    graph = varied_graph(9, 30, 3)
    path = tmp_path / "run.ckpt"
    with pytest.raises(Killed):
        solvers.solve(
            graph, robots=solvers.Robots(3, checkpoint=Checkpoint(path)), callback=killed_after(2)
        )
    return graph, path


def changed_graph(graph, name):
    array = getattr(graph, name).copy()
    array.flat[0] = np.nextafter(array.flat[0], 2.0)
    return replace(graph, **{name: array})


def renamed(robots):
    return replace(robots, robot=robots.num_robots - 1 - robots.robot)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        *(
            ("graph", lambda graph, part=part: {"problem": changed_graph(graph, part)})
            for part in MEASURED
        ),
        ("graph", lambda graph: {"problem": replace(graph, i=graph.j, j=graph.i)}),
        ("partition", lambda graph: {"robots": 2}),
        ("partition", lambda graph: {"robots": renamed(partition(graph, 3))}),
        ("settings", lambda graph: {"pipeline": solvers.Pipeline(gap=1e-5)}),
        ("settings", lambda graph: {"pipeline": solvers.Pipeline(other_starts=False)}),
        (
            "settings",
            lambda graph: {"pipeline": solvers.Pipeline(newton=solvers.Newton(max_iterations=7))},
        ),
        ("settings", lambda graph: {"pipeline": solvers.Pipeline(soc=None)}),
        ("settings", lambda graph: {"start": pgo.spanning_tree_start(graph)}),
    ],
)
def test_another_graph_partition_or_setting_is_refused(name, change, broken_off):
    graph, path = broken_off
    arguments = {"problem": graph, "robots": 3, **change(graph)}
    arguments["robots"] = solvers.Robots(arguments["robots"], checkpoint=Checkpoint(path))
    with pytest.raises(SettingError, match=rf"run with another {name}; go on with the same"):
        solvers.solve(**arguments)
    assert [one.name for one in path.parent.iterdir()] == ["run.ckpt"]


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
        path.write_bytes(
            {"text": b"VERTEX_SE2 0 0 0 0\n", "half": whole[: len(whole) // 2], "empty": b""}[
                damage
            ]
        )
    wrong = {"half": "a damaged checkpoint, its checksum", "directory": "cannot be read"}.get(
        damage, "no checkpoint"
    )
    with pytest.raises(FileFormatError, match=rf"run\.ckpt: {wrong}"):
        solvers.solve(graph, robots=solvers.Robots(3, checkpoint=Checkpoint(path)))
    assert [one.name for one in path.parent.iterdir()] == ["run.ckpt"]  # and no lock


@given(
    place=st.floats(0, 1, exclude_max=True),
    bit=st.integers(0, 7),
    length=st.none() | st.floats(0, 1, exclude_max=True),
)
@hypothesis_settings(
    max_examples=examples(60), suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_a_flipped_bit_or_a_lost_end_is_one_error(broken_off, place, bit, length):
    path = broken_off[1]
    whole = path.read_bytes()
    damaged = bytearray(whole)
    damaged[int(place * len(whole))] ^= 1 << bit
    other = path.with_name("damaged.ckpt")
    other.write_bytes(damaged if length is None else whole[: int(length * len(whole))])
    with pytest.raises(
        FileFormatError, match=r"damaged\.ckpt: (no checkpoint of a solve|a damaged checkpoint)"
    ):
        Journal(Checkpoint(other), {}, [])


def content(path):
    """Arrays of a checkpoint, which follow two lines."""
    return np.load(io.BytesIO(path.read_bytes().split(b"\n", 2)[2]), allow_pickle=False)


def test_a_checkpoint_holds_no_pickle(broken_off):
    with content(broken_off[1]) as file:
        assert {file[name].dtype.kind for name in file.files} <= set("fiUb")


def test_a_whole_file_of_another_version_is_refused(broken_off):
    graph, path = broken_off
    with content(path) as file:
        arrays = {name: file[name] for name in file.files if not name.startswith("run")}
    rest = io.BytesIO()
    np.savez(rest, allow_pickle=False, **arrays)
    digest = hashlib.sha256(rest.getvalue()).hexdigest().encode()
    path.write_bytes(b"\n".join((path.read_bytes().split(b"\n")[0], digest, rest.getvalue())))
    with pytest.raises(FileFormatError, match="a checkpoint of another version of this package"):
        solvers.solve(graph, robots=solvers.Robots(3, checkpoint=Checkpoint(path)))


def test_a_checkpoint_that_cannot_be_written_or_removed_loses_no_result(tmp_path, caplog):
    graph = varied_graph(6, 30, 2)
    path = tmp_path / "run.ckpt"

    def block(state, record):
        if path.is_file():
            path.unlink()
            path.mkdir()

    found = solvers.solve(
        graph, robots=solvers.Robots(3, checkpoint=Checkpoint(path, rounds=1)), callback=block
    )
    assert_same(found, solvers.solve(graph, robots=3))
    first, last = caplog.messages
    assert first.startswith(
        f"the solve goes on without a new checkpoint: cannot write {path}: it is not a regular file"
    )
    assert last.startswith(f"cannot remove {path}: ")


@pytest.mark.parametrize("is_there", [False, True])
def test_a_second_run_on_a_checkpoint_does_the_first_no_harm(is_there, tmp_path):
    graph = varied_graph(9, 30, 3)
    path = tmp_path / "run.ckpt"
    if is_there:
        with pytest.raises(Killed):
            solvers.solve(
                graph,
                robots=solvers.Robots(3, checkpoint=Checkpoint(path)),
                callback=killed_after(2),
            )
    expected = solvers.solve(graph, robots=3)
    robots = solvers.Robots(3, checkpoint=Checkpoint(path))
    others = []

    def second(state, record):
        others.append(solvers.solve(graph, robots=robots))

    found = solvers.solve(graph, robots=robots, callback=second)
    assert others
    for solution in (found, *others):
        assert_same(solution, expected)
    assert list(tmp_path.iterdir()) == []


def test_rounds_are_positive():
    with pytest.raises(SettingError, match="rounds must be at least 1, got 0"):
        Checkpoint("run.ckpt", rounds=0)


# A run that stops in the middle of SOC, says so, and waits until it is killed.
WAITING_RUN = """
import sys
import solvers
from processes import long_run

def wait_in_the_middle(state, record):
    if record.k == 60:
        print("in the middle", flush=True)
        sys.stdin.read()

graph, settings, robots = long_run()
checkpoint = solvers.Checkpoint(sys.argv[1])
robots = solvers.Robots(robots, checkpoint=checkpoint)
solvers.solve(graph, settings, robots=robots, callback=wait_in_the_middle)
"""


def test_a_killed_process_goes_on_where_it_was(tmp_path):
    path = tmp_path / "run.ckpt"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        [sys.executable, "-c", WAITING_RUN, str(path)],
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as process:
        assert process.stdout.readline() == b"in the middle\n"
        process.kill()
    assert process.returncode == -signal.SIGKILL
    graph, settings, robots = long_run()
    expected = solvers.solve(graph, settings, robots=robots)
    seen = []
    found = solvers.solve(
        graph,
        settings,
        robots=solvers.Robots(robots, checkpoint=Checkpoint(path)),
        callback=lambda state, record: seen.append(record.k),
    )
    np.testing.assert_allclose(found.objective, expected.objective, rtol=1e-8, atol=0)
    assert found.is_certified
    soc = next(stage for stage in found.stages if stage.name == "SOC")
    assert soc.iterations == 150
    assert 50 <= seen[0] <= 61  # the first state after the resume is not the start
    assert len(seen) < len(soc.history)
