"""The lines of one g2o file as arrays, every fault named by file:line.

Tags are in `g2o_tags`, the text is parsed in `g2o_source`, and what a line alone does not say is
decided in `g2o_dialects`.
"""

import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pgo_models.errors import FileFormatError, GraphWarning, printable
from pgo_models.files import (
    LARGEST,
    Problem,
    check_lines,
    far_lines,
    finite_number,
    read_blocks,
    zero_quaternion_lines,
)
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.foreign_files import as_g2o
from pgo_models.graphs.g2o_dialects import (
    NEGATIVE,
    NO_OFFSET,
    fitting_orders,
    from_toro_order,
    in_frames_of_poses,
    landmark_shift,
    offsets_named,
)
from pgo_models.graphs.g2o_readings import ROTATION_FIRST, Reading, edges_as, noise_as, numbers_as
from pgo_models.graphs.g2o_rows import information_of
from pgo_models.graphs.g2o_source import ParsedLines, Source
from pgo_models.graphs.g2o_tags import (
    COMPLETE_TAGS,
    OFFSET_TAGS,
    SHORT_TAGS,
    SKIPPED_TAGS,
    TAGS,
    Noise,
    Tag,
    supported_tags,
)
from pgo_models.graphs.pose_graph import WORLD_ID, IntArray
from pgo_models.graphs.precisions import are_definite, is_negative_by_rounding
from pgo_models.graphs.weight_errors import MOST, SINGULAR
from pgo_models.graphs.written_digits import ALL_DIGITS, WrittenDigits, digits_of

_NAMED_TAGS = 10  # unknown tags that a warning names
_NO_CHANCE = 8  # lines in g2o's order that are hardly all definite in TORO's, too
_SQUARE_ROOTS = (
    "iSAM's own files have square roots of information (pgo info --reading square-roots --out)"
)
HIDDEN_INFORMATION = (
    "doubles cannot hold the information matrix, as its condition is too large; give a larger "
    "smallest deviation, or an EDGE line with the information matrix itself"
)
_TAKEN_AS_INFORMATION = f"matrices are taken as information; {_SQUARE_ROOTS}"


@dataclass(frozen=True, eq=False)
class G2OLines:
    """What one g2o file holds, in the order of its lines, which count from 1."""

    path: Path
    d: int  # 2 or 3
    vertex_ids: IntArray  # (v,): of the VERTEX lines
    vertex_lines: IntArray  # (v,): lines that they stand on
    vertices: Array  # (v, 3) or (v, 7): x y theta, or x y z qx qy qz qw
    edge_ids: IntArray  # (m, 2): the two poses; `WORLD_ID` and the pose, of a prior
    # (m, 9) or (m, 28): the measurement like a vertex, then the upper triangle of its information
    # matrix, row by row.
    edges: Array
    edge_lines: IntArray  # (m,)
    fixed: IntArray  # (f,): ids of the FIX lines
    fixed_lines: IntArray  # (f,)
    landmarks: IntArray  # (l,): ids of points
    digits: WrittenDigits  # of the measurements as they are written
    weights_error: float = 0.0  # the largest of the edges, see `weight_errors`
    # (m, d): what the positions of priors have in decimals beyond `edges`; None of none.
    remainders: Array | None = None
    landmark_shift: int = 0  # what was added to the ids of landmarks, which the file has for poses


class _Rows(NamedTuple):
    """All VERTEX or all EDGE lines of a file."""

    ids: IntArray  # (n, 2): the second id alone counts for a vertex
    numbers: Array  # (n, width)
    lines: IntArray  # (n,)
    is_point: BoolArray  # (n,): whether the last id is that of a landmark


def read_lines(
    path: Path | str,
    skip_unknown: bool = False,
    reading: Reading = Reading.AS_WRITTEN,
    needs_matrices: bool = True,
) -> G2OLines:
    """Read and check the lines of one g2o file, which may be compressed by gzip.

    `skip_unknown` and `reading` are as for `read_g2o`, which lists what is assumed with a
    `GraphWarning`. Unless `needs_matrices`, edges may have no matrix: theirs are the identity. A
    FileFormatError names the wrong lines, as `check_lines` does.
    """
    path = Path(path)
    blocks = as_g2o(path, read_blocks(path))
    return parse_lines(path, blocks, skip_unknown, reading, needs_matrices)


