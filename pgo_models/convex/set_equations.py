"""The quadratic equations that hold of points of the sets: u^T A_k u = 0.

Columns are orthonormal, and rows, too, where X is square. In SO(3) every column is the cross
product of the two others, which is linear beside quadratic and tells rotations from reflections
(Briales & Gonzalez-Jimenez 2017). In SO(4) a minor of two rows and two columns is that of the other
two rows and columns, up to a sign (Jacobi); of reflections the sign is the other one. A rotation of
the plane is (a, -b; b, a), so that only a^2 + b^2 = 1 is left to say. An equality E_r u = 0 holds
times each of its coordinates.

Multipliers l of these equations make the Lagrangian u^T S u, S = Q - sum_k l_k A_k, which is J
wherever the equations hold. Inequalities and hulls of the sets, and products of two of these
(`pgo_models.convex.hulls`), say that <P, W(u)> >= 0 for every positive semidefinite P: their
multipliers are the entries of P, and u^T S u is at most J on the sets.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array, csc_array

from pgo_models.convex.constraint_sets import Orthonormal, Rotations, UnitColumns, UnitRows
from pgo_models.convex.quadratic_form import Block, NotQuadraticError, QuadraticForm
from pgo_models.geometry.arrays import ReadOnly
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray

# An equation of one block: terms (a, b, value) of value u_a u_b; -1 stands for the last of u.
Terms = list[tuple[int, int, float]]
ONE = -1
INEQUALITY = -2  # stands for an inequality among the positions of variables
_EVEN = ((0, 1, 2, 3), (0, 2, 3, 1), (0, 3, 1, 2))  # even permutations, one for each two pairs


@dataclass(frozen=True)
class HullProduct:
    """A matrix W, linear in u u^T, that is positive semidefinite on the sets.

    Parameters
    ----------
    of : one or two of (int, int)
        Of both factors, the position of the variable and its column or row; INEQUALITY and its
        number; ONE and 0 of the factor 1. One alone is the position of a variable X with
        orthonormal columns, of W = I - X X^T.
    start : int
        The k of the first entry of P. Those of its upper triangle follow, row by row, and the
        other triangle is counted with them.
    side : int
        Of P and W.
    """

    of: tuple[tuple[int, int], ...]
    start: int
    side: int

    @property
    def entries(self) -> slice:
        """The k of the entries of P."""
        return slice(self.start, self.start + self.side * (self.side + 1) // 2)

    def matrix(self, multipliers: Array) -> Array:
        """P, which is in the multipliers."""
        P = np.zeros((self.side, self.side))
        P[np.triu_indices(self.side)] = multipliers[self.entries]
        return P + np.triu(P, 1).T

    def at(self, equations: "SetEquations", u: Array) -> Array:
        """W(u)."""
        upper = equations.values(u)[self.entries]
        rows, columns = np.triu_indices(self.side)
        W = np.zeros((self.side, self.side))
        W[rows, columns] = np.where(rows == columns, upper, 0.5 * upper)
        return W + np.triu(W, 1).T


@dataclass(frozen=True, eq=False)
class SetEquations(ReadOnly):
    """Symmetric matrices A_k, their entries in one list.

    Parameters
    ----------
    side : int
        N, the number of coordinates of u.
    number : int
        How many A_k there are.
    num_basic : int
        How many of them, the first ones, say that columns (or rows) have norm 1 and are orthogonal.
    k, i, j, entries
        Entry (i, j) of A_k; the same (k, i, j) may come again and is then added.
    of_equalities : array of int
        The k that are E_r u itself, times the last of u.
    penalty : (number,) array
        Multipliers l with sum l_k u^T A_k u = -||E u||^2.
    norms : (number,) array
        Multipliers l, 0 and 1, with sum l_k u^T A_k u = ||x||^2 less the number of columns (or
        rows) of norm 1.
    products : tuple of HullProduct
        Matrices W, whose A_k come last.
    """

    side: int
    number: int
    num_basic: int
    k: IntArray
    i: IntArray
    j: IntArray
    entries: Array
    of_equalities: IntArray
    penalty: Array
    norms: Array
    products: tuple[HullProduct, ...] = ()

    @property
    def num_equations(self) -> int:
        """How many A_k are of equations, the first ones."""
        return self.products[0].start if self.products else self.number

    def combined(self, multipliers: Array) -> csc_array:
        """The sum of l_k A_k, (N, N)."""
        data = multipliers[self.k] * self.entries
        return csc_array(coo_array((data, (self.i, self.j)), shape=(self.side, self.side)))

    def sizes(self, multipliers: Array) -> csc_array:
        """The sum of |l_k| |A_k|, (N, N)."""
        data = abs(multipliers[self.k] * self.entries)
        return csc_array(coo_array((data, (self.i, self.j)), shape=(self.side, self.side)))

    def times(self, u: Array) -> csc_array:
        """The columns A_k u, (N, number)."""
        data = self.entries * u[self.j]
        return csc_array(coo_array((data, (self.i, self.k)), shape=(self.side, self.number)))

    def with_products(
        self, products: Sequence[tuple[tuple[tuple[int, int], ...], int, list[Terms]]]
    ) -> "SetEquations":
        """The equations, and after them those of products: `of`, side and W's upper triangle."""
        hull_products = []
        terms: list[Terms] = []
        for of, side, its_terms in products:
            hull_products.append(HullProduct(of, self.number + len(terms), side))
            terms += its_terms
        k, i, j, entries = entries_of_terms(self.side, terms)
        none = np.zeros(len(terms))
        return replace(
            self,
            number=self.number + len(terms),
            k=np.concatenate([self.k, self.number + k]),
            i=np.concatenate([self.i, i]),
            j=np.concatenate([self.j, j]),
            entries=np.concatenate([self.entries, entries]),
            penalty=np.concatenate([self.penalty, none]),
            norms=np.concatenate([self.norms, none]),
            products=(*self.products, *hull_products),
        )

    def values(self, u: Array) -> Array:
        """u^T A_k u, (number,)."""
        return np.bincount(self.k, self._all_terms(u), self.number).astype(float)

    def value_sizes(self, u: Array) -> Array:
        """The sums of the absolute terms of u^T A_k u, (number,); numbers below 1 count as 1."""
        at_least_one = np.maximum(abs(u), 1.0)
        return np.bincount(self.k, abs(self._all_terms(at_least_one)), self.number).astype(float)

    def violation(self, u: Array) -> float:
        """The largest violation of an equation or an inequality, as a share of its terms."""
        shares = self.values(u) / np.maximum(self.value_sizes(u), 1e-300)
        inequalities = [product.start for product in self.products if product.side == 1]
        violations = [*abs(shares[: self.num_equations]), *-shares[inequalities]]
        return float(np.max(violations, initial=0.0))

    def terms(self, multipliers: Array, u: Array) -> Array:
        """The terms of sum l_k u^T A_k u, of at most four factors each."""
        return multipliers[self.k] * self._all_terms(u)

    def _all_terms(self, u: Array) -> Array:
        return self.entries * u[self.i] * u[self.j]


