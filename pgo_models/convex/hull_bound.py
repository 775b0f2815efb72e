"""A proven lower bound on any convex objective: the least J over the convex hulls of the sets.

The hulls are those of `pgo_models.convex.hulls`; unit columns have the unit ball. cvxpy states the
convex program as

    minimise c^T x + constant   subject to   A x + s = b,  s in a cone K of numbers that are not
    negative, second-order cones and semidefinite matrices.

For every y in the dual cone, and g = c + A^T y, c^T x >= -b^T y + g^T x. Entries of variables in
sets are between -1 and 1, so that there g^T x >= -|g|_1. All other entries, F, may be anything: g
has to vanish there. The solver's y does so up to rounding, g_F = A_F^T y + c_F, and an exact one is
nearby: y - A_F (A_F^T A_F)^-1 g_F, at a distance of at most delta = |g_F| / sigma, with sigma^2 a
proven lower bound on the eigenvalues of A_F^T A_F. It is in the dual cone where y is by more than
delta; therefore a small share of a dual point well inside the cone is mixed into the solver's.

The bound is mostly wide: hulls have all points between those of the sets.
"""

import warnings
from dataclasses import dataclass
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.sparse import coo_array, csc_array

from pgo_models.convex.constraint_sets import ConstraintSet, Orthonormal, UnitColumns, UnitRows
from pgo_models.convex.convex_solver import has_attributes
from pgo_models.convex.hulls import hulls_of
from pgo_models.convex.model_bound import is_proven_definite, prove_matrix
from pgo_models.convex.orthogonality import OrthogonalProblem
from pgo_models.convex.quadratic_form import Block
from pgo_models.geometry.arrays import ReadOnly
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.floating_point import OUTWARD, gamma

_TOLERANCE = 1e-9
_REFINEMENTS = 3
_SHARES = (1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3)  # of the point well inside, in turn
_LARGEST_DUAL = 1e3  # its entries at most, as multiples of the largest of c
_MARGINS = (1e-2, 1e-4, 1e-6)  # shares of the diagonal of A_F^T A_F to be proven as sigma^2


@dataclass(frozen=True, eq=False)
class HullBound(ReadOnly):
    """J >= value at all points of the sets, in exact arithmetic.

    Parameters
    ----------
    value : float
        The bound.
    rounding : float
        What was subtracted for rounding, and for what the solver left.
    point : tuple of arrays
        The variables at the least J over the hulls, as the solver gives them; they are in no set.
    """

    value: float
    rounding: float
    point: tuple[Array, ...]


def prove_hull_bound(problem: OrthogonalProblem) -> HullBound | None:
    """The bound of a model; None where nothing is proven.

    That is where a set has no hull here, or a variable in a set has attributes, as nonneg=True;
    where the program has exponential cones, is not strictly feasible, or leaves a direction of the
    variables without a set free.
    """
    hulls = hull_constraints(problem)
    if hulls is None or any(has_attributes(variable) for variable in problem.variables):
        return None
    model = cp.Problem(cp.Minimize(problem.J), [*problem.problem.constraints, *hulls])
    try:
        data, chain, inverse = model.get_problem_data(
            cp.CLARABEL, solver_opts={"use_quad_obj": False}
        )
        options = {"max_threads": 1, "tol_gap_rel": _TOLERANCE, "tol_feas": _TOLERANCE}
        raw = chain.solve_via_data(model, data, False, False, options)
        with warnings.catch_warnings(action="ignore"):  # of digits, which the proof does not need
            model.unpack_results(raw, chain, inverse)
    except (cp.SolverError, ValueError):
        return None
    point = tuple(variable.value for variable in problem.variables)
    if any(value is None for value in point):
        return None
    is_bounded = np.zeros(len(data["c"]), dtype=bool)
    columns = data["param_prob"].var_id_to_col
    for variable in problem.variables:
        first = columns[variable.id]
        is_bounded[first : first + variable.size] = True
    program = _ConeProgram(csc_array(data["A"]), data["b"], data["c"], data["dims"], is_bounded)
    inside = program.point_inside()
    if inside is None:
        return None
    y = np.asarray(raw.z, dtype=float)
    bounds = (program.bound((1.0 - share) * y + share * inside) for share in _SHARES)
    found = next((bound for bound in bounds if bound is not None), None)
    if found is None:
        return None
    value, rounding = found
    constant = float(inverse[-1]["offset"])
    rounding += gamma(2.0) * (abs(value) + abs(constant))
    return HullBound(value + constant - 2.0 * gamma(2.0) * abs(constant), rounding, point)


