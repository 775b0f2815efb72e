"""Measurements of a JSON robot log (JRL) as exact numbers: the verifier's own reader.

The format is that of MESA and COSMO-Bench (McGann, Potokar & Kaess). Keys are GTSAM's, and so is
the order of covariances in space: rotation first. A measurement that the logs of two robots have
counts once.
"""

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pgo_models.errors import FileFormatError
from pgo_models.verification.balls import fmpq
from pgo_models.verification.measurements import (
    WORLD,
    WRITTEN_FILE,
    Edge,
    Graph,
    Tag,
    checked_graph,
    exact_number,
    inverse_triangle,
    read_text,
)

SUFFIX = ".jrl"
FACTORS = {
    "BetweenFactorPose2": Tag(2, has_covariance=True),
    "BetweenFactorPose3": Tag(3, has_covariance=True),
    "PriorFactorPose2": Tag(2, num_ids=1, has_covariance=True),
    "PriorFactorPose3": Tag(3, num_ids=1, has_covariance=True),
    "PriorFactorPoint2": Tag(2, num_ids=1, is_point=True, to_landmark=True, has_covariance=True),
    "PriorFactorPoint3": Tag(3, num_ids=1, is_point=True, to_landmark=True, has_covariance=True),
}
TRANSLATION_FIRST = (3, 4, 5, 0, 1, 2)  # GTSAM's order in space is rotation, translation
ASYMMETRY = fmpq(1, 10**9)  # of a covariance matrix, relative to its largest entry


def read_robot_log(path: Path, skip_unknown: bool) -> Graph:
    """Edges of a JSON robot log; a FileFormatError names the number of a wrong measurement."""
    edges: list[Edge] = []
    counts: Counter[tuple[object, ...]] = Counter()  # how often an edge was kept
    number = 0
    for measurements in logs(path):
        in_this_log: Counter[tuple[object, ...]] = Counter()
        for measurement in measurements:
            number += 1
            name = measurement.get("type") if isinstance(measurement, dict) else None
            if name not in FACTORS:
                check_skipped(path, number, name, skip_unknown)
                continue
            edge = read_factor(path, number, FACTORS[name], measurement)
            same = edge.i, edge.j, edge.measured, edge.triangle
            in_this_log[same] += 1
            if in_this_log[same] > counts[same]:
                counts[same] += 1
                edges.append(edge)
    landmarks = {edge.j for edge in edges if edge.tag.to_landmark}
    return checked_graph(path, edges, landmarks)


def logs(path: Path) -> Iterator[list[Any]]:
    """Measurements of every robot, in the alphabetical order of their names."""
    try:
        log = json.loads(
            read_text(path),
            parse_float=lambda word: exact_number(path, 1, word),
            parse_constant=lambda word: exact_number(path, 1, word),
        )
        robots = sorted(log["measurements"].items())
        for _, entries in robots:
            yield [
                measurement for entry in entries for measurement in entry.get("measurements", [])
            ]
    except FileFormatError:
        raise
    except (ValueError, RecursionError, TypeError, KeyError, AttributeError) as error:
        problem = f"no JSON robot log ({error}); give the file that was solved"
        raise FileFormatError(path, None, problem) from error


def check_skipped(path: Path, number: int, name: object, skip_unknown: bool) -> None:
    """Raise a FileFormatError of a measurement that is not read, unless it is to be skipped."""
    if skip_unknown:
        return
    problem = f"measurement type {name!s:.40}; known are {', '.join(FACTORS)}; use --skip-unknown"
    raise FileFormatError(path, number, f"{problem}, or {WRITTEN_FILE}")


def read_factor(path: Path, number: int, tag: Tag, measurement: dict[str, Any]) -> Edge:
    """Edge of a measurement."""
    if tag.num_ids == 1:
        i = WORLD
        j = entry(path, number, measurement, "key")
        value = entry(path, number, measurement, "prior")
    else:
        i = entry(path, number, measurement, "key1")
        j = entry(path, number, measurement, "key2")
        value = entry(path, number, measurement, "measurement")
    if not all(type(key) is int and 0 <= key <= WORLD for key in (i, j)):
        raise FileFormatError(path, number, "a key is none; number the variables")
    if tag.d == 3 and not tag.is_point:
        w, *xyz = numbers(path, number, entry(path, number, value, "rotation"), 4)
        translation = entry(path, number, value, "translation")
        measured = [*numbers(path, number, translation, 3), *xyz, w]
    else:
        names = ["x", "y", "z"][: tag.d] if tag.is_point else ["x", "y", "theta"]
        coordinates = [entry(path, number, value, name) for name in names]
        measured = numbers(path, number, coordinates, len(names))
    if tag.num_measured == 7 and not any(measured[3:]):
        raise FileFormatError(path, number, "zero quaternion; it is no rotation")
    covariance = read_covariance(path, number, tag, measurement)
    information = inverse_triangle(path, number, covariance, tag.side)
    return Edge(number, tag, i, j, tuple(measured), information, tuple(covariance))


def read_covariance(path: Path, number: int, tag: Tag, measurement: dict[str, Any]) -> list[fmpq]:
    """Upper triangle of the covariance matrix of a measurement, translation first."""
    side = tag.side
    entries = numbers(path, number, entry(path, number, measurement, "covariance"), side * side)
    places = TRANSLATION_FIRST if side == 6 else range(side)
    C = [[entries[a * side + b] for b in places] for a in places]
    most = ASYMMETRY * max(map(abs, entries))
    if any(abs(C[a][b] - C[b][a]) > most for a in range(side) for b in range(a)):
        raise FileFormatError(path, number, "covariance is not symmetric; correct or remove it")
    return [C[a][b] for a in range(side) for b in range(a, side)]


def entry(path: Path, number: int, record: object, name: str) -> Any:  # noqa: ANN401 - of JSON
    """Entry of a JSON object."""
    if not isinstance(record, dict) or name not in record:
        raise FileFormatError(path, number, f"no entry {name!r}; correct or remove the measurement")
    return record[name]


def numbers(path: Path, number: int, values: Any, count: int) -> list[fmpq]:  # noqa: ANN401 - of JSON
    """So many rational numbers in a list."""
    is_list = isinstance(values, list) and len(values) == count
    if not is_list or any(type(value) not in (int, fmpq) for value in values):
        raise FileFormatError(path, number, f"{values!s:.40} are not {count} numbers; correct them")
    return [fmpq(value) for value in values]
