"""Reader of JRL, the JSON Robot Log: one file with the measurements of several robots.

The format of MESA, iMESA and COSMO-Bench (McGann, Potokar & Kaess), as its page and its parser
define it: keys are GTSAM's, covariances are stored whole and in GTSAM's order of the tangent space.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pgo_models.errors import FileFormatError, GraphWarning, door, printable
from pgo_models.files import (
    LARGEST,
    Problem,
    check_lines,
    far_lines,
    json_of,
    zero_quaternion_lines,
)
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.g2o import edge_rows_to_keep, graph_of_files
from pgo_models.graphs.g2o_parser import G2OLines, problems_of, sound_rows
from pgo_models.graphs.g2o_source import ParsedLines
from pgo_models.graphs.g2o_tags import Noise, Tag
from pgo_models.graphs.origin import remainder_of
from pgo_models.graphs.pose_graph import WORLD_ID, IntArray, PoseGraph
from pgo_models.graphs.written_digits import digits_of

SUFFIX = ".jrl"
_SHOWN = 60  # characters of a wrong value that a message shows
# Entries of a covariance matrix and of its transpose, relative to the largest one.
_SYMMETRY = 1e-9

_FACTORS = {
    "BetweenFactorPose2": Tag(2, 2, noise=Noise.COVARIANCE),
    "BetweenFactorPose3": Tag(3, 2, noise=Noise.COVARIANCE),
    "PriorFactorPose2": Tag(2, 1, noise=Noise.COVARIANCE),
    "PriorFactorPose3": Tag(3, 1, noise=Noise.COVARIANCE),
    "PriorFactorPoint2": Tag(2, 1, is_point=True, to_landmark=True, noise=Noise.COVARIANCE),
    "PriorFactorPoint3": Tag(3, 1, is_point=True, to_landmark=True, noise=Noise.COVARIANCE),
    "BearingRangeFactor2D": Tag(2, 2, is_point=True, to_landmark=True, noise=Noise.DEVIATIONS),
}
# Values and the dimension of their space; others are no poses and no points.
_DIMENSIONS = {"Pose2": 2, "Point2": 2, "Pose3": 3, "Point3": 3}
# GTSAM's order of a pose in space is rotation, translation; here it is translation, rotation.
TRANSLATION_FIRST = [3, 4, 5, 0, 1, 2]


class _WrongValueError(Exception):
    """A part of the file that is not what belongs there; the text says what."""


@dataclass
class Measurements:
    """Measurements of one type in the log of one robot."""

    kind: Tag
    places: list[int] = field(default_factory=list)  # numbers of the measurements in the file
    ids: list[list[int]] = field(default_factory=list)
    numbers: list[list[float]] = field(default_factory=list)


@door
def read_jrl(path: Path | str, *, skip_unknown: bool = False) -> PoseGraph:
    """Read a JRL file: priors and relative measurements of one or several robots.

    Read are the measurements PriorFactorPose2 and 3, BetweenFactorPose2 and 3, PriorFactorPoint2
    and 3, and BearingRangeFactor2D, which becomes a point with the covariance to first order. A
    measurement that is in the logs of two robots is one. The robot of a pose is the letter of its
    key; where some key has the letter of no robot, a pose belongs to the first robot with a value
    or measurement of it. `initialization` gives `PoseGraph.initial`, and `groundtruth` gives
    `PoseGraph.truth`, if they have a value for every pose. Stamps and outlier marks are not used.

    Measurements have no lines: messages count them from 1, robot by robot in alphabetical order.

    `information` is inverse to the covariances. With `skip_unknown` measurements of other types are
    skipped with a warning. A FileFormatError for a file that is no JSON, as CBOR, or no JRL, and
    with the numbers of the first 20 measurements that cannot be read or measure nothing.

    References
    ----------
    McGann, Lassak & Kaess, *Asynchronous distributed smoothing and mapping via on-manifold
    consensus ADMM*, ICRA 2024.
    """
    path = Path(path)
    log = _read_json(path)
    files = _files_of_robots(path, log, skip_unknown)
    initial_files = _with_values(path, log, "initialization", files)
    letters = [ord(robot) for robot, _ in _logs(path, log) if len(robot) == 1]
    graph = graph_of_files(path, initial_files, letters)
    if "groundtruth" not in log:
        return graph
    true_files = _with_values(path, log, "groundtruth", files)
    truth = graph_of_files(path, true_files, letters).initial
    return replace(graph, truth=truth)


def jrl_edge_places(path: Path | str) -> list[str]:
    """`file:number` of every edge of the graph that `read_jrl` reads from a file."""
    path = Path(path)
    files = _files_of_robots(path, _read_json(path), skip_unknown=True)
    kept_rows = edge_rows_to_keep([(file.edge_ids, file.edges) for file in files])
    places = []
    for file, kept in zip(files, kept_rows, strict=True):
        places += [f"{path}:{number}" for number in file.edge_lines[kept]]
    return places


def _read_json(path: Path) -> Mapping[str, Any]:
    """The object in a JSON file."""
    log = json_of(path, None, "a JSON robot log, as JSON and not as CBOR")
    if not isinstance(log, dict) or not isinstance(log.get("measurements"), dict):
        problem = "no robot log: it has no object `measurements` with a list for each robot"
        raise FileFormatError(path, None, problem)
    return log


def _logs(path: Path, log: Mapping[str, Any]) -> Iterator[tuple[str, Sequence[Any]]]:
    """Robots, in alphabetical order, and their measurements in the order of the file."""
    for robot, entries in sorted(log["measurements"].items()):
        measurements: list[Any] = []
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            problem = f"measurements of robot {printable(robot)} are no list of objects"
            raise FileFormatError(path, None, f"{problem}; give one object for each time")
        for entry in entries:
            at_one_time = entry.get("measurements", [])
            if not isinstance(at_one_time, list):
                shown = printable(f"{at_one_time!r:.{_SHOWN}}")
                problem = f"measurements of robot {printable(robot)} at one time are {shown}"
                raise FileFormatError(path, None, f"{problem}, and no list; correct or remove it")
            measurements += at_one_time
        yield robot, measurements


def _files_of_robots(path: Path, log: Mapping[str, Any], skip_unknown: bool) -> list[G2OLines]:
    """The measurements of each robot, as if it had a g2o file of its own, without vertices."""
    by_robot: list[dict[str, Measurements]] = []
    unknown: dict[str, list[int]] = {}
    problems: list[Problem] = []
    place = 0
    for _, measurements in _logs(path, log):
        by_type: dict[str, Measurements] = {}
        for measurement in measurements:
            place += 1
            name = str(measurement.get("type")) if isinstance(measurement, dict) else ""
            if name not in _FACTORS:
                unknown.setdefault(name[:_SHOWN], []).append(place)
                continue
            of_type = by_type.setdefault(name, Measurements(_FACTORS[name]))
            try:
                _take(of_type, measurement)
            except _WrongValueError as error:
                problems.append((place, f"{name}: {error}; correct or remove it"))
                continue
            of_type.places.append(place)
        by_robot.append(by_type)
    if unknown and skip_unknown:
        warnings.warn(_text_of_unknown(path, unknown), GraphWarning, stacklevel=3)
    elif unknown:
        problems += _problems_of_unknown(unknown)
    d = common_dimension(path, by_robot, problems)
    files = [lines_of_measurements(path, d, by_type, problems) for by_type in by_robot]
    for file in files:
        problems += problems_of(file)
    check_lines(path, problems, "measurements")
    return files


def _problems_of_unknown(unknown: Mapping[str, list[int]]) -> list[Problem]:
    problems: list[Problem] = []
    for name, places in unknown.items():
        problem = (
            f"measurement type {name!r} ({len(places)} of it); supported are "
            f"{', '.join(_FACTORS)}: remove them, or have them skipped with --skip-unknown"
        )
        problems.append((places[0], problem))
    return problems


def _text_of_unknown(path: Path, unknown: Mapping[str, list[int]]) -> str:
    counts = [
        f"{len(places)} of {printable(name)} (first: {places[0]})"
        for name, places in unknown.items()
    ]
    return f"{printable(str(path))}: measurements of other types were skipped: {', '.join(counts)}"


def common_dimension(
    path: Path, by_robot: Sequence[Mapping[str, Measurements]], problems: list[Problem]
) -> int:
    """Dimension of all measurements; a FileFormatError unless they have one."""
    first_place: dict[int, int] = {}
    for by_type in by_robot:
        for of_type in by_type.values():
            d = of_type.kind.d
            for place in of_type.places[:1]:
                first_place[d] = min(first_place.get(d, place), place)
    if len(first_place) == 2:
        earlier, later = sorted(first_place.values())
        problem = f"2D and 3D in one file (measurement {earlier} is of the other kind); divide it"
        problems.append((later, problem))
    if len(first_place) != 1:
        check_lines(path, problems, "measurements")
        problem = f"no measurement of the types {', '.join(_FACTORS)}; a pose graph needs some"
        raise FileFormatError(path, None, problem)
    (d,) = first_place
    return d


def lines_of_measurements(
    path: Path, d: int, by_type: Mapping[str, Measurements], problems: list[Problem]
) -> G2OLines:
    """The measurements of a robot as edges, in the order of the file."""
    width = 9 if d == 2 else 28
    ids: list[IntArray] = [np.zeros((0, 2), dtype=np.int64)]
    rows = [np.zeros((0, width))]
    remainders = [np.zeros((0, d))]
    places: list[IntArray] = [np.zeros(0, dtype=np.int64)]
    landmarks: list[IntArray] = [np.zeros(0, dtype=np.int64)]
    measured = [np.zeros(0)]
    weights_error = 0.0
    for of_type in by_type.values():
        kind = of_type.kind
        if kind.d != d:  # none of its measurements could be read
            continue
        part = ParsedLines(
            np.array(of_type.places, dtype=np.int64),
            np.array(of_type.ids, dtype=np.int64).reshape(-1, 2),
            np.array(of_type.numbers).reshape(-1, kind.num_numbers),
        )
        part, rows_of_kind, error = sound_rows(kind, part, problems)
        weights_error = max(weights_error, error)
        rows.append(rows_of_kind)
        remainders.append(_remainders(kind, rows_of_kind))
        measured.append(part.numbers[:, : kind.num_measured].ravel())
        ids.append(part.ids)
        places.append(part.lines)
        if kind.to_landmark:
            landmarks.append(part.ids[:, 1])
    edge_lines = np.concatenate(places)
    order = np.argsort(edge_lines)
    no_ids = np.zeros(0, dtype=np.int64)
    return G2OLines(
        path,
        d,
        vertex_ids=no_ids,
        vertex_lines=no_ids,
        vertices=np.zeros((0, 3 if d == 2 else 7)),
        edge_ids=np.concatenate(ids)[order],
        edges=np.concatenate(rows)[order],
        edge_lines=edge_lines[order],
        fixed=no_ids,
        fixed_lines=no_ids,
        landmarks=np.unique(np.concatenate(landmarks)),
        digits=digits_of(np.concatenate(measured)),
        weights_error=weights_error,
        remainders=np.concatenate(remainders)[order],
    )


def _remainders(kind: Tag, rows: Array) -> Array:
    """What the positions of priors have in decimals beyond the numbers of rows, (k, d).

    JSON is written with the fewest digits that bring a double back, which are those of `repr`.
    """
    positions = rows[:, : kind.d]
    if kind.num_ids != 1:
        return np.zeros_like(positions)
    beyond = [remainder_of(repr(x), x) for x in positions.ravel().tolist()]
    return np.reshape(beyond, positions.shape)


def _take(of_type: Measurements, measurement: Mapping[str, Any]) -> None:
    """Add a measurement, all of it or, with a _WrongValueError, nothing."""
    kind = of_type.kind
    name = measurement["type"]
    is_prior = kind.num_ids == 1
    if is_prior:
        ids = [WORLD_ID, _key(measurement, "key")]
    else:
        ids = [_key(measurement, "key1"), _key(measurement, "key2")]
    covariance = _covariance(measurement, kind)
    if kind.noise is Noise.DEVIATIONS:
        numbers = _bearing_and_range(measurement, covariance)
    else:
        value = measurement.get("prior" if is_prior else "measurement")
        _, _, value_type = name.partition("Factor")
        numbers = _numbers_of_value(value, value_type)
        numbers += covariance[np.triu_indices(len(covariance))].tolist()
    of_type.ids.append(ids)
    of_type.numbers.append(numbers)


def _key(of: Mapping[str, Any], name: str) -> int:
    """A key, GTSAM's name of a variable."""
    value = of.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < WORLD_ID:
        raise _WrongValueError(f"{name} is {value!r:.{_SHOWN}}, and no key below 2^63 - 1")
    return value


