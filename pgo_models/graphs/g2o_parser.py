"""The lines of one g2o file as arrays, every fault named by file:line; their tags are in `g2o_tags`.

The way through a sound file is short: blocks of some megabytes, whose lines of a tag are parsed by one call. Only when
that fails are the lines looked at one by one, to name the one that is wrong.
"""

import warnings
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from operator import methodcaller
from pathlib import Path
from typing import NoReturn

import numpy as np

from pgo_models.errors import FileFormatError, GraphWarning
from pgo_models.files import LARGEST, LONGEST, check_length, check_metres, check_quaternions, finite_number, read_blocks
from pgo_models.geometry.arrays import triangle_places
from pgo_models.geometry.rotations import Array, BoolArray, exp_map, rotations_from_quaternions
from pgo_models.graphs.g2o_tags import ALIASES, TAGS
from pgo_models.graphs.pose_graph import WORLD_ID, IntArray
from pgo_models.graphs.precisions import are_definite

_LONG_RUN = 16  # lines of one tag, from which on they are not sorted by it one by one
_SINGULAR = 1e-15  # an eigenvalue below it, of a matrix with ones on its diagonal, is rounding


@dataclass(frozen=True, eq=False)
class G2OLines:
    """What one g2o file says, in the order of its lines, which count from 1."""

    path: Path
    d: int  # 2 or 3
    vertex_ids: IntArray  # (v,): of the VERTEX lines
    vertex_lines: IntArray  # (v,): lines that they stand on
    vertices: Array  # (v, 3) or (v, 7): x y theta, or x y z qx qy qz qw
    edge_ids: IntArray  # (m, 2): `WORLD_ID` and the pose, of a prior
    # (m, 9) or (m, 28): the measurement like a vertex, then the upper triangle of its information matrix, row by row.
    edges: Array
    edge_lines: IntArray  # (m,)
    fixed: IntArray  # (f,): ids of the FIX lines
    fixed_lines: IntArray  # (f,)
    landmarks: IntArray  # (l,): ids that some line says are of a point


def read_lines(path: Path | str, skip_unknown: bool = False) -> G2OLines:
    """Read and check the lines of one g2o file; blank lines, comments (#) and PARAMS_ lines are skipped.

    With `skip_unknown`, so are lines with unknown tags, and a `GraphWarning` says how many of each. A FileFormatError
    with file:line, for: a file that is missing, binary or without VERTEX and EDGE lines; an unknown tag; too few or too
    many numbers on a line, or thousands of them; a word, nan or inf where a number belongs; an id that is no integer of
    64 bits; a zero quaternion; a length beyond `FARTHEST`; an information matrix whose translation or rotation block is
    not positive definite, nor zero, or both are zero; an edge to itself; a second VERTEX line of an id; a measurement
    in the frame of a sensor that is not that of the pose; an edge from a landmark, or of its rotation; 2D beside 3D.
    """
    path = Path(path)
    source, first = _Source(path, skip_unknown), 1
    for block in read_blocks(path):
        first += source.take(first, block.removesuffix("\n").split("\n"))
    if source.unknown:
        said = ", ".join(f"{count} of {tag} (first: line {at})" for tag, (count, at) in source.unknown.items())
        warnings.warn(f"{path}: lines with unknown tags were skipped: {said}", GraphWarning, stacklevel=2)
    d = source.dimension()
    vertex_ids, vertices, vertex_lines, is_point = source.joined(d, is_edge=False)
    edge_ids, edges, edge_lines, to_point = source.joined(d, is_edge=True)
    landmarks = np.unique(np.concatenate([vertex_ids[is_point, 1], edge_ids[to_point, 1]]))
    is_posed = np.isin(edge_ids, landmarks) & ~np.stack([np.zeros_like(to_point), to_point], axis=1)
    posed = [*vertex_lines[np.isin(vertex_ids[:, 1], landmarks) & ~is_point], *edge_lines[is_posed.any(axis=1)]]
    if posed:
        problem = "a pose, or an edge of poses, with the id of a landmark, which is a point; renumber one of them"
        raise FileFormatError(path, int(min(posed)), problem)
    fixed, fixed_lines = np.array(source.fixed, dtype=np.int64).reshape(-1, 2).T
    of_poses, of_edges = (vertex_ids[:, 1], vertex_lines, vertices), (edge_ids, edges, edge_lines)
    found = G2OLines(path, d, *of_poses, *of_edges, fixed, fixed_lines, landmarks)
    for rows, at in ((vertices, found.vertex_lines), (edges, found.edge_lines)):
        check_metres(path, at, rows[:, :d])
        if d == 3:
            check_quaternions(path, at, rows[:, 3:7])
    for number, problem in _faults(found):
        raise FileFormatError(path, number, problem)
    return found


