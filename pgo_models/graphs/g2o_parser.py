"""The lines of one g2o file as arrays, every fault named by file:line.

Tags are in `g2o_tags`.

A sound file takes a short way: blocks of some megabytes, in which all lines of a tag are parsed by
one call. Only when that call fails are the lines looked at one by one, to name the wrong one.
"""

import warnings
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from pgo_models.errors import FileFormatError, GraphWarning, printable
from pgo_models.files import (
    LARGEST,
    LONGEST,
    check_length,
    check_metres,
    check_quaternions,
    finite_number,
    read_blocks,
)
from pgo_models.geometry.arrays import triangle_places
from pgo_models.geometry.rotations import Array, BoolArray, exp_map, rotations_from_quaternions
from pgo_models.graphs.g2o_tags import ALIASES, TAGS, Tag
from pgo_models.graphs.pose_graph import WORLD_ID, IntArray
from pgo_models.graphs.precisions import are_definite

_LONG_RUN = 16  # lines of one tag in a row, from which on they need not be sorted by tag
_NAMED_TAGS = 10  # unknown tags that a warning names
_SHOWN = 40  # characters of a wrong word that a message shows
# An eigenvalue below this, of a matrix with ones on its diagonal, is rounding.
_SINGULAR = 1e-15


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
    landmarks: IntArray  # (l,): ids that some line uses for a point


class _ParsedLines(NamedTuple):
    """Lines of one tag: their numbers in the file, and what stands on them."""

    lines: IntArray  # (n,)
    ids: IntArray  # (n, num_ids)
    numbers: Array  # (n, num_numbers)


class _Rows(NamedTuple):
    """All VERTEX or all EDGE lines of a file."""

    ids: IntArray  # (n, 2): the second id alone counts for a vertex
    numbers: Array  # (n, width)
    lines: IntArray  # (n,)
    is_point: BoolArray  # (n,): whether the last id is that of a landmark


def read_lines(path: Path | str, skip_unknown: bool = False) -> G2OLines:
    """Read and check the lines of one g2o file.

    Blank lines, comments (#) and PARAMS_ lines are skipped. With `skip_unknown`, so are lines with
    unknown tags, and a `GraphWarning` gives the number of each.

    A FileFormatError with file:line, for: a file that is missing, binary or without VERTEX and EDGE
    lines; an unknown tag; too few or too many numbers on a line, or thousands of them; a word, nan
    or inf where a number belongs; an id that is no integer of 64 bits; a zero quaternion; a length
    beyond `FARTHEST`; an information matrix whose translation or rotation block is neither positive
    definite nor zero, or both of whose blocks are zero; an edge to itself; a second VERTEX line of
    an id; a measurement in the frame of a sensor that is not at its pose; an edge that begins at a
    landmark, or measures its rotation; lines in 2D beside lines in 3D.
    """
    path = Path(path)
    source = _Source(path, skip_unknown)
    first_line = 1
    for block in read_blocks(path):
        lines = block.removesuffix("\n").split("\n")
        source.take(first_line, lines)
        first_line += len(lines)
    if source.unknown:
        warnings.warn(source.text_of_unknown(), GraphWarning, stacklevel=2)
    d = source.dimension()
    vertices = source.joined(d, is_edge=False)
    edges = source.joined(d, is_edge=True)
    fixed, fixed_lines = np.array(source.fixed, dtype=np.int64).reshape(-1, 2).T
    file = G2OLines(
        path,
        d,
        vertex_ids=vertices.ids[:, 1],
        vertex_lines=vertices.lines,
        vertices=vertices.numbers,
        edge_ids=edges.ids,
        edges=edges.numbers,
        edge_lines=edges.lines,
        fixed=fixed,
        fixed_lines=fixed_lines,
        landmarks=_landmarks(path, vertices, edges),
    )
    for rows in (vertices, edges):
        check_metres(path, rows.lines, rows.numbers[:, :d])
        if d == 3:
            check_quaternions(path, rows.lines, rows.numbers[:, 3:7])
    for line, problem in _faults(file):
        raise FileFormatError(path, line, problem)
    return file