def _numbers(value: object, count: int, name: str) -> list[float]:
    """`count` finite numbers."""
    if not isinstance(value, list) or len(value) != count:
        raise _WrongValueError(f"{name} is {value!r:.{_SHOWN}}, not {count} numbers")
    return [_number(entry, name) for entry in value]


def _number(value: object, name: str) -> float:
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST:
        return float(value)
    raise _WrongValueError(f"{name} is {value!r:.{_SHOWN}}, and no number up to {LARGEST:g}")


def _numbers_of_value(value: object, value_type: str) -> list[float]:
    """Numbers of a pose or point, as in the rows of `G2OLines`; points have their d alone."""
    if not isinstance(value, dict):
        raise _WrongValueError(f"{value_type} is {value!r:.{_SHOWN}}, and no object")
    if value_type == "Pose3":
        w, *xyz = _numbers(value.get("rotation"), 4, "rotation")
        return [*_numbers(value.get("translation"), 3, "translation"), *xyz, w]
    names = {"Pose2": "x y theta", "Point2": "x y", "Point3": "x y z"}[value_type].split()
    return [_number(value.get(name), name) for name in names]


def _covariance(measurement: Mapping[str, Any], kind: Tag) -> Array:
    """Covariance matrix (k, k) of a measurement, translation first."""
    side = kind.d if kind.is_point else 3 * kind.d - 3
    entries = _numbers(measurement.get("covariance"), side * side, "covariance")
    covariance = np.array(entries).reshape(side, side)
    largest = np.abs(covariance).max()
    if not (np.abs(covariance - covariance.T) <= _SYMMETRY * largest).all():
        raise _WrongValueError("covariance is not symmetric")
    if side == 6:
        covariance = covariance[np.ix_(TRANSLATION_FIRST, TRANSLATION_FIRST)]
    return covariance


