"""Tables of measurements between poses, whose header names the columns, as lines of g2o.

Case, blanks and signs in a name do not count: `From ID`, `from_id` and `"fromId"` are one. What a
column stands for follows from its name, and columns with other names are not used.
"""

import re
import warnings
from dataclasses import dataclass
from pathlib import Path

from pgo_models.errors import FileFormatError, GraphWarning, printable
from pgo_models.files import Problem, check_lines, finite_number
from pgo_models.graphs.g2o_tags import COVARIANCE_TAGS, Noise

COMMENT_SIGNS = ("#", "//", "%")
UNIT_ROTATION = " ".join(["0"] * 15 + ["1 0 0 1 0 1"])  # information of a rotation alone
# Words beside those that say which pose of a measurement is meant.
_NOUNS = re.compile(r"keyframe|vertex|camera|image|frame|index|pose|node|view|name|idx|key|id")
_FIRST = {"i", "from", "1", "a", "source", "src", "start", "parent"}
_SECOND = {"j", "to", "2", "b", "target", "dst", "end", "child"}
_HEADINGS = ("theta", "yaw", "heading", "angle", "th")
_MEASURED = re.compile(
    rf"(?:delta|meas|rel|d|t)?(q?[xyz]|qw|roll|pitch|{'|'.join(_HEADINGS)})(?:m|rad)?"
)
# What is measured, the tag of such lines, and the rows of their matrices.
_MEASUREMENTS = (
    (("x", "y", "z", "qx", "qy", "qz", "qw"), "EDGE_SE3:QUAT", 6),
    (("x", "y", "z", "roll", "pitch", "yaw"), "EDGE_SE3:EULER", 6),
    (("qx", "qy", "qz", "qw"), "EDGE_SE3:QUAT", 0),
    (("x", "y", "theta"), "EDGE_SE2", 3),
)
_KINDS = {
    **dict.fromkeys(("", "information", "info", "inf", "omega", "i"), Noise.INFORMATION),
    **dict.fromkeys(("covariance", "cov", "c", "p", "variance", "var"), Noise.COVARIANCE),
    **dict.fromkeys(("stddev", "std", "sigma", "sd"), Noise.DEVIATIONS),
}
_AXES = {"x": 0, "y": 1, "z": 2, "roll": 3, "pitch": 4, "yaw": 5, "rx": 3, "ry": 4, "rz": 5}
_PLANAR_AXES = {"x": 0, "y": 1, "t": 2, **dict.fromkeys(_HEADINGS, 2)}
_AXIS = "|".join(sorted({*_AXES, *_PLANAR_AXES}, key=len, reverse=True))
_KIND = "|".join(sorted(_KINDS, key=len, reverse=True))
_ENTRY = re.compile(f"({_KIND})({_AXIS}|[0-6])({_AXIS}|[0-6])?")
_TEXTS = {
    Noise.INFORMATION: "information matrices",
    Noise.COVARIANCE: "covariance matrices",
    Noise.DEVIATIONS: "standard deviations",
    Noise.MISSING: "no matrices",
}


@dataclass(frozen=True)
class Table:
    """What the columns of a table are, of which the header is on line `header`, from 1.

    `measured` has the columns of the two poses and of the numbers, as on a line of g2o, and
    `matrix` those of the upper triangle, where a column that the table lacks is None.
    """

    header: int
    separator: str | None
    measured: list[int]
    is_rotation: bool
    tag: str
    noise: Noise
    matrix: list[int | None]
    unused: list[str]


def table_of(path: Path, line: int, header: str) -> Table | None:
    """Columns of a table with this header, on a line of a file; None where it is none.

    A FileFormatError where a header that is no comment has two poses and no measurement of them.
    """
    plain = header.strip().lstrip("#/%")
    separator = next((mark for mark in (",", ";", "\t") if mark in plain), None)
    written = [word.strip().strip("\"'") for word in plain.split(separator)]
    names = [re.sub(r"[^a-z0-9]", "", name.lower()) for name in written]
    ends = [_place_of_end(names, words) for words in (_FIRST, _SECOND)]
    if not names or -1 in ends:
        return None
    tag, side, numbers = _measurement(_places_of_measurements(names))
    if not tag:
        if header.lstrip().startswith(COMMENT_SIGNS):
            return None
        problem = (
            "a table needs columns x, y and theta; x, y, z, qx, qy, qz and qw; x, y, z, roll, "
            "pitch and yaw; or the quaternion alone"
        )
        raise FileFormatError(path, line, f"{problem}; this one has {printable(plain)}")
    measured = [*ends, *numbers]
    others = {place: name for place, name in enumerate(names) if place not in measured}
    noise, entries = _noise(path, line, others, side)
    matrix = [entries.get((a, b)) for a in range(side) for b in range(a, side)]
    unused = [written[place] for place in others if place not in matrix]
    if not entries:
        matrix = []
    return Table(line, separator, measured, side == 0, tag, noise, matrix, unused)


def _place_of_end(names: list[str], words: set[str]) -> int:
    """First column that names one end of a measurement; -1 where there is none."""
    for place, name in enumerate(names):
        if not name.isdigit() and _NOUNS.sub("", name) in words:
            return place
    return -1


def _places_of_measurements(names: list[str]) -> dict[str, int]:
    """First columns of x, y, z, theta and the rest of what a table may measure, by name."""
    places: dict[str, int] = {}
    for place, name in enumerate(names):
        match = _MEASURED.fullmatch(name)
        if match:
            places.setdefault("theta" if match[1] in _HEADINGS[2:] else match[1], place)
    if "yaw" in places:
        places.setdefault("theta", places["yaw"])
    return places


