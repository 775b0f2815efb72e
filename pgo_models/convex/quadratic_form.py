"""A quadratic cvxpy model as one quadratic form, from the numbers that cvxpy gives a solver.

cvxpy states a convex quadratic model as

    minimise 1/2 z^T P z + c^T z + constant   subject to   A z = b,  H z <= h,

where z holds the model's variables, and numbers of cvxpy's own, such as the residuals r of a sum of
squares, with the equality r = A x - b. Two steps, both exact, lead to fewer numbers:

1. A number of cvxpy's own that stands in a single equality, with the factor 1 or -1, is what this
   equality says of it. So z = T w, and w has the variables, the rest of cvxpy's own numbers, and 1.
2. A rotation of the plane, (a, -b; b, a), has two different numbers. So w = spread u, where u has
   every number once; the entries of `spread` are 0, 1 and -1.

What remains is

    J = u^T Q u,   Q = spread^T T^T P T spread / 2 + sym(e (T spread)^T c) + constant e e^T,

with e the last unit vector, equalities E u = 0, inequalities G u >= 0, and coordinates of u that
equalities fix.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.linalg import qr
from scipy.sparse import (
    block_array,
    coo_array,
    csc_array,
    csr_array,
    diags_array,
    eye_array,
    vstack,
)
from scipy.sparse.linalg import splu

from pgo_models.convex.constraint_sets import (
    ConstraintSet,
    Orthonormal,
    Rotations,
    UnitColumns,
    UnitRows,
)
from pgo_models.convex.convex_solver import check_parameters, has_attributes
from pgo_models.convex.orthogonality import OrthogonalProblem
from pgo_models.errors import SettingError
from pgo_models.geometry.arrays import ReadOnly
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.floating_point import OUTWARD, exact_sum, gamma

# of the linear equations for variables without a set: their regularisation, and what is left of
# the right side where they have no solution, both as shares
_DAMPING = 1e-9
_REFINEMENTS = 4
_INCONSISTENT = 1e-6
_MOST_FLAT = 8  # directions in which J may be constant
_LARGEST_DENSE = 600  # side up to which y is found by one dense matrix
_FLAT = 1e-3  # share of a random direction that is left where J is constant


class NotQuadraticError(SettingError):
    """A model is no quadratic form with linear constraints."""


@dataclass(frozen=True)
class Block:
    """A constrained variable among the coordinates of u.

    Parameters
    ----------
    start : int
        Its first coordinate. Entries follow column by column; of a rotation of the plane there are
        two, its first column.
    shape : tuple of ints
        Shape of the variable.
    sets : tuple of ConstraintSet
        What it is in.
    """

    start: int
    shape: tuple[int, ...]
    sets: tuple[ConstraintSet, ...]

    @property
    def is_plane(self) -> bool:
        """Whether it is a rotation of the plane, (a, -b; b, a)."""
        return self.shape == (2, 2) and any(isinstance(each, Rotations) for each in self.sets)

    @property
    def size(self) -> int:
        """Number of its coordinates."""
        return 2 if self.is_plane else math.prod(self.shape)

    @property
    def coordinates(self) -> slice:
        """Where they are in u."""
        return slice(self.start, self.start + self.size)

    def value(self, x: Array) -> Array:
        """The variable, in its shape, of its coordinates."""
        if self.is_plane:
            a, b = x
            return np.array([[a, -b], [b, a]])
        return x.reshape(self.shape, order="F")

    def coordinates_of(self, value: Array) -> Array:
        """Its coordinates of the variable."""
        return value.reshape(-1, order="F")[: self.size]


@dataclass(frozen=True, eq=False)
class Gauge(ReadOnly):
    """A common rotation of all variables that leaves J as it is (`pgo_models.convex.gauge`).

    Parameters
    ----------
    block : int
        Position of the variable that is held at the identity.
    is_left : bool
        Whether variables are turned from the left, X -> Q X, or from the right, X -> X Q.
    entries : (d, k) array of ints
        The entries of w that are turned: every column of w[entries] is.
    """

    block: int
    is_left: bool
    entries: IntArray

    def turned(self, form: "QuadraticForm", u: Array) -> Array:
        """U turned so that the variable is the identity."""
        block = form.blocks[self.block]
        X = block.value(u[block.coordinates])
        w = form.spread @ u
        w[self.entries] = (X.T if self.is_left else X) @ w[self.entries]
        # the first of the entries that are the same number
        turned = w[form.spread.indices[form.spread.indptr[:-1]]]
        turned[block.coordinates] = block.coordinates_of(np.eye(len(X)))
        return np.asarray(turned)


@dataclass(frozen=True, eq=False)
class QuadraticForm(ReadOnly):
    """J = u^T Q u with u = (x_1, .., x_m, y, 1), subject to E u = 0 and G u >= 0.

    x_k are the entries of `problem.variables[k]`, column by column (of a rotation of the plane its
    first column), y those of `problem.others` in their order, then numbers of cvxpy's own, if any.
    P, c, A, b and the constant are the model as cvxpy hands it to a solver, of which a bound is
    proven; A z = b also has the entries that an entry of 1 or -1 leaves zero on the sets. Made by
    `quadratic_form`.

    Parameters
    ----------
    P, c, A, b, H, h, constant
        1/2 z^T P z + c^T z + constant, A z = b and H z <= h.
    T : (len(c), k) sparse array
        z = T w, exactly.
    spread : (k, N) sparse array
        w = spread u, entries 0, 1 and -1.
    E : (rows, N) sparse array
        Equalities E u = 0 that are left.
    G : (rows, N) sparse array
        Inequalities G u >= 0.
    fixed : (N,) array
        The values that equalities give to coordinates, nan where they give none. The last is 1.
    blocks : tuple of Block
        One for every constrained variable.
    names : tuple of (int, str)
        First coordinate and name of every variable.
    w_columns : array of ints
        The entry of z that every entry of w is, but for the last, which is 1.
    gauge : Gauge or None
        Why a variable is held at the identity, where no equality does it.
    """

    P: csc_array
    c: Array
    A: csc_array
    b: Array
    H: csr_array
    h: Array
    constant: float
    T: csc_array
    spread: csc_array
    E: csr_array
    G: csr_array
    fixed: Array
    blocks: tuple[Block, ...]
    names: tuple[tuple[int, str], ...]
    w_columns: IntArray
    gauge: Gauge | None = None

    @property
    def first_entries(self) -> list[int]:
        """The first entry in z of every constrained variable."""
        sizes = [int(np.prod(block.shape)) for block in self.blocks]
        return [int(self.w_columns[start]) for start in np.cumsum([0, *sizes[:-1]])]

    @property
    def side(self) -> int:
        """N, the number of coordinates of u."""
        return len(self.fixed)

    @cached_property
    def num_constrained(self) -> int:
        """Number of coordinates of x."""
        last = self.blocks[-1]
        return last.start + last.size

    @cached_property
    def is_free(self) -> BoolArray:
        """Which coordinates are not fixed, (N,)."""
        return np.isnan(self.fixed)

    @cached_property
    def from_u(self) -> csc_array:
        """T spread, (len(c), N), rounded where two entries of T meet in a plane rotation."""
        return csc_array(self.T @ self.spread)

    @cached_property
    def Q(self) -> csc_array:
        """The matrix of the form, (N, N), in doubles, with all of its diagonal stored."""
        return self._assembled(self.P, self.c, self.constant, self.T, self.spread)

    @cached_property
    def Q_error(self) -> csc_array:
        """Bound on the rounding of every entry of Q, (N, N)."""
        # Entries are sums of at most so many products, at most three factors each.
        most_of_P = np.diff(csr_array(self.P).indptr).max(initial=0)
        most_of_T = np.diff(self.T.indptr).max(initial=0)
        share: float = gamma(float(most_of_P + most_of_T) + 12.0)
        sizes = abs(self.P), abs(self.c), abs(self.constant), abs(self.T), abs(self.spread)
        return csc_array(share * self._assembled(*sizes))

    def _assembled(
        self, P: csc_array, c: Array, constant: float, T: csc_array, spread: csc_array
    ) -> csc_array:
        quadratic = coo_array(0.5 * (spread.T @ (T.T @ (P @ T)) @ spread))
        linear = coo_array(0.5 * (spread.T @ (T.T @ c))[:, None])
        last = self.side - 1
        rows: list[Any] = [linear.row, np.full(linear.nnz, last), np.arange(self.side), [last]]
        columns: list[Any] = [np.full(linear.nnz, last), linear.row, np.arange(self.side), [last]]
        data: list[Any] = [linear.data, linear.data, np.zeros(self.side), [constant]]
        rows.append(quadratic.row)
        columns.append(quadratic.col)
        data.append(quadratic.data)
        entries = np.concatenate(data), (np.concatenate(rows), np.concatenate(columns))
        return csc_array(coo_array(entries, shape=(self.side, self.side)))

    def objective(self, u: Array) -> float:
        """J at u, from the residuals rather than from Q."""
        z = self.from_u @ u
        return float(0.5 * z @ (self.P @ z) + self.c @ z + self.constant)

    def residuals(self, u: Array) -> tuple[Array, Array]:
        """Z at u, and a bound on its rounding."""
        count = np.bincount(self.T.indices, minlength=len(self.c)).astype(float) + 4.0
        sizes = abs(self.T) @ (abs(self.spread) @ abs(u))
        return self.T @ (self.spread @ u), gamma(count) * sizes

    def evaluated(self, u: Array, others: Array | None = None) -> tuple[float, float]:
        """J at u plus the terms of another sum, and a bound on the rounding of both.

        The terms are products of at most four factors.
        """
        terms = np.zeros(0) if others is None else others
        z, z_error = self.residuals(u)
        Pz = self.P @ z
        size = abs(self.P) @ (abs(z) + z_error)
        share = gamma(float(np.diff(self.P.indptr).max(initial=0) + 6.0))
        parts = np.concatenate([0.5 * z * Pz, self.c * z, [self.constant], terms])
        error = share * (0.5 * abs(z) @ size + abs(self.c) @ abs(z) + np.sum(abs(terms)))
        error += z_error @ size + abs(self.c) @ z_error
        value = exact_sum(parts.tolist())
        return value, OUTWARD * float(error + gamma(1.0) * abs(value))

    def rounding_level(self, u: Array) -> float:
        """J, less its constant, where all of z is as large as the rounding of u makes it."""
        z = gamma(4.0) * (abs(self.T) @ (abs(self.spread) @ abs(u)))
        return float(0.5 * z @ (abs(self.P) @ z))

    @property
    def is_sum_of_squares(self) -> bool:
        """Whether J is a sum of weighted squares and thus never negative."""
        has_squares_alone = not self.c.any() and self.constant >= 0.0
        off_diagonal = self.P - diags_array(self.P.diagonal())
        return bool(has_squares_alone and not off_diagonal.count_nonzero()) and bool(
            (self.P.diagonal() >= 0.0).all()
        )

    def values(self, u: Array) -> list[Array]:
        """The constrained variables at u, each in its shape."""
        return [block.value(u[block.coordinates]) for block in self.blocks]

    def u_of(self, values: Sequence[Array]) -> Array:
        """The u of constrained variables, with the best values of all others."""
        pairs = zip(self.blocks, values, strict=True)
        x = np.concatenate([block.coordinates_of(value) for block, value in pairs])
        if self.gauge is not None:
            u = np.where(self.is_free, 0.0, self.fixed)
            u[: len(x)] = x
            x = self.gauge.turned(self, u)[: len(x)]
        return self.u_of_entries(x)

    def with_others(self, u: Array, others: Sequence[Array]) -> Array:
        """U with given values of the variables without a set, where equalities do not fix them."""
        entries = np.concatenate([np.zeros(0), *(np.ravel(y, order="F") for y in others)])
        places = slice(self.num_constrained, self.num_constrained + len(entries))
        changed = u.copy()
        changed[places] = np.where(self.is_free[places], entries, u[places])
        return changed

    def u_of_entries(self, x: Array) -> Array:
        """The u of the coordinates of x, with the best values of all others."""
        if self.reduction is not None:
            return np.asarray(self.reduction[:, :-1] @ x[self.free_x] + self.reduction[:, -1])
        u = np.zeros(self.side)
        u[: len(x)] = x
        return self.with_best_others(self.with_fixed(u))

    def with_fixed(self, u: Array) -> Array:
        """U with the values that equalities give to coordinates."""
        return np.where(self.is_free, u, self.fixed)

    @cached_property
    def free_x(self) -> IntArray:
        """Coordinates of x that are not fixed."""
        return np.flatnonzero(self.is_free[: self.num_constrained])

    @cached_property
    def limits_x(self) -> bool:
        """Whether inequalities, or equalities of x alone, are left beside the sets.

        Step (a) then takes a convex solver, and points of the sets need not be feasible.
        """
        return bool(self.G.shape[0]) or self._equalities_of_others.shape[0] < self.E.shape[0]

    # Variables without a set.

    @cached_property
    def free_others(self) -> IntArray:
        """Coordinates that are neither fixed nor of a constrained variable."""
        positions = np.flatnonzero(self.is_free)
        return positions[positions >= self.num_constrained]

    def with_best_others(self, u: Array) -> Array:
        """U with the coordinates of y at which J is least, for its x, without inequalities.

        Raises a NotQuadraticError where combinations of equalities hold of x alone, and a
        SettingError where J has no minimum over y.
        """
        best = u.copy()
        y = self.free_others
        if not len(y):
            return best
        if self.side <= _LARGEST_DENSE:
            best[y] = self._others_of_constrained @ u
            return best
        best[y] = 0.0
        best[y] = self._solve_for_others(self._right_side(best[:, None]))[:, 0]
        return best

    def _right_side(self, u: Array) -> Array:
        """Right side of `other_equations` at several u with y = 0."""
        of_equalities = self._equalities_of_others @ u
        return np.concatenate([-2.0 * (self.Q @ u)[self.free_others], -of_equalities])

    @cached_property
    def _equalities_of_others(self) -> csr_array:
        """The equalities that have entries of y, each as large as Q; others hold of x alone."""
        rows = self.E[np.flatnonzero(np.diff(csr_array(self.E[:, self.free_others]).indptr))]
        sizes = abs(rows).max(axis=1).toarray().ravel()
        return csr_array(diags_array((abs(self.Q).max() or 1.0) / sizes) @ rows)

    @cached_property
    def _others_of_constrained(self) -> Array:
        """Matrix with y = matrix u, (len(y), N), for small models."""
        without = np.eye(self.side)
        without[self.free_others] = 0.0
        return self._solve_for_others(self._right_side(without))

    @cached_property
    def other_equations(self) -> tuple[csc_array, Any]:
        """Optimality conditions of y, regularised for the factor that solves them."""
        y = self.free_others
        H = 2.0 * self.Q[y][:, y]
        E = self._equalities_of_others[:, y]
        blocks: list[list[Any]] = [[H, E.T], [E, None]]
        equations = csc_array(block_array(blocks)) if E.shape[0] else csc_array(H)
        damping = np.full(equations.shape[0], _DAMPING * (abs(self.Q).max() or 1.0))
        damping[len(y) :] *= -1.0
        return equations, splu(csc_array(equations + diags_array(damping)))

    def _solve_for_others(self, right: Array) -> Array:
        equations, factor = self.other_equations
        solution = np.zeros(right.shape)
        residual = right
        for _ in range(_REFINEMENTS):
            solution = solution + factor.solve(residual)
            residual = right - equations @ solution
        num_others = len(self.free_others)
        sizes = np.linalg.norm(right, axis=0)
        scale = sizes + np.linalg.norm(solution, axis=0) * abs(self.Q).max() * _DAMPING
        of_equalities = np.linalg.norm(residual[num_others:], axis=0)
        if (of_equalities > _INCONSISTENT * scale).any():
            raise NotQuadraticError(
                "a combination of equalities holds of the constrained variables alone; "
                "write it as one equality without the other variables"
            )
        is_slope = abs(residual[:num_others]) > _INCONSISTENT * scale
        if is_slope.any():
            if self.G.shape[0]:
                raise NotQuadraticError(
                    "inequalities alone bound the objective, as the pieces of |x| or Huber's loss"
                )
            steepest = self.free_others[np.argmax(is_slope.any(axis=1))]
            raise SettingError(
                f"the objective is not bounded below in {self.name_of(int(steepest))}; "
                "bound it by a square or an equality"
            )
        return solution[:num_others]

    @cached_property
    def reduction(self) -> Array | None:
        """D with u = D (free x, 1) where fixed coordinates and the best y are put in.

        None of a model with many coordinates.
        """
        if self.side > _LARGEST_DENSE:
            return None
        constrained = self.free_x
        D = np.zeros((self.side, len(constrained) + 1))
        D[constrained, np.arange(len(constrained))] = 1.0
        D[:, -1] = np.where(self.is_free, 0.0, self.fixed)
        y = self.free_others
        if len(y):
            D[y] = self._others_of_constrained @ D
        return D

    def name_of(self, coordinate: int) -> str:
        """Name of the variable that a coordinate is of."""
        return [name for start, name in self.names if start <= coordinate][-1]

    @cached_property
    def grounded(self) -> IntArray:
        """Coordinates of y that may be held wherever they are, since a shift changes nothing.

        A common shift of all translations leaves most models as they are. Held are coordinates
        with whose help every such shift, all of whose entries are 0, 1 and -1, can be undone. That
        T and E do not see it is checked exactly.
        """
        y = self.free_others
        basis = self._flat_directions()
        if basis is None:
            return y[:0]
        pivots = qr(basis.T, mode="r", pivoting=True)[1][: basis.shape[1]]
        shifts = np.round(basis @ np.linalg.inv(basis[pivots]))
        seen = csr_array(self.from_u[:, y])
        with_weight = abs(self.P).sum(axis=0) + abs(self.c) > 0.0
        of_all = [seen[np.flatnonzero(with_weight)], self.E[:, y], self.G[:, y]]
        held = []
        for pivot, shift in zip(pivots, shifts.T, strict=True):
            is_plain = np.isin(shift, (-1.0, 0.0, 1.0)).all()
            if is_plain and all(_is_zero(rows, shift) for rows in of_all):
                held.append(y[pivot])
        return np.array(sorted(held), dtype=int)

    def _flat_directions(self) -> Array | None:
        """Basis of the directions of y in which J is constant, None where there are none."""
        y = self.free_others
        if not len(y):
            return None
        equations, factor = self.other_equations
        draws = np.zeros((equations.shape[0], _MOST_FLAT))
        draws[: len(y)] = np.random.default_rng(0).standard_normal((len(y), _MOST_FLAT))
        flat = draws
        for _ in range(_REFINEMENTS):
            flat = flat - factor.solve(equations @ flat)
        sizes, directions = np.linalg.svd(flat[: len(y)], full_matrices=False)[1::-1]
        directions = directions[:, sizes > _FLAT]
        return directions if directions.shape[1] else None


def _is_zero(rows: csr_array, shift: Array) -> bool:
    """Whether rows @ shift is zero in exact arithmetic, for a shift of 0, 1 and -1."""
    if (rows @ shift).any():
        return False
    is_long = np.diff((rows @ diags_array(abs(shift))).indptr) > 2  # of two, zero is exact
    for row in np.flatnonzero(is_long):
        entries = slice(rows.indptr[row], rows.indptr[row + 1])
        if exact_sum(rows.data[entries] * shift[rows.indices[entries]]) != 0.0:
            return False
    return True


def quadratic_form(problem: OrthogonalProblem) -> QuadraticForm:
    """The quadratic form of a convex quadratic model with linear constraints.

    Raises
    ------
    NotQuadraticError
        If the objective is no convex quadratic, or constraints are not linear.
    SettingError
        If a Parameter has no value, or the data have nan or inf.

    Examples
    --------
    >>> X = cp.Variable((2, 2))
    >>> nearest = cp.Problem(cp.Minimize(cp.sum_squares(X - np.eye(2))))
    >>> form = quadratic_form(OrthogonalProblem(nearest, rotations=[X]))
    >>> form.Q.toarray()
    array([[ 2.,  0., -2.],
           [ 0.,  2.,  0.],
           [-2.,  0.,  2.]])
    """
    data, columns, constant = _canonical_data(problem)
    c = np.asarray(data["c"], dtype=float)
    b = np.asarray(data["b"], dtype=float)
    num_equalities = data["dims"].zero
    H = csr_array(data["A"])[num_equalities:]
    h = b[num_equalities:]
    A = csc_array(csr_array(data["A"])[:num_equalities])
    b = b[:num_equalities]
    P = _symmetric_of_upper(data.get("P"), len(c))
    of_rows = (("data", numbers) for numbers in (A.data, b, H.data, h))
    for name, numbers in (("objective", P.data), ("objective", c), *of_rows):
        if not np.isfinite(numbers).all():
            raise SettingError(f"the {name} of the model has nan or inf; check the data")
    w_columns, blocks, names, spread = _coordinates(problem, columns)
    T, rows_left, w_columns = _without_residuals(A, b, w_columns)
    names = [*names, (spread.shape[1], "a number of cvxpy's own")]
    num_own = len(w_columns) - spread.shape[0]
    corners: list[list[Any]] = [[spread, None], [None, eye_array(num_own + 1)]]
    spread = csc_array(block_array(corners))
    spread.sort_indices()
    E = _in_u(csr_array(A[rows_left]), b[rows_left], w_columns, spread)
    G = -_in_u(H, h, w_columns, spread)
    fixed, is_left = _fixed_coordinates(E)
    zeros = _forced_to_zero(blocks, fixed)
    fixed[zeros] = 0.0
    # A number of a rotation of the plane is two entries, of which the first is enough.
    of_zeros = w_columns[spread.indices[spread.indptr[zeros]]]
    A = csc_array(vstack([A, csr_array(eye_array(len(c)))[of_zeros]]))
    b = np.append(b, np.zeros(len(zeros)))
    form = QuadraticForm(
        P=P,
        c=c,
        A=A,
        b=b,
        H=H,
        h=h,
        constant=constant,
        T=T,
        spread=spread,
        E=csr_array(E[is_left]),
        G=csr_array(G),
        fixed=fixed,
        blocks=tuple(blocks),
        names=tuple(names),
        w_columns=w_columns,
    )
    form.with_best_others(np.cos(np.arange(form.side)))  # refuses what has no best ones
    return form


def _canonical_data(problem: OrthogonalProblem) -> tuple[dict[str, Any], dict[int, int], float]:
    """What cvxpy hands to a solver, the first column of every variable, and the constant."""
    check_parameters(problem.problem)
    if not problem.J.is_qpwa():
        raise NotQuadraticError("the objective is not quadratic")
    try:
        data, _, inverse = problem.minimisation.get_problem_data(cp.CLARABEL)
    except ValueError as error:  # cvxpy's of nan and inf in the data
        raise SettingError(f"the model has nan or inf: {error}") from error
    if data["dims"].zero + data["dims"].nonneg != data["A"].shape[0]:
        raise NotQuadraticError("a constraint is not linear")
    columns = data["param_prob"].var_id_to_col
    for variable in (*problem.variables, *problem.others):
        if has_attributes(variable):
            raise NotQuadraticError(
                f"{variable.name()} has attributes; write them as constraints, as x >= 0"
            )
    return data, columns, float(inverse[-1]["offset"])


def _in_u(rows: csr_array, right: Array, w_columns: IntArray, spread: csc_array) -> csr_array:
    """Rows z - right in the coordinates of u, which are the same numbers."""
    in_w = csc_array(rows)[:, w_columns]
    if in_w.nnz < rows.nnz:
        raise NotQuadraticError("an inequality has a residual of the objective")
    with_constant = csr_array(block_array([[in_w, csc_array(-right[:, None])]]))
    in_u = csr_array(with_constant @ spread)
    # The two equal entries of a rotation of the plane are added. A sum is exact where both
    # differences are (Dekker 1971).
    equal = np.flatnonzero(np.diff(spread.indptr) == 2)
    first, second = (
        csc_array(with_constant)[:, spread.indices[of_both]] @ diags_array(spread.data[of_both])
        for of_both in (spread.indptr[equal], spread.indptr[equal] + 1)
    )
    added = csc_array(in_u)[:, equal]
    if (added - first != second).nnz or (added - second != first).nnz:
        raise NotQuadraticError(
            "a constraint adds factors of equal entries of a rotation of the plane, and rounds; "
            "write it with its first column alone"
        )
    return in_u


def _symmetric_of_upper(P: csc_array | None, side: int) -> csc_array:
    """The symmetric matrix whose upper triangle a solver takes."""
    if P is None:
        return csc_array((side, side))
    upper = coo_array(P)
    is_above = upper.row < upper.col
    rows = np.concatenate([upper.row[upper.row <= upper.col], upper.col[is_above]])
    columns = np.concatenate([upper.col[upper.row <= upper.col], upper.row[is_above]])
    data = np.concatenate([upper.data[upper.row <= upper.col], upper.data[is_above]])
    return csc_array(coo_array((data, (rows, columns)), shape=(side, side)))


def _coordinates(
    problem: OrthogonalProblem, columns: dict[int, int]
) -> tuple[IntArray, list[Block], list[tuple[int, str]], csc_array]:
    """Columns of z that are the variables', blocks and names, and w from u without its 1."""
    w_columns = []
    blocks = []
    names = []
    spreads = []
    start = 0
    for position, variable in enumerate((*problem.variables, *problem.others)):
        first = columns[variable.id]
        w_columns.append(np.arange(first, first + variable.size))
        names.append((start, variable.name()))
        size = variable.size
        spread = csc_array(eye_array(variable.size))
        if position < len(problem.variables):
            block = Block(start, variable.shape, tuple(problem.terms_of(position)))
            blocks.append(block)
            size = block.size
            if block.is_plane:
                spread = csc_array([[1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 0.0]])
        spreads.append(spread)
        start += size
    grid: list[list[Any]] = [[None] * len(spreads) for _ in spreads]
    for k, spread in enumerate(spreads):
        grid[k][k] = spread
    return np.concatenate(w_columns), blocks, names, csc_array(block_array(grid))


