"""Reader and writer of g2o files: one file for all robots, or a folder with one for each robot.

Information matrices become the precisions of SE-Sync (Rosen et al. 2019), see `edge_precisions`.
"""

import os
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pgo_models.errors import FileFormatError, GraphError, GraphWarning, PGOError, printable
from pgo_models.files import check_lines, check_writable, replace_when_done
from pgo_models.geometry.arrays import check_shape
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.g2o_folder import (
    FILES_HERE,
    LETTER_CODES,
    LETTER_SHIFT,
    LETTERS,
    Rows,
    absent_ids,
    are_reprinted,
    check_one_graph,
    copies_within_printing,
    edge_rows,
    edges_as_first_printed,
    robot_letters,
)
from pgo_models.graphs.g2o_parser import G2OLines, read_lines
from pgo_models.graphs.g2o_readings import Reading
from pgo_models.graphs.g2o_rows import (
    information_of,
    lines_of,
    measurements_of,
    numbers_of,
    poses_of,
)
from pgo_models.graphs.g2o_tags import G2O_TAGS, Tag
from pgo_models.graphs.missing_poses import with_missing_poses
from pgo_models.graphs.origin import far_middle, shifted_exactly
from pgo_models.graphs.pose_graph import WORLD_ID, IntArray, PoseGraph, matrices_of_edges
from pgo_models.graphs.precisions import (
    edge_precisions,
    without_negative_rounding,
)
from pgo_models.graphs.written_digits import (
    WrittenDigits,
    digits_of,
    most_digits,
    written_errors,
)

MOST_SYMBOLS = len(LETTERS)  # robots whose poses can be named by GTSAM symbols
COMPRESSED = ".gz"  # suffix of a file that is compressed by gzip
_WHOLE_GRAPH = "fullGraph.g2o"  # beside the files of robots, in the folders of distributed-mapper


