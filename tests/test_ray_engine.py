import contextlib
import gc
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from graphs import varied_graph

import pgo_models as pgo
import solvers
from pgo_models.errors import EngineError, MissingExtraError, NotPositiveDefiniteError, SettingError
from pgo_models.pose_graph import PoseGraph
from solvers import cli, ray_engine
from solvers.member import Member
from solvers.ray_engine import RayEngine, connect
from solvers.recovery import Recovery
from solvers.share import Share

ray = pytest.importorskip("ray")


@pytest.fixture(scope="module", autouse=True)
def local_ray():
    """Ray on this machine, started once: an engine uses it and leaves it running."""
    assert connect(num_cpus=2)
    yield
    ray.shutdown()


@pytest.fixture(scope="module")
def graph():
    return varied_graph(0, 60, 3)


@pytest.fixture(scope="module")
def robots(graph):
    return pgo.partition(graph, 3)


@pytest.fixture
def actors(monkeypatch):
    """Places of the engines that are opened, with their actors."""
    opened = []
    start = ray_engine._RayPlace.start

    def watched(place, robots):
        if place not in opened:
            opened.append(place)
        start(place, robots)

    monkeypatch.setattr(ray_engine._RayPlace, "start", watched)
    return opened


def pipeline(coupling, robots):
    chosen = solvers.Pipeline()
    return replace(chosen, soc=replace(chosen.soc, coupling=coupling, robots=robots, tolerance=1e-6))


def pid_of(actor):
    return ray.get(actor.__ray_call__.remote(lambda holder: os.getpid()))


def assert_same(found, expected):
    np.testing.assert_array_equal(found.poses.R, expected.poses.R)
    np.testing.assert_array_equal(found.poses.t, expected.poses.t)
    assert found.lower_bound == expected.lower_bound
    assert repr(found.ledger) == repr(expected.ledger)


def sent_arrays(value):
    """All arrays of numbers in what was sent."""
    if isinstance(value, np.ndarray):
        if value.dtype.kind in "fiub":
            yield value
    elif isinstance(value, dict):
        for item in value.values():
            yield from sent_arrays(item)
    elif isinstance(value, tuple | list):
        for item in value:
            yield from sent_arrays(item)
    elif hasattr(value, "__dict__"):
        yield from sent_arrays(vars(value))


@pytest.fixture
def sent(monkeypatch):
    """Arguments of all that crosses to every actor, those of its constructor first."""
    from ray.actor import ActorClass, ActorMethod

    crossed = {}
    make, call = ActorClass._remote, ActorMethod._remote

    def recording_make(self, args=None, kwargs=None, **options):
        handle = make(self, args, kwargs, **options)
        crossed[handle._actor_id] = [args, kwargs]
        return handle

    def recording_call(self, args=None, kwargs=None, **options):
        crossed[self._actor._actor_id].append((args, kwargs))
        return call(self, args, kwargs, **options)

    monkeypatch.setattr(ActorClass, "_remote", recording_make)
    monkeypatch.setattr(ActorMethod, "_remote", recording_call)
    return crossed


@pytest.mark.parametrize("coupling", [solvers.Coupling.SUBSTRUCTURED, solvers.Coupling.CONSENSUS])
def test_killed_actors_change_nothing_and_no_process_receives_anothers_private_edges(
    coupling, graph, robots, actors, sent
):
    settings = pipeline(coupling, robots)
    expected = solvers.solve(graph, settings, robots=robots)
    steps = []

    def kill(state, record):
        steps.append(record.k)
        (place,) = actors
        if len(steps) == 3:
            os.kill(pid_of(place.actors[1]), signal.SIGKILL)
        if len(steps) == 12:
            ray.kill(place.actors[0])

    engine = RayEngine(recovery=Recovery(orders_between_snapshots=20))
    found = solvers.solve(graph, settings, robots=robots, engine=engine, callback=kill)
    assert len(steps) > 12
    assert_same(found, expected)
    assert ray.is_initialized()  # it was not the engine that started it
    assert len(sent) == 5  # three, and two in place of those that were killed
    for crossed in sent.values():
        assert_only_own_edges(crossed, graph, robots)