def _measurement(places: dict[str, int]) -> tuple[str, int, list[int]]:
    """Tag, rows of the matrix and columns of what a table measures; no tag where it is nothing."""
    for names, tag, side in _MEASUREMENTS:
        has_position = bool({"x", "y", "z"} & set(places))
        if not all(name in places for name in names) or (side == 0 and has_position):
            continue
        if side == 3 and {"z", "roll", "pitch", "qw"} & set(places):
            continue  # measurements in space, of which something is missing
        return tag, side, [places[name] for name in names]
    return "", 0, []


Places = dict[tuple[int, int], int]  # columns by row and column of the matrix


def _noise(path: Path, line: int, others: dict[int, str], side: int) -> tuple[Noise, Places]:
    """What the other columns say of the noise, and their places.

    Columns with numbers come before named ones. Columns of other names are a triangle where they
    are as many as its entries.
    """
    triangle = [(a, b) for a in range(side) for b in range(a, side)]
    if not triangle:
        return Noise.MISSING, {}
    numbered = _numbered(others)
    if len(numbered) == len(triangle):
        kind = next(iter(numbered.values()))
        return kind, dict(zip(triangle, numbered, strict=True))
    named = _named(others, side)
    if named:
        return _one_kind(path, line, named, side)
    if len(others) == len(triangle):
        return Noise.INFORMATION, dict(zip(triangle, others, strict=True))
    return Noise.MISSING, {}


def _one_kind(path: Path, line: int, named: dict[Noise, Places], side: int) -> tuple[Noise, Places]:
    """The one kind of noise that columns are named after, with the whole diagonal.

    A FileFormatError where they have several kinds, or lack an entry on the diagonal.
    """
    (kind, places), *others = named.items()
    if others:
        kinds = " and ".join(_TEXTS[kind] for kind in named)
        raise FileFormatError(path, line, f"a table with {kinds}; leave one of them out")
    if not all((axis, axis) in places for axis in range(side)):
        problem = f"the columns of {_TEXTS[kind]} lack an entry on the diagonal; add it"
        raise FileFormatError(path, line, problem)
    return kind, places


def _named(others: dict[int, str], side: int) -> dict[Noise, Places]:
    """Columns whose names have a kind of noise and one or two axes, as `cov_xx` and `std_x` do."""
    first_number = 0 if any("0" in name for name in others.values()) else 1
    axes = _PLANAR_AXES if side == 3 else _AXES
    axes = axes | {str(first_number + axis): axis for axis in range(side)}
    named: dict[Noise, Places] = {}
    for place, name in others.items():
        match = _ENTRY.fullmatch(name)
        if match is None:
            continue
        kind_of_name, row, column = match.groups()
        kind = _KINDS[kind_of_name]
        needs_two_axes = len(kind_of_name) < 2  # "x" alone, or "ix", is no entry of a matrix
        has_one_too_many = kind is Noise.DEVIATIONS and column
        a, b = sorted((axes.get(row, -1), axes.get(column or row, -1)))
        if a >= 0 and not has_one_too_many and (column or not needs_two_axes):
            named.setdefault(kind, {})[a, b] = place
    return named


def _numbered(others: dict[int, str]) -> dict[int, Noise]:
    """Columns such as info1, info2, .., which have the entries of a triangle in their order."""
    matches = {place: re.fullmatch(r"([a-z]+?)([0-9]+)", name) for place, name in others.items()}
    of_kind = {place: match for place, match in matches.items() if match and match[1] in _KINDS}
    numbers = [int(match[2]) for match in of_kind.values()]
    first = min(numbers, default=0)
    if numbers != list(range(first, first + len(numbers))):
        return {}
    return {place: _KINDS[match[1]] for place, match in of_kind.items()}


def lines_of_table(path: Path, table: Table, text: str) -> str:
    """Lines of g2o of a table, as many as it has; those without a measurement are empty."""
    lines = text.split("\n")
    written = [""] * len(lines)
    problems: list[Problem] = []
    used = [place for place in (*table.measured, *table.matrix) if place is not None]
    for place, line in enumerate(lines[table.header :], table.header):
        if not line.strip() or line.lstrip().startswith(COMMENT_SIGNS):
            continue
        words = line.partition("#")[0].split(table.separator)
        words = [word.strip().strip("\"'") for word in words]
        if len(words) <= max(used):
            problem = f"{len(words)} columns, and column {max(used) + 1} of the header is used"
            problems.append((place + 1, f"{problem}; complete the line"))
            continue
        try:
            written[place] = _line(path, table, place + 1, words)
        except FileFormatError as error:
            problems.append((place + 1, error.problem))
    check_lines(path, problems)
    tag = "rotations" if table.is_rotation else f"{table.tag} measurements"
    note = f"{printable(str(path))}: a table of {tag}, with {_TEXTS[table.noise]}"
    if table.unused:
        note += f"; the columns {printable(', '.join(table.unused))} are not used"
    warnings.warn(note, GraphWarning, stacklevel=2)
    return "\n".join(written)


def _line(path: Path, table: Table, line: int, words: list[str]) -> str:
    first, second, *numbers = [words[place] for place in table.measured]
    if table.is_rotation:
        return " ".join([table.tag, first, second, "0 0 0", *numbers, UNIT_ROTATION])
    tag = table.tag
    matrix = ["0" if place is None else words[place] for place in table.matrix]
    if table.noise in (Noise.COVARIANCE, Noise.DEVIATIONS):
        tag = COVARIANCE_TAGS[tag]
    if table.noise is Noise.DEVIATIONS:
        matrix = [repr(finite_number(path, line, word) ** 2) for word in matrix]
    return " ".join([tag, first, second, *numbers, *matrix])
