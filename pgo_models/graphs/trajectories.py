"""Trajectories in the TUM and KITTI text formats, as evo reads and writes them; poses in the plane are lifted to z = 0.

Both hold world from body, metres: see `write_tum` and `write_kitti`.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pgo_models.errors import FileFormatError, GraphError
from pgo_models.files import check_metres, check_quaternions, read_table, read_text, replace_when_done
from pgo_models.geometry import rotations
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations

_PLANE_TOLERANCE = 1e-6  # metres, and of the entries of R that vanish when a pose lies in the plane
_MATRIX_TOLERANCE = 1e-3  # KITTI's own files have about seven digits; this tells digits from a wrong matrix


def write_tum(poses: Poses, path: Path | str, timestamps: Array | None = None) -> None:
    """Write one line `timestamp tx ty tz qx qy qz qw` for each pose; the floats come back exactly.

    `timestamps`, (n,), are ascending seconds; 0, 1, .. unless given. A GraphError when there is not one finite one for
    each pose, or they do not ascend; a PGOError when the file cannot be written; what stood there stays.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "poses.tum"
    >>> write_tum(Poses.identity(2, 3), path)
    >>> len(path.read_text().splitlines())
    2
    """
    seconds = np.arange(poses.num_poses, dtype=float) if timestamps is None else np.asarray(timestamps, dtype=float)
    if seconds.shape != (poses.num_poses,) or not np.isfinite(seconds).all() or (np.diff(seconds) <= 0).any():
        raise GraphError(f"timestamps of shape {seconds.shape} for {poses}; give {poses.num_poses} that ascend")
    R, t = _lifted(poses)
    _write_rows(np.column_stack([seconds, t, rotations.quaternions_from_rotations(R)]), path)


def read_tum(path: Path | str, d: int = 3) -> Poses:
    """Poses of a TUM file, in the order of its lines; `read_times` reads the timestamps.

    A FileFormatError with file:line, for a row that is not 8 finite numbers, a zero quaternion, a position beyond
    `FARTHEST`, or, with d = 2, a pose out of the plane.

    Examples
    --------
    >>> from pgo_models.graphs.datasets import locate
    >>> read_tum(locate("grid").with_suffix(".truth.tum"))
    Poses(n=27, d=3)
    """
    rows, lines = read_table(path, 8)
    check_quaternions(path, lines, rows[:, 4:])
    return _in_dimension(rotations.rotations_from_quaternions(rows[:, 4:]), rows[:, 1:4], d, path, lines)


def read_times(path: Path | str) -> Array:
    """Seconds, (n,), of a TUM file or of one with a number a line, ascending.

    A FileFormatError with file:line, for a row that is not 8 finite numbers, or 1, like the first, or does not ascend.
    """
    words = (line.split() for line in read_text(path).split("\n"))
    first = next((row for row in words if row and not row[0].startswith("#")), [])
    rows, lines = read_table(path, 8 if len(first) == 8 else 1)
    late = np.flatnonzero(np.diff(rows[:, 0]) <= 0)
    if len(late):
        before, after = rows[late[0] : late[0] + 2, 0].tolist()
        raise FileFormatError(path, lines[late[0] + 1], f"time {after!r} is not after {before!r}; sort the lines")
    return rows[:, 0]


def write_kitti(poses: Poses, path: Path | str) -> None:
    """Write one line of 12 numbers for each pose: the 3 x 4 matrix (R_i, t_i) row by row; the floats come back exactly.

    A PGOError when the file cannot be written; what stood there stays.
    """
    R, t = _lifted(poses)
    _write_rows(np.concatenate([R, t[:, :, None]], axis=2).reshape(-1, 12), path)


def read_kitti(path: Path | str, d: int = 3) -> Poses:
    """Poses of a KITTI file; the rotations are projected, since its files have few digits.

    A FileFormatError with file:line, for a row that is not 12 finite numbers, a matrix that is no rotation even to
    three digits, a position beyond `FARTHEST`, or, with d = 2, a pose out of the plane.
    """
    rows, lines = read_table(path, 12)
    matrices = rows.reshape(-1, 3, 4)
    error = rotations.orthogonality_error(matrices[:, :, :3])
    worst = int(np.argmax(error))
    if not error[worst] < _MATRIX_TOLERANCE:
        what = f"||R^T R - I|| or 1 - det R is {error[worst]:.3g}"
        raise FileFormatError(path, lines[worst], f"the 3 x 3 part is no rotation: {what}; give (R, t) by rows")
    return _in_dimension(project_to_rotations(matrices[:, :, :3]), matrices[:, :, 3], d, path, lines)


def _lifted(poses: Poses) -> tuple[Array, Array]:
    if poses.d == 3:
        return poses.R, poses.t
    R = np.tile(np.eye(3), (poses.num_poses, 1, 1))
    R[:, :2, :2] = poses.R
    return R, np.column_stack([poses.t, np.zeros(poses.num_poses)])


def _in_dimension(R: Array, t: Array, d: int, path: Path | str, lines: Sequence[int]) -> Poses:
    check_metres(path, lines, t)
    if d == 3:
        return Poses(R, t)
    out = np.maximum(np.abs(t[:, 2]), np.abs(R[:, 2, :] - [0.0, 0.0, 1.0]).max(axis=1))
    worst = int(np.argmax(out))
    if out[worst] > _PLANE_TOLERANCE:
        raise FileFormatError(path, lines[worst], f"pose is out of the x-y plane by {out[worst]:.3g}; read with d = 3")
    return Poses(project_to_rotations(R[:, :2, :2]), t[:, :2])


def _write_rows(rows: Array, path: Path | str) -> None:
    with replace_when_done(path) as temporary, temporary.open("w", encoding="ascii", newline="\n") as file:
        file.writelines(" ".join(map(repr, row)) + "\n" for row in rows.tolist())
