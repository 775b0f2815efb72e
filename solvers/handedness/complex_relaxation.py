"""The relaxation of rotations of the plane as complex numbers, solved on a low-rank factor.

With M_c the Hermitian matrix of a quadratic cost in the complex numbers z = (t, r) of the poses
(`pgo_models.certificates.unknowns`), the relaxation is

    min tr(M_c W)    over W positive semidefinite, W_ii = 1 for every r_i

(Calafiore, Carlone & Dellaert 2016). In real numbers, where M_c has side 4 n, its solution is
sought as X X^T with X, (4 n, q): a pose has two rows for r_i, whose 2 q squares sum to 1, a point
of a sphere (Burer & Monteiro 2003). Translations are the best ones for these rows. One column, q =
1, is a choice of poses; a few more lead around local minima. At a stationary point (M X)_i =
lambda_i X_i in the rows of r_i, and the lambda_i are multipliers for a bound on the cost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from pgo_models.certificates.certificate import (
    BoundSource,
    Certificate,
    certify_at,
    certify_with,
)
from pgo_models.certificates.definiteness import smallest_eta
from pgo_models.certificates.lower_bound import best_bound, pose_rows
from pgo_models.certificates.rounding_errors import rounding_level
from pgo_models.certificates.unknowns import ComplexUnknowns
from pgo_models.errors import NotPositiveDefiniteError, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.geometry.stiefel import project_to_tangent, row_products
from pgo_models.problem.cholesky import CholeskyFactor
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.matrices import inner
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.stationarity import STATIONARY_DECREMENT
from pgo_models.summaries import Summarised
from solvers.result import Measurement, Status
from solvers.riemannian.newton_step import ROUNDING, scaled_decrement
from solvers.riemannian.polish import polish
from solvers.riemannian.trust_region import Precision, first_radius, trust_region_step

# First shift of the rows of rotations for the preconditioner, as a share of their mean diagonal
# entry in M: it makes M, which is singular, definite.
_SHIFT = 1e-6
# Size of the numbers beyond the first column at the start: a way out of a saddle point.
_AWAY = 0.1


@dataclass(frozen=True, eq=False)
class ComplexPoint:
    """A point of the spheres and what is known there to first order."""

    Y: Array  # (n, 1, 2 q): the two rows of every r_i, one after the other
    value: float  # the least cost over the translations
    multipliers: Array  # (n, 1, 1): lambda_i, whose sum is the value
    gradient: Array  # (n, 1, 2 q): Riemannian: 2 ((M X)_i - lambda_i X_i)

    @property
    def Lambda(self) -> Array:
        """The multipliers as blocks lambda_i / 2 I, (n, 2, 2)."""
        return 0.5 * self.multipliers * np.eye(2)


@dataclass(frozen=True, eq=False)
class ComplexCost:
    """The cost of a relaxation as a function on spheres (`SmoothFunction` of the trust region)."""

    problem: PGOProblem  # a quadratic one
    M_rr: csr_array  # blocks of M, (2 n, 2 n) each, in the numbers of translations and rotations
    M_tr: csr_array
    factor: CholeskyFactor  # of M with a shift of the rows of rotations

    @classmethod
    def of(cls, problem: PGOProblem) -> ComplexCost:
        """The cost of a quadratic problem in the plane."""
        n = problem.num_poses
        unknowns = ComplexUnknowns(problem, pose_rows(0, n, 2))
        M = unknowns.M
        mean = float(M.diagonal()[2 * n :].mean())

        def attempt(shift: float) -> CholeskyFactor | None:
            try:
                return unknowns.factorize_shifted(shift)
            except NotPositiveDefiniteError:
                return None

        smallest = smallest_eta(attempt, _SHIFT * mean, below=mean / _SHIFT)
        if smallest is None:
            raise NotPositiveDefiniteError("no shift makes the matrix of the relaxation definite")
        of_t = slice(None, 2 * n)
        of_r = slice(2 * n, None)
        return cls(problem, M[of_r, of_r].tocsr(), M[of_t, of_r].tocsr(), smallest[1])

    @property
    def rounding_level(self) -> float:
        """Size of the rounding errors of a value, a difference of sums as large as tr(M_rr)."""
        return ROUNDING * float(self.M_rr.diagonal().sum())

    def apply_Q(self, Y: Array) -> Array:
        """The rows of rotations of M X, (n, 1, 2 q), with the best translations for Y."""
        n = self.problem.num_poses
        rows = Y.reshape(2 * n, -1)
        b = -(self.M_tr @ rows)
        # Both coordinates of a translation, in every column, have the same matrix.
        t = self.problem.translations.solve(b.reshape(n, -1)).reshape(2 * n, -1)
        return np.asarray(self.M_rr @ rows + self.M_tr.T @ t).reshape(Y.shape)

    def evaluate(self, Y: Array) -> ComplexPoint:
        """Return the point Y with value, multipliers and gradient."""
        QY = self.apply_Q(Y)
        multipliers = row_products(QY, Y)
        gradient = 2.0 * (QY - multipliers @ Y)
        return ComplexPoint(Y, float(np.sum(multipliers)), multipliers, gradient)

    def hessian_product(self, point: ComplexPoint, V: Array) -> Array:
        """Apply the Riemannian Hessian at a point to a tangent."""
        return 2.0 * project_to_tangent(point.Y, self.apply_Q(V) - point.multipliers @ V)

    def precondition(self, point: ComplexPoint, V: Array) -> Array:
        """Apply the inverse of Q with a shift to a tangent, and project."""
        n = self.problem.num_poses
        rows = V.reshape(2 * n, -1)
        solution = self.factor.solve(np.concatenate([np.zeros_like(rows), rows]))
        return project_to_tangent(point.Y, solution[2 * n :].reshape(V.shape))


@dataclass(frozen=True, eq=False)
class ComplexState(Summarised):
    """State k."""

    k: int
    cost: ComplexCost
    ground: Poses  # the start, where the quadratic cost touches one that is not quadratic
    point: ComplexPoint
    decrement: float  # as of the Riemannian staircase
    radius: float  # of the trust region, in the norm of the preconditioner
    rounding_level: float  # a value below it cannot be told from zero
    is_stationary: bool = False


@dataclass(frozen=True)
class ComplexRelaxation:
    """The relaxation of planar rotations as complex numbers, by a trust region on spheres.

    `primal_residual` is what rounding to poses loses, (F - f) / F, and `dual_residual` half the
    squared Newton decrement over f, f the value of the relaxation. Of a cost that is not quadratic
    the relaxation is that of its tangent at the start.

    Parameters
    ----------
    columns : int
        Number of columns q of the factor. With four, no local minimum was found on any graph.
    tolerance : float
        On the decrement.
    max_iterations : int
        Most steps.

    Raises
    ------
    SettingError
        If tolerance is not positive, `max_iterations` is negative, or there are no columns.

    References
    ----------
    G. Calafiore, L. Carlone and F. Dellaert, Pose graph optimization in the complex domain, 2016.

    Examples
    --------
    >>> from solvers.loop import run
    >>> from solvers.studies.tightness import noisy_lattice
    >>> lattice = noisy_lattice(4, 0.5, np.random.default_rng(4), d=2, kappa=1.0)
    >>> run(ComplexRelaxation(), lattice).status.name
    'CONVERGED'
    """

    columns: int = 4
    tolerance: float = STATIONARY_DECREMENT
    max_iterations: int = 100

    def __post_init__(self) -> None:
        check_settings(self, positive=["tolerance"], not_negative=["max_iterations"])
        check_settings(self, at_least_one=["columns"])

    def init(self, problem: PGOProblem, start: Poses | None) -> ComplexState:
        """State 0: the rotations of a start, or of the chordal one, with further columns."""
        poses = start if start is not None else chordal_start(problem.convex_part)
        ground = problem.at_best_translations(poses)
        n = problem.num_poses
        rng = np.random.default_rng(0)  # fixed, so that every run is the same
        rows = _AWAY * rng.standard_normal((n, 2, self.columns))
        rows[:, :, 0] = poses.R[:, :, 0]  # a and b of (a, -b; b, a)
        lengths = np.linalg.norm(rows, axis=(1, 2), keepdims=True)
        Y = (rows / lengths).reshape(n, 1, -1)
        cost = ComplexCost.of(problem.tangent_at(ground))
        level = max(rounding_level(problem, ground), cost.rounding_level)
        return self._arrive(0, cost, ground, cost.evaluate(Y), level)

    def step(self, problem: PGOProblem, state: ComplexState) -> ComplexState:
        """One iteration of the trust region."""
        point = state.point
        precision = Precision.at(point.value, state.decrement, self.tolerance, state.rounding_level)
        step = trust_region_step(state.cost, point, state.radius, precision)
        if step.point is None:
            return replace(
                state, k=state.k + 1, radius=step.radius, is_stationary=step.is_below_rounding
            )
        k = state.k + 1
        arrived = self._arrive(k, state.cost, state.ground, step.point, state.rounding_level)
        is_stuck = step.is_below_rounding and arrived.decrement > 0.5 * state.decrement
        return replace(arrived, radius=step.radius, is_stationary=is_stuck or arrived.is_stationary)

    def measure(self, problem: PGOProblem, state: ComplexState) -> Measurement:
        """F of the rounded poses, what rounding loses, and the decrement."""
        objective = problem.objective(self.poses(problem, state))
        lost = max(objective - state.point.value, 0.0) / max(objective, state.rounding_level)
        return Measurement(objective, lost, state.decrement)

    def poses(self, problem: PGOProblem, state: ComplexState) -> Poses:
        """Round the columns a + b i to the numbers of length 1 nearest to their leading vector.

        Returns
        -------
        Poses
            With the best translations.
        """
        n = problem.num_poses
        a, b = np.moveaxis(state.point.Y.reshape(n, 2, -1), 1, 0)
        numbers = a + 1j * b
        _, vectors = np.linalg.eigh(numbers.conj().T @ numbers)
        leading = numbers @ vectors[:, -1]
        angles = np.angle(leading)
        c = np.cos(angles)
        s = np.sin(angles)
        R = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
        return problem.at_best_translations(problem.with_best_translations(R))

    def converged(self, state: ComplexState, measurement: Measurement) -> Status | None:
        """CONVERGED at a stationary point."""
        return Status.CONVERGED if state.is_stationary else None

    def _arrive(
        self, k: int, cost: ComplexCost, ground: Poses, point: ComplexPoint, level: float
    ) -> ComplexState:
        """State at a point, with the first radius."""
        squared = inner(point.gradient, cost.precondition(point, point.gradient))
        decrement = 0.0
        if point.value > level:
            decrement = scaled_decrement(0.5 * squared, point.value, level)
        return ComplexState(
            k=k,
            cost=cost,
            ground=ground,
            point=point,
            decrement=decrement,
            radius=first_radius(squared),
            rounding_level=level,
            is_stationary=decrement <= self.tolerance,
        )


def certificates_of_relaxation(
    problem: PGOProblem, method: ComplexRelaxation, state: ComplexState, gap: float
) -> tuple[Certificate, Certificate]:
    """Certificate of the multipliers at a state, and that of the poses that it polishes to.

    The first is of the poses that the relaxation was started at: where the cost is not quadratic,
    its tangent touches it there.
    """
    point = state.point
    ground = state.ground
    bound = best_bound(state.cost.problem, point.Lambda, ground, gap, point.value, is_complex=True)
    relaxed = certify_with(problem, ground, point.Lambda, gap, math.nan, BoundSource.COMPLEX, bound)
    rounded = polish(problem, method.poses(problem, state))
    return relaxed, certify_at(problem, rounded, gap)
