import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from pgo_models import (
    PGOError,
    PGOProblem,
    PoseGraph,
    Poses,
    exp_map,
    grid_world,
    random_geometric,
    read_g2o,
    write_g2o,
)
from pgo_models.errors import FileFormatError, GraphError, GraphWarning
from pgo_models.graphs.g2o import read_g2o_poses, symbol_ids, write_g2o_folder
from pgo_models.graphs.precisions import edge_precisions

EPS = np.finfo(float).eps
SEEDS = st.integers(0, 2**32 - 1)
DIMENSIONS = st.sampled_from([2, 3])

SIZES = {
    "tinyGrid3D": (9, 11, 3, True),
    "smallGrid3D": (125, 297, 3, True),
    "sphere2500": (2500, 4949, 3, True),
    "torus3D": (5000, 9048, 3, True),
    "parking-garage": (1661, 6275, 3, True),
    "cubicle": (5750, 16869, 3, True),
    "CSAIL": (1045, 1172, 2, False),
    "manhattan": (3500, 5453, 2, False),
    "kitti_00": (4541, 4677, 2, False),
    "intel": (1728, 2512, 2, True),
    "city10000": (10000, 20687, 2, True),
}


def random_graph(seed: int, num_poses: int, d: int) -> PoseGraph:
    """A graph with arbitrary ids and full information matrices."""
    rng = np.random.default_rng(seed)
    graph = random_geometric(num_poses, rng, d=d)
    k = 3 if d == 2 else 6
    root = rng.standard_normal((graph.num_edges, k, k))
    information = root @ np.swapaxes(root, 1, 2) + np.eye(k)
    kappa, tau = edge_precisions(information)
    ids = np.sort(rng.choice(2**62, num_poses, replace=False) - 2**40)
    fixed = rng.choice(num_poses, 2, replace=False)
    return dataclasses.replace(
        graph,
        information=information,
        kappa=kappa,
        tau=tau,
        ids=ids,
        fixed=np.sort(fixed),
        truth=None,
        name="graph",
    )