def parse_lines(
    path: Path,
    blocks: Iterable[str],
    skip_unknown: bool = False,
    reading: Reading = Reading.AS_WRITTEN,
    needs_matrices: bool = True,
) -> G2OLines:
    """Lines of the text that `blocks` are, whole lines each; errors name the `path`."""
    source = Source(path, skip_unknown)
    first_line = 1
    for block in blocks:
        lines = block.removesuffix("\n").split("\n")
        source.take(first_line, lines)
        first_line += len(lines)
    if skip_unknown and source.unknown:
        warnings.warn(_text_of_unknown(source), GraphWarning, stacklevel=2)
    d = _dimension(source)
    if reading.dimension not in (None, d):
        problem = f"{d}D, and only {reading.dimension}D files can be read {reading.text}"
        raise FileFormatError(path, None, f"{problem}; leave this reading out")
    if needs_matrices:
        source.problems += _problems_of_missing_matrices(source)
    assembly = _Assembly(source, d, reading)
    file = assembly.lines()
    has_unknown = bool(source.unknown) and not skip_unknown
    hint = f"; supported tags are {supported_tags()}" if has_unknown else ""
    check_lines(path, [*source.problems, *problems_of(file)], hint=hint)
    if assembly.notes:
        text = f"{printable(str(path))}: {'; '.join(assembly.notes)}"
        warnings.warn(text, GraphWarning, stacklevel=2)
    return file


def _dimension(source: Source) -> int:
    """Dimension of the lines, 2 or 3.

    A FileFormatError where no line has a known tag, or lines are of neither dimension or of both.
    """
    first_line: dict[int, int] = {}
    for tag, parts in source.parsed.items():
        d = TAGS[tag].d
        for part in parts:
            line = int(part.lines[0])
            first_line[d] = min(first_line.get(d, line), line)
    if not source.skip_unknown:
        has_known = bool(first_line or source.problems)
        source.problems += _problems_of_unknown(source, has_known)
    if len(first_line) == 2:
        earlier, later = sorted(first_line.values())
        problem = (
            f"2D and 3D lines in one file (the other kind is on line {earlier}); "
            "give one file for each"
        )
        source.problems.append((later, problem))
    if len(first_line) != 1:
        check_lines(source.path, source.problems)
        problem = "no measurement in it; a pose graph needs lines with one of the supported tags"
        raise FileFormatError(source.path, None, f"{problem} ({supported_tags()})")
    (d,) = first_line
    return d


def _problems_of_unknown(source: Source, has_known: bool) -> list[Problem]:
    """A problem for every unknown tag; one alone where no line has a known tag."""
    problems: list[Problem] = []
    for tag, (count, first) in source.unknown.items():
        problem = f"unknown tag {tag!r}"
        if "," in tag:
            problem += "; separate words by blanks, not by commas"
        if not has_known:
            problem += (
                ", and no line has a tag of a pose graph, such as EDGE_SE2; images, IMU readings "
                "and tables of numbers are none: give measurements between poses"
            )
            return [(first, problem)]
        if count > 1:
            problem += f" ({count} lines)"
        way_out = "remove the line, or have such lines skipped with --skip-unknown"
        problems.append((first, f"{problem}: {way_out}"))
    return problems


def _problems_of_missing_matrices(source: Source) -> list[Problem]:
    """A problem for every tag of lines without a matrix; EDGE3 has the identity, as in iSAM."""
    problems = []
    for tag, short_tag in SHORT_TAGS.items():
        parts = source.parsed[short_tag]
        if parts and tag != "EDGE3":
            num_lines = sum(len(part.lines) for part in parts)
            problem = (
                f"no information matrix on {num_lines} {tag} lines, the first of them here; choose "
                "the weights: --cost unit of solve and certify, --unit-weights of other commands "
                "and unit_weights=True take those of the "
                "paper, and --estimate-noise finds them from the measurements"
            )
            problems.append((int(parts[0].lines[0]), problem))
    return problems