def poses_of(d: int, numbers: Array) -> tuple[Array, Array]:
    """Rotations (n, d, d) and translations (n, d) of rows that open with x y theta, or x y z qx qy qz qw."""
    if d == 2:
        return exp_map(numbers[:, 2:3]), numbers[:, :2].copy()
    return rotations_from_quaternions(numbers[:, 3:7]), numbers[:, :3].copy()


def information_of(d: int, edges: Array) -> Array:
    """Information matrices (m, k, k) of EDGE rows, k = 3 in the plane and 6 in space."""
    k, first = (3, 3) if d == 2 else (6, 7)
    return np.asarray(edges[:, first + triangle_places(k)])


class _Source:
    """What the lines of a file say so far: parsed tag by tag, and when that fails, one by one to say which is wrong."""

    def __init__(self, path: Path, skip_unknown: bool) -> None:
        self.path, self._skip_unknown = path, skip_unknown
        self.parsed: dict[str, list[tuple[IntArray, IntArray, Array]]] = {tag: [] for tag in TAGS}
        self.fixed: list[tuple[int, int]] = []  # a pose and its line
        self.unknown: dict[str, tuple[int, int]] = {}  # how many lines, and the first
        self._offset = 0  # line of a sensor that is not at its pose

    def take(self, first: int, lines: list[str]) -> int:
        """Parse lines, of which the first has that number, and return how many they are."""
        done = 0
        while done < len(lines):  # runs of lines of one tag, whose ends are found by bisection
            tag = "".join(lines[done].split(None, 1)[:1])
            end = bisect_left(lines, True, done, key=lambda line: not line.startswith(tag))
            is_run = tag in TAGS and not TAGS[tag].has_offset and end - done >= _LONG_RUN
            if not (is_run and self._parse(tag, np.arange(first + done, first + end), lines[done:end])):
                break
            done = end
        groups: dict[str, list[int]] = {}
        for place, line in enumerate(lines[done:], done):
            if words := line.split(None, 1):
                groups.setdefault(words[0], []).append(place)
        for tag, at in groups.items():
            numbers, mine = np.array(at) + first, [lines[place] for place in at]
            if (known := ALIASES.get(tag, tag)) in TAGS:
                if TAGS[known].has_offset:
                    mine = [" ".join([tag, *self._words(known, line)]) for line in mine]
                if not self._parse(known, numbers, mine, tag):
                    self._diagnose(known, numbers.tolist(), mine)
            elif not tag.startswith("#"):
                self._take_other(tag, numbers.tolist(), mine)
        return len(lines)

    def joined(self, d: int, is_edge: bool) -> tuple[IntArray, Array, IntArray, BoolArray]:
        """Ids (n, 2), rows, lines and whether they are of landmarks, of all VERTEX or all EDGE lines, line by line."""
        wanted = [tag for tag, kind in TAGS.items() if (kind.d, kind.is_edge) == (d, is_edge)]
        found = [(TAGS[tag], *part) for tag in wanted for part in self.parsed.pop(tag)]
        kind, none = TAGS[wanted[0]], np.zeros(0, dtype=np.int64)
        found = found or [(kind, none, none.reshape(0, kind.num_ids), np.zeros((0, kind.num_numbers)))]
        lines = np.concatenate([at for _, at, _, _ in found])
        ids = np.concatenate([np.insert(own, 0, WORLD_ID, axis=1)[:, -2:] for _, _, own, _ in found])
        rows = np.concatenate([kind.rows(own) for kind, _, _, own in found])
        points = np.repeat([kind.to_landmark for kind, *_ in found], [len(at) for _, at, _, _ in found])
        order = np.argsort(lines) if (np.diff(lines) < 0).any() else slice(None)
        return ids[order], rows[order], lines[order], points[order]

    def dimension(self) -> int:
        """2 or 3; a FileFormatError where lines are of neither, or of both, or measured by a sensor off its pose."""
        if self._offset and any(self.parsed[tag] for tag, kind in TAGS.items() if kind.has_offset):
            problem = "a sensor that is not at its pose; give what it measured in the frame of the pose"
            raise self._error(self._offset, f"{problem}, without this line")
        at = [(part[0][0], TAGS[tag].d) for tag, parts in self.parsed.items() for part in parts]
        first = {d: min((line for line, of in at if of == d), default=0) for d in (2, 3)}
        if not first[2] and not first[3]:
            problem = f"no measurement in it; a pose graph needs lines of {' or '.join(TAGS)}"
            raise FileFormatError(self.path, None, problem)
        if first[2] and first[3]:
            other = f"(the other kind is on line {min(first.values())})"
            raise self._error(max(first.values()), f"2D and 3D lines in one file {other}; give one file for each")
        return 2 if first[2] else 3

    def _parse(self, tag: str, at: IntArray, lines: list[str], written: str = "") -> bool:
        """Whether lines are all of one tag, which may be written as its alias, with ids and finite numbers; keep."""
        kind = TAGS[tag]
        if max(map(len, lines)) > LONGEST:
            return False
        shared = _shared_end(lines, kind.num_numbers - 1)
        own = kind.num_numbers - len(shared.split())
        row = np.dtype([("tag", "S20"), ("ids", "i8", (kind.num_ids,)), ("numbers", "f8", (own,))])
        try:
            with warnings.catch_warnings(action="error", category=DeprecationWarning):  # of an id like 1.0
                found = np.loadtxt([line.removesuffix(shared) for line in lines], comments=None, ndmin=1, dtype=row)
            same = np.loadtxt([shared], comments=None, ndmin=2) if shared else np.zeros((1, 0))
        except (ValueError, DeprecationWarning):
            return False
        ids, numbers = found["ids"], np.concatenate([found["numbers"], same.repeat(len(found), axis=0)], axis=1)
        is_sound = len(ids) == len(at) and (found["tag"] == (written or tag).encode()).all()
        if not is_sound or (ids == WORLD_ID).any() or not (np.abs(numbers) <= LARGEST).all():
            return False
        self.parsed[tag].append((at, ids.copy(), numbers))
        return True

    def _take_other(self, tag: str, at: list[int], lines: list[str]) -> None:
        """Take lines of a tag that is no measurement's."""
        for number, line in zip(at, lines, strict=True):
            words = line.split()
            if tag == "FIX":
                self.fixed += [(self._integer(number, word), number) for word in words[1:]]
            elif tag == "PARAMS_SE3OFFSET":
                if any(finite_number(self.path, number, word) for word in words[2:8]):
                    self._offset = number
            elif not self._skip_unknown and not tag.startswith("PARAMS_"):
                problem = f"unknown tag {tag[:40]!r}; supported are {', '.join(TAGS)} and FIX: remove the line"
                raise self._error(number, f"{problem}, or have such lines skipped with --skip-unknown")
        if self._skip_unknown and tag != "FIX" and not tag.startswith("PARAMS_"):
            count, earliest = self.unknown.get(tag[:40], (0, at[0]))
            self.unknown[tag[:40]] = count + len(at), earliest

    def _words(self, tag: str, line: str) -> list[str]:
        """Ids and numbers on a line, without the id of an offset."""
        kind, words = TAGS[tag], line.split()[1:]
        if kind.has_offset and len(words) == kind.num_ids + 1 + kind.num_numbers:
            words.pop(kind.num_ids)
        return words

    def _integer(self, line: int, word: str) -> int:
        """Id of 64 bits."""
        try:
            # int() also takes 1_000 and the digits of other scripts; number files do not.
            value = int(word if word.isascii() and "_" not in word else "")
        except ValueError:
            raise self._error(line, f"id {word[:40]!r} is no integer; number the poses") from None
        if not -(2**63) <= value < WORLD_ID:
            raise self._error(
                line, f"id {word[:40]} does not fit 64 bits, less one that stands for the world; renumber the poses"
            )
        return value

    def _diagnose(self, tag: str, at: list[int], lines: list[str]) -> NoReturn:
        kind = TAGS[tag]
        for number, line in zip(at, lines, strict=True):
            check_length(self.path, number, line)
            words = self._words(tag, line)
            for word in words[: kind.num_ids]:
                self._integer(number, word)
            for word in words[kind.num_ids :]:
                finite_number(self.path, number, word)
            expected = kind.num_ids + kind.num_numbers
            if len(words) != expected:
                few = "the line is cut off" if len(words) < expected else "the line is too long"
                needed = f"{kind.num_ids} id{'s' * (kind.num_ids > 1)} and {kind.num_numbers} numbers"
                problem = f"{tag} needs {needed}, {expected} in all, found {len(words)}; {few}: complete or remove it"
                raise self._error(number, problem)
        raise self._error(at[0], f"the {tag} lines cannot be read; write numbers like 1.5e-3, separated by blanks")

    def _error(self, line: int, problem: str) -> FileFormatError:
        return FileFormatError(self.path, line, problem)


