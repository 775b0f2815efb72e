"""Whether the files of a folder are of one graph: what is asked before they are joined.

In a folder of robots an id is the same pose in all files, an edge that stands in two files counts
once, and every robot has a file. The checks below ask where the lines speak against it. They take
the lines of files, or what robots with files of their own tell each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components

from pgo_models.errors import FileFormatError
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.g2o_parser import G2OLines
from pgo_models.graphs.g2o_rows import poses_of
from pgo_models.graphs.pose_graph import WORLD_ID, IntArray, edge_counts
from pgo_models.graphs.written_digits import WrittenDigits, within_printing

LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz"
LETTER_CODES = [ord(letter) for letter in LETTERS + "0123456789"]  # digits, too, name robots
LETTER_SHIFT = 56  # a GTSAM symbol is a letter in the top byte and an index below it
# A GTSAM LabeledSymbol has the label of its robot in the second byte. Symbols have no index so
# large.
LABEL_SHIFT = 48
# Numbers are nearly equal that may be one number, written with two digits or more: rounding to two
# digits changes a number by up to 5 %. Lengths are compared with the longer one, positions with the
# extent of their file, and angles with 1 rad.
_NEARLY = 0.05
TRUST = "add --trust-folder (trust_folder=True)"
OTHER_GRAPHS = "Files of several graphs are solved each on its own, or need ids of their own"
FILES_HERE = "only robots with a file here"  # what the name of a graph without absent robots says


@dataclass(frozen=True, eq=False)
class Rows:
    """VERTEX or EDGE lines of one file, or some of them.

    `scale` is the length by which positions or lengths of this file are taken to be small.
    """

    path: str
    lines: IntArray  # (n,)
    ids: IntArray  # (n,) of VERTEX lines, (n, 2) of EDGE lines
    numbers: Array  # (n, k): as in `G2OLines`
    scale: float
    digits: WrittenDigits  # of the file

    def some(self, chosen: IntArray | BoolArray | slice) -> Rows:
        """The chosen lines, by numbers, a mask or a slice."""
        return Rows(
            self.path,
            self.lines[chosen],
            self.ids[chosen],
            self.numbers[chosen],
            self.scale,
            self.digits,
        )


class Owners(NamedTuple):
    """Ids of poses, ascending, and which robot owns each, (n,) both."""

    ids: IntArray
    robots: IntArray

    def are_one(self, ends: IntArray) -> BoolArray:
        """Whether one robot owns both ends of edges, (m, 2), (m,)."""
        first, second = self.robots[np.searchsorted(self.ids, ends)].T
        return np.asarray(first == second)


class _Joined(NamedTuple):
    """Lines of several files, one file after the other."""

    file: IntArray  # (n,): number of the file
    row: IntArray  # (n,): place among the lines of its file
    ids: IntArray
    numbers: Array
    scale: Array  # (n,)
    units: Array  # (n, k): of the last digits of the numbers, 0 where they do not tell copies

    @classmethod
    def of(cls, files: Sequence[Rows]) -> _Joined:
        sizes = [len(rows.lines) for rows in files]
        return cls(
            np.repeat(np.arange(len(files)), sizes),
            np.concatenate([np.arange(size) for size in sizes]),
            np.concatenate([rows.ids for rows in files]),
            np.concatenate([rows.numbers for rows in files]),
            np.repeat([rows.scale for rows in files], sizes),
            np.concatenate([_units_of_copies(rows) for rows in files]),
        )

    def some(self, chosen: IntArray | BoolArray) -> _Joined:
        return _Joined(
            self.file[chosen],
            self.row[chosen],
            self.ids[chosen],
            self.numbers[chosen],
            self.scale[chosen],
            self.units[chosen],
        )


def _units_of_copies(rows: Rows) -> Array:
    if rows.digits.tell_copies:
        return rows.digits.units(rows.numbers)
    return np.zeros_like(rows.numbers)


def check_one_graph(files: Sequence[G2OLines]) -> None:
    """Raise a FileFormatError where files of a folder speak against being of one graph."""
    if len(files) == 1:
        return
    d = files[0].d
    _check_kinds(files)
    check_places(d, [placed_poses(file) for file in files])
    edges = [measured_edges(file) for file in files]
    check_measurements(d, edges, _first_owners(files))


def _first_owners(files: Sequence[G2OLines]) -> Owners:
    """The first file with a VERTEX line of every pose, or else the first that names it."""
    ids_of_files = [file.vertex_ids for file in files] + [file.edge_ids.ravel() for file in files]
    number = np.tile(np.arange(len(files)), 2)
    named_by = np.repeat(number, [len(ids) for ids in ids_of_files])
    ids, first = np.unique(np.concatenate(ids_of_files), return_index=True)
    return Owners(ids, named_by[first])


def absent_ids(files: Sequence[G2OLines]) -> IntArray:
    """Ids, ascending, of poses that belong to robots without a file.

    Edges name them, and no file has a VERTEX line of them, although each that names them has VERTEX
    lines of other poses. Where files have no VERTEX lines, nothing says whose a pose is.
    """
    ids_of_edges = [np.unique(file.edge_ids) for file in files]
    has_vertices = [len(file.vertex_ids) > 0 for file in files]
    placed = [file.vertex_ids for file in files]
    # A file without VERTEX lines places all that it names.
    placed += [ids for ids, places in zip(ids_of_edges, has_vertices, strict=True) if not places]
    named = np.unique(np.concatenate(ids_of_edges))
    absent = np.setdiff1d(named, np.concatenate(placed))
    return np.asarray(absent[absent != WORLD_ID])


def _check_kinds(files: Sequence[G2OLines]) -> None:
    """Raise a FileFormatError where an id is a landmark in one file and a pose in another."""
    landmarks = np.concatenate([file.landmarks for file in files])
    for file in files:
        named = [(file.vertex_ids, file.vertex_lines)]
        named += [(ends, file.edge_lines) for ends in file.edge_ids.T]
        for ids, lines in named:
            is_both = np.isin(ids, landmarks) & ~np.isin(ids, file.landmarks)
            if is_both.any():
                first = int(np.argmax(is_both))
                problem = (
                    f"{ids[first]} is a pose here and a landmark in another file; "
                    "give landmarks ids of their own, or solve each file on its own"
                )
                raise FileFormatError(file.path, int(lines[first]), problem)


def robot_letters(ids: IntArray) -> tuple[IntArray, int]:
    """Codes of the letters that may name robots in ids of poses, and how many bits are below them.

    They are the labels where all ids are LabeledSymbols, and else the top bytes.
    """
    letters = ids >> LETTER_SHIFT
    labels = (ids >> LABEL_SHIFT) & 0xFF
    if len(ids) and np.isin(letters, LETTER_CODES).all() and np.isin(labels, LETTER_CODES).all():
        return labels, LABEL_SHIFT
    return letters, LETTER_SHIFT


def placed_poses(file: G2OLines) -> Rows:
    """VERTEX lines of a file, without those of neighbours.

    The letter of a GTSAM symbol names the robot that owns a pose. If all ids are symbols, the file
    belongs to the letter on most lines. Its lines of other letters are estimates of neighbours,
    maybe in another frame, and the files of these neighbours place the poses. Other ids name no
    robot. Two files that place one of them differently may mean two poses. (No public folder known
    has two VERTEX lines of a pose.)
    """
    _, t = poses_of(file.d, file.vertices)
    extent = float(np.ptp(t, axis=0).max()) if len(t) else 0.0
    if extent == 0.0:
        extent = float(np.abs(t).max(initial=0.0))
    rows = Rows(
        str(file.path), file.vertex_lines, file.vertex_ids, file.vertices, extent, file.digits
    )
    letters, _ = robot_letters(file.vertex_ids)
    if len(letters) == 0 or not np.isin(letters, LETTER_CODES).all():
        return rows
    own_letter = np.bincount(letters).argmax()
    return rows.some(letters == own_letter)


def edge_rows(file: G2OLines) -> Rows:
    """EDGE lines of a file."""
    is_measured = file.edge_ids[:, 0] != WORLD_ID
    lengths = np.linalg.norm(file.edges[is_measured, : file.d], axis=1)
    usual = float(np.median(lengths)) if len(lengths) else 0.0
    return Rows(str(file.path), file.edge_lines, file.edge_ids, file.edges, usual, file.digits)


def measured_edges(file: G2OLines) -> Rows:
    """EDGE lines of a file without priors: two fixes of one pose are two measurements."""
    return edge_rows(file).some(file.edge_ids[:, 0] != WORLD_ID)


def edges_as_first_printed(d: int, files: Sequence[Rows]) -> list[Rows]:
    """The same edges, of which all that are one within printing have the numbers of the first.

    Two lines are one edge within printing if they join the same poses, stand in different files,
    and all their numbers are one within printing: see `pgo_models.graphs.written_digits`. A
    quaternion may have the other sign, and an angle be another by 2 pi.
    """
    lines = _in_two_files(_Joined.of(files))
    earlier, later = _pairs_of_rows(lines)
    is_other_file = lines.file[earlier] != lines.file[later]
    earlier = earlier[is_other_file]
    later = later[is_other_file]
    x = lines.numbers[earlier]
    y = _as_written_beside(d, lines.numbers[later], x)
    are_one = within_printing(x, y, lines.units[earlier], lines.units[later]).all(axis=1)
    if (x == y).all(axis=1)[are_one].all():
        return list(files)
    one = edge_counts(earlier[are_one], later[are_one], len(lines.file))
    _, label = connected_components(one, directed=False)
    _, first = np.unique(label, return_index=True)
    numbers = [rows.numbers.copy() for rows in files]
    for line in np.flatnonzero(first[label] != np.arange(len(label))).tolist():
        numbers[lines.file[line]][lines.row[line]] = lines.numbers[first[label[line]]]
    return [replace(rows, numbers=of_file) for rows, of_file in zip(files, numbers, strict=True)]


def are_reprinted(rows: Rows, as_first: Rows) -> BoolArray:
    """Which edges have other digits than where they are first printed, (n,)."""
    return np.asarray((rows.numbers != as_first.numbers).any(axis=1))


def copies_within_printing(num_copies: int) -> str:
    """What is said of the edges of a folder that are printed twice."""
    return (
        f"{num_copies} edges of two files differ in no more than the last printed digit: "
        "each counts once, as first printed"
    )


def _as_written_beside(d: int, numbers: Array, others: Array) -> Array:
    """The numbers, with angles less than half a turn, and quaternions less than 90 degrees, off."""
    numbers = numbers.copy()
    if d == 2:
        turns = np.rint((others[:, 2] - numbers[:, 2]) / (2.0 * np.pi))
        numbers[:, 2] += 2.0 * np.pi * turns
        return numbers
    is_opposite = (numbers[:, 3:7] * others[:, 3:7]).sum(axis=1) < 0.0
    numbers[is_opposite, 3:7] *= -1.0
    return numbers


def check_places(d: int, files: Sequence[Rows]) -> None:
    """Raise a FileFormatError where two files place the pose of one id differently.

    `files` are `placed_poses`, or some of each. Nearly equal estimates are of one pose.
    """
    lines = _Joined.of(files)
    order = np.lexsort([lines.file, lines.ids])
    lines = lines.some(order)
    _, first, pose = np.unique(lines.ids, return_index=True, return_inverse=True)
    reference = first[pose.ravel()]
    again = np.flatnonzero(lines.file != lines.file[reference])
    apart, turned = _differences(d, lines.numbers[again], lines.numbers[reference[again]])
    differs = (apart > _NEARLY * lines.scale[reference[again]]) | (turned > _NEARLY)
    if not differs.any():
        return
    index = int(np.argmax(differs))
    first_one = again[index]
    place = _place(files, lines, reference[first_one])
    problem = (
        f"pose {lines.ids[first_one]} is elsewhere than at {place}, {apart[index]:.3g} away and "
        f"turned by {np.rad2deg(turned[index]):.3g} degrees; of the {len(again)} poses that two "
        f"files place, {differs.sum()} are in two places. {OTHER_GRAPHS}; if these are estimates "
        f"of the same poses, {TRUST}"
    )
    _refuse(files, lines, first_one, problem)


def check_measurements(d: int, files: Sequence[Rows], owners: Owners) -> None:
    """Raise a FileFormatError where two files measure the same edge with different numbers.

    `files` are `measured_edges`, or some of each. Copies with the same numbers, within printing,
    count once and are no question; nor is an edge that one file measures several times. There is
    one

    - where numbers of two files are nearly equal: one has a copy of the other's edge, rounded or
      recomputed, which would count twice, or both measured it, and both count;
    - where they differ on the step from an id to the next of one robot, which is its odometry: the
      ids are then of two graphs. Other edges may be measured by both robots that they join;
    - where most edges that two files measure are off by more than their own length, or by more than
      1 rad: one may be a wrong closure, and most are edges of another graph.
    """
    lines = _in_two_files(_Joined.of(edges_as_first_printed(d, files)))
    lines, in_files = _distinct(lines, len(files))
    earlier, later = _pairs_of_rows(lines)
    # Two measurements that one file has, too, are measurements of their own.
    are_apart = ~(in_files[earlier] & in_files[later]).any(axis=1)
    earlier = earlier[are_apart]
    later = later[are_apart]
    apart, turned = _differences(d, lines.numbers[earlier], lines.numbers[later])
    lengths = np.linalg.norm(lines.numbers[:, :d], axis=1)
    scale = np.maximum(np.maximum(lengths, lines.scale)[earlier], lengths[later])
    is_copy = (apart <= _NEARLY * scale) & (turned <= _NEARLY)
    is_next = np.abs(np.diff(lines.ids[later], axis=1)).ravel() == 1
    is_step = is_next & owners.are_one(lines.ids[later])
    is_far = (apart > scale) | (turned > 1.0)
    contradicts = (is_step & ~is_copy) | (is_far & (2 * is_far.sum() > len(is_far)))
    if contradicts.sum() > is_copy.sum():
        index = int(np.argmax(contradicts))
        i, j = lines.ids[later[index]]
        problem = (
            f"the edge from {i} to {j} is another than at "
            f"{_place(files, lines, earlier[index])}: {apart[index]:.3g} away and turned by "
            f"{np.rad2deg(turned[index]):.3g} degrees; two files differ so on {contradicts.sum()} "
            f"edges. {OTHER_GRAPHS}; if both are measurements of one edge, {TRUST}"
        )
        _refuse(files, lines, later[index], problem)
    if is_copy.any():
        _refuse_copies(files, lines, earlier[is_copy], later[is_copy])


def _refuse_copies(
    files: Sequence[Rows], lines: _Joined, earlier: IntArray, later: IntArray
) -> None:
    """Raise a FileFormatError for nearly equal edges: of the file that has most of them."""
    copies = np.unique(later)
    file = int(np.bincount(lines.file[copies]).argmax())
    num_copies = int((lines.file[copies] == file).sum())
    index = int(np.argmax(lines.file[later] == file))
    i, j = lines.ids[later[index]]
    problem = (
        f"the edge from {i} to {j} is nearly that at {_place(files, lines, earlier[index])}; "
        f"{num_copies} edges of this file are nearly edges of others. Copies would count twice: "
        f"remove them, or the file; if they are measurements of their own, {TRUST}"
    )
    _refuse(files, lines, later[index], problem)


def _refuse(files: Sequence[Rows], lines: _Joined, row: int, problem: str) -> None:
    rows = files[lines.file[row]]
    raise FileFormatError(rows.path, int(rows.lines[lines.row[row]]), problem)


def _place(files: Sequence[Rows], lines: _Joined, row: int) -> str:
    """`file:line` of a row."""
    rows = files[lines.file[row]]
    return f"{rows.path}:{rows.lines[lines.row[row]]}"


def _in_two_files(lines: _Joined) -> _Joined:
    """The lines whose ids stand in several files, sorted by ids and then by file."""
    lines = lines.some(np.lexsort([lines.row, lines.file, lines.ids[:, 1], lines.ids[:, 0]]))
    edge = _edge_numbers(lines)
    if not len(edge):
        return lines
    first_file = np.full(edge[-1] + 1, len(lines.file))
    last_file = np.full(edge[-1] + 1, -1)
    np.minimum.at(first_file, edge, lines.file)
    np.maximum.at(last_file, edge, lines.file)
    return lines.some((first_file < last_file)[edge])


def _edge_numbers(lines: _Joined) -> IntArray:
    """Number of the pair of ids of every line, (n,), of lines sorted by ids."""
    is_new = (np.diff(lines.ids, axis=0) != 0).any(axis=1)
    return np.cumsum(np.append(False, is_new))[: len(lines.file)]


def _distinct(lines: _Joined, num_files: int) -> tuple[_Joined, BoolArray]:
    """The first of all lines with the same ids and numbers, and which files have it, (n, files)."""
    row_of: dict[bytes, int] = {}
    positive_zeros = lines.numbers + 0.0  # as in `edge_rows_to_keep`
    in_files = np.zeros((len(lines.file), num_files), dtype=bool)
    rows = zip(lines.ids, positive_zeros, lines.file.tolist(), strict=True)
    for row, (ids, numbers, file) in enumerate(rows):
        first = row_of.setdefault(ids.tobytes() + numbers.tobytes(), row)
        in_files[first, file] = True
    first_rows = np.array(list(row_of.values()), dtype=np.int64)
    return lines.some(first_rows), in_files[first_rows]


def _pairs_of_rows(lines: _Joined) -> tuple[IntArray, IntArray]:
    """All pairs of rows with the same ids, of lines sorted by ids."""
    edge = _edge_numbers(lines)
    most = int(np.bincount(edge).max(initial=0))  # lines with the same ids
    earlier = [np.zeros(0, dtype=np.int64)]
    later = [np.zeros(0, dtype=np.int64)]
    for step in range(1, most):
        first = np.flatnonzero(edge[step:] == edge[:-step])
        earlier.append(first)
        later.append(first + step)
    return np.concatenate(earlier), np.concatenate(later)


def _differences(d: int, first: Array, second: Array) -> tuple[Array, Array]:
    """Distances (n,) and angles (n,), rad, between the poses that rows of numbers open with."""
    first_R, first_t = poses_of(d, first)
    second_R, second_t = poses_of(d, second)
    apart = np.linalg.norm(first_t - second_t, axis=1)
    # ||R - R'||_F = 2 sqrt(2) sin(angle / 2)
    chord = np.linalg.norm(first_R - second_R, axis=(1, 2)) / np.sqrt(8.0)
    return apart, 2.0 * np.arcsin(np.minimum(chord, 1.0))
