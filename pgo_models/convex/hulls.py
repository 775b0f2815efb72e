"""Convex hulls of the sets as linear matrix inequalities, and the products of two of them.

A matrix H(x), affine in the entries of x, is positive semidefinite where x is in the hull of its
set:

    rotation of space     4 q q^T of its unit quaternion q (Saunderson, Parrilo & Willsky 2015)
    rotation of the plane 2 h h^T, h = (cos, sin) of half its angle
    X^T X = I             (I, X; X^T, I)
    unit column x         (I, x; x^T, 1)

The Kronecker product of two such matrices, of two variables or twice of one, is positive
semidefinite on the sets, too, and linear in u u^T: <P, H x H'> >= 0 is a quadratic inequality for
every positive semidefinite P (Anstreicher, *Kronecker product constraints*, 2017). Two rotations of
space give one of side 16, that of q x q'. A linear inequality of the model is a matrix of side 1.
"""

from dataclasses import dataclass

import numpy as np

from pgo_models.convex.constraint_sets import Orthonormal, Rotations, UnitRows
from pgo_models.convex.quadratic_form import Block, QuadraticForm
from pgo_models.convex.set_equations import INEQUALITY, ONE, SetEquations, Terms
from pgo_models.graphs.pose_graph import IntArray

# All products together have at most so many entries above and on their diagonals: those of six
# rotations, which take a solver some seconds.
_MOST_ENTRIES = 2100

_LARGEST = 60  # coordinates of x; more take a solver a minute

Affine = list[tuple[int, float]]  # terms (coordinate of u, factor)

# Rows of the upper triangle of 4 q q^T, with X_ab as (a, b), and 1 as ().
_QUATERNION = (
    (0, 0, "+1 +00 +11 +22"),
    (0, 1, "+21 -12"),
    (0, 2, "+02 -20"),
    (0, 3, "+10 -01"),
    (1, 1, "+1 +00 -11 -22"),
    (1, 2, "+01 +10"),
    (1, 3, "+02 +20"),
    (2, 2, "+1 -00 +11 -22"),
    (2, 3, "+12 +21"),
    (3, 3, "+1 -00 -11 +22"),
)


@dataclass(frozen=True)
class Hull:
    """H(x) of a variable, or of one of its columns or rows.

    Parameters
    ----------
    block : int
        Position of the variable; INEQUALITY, or ONE of the constant 1.
    part : int
        Column or row, 0 where the variable is taken as a whole; number of the inequality.
    side : int
        Of H.
    entries : dict
        The affine function in every entry (a, b) that is not zero.
    has_rank_one : bool
        Whether H is h h^T on the set; a product of H with itself then says nothing new.
    """

    block: int
    part: int
    side: int
    entries: dict[tuple[int, int], Affine]
    has_rank_one: bool


def hulls_of(position: int, block: Block) -> list[Hull]:
    """The matrices of one variable in its first set; one for every unit column or row."""
    kind = block.sets[0]
    first = block.start
    n, p = block.shape if len(block.shape) == 2 else (block.shape[0], 1)
    coordinates: IntArray = first + np.arange(n * p).reshape(p, n).T
    if block.is_plane:
        half: dict[tuple[int, int], Affine] = {
            (0, 0): [(ONE, 1.0), (first, 1.0)],
            (0, 1): [(first + 1, 1.0)],
            (1, 1): [(ONE, 1.0), (first, -1.0)],
        }
        return [Hull(position, 0, 2, _mirrored(half), True)]
    if isinstance(kind, Rotations) and n == 3:
        quaternion = {(a, b): _affine(text, coordinates) for a, b, text in _QUATERNION}
        return [Hull(position, 0, 4, _mirrored(quaternion), True)]
    if isinstance(kind, Orthonormal):
        return [Hull(position, 0, n + p, _spectral_ball(coordinates), False)]
    vectors = coordinates if isinstance(kind, UnitRows) else coordinates.T
    return [
        Hull(position, part, len(vector) + 1, _spectral_ball(vector[:, None]), True)
        for part, vector in enumerate(vectors)
    ]


_CONSTANT = Hull(ONE, 0, 1, {(0, 0): [(ONE, 1.0)]}, True)


def with_inequalities(form: QuadraticForm, equations: SetEquations) -> SetEquations:
    """The equations, and after them the inequalities of the model."""
    pairs = [(inequality, _CONSTANT) for inequality in _inequalities(form)]
    return _with_products(equations, pairs) if pairs else equations


