"""`pgo robot`: processes with a folder each, on networks of their own where that is allowed."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

import pgo_models as pgo
import solvers
from pgo_models.graphs.g2o import write_g2o_folder

pytest.importorskip("zenoh")
pytestmark = pytest.mark.slow

PGO = [sys.executable, "-c", "from solvers.cli.app import main; main()", "robot"]
NAMES = ("a", "b", "c")
WORLD = pgo.grid_world(1, 300, 3)
NUMBERS = itertools.count()


@dataclass
class Machine:
    """A machine: what comes before a command on it, its address, and its folder."""

    prefix: list[str]
    address: str
    folder: Path


@dataclass
class Fleet:
    """Machines with a robot each, whose graphs are parts of one; processes by robot."""

    machines: dict[str, Machine]
    has_own_networks: bool
    cut: Callable[[str, bool], None]
    processes: dict[str, subprocess.Popen[str]] = field(default_factory=dict)

    def start(self, name: str, *more: str) -> None:
        machine = self.machines[name]
        command = [*machine.prefix, *PGO, "mine.g2o", "--name", name, "--team", ",".join(NAMES)]
        command += ["--key", "team.key", "--listen", machine.address, "--json", "--patience", "4"]
        for other, its in self.machines.items():
            if other < name:
                command += ["--connect", its.address]
        self.processes[name] = subprocess.Popen(
            [*command, "--cost", "isotropic", "--out", "solved.g2o", *more],
            cwd=machine.folder,
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2].parent)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def says(self, name: str, text: str) -> None:
        """Wait until a robot says something on stderr."""
        stderr = self.processes[name].stderr
        assert stderr is not None
        assert any(text in line for line in stderr)

    def ended(self, name: str, seconds: float = 90.0) -> tuple[int, dict[str, object]]:
        """Exit code and JSON of a robot."""
        process = self.processes[name]
        out, err = process.communicate(timeout=seconds)
        assert out, err
        return process.returncode, json.loads(out)

    def carried(self, name: str) -> tuple[int, int]:
        """Bytes that the operating system has sent and received at the network of a machine."""
        prefix = self.machines[name].prefix
        counts = []
        for way in ("tx", "rx"):
            path = f"/sys/class/net/eth-{name}/statistics/{way}_bytes"
            read = subprocess.run(
                [*prefix, "cat", path], capture_output=True, text=True, check=True
            )
            counts.append(int(read.stdout))
        return counts[0], counts[1]


def ip(*words: str) -> bool:
    """Whether a command of iproute2 has worked."""
    return subprocess.run(["ip", *words], capture_output=True, check=False).returncode == 0


def own_networks(tag: str) -> bool:
    """Make a network namespace for every robot, joined by a bridge; whether that is allowed."""
    if shutil.which("ip") is None or not ip("link", "add", f"br{tag}", "type", "bridge"):
        return False
    works = ip("link", "set", f"br{tag}", "up")
    for k, name in enumerate(NAMES):
        space, here = f"{tag}{name}", f"v{tag}{name}"
        works &= ip("netns", "add", space)
        works &= ip(
            "link", "add", here, "type", "veth", "peer", "name", f"eth-{name}", "netns", space
        )
        works &= ip("link", "set", here, "master", f"br{tag}", "up")
        works &= ip("-n", space, "addr", "add", f"10.77.0.{k + 1}/24", "dev", f"eth-{name}")
        works &= ip("-n", space, "link", "set", f"eth-{name}", "up")
        works &= ip("-n", space, "link", "set", "lo", "up")
    return works


def without_networks(tag: str) -> None:
    for name in NAMES:
        ip("netns", "del", f"{tag}{name}")
    ip("link", "del", f"br{tag}")


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Fleet]:
    """Three machines, each with a folder that has its own file and the key of the team alone."""
    # A network that is deleted lingers for a while, with its names.
    tag = f"p{os.getpid() % 10000}n{next(NUMBERS)}"
    world = WORLD.with_robots(pgo.partition(WORLD, 3).robot)
    write_g2o_folder(world, tmp_path / "all", world.truth)
    has_networks = own_networks(tag)
    machines = {}
    for k, name in enumerate(NAMES):
        folder = tmp_path / name
        folder.mkdir()
        shutil.copy(tmp_path / "all" / f"{k}.g2o", folder / "mine.g2o")
        (folder / "team.key").write_bytes(b"the secret of the three robots")
        prefix = ["ip", "netns", "exec", f"{tag}{name}"] if has_networks else []
        host = f"10.77.0.{k + 1}:7447" if has_networks else f"127.0.0.1:{17447 + k}"
        machines[name] = Machine(prefix, host, folder)

    def cut(name: str, is_cut: bool) -> None:
        ip("link", "set", f"v{tag}{name}", "down" if is_cut else "up")

    made = Fleet(machines, has_networks, cut)
    yield made
    for process in made.processes.values():
        process.kill()
        process.communicate()
    without_networks(tag)


def central() -> solvers.Solution:
    return solvers.solve(pgo.PGOProblem(WORLD, weighting=pgo.Weighting.ISOTROPIC))


KEEP = ["--sharing", "interface"]


@pytest.mark.parametrize("words", [[], KEEP, [*KEEP, "--method", "consensus"]])
def test_three_machines_have_one_certified_map(fleet: Fleet, words: list[str]) -> None:
    for name in NAMES:
        fleet.start(name, *words)
    best = central()
    for name in NAMES:
        code, told = fleet.ended(name)
        assert code == 0, told
        assert told["verdict"] == "CERTIFIED"
        assert told["covered"] == list(NAMES)
        assert told["absent"] == []
        assert told["objective"] == pytest.approx(best.objective, rel=1e-6)
        assert ("SOC" in told["stages"]) == bool(words)  # type: ignore[operator]
        solved = (fleet.machines[name].folder / "solved.g2o").read_text()
        given = (fleet.machines[name].folder / "mine.g2o").read_text()
        for tag in ("VERTEX_SE3", "EDGE_SE3"):
            assert solved.count(tag) == given.count(tag) > 0
        files = sorted(path.name for path in fleet.machines[name].folder.iterdir())
        assert files == ["mine.g2o", "solved.g2o", "team.key"]
        if fleet.has_own_networks and words:
            sent, received = (sum(told[way].values()) for way in ("sent", "received"))  # type: ignore[attr-defined]
            by_system = fleet.carried(name)
            assert sum(by_system) == pytest.approx(sent + received, rel=0.2)


def test_machines_find_wrong_edges_as_one_place_does(fleet: Fleet) -> None:
    for name in NAMES:
        fleet.start(name, "--robust", "gnc")
    best = central()
    for name in NAMES:
        code, told = fleet.ended(name)
        assert code == 0, told
        assert told["rejected"] == []
        assert told["objective"] == pytest.approx(best.objective, rel=1e-6)


def test_a_late_robot_is_waited_for_and_one_that_never_comes_is_named(fleet: Fleet) -> None:
    fleet.start("a", "--wait", "16")
    time.sleep(7.0)
    fleet.start("b", "--wait", "9")
    for name in ("a", "b"):
        code, told = fleet.ended(name)
        assert code == 3  # a map of a part of the team
        assert told["verdict"] == "CERTIFIED"
        assert told["covered"] == ["a", "b"]
        assert told["absent"] == ["c"]


def test_a_robot_that_is_cut_off_for_twenty_seconds_goes_on(fleet: Fleet) -> None:
    if not fleet.has_own_networks:
        pytest.skip("network namespaces are not allowed here")
    fleet.start("a")
    fleet.start("b")
    time.sleep(3.0)
    fleet.cut("b", True)
    fleet.start("c")
    time.sleep(20.0)
    fleet.cut("b", False)
    for name in NAMES:
        code, told = fleet.ended(name)
        assert code == 0, told
        assert told["covered"] == list(NAMES)


def test_a_robot_that_leaves_after_the_verdict_takes_nothing_from_the_others(fleet: Fleet) -> None:
    if not fleet.has_own_networks:
        pytest.skip("network namespaces are not allowed here")
    for name in NAMES:
        fleet.start(name)
    fleet.says("c", "CERTIFIED, for a, b, c")
    fleet.cut("c", True)
    for name in ("a", "b"):
        code, told = fleet.ended(name)
        assert code == 0, told
        assert told["covered"] == list(NAMES)
        assert (fleet.machines[name].folder / "solved.g2o").exists()


def test_ctrl_c_keeps_what_is_known(fleet: Fleet) -> None:
    fleet.start("a")
    fleet.start("b")
    fleet.says("a", "CERTIFIED, for a, b")
    fleet.processes["a"].send_signal(signal.SIGINT)
    code, told = fleet.ended("a")
    assert code != 0
    assert told["covered"] == ["a", "b"]
    assert (fleet.machines["a"].folder / "solved.g2o").exists()


@pytest.mark.parametrize("words", [["--key", "other.key"], ["--team", "a,b"], ["--name", "b"]])
def test_a_wrong_key_team_or_name_is_told_by_the_others(fleet: Fleet, words: list[str]) -> None:
    sentences = {
        "--key": "not sealed with the key of the team",
        "--team": "'c' has the key of the team, and is not in it",
        "--name": "two robots are called b",
    }
    (fleet.machines["c"].folder / "other.key").write_bytes(b"the secret of other robots")
    for name in NAMES:
        has_words = (name == "c") != (words[0] == "--team")
        fleet.start(name, *(words if has_words else ()), "--wait", "15")
    code, told = fleet.ended("a")
    assert code == 3
    assert any(sentences[words[0]] in problem for problem in told["problems"])  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--key", "nothing"], "the key of the team cannot be read"),
        (["--listen", "here"], "'here' is no address; give HOST:PORT"),
        (["--name", "z"], "'z' is not in the team"),
        (["--cost", "unit"], "give --cost chi2 or isotropic"),
        (["--method", "consensus"], "give --sharing interface"),
        (["--method", "joint"], "'joint' is not one of 'substructured', 'consensus', 'paper'"),
    ],
)
def test_wrong_words_are_answered_in_a_sentence(
    tmp_path: Path, words: list[str], sentence: str
) -> None:
    pgo.write_g2o(pgo.load("grid"), tmp_path / "mine.g2o")
    (tmp_path / "team.key").write_bytes(b"the secret of the three robots")
    given = {"--name": "a", "--team": "a,b", "--key": "team.key", "--listen": "127.0.0.1:17449"}
    given |= dict(zip(words[::2], words[1::2], strict=True))
    command = [*PGO, "mine.g2o", *(word for pair in given.items() for word in pair)]
    ended = subprocess.run(
        command,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2].parent)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 1
    assert sentence in ended.stderr
    assert len(ended.stderr.splitlines()) == 1
