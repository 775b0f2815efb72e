"""Newton on the sets for a quadratic model: from a point to the stationary point nearby.

The Hessian in coordinates of the tangent spaces is N^T S N, where S is the matrix of the Lagrangian
with closed-form multipliers (Absil et al. 2008, section 6.5), N the bases of the tangent spaces and
the identity for variables without a set. Where it is not positive definite, N^T Q N takes its
place, which is never indefinite, with damping (Levenberg and Marquardt).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, block_diag, cho_factor, cho_solve
from scipy.sparse import block_diag as sparse_block_diag, csc_array, eye_array

from pgo_models.convex.constraint_sets import Orthonormal, UnitColumns
from pgo_models.convex.model_relaxation import closed_form_multipliers
from pgo_models.convex.quadratic_form import Block, QuadraticForm
from pgo_models.convex.set_equations import SetEquations
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.arrays import ReadOnly
from pgo_models.geometry.rotations import Array
from pgo_models.problem.cholesky import factorize

_SMOOTH = Orthonormal | UnitColumns  # sets that have tangent spaces
_MAX_STEPS = 50
_HALVINGS = 30
_SUFFICIENT = 1e-4  # Armijo's constant
_ROUNDING = 4e-16  # share of J that is not told apart from zero
_SMALL = 1e-9  # decrement, as a share of J, that a Newton step squares
_LARGEST_DENSE = 150  # side up to which matrices are dense
_FIRST_DAMPING = 1e-3
_DAMPING_GROWTH = 10.0
_LARGEST_DAMPING = 1e6


@dataclass(frozen=True, eq=False)
class ModelNewton(ReadOnly):
    """Newton for one model."""

    form: QuadraticForm
    equations: SetEquations

    @property
    def is_possible(self) -> bool:
        """Whether every variable is in one set that has tangent spaces, and free or fixed."""
        for block in self.form.blocks:
            has_one = len(block.sets) == 1 and isinstance(block.sets[0], _SMOOTH)
            free = self.form.is_free[block.coordinates]
            if not has_one or (free.any() and not free.all()):
                return False
        return not self.form.E.shape[0] or bool(len(self.form.free_others))

    def polish(self, u: Array) -> Array:
        """The stationary point beside u, to rounding."""
        J = self.form.objective(u)
        last = np.inf
        for _ in range(_MAX_STEPS):
            N = self._tangent_bases(u)
            S = self._lagrangian(u)
            gradient = N.T @ (S @ u)
            step = _solved(N.T @ (S @ N), gradient)
            is_newton = step is not None
            if step is None:
                step = _damped(N.T @ (self._Q @ N), gradient)
            decrement = float(-gradient @ step)
            if is_newton and decrement > 0.1 * last and last < _SMALL * abs(J):
                break  # a Newton step squares what is left; this is rounding
            moved, moved_J = self._backtracked(u, J, N @ step, decrement)
            if moved is None:
                break
            u = moved
            J = moved_J
            last = decrement if is_newton else np.inf
        return u

    def on_sets(self, u: Array) -> Array:
        """U with x projected onto the sets, and y at its best."""
        projected = []
        for block, value in zip(self.form.blocks, self.form.values(u), strict=True):
            projected.append(block.sets[0].projected(value))
        return self.form.u_of(projected)

    @cached_property
    def _is_dense(self) -> bool:
        return self.form.side <= _LARGEST_DENSE

    @cached_property
    def _Q(self) -> Any:  # noqa: ANN401 - dense or sparse
        return self.form.Q.toarray() if self._is_dense else self.form.Q

    def _lagrangian(self, u: Array) -> Any:  # noqa: ANN401 - dense or sparse
        """S with the multipliers of u."""
        equations = self.equations
        if not self._is_dense or len(equations.of_equalities):
            return self._Q - equations.combined(closed_form_multipliers(self.form, equations, u))
        number = equations.num_basic
        is_basic = equations.k < number
        k, i, j = (each[is_basic] for each in (equations.k, equations.i, equations.j))
        entries = equations.entries[is_basic]
        side = self.form.side
        products = np.bincount(i * number + k, entries * u[j], side * number)
        products = products.reshape(side, number)[: self.form.num_constrained]
        residual = (self._Q @ u)[: self.form.num_constrained]
        multipliers = np.linalg.solve(products.T @ products, products.T @ residual)
        combined = np.bincount(i * side + j, multipliers[k] * entries, side**2)
        return self._Q - combined.reshape(side, side)

    def _tangent_bases(self, u: Array) -> Any:  # noqa: ANN401 - dense or sparse
        """N, (N, dimension)."""
        form = self.form
        bases = []
        for block in form.blocks:
            x = u[block.coordinates]
            if not form.is_free[block.start]:
                basis = np.zeros((block.size, 0))
            elif block.is_plane:
                basis = np.array([[-x[1]], [x[0]]])
            else:
                basis = _smooth_set(block).tangent_basis(block.value(x))
            bases.append(basis)
        kept = np.setdiff1d(form.free_others, form.grounded) - form.num_constrained
        others = eye_array(form.side - form.num_constrained, format="csc")[:, kept]
        if self._is_dense:
            return block_diag(*bases, others.toarray())
        return csc_array(sparse_block_diag([*bases, others], format="csc"))

    def _backtracked(
        self, u: Array, J: float, move: Array, decrement: float
    ) -> tuple[Array | None, float]:
        """The first of u + move, u + move / 2, .. on the sets that lowers J enough, and J there."""
        length = 1.0
        noise = _ROUNDING * abs(J)
        for _ in range(_HALVINGS):
            moved = self.on_sets(u + length * move)
            moved_J = self.form.objective(moved)
            if moved_J <= J - _SUFFICIENT * length * decrement + length * noise:
                return moved, moved_J
            length *= 0.5
            if length * decrement <= noise:
                break
        return None, J


def _smooth_set(block: Block) -> Orthonormal | UnitColumns:
    """The set of a constrained variable, where Newton is possible."""
    (kind,) = block.sets
    assert isinstance(kind, _SMOOTH)
    return kind


def _damped(convex: Array | csc_array, gradient: Array) -> Array:
    """The step of the convex part with the least damping that makes it definite."""
    scale = convex.diagonal().max(initial=0.0) or 1.0
    identity = np.eye(len(gradient)) if isinstance(convex, np.ndarray) else eye_array(len(gradient))
    damping = _FIRST_DAMPING
    while damping <= _LARGEST_DAMPING:
        damped: Any = convex + damping * scale * identity
        step = _solved(damped, gradient)
        if step is not None:
            return step
        damping *= _DAMPING_GROWTH
    return -gradient / scale


def _solved(matrix: Array | csc_array, gradient: Array) -> Array | None:
    """-matrix^-1 gradient, or None where the matrix is not positive definite."""
    try:
        if isinstance(matrix, np.ndarray):
            step = cho_solve(cho_factor(matrix, check_finite=False), gradient, check_finite=False)
        else:
            step = factorize(csc_array(matrix + 0.0 * eye_array(len(gradient)))).solve(gradient)
    except (LinAlgError, NotPositiveDefiniteError):
        return None
    return -step if np.isfinite(step).all() else None
