"""Verify the lower bound of a convex cvxpy model over sets without trusting whoever wrote it.

**The problem** is that of the numbers in the proof file, which are doubles, and so rational:

    minimise c^T x + constant   subject to   b - A x in a cone,

whose entries are zeros, then numbers that are not negative, then vectors (t, v) with t >= |v|, then
upper triangles of semidefinite matrices, column by column, off the diagonal times root 2; and to
the sets of some variables, as in `pgo_models.verification.model_proof`.

**The theorem.** For every y in the dual cone, y^T (b - A x) >= 0, and for every semidefinite P,
<P, H(x)> >= 0 with the matrix H of a variable (`hull`). Without these,

    c^T x + constant >= constant - b^T y - <P, H(0)> + g^T x,

with g = c + A^T y less the linear part of <P, H(x)>.

Columns of variables, or rows, have norm 1: of them g^T x is at least minus the norms of g. Of a
rotation of the plane, (a, -b; b, a), g^T x is linear in (a, b). All other entries of x may be
anything: g has to be zero there, exactly. So y is not the one of the file, but the nearest y with
this property, y - A_F (A_F^T A_F)^-1 (c + A^T y)_F, in ball arithmetic.
"""

from collections.abc import Iterator
from typing import Any

from pgo_models.verification.balls import (
    arb,
    arb_mat,
    ctx,
    exact,
    first_bad_pivot,
    fmpq,
    is_semidefinite,
    symmetric,
)
from pgo_models.verification.model_proof import ONE, hull, is_plane

BITS = 256
Rows = list[dict[int, arb]]


def hull_bound(record: dict[str, Any]) -> tuple[fmpq | None, str]:
    """The bound that is proven, the lower end of a ball, and what failed, if anything."""
    with ctx.workprec(BITS):
        c = [arb(exact(float(value))) for value in record["c"]]
        rows = rows_of(record, len(c))
        y = [arb(exact(float(value))) for value in record["y"]]
        b = [arb(exact(float(value))) for value in record["b"]]
        if not len(rows) == len(y) == len(b):
            raise ValueError("y has another length than b")
        bounded = [k for each in record["variables"] for k in entries_within(each, len(c))]
        if len(set(bounded)) < len(bounded):
            raise ValueError("an entry is of two variables")
        free = sorted(set(range(len(c))) - set(bounded))
        moved = without_free_part(rows, y, c, free)
        if moved is None:
            return None, "the dual point: entries of no set are not determined"
        if not is_in_dual_cone(moved, record["cones"]):
            return None, "the dual point, which is not in the dual cone"
        g = gradient(rows, moved, c)
        bound = arb(exact(float(record["constant"])))
        bound -= sum((of_b * of_y for of_b, of_y in zip(b, moved, strict=True)), arb(0))
        for variable in record["variables"]:
            least = least_on_set(variable, g)
            if least is None:
                return None, "a hull: its matrix P is not positive semidefinite"
            bound += least
        lower = bound.lower()
        if not lower.is_finite():
            return None, "the bound, which is not finite"
        return lower.fmpq(), ""


def rows_of(record: dict[str, Any], num_columns: int) -> Rows:
    """The rows of A."""
    rows: Rows = [{} for _ in record["b"]]
    for i, j, value in record["A"]:
        if not (0 <= i < len(rows) and 0 <= j < num_columns):
            raise ValueError(f"A has no entry {i}, {j}")
        row = rows[int(i)]
        row[int(j)] = row.get(int(j), arb(0)) + exact(float(value))
    return rows


def entries_within(variable: dict[str, Any], num_columns: int) -> range:
    """The entries of x that are of a variable, whose set has to be known."""
    n, p = variable["shape"]
    first = variable["first"]
    if variable["sets"] not in (["rotation"], ["orthonormal"], ["unit columns"], ["unit rows"]):
        raise ValueError(f"unknown sets {variable['sets']}")
    if min(n, p) < 1 or not 0 <= first <= num_columns - n * p:
        raise ValueError(f"no entries of a {n} x {p} variable from {first}")
    return range(first, first + n * p)