def poses_of(d: int, numbers: Array) -> tuple[Array, Array]:
    """Rotations (n, d, d) and translations (n, d) of rows of `G2OLines`.

    The rows open with x y theta, or x y z qx qy qz qw.
    """
    if d == 2:
        return exp_map(numbers[:, 2:3]), numbers[:, :2].copy()
    return rotations_from_quaternions(numbers[:, 3:7]), numbers[:, :3].copy()


def information_of(d: int, edges: Array) -> Array:
    """Information matrices (m, k, k) of EDGE rows, k = 3 in the plane and 6 in space."""
    k, first = (3, 3) if d == 2 else (6, 7)
    return np.asarray(edges[:, first + triangle_places(k)])


class _Source:
    """What the lines of a file hold, parsed tag by tag.

    Where that fails, the lines are looked at one by one to name the wrong one.
    """

    def __init__(self, path: Path, skip_unknown: bool) -> None:
        self.path = path
        self._skip_unknown = skip_unknown
        self.parsed: dict[str, list[_ParsedLines]] = {tag: [] for tag in TAGS}
        self.fixed: list[tuple[int, int]] = []  # a pose and its line
        self.unknown: dict[str, tuple[int, int]] = {}  # tag: how many lines, and the first
        self._offset_line = 0  # line of a sensor that is not at its pose; 0 if there is none

    def take(self, first_line: int, lines: list[str]) -> None:
        """Parse lines, of which the first has the number `first_line` in the file."""
        num_taken = self._take_runs(first_line, lines)
        self._take_groups(first_line + num_taken, lines[num_taken:])

    def _take_runs(self, first_line: int, lines: list[str]) -> int:
        """Parse long runs of lines of one tag; return how many lines these are."""
        start = 0
        while start < len(lines):
            tag = "".join(lines[start].split(None, 1)[:1])
            # Bisection takes for granted that all lines of a tag follow each other. Where other
            # lines stand between them, parsing fails, and the lines are sorted by their tags.
            end = bisect_left(lines, True, start, key=lambda line: not line.startswith(tag))
            is_run = tag in TAGS and not TAGS[tag].has_offset and end - start >= _LONG_RUN
            numbers = np.arange(first_line + start, first_line + end)
            if not is_run or not self._parse(tag, tag, numbers, lines[start:end]):
                break
            start = end
        return start

    def _take_groups(self, first_line: int, lines: list[str]) -> None:
        """Sort lines by their tags, and parse the lines of each tag."""
        places: dict[str, list[int]] = {}
        for place, line in enumerate(lines):
            if words := line.split(None, 1):
                places.setdefault(words[0], []).append(place)
        for written_tag, places_of_tag in places.items():
            numbers = np.array(places_of_tag) + first_line
            lines_of_tag = [lines[place] for place in places_of_tag]
            tag = ALIASES.get(written_tag, written_tag)
            if tag in TAGS:
                self._take_measurements(tag, written_tag, numbers, lines_of_tag)
            elif not written_tag.startswith("#"):
                self._take_others(written_tag, numbers.tolist(), lines_of_tag)

    def _take_measurements(
        self, tag: str, written_tag: str, numbers: IntArray, lines: list[str]
    ) -> None:
        """Take VERTEX or EDGE lines, whose tag may be written as an alias."""
        if TAGS[tag].has_offset:
            lines = [" ".join([written_tag, *_words(TAGS[tag], line)]) for line in lines]
        if not self._parse(tag, written_tag, numbers, lines):
            self._diagnose(tag, numbers.tolist(), lines)

    def _take_others(self, tag: str, numbers: list[int], lines: list[str]) -> None:
        """Take lines of a tag that is no measurement's."""
        if tag == "FIX":
            for number, line in zip(numbers, lines, strict=True):
                self.fixed += [(self._id(number, word), number) for word in line.split()[1:]]
        elif tag == "PARAMS_SE3OFFSET":
            for number, line in zip(numbers, lines, strict=True):
                offset = line.split()[2:8]
                if any(finite_number(self.path, number, word) for word in offset):
                    self._offset_line = number
        elif tag.startswith("PARAMS_"):
            return
        elif self._skip_unknown:
            shown_tag = tag[:_SHOWN]
            count, first = self.unknown.get(shown_tag, (0, numbers[0]))
            self.unknown[shown_tag] = (count + len(numbers), first)
        else:
            known = f"{', '.join(TAGS)} and FIX"
            raise self._error(
                numbers[0],
                f"unknown tag {tag[:_SHOWN]!r}; supported are {known}: remove the line, "
                "or have such lines skipped with --skip-unknown",
            )

    def text_of_unknown(self) -> str:
        """Text of the warning for lines with unknown tags."""
        named = islice(self.unknown.items(), _NAMED_TAGS)
        counts = [
            f"{count} of {printable(tag)} (first: line {first})" for tag, (count, first) in named
        ]
        text = f"{printable(str(self.path))}: lines with unknown tags were skipped: "
        text += ", ".join(counts)
        num_unnamed = len(self.unknown) - _NAMED_TAGS
        if num_unnamed > 0:
            text += f", .. and of {num_unnamed} other tags"
        return text

    def joined(self, d: int, is_edge: bool) -> _Rows:
        """All VERTEX or all EDGE lines, line by line; what was parsed of them is given away."""
        kinds = {tag: kind for tag, kind in TAGS.items() if (kind.d, kind.is_edge) == (d, is_edge)}
        parts = []
        for tag, kind in kinds.items():
            parts += [_as_rows(kind, part) for part in self.parsed.pop(tag)]
        if not parts:
            kind = next(iter(kinds.values()))
            no_ids = np.zeros((0, kind.num_ids), dtype=np.int64)
            no_lines = np.zeros(0, dtype=np.int64)
            none = _ParsedLines(no_lines, no_ids, np.zeros((0, kind.num_numbers)))
            parts = [_as_rows(kind, none)]
        ids, numbers, lines, is_point = map(np.concatenate, zip(*parts, strict=True))
        if (np.diff(lines) < 0).any():
            order = np.argsort(lines)
            return _Rows(ids[order], numbers[order], lines[order], is_point[order])
        return _Rows(ids, numbers, lines, is_point)

    def dimension(self) -> int:
        """Dimension of the lines, 2 or 3.

        A FileFormatError where lines are of neither or of both, or measured by a sensor that is not
        at its pose.
        """
        uses_offset = any(self.parsed[tag] for tag, kind in TAGS.items() if kind.has_offset)
        if self._offset_line and uses_offset:
            raise self._error(
                self._offset_line,
                "a sensor that is not at its pose; give what it measured in the frame of the pose, "
                "without this line",
            )
        first_line: dict[int, int] = {}
        for tag, parts in self.parsed.items():
            d = TAGS[tag].d
            for part in parts:
                line = int(part.lines[0])
                first_line[d] = min(first_line.get(d, line), line)
        if not first_line:
            problem = f"no measurement in it; a pose graph needs lines of {' or '.join(TAGS)}"
            raise FileFormatError(self.path, None, problem)
        if len(first_line) == 2:
            earlier, later = sorted(first_line.values())
            raise self._error(
                later,
                f"2D and 3D lines in one file (the other kind is on line {earlier}); "
                "give one file for each",
            )
        (d,) = first_line
        return d

    def _parse(self, tag: str, written_tag: str, numbers: IntArray, lines: list[str]) -> bool:
        """Parse lines of one tag by one call, keep what they hold, and return if they are sound.

        They are sound unless a line has another tag, an id that is no integer, a number that is not
        finite, or another number of words.
        """
        kind = TAGS[tag]
        if max(map(len, lines)) > LONGEST:
            return False
        shared_end = _shared_end(lines, kind.num_numbers - 1)
        num_own = kind.num_numbers - len(shared_end.split())
        row_type = np.dtype(
            [("tag", "S20"), ("ids", "i8", (kind.num_ids,)), ("numbers", "f8", (num_own,))]
        )
        own_ends = [line.removesuffix(shared_end) for line in lines]
        shared = np.zeros((1, 0))
        try:
            # NumPy warns of an id like 1.0, which is none.
            with warnings.catch_warnings(action="error", category=DeprecationWarning):
                rows = np.loadtxt(own_ends, comments=None, ndmin=1, dtype=row_type)
            if shared_end:
                shared = np.loadtxt([shared_end], comments=None, ndmin=2)
        except (ValueError, DeprecationWarning):
            return False
        ids = rows["ids"]
        values = np.concatenate([rows["numbers"], shared.repeat(len(rows), axis=0)], axis=1)
        has_tag = len(ids) == len(numbers) and (rows["tag"] == written_tag.encode()).all()
        if not has_tag or (ids == WORLD_ID).any() or not (np.abs(values) <= LARGEST).all():
            return False
        self.parsed[tag].append(_ParsedLines(numbers, ids.copy(), values))
        return True

    def _diagnose(self, tag: str, numbers: list[int], lines: list[str]) -> NoReturn:
        """Raise the error of the first line that is wrong."""
        for number, line in zip(numbers, lines, strict=True):
            check_length(self.path, number, line)
            self._check_line(tag, number, line)
        raise self._error(
            numbers[0],
            f"the {tag} lines cannot be read; write numbers like 1.5e-3, separated by blanks",
        )

    def _check_line(self, tag: str, number: int, line: str) -> None:
        """Raise a FileFormatError when a word of a line is wrong, or there are not enough."""
        kind = TAGS[tag]
        words = _words(kind, line)
        for word in words[: kind.num_ids]:
            self._id(number, word)
        for word in words[kind.num_ids :]:
            finite_number(self.path, number, word)
        expected = kind.num_ids + kind.num_numbers
        if len(words) == expected:
            return
        ids = "1 id" if kind.num_ids == 1 else f"{kind.num_ids} ids"
        cause = "the line is cut off" if len(words) < expected else "the line is too long"
        raise self._error(
            number,
            f"{tag} needs {ids} and {kind.num_numbers} numbers, {expected} in all, "
            f"found {len(words)}; {cause}: complete or remove it",
        )

    def _id(self, line: int, word: str) -> int:
        """Id of a pose, which has 64 bits."""
        try:
            # int() also takes 1_000 and the digits of other scripts; number files do not.
            value = int(word if word.isascii() and "_" not in word else "")
        except ValueError:
            problem = f"id {word[:_SHOWN]!r} is no integer; number the poses"
            raise self._error(line, problem) from None
        if not -(2**63) <= value < WORLD_ID:
            raise self._error(
                line,
                f"id {word[:_SHOWN]} does not fit 64 bits, less one that stands for the world; "
                "renumber the poses",
            )
        return value

    def _error(self, line: int, problem: str) -> FileFormatError:
        return FileFormatError(self.path, line, problem)