def assert_only_own_edges(crossed, graph, robots):
    """The first thing sent is a share; in none of it is an edge that two poses of another robot have to themselves."""
    share = crossed[0][0]
    assert isinstance(share, Share)
    assert set(vars(share)) == set(Share.__dataclass_fields__)  # nothing that was worked out of it
    assert isinstance(share.graph, PoseGraph)
    assert len(crossed) > 10
    i, j = robots.robot[graph.i], robots.robot[graph.j]
    others, own = np.flatnonzero((i == j) & (i != share.robot)), np.flatnonzero((i == share.robot) | (j == share.robot))
    numbers = np.concatenate([array.ravel().astype(float) for array in sent_arrays(crossed)])
    assert np.isin(graph.t_ij[own], numbers).all()
    # Weights are drawn from continuous distributions. A pose at the end of a single edge may be that edge.
    assert not np.isin([graph.kappa[others], graph.tau[others]], numbers).any()
    for measured in (graph.t_ij[others], graph.R_ij[others].reshape(len(others), -1)):
        assert not np.isin(measured, numbers).all(axis=1).any()


def test_a_robot_that_is_lost_too_often_ends_the_run(graph, actors):
    def kill(state, record):
        ray.kill(actors[0].actors[1])

    engine = RayEngine(recovery=Recovery(max_restarts=0))
    with pytest.raises(EngineError, match=r"robot 1 was lost 1 times \(robot 1's actor is gone"):
        solvers.solve(graph, robots=2, engine=engine, callback=kill)
    assert actors[0].actors == {}


def test_errors_of_robots_arrive_as_what_they_are(graph):
    crew = RayEngine().open(solvers.share.share_out(graph, pgo.partition(graph, 1)), None)
    try:
        with pytest.raises(NotPositiveDefiniteError, match=r"^the matrix has nan or inf; check the weights"):
            crew.ask("penalize", [{"rule": np.full(3, np.nan), "is_stationary": np.zeros(1)}])
    finally:
        crew.close()


def test_a_slow_answer_is_waited_for_while_the_cluster_lives(graph, actors, monkeypatch):
    crew = RayEngine().open(solvers.share.share_out(graph, pgo.partition(graph, 1)), None)
    monkeypatch.setattr(ray_engine, "_SECONDS_TO_ANSWER", 0.1)
    try:
        ticket = actors[0].actors[0].__ray_call__.remote(lambda holder: time.sleep(1) or {"slow": 1})
        assert actors[0].receive(0, ticket) == {"slow": 1}
        monkeypatch.setattr(ray_engine, "_SECONDS_TO_COME_BACK", 0.5)
        monkeypatch.setattr(ray, "nodes", lambda: [{"Alive": False}])
        ticket = actors[0].actors[0].__ray_call__.remote(lambda holder: time.sleep(5) or {})
        with pytest.raises(EngineError, match=r"has died \(none of its machines is left\); solve again"):
            actors[0].receive(0, ticket)
        assert actors[0].actors == {}
    finally:
        crew.close()


@pytest.mark.parametrize("error", [MissingExtraError("cvxopt", "fast"), pgo.FileFormatError("x.g2o", 3, "bad")])
def test_errors_can_be_sent(error):
    import pickle

    assert str(pickle.loads(pickle.dumps(error))) == str(error)


@pytest.mark.parametrize(("robots", "share"), [(1, 1.0), (2, 1.0), (3, 0.5), (4, 0.5), (6, 0.3333)])
def test_every_cpu_has_room_for_as_many_robots(robots, share, graph):
    shares = solvers.share.share_out(graph, pgo.partition(graph, robots))
    assert ray_engine._RayPlace(ray, shares, None, RayEngine(robots_per_cpu=3), False)._cpus_a_robot == share


def test_too_few_cpus_are_told_at_once(graph):
    with pytest.raises(EngineError, match="too few CPUs: 5 robots with at most 2 a CPU, on 2; use fewer robots"):
        solvers.solve(graph, robots=5, engine=RayEngine(robots_per_cpu=2))


def test_cpus_that_others_use_are_told_in_time(graph):
    busy = ray.remote(Member).options(num_cpus=2)
    shares = solvers.share.share_out(graph, pgo.partition(graph, 2))
    held = busy.remote(shares[0], None)
    ray.get(held.obey.remote("keep", {}))
    try:
        with pytest.raises(
            EngineError, match=r"too few CPUs: 2 of 2 robots have not started in 0\.5 s, 0 CPUs are free"
        ):
            solvers.solve(graph, robots=2, engine=RayEngine(patience=0.5))
    finally:
        ray.kill(held)


