"""Forms in which people write g2o files: left out and complete matrices, other tags, comments."""

import gzip
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from graphs import assert_says

from pgo_models import (
    PGOProblem,
    PoseGraph,
    Poses,
    Reading,
    Weighting,
    exp_map,
    load,
    log_map,
    read_g2o,
    write_g2o,
)
from pgo_models.errors import FileFormatError, GraphWarning, SettingError
from pgo_models.graphs.g2o import read_g2o_poses
from pgo_models.graphs.g2o_tags import COMPLETE_TAGS, TAGS

EDGE_2D = "EDGE_SE2 0 1 1 2 0.5 4 0 0 4 0 9"
TRIANGLE_3D = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
EDGE_3D = f"EDGE_SE3:QUAT 0 1 1 2 3 0 0 0.6 0.8 {TRIANGLE_3D}"


def read(folder: Path, lines: Sequence[str], **options: object) -> PoseGraph:
    path = folder / "graph.g2o"
    path.write_text("\n".join(lines) + "\n")
    return read_g2o(path, **options)


def assert_same(a: PoseGraph, b: PoseGraph) -> None:
    assert a.num_poses == b.num_poses
    for name in ("i", "j", "R_ij", "t_ij", "kappa", "tau", "information", "ids"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize(
    ("edge", "num_words"),
    [(EDGE_2D, 6), (EDGE_3D, 10), ("EDGE_PRIOR_SE2 0 1 2 0.5 1 0 0 1 0 1", 5)],
)
def test_edges_without_matrices_need_a_choice_of_weights(
    tmp_path: Path, edge: str, num_words: int
) -> None:
    bare = " ".join(edge.split()[:num_words])
    other = EDGE_3D if "3:" in edge else EDGE_2D
    with pytest.raises(FileFormatError) as caught:
        read(tmp_path, [other, bare, bare])
    words = ["2 ", "lines", "no information matrix", "--cost unit", "--estimate-noise"]
    assert_says(caught.value, f"{tmp_path / 'graph.g2o'}:2: ", words)
    graph = read(tmp_path, [other, bare, bare], unit_weights=True)
    assert graph.information is None
    np.testing.assert_array_equal(graph.kappa, 1.0)
    np.testing.assert_array_equal(graph.tau, 1.0)
    whole = read(tmp_path, [other, edge, edge])
    np.testing.assert_array_equal(graph.t_ij, whole.t_ij)
    np.testing.assert_array_equal(graph.R_ij, whole.R_ij)


def test_an_estimate_needs_no_matrices(tmp_path: Path) -> None:
    vertices = ["VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 1 2 0"]
    graph = read(tmp_path, [*vertices, EDGE_2D])
    (tmp_path / "bare.g2o").write_text("\n".join([*vertices, "EDGE_SE2 0 1 1 2 0.5"]))
    poses = read_g2o_poses(tmp_path / "bare.g2o", graph)
    np.testing.assert_array_equal(poses.t, [[0, 0], [1, 2]])


@pytest.mark.filterwarnings("ignore:.*EDGE_SE3_PRIORQUAT has w first")
@pytest.mark.filterwarnings("ignore:.*matrices have the rotation first")
@pytest.mark.parametrize("tag", sorted(set(COMPLETE_TAGS) - {"EDGE3"}))
def test_a_complete_matrix_is_that_of_its_triangle(tmp_path: Path, tag: str) -> None:
    kind = TAGS[tag]
    rng = np.random.default_rng(0)
    side = round((TAGS[COMPLETE_TAGS[tag]].num_numbers - kind.num_measured) ** 0.5)
    root = rng.standard_normal((side, side))
    matrix = root @ root.T + np.eye(side)
    matrix = np.triu(matrix) + np.triu(matrix, 1).T
    measured = rng.standard_normal(kind.num_measured)
    if kind.is_similarity:
        measured[6] = 0.0  # the logarithm of the scale
    start = (
        f"{tag} {' '.join(map(str, range(kind.num_ids)))} {' '.join(map(repr, measured.tolist()))}"
    )
    words = " ".join(map(repr, matrix.ravel().tolist()))
    triangle = " ".join(map(repr, matrix[np.triu_indices(side)].tolist()))
    chain = [f"EDGE_SE2 7 8 {EDGE_2D[13:]}", f"EDGE_SE3:QUAT 7 8 {EDGE_3D[18:]}"][kind.d - 2]
    assert_same(
        read(tmp_path, [chain, f"{start} {words}"]), read(tmp_path, [chain, f"{start} {triangle}"])
    )


def test_a_matrix_that_is_not_symmetric_is_refused_with_its_line(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r":2: the matrix is not symmetric; .* triangle"):
        read(tmp_path, [EDGE_2D, "EDGE_SE2 1 2 1 0 0 4 1 0 0 4 0 0 0 9"])


@pytest.mark.parametrize("prefix", ["TUTORIAL_", "ONLINE_"])
def test_tags_of_the_tutorial_and_of_online_examples(tmp_path: Path, prefix: str) -> None:
    lines = ["VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 1 2 0.5", EDGE_2D]
    graph = read(tmp_path, [f"{prefix}{line}" for line in lines])
    assert_same(graph, read(tmp_path, lines))
    np.testing.assert_array_equal(graph.initial.t, [[0, 0], [1, 2]])


def test_landmarks_of_the_tutorial_are_seen_by_its_sensor(tmp_path: Path) -> None:
    lines = [
        "PARAMS_SE2_OFFSET 0 1 0 0",
        "VERTEX_POINT_XY 5 3 2",
        "EDGE_SE2_POINT_XY 0 5 0 2 1 1 0 1",
    ]
    graph = read(tmp_path, [EDGE_2D, *(f"TUTORIAL_{line}" for line in lines[:1] + lines[2:])])
    np.testing.assert_array_equal(graph.t_ij[1], [3, 1])
    assert graph.landmarks.tolist() == [2]


def test_tags_in_space_without_quat(tmp_path: Path) -> None:
    vertices = [f"VERTEX_SE3:QUAT {k} 0 0 0 0 0 0 1" for k in (0, 1)]
    lines = [*vertices, EDGE_3D]
    assert_same(
        read(tmp_path, [line.replace(":QUAT", "") for line in lines]), read(tmp_path, lines)
    )


@pytest.mark.parametrize(
    ("edge", "tag"),
    [
        (EDGE_2D, "EDGE_SE2_SWITCHABLE"),
        (EDGE_3D, "EDGE_SE3_SWITCHABLE"),
        (EDGE_3D, "EDGE_SE3:QUAT_SWITCHABLE"),
    ],
)
@pytest.mark.parametrize("switch", ["17 ", ""])
def test_switchable_edges_hold_and_switches_are_counted(
    tmp_path: Path, edge: str, tag: str, switch: str
) -> None:
    _, i, j, numbers = edge.split(" ", 3)
    lines = ["VERTEX_SWITCH 17 1", "EDGE_SWITCH_PRIOR 17 1 1.0", f"{tag} {i} {j} {switch}{numbers}"]
    with pytest.warns(GraphWarning) as caught:
        graph = read(tmp_path, lines)
    (text,) = (str(warning.message) for warning in caught)
    assert "1 VERTEX_SWITCH and 1 EDGE_SWITCH_PRIOR lines are skipped" in text
    assert "1 switchable edges are read as edges that hold always" in text
    assert_same(graph, read(tmp_path, [edge]))


def test_a_prior_of_a_rotation_has_w_first(tmp_path: Path) -> None:
    with pytest.warns(GraphWarning, match="w first"):
        graph = read(tmp_path, [EDGE_3D, "EDGE_SE3_PRIORQUAT 1 0.8 0 0.6 0 5 1 2 6 3 7"])
    angle = 2.0 * np.arctan2(0.6, 0.8)
    np.testing.assert_allclose(log_map(graph.R_ij[1:]), [[0, angle, 0]], rtol=0, atol=1e-12)
    information = graph.information[1]
    np.testing.assert_array_equal(information[3:, 3:], [[5, 1, 2], [1, 6, 3], [2, 3, 7]])
    assert not information[:3].any()
    assert graph.tau[1] == 0 < graph.kappa[1]
    written = tmp_path / "written.g2o"
    write_g2o(graph, written)
    again = read_g2o(written)
    np.testing.assert_allclose(again.R_ij, graph.R_ij, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(again.information, graph.information)


@pytest.mark.parametrize("measured", [[0.1, 0.2, 0.9], [0.0, 0.0, -1.0], [0.0, 0.0, 4.0]])
def test_chi2_of_a_direction_is_that_of_hdl_graph_slam(
    tmp_path: Path, measured: list[float]
) -> None:
    words = " ".join(map(str, measured))
    prior = f"EDGE_SE3_PRIORVEC 1 0 0 2 {words} 5 0 0 5 0 5"
    fixes = [f"EDGE_SE3_PRIORXYZ {k} {k} 2 3 1 0 0 1 0 1" for k in range(2)]
    graph = read(tmp_path, [EDGE_3D, prior, *fixes])
    rng = np.random.default_rng(0)
    poses = Poses(exp_map(rng.normal(size=(3, 3))), rng.normal(size=(3, 3)))
    world, pose = poses.R[graph.i[1]], poses.R[graph.j[1]]
    seen = pose.T @ world @ np.array([0.0, 0.0, 1.0])
    difference = seen - np.array(measured) / np.linalg.norm(measured)
    costs = PGOProblem(graph, weighting=Weighting.INFORMATION).edge_costs(poses)
    assert costs[1] == pytest.approx(5.0 * difference @ difference, rel=1e-12)


def test_a_direction_of_length_zero_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=":2: a direction of length zero"):
        read(tmp_path, [EDGE_3D, "EDGE_SE3_PRIORVEC 1 0 0 0 0 0 1 5 0 0 5 0 5"])


CAMERAS = "matrices have the rotation first"
UPPER = np.triu_indices(6)


def rotation_first(triangle: np.ndarray) -> np.ndarray:
    matrix = np.zeros((6, 6))
    matrix[UPPER] = triangle
    matrix = matrix + np.triu(matrix, 1).T
    order = [3, 4, 5, 0, 1, 2]
    return matrix[np.ix_(order, order)]


def test_poses_of_cameras_are_those_of_g2o_with_the_rotation_first(tmp_path: Path) -> None:
    triangle = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])[UPPER] + 0.1
    turned = rotation_first(triangle)[UPPER]
    pose = "1 2 3 0 0 0.6 0.8"
    vertices = ["VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1", f"VERTEX_SE3:QUAT 1 {pose}"]
    plain = read(tmp_path, [*vertices, f"EDGE_SE3:QUAT 0 1 {pose} {' '.join(map(str, triangle))}"])
    vertices = [line.replace("QUAT", "EXPMAP") for line in vertices]
    with pytest.warns(GraphWarning, match=CAMERAS):
        graph = read(
            tmp_path, [*vertices, f"EDGE_SE3:EXPMAP 0 1 {pose} {' '.join(map(str, turned))}"]
        )
    assert_same(graph, plain)
    np.testing.assert_array_equal(graph.initial.t, plain.initial.t)


