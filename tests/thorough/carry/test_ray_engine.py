import gc
import os
import pickle
import signal
import socket
import subprocess
import sys
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from graphs import varied_graph

import pgo_models as pgo
import solvers
from pgo_models import PoseGraph
from pgo_models.errors import (
    EngineError,
    FileFormatError,
    MissingExtraError,
    NotPositiveDefiniteError,
    SettingError,
)
from pgo_models.figures import rounded_up
from solvers import RayEngine
from solvers.carry.ray_cluster import connect
from solvers.cli import app as cli
from solvers.robots import soc as substructured
from solvers.robots.agent import Agent, order_interior
from solvers.soc.penalty import PenaltyOrder
from solvers.soc.soc import WARM_START
from solvers.soc.subgraph import Subgraph, split_graph

pytestmark = pytest.mark.slow  # starts Ray

ray = pytest.importorskip("ray")


@pytest.fixture(scope="module", autouse=True)
def local_ray():
    """Ray on this machine, started once: an engine uses it and leaves it running."""
    earlier = signal.getsignal(signal.SIGTERM)
    assert connect(num_cpus=2)
    # Ray's own would end a solve without its best iterate
    assert signal.getsignal(signal.SIGTERM) is earlier
    yield
    ray.shutdown()


@pytest.fixture(scope="module")
def graph():
    return varied_graph(0, 60, 3)


@pytest.fixture(scope="module")
def robots(graph):
    return pgo.partition(graph, 3)


def pipeline(coupling, robots):
    chosen = solvers.Pipeline()
    return replace(
        chosen, soc=replace(WARM_START, coupling=coupling, robots=robots, tolerance=1e-6)
    )


def pid_of(actor):
    return ray.get(actor.__ray_call__.remote(lambda holder: os.getpid()))


def assert_same(solution, expected):
    np.testing.assert_array_equal(solution.poses.R, expected.poses.R)
    np.testing.assert_array_equal(solution.poses.t, expected.poses.t)
    assert solution.lower_bound == expected.lower_bound


def sent_arrays(value):
    """All arrays of numbers in what was sent."""
    if isinstance(value, np.ndarray):
        if value.dtype.kind in "fiub":
            yield value
    elif isinstance(value, bytes):
        yield from sent_arrays(pickle.loads(value))
    elif isinstance(value, dict):
        for item in value.values():
            yield from sent_arrays(item)
    elif isinstance(value, tuple | list):
        for item in value:
            yield from sent_arrays(item)
    elif hasattr(value, "__dict__"):
        yield from sent_arrays(vars(value))


class Sent:
    """Actors, and the arguments of all calls of each: its constructor, `hold`, then orders."""

    def __init__(self) -> None:
        self.actors = []
        self.crossed = {}

    def newest(self):
        return self.actors[-1]


@pytest.fixture
def sent(monkeypatch):
    from ray.actor import ActorClass, ActorMethod

    watched = Sent()
    make = ActorClass._remote
    call = ActorMethod._remote

    def recording_make(self, args=None, kwargs=None, **options):
        handle = make(self, args, kwargs, **options)
        watched.actors.append(handle)
        watched.crossed[handle._actor_id] = [args, kwargs]
        return handle

    def recording_call(self, args=None, kwargs=None, **options):
        if self._actor._actor_id in watched.crossed and self._method_name != "__ray_call__":
            watched.crossed[self._actor._actor_id].append((args, kwargs))
        return call(self, args, kwargs, **options)

    monkeypatch.setattr(ActorClass, "_remote", recording_make)
    monkeypatch.setattr(ActorMethod, "_remote", recording_call)
    return watched


