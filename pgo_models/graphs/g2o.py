"""g2o files, one for all robots or a folder with one for each, as a PoseGraph and back.

Information matrices become the precisions of SE-Sync (Rosen et al. 2019), see `edge_precisions`.
"""

import os
import re
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pgo_models.errors import FileFormatError, GraphError, GraphWarning, PGOError, printable
from pgo_models.files import check_writable, replace_when_done
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, log_map, quaternions_from_rotations
from pgo_models.graphs.g2o_parser import G2OLines, information_of, poses_of, read_lines
from pgo_models.graphs.g2o_tags import TAGS, Tag
from pgo_models.graphs.pose_graph import WORLD_ID, IntArray, PoseGraph, isotropic_information
from pgo_models.graphs.precisions import RotationWeight, edge_precisions

_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz"
MOST_SYMBOLS = len(_LETTERS)  # robots whose poses can be named by GTSAM symbols
_ROWS_AT_A_TIME = 2**14  # rows of numbers that are turned into text at a time
_LETTER_SHIFT = 56  # a GTSAM symbol is a letter in the top byte and an index below it
# Entries of two rotations that may differ by normalisation of their quaternions.
_SAME_ROTATION = 1e-9


def read_g2o(
    path: Path | str,
    weights: RotationWeight = RotationWeight.SE_SYNC,
    *,
    skip_unknown: bool = False,
) -> PoseGraph:
    """Read a g2o file, or a folder with one g2o file for each robot.

    Read are FIX lines, and those of poses, landmarks and priors as g2o, GTSAM and TORO write them.
    Poses are numbered by ascending id, the world pose of priors last. Quaternions are normalised,
    and repeated edges all count. `PoseGraph.initial` is set when every pose has a VERTEX line.
    Edges to poses without one are accepted; then `initial` is left out.

    Robots: when every id is a GTSAM symbol (a letter in the top byte), the rank of its letter is
    the robot. Otherwise a pose of a folder belongs to the file with its VERTEX line, the first of
    them in the order 0, 1, .., 9, 10, or else to the first file that names it. An edge that stands
    in two files of a folder is one measurement, and the VERTEX line that counts is that of the
    pose's own robot. A file beside those of two robots or more whose edges are those of all others
    once more, under the same ids or others, is the whole graph, no robot: a `GraphWarning` names
    it, and it is left out (`fullGraph.g2o` of distributed-mapper's folders).

    Parameters
    ----------
    path : Path or str
        File or folder. Translations are in the file's unit, taken as metres.
    weights : RotationWeight
        Which kappa stands for the information of a heading in the plane.
    skip_unknown : bool
        Whether lines with other tags are skipped with a warning.

    Returns
    -------
    PoseGraph
        Graph with kappa and tau, and `information` as in the file.

    Raises
    ------
    FileFormatError
        With file:line, for a line that cannot be read or measures nothing, for FIX of an unknown
        pose, for a file in the plane beside one in space, and where there are no edges or no files.

    References
    ----------
    Kuemmerle et al., g2o: a general framework for graph optimization, ICRA 2011.

    Examples
    --------
    >>> from pgo_models.graphs.datasets import locate
    >>> read_g2o(locate("grid"))
    PoseGraph('grid', d=3, poses=27, edges=108, robots=1)
    """
    path = Path(path)
    files = _files_of_robots([read_lines(file, skip_unknown) for file in g2o_files(path)])
    d = _common_dimension(files)
    edge_ids, rows = _joined_edges(files)
    if not len(rows):
        raise FileFormatError(
            path, None, "no edges; a pose graph needs at least one EDGE_SE2 or EDGE_SE3:QUAT line"
        )
    ids = _distinct([edge_ids.ravel(), *(file.vertex_ids for file in files)])
    file_ids = ids[ids != WORLD_ID]  # the world pose, if there is one, has the largest id
    edges = np.searchsorted(ids, edge_ids)
    robot = _robots(file_ids, files)
    initial = _initial(file_ids, robot, files)
    world = None
    if len(file_ids) < len(ids):
        world = len(file_ids)
        if robot is not None:
            first_prior = np.argmax(edges[:, 0] == world)
            robot = np.append(robot, robot[edges[first_prior, 1]])
    information = information_of(d, rows)
    kappa, tau = edge_precisions(information, weights)
    R_ij, t_ij = poses_of(d, rows)
    landmark_ids = np.concatenate([file.landmarks for file in files])
    return PoseGraph(
        len(ids),
        i=edges[:, 0],
        j=edges[:, 1],
        R_ij=R_ij,
        t_ij=t_ij,
        kappa=kappa,
        tau=tau,
        information=information,
        ids=ids,
        robot=robot,
        initial=initial,
        fixed=_fixed(ids, files),
        name=printable(name_of(path)),
        world=world,
        landmarks=np.flatnonzero(np.isin(ids, landmark_ids)),
    )