def _without_residuals(
    A: csc_array, b: Array, w_columns: IntArray
) -> tuple[csc_array, IntArray, IntArray]:
    """T with z = T w, the rows of A that it does not use, and the columns of w without its 1.

    Of a column j with one entry, 1 or -1, row i of A z = b says z_j = A_ij (b_i - the others).
    """
    num_columns = A.shape[1]
    is_own = np.ones(num_columns, dtype=bool)
    is_own[w_columns] = False
    candidates = np.flatnonzero(is_own & (np.diff(A.indptr) == 1))
    candidates = candidates[abs(A.data[A.indptr[candidates]]) == 1.0]
    rows, first = np.unique(A.indices[A.indptr[candidates]], return_index=True)
    residuals = candidates[first]
    signs = A.data[A.indptr[residuals]]
    is_own[residuals] = False
    w_columns = np.concatenate([w_columns, np.flatnonzero(is_own)])
    identity = coo_array(
        (np.ones(len(w_columns)), (w_columns, np.arange(len(w_columns)))),
        shape=(num_columns, len(w_columns) + 1),
    )
    others = coo_array(diags_array(-signs) @ csr_array(A)[rows][:, w_columns])
    is_constant = b[rows] != 0.0
    entries = [identity.data, others.data, (signs * b[rows])[is_constant]]
    in_rows = [identity.row, residuals[others.row], residuals[is_constant]]
    in_columns = [identity.col, others.col, np.full(is_constant.sum(), len(w_columns))]
    T = coo_array(
        (np.concatenate(entries), (np.concatenate(in_rows), np.concatenate(in_columns))),
        shape=identity.shape,
    )
    return csc_array(T), np.setdiff1d(np.arange(A.shape[0]), rows), w_columns