def hull_constraints(problem: OrthogonalProblem) -> list[cp.Constraint] | None:
    """The hulls of all variables as constraints of cvxpy; None where a set has none here."""
    constraints: list[cp.Constraint] = []
    for term in problem.terms:
        X = problem.variables[term.variable]
        if not isinstance(term.constraint, Orthonormal | UnitColumns):
            return None
        constraints += _hull_of(X, term.constraint)
    return constraints


def _hull_of(X: cp.Variable, kind: ConstraintSet) -> list[cp.Constraint]:
    if isinstance(kind, UnitRows):
        return [cp.norm(X, axis=1) <= 1.0] if X.ndim == 2 else [cp.abs(X) <= 1.0]
    if isinstance(kind, UnitColumns):
        return [cp.norm(X, axis=0) <= 1.0] if X.ndim == 2 else [cp.norm(X) <= 1.0]
    block = Block(0, X.shape, (kind,))
    (hull,) = hulls_of(0, block)
    entries = [
        (a + hull.side * b, coordinate % (X.size + 1), factor)
        for (a, b), terms in hull.entries.items()
        for coordinate, factor in terms
    ]
    rows, of, factors = zip(*entries, strict=True)
    to_H = csc_array(coo_array((factors, (rows, of)), shape=(hull.side**2, X.size + 1)))
    H = to_H @ cp.hstack([cp.vec(X, order="F"), np.ones(1)])
    constraints = [cp.reshape(H, (hull.side, hull.side), order="F") >> 0]
    if block.is_plane:
        constraints += [X[0, 0] == X[1, 1], X[0, 1] == -X[1, 0]]
    return constraints