def test_similarities_are_read_where_their_scale_is_one(tmp_path: Path) -> None:
    gtsam = pytest.importorskip("gtsam")
    logarithm = np.array([0.3, -0.5, 0.7, 1.0, 2.0, 3.0])
    pose = gtsam.Pose3.Expmap(logarithm)
    words = " ".join(map(repr, logarithm.tolist()))
    matrix = np.diag([4.0, 5.0, 6.0, 1.0, 2.0, 3.0, 9.0])[np.triu_indices(7)]
    camera = "500 500 320 240"
    lines = [
        f"VERTEX_SIM3:EXPMAP 0 0 0 0 0 0 0 0 {camera}",
        f"VERTEX_SIM3:EXPMAP 1 {words} 0 {camera}",
        f"EDGE_SIM3:EXPMAP 0 1 {words} 0 {' '.join(map(str, matrix))}",
    ]
    with pytest.warns(GraphWarning, match=CAMERAS):
        graph = read(tmp_path, lines)
    np.testing.assert_allclose(graph.R_ij[0], pose.rotation().matrix(), atol=1e-15, rtol=0)
    np.testing.assert_allclose(graph.t_ij[0], pose.translation(), atol=1e-14, rtol=0)
    np.testing.assert_allclose(graph.initial.t[1], pose.translation(), atol=1e-14, rtol=0)
    np.testing.assert_array_equal(graph.information[0], np.diag([1, 2, 3, 4, 5, 6]))
    rounded = [lines[0], lines[1], lines[2].replace(f"{words} 0", f"{words} 2.2e-16")]
    with pytest.warns(GraphWarning, match=CAMERAS):
        assert_same(read(tmp_path, rounded), graph)
    lines[2] = lines[2].replace(f"{words} 0", f"{words} 0.1")
    with pytest.raises(FileFormatError, match=":3: a similarity with a scale other than 1"):
        read(tmp_path, lines)