@pytest.mark.parametrize("address", ["nonsense", "host:port", ":6379", "localhost:0", "ray://localhost:10001"])
def test_an_address_that_is_none_is_refused(address):
    with pytest.raises(SettingError, match=r"address is .*; give host:port"):
        connect(address)


def test_an_address_where_no_cluster_answers_is_told_in_one_line(monkeypatch, capfd):
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        free = f"127.0.0.1:{closed.getsockname()[1]}"
    with pytest.raises(SystemExit) as end:
        cli.main(["solve", "circle", "--robots", "2", "--engine", "ray", "--address", free])
    assert end.value.code == 1
    out, err = capfd.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err.startswith(f"pgo: no Ray cluster answers at {free} (")
    monkeypatch.setattr(ray_engine, "_SECONDS_TO_JOIN", 0.5)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        with pytest.raises(EngineError, match="connected to Ray already"):
            connect(f"127.0.0.1:{silent.getsockname()[1]}")
        with pytest.raises(EngineError, match="is no Ray cluster that can be joined from here"):
            ray_engine._check_cluster(f"127.0.0.1:{silent.getsockname()[1]}")


def processes(root):
    """A process and all below it."""
    children = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended meanwhile
            children.setdefault(int(stat.read_text().rpartition(")")[2].split()[1]), []).append(int(stat.parent.name))
    found = [root]
    for process in found:
        found += children.get(process, [])
    return found


def listening(pids):
    """Addresses, in hexadecimal digits, at which processes listen."""
    links = set()
    for pid in pids:
        for link in Path(f"/proc/{pid}/fd").glob("*"):
            with contextlib.suppress(OSError):
                links.add(os.readlink(link))
    rows = [row.split() for name in ("tcp", "tcp6") for row in Path("/proc/net", name).read_text().splitlines()[1:]]
    return [row[1].partition(":")[0] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in links]


@pytest.mark.skipif(sys.platform != "linux", reason="/proc is Linux's")
def test_without_an_address_all_listen_on_the_loopback_alone(graph):
    crew = RayEngine().open(solvers.share.share_out(graph, pgo.partition(graph, 2)), None)
    try:
        found = listening(processes(os.getpid()))
    finally:
        crew.close()
    assert len(found) >= 6  # this process, two actors, the raylet, the GCS, the agent
    assert set(found) <= {"0100007F", "0000000000000000FFFF00000100007F", "0" * 24 + "01000000"}


def test_a_ray_that_does_not_keep_to_the_loopback_is_refused(monkeypatch):
    stopped = []
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", lambda **options: None)
    monkeypatch.setattr(ray, "shutdown", lambda: stopped.append(True))
    monkeypatch.setattr(ray.util, "get_node_ip_address", lambda: "192.0.2.2")
    with pytest.raises(EngineError, match=r"would listen at 192\.0\.2\.2, not on the loopback"):
        connect()
    assert stopped == [True]


def test_names_of_a_module_are_replaced_for_a_while_where_it_has_them():
    module = type(sys)("module")
    module.one = 1

    def fail():
        with ray_engine._replaced(module, one=2, two=2):
            assert module.one == 2
            assert not hasattr(module, "two")
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert module.one == 1


TOLD = {
    "authentication": (
        "[2026-01-01 W 1 1] gcs_client.cc:210: Failed\nRuntimeError: Failed to connect to GCS. Last:\n"
        "ray.exceptions.AuthenticationError: the token is missing\n\nConnectionError: Failed to connect to Ray\n",
        "the token is missing; check",
    ),
    "version": (
        "[2026-01-01 W 1 1] gcs_client.cc:210: slow\nTraceback\nRuntimeError: Version mismatch: started with:\n"
        "    Ray: 2.9\nThis process:\n    Ray: 2.60\n",
        "Version mismatch: started with: Ray: 2.9 This process: Ray: 2.60; check",
    ),
    "other": (
        "[2026-01-01 W 1 1] rpc_client.h:153: first\n[2026-01-01 W 1 1] gcs_client.cc:210: last\n"
        "ConnectionError: Failed to connect to Ray cluster at host:1\n",
        "last; check",
    ),
    "none": ("", "no answer in 15 s; check"),
    "long": ("ValueError: " + 100 * "word " + "\n", r"(word )+\.\.; check"),
}