def _words(kind: Tag, line: str) -> list[str]:
    """Ids and numbers on a line, without the id of an offset."""
    words = line.split()[1:]
    if kind.has_offset and len(words) == kind.num_ids + 1 + kind.num_numbers:
        words.pop(kind.num_ids)
    return words


def _as_rows(kind: Tag, part: _ParsedLines) -> _Rows:
    """Lines of a tag in the common form: edges of one pose are priors, which begin at the world."""
    two_ids = np.insert(part.ids, 0, WORLD_ID, axis=1)[:, -2:]
    is_point = np.full(len(part.lines), kind.to_landmark)
    return _Rows(two_ids, kind.rows(part.numbers), part.lines, is_point)


def _landmarks(path: Path, vertices: _Rows, edges: _Rows) -> IntArray:
    """Ids of landmarks; a FileFormatError where one stands for a pose in another line."""
    vertex_ids = vertices.ids[:, 1]
    landmarks = np.unique(
        np.concatenate([vertex_ids[vertices.is_point], edges.ids[edges.is_point, 1]])
    )
    is_posed_vertex = np.isin(vertex_ids, landmarks) & ~vertices.is_point
    # The first id of an edge is always that of a pose, the second one unless it ends at a point.
    may_be_landmark = np.stack([np.zeros_like(edges.is_point), edges.is_point], axis=1)
    is_posed_edge = (np.isin(edges.ids, landmarks) & ~may_be_landmark).any(axis=1)
    posed = [*vertices.lines[is_posed_vertex], *edges.lines[is_posed_edge]]
    if posed:
        problem = (
            "a pose, or an edge of poses, with the id of a landmark, which is a point; "
            "renumber one of them"
        )
        raise FileFormatError(path, int(min(posed)), problem)
    return landmarks