def _common_dimension(files: list[G2OLines]) -> int:
    """Dimension of all files; a FileFormatError where they differ."""
    d = files[0].d
    for file in files:
        if file.d != d:
            raise FileFormatError(
                file.path, None, f"{file.d}D, but {files[0].path} is {d}D; part the folder"
            )
    return d


def _distinct(ids: list[IntArray]) -> IntArray:
    """Distinct ids, ascending; `numpy.unique` takes ten times as long."""
    ascending: IntArray = np.sort(np.concatenate(ids))
    is_new = np.append(True, np.diff(ascending) != 0)
    return np.asarray(ascending[is_new])


def edge_places(path: Path | str) -> list[str]:
    """`file:line` of every edge of the graph that `read_g2o` has read from a file or folder."""
    files = _files_of_robots(
        [read_lines(file, skip_unknown=True) for file in g2o_files(Path(path))]
    )
    places = []
    for file, kept in zip(files, _edges_to_keep(files), strict=True):
        places += [f"{file.path}:{line}" for line in file.edge_lines[kept]]
    return places


def read_g2o_poses(path: Path | str, graph: PoseGraph) -> Poses:
    """Poses of the VERTEX lines of a g2o file, in the order of `graph`; its edges are ignored.

    A FileFormatError as of `read_lines`; also when the file has another dimension, and unless every
    pose and landmark of the graph has a VERTEX line there and the file has no others: poses of
    another graph are no estimate of this one.
    """
    file = read_lines(path)
    if file.d != graph.d:
        raise FileFormatError(
            path, None, f"{file.d}D, but {graph.name} is {graph.d}D; give poses of this graph"
        )
    _check_same_poses(file, graph)
    ids = graph.pose_ids[graph.in_files]
    order = np.argsort(file.vertex_ids)
    row = order[np.searchsorted(file.vertex_ids[order], ids)]
    R, t = poses_of(file.d, file.vertices[row])
    return graph.completed(Poses(R, t))


def _check_same_poses(file: G2OLines, graph: PoseGraph) -> None:
    """Raise a FileFormatError unless the file has the poses and landmarks of a graph, no others."""
    ids = graph.pose_ids[graph.in_files]
    sizes = f"the file has {len(file.vertex_ids)}, {graph.name} {len(ids)}"
    way_out = "give an estimate of this graph"
    is_unknown = ~np.isin(file.vertex_ids, ids)
    if is_unknown.any():
        first = int(np.argmax(is_unknown))
        problem = (
            f"pose {file.vertex_ids[first]} is not in {graph.name} "
            f"({is_unknown.sum()} are not; {sizes}); {way_out}"
        )
        raise FileFormatError(file.path, int(file.vertex_lines[first]), problem)
    is_absent = ~np.isin(ids, file.vertex_ids)
    if is_absent.any():
        problem = (
            f"no VERTEX line for pose {ids[np.argmax(is_absent)]} "
            f"({is_absent.sum()} missing; {sizes}); {way_out}"
        )
        raise FileFormatError(file.path, None, problem)
    is_landmark = np.isin(file.vertex_ids, file.landmarks)
    is_landmark_of_graph = np.isin(file.vertex_ids, graph.pose_ids[graph.landmarks])
    differs = is_landmark != is_landmark_of_graph
    if differs.any():
        first = int(np.argmax(differs))
        here, in_graph = ("landmark", "pose") if is_landmark[first] else ("pose", "landmark")
        problem = (
            f"{file.vertex_ids[first]} is a {here} here and a {in_graph} of {graph.name}; {way_out}"
        )
        raise FileFormatError(file.path, int(file.vertex_lines[first]), problem)


