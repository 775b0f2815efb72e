"""A proven lower bound on any convex objective: the least J over the convex hulls of the sets.

The hulls are those of `pgo_models.convex.hulls`; unit columns have the unit ball. With the hulls
below what cvxpy states of the model, the convex program is

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

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cvxpy as cp
import numpy as np
from cvxpy.reductions.solvers.conic_solvers.clarabel_conif import CLARABEL
from scipy.sparse import csc_array, csr_array, diags_array, lil_array, vstack

from pgo_models.convex.constraint_sets import Orthonormal, UnitColumns
from pgo_models.convex.convex_solver import has_attributes
from pgo_models.convex.hulls import Affine, Hull, hulls_of
from pgo_models.convex.model_bound import is_proven_definite, prove_matrix
from pgo_models.convex.model_relaxation import matrix_of_triangle
from pgo_models.convex.orthogonality import OrthogonalProblem
from pgo_models.convex.quadratic_form import Block
from pgo_models.convex.set_equations import ONE
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
    program : HullProgram
        The convex program.
    y : array
        Its dual point, which is the proof.
    """

    value: float
    rounding: float
    point: tuple[Array, ...]
    program: "HullProgram"
    y: Array


def prove_hull_bound(problem: OrthogonalProblem) -> HullBound | None:
    """The bound of a model; None where nothing is proven.

    That is where a set has no hull here, or a variable in a set has attributes, as nonneg=True;
    where the program has exponential cones, is not strictly feasible, or leaves a direction of the
    variables without a set free.
    """
    program = _program_over_hulls(problem)
    if program is None:
        return None
    x, z = program.solve()
    if not np.isfinite(x).all():
        return None
    point = program.variables(x)
    inside = program.point_inside()
    if inside is None:
        return None
    for share in _SHARES:
        found = program.bound(program.scale * ((1.0 - share) * z + share * inside))
        if found is not None:
            y, value, rounding = found
            return HullBound(value, rounding, point, program, y)
    return None


def _program_over_hulls(problem: OrthogonalProblem) -> "HullProgram | None":
    """The convex program as cvxpy states it, with the hulls of all variables."""
    if any(has_attributes(variable) for variable in problem.variables):
        return None
    if not all(isinstance(term.constraint, Orthonormal | UnitColumns) for term in problem.terms):
        return None
    model = cp.Problem(cp.Minimize(problem.J), problem.problem.constraints)
    try:
        data, _, inverse = model.get_problem_data(cp.CLARABEL, solver_opts={"use_quad_obj": False})
    except (cp.SolverError, ValueError):
        return None
    dims = data["dims"]
    if dims.exp or dims.p3d or len(dims.pnd):
        return None
    columns = data["param_prob"].var_id_to_col
    blocks = tuple(
        Block(columns[X.id], X.shape, tuple(problem.terms_of(position)))
        for position, X in enumerate(problem.variables)
    )
    return _with_hulls(data, float(inverse[-1]["offset"]), blocks)


def _with_hulls(data: dict[str, Any], constant: float, blocks: tuple[Block, ...]) -> "HullProgram":
    """A program with the hulls of variables, whose rows are put where cvxpy's order has them."""
    A, b, c, dims = csr_array(data["A"]), data["b"], data["c"], data["dims"]
    equalities: list[Affine] = []
    balls: list[list[Affine]] = []
    matrices: list[Hull] = []
    for block in blocks:
        if block.is_plane:
            x = block.start
            equalities += [[(x, 1.0), (x + 3, -1.0)], [(x + 1, 1.0), (x + 2, 1.0)]]
        for kind in block.sets:
            hulls = hulls_of(0, replace(block, sets=(kind,)))
            if isinstance(kind, UnitColumns):
                balls += [_ball(hull) for hull in hulls]
            else:
                matrices += hulls
    of_balls = [row for ball in balls for row in ball]
    of_matrices = [row for hull in matrices for row in _triangle(hull)]
    end = dims.zero + dims.nonneg + sum(dims.soc)
    parts = [
        _rows(equalities, len(c)),
        (A[:end], b[:end]),
        _rows(of_balls, len(c)),
        (A[end:], b[end:]),
        _rows(of_matrices, len(c)),
    ]
    of_all = copy.copy(dims)
    of_all.zero += len(equalities)
    of_all.soc = [*dims.soc, *map(len, balls)]
    of_all.psd = [*dims.psd, *(hull.side for hull in matrices)]
    of_model = np.arange(len(b)) + len(equalities)
    of_model[end:] += len(of_balls)
    rows = csc_array(vstack([rows for rows, _ in parts]))
    right = np.concatenate([right for _, right in parts])
    return HullProgram(rows, right, c, constant, of_all, blocks, of_model, dims)


def _ball(hull: Hull) -> list[Affine]:
    """(1, x), a vector of the second-order cone, of (I, x; x^T, 1)."""
    last = hull.side - 1
    return [[(ONE, 1.0)], *(hull.entries[k, last] for k in range(last))]


