"""Verify the lower bound of a quadratic cvxpy model without trusting whoever wrote it, exactly.

**The problem** is that of the numbers in the proof file, which are doubles, and so rational:

    minimise 1/2 z^T P z + c^T z + constant   subject to   A z = b,

and to the sets: the entries of a variable X, which are consecutive entries of z, column by column,
have orthonormal columns, are a rotation, or have unit columns or rows.

**The theorem.** A z = b, and X = (a, -b; b, a) of a rotation of the plane, are solved for some
entries of z. With any multipliers l_k of equations q_k that hold on the sets (columns and, of a
square matrix, rows are orthonormal; in SO(3) a column is the cross product of the two others),

    L(v) = objective - sum_k l_k q_k,

is a quadratic function of the entries v that are left, and equal to the objective on the sets. Its
minimum over all v is a lower bound. The square is completed entry by entry: where all pivots are
positive (or a whole row of zeros), the constant that remains is that minimum.

All is done in rational numbers, without any rounding. Nothing outside `pgo_models.verification` is
imported but `pgo_models.errors`.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from pgo_models.errors import FileFormatError
from pgo_models.verification.balls import exact, fmpq
from pgo_models.verification.measurements import read_text

FORMAT = "pgo-splitting model proof 1"
ONE = -1  # stands for the constant among the entries of z
Affine = dict[int, fmpq]
Quadratic = dict[int, dict[int, fmpq]]


@dataclass(frozen=True)
class ModelVerification:
    """What a proof proves of a model.

    Parameters
    ----------
    claim : float
        The lower bound that is claimed.
    bound : Fraction, optional
        The lower bound that is proven, exactly.
    failure : str
        Why the proof fails; empty where it is verified.
    """

    claim: float
    bound: Fraction | None = None
    failure: str = ""

    @property
    def is_verified(self) -> bool:
        """Whether the bound that is claimed is proven."""
        return not self.failure


def verify_model_proof(proof: Path | str) -> ModelVerification:
    """Check the proof of a lower bound on a model, as `ModelCertificate.save_proof` writes it.

    Whether the numbers are those of a model is for its owner to say: cvxpy gives them by
    `problem.get_problem_data(cvxpy.CLARABEL)`.

    Parameters
    ----------
    proof : Path or str
        The file, JSON.

    Returns
    -------
    ModelVerification
        The bound, a rational number, and why the proof fails if it does.

    Raises
    ------
    FileFormatError
        When the file cannot be read, or is not what it has to be.
    MissingExtraError
        When python-flint is not installed, which the extra `verify` brings.
    """
    path = Path(proof)
    try:
        record = json.loads(read_text(path))
        if record["format"] != FORMAT:
            raise FileFormatError(path, None, f"its format is not {FORMAT!r}")
        claim = float(record["lower_bound"])
        L, failure = lagrangian(record)
        bound = None if failure else least_value(L)
    except (ValueError, KeyError, TypeError, IndexError, OverflowError) as error:
        raise FileFormatError(path, None, f"not a proof of a model: {error!r:.80}") from error
    if failure:
        return ModelVerification(claim, None, failure)
    if bound is None:
        return ModelVerification(claim, None, "a pivot of the Lagrangian is not positive")
    proven = Fraction(int(bound.p), int(bound.q))
    if not Fraction(claim) <= proven:
        return ModelVerification(claim, proven, "the bound that is claimed is above the proven one")
    return ModelVerification(claim, proven)


def lagrangian(record: dict[str, Any]) -> tuple[Quadratic, str]:
    """The Lagrangian in the entries of z that are left, and what is wrong, if anything."""
    variables = record["variables"]
    constrained = set()
    for variable in variables:
        constrained |= set(range(variable["first"], variable["first"] + entries_of(variable)))
    solved = solutions([*equalities(record), *plane_equations(variables)], constrained)
    if solved is None:
        return {}, "the equalities contradict each other"
    L: Quadratic = {}
    for i, j, value in record["P"]:  # the upper triangle
        half = exact(float(value)) * (fmpq(1, 2) if i == j else 1)
        add_product(L, affine(solved, int(i)), affine(solved, int(j)), half)
    unit = {ONE: fmpq(1)}
    for j, value in enumerate(record["c"]):
        if value:
            add_product(L, affine(solved, j), unit, exact(float(value)))
    add_product(L, unit, unit, exact(float(record["constant"])))
    for variable in variables:
        for multiplier, terms in equations(variable):
            for a, b, value in terms:
                product = affine(solved, a), affine(solved, b)
                add_product(L, *product, -exact(float(multiplier)) * value)
    return L, ""


def equalities(record: dict[str, Any]) -> Iterable[Affine]:
    """The rows of A z - b."""
    rows: dict[int, Affine] = {}
    for i, j, value in record["A"]:
        rows.setdefault(int(i), {})[int(j)] = exact(float(value))
    for i, value in enumerate(record["b"]):
        rows.setdefault(i, {})[ONE] = -exact(float(value))
    return rows.values()


def entries_of(variable: dict[str, Any]) -> int:
    """Number of entries of a variable, whose shape is (rows, columns)."""
    rows, columns = variable["shape"]
    return int(rows) * int(columns)


def plane_equations(variables: Iterable[dict[str, Any]]) -> list[Affine]:
    """x_11 - x_22 = 0 and x_12 + x_21 = 0 of rotations of the plane."""
    rows: list[Affine] = []
    for variable in variables:
        if variable["shape"] == [2, 2] and "rotation" in variable["sets"]:
            k = int(variable["first"])
            rows.append({k + 3: fmpq(1), k: fmpq(-1)})
            rows.append({k + 2: fmpq(1), k + 1: fmpq(1)})
    return rows


def solutions(rows: Iterable[Affine], constrained: set[int]) -> dict[int, Affine] | None:
    """Rows = 0 solved for entries of z, others than constrained ones if possible."""
    solved: dict[int, Affine] = {}
    for row in rows:
        left: Affine = {}
        for j, value in row.items():
            for k, factor in affine(solved, j).items():
                left[k] = left.get(k, fmpq(0)) + value * factor
        left = {k: value for k, value in left.items() if value != 0}
        pivots = sorted((k in constrained, k) for k in left if k != ONE)
        if not pivots:
            if left:
                return None
            continue
        pivot = pivots[0][1]
        divisor = -left.pop(pivot)
        solution = {k: value / divisor for k, value in left.items()}
        for expression in solved.values():
            if pivot not in expression:
                continue
            factor = expression.pop(pivot)
            for k, value in solution.items():
                expression[k] = expression.get(k, fmpq(0)) + factor * value
        solved[pivot] = solution
    return solved


def affine(solved: dict[int, Affine], j: int) -> Affine:
    """Entry j of z in those that are left."""
    return solved.get(j, {j: fmpq(1)})


def add_product(L: Quadratic, first: Affine, second: Affine, factor: fmpq) -> None:
    """Add factor times a product of two affine functions to a symmetric matrix."""
    for a, of_a in first.items():
        for b, of_b in second.items():
            half = factor * of_a * of_b / 2
            for i, j in ((a, b), (b, a)):
                row = L.setdefault(i, {})
                row[j] = row.get(j, fmpq(0)) + half


Terms = list[tuple[int, int, fmpq]]


def equations(variable: dict[str, Any]) -> Iterable[tuple[float, Terms]]:
    """Multipliers and the equations of a variable that they are of, one after the other."""
    n, p = (int(size) for size in variable["shape"])
    first = int(variable["first"])
    columns = [[first + a + n * b for a in range(n)] for b in range(p)]
    rows = [[first + a + n * b for b in range(p)] for a in range(n)]
    kinds = set(variable["sets"])
    if not kinds <= {"rotation", "orthonormal", "unit columns", "unit rows"} or not kinds:
        raise ValueError(f"unknown sets {sorted(kinds)}")
    known: dict[str, list[Terms]] = {}
    if kinds & {"rotation", "orthonormal"}:
        known["columns"] = gram(columns)
        if n == p:
            known["rows"] = gram(rows)
    if "rotation" in kinds and n == p == 3:
        known["cross"] = [
            terms for a in range(3) for terms in cross(*(columns[(a + k) % 3] for k in range(3)))
        ]
    if kinds & {"unit columns", "rotation", "orthonormal"}:
        known["unit columns"] = [product(column, column, 1) for column in columns]
    if "unit rows" in kinds or "rows" in known:
        known["unit rows"] = [product(row, row, 1) for row in rows]
    for name, multipliers in variable["multipliers"].items():
        yield from zip(multipliers, known[name][: len(multipliers)], strict=True)


def gram(vectors: list[list[int]]) -> list[Terms]:
    """<v_a, v_b> = 1 if a = b, else 0, of b = 0, 1, .. and a = 0, .., b."""
    of_all = []
    for b, second in enumerate(vectors):
        of_all += [product(vectors[a], second, int(a == b)) for a in range(b + 1)]
    return of_all


def product(first: list[int], second: list[int], value: int) -> Terms:
    """<first, second> - value."""
    terms = [(a, b, fmpq(1)) for a, b in zip(first, second, strict=True)]
    return [*terms, (ONE, ONE, fmpq(-value))]


def cross(first: list[int], second: list[int], third: list[int]) -> list[Terms]:
    """Entries of first x second - third."""
    of_all = []
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        plus = (first[b], second[c], fmpq(1))
        minus = (first[c], second[b], fmpq(-1))
        of_all.append([plus, minus, (third[a], ONE, fmpq(-1))])
    return of_all


def least_value(L: Quadratic) -> fmpq | None:
    """Minimum over all v of (v, 1)^T L (v, 1); None where L is not positive semidefinite in v."""
    while True:
        entries = [k for k in L if k != ONE]
        if not entries:
            return L.get(ONE, {}).get(ONE, fmpq(0))
        k = min(entries, key=lambda entry: len(L[entry]))
        row = {j: value for j, value in L.pop(k).items() if value != 0}
        pivot = row.pop(k, fmpq(0))
        if pivot < 0 or (pivot == 0 and row):
            return None
        for i in row:
            share = row[i] / pivot
            target = L[i]
            for j, value in row.items():
                target[j] = target.get(j, fmpq(0)) - share * value
        for other in L.values():
            other.pop(k, None)
