"""Measurements of a g2o file as exact numbers: the verifier's own reader, which nothing else uses.

A number of the file is the rational number that its digits say, and the information that belongs to
a covariance matrix is its inverse, exactly. Tags and conventions are those of g2o, GTSAM and TORO:
information is in the frame measured, of a position prior in the world's, of a landmark in the
pose's.
"""

import gzip
import io
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

from pgo_models.errors import FileFormatError
from pgo_models.verification.balls import (
    angles_rotation,
    arb_mat,
    first_bad_pivot,
    fmpq,
    fmpq_mat,
    identity,
    plane_rotation,
    quaternion_rotation,
    symmetric,
)


@dataclass(frozen=True)
class Tag:
    """What stands behind a tag: ids, the measurement, and the triangle of its information matrix.

    `has_offset`: the id of a PARAMS_SE3OFFSET line may follow the ids. `is_toro`: in space angles
    roll, pitch, yaw instead of a quaternion, in the plane another order of the triangle.
    `has_covariance`: the triangle is that of the covariance matrix.
    """

    d: int
    num_ids: int = 2  # with one, what is measured is the pose in the frame of the world
    is_point: bool = False  # a position without a rotation
    to_landmark: bool = False
    has_offset: bool = False
    is_toro: bool = False
    has_covariance: bool = False

    @property
    def num_measured(self) -> int:
        """How many numbers the measurement has."""
        if self.is_point:
            return self.d
        if self.d == 2:
            return 3
        return 6 if self.is_toro else 7

    @property
    def side(self) -> int:
        """Rows of the information matrix."""
        return self.d if self.is_point else 3 * self.d - 3


TAGS = {
    "EDGE_SE2": Tag(2),
    "EDGE_SE3:QUAT": Tag(3),
    "EDGE_SE2_XY": Tag(2, is_point=True, to_landmark=True),
    "LANDMARK2": Tag(2, is_point=True, to_landmark=True),
    "EDGE_SE3_TRACKXYZ": Tag(3, is_point=True, to_landmark=True, has_offset=True),
    "EDGE_PRIOR_SE2": Tag(2, num_ids=1),
    "EDGE_SE2_PRIOR": Tag(2, num_ids=1),
    "EDGE_SE3_PRIOR": Tag(3, num_ids=1, has_offset=True),
    "EDGE_PRIOR_SE3": Tag(3, num_ids=1, has_offset=True),
    "EDGE_PRIOR_SE2_XY": Tag(2, num_ids=1, is_point=True),
    "EDGE_SE3_XYZ_PRIOR": Tag(3, num_ids=1, is_point=True, has_offset=True),
    "EDGE_PRIOR_XY": Tag(2, num_ids=1, is_point=True, to_landmark=True),
    "EDGE_POINTXYZ_PRIOR": Tag(3, num_ids=1, is_point=True, to_landmark=True),
    "EDGE2": Tag(2, is_toro=True),
    "EDGE3": Tag(3, is_toro=True),
    "ODOMETRY": Tag(2, has_covariance=True),
    "LANDMARK": Tag(2, is_point=True, to_landmark=True, has_covariance=True),
}
LANDMARK_TAGS = ("VERTEX_XY", "VERTEX_TRACKXYZ")
POSE_TAGS = ("VERTEX_SE2", "VERTEX_SE3:QUAT", "VERTEX2", "VERTEX3")
# They are no part of the cost.
DATA_TAGS = ("ROBOTLASER1", "ROBOTLASER2", "RAWLASER1", "VERTEX_TAG", "VERTEX_ELLIPSE")
IGNORED_TAGS = (*POSE_TAGS, *DATA_TAGS, "FIX", "EQUIV")
COMMENT = re.compile(r"(#|//|%).*")
# Places of xx xy xr yy yr rr in TORO's order of the plane, xx xy yy rr xr yr.
TORO_TRIANGLE = (0, 1, 4, 2, 5, 3)
WRITTEN_FILE = "verify the proof of the file that pgo solve --out one.g2o writes"
WORLD = 2**63  # the pose that priors are measured from; ids have 64 bits, with a sign
NUMBER = re.compile(r"([+-]?)(\d*)\.?(\d*)(?:[eE]([+-]?\d{1,3}))?", re.ASCII)
LONGEST_WORD = 1000  # characters of a number; the time to read one grows with their square
GZIP = b"\x1f\x8b"  # first bytes of a file that is compressed by gzip


