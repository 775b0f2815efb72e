"""A proof as its file has it: poses, multipliers, ground and shift. The verifier believes none."""

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pgo_models.errors import FileFormatError
from pgo_models.verification.measurements import WORLD, read_text

FORMAT = "pgo-splitting proof 1"
MODEL_FORMAT = "pgo-splitting model proof 1"
COSTS = {
    "F": "F, two precisions an edge, as in SE-Sync",
    "unit": "F with kappa = tau = 1, as in the paper",
    "chi2": "chi2 of the information matrices",
    "rotations": "F(R), the rotation part of F: of rotations alone",
    "unit rotations": "F(R) with kappa = 1, as in the paper's first stage",
}
# Costs of rotations alone; a proof of them has no translations.
ROTATION_COSTS = ("rotations", "unit rotations")
UNIT_COSTS = ("unit", "unit rotations")
WAY_OUT = "give a file of pgo solve --proof, as it was written"
_WAYS_OUT = {
    FORMAT: "it is the proof of a graph, which is verified with the graph: give both",
    MODEL_FORMAT: "it is the proof of a model, which has the model's numbers: give it alone",
}


@dataclass(frozen=True, eq=False)
class HandednessTerm:
    """A term that the proof takes off the cost: v^T P v of the poses i and j, with T."""

    i: int
    j: int
    T: list[list[float]]
    P: list[float]  # upper triangle, row by row


@dataclass(frozen=True, eq=False)
class Split:
    """The tau, J_ss and D by which chi2 of an edge is split into quadratic and convex parts."""

    tau: float
    J_ss: tuple[float, ...]  # upper triangle, row by row; empty for a J_ss of zeros
    D: tuple[float, ...] = ()  # weights along the axes of the world; empty for zeros


@dataclass(frozen=True, eq=False)
class Proof:
    """What a proof file says; all numbers are doubles, exactly."""

    cost: str
    objective: float
    lower_bound: float
    eta: float | None  # None: nothing is claimed but that the cost is never negative
    ground: int
    t: dict[int, list[float]]
    R: dict[int, list[list[float]]]  # not of landmarks
    # Upper triangles, row by row. Where there are none, those of a stationary point are taken.
    Lambda: dict[int, list[float]]
    terms: list[HandednessTerm]
    # Multipliers of the lengths of the rows of R, (d) of a pose; zero of poses without.
    gamma: dict[int, list[float]] = field(default_factory=dict)
    is_complex: bool = False  # whether rotations of the plane are taken as complex numbers
    # Of the edges from a pose to another, in the order of the file of the graph. The verifier
    # chooses tau and J_ss itself where they are missing or do not fit.
    splits: dict[tuple[int, int], list[Split]] = field(default_factory=dict)
    # The pose whose prior holds shifts of the map that no prior measures, and the information, (d),
    # along the axes of the world that holds them.
    held: tuple[int, list[float]] | None = None


def read_proof(path: Path, d: int) -> Proof:
    """Proof in a JSON file, shapes and numbers checked; a FileFormatError says what is wrong."""
    record = read_record(path, FORMAT)
    cost = entry(path, record, "cost")
    if cost not in list(COSTS) or entry(path, record, "d") != d:
        problem = f"not the proof of {', '.join(COSTS)} in {d}D; give the proof of this graph"
        raise FileFormatError(path, None, problem)
    t: dict[int, list[float]] = {}
    R: dict[int, list[list[float]]] = {}
    Lambda: dict[int, list[float]] = {}
    gamma: dict[int, list[float]] = {}
    poses = entry(path, record, "poses")
    if not isinstance(poses, list):
        poses = [poses]
    size_of_triangle = d * (d + 1) // 2
    for pose in poses:
        name = name_of(path, entry(path, pose, "id"))
        t[name] = [0.0] * d
        if cost not in ROTATION_COSTS:
            t[name] = numbers(path, entry(path, pose, "t"), f"t of pose {name}", d)
        if "R" in pose:
            R[name] = numbers(path, pose["R"], f"R of pose {name}", d, d)
        if "Lambda" in pose:
            Lambda[name] = numbers(path, pose["Lambda"], f"Lambda of pose {name}", size_of_triangle)
        if "gamma" in pose:
            gamma[name] = numbers(path, pose["gamma"], f"gamma of pose {name}", d)
    return Proof(
        cost=cost,
        objective=number_entry(path, record, "objective"),
        lower_bound=number_entry(path, record, "lower_bound"),
        eta=read_shift(path, entry(path, record, "eta")),
        ground=name_of(path, entry(path, record, "ground")),
        t=t,
        R=R,
        Lambda=Lambda,
        terms=read_terms(path, record, d),
        gamma=gamma,
        is_complex=read_is_complex(path, record, d),
        splits=read_splits(path, record, d),
        held=read_held(path, record, d),
    )