def _forced_to_zero(blocks: Sequence[Block], fixed: Array) -> IntArray:
    """Coordinates that are zero, as another entry of a row or column of norm one is 1 or -1.

    Unless these are fixed as well, the relaxation has no interior, and its bound is attained by no
    multipliers. `fixed` is nan for coordinates without a value. An entry counts only where it is
    exactly 1 or -1; of two such entries in a vector, which contradict each other, nothing follows.
    """
    zeros: list[int] = []
    for vector in (each for block in blocks for each in _unit_vectors(block)):
        values = fixed[vector]
        if (abs(values) == 1.0).sum() == 1:
            zeros += vector[np.isnan(values)].tolist()
    return np.unique(np.array(zeros, dtype=int))


def _unit_vectors(block: Block) -> list[IntArray]:
    """Coordinates of every column and row of a variable whose norm is one by its sets.

    A vector is one column, and so is a rotation of the plane, by its coordinates.
    """
    coordinates = np.arange(block.start, block.start + block.size)
    is_vector = block.is_plane or len(block.shape) == 1
    entries = coordinates[:, None] if is_vector else coordinates.reshape(block.shape, order="F")
    rows = [*entries]
    columns = [*entries.T]
    vectors = []
    for each in block.sets:
        if isinstance(each, UnitRows):
            vectors += rows
        elif isinstance(each, UnitColumns):
            vectors += columns
        elif isinstance(each, Orthonormal):
            vectors += [*columns, *rows] if len(rows) == len(columns) else columns
    return vectors


def _fixed_coordinates(E: csr_array) -> tuple[Array, BoolArray]:
    """Values of the coordinates that one row of E u = 0 fixes exactly, and the other rows."""
    E.eliminate_zeros()
    last = E.shape[1] - 1
    fixed = np.full(E.shape[1], np.nan)
    fixed[last] = 1.0
    is_left = np.ones(E.shape[0], dtype=bool)
    for row in range(E.shape[0]):
        entries = slice(E.indptr[row], E.indptr[row + 1])
        constant = sum(E.data[entries][E.indices[entries] == last])
        of_variables = E.indices[entries] != last
        if of_variables.sum() != 1:
            continue
        factor = float(E.data[entries][of_variables][0])
        position = int(E.indices[entries][of_variables][0])
        value = -constant / factor
        is_exact = Fraction(value) * Fraction(factor) == -Fraction(float(constant))
        if is_exact and (np.isnan(fixed[position]) or fixed[position] == value):
            fixed[position] = value
            is_left[row] = False
    return fixed, is_left