def _shared_end(lines: list[str], most: int) -> str:
    """Words that all lines end with, as information matrices are often the same; nothing where they are over `most`."""
    first, last = (line.split(" ")[::-1] for line in (lines[0], lines[-1]))
    count = next((k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), 0)
    shared = " " + " ".join(first[:count][::-1])
    return shared if 0 < len(shared.split()) <= most and all(map(methodcaller("endswith", shared), lines)) else ""


def _faults(found: G2OLines) -> Iterator[tuple[int, str]]:
    """Line and description of what the numbers of a file cannot be."""
    order = np.argsort(found.vertex_ids, kind="stable")
    again = np.flatnonzero(np.diff(found.vertex_ids[order]) == 0)
    if again.size:
        earlier, later = order[again[0]], order[again[0] + 1]
        first = f"(the first is line {found.vertex_lines[earlier]})"
        problem = f"a second VERTEX line of pose {found.vertex_ids[later]} {first}; remove one"
        yield int(found.vertex_lines[later]), problem
    loops = found.edge_ids[:, 0] == found.edge_ids[:, 1]
    if loops.any():
        at = int(np.argmax(loops))
        yield int(found.edge_lines[at]), f"an edge from pose {found.edge_ids[at, 0]} to itself; remove it"
    # The blocks alone are asked for: the precisions use nothing else, and the coupling blocks of the public cubicle
    # graph make 5,021 of its whole matrices indefinite.
    information = information_of(found.d, found.edges)
    empty = ~information.any(axis=(1, 2))
    if empty.any():
        at = int(np.argmax(empty))
        yield int(found.edge_lines[at]), "the information matrix is zero; the edge says nothing: remove it"
    for name, block in (("translation", slice(None, found.d)), ("rotation", slice(found.d, None))):
        bad = information[:, block, block].any(axis=(1, 2)) & ~_is_positive_definite(information[:, block, block])
        if bad.any():
            at = int(np.argmax(bad))
            smallest = np.linalg.eigvalsh(information[at, block, block])[0]
            indefinite = f"information matrix is not positive definite (smallest eigenvalue {smallest:.3g})"
            way_out = "give the upper triangle row by row, or remove the line"
            yield int(found.edge_lines[at]), f"{name} block of the {indefinite}; {way_out}"


def _is_positive_definite(A: Array) -> BoolArray:
    """Whether every (k, k) matrix of a stack is positive definite, (m,), beyond rounding and underflow."""
    positive = (np.einsum("mkk->mk", A) > 1.0 / LARGEST).all(axis=1)
    positive[positive] = are_definite(A[positive], _SINGULAR)
    return np.asarray(positive)