def _triangle(hull: Hull) -> list[Affine]:
    """The upper triangle of H, column by column, off the diagonal doubled."""
    return [
        [(k, factor * (1.0 if a == b else 2.0)) for k, factor in hull.entries.get((a, b), [])]
        for b in range(hull.side)
        for a in range(b + 1)
    ]


def _rows(functions: Sequence[Affine], num_columns: int) -> tuple[csr_array, Array]:
    """A and b with b - A x of affine functions."""
    b = np.zeros(len(functions))
    A = lil_array((len(functions), num_columns))
    for row, terms in enumerate(functions):
        for column, factor in terms:
            if column == ONE:
                b[row] += factor
            else:
                A[row, column] = -factor
    return csr_array(A), b


@dataclass(frozen=True, eq=False)
class HullProgram(ReadOnly):
    """minimise c^T x + constant subject to b - A x in a cone; the last rows are those of hulls H.

    Of H(x) these are the upper triangle, off the diagonal doubled, so that their y are the entries
    of a matrix P, and all numbers are exact. Of semidefinite matrices of the model rows and y are
    as solvers take them, off the diagonal times root 2.

    Parameters
    ----------
    A, b, c, constant, dims
        The program, and the sizes of its cones in cvxpy's order.
    blocks : tuple of Block
        The variables in sets; `start` is the first entry in x.
    of_model : array of ints
        The rows that are not of hulls.
    dims_of_model : object
        The sizes of their cones.
    """

    A: csc_array
    b: Array
    c: Array
    constant: float
    dims: Any
    blocks: tuple[Block, ...]
    of_model: IntArray
    dims_of_model: Any

    @property
    def is_bounded(self) -> BoolArray:
        """Which entries of x are of variables in sets, and at most 1."""
        is_bounded = np.zeros(len(self.c), dtype=bool)
        for block in self.blocks:
            is_bounded[block.start : block.start + math.prod(block.shape)] = True
        return is_bounded

    @property
    def scale(self) -> Array:
        """What a solver's y is multiplied by, (rows,)."""
        scale = np.ones(len(self.b))
        first = len(self.b)
        for side in reversed(self.dims.psd[len(self.dims_of_model.psd) :]):
            triangle = np.eye(side)[np.tril_indices(side)]
            first -= len(triangle)
            scale[first : first + len(triangle)] = np.where(triangle, 1.0, np.sqrt(0.5))
        return scale

    def variables(self, x: Array) -> tuple[Array, ...]:
        """The variables in sets, each in its shape."""
        sizes = [(block, math.prod(block.shape)) for block in self.blocks]
        return tuple(
            x[block.start : block.start + size].reshape(block.shape, order="F")
            for block, size in sizes
        )

    def solve(self) -> tuple[Array, Array]:
        """The point and the dual point of a solver; not finite where it has none."""
        scale = self.scale
        scaled = csc_array(diags_array(scale) @ self.A)
        data = {"A": scaled, "b": scale * self.b, "c": self.c, "dims": self.dims}
        options = {"max_threads": 1, "tol_gap_rel": _TOLERANCE, "tol_feas": _TOLERANCE}
        raw = CLARABEL().solve_via_data(data, False, False, options)
        return np.array(raw.x, dtype=float), np.array(raw.z, dtype=float)

    def semidefinite(self, y: Array) -> list[Array]:
        """The matrices of y, those of the model first, rounded, then every P, exactly."""
        first = len(y) - sum(side * (side + 1) // 2 for side in self.dims.psd)
        matrices = []
        for place, side in enumerate(self.dims.psd):
            last = first + side * (side + 1) // 2
            is_of_model = place < len(self.dims_of_model.psd)
            factor = np.sqrt(0.5) if is_of_model else 1.0
            to_matrix = matrix_of_triangle(*np.tril_indices(int(side)), factor)
            matrices.append((to_matrix @ y[first:last]).reshape(side, side))
            first = last
        return matrices

    def point_inside(self) -> Array | None:
        """A point well inside the dual cone with g = 0 where x is free, up to rounding.

        It is a solver's; rows of hulls, which `scale` is of, have no x that is free.
        """
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
            to_matrix = matrix_of_triangle(*np.tril_indices(int(side)), np.sqrt(0.5))
            Y = cp.reshape(to_matrix @ y[first:last], (side, side), order="F")
            constraints.append(Y - margin * np.eye(side) >> 0)
        try:
            cp.Problem(cp.Maximize(margin), constraints).solve(solver=cp.CLARABEL)
        except cp.SolverError:
            return None
        return y.value if y.value is not None and margin.value > 0.0 else None

    def bound(self, y: Array) -> tuple[Array, float, float] | None:
        """Y moved, its lower bound, and what was subtracted; None where it proves nothing."""
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
        value = float(np.sum(terms))
        left += gamma(4.0) * (abs(value) + abs(self.constant))
        return y, value + self.constant - OUTWARD * left, left

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
        for Y in self.semidefinite(y):
            rounding = gamma(4.0) * float(np.linalg.norm(Y))
            if not is_proven_definite(Y - OUTWARD * (delta + rounding) * np.eye(len(Y))):
                return False
        return True


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