def _text_of_unknown(source: Source) -> str:
    """Text of the warning for lines with unknown tags."""
    named = islice(source.unknown.items(), _NAMED_TAGS)
    counts = [f"{count} of {printable(tag)} (first: line {first})" for tag, (count, first) in named]
    text = f"{printable(str(source.path))}: lines with unknown tags were skipped: "
    text += ", ".join(counts)
    num_unnamed = len(source.unknown) - _NAMED_TAGS
    if num_unnamed > 0:
        text += f", .. and of {num_unnamed} other tags"
    return text


class _Assembly:
    """The parsed lines of a file put together: in common units and axes, in the order of the file.

    `notes` says what was assumed where files differ, and `weights_error` how far the weights can
    be from those of the file (`weight_errors`).
    """

    def __init__(self, source: Source, d: int, reading: Reading) -> None:
        self.notes: list[str] = []
        self.weights_error = 0.0
        self._source = source
        self._poses: IntArray = np.zeros(0, dtype=np.int64)  # ids of poses, and of no landmark
        self._d = d
        self._reading = reading

    def lines(self) -> G2OLines:
        """What the file holds. Lines with problems are left out, and noted in the source."""
        self._settle_complete()
        if self._reading is not Reading.SQUARE_ROOTS:
            self._settle_edge2()
        self._settle_edge_se2()
        self._note_noise()
        digits = self._digits()
        self._poses = self._ids_of_poses()
        vertices = self._without_repetitions(self._joined(is_edge=False))
        edges = self._joined(is_edge=True)
        edge_ids, edge_rows = edges_as(
            self._reading, edges.ids, edges.numbers, self._d, edges.is_point
        )
        fixed_rows = np.array(self._source.fixed, dtype=np.int64).reshape(-1, 2)
        fixed, fixed_lines = fixed_rows.T
        file = G2OLines(
            self._source.path,
            self._d,
            vertex_ids=vertices.ids[:, 1],
            vertex_lines=vertices.lines,
            vertices=vertices.numbers,
            edge_ids=edge_ids,
            edges=edge_rows,
            edge_lines=edges.lines,
            fixed=fixed,
            fixed_lines=fixed_lines,
            landmarks=np.zeros(0, dtype=np.int64),
            digits=digits,
            weights_error=self.weights_error,
            remainders=self._remainders(edges),
        )
        if vertices.is_point.any() or edges.is_point.any():
            return self._with_landmarks(file, vertices.is_point, edges.is_point)
        return file

    def _ids_of_poses(self) -> IntArray:
        """Ids that lines name as those of poses, and none as that of a landmark.

        Priors of points are no such lines. Where there are none of these, nothing asks for the ids.
        """
        kinds = {tag: kind for tag, kind in TAGS.items() if self._source.parsed[tag]}
        if not any(kind.to_landmark and kind.is_position for kind in kinds.values()):
            return np.zeros(0, dtype=np.int64)
        poses: list[IntArray] = [np.zeros(0, dtype=np.int64)]
        landmarks = poses.copy()
        for tag, kind in kinds.items():
            if kind.to_landmark and kind.is_position:
                continue
            for part in self._source.parsed[tag]:
                num_poses = kind.num_ids - kind.to_landmark
                poses.append(part.ids[:, :num_poses].ravel())
                landmarks.append(part.ids[:, num_poses : kind.num_ids].ravel())
        return np.setdiff1d(np.concatenate(poses), np.concatenate(landmarks))

    def _remainders(self, edges: _Rows) -> Array | None:
        """What the positions of priors have in decimals beyond the numbers of the edges, (m, d)."""
        of_lines = self._source.remainders
        if not of_lines:
            return None
        remainders = np.zeros((len(edges.lines), self._d))
        for row in np.flatnonzero(edges.ids[:, 0] == WORLD_ID):
            remainders[row] = of_lines[int(edges.lines[row])]
        return remainders

    def _settle_complete(self) -> None:
        """Put the upper triangles of complete matrices in their place."""
        parsed = self._source.parsed
        for tag, complete_tag in COMPLETE_TAGS.items():
            for part in parsed[complete_tag]:
                numbers, is_symmetric = TAGS[complete_tag].triangles_of_complete(part.numbers)
                problem = (
                    "the matrix is not symmetric; correct it, or give its upper triangle row by row"
                )
                self._note_problem(part.lines[~is_symmetric], problem)
                parsed[tag].append(part._replace(numbers=numbers).some(is_symmetric))
            parsed[complete_tag] = []

    def _settle_edge2(self) -> None:
        """Settle the order of the matrices on EDGE2 lines, which is by rows afterwards."""
        parts = self._source.parsed["EDGE2"]
        if not parts:
            return
        # TORO's page defines this tag, so that its order is taken where neither fits.
        is_toro, is_by_rows = fitting_orders([part.numbers for part in parts], SINGULAR)
        if is_by_rows and not is_toro:
            self.notes.append(
                "EDGE2 matrices are read in iSAM's order, xx xy xt yy yt tt: all are positive "
                f"definite in it, and not in TORO's; {_TAKEN_AS_INFORMATION}"
            )
            return
        if is_by_rows:
            self.notes.append(
                "EDGE2 matrices are read in TORO's order, ff fs ss rr fr sr; they are all positive "
                "definite in iSAM's, xx xy xt yy yt tt, too"
            )
        self._reorder("EDGE2")

    def _settle_edge_se2(self) -> None:
        """Settle the order of the matrices on EDGE_SE2 lines, which is by rows afterwards."""
        parts = self._source.parsed["EDGE_SE2"]
        if not parts or noise_as(self._reading, TAGS["EDGE_SE2"]) is Noise.SQUARE_ROOT:
            return
        if self._reading in ROTATION_FIRST:
            return
        if self._reading is Reading.TORO_ORDER:
            self._reorder("EDGE_SE2")
            return
        is_toro, is_by_rows = fitting_orders([part.numbers for part in parts], NEGATIVE)
        if is_toro and not is_by_rows:
            self.notes.append(
                "EDGE_SE2 matrices are read in TORO's order, ff fs ss rr fr sr: all are positive "
                "definite in it, and not in g2o's, xx xy xt yy yt tt"
            )
            self._reorder("EDGE_SE2")
        elif is_toro and sum(len(part.lines) for part in parts) >= _NO_CHANCE:
            self.notes.append(
                "EDGE_SE2 matrices are read in g2o's order, xx xy xt yy yt tt; they are all "
                "positive definite in TORO's, ff fs ss rr fr sr, too (--reading toro-order)"
            )

    def _reorder(self, tag: str) -> None:
        """Put the matrices of a tag, which are in TORO's order, into the order of rows."""
        parts = self._source.parsed[tag]
        self._source.parsed[tag] = [
            part._replace(numbers=from_toro_order(part.numbers)) for part in parts
        ]

    def _without_repetitions(self, vertices: _Rows) -> _Rows:
        """VERTEX lines without those that repeat another one, number by number."""
        ids = vertices.ids[:, 1]
        if (np.diff(ids) > 0).all():  # as in most files
            return vertices
        order = np.argsort(ids, kind="stable")
        is_same_id = np.diff(ids[order]) == 0
        numbers = vertices.numbers[order]
        is_same = is_same_id & (numbers[1:] == numbers[:-1]).all(axis=1)
        is_same &= vertices.is_point[order][1:] == vertices.is_point[order][:-1]
        is_kept = np.ones(len(ids), dtype=bool)
        is_kept[order[1:][is_same]] = False
        if is_same.any():
            self.notes.append(f"{int(is_same.sum())} VERTEX lines repeat others, and are left out")
        return _Rows(
            vertices.ids[is_kept],
            vertices.numbers[is_kept],
            vertices.lines[is_kept],
            vertices.is_point[is_kept],
        )

    def _note_noise(self) -> None:
        """Note what is taken for the noise of measurements, where files differ or have none."""
        parsed = self._source.parsed
        if self._reading is not Reading.SQUARE_ROOTS:
            self._note_matrices()
        num_short = sum(len(part.lines) for part in parsed[SHORT_TAGS["EDGE3"]])
        if num_short:
            self.notes.append(f"{num_short} EDGE3 lines have no matrix; the identity is taken")
        if parsed["EDGE_SE3_PRIORQUAT"]:
            self.notes.append(
                "EDGE_SE3_PRIORQUAT has w first, and its matrix is taken as that of a rotation "
                "vector, as with EDGE_SE3:QUAT"
            )
        of_cameras = [tag for tag in ("EDGE_SE3:EXPMAP", "EDGE_SIM3:EXPMAP") if parsed[tag]]
        if of_cameras:
            self.notes.append(
                f"{' and '.join(of_cameras)}: matrices have the rotation first, and are taken as "
                "those of the relative pose; g2o has such errors in the axes of the world"
            )
        if parsed["BR"]:
            self.notes.append(
                "BR measurements, bearing and range, are taken as points with the covariance to "
                "first order"
            )
        self._note_skipped()

    def _note_skipped(self) -> None:
        """Note what lines hold that is not used, and how many there are."""
        source = self._source
        counts: dict[str, list[str]] = {}  # by the reason
        for tag, count in source.skipped.items():
            counts.setdefault(SKIPPED_TAGS[tag], []).append(f"{count} {tag}")
        for reason, of_tags in counts.items():
            self.notes.append(f"{' and '.join(of_tags)} lines are skipped: {reason}")
        tags = ("EDGE_SE2_SWITCHABLE", "EDGE_SE3_SWITCHABLE")
        num_switchable = sum(len(part.lines) for tag in tags for part in source.parsed[tag])
        if num_switchable:
            self.notes.append(
                f"{num_switchable} switchable edges are read as edges that hold always; --robust "
                "finds wrong ones"
            )
        if source.num_kernels:
            self.notes.append(
                f"robust kernels of {source.num_kernels} edges are not used; --robust finds wrong "
                "edges"
            )

    def _note_matrices(self) -> None:
        """Note what matrices are taken for, which iSAM's files have the square roots of."""
        parsed = self._source.parsed
        covariances = [tag for tag in ("ODOMETRY", "LANDMARK") if parsed[tag]]
        if covariances:
            self.notes.append(
                f"{' and '.join(covariances)} matrices are taken as covariances, as GTSAM does; "
                f"{_SQUARE_ROOTS}"
            )
        if "LANDMARK2" in self._source.written_tags:
            self.notes.append(f"LANDMARK2 {_TAKEN_AS_INFORMATION}")
        if {"EDGE_SE3", "EDGE_SE3:EULER"} & self._source.written_tags and parsed["EDGE3"]:
            self.notes.append(
                "EDGE_SE3 lines with three angles are read as TORO's EDGE3: roll, pitch and yaw, "
                "and the information of a rotation vector"
            )
        # TORO, whose matrices are information, writes vertices; iSAM does not.
        if "EDGE3" in self._source.written_tags and parsed["EDGE3"] and not parsed["VERTEX3"]:
            self.notes.append(f"EDGE3 {_TAKEN_AS_INFORMATION}")

    def _digits(self) -> WrittenDigits:
        """Digits with which the measurements are written, all where their units are changed."""
        if self._reading.converts_units:
            return ALL_DIGITS
        measured = [np.zeros(0)]
        for tag, kind in TAGS.items():
            if kind.is_edge:
                parts = self._source.parsed[tag]
                measured += [part.numbers[:, : kind.num_measured].ravel() for part in parts]
        return digits_of(np.concatenate(measured))

    def _joined(self, is_edge: bool) -> _Rows:
        """All VERTEX or all EDGE lines in the order of the file.

        What was parsed of them is removed from the source, so that it takes no memory any more.
        """
        kinds = {}
        for tag, kind in TAGS.items():
            if kind.d == self._d and kind.is_edge == is_edge:
                kinds[tag] = kind
        parts = []
        for tag, kind in kinds.items():
            parts += [self._as_rows(kind, part) for part in self._source.parsed.pop(tag)]
        if not parts:
            kind = next(iter(kinds.values()))
            no_ids = np.zeros((0, kind.num_ids), dtype=np.int64)
            no_lines = np.zeros(0, dtype=np.int64)
            no_numbers = np.zeros((0, kind.num_numbers))
            none = ParsedLines(no_lines, no_ids, no_numbers)
            parts = [self._as_rows(kind, none)]
        fields = zip(*parts, strict=True)
        ids, numbers, lines, is_point = map(np.concatenate, fields)
        is_sorted = not (np.diff(lines) < 0).any()
        if is_sorted:
            return _Rows(ids, numbers, lines, is_point)
        order = np.argsort(lines)
        return _Rows(ids[order], numbers[order], lines[order], is_point[order])

    def _as_rows(self, kind: Tag, part: ParsedLines) -> _Rows:
        """Lines of a tag in the common form, in which an edge of one pose begins at the world.

        Lines with a noise or an offset that is none are left out; their problems are noted.
        """
        noise = noise_as(self._reading, kind)
        if noise is not kind.noise:
            kind = replace(kind, noise=noise)
        part = part._replace(numbers=numbers_as(self._reading, kind, part.numbers))
        part, numbers, weights_error = sound_rows(kind, part, self._source.problems)
        self.weights_error = max(self.weights_error, weights_error)
        if kind.num_offsets:
            part, numbers = self._in_frames_of_poses(kind, part, numbers)
        ids = part.ids[:, : kind.num_ids]
        ids_behind_world = np.insert(ids, 0, WORLD_ID, axis=1)
        last_two_ids = ids_behind_world[:, -2:]
        is_point = np.full(len(part.lines), kind.to_landmark)
        if kind.to_landmark and kind.is_position:
            is_of_pose = np.isin(last_two_ids[:, 1], self._poses)
            is_point &= ~is_of_pose
            self._note_positions(int(is_of_pose.sum()))
        return _Rows(last_two_ids, numbers, part.lines, is_point)

    def _note_positions(self, count: int) -> None:
        """Note how many priors of points are those of poses, as RTAB-Map writes fixes of GPS."""
        if count:
            tag = "EDGE_PRIOR_XY" if self._d == 2 else "EDGE_POINTXYZ_PRIOR"
            self.notes.append(
                f"{count} {tag} lines name poses, as RTAB-Map writes GPS: they are read as "
                "positions of these poses"
            )

    def _note_problem(self, lines: IntArray, problem: str) -> None:
        self._source.problems += [(line, problem) for line in lines.tolist()]

    def _in_frames_of_poses(
        self, kind: Tag, part: ParsedLines, numbers: Array
    ) -> tuple[ParsedLines, Array]:
        """EDGE rows in the frames of the poses. Rows of sensors at their poses stay as they are.

        Rows with a zero quaternion, which have no frame, are left out.
        """
        if self._d == 3:
            problems = zero_quaternion_lines(part.lines, numbers[:, 3:7])
            self._source.problems += problems
            is_right = ~np.isin(part.lines, [line for line, _ in problems])
            part = part.some(is_right)
            numbers = numbers[is_right]
        offset_ids = part.ids[:, kind.num_ids :]
        offset_of: dict[int, Array] = {}
        for offset_id in np.unique(offset_ids).tolist():
            if (self._d, str(offset_id)) not in self._source.offsets:
                is_named = (offset_ids == offset_id).any(axis=1)
                self._check_unknown_offset(kind, offset_id, part.lines[is_named])
                continue
            offset = self._offset(offset_id)
            if offset is not None:
                offset_of[offset_id] = offset
        is_moved = np.isin(offset_ids, list(offset_of)).any(axis=1)
        if not is_moved.any():
            return part, numbers
        if kind.is_position:
            problem = (
                "the position of a sensor that is not at its pose; give the position of the pose, "
                "without the offset"
            )
            self._note_problem(part.lines[is_moved], problem)
            return part, numbers
        offsets = [offsets_named(ids, self._d, offset_of) for ids in offset_ids[is_moved].T]
        numbers = numbers.copy()
        numbers[is_moved], errors = in_frames_of_poses(kind, numbers[is_moved], offsets)
        is_hidden = np.asarray(errors > MOST)
        self._note_problem(part.lines[is_moved][is_hidden], HIDDEN_INFORMATION)
        self.weights_error = max([self.weights_error, *errors[~is_hidden].tolist()])
        return part, numbers

    def _check_unknown_offset(self, kind: Tag, offset_id: int, lines: IntArray) -> None:
        """Note a problem of lines that name an offset without a PARAMS_ line.

        0 is then a sensor at its pose, and g2o measures the position of the pose itself.
        """
        if offset_id == 0 and not kind.is_position:
            self.notes.append(
                f"{len(lines)} lines name sensor 0 (the first is line {lines[0]}), and no "
                f"{OFFSET_TAGS[self._d]} line says where it is: it is taken to be at the pose; "
                "add the line if it is not"
            )
        if offset_id in (0, NO_OFFSET) or kind.is_position:
            return
        tag = OFFSET_TAGS[self._d]
        self._note_problem(lines, f"no {tag} line has the id {offset_id}; add it, or name 0")

    def _offset(self, offset_id: int) -> Array | None:
        """Numbers of a sensor's pose, like those of a vertex; None where it is at its pose."""
        given = self._source.offsets[self._d, str(offset_id)]
        line, words = given[0]
        try:
            numbers = np.array([finite_number(self._source.path, line, word) for word in words])
        except FileFormatError as error:
            self._source.problems.append((line, error.problem))
            return None
        problems = self._problems_of_offset(numbers, [line for line, _ in given])
        self._source.problems += problems
        is_at_pose = not numbers[: 6 if self._d == 3 else 3].any()
        return None if problems or is_at_pose else numbers

    def _problems_of_offset(self, numbers: Array, lines: list[int]) -> list[Problem]:
        """Problems of a sensor's pose, which is on the first of these lines."""
        tag = OFFSET_TAGS[self._d]
        expected = 3 if self._d == 2 else 7
        first, *others = lines
        if len(numbers) != expected:
            problem = f"{tag} needs 1 id and {expected} numbers, found {len(numbers)}; complete it"
            return [(first, problem)]
        if others:
            problem = f"a second {tag} line of an id (the first is line {first}); remove one"
            return [(others[0], problem)]
        rows = numbers[None]
        problems = far_lines([first], rows[:, : self._d])
        if self._d == 3:
            problems += zero_quaternion_lines([first], rows[:, 3:])
        return problems

    def _with_landmarks(
        self, file: G2OLines, vertex_is_point: BoolArray, edge_ends_at_point: BoolArray
    ) -> G2OLines:
        """The file with its landmarks, whose ids are shifted where some are those of poses.

        The masks, (v,) and (m,), say which lines are of points, or edges that end at one.
        """
        ids_i, ids_j = file.edge_ids.T
        pose_ids = [file.vertex_ids[~vertex_is_point], ids_i, ids_j[~edge_ends_at_point]]
        poses = np.unique(np.concatenate(pose_ids))
        poses = poses[poses != WORLD_ID]
        landmark_ids = [file.vertex_ids[vertex_is_point], ids_j[edge_ends_at_point]]
        landmarks = np.unique(np.concatenate(landmark_ids))
        both = np.intersect1d(poses, landmarks)
        if not len(both):
            return replace(file, landmarks=landmarks)
        shift = landmark_shift(poses, landmarks)
        if shift == 0:
            problem = f"id {both[0]} is that of a pose and of a landmark; renumber one of them"
            raise FileFormatError(self._source.path, None, problem)
        self.notes.append(
            f"poses and landmarks have ids in common ({len(both)}), and are kept apart: "
            f"{shift} is added to the ids of landmarks"
        )
        is_fixed_landmark = np.isin(file.fixed, landmarks) & ~np.isin(file.fixed, poses)
        shifted_ends = np.stack([ids_i, ids_j + shift * edge_ends_at_point], axis=1)
        return replace(
            file,
            vertex_ids=file.vertex_ids + shift * vertex_is_point,
            edge_ids=shifted_ends,
            fixed=file.fixed + shift * is_fixed_landmark,
            landmarks=landmarks + shift,
            landmark_shift=shift,
        )


