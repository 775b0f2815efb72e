"""The measurements of a robot of a team, as the lines of a g2o file."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pgo_models.errors import FileFormatError, GraphError, SettingError
from pgo_models.files import read_text
from pgo_models.geometry.arrays import real_array
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.g2o_parser import parse_lines
from pgo_models.graphs.g2o_rows import lines_of, numbers_of
from pgo_models.graphs.g2o_tags import G2O_TAGS, SKIPPED_TAGS
from pgo_models.graphs.pose_graph import IntArray, isotropic_information
from solvers.carry.registry import record

_DIGITS_OF_HASH = 16  # of base 16: two different contents agree by chance once in 2^64
_EDGE_TAGS = {2: "EDGE_SE2", 3: "EDGE_SE3:QUAT"}
_VERTEX_TAGS = {2: "VERTEX_SE2", 3: "VERTEX_SE3:QUAT"}
_LANDMARK_TAGS = {2: "VERTEX_XY", 3: "VERTEX_TRACKXYZ"}
_ORIGIN = {2: "0 0 0", 3: "0 0 0 0 0 0 1"}
_TAKEN_BACK = "REMOVE"  # tag of a line that takes all edges i -> j before it back
_IDS_END = 1 << 63
# Tag of a pose without an estimate, whose line becomes a VERTEX line when the dimension is known.
_WITHOUT_ESTIMATE = "POSE"


@record("Revision")
@dataclass(frozen=True)
class Revision:
    """Which measurements a robot has: how many lines, and a hash (SHA-256) of what they say."""

    num_lines: int = 0
    digest: str = ""

    def __str__(self) -> str:
        return f"{self.num_lines} lines, {self.digest}"


@record("Measurements")
@dataclass(eq=False)
class Measurements:
    """Lines of a g2o file, in the order in which they have come, each with its end.

    Lines are only added: one of them may take others back. So a revision is that of all lines, and
    those before it are the first ones. Another robot's are added as they arrive.

    Parameters
    ----------
    lines : list of str
        The lines.
    d : int, optional
        Dimension; None as long as no line has told it.
    """

    lines: list[str] = field(default_factory=list)
    d: int | None = None

    def __post_init__(self) -> None:
        self._digests = [""]  # of the first k lines: each of the one before and a line

    @property
    def revision(self) -> Revision:
        """Which measurements they are."""
        return self.revision_at(len(self.lines))

    def revision_at(self, num_lines: int) -> Revision:
        """The revision of the first lines."""
        for line in self.lines[len(self._digests) - 1 :]:
            content = f"{self._digests[-1]}{line}".encode()
            self._digests.append(hashlib.sha256(content).hexdigest()[:_DIGITS_OF_HASH])
        return Revision(num_lines, self._digests[num_lines])

    def restore(self, saved: Measurements) -> None:
        """Take lines that were saved."""
        self.end_at(0, list(saved.lines))
        self.d = saved.d

    @property
    def told_dimension(self) -> int | None:
        """The dimension that the first line with a tag of one tells; None where none does."""
        if self.d is None:
            for line in self.lines:
                tag = line.split(maxsplit=1)[0] if line.strip() else ""
                if tag != _WITHOUT_ESTIMATE and tag in G2O_TAGS:
                    return G2O_TAGS[tag].d
        return self.d

    def begins_with(self, revision: Revision) -> bool:
        """Whether the first lines are those of a revision."""
        num_lines = revision.num_lines
        return 0 <= num_lines <= len(self.lines) and self.revision_at(num_lines) == revision

    def end_at(self, num_lines: int, more: list[str]) -> None:
        """Replace all lines but the first ones by others."""
        if num_lines < len(self.lines):
            del self.lines[num_lines:]
            del self._digests[num_lines + 1 :]
        self._add(more)

    def _add(self, lines: list[str]) -> None:
        """Add lines, and their digests here: calls of `tick` and `receive` are to be short."""
        self.lines += lines
        self.revision_at(len(self.lines))

    def add_pose(self, pose_id: int, R: Array | None, t: Array | None, fixed: bool) -> None:
        """Add a pose, as `Robot.add_pose` has it."""
        _check_ids(pose_id)
        if R is None or t is None:
            lines = [f"{_WITHOUT_ESTIMATE} {pose_id}\n"]
        else:
            tag = _VERTEX_TAGS[self._dimension_of(t)]
            lines = list(lines_of(tag, np.array([[pose_id]]), _numbers(R, t)))
        self._add([*lines, f"FIX {pose_id}\n"] if fixed else lines)

    def add_edge(
        self,
        i: int,
        j: int,
        R: Array,
        t: Array,
        information: Array | None,
        kappa: float | None,
        tau: float | None,
    ) -> None:
        """Add a measurement, as `Robot.add_edge` has it."""
        _check_ids(i, j)
        before = self.d
        d = self._dimension_of(t)
        matrix = _information(information, kappa, tau, d)
        upper = matrix[np.triu_indices(len(matrix))]
        numbers = np.concatenate([_numbers(R, t), upper[None]], axis=1)
        lines = list(lines_of(_EDGE_TAGS[d], np.array([[i, j]]), numbers))
        try:
            parse_lines(Path(f"edge {i} -> {j}"), lines)
        except FileFormatError as error:
            self.d = before
            raise GraphError(f"{error}; it is not added") from error
        self._add(lines)

    def remove_edge(self, i: int, j: int) -> None:
        """Take measurements back, as `Robot.remove_edge` has it."""
        if not any(_is_edge(line, i, j) for line in _standing(self.lines)):
            raise GraphError(f"there is no edge {i} -> {j} to remove; add_edge adds one")
        self._add([f"{_TAKEN_BACK} {i} {j}\n"])

    def read(self, path: Path) -> None:
        """Add the lines of a file, which `read_g2o` could read."""
        text = read_text(path)
        if not text.endswith("\n"):
            text += "\n"
        self.d = parse_lines(path, [text]).d
        self._add(text.splitlines(keepends=True))

    def text(self, d: int | None = None) -> str:
        """All lines that stand, in which a pose without an estimate is at the origin."""
        d = self.d if d is None else d
        assert d is not None
        lines = []
        for line in _standing(self.lines):
            if line.startswith(_WITHOUT_ESTIMATE):
                pose_id = line.removeprefix(_WITHOUT_ESTIMATE).strip()
                line = f"{_VERTEX_TAGS[d]} {pose_id} {_ORIGIN[d]}\n"
            lines.append(line)
        return "".join(lines)

    def text_at(self, ids: IntArray, poses: Poses) -> str:
        """VERTEX lines of poses and landmarks, and all lines but those of VERTEX as they are."""
        d = poses.d
        is_landmark = np.isin(ids, parse_lines(Path("measurements"), [self.text()]).landmarks)
        robot_poses = poses[~is_landmark]
        numbers = numbers_of(robot_poses.R, robot_poses.t)
        vertices = [
            *lines_of(_VERTEX_TAGS[d], ids[~is_landmark, None], numbers),
            *lines_of(_LANDMARK_TAGS[d], ids[is_landmark, None], poses.t[is_landmark]),
        ]
        others = [line for line in _standing(self.lines) if not _is_of_vertex(line)]
        return "".join([*vertices, *others])

    def _dimension_of(self, t: Array) -> int:
        """The dimension of a position, which is that of all others."""
        d = len(np.atleast_1d(t))
        if d not in (2, 3) or self.d not in (None, d):
            raise GraphError(f"t has {d} numbers; give 2 in the plane or 3 in space, always alike")
        self.d = d
        return d


def _check_ids(*ids: int) -> None:
    """Raise a GraphError for ids that are no integers of 64 bits."""
    for pose_id in ids:
        is_integer = isinstance(pose_id, int | np.integer) and not isinstance(pose_id, bool)
        if not is_integer or not 0 <= pose_id < _IDS_END:
            raise GraphError(f"the id of a pose is {pose_id!r}; give an integer from 0 to 2^63 - 1")


def _standing(lines: Iterable[str]) -> Iterable[str]:
    """The lines that were not taken back."""
    standing: dict[int, str] = {}
    edges: dict[tuple[str, str], list[int]] = {}
    for number, line in enumerate(lines):
        words = line.split(maxsplit=3)
        if len(words) > 2 and words[0] == _TAKEN_BACK:
            for edge in edges.pop((words[1], words[2]), []):
                del standing[edge]
            continue
        standing[number] = line
        if len(words) > 2 and words[0] in _EDGE_TAGS.values():
            edges.setdefault((words[1], words[2]), []).append(number)
    return standing.values()


def _is_edge(line: str, i: int, j: int) -> bool:
    """Whether a line is an edge between two poses."""
    words = line.split(maxsplit=3)
    return len(words) > 2 and words[0] in _EDGE_TAGS.values() and words[1:3] == [str(i), str(j)]


def _is_of_vertex(line: str) -> bool:
    """Whether a line is that of a pose or landmark, under any of the tags for it."""
    tag = line.split()[0] if line.strip() else ""
    return tag == _WITHOUT_ESTIMATE or ("VERTEX" in tag and tag not in SKIPPED_TAGS)


def _numbers(R: Array, t: Array) -> Array:
    """The row of numbers of a pose, (1, k)."""
    pose = Poses(real_array(R, "R")[None], real_array(t, "t")[None])
    return numbers_of(pose.R, pose.t)


def _information(
    information: Array | None, kappa: float | None, tau: float | None, d: int
) -> Array:
    """Matrix of an edge, or that of its precisions, as `write_g2o` writes it."""
    if information is not None:
        size = 3 if d == 2 else 6
        matrix = real_array(information, "information")
        if matrix.shape != (size, size):
            raise GraphError(f"information has shape {matrix.shape}; give {(size, size)}")
        return matrix
    if kappa is None or tau is None:
        raise SettingError("an edge needs information, or kappa and tau")
    kappas, taus = real_array([kappa], "kappa"), real_array([tau], "tau")
    return np.asarray(isotropic_information(kappas, taus, d)[0])
