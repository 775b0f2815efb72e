"""g2o files, one for all robots or a folder with one for each, as a PoseGraph and back.

Information matrices become the precisions of SE-Sync (Rosen et al. 2019), see `edge_precisions`.
"""

import os
import re
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pgo_models.errors import FileFormatError, GraphError, GraphWarning, PGOError
from pgo_models.files import check_writable, replace_when_done
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, log_map, quaternions_from_rotations
from pgo_models.graphs.g2o_parser import G2OLines, information_of, poses_of, read_lines
from pgo_models.graphs.g2o_tags import TAGS
from pgo_models.graphs.measurements import IntArray, isotropic_information
from pgo_models.graphs.pose_graph import WORLD_ID, PoseGraph
from pgo_models.graphs.precisions import RotationWeight, edge_precisions

_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz"
MOST_SYMBOLS = len(_LETTERS)  # robots whose poses can be named by GTSAM symbols
_ROWS = 2**14  # that are made text at a time
_LETTER_SHIFT = 56  # a GTSAM symbol is a letter in the top byte and an index below it


def read_g2o(
    path: Path | str, weights: RotationWeight = RotationWeight.SE_SYNC, *, skip_unknown: bool = False
) -> PoseGraph:
    """Pose graph of a g2o file, or of a folder with one g2o file for each robot.

    Read are FIX lines and those of `g2o_tags`: poses, landmarks, priors. Poses are numbered by ascending id, the world
    pose of priors last. Quaternions are normalised, repeated edges all count. `initial` is set when every pose has a
    VERTEX line; edges to poses without one are accepted, and leave it out.

    Robots. When every id is a GTSAM symbol (a letter in the top byte), the rank of its letter is the robot. Otherwise a
    pose of a folder belongs to the file with its VERTEX line, the first of them in the order 0, 1, .., 9, 10, or else
    to the first file that names it. An edge that stands in two files of a folder is one measurement, and the VERTEX
    line that counts is that of the pose's own robot. A file beside those of two robots or more whose edges are those of
    all others once more, under the same ids or others, is the whole graph, no robot: a `GraphWarning` names it, and it
    is left out (`fullGraph.g2o` of distributed-mapper's folders).

    Translations are in the file's unit, taken as metres, and `information` is as in the file; what kappa becomes of it
    in the plane is said by `weights`. With `skip_unknown`, lines with other tags are skipped with a warning.

    A FileFormatError as of `read_lines`; also for a folder without g2o files, no edges, or FIX of an unknown pose.

    Examples
    --------
    >>> from pgo_models.graphs.datasets import locate
    >>> read_g2o(locate("grid"))
    PoseGraph('grid', d=3, poses=27, edges=108, robots=1)
    """
    path = Path(path)
    files = _robots_files([read_lines(file, skip_unknown) for file in g2o_files(path)])
    for file in files[1:]:
        if file.d != files[0].d:
            raise FileFormatError(file.path, None, f"{file.d}D, but {files[0].path} is {files[0].d}D; part the folder")
    d = files[0].d
    parts = [(file.edge_ids[kept], file.edges[kept]) for file, kept in zip(files, _join_edges(files), strict=True)]
    edge_ids, rows = map(np.concatenate, zip(*parts, strict=True))
    if not len(rows):
        raise FileFormatError(path, None, "no edges; a pose graph needs at least one EDGE_SE2 or EDGE_SE3:QUAT line")
    ids = np.sort(np.concatenate([edge_ids.ravel(), *(file.vertex_ids for file in files)]))
    ids = ids[np.append(True, np.diff(ids) != 0)]  # numpy.unique takes ten times as long
    named = ids[ids != WORLD_ID]  # the largest number there is
    robot = _robots(named, files)
    information = information_of(d, rows)
    kappa, tau = edge_precisions(information, weights)
    both, initial = np.searchsorted(ids, edge_ids), _initial(named, robot, files)
    world = len(named) if len(named) < len(ids) else None
    if world is not None and robot is not None:
        robot = np.append(robot, robot[both[np.argmax(both[:, 0] == world), 1]])
    name, fixed = _name_of(path), _fixed(ids, files)
    landmarks = np.flatnonzero(np.isin(ids, np.concatenate([file.landmarks for file in files])))
    measured = both[:, 0], both[:, 1], *poses_of(d, rows), kappa, tau, information
    return PoseGraph(len(ids), *measured, ids, robot, initial, fixed=fixed, name=name, world=world, landmarks=landmarks)


def edge_places(path: Path | str) -> list[str]:
    """`file:line` of every edge of the graph that `read_g2o` has read from a file or folder."""
    files = _robots_files([read_lines(file, skip_unknown=True) for file in g2o_files(Path(path))])
    kept = zip(files, _join_edges(files), strict=True)
    return [f"{file.path}:{line}" for file, rows in kept for line in file.edge_lines[rows]]