def read_g2o(
    path: Path | str,
    *,
    reading: Reading = Reading.AS_WRITTEN,
    unit_weights: bool = False,
    skip_unknown: bool = False,
    trust_folder: bool = False,
) -> PoseGraph:
    """Read a g2o file, or a folder with one g2o file for each robot.

    The reader takes FIX lines, and the lines of poses, landmarks and priors that g2o, GTSAM, TORO,
    iSAM, Vertigo and hdl_graph_slam write, also from files that are compressed by gzip. It numbers
    the poses by ascending id; the world pose of priors comes last. It normalises quaternions, and
    counts every copy of an edge that a file repeats. A matrix is the upper triangle, row by row, or
    complete. An edge may lead to a pose that has no VERTEX line. `PoseGraph.initial` is set if
    every pose has a VERTEX line. Where at least half of the poses of one file have one, the others
    are placed along edges, with a warning; it is None otherwise.

    Read are also the pose graphs of Open3D (JSON), view graphs with lines i j, a rotation by rows
    and a translation, of which the rotations are taken, and tables with a header such as
    i,j,x,y,theta, with the upper triangles of information matrices or without.

    Where the lines leave a choice, a `GraphWarning` says what was assumed:

    - EDGE2, EDGE3 and LANDMARK2 have information matrices, although iSAM's files have square roots
      of them (`Reading.SQUARE_ROOTS`). The matrices of EDGE2 are in TORO's order, unless all are
      positive definite in iSAM's, and not in TORO's. Those of EDGE_SE2 are in g2o's order, unless
      one is indefinite in it, and all are positive definite in TORO's.
    - EDGE3 without a matrix has the identity.
    - ODOMETRY and LANDMARK have covariance matrices, as in GTSAM.
    - BR, a point by bearing and range with their standard deviations, becomes a point with the
      covariance to first order, an approximation.
    - EDGE_SE3_PRIORQUAT, a rotation with its w first, has the information of a rotation vector.
    - EDGE_SE3_PRIORVEC, a direction of the world and what the pose has measured of it, such as
      gravity, measures the tilt of the pose.
    - Switchable edges hold always. Switches, robust kernels and data of sensors are not used.
    - EQUIV, which names edges that TORO may contract, is skipped.
    - An id of a pose that is a landmark's, too, names two things; a power of ten is added to the
      ids of all landmarks.

    A measurement by a sensor that PARAMS_SE2OFFSET or PARAMS_SE3OFFSET places beside its pose is
    brought into the frame of the pose. This is exact for landmarks; of an edge or prior that ends
    at such a sensor, the information is right to first order in the rotation error.

    The robot of a pose is found in one of three ways:

    (a) Every id is a GTSAM symbol, which has a letter in its top byte. The letters in use, sorted,
        number the robots. Landmarks whose letter is that of no pose belong to who sees them first.
    (b) Some id is no symbol, and the folder has several files. A pose belongs to the first file
        with a VERTEX line of it, or, if there is none, to the first file with an edge of it. The
        order of the files is 0, 1, .., 9, 10.
    (c) Some id is no symbol, and there is one file. One robot owns all poses.

    An edge that two files of a folder contain is one measurement. If several files have a VERTEX
    line of a pose, the file of the robot that owns the pose decides where the pose is. Files that
    speak against being of one graph are refused, unless the folder is trusted: ids that name no
    robot and stand on VERTEX lines far from each other, odometry that two files measure
    differently, and edges of two files with nearly equal numbers, which would count twice.

    If the files have VERTEX lines of their own poses, and no file has one of a pose that edges
    name, the file of its robot is absent: `PoseGraph.absent` has these poses, and the name of the
    graph says so.

    A file `fullGraph.g2o` beside others is the whole graph, as in the folders of
    distributed-mapper, which may number the poses in its own way. It is left out, and a
    `GraphWarning` says so.

    Parameters
    ----------
    path : Path or str
        File or folder. Translations are in the file's unit, taken as metres.
    reading : Reading
        What the lines mean, if it is not what g2o's format says: for example that closures are
        reversed, or that matrices, of all tags, are square roots, as iSAM writes them.
    unit_weights : bool
        Whether the graph has the weights of the paper, kappa = tau = 1, and no information
        matrices. Edges of the file then need none.
    skip_unknown : bool
        Whether lines with other tags are skipped with a warning.
    trust_folder : bool
        Whether the files of a folder are of one graph whatever speaks against it: the same id is
        the same pose, and edges count unless all their numbers are the same.

    Raises
    ------
    FileFormatError
        With file:line of the first 20 lines that cannot be read or measure nothing, for edges
        without a matrix unless `unit_weights`, and for FIX of unknown poses. Also for a folder with
        a 2D file and a 3D file, and if there are no edges or no files; and with file:line of both
        lines for files that speak against being of one graph.

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
    reading = Reading.of(reading)
    files = [
        read_lines(file, skip_unknown, reading, needs_matrices=not unit_weights)
        for file in g2o_files(path)
    ]
    graph = graph_of_robots(path, files, path.is_dir(), trust_folder)
    return graph.unit_weights() if unit_weights else graph


def graph_of_robots(
    path: Path,
    files: list[G2OLines],
    is_folder: bool,
    trust_folder: bool = False,
) -> PoseGraph:
    """Graph of files that have been read: of a folder with one for each robot, or of one file.

    Those of several robots have to be of one graph, unless the folder is trusted. Poses of robots
    without a file are `PoseGraph.absent`.
    """
    _check_ids_of_landmarks(files)
    _common_dimension(files)
    if not trust_folder:
        check_one_graph(files)
    graph = graph_of_files(path, files)
    num_copies = sum(
        int(are_reprinted(edge_rows(file), rows).sum())
        for file, rows in zip(files, _as_first_printed(files), strict=True)
    )
    if num_copies:
        message = f"{printable(str(path))}: {copies_within_printing(num_copies)}"
        warnings.warn(message, GraphWarning, stacklevel=3)
    for file in [] if trust_folder else _without_own_poses(files):
        message = (
            f"{printable(str(file.path))}: all its poses are in files before it; a file of the "
            f"whole graph is left out if it is named {_WHOLE_GRAPH}"
        )
        warnings.warn(message, GraphWarning, stacklevel=3)
    absent = absent_ids(files) if is_folder else np.zeros(0, dtype=np.int64)
    if not len(absent):
        return graph
    name = f"{graph.name}, {FILES_HERE}"
    return replace(graph, absent=np.searchsorted(graph.pose_ids, absent), name=name)


def _without_own_poses(files: list[G2OLines]) -> list[G2OLines]:
    """Files with VERTEX lines, all of which are of poses that files before them have."""
    without = []
    seen = np.zeros(0, dtype=np.int64)
    for file in files:
        if len(file.vertex_ids) and np.isin(file.vertex_ids, seen).all():
            without.append(file)
        seen = np.union1d(seen, file.vertex_ids)
    return without


def graph_of_files(
    path: Path,
    files: list[G2OLines],
    letters: Sequence[int] = LETTER_CODES,
) -> PoseGraph:
    """Graph of the lines of a file for each robot, or of one file.

    `path` is that of all files together. `letters` are the codes of those letters in the top byte
    of ids that name robots.
    """
    d = _common_dimension(files)
    edge_ids, rows = _joined_edges(files)
    if not len(rows):
        raise FileFormatError(
            path, None, "no edges; a pose graph needs at least one EDGE_SE2 or EDGE_SE3:QUAT line"
        )
    ids_of_vertices = [file.vertex_ids for file in files]
    ids = _distinct([edge_ids.ravel(), *ids_of_vertices])
    file_ids = ids[ids != WORLD_ID]  # the world pose, if there is one, has the largest id
    edges = np.searchsorted(ids, edge_ids)
    robot = _robots(file_ids, files, letters)
    estimate, is_known = _estimate(file_ids, robot, files)
    information, is_changed = without_negative_rounding(information_of(d, rows), d)
    if is_changed.any():
        first = edge_places_of(files)[int(np.argmax(is_changed))]
        warnings.warn(
            f"{printable(first)}: information matrices of {is_changed.sum()} edges, of which this "
            "is the first, are indefinite by the rounding of their digits; their negative "
            "eigenvalues are taken for zero",
            GraphWarning,
            stacklevel=3,
        )
    kappa, tau = edge_precisions(information)
    R_ij, t_ij = poses_of(d, rows)
    is_prior = edge_ids[:, 0] == WORLD_ID
    origin = far_middle(t_ij[is_prior & (tau > 0)], t_ij[~is_prior])
    if origin.any():
        t_ij[is_prior] = shifted_exactly(t_ij[is_prior], _remainders(files)[is_prior], origin)
    landmark_ids = np.concatenate([file.landmarks for file in files])
    is_landmark = np.isin(ids, landmark_ids)
    world = None
    if len(file_ids) < len(ids):
        world = len(file_ids)
        if robot is not None:
            # Every pose needs an owner, and no file says whose the world pose is. It is given,
            # arbitrarily, to the robot of the pose that the first prior measures.
            first_prior = np.argmax(edges[:, 0] == world)
            measured_pose = edges[first_prior, 1]
            robot = np.append(robot, robot[measured_pose])
    digits = most_digits(file.digits for file in files)
    graph = PoseGraph(
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
        initial=estimate if is_known.all() else None,
        fixed=_fixed(ids, files),
        name=printable(name_of(path)),
        world=world,
        landmarks=np.flatnonzero(is_landmark),
        written_error=written_errors(measurements_of(d, rows), digits),
        weights_error=max(file.weights_error for file in files),
        origin=origin,
    )
    if not path.is_dir() and len(files) == 1 and is_known.any() and not is_known.all():
        return with_missing_poses(graph, estimate, is_known, printable(str(path)))
    return graph


def _common_dimension(files: list[G2OLines]) -> int:
    """Dimension of all files; a FileFormatError where they differ."""
    first = files[0]
    for file in files:
        if file.d != first.d:
            problem = (
                f"{file.d}D, but {first.path} is {first.d}D; "
                "put 2D files and 3D files into folders of their own"
            )
            raise FileFormatError(file.path, None, problem)
    return first.d


def _check_ids_of_landmarks(files: list[G2OLines]) -> None:
    """Raise a FileFormatError where a file of several has poses and landmarks with the same ids."""
    for file in files:
        if len(files) > 1 and file.landmark_shift:
            problem = (
                "ids of poses are those of landmarks, too; in a folder of several files, "
                "give the landmarks ids of their own"
            )
            raise FileFormatError(file.path, None, problem)


def _distinct(ids: list[IntArray]) -> IntArray:
    """Distinct ids, ascending; `numpy.unique` takes ten times as long."""
    ascending: IntArray = np.sort(np.concatenate(ids))
    is_new = np.append(True, np.diff(ascending) != 0)
    return np.asarray(ascending[is_new])


def edge_places(path: Path | str) -> list[str]:
    """`file:line` of every edge of the graph that `read_g2o` reads from a file or folder."""
    files = [
        read_lines(file, skip_unknown=True, needs_matrices=False) for file in g2o_files(Path(path))
    ]
    return edge_places_of(files)


def edge_places_of(files: list[G2OLines]) -> list[str]:
    """`file:line` of every edge of the graph of files that have been read."""
    kept_rows = _rows_to_keep(files)
    places = []
    for file, kept in zip(files, kept_rows, strict=True):
        lines = file.edge_lines[kept]
        places += [f"{file.path}:{line}" for line in lines]
    return places


def read_g2o_poses(path: Path | str, graph: PoseGraph) -> Poses:
    """Poses of the VERTEX lines of a g2o file, in the order of `graph`; its edges are ignored.

    The VERTEX lines must be those of the poses and landmarks of the graph, each of them and no
    others: poses of another graph are no estimate of this one. A FileFormatError if they are not,
    if the file has another dimension, and for the faults that `read_lines` finds.
    """
    file = read_lines(path, needs_matrices=False)
    if file.d != graph.d:
        problem = f"{file.d}D, but {graph.name} is {graph.d}D; give poses of this graph"
        raise FileFormatError(path, None, problem)
    _check_same_poses(file, graph)
    ids = graph.pose_ids[graph.in_files]
    order = np.argsort(file.vertex_ids)
    ascending_ids = file.vertex_ids[order]
    row = order[np.searchsorted(ascending_ids, ids)]
    R, t = poses_of(file.d, file.vertices[row])
    return graph.completed(Poses(R, t))[graph.in_files]


def digits_of_vertices(path: Path) -> WrittenDigits:
    """Digits that the poses on the VERTEX lines of a g2o file are written with."""
    file = read_lines(path, skip_unknown=True, needs_matrices=False)
    return digits_of(file.vertices.ravel())


def _check_same_poses(file: G2OLines, graph: PoseGraph) -> None:
    """Raise a FileFormatError unless the file has the poses and landmarks of a graph, no others."""
    ids = graph.pose_ids[graph.in_files]
    landmark_ids = graph.pose_ids[graph.landmarks]
    sizes = f"the file has {len(file.vertex_ids)}, {graph.name} {len(ids)}"
    way_out = "give an estimate of this graph"
    is_unknown = ~np.isin(file.vertex_ids, ids)
    if is_unknown.any():
        first = int(np.argmax(is_unknown))
        problem = (
            f"pose {file.vertex_ids[first]} is not in {graph.name} "
            f"({is_unknown.sum()} are not; {sizes}); {way_out}"
        )
        line = int(file.vertex_lines[first])
        raise FileFormatError(file.path, line, problem)
    is_absent = ~np.isin(ids, file.vertex_ids)
    if is_absent.any():
        first_absent = ids[np.argmax(is_absent)]
        problem = (
            f"no VERTEX line for pose {first_absent} "
            f"({is_absent.sum()} missing; {sizes}); {way_out}"
        )
        raise FileFormatError(file.path, None, problem)
    is_landmark = np.isin(file.vertex_ids, file.landmarks)
    is_landmark_of_graph = np.isin(file.vertex_ids, landmark_ids)
    differs = is_landmark != is_landmark_of_graph
    if differs.any():
        first = int(np.argmax(differs))
        kinds = "a landmark here and a pose" if is_landmark[first] else "a pose here and a landmark"
        problem = f"{file.vertex_ids[first]} is {kinds} of {graph.name}; {way_out}"
        line = int(file.vertex_lines[first])
        raise FileFormatError(file.path, line, problem)


def write_g2o(
    graph: PoseGraph, path: Path | str, poses: Poses | None = None, mine: BoolArray | None = None
) -> None:
    """Write a graph as one g2o file: VERTEX lines, FIX lines and EDGE lines.

    The numbers have all digits of the doubles. If the graph has no information matrices, they are
    made of its precisions: diag(tau, tau, kappa) in 2D and blockdiag(tau I_3, 2 kappa I_3) in 3D.
    Read, they give the same kappa and tau again. An existing file is replaced when the new one is
    complete.

    Parameters
    ----------
    graph : PoseGraph
        Graph to write.
    path : Path or str
        File to write.
    poses : Poses, optional
        Poses of the VERTEX lines; `graph.initial` unless given. The file has no VERTEX lines if
        both are None.
    mine : BoolArray, (n,), optional
        Poses that have VERTEX and FIX lines; all unless given.

    Examples
    --------
    >>> import tempfile
    >>> from pgo_models.graphs.scenes import grid
    >>> path = Path(tempfile.mkdtemp()) / "grid.g2o"
    >>> write_g2o(grid(np.random.default_rng(0)), path)
    >>> read_g2o(path)
    PoseGraph('grid', d=3, poses=27, edges=108, robots=1)
    """
    written_poses = _poses_to_write(graph, poses)
    all_edges = np.ones(graph.num_edges, dtype=bool)
    if mine is None:
        mine = np.ones(graph.num_poses, dtype=bool)
    check_shape(mine, (graph.num_poses,), "mine")
    _write(graph, Path(path), written_poses, mine, all_edges)


def write_g2o_folder(graph: PoseGraph, folder: Path | str, poses: Poses | None = None) -> None:
    """Write one file 0.g2o, 1.g2o, .. for each robot: its poses, and all edges that touch them.

    An edge between two robots is written to the files of both. Reading the folder gives the graph
    back, up to the order of its edges. If the files have no VERTEX lines, the owners of the poses
    come back only if the ids are symbols (`symbol_ids`).

    The folder is made if it does not exist. A PGOError if it has other g2o files, which a reader
    would take for a part of this graph; other errors are those of `write_g2o`.
    """
    written_poses = _poses_to_write(graph, poses)
    folder = Path(folder)
    check_g2o_folder(folder, graph.num_robots)
    make_folder(folder)
    for robot in range(graph.num_robots):
        mine = graph.robots == robot
        # A prior begins at the world pose. It belongs to the robot of the pose that it measures.
        begins_here = mine[graph.i] & ~graph.is_prior
        ends_here = mine[graph.j]
        path = folder / f"{robot}.g2o"
        _write(graph, path, written_poses, mine, begins_here | ends_here)


def make_folder(folder: Path) -> None:
    """Make a folder unless it exists; a PGOError if it cannot be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        problem = f"cannot write {folder}: {error.strerror}"
        raise PGOError(f"{problem}; choose a place that can be written") from error


