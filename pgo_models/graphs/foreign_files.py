"""Files of other programs as lines of g2o: Open3D's pose graphs, view graphs, and tables.

What a file is follows from its first lines. A table and a view graph become a file with the same
number of lines, so that messages name the lines of the file itself.
"""

import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from pgo_models.errors import FileFormatError, GraphWarning, printable
from pgo_models.files import Problem, check_lines, json_of
from pgo_models.geometry.rotations import (
    Array,
    BoolArray,
    project_to_rotations,
    quaternions_from_rotations,
    rotations_from_quaternions,
)
from pgo_models.graphs.tables import COMMENT_SIGNS, UNIT_ROTATION, lines_of_table, table_of

# Words on a line of a view graph: i j, a quaternion or a rotation by rows, perhaps a translation.
# One more is a weight, such as the number of matches.
_QUATERNION_WORDS = (6, 9)
_VIEW_WORDS = (*_QUATERNION_WORDS, 11, 14)
_CLEARLY = 0.7  # share of a misfit that is better not only by chance
_FAR = 1.0  # misfit of a cycle that has a wrong edge, or is read in the wrong order
_NOT_UNIT = 1e-3  # of a quaternion or matrix that is no rotation
_FEW_TRIANGLES = 2000  # of views that are compared
_OPEN3D = "what its write_pose_graph writes"
# Files that are no text of measurements, and what exports them.
_EXPORTED_BY = {
    ".pbstream": "a state of Cartographer; its constraints are printed by cartographer_pbstream "
    "info --all_debug_strings: write them as lines of g2o",
    ".posegraph": "a graph that slam_toolbox has serialized; load it with deserialize_map, and "
    "write its constraints as lines of g2o",
    ".pyfg": "a factor graph of PyFG; read it with py_factor_graph (read_from_pyfg_text), and "
    "write its measurements as lines of g2o",
    ".db": "a data base, as of RTAB-Map; rtabmap-export --poses --poses_format 4 "
    "writes g2o: give that",
}


def as_g2o(path: Path, blocks: Iterable[str]) -> Iterator[str]:
    """Blocks of lines of g2o, of a file of another program or of g2o itself."""
    suffix = path.with_suffix("").suffix if path.suffix.lower() == ".gz" else path.suffix
    if suffix.lower() in _EXPORTED_BY:
        raise FileFormatError(path, None, _EXPORTED_BY[suffix.lower()])
    if path.suffix.lower() == ".json" and path.is_file():
        return iter([_of_open3d(path)])
    stream = iter(blocks)
    opening = next(stream, "")
    rest = chain([opening], stream)
    line, first, second = _first_lines(opening)
    if first.lstrip().startswith("{"):
        return iter([_of_open3d(path, "".join(rest))])
    if _view(first) is not None or (_is_count(first) and _view(second) is not None):
        return iter([_of_views(path, "".join(rest))])
    if _has_names_for_ids(first.split()):
        raise FileFormatError(path, line, _EXPORTED_BY[".pyfg"])
    table = table_of(path, line, first)
    if table is None and line > 1 and first.lstrip("\"' ")[:1].isdigit():
        # The header of numbers may be the last comment.
        before = opening.split("\n")[line - 2]
        table = table_of(path, line - 1, before)
    if table is not None:
        return iter([lines_of_table(path, table, "".join(rest))])
    return rest


def _first_lines(text: str) -> tuple[int, str, str]:
    """The first two lines with words that are no comments, and the number of the first."""
    numbered = ((number, line) for number, line in enumerate(text.split("\n"), 1))
    with_words = (pair for pair in numbered if _has_words(pair[1]))
    number, first = next(with_words, (1, ""))
    _, second = next(with_words, (number, ""))
    return number, first, second