def read_g2o_poses(path: Path | str, graph: PoseGraph) -> Poses:
    """Poses of the VERTEX lines of a g2o file, in the order of `graph`; the file needs no edges.

    A FileFormatError as of `read_lines`; also when the file has another dimension, or a pose of the graph is not in it.
    """
    file = read_lines(path)
    if file.d != graph.d:
        raise FileFormatError(path, None, f"{file.d}D, but {graph.name} is {graph.d}D; give poses of this graph")
    ids = graph.pose_ids[graph.in_files]
    absent = ~np.isin(ids, file.vertex_ids)
    if absent.any():
        first = ids[np.argmax(absent)]
        raise FileFormatError(path, None, f"no VERTEX line for pose {first} ({absent.sum()} missing); add it")
    order = np.argsort(file.vertex_ids)
    at = order[np.searchsorted(file.vertex_ids[order], ids)]
    return graph.completed(Poses(*poses_of(file.d, file.vertices[at])))


def write_g2o(graph: PoseGraph, path: Path | str, poses: Poses | None = None, mine: BoolArray | None = None) -> None:
    """Write VERTEX lines (of `poses`, else of `graph.initial`, else none), FIX lines and EDGE lines to one file.

    Numbers are written so that reading gives the same floats. Without `graph.information` the matrices are
    tau I, 2 kappa I in space and diag(tau, tau, kappa) in the plane, which read back as the same kappa and tau
    (RotationWeight.SE_SYNC). VERTEX and FIX lines are of `mine`, (n,), alone, if given. A GraphError when `poses` do
    not have the size of the graph, a PGOError when the file cannot be written; what stood there stays.

    Examples
    --------
    >>> import tempfile
    >>> from pgo_models.graphs.scenes import grid
    >>> path = Path(tempfile.mkdtemp()) / "grid.g2o"
    >>> write_g2o(grid(np.random.default_rng(0)), path)
    >>> path.read_text().split()[0]
    'VERTEX_SE3:QUAT'
    """
    every = np.ones(graph.num_edges, dtype=bool)
    mine = np.ones(graph.num_poses, dtype=bool) if mine is None else mine
    _write(graph, Path(path), _poses_to_write(graph, poses), mine, every)


def write_g2o_folder(graph: PoseGraph, folder: Path | str, poses: Poses | None = None) -> None:
    """Write one file 0.g2o, 1.g2o, .. for each robot: its poses, and all edges that touch one of them.

    Edges between two robots stand in both files. Reading the folder gives the graph back, up to the order of its edges;
    without VERTEX lines, the owners come back only if the ids are symbols (`symbol_ids`). Errors as of `write_g2o`, and
    a PGOError when the folder, made if need be, holds other g2o files: reading it would join them to this graph.
    """
    chosen, folder = _poses_to_write(graph, poses), Path(folder)
    check_g2o_folder(folder, graph.num_robots)
    make_folder(folder)
    for robot in range(graph.num_robots):
        mine = graph.robots == robot
        _write(graph, folder / f"{robot}.g2o", chosen, mine, (mine[graph.i] & ~graph.is_prior) | mine[graph.j])