def set_equations(form: QuadraticForm) -> SetEquations:
    """The equations of all sets and equalities of a form.

    Returns
    -------
    SetEquations
        Basic ones first.

    Raises
    ------
    NotQuadraticError
        If a variable is in a set without such equations.
    """
    basic: list[Terms] = []
    further: list[Terms] = []
    norms: list[bool] = []
    for block in form.blocks:
        first, others = equations_of_block(block)
        basic += first
        further += others
        of_first_set = 1 if block.is_plane else len(_equations_of(block.sets[0], block.shape)[0])
        for position, terms in enumerate(first):
            norms.append(position < of_first_set and (ONE, ONE, -1.0) in terms)
    last = form.side - 1
    of_equalities = []
    penalty = [0.0] * (len(basic) + len(further))
    for row in range(form.E.shape[0]):
        entries = slice(form.E.indptr[row], form.E.indptr[row + 1])
        equality = dict(zip(form.E.indices[entries].tolist(), form.E.data[entries], strict=True))
        of_equalities.append(len(penalty))
        for times in (last, *(position for position in equality if position != last)):
            further.append([(position, times, factor) for position, factor in equality.items()])
            penalty.append(-equality.get(times, 0.0))
    is_norm = np.zeros(len(penalty))
    is_norm[: len(basic)] = norms
    return SetEquations(
        form.side,
        len(penalty),
        len(basic),
        *entries_of_terms(form.side, basic + further),
        np.array(of_equalities, dtype=int),
        np.array(penalty),
        is_norm,
    )