def write_g2o(
    graph: PoseGraph, path: Path | str, poses: Poses | None = None, mine: BoolArray | None = None
) -> None:
    """Write a graph as one g2o file: VERTEX lines, FIX lines and EDGE lines.

    The numbers have all digits of the doubles. Without `graph.information` the matrices are tau I,
    2 kappa I in space and diag(tau, tau, kappa) in the plane, which read back as the same kappa and
    tau (RotationWeight.SE_SYNC). A file that exists is replaced when the new one is complete.

    Parameters
    ----------
    graph : PoseGraph
        Graph to write.
    path : Path or str
        File to write.
    poses : Poses, optional
        Poses of the VERTEX lines; `graph.initial` unless given. Without either there are no VERTEX
        lines.
    mine : BoolArray, (n,), optional
        Poses that have VERTEX and FIX lines; all unless given.

    Raises
    ------
    GraphError
        When there is not one pose for every pose of the graph.
    PGOError
        When the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from pgo_models.graphs.scenes import grid
    >>> path = Path(tempfile.mkdtemp()) / "grid.g2o"
    >>> write_g2o(grid(np.random.default_rng(0)), path)
    >>> read_g2o(path)
    PoseGraph('grid', d=3, poses=27, edges=108, robots=1)
    """
    all_edges = np.ones(graph.num_edges, dtype=bool)
    if mine is None:
        mine = np.ones(graph.num_poses, dtype=bool)
    _write(graph, Path(path), _poses_to_write(graph, poses), mine, all_edges)


def write_g2o_folder(graph: PoseGraph, folder: Path | str, poses: Poses | None = None) -> None:
    """Write one file 0.g2o, 1.g2o, .. for each robot: its poses, and all edges that touch them.

    Edges between two robots stand in both files. Reading the folder gives the graph back, up to the
    order of its edges; without VERTEX lines, the owners come back only if the ids are symbols
    (`symbol_ids`). Errors as of `write_g2o`. Also a PGOError when the folder, which is made if need
    be, holds other g2o files: reading it would join them to this graph.
    """
    written_poses = _poses_to_write(graph, poses)
    folder = Path(folder)
    check_g2o_folder(folder, graph.num_robots)
    make_folder(folder)
    for robot in range(graph.num_robots):
        mine = graph.robots == robot
        # A prior belongs to the robot of the pose that it measures.
        edges = (mine[graph.i] & ~graph.is_prior) | mine[graph.j]
        _write(graph, folder / f"{robot}.g2o", written_poses, mine, edges)