def make_folder(folder: Path) -> None:
    """Make a folder if it is not there; a PGOError when that cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PGOError(f"cannot write {folder}: {error.strerror}; choose a place that can be written") from error


def check_g2o_folder(folder: Path | str, num_robots: int) -> None:
    """Raise what `write_g2o_folder` would for this folder, before there is anything to write."""
    folder = Path(folder)
    present, inside = folder.absolute(), folder.absolute() / "0.g2o"
    while not os.path.lexists(present):
        present, inside = present.parent, present
    if not present.is_dir():
        raise PGOError(f"cannot write {folder}: {present} is no folder, and a name without a suffix stands for one")
    check_writable(inside)
    strangers = {file.name for file in folder.glob("*.g2o")} - {f"{robot}.g2o" for robot in range(num_robots)}
    if strangers:
        raise PGOError(f"cannot write {folder}: it holds another graph's {min(strangers)}; choose an empty folder")


def symbol_ids(robots: IntArray) -> IntArray:
    """GTSAM symbols a0, a1, .., b0, .. for poses owned by `robots`, (n,): up to 26 robots a to z, up to 52 A to z.

    A GraphError for more than 52 robots: there are no more letters.
    """
    count = int(robots.max()) + 1
    if count > MOST_SYMBOLS:
        raise GraphError(f"{count} robots, but symbols have {MOST_SYMBOLS} letters; number the poses instead")
    letters = _LETTERS[26:] if count <= 26 else _LETTERS
    ids = np.zeros(len(robots), dtype=np.int64)
    for robot in range(count):
        mine = robots == robot
        ids[mine] = (ord(letters[robot]) << _LETTER_SHIFT) + np.arange(mine.sum())
    return ids


def pose_names(graph: PoseGraph) -> list[str]:
    """Names of the poses for people: a GTSAM symbol as its letter and index, another id as it is, or the world."""
    names = [graph.pose_name(pose) for pose in range(graph.num_poses)]
    ids = {pose: int(names[pose]) for pose in graph.in_files.tolist()}
    if all(id_ >> _LETTER_SHIFT in map(ord, _LETTERS) for id_ in ids.values()):
        for pose, id_ in ids.items():
            names[pose] = f"{chr(id_ >> _LETTER_SHIFT)}{id_ & ((1 << _LETTER_SHIFT) - 1)}"
    return names


def _name_of(path: Path) -> str:
    if path.is_dir():
        return path.resolve().name
    return path.resolve().stem if path.is_file() else path.stem  # a pipe has no better name than that it was asked by


def g2o_files(path: Path) -> list[Path]:
    """A file itself, or those of a folder in the order 0, 1, .., 9, 10; a FileFormatError where it has none."""
    if not path.is_dir():
        return [path]
    found = [file for file in path.iterdir() if file.suffix == ".g2o" and file.is_file()]
    if not found:
        raise FileFormatError(path, None, "a folder without g2o files; give a file, or a folder with a file a robot")
    return sorted(found, key=lambda file: [(len(part), part) for part in re.findall(r"\d+|\D+", file.name)])


def _robots_files(files: list[G2OLines]) -> list[G2OLines]:
    """All files but one that repeats the others."""
    most = max(len(file.edges) for file in files)
    for whole in files:
        others = [file for file in files if file is not whole]
        if len(whole.edges) == most and len(others) >= 2 and _is_whole(whole, others):
            message = f"{whole.path}: left out, it repeats the edges of the other {len(others)} files; remove it"
            warnings.warn(message, GraphWarning, stacklevel=3)
            return others
    return files


def _is_whole(whole: G2OLines, others: list[G2OLines]) -> bool:
    """Whether a file has the edges of all others, and cannot be a robot's whose poses every one of them touches."""
    width = 3 if whole.d == 2 else 7
    exact = np.r_[: whole.d, width : whole.edges.shape[1]]  # a rotation may have been normalised, or turned its sign
    if any(file.d != whole.d for file in others) or not all(
        (whole.edges[:, exact] == file.edges[0, exact]).all(axis=1).any() for file in others if len(file.edges)
    ):
        return False
    parts = [(file.edge_ids[kept], file.edges[kept]) for file, kept in zip(others, _join_edges(others), strict=True)]
    ids, edges = map(np.concatenate, zip(*parts, strict=True))
    if len(edges) != len(whole.edges):
        return False
    mine, theirs = (rows[np.lexsort(rows[:, exact].T)] for rows in (whole.edges, edges))
    R, R_theirs = (poses_of(whole.d, rows)[0] for rows in (mine, theirs))
    if not np.array_equal(mine[:, exact], theirs[:, exact]) or np.abs(R - R_theirs).max() > 1e-9:
        return False
    if not np.array_equal(np.unique(whole.edge_ids, axis=0), np.unique(ids, axis=0)):
        return True  # it numbers the poses in its own way
    # An edge between two of the others has no end at a robot whose file has all edges.
    if sum(len(file.edges) for file in others) > len(edges):
        return True
    known = np.concatenate([file.vertex_ids for file in others])
    return len(whole.vertex_ids) > 0 and bool(np.isin(whole.vertex_ids, known).all())


def _join_edges(files: list[G2OLines]) -> list[IntArray | slice]:
    return join_edges([(file.edge_ids, file.edges) for file in files])


def join_edges(files: Sequence[tuple[IntArray, Array]]) -> list[IntArray | slice]:
    """Rows of every file to keep: the k-th copy of an edge counts in the first file that has k copies of it."""
    if len(files) == 1:
        return [slice(None)]
    seen: set[tuple[bytes, int]] = set()
    kept: list[IntArray | slice] = []
    for edge_ids, edges in files:
        copies: dict[bytes, int] = {}
        new = []
        for row, (ids, numbers) in enumerate(zip(edge_ids, edges + 0.0, strict=True)):  # -0.0 is 0.0
            edge = ids.tobytes() + numbers.tobytes()
            copies[edge] = copies.get(edge, 0) + 1
            if (edge, copies[edge]) not in seen:
                seen.add((edge, copies[edge]))
                new.append(row)
        kept.append(np.array(new, dtype=np.int64))
    return kept


