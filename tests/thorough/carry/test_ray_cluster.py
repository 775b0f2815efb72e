import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from graphs import varied_graph

import pgo_models as pgo
from solvers import RayEngine
from solvers.cli import app as cli
from solvers.robots.agent import Agent
from solvers.soc.subgraph import split_graph

pytestmark = pytest.mark.slow  # starts Ray

pytest.importorskip("ray")


def processes(root):
    """A process and all below it."""
    children = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended meanwhile
            children.setdefault(int(stat.read_text().rpartition(")")[2].split()[1]), []).append(
                int(stat.parent.name)
            )
    tree = [root]
    for process in tree:
        tree += children.get(process, [])
    return tree


def listening(pids):
    """Addresses, in hexadecimal digits, at which processes listen."""
    links = set()
    for pid in pids:
        for link in Path(f"/proc/{pid}/fd").glob("*"):
            with contextlib.suppress(OSError):
                links.add(os.readlink(link))
    rows = [
        row.split()
        for name in ("tcp", "tcp6")
        for row in Path("/proc/net", name).read_text().splitlines()[1:]
    ]
    return [
        row[1].partition(":")[0] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in links
    ]


@pytest.mark.skipif(sys.platform != "linux", reason="/proc is Linux's")
def test_without_an_address_all_listen_on_the_loopback_alone():
    graph = varied_graph(0, 60, 3)
    pool = RayEngine(num_cpus=2).open(
        partial(Agent, backend=None), split_graph(graph, pgo.partition(graph, 2))
    )
    try:
        addresses = listening(processes(os.getpid()))
    finally:
        pool.close()
    assert len(addresses) >= 6  # this process, two actors, the raylet, the GCS, the agent
    assert set(addresses) <= {"0100007F", "0000000000000000FFFF00000100007F", "0" * 24 + "01000000"}


@pytest.fixture
def head(tmp_path):
    """A cluster with a token: its process, address and environment."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = {
        **os.environ,
        "PYTHONPATH": str(Path(cli.__file__).parents[2]),
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


@pytest.mark.skipif(sys.platform != "linux", reason="Ray has clusters on Linux alone")
def test_a_cluster_that_refuses_and_one_that_dies_are_one_line_each(head, tmp_path):
    process, address, environment = head
    path = tmp_path / "run.ckpt"
    command = [
        sys.executable,
        "-c",
        "from solvers.cli.app import main; main()",
        "solve",
        "circle",
        "--robots",
        "2",
    ]
    command += [
        "--address",
        address,
        "--resume",
        str(path),
        "--tolerance",
        "1e-300",
        "--max-iterations",
        "1000000",
    ]
    wait_for(lambda: "Ray runtime started" in (tmp_path / "head.log").read_text())
    stranger = {**environment, "RAY_AUTH_MODE": "disabled"}
    refused = subprocess.run(command, env=stranger, capture_output=True, text=True, check=False)
    assert (refused.returncode, refused.stdout, refused.stderr.count("\n")) == (1, "", 1)
    assert (
        "can be joined from here: RPC error: InvalidAuthToken: Authentication token is missing"
        in refused.stderr
    )
    solving = subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
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
    # The actors are gone before the cluster or after it, or are to start where it is gone already.
    if not err.startswith("pgo: no Ray cluster answers at "):
        gone = ("pgo: the Ray cluster at ", "pgo: robots were lost (the actor is gone")
        assert err.startswith(gone)
        assert err.endswith("a run with --resume FILE goes on from its last checkpoint\n")
    assert path.exists()
