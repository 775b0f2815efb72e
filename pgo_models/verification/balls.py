"""Small matrices of balls (`arb`) and of rational numbers (`fmpq`), of which the verifier is made.

Only this file imports python-flint. If it is not installed, the error names the extra to install.
"""

from collections.abc import Iterable, Sequence
from typing import TypeVar

from pgo_models.errors import extra_module

extra_module("flint", "verify")
from flint import (  # noqa: E402 - after the line above, which names the extra
    arb as arb,
    arb_mat as arb_mat,
    ctx as ctx,
    fmpq as fmpq,
    fmpq_mat as fmpq_mat,
)

Entry = TypeVar("Entry")
Number = TypeVar("Number", arb, fmpq, float)


def identity(side: int) -> arb_mat:
    """Identity matrix, (side, side), exact."""
    return diagonal([fmpq(1)] * side)


def diagonal(entries: Sequence[arb | fmpq]) -> arb_mat:
    """Matrix with these entries on its diagonal."""
    side = len(entries)
    matrix = arb_mat(side, side)
    for k, entry in enumerate(entries):
        matrix[k, k] = arb(entry)
    return matrix


def blocks_on_diagonal(first: arb_mat, second: arb_mat) -> arb_mat:
    """Matrix with two blocks on its diagonal."""
    upper_right = arb_mat(first.nrows(), second.ncols())
    lower_left = arb_mat(second.nrows(), first.ncols())
    top = beside(first, upper_right)
    bottom = beside(lower_left, second)
    return above(top, bottom)


def beside(left: arb_mat, right: arb_mat) -> arb_mat:
    """Two matrices of as many rows, side by side."""
    rows = zip(left.tolist(), right.tolist(), strict=True)
    return arb_mat([of_left + of_right for of_left, of_right in rows])


def above(top: arb_mat, bottom: arb_mat) -> arb_mat:
    """Two matrices of as many columns, one above the other."""
    rows = top.tolist() + bottom.tolist()
    return arb_mat(rows)


def part(A: arb_mat, rows: range, columns: range) -> arb_mat:
    """Some rows and columns of a matrix."""
    entries = [[A[a, b] for b in columns] for a in rows]
    return arb_mat(entries)


def symmetric(triangle: Sequence[Entry], side: int) -> list[list[Entry]]:
    """Rows of the symmetric matrix that has this upper triangle, row by row."""
    matrix = [[triangle[0]] * side for _ in range(side)]
    entries = iter(triangle)
    for a in range(side):
        for b in range(a, side):
            entry = next(entries)
            matrix[a][b] = entry
            matrix[b][a] = entry
    return matrix


def exact(number: float) -> fmpq:
    """The rational number that a double is."""
    numerator, denominator = number.as_integer_ratio()
    return fmpq(numerator, denominator)


def sum_of(matrices: Iterable[arb_mat]) -> arb_mat:
    """Sum of one matrix or more."""
    first, *others = matrices
    for other in others:
        first = first + other
    return first


def first_bad_pivot(rows: Sequence[Sequence[Number]]) -> Number | None:
    """None where a symmetric matrix is positive definite, else a pivot not known to be above zero.

    LDL^T without exchanges: of rational numbers it is exact, and of balls it holds for all
    matrices in them. Of doubles it is a guess.
    """
    remaining = [list(row) for row in rows]
    for k, row in enumerate(remaining):
        pivot = row[k]
        # Not `pivot <= 0`, which is False of a ball that contains zero.
        if not pivot > 0:
            return pivot
        _eliminate(remaining, k)
    return None


def is_semidefinite(rows: Sequence[Sequence[fmpq]]) -> bool:
    """Whether a symmetric matrix of rational numbers has no negative eigenvalue, exactly.

    LDL^T as in `first_bad_pivot`; beside a pivot of zero there may be nothing but zeros.
    """
    remaining = [list(row) for row in rows]
    for k, row in enumerate(remaining):
        pivot = row[k]
        beside_pivot = row[k + 1 :]
        if pivot < 0:
            return False
        if pivot == 0 and any(beside_pivot):
            return False
        if pivot > 0:
            _eliminate(remaining, k)
    return True


def _eliminate(rows: list[list[Number]], k: int) -> None:
    """Subtract multiples of row k, with a pivot that is not zero, from all rows that follow.

    Only columns after k are updated, in the lower triangle and by symmetry in the upper one.
    """
    pivot = rows[k][k]
    for a in range(k + 1, len(rows)):
        row = rows[a]
        share = row[k] / pivot
        for b in range(k + 1, a + 1):
            updated = row[b] - share * rows[b][k]
            row[b] = updated
            rows[b][a] = updated


def plane_rotation(theta: arb | fmpq) -> arb_mat:
    """Rotation of the plane by an angle."""
    sine, cosine = arb(theta).sin_cos()
    return arb_mat([[cosine, -sine], [sine, cosine]])


def angles_rotation(roll: fmpq, pitch: fmpq, yaw: fmpq) -> arb_mat:
    """Rotation by roll about x, then by pitch about y, then by yaw about z."""
    unturned_axis = identity(1)
    swap_y_and_z = arb_mat([[1, 0, 0], [0, 0, 1], [0, 1, 0]])
    about_x = blocks_on_diagonal(unturned_axis, plane_rotation(roll))
    about_z_by_minus_pitch = blocks_on_diagonal(plane_rotation(-pitch), unturned_axis)
    about_y = swap_y_and_z * about_z_by_minus_pitch * swap_y_and_z
    about_z = blocks_on_diagonal(plane_rotation(yaw), unturned_axis)
    return about_z * about_y * about_x


def quaternion_rotation(x: fmpq, y: fmpq, z: fmpq, w: fmpq) -> arb_mat:
    """Rotation of a quaternion of any length: a rational function of its entries."""
    # Rational numbers: exact in whatever order.
    xx = x * x
    yy = y * y
    zz = z * z
    xy = x * y
    xz = x * z
    yz = y * z
    xw = x * w
    yw = y * w
    zw = z * w
    s = 2 / (xx + yy + zz + w * w)
    rows = [
        [1 - s * (yy + zz), s * (xy - zw), s * (xz + yw)],
        [s * (xy + zw), 1 - s * (xx + zz), s * (yz - xw)],
        [s * (xz - yw), s * (yz + xw), 1 - s * (xx + yy)],
    ]
    return arb_mat(fmpq_mat(rows))


Parts = tuple[tuple[int, int], tuple[int, int]]  # mantissa and exponent of midpoint and radius


def exact_parts(ball: arb | None) -> Parts | None:
    """Midpoint and radius of a ball, each man 2^exp, exactly; None of none."""
    if ball is None:
        return None
    mantissa, exponent = ball.mid().man_exp()
    midpoint = int(mantissa), int(exponent)
    mantissa, exponent = ball.rad().man_exp()
    radius = int(mantissa), int(exponent)
    return midpoint, radius


def ball_of_parts(parts: Parts | None) -> arb | None:
    """The ball that has the parts of `exact_parts`."""
    return None if parts is None else arb(*parts)
