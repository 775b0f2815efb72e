"""Dialects of g2o files: what lines of GTSAM, TORO and iSAM mean, and what is assumed of them."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, assert_says, random_poses
from hypothesis import given, strategies as st

from pgo_models import (
    Chi2Convention,
    PoseGraph,
    Poses,
    Reading,
    chi2,
    exp_map,
    log_map,
    random_rotations,
    read_g2o,
    write_g2o,
)
from pgo_models.errors import FileFormatError, GraphWarning
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.g2o import read_g2o_poses
from pgo_models.graphs.g2o_rows import numbers_of

ODOMETRY_2D = "EDGE_SE2 0 1 1 0 0 4 0 0 4 0 9"
STEP = 1e-20  # imaginary: derivatives by complex steps have no cancellation


@pytest.fixture
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("dialects")


def read(folder: Path, lines: Sequence[str]) -> PoseGraph:
    path = folder / "graph.g2o"
    path.write_text("\n".join(lines) + "\n")
    return read_g2o(path)


def read_with_notes(folder: Path, lines: Sequence[str], *words: str) -> PoseGraph:
    """The graph, which is read with one warning that has these words."""
    with pytest.warns(GraphWarning) as caught:
        graph = read(folder, lines)
    (text,) = (str(warning.message) for warning in caught)
    assert text.startswith(str(folder / "graph.g2o"))
    assert "\n" not in text
    for word in words:
        assert word in text
    return graph


def definite(rng: np.random.Generator, n: int, k: int) -> Array:
    root = rng.standard_normal((n, k, k))
    return root @ root.mT + np.eye(k)


def words(numbers: Array) -> str:
    return " ".join(map(repr, np.ravel(numbers).tolist()))


def triangle(matrix: Array) -> str:
    return words(matrix[np.triu_indices(len(matrix))])


def assert_same_edges(a: PoseGraph, b: PoseGraph, rtol: float = 1e-12) -> None:
    np.testing.assert_array_equal([a.i, a.j], [b.i, b.j])
    for name in ("R_ij", "t_ij", "kappa", "tau", "information"):
        size = np.abs(getattr(b, name)).max()
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=rtol, atol=1e-13 * size)


@given(seed=SEEDS, num_edges=st.integers(1, 6), by_rows=st.booleans())
def test_edge2_is_read_in_the_order_in_which_all_matrices_are_definite(
    tmp_path_factory: pytest.TempPathFactory, seed: int, num_edges: int, by_rows: bool
) -> None:
    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp("edge2")
    information = definite(rng, num_edges, 3)
    # A diagonal matrix is definite in one order alone, and one line decides for all.
    information[rng.integers(num_edges)] = np.diag(rng.uniform(1, 5, 3))
    measured = rng.standard_normal((num_edges, 3))
    toro = [(0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2)]
    rows = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    edge2 = []
    edge_se2 = []
    for e in range(num_edges):
        start = f"{e} {e + 1} {words(measured[e])}"
        order = rows if by_rows else toro
        entries = np.array([information[e][place] for place in order])
        edge2.append(f"EDGE2 {start} {words(entries)}")
        edge_se2.append(f"EDGE_SE2 {start} {triangle(information[e])}")
    expected = read(folder, edge_se2)
    if by_rows:
        graph = read_with_notes(folder, edge2, "EDGE2", "iSAM's order", "as information", "square")
    else:
        graph = read(folder, edge2)
    assert_same_edges(graph, expected)


def test_edge2_in_either_order_is_read_as_toro_does_and_said(folder: Path) -> None:
    lines = ["EDGE2 0 1 1 2 0.5 10 1 5 20 2 9"]
    graph = read_with_notes(folder, lines, "TORO's order", "positive definite in iSAM's", "too")
    np.testing.assert_array_equal(graph.information[0], [[10, 1, 2], [1, 5, 9], [2, 9, 20]])


def test_edge2_in_neither_order_is_refused_line_by_line(folder: Path) -> None:
    lines = ["EDGE2 0 1 1 2 0.5 -1 0 1 1 0 0", "EDGE2 1 2 1 2 0.5 1 0 1 1 0 0"]
    with pytest.raises(FileFormatError) as caught:
        read(folder, [*lines, "EDGE2 2 3 1 2 0.5 1 0 -1 1 0 0"])
    assert caught.value.line == 1
    assert ":3: translation block" in str(caught.value)
    assert str(caught.value).endswith("\n2 lines are wrong")


def test_edge3_without_a_matrix_has_the_identity(folder: Path) -> None:
    identity = triangle(np.eye(6))
    measured = ["1 2 3 0.1 0.2 0.3", "0 1 0 -0.1 0.5 0.7", "3 1 2 0.3 0.2 0.1"]
    whole = [f"EDGE3 {e} {e + 1} {text} {identity}" for e, text in enumerate(measured)]
    vertices = [f"VERTEX3 {k} 0 0 0 0 0 0" for k in range(4)]
    expected = read(folder, [*vertices, *whole])
    short = [f"EDGE3 {e} {e + 1} {text}" for e, text in enumerate(measured)]
    graph = read_with_notes(folder, [*vertices, *short], "3 EDGE3 lines have no matrix", "identity")
    assert_same_edges(graph, expected, rtol=0)
    mixed = [*vertices, whole[0], short[1], whole[2]]
    graph = read_with_notes(folder, mixed, "1 EDGE3 lines have no matrix")
    assert_same_edges(graph, expected, rtol=0)
    with pytest.raises(FileFormatError, match=r":2: EDGE3 needs 2 ids and 27 numbers"):
        read(folder, [short[0], f"{short[1]} 1"])


def test_edge3_of_isam_is_taken_as_information_and_said(folder: Path) -> None:
    line = f"EDGE3 0 1 1 2 3 0.1 0.2 0.3 {triangle(np.eye(6))}"
    read_with_notes(folder, [line], "EDGE3 matrices are taken as information", "square roots")
    vertices = ["VERTEX3 0 0 0 0 0 0 0", "VERTEX3 1 1 2 3 0 0 0"]
    read(folder, [*vertices, line])  # TORO's, without a warning


@given(seed=SEEDS)
def test_odometry_and_landmark_have_covariances(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp("covariances")
    of_pose = definite(rng, 1, 3)[0]
    of_point = definite(rng, 1, 2)[0]
    expected = read(
        folder,
        [
            f"EDGE_SE2 0 1 1 2 0.5 {triangle(np.linalg.inv(of_pose))}",
            f"EDGE_SE2_XY 1 7 3 4 {triangle(np.linalg.inv(of_point))}",
        ],
    )
    graph = read_with_notes(
        folder,
        [
            f"ODOMETRY 0 1 1 2 0.5 {triangle(of_pose)}",
            f"LANDMARK 1 7 3 4 {triangle(of_point)}",
        ],
        "ODOMETRY and LANDMARK matrices are taken as covariances, as GTSAM does",
    )
    assert graph.landmarks.tolist() == [2]
    assert_same_edges(graph, expected, rtol=1e-9)


def test_landmark2_is_edge_se2_xy_with_ids_of_its_own(folder: Path) -> None:
    lines = [ODOMETRY_2D, "LANDMARK2 0 1 1 2 10 1 20", "LANDMARK2 1 0 0 2 5 0 5", "FIX 1"]
    graph = read_with_notes(
        folder, lines, "LANDMARK2 matrices are taken as information", "10 is added"
    )
    expected = read(
        folder,
        [ODOMETRY_2D, "EDGE_SE2_XY 0 11 1 2 10 1 20", "EDGE_SE2_XY 1 10 0 2 5 0 5", "FIX 1"],
    )
    assert_same_edges(graph, expected, rtol=0)
    np.testing.assert_array_equal(graph.pose_ids, [0, 1, 10, 11])
    np.testing.assert_array_equal(graph.landmarks, [2, 3])
    np.testing.assert_array_equal(graph.fixed, [1])


def test_tags_keep_poses_and_landmarks_of_one_id_apart(folder: Path) -> None:
    lines = [
        "VERTEX_SE2 0 0 0 0",
        "VERTEX_SE2 7 1 0 0",
        "VERTEX_XY 7 3 4",
        "VERTEX_XY 8 5 6",
        "EDGE_SE2 0 7 1 0 0 4 0 0 4 0 9",
        "EDGE_SE2_XY 0 7 3 4 1 0 1",
        "EDGE_SE2_XY 7 8 4 6 1 0 1",
        "EDGE_PRIOR_XY 7 3 4 1 0 1",
        "EDGE_PRIOR_SE2 7 1 0 0 1 0 0 1 0 1",
        "FIX 8 0",
    ]
    graph = read_with_notes(folder, lines, "ids in common (1)", "10 is")
    np.testing.assert_array_equal(graph.pose_ids[graph.in_files], [0, 7, 17, 18])
    np.testing.assert_array_equal(graph.initial.t[:4], [[0, 0], [1, 0], [3, 4], [5, 6]])
    np.testing.assert_array_equal(graph.j, [1, 2, 3, 2, 1])
    np.testing.assert_array_equal(graph.fixed, [0, 3])
    assert chi2(graph, graph.initial) == 0.0
    # What is written names each with an id of its own, and is read without a warning.
    write_g2o(graph, folder / "written.g2o")
    again = read_g2o(folder / "written.g2o")
    np.testing.assert_array_equal(again.pose_ids, graph.pose_ids)
    poses = read_g2o_poses(folder / "written.g2o", graph)
    np.testing.assert_array_equal(poses.t, graph.initial.t)


def test_ids_without_room_for_landmarks_are_refused(folder: Path) -> None:
    symbol = ord("x") << 56
    lines = [f"EDGE_SE2_XY {symbol} {symbol} 1 2 1 0 1"]
    with pytest.raises(FileFormatError) as caught:
        read(folder, lines)
    assert_says(caught.value, str(folder / "graph.g2o"), ["of a pose and of a landmark", "renum"])


def test_robots_need_landmarks_with_ids_of_their_own(folder: Path) -> None:
    for robot in range(2):
        (folder / f"{robot}.g2o").write_text(
            f"EDGE_SE2 {robot} {robot + 1} 1 0 0 4 0 0 4 0 9\nEDGE_SE2_XY 1 1 1 2 1 0 1\n"
        )
    with (
        pytest.warns(GraphWarning, match="kept apart"),
        pytest.raises(FileFormatError, match=r"0.g2o: .* in a folder of several files"),
    ):
        read_g2o(folder)


@given(seed=SEEDS)
def test_a_point_in_polar_coordinates_has_the_covariance_to_first_order(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp("polar")
    bearing = rng.uniform(-np.pi, np.pi)
    distance = rng.uniform(0.5, 20.0)
    deviations = rng.uniform(0.01, 0.5, 2)

    def point(b: complex, r: complex) -> np.ndarray:
        return np.array([r * np.cos(b), r * np.sin(b)])

    numbers = np.array([bearing, distance, *deviations])
    graph = read_with_notes(
        folder, [ODOMETRY_2D, f"BR 0 7 {words(numbers)}"], "BR", "to first order"
    )
    np.testing.assert_allclose(graph.t_ij[1], point(bearing, distance), rtol=0, atol=1e-13)
    along_bearing = point(bearing + STEP * 1j, distance).imag
    along_range = point(bearing, distance + STEP * 1j).imag
    jacobian = np.stack([along_bearing, along_range], axis=1) / STEP
    covariance = jacobian @ np.diag(deviations**2) @ jacobian.T
    information = graph.information[1, :2, :2]
    rounding = 1e-14 * np.linalg.cond(covariance)
    np.testing.assert_allclose(information @ covariance, np.eye(2), rtol=0, atol=rounding)
    np.testing.assert_allclose(graph.tau[1], 2 / np.trace(covariance), rtol=rounding, atol=0)


def test_equivalences_of_toro_are_skipped_and_counted(folder: Path) -> None:
    edge = "EDGE2 0 1 1 0 0 4 0 4 9 0 0"
    graph = read_with_notes(folder, [edge, "EQUIV 0 1", "EQUIV 1 0"], "2 EQUIV lines are skipped")
    assert graph.num_edges == 1


def offset_line(d: int, number: int, sensors: Poses) -> str:
    tag = f"PARAMS_SE{d}OFFSET"
    return f"{tag} {number} {words(numbers_of(sensors.R, sensors.t)[number - 1])}"


@pytest.mark.filterwarnings("ignore:.*lines name sensor 0")
@given(seed=SEEDS, d=DIMENSIONS)
def test_a_landmark_seen_by_a_sensor_costs_what_the_sensor_sees(
    tmp_path_factory: pytest.TempPathFactory, seed: int, d: int
) -> None:
    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp("sensors")
    sensors = random_poses(2, d, seed)
    tag = "EDGE_SE2_POINTXY_OFFSET" if d == 2 else "EDGE_SE3_TRACKXYZ"
    seen = rng.standard_normal((3, d))
    information = definite(rng, 3, d)
    lines = [offset_line(d, 1, sensors), offset_line(d, 2, sensors)]
    lines += [f"PARAMS_SE{d}OFFSET 3 not used"]
    for e, number in enumerate((1, 2, 0)):
        lines.append(f"{tag} {e} 9 {number} {words(seen[e])} {triangle(information[e])}")
    graph = read(folder, lines)
    poses = graph.completed(random_poses(4, d, seed + 1))
    sensor_R = np.concatenate([sensors.R, np.eye(d)[None]])
    sensor_t = np.concatenate([sensors.t, np.zeros((1, d))])
    expected = 0.0
    for e in range(3):
        R = poses.R[e] @ sensor_R[e]
        t = poses.t[e] + poses.R[e] @ sensor_t[e]
        error = R.T @ (poses.t[3] - t) - seen[e]
        expected += error @ information[e] @ error
    np.testing.assert_allclose(chi2(graph, poses), expected, rtol=1e-9, atol=0)
    np.testing.assert_array_equal(graph.t_ij[2], seen[2])


def sensor_cost(poses: Poses, sensors: Poses, measured: Poses, information: Array) -> float:
    """e^T I e of an edge between sensors 0 and 1 at poses 0 and 1, with the angle of the turn."""
    R = poses.R @ sensors.R
    t = poses.t + np.einsum("nab,nb->na", poses.R, sensors.t)
    R_ij = R[0].T @ R[1]
    t_ij = R[0].T @ (t[1] - t[0])
    Z = measured.R.reshape(R_ij.shape)
    turn = log_map((Z.T @ R_ij)[None])[0]
    error = np.concatenate([Z.T @ (t_ij - measured.t.ravel()), turn])
    return float(error @ information @ error)


def line_between_sensors(d: int, measured: Poses, information: Array) -> str:
    tag = f"EDGE_SE{d}_OFFSET"
    numbers = words(numbers_of(measured.R, measured.t))
    return f"{tag} 0 1 1 2 {numbers} {triangle(information)}"


@given(seed=SEEDS, d=DIMENSIONS, beside=st.booleans())
def test_an_edge_between_sensors_costs_what_they_measure(
    tmp_path_factory: pytest.TempPathFactory, seed: int, d: int, beside: bool
) -> None:
    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp("sensors")
    sensors = random_poses(2, d, seed)
    if not beside:  # the second sensor is turned and stands at its pose: no approximation
        sensors = Poses(sensors.R, sensors.t * [[1.0], [0.0]])
    measured = random_poses(1, d, seed + 1)
    information = definite(rng, 1, 3 * d - 3)[0]
    lines = [offset_line(d, 1, sensors), offset_line(d, 2, sensors)]
    graph = read(folder, [*lines, line_between_sensors(d, measured, information)])
    start = random_poses(1, d, seed + 2)
    # Poses at which the measurement has the errors h (t, w).
    direction = rng.standard_normal(3 * d - 3)
    ratios = []
    for h in (1e-2, 1e-4):
        turn = exp_map(h * direction[None, d:])
        R_ij = graph.R_ij @ turn
        t_ij = graph.t_ij + h * direction[None, :d]
        R = np.concatenate([start.R, start.R @ R_ij])
        t = np.concatenate([start.t, start.t + np.einsum("nab,nb->na", start.R, t_ij)])
        poses = Poses(R, t)
        exact = sensor_cost(poses, sensors, measured, information)
        ratios.append(chi2(graph, poses, Chi2Convention.GEODESIC) / exact - 1)
    if beside:
        assert abs(ratios[1]) < 1e-2 * np.linalg.cond(information)
        assert abs(ratios[1]) <= max(0.1 * abs(ratios[0]), 1e-6 * np.linalg.cond(information))
    else:
        np.testing.assert_allclose(ratios[0], 0, rtol=0, atol=1e-9)


@given(seed=SEEDS)
def test_a_prior_of_a_sensor_is_one_of_its_pose(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    folder = tmp_path_factory.mktemp("sensors")
    sensors = random_poses(1, 3, seed)
    poses = random_poses(2, 3, seed + 1)
    measured_R = poses.R[1] @ sensors.R[0]
    measured_t = poses.t[1] + poses.R[1] @ sensors.t[0]
    relative = Poses(
        (poses.R[0].T @ poses.R[1])[None], (poses.R[0].T @ (poses.t[1] - poses.t[0]))[None]
    )
    identity = triangle(np.eye(6))
    lines = [
        offset_line(3, 1, sensors),
        f"EDGE_SE3:QUAT 0 1 {words(numbers_of(relative.R, relative.t))} {identity}",
        f"EDGE_SE3_PRIOR 1 1 {words(numbers_of(measured_R[None], measured_t[None]))} {identity}",
    ]
    graph = read(folder, lines)
    assert chi2(graph, graph.completed(poses)) < 1e-24 * (1 + np.square(poses.t).sum())


def test_an_offset_of_the_identity_changes_no_bit(folder: Path) -> None:
    rng = np.random.default_rng(0)
    R = random_rotations(1, 3, rng)
    numbers = words(numbers_of(R, rng.standard_normal((1, 3))))
    plain = f"EDGE_SE3:QUAT 0 1 {numbers} {triangle(definite(rng, 1, 6)[0])}"
    named = plain.replace("EDGE_SE3:QUAT 0 1", "EDGE_SE3_OFFSET 0 1 4 4")
    expected = read(folder, [plain])
    graph = read(folder, ["PARAMS_SE3OFFSET 4 0 0 0 0 0 0 1", named])
    for name in ("R_ij", "t_ij", "information"):
        np.testing.assert_array_equal(getattr(graph, name), getattr(expected, name))


def test_files_that_are_no_pose_graphs_are_refused_in_one_line(folder: Path) -> None:
    cases = {
        "3 7 19\n\n0 0 -385.99 387.12\n": ["unknown tag '3'", "no line has a tag", "images"],
        "t,x,y\n1,2,3\n": ["unknown tag 't,x,y'", "IMU"],
        "EDGE2 0 1 1 0 1 1 0 0\nEDGE2 1 1 2 0 2 1 0 0 2 0 0\n": ["hypotheses", "EDGE_SE2"],
        "VERTEX_XY L0 1 2\nEDGE_RANGE 0.0 A0 L0 3 0.1\n": ["EDGE_RANGE measures a range"],
        "VERTEX_SE2 0 0 0 0\n": ["no edges"],
    }
    for text, expected in cases.items():
        (folder / "graph.txt").write_text(text)
        with pytest.raises(FileFormatError) as caught:
            read_g2o(folder / "graph.txt")
        assert_says(caught.value, str(folder / "graph.txt"), expected)


@given(seed=SEEDS, num_lines=st.integers(2, 60), num_wrong=st.integers(1, 60))
def test_all_wrong_lines_are_named_in_one_run(
    tmp_path_factory: pytest.TempPathFactory, seed: int, num_lines: int, num_wrong: int
) -> None:
    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp("wrong")
    num_wrong = min(num_wrong, num_lines - 1)
    wrong = np.sort(rng.choice(num_lines, num_wrong, replace=False))
    faults = [
        lambda line: line.replace("1.5", "one"),
        lambda line: line.replace("4 0 9", "4 0 -9"),
        lambda line: line.removesuffix(" 9"),
        lambda line: line.replace("1.5", "inf"),
        lambda line: line.replace("4 0 0 4 0 9", "0 0 0 0 0 0"),
        lambda line: line.replace("1.5", "1e20"),
        lambda line: line.replace("EDGE_SE2 ", "EDGE_SE2 x"),
    ]
    lines = [f"EDGE_SE2 {e} {e + 1} 1.5 0 0 4 0 0 4 0 9" for e in range(num_lines)]
    for e in wrong:
        lines[e] = faults[rng.integers(len(faults))](lines[e])
    path = folder / "graph.g2o"
    path.write_text("\n".join(lines))
    with pytest.raises(FileFormatError) as caught:
        read_g2o(path)
    assert caught.value.line == wrong[0] + 1
    text = str(caught.value)
    named = [int(line) for line in re.findall(rf"^{re.escape(str(path))}:(\d+): ", text, re.M)]
    assert set(named) <= set(wrong + 1)
    # Of a problem that more than three lines have, the first line is named, and the others counted.
    num_more = [int(count) for count in re.findall(r"^so are (\d+) more lines, up to", text, re.M)]
    assert all(count >= 3 for count in num_more)
    if len(named) <= 20 and "are named" not in text:
        assert len(named) + sum(num_more) == num_wrong
    if len(named) > 1:
        assert text.split("\n")[-1].startswith(f"{num_wrong} lines are wrong")


@given(seed=SEEDS, d=DIMENSIONS)
def test_square_roots_are_those_of_the_information(
    tmp_path_factory: pytest.TempPathFactory, seed: int, d: int
) -> None:
    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp("roots")
    k = 3 * d - 3
    of_pose = definite(rng, 2, k)
    of_point = definite(rng, 2, d)
    root_of_pose = np.linalg.cholesky(of_pose, upper=True)
    root_of_point = np.linalg.cholesky(of_point, upper=True)
    poses = random_poses(2, d, seed)
    numbers = numbers_of(poses.R, poses.t)
    edge = {2: "EDGE_SE2", 3: "EDGE_SE3:QUAT"}[d]
    sight = {2: "EDGE_SE2_XY", 3: "EDGE_SE3_TRACKXYZ"}[d]
    information = []
    roots = []
    for e in range(2):
        start = f"{edge} {e} {e + 1} {words(numbers[e])}"
        information.append(f"{start} {triangle(of_pose[e])}")
        roots.append(f"{start} {triangle(root_of_pose[e])}")
        start = f"{sight} {e} 9 {words(poses.t[e])}"
        information.append(f"{start} {triangle(of_point[e])}")
        roots.append(f"{start} {triangle(root_of_point[e])}")
    expected = read(folder, information)
    path = folder / "roots.g2o"
    isam = {"EDGE_SE2 ": "EDGE2 ", "EDGE_SE2_XY": "LANDMARK"}
    spellings = [roots]
    if d == 2:
        for tag, name in isam.items():
            spellings.append([line.replace(tag, name) for line in roots])
    for lines in spellings:
        path.write_text("\n".join(lines))
        assert_same_edges(read_g2o(path, reading=Reading.SQUARE_ROOTS), expected, rtol=1e-9)


PLANE = [
    "PARAMS_SE2OFFSET 1 0.1 0.2 0.3",
    "EDGE2 0 1 1 0 0.5 4 0 4 9 0 0",
    "ODOMETRY 1 2 1 0 0.5 4 0 0 4 0 9",
    "EDGE_SE2_OFFSET 2 3 1 1 1 0 0.5 4 0 0 4 0 9",
    "LANDMARK 0 1 3 4 2 0 2",
    "LANDMARK2 1 1 2 3 2 0 2",
    "BR 2 2 0.5 4 0.1 0.2",
    "EDGE_SE2_POINTXY_OFFSET 3 2 1 0.5 4 3 0 3",
    "EQUIV 0 1",
]
SPACE = [
    "PARAMS_SE3OFFSET 1 0.1 0.2 0.3 0 0 0.6 0.8",
    "EDGE3 0 1 1 0 0 0.1 0.2 0.3",
    f"EDGE3 1 2 1 0 0 0.1 0.2 0.3 {triangle(np.eye(6))}",
    f"EDGE_SE3_OFFSET 2 3 1 1 1 0 0 0 0 0 1 {triangle(np.eye(6))}",
    f"EDGE_SE3_PRIOR 2 1 1 0 0 0 0 0 1 {triangle(np.eye(6))}",
    "EDGE_SE3_TRACKXYZ 0 1 1 1 2 3 1 0 0 1 0 1",
    "EDGE_SE3_TRACKXYZ 1 1 1 2 3 1 0 0 1 0 1",
]
NOISE = st.sampled_from(
    ["", "0", "-1", "1e99", "1e-99", "5e-324", "-3", "x", "nan", "9" * 18, "\n", "1 2", "#", "1.5"]
)


@pytest.mark.filterwarnings("ignore::pgo_models.errors.GraphWarning")
@given(lines=st.sampled_from([PLANE, SPACE]), noise=NOISE, roots=st.booleans(), data=st.data())
def test_damaged_lines_are_read_or_refused_with_their_place(
    tmp_path_factory: pytest.TempPathFactory,
    lines: list[str],
    noise: str,
    roots: bool,
    data: st.DataObject,
) -> None:
    path = tmp_path_factory.mktemp("damaged") / "graph.g2o"
    parts = " \n ".join(lines).split(" ")
    parts[data.draw(st.integers(0, len(parts) - 1))] = noise
    path.write_text(" ".join(parts))
    problem = str(path)
    try:
        reading = Reading.SQUARE_ROOTS if roots else Reading.AS_WRITTEN
        graph = read_g2o(path, reading=reading)
        for values in (graph.kappa, graph.tau, graph.information):
            assert np.isfinite(values).all()
    except FileFormatError as error:
        problem = str(error)
    assert problem.startswith(str(path))