@pytest.mark.parametrize("processes", [3, None])
@pytest.mark.parametrize("coupling", [solvers.Coupling.SUBSTRUCTURED, solvers.Coupling.CONSENSUS])
def test_killed_actors_change_nothing_and_no_process_receives_anothers_private_edges(
    coupling, processes, graph, robots, sent
):
    settings = pipeline(coupling, robots)
    expected = solvers.solve(graph, settings, robots=robots)
    steps = []

    def kill(state, record):
        steps.append(record.k)
        if len(steps) == 3:
            os.kill(pid_of(sent.newest()), signal.SIGKILL)
        if len(steps) == 12:
            ray.kill(sent.newest())

    engine = RayEngine(actors=processes)
    solution = solvers.solve(
        graph, settings, robots=solvers.Robots(robots, engine=engine), callback=kill
    )
    assert len(steps) > 12
    assert_same(solution, expected)
    assert solution.ledger.num_bytes >= expected.ledger.num_bytes  # some are sent again
    assert solution.ledger.snapshot_bytes > 0
    assert expected.ledger.snapshot_bytes == 0
    assert ray.is_initialized()  # it was not the engine that started it
    assert len(sent.crossed) == 3 * (processes or 2)  # all anew after each loss
    for crossed in sent.crossed.values():
        assert_only_own_edges(crossed, graph, robots)
    num_robots = {len(crossed[2][0][1]) for crossed in sent.crossed.values()}
    assert num_robots == ({1} if processes else {1, 2})


def assert_only_own_edges(crossed, graph, robots):
    """An actor gets the factory and its robots' parts, never an edge between poses of others."""
    _, shares = crossed[2][0]
    for share in shares:
        assert isinstance(share, Subgraph)
        # nothing that was worked out of it
        assert set(vars(share)) == set(Subgraph.__dataclass_fields__)
        assert isinstance(share.graph, PoseGraph)
    assert len(crossed) > 10
    mine = [share.robot for share in shares]
    i = robots.robot[graph.i]
    j = robots.robot[graph.j]
    is_own = np.isin(i, mine) | np.isin(j, mine)
    others = np.flatnonzero((i == j) & ~is_own)
    own = np.flatnonzero(is_own)
    numbers = np.concatenate([array.ravel().astype(float) for array in sent_arrays(crossed)])
    assert np.isin(graph.t_ij[own], numbers).all()
    # Weights are drawn from continuous distributions. A pose at the end of a single edge may be
    # that edge.
    assert not np.isin([graph.kappa[others], graph.tau[others]], numbers).any()
    for measured in (graph.t_ij[others], graph.R_ij[others].reshape(len(others), -1)):
        assert not np.isin(measured, numbers).all(axis=1).any()


def test_a_robot_that_is_lost_too_often_ends_the_run(graph, sent):
    def kill(state, record):
        ray.kill(sent.newest())

    engine = RayEngine(max_restarts=0)
    with pytest.raises(
        EngineError, match=r"robots were lost 1 times, the last time as the actor is gone"
    ):
        solvers.solve(graph, robots=solvers.Robots(2, engine=engine), callback=kill)
    assert ray.is_initialized()


def test_errors_of_robots_arrive_as_what_they_are(graph):
    pool = RayEngine().open(
        partial(Agent, backend=None), split_graph(graph, pgo.partition(graph, 1))
    )
    try:
        with pytest.raises(
            NotPositiveDefiniteError, match=r"^the matrix has nan or inf; check the weights"
        ):
            pool.ask(
                partial(order_interior, substructured.penalize),
                [PenaltyOrder(np.nan, np.nan, np.nan)],
            )
    finally:
        pool.close()


@pytest.mark.parametrize(
    "error", [MissingExtraError("cvxopt", "fast"), FileFormatError("x.g2o", 3, "bad")]
)
def test_errors_can_be_sent(error):
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_cpus_that_others_use_are_told_in_time(graph):
    busy = ray.remote(Agent).options(num_cpus=2)
    shares = split_graph(graph, pgo.partition(graph, 2))
    held = busy.remote(shares[0], None)
    ray.get(held.snapshot.remote())
    try:
        with pytest.raises(
            EngineError,
            match=r"too few CPUs: 2 of 2 actors have not started in 0\.5 s, 0 CPUs are free",
        ):
            solvers.solve(graph, robots=solvers.Robots(2, engine=RayEngine(patience=0.5)))
    finally:
        ray.kill(held)


@pytest.mark.parametrize(
    "address", ["nonsense", "host:port", ":6379", "localhost:0", "ray://localhost:10001"]
)
def test_an_address_that_is_none_is_refused(address):
    with pytest.raises(SettingError, match=r"address is .*; give host:port"):
        connect(address)