def assert_same_measurements(a: PoseGraph, b: PoseGraph) -> None:
    for name in ("i", "j", "t_ij", "fixed", "pose_ids", "robots"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    # Rotation matrices pass through quaternions, or an angle: a few roundings.
    np.testing.assert_allclose(a.R_ij, b.R_ij, rtol=0, atol=16 * EPS)
    np.testing.assert_allclose(a.kappa, b.kappa, rtol=16 * EPS, atol=0)
    np.testing.assert_allclose(a.tau, b.tau, rtol=16 * EPS, atol=0)


def assert_same_poses(a: Poses | None, b: Poses | None) -> None:
    assert a is not None
    assert b is not None
    np.testing.assert_array_equal(a.t, b.t)
    np.testing.assert_allclose(a.R, b.R, rtol=0, atol=16 * EPS)


@given(seed=SEEDS, num_poses=st.integers(2, 20), d=DIMENSIONS)
def test_writing_and_reading_gives_the_graph_back(
    tmp_path_factory: pytest.TempPathFactory, seed: int, num_poses: int, d: int
) -> None:
    graph = random_graph(seed, num_poses, d)
    path = tmp_path_factory.mktemp("g2o") / "graph.g2o"
    write_g2o(graph, path)
    back = read_g2o(path)
    assert_same_measurements(back, graph)
    assert_same_poses(back.initial, graph.initial)
    assert back.information is not None
    np.testing.assert_array_equal(back.information, graph.information)
    assert back.name == "graph"


@given(seed=SEEDS, d=DIMENSIONS)
def test_without_information_the_precisions_come_back(
    tmp_path_factory: pytest.TempPathFactory, seed: int, d: int
) -> None:
    rng = np.random.default_rng(seed)
    graph = random_geometric(5, rng, d=d)
    kappa, tau = 10.0 ** rng.uniform(-6, 6, (2, graph.num_edges))
    graph = dataclasses.replace(graph, kappa=kappa, tau=tau, initial=None)
    path = tmp_path_factory.mktemp("g2o") / "graph.g2o"
    write_g2o(graph, path)
    back = read_g2o(path)
    assert back.initial is None
    assert_same_measurements(back, dataclasses.replace(graph, robot=back.robot))


@given(seed=SEEDS, d=DIMENSIONS)
def test_precisions_give_the_chi_square_of_a_small_error(seed: int, d: int) -> None:
    # One edge of identities, its end pose off by a small turn and a step: I_theta theta^2 + I_t
    # |t|^2, no 1/2; in the plane rotations have twice that weight.
    rng = np.random.default_rng(seed)
    I_t, I_theta = np.exp(rng.uniform(-5, 5, 2))
    information = np.diag([I_t] * d + [I_theta] * (d * (d - 1) // 2))[None]
    kappa, tau = edge_precisions(information)
    one = np.array([0])
    graph = PoseGraph(2, one, one + 1, np.eye(d)[None], np.zeros((1, d)), kappa, tau)
    turn = 1e-4 * rng.standard_normal(d * (d - 1) // 2)
    step = rng.standard_normal(d)
    poses = Poses(np.stack([np.eye(d), exp_map(turn[None])[0]]), np.stack([np.zeros(d), step]))
    chi_square = I_t * step @ step + (2.0 if d == 2 else 1.0) * I_theta * turn @ turn
    np.testing.assert_allclose(PGOProblem(graph).objective(poses), chi_square, rtol=1e-6, atol=0)


@pytest.mark.parametrize("name", SIZES)
def test_benchmarks_have_their_published_sizes(benchmark_data: Path, name: str) -> None:
    graph = read_g2o(benchmark_data / f"{name}.g2o")
    assert (graph.num_poses, graph.num_edges, graph.d, graph.initial is not None) == SIZES[name]
    assert graph.robot is None
    assert graph.is_connected
    assert graph.name == name


def test_the_fixed_pose_of_intel_is_kept(benchmark_data: Path) -> None:
    text = (benchmark_data / "intel.g2o").read_text()
    assert [f"FIX {p}" for p in read_g2o(benchmark_data / "intel.g2o").fixed] == [
        line.strip() for line in text.splitlines() if line.startswith("FIX")
    ]


@pytest.mark.parametrize(("num_robots", "num_poses", "num_edges"), [(4, 64, 144), (16, 128, 288)])
def test_folders_of_robots_load_as_one_graph(
    benchmark_data: Path, num_robots: int, num_poses: int, num_edges: int
) -> None:
    folder = benchmark_data / f"example_{num_robots}robots"
    graph = read_g2o(folder)
    assert (graph.num_robots, graph.num_poses, graph.num_edges) == (
        num_robots,
        num_poses,
        num_edges,
    )
    assert graph.initial is not None
    assert graph.is_connected
    for pose in range(num_poses):
        assert graph.robots[pose] == (int(graph.pose_ids[pose]) >> 56) - ord("a")
    # Every vertex of robot a is on a VERTEX line of file a.g2o.
    for robot in range(num_robots):
        lines = (folder / f"{robot}.g2o").read_text().splitlines()
        written = {int(line.split()[1]) for line in lines if line.startswith("VERTEX")}
        assert written == set(graph.pose_ids[graph.robots == robot].tolist())


def sorted_edges(graph: PoseGraph) -> PoseGraph:
    order = np.lexsort((graph.t_ij[:, 0], graph.j, graph.i))
    changes = {
        name: getattr(graph, name)[order] for name in ("i", "j", "R_ij", "t_ij", "kappa", "tau")
    }
    return dataclasses.replace(graph, information=None, **changes)


@given(seed=SEEDS, num_robots=st.integers(1, 12), d=DIMENSIONS, symbols=st.booleans())
def test_a_folder_written_is_the_graph_read(
    tmp_path_factory: pytest.TempPathFactory, seed: int, num_robots: int, d: int, symbols: bool
) -> None:
    graph = grid_world(num_robots, 6, np.random.default_rng(seed), d=d)
    if symbols:
        graph = dataclasses.replace(graph, ids=symbol_ids(graph.robots))
    # A repeated measurement stands twice in each file it is in, and counts twice.
    twice = np.append(np.arange(graph.num_edges), graph.num_edges - 1)
    changes = {
        name: getattr(graph, name)[twice] for name in ("i", "j", "R_ij", "t_ij", "kappa", "tau")
    }
    graph = dataclasses.replace(graph, **changes)
    folder = tmp_path_factory.mktemp("robots")
    write_g2o_folder(graph, folder)
    back = read_g2o(folder)
    assert back.name == folder.name
    assert_same_measurements(sorted_edges(back), sorted_edges(graph))
    assert_same_poses(back.initial, graph.initial)


EDGE = "EDGE_SE2 {} {} 1 0 0 1 0 0 1 0 1\n"
VERTEX = "VERTEX_SE2 {} {} 0 0\n"


def test_a_folder_without_symbols_goes_by_vertex_lines_then_by_first_mention(
    tmp_path: Path,
) -> None:
    (tmp_path / "2.g2o").write_text(VERTEX.format(5, 1) + EDGE.format(5, 6))
    (tmp_path / "10.g2o").write_text(VERTEX.format(6, 2) + EDGE.format(6, 7) + EDGE.format(5, 6))
    graph = read_g2o(tmp_path)
    np.testing.assert_array_equal(graph.pose_ids, [5, 6, 7])
    np.testing.assert_array_equal(graph.robots, [0, 1, 1])
    assert graph.num_edges == 2
    assert graph.initial is None


NAMINGS = {
    "the same ids": lambda ids: ids,
    "ids of its own": lambda ids: np.unique(ids, return_inverse=True)[1],
}


@pytest.mark.parametrize("naming", NAMINGS)
@pytest.mark.parametrize("d", [2, 3])
def test_the_whole_graph_beside_the_robots_is_said_and_left_out(
    tmp_path: Path, d: int, naming: str
) -> None:
    robots = np.arange(12) // 4
    graph = dataclasses.replace(random_graph(3, 12, d), robot=robots, ids=symbol_ids(robots))
    write_g2o_folder(graph, tmp_path)
    expected = read_g2o(tmp_path)
    whole = dataclasses.replace(graph, ids=NAMINGS[naming](graph.pose_ids))
    write_g2o(whole, tmp_path / "fullGraph.g2o")
    with pytest.warns(GraphWarning, match=r"fullGraph\.g2o: left out, .* of the other 3 files"):
        found = read_g2o(tmp_path)
    assert found.num_robots == 3
    np.testing.assert_array_equal(found.pose_ids, expected.pose_ids)
    np.testing.assert_array_equal(found.robots, expected.robots)
    assert_same_measurements(found, expected)


@pytest.mark.parametrize(("name", "without_own"), [("all", "robot0"), ("whole", "whole")])
def test_the_whole_graph_under_another_name_is_warned_of(
    tmp_path: Path, name: str, without_own: str
) -> None:
    robots = np.arange(12) // 4
    graph = dataclasses.replace(random_graph(3, 12, 2), robot=robots)
    folder = tmp_path / "folder"
    write_g2o_folder(graph, folder)
    for k in range(3):
        (folder / f"{k}.g2o").rename(folder / f"robot{k}.g2o")
    expected = read_g2o(folder)
    write_g2o(graph, folder / f"{name}.g2o")
    message = rf"{without_own}\.g2o: all its poses are in files before it; .* fullGraph\.g2o"
    with pytest.warns(GraphWarning) as caught:
        found = read_g2o(folder)
    assert any(re.search(message, str(warning.message)) for warning in caught)
    assert found.num_edges == expected.num_edges  # each counts once


def test_robots_that_all_measure_the_same_step_keep_their_edges(tmp_path: Path) -> None:
    poses = np.arange(7)
    edges = [EDGE.format(i, j) for i, j in zip(poses, np.roll(poses, -1), strict=True)]
    for number, text in enumerate((edges[:3], edges[3:5], edges[5:])):
        (tmp_path / f"{number}.g2o").write_text("".join(text))
    assert read_g2o(tmp_path).num_edges == len(edges)


def test_two_files_with_the_same_edges_are_two_robots(tmp_path: Path) -> None:
    for number in range(2):
        (tmp_path / f"{number}.g2o").write_text(VERTEX.format(number, number) + EDGE.format(0, 1))
    np.testing.assert_array_equal(read_g2o(tmp_path).robots, [0, 1])


def test_the_own_robot_says_where_a_pose_is(tmp_path: Path) -> None:
    a, b = symbol_ids(np.array([0, 0, 1, 1])).reshape(2, 2)
    (tmp_path / "0.g2o").write_text(
        VERTEX.format(a[0], 1)
        + VERTEX.format(a[1], 2)
        + VERTEX.format(b[0], 77)
        + EDGE.format(a[0], a[1])
    )
    (tmp_path / "1.g2o").write_text(
        VERTEX.format(a[1], 88)
        + VERTEX.format(b[0], 3)
        + VERTEX.format(b[1], 4)
        + EDGE.format(a[1], b[0])
    )
    graph = read_g2o(tmp_path)
    assert graph.initial is not None
    np.testing.assert_array_equal(graph.initial.t[:, 0], [1, 2, 3, 4])
    np.testing.assert_array_equal(graph.robots, [0, 0, 1, 1])


def test_repeated_edges_of_one_file_all_count(tmp_path: Path) -> None:
    (tmp_path / "a.g2o").write_text(EDGE.format(0, 1) * 3)
    assert read_g2o(tmp_path / "a.g2o").num_edges == 3
    (tmp_path / "b.g2o").write_text(EDGE.format(0, 1) * 2)
    assert read_g2o(tmp_path).num_edges == 3


def test_poses_without_vertex_lines_are_placed_along_edges_or_leave_no_estimate(
    tmp_path: Path,
) -> None:
    path = tmp_path / "a.g2o"
    path.write_text(VERTEX.format(3, 1) + VERTEX.format(9, 1) + EDGE.format(9, 20))
    with pytest.warns(GraphWarning, match=r"1 of 3 poses have no VERTEX line \(the first is 20\)"):
        graph = read_g2o(path)
    np.testing.assert_array_equal(graph.pose_ids, [3, 9, 20])
    moved = graph.initial.R[1] @ graph.t_ij[0] + graph.initial.t[1]
    np.testing.assert_allclose(graph.initial.t[2], moved, rtol=0, atol=1e-12)
    with pytest.raises(GraphError, match="pose 3 has no edges; leave out"):
        graph.check_connected()
    path.write_text(VERTEX.format(3, 1) + EDGE.format(3, 9) + EDGE.format(9, 20))
    with pytest.warns(GraphWarning, match="2 of 3 .* the estimate is left out"):
        assert read_g2o(path).initial is None


def test_quaternions_are_normalised(tmp_path: Path) -> None:
    path = tmp_path / "a.g2o"
    path.write_text("EDGE_SE3:QUAT 0 1 0 0 0 0 0 2 2 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1\n")
    np.testing.assert_allclose(
        read_g2o(path).R_ij[0], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], rtol=0, atol=4 * EPS
    )


NOISE = st.sampled_from(
    [
        "",
        "-",
        "x",
        "nan",
        "1e400",
        "0",
        "-1",
        "1 2",
        "\n",
        "#",
        "\0",
        "\u00e9",
        "1_0",
        "99999999999999999999",
    ]
)


@pytest.mark.filterwarnings("ignore::pgo_models.errors.GraphWarning")
@given(seed=SEEDS, d=DIMENSIONS, noise=NOISE, data=st.data())
def test_a_damaged_file_is_read_or_refused_with_all_its_lines(
    tmp_path_factory: pytest.TempPathFactory, seed: int, d: int, noise: str, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("g2o") / "graph.g2o"
    write_g2o(random_graph(seed, 4, d), path)
    words = path.read_text().replace("\n", " \n ").split(" ")
    at = data.draw(st.integers(0, len(words) - 1))
    words[at] = noise
    path.write_text(" ".join(words))
    problem = ""
    try:
        read_g2o(path)
    except FileFormatError as error:
        problem = str(error)
    if problem:
        *lines, last = problem.split("\n")
        assert all(line.startswith(f"{path}:") for line in lines)
        if lines:
            assert last.partition(";")[0] == f"{len(lines)} lines are wrong"
        else:
            assert last.startswith(str(path))


def test_bad_folders_and_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="without g2o files"):
        read_g2o(tmp_path)
    (tmp_path / "a.g2o").write_text(VERTEX.format(0, 0))
    with pytest.raises(FileFormatError, match="no edges"):
        read_g2o(tmp_path / "a.g2o")
    (tmp_path / "a.g2o").write_text(EDGE.format(0, 1) + "FIX 1 2\n")
    with pytest.raises(FileFormatError, match=r"a.g2o:2: FIX names pose 2"):
        read_g2o(tmp_path / "a.g2o")
    (tmp_path / "a.g2o").write_text(EDGE.format(0, 1))
    (tmp_path / "b.g2o").write_text("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n")
    with pytest.raises(FileFormatError, match=r"b.g2o: 3D, but .*a.g2o is 2D"):
        read_g2o(tmp_path)


def test_a_folder_without_edges_is_refused(tmp_path: Path) -> None:
    for robot in range(3):
        (tmp_path / f"{robot}.g2o").write_text(VERTEX.format(robot, 0))
    with pytest.raises(FileFormatError, match="no edges; a pose graph needs at least one"):
        read_g2o(tmp_path)


def test_poses_are_read_in_the_order_of_the_graph(tmp_path: Path) -> None:
    graph = random_graph(0, 6, 2)
    assert graph.initial is not None
    write_g2o(graph, tmp_path / "a.g2o")
    lines = [
        line for line in (tmp_path / "a.g2o").read_text().splitlines() if line.startswith("VERTEX")
    ]
    (tmp_path / "b.g2o").write_text("\n".join(reversed(lines)))
    assert_same_poses(read_g2o_poses(tmp_path / "b.g2o", graph), graph.initial)
    (tmp_path / "b.g2o").write_text("\n".join(lines[1:]))
    with pytest.raises(FileFormatError, match=f"no VERTEX line for pose {graph.pose_ids[0]}"):
        read_g2o_poses(tmp_path / "b.g2o", graph)
    with pytest.raises(FileFormatError, match="2D, but random_geometric is 3D"):
        read_g2o_poses(tmp_path / "b.g2o", random_geometric(6, np.random.default_rng(0)))


def test_what_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    graph = random_graph(0, 6, 3)
    with pytest.raises(PGOError, match="cannot write"):
        write_g2o(graph, tmp_path / "missing" / "a.g2o")
    with pytest.raises(GraphError, match="needs 6 of them"):
        write_g2o(graph, tmp_path / "a.g2o", Poses.identity(5, 3))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("num_robots", [1, 26, 27, 52])
def test_symbols_ascend_and_name_the_robot(num_robots: int) -> None:
    robots = np.repeat(np.arange(num_robots), 3)
    ids = symbol_ids(robots)
    assert (np.diff(ids) > 0).all()
    np.testing.assert_array_equal(np.unique(ids >> 56, return_inverse=True)[1], robots)