@dataclass(frozen=True, eq=False)
class Edge:
    """A measurement of pose or landmark j in the frame of pose i."""

    line: int
    tag: Tag
    i: int
    j: int
    measured: tuple[fmpq, ...]
    triangle: tuple[fmpq, ...]
    # Upper triangle of the covariance matrix, whose inverse the information is; empty where the
    # file has the information.
    covariance: tuple[fmpq, ...] = ()

    @property
    def t(self) -> arb_mat:
        """t_ij, (d, 1)."""
        return arb_mat([[number] for number in self.measured[: self.tag.d]])

    @property
    def R(self) -> arb_mat:
        """R_ij, (d, d), that of a normalised quaternion; of a position the identity."""
        if self.tag.is_point:
            return identity(self.tag.d)
        if self.tag.d == 2:
            return plane_rotation(self.measured[2])
        if self.tag.is_toro:
            return angles_rotation(*self.measured[3:])
        return quaternion_rotation(*self.measured[3:])

    def block(self, rows: range, columns: range) -> fmpq_mat:
        """Some rows and columns of the information matrix, translation first."""
        information = symmetric(self.triangle, self.tag.side)
        entries = [[information[a][b] for b in columns] for a in rows]
        return fmpq_mat(entries)


@dataclass(frozen=True, eq=False)
class Graph:
    """What a file says of the cost: its edges, and which of the ids they name are landmarks."""

    d: int
    edges: list[Edge]
    landmarks: set[int]

    @property
    def nodes(self) -> set[int]:
        """Poses, landmarks, and where there are priors the world."""
        return {node for edge in self.edges for node in (edge.i, edge.j)}


def read_graph(path: Path, skip_unknown: bool) -> Graph:
    """Edges of a g2o file; a FileFormatError names the line that is wrong."""
    edges: list[Edge] = []
    landmarks: set[int] = set()
    point_vertices: set[int] = set()
    pose_vertices: set[int] = set()
    offset_line = 0  # of a sensor that is not at its pose
    lines = read_text(path).split("\n")
    for number, line in enumerate(lines, 1):
        tag, *words = COMMENT.sub("", line).split() or ["FIX"]
        if tag in TAGS:
            edge = read_edge(path, number, TAGS[tag], words)
            edges.append(edge)
        elif tag in LANDMARK_TAGS:
            point_vertices.add(read_id(path, number, words[0] if words else ""))
        elif tag in POSE_TAGS:
            pose_vertices.add(read_id(path, number, words[0] if words else ""))
        elif tag == "PARAMS_SE3OFFSET":
            if any(exact_number(path, number, word) != 0 for word in words[1:7]):
                offset_line = number
        elif not skip_unknown:
            check_ignored_tag(path, number, tag)
    check_offset(path, edges, offset_line)
    edges = [positions_of_poses(edge, pose_vertices - point_vertices) for edge in edges]
    landmarks |= point_vertices | {edge.j for edge in edges if edge.tag.to_landmark}
    edges = in_order_of_toro(in_order_of_isam(edges))
    edges, landmarks = apart_from_poses(edges, landmarks, pose_vertices)
    return checked_graph(path, edges, landmarks)


def positions_of_poses(edge: Edge, poses: set[int]) -> Edge:
    """The edge; where it is a prior of a point that is a pose, one of the position of the pose."""
    if edge.tag.to_landmark and edge.tag.num_ids == 1 and edge.j in poses:
        return replace(edge, tag=replace(edge.tag, to_landmark=False))
    return edge


def checked_graph(path: Path, edges: list[Edge], landmarks: set[int]) -> Graph:
    """Graph of edges and landmarks; a FileFormatError where they are none."""
    if not edges:
        raise FileFormatError(path, None, "no measurement in it; give the file that was solved")
    graph = Graph(edges[0].tag.d, edges, landmarks)
    for edge in edges:
        check_edge(path, graph, edge)
    return graph