def check_g2o_folder(folder: Path | str, num_robots: int) -> None:
    """Raise the PGOError that `write_g2o_folder` would raise, before there is anything to write."""
    folder = Path(folder)
    # Folders of the path that do not exist yet have to be made. `existing` is the innermost folder
    # that exists, and `new_entry` is what would be made in it: a folder, or the first file.
    existing = folder.absolute()
    new_entry = existing / "0.g2o"
    while not os.path.lexists(existing):
        new_entry = existing
        existing = existing.parent
    if not existing.is_dir():
        raise PGOError(
            f"cannot write {folder}: a name without a suffix is that of a folder, "
            f"and {existing} is not a folder; choose another name, or one that ends in .g2o"
        )
    check_writable(new_entry)
    expected_names = {f"{robot}.g2o" for robot in range(num_robots)}
    names = {file.name for file in folder.glob("*.g2o")}
    other_names = names - expected_names
    if other_names:
        raise PGOError(
            f"cannot write {folder}: it holds another graph's {min(other_names)}; "
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
    letters = LETTERS[26:] if count <= 26 else LETTERS
    ids = np.zeros(len(robots), dtype=np.int64)
    for robot in range(count):
        mine = robots == robot
        first_symbol = ord(letters[robot]) << LETTER_SHIFT
        ids[mine] = first_symbol + np.arange(mine.sum())
    return ids


def pose_names(graph: PoseGraph) -> list[str]:
    """Names of the poses for people.

    A GTSAM symbol is shown as its letter and index, another id as it is, the world pose by its
    name.
    """
    names = [graph.pose_name(pose) for pose in range(graph.num_poses)]
    poses = graph.in_files.tolist()
    ids = np.array([int(names[pose]) for pose in poses], dtype=np.int64)
    if not np.isin(ids >> LETTER_SHIFT, LETTER_CODES).all():
        return names
    is_landmark = np.isin(poses, graph.landmarks)
    _, num_bits = robot_letters(ids[~is_landmark])
    bits = np.where(is_landmark, LETTER_SHIFT, num_bits)
    letters = (ids >> bits) & 0xFF
    numbers = ids & ((1 << bits) - 1)
    for pose, letter, number in zip(poses, letters.tolist(), numbers.tolist(), strict=True):
        names[pose] = f"{chr(letter)}{number}"
    return names


def trajectories_of_robots(graph: PoseGraph) -> list[tuple[str, IntArray, IntArray]]:
    """Name, poses and numbers of the poses of every robot of a graph.

    The name is the letter that the ids have for it, and the numbers are their indices; else the
    number of the robot, and the ids themselves.
    """
    bodies = graph.bodies
    ids = graph.pose_ids[bodies].astype(np.int64)
    robots = graph.robots[bodies]
    letters, num_bits = robot_letters(ids)
    has_letters = bool(np.isin(letters, LETTER_CODES).all())
    trajectories = []
    for robot in range(graph.num_robots):
        own = robots == robot
        if not own.any():
            continue
        name = chr(int(letters[own][0])) if has_letters else str(robot)
        numbers = ids[own] & ((1 << num_bits) - 1) if has_letters else ids[own]
        trajectories.append((name, bodies[own], numbers))
    return trajectories


def name_of(path: Path) -> str:
    """Name of the graph in a file or folder, as the system has it."""
    if path.is_dir():
        return path.resolve().name
    # The resolved path of a pipe is no name. What is no regular file has the name that was given.
    name = path.resolve().stem if path.is_file() else path.stem
    return name.removesuffix(".g2o") if path.suffix == COMPRESSED else name


def g2o_files(path: Path) -> list[Path]:
    """The path itself if it is a file; the g2o files of a folder, in the order 0, 1, .., 9, 10.

    The file of the whole graph is left out, with a GraphWarning. A FileFormatError if the folder
    has no files.
    """
    if not path.is_dir():
        return [path]
    entries = [entry for entry in path.iterdir() if entry.suffix == ".g2o"]
    files = [entry for entry in entries if entry.is_file()]
    if not files:
        raise FileFormatError(
            path, None, "a folder without g2o files; give a file, or a folder with a file a robot"
        )
    of_robots = [file for file in files if file.name != _WHOLE_GRAPH]
    if 0 < len(of_robots) < len(files):
        warnings.warn(
            f"{printable(str(path / _WHOLE_GRAPH))}: left out, as it is the whole graph of the "
            f"other {len(of_robots)} files by its name; remove it, or rename it if it is a robot's",
            GraphWarning,
            stacklevel=3,
        )
        files = of_robots

    def natural_order(file: Path) -> list[tuple[int, str]]:  # 9 before 10
        return [(len(part), part) for part in re.findall(r"\d+|\D+", file.name)]

    return sorted(files, key=natural_order)


def _rows_to_keep(files: list[G2OLines]) -> list[IntArray | slice]:
    ids_and_rows = [(rows.ids, rows.numbers) for rows in _as_first_printed(files)]
    return edge_rows_to_keep(ids_and_rows)


def _as_first_printed(files: list[G2OLines]) -> list[Rows]:
    return edges_as_first_printed(files[0].d, [edge_rows(file) for file in files])


def _joined_edges(files: list[G2OLines]) -> tuple[IntArray, Array]:
    """Ids and rows of the edges of all files, each measurement once."""
    kept_rows = _rows_to_keep(files)
    edge_ids = []
    edges = []
    for file, kept in zip(files, kept_rows, strict=True):
        edge_ids.append(file.edge_ids[kept])
        edges.append(file.edges[kept])
    return np.concatenate(edge_ids), np.concatenate(edges)


def _remainders(files: list[G2OLines]) -> Array:
    """What the decimals of the edges of `_joined_edges` have beyond their doubles, (m, d)."""
    remainders = []
    for file, kept in zip(files, _rows_to_keep(files), strict=True):
        of_file = file.remainders
        if of_file is None:
            of_file = np.zeros((len(file.edges), file.d))
        remainders.append(of_file[kept])
    return np.concatenate(remainders)


def edge_rows_to_keep(files: Sequence[tuple[IntArray, Array]]) -> list[IntArray | slice]:
    """Rows of every file to keep, so that an edge that is in two files counts once.

    A file is given as the ids, (m, 2), and the numbers, (m, k), of its edges. Two rows are copies
    of one edge if their ids and numbers are equal.

    Copies within a file are measurements of their own, and all count. An edge with a copies in one
    file and b in another is kept max(a, b) times: the k-th copy of an edge is kept in the first
    file that has k copies or more.
    """
    if len(files) == 1:
        return [slice(None)]
    seen: set[tuple[bytes, int]] = set()  # an edge, and which of its copies
    kept: list[IntArray | slice] = []
    for edge_ids, edges in files:
        num_copies: dict[bytes, int] = {}
        new_rows = []
        positive_zeros = edges + 0.0  # -0.0 becomes 0.0, so that equal numbers have equal bytes
        rows = zip(edge_ids, positive_zeros, strict=True)
        for row, (ids, numbers) in enumerate(rows):
            edge = ids.tobytes() + numbers.tobytes()
            num_copies[edge] = num_copies.get(edge, 0) + 1
            copy = (edge, num_copies[edge])
            if copy not in seen:
                seen.add(copy)
                new_rows.append(row)
        kept.append(np.array(new_rows, dtype=np.int64))
    return kept


def _robots(
    ids: IntArray, files: list[G2OLines], letters_of_robots: Sequence[int]
) -> IntArray | None:
    """Robot of every pose by the cases (a) and (b) of `read_g2o`; None in case (c)."""
    letters = _letters_of_owners(ids, files)
    if np.isin(letters, letters_of_robots).all():
        return _ranks(letters)
    if len(files) == 1:
        return None
    owner = np.full(len(ids), -1, dtype=np.int64)
    ids_of_vertices = [file.vertex_ids for file in files]
    ids_of_edges = [file.edge_ids.ravel() for file in files]
    # The VERTEX lines of all files come before the edges of any.
    for ids_of_files in (ids_of_vertices, ids_of_edges):
        for robot, ids_of_file in enumerate(ids_of_files):
            is_in_files = ids_of_file != WORLD_ID
            poses = np.searchsorted(ids, ids_of_file[is_in_files])
            has_no_owner = owner[poses] < 0
            owner[poses[has_no_owner]] = robot
    return _ranks(owner)


def _letters_of_owners(ids: IntArray, files: list[G2OLines]) -> IntArray:
    """Codes of the letters of ids; a landmark that shares none with a pose has its observer's."""
    is_landmark = np.isin(ids, np.concatenate([file.landmarks for file in files]))
    of_poses, num_bits = robot_letters(ids[~is_landmark])
    letters = (ids >> num_bits) & 0xFF
    nameless = np.flatnonzero(is_landmark & ~np.isin(letters, of_poses))
    if not len(nameless) or not len(of_poses):
        return letters
    letters[nameless] = of_poses[0]
    edges = np.concatenate([file.edge_ids for file in files])
    edges = edges[np.isin(edges[:, 1], ids[nameless]) & (edges[:, 0] != WORLD_ID)]
    seen, first_sight = np.unique(edges[:, 1], return_index=True)
    observers = np.searchsorted(ids, edges[first_sight, 0])
    letters[np.searchsorted(ids, seen)] = letters[observers]
    return letters


def _ranks(values: IntArray) -> IntArray:
    """Rank of every value among the distinct ones."""
    _, rank = np.unique(values, return_inverse=True)
    return np.asarray(rank, dtype=np.int64)


def _estimate(
    ids: IntArray, robot: IntArray | None, files: list[G2OLines]
) -> tuple[Poses, BoolArray]:
    """Estimate of the VERTEX lines, and which poses have one, (n,); the others are anything.

    Of several VERTEX lines of a pose, the first in a file of its own robot counts; if there is no
    such line, the first in any file.
    """
    d = files[0].d
    num_columns = files[0].vertices.shape[1]
    numbers = np.zeros((len(ids), num_columns))
    numbers[:, -1] = d - 2  # the angle 0, or the w of the quaternion 0 0 0 1
    is_known = np.zeros(len(ids), dtype=bool)
    is_from_owner = np.zeros(len(ids), dtype=bool)
    for file in files:
        if not len(file.vertex_ids):
            continue
        poses = np.searchsorted(ids, file.vertex_ids)
        is_own = np.ones(len(poses), dtype=bool)
        if robot is not None:
            # Nothing in a file names its robot: the letters of symbols need not follow the order
            # of the files, and a file may also have VERTEX lines of neighbours. The robot that
            # owns most of the poses on its VERTEX lines is taken for that of the file.
            owners = robot[poses]
            robot_of_file = np.bincount(owners).argmax()
            is_own = owners == robot_of_file
        # A line replaces nothing, or, in a file of the own robot, a line of another robot's file.
        is_better = ~is_known[poses] | (is_own & ~is_from_owner[poses])
        replaced = poses[is_better]
        numbers[replaced] = file.vertices[is_better]
        is_known[poses] = True
        is_from_owner[replaced] = is_own[is_better]
    R, t = poses_of(d, numbers)
    return Poses(R, t), is_known


def _fixed(ids: IntArray, files: list[G2OLines]) -> IntArray:
    """Poses of the FIX lines, ascending; a FileFormatError for one that has no other line."""
    for file in files:
        problems = []
        for row in np.flatnonzero(~np.isin(file.fixed, ids)):
            problem = f"FIX names pose {file.fixed[row]}, which has no other line; remove it"
            problems.append((int(file.fixed_lines[row]), problem))
        check_lines(file.path, problems)
    fixed_ids = np.concatenate([file.fixed for file in files])
    fixed_poses = np.searchsorted(ids, fixed_ids)
    return np.unique(fixed_poses)


def _poses_to_write(graph: PoseGraph, poses: Poses | None) -> Poses | None:
    """Given poses, else the estimate; a GraphError when they do not have the size of the graph."""
    written = graph.initial if poses is None else poses
    if written is not None:
        written = graph.with_world_of(written)
    expected_shape = (graph.num_poses, graph.d)
    if written is not None and written.t.shape != expected_shape:
        raise GraphError(
            f"poses are {written}; {graph.name} needs {graph.num_poses} of them in {graph.d}D"
        )
    if written is not None and graph.has_far_priors:
        return graph.in_frame_of_priors(written)
    return written


def _write(
    graph: PoseGraph, path: Path, poses: Poses | None, mine: BoolArray, edges: BoolArray
) -> None:
    """Write VERTEX and FIX lines of the poses `mine`, (n,), and EDGE lines of `edges`, (m,)."""
    with (
        replace_when_done(path) as temporary,
        temporary.open("w", encoding="ascii", newline="\n") as file,
    ):
        # Lines of priors and landmarks in space name the offset 0, of a sensor at its pose.
        to_landmark = np.isin(graph.j, graph.landmarks)
        needs_offset = edges & (graph.is_prior | to_landmark)
        if graph.d == 3 and needs_offset.any():
            file.write("PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\n")
        if poses is not None:
            file.writelines(_vertex_lines(graph, poses, mine))
        fixed = graph.fixed[mine[graph.fixed]]
        fixed_ids = graph.pose_ids[fixed]
        file.writelines(f"FIX {pose_id}\n" for pose_id in fixed_ids)
        file.writelines(_edge_lines(graph, edges))


def _written_tags(d: int, is_edge: bool) -> dict[str, Tag]:
    """Tags of the VERTEX or EDGE lines that are written in d dimensions."""
    written = {}
    for tag, kind in G2O_TAGS.items():
        if kind.d == d and kind.is_edge == is_edge:
            written[tag] = kind
    return written


def _vertex_lines(graph: PoseGraph, poses: Poses, mine: BoolArray) -> Iterator[str]:
    """VERTEX lines of the poses `mine`, (n,)."""
    pose = np.arange(graph.num_poses)
    is_landmark = np.isin(pose, graph.landmarks)
    is_written = mine & (pose != graph.world)
    tags = _written_tags(graph.d, is_edge=False)
    for tag, kind in tags.items():
        is_of_kind = is_landmark == kind.is_point
        chosen = np.flatnonzero(is_written & is_of_kind)
        ids = graph.pose_ids[chosen, None]
        numbers = _numbers(poses[chosen], kind)
        yield from lines_of(tag, ids, numbers)


def _edge_lines(graph: PoseGraph, edges: BoolArray) -> Iterator[str]:
    """EDGE lines of some edges, (m,)."""
    d = graph.d
    information = matrices_of_edges(graph)
    to_landmark = np.isin(graph.j, graph.landmarks)
    # The line of a position prior has no rotation, and is read as R_ij = I with kappa = 0. A prior
    # with another R_ij, whose information is in that frame, is therefore written with a rotation.
    is_unturned = (graph.R_ij == np.eye(d)).all(axis=(1, 2))
    is_position_prior = graph.is_prior & (graph.kappa == 0) & is_unturned
    is_point = to_landmark | is_position_prior
    ids_i = graph.pose_ids[graph.i]
    ids_j = graph.pose_ids[graph.j]
    end_ids = np.stack([ids_i, ids_j], axis=1)
    tags = _written_tags(d, is_edge=True)
    for tag, kind in tags.items():
        is_of_kind = (
            (graph.is_prior == (kind.num_ids == 1))
            & (to_landmark == kind.to_landmark)
            & (is_point == kind.is_point)
        )
        chosen = np.flatnonzero(edges & is_of_kind)
        measured_poses = Poses(graph.R_ij[chosen], graph.t_ij[chosen])
        measured = _numbers(measured_poses, kind)
        # The line of a point has the d x d block of the translation alone.
        side = d if kind.is_point else information.shape[-1]
        triangles = information[chosen][:, *np.triu_indices(side)]
        numbers = np.concatenate([measured, triangles], axis=1)
        # The line of a prior names the measured pose alone, which is the second end of the edge.
        ids = end_ids[chosen, -kind.num_ids :]
        offset = "0 " * kind.num_offsets
        origin = graph.origin if kind.num_ids == 1 else None
        yield from lines_of(tag, ids, numbers, offset, origin)


def _numbers(poses: Poses, kind: Tag) -> Array:
    """Numbers of poses, (n, ..), as they stand on lines of a kind."""
    if kind.is_point:
        return poses.t
    return numbers_of(poses.R, poses.t)
