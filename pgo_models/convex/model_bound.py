"""A proven lower bound on a quadratic model over sets, from any multipliers of their equations.

Let u^T S u be the Lagrangian (`pgo_models.convex.set_equations`), which is J wherever the equations
hold, and u' any point that has the fixed coordinates of u right, the last of which is 1. An index r
means that these are left out. With Z = u - u', which vanishes there, and G = S u',

    J(u) = u'^T S u' + 2 G_r^T Z_r + Z_r^T S_r Z_r >= u'^T S u' - G_r^T S_r^-1 G_r

if S_r is positive definite. This is the bound of a pose graph grounded at a pose
(`pgo_models.certificates.lower_bound`), where the pose takes the place of the fixed coordinates;
definiteness is proven by the same factorisation, and u' is moved by -S_r^-1 G_r as X' is there. The
matrices P of products of hulls are proven definite, too. Where S_r is not definite, S_r + eta I may
be, I of the coordinates x. As columns have norm 1, that is nothing but other multipliers: eta less
for each of the equations that say so.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array, diags_array

from pgo_models.certificates.definiteness import (
    DefiniteProof,
    StoredMatrix,
    is_in_range,
    prove_stored,
    smallest_eta,
)
from pgo_models.certificates.lower_bound import MOST_MOVES, quadratic_loss
from pgo_models.convex.quadratic_form import QuadraticForm
from pgo_models.convex.set_equations import SetEquations
from pgo_models.geometry.arrays import ReadOnly
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import analyze
from pgo_models.problem.floating_point import OUTWARD, exact_sum, gamma

# A shift as a share of the largest diagonal entry: the first, and where the search ends.
_FIRST_ETA = 1e-13
_LAST_ETA = 1e2


@dataclass(frozen=True, eq=False)
class ModelBound(ReadOnly):
    """J >= value for all points of the sets, in exact arithmetic.

    Parameters
    ----------
    value : float
        The bound.
    multipliers : array
        l, of `set_equations`.
    u : (N,) array
        u', which with l is the proof.
    rounding : float
        What was subtracted for rounding and for the G_r that is left.
    equations : SetEquations
        What the multipliers are of.
    """

    value: float
    multipliers: Array
    u: Array
    rounding: float
    equations: SetEquations


@dataclass(frozen=True)
class _Lagrangian:
    """S in doubles and a bound on its errors, and what is left out."""

    form: QuadraticForm
    equations: SetEquations
    multipliers: Array
    S: csc_array
    S_error: csc_array
    is_free: BoolArray  # neither fixed nor grounded, (N,)

    @classmethod
    def of(cls, form: QuadraticForm, equations: SetEquations, multipliers: Array) -> "_Lagrangian":
        S = csc_array(form.Q - equations.combined(multipliers))
        most = np.bincount(equations.i, minlength=form.side)[:-1].max(initial=0) + 4.0
        sizes = abs(form.Q) + equations.sizes(multipliers)
        S_error = csc_array(form.Q_error + gamma(float(most)) * sizes)
        is_free = form.is_free.copy()
        is_free[form.grounded] = False
        return cls(form, equations, multipliers, S, S_error, is_free)

    def prove(self) -> DefiniteProof | None:
        """Proof that S_r is definite, or None; also where a P is not proven definite."""
        of_products = (each.matrix(self.multipliers) for each in self.equations.products)
        if not all(is_proven_definite(P) for P in of_products if P.any()):
            return None
        stored_diagonal = np.where(self.is_free, self.S.diagonal(), 2.0)
        if not is_in_range(self.S.data, stored_diagonal):
            return None
        diagonal = np.maximum(abs(self.form.Q.diagonal()), stored_diagonal)
        diagonal[~self.is_free] = 1.0
        keep = diags_array(self.is_free.astype(float))
        stored = csc_array(keep @ self.S @ keep + diags_array(1.0 + abs(self.S.diagonal())))
        stored.setdiag(stored_diagonal)
        stored.sort_indices()
        # |v^T E v| <= sum_ij |E_ij| (v_i^2 / s + s v_j^2) / 2 with s = sqrt(d_j / d_i)
        root = np.sqrt(diagonal)
        error = keep @ self.S_error @ keep
        entries = OUTWARD * (error @ (1.0 / root)) / root
        positions = _diagonal_positions(stored)
        fixed = np.flatnonzero(~self.is_free)
        matrix = StoredMatrix(stored, diagonal, fixed, entries, analyze(stored), positions)
        return prove_stored(matrix)

    def gradient(self, u: Array) -> tuple[Array, Array]:
        """G_r = (S u)_r and a bound on its error, zeros where left out."""
        form = self.form
        z, z_error = form.residuals(u)
        terms_of_P = np.diff(form.P.indptr).max(initial=0)
        count = gamma(float(np.diff(form.T.indptr).max(initial=0) + terms_of_P + 12.0))
        of_P = form.P @ z + form.c
        size_of_P = abs(form.P) @ (abs(z) + z_error) + abs(form.c)
        G = 0.5 * (form.spread.T @ (form.T.T @ of_P))
        G -= self.equations.combined(self.multipliers) @ u
        P_error = abs(form.P) @ z_error + count * size_of_P
        error = 0.5 * (abs(form.spread).T @ (abs(form.T).T @ (P_error + count * size_of_P)))
        most = np.bincount(self.equations.i, minlength=form.side)[:-1].max(initial=0) + 8.0
        error += gamma(float(most)) * (self.equations.sizes(self.multipliers) @ abs(u) + abs(G))
        return np.where(self.is_free, G, 0.0), np.where(self.is_free, OUTWARD * error, 0.0)

    def value(self, u: Array) -> tuple[float, float]:
        """The Lagrangian at u, and a bound on its error."""
        return self.form.evaluated(u, -self.equations.terms(self.multipliers, u))


def is_proven_definite(P: Array) -> bool:
    """Whether a matrix of doubles is proven positive definite."""
    return prove_matrix(P, np.zeros(P.shape), 0.0) is not None


def prove_matrix(P: Array, error: Array, first_margin: float) -> DefiniteProof | None:
    """Proof that a dense symmetric matrix is definite, whose entries have errors."""
    diagonal = P.diagonal()
    if not is_in_range(P, diagonal):
        return None
    stored = csc_array(P)
    root = np.sqrt(diagonal)  # as in `_Lagrangian.prove`
    shares = OUTWARD * (error @ (1.0 / root)) / root
    none = np.zeros(0, dtype=int)
    positions = _diagonal_positions(stored)
    matrix = StoredMatrix(stored, diagonal, none, shares, analyze(stored), positions)
    return prove_stored(matrix, first_margin)


def _diagonal_positions(matrix: csc_array) -> IntArray:
    """Of the diagonal among the values stored, all of which it has."""
    columns = np.repeat(np.arange(matrix.shape[1]), np.diff(matrix.indptr))
    return np.flatnonzero(matrix.indices == columns)


def prove_model_bound(
    form: QuadraticForm, equations: SetEquations, multipliers: Array, u: Array
) -> ModelBound | None:
    """The bound of some multipliers, or None where S_r is not proven definite.

    u is moved where that raises the bound; coordinates that are left out stay as they are, but for
    fixed ones, which have to be right.
    """
    lagrangian = _Lagrangian.of(form, equations, multipliers)
    proof = lagrangian.prove()
    if proof is None:
        return None
    best = _bound_at(lagrangian, proof, form.with_fixed(u))
    for _ in range(MOST_MOVES):
        G, _ = lagrangian.gradient(best.u)
        bound = _bound_at(lagrangian, proof, best.u - proof.solve(G[:, None])[:, 0])
        if not bound.value > best.value:
            break
        best = bound
    return best


def _bound_at(lagrangian: _Lagrangian, proof: DefiniteProof, u: Array) -> ModelBound:
    value, error = lagrangian.value(u)
    G, G_error = lagrangian.gradient(u)
    free = proof.free
    loss = quadratic_loss(G[free, None], G_error[free, None], proof.slack[free])
    bound = np.nextafter(exact_sum([value, -error, -loss]), -np.inf)
    if lagrangian.form.is_sum_of_squares:
        bound = max(bound, 0.0)
    rounding = float(error + loss)
    return ModelBound(float(bound), lagrangian.multipliers, u, rounding, lagrangian.equations)


def best_model_bound(
    form: QuadraticForm, equations: SetEquations, multipliers: Array, u: Array
) -> ModelBound | None:
    """The bound of some multipliers as they are, else with nearly the smallest shift eta."""
    bound = prove_model_bound(form, equations, multipliers, u)
    if bound is not None:
        return bound
    scale = float(abs(form.Q.data).max()) or 1.0
    found = smallest_eta(
        lambda eta: prove_model_bound(form, equations, multipliers - eta * equations.norms, u),
        _FIRST_ETA * scale,
        below=_LAST_ETA * scale,
    )
    return None if found is None else found[1]