def apart_from_poses(
    edges: list[Edge], landmarks: set[int], pose_vertices: set[int]
) -> tuple[list[Edge], set[int]]:
    """Edges and landmarks with ids that no pose has.

    GTSAM numbers landmarks and poses each from zero. Where an edge to a landmark names the id of a
    pose, the least power of ten that puts all landmarks above the poses is added to their ids.
    """
    poses = set(pose_vertices)
    for edge in edges:
        poses.add(edge.i)
        if not edge.tag.to_landmark:
            poses.add(edge.j)
    poses.discard(WORLD)
    if not any(edge.tag.to_landmark and edge.j in poses for edge in edges):
        return edges, landmarks
    shift = 10
    while shift + min(*landmarks, 0) <= max(poses):
        shift *= 10
    shifted = [replace(edge, j=edge.j + shift) if edge.tag.to_landmark else edge for edge in edges]
    return shifted, {landmark + shift for landmark in landmarks}


def in_order_of_isam(edges: list[Edge]) -> list[Edge]:
    """Edges with the matrices of EDGE2 lines by rows, as iSAM writes them, if that is their order.

    It is where all of them are positive definite by rows, and some are not in TORO's order.
    """
    by_rows = {}
    for place, edge in enumerate(edges):
        if edge.tag.is_toro and edge.tag.d == 2:
            triangle = [fmpq(0)] * len(TORO_TRIANGLE)
            for entry, place_on_line in zip(edge.triangle, TORO_TRIANGLE, strict=True):
                triangle[place_on_line] = entry
            by_rows[place] = replace(edge, triangle=tuple(triangle))
    if all(is_definite(edges[place]) for place in by_rows):
        return edges
    if not all(map(is_definite, by_rows.values())):
        return edges
    return [by_rows.get(place, edge) for place, edge in enumerate(edges)]


def in_order_of_toro(edges: list[Edge]) -> list[Edge]:
    """Edges with the matrices of EDGE_SE2 lines in TORO's order, if that is their order.

    It is where one of them is indefinite by rows, and all are positive definite in TORO's order.
    """
    in_toro_order = {
        place: replace(edge, triangle=tuple(edge.triangle[k] for k in TORO_TRIANGLE))
        for place, edge in enumerate(edges)
        if edge.tag == TAGS["EDGE_SE2"]
    }
    if all(is_semidefinite(edges[place]) for place in in_toro_order):
        return edges
    if not all(map(is_definite, in_toro_order.values())):
        return edges
    return [in_toro_order.get(place, edge) for place, edge in enumerate(edges)]


def is_semidefinite(edge: Edge) -> bool:
    """Whether no eigenvalue of the information matrix is negative: no principal minor is."""
    rows = symmetric(edge.triangle, edge.tag.side)
    if first_bad_pivot(rows) is None:
        return True
    side = edge.tag.side
    minors = (
        fmpq_mat([[rows[a][b] for b in places] for a in places]).det()
        for size in range(1, side + 1)
        for places in combinations(range(side), size)
    )
    return all(minor >= 0 for minor in minors)


def is_definite(edge: Edge) -> bool:
    """Whether the information matrix is positive definite: its leading minors are positive."""
    sizes = range(1, edge.tag.side + 1)
    return all(edge.block(range(size), range(size)).det() > 0 for size in sizes)


def check_ignored_tag(path: Path, line: int, tag: str) -> None:
    """Raise a FileFormatError unless a tag is one of those whose lines say nothing of edges."""
    if tag in IGNORED_TAGS or tag.startswith("PARAMS_"):
        return
    known = ", ".join([*TAGS, *LANDMARK_TAGS, *IGNORED_TAGS])
    problem = f"unknown tag {tag[:40]!r}; known are {known}; use --skip-unknown, or {WRITTEN_FILE}"
    raise FileFormatError(path, line, problem)


def check_offset(path: Path, edges: list[Edge], offset_line: int) -> None:
    """Raise a FileFormatError where edges are seen from a sensor that is not at its pose.

    `offset_line` is the line that says so of a sensor, 0 where there is none.
    """
    if offset_line and any(edge.tag.has_offset for edge in edges):
        problem = f"a sensor that is not at its pose; {WRITTEN_FILE}"
        raise FileFormatError(path, offset_line, problem)