def test_positions_of_hdl_graph_slam_are_priors(tmp_path: Path) -> None:
    graph = read(tmp_path, [EDGE_3D, "EDGE_SE3_PRIORXYZ 1 3 4 5  2 0 0 2 0 2"])
    assert_same(graph, read(tmp_path, [EDGE_3D, "EDGE_SE3_XYZ_PRIOR 1 3 4 5 2 0 0 2 0 2"]))


def test_positions_without_height_are_those_of_which_nothing_measures_the_height(
    tmp_path: Path,
) -> None:
    graph = read(tmp_path, [EDGE_3D, "EDGE_SE3_PRIORXY 1 3.1 4.1  2.3 0.5 7"])
    whole = "EDGE_SE3_XYZ_PRIOR 1 3.1 4.1 0 2.3 0.5 0 7 0 0"
    assert_same(graph, read(tmp_path, [EDGE_3D, whole]))
    covariances = [EDGE_3D, "EDGE_SE3_PRIORXY 1 3.1 4.1  0.25 0 0.5"]
    (tmp_path / "covariances.g2o").write_text("\n".join(covariances))
    graph = read_g2o(tmp_path / "covariances.g2o", reading=Reading.COVARIANCES)
    np.testing.assert_allclose(graph.information[1, :3, :3], np.diag([4.0, 2.0, 0.0]), atol=1e-12)