def _robots(ids: IntArray, files: list[G2OLines]) -> IntArray | None:
    letters = ids >> _LETTER_SHIFT
    if np.isin(letters, [ord(letter) for letter in _LETTERS]).all():
        return np.asarray(np.unique(letters, return_inverse=True)[1], dtype=np.int64)
    if len(files) == 1:
        return None
    owner = np.full(len(ids), -1, dtype=np.int64)
    for mentioned in ([file.vertex_ids for file in files], [file.edge_ids.ravel() for file in files]):
        for robot, named in enumerate(mentioned):
            at = np.searchsorted(ids, named[named != WORLD_ID])
            owner[at[owner[at] < 0]] = robot
    return np.asarray(np.unique(owner, return_inverse=True)[1], dtype=np.int64)


def _initial(ids: IntArray, robot: IntArray | None, files: list[G2OLines]) -> Poses | None:
    numbers = np.zeros((len(ids), files[0].vertices.shape[1]))
    known, own = np.zeros((2, len(ids)), dtype=bool)
    for file in files:
        if not len(file.vertex_ids):
            continue
        at = np.searchsorted(ids, file.vertex_ids)
        # The robot of a file is the one most of its VERTEX lines belong to.
        mine = np.ones(len(at), dtype=bool) if robot is None else robot[at] == np.bincount(robot[at]).argmax()
        better = ~known[at] | (mine & ~own[at])
        numbers[at[better]] = file.vertices[better]
        known[at], own[at[better]] = True, mine[better]
    return Poses(*poses_of(files[0].d, numbers)) if known.all() else None


def _fixed(ids: IntArray, files: list[G2OLines]) -> IntArray:
    for file in files:
        unknown = ~np.isin(file.fixed, ids)
        if unknown.any():
            at = int(np.argmax(unknown))
            problem = f"FIX names pose {file.fixed[at]}, which has no other line; remove it"
            raise FileFormatError(file.path, int(file.fixed_lines[at]), problem)
    return np.unique(np.searchsorted(ids, np.concatenate([file.fixed for file in files])))


def _poses_to_write(graph: PoseGraph, poses: Poses | None) -> Poses | None:
    chosen = graph.initial if poses is None else poses
    if chosen is not None and chosen.t.shape != (graph.num_poses, graph.d):
        raise GraphError(f"poses are {chosen}; {graph.name} needs {graph.num_poses} of them in {graph.d}D")
    return chosen


def _write(graph: PoseGraph, path: Path, poses: Poses | None, mine: BoolArray, edges: BoolArray) -> None:
    d, ids, is_point = graph.d, graph.pose_ids, np.isin(np.arange(graph.num_poses), graph.landmarks)
    information = isotropic_information(graph.kappa, graph.tau, d) if graph.information is None else graph.information
    to_point, ends = is_point[graph.j], np.stack([ids[graph.i], ids[graph.j]], axis=1)
    no_turn = graph.is_prior & (graph.kappa == 0) & (graph.R_ij == np.eye(d)).all(axis=(1, 2))
    kinds = {tag: kind for tag, kind in TAGS.items() if kind.d == d and not kind.is_toro}
    with replace_when_done(path) as temporary, temporary.open("w", encoding="ascii", newline="\n") as file:
        if d == 3 and (edges & (graph.is_prior | to_point)).any():
            file.write("PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\n")
        for tag, kind in kinds.items():
            if not kind.is_edge and poses is not None:
                at = np.flatnonzero(mine & (is_point == kind.is_point) & (np.arange(len(mine)) != graph.world))
                file.writelines(_lines(tag, ids[at, None], poses.t[at] if kind.is_point else _numbers(poses[at])))
        file.writelines(f"FIX {ids[pose]}\n" for pose in graph.fixed if mine[pose])
        for tag, kind in kinds.items():
            if kind.is_edge:
                wanted = (graph.is_prior == (kind.num_ids == 1)) & (to_point == kind.to_landmark)
                at = np.flatnonzero(edges & wanted & ((to_point | no_turn) == kind.is_point))
                measured, k = Poses(graph.R_ij[at], graph.t_ij[at]), d if kind.is_point else information.shape[-1]
                upper = information[at][:, *np.triu_indices(k)]
                rows = np.concatenate([measured.t if kind.is_point else _numbers(measured), upper], axis=1)
                file.writelines(_lines(tag, ends[at, -kind.num_ids :], rows, "0 " * kind.has_offset))


def _numbers(poses: Poses) -> Array:
    R, t = poses.R, poses.t
    return np.concatenate([t, log_map(R) if R.shape[-1] == 2 else quaternions_from_rotations(R)], axis=1)


def _lines(tag: str, ids: IntArray, numbers: Array, offset: str = "") -> Iterator[str]:
    for first in range(0, len(ids), _ROWS):
        rows = slice(first, first + _ROWS)
        for names, row in zip(ids[rows].tolist(), numbers[rows].tolist(), strict=True):
            yield f"{tag} {' '.join(map(str, names))} {offset}{' '.join(map(repr, row))}\n"