def _shared_end(lines: list[str], most: int) -> str:
    """Words that all lines end with, as information matrices are often the same.

    It is empty where these words are more than `most`.
    """
    first = lines[0].split(" ")[::-1]
    last = lines[-1].split(" ")[::-1]
    differs = (place for place, (a, b) in enumerate(zip(first, last, strict=False)) if a != b)
    count = next(differs, 0)
    shared_end = " " + " ".join(first[:count][::-1])
    if not 0 < len(shared_end.split()) <= most:
        return ""
    return shared_end if all(line.endswith(shared_end) for line in lines) else ""


def _faults(file: G2OLines) -> Iterator[tuple[int, str]]:
    """Line and description of what the numbers of a file cannot be."""
    order = np.argsort(file.vertex_ids, kind="stable")
    repeated = np.flatnonzero(np.diff(file.vertex_ids[order]) == 0)
    if repeated.size:
        earlier = order[repeated[0]]
        later = order[repeated[0] + 1]
        first = f"(the first is line {file.vertex_lines[earlier]})"
        problem = f"a second VERTEX line of pose {file.vertex_ids[later]} {first}; remove one"
        yield int(file.vertex_lines[later]), problem
    loops = file.edge_ids[:, 0] == file.edge_ids[:, 1]
    if loops.any():
        e = int(np.argmax(loops))
        problem = f"an edge from pose {file.edge_ids[e, 0]} to itself; remove it"
        yield int(file.edge_lines[e]), problem
    # Only the two blocks are checked: the precisions use nothing else, and the coupling blocks of
    # the public cubicle graph make 5,021 of its whole matrices indefinite.
    information = information_of(file.d, file.edges)
    is_zero = ~information.any(axis=(1, 2))
    if is_zero.any():
        problem = "the information matrix is zero; the edge says nothing: remove it"
        yield int(file.edge_lines[int(np.argmax(is_zero))]), problem
    d = file.d
    yield from _faults_of_blocks(file, "translation", information[:, :d, :d])
    yield from _faults_of_blocks(file, "rotation", information[:, d:, d:])


def _faults_of_blocks(file: G2OLines, name: str, blocks: Array) -> Iterator[tuple[int, str]]:
    """Line and description of a block, (m, k, k), that is neither zero nor positive definite."""
    is_wrong = blocks.any(axis=(1, 2)) & ~_is_positive_definite(blocks)
    if is_wrong.any():
        e = int(np.argmax(is_wrong))
        smallest = np.linalg.eigvalsh(blocks[e])[0]
        yield (
            int(file.edge_lines[e]),
            f"{name} block of the information matrix is not positive definite "
            f"(smallest eigenvalue {smallest:.3g}); "
            "give the upper triangle row by row, or remove the line",
        )


def _is_positive_definite(A: Array) -> BoolArray:
    """Whether matrices (m, k, k) are positive definite, (m,), beyond rounding and underflow."""
    is_positive = (np.einsum("mkk->mk", A) > 1.0 / LARGEST).all(axis=1)
    is_positive[is_positive] = are_definite(A[is_positive], _SINGULAR)
    return np.asarray(is_positive)
