"""Small matrices of balls (`arb`) and of rational numbers (`fmpq`), of which the verifier is made.

This is the one place that imports python-flint, so that the error names the extra that brings it.
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
    """The identity."""
    return diagonal([fmpq(1)] * side)


def diagonal(entries: Sequence[arb | fmpq]) -> arb_mat:
    """Matrix with these entries on its diagonal."""
    found = arb_mat(len(entries), len(entries))
    for k, entry in enumerate(entries):
        found[k, k] = arb(entry)
    return found


def blocks_on_diagonal(first: arb_mat, second: arb_mat) -> arb_mat:
    """Matrix with two blocks on its diagonal."""
    right = arb_mat(first.nrows(), second.ncols())
    left = arb_mat(second.nrows(), first.ncols())
    return above(beside(first, right), beside(left, second))


def beside(left: arb_mat, right: arb_mat) -> arb_mat:
    """Two matrices of as many rows, side by side."""
    return arb_mat([a + b for a, b in zip(left.tolist(), right.tolist(), strict=True)])


def above(top: arb_mat, bottom: arb_mat) -> arb_mat:
    """Two matrices of as many columns, one above the other."""
    return arb_mat(top.tolist() + bottom.tolist())


def part(A: arb_mat, rows: range, columns: range) -> arb_mat:
    """Some rows and columns of a matrix."""
    return arb_mat([[A[a, b] for b in columns] for a in rows])


def symmetric(triangle: Sequence[Entry], side: int) -> list[list[Entry]]:
    """Rows of the symmetric matrix that has this upper triangle, row by row."""
    places = iter(range(len(triangle)))
    place = {(a, b): next(places) for a in range(side) for b in range(a, side)}
    return [[triangle[place[min(a, b), max(a, b)]] for b in range(side)] for a in range(side)]


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
    left = [list(row) for row in rows]
    for k, row in enumerate(left):
        if not row[k] > 0:
            return row[k]
        _eliminate(left, k)
    return None


def is_semidefinite(rows: Sequence[Sequence[fmpq]]) -> bool:
    """Whether a symmetric matrix of rational numbers has no negative eigenvalue, exactly.

    LDL^T as in `first_bad_pivot`; beside a pivot of zero there may be nothing but zeros.
    """
    left = [list(row) for row in rows]
    for k, row in enumerate(left):
        if row[k] < 0 or (row[k] == 0 and any(row[k + 1 :])):
            return False
        if row[k] > 0:
            _eliminate(left, k)
    return True


def _eliminate(left: list[list[Number]], k: int) -> None:
    """Take row k, with a pivot that is not zero, off all that follow."""
    for a in range(k + 1, len(left)):
        share = left[a][k] / left[k][k]
        for b in range(k + 1, a + 1):
            left[a][b] = left[b][a] = left[a][b] - share * left[b][k]


def plane_rotation(theta: arb | fmpq) -> arb_mat:
    """Rotation of the plane by an angle."""
    sine, cosine = arb(theta).sin_cos()
    return arb_mat([[cosine, -sine], [sine, cosine]])


def angles_rotation(roll: fmpq, pitch: fmpq, yaw: fmpq) -> arb_mat:
    """Rotation by roll about x, then by pitch about y, then by yaw about z."""
    one = identity(1)
    swap = arb_mat([[1, 0, 0], [0, 0, 1], [0, 1, 0]])  # of y and z
    about_x = blocks_on_diagonal(one, plane_rotation(roll))
    about_y = swap * blocks_on_diagonal(plane_rotation(-pitch), one) * swap
    about_z = blocks_on_diagonal(plane_rotation(yaw), one)
    return about_z * about_y * about_x


def quaternion_rotation(x: fmpq, y: fmpq, z: fmpq, w: fmpq) -> arb_mat:
    """Rotation of a quaternion of any length: a rational function of its entries."""
    s = 2 / (x * x + y * y + z * z + w * w)
    rows = [
        [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
    ]
    return arb_mat(fmpq_mat(rows))


Parts = tuple[tuple[int, int], tuple[int, int]]  # mantissa and exponent of midpoint and radius


def exact_parts(ball: arb | None) -> Parts | None:
    """Midpoint and radius of a ball, each man 2^exp, exactly; None of none."""
    if ball is None:
        return None
    (man, exp), (rad_man, rad_exp) = ball.mid().man_exp(), ball.rad().man_exp()
    return (int(man), int(exp)), (int(rad_man), int(rad_exp))


def ball_of_parts(parts: Parts | None) -> arb | None:
    """The ball that has the parts of `exact_parts`."""
    return None if parts is None else arb(*parts)