@pytest.mark.parametrize("tag", ["EDGE_RANGE", "EDGE_SE3_PLANE"])
def test_what_is_no_edge_is_refused_with_the_reason(tmp_path: Path, tag: str) -> None:
    with pytest.raises(FileFormatError, match=f":2: {tag} measures a .*--skip-unknown"):
        read(tmp_path, [EDGE_3D, f"{tag} 1 2 3 4"])


def test_data_of_sensors_and_robust_kernels_are_counted_and_not_used(tmp_path: Path) -> None:
    lines = ["ROBOTLASER1 0 -1.57 3.14 0.01 30 0.1 0 2 1.0 2.0", "VERTEX_TAG 1 2 3 4"]
    kernels = [f"{EDGE_2D} ROBUST_KERNEL Huber 0.1", f"{EDGE_2D} Cauchy 1", EDGE_2D]
    with pytest.warns(GraphWarning) as caught:
        graph = read(tmp_path, [*lines, *kernels])
    (text,) = (str(warning.message) for warning in caught)
    assert "1 ROBOTLASER1 and 1 VERTEX_TAG lines are skipped: the data of sensors" in text
    assert "robust kernels of 2 edges are not used" in text
    assert_same(graph, read(tmp_path, [EDGE_2D] * 3))


def test_comments_and_exponents_of_fortran_are_read(tmp_path: Path) -> None:
    lines = [
        "// written by a program",
        "% of MATLAB",
        "  # indented",
        EDGE_2D.replace(" 1 2 0.5", " 1.0D+00 20d-1 5.D-1"),
        f"{EDGE_2D} # odometry",
        f"{EDGE_2D}// odometry",
        "FIX 0 # the first",
    ]
    graph = read(tmp_path, lines)
    assert_same(graph, read(tmp_path, [EDGE_2D] * 3))
    assert graph.fixed.tolist() == [0]


