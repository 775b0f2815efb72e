"""Multipliers of the sets' equations: in closed form, by the relaxation, and moved to a point.

The relaxation replaces u u^T by any positive semidefinite Z with the same equations; its dual is

    maximise g   subject to   Q - sum_k l_k A_k - g e e^T positive semidefinite,

and so are the matrices P of products of hulls, if there are any. Its value has seven digits and may
be above the minimum, and is no bound: what is proven is the bound of its multipliers
(`pgo_models.convex.model_bound`). At a stationary point u* multipliers are moved to the nearest
ones with S u* = 0 in all coordinates that are not fixed, so that the bound is J(u*) where S stays
definite. P stays positive semidefinite if P W(u*) = 0, as at the optimum.
"""

import cvxpy as cp
import numpy as np
from scipy.sparse import block_diag, coo_array, csc_array, diags_array, eye_array
from scipy.sparse.linalg import splu

from pgo_models.convex.convex_solver import solve_compiled
from pgo_models.convex.quadratic_form import QuadraticForm
from pgo_models.convex.set_equations import SetEquations
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray

LARGEST = 108  # coordinates of x, those of twelve rotations: half a minute of a solver
_PENALTY = 100.0  # of equalities, as a multiple of the largest entry of Q
_ZERO = 1e-6  # eigenvalues of W(u*), whose others are of the order of the largest
_DEFINITE = 2e-14  # what is added to P, as a share of its side times its largest eigenvalue
_DAMPING = 1e-14  # of the normal equations, as a share of their diagonal


def closed_form_multipliers(
    form: QuadraticForm, equations: SetEquations, u: Array, further: Array | None = None
) -> Array:
    """Multipliers of the basic equations, beside given further ones, with S u nearest to 0.

    For X^T X = I they are sym(X^T G) / 2, with the gradient G of J. Equalities have a multiplier,
    too, and a penalty.
    """
    active = active_inequalities(equations, u)
    used = np.concatenate([np.arange(equations.num_basic), equations.of_equalities, active])
    residual = form.Q @ u
    free = form.is_free
    columns = equations.times(u)[free][:, used]
    normal = csc_array(columns.T @ columns)
    normal = csc_array(normal + diags_array(_DAMPING * normal.diagonal() + 1e-300))
    multipliers = np.zeros(equations.number) if further is None else further.copy()
    for _ in range(2):  # the second is for the rounding of the first
        left = residual - equations.combined(multipliers) @ u
        multipliers[used] += splu(normal).solve(columns.T @ left[free])
    return multipliers + _PENALTY * _scale(form) * equations.penalty


def moved_multipliers(
    form: QuadraticForm, equations: SetEquations, multipliers: Array, u: Array
) -> Array:
    """The multipliers nearest to given ones with S u = 0, but for coordinates that are fixed."""
    first = multipliers.copy()
    columns = equations.times(u)[form.is_free].toarray()
    bases = [eye_array(equations.num_equations, format="csc")]
    active = active_inequalities(equations, u)
    for product in equations.products:
        if product.side == 1:
            N = np.ones((1, int(product.start in active)))
        else:
            N = _kernel(product.at(equations, u))
        first[product.entries] = _triangle(N @ (N.T @ product.matrix(multipliers) @ N) @ N.T)
        bases.append(csc_array(_congruence(N)))
    basis = csc_array(block_diag(bases))
    residual = form.Q @ u - equations.combined(first) @ u
    moved = first + basis @ np.linalg.lstsq(columns @ basis, residual[form.is_free])[0]
    return definite_multipliers(equations, moved)


def definite_multipliers(equations: SetEquations, multipliers: Array) -> Array:
    """The multipliers with every P moved to a definite one, which costs the bound little."""
    definite = multipliers.copy()
    for product in equations.products:
        values, vectors = np.linalg.eigh(product.matrix(multipliers))
        values = np.maximum(values, 0.0) + _DEFINITE * len(values) * max(abs(values).max(), 1e-300)
        definite[product.entries] = _triangle((vectors * values) @ vectors.T)
    return definite


def _triangle(P: Array) -> Array:
    return P[np.triu_indices(len(P))]


def _kernel(W: Array) -> Array:
    """Basis of the directions in which W is zero."""
    values, vectors = np.linalg.eigh(W)
    return np.asarray(vectors[:, values < _ZERO * values[-1]])


def active_inequalities(equations: SetEquations, u: Array) -> IntArray:
    """The k of inequalities that hold as equalities at u, or do not hold."""
    k = np.array([product.start for product in equations.products if product.side == 1], dtype=int)
    is_active = equations.values(u)[k] <= _ZERO * equations.value_sizes(u)[k]
    return np.asarray(k[is_active])


def _congruence(N: Array) -> Array:
    """Matrix from the upper triangle of D to that of N D N^T."""
    rows, columns = np.triu_indices(N.shape[1])
    below, right = np.triu_indices(N.shape[0])
    products = N[below][:, rows] * N[right][:, columns]
    mirrored = N[below][:, columns] * N[right][:, rows]
    return np.asarray(np.where(rows == columns, products, products + mirrored))


def solve_model_relaxation(form: QuadraticForm, equations: SetEquations) -> tuple[Array, Array]:
    """Multipliers l and u, the last column of Z, of a model with few coordinates.

    The x of u is in no set unless the relaxation is tight. A PGOError if the solver ends without a
    solution.
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
    constraints = [is_semidefinite]
    for product in equations.products:
        of_triangle = matrix_of_triangle(*np.triu_indices(product.side))
        P = of_triangle @ multipliers[product.entries]
        constraints.append(cp.reshape(P, (product.side, product.side), order="F") >> 0)
    model = cp.Problem(cp.Maximize(g), constraints)
    solve_compiled(model, "relaxation", tolerance=1e-10, accepted=cp.OPTIMAL_INACCURATE)
    Z = np.asarray(is_semidefinite.dual_value)
    u = D @ (Z[:, -1] / Z[-1, -1])
    return scale * np.asarray(multipliers.value), u


def _reduction(form: QuadraticForm) -> Array:
    """D with u = D (free x, 1), or (free x, free y, 1) where equalities have multipliers."""
    if form.reduction is not None and not form.E.shape[0] and not form.G.shape[0]:
        return form.reduction
    free = np.flatnonzero(form.is_free)
    D = np.zeros((form.side, len(free) + 1))
    D[free, np.arange(len(free))] = 1.0
    D[:, -1] = np.where(form.is_free, 0.0, form.fixed)
    return D


def matrix_of_triangle(rows: IntArray, columns: IntArray, off_diagonal: float = 1.0) -> csc_array:
    """To a symmetric matrix from the entries of a triangle, with a factor off the diagonal.

    Where it is the root of 1/2, the norms of triangle and matrix are the same.
    """
    side = int(rows.max()) + 1
    k = np.arange(len(rows))
    off = rows != columns
    factors = np.where(off, off_diagonal, 1.0)
    entries = np.concatenate([rows + side * columns, (columns + side * rows)[off]])
    data = np.concatenate([factors, factors[off]])
    return csc_array((data, (entries, np.concatenate([k, k[off]]))), shape=(side**2, len(k)))


def _scale(form: QuadraticForm) -> float:
    return float(abs(form.Q.data).max(initial=0.0)) or 1.0
