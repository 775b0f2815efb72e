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
    fixed_rows = np.array(source.fixed, dtype=np.int64).reshape(-1, 2)
    fixed, fixed_lines = fixed_rows.T
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
        translations = rows.numbers[:, :d]
        check_metres(path, rows.lines, translations)
        if d == 3:
            quaternions = rows.numbers[:, 3:7]
            check_quaternions(path, rows.lines, quaternions)
    for line, problem in _faults(file):
        raise FileFormatError(path, line, problem)
    return file


def poses_of(d: int, numbers: Array) -> tuple[Array, Array]:
    """Rotations (n, d, d) and translations (n, d) of rows of `G2OLines`.

    The rows open with x y theta, or x y z qx qy qz qw.
    """
    t = numbers[:, :d].copy()
    if d == 2:
        angles = numbers[:, 2:3]
        return exp_map(angles), t
    quaternions = numbers[:, 3:7]
    return rotations_from_quaternions(quaternions), t


def information_of(d: int, edges: Array) -> Array:
    """Information matrices (m, k, k) of EDGE rows, k = 3 in the plane and 6 in space."""
    k = 3 if d == 2 else 6
    num_measured = 3 if d == 2 else 7
    columns = num_measured + triangle_places(k)
    return np.asarray(edges[:, columns])


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
            first_word = lines[start].split(None, 1)[:1]
            tag = "".join(first_word)  # empty on a blank line
            # Bisection takes for granted that all lines of a tag follow each other. Where other
            # lines stand between them, parsing fails, and the lines are sorted by their tags.
            end = bisect_left(lines, True, start, key=lambda line: not line.startswith(tag))
            is_simple = tag in TAGS and not TAGS[tag].has_offset
            if not is_simple or end - start < _LONG_RUN:
                break
            numbers = np.arange(first_line + start, first_line + end)
            is_sound = self._parse(tag, tag, numbers, lines[start:end])
            if not is_sound:
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
        kind = TAGS[tag]
        if kind.has_offset:
            words_of_lines = [_words(kind, line) for line in lines]
            lines = [" ".join([written_tag, *words]) for words in words_of_lines]
        if not self._parse(tag, written_tag, numbers, lines):
            self._diagnose(tag, numbers.tolist(), lines)

    def _take_others(self, tag: str, numbers: list[int], lines: list[str]) -> None:
        """Take lines of a tag that is no measurement's."""
        if tag == "FIX":
            for number, line in zip(numbers, lines, strict=True):
                for word in line.split()[1:]:
                    pose_id = self._id(number, word)
                    self.fixed.append((pose_id, number))
        elif tag == "PARAMS_SE3OFFSET":
            for number, line in zip(numbers, lines, strict=True):
                words = line.split()[2:8]
                if any(finite_number(self.path, number, word) for word in words):
                    self._offset_line = number
        elif tag.startswith("PARAMS_"):
            return
        elif self._skip_unknown:
            shown_tag = tag[:_SHOWN]
            count, first = self.unknown.get(shown_tag, (0, numbers[0]))
            self.unknown[shown_tag] = (count + len(numbers), first)
        else:
            known = f"{', '.join(TAGS)} and FIX"
            problem = (
                f"unknown tag {tag[:_SHOWN]!r}; supported are {known}: remove the line, "
                "or have such lines skipped with --skip-unknown"
            )
            raise self._error(numbers[0], problem)

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
        """All VERTEX or all EDGE lines in the order of the file.

        What was parsed of them is removed from `parsed`, so that it takes no memory any more.
        """
        kinds = {}
        for tag, kind in TAGS.items():
            if kind.d == d and kind.is_edge == is_edge:
                kinds[tag] = kind
        parts = []
        for tag, kind in kinds.items():
            parts += [_as_rows(kind, part) for part in self.parsed.pop(tag)]
        if not parts:
            kind = next(iter(kinds.values()))
            no_ids = np.zeros((0, kind.num_ids), dtype=np.int64)
            no_lines = np.zeros(0, dtype=np.int64)
            no_numbers = np.zeros((0, kind.num_numbers))
            none = _ParsedLines(no_lines, no_ids, no_numbers)
            parts = [_as_rows(kind, none)]
        fields = zip(*parts, strict=True)
        ids, numbers, lines, is_point = map(np.concatenate, fields)
        is_sorted = not (np.diff(lines) < 0).any()
        if is_sorted:
            return _Rows(ids, numbers, lines, is_point)
        order = np.argsort(lines)
        return _Rows(ids[order], numbers[order], lines[order], is_point[order])

    def dimension(self) -> int:
        """Dimension of the lines, 2 or 3.

        A FileFormatError where lines are of neither or of both, or measured by a sensor that is not
        at its pose.
        """
        tags_with_offset = [tag for tag, kind in TAGS.items() if kind.has_offset]
        uses_offset = any(self.parsed[tag] for tag in tags_with_offset)
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
        num_shared = len(shared_end.split())
        num_own = kind.num_numbers - num_shared
        ids_field = ("ids", "i8", (kind.num_ids,))
        numbers_field = ("numbers", "f8", (num_own,))
        row_type = np.dtype([("tag", "S20"), ids_field, numbers_field])
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
        repeated = shared.repeat(len(rows), axis=0)
        values = np.concatenate([rows["numbers"], repeated], axis=1)
        has_tag = rows["tag"] == written_tag.encode()
        if len(ids) != len(numbers) or not has_tag.all():
            return False
        is_finite = np.abs(values) <= LARGEST
        if (ids == WORLD_ID).any() or not is_finite.all():
            return False
        parsed = _ParsedLines(numbers, ids.copy(), values)
        self.parsed[tag].append(parsed)
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
        words_of_ids = words[: kind.num_ids]
        words_of_numbers = words[kind.num_ids :]
        for word in words_of_ids:
            self._id(number, word)
        for word in words_of_numbers:
            finite_number(self.path, number, word)
        expected = kind.num_ids + kind.num_numbers
        if len(words) == expected:
            return
        ids = "1 id" if kind.num_ids == 1 else f"{kind.num_ids} ids"
        cause = "the line is cut off" if len(words) < expected else "the line is too long"
        problem = (
            f"{tag} needs {ids} and {kind.num_numbers} numbers, {expected} in all, "
            f"found {len(words)}; {cause}: complete or remove it"
        )
        raise self._error(number, problem)

    def _id(self, line: int, word: str) -> int:
        """Id of a pose, which has 64 bits."""
        # int() also takes 1_000 and the digits of other scripts; number files do not.
        is_plain = word.isascii() and "_" not in word
        try:
            value = int(word if is_plain else "")
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
    num_with_offset = kind.num_ids + 1 + kind.num_numbers
    if kind.has_offset and len(words) == num_with_offset:
        words.pop(kind.num_ids)
    return words