@dataclass(frozen=True)
class _ConeProgram:
    """minimise c^T x subject to b - A x in a cone; |x_i| <= 1 where `is_bounded`."""

    A: csc_array
    b: Array
    c: Array
    dims: Any
    is_bounded: BoolArray

    def point_inside(self) -> Array | None:
        """A point well inside the dual cone with g = 0 where x is free, up to rounding."""
        y = cp.Variable(len(self.b))
        margin = cp.Variable()
        scale = float(abs(self.c).max()) or 1.0
        free = np.flatnonzero(~self.is_bounded)
        constraints = [margin <= scale, cp.norm(y, "inf") <= _LARGEST_DUAL * scale]
        if len(free):
            constraints.append(self.A[:, free].T @ y + self.c[free] == 0)
        first = int(self.dims.zero)
        last = first + int(self.dims.nonneg)
        if last > first:
            constraints.append(y[first:last] >= margin)
        for size in self.dims.soc:
            first, last = last, last + int(size)
            constraints.append(cp.norm(y[first + 1 : last]) + margin <= y[first])
        for side in self.dims.psd:
            first, last = last, last + side * (side + 1) // 2
            Y = cp.reshape(_to_matrix(int(side)) @ y[first:last], (side, side), order="F")
            constraints.append(Y - margin * np.eye(side) >> 0)
        try:
            cp.Problem(cp.Maximize(margin), constraints).solve(solver=cp.CLARABEL)
        except cp.SolverError:
            return None
        return y.value if y.value is not None and margin.value > 0.0 else None

    def bound(self, y: Array) -> tuple[float, float] | None:
        """A lower bound of any y, and what was subtracted; None where y proves nothing."""
        if self.dims.exp or self.dims.p3d or len(self.dims.pnd):
            return None
        free = np.flatnonzero(~self.is_bounded)
        A_free = csc_array(self.A[:, free])
        sigma = _least_singular_value(A_free)
        if sigma is None:
            return None
        y = self._refined(y, A_free, free)
        g, error = self._gradient(y)
        largest = abs(g) + error
        delta = 0.0
        if len(free):
            delta = OUTWARD * float(np.linalg.norm(largest[free])) / sigma
        if not self._is_in_dual_cone(y, delta):
            return None
        column_norms = np.sqrt(abs(self.A).power(2).sum(axis=0))
        in_box = (largest + delta * column_norms)[self.is_bounded]
        terms = -self.b * y
        share: float = gamma(float(len(y) + 4))
        rounding = share * float(np.sum(abs(terms))) + delta * float(np.linalg.norm(self.b))
        left = OUTWARD * float(np.sum(in_box)) + rounding
        return float(np.sum(terms)) - OUTWARD * left, left

    def _gradient(self, y: Array) -> tuple[Array, Array]:
        """C + A^T y and a bound on its rounding."""
        g = self.c + self.A.T @ y
        count = np.diff(self.A.indptr) + 4.0
        return g, gamma(count) * (abs(self.c) + abs(self.A).T @ abs(y) + abs(g))

    def _refined(self, y: Array, A_free: csc_array, free: IntArray) -> Array:
        """Y moved so that g vanishes where x is free, but for rounding."""
        dense = A_free.toarray()
        for _ in range(_REFINEMENTS if len(free) else 0):
            g = self.c[free] + A_free.T @ y
            y = y - np.linalg.lstsq(dense.T, g)[0]
        return y

    def _is_in_dual_cone(self, y: Array, delta: float) -> bool:
        """Whether all vectors within delta of y are in the dual cone."""
        first = int(self.dims.zero)
        last = first + int(self.dims.nonneg)
        if not (y[first:last] >= OUTWARD * delta).all():
            return False
        for size in self.dims.soc:
            first, last = last, last + int(size)
            radius = OUTWARD**2 * (float(np.linalg.norm(y[first + 1 : last])) + 2.0 * delta)
            if not y[first] >= (1.0 + gamma(float(size) + 4.0)) * radius:
                return False
        for side in self.dims.psd:
            first, last = last, last + side * (side + 1) // 2
            Y = (_to_matrix(int(side)) @ y[first:last]).reshape(side, side)
            rounding = gamma(4.0) * float(np.linalg.norm(Y))
            shifted = Y - OUTWARD * (delta + rounding) * np.eye(side)
            if not is_proven_definite(shifted):
                return False
        return last == len(y)


def _to_matrix(side: int) -> csc_array:
    """To a matrix from its upper triangle, column by column, off the diagonal times root 2.

    The Euclidean norm of the triangle is the Frobenius norm of the matrix.
    """
    columns, rows = np.tril_indices(side)
    k = np.arange(len(rows))
    off = rows != columns
    factors = np.where(off, 1.0 / np.sqrt(2.0), 1.0)
    entries = np.concatenate([rows + side * columns, (columns + side * rows)[off]])
    data = np.concatenate([factors, factors[off]])
    return csc_array((data, (entries, np.concatenate([k, k[off]]))), shape=(side**2, len(k)))


def _least_singular_value(A: csc_array) -> float | None:
    """A proven lower bound on the singular values of a matrix; None where there is none."""
    if not A.shape[1]:
        return 1.0
    gram = (A.T @ A).toarray()
    sizes = (abs(A).T @ abs(A)).toarray()
    for margin in _MARGINS:
        error = gamma(float(A.shape[0] + 4)) * sizes
        proof = prove_matrix(gram, error, margin)
        if proof is not None:
            return float(np.sqrt(proof.slack.min()) / OUTWARD)
    return None