def test_an_address_where_no_cluster_answers_is_told_in_one_line(capfd):
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        free = f"127.0.0.1:{closed.getsockname()[1]}"
    with pytest.raises(SystemExit) as end:
        cli.main(["solve", "circle", "--robots", "2", "--engine", "ray", "--address", free])
    assert end.value.code == 1
    out, err = capfd.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err.startswith(f"pgo: no Ray cluster answers at {free} (")
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        with pytest.raises(EngineError, match="connected to Ray already"):
            connect(f"127.0.0.1:{silent.getsockname()[1]}")


def test_a_ray_that_does_not_keep_to_the_loopback_is_refused(monkeypatch):
    stopped = []
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", lambda **options: None)
    monkeypatch.setattr(ray, "shutdown", lambda: stopped.append(True))
    monkeypatch.setattr(ray.util, "get_node_ip_address", lambda: "192.0.2.2")
    with pytest.raises(EngineError, match=r"would listen at 192\.0\.2\.2, not on the loopback"):
        connect()
    assert stopped == [True]


def test_without_ray_the_extra_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'pgo-splitting\[ray\]'"):
        connect()
    with pytest.raises(SystemExit) as end:
        cli.main(["solve", "circle", "--robots", "2", "--engine", "ray"])
    assert end.value.code == 1
    assert (
        capsys.readouterr().err
        == "pgo: ray is not installed; run: pip install 'pgo-splitting[ray]'\n"
    )


def test_cpus_of_a_cluster_are_its_own():
    with pytest.raises(SettingError, match="the cluster at host:1 has its own"):
        RayEngine(address="host:1", num_cpus=2)


def test_a_solve_starts_and_stops_ray_and_is_quiet(tmp_path):
    path = Path(cli.__file__).parents[2]
    command = [sys.executable, "-W", "error", "-c", "from solvers.cli.app import main; main()"]
    options = [
        "solve",
        "robots",
        "--engine",
        "ray",
        "--split",
        "given",
        "--resume",
        str(tmp_path / "run.ckpt"),
    ]
    finished = subprocess.run(
        [*command, *options],
        env={**os.environ, "PYTHONPATH": str(path)},
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
    )
    assert (finished.returncode, finished.stderr) == (0, "")
    assert "4, 40 to 40 poses each, as the graph names them" in finished.stdout
    assert list(tmp_path.iterdir()) == []


def test_robots_of_a_folder_read_and_write_files_of_their_own(tmp_path, sent, pgo_command):
    folder = Path(cli.__file__).parents[2] / "data" / "robots"
    out = tmp_path / "out"
    code, output, _ = pgo_command("solve", folder, "--engine", "ray", "--out", out)
    expected = solvers.solve_folder(folder, out=tmp_path / "here")
    assert code == 0
    assert f"F            {rounded_up(expected.certificate.objective)} " in output
    assert "as their own files have them" in output
    for name in ("0.g2o", "1.g2o", "2.g2o", "3.g2o"):
        assert (out / name).read_text() == (tmp_path / "here" / name).read_text()
    code, output, _ = pgo_command("solve", folder, "--engine", "ray", "--method", "consensus")
    assert code == 0
    assert ", 0 all-reduces" not in output
    for refused in (
        ("--report", tmp_path / "x.html"),
        ("--json",),
        ("--anchor", 0),
        ("--out", tmp_path / "x.tum"),
    ):
        code, _, error = pgo_command("solve", folder, "--engine", "ray", *refused)
        assert code == 1
        assert "takes the whole graph in one process; to have it read: --split given" in error

    is_lost = []

    def lose(state, record):
        if not is_lost:
            is_lost.append(True)
            ray.kill(sent.newest())

    solution = solvers.solve_folder(
        folder, robots=solvers.Robots(engine=RayEngine()), callback=lose
    )
    assert solution.certificate.objective == expected.certificate.objective
    assert solution.certificate.lower_bound == expected.certificate.lower_bound


def test_nothing_is_left_open():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        gc.collect()
    assert [str(warning.message) for warning in caught] == []
    assert ray.is_initialized()  # the engines used the Ray of this machine and left it running