@pytest.mark.parametrize("word", ["1,5", "1.5,"])
def test_decimal_commas_are_refused_with_the_reason(tmp_path: Path, word: str) -> None:
    with pytest.raises(FileFormatError, match=f":1: '{word}' is no number; .*decimal point"):
        read(tmp_path, [EDGE_2D.replace(" 0.5 ", f" {word} ")])


def test_a_file_that_is_compressed_by_gzip_is_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "packed.g2o.gz"
    path.write_bytes(gzip.compress(f"{EDGE_2D}\n".encode()))
    graph = load(path)
    assert graph.name == "packed"
    assert_same(graph, read(tmp_path, [EDGE_2D]))
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(FileFormatError, match="gzip cannot unpack it"):
        load(path)


def test_vertex_lines_may_be_repeated_but_not_changed(tmp_path: Path) -> None:
    vertices = ["VERTEX_SE2 0 1 2 0.5", "VERTEX_SE2 1 3 4 0"]
    with pytest.warns(GraphWarning, match="2 VERTEX lines repeat others"):
        graph = read(tmp_path, [*vertices, EDGE_2D, vertices[0], vertices[0]])
    np.testing.assert_array_equal(graph.initial.t, [[1, 2], [3, 4]])
    with pytest.raises(FileFormatError, match=r":4: a second VERTEX line of pose 0"):
        read(tmp_path, [*vertices, EDGE_2D, "VERTEX_SE2 0 1 2 0.6"])


def test_missing_poses_are_placed_along_edges_both_ways(tmp_path: Path) -> None:
    known = ["VERTEX_SE2 0 50 60 1", "VERTEX_SE2 1 51 60 1", "VERTEX_SE2 2 52 60 0"]
    edges = ["EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1", "EDGE_SE2 1 2 1 0 0 1 0 0 1 0 1"]
    ahead = "EDGE_SE2 2 3 1 2 0.5 1 0 0 1 0 1"
    behind = "EDGE_SE2 4 3 1 2 0.5 1 0 0 1 0 1"
    sight = "EDGE_SE2_XY 0 9 1 0 1 0 1"
    with pytest.warns(GraphWarning, match="3 of 6 poses have no VERTEX line"):
        graph = read(tmp_path, [*known, *edges, ahead, behind, sight])
    step = graph.edge_subgraph(np.array([2])).t_ij[0]
    poses = graph.initial
    np.testing.assert_allclose(poses.t[3], [53, 62], rtol=0, atol=1e-12)
    back = poses.t[4] + poses.R[4] @ step
    np.testing.assert_allclose(back, poses.t[3], rtol=0, atol=1e-12)
    np.testing.assert_allclose(poses.R[4] @ graph.R_ij[3], poses.R[3], rtol=0, atol=1e-12)
    np.testing.assert_allclose(poses.t[5], [50 + np.cos(1), 60 + np.sin(1)], rtol=0, atol=1e-12)


def test_matrices_of_edge_se2_in_the_order_of_toro_are_found_over_the_whole_file(
    tmp_path: Path,
) -> None:
    matrix = np.array([[10.0, 1.0, 2.0], [1.0, 20.0, 3.0], [2.0, 3.0, 5.0]])
    places = ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))
    correlated = " ".join(str(matrix[place]) for place in places)
    diagonal = "4 0 4 9 0 0"
    edges = [f"EDGE_SE2 0 1 1 0 0 {correlated}", f"EDGE_SE2 1 2 1 0 0 {diagonal}"]
    with pytest.warns(GraphWarning, match="EDGE_SE2 matrices are read in TORO's order"):
        graph = read(tmp_path, edges)
    np.testing.assert_array_equal(graph.information, [matrix, np.diag([4, 4, 9])])
    by_rows = [EDGE_2D, f"EDGE_SE2 1 2 1 0 0 {correlated}"]
    np.testing.assert_array_equal(read(tmp_path, by_rows).information[0], np.diag([4, 4, 9]))


