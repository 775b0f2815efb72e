"""Multipliers of the sets' equations: in closed form, by the relaxation, and moved to a point.

The relaxation replaces u u^T by any positive semidefinite Z with the same equations; its dual is

    maximise g   subject to   Q - sum_k l_k A_k - g e e^T positive semidefinite.

Its value has seven digits and may be above the minimum, and is no bound: what is proven is the
bound of its multipliers (`pgo_models.convex.model_bound`). At a stationary point u* multipliers are
moved to the nearest ones with S u* = 0 in all coordinates that are not fixed, so that the bound is
J(u*) where S stays definite.
"""

from dataclasses import dataclass

import cvxpy as cp
import numpy as np
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import splu

from pgo_models.convex.convex_solver import COLD, ConvexSolver, solve_compiled
from pgo_models.convex.quadratic_form import QuadraticForm
from pgo_models.convex.set_equations import SetEquations
from pgo_models.geometry.arrays import ReadOnly
from pgo_models.geometry.rotations import Array

LARGEST = 120  # coordinates of x up to which the relaxation is solved
_PENALTY = 100.0  # of equalities, as a multiple of the largest entry of Q
_DAMPING = 1e-14  # of the normal equations, as a share of their diagonal


def closed_form_multipliers(form: QuadraticForm, equations: SetEquations, u: Array) -> Array:
    """Multipliers of the basic equations alone with S u nearest to 0.

    For X^T X = I they are sym(X^T G) / 2, with the gradient G of J. Equalities have a multiplier,
    too, and a penalty.
    """
    used = np.concatenate([np.arange(equations.num_basic), equations.of_equalities])
    residual = form.Q @ u
    free = form.is_free
    products = equations.products(u)[free][:, used]
    normal = csc_array(products.T @ products)
    normal = csc_array(normal + diags_array(_DAMPING * normal.diagonal() + 1e-300))
    multipliers = np.zeros(equations.number)
    for _ in range(2):  # the second is for the rounding of the first
        left = residual - equations.combined(multipliers) @ u
        multipliers[used] += splu(normal).solve(products.T @ left[free])
    return multipliers + _PENALTY * _scale(form) * equations.penalty


def moved_multipliers(
    form: QuadraticForm, equations: SetEquations, multipliers: Array, u: Array
) -> Array:
    """The multipliers nearest to given ones with S u = 0, but for coordinates that are fixed."""
    residual = form.Q @ u - equations.combined(multipliers) @ u
    free = form.is_free
    products = equations.products(u)[free].toarray()
    return np.asarray(multipliers + np.linalg.lstsq(products, residual[free])[0])


@dataclass(frozen=True, eq=False)
class RelaxedModel(ReadOnly):
    """The relaxation, solved.

    Parameters
    ----------
    value : float
        g, which is no bound.
    multipliers : array
        l.
    u : (N,) array
        The last column of Z, whose x is in no set unless the relaxation is tight.
    """

    value: float
    multipliers: Array
    u: Array


def solve_model_relaxation(
    form: QuadraticForm, equations: SetEquations, solver: ConvexSolver | str = COLD
) -> RelaxedModel:
    """Solve the relaxation of a model with few coordinates.

    Parameters
    ----------
    form : QuadraticForm
        The model.
    equations : SetEquations
        Its equations.
    solver : ConvexSolver or str
        A solver of semidefinite programs.

    Returns
    -------
    RelaxedModel
        Its multipliers and its point.

    Raises
    ------
    PGOError
        If the solver ends without a solution.
    """
    D = _reduction(form)
    side = D.shape[1]
    scale = _scale(form)
    Q = (D.T @ (form.Q @ D)) / scale
    # The A_k have coordinates alone of which D has one entry a row.
    column = np.argmax(abs(D), axis=1)
    factor = np.asarray(D[np.arange(form.side), column])
    rows = column[equations.i] + side * column[equations.j]
    data = equations.entries * factor[equations.i] * factor[equations.j]
    C = csc_array(coo_array((data, (rows, equations.k)), shape=(side**2, equations.number)))
    multipliers = cp.Variable(equations.number)
    g = cp.Variable()
    corner = np.zeros((side, side))
    corner[-1, -1] = 1.0
    M = Q - cp.reshape(C @ multipliers, (side, side), order="F") - g * corner
    is_semidefinite = M >> 0
    model = cp.Problem(cp.Maximize(g), [is_semidefinite])
    solve_compiled(
        model, "relaxation", tolerance=1e-10, solver=solver, accepted=cp.OPTIMAL_INACCURATE
    )
    Z = np.asarray(is_semidefinite.dual_value)
    u = D @ (Z[:, -1] / Z[-1, -1])
    return RelaxedModel(scale * float(g.value), scale * np.asarray(multipliers.value), u)


def _reduction(form: QuadraticForm) -> Array:
    """D with u = D (free x, 1), or (free x, free y, 1) where equalities have multipliers."""
    if form.reduction is not None and not form.E.shape[0]:
        return form.reduction
    free = np.flatnonzero(form.is_free)
    D = np.zeros((form.side, len(free) + 1))
    D[free, np.arange(len(free))] = 1.0
    D[:, -1] = np.where(form.is_free, 0.0, form.fixed)
    return D


def _scale(form: QuadraticForm) -> float:
    return float(abs(form.Q.data).max(initial=0.0)) or 1.0
