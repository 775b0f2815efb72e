"""Folders whose files speak against being of one graph, and folders that robots are absent from.

Each is asked about where the files are read together, and where robots read their own.
"""

import shutil
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from networks import Network, robots_with_files

import pgo_models as pgo
import solvers
from pgo_models import random_geometric, read_g2o, write_g2o
from pgo_models.errors import FileFormatError, GraphWarning
from pgo_models.graphs.g2o import write_g2o_folder
from solvers import solve_folder
from solvers.robots_solution import RobotsSolution

ROBOTS = Path(pgo.__file__).parent.parent / "data" / "robots"
DOORS: dict[str, Callable[[Path], object]] = {"whole": read_g2o, "own files": solve_folder}
EDGE = "EDGE_SE2 {} {} {} {} {} 1 0 0 1 0 1\n"
VERTEX = "VERTEX_SE2 {} {} {} {}\n"


def rounded(path: Path, digits: int, tag: str = "") -> None:
    """Write the measured numbers on some lines of a file with so many digits."""
    lines = []
    for line in path.read_text().splitlines():
        words = line.split()
        num_names = 3 if line.startswith("EDGE") else 2
        if line.startswith(tag):
            words[num_names:] = [f"{float(word):.{digits}g}" for word in words[num_names:]]
        lines.append(" ".join(words))
    path.write_text("\n".join(lines))


# Files of several graphs


@pytest.mark.parametrize("has_vertices", [True, False])
@pytest.mark.parametrize("d", [2, 3])
def test_graphs_with_the_same_ids_are_not_joined(
    d: int, has_vertices: bool, tmp_path: Path
) -> None:
    for number in range(2):
        rng = np.random.default_rng(number)
        graph = random_geometric(12, rng, d=d)
        steps = np.arange(11)
        moves = pgo.Poses(graph.R_ij[steps], graph.t_ij[steps])
        graph = replace(graph.with_edges(steps, steps + 1, moves, 1.0, 1.0), initial=None)
        write_g2o(graph, tmp_path / f"{number}.g2o", graph.truth if has_vertices else None)
    first = "pose 0 is elsewhere than" if has_vertices else "the edge from . to . is another than"
    with pytest.raises(FileFormatError, match=rf"1\.g2o:\d+: {first}.* at .*0\.g2o:\d+.*trust_f"):
        read_g2o(tmp_path)
    trusted = read_g2o(tmp_path, trust_folder=True)
    assert trusted.num_poses == 12


def test_most_edges_off_by_their_length_are_of_another_graph(tmp_path: Path) -> None:
    """A single one beside others that agree may be a wrong closure."""
    places = [VERTEX.format(pose, pose, 0, 0) for pose in range(6)]
    rows = [[0, 3, 1, 0], [1, 4, 2, 0], [2, 5, 3, 0]]
    own = [EDGE.format(i, i + 1, 1, 0, 0) for i in (0, 1, 3, 4)]
    for number, offsets in enumerate([(0.2, 0.4, -7), (0.2, -5, -7)]):
        folder = tmp_path / str(number)
        folder.mkdir()
        ours = [EDGE.format(i, j, x, y, 0) for i, j, x, y in rows]
        theirs = [
            EDGE.format(i, j, x + offset, y, 0)
            for (i, j, x, y), offset in zip(rows, offsets, strict=True)
        ]
        (folder / "0.g2o").write_text("".join(places[:3] + own[:2] + ours))
        (folder / "1.g2o").write_text("".join(places[3:] + own[2:] + theirs))
    assert read_g2o(tmp_path / "0").num_edges == 10
    with pytest.raises(FileFormatError, match=r"1\.g2o:7: the edge from 1 to 4 is another than"):
        read_g2o(tmp_path / "1")


def test_the_data_folder_is_no_graph() -> None:
    with pytest.raises(FileFormatError, match=r"circle\.g2o:1: pose 0 is elsewhere .*grid\.g2o:1"):
        read_g2o(ROBOTS.parent)