def _has_words(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith(COMMENT_SIGNS)


def _is_count(line: str) -> bool:
    """Whether a line has numbers of views and pairs, as some view graphs open with."""
    words = line.split()
    return len(words) <= 2 and all(map(str.isdigit, words))


def _has_names_for_ids(words: list[str]) -> bool:
    """Whether words are a line of PyFG: behind the tag a time and a name such as A0."""
    is_tag = bool(words) and words[0].startswith(("VERTEX_", "EDGE_"))
    return is_tag and len(words) > 2 and re.fullmatch(r"[A-Z][0-9]+", words[2]) is not None


# Open3D


def _of_open3d(path: Path, text: str | None = None) -> str:
    """Lines of g2o of Open3D's PoseGraph, in a file or a text, on the lines where they begin.

    An edge has the transformation X from source to target, which is x_target^-1 x_source, and the
    information of its error, the rotation first. Both are stored by columns.
    """
    record = json_of(path, text, _OPEN3D)
    nodes, edges = _nodes_and_edges(record)
    if not edges:
        raise FileFormatError(path, None, f"no PoseGraph of Open3D with edges; give {_OPEN3D}")
    entries = [*((_vertex_line, node) for node in nodes), *((_edge_line, edge) for edge in edges)]
    lines = (path.read_text() if text is None else text).split("\n")
    of_nodes, of_edges = (
        [place for place, line in enumerate(lines) if key in line]
        for key in ('"pose"', '"transformation"')
    )
    places = [*of_nodes, *of_edges]
    if len(of_nodes) != len(nodes) or len(set(places)) != len(entries):  # not one a line
        places = list(range(len(entries)))
    written = [""] * (max(places) + 1)
    problems: list[Problem] = []
    for k, (line_of, entry) in enumerate(entries):
        try:
            written[places[k]] = line_of(k, entry)
        except (KeyError, TypeError, ValueError) as error:
            name = f"edge {k - len(nodes)}" if k >= len(nodes) else f"node {k}"
            problem = f"{name} of Open3D's PoseGraph cannot be read ({error}); correct it"
            problems.append((places[k] + 1, problem))
    check_lines(path, problems)
    num_uncertain = sum(bool(edge.get("uncertain")) for edge in edges)
    if num_uncertain:
        warnings.warn(
            f"{printable(str(path))}: {num_uncertain} of {len(edges)} edges are uncertain, as "
            "Open3D marks loop closures; --robust gnc finds wrong ones",
            GraphWarning,
            stacklevel=2,
        )
    return "\n".join(written) + "\n"


def _nodes_and_edges(record: Any) -> tuple[list[Any], list[Any]]:  # noqa: ANN401
    """Nodes and edges of Open3D's PoseGraph; none where a record is no such graph."""
    lists = [record.get(name) if isinstance(record, dict) else None for name in ("nodes", "edges")]
    nodes, edges = (entries if isinstance(entries, list) else [] for entries in lists)
    return nodes, edges


def certain_edges(path: Path) -> BoolArray | None:
    """Whether Open3D calls an edge certain, (m,), in the order of a file; None of other files.

    Uncertain edges, mostly loop closures, are the suspects of its own robust optimisation.
    """
    if not path.is_file() or path.suffix.lower() != ".json":
        return None
    _, edges = _nodes_and_edges(json_of(path, None, _OPEN3D))
    return np.array([not edge.get("uncertain") for edge in edges], dtype=bool)


def _vertex_line(number: int, node: dict[str, list[float]]) -> str:
    pose = np.array(node["pose"], dtype=float).reshape(4, 4).T
    return f"VERTEX_SE3:QUAT {number} {_words_of_pose(pose[:3, :3], pose[:3, 3])}"


def _edge_line(_: int, edge: dict[str, list[float]]) -> str:
    X = np.array(edge["transformation"], dtype=float).reshape(4, 4).T
    information = np.array(edge["information"], dtype=float).reshape(6, 6)
    translation_first = np.roll(information, 3, axis=(0, 1))
    triangle = 0.5 * (translation_first + translation_first.T)[np.triu_indices(6)]
    ends = f"{edge['target_node_id']} {edge['source_node_id']}"
    words = _words_of_pose(X[:3, :3], X[:3, 3])
    return f"EDGE_SE3:QUAT {ends} {words} {_words(triangle)}"


def _words_of_pose(R: Array, t: Array) -> str:
    quaternion = quaternions_from_rotations(project_to_rotations(R[None]))[0]
    return f"{_words(t)} {_words(quaternion)}"


def _words(numbers: Array) -> str:
    return " ".join(map(repr, numbers.tolist()))


# View graphs


def _view(line: str) -> Array | None:
    """Rotation, (3, 3), between two views with ids or names; None if a line has no such thing.

    It is given by rows, as in EGs.txt, or as a quaternion, its w first, as GLOMAP reads it. A
    translation may follow, and a weight.
    """
    words = _words_of(line)
    if _has_weight(words):
        words.pop()
    are_numbers = [word.isdigit() for word in words[:2]]
    if len(words) not in _VIEW_WORDS or are_numbers[0] is not are_numbers[1]:
        return None
    try:
        numbers = np.array(words[2:], dtype=float)
    except ValueError:
        return None
    if len(words) in _QUATERNION_WORDS:
        w, x, y, z = numbers[:4]
        is_unit = abs(np.linalg.norm(numbers[:4]) - 1.0) < _NOT_UNIT
        return rotations_from_quaternions(np.array([[x, y, z, w]]))[0] if is_unit else None
    R = numbers[:9].reshape(3, 3)
    is_rotation = np.abs(R @ R.T - np.eye(3)).max() < _NOT_UNIT and np.linalg.det(R) > 0.0
    return R if is_rotation else None


def _has_weight(words: list[str]) -> bool:
    """Whether there is one word more than a view takes."""
    return len(words) not in _VIEW_WORDS and len(words) - 1 in _VIEW_WORDS


def _words_of(line: str) -> list[str]:
    """Words of a line, which commas may separate, without a comment behind them."""
    return line.partition("#")[0].replace(",", " ").split()


def _of_views(path: Path, text: str) -> str:
    """Lines of g2o of a view graph: rotations alone, as the translations have no length.

    Programs differ in whether R_ij is R_i^T R_j or R_j R_i^T of cameras that see the world: cycles
    of three views tell.
    """
    lines = text.split("\n")
    rotations = _rotations_of_views(path, lines)
    ends = {place: _words_of(lines[place])[:2] for place in rotations}
    names = sorted({name for pair in ends.values() for name in pair})
    are_named = not names[0].isdigit()
    number_of = {name: k if are_named else int(name) for k, name in enumerate(names)}
    pairs = {place: (number_of[i], number_of[j]) for place, (i, j) in ends.items()}
    are_transposed = _are_transposed({pairs[place]: R for place, R in rotations.items()}, are_named)
    written = [""] * len(lines)
    for place, R in rotations.items():
        i, j = pairs[place]
        pose = _words_of_pose(R.T if are_transposed else R, np.zeros(3))
        written[place] = f"EDGE_SE3:QUAT {i} {j} {pose} {UNIT_ROTATION}"
    notes = ["R_j R_i^T of R_i, from the world to camera i" if are_transposed else "R_i^T R_j"]
    if any(_has_weight(_words_of(lines[place])) for place in rotations):
        notes.append("the last column, taken for a weight, is not used")
    if are_named:
        last = len(names) - 1
        notes.append(f"views have the numbers 0 ({names[0]}) to {last} ({names[-1]}), sorted")
    warnings.warn(
        f"{printable(str(path))}: a view graph, of which the rotations are read, as "
        f"{printable('; '.join(notes))}",
        GraphWarning,
        stacklevel=2,
    )
    return "\n".join(written)


def _rotations_of_views(path: Path, lines: Sequence[str]) -> dict[int, Array]:
    """Rotations of a view graph, by the places of their lines; a count may come before them."""
    rotations: dict[int, Array] = {}
    for place, line in enumerate(lines):
        is_count_before = not rotations and _is_count(line)
        if not _has_words(line) or is_count_before:
            continue
        R = _view(line)
        if R is None:
            problem = (
                "no view: give two ids or names, a rotation by rows or as qw qx qy qz, and a "
                "translation or nothing"
            )
            raise FileFormatError(path, place + 1, problem)
        rotations[place] = R
    return rotations


def _are_transposed(rotations: dict[tuple[int, int], Array], by_default: bool) -> bool:
    """Whether cycles of three views fit R_jk R_ij = R_ik better than R_ij R_jk = R_ik.

    The default is returned where they do not tell.
    """
    successors: dict[int, list[int]] = {}
    for i, j in rotations:
        successors.setdefault(i, []).append(j)
    misfits: list[tuple[float, float]] = []
    for (i, j), first in rotations.items():
        for k in successors.get(j, []):
            if (i, k) in rotations and len(misfits) < _FEW_TRIANGLES:
                second = rotations[j, k]
                third = rotations[i, k]
                direct = np.linalg.norm(first @ second - third)
                transposed = np.linalg.norm(second @ first - third)
                misfits.append((float(direct), float(transposed)))
    if not misfits:
        return by_default
    # Right rotations that commute fit in both orders, and a wrong one fits in none.
    of_direct, of_transposed = np.minimum(misfits, _FAR).sum(axis=0)
    if by_default:
        return not bool(of_direct < _CLEARLY * of_transposed)
    return bool(of_transposed < _CLEARLY * of_direct)
