"""Verify the lower bound of a quadratic cvxpy model without trusting whoever wrote it, exactly.

**The problem** is that of the numbers in the proof file, which are doubles, and so rational:

    minimise 1/2 z^T P z + c^T z + constant   subject to   A z = b,  H z <= h,

and to the sets: the entries of a variable X, which are consecutive entries of z, column by column,
have orthonormal columns, are a rotation, or have unit columns or rows.

**The theorem.** A z = b, and X = (a, -b; b, a) of a rotation of the plane, are solved for some
entries of z. With any multipliers l_k of equations q_k that hold on the sets (columns and, of a
square matrix, rows are orthonormal; in SO(3) a column is the cross product of the two others; in
SO(4) a minor of two rows and two columns is that of the others, up to its sign),

    L(v) = objective - sum_k l_k q_k - sum_j <P_j, W_j>,

is a quadratic function of the entries v that are left, and at most the objective on the sets. W is
positive semidefinite on the sets: the Kronecker product of two matrices, each of which is affine in
a variable and semidefinite on its set (`hull`), or one of the numbers h - H z, or 1; or it is
I - X X^T of X with orthonormal columns. P_j has to be, too, which is shown as the following is. The
minimum of L over all v is a lower bound. The square is completed entry by entry: where all pivots
are positive (or a whole row of zeros), the constant that remains is that minimum.

**A variable that is held.** The objective and the sets may stay as they are when all variables are
turned together. Then one of them may be taken to be the identity (`held_entries`).

All is done in rational numbers, without any rounding. Nothing outside `pgo_models.verification` is
imported but `pgo_models.errors`.
"""

from collections.abc import Callable, Iterable
from typing import Any

from pgo_models.verification.balls import exact, fmpq

ONE = -1  # stands for the constant among the entries of z, and for the factor 1
INEQUALITY = -2  # stands for an inequality among the factors of a product
Affine = dict[int, fmpq]
Quadratic = dict[int, dict[int, fmpq]]
# Side of a matrix W, and products of affine functions whose sum is an entry of it.
Products = tuple[int, Callable[[int, int], list[tuple[Affine, Affine]]]]


def quadratic_bound(record: dict[str, Any]) -> tuple[fmpq | None, str]:
    """The bound that a proof with equations of the sets proves, and what failed, if anything."""
    L, failure = lagrangian(record)
    bound = None if failure else least_value(L)
    if float(record["lower_bound"]) <= 0.0 and is_sum_of_squares(record):
        return max(bound or fmpq(0), fmpq(0)), ""  # whatever the multipliers prove
    if not failure and bound is None:
        failure = "the minimum: a pivot of the Lagrangian is not positive"
    return bound, failure


def is_sum_of_squares(record: dict[str, Any]) -> bool:
    """Whether the objective is a sum of squares of entries of z and a constant, not negative."""
    is_diagonal = all(i == j and value >= 0.0 for i, j, value in record["P"])
    return is_diagonal and not any(record["c"]) and record["constant"] >= 0.0


def lagrangian(record: dict[str, Any]) -> tuple[Quadratic, str]:
    """The Lagrangian in the entries of z that are left, and what is wrong, if anything."""
    variables = record["variables"]
    constrained = set()
    for variable in variables:
        constrained |= set(range(variable["first"], variable["first"] + entries_of(variable)))
    rows = [*equalities(record), *plane_equations(variables)]
    if "held" in record:
        if not stays_when_turned(record, constrained):
            return (
                {},
                "the variable held: turning all may change the objective or leave a set",
            )
        rows += held_entries(record)
    solved = solutions(rows, constrained)
    if solved is None:
        return {}, "the equalities, which contradict each other"
    L = objective(record, solved)
    for variable in variables:
        for multiplier, terms in equations(variable):
            for a, b, value in terms:
                product = affine(solved, a), affine(solved, b)
                add_product(L, *product, -exact(float(multiplier)) * value)
    for product_of_hulls in record.get("products", []):
        if not subtract_product(L, solved, record, product_of_hulls):
            return {}, "the products: a matrix P of a product of hulls is not positive semidefinite"
    return L, ""


def held_entries(record: dict[str, Any]) -> list[Affine]:
    """X - I = 0 of the variable that is held; of a rotation of the plane, its first column."""
    variable = record["variables"][record["held"]["variable"]]
    side = int(variable["shape"][0])
    first = int(variable["first"])
    columns = 1 if is_plane(variable) else side
    return [
        {first + a + side * b: fmpq(1)} | ({ONE: fmpq(-1)} if a == b else {})
        for b in range(columns)
        for a in range(side)
    ]


