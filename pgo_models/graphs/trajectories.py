"""Trajectories in the text formats of TUM and KITTI, as evo reads and writes them.

Both hold world from body, metres. Poses in the plane are written as poses in space with z = 0.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pgo_models.errors import FileFormatError, GraphError
from pgo_models.files import (
    check_lines,
    far_lines,
    read_table,
    read_text,
    replace_when_done,
    zero_quaternion_lines,
)
from pgo_models.geometry import rotations
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations
from pgo_models.graphs.pose_graph import is_ascending

# Metres; also a bound on those entries of R that vanish when a pose lies in the plane.
_PLANE_TOLERANCE = 1e-6
# KITTI's own files have about seven digits. This bound tells few digits from a wrong matrix.
_MATRIX_TOLERANCE = 1e-3


def write_tum(poses: Poses, path: Path | str, timestamps: Array | None = None) -> None:
    """Write a TUM file: a line `timestamp tx ty tz qx qy qz qw` for each pose.

    The numbers have all digits of the doubles. A file that exists is replaced when the new one is
    complete.

    Parameters
    ----------
    poses : Poses
        World from body, metres.
    path : Path or str
        File to write.
    timestamps : Array, (n,), optional
        Ascending seconds; 0, 1, .. unless given.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "poses.tum"
    >>> write_tum(Poses.identity(2, 3), path)
    >>> read_tum(path)
    Poses(n=2, d=3)
    """
    if timestamps is None:
        seconds = np.arange(poses.num_poses, dtype=float)
    else:
        seconds = np.asarray(timestamps, dtype=float)
    if seconds.shape != (poses.num_poses,) or not is_ascending(seconds):
        raise GraphError(
            f"timestamps of shape {seconds.shape} for {poses}; give {poses.num_poses} that ascend"
        )
    R, t = _lifted(poses)
    quaternions = rotations.quaternions_from_rotations(R)
    rows = np.column_stack([seconds, t, quaternions])
    _write_rows(rows, path)


def read_tum(path: Path | str, d: int = 3) -> Poses:
    """Return the poses, world from body in metres, of a TUM file, in the order of its lines.

    A line is `timestamp tx ty tz qx qy qz qw`; `pgo_models.graphs.trajectories.read_times` reads
    the time stamps. Blank lines and comments (#) are skipped.

    With d = 2 the poses have to lie in the x-y plane. A FileFormatError names the line of a row
    that is not 8 finite numbers, of a zero quaternion, and of a pose out of the plane or beyond
    1e15 m.

    Examples
    --------
    >>> from pgo_models.graphs.datasets import locate
    >>> read_tum(locate("grid").with_suffix(".truth.tum"))
    Poses(n=27, d=3)
    """
    rows, lines = read_table(path, 8)
    t = rows[:, 1:4]
    quaternions = rows[:, 4:]
    check_lines(path, zero_quaternion_lines(lines, quaternions))
    R = rotations.rotations_from_quaternions(quaternions)
    return _in_dimension(R, t, d, path, lines)


def read_times(path: Path | str) -> Array:
    """Seconds, (n,), of a TUM file or of one with a number a line, ascending.

    A FileFormatError with file:line, for a row that is not 8 finite numbers, or 1, like the first,
    or does not ascend.
    """
    text_lines = read_text(path).split("\n")
    all_rows = (line.split() for line in text_lines)
    rows_of_numbers = (words for words in all_rows if words and not words[0].startswith("#"))
    first_row = next(rows_of_numbers, [])
    is_tum = len(first_row) == 8
    rows, lines = read_table(path, 8 if is_tum else 1)
    times = rows[:, 0]
    not_after = np.flatnonzero(np.diff(times) <= 0)
    if len(not_after):
        first = int(not_after[0])
        earlier, later = times[first : first + 2].tolist()
        problem = f"time {later!r} is not after {earlier!r}; sort the lines"
        raise FileFormatError(path, lines[first + 1], problem)
    return times


def write_kitti(poses: Poses, path: Path | str) -> None:
    """Write one line of 12 numbers for each pose: the 3 x 4 matrix (R_i, t_i) row by row.

    The numbers have all digits of the doubles. A file that exists is replaced when the new one is
    complete. A PGOError when the file cannot be written.
    """
    R, t = _lifted(poses)
    columns = t[:, :, None]
    matrices = np.concatenate([R, columns], axis=2)
    rows = matrices.reshape(-1, 12)
    _write_rows(rows, path)


def read_kitti(path: Path | str, d: int = 3) -> Poses:
    r"""Return the poses of a KITTI odometry file, in the order of its lines.

    A line has 12 numbers: the 3 x 4 matrix (R_i, t_i) of a pose, row by row. There are no time
    stamps. The rotations are projected, since files of this format have few digits. Blank lines and
    comments (#) are skipped. Errors are those of `read_tum`, and a matrix that is no rotation even
    to three digits.

    The body of KITTI's own files is the left camera, and their world is its first pose, with z
    ahead of the camera and y down, so that their poses are not in the x-y plane.

    References
    ----------
    Geiger, Lenz & Urtasun, Are we ready for autonomous driving? The KITTI vision benchmark suite,
    CVPR 2012.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "00.txt"
    >>> _ = path.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 2.5\n")
    >>> read_kitti(path).t.tolist()
    [[0.0, 0.0, 0.0], [0.0, 0.0, 2.5]]
    """
    rows, lines = read_table(path, 12)
    matrices = rows.reshape(-1, 3, 4)
    R = matrices[:, :, :3]
    t = matrices[:, :, 3]
    error = rotations.orthogonality_error(R)
    worst = int(np.argmax(error))
    if not error[worst] < _MATRIX_TOLERANCE:
        difference = f"||R^T R - I|| or 1 - det R is {error[worst]:.3g}"
        problem = f"the 3 x 3 part is no rotation: {difference}; give (R, t) by rows"
        raise FileFormatError(path, lines[worst], problem)
    return _in_dimension(project_to_rotations(R), t, d, path, lines)


def _lifted(poses: Poses) -> tuple[Array, Array]:
    """Rotations (n, 3, 3) and positions (n, 3) of poses, those in the plane at z = 0."""
    if poses.d == 3:
        return poses.R, poses.t
    R = np.tile(np.eye(3), (poses.num_poses, 1, 1))
    R[:, :2, :2] = poses.R
    z = np.zeros(poses.num_poses)
    return R, np.column_stack([poses.t, z])


def _in_dimension(R: Array, t: Array, d: int, path: Path | str, lines: Sequence[int]) -> Poses:
    """Poses in d dimensions of those that a file has in space; every pose is one of `lines`."""
    check_lines(path, far_lines(lines, t))
    if d == 3:
        return Poses(R, t)
    height = np.abs(t[:, 2])
    tilt_of_z_axis = R[:, 2, :] - [0.0, 0.0, 1.0]
    tilt = np.abs(tilt_of_z_axis).max(axis=1)
    distance = np.maximum(height, tilt)
    worst = int(np.argmax(distance))
    if distance[worst] > _PLANE_TOLERANCE:
        problem = f"pose is out of the x-y plane by {distance[worst]:.3g}; read with d = 3"
        raise FileFormatError(path, lines[worst], problem)
    R_in_plane = project_to_rotations(R[:, :2, :2])
    return Poses(R_in_plane, t[:, :2])


def _write_rows(rows: Array, path: Path | str) -> None:
    """Write a line for every row; `repr` of a double gives the digits that bring it back."""
    with (
        replace_when_done(path) as temporary,
        temporary.open("w", encoding="ascii", newline="\n") as file,
    ):
        for row in rows.tolist():
            words = " ".join(map(repr, row))
            file.write(words + "\n")