def test_unknown_tags_are_named_first_and_the_supported_ones_last(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError) as caught:
        read(tmp_path, [EDGE_2D, "SIGHT 1 2", "VIEW 1"])
    first, second, last = str(caught.value).split("\n")
    way_out = "remove the line, or have such lines skipped with --skip-unknown"
    assert first == f"{tmp_path / 'graph.g2o'}:2: unknown tag 'SIGHT': {way_out}"
    assert second == f"{tmp_path / 'graph.g2o'}:3: unknown tag 'VIEW': {way_out}"
    assert last.startswith("2 lines are wrong; supported tags are poses: VERTEX_SE2, ")
    assert "edges: EDGE_SE2, EDGE_SE3:QUAT" in last


def test_readings_are_of_files_of_their_dimension(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="2D, and only 3D files can be read with w first"):
        read(tmp_path, [EDGE_2D], reading=Reading.W_FIRST)


CHAIN = ["EDGE_SE2 0 1 1 2 30 4 0 0 4 0 9", "EDGE_SE2 1 2 1 2 30 4 0 0 4 0 9"]
CLOSURE = "EDGE_SE2 0 2 5 6 90 4 0 0 4 0 9"


@pytest.mark.parametrize(
    ("reading", "ends", "lengths"),
    [
        (Reading.CLOSURES_REVERSED, [(0, 1), (1, 2), (2, 0)], [1, 1, 1]),
        (Reading.ODOMETRY_REVERSED, [(1, 0), (2, 1), (0, 2)], [1, 1, 1]),
        (Reading.REVERSED, [(1, 0), (2, 1), (2, 0)], [1, 1, 1]),
        (Reading.CLOSURES_IN_MILLIMETRES, [(0, 1), (1, 2), (0, 2)], [1, 1, 1e-3]),
        (Reading.ODOMETRY_IN_MILLIMETRES, [(0, 1), (1, 2), (0, 2)], [1e-3, 1e-3, 1]),
    ],
)
def test_readings_of_ends_and_lengths(
    tmp_path: Path, reading: Reading, ends: list[tuple[int, int]], lengths: list[float]
) -> None:
    prior = "EDGE_PRIOR_SE2 0 1 2 30 1 0 0 1 0 1"
    written = read(tmp_path, [*CHAIN, CLOSURE, prior])
    graph = read(tmp_path, [*CHAIN, CLOSURE, prior], reading=reading)
    assert list(zip(graph.i.tolist(), graph.j.tolist(), strict=True)) == [*ends, (3, 0)]
    scaled = written.t_ij * np.array([*lengths, 1])[:, None]
    np.testing.assert_allclose(
        (graph.t_ij + np.where(graph.is_prior[:, None], graph.origin, 0.0)),
        scaled,
        rtol=1e-15,
        atol=0,
    )
    np.testing.assert_array_equal(graph.information, written.information)