@pytest.mark.parametrize("case", TOLD)
def test_the_reason_is_rays_own(case, monkeypatch):
    told, expected = TOLD[case]

    def fail(command, **options):
        raise subprocess.CalledProcessError(1, command, stderr=told.encode())

    monkeypatch.setattr(subprocess, "run", fail)
    with pytest.raises(EngineError, match=rf"can be joined from here: {expected}") as refused:
        ray_engine._check_cluster("host:1")
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 550


@pytest.fixture
def head(tmp_path):
    """A cluster with a token: its process, address and environment."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = {
        **os.environ,
        "PYTHONPATH": str(Path(cli.__file__).parent.parent),
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": "a" * 32,
        "RAY_USAGE_STATS_ENABLED": "0",
    }
    options = ["--head", f"--port={port}", "--num-cpus=2", "--include-dashboard=false", "--block"]
    with (tmp_path / "head.log").open("w") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "ray.scripts.scripts", "start", *options],
            env=environment,
            stdout=log,
            stderr=subprocess.STDOUT,
        )
    try:
        yield process, f"127.0.0.1:{port}", environment
    finally:
        with contextlib.suppress(ProcessLookupError):
            for pid in processes(process.pid)[::-1]:
                os.kill(pid, signal.SIGKILL)
        process.wait()


def wait_for(is_done, seconds=60):
    deadline = time.monotonic() + seconds
    while not is_done():
        assert time.monotonic() < deadline, "it does not come"
        time.sleep(0.1)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="Ray has clusters on Linux alone")
def test_a_cluster_that_refuses_and_one_that_dies_are_one_line_each(head, tmp_path):
    process, address, environment = head
    path = tmp_path / "run.ckpt"
    command = [sys.executable, "-c", "from solvers.cli import main; main()", "solve", "circle", "--robots", "2"]
    command += ["--address", address, "--resume", str(path), "--tolerance", "1e-300", "--max-iterations", "1000000"]
    wait_for(lambda: "Ray runtime started" in (tmp_path / "head.log").read_text())
    stranger = {**environment, "RAY_AUTH_MODE": "disabled"}
    refused = subprocess.run(command, env=stranger, capture_output=True, text=True, check=False)
    assert (refused.returncode, refused.stdout, refused.stderr.count("\n")) == (1, "", 1)
    assert "can be joined from here: RPC error: InvalidAuthToken: Authentication token is missing" in refused.stderr
    solving = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        wait_for(path.exists)
        for pid in processes(process.pid)[1:]:
            if "raylet/raylet" in Path(f"/proc/{pid}/cmdline").read_text().partition("\0")[0]:
                os.kill(pid, signal.SIGKILL)
        out, err = solving.communicate(timeout=120)
    finally:
        solving.kill()
        solving.communicate()
    assert (solving.returncode, out, err.count("\n")) == (1, "", 1)
    assert err.startswith("pgo: the Ray cluster at ")
    assert err.endswith("solve again when there is one: a run with --resume FILE goes on from its last checkpoint\n")
    assert path.exists()


def test_without_ray_the_extra_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'pgo-splitting\[ray\]'"):
        connect()
    with pytest.raises(SystemExit) as end:
        cli.main(["solve", "circle", "--robots", "2", "--engine", "ray"])
    assert end.value.code == 1
    assert capsys.readouterr().err == "pgo: ray is not installed; run: pip install 'pgo-splitting[ray]'\n"


@pytest.mark.parametrize("wrong", [{"num_cpus": 0}, {"robots_per_cpu": 0}, {"patience": 0.0}])
def test_settings_are_checked(wrong):
    with pytest.raises(SettingError, match=f"{next(iter(wrong))} must be positive, got 0"):
        RayEngine(**wrong)


def test_cpus_of_a_cluster_are_its_own():
    with pytest.raises(SettingError, match="the cluster at host:1 has its own"):
        RayEngine(address="host:1", num_cpus=2)


@pytest.mark.slow
def test_a_solve_starts_and_stops_ray_and_is_quiet(tmp_path):
    path = Path(cli.__file__).parent.parent
    command = [sys.executable, "-W", "error", "-c", "from solvers.cli import main; main()"]
    options = ["solve", "robots", "--engine", "ray", "--resume", str(tmp_path / "run.ckpt")]
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


def test_nothing_is_left_open():
    gc.collect()  # a ResourceWarning is an error here
