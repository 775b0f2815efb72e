"""Priors, landmarks and TORO's lines: what every tag means at its source, worked out by hand."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from graphs import assert_says

from pgo_models import (
    Chi2Convention,
    PoseGraph,
    Poses,
    chi2,
    grid,
    load,
    read_g2o,
    victoria_park,
    write_g2o,
)
from pgo_models.errors import FileFormatError, GraphWarning
from pgo_models.graphs.g2o import pose_names, read_g2o_poses, write_g2o_folder
from pgo_models.graphs.g2o_tags import TAGS

ODOMETRY_2D = "EDGE_SE2 0 1 1 0 0 4 0 0 4 0 9"
ODOMETRY_3D = "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
TRIANGLE_3D = "1 2 3 4 5 6  70 8 9 10 11  120 13 14 15  160 17 18  190 20  210"


def read(folder: Path, *lines: str, **options: bool) -> PoseGraph:
    path = folder / "graph.g2o"
    path.write_text("\n".join(lines) + "\n")
    return read_g2o(path, **options)


def at(x: float, y: float, theta: float) -> tuple[np.ndarray, np.ndarray]:
    c = np.cos(theta)
    s = np.sin(theta)
    return np.array([[c, -s], [s, c]]), np.array([x, y])


@pytest.mark.parametrize("tag", ["EDGE_PRIOR_SE2", "EDGE_SE2_PRIOR"])
def test_a_prior_of_a_pose_in_the_plane(tmp_path: Path, tag: str) -> None:
    # g2o: e = (Z^-1 x) as x, y, theta; then the triangle of its information, row by row.
    graph = read(tmp_path, ODOMETRY_2D, f"{tag} 1 3 4 0.5 10 1 2 20 3 30")
    assert graph.world == 2
    assert (graph.i[1], graph.j[1]) == (2, 1)
    np.testing.assert_allclose(graph.R_ij[1], at(0, 0, 0.5)[0], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(graph.t_ij[1], [3, 4])
    np.testing.assert_array_equal(graph.information[1], [[10, 1, 2], [1, 20, 3], [2, 3, 30]])
    R, t = at(3.7, 3.9, 0.8)
    Z = at(0, 0, 0.5)[0]
    e = np.append(Z.T @ (t - [3, 4]), 0.3)
    poses = graph.completed(Poses(np.stack([R, R]), np.stack([t - R @ [1, 0], t])))
    cost = e @ graph.information[1] @ e
    np.testing.assert_allclose(
        chi2(graph, poses, Chi2Convention.GEODESIC), cost, rtol=1e-12, atol=0
    )


@pytest.mark.parametrize("offset", ["", "0 "])
@pytest.mark.parametrize("tag", ["EDGE_SE3_PRIOR", "EDGE_PRIOR_SE3"])
def test_a_prior_of_a_pose_in_space_with_or_without_an_offset_id(
    tmp_path: Path, tag: str, offset: str
) -> None:
    q = "0 0 0.6 0.8"
    offsets = ["PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1"] if offset else []
    graph = read(tmp_path, *offsets, ODOMETRY_3D, f"{tag} 1 {offset}3 4 5 {q} {TRIANGLE_3D}")
    c = 0.8**2 - 0.6**2
    s = 2 * 0.6 * 0.8
    np.testing.assert_allclose(
        graph.R_ij[1], [[c, -s, 0], [s, c, 0], [0, 0, 1]], rtol=0, atol=1e-15
    )
    np.testing.assert_array_equal(graph.t_ij[1], [3, 4, 5])
    np.testing.assert_array_equal(graph.information[1][0], [1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(graph.information[1].diagonal(), [1, 70, 120, 160, 190, 210])
    np.testing.assert_array_equal(graph.information[1][:, 5], [6, 11, 15, 18, 20, 210])


def test_positions_in_the_plane_are_in_the_axes_of_the_world(tmp_path: Path) -> None:
    # g2o's EDGE_PRIOR_SE2_XY: e = t_i - z, information 2 x 2.
    graph = read(
        tmp_path, ODOMETRY_2D, "EDGE_PRIOR_SE2_XY 0 3 4 10 1 20", "EDGE_PRIOR_SE2_XY 1 5 6 1 0 1"
    )
    np.testing.assert_array_equal(graph.kappa[1:], [0, 0])
    # the inverse has trace 30 / 199
    np.testing.assert_allclose(graph.tau[1], 2 * 199 / 30, rtol=1e-12, atol=0)
    np.testing.assert_array_equal(graph.R_ij[1], np.eye(2))
    np.testing.assert_array_equal(graph.information[1], [[10, 1, 0], [1, 20, 0], [0, 0, 0]])
    R, t = at(3.5, 4.2, 1.1)
    poses = graph.completed(Poses(np.stack([R, R]), np.stack([t, t + R @ [1, 0]])))
    e = np.array([0.5, 0.2])
    f = poses.t[1] - [5, 6]
    expected = e @ [[10, 1], [1, 20]] @ e + f @ f
    np.testing.assert_allclose(chi2(graph, poses), expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("offset", ["", "7 "])
def test_positions_in_space(tmp_path: Path, offset: str) -> None:
    graph = read(
        tmp_path,
        ODOMETRY_3D,
        *(f"EDGE_SE3_XYZ_PRIOR {k} {offset}3 4 {k} 2 0 0 2 0 2" for k in (0, 1)),
    )
    np.testing.assert_array_equal(graph.t_ij[1:], [[3, 4, 0], [3, 4, 1]])
    np.testing.assert_allclose(graph.tau[1:], 2.0, rtol=1e-15, atol=0)
    np.testing.assert_array_equal(graph.information[1].diagonal(), [2, 2, 2, 0, 0, 0])


def test_landmarks_in_the_plane_are_seen_in_the_frame_of_the_pose(tmp_path: Path) -> None:
    # g2o's EDGE_SE2_XY: e = x_i^-1 l - z, information 2 x 2.
    lines = ["VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 1 0 0", "VERTEX_XY 7 3 4", ODOMETRY_2D]
    graph = read(tmp_path, *lines, "EDGE_SE2_XY 0 7 1 2 10 1 20", "EDGE_SE2_XY 1 7 0 2 5 0 5")
    np.testing.assert_array_equal(graph.landmarks, [2])
    np.testing.assert_array_equal(graph.pose_ids, [0, 1, 7])
    np.testing.assert_array_equal(graph.initial.t, [[0, 0], [1, 0], [3, 4]])
    np.testing.assert_array_equal(graph.t_ij[1:], [[1, 2], [0, 2]])
    assert graph.kappa[1] > 0 == graph.kappa[2]
    R, t = at(0.5, 0.1, 0.7)
    poses = Poses(np.stack([R, R, R]), np.stack([t, t + R @ [1, 0], [2.0, 3.0]]))
    e = R.T @ ([2, 3] - t) - [1, 2]
    f = R.T @ ([2, 3] - t - R @ [1, 0]) - [0, 2]
    expected = e @ [[10, 1], [1, 20]] @ e + 5 * f @ f
    for convention in (
        Chi2Convention.CHORDAL,
        Chi2Convention.GEODESIC,
        Chi2Convention.G2O,
        Chi2Convention.GTSAM,
    ):
        np.testing.assert_allclose(chi2(graph, poses, convention), expected, rtol=1e-12, atol=0)


@pytest.mark.filterwarnings("ignore:.*lines name sensor 0")
@pytest.mark.parametrize("offset", ["", "0 "])
def test_landmarks_in_space(tmp_path: Path, offset: str) -> None:
    lines = (f"EDGE_SE3_TRACKXYZ {k} 9 {offset}1 2 3 10 1 2 20 3 30" for k in (0, 1))
    graph = read(tmp_path, ODOMETRY_3D, *lines)
    assert graph.landmarks.tolist() == [2]
    np.testing.assert_array_equal(
        graph.information[2][:3, :3], [[10, 1, 2], [1, 20, 3], [2, 3, 30]]
    )
    assert not graph.information[2][3:].any()
    np.testing.assert_array_equal(graph.R_ij[1:], np.tile(np.eye(3), (2, 1, 1)))


@pytest.mark.filterwarnings("ignore:.*lines name sensor 0")
def test_priors_of_landmarks(tmp_path: Path) -> None:
    sights = ["EDGE_SE2_XY 0 7 1 2 1 0 1", "EDGE_SE2_XY 1 7 1 2 1 0 1"]
    graph = read(
        tmp_path, ODOMETRY_2D, *sights, "EDGE_PRIOR_XY 7 8 9 2 0 2", "EDGE_PRIOR_SE2_XY 0 0 0 1 0 1"
    )
    assert (graph.i[3], graph.j[3], graph.tau[3]) == (graph.world, 2, 2)
    in_space = (f"EDGE_SE3_TRACKXYZ {k} 9 0 1 2 3 1 0 0 1 0 1" for k in (0, 1))
    graph = read(tmp_path, ODOMETRY_3D, *in_space, "EDGE_POINTXYZ_PRIOR 9 8 9 10 2 0 0 2 0 2")
    np.testing.assert_array_equal(graph.t_ij[3], [8, 9, 10])


def test_toro_in_the_plane_has_its_own_order_of_the_information(tmp_path: Path) -> None:
    # EDGE2 i j forward sideward rotate inf_ff inf_fs inf_ss inf_rr inf_fr inf_sr
    graph = read(
        tmp_path, "VERTEX2 0 0 0 0", "VERTEX2 1 1 2 0.5", "EDGE2 0 1 1 2 0.5 10 1 20 30 2 3"
    )
    np.testing.assert_array_equal(graph.information[0], [[10, 1, 2], [1, 20, 3], [2, 3, 30]])
    np.testing.assert_array_equal(graph.t_ij[0], [1, 2])
    np.testing.assert_allclose(graph.initial.R[1], at(0, 0, 0.5)[0], rtol=0, atol=1e-15)


def test_toro_in_space_has_roll_pitch_yaw(tmp_path: Path) -> None:
    roll = 0.3
    pitch = -0.4
    yaw = 1.2
    numbers = f"1 2 3 {roll} {pitch} {yaw}"
    graph = read(
        tmp_path,
        f"VERTEX3 1 {numbers}",
        "VERTEX3 0 0 0 0 0 0 0",
        f"EDGE3 0 1 {numbers} {TRIANGLE_3D}",
    )
    Rx = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
    Ry = np.array(
        [[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]
    )
    Rz = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    np.testing.assert_allclose(graph.R_ij[0], Rz @ Ry @ Rx, rtol=0, atol=1e-14)
    np.testing.assert_allclose(graph.initial.R[1], Rz @ Ry @ Rx, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(graph.information[0].diagonal(), [1, 70, 120, 160, 190, 210])


def test_tags_of_two_kinds_keep_the_order_of_the_lines(tmp_path: Path) -> None:
    graph = read(
        tmp_path, "EDGE_PRIOR_SE2 1 3 4 0 1 0 0 1 0 1", ODOMETRY_2D, "EDGE2 1 2 1 0 0 1 0 1 1 0 0"
    )
    np.testing.assert_array_equal(graph.i, [3, 0, 1])
    np.testing.assert_array_equal(graph.j, [1, 1, 2])
    assert pose_names(graph) == ["0", "1", "2", "the world"]


SEEN = "EDGE_SE2_XY 0 7 1 2 1 0 1"


@pytest.mark.parametrize(
    ("lines", "where", "words"),
    [
        (
            [ODOMETRY_2D, "EDGE_PRIOR_SE2_XY 0 1 2 1 0"],
            ":2",
            ["EDGE_PRIOR_SE2_XY needs 1 id and 5 numbers", "found 5"],
        ),
        (
            [ODOMETRY_2D, "EDGE_PRIOR_SE2_XY 0 1 2 1 0 -1"],
            ":2",
            ["translation block", "indefinite"],
        ),
        ([ODOMETRY_2D, "EDGE_PRIOR_SE2 0 1 2 0 0 0 0 0 0 0"], ":2", ["zero", "remove it"]),
        ([ODOMETRY_2D, "EDGE_SE2_XY 0 x 1 2 1 0 1"], ":2", ["id 'x'"]),
        ([ODOMETRY_3D, "EDGE_SE3_PRIOR 0 0 1 2 3"], ":2", ["1 id and 28 numbers", "cut off"]),
        ([ODOMETRY_3D, f"EDGE_SE3_PRIOR 0 1 2 3 0 0 0 0 {TRIANGLE_3D}"], ":2", ["zero quaternion"]),
        ([ODOMETRY_3D, SEEN], ":2", ["2D and 3D"]),
        ([ODOMETRY_2D, f"EDGE_PRIOR_SE2_XY {2**63 - 1} 1 2 1 0 1"], ":2", ["does not fit 64 bits"]),
        (
            [
                "PARAMS_SE3OFFSET 3 0 0 0.5 0 0 0 1",
                ODOMETRY_3D,
                "EDGE_SE3_XYZ_PRIOR 0 3 1 2 3 1 0 0 1 0 1",
            ],
            ":3",
            ["sensor", "give the position of the pose"],
        ),
        (
            [ODOMETRY_3D, "EDGE_SE3_TRACKXYZ 0 9 3 1 2 3 1 0 0 1 0 1"],
            ":2",
            ["no PARAMS_SE3OFFSET line has the id 3", "add it"],
        ),
        (
            ["PARAMS_SE3OFFSET 3 0 0 0.5 0 0 0", "EDGE_SE3_TRACKXYZ 0 9 3 1 2 3 1 0 0 1 0 1"],
            ":1",
            ["PARAMS_SE3OFFSET needs 1 id and 7 numbers, found 6"],
        ),
        (
            ["PARAMS_SE3OFFSET 3 0 0 x 0 0 0 1", "EDGE_SE3_TRACKXYZ 0 9 3 1 2 3 1 0 0 1 0 1"],
            ":1",
            ["'x' is no number"],
        ),
        (
            [
                "PARAMS_SE3OFFSET 3 0 0 1 0 0 0 1",
                "PARAMS_SE3OFFSET 3 0 0 2 0 0 0 1",
                "EDGE_SE3_TRACKXYZ 0 9 3 1 2 3 1 0 0 1 0 1",
            ],
            ":2",
            ["a second PARAMS_SE3OFFSET line", "line 1", "remove one"],
        ),
        (
            ["EDGE_BEARING_SE2_XY 1 2", ODOMETRY_2D],
            ":1",
            ["unknown tag 'EDGE_BEARING_SE2_XY'", "EDGE_SE3_TRACKXYZ", "--skip-unknown"],
        ),
        ([ODOMETRY_2D, "BR 0 7 0.5 0 0.1 0.1"], ":2", ["not all positive", "correct or remove"]),
        ([ODOMETRY_2D, "BR 0 7 0.5 2 0.1 -0.1"], ":2", ["not all positive"]),
        (
            [ODOMETRY_2D, "ODOMETRY 1 2 1 0 0 1 2 0 1 0 1"],
            ":2",
            ["covariance matrix is not positive definite"],
        ),
        (
            [ODOMETRY_2D, "ODOMETRY 1 2 1 0 0 1e-200 0 0 1 0 1"],
            ":2",
            ["information beyond 1e+100"],
        ),
        ([ODOMETRY_2D, "BR 0 7 0.5 2 1e-99 1e-99"], ":2", ["information beyond 1e+100"]),
        (
            [ODOMETRY_2D, "EDGE_RANGE 0 7 3.5 0.1"],
            ":2",
            ["EDGE_RANGE measures a range without a bearing", "--skip-unknown"],
        ),
    ],
)
def test_every_fault_has_its_line_and_a_way_out(
    tmp_path: Path, lines: list[str], where: str, words: list[str]
) -> None:
    with pytest.raises(FileFormatError) as caught:
        read(tmp_path, *lines)
    assert_says(caught.value, f"{tmp_path / 'graph.g2o'}{where}: ", words)


def test_an_offset_that_nobody_uses_is_skipped(tmp_path: Path) -> None:
    assert read(tmp_path, "PARAMS_SE3OFFSET 3 0 0 0.5 0 0 0 1", ODOMETRY_3D).num_poses == 2


def test_unknown_tags_are_skipped_when_asked_for_and_named_once(tmp_path: Path) -> None:
    lines = [ODOMETRY_2D, "SIGHT 1 2 3", "EDGE_RANGE 0 1", "SIGHT 4 5 6"]
    for reading in (read, lambda folder, *_, **options: load(folder / "graph.g2o", **options)):
        with pytest.warns(GraphWarning) as said:
            assert reading(tmp_path, *lines, skip_unknown=True).num_edges == 1
        (message,) = (str(one.message) for one in said)
        assert message.endswith(
            "skipped: 2 of SIGHT (first: line 2), 1 of EDGE_RANGE (first: line 3)"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read(tmp_path, ODOMETRY_2D, skip_unknown=True)


def with_everything(d: int, information: bool, tmp_path: Path) -> PoseGraph:
    """Poses, landmarks, a prior of a pose, of positions, of a landmark."""
    rng = np.random.default_rng(d)
    graph = victoria_park(rng, num_poses=20) if d == 2 else grid(rng)
    if information:
        write_g2o(graph, tmp_path / "plain.g2o")
        graph = read_g2o(tmp_path / "plain.g2o")
    graph = graph.with_landmark(np.array([0, 1, 2]), rng.standard_normal((3, d)), 3.0)
    graph = graph.with_position_prior(
        np.arange(5), rng.standard_normal((5, d)), rng.uniform(1, 2, 5)
    )
    graph = graph.with_prior(
        np.array([6]), Poses(graph.initial.R[6:7], graph.initial.t[6:7]), 2.0, 3.0
    )
    return graph.with_position_prior(graph.landmarks[-1:], rng.standard_normal((1, d)), 5.0)


@pytest.mark.parametrize("information", [False, True])
@pytest.mark.parametrize("d", [2, 3])
def test_what_is_written_reads_back(tmp_path: Path, d: int, information: bool) -> None:
    graph = with_everything(d, information, tmp_path)
    write_g2o(graph, tmp_path / "out.g2o")
    again = read_g2o(tmp_path / "out.g2o")
    assert repr(again).replace("'out'", repr(graph.name)) == repr(graph)
    # Lines go kind by kind, and the world pose last.
    number = np.searchsorted(again.pose_ids, graph.pose_ids)
    of_file = np.lexsort((again.t_ij[:, 0], again.j, again.i))
    own = np.lexsort((graph.t_ij[:, 0], number[graph.j], number[graph.i]))
    for name in ("t_ij", "R_ij", "kappa", "tau"):
        ours = getattr(graph, name)[own]
        theirs = getattr(again, name)[of_file]
        np.testing.assert_allclose(theirs, ours, rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(number[graph.i[own]], again.i[of_file])
    np.testing.assert_array_equal(number[graph.landmarks], again.landmarks)
    read = again.initial[number[graph.in_files]]
    np.testing.assert_allclose(read.t, graph.initial.t, rtol=0, atol=1e-14)
    np.testing.assert_allclose(read.R, graph.initial.R, rtol=0, atol=1e-14)
    poses = read_g2o_poses(tmp_path / "out.g2o", graph)
    np.testing.assert_allclose(poses.stacked(), graph.initial.stacked(), rtol=0, atol=1e-14)
    tags = {line.split()[0] for line in (tmp_path / "out.g2o").read_text().splitlines()}
    assert len(tags & set(TAGS)) == 7


def test_a_folder_of_robots_keeps_priors_and_landmarks(tmp_path: Path) -> None:
    graph = with_everything(2, False, tmp_path)
    graph = graph.with_robots((np.arange(graph.num_poses) % 3).astype(np.int64))
    write_g2o_folder(graph, tmp_path / "robots")
    again = read_g2o(tmp_path / "robots")
    assert (again.num_robots, again.num_edges, again.extras) == (3, graph.num_edges, graph.extras)
    np.testing.assert_array_equal(again.robots[:20], graph.robots[:20])