def test_readings_of_angles_quaternions_and_matrices(tmp_path: Path) -> None:
    lines = ["VERTEX_SE2 0 0 0 90", "VERTEX_SE2 1 0 0 90", CHAIN[0]]
    graph = read(tmp_path, lines, reading=Reading.DEGREES)
    np.testing.assert_allclose(log_map(graph.R_ij), [[np.pi / 6]], rtol=1e-12, atol=0)
    np.testing.assert_allclose(log_map(graph.initial.R), [[np.pi / 2]] * 2, rtol=1e-12, atol=0)
    graph = read(tmp_path, [EDGE_3D.replace("0 0 0.6 0.8", "0.8 0 0 0.6")], reading=Reading.W_FIRST)
    assert_same(graph, read(tmp_path, [EDGE_3D]))
    graph = read(tmp_path, [EDGE_2D], reading=Reading.COVARIANCES)
    inverse = np.diag([0.25, 0.25, 1 / 9])
    np.testing.assert_allclose(graph.information[0], inverse, rtol=1e-15, atol=0)
    assert graph.weights_error > 0
    graph = read(tmp_path, [EDGE_2D], reading=Reading.SQUARE_ROOTS)
    np.testing.assert_allclose(graph.information[0], np.diag([16, 16, 81]), rtol=1e-15, atol=0)
    line = EDGE_2D.replace("4 0 0 4 0 9", "4 0 4 9 0 1")
    graph = read(tmp_path, [line], reading=Reading.TORO_ORDER)
    np.testing.assert_array_equal(graph.information[0], [[4, 0, 0], [0, 4, 1], [0, 1, 9]])


def test_an_infinite_matrix_is_that_of_a_covariance_of_zero(tmp_path: Path) -> None:
    with pytest.raises(
        FileFormatError, match=r":2: inf is not finite, .* covariance of zero; give"
    ):
        read(tmp_path, [EDGE_2D, "EDGE_PRIOR_SE2_XY 0 5 6 inf 0 inf"])


@pytest.mark.parametrize("suffix", ["", ":EULER"])
def test_edges_in_space_with_three_angles_are_those_of_toro(tmp_path: Path, suffix: str) -> None:
    lines = ["VERTEX3 0 0 0 0 0 0 0", "VERTEX3 1 1 2 3 0.1 0.2 0.3"]
    lines.append(f"EDGE3 0 1 1 2 3 0.1 0.2 0.3 {TRIANGLE_3D}")
    euler = [line.replace("3", f"_SE3{suffix}", 1) for line in lines]
    with pytest.warns(
        GraphWarning, match="EDGE_SE3 lines with three angles .* roll, pitch and yaw"
    ):
        graph = read(tmp_path, euler)
    assert_same(graph, read(tmp_path, lines))
    np.testing.assert_array_equal(graph.initial.t, [[0, 0, 0], [1, 2, 3]])


def test_matrices_of_edge_se2_that_fit_both_orders_are_said_to(tmp_path: Path) -> None:
    with pytest.warns(GraphWarning, match="read in g2o's order, .* in TORO's, .*toro-order"):
        graph = read(tmp_path, ["EDGE_SE2 0 1 1 2 0.5 10 1 2 20 3 5"] * 8)
    assert_same(
        read(tmp_path, ["EDGE_SE2 0 1 1 2 0.5 10 1 2 20 3 5"]), graph.edge_subgraph(np.array([0]))
    )
    np.testing.assert_array_equal(graph.information[0], [[10, 1, 2], [1, 20, 3], [2, 3, 5]])


def test_words_that_commas_separate_are_told_so(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="separate words by blanks, not by commas"):
        read(tmp_path, [EDGE_2D.replace(" ", ",")])


@pytest.mark.parametrize("tiny", ["1e-99", "5e-324"])
def test_no_order_overflows_by_tiny_entries(tmp_path: Path, tiny: str) -> None:
    graph = read(tmp_path, [f"EDGE_SE2 0 1 1 2 0.5 4 0 {tiny} 4 1e9 9e99"])
    assert graph.information[0, 2, 2] == 9e99


def test_a_reading_is_given_by_its_word_or_name_too(tmp_path: Path) -> None:
    (tmp_path / "a.g2o").write_text(EDGE_2D.replace("0.5", "90"))
    for given in ("degrees", "DEGREES", Reading.DEGREES):
        angle = log_map(load(tmp_path / "a.g2o", reading=given).R_ij)
        np.testing.assert_allclose(angle, np.pi / 2, rtol=1e-12, atol=0)
    for given in ("upside-down", 3):
        with pytest.raises(SettingError, match=r"reading must be Reading\.AS_WRITTEN or "):
            read_g2o(tmp_path / "a.g2o", reading=given)