def gradient(rows: Rows, y: list[arb], c: list[arb]) -> list[arb]:
    """The vector c + A^T y."""
    g = list(c)
    for row, of_y in zip(rows, y, strict=True):
        for k, value in row.items():
            g[k] += value * of_y
    return g


def without_free_part(rows: Rows, y: list[arb], c: list[arb], free: list[int]) -> list[arb] | None:
    """The nearest y with (c + A^T y)_F = 0; None where A_F is not known to have full rank."""
    if not free:
        return y
    place = {k: position for position, k in enumerate(free)}
    of_free = [[(place[k], v) for k, v in row.items() if k in place] for row in rows]
    gram = arb_mat(len(free), len(free))
    for entries in of_free:
        for i, of_i in entries:
            for j, of_j in entries:
                gram[i, j] += of_i * of_j
    g = gradient(rows, y, c)
    try:
        steps = gram.solve(arb_mat([[g[k]] for k in free]))
    except ZeroDivisionError:
        return None
    return [
        of_y - sum((value * steps[k, 0] for k, value in entries), arb(0))
        for of_y, entries in zip(y, of_free, strict=True)
    ]


def is_in_dual_cone(y: list[arb], cones: dict[str, Any]) -> bool:
    """Whether every y in the balls is."""
    entries = iter(y)
    sizes = [cones["zero"], cones["nonneg"], *cones["soc"], *cones["psd"]]
    num_rows = cones["zero"] + cones["nonneg"] + sum(cones["soc"])
    num_rows += sum(side * (side + 1) // 2 for side in cones["psd"])
    if min(sizes) < 0 or num_rows != len(y) or 0 in cones["soc"]:
        raise ValueError("the cones have other sizes than b")
    take(entries, cones["zero"])
    if not all(value >= 0 for value in take(entries, cones["nonneg"])):
        return False
    for size in cones["soc"]:
        t, *v = take(entries, size)
        if not t >= norm(v):
            return False
    for side in cones["psd"]:
        Y = [[arb(0)] * side for _ in range(side)]
        for column in range(side):
            for row, value in enumerate(take(entries, column + 1)):
                half = value if row == column else value * arb(2).rsqrt()
                Y[row][column] = Y[column][row] = half
        if first_bad_pivot(Y) is not None:
            return False
    return True


def take(entries: Iterator[arb], count: int) -> list[arb]:
    """The next entries."""
    return [next(entries) for _ in range(count)]


def norm(vector: list[arb]) -> arb:
    """Euclidean norm, a ball."""
    return sum((value * value for value in vector), arb(0)).nonnegative_part().sqrt()


def least_on_set(variable: dict[str, Any], g: list[arb]) -> arb | None:
    """A lower bound on g^T x of a variable; None where P is not positive semidefinite."""
    n, p = variable["shape"]
    first = variable["first"]
    if is_plane(variable):
        a, b, minus_b, d = g[first : first + 4]
        return -norm([a + d, b - minus_b])
    of_x = {k: g[k] for k in range(first, first + n * p)} | {ONE: arb(0)}
    if "P" in variable:
        side, H = hull(variable, 0)
        triangle = [exact(float(value)) for value in variable["P"]]
        if len(triangle) != side * (side + 1) // 2:
            raise ValueError(f"P is no triangle of side {side}")
        P = symmetric(triangle, side)
        if not is_semidefinite(P):
            return None
        for (row, column), function in H.items():
            for k, factor in function.items():
                of_x[k] -= P[row][column] * factor
    columns = [[of_x[first + a + n * b] for a in range(n)] for b in range(p)]
    vectors = columns
    if variable["sets"] == ["unit rows"]:
        vectors = [list(row) for row in zip(*columns, strict=True)]
    return of_x[ONE] - sum((norm(vector) for vector in vectors), arb(0))