def with_hull_products(form: QuadraticForm, equations: SetEquations) -> SetEquations | None:
    """The equations, and after them the entries of products of hulls; None where there are none.

    Where all would be too many for a solver, they are those of the variables that J couples most;
    a large model gets none. Inequalities are factors of products, too.
    """
    if form.num_constrained > _LARGEST:
        return None
    hulls = [hull for k, block in enumerate(form.blocks) for hull in hulls_of(k, block)]
    # Numbers of two inequalities would be multiplied, and rounded.
    inequalities = _inequalities(form)
    mixed = [(hull, inequality) for hull in hulls for inequality in inequalities]
    pairs = _strongest(form, [*_pairs(hulls), *mixed])
    return _with_products(equations, pairs) if pairs else None


def _inequalities(form: QuadraticForm) -> list[Hull]:
    """G_r u >= 0 as matrices of side 1."""
    last = form.side - 1
    hulls = []
    for row in range(form.G.shape[0]):
        entries = slice(form.G.indptr[row], form.G.indptr[row + 1])
        pairs = zip(form.G.indices[entries].tolist(), form.G.data[entries].tolist(), strict=True)
        function = [(ONE if place == last else place, factor) for place, factor in pairs]
        hulls.append(Hull(INEQUALITY, row, 1, {(0, 0): function}, True))
    return hulls


def _with_products(equations: SetEquations, pairs: list[tuple[Hull, Hull]]) -> SetEquations:
    """The equations, and after them <P, H x H'> of pairs of matrices."""
    products = []
    for first, second in pairs:
        of = ((first.block, first.part), (second.block, second.part))
        products.append((of, first.side * second.side, _product_terms(first, second)))
    return equations.with_products(products)


def _pairs(hulls: list[Hull]) -> list[tuple[Hull, Hull]]:
    """Every two matrices, and every one with itself where that says something new."""
    pairs = []
    for place, second in enumerate(hulls):
        pairs += [(first, second) for first in hulls[:place]]
        if not second.has_rank_one:
            pairs.append((second, second))
    return pairs


def _strongest(form: QuadraticForm, pairs: list[tuple[Hull, Hull]]) -> list[tuple[Hull, Hull]]:
    """As many pairs as a solver can take, those first that J couples most."""
    Q = abs(form.Q).toarray()
    if form.reduction is not None:  # the best y in place of y
        x = np.flatnonzero(form.is_free[: form.num_constrained])
        Q[np.ix_(x, x)] = abs(form.reduction.T @ (form.Q @ form.reduction))[:-1, :-1]
    coupling = []
    for first, second in pairs:
        coupling.append(float(Q[np.ix_(_coordinates(first), _coordinates(second))].max()))
    kept = []
    num_entries = 0
    for place in np.argsort(-np.array(coupling), kind="stable"):
        first, second = pairs[place]
        side = first.side * second.side
        num_entries += side * (side + 1) // 2
        if num_entries <= _MOST_ENTRIES and coupling[place] > 0.0:
            kept.append(pairs[place])
    return kept


def _coordinates(hull: Hull) -> list[int]:
    """The coordinates of u, but for the last, that a matrix has."""
    of_all = {coordinate for terms in hull.entries.values() for coordinate, _ in terms}
    return sorted(of_all - {ONE})


def _product_terms(first: Hull, second: Hull) -> list[Terms]:
    """The upper triangle of the Kronecker product, row by row; off the diagonal twice."""
    side = second.side
    of_all: list[Terms] = []
    upper = np.transpose(np.triu_indices(first.side * side)).tolist()
    for row, column in upper:
        one = first.entries.get((row // side, column // side), [])
        other = second.entries.get((row % side, column % side), [])
        twice = 1.0 if row == column else 2.0
        of_all.append([(a, b, twice * of_a * of_b) for a, of_a in one for b, of_b in other])
    return of_all


def _affine(text: str, coordinates: IntArray) -> Affine:
    """One entry of q q^T."""
    terms: Affine = []
    for term in text.split():
        place = term[1:]
        coordinate = ONE if place == "1" else int(coordinates[int(place[0]), int(place[1])])
        terms.append((coordinate, 1.0 if term[0] == "+" else -1.0))
    return terms


def _spectral_ball(coordinates: IntArray) -> dict[tuple[int, int], Affine]:
    """(I, X; X^T, I) of a matrix of coordinates."""
    n, p = coordinates.shape
    entries: dict[tuple[int, int], Affine] = {(a, a): [(ONE, 1.0)] for a in range(n + p)}
    for a in range(n):
        for b in range(p):
            entries[a, n + b] = [(int(coordinates[a, b]), 1.0)]
    return _mirrored(entries)


def _mirrored(upper: dict[tuple[int, int], Affine]) -> dict[tuple[int, int], Affine]:
    return upper | {(b, a): terms for (a, b), terms in upper.items()}