@pytest.mark.parametrize("door", DOORS)
def test_one_vertex_line_that_contradicts_another_is_a_question(door: str, tmp_path: Path) -> None:
    own = VERTEX.format(0, 0, 0, 0) + VERTEX.format(1, 1, 0, 0) + EDGE.format(0, 1, 1, 0, 0)
    for place, is_same in (("1.01 0 0", True), ("1 2 0", False), ("1 0 1", False)):
        (tmp_path / "0.g2o").write_text(own)
        (tmp_path / "1.g2o").write_text(
            f"VERTEX_SE2 1 {place}\n" + VERTEX.format(2, 2, 0, 0) + EDGE.format(1, 2, 1, 0, 0)
        )
        if is_same:
            DOORS[door](tmp_path)
            continue
        with pytest.raises(FileFormatError, match=r"1\.g2o:1: pose 1 is .* at .*0\.g2o:2, "):
            DOORS[door](tmp_path)
    assert read_g2o(tmp_path, trust_folder=True).num_edges == 2
    assert solve_folder(tmp_path, trust_folder=True).certificate.is_certified


@pytest.mark.parametrize("door", DOORS)
def test_what_a_neighbour_says_of_a_symbol_is_its_own_estimate(door: str, tmp_path: Path) -> None:
    """Maybe in a frame of its own; the letter says whose pose it is."""
    shutil.copytree(ROBOTS, tmp_path / "in")
    pose = int((tmp_path / "in" / "1.g2o").read_text().split()[1])
    line = f"VERTEX_SE3:QUAT {pose} 70 80 90 1 0 0 0\n"
    with (tmp_path / "in" / "2.g2o").open("a") as file:
        file.write(line)
    DOORS[door](tmp_path / "in")
    (tmp_path / "in" / "4.g2o").write_text(line + "VERTEX_SE3:QUAT 7 0 0 0 0 0 0 1\n")
    lines = (tmp_path / "in" / "1.g2o").read_text().splitlines()
    edge = next(text for text in lines if text.startswith("EDGE"))
    words = edge.split()
    words[1] = "7"
    with (tmp_path / "in" / "4.g2o").open("a") as file:
        file.write(" ".join(words))
    with pytest.raises(FileFormatError, match=rf"4\.g2o:1: pose {pose} is elsewhere"):
        DOORS[door](tmp_path / "in")


def test_a_landmark_of_one_file_is_no_pose_of_another(tmp_path: Path) -> None:
    (tmp_path / "0.g2o").write_text(EDGE.format(0, 1, 1, 0, 0) + "EDGE_SE2_XY 0 2 1 0 1 0 1\n")
    (tmp_path / "1.g2o").write_text(EDGE.format(1, 3, 1, 0, 0) + EDGE.format(3, 2, 1, 0, 0))
    with pytest.raises(FileFormatError, match=r"1\.g2o:2: 2 is a pose here and a landmark"):
        read_g2o(tmp_path)


# Edges that would count twice


def reprinted(folder: Path, units: int) -> int:
    """Write `data/robots` with six digits, and copies of edges up to so many units off.

    A copy is in another file. Quaternions have the other sign there. Return the number of copies.
    """
    folder.mkdir()
    seen: dict[tuple[str, ...], int] = {}
    num_copies = 0
    rng = np.random.default_rng(0)
    for robot in range(4):
        lines = []
        for line in (ROBOTS / f"{robot}.g2o").read_text().splitlines():
            words = line.split()
            is_edge = words[0].startswith("EDGE")
            is_copy = is_edge and seen.setdefault(tuple(words[1:3]), robot) != robot
            first_number = 3 if is_edge else 2
            for place in range(first_number, len(words)):
                number = float(words[place])
                if is_copy and 3 <= place < 10 and number != 0.0:
                    unit = 10.0 ** (np.floor(np.log10(abs(float(f"{number:.6g}")))) - 5)
                    number = float(f"{number:.6g}") + units * unit * rng.integers(2)
                    number *= -1.0 if place >= 6 else 1.0
                words[place] = f"{number:.6g}"
            num_copies += is_copy
            lines.append(" ".join(words))
        (folder / f"{robot}.g2o").write_text("\n".join(lines) + "\n")
    return num_copies