def check_edge(path: Path, graph: Graph, edge: Edge) -> None:
    """Raise a FileFormatError where an edge does not go with the rest of its file."""
    problem = ""
    if edge.tag.d != graph.d:
        problem = "2D and 3D lines in one file; give one file for each"
    elif edge.i == edge.j:
        problem = "an edge from a pose to itself; remove it"
    elif edge.i in graph.landmarks or (edge.j in graph.landmarks and not edge.tag.is_point):
        problem = f"an edge that takes a landmark for a pose; {WRITTEN_FILE}"
    if problem:
        raise FileFormatError(path, edge.line, problem)


def read_edge(path: Path, line: int, tag: Tag, words: list[str]) -> Edge:
    """Edge of the words behind its tag."""
    size_of_triangle = tag.side * (tag.side + 1) // 2
    num_words = tag.num_ids + tag.num_measured + size_of_triangle
    if tag.has_offset and len(words) == num_words + 1:
        words = words[: tag.num_ids] + words[tag.num_ids + 1 :]
    if len(words) != num_words:
        problem = f"{len(words)} words behind the tag, {num_words} belong there; complete the line"
        raise FileFormatError(path, line, problem)
    ids = [read_id(path, line, word) for word in words[: tag.num_ids]]
    numbers = [exact_number(path, line, word) for word in words[tag.num_ids :]]
    measured = numbers[: tag.num_measured]
    triangle = numbers[tag.num_measured :]
    if tag.num_measured == 7 and not any(measured[3:]):
        problem = "zero quaternion; it is no rotation: 0 0 0 1 is the unrotated one"
        raise FileFormatError(path, line, problem)
    if tag.is_toro and tag.d == 2:
        triangle = [triangle[place] for place in TORO_TRIANGLE]
    if tag.num_ids == 1:
        ids = [WORLD, *ids]
    i, j = ids
    if tag.has_covariance:
        information = inverse_triangle(path, line, triangle, tag.side)
        return Edge(line, tag, i, j, tuple(measured), information, tuple(triangle))
    return Edge(line, tag, i, j, tuple(measured), tuple(triangle))


def inverse_triangle(
    path: Path, line: int, covariance: Sequence[fmpq], side: int
) -> tuple[fmpq, ...]:
    """Upper triangle of the information matrix of a covariance matrix, exactly."""
    rows = symmetric(covariance, side)
    if first_bad_pivot(rows) is not None:
        problem = "the covariance matrix is not positive definite; correct or remove it"
        raise FileFormatError(path, line, problem)
    information = fmpq_mat(rows).inv()
    return tuple(information[a, b] for a in range(side) for b in range(a, side))


def read_id(path: Path, line: int, word: str) -> int:
    """Id of a pose, an integer of 64 bits."""
    is_integer = re.fullmatch(r"[+-]?[0-9]{1,19}", word) is not None
    if not is_integer or abs(int(word)) >= WORLD:
        problem = f"id {word[:40]!r} is no integer of 64 bits; number the poses"
        raise FileFormatError(path, line, problem)
    return int(word)


def exact_number(path: Path, line: int, word: str) -> fmpq:
    """The rational number that a word like -1.5e-3 stands for."""
    parts = NUMBER.fullmatch(word) if len(word) <= LONGEST_WORD else None
    if parts is None or not (parts[2] or parts[3]):
        problem = f"{word[:40]!r} is no finite number; correct or remove the line"
        raise FileFormatError(path, line, problem)
    sign, integer, fraction, exponent = parts.groups(default="0")
    digits = int(f"{sign}{integer}{fraction}")
    power = int(exponent) - len(fraction)
    if power >= 0:
        return fmpq(digits * 10**power)
    return fmpq(digits, 10**-power)


def read_text(path: Path) -> str:
    """Text of a UTF-8 file, which gzip may have compressed; else a FileFormatError."""
    if path.is_dir():
        problem = "a folder; verify the file that pgo solve --out one.g2o writes of it"
        raise FileFormatError(path, None, problem)
    try:
        content = path.read_bytes()
        if content.startswith(GZIP):
            content = gzip.decompress(content)
        return io.TextIOWrapper(io.BytesIO(content), encoding="utf-8-sig").read()
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        problem = "gzip cannot unpack it, as it is cut off or damaged; compress it again"
        raise FileFormatError(path, None, problem) from error
    except OSError as error:
        problem = f"cannot be read: {error.strerror}; give a readable file"
        raise FileFormatError(path, None, problem) from error
    except UnicodeDecodeError as error:
        raise FileFormatError(path, None, "bytes that are no text; give a text file") from error