def _bearing_and_range(measurement: Mapping[str, Any], covariance: Array) -> list[float]:
    """Bearing, range and their standard deviations."""
    value = measurement.get("measurement")
    if not isinstance(value, dict):
        raise _WrongValueError(f"measurement is {value!r:.{_SHOWN}}, and no object")
    bearing = value.get("bearing")
    if isinstance(bearing, dict):  # a Rot2
        bearing = bearing.get("theta")
    if covariance[0, 1] != 0.0:
        raise _WrongValueError("bearing and range are correlated, which is not read")
    variances = np.diag(covariance)
    deviations = np.sqrt(np.maximum(variances, 0.0))
    return [_number(bearing, "bearing"), _number(value.get("range"), "range"), *deviations.tolist()]


def _with_values(
    path: Path, log: Mapping[str, Any], name: str, files: Sequence[G2OLines]
) -> list[G2OLines]:
    """The files of the robots with the values of `initialization` or `groundtruth` as vertices.

    Values of keys that no measurement has are left out.
    """
    values_of_robots = log.get(name) or {}
    if not isinstance(values_of_robots, dict):
        raise FileFormatError(path, None, f"{name} is no object with a list for each robot")
    measured = np.unique(np.concatenate([file.edge_ids.ravel() for file in files]))
    complete = []
    for (robot, _), file in zip(_logs(path, log), files, strict=True):
        ids, rows = _vertices(path, f"{name} of robot {robot}", values_of_robots.get(robot), file.d)
        is_measured = np.isin(ids, measured)
        complete.append(replace(file, vertex_ids=ids[is_measured], vertices=rows[is_measured]))
    return complete