@pytest.mark.parametrize("door", DOORS)
def test_copies_that_differ_in_the_last_printed_digit_are_one_edge(
    door: str, tmp_path: Path
) -> None:
    """With all files, and a robot that hears of the copies of its own edges alone."""
    num_copies = reprinted(tmp_path / "in", units=1)
    sentence = f"{num_copies} edges of two files differ in no more than the last printed digit"
    with pytest.warns(GraphWarning, match=f"{sentence}: each counts once"):
        graph = read_g2o(tmp_path / "in", trust_folder=True)
    assert graph.num_edges == read_g2o(ROBOTS).num_edges
    is_told = pytest.warns(GraphWarning, match=sentence) if door == "whole" else nullcontext()
    with is_told:
        opened = DOORS[door](tmp_path / "in")
    if isinstance(opened, RobotsSolution):
        assert sentence in opened.note
        assert opened.sizes[1].sum() == graph.num_edges
        expected = solvers.solve(graph)
        assert opened.objective == pytest.approx(expected.objective, rel=1e-9)
    reprinted(tmp_path / "off", units=3)
    with pytest.raises(FileFormatError, match="is nearly that at"):
        DOORS[door](tmp_path / "off")


def test_copies_with_other_matrices_or_few_digits_are_a_question(tmp_path: Path) -> None:
    ends = (EDGE.format(0, 1, 1.23456, 0, 0), EDGE.format(2, 3, 1.23456, 0, 0))
    places = [VERTEX.format(pose, pose, 0, 0) for pose in range(4)]
    pairs = {
        "matrix": ("EDGE_SE2 0 2 2.00001 0 0.123456 1 0 0 1 0 1\n",) * 2,
        "digits": ("EDGE_SE2 0 2 2.01 0 0 1 0 0 1 0 1\n", "EDGE_SE2 0 2 2.02 0 0 1 0 0 1 0 1\n"),
    }
    first, second = pairs["matrix"]
    pairs["matrix"] = (first, second.replace("2.00001", "2.00002").replace("0 1\n", "0 2\n"))
    for name, (first, second) in pairs.items():
        folder = tmp_path / name
        folder.mkdir()
        own = (
            ends if name == "matrix" else (EDGE.format(0, 1, 1.2, 0, 0), EDGE.format(2, 3, 1, 0, 0))
        )
        (folder / "0.g2o").write_text("".join(places[:2]) + own[0] + first)
        (folder / "1.g2o").write_text("".join(places[2:]) + own[1] + second)
        with pytest.raises(FileFormatError, match="the edge from 0 to 2 is nearly that at"):
            read_g2o(folder)


@pytest.mark.parametrize("sharing", solvers.Sharing)
def test_a_team_says_that_copies_count_once(sharing: solvers.Sharing, tmp_path: Path) -> None:
    num_copies = reprinted(tmp_path / "in", units=1)
    team = robots_with_files(tmp_path / "in", 4, sharing=sharing)
    network = Network(team, np.random.default_rng(0))
    network.run(30.0)
    expected = solvers.solve_folder(tmp_path / "in")
    for robot in team.values():
        assert robot.is_certified
        assert robot.problems == []
        assert robot.solution is not None
        assert robot.solution.objective == pytest.approx(expected.objective, rel=1e-9)
        assert f"{num_copies} edges of two files differ" in dict(robot.facts())["note"]


