"""Newton on the sets for a quadratic model: from a point to the stationary point nearby.

The Hessian in coordinates of the tangent spaces is N^T S N, where S is the matrix of the Lagrangian
with closed-form multipliers (Absil et al. 2008, section 6.5), N the bases of the tangent spaces and
the identity for variables without a set. Where it is not positive definite, N^T Q N takes its
place, which is never indefinite, with damping (Levenberg and Marquardt).
"""

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import block_diag, csc_array, diags_array

from pgo_models.convex.constraint_sets import Orthonormal, UnitColumns
from pgo_models.convex.model_relaxation import closed_form_multipliers
from pgo_models.convex.quadratic_form import QuadraticForm
from pgo_models.convex.set_equations import SetEquations
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array
from pgo_models.problem.cholesky import factorize

_MAX_STEPS = 50
_HALVINGS = 30
_SUFFICIENT = 1e-4  # Armijo's constant
_ROUNDING = 1e-15  # share of J, or of its terms, that is not told apart from zero
_LARGEST_DENSE = 300  # side up to which matrices are factored dense
_FIRST_DAMPING = 1e-3
_DAMPING_GROWTH = 10.0
_LARGEST_DAMPING = 1e6


def polish_model(form: QuadraticForm, equations: SetEquations, u: Array) -> Array:
    """The stationary point beside u, to rounding; u itself where a variable is in several sets."""
    if not _has_tangents(form):
        return u
    J = form.objective(u)
    previous = np.inf
    for _ in range(_MAX_STEPS):
        S = form.Q - equations.combined(closed_form_multipliers(form, equations, u))
        N = _tangent_bases(form, u)
        gradient = N.T @ (S @ u)
        step, is_newton = _step(csc_array(N.T @ S @ N), csc_array(N.T @ form.Q @ N), gradient)
        decrement = float(-gradient @ step)
        moved, moved_J = _backtracked(form, u, J, N @ step, decrement)
        if moved is None or (is_newton and not decrement < 0.1 * previous and previous < 1e-12 * abs(J)):
            break
        u, J = moved, moved_J
        previous = decrement if is_newton else np.inf
    return u


def _has_tangents(form: QuadraticForm) -> bool:
    """Whether every variable is in one set that has tangent spaces, and fixed as a whole or not."""
    for block in form.blocks:
        has_one = len(block.sets) == 1 and isinstance(block.sets[0], Orthonormal | UnitColumns)
        free = form.is_free[block.coordinates]
        if not has_one or (free.any() and not free.all()):
            return False
    return True


def _tangent_bases(form: QuadraticForm, u: Array) -> csc_array:
    """N, (N, dimension)."""
    bases = []
    for block in form.blocks:
        x = u[block.coordinates]
        if not form.is_free[block.start]:
            basis = np.zeros((block.size, 0))
        elif block.is_plane:
            basis = np.array([[-x[1]], [x[0]]])
        else:
            basis = block.sets[0].tangent_basis(block.value(x))
        bases.append(basis)
    others = np.zeros(form.side - form.num_constrained)
    kept = form.free_others[~np.isin(form.free_others, form.grounded)]
    others[kept - form.num_constrained] = 1.0
    identity = diags_array(others).tocsc()[:, np.flatnonzero(others)]
    return csc_array(block_diag([*bases, identity], format="csc"))


def _step(newton: csc_array, convex: csc_array, gradient: Array) -> tuple[Array, bool]:
    """The step of Newton, or of the damped convex part, and which of them it is."""
    step = _solved(newton, gradient)
    if step is not None:
        return step, True
    damping = _FIRST_DAMPING
    scale = convex.diagonal().max(initial=0.0) or 1.0
    while step is None and damping <= _LARGEST_DAMPING:
        damped = convex + damping * scale * diags_array(np.ones(len(gradient)))
        step = _solved(csc_array(damped), gradient)
        damping *= _DAMPING_GROWTH
    return (-gradient / scale if step is None else step), False


def _solved(matrix: csc_array, gradient: Array) -> Array | None:
    """-matrix^-1 gradient, or None where the matrix is not positive definite."""
    try:
        if len(gradient) <= _LARGEST_DENSE:
            step = cho_solve(cho_factor(matrix.toarray(), check_finite=False), gradient)
        else:
            full = csc_array(matrix + 0.0 * diags_array(np.ones(len(gradient))))
            step = factorize(full).solve(gradient)
    except (LinAlgError, NotPositiveDefiniteError):
        return None
    return -step if np.isfinite(step).all() else None


def _backtracked(
    form: QuadraticForm, u: Array, J: float, move: Array, decrement: float
) -> tuple[Array | None, float]:
    """The first of u + move, u + move / 2, .. on the sets that lowers J enough, and J there."""
    length = 1.0
    noise = _ROUNDING * (abs(J) + abs(form.constant))
    for _ in range(_HALVINGS):
        moved = on_sets(form, u + length * move)
        moved_J = form.objective(moved)
        if moved_J <= J - _SUFFICIENT * length * decrement + (noise if length == 1.0 else 0.0):
            return moved, moved_J
        length *= 0.5
        if length * decrement <= noise:
            break
    return None, J


def on_sets(form: QuadraticForm, u: Array) -> Array:
    """u with x projected onto the sets, and y at its best."""
    projected = []
    for block, value in zip(form.blocks, form.values(u), strict=True):
        projected.append(block.sets[0].projected(value))
    return form.u_of(projected)