def sound_rows(
    kind: Tag, part: ParsedLines, problems: list[Problem]
) -> tuple[ParsedLines, Array, float]:
    """Lines of a tag that are sound, their rows, (n, width), and the error of their weights.

    The others are left out, and their problems are added to those given: a noise that is none, and
    information that doubles cannot hold.
    """
    is_wrong, problem = kind.problem(part.numbers)
    problems += [(line, problem) for line in part.lines[is_wrong].tolist()]
    part = part.some(~is_wrong)
    errors = kind.weights_error(part.numbers)
    is_hidden = np.asarray(errors > MOST)
    problems += [(line, HIDDEN_INFORMATION) for line in part.lines[is_hidden].tolist()]
    part = part.some(~is_hidden)
    rows = kind.rows(part.numbers)
    is_far = np.asarray((np.abs(rows) > LARGEST).any(axis=1))
    problem = f"information beyond {LARGEST:g}; correct the line"
    problems += [(line, problem) for line in part.lines[is_far].tolist()]
    weights_error = float(errors[~is_hidden].max(initial=0.0))
    return part.some(~is_far), rows[~is_far], weights_error


def problems_of(file: G2OLines) -> list[Problem]:
    """Lines whose numbers cannot be what they stand for, and why."""
    problems: list[Problem] = []
    for lines, numbers in ((file.vertex_lines, file.vertices), (file.edge_lines, file.edges)):
        problems += far_lines(lines, numbers[:, : file.d])
        if file.d == 3:
            problems += zero_quaternion_lines(lines, numbers[:, 3:7])
    problems += _problems_of_ids(file)
    # Only the two blocks are checked: the precisions use nothing else, and the coupling blocks of
    # the public cubicle graph make 5,021 of its whole matrices indefinite.
    information = information_of(file.d, file.edges)
    is_zero = ~information.any(axis=(1, 2))
    for line in file.edge_lines[is_zero].tolist():
        problem = "the information matrix is zero; the edge says nothing: remove it"
        problems.append((line, problem))
    d = file.d
    problems += _problems_of_blocks(file, "translation", information[:, :d, :d])
    problems += _problems_of_blocks(file, "rotation", information[:, d:, d:])
    return problems