def test_what_one_file_measures_twice_within_printing_counts_twice(tmp_path: Path) -> None:
    """An angle may be written below pi in one file and above -pi in another."""
    tail = " 1 0 0 1 0 1\n"
    measured = ("EDGE_SE2 0 2 2.00001 0 3.141593" + tail, "EDGE_SE2 0 2 2.00002 0 3.141592" + tail)
    printed = "EDGE_SE2 0 2 2.00002 0 -3.141593" + tail
    places = [VERTEX.format(pose, pose, 0, 0) for pose in range(4)]
    (tmp_path / "0.g2o").write_text(
        "".join(places[:2]) + EDGE.format(0, 1, 1.123456, 0, 0.123456) + "".join(measured)
    )
    (tmp_path / "1.g2o").write_text(
        "".join(places[2:]) + EDGE.format(2, 3, 1.123456, 0, 0.123456) + printed
    )
    with pytest.warns(GraphWarning, match="1 edges of two files"):
        graph = read_g2o(tmp_path)
    assert graph.num_edges == 4
    np.testing.assert_allclose(np.sort(graph.t_ij[:, 0])[-2:], [2.00001, 2.00002], rtol=0, atol=0)


@pytest.mark.parametrize("digits", [2, 3])
def test_a_whole_graph_with_other_digits_is_a_question(digits: int, tmp_path: Path) -> None:
    shutil.copytree(ROBOTS, tmp_path / "in")
    graph = read_g2o(ROBOTS)
    write_g2o(graph, tmp_path / "in" / "whole.g2o")
    rounded(tmp_path / "in" / "whole.g2o", digits)
    with pytest.raises(
        FileFormatError,
        match=rf"whole\.g2o:161: the edge from \d+ to \d+ is nearly that at .*0\.g2o:41; "
        rf"{graph.num_edges} edges of this file are nearly edges of others.*remove them, or the",
    ):
        read_g2o(tmp_path / "in")
    trusted = read_g2o(tmp_path / "in", trust_folder=True)
    assert trusted.num_edges == 2 * graph.num_edges


@pytest.mark.parametrize("door", DOORS)
def test_edges_between_robots_that_one_file_rounds_are_a_question(
    door: str, tmp_path: Path
) -> None:
    shutil.copytree(ROBOTS, tmp_path / "in")
    rounded(tmp_path / "in" / "1.g2o", 3, tag="EDGE")
    with pytest.raises(FileFormatError, match=r"\d\.g2o:\d+: .* nearly that at .*\d\.g2o:\d+"):
        DOORS[door](tmp_path / "in")
    graph = read_g2o(ROBOTS)
    both = int(((graph.robots[graph.i] == 1) != (graph.robots[graph.j] == 1)).sum())
    trusted = solve_folder(tmp_path / "in", trust_folder=True)
    assert trusted.sizes[1].sum() == graph.num_edges + both


def test_copies_in_a_third_file_are_found(tmp_path: Path) -> None:
    """Edges that two files have with the same numbers, and a third one with fewer digits."""
    shutil.copytree(ROBOTS, tmp_path / "in")
    of_first = set((ROBOTS / "0.g2o").read_text().splitlines())
    of_second = set((ROBOTS / "1.g2o").read_text().splitlines())
    shared = sorted(of_first & of_second)
    (tmp_path / "in" / "closures.g2o").write_text("\n".join(shared))
    assert read_g2o(tmp_path / "in").num_edges == read_g2o(ROBOTS).num_edges
    rounded(tmp_path / "in" / "closures.g2o", 3)
    with pytest.raises(FileFormatError, match=rf"closures\.g2o:1: .*; {len(shared)} edges of this"):
        read_g2o(tmp_path / "in")


@pytest.mark.parametrize("door", DOORS)
def test_measurements_that_are_repeated_in_one_file_all_count(door: str, tmp_path: Path) -> None:
    places = [VERTEX.format(pose, pose, 0, 0) for pose in range(4)]
    own = EDGE.format(0, 1, 1, 0, 0) + EDGE.format(0, 1, 1.01, 0, 0)
    between = EDGE.format(1, 2, 1, 0, 0)
    again = EDGE.format(1, 2, 1.01, 0, 0)
    (tmp_path / "0.g2o").write_text("".join(places[:2]) + own + between)
    (tmp_path / "1.g2o").write_text(
        "".join(places[2:]) + between + again + EDGE.format(2, 3, 1, 0, 0)
    )
    assert read_g2o(tmp_path).num_edges == 5
    DOORS[door](tmp_path)