def _as_rows(kind: Tag, part: _ParsedLines) -> _Rows:
    """Lines of a tag in the common form: edges of one pose are priors, which begin at the world."""
    ids_behind_world = np.insert(part.ids, 0, WORLD_ID, axis=1)
    last_two_ids = ids_behind_world[:, -2:]
    numbers = kind.rows(part.numbers)
    is_point = np.full(len(part.lines), kind.to_landmark)
    return _Rows(last_two_ids, numbers, part.lines, is_point)


def _landmarks(path: Path, vertices: _Rows, edges: _Rows) -> IntArray:
    """Ids of landmarks; a FileFormatError where one stands for a pose in another line."""
    vertex_ids = vertices.ids[:, 1]
    ids_of_vertices = vertex_ids[vertices.is_point]
    ids_of_edges = edges.ids[edges.is_point, 1]
    landmarks = np.unique(np.concatenate([ids_of_vertices, ids_of_edges]))
    is_posed_vertex = np.isin(vertex_ids, landmarks) & ~vertices.is_point
    # The first id of an edge is always that of a pose, the second one unless it ends at a point.
    never = np.zeros_like(edges.is_point)
    may_be_landmark = np.stack([never, edges.is_point], axis=1)
    is_posed_end = np.isin(edges.ids, landmarks) & ~may_be_landmark
    is_posed_edge = is_posed_end.any(axis=1)
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
    # The first and the last line are compared word by word, from the end on.
    first = lines[0].split(" ")[::-1]
    last = lines[-1].split(" ")[::-1]
    pairs = enumerate(zip(first, last, strict=False))
    differences = (place for place, (a, b) in pairs if a != b)
    count = next(differences, 0)
    shared_words = first[:count][::-1]
    shared_end = " " + " ".join(shared_words)
    num_shared = len(shared_end.split())
    if not 0 < num_shared <= most:
        return ""
    is_shared = all(line.endswith(shared_end) for line in lines)
    return shared_end if is_shared else ""


def _faults(file: G2OLines) -> Iterator[tuple[int, str]]:
    """Line and description of what the numbers of a file cannot be."""
    order = np.argsort(file.vertex_ids, kind="stable")
    steps = np.diff(file.vertex_ids[order])
    repeated = np.flatnonzero(steps == 0)
    if repeated.size:
        earlier = order[repeated[0]]
        later = order[repeated[0] + 1]
        first = f"(the first is line {file.vertex_lines[earlier]})"
        problem = f"a second VERTEX line of pose {file.vertex_ids[later]} {first}; remove one"
        yield int(file.vertex_lines[later]), problem
    ids_i, ids_j = file.edge_ids.T
    loops = ids_i == ids_j
    if loops.any():
        e = int(np.argmax(loops))
        problem = f"an edge from pose {ids_i[e]} to itself; remove it"
        yield int(file.edge_lines[e]), problem
    # Only the two blocks are checked: the precisions use nothing else, and the coupling blocks of
    # the public cubicle graph make 5,021 of its whole matrices indefinite.
    information = information_of(file.d, file.edges)
    is_zero = ~information.any(axis=(1, 2))
    if is_zero.any():
        e = int(np.argmax(is_zero))
        problem = "the information matrix is zero; the edge says nothing: remove it"
        yield int(file.edge_lines[e]), problem
    d = file.d
    translation_blocks = information[:, :d, :d]
    rotation_blocks = information[:, d:, d:]
    yield from _faults_of_blocks(file, "translation", translation_blocks)
    yield from _faults_of_blocks(file, "rotation", rotation_blocks)


def _faults_of_blocks(file: G2OLines, name: str, blocks: Array) -> Iterator[tuple[int, str]]:
    """Line and description of a block, (m, k, k), that is neither zero nor positive definite."""
    is_nonzero = blocks.any(axis=(1, 2))
    is_wrong = is_nonzero & ~_is_positive_definite(blocks)
    if is_wrong.any():
        e = int(np.argmax(is_wrong))
        smallest = np.linalg.eigvalsh(blocks[e])[0]
        problem = (
            f"{name} block of the information matrix is not positive definite "
            f"(smallest eigenvalue {smallest:.3g}); "
            "give the upper triangle row by row, or remove the line"
        )
        yield int(file.edge_lines[e]), problem


def _is_positive_definite(A: Array) -> BoolArray:
    """Whether matrices (m, k, k) are positive definite, (m,), beyond rounding and underflow."""
    diagonals = np.einsum("mkk->mk", A)
    is_positive = (diagonals > 1.0 / LARGEST).all(axis=1)
    is_positive[is_positive] = are_definite(A[is_positive], _SINGULAR)
    return np.asarray(is_positive)