def stays_when_turned(record: dict[str, Any], constrained: set[int]) -> bool:
    """Whether turning all variables leaves the objective and the sets, and can make one I.

    `entries` has d lists of entries of z: those in the same place of every list are turned
    together, as a vector. The objective is a sum of the same form of every list, and every column
    of a variable (every row, from the right) is such a vector.
    """
    held = record["held"]
    if record.get("h"):
        return False
    lists = [[int(entry) for entry in entries] for entries in held["entries"]]
    d = len(lists)
    places: dict[int, tuple[int, int]] = {}
    for a, entries in enumerate(lists):
        places |= {entry: (a, place) for place, entry in enumerate(entries)}
    if any(len(entries) * d != len(places) for entries in lists):
        return False
    variables = record["variables"]
    is_left = {"from the left": True, "from the right": False}[held["turned"]]
    if not all(is_turned_as_vectors(each, places, d, is_left=is_left) for each in variables):
        return False
    has_rotations = any("rotation" in variable["sets"] for variable in variables)
    makes_identity = "rotation" if has_rotations else "orthonormal"
    of_held = variables[held["variable"]]
    if of_held["sets"] != [makes_identity] or of_held["shape"] != [d, d]:
        return False
    solved = solutions(equalities(record), constrained)
    if solved is None or set(solved) & constrained:  # an equality of variables in sets alone
        return False
    return is_same_of_every_list(objective(record, solved), lists, places)


def is_same_of_every_list(
    J: Quadratic, lists: list[list[int]], places: dict[int, tuple[int, int]]
) -> bool:
    """Whether a quadratic function is a sum of the same form of every list of entries."""
    for i, row in J.items():
        for j, value in row.items():
            if value == 0 or (i == ONE and j == ONE):
                continue
            if i not in places or j not in places or places[i][0] != places[j][0]:
                return False
            of_i, of_j = places[i][1], places[j][1]
            if any(J.get(e[of_i], {}).get(e[of_j], fmpq(0)) != value for e in lists):
                return False
    return True


def is_turned_as_vectors(
    variable: dict[str, Any], places: dict[int, tuple[int, int]], d: int, *, is_left: bool
) -> bool:
    """Whether every column (row, from the right) of a variable is a vector of d lists."""
    (kind,) = variable["sets"]
    n, p = (int(size) for size in variable["shape"])
    first = int(variable["first"])
    if kind == ("unit rows" if is_left else "unit columns") or d != (n if is_left else p):
        return False
    x = [[first + a + n * b for b in range(p)] for a in range(n)]
    vectors = [[x[a][b] for a in range(n)] for b in range(p)] if is_left else x
    for vector in vectors:
        where = [places.get(entry) for entry in vector]
        place = where[0][1] if where[0] else 0
        if where != [(a, place) for a in range(d)]:
            return False
    return True


def objective(record: dict[str, Any], solved: dict[int, Affine]) -> Quadratic:
    """1/2 z^T P z + c^T z + constant in the entries that are left."""
    J: Quadratic = {}
    for i, j, value in record["P"]:  # the upper triangle
        half = exact(float(value)) * (fmpq(1, 2) if i == j else 1)
        add_product(J, affine(solved, int(i)), affine(solved, int(j)), half)
    unit = {ONE: fmpq(1)}
    for j, value in enumerate(record["c"]):
        if value:
            add_product(J, affine(solved, j), unit, exact(float(value)))
    add_product(J, unit, unit, exact(float(record["constant"])))
    return J


def subtract_product(
    L: Quadratic, solved: dict[int, Affine], record: dict[str, Any], product: dict[str, Any]
) -> bool:
    """Subtract <P, W>, and say whether P is positive semidefinite."""
    side, W = outside(record, product) if len(product["of"]) == 1 else kronecker(record, product)
    entries = list(reversed(product["P"]))
    P: Quadratic = {}
    for row in range(side):
        for column in range(row, side):
            value = exact(float(entries.pop()))
            P.setdefault(row, {})[column] = P.setdefault(column, {})[row] = value
            for first, second in W(row, column):
                times = -value * (1 if row == column else 2)
                add_product(L, substituted(solved, first), substituted(solved, second), times)
    return least_value(P) is not None