def _vertices(path: Path, name: str, values: object, d: int) -> tuple[IntArray, Array]:
    """Keys and rows of the poses and points among values; a FileFormatError names a wrong one."""
    width = 3 if d == 2 else 7
    ids = []
    rows = []
    if values is None:
        values = []
    if not isinstance(values, list):
        raise FileFormatError(path, None, f"{name} is no list of values; correct or remove it")
    for place, value in enumerate(values, 1):
        value_type = str(value.get("type")) if isinstance(value, dict) else ""
        if _DIMENSIONS.get(value_type) != d:
            continue
        try:
            ids.append(_key(value, "key"))
            numbers = _numbers_of_value(value, value_type)
        except _WrongValueError as error:
            problem = f"{name}, value {place}: {error}; correct or remove it"
            raise FileFormatError(path, None, problem) from None
        unrotated = [0.0] * (width - d)
        unrotated[-1] = d - 2.0  # the angle 0, or the w of the quaternion 0 0 0 1
        rows.append([*numbers, *unrotated] if len(numbers) == d else numbers)
    table = np.array(rows).reshape(-1, width)
    problems = far_lines(range(1, len(table) + 1), table[:, :d])
    if d == 3:
        problems += zero_quaternion_lines(range(1, len(table) + 1), table[:, 3:])
    for place, problem in problems:
        raise FileFormatError(path, None, f"{name}, pose or point {place}: {problem}")
    return np.array(ids, dtype=np.int64), table