def make_folder(folder: Path) -> None:
    """Make a folder if it is not there; a PGOError when that cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PGOError(
            f"cannot write {folder}: {error.strerror}; choose a place that can be written"
        ) from error


def check_g2o_folder(folder: Path | str, num_robots: int) -> None:
    """Raise what `write_g2o_folder` would for this folder, before there is anything to write."""
    folder = Path(folder)
    # The nearest folder that exists has to take the next one on the way to the first file.
    existing = folder.absolute()
    new_entry = existing / "0.g2o"
    while not os.path.lexists(existing):
        new_entry = existing
        existing = existing.parent
    if not existing.is_dir():
        raise PGOError(
            f"cannot write {folder}: {existing} is no folder, "
            "and a name without a suffix stands for one"
        )
    check_writable(new_entry)
    expected = {f"{robot}.g2o" for robot in range(num_robots)}
    strangers = {file.name for file in folder.glob("*.g2o")} - expected
    if strangers:
        raise PGOError(
            f"cannot write {folder}: it holds another graph's {min(strangers)}; "
            "choose an empty folder"
        )


def symbol_ids(robots: IntArray) -> IntArray:
    """GTSAM symbols a0, a1, .., b0, .. of poses owned by `robots`, (n,).

    Up to 26 robots have the letters a to z, up to 52 A to z. A GraphError for more robots.
    """
    count = int(robots.max()) + 1
    if count > MOST_SYMBOLS:
        raise GraphError(
            f"{count} robots, but symbols have {MOST_SYMBOLS} letters; number the poses instead"
        )
    letters = _LETTERS[26:] if count <= 26 else _LETTERS
    ids = np.zeros(len(robots), dtype=np.int64)
    for robot in range(count):
        mine = robots == robot
        ids[mine] = (ord(letters[robot]) << _LETTER_SHIFT) + np.arange(mine.sum())
    return ids


def pose_names(graph: PoseGraph) -> list[str]:
    """Names of the poses for people.

    A GTSAM symbol is shown as its letter and index, another id as it is, the world pose by its
    name.
    """
    names = [graph.pose_name(pose) for pose in range(graph.num_poses)]
    ids = {pose: int(names[pose]) for pose in graph.in_files.tolist()}
    letter_codes = {ord(letter) for letter in _LETTERS}
    if not all(symbol >> _LETTER_SHIFT in letter_codes for symbol in ids.values()):
        return names
    for pose, symbol in ids.items():
        index = symbol & ((1 << _LETTER_SHIFT) - 1)
        names[pose] = f"{chr(symbol >> _LETTER_SHIFT)}{index}"
    return names


def name_of(path: Path) -> str:
    """Name of the graph in a file or folder, as the system has it."""
    if path.is_dir():
        return path.resolve().name
    # a pipe has no better name than that it was asked by
    return path.resolve().stem if path.is_file() else path.stem


def g2o_files(path: Path) -> list[Path]:
    """A file itself, or those of a folder in the order 0, 1, .., 9, 10.

    A FileFormatError where the folder has none.
    """
    if not path.is_dir():
        return [path]
    files = [file for file in path.iterdir() if file.suffix == ".g2o" and file.is_file()]
    if not files:
        raise FileFormatError(
            path, None, "a folder without g2o files; give a file, or a folder with a file a robot"
        )
    return sorted(files, key=_natural_order)


def _natural_order(file: Path) -> list[tuple[int, str]]:
    """Key by which 9 comes before 10: shorter runs of digits first."""
    return [(len(part), part) for part in re.findall(r"\d+|\D+", file.name)]


def _files_of_robots(files: list[G2OLines]) -> list[G2OLines]:
    """All files but one that repeats the others, which a GraphWarning names."""
    most_edges = max(len(file.edges) for file in files)
    if len(files) < 3 or most_edges == 0:
        return files
    for whole in files:
        if len(whole.edges) < most_edges:
            continue
        others = [file for file in files if file is not whole]
        if _is_whole_graph(whole, others):
            warnings.warn(
                f"{whole.path}: left out, it repeats the edges of the other {len(others)} files; "
                "remove it",
                GraphWarning,
                stacklevel=3,
            )
            return others
    return files


def _is_whole_graph(whole: G2OLines, others: list[G2OLines]) -> bool:
    """Whether a file has the edges of all others, and is not that of a robot.

    A robot's file also has all edges where every edge of the others touches its poses.
    """
    if not _may_have_edges_of(whole, others):
        return False
    edge_ids, edges = _joined_edges(others)
    if not _are_same_measurements(whole.d, whole.edges, edges):
        return False
    same_ids = np.array_equal(np.unique(whole.edge_ids, axis=0), np.unique(edge_ids, axis=0))
    if not same_ids:
        return True  # it numbers the poses in its own way
    # An edge that stands in two of the others does not touch the poses of a robot of its own.
    if sum(len(file.edges) for file in others) > len(edges):
        return True
    others_ids = np.concatenate([file.vertex_ids for file in others])
    return len(whole.vertex_ids) > 0 and bool(np.isin(whole.vertex_ids, others_ids).all())


def _exact_columns(d: int, num_columns: int) -> IntArray:
    """Columns of edges that are the same in two files; rotations may be normalised, or -q for q."""
    num_measured = 3 if d == 2 else 7
    return np.asarray(np.r_[:d, num_measured:num_columns])


def _may_have_edges_of(whole: G2OLines, others: list[G2OLines]) -> bool:
    """Whether a file has the first edge of every other file, which is quickly found out."""
    columns = _exact_columns(whole.d, whole.edges.shape[1])
    for file in others:
        if file.d != whole.d:
            return False
        if len(file.edges):
            is_first = (whole.edges[:, columns] == file.edges[0, columns]).all(axis=1)
            if not is_first.any():
                return False
    return True


def _are_same_measurements(d: int, edges: Array, others: Array) -> bool:
    """Whether two arrays of edges hold the same measurements, in any order."""
    if len(edges) != len(others):
        return False
    columns = _exact_columns(d, edges.shape[1])
    ours = edges[np.lexsort(edges[:, columns].T)]
    theirs = others[np.lexsort(others[:, columns].T)]
    if not np.array_equal(ours[:, columns], theirs[:, columns]):
        return False
    our_R, _ = poses_of(d, ours)
    their_R, _ = poses_of(d, theirs)
    return bool(np.abs(our_R - their_R).max() <= _SAME_ROTATION)


def _edges_to_keep(files: list[G2OLines]) -> list[IntArray | slice]:
    return join_edges([(file.edge_ids, file.edges) for file in files])


def _joined_edges(files: list[G2OLines]) -> tuple[IntArray, Array]:
    """Ids and rows of the edges of all files, each measurement once."""
    kept = _edges_to_keep(files)
    edge_ids = [file.edge_ids[rows] for file, rows in zip(files, kept, strict=True)]
    edges = [file.edges[rows] for file, rows in zip(files, kept, strict=True)]
    return np.concatenate(edge_ids), np.concatenate(edges)


def join_edges(files: Sequence[tuple[IntArray, Array]]) -> list[IntArray | slice]:
    """Rows of every file to keep, so that an edge that stands in two files counts once.

    An edge may be repeated within a file, where every copy counts: the k-th copy of an edge counts
    in the first file that has k copies of it.
    """
    if len(files) == 1:
        return [slice(None)]
    seen: set[tuple[bytes, int]] = set()
    kept: list[IntArray | slice] = []
    for edge_ids, edges in files:
        num_copies: dict[bytes, int] = {}
        new_rows = []
        positive_zeros = edges + 0.0  # -0.0 becomes 0.0, so that equal numbers have equal bytes
        for row, (ids, numbers) in enumerate(zip(edge_ids, positive_zeros, strict=True)):
            edge = ids.tobytes() + numbers.tobytes()
            num_copies[edge] = num_copies.get(edge, 0) + 1
            copy = (edge, num_copies[edge])
            if copy not in seen:
                seen.add(copy)
                new_rows.append(row)
        kept.append(np.array(new_rows, dtype=np.int64))
    return kept


def _robots(ids: IntArray, files: list[G2OLines]) -> IntArray | None:
    """Robot of every pose, as `read_g2o` says; None where one file names no robots."""
    letters = ids >> _LETTER_SHIFT
    if np.isin(letters, [ord(letter) for letter in _LETTERS]).all():
        return _ranks(letters)
    if len(files) == 1:
        return None
    owner = np.full(len(ids), -1, dtype=np.int64)
    ids_of_vertices = [file.vertex_ids for file in files]
    ids_of_edges = [file.edge_ids.ravel() for file in files]
    for ids_of_files in (ids_of_vertices, ids_of_edges):
        for robot, ids_of_file in enumerate(ids_of_files):
            poses = np.searchsorted(ids, ids_of_file[ids_of_file != WORLD_ID])
            owner[poses[owner[poses] < 0]] = robot
    return _ranks(owner)


def _ranks(values: IntArray) -> IntArray:
    """Rank of every value among the distinct ones."""
    _, rank = np.unique(values, return_inverse=True)
    return np.asarray(rank, dtype=np.int64)


def _initial(ids: IntArray, robot: IntArray | None, files: list[G2OLines]) -> Poses | None:
    """Estimate of the VERTEX lines; None unless every pose has one."""
    d = files[0].d
    numbers = np.zeros((len(ids), files[0].vertices.shape[1]))
    is_known = np.zeros(len(ids), dtype=bool)
    is_from_owner = np.zeros(len(ids), dtype=bool)
    for file in files:
        if not len(file.vertex_ids):
            continue
        poses = np.searchsorted(ids, file.vertex_ids)
        is_own = np.ones(len(poses), dtype=bool)
        if robot is not None:
            # The robot of a file is the one that most of its VERTEX lines belong to.
            robot_of_file = np.bincount(robot[poses]).argmax()
            is_own = robot[poses] == robot_of_file
        is_better = ~is_known[poses] | (is_own & ~is_from_owner[poses])
        numbers[poses[is_better]] = file.vertices[is_better]
        is_known[poses] = True
        is_from_owner[poses[is_better]] = is_own[is_better]
    if not is_known.all():
        return None
    R, t = poses_of(d, numbers)
    return Poses(R, t)


def _fixed(ids: IntArray, files: list[G2OLines]) -> IntArray:
    """Poses of the FIX lines, ascending; a FileFormatError for one that has no other line."""
    for file in files:
        is_unknown = ~np.isin(file.fixed, ids)
        if is_unknown.any():
            first = int(np.argmax(is_unknown))
            problem = f"FIX names pose {file.fixed[first]}, which has no other line; remove it"
            raise FileFormatError(file.path, int(file.fixed_lines[first]), problem)
    fixed_ids = np.concatenate([file.fixed for file in files])
    return np.unique(np.searchsorted(ids, fixed_ids))


def _poses_to_write(graph: PoseGraph, poses: Poses | None) -> Poses | None:
    """Given poses, else the estimate; a GraphError when they do not have the size of the graph."""
    written = graph.initial if poses is None else poses
    if written is not None and written.t.shape != (graph.num_poses, graph.d):
        raise GraphError(
            f"poses are {written}; {graph.name} needs {graph.num_poses} of them in {graph.d}D"
        )
    return written


def _write(
    graph: PoseGraph, path: Path, poses: Poses | None, mine: BoolArray, edges: BoolArray
) -> None:
    """Write VERTEX and FIX lines of the poses `mine`, (n,), and EDGE lines of `edges`, (m,)."""
    with (
        replace_when_done(path) as temporary,
        temporary.open("w", encoding="ascii", newline="\n") as file,
    ):
        to_landmark = np.isin(graph.j, graph.landmarks)
        if graph.d == 3 and (edges & (graph.is_prior | to_landmark)).any():
            file.write("PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\n")
        if poses is not None:
            file.writelines(_vertex_lines(graph, poses, mine))
        ids = graph.pose_ids
        file.writelines(f"FIX {ids[pose]}\n" for pose in graph.fixed if mine[pose])
        file.writelines(_edge_lines(graph, edges))


def _written_tags(d: int, is_edge: bool) -> dict[str, Tag]:
    """Tags of the VERTEX or EDGE lines that are written in d dimensions."""
    return {
        tag: kind
        for tag, kind in TAGS.items()
        if kind.d == d and kind.is_edge == is_edge and not kind.is_toro
    }


def _vertex_lines(graph: PoseGraph, poses: Poses, mine: BoolArray) -> Iterator[str]:
    """VERTEX lines of the poses `mine`, (n,)."""
    pose = np.arange(graph.num_poses)
    is_landmark = np.isin(pose, graph.landmarks)
    for tag, kind in _written_tags(graph.d, is_edge=False).items():
        chosen = np.flatnonzero(mine & (is_landmark == kind.is_point) & (pose != graph.world))
        numbers = _numbers(poses[chosen], kind)
        yield from _lines(tag, graph.pose_ids[chosen, None], numbers)


def _edge_lines(graph: PoseGraph, edges: BoolArray) -> Iterator[str]:
    """EDGE lines of some edges, (m,)."""
    d = graph.d
    information = graph.information
    if information is None:
        information = isotropic_information(graph.kappa, graph.tau, d)
    to_landmark = np.isin(graph.j, graph.landmarks)
    is_unturned = (graph.R_ij == np.eye(d)).all(axis=(1, 2))
    is_position_prior = graph.is_prior & (graph.kappa == 0) & is_unturned
    is_point = to_landmark | is_position_prior
    end_ids = np.stack([graph.pose_ids[graph.i], graph.pose_ids[graph.j]], axis=1)
    for tag, kind in _written_tags(d, is_edge=True).items():
        is_of_kind = (
            (graph.is_prior == (kind.num_ids == 1))
            & (to_landmark == kind.to_landmark)
            & (is_point == kind.is_point)
        )
        chosen = np.flatnonzero(edges & is_of_kind)
        measured = _numbers(Poses(graph.R_ij[chosen], graph.t_ij[chosen]), kind)
        k = d if kind.is_point else information.shape[-1]
        triangles = information[chosen][:, *np.triu_indices(k)]
        numbers = np.concatenate([measured, triangles], axis=1)
        offset = "0 " if kind.has_offset else ""
        yield from _lines(tag, end_ids[chosen, -kind.num_ids :], numbers, offset)


def _numbers(poses: Poses, kind: Tag) -> Array:
    """Numbers of poses, (n, ..), as they stand on lines of a kind."""
    if kind.is_point:
        return poses.t
    if poses.d == 2:
        return np.concatenate([poses.t, log_map(poses.R)], axis=1)
    return np.concatenate([poses.t, quaternions_from_rotations(poses.R)], axis=1)


def _lines(tag: str, ids: IntArray, numbers: Array, offset: str = "") -> Iterator[str]:
    """Lines `tag ids offset numbers`; `repr` of a double gives the digits that bring it back."""
    for first in range(0, len(ids), _ROWS_AT_A_TIME):
        rows = slice(first, first + _ROWS_AT_A_TIME)
        for row_ids, row in zip(ids[rows].tolist(), numbers[rows].tolist(), strict=True):
            yield f"{tag} {' '.join(map(str, row_ids))} {offset}{' '.join(map(repr, row))}\n"