def equations_of_block(block: Block) -> tuple[list[Terms], list[Terms]]:
    """Basic and further equations of one variable; a NotQuadraticError if a set has none."""
    for each in block.sets:
        if not isinstance(each, Orthonormal | UnitColumns):
            raise NotQuadraticError(f"{each!r} is no set of quadratic equations")
    basic = []
    further = []
    for each in (UnitColumns(),) if block.is_plane else block.sets:
        first, others = _equations_of(each, (2, 1) if block.is_plane else block.shape)
        basic += [_shifted(terms, block.start) for terms in first]
        further += [_shifted(terms, block.start) for terms in others]
    return basic, further


def _equations_of(kind: object, shape: tuple[int, ...]) -> tuple[list[Terms], list[Terms]]:
    """Basic and further equations of one variable in one set."""
    n, p = shape if len(shape) == 2 else (shape[0], 1)
    columns = [[a + n * b for a in range(n)] for b in range(p)]
    rows = [[a + n * b for b in range(p)] for a in range(n)]
    if isinstance(kind, UnitRows):
        vectors = rows if len(shape) == 2 else [[a] for a in range(n)]
        return [_product(vector, vector, 1.0) for vector in vectors], []
    if isinstance(kind, UnitColumns):
        return [_product(column, column, 1.0) for column in columns], []
    further = []
    if n == p:
        further = _orthonormal(rows)[:-1]  # the norms of columns and rows have one sum
    if isinstance(kind, Rotations):
        further += _not_of_reflections(columns)
    return _orthonormal(columns), further


def _not_of_reflections(columns: Sequence[Sequence[int]]) -> list[Terms]:
    """Equations of rotations in three and four dimensions that reflections do not hold."""
    equations = []
    if len(columns) == 3:
        for a in range(3):
            equations += _cross_product(columns[a], columns[(a + 1) % 3], columns[(a + 2) % 3])
    if len(columns) == 4:
        swapped = [(c, d, a, b) for a, b, c, d in _EVEN]
        for these_columns in _EVEN:
            for these_rows in (*_EVEN, *swapped):
                equations.append(_minors(columns, these_rows, these_columns))
    return equations


def _orthonormal(vectors: Sequence[Sequence[int]]) -> list[Terms]:
    equations = []
    for b, second in enumerate(vectors):
        for first in vectors[: b + 1]:
            equations.append(_product(first, second, float(first is second)))
    return equations


def _product(first: Sequence[int], second: Sequence[int], value: float) -> Terms:
    """<first, second> = value."""
    terms = [(a, b, 1.0) for a, b in zip(first, second, strict=True)]
    return [*terms, (ONE, ONE, -value)] if value else terms


def _cross_product(
    first: Sequence[int], second: Sequence[int], third: Sequence[int]
) -> list[Terms]:
    """Entries of first x second = third."""
    equations = []
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        plus = (first[b], second[c], 1.0)
        minus = (first[c], second[b], -1.0)
        equations.append([plus, minus, (third[a], ONE, -1.0)])
    return equations


def _minors(columns: Sequence[Sequence[int]], r: Sequence[int], c: Sequence[int]) -> Terms:
    """The minor of rows r_0, r_1 and columns c_0, c_1 is that of r_2, r_3 and c_2, c_3."""
    terms = []
    for a, b, sign in ((0, 1, 1.0), (2, 3, -1.0)):
        terms.append((columns[c[a]][r[a]], columns[c[b]][r[b]], sign))
        terms.append((columns[c[a]][r[b]], columns[c[b]][r[a]], -sign))
    return terms


def _shifted(terms: Terms, start: int) -> Terms:
    return [
        (a if a == ONE else a + start, b if b == ONE else b + start, value) for a, b, value in terms
    ]


def entries_of_terms(
    side: int, equations: list[Terms]
) -> tuple[IntArray, IntArray, IntArray, Array]:
    """All equations as one list of entries; a term of two coordinates is half above, half below."""
    k = np.repeat(np.arange(len(equations)), [len(terms) for terms in equations])
    flat = np.array([term for terms in equations for term in terms]).reshape(-1, 3)
    a = flat[:, 0].astype(int) % side
    b = flat[:, 1].astype(int) % side
    half = 0.5 * flat[:, 2]
    k, i, j = (np.concatenate(both) for both in ((k, k), (a, b), (b, a)))
    return k, i, j, np.concatenate([half, half])