def outside(record: dict[str, Any], product: dict[str, Any]) -> Products:
    """I - X X^T of a variable with orthonormal columns."""
    ((place, _),) = product["of"]
    variable = record["variables"][place]
    if not set(variable["sets"]) <= {"rotation", "orthonormal"}:
        raise ValueError("a product of a variable whose columns are not orthonormal")
    n, p = (int(size) for size in variable["shape"])
    first = int(variable["first"])

    def entry(a: int, b: int) -> list[tuple[Affine, Affine]]:
        unit = [({ONE: fmpq(1)}, {ONE: fmpq(1)})] if a == b else []
        columns = range(first, first + n * p, n)
        return unit + [({k + a: fmpq(-1)}, {k + b: fmpq(1)}) for k in columns]

    return n, entry


def kronecker(record: dict[str, Any], product: dict[str, Any]) -> Products:
    """The Kronecker product of two matrices."""
    (side, H), (other_side, other_H) = (factor(record, *of) for of in product["of"])

    def entry(a: int, b: int) -> list[tuple[Affine, Affine]]:
        of_first = H.get((a // other_side, b // other_side), {})
        return [(of_first, other_H.get((a % other_side, b % other_side), {}))]

    return side * other_side, entry


def equalities(record: dict[str, Any]) -> Iterable[Affine]:
    """The rows of A z - b."""
    return rows_of(record["A"], record["b"], 1).values()


def rows_of(matrix: list[Any], right: list[float], sign: int) -> dict[int, Affine]:
    """The rows of a matrix times z, less the right side, times a sign."""
    rows: dict[int, Affine] = {}
    for i, j, value in matrix:
        rows.setdefault(int(i), {})[int(j)] = sign * exact(float(value))
    for i, value in enumerate(right):
        rows.setdefault(i, {})[ONE] = -sign * exact(float(value))
    return rows


def entries_of(variable: dict[str, Any]) -> int:
    """Number of entries of a variable, whose shape is (rows, columns)."""
    rows, columns = variable["shape"]
    return int(rows) * int(columns)


def plane_equations(variables: Iterable[dict[str, Any]]) -> list[Affine]:
    """x_11 - x_22 = 0 and x_12 + x_21 = 0 of rotations of the plane."""
    rows: list[Affine] = []
    for k in planes(variables):
        rows.append({k + 3: fmpq(1), k: fmpq(-1)})
        rows.append({k + 2: fmpq(1), k + 1: fmpq(1)})
    return rows


def is_plane(variable: dict[str, Any]) -> bool:
    """Whether a variable is a rotation of the plane."""
    return variable["shape"] == [2, 2] and "rotation" in variable["sets"]


def planes(variables: Iterable[dict[str, Any]]) -> list[int]:
    """The first entries of the rotations of the plane."""
    return [int(variable["first"]) for variable in variables if is_plane(variable)]


def solutions(rows: Iterable[Affine], constrained: set[int]) -> dict[int, Affine] | None:
    """Rows = 0 solved for entries of z, others than constrained ones if possible."""
    solved: dict[int, Affine] = {}
    for row in rows:
        left = {k: value for k, value in substituted(solved, row).items() if value != 0}
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


def substituted(solved: dict[int, Affine], function: Affine) -> Affine:
    """An affine function of z in the entries that are left."""
    left: Affine = {}
    for j, value in function.items():
        for k, factor in affine(solved, j).items():
            left[k] = left.get(k, fmpq(0)) + value * factor
    return left


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
    entries = [[first + a + n * b for b in range(p)] for a in range(n)]
    known = equations_of(set(variable["sets"]), entries)
    for name, multipliers in variable["multipliers"].items():
        yield from zip(multipliers, known[name][: len(multipliers)], strict=True)


def equations_of(sets: set[str], entries: list[list[int]]) -> dict[str, list[Terms]]:
    """Equations by name that hold for a matrix in some sets, whose entries have these numbers."""
    if not sets <= {"rotation", "orthonormal", "unit columns", "unit rows"} or not sets:
        raise ValueError(f"unknown sets {sorted(sets)}")
    rows = entries
    columns = [list(column) for column in zip(*entries, strict=True)]
    of_columns = [product(column, column, 1) for column in columns]
    of_rows = [product(row, row, 1) for row in rows]
    known: dict[str, list[Terms]] = {}
    if "unit columns" in sets:
        known["unit columns"] = of_columns
    if "unit rows" in sets:
        known["unit rows"] = of_rows
    if not sets & {"rotation", "orthonormal"}:
        return known
    known |= {"columns": gram(columns), "unit columns": of_columns}
    if len(rows) == len(columns):
        known |= {"rows": gram(rows), "unit rows": of_rows}
        if "rotation" in sets:
            known |= equations_of_rotations(columns)
    return known


def equations_of_rotations(columns: list[list[int]]) -> dict[str, list[Terms]]:
    """Equations that tell rotations in three and in four dimensions from reflections."""
    if len(columns) == 3:
        in_turn = [[columns[(a + k) % 3] for k in range(3)] for a in range(3)]
        return {"cross": [terms for turn in in_turn for terms in cross(*turn)]}
    if len(columns) == 4:
        return {"minors": minors(columns)}
    return {}


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


def minors(columns: list[list[int]]) -> list[Terms]:
    """Minors of two rows and two columns, less those of the other rows and columns.

    Rows a, b and columns c, d come with the rest in the order in which all four are an even
    permutation, so that no sign changes.
    """
    even = [(0, 1, 2, 3), (0, 2, 3, 1), (0, 3, 1, 2)]
    of_all = []
    for c, d, g, h in even:
        for a, b, e, f in even + [(k, m, i, j) for i, j, k, m in even]:
            minor = [
                (columns[c][a], columns[d][b], fmpq(1)),
                (columns[c][b], columns[d][a], fmpq(-1)),
            ]
            of_rest = [
                (columns[g][e], columns[h][f], fmpq(-1)),
                (columns[g][f], columns[h][e], fmpq(1)),
            ]
            of_all.append(minor + of_rest)
    return of_all


def factor(
    record: dict[str, Any], position: int, part: int
) -> tuple[int, dict[tuple[int, int], Affine]]:
    """Side and entries of a matrix: of a variable's hull, an inequality, or the constant 1."""
    if position == ONE:
        return 1, {(0, 0): {ONE: fmpq(1)}}
    if position == INEQUALITY:
        return 1, {(0, 0): rows_of(record["H"], record["h"], -1)[part]}
    return hull(record["variables"][position], part)


def hull(variable: dict[str, Any], part: int) -> tuple[int, dict[tuple[int, int], Affine]]:
    """Side and entries of a matrix that is positive semidefinite on the set of a variable.

    Of the unit quaternion q = (w, x, y, z) of a rotation of space it is 4 q q^T; of a rotation of
    the plane 2 h h^T, with h = (cos, sin) of half its angle; of X^T X = I it is (I, X; X^T, I),
    and of one unit column or row x the same, (I, x; x^T, 1).
    """
    (kind,) = variable["sets"]
    n, p = (int(size) for size in variable["shape"])
    first = int(variable["first"])
    x = [[first + a + n * b for b in range(p)] for a in range(n)]
    if kind == "rotation" and n == 3:
        return 4, quaternion_products(x)
    if kind == "rotation" and n == 2:
        plane = {(0, 0): {ONE: 1, x[0][0]: 1}, (1, 1): {ONE: 1, x[0][0]: -1}, (0, 1): {x[1][0]: 1}}
        return 2, both_triangles(plane)
    if kind == "unit columns":
        x = [[x[a][range(p)[part]]] for a in range(n)]
    elif kind == "unit rows":
        x = [[entry] for entry in x[part]]
    ball: dict[tuple[int, int], dict[int, int]] = {}
    for a in range(len(x)):
        for b in range(len(x[0])):
            ball[a, len(x) + b] = {x[a][b]: 1}
    side = len(x) + len(x[0])
    return side, both_triangles(ball | {(a, a): {ONE: 1} for a in range(side)})


def quaternion_products(x: list[list[int]]) -> dict[tuple[int, int], Affine]:
    """4 q q^T in the entries of a rotation."""
    entries: dict[tuple[int, int], dict[int, int]] = {}
    for a in range(4):
        # 4 w^2 = 1 + x_11 + x_22 + x_33, and 4 x^2 = 1 + x_11 - x_22 - x_33, ..
        signs = [1 if a in (0, k + 1) else -1 for k in range(3)]
        entries[a, a] = {ONE: 1} | {x[k][k]: signs[k] for k in range(3)}
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        entries[0, a + 1] = {x[c][b]: 1, x[b][c]: -1}
        entries[min(b, c) + 1, max(b, c) + 1] = {x[b][c]: 1, x[c][b]: 1}
    return both_triangles(entries)


def both_triangles(
    upper: dict[tuple[int, int], dict[int, int]],
) -> dict[tuple[int, int], Affine]:
    """A symmetric matrix of its upper triangle."""
    of_all: dict[tuple[int, int], Affine] = {}
    for (a, b), function in upper.items():
        of_all[a, b] = of_all[b, a] = {k: fmpq(factor) for k, factor in function.items()}
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