@pytest.mark.parametrize("door", DOORS)
def test_robots_that_measure_each_other_both_count(door: str, tmp_path: Path) -> None:
    """From an id to the next, too: only the steps between own poses are measured by one robot."""
    places = [VERTEX.format(pose, pose, 0, 0) for pose in range(4)]
    ends = (EDGE.format(0, 1, 1, 0, 0), EDGE.format(2, 3, 1, 0, 0))
    measured = [(0, 2.0, 2.4), (0, 2.0, 2.04), (1, 1.0, 1.2)]
    for number, (i, first, second) in enumerate(measured):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "0.g2o").write_text(
            "".join(places[:2]) + ends[0] + EDGE.format(i, 2, first, 0, 0)
        )
        (folder / "1.g2o").write_text(
            "".join(places[2:]) + ends[1] + EDGE.format(i, 2, second, 0, 0)
        )
    for number in ("0", "2"):
        DOORS[door](tmp_path / number)
        assert read_g2o(tmp_path / number).num_edges == 4
    with pytest.raises(FileFormatError, match="the edge from 0 to 2 is nearly that at"):
        DOORS[door](tmp_path / "1")


def test_two_fixes_of_one_pose_are_two_measurements(tmp_path: Path) -> None:
    for number in range(2):
        (tmp_path / f"{number}.g2o").write_text(
            EDGE.format(0, 1 + number, 1, 0, 0)
            + f"EDGE_PRIOR_SE2_XY 0 {100 + number} 0 1 0 1\n"
            + "EDGE_PRIOR_SE2_XY 1 0 9 1 0 1\n"
        )
    graph = read_g2o(tmp_path)
    assert int(graph.is_prior.sum()) == 3


# Robots that are absent


def without(robots: set[int], folder: Path) -> Path:
    folder.mkdir()
    for robot in set(range(4)) - robots:
        shutil.copy(ROBOTS / f"{robot}.g2o", folder)
    return folder


@pytest.mark.parametrize("robots", [{1, 2, 3}, {0}, {0, 2}])
def test_poses_of_absent_robots_are_known(robots: set[int], tmp_path: Path) -> None:
    graph = read_g2o(without(robots, tmp_path / "in"))
    whole = read_g2o(ROBOTS)
    owner = whole.robots[np.searchsorted(whole.pose_ids, graph.pose_ids)]
    np.testing.assert_array_equal(graph.absent, np.flatnonzero(np.isin(owner, list(robots))))
    assert graph.name == "in, only robots with a file here"
    assert f"poses of absent robots={len(graph.absent)}" in repr(graph)
    solution = solve_folder(tmp_path / "in")
    assert solution.num_absent == len(graph.absent)
    lines = str(solution).splitlines()
    assert "in, only robots with a file here: " in lines[0]
    assert f"edges name {len(graph.absent)} poses of robots without a file here" in solution.note
    (verdict,) = [line for line in lines if line.startswith("verdict")]
    assert verdict.endswith("without absent robots")
    part = graph.subgraph(np.flatnonzero(np.isin(owner, list(robots), invert=True)))
    assert not len(part.absent)


def test_nobody_is_absent_where_all_poses_have_a_file(tmp_path: Path) -> None:
    assert not len(read_g2o(ROBOTS).absent)
    assert solve_folder(ROBOTS).num_absent == 0
    # Files without VERTEX lines do not say whose their poses are, and one file is what was asked.
    write_g2o_folder(read_g2o(ROBOTS), tmp_path / "in", None)
    for path in (tmp_path / "in").glob("*.g2o"):
        lines = path.read_text().splitlines(keepends=True)
        path.write_text("".join(line for line in lines if line.startswith("EDGE")))
    assert not len(read_g2o(tmp_path / "in").absent)
    assert solve_folder(tmp_path / "in").num_absent == 0
    with pytest.warns(GraphWarning, match="21 of 61 poses have no VERTEX line"):
        assert not len(read_g2o(ROBOTS / "0.g2o").absent)
