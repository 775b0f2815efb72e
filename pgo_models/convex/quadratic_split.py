"""Step (a) of SOC for a quadratic model, without a convex solver.

    X, y = argmin J(X, y) + sum over the terms of rho/2 ||X - V_term||^2.

Of a small model y is put in at its best and the rest diagonalised once, so that every rho takes two
products with a matrix. Of a large one a sparse Cholesky factor serves until rho changes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array

from pgo_models.convex.orthogonality import OrthogonalPoint, OrthogonalProblem
from pgo_models.convex.quadratic_form import QuadraticForm
from pgo_models.geometry.arrays import ReadOnly
from pgo_models.geometry.rotations import Array
from pgo_models.problem.cholesky import CholeskyFactor, factorize

# as multiples of the largest entry: what holds variables without a set that nothing else holds,
# and the penalty of equalities, which hold exactly in the values that are returned at the end
_DAMPING = 1e-12
_PENALTY = 1e6


@dataclass(frozen=True, eq=False)
class QuadraticSplit(ReadOnly):
    """The subproblem of `OrthogonalProblem.split` by linear algebra.

    Parameters
    ----------
    problem : OrthogonalProblem
        The model.
    form : QuadraticForm
        Its quadratic form.
    factored : pair of float and CholeskyFactor, optional
        A penalty and the factor of a large model with it.
    """

    problem: OrthogonalProblem
    form: QuadraticForm
    factored: tuple[float, CholeskyFactor] | None = None

    def solve(self, V: Sequence[Array], rho: float) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """As `SplitProblem.solve`."""
        form = self.form
        sums = self.problem.sums(V)
        entries = np.concatenate([total.reshape(-1, order="F") for total in sums])
        pull = rho * (self._x_of_entries @ entries)
        u = self._solved_dense(pull, rho) if form.reduction is not None else self._solved(pull, rho)
        return tuple(form.values(u)), self.others(u)

    def at(self, rho: float) -> "QuadraticSplit":
        """The same with the factor of a penalty, if it needs one."""
        if self.form.reduction is not None:
            return self
        return replace(self, factored=(rho, self._factor(rho)))

    def others(self, u: Array) -> tuple[Array, ...]:
        """The values of the variables without a set at u."""
        values = []
        start = self.form.num_constrained
        for variable in self.problem.others:
            entries = u[start : start + variable.size]
            values.append(entries.reshape(variable.shape, order="F"))
            start += variable.size
        return tuple(values)

    def stationary_point(self, u: Array) -> OrthogonalPoint:
        """The point u with the multipliers that it has if it is stationary: minus the gradient.

        Every variable has to be in one set.
        """
        form = self.form
        gradient = form.T.T @ (form.P @ form.residuals(u)[0] + form.c)
        normals = []
        start = 0
        for variable in self.problem.variables:
            entries = gradient[start : start + variable.size]
            normals.append(-entries.reshape(variable.shape, order="F"))
            start += variable.size
        values = form.values(u)
        ordered = [term.variable for term in self.problem.terms]
        return OrthogonalPoint(
            tuple(values[place] for place in ordered), tuple(normals[place] for place in ordered)
        )

    def measured(self, copies: Sequence[Array], others: Sequence[Array]) -> tuple[float, float]:
        """J at copies with the best other variables, and how much the copies violate."""
        u = self.form.u_of(self.problem.values(copies))
        return self.form.objective(u), self.problem.distance(copies)

    @cached_property
    def _entries_of_x(self) -> csc_array:
        """The entries of the variables from x; of a rotation of the plane four from two."""
        num_entries = sum(variable.size for variable in self.problem.variables)
        return csc_array(self.form.spread[:num_entries, : self.form.num_constrained])

    @cached_property
    def _x_of_entries(self) -> csr_array:
        """Its transpose."""
        return csr_array(self._entries_of_x.T)

    @cached_property
    def _weights(self) -> Array:
        """What rho is multiplied by in the Hessian of the penalty, a diagonal."""
        squares = abs(self._entries_of_x).sum(axis=0)
        weights = np.zeros(len(squares))
        for position, block in enumerate(self.form.blocks):
            num_terms = len(self.problem.terms_of(position))
            weights[block.coordinates] = num_terms * squares[block.coordinates]
        return weights

    @cached_property
    def _diagonal(self) -> tuple[Array, Array, Array]:
        """Eigenvalues and vectors of the Hessian relative to the weights, and the linear term."""
        D = self.form.reduction
        assert D is not None
        H = 2.0 * (D.T @ (self.form.Q @ D))
        free = self.form.is_free[: self.form.num_constrained]
        scale = np.sqrt(self._weights[free])
        values, scaled = np.linalg.eigh(H[:-1, :-1] / scale / scale[:, None])
        vectors = scaled / scale[:, None]
        return values, vectors, H[:-1, -1]

    def _solved_dense(self, pull: Array, rho: float) -> Array:
        D = self.form.reduction
        assert D is not None
        values, vectors, linear = self._diagonal
        right = pull[self.form.free_x] - linear
        x = vectors @ ((vectors.T @ right) / (np.maximum(values, 0.0) + rho))
        return np.asarray(D[:, :-1] @ x + D[:, -1])

    def _solved(self, pull: Array, rho: float) -> Array:
        form = self.form
        known_rho, factor = self.factored or (math.nan, None)
        if factor is None or known_rho != rho:
            factor = self._factor(rho)
        free = np.flatnonzero(form.is_free)
        u = np.where(form.is_free, 0.0, form.fixed)
        right = -(self._penalised @ u)
        right[: len(pull)] += pull
        u[free] = factor.solve(right[free])
        return u

    @cached_property
    def _penalised(self) -> csc_array:
        """The Hessian of J with equalities as a penalty, (N, N)."""
        E = self.form.E
        return csc_array(2.0 * self.form.Q + _PENALTY * abs(self.form.Q).max() * (E.T @ E))

    def _factor(self, rho: float) -> CholeskyFactor:
        form = self.form
        free = np.flatnonzero(form.is_free)
        added = np.full(form.side, _DAMPING * abs(form.Q).max())
        added[: form.num_constrained] += rho * self._weights
        return factorize(csc_array((self._penalised + diags_array(added))[free][:, free]))
