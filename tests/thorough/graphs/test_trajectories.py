from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

import pgo_models
from pgo_models import Poses, exp_map, random_rotations, read_kitti, read_tum, write_tum
from pgo_models.errors import FileFormatError, GraphError
from pgo_models.graphs.trajectories import read_times, write_kitti

EPS = np.finfo(float).eps
SEEDS = st.integers(0, 2**32 - 1)
DIMENSIONS = st.sampled_from([2, 3])
COUNTS = st.integers(1, 10)


def random_poses(seed: int, n: int, d: int) -> Poses:
    rng = np.random.default_rng(seed)
    return Poses(random_rotations(n, d, rng), 10 ** rng.uniform(-8, 8, (n, d)))


@given(seed=SEEDS, n=COUNTS, d=DIMENSIONS)
def test_tum_round_trip(
    tmp_path_factory: pytest.TempPathFactory, seed: int, n: int, d: int
) -> None:
    poses = random_poses(seed, n, d)
    path = tmp_path_factory.mktemp("tum") / "a.tum"
    write_tum(poses, path)
    back = read_tum(path, d=d)
    np.testing.assert_array_equal(back.t, poses.t)
    np.testing.assert_allclose(back.R, poses.R, rtol=0, atol=16 * EPS)


@given(seed=SEEDS, n=COUNTS, d=DIMENSIONS)
def test_kitti_round_trip(
    tmp_path_factory: pytest.TempPathFactory, seed: int, n: int, d: int
) -> None:
    poses = random_poses(seed, n, d)
    path = tmp_path_factory.mktemp("kitti") / "a.txt"
    write_kitti(poses, path)
    back = read_kitti(path, d=d)
    np.testing.assert_array_equal(back.t, poses.t)
    np.testing.assert_allclose(back.R, poses.R, rtol=0, atol=16 * EPS)


def test_tum_is_timestamp_translation_quaternion(tmp_path: Path) -> None:
    poses = Poses(exp_map(np.array([[0.0], [np.pi / 2]])), np.array([[1.0, 2.0], [3.0, 4.0]]))
    write_tum(poses, tmp_path / "a", timestamps=np.array([0.5, 7.25]))
    rows = [
        [float(word) for word in line.split(" ")]
        for line in (tmp_path / "a").read_text().splitlines()
    ]
    half = np.sqrt(0.5)
    np.testing.assert_allclose(
        rows, [[0.5, 1, 2, 0, 0, 0, 0, 1], [7.25, 3, 4, 0, 0, 0, half, half]], rtol=0, atol=4 * EPS
    )


def test_kitti_is_the_matrix_by_rows(tmp_path: Path) -> None:
    poses = Poses(exp_map(np.array([[np.pi / 2]])), np.array([[3.0, 4.0]]))
    write_kitti(poses, tmp_path / "a")
    row = [float(word) for word in (tmp_path / "a").read_text().split(" ")]
    np.testing.assert_allclose(row, [0, -1, 0, 3, 1, 0, 0, 4, 0, 0, 1, 0], rtol=0, atol=EPS)


def test_files_of_others_are_read(tmp_path: Path) -> None:
    (tmp_path / "tum").write_text("# timestamp tx ty tz qx qy qz qw\n1305031102.17 1 2 3 0 0 2 2\n")
    poses = read_tum(tmp_path / "tum")
    np.testing.assert_array_equal(poses.t, [[1, 2, 3]])
    (tmp_path / "kitti").write_text(
        "1.000001e+00 9.0e-05 0.0 1 -9.0e-05 9.99999e-01 0 2 0 0 1.0 3\n"
    )
    poses = read_kitti(tmp_path / "kitti")
    assert np.abs(poses.R[0] @ poses.R[0].T - np.eye(3)).max() < 8 * EPS


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0\n", "a:2: 7 numbers where 8 belong"),
        ("0 1 2 3 0 0 0 one\n", "a:1: 'one' is no number"),
        ("0 1 2 nan 0 0 0 1\n", "a:1: nan is not finite"),
        ("#\n0 1 2 3 0 0 0 0\n", "a:2: zero quaternion"),
        ("0 1 2 3 0 0 0 9e-10\n", "a:1: zero quaternion"),
        ("0 1 2 3 0 0 0 1\n1e18 1 -1e100 3 0 0 0 1\n", r"a:2: 1e\+100 m is beyond 1e\+15 m"),
        ("0 1 2 3 0 0 0 1" + " 0" * 10_000, "a:1: 20015 characters"),
        ("", "a: no rows"),
    ],
)
def test_bad_tum_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a").write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_tum(tmp_path / "a")