def read_record(path: Path, wanted: str) -> dict[str, Any]:
    """The JSON object of a proof file in a format; a FileFormatError says what is wrong."""
    try:
        record = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(path, None, f"no JSON: {error}; {WAY_OUT}") from error
    given = entry(path, record, "format")
    if given == wanted:
        return dict(record)
    other = _WAYS_OUT.get(given) if isinstance(given, str) else None
    raise FileFormatError(path, None, f"its format is not {wanted!r}; {other or WAY_OUT}")


def read_terms(path: Path, record: dict[str, Any], d: int) -> list[HandednessTerm]:
    """The handedness terms of a proof, none where it has no such entry; they exist in 3D alone."""
    rows = record.get("handedness", [])
    if not isinstance(rows, list) or (rows and d != 3):
        raise FileFormatError(path, None, f"handedness is no list of terms in 3D; {WAY_OUT}")
    return [
        HandednessTerm(
            i=name_of(path, entry(path, row, "i")),
            j=name_of(path, entry(path, row, "j")),
            T=numbers(path, entry(path, row, "T"), "T of a handedness term", 3, 3),
            P=numbers(path, entry(path, row, "P"), "P of a handedness term", 6),
        )
        for row in rows
    ]


def read_held(path: Path, record: dict[str, Any], d: int) -> tuple[int, list[float]] | None:
    """The pose that shifts of the map are held at, and by what; None where none are."""
    if "held" not in record:
        return None
    row = record["held"]
    weights = numbers(path, entry(path, row, "weights"), "weights of the pose held", d)
    return name_of(path, entry(path, row, "id")), weights


def read_is_complex(path: Path, record: dict[str, Any], d: int) -> bool:
    """Whether rotations are taken as complex numbers, as they can be in the plane alone."""
    is_complex = record.get("complex", False)
    if not isinstance(is_complex, bool) or (is_complex and d != 2):
        raise FileFormatError(path, None, f"complex is not true or false, in 2D; {WAY_OUT}")
    return is_complex


def read_splits(path: Path, record: dict[str, Any], d: int) -> dict[tuple[int, int], list[Split]]:
    """The splits of chi2, none where the proof has no such entry."""
    rows = record.get("splits", [])
    if not isinstance(rows, list):
        raise FileFormatError(path, None, f"splits is no list of splits of edges; {WAY_OUT}")
    size_of_triangle = 1 if d == 2 else 6
    splits: dict[tuple[int, int], list[Split]] = {}
    for row in rows:
        i = name_of(path, entry(path, row, "i"))
        j = name_of(path, entry(path, row, "j"))
        J_ss: list[float] = []
        if "J_ss" in row:
            J_ss = numbers(path, row["J_ss"], "J_ss of a split", size_of_triangle)
        D: list[float] = []
        if "D" in row:
            D = numbers(path, row["D"], "D of a split", d)
        split = Split(number_entry(path, row, "tau"), tuple(J_ss), tuple(D))
        splits.setdefault((i, j), []).append(split)
    return splits


def entry(path: Path, record: object, name: str) -> Any:  # noqa: ANN401 - of JSON
    """Entry of a JSON object."""
    if not isinstance(record, dict) or name not in record:
        raise FileFormatError(path, None, f"no entry {name!r} where one belongs; {WAY_OUT}")
    return record[name]


def number_entry(path: Path, record: object, name: str) -> float:
    """Finite number in an entry of a JSON object."""
    number: float = numbers(path, entry(path, record, name), name)
    return number


def numbers(path: Path, value: Any, what: str, *shape: int) -> Any:  # noqa: ANN401 - of JSON
    """A finite number, or as many of them in lists as a shape says."""
    if shape and isinstance(value, list) and len(value) == shape[0]:
        return [numbers(path, inner, what, *shape[1:]) for inner in value]
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not shape and is_number and abs(value) <= sys.float_info.max:
        return float(value)
    expected = "a finite number"
    if shape:
        sizes = " x ".join(map(str, shape))
        expected = f"{sizes} finite numbers"
    raise FileFormatError(path, None, f"{what}: {value!s:.40} is not {expected}; {WAY_OUT}")


def read_shift(path: Path, value: object) -> float | None:
    """The shift eta, or None; the theorem is for shifts that are not negative."""
    eta: float | None = None if value is None else numbers(path, value, "eta")
    if eta is not None and eta < 0:
        raise FileFormatError(path, None, f"eta is {eta}, and must not be negative; {WAY_OUT}")
    return eta


def name_of(path: Path, value: object) -> int:
    """Id of a pose, or that of the world."""
    if value == "world":
        return WORLD
    if type(value) is int and abs(value) < WORLD:
        return value
    raise FileFormatError(path, None, f"{value!s:.40} is no id of a pose; {WAY_OUT}")
