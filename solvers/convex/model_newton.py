"""Newton on the sets for a quadratic model: from a point to the stationary point nearby.

The Hessian in coordinates of the tangent spaces is N^T S N, where S is the matrix of the Lagrangian
with closed-form multipliers (Absil et al. 2008, section 6.5), N the bases of the tangent spaces and
the identity for variables without a set, which small models hold at their best instead. Where it is
not positive definite, absolute eigenvalues take its place, or N^T Q N, which is never indefinite,
with damping (Levenberg and Marquardt).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg.lapack import dposv
from scipy.sparse import block_diag as sparse_block_diag, csc_array, eye_array

from pgo_models.convex.constraint_sets import Orthonormal, UnitColumns
from pgo_models.convex.model_relaxation import closed_form_multipliers
from pgo_models.convex.quadratic_form import Block, QuadraticForm
from pgo_models.convex.set_equations import SetEquations, set_equations
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.arrays import ReadOnly
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import factorize

_SMOOTH = Orthonormal | UnitColumns  # sets that have tangent spaces
_MAX_STEPS = 50
_HALVINGS = 30
_SUFFICIENT = 1e-4  # Armijo's constant
_ROUNDING = 4e-16  # share of J that is not told apart from zero
_SMALL = 1e-9  # decrement, as a share of J, that a Newton step squares
_SMALLEST_CURVATURE = 1e-3  # of absolute eigenvalues, as a share of the largest
_FIRST_DAMPING = 1e-3
_DAMPING_GROWTH = 10.0
_LARGEST_DAMPING = 1e6


@dataclass(frozen=True, eq=False)
class ModelNewton(ReadOnly):
    """Newton for one model; the equations of its sets are made where they are not given."""

    form: QuadraticForm
    given_equations: SetEquations | None = None

    @cached_property
    def equations(self) -> SetEquations:
        """The equations of the sets, which large models need."""
        return self.given_equations or set_equations(self.form)

    @property
    def is_possible(self) -> bool:
        """Whether every variable is in one set with tangent spaces, free or fixed, and no more."""
        for block in self.form.blocks:
            has_one = len(block.sets) == 1 and isinstance(block.sets[0], _SMOOTH)
            free = self.form.is_free[block.coordinates]
            if not has_one or (free.any() and not free.all()):
                return False
        return not self.form.limits_x

    def polish(self, u: Array) -> Array:
        """The stationary point beside u, to rounding."""
        J = self.form.objective(u)
        last = np.inf
        for _ in range(_MAX_STEPS):
            model = self._dense_model(u) if self._halves is not None else self._sparse_model(u)
            if not len(model.gradient):
                break  # isolated points, as -1 and 1
            step = _solved(model.hessian, model.gradient)
            moved = None
            decrement = np.inf
            if step is not None:
                decrement = float(-model.gradient @ step)
                if decrement > 0.1 * last and last < _SMALL * abs(J):
                    break  # a Newton step squares what is left; this is rounding
                moved, moved_J = self._backtracked(u, J, model, step)
            last = np.inf if moved is None else decrement
            if moved is None:  # indefinite, or flat, where a Newton step is long and of rounding
                moved, moved_J = self._backtracked(u, J, model, _downhill(model))
            if moved is None:
                break
            u = moved
            J = moved_J
        return u

    def on_sets(self, u: Array) -> Array:
        """U with x projected onto the sets, and y at its best, or as it is under inequalities.

        Fixed entries keep their values, and may leave their variable outside its set.
        """
        moved = u.copy()
        for block in self.form.blocks:
            value = block.sets[0].projected(block.value(u[block.coordinates]))
            moved[block.coordinates] = block.coordinates_of(value)
        if self.form.G.shape[0]:
            return self.form.with_fixed(moved)
        return self.form.u_of_entries(moved[: self.form.num_constrained])

    @cached_property
    def _halves(self) -> tuple[Array, Array] | None:
        """H / 2 and g / 2 of J = x^T H x / 2 + g^T x + .. in free x with the best y, if small."""
        D = self.form.reduction
        if D is None:
            return None
        Q = D.T @ (self.form.Q @ D)
        return Q[:-1, :-1], Q[:-1, -1]

    def _dense_model(self, u: Array) -> "_TangentModel":
        """The model in free x; y is at its best."""
        assert self._halves is not None
        H, g = self._halves
        gradient = H @ u[self.form.free_x] + g
        blocks = [block for block in self.form.blocks if self.form.is_free[block.start]]
        bases = [_tangent_basis(block, u[block.coordinates]) for block in blocks]
        N = np.zeros((len(g), sum(basis.shape[1] for basis in bases)))
        N_Lambda = np.zeros(N.shape)
        rows = []
        row = 0
        column = 0
        for block, basis in zip(blocks, bases, strict=True):
            rows.append(slice(row, row + block.size))
            place = rows[-1], slice(column, column + basis.shape[1])
            N[place] = basis
            x = u[block.coordinates]
            N_Lambda[place] = _times_multiplier(block, x, gradient[rows[-1]], basis)
            row += block.size
            column += basis.shape[1]

        def tangent_part(M: Array) -> Array:
            parts = [M[:0]]  # a held rotation may leave none
            for block, basis, its_rows in zip(blocks, bases, rows, strict=True):
                parts.append(_tangent_part(block, u[block.coordinates], basis, M[its_rows]))
            return np.concatenate(parts)

        hessian = tangent_part(tangent_part(H).T - N_Lambda)
        return _TangentModel(self.form.free_x, N, N.T @ gradient, hessian)

    def _sparse_model(self, u: Array) -> "_TangentModel":
        """The model in x and y, sparse."""
        form = self.form
        equations = self.equations
        S = form.Q - equations.combined(closed_form_multipliers(form, equations, u))
        bases = []
        for block in form.blocks:
            is_free = form.is_free[block.start]
            basis = np.zeros((block.size, 0))
            if is_free:
                basis = _tangent_basis(block, u[block.coordinates])
            bases.append(basis)
        kept = np.setdiff1d(form.free_others, form.grounded) - form.num_constrained
        others = eye_array(form.side - form.num_constrained, format="csc")[:, kept]
        N = csc_array(sparse_block_diag([*bases, others], format="csc"))
        everywhere = np.arange(form.side)
        convex = N.T @ (form.Q @ N)
        return _TangentModel(everywhere, N, N.T @ (S @ u), N.T @ (S @ N), convex)

    def _backtracked(
        self, u: Array, J: float, model: "_TangentModel", step: Array
    ) -> tuple[Array | None, float]:
        """The first of u + step, u + step / 2, .. on the sets that lowers J enough, and J there."""
        move = np.zeros(self.form.side)
        move[model.moved] = model.basis @ step
        decrement = float(-model.gradient @ step)
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


@dataclass(frozen=True)
class _TangentModel:
    """Half of the second-order model of J along tangent directions at u, dense or sparse."""

    moved: IntArray  # coordinates of u
    basis: Any  # directions in them, one a column
    gradient: Array
    hessian: Any
    convex_part: csc_array | None = None  # of a sparse Hessian, without the curvature of the sets


def _tangent_basis(block: Block, x: Array) -> Array:
    """Orthonormal basis of the tangent space at x, one direction a column."""
    if block.is_plane:
        return np.array([[-x[1]], [x[0]]])
    return _smooth_set(block).tangent_basis(block.value(x))


def _tangent_part(block: Block, x: Array, basis: Array, M: Array) -> Array:
    """basis^T M."""
    if block.is_plane:
        return np.asarray(basis.T @ M)
    return _smooth_set(block).tangent_part(block.value(x), basis, M)


def _times_multiplier(block: Block, x: Array, gradient: Array, directions: Array) -> Array:
    """What the Lagrangian subtracts from the Hessian along directions."""
    if block.is_plane:
        return float(x @ gradient) * directions
    value, slope = block.value(x), block.value(gradient)
    return _smooth_set(block).times_multiplier(value, slope, directions)


def _smooth_set(block: Block) -> Orthonormal | UnitColumns:
    """The set of a constrained variable, where Newton is possible."""
    (kind,) = block.sets
    assert isinstance(kind, _SMOOTH)
    return kind


def _downhill(model: _TangentModel) -> Array:
    """A step where the Hessian is not positive definite.

    Of a dense model it is Newton's with the absolute eigenvalues (Nocedal & Wright 2006, section
    3.4), which leaves saddle points; of a sparse one it is that of the convex part with the least
    damping that makes it definite.
    """
    if model.convex_part is None:
        eigenvalues, vectors = np.linalg.eigh(model.hessian)
        sizes = abs(eigenvalues)
        sizes = np.maximum(sizes, _SMALLEST_CURVATURE * sizes.max() or 1.0)
        return -np.asarray(vectors @ ((vectors.T @ model.gradient) / sizes))
    scale = model.convex_part.diagonal().max(initial=0.0) or 1.0
    identity = eye_array(len(model.gradient))
    damping = _FIRST_DAMPING
    while damping <= _LARGEST_DAMPING:
        step = _solved(model.convex_part + damping * scale * identity, model.gradient)
        if step is not None:
            return step
        damping *= _DAMPING_GROWTH
    return -model.gradient / scale


def _solved(matrix: Array | csc_array, gradient: Array) -> Array | None:
    """-matrix^-1 gradient, or None where the matrix is not positive definite."""
    if isinstance(matrix, np.ndarray):
        _, step, failure = dposv(matrix, gradient)
        return None if failure or not np.isfinite(step).all() else -step
    try:
        step = factorize(csc_array(matrix + 0.0 * eye_array(len(gradient)))).solve(gradient)
    except NotPositiveDefiniteError:
        return None
    return -step if np.isfinite(step).all() else None