def _problems_of_ids(file: G2OLines) -> list[Problem]:
    """Lines that repeat a vertex, and edges from a pose to itself."""
    problems: list[Problem] = []
    order = np.argsort(file.vertex_ids, kind="stable")
    steps = np.diff(file.vertex_ids[order])
    for place in np.flatnonzero(steps == 0).tolist():
        earlier, later = file.vertex_lines[order[place : place + 2]].tolist()
        vertex_id = file.vertex_ids[order[place]]
        problem = (
            f"a second VERTEX line of pose {vertex_id} (the one before is line {earlier}); "
            "remove one"
        )
        problems.append((later, problem))
    ids_i, ids_j = file.edge_ids.T
    for e in np.flatnonzero(ids_i == ids_j).tolist():
        problem = f"an edge from pose {ids_i[e]} to itself; remove it"
        problems.append((int(file.edge_lines[e]), problem))
    return problems


def _problems_of_blocks(file: G2OLines, name: str, blocks: Array) -> list[Problem]:
    """Lines with a block, (m, k, k), that has a negative eigenvalue, or is too small for doubles.

    Directions without information are no fault.
    """
    doubtful = np.flatnonzero(_may_be_indefinite(blocks))
    if not len(doubtful):
        return []
    diagonals = np.abs(np.einsum("mkk->mk", blocks[doubtful]))
    is_tiny = ((diagonals > 0.0) & (diagonals <= 1.0 / LARGEST)).any(axis=1)
    is_wrong = ~is_negative_by_rounding(blocks[doubtful]) | is_tiny
    wrong = doubtful[is_wrong]
    smallest = np.linalg.eigvalsh(blocks[wrong])[:, 0].tolist()
    lines = file.edge_lines[wrong].tolist()
    problems = []
    for line, eigenvalue in zip(lines, smallest, strict=True):
        problem = (
            f"{name} block of the information matrix is indefinite "
            f"(smallest eigenvalue {eigenvalue:.3g}); "
            "give the upper triangle row by row, or remove the line"
        )
        problems.append((line, problem))
    return problems


def _may_be_indefinite(A: Array) -> BoolArray:
    """Whether matrices (m, k, k) are neither zero nor positive definite, (m,), beyond rounding."""
    diagonals = np.einsum("mkk->mk", A)
    is_positive = (diagonals > 1.0 / LARGEST).all(axis=1)
    is_positive[is_positive] = are_definite(A[is_positive], SINGULAR)
    return np.asarray(~is_positive & A.any(axis=(1, 2)))