def test_a_short_quaternion_has_a_direction(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("0 1 2 3 0 0 1.1e-9 0\n")
    np.testing.assert_allclose(
        read_tum(tmp_path / "a").R[0], np.diag([-1.0, -1.0, 1.0]), rtol=0, atol=8 * EPS
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 -1 0\n",
            "a:2: the 3 x 3 part is no rotation",
        ),
        ("1 0 0 0 0 1 0 0 0 0 1e90 0\n", "a:1: the 3 x 3 part is no rotation"),
        (
            "1 0 0 0 0 1 0 0 0 0 1 0\n\n1 0 0 0 0 1 0 0 0 0 1\n",
            "a:3: 11 numbers where 12 belong; complete or remove it",
        ),
        ("1 0 0 0 0 1 0 0 0 0 1 0 0\n", "a:1: 13 numbers where 12 belong"),
        ("1 0 0 0 0 1 0 0 0 0 1 inf\n", "a:1: inf is not finite"),
        ("1 0 0 0 0 1 0 0 0 0 1 zero\n", "a:1: 'zero' is no number"),
        ("1 0 0 0 0 1 0 0 0 0 1 1e16\n", r"a:1: 1e\+16 m is beyond 1e\+15 m"),
        ("# nothing\n", "a: no rows; give lines of 12 numbers"),
    ],
)
def test_bad_kitti_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a").write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_kitti(tmp_path / "a")


def test_a_missing_kitti_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="missing: no such file; check the path"):
        pgo_models.read_kitti(tmp_path / "missing")


def test_poses_out_of_the_plane_are_refused_there(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("0 1 2 0 0 0 0 1\n1 1 2 0.5 0 0 0 1\n")
    with pytest.raises(FileFormatError, match=r"a:2: pose is out of the x-y plane by 0.5"):
        read_tum(tmp_path / "a", d=2)
    (tmp_path / "a").write_text("0 1 2 0 1 0 0 0\n")
    with pytest.raises(FileFormatError, match="a:1: pose is out of the x-y plane by 2"):
        read_tum(tmp_path / "a", d=2)
    (tmp_path / "a").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 3\n")
    with pytest.raises(FileFormatError, match="a:2: pose is out of the x-y plane by 3"):
        read_kitti(tmp_path / "a", d=2)


@pytest.mark.parametrize("timestamps", [[0.0], [0.0, 0.0], [1.0, 0.0], [0.0, np.nan]])
def test_timestamps_must_ascend(tmp_path: Path, timestamps: list[float]) -> None:
    with pytest.raises(GraphError, match="give 2 that ascend"):
        write_tum(Poses.identity(2, 3), tmp_path / "a", np.array(timestamps))
    assert not list(tmp_path.iterdir())


def test_times_are_read_from_tum_and_from_one_column(tmp_path):
    times = np.array([0.5, 1.25, 1e9])
    write_tum(Poses.identity(3, 3), tmp_path / "poses.tum", times)
    (tmp_path / "times.txt").write_text("# seconds\n0.5\n1.25\n\n1e9\n")
    for name in ("poses.tum", "times.txt"):
        np.testing.assert_array_equal(read_times(tmp_path / name), times)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1\n2\n2\n", r"times\.txt:3: time 2\.0 is not after 2\.0; sort the lines"),
        ("1\nlate\n", r"times\.txt:2: "),
        ("1\n2 3\n", r"times\.txt:2: 2 numbers where 1 belong"),
        ("# nothing\n", r"times\.txt: no rows"),
    ],
)
def test_times_that_are_none_are_named(text, message, tmp_path):
    (tmp_path / "times.txt").write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_times(tmp_path / "times.txt")
