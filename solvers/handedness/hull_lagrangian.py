"""The relaxation with hulls of rotations by its low-rank factor: an augmented Lagrangian.

It minimises f(Y) = tr(Y^T Q Y) over Y in St(3, r)^n subject to A_e = A(Y_i Y_j^T) PSD for every
pair e = (i, j) of poses that share an edge (`pgo_models.relaxations.rotation_hull`). With a
multiplier Pi_e >= 0, (4, 4), of every pair and a penalty rho, the augmented Lagrangian is

    L(Y) = f(Y) + sum_e (||[Pi_e - rho A_e]_+||^2 - ||Pi_e||^2) / (2 rho),

where [.]_+ raises negative eigenvalues to zero (Rockafellar 1973; Burer & Monteiro 2003 for
low-rank factors). An iteration

    (a) minimises L over Y, and climbs where a negative eigenvalue shows a way down,
    (b) Pi_e <- [Pi_e - rho A_e]_+,
    (c) raises rho where the largest violation of A_e >= 0 has not fallen enough.

Where Y is stationary the multipliers Lambda_i of Y_i Y_i^T = I are those of the new Pi_e as well,
and S = M - blockdiag(0, Lambda) - sum_e N(Pi_e) has S Y = 0: every iteration proves a bound, with
what S lacks to be positive semidefinite taken off. Products with Q are all it needs of the graph,
so that it solves graphs for which the models of cvxpy are too large.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pgo_models.certificates.certificate import DEFAULT_GAP
from pgo_models.certificates.dual_variables import factorize_certificate
from pgo_models.certificates.handedness import HandednessTerms, distinct_pairs
from pgo_models.certificates.lower_bound import LowerBound, best_bound_with_terms
from pgo_models.certificates.rounding_errors import rounding_level
from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.geometry.stiefel import append_rank, project_to_tangent, retract, row_products
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyFactor
from pgo_models.problem.incidence import Incidence
from pgo_models.problem.matrices import inner
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.stationarity import rotation_scale
from pgo_models.relaxations.low_rank import lifted_point
from pgo_models.relaxations.rotation_hull import (
    hull_changes,
    hull_gradients,
    hull_matrices,
    less_diagonal_blocks,
    terms_of,
)
from pgo_models.relaxations.rounding import round_factor
from solvers.result import Measurement, Status
from solvers.riemannian.climb import DualBound, climb
from solvers.riemannian.staircase import EscapeDirection, escape_direction, precondition
from solvers.riemannian.trust_region import Precision, first_radius, trust_region_step

_SHIFT = 1e-2  # of the mean diagonal entry of M over the rotations, in the preconditioner
_FIRST_PENALTY = 0.04  # of it, too
_FIRST_MOVE = 0.3  # of the start, at random: at rank 3 the start is a saddle of L
# Squared Newton decrement of L, relative to f, at which a point is stationary: a share of the
# distance of f from F, within limits.
_ENOUGH = 1e-3
_COARSEST = 1e-7
_FINEST = 1e-11
_MOST_STEPS = 30  # of the trust region, in an iteration
_MOST_RANK = 14  # of Y; above it the least of the columns is left out
_MOST_PRODUCTS = 60  # with the Hessian, in a step of it
_MOST_CLIMBS = 2  # in an iteration
_FALLEN = 0.75  # share of the last violation above which rho grows
_GROWTH = 1.5  # of rho then
_MOST_PENALTY = 4.0  # of the mean diagonal entry: beyond, L is hard to minimise
_NEGLIGIBLE = 1e-6  # share of n below which the square of a column of Y counts as zero
_WINDOW = 8  # iterations, of which
_LEAST_RISE = 0.02  # is how much the bound rises at least, relative to what is left to rise


@dataclass(frozen=True, eq=False)
class HullPoint:
    """A point of St(3, r)^n and what is known of L there to first order."""

    Y: Array  # (n, 3, r)
    value: float  # L
    cost: float  # f
    # (n, 3, 3): sym((dL/dY)_i Y_i^T) / 2, the multipliers of Y_i Y_i^T = I
    Lambda: Array
    gradient: Array  # (n, 3, r): Riemannian, of L
    hull: Array  # A_e, (k, 4, 4)
    # of Pi_e - rho A_e, (k, 4) and (k, 4, 4)
    eigenvalues: Array
    axes: Array

    @property
    def Pi(self) -> Array:
        """The multipliers [Pi_e - rho A_e]_+ of the next iteration, (k, 4, 4)."""
        raised = np.maximum(self.eigenvalues, 0.0)
        return np.asarray((self.axes * raised[:, None, :]) @ np.swapaxes(self.axes, 1, 2))

    @property
    def violation(self) -> float:
        """How far the smallest eigenvalue of all A_e is below zero."""
        return max(0.0, -float(np.linalg.eigvalsh(self.hull)[:, 0].min(initial=0.0)))


@dataclass(frozen=True, eq=False)
class AugmentedLagrangian:
    """L as a function for the trust region."""

    problem: PGOProblem
    pairs: IntArray  # (k, 2)
    incidence: Incidence  # of the pairs
    Pi: Array  # (k, 4, 4)
    rho: float
    preconditioner: CholeskyFactor

    @classmethod
    def of(
        cls, problem: PGOProblem, Pi: Array, rho: float, preconditioner: CholeskyFactor
    ) -> AugmentedLagrangian:
        """L of a problem, with multipliers of the pairs of poses that share an edge."""
        pairs = distinct_pairs(problem.graph)
        incidence = Incidence.of_pairs(problem.num_poses, *pairs.T)
        return cls(problem, pairs, incidence, Pi, rho, preconditioner)

    def evaluate(self, Y: Array) -> HullPoint:
        """Return the point Y with value and gradient."""
        lifted = lifted_point(self.problem, Y)
        hull = hull_matrices(self._products(Y, Y))
        eigenvalues, axes = np.linalg.eigh(self.Pi - self.rho * hull)
        raised = np.maximum(eigenvalues, 0.0)
        penalty = (np.sum(raised**2) - np.sum(self.Pi**2)) / (2.0 * self.rho)
        multipliers = (axes * raised[:, None, :]) @ np.swapaxes(axes, 1, 2)
        QY = lifted.Lambda @ Y + 0.5 * lifted.gradient
        half_gradient = QY - 0.5 * self._spread(hull_gradients(multipliers), Y)
        Lambda = row_products(half_gradient, Y)
        gradient = 2.0 * (half_gradient - Lambda @ Y)
        value = lifted.value + float(penalty)
        return HullPoint(Y, value, lifted.value, Lambda, gradient, hull, eigenvalues, axes)

    def hessian_product(self, point: HullPoint, V: Array) -> Array:
        """Apply the Riemannian Hessian of L (a generalised one, as [.]_+ has kinks)."""
        n, d, r = V.shape
        Y = point.Y
        QV = self.problem.translations.apply_Q(V.reshape(n * d, r)).reshape(n, d, r)
        changes = hull_changes(self._products(V, Y) + self._products(Y, V))
        multiplier_changes = -self.rho * _projection_derivative(point, changes)
        coupling = self._spread(hull_gradients(point.Pi), V)
        coupling += self._spread(hull_gradients(multiplier_changes), Y)
        product = QV - 0.5 * coupling - point.Lambda @ V
        return 2.0 * project_to_tangent(Y, product)

    def precondition(self, point: HullPoint, V: Array) -> Array:
        """Apply the preconditioner of the staircase to a tangent."""
        return precondition(self.problem, self.preconditioner, point.Y, V)

    def _products(self, Y: Array, V: Array) -> Array:
        """Y_i V_j^T of every pair, (k, 3, 3)."""
        i, j = self.pairs.T
        return np.asarray(Y[i] @ np.swapaxes(V[j], 1, 2))

    def _spread(self, C: Array, Y: Array) -> Array:
        """Gradient of sum_e <C_e, Y_i Y_j^T> for fixed C, (k, 3, 3): an array as Y."""
        i, j = self.pairs.T
        return self.incidence.at_both(C @ Y[j], np.swapaxes(C, 1, 2) @ Y[i])


def _projection_derivative(point: HullPoint, changes: Array) -> Array:
    """Derivative of [B]_+ at B = Pi_e - rho A_e along symmetric matrices, (k, 4, 4).

    In the eigenvectors of B it multiplies entry (a, b) by the difference quotient of max(., 0) of
    the eigenvalues a and b (Loewner).
    """
    values = point.eigenvalues
    raised = np.maximum(values, 0.0)
    differences = values[:, :, None] - values[:, None, :]
    is_equal = differences == 0.0
    slopes = (raised[:, :, None] - raised[:, None, :]) / np.where(is_equal, 1.0, differences)
    slopes = np.where(is_equal, values[:, :, None] > 0.0, slopes)
    axes = point.axes
    transposed = np.swapaxes(axes, 1, 2)
    return np.asarray(axes @ (slopes * (transposed @ changes @ axes)) @ transposed)


@dataclass(frozen=True, eq=False)
class HullState:
    """State k."""

    k: int
    point: HullPoint  # stationary for L of the last iteration
    Pi: Array  # multipliers of the next one
    rho: float  # and its penalty
    scale: float  # mean diagonal entry of M over the rotations
    preconditioner: CholeskyFactor
    objective: float  # cost of the rounded poses
    rounding_level: float  # f below it cannot be told from zero
    bound: DualBound | None = None  # the best that was proven so far
    bounds: tuple[float, ...] = ()  # its value after every iteration

    @property
    def closeness(self) -> float:
        """(F - f) / F of the rounded poses: zero where the relaxation is tight."""
        return max(0.0, self.objective - self.point.cost) / max(self.objective, self.rounding_level)


@dataclass(frozen=True)
class HullLagrangian:
    """Augmented Lagrangian of the relaxation with hulls of rotations, on a low-rank factor.

    `primal_residual` is how far the smallest eigenvalue of all A_e is below zero. `dual_residual`
    is the relative distance of f from the cost of the rounded poses. The run ends as CONVERGED if
    the dual residual is within the tolerance, or the bound within the gap. It ends as STALLED if
    the bound rises no more.

    Parameters
    ----------
    tolerance : float
        On (F - f) / F, at which Y is close to poses and terms there are worth trying.
    gap : float
        Relative gap between F of the rounded poses and the proven bound.
    rank : int
        First rank r of Y, from 4 to 14. It grows where that leads down, up to 14.
    max_iterations : int
        Most updates of the multipliers.

    Raises
    ------
    SettingError
        If tolerance or gap is not positive, or a number of iterations or a rank is too small.

    References
    ----------
    S. Burer and R. D. C. Monteiro, A nonlinear programming algorithm for solving semidefinite
    programs via low-rank factorization, Math. Program. 95, 2003; J. Saunderson, P. A. Parrilo and
    A. S. Willsky, Semidefinite descriptions of the convex hull of rotation matrices, SIAM J. Optim.
    25, 2015.
    """

    tolerance: float = 3e-5
    gap: float = DEFAULT_GAP
    rank: int = 9
    max_iterations: int = 40

    def __post_init__(self) -> None:
        check_settings(self, positive=["tolerance", "gap"], not_negative=["max_iterations"])
        if not 4 <= self.rank <= _MOST_RANK:
            raise SettingError(f"rank must be from 4 to {_MOST_RANK}, got {self.rank}")

    def init(self, problem: PGOProblem, start: Poses | HullState | None) -> HullState:
        """State 0: the state of an earlier run, or poses moved at random in more dimensions."""
        if isinstance(start, HullState):
            return replace(start, k=0)
        assert start is not None
        n = problem.num_poses
        scale = float(rotation_scale(problem).mean())
        preconditioner = factorize_certificate(problem, np.zeros((n, 3, 3)), _SHIFT * scale)
        num_pairs = len(distinct_pairs(problem.graph))
        Pi = np.zeros((num_pairs, 4, 4))
        rho = _FIRST_PENALTY * scale
        more_columns = np.zeros((n, 3, self.rank - 3))
        Y = np.concatenate([np.swapaxes(start.R, 1, 2), more_columns], axis=2)
        move = _FIRST_MOVE * np.random.default_rng(0).standard_normal(Y.shape)
        moved = retract(Y, project_to_tangent(Y, move))
        return HullState(
            k=0,
            point=AugmentedLagrangian.of(problem, Pi, rho, preconditioner).evaluate(moved),
            Pi=Pi,
            rho=rho,
            scale=scale,
            preconditioner=preconditioner,
            objective=problem.objective(start),
            rounding_level=rounding_level(problem, start),
        )

    def step(self, problem: PGOProblem, state: HullState) -> HullState:
        """One minimisation of L, and the update of the multipliers."""
        function = AugmentedLagrangian.of(problem, state.Pi, state.rho, state.preconditioner)
        # (a)
        level = state.rounding_level
        start = self._without_negligible_columns(state.point.Y)
        enough = min(max(_ENOUGH * state.closeness, _FINEST), _COARSEST)
        point = _minimised(function, function.evaluate(start), level, enough)
        bound = state.bound
        for _ in range(_MOST_CLIMBS):
            rng = np.random.default_rng(state.k)
            climbed = climb(HullClimb(function, point, level, rng), self.gap, bound)
            bound = climbed.bound
            if climbed.point is None:
                break
            point = _minimised(function, climbed.point, level, enough)
        # (b)
        Pi = point.Pi
        # (c)
        has_fallen = point.violation <= _FALLEN * state.point.violation
        most = _MOST_PENALTY * state.scale
        rho = state.rho if has_fallen else min(_GROWTH * state.rho, most)
        proven = bound.lower_bound if bound is not None else 0.0
        return replace(
            state,
            k=state.k + 1,
            point=point,
            Pi=Pi,
            rho=rho,
            objective=problem.objective(round_factor(problem, point.Y)[0]),
            bound=bound,
            bounds=(*state.bounds, proven),
        )

    def measure(self, problem: PGOProblem, state: HullState) -> Measurement:
        """The cost of the rounded poses, the violation, and how close Y is to them."""
        violation = state.point.violation
        return Measurement(state.objective, violation, state.closeness, infeasibility=violation)

    def converged(self, state: HullState, measurement: Measurement) -> Status | None:
        """CONVERGED close to poses or with a proven gap, STALLED where the bound does not rise."""
        if state.k == 0 or state.bound is None:
            return None
        best = state.bounds[-1]
        difference = state.objective - best
        if state.closeness <= self.tolerance or difference <= self.gap * state.objective:
            return Status.CONVERGED
        if len(state.bounds) <= _WINDOW or state.closeness <= 10.0 * self.tolerance:
            return None
        rise = best - state.bounds[-1 - _WINDOW]
        return None if rise > _LEAST_RISE * difference else Status.STALLED

    def _without_negligible_columns(self, Y: Array) -> Array:
        """Y turned so that its columns are orthogonal, without those that are about zero.

        As many as `rank` stay, and at most `_MOST_RANK`.
        """
        n, d, r = Y.shape
        if r <= self.rank:
            return Y
        stacked = Y.reshape(n * d, r)
        squares, axes = np.linalg.eigh(stacked.T @ stacked)
        num_kept = int(np.count_nonzero(squares > _NEGLIGIBLE * n))
        num_kept = min(max(num_kept, self.rank), _MOST_RANK)
        turned = (stacked @ axes[:, -num_kept:]).reshape(n, d, num_kept)
        return retract(turned, np.zeros_like(turned))


def _minimised(
    function: AugmentedLagrangian, point: HullPoint, rounding_level: float, enough: float
) -> HullPoint:
    """Stationary point of L, up to the relative decrement `enough`, by the trust region."""
    radius: float | None = None
    for _ in range(_MOST_STEPS):
        preconditioned = function.precondition(point, point.gradient)
        squared = inner(point.gradient, preconditioned)
        scale = max(point.cost, rounding_level)
        decrement = 0.25 * squared / scale
        if decrement <= enough:
            break
        if radius is None:
            radius = first_radius(squared)
        precision = Precision.at(point.cost, decrement, 0.0, rounding_level, _MOST_PRODUCTS)
        step = trust_region_step(function, point, radius, precision)
        radius = step.radius
        if step.point is not None:
            point = step.point
        if step.is_below_rounding:
            break
    return point


@dataclass(frozen=True, eq=False)
class HullClimb:
    """`climb.ClimbAlgebra` at a stationary point of L; `rng` draws the first Lanczos vector."""

    function: AugmentedLagrangian
    point: HullPoint
    rounding_level: float
    rng: np.random.Generator

    @property
    def objective(self) -> float:
        """Value of L at the point."""
        return self.point.value

    @property
    def num_rows(self) -> int:
        """Number of rows of the rotations, 3 n."""
        return 3 * self.function.problem.num_poses

    @property
    def has_room(self) -> bool:
        """Whether the next rank fits into memory: always."""
        return True

    @cached_property
    def terms(self) -> HandednessTerms:
        """Handedness terms of the multipliers Pi at the point."""
        return terms_of(self.function.pairs, self.point.Pi)

    @cached_property
    def Lambda(self) -> Array:
        """Multipliers, (n, 3, 3), of the cost less the terms."""
        return less_diagonal_blocks(self.point.Lambda, self.terms)

    def prove(self, gap: float) -> LowerBound:
        """Return the bound of the multipliers and the terms."""
        problem = self.function.problem
        cost = self.point.cost
        return best_bound_with_terms(problem, self.Lambda, None, gap, cost, self.terms)

    def with_multipliers(self, bound: LowerBound) -> DualBound:
        """Return a bound with the multipliers at the point."""
        return DualBound(bound, self.Lambda)

    def direction(self, proven: LowerBound, smallest: float) -> EscapeDirection:
        """Return the direction of the smallest eigenvalue of S, by Lanczos."""
        less_terms = self.terms.taken_off(self.function.problem)
        return escape_direction(less_terms, self.Lambda, self.point.Y, smallest, self.rng)

    def evaluate(self, direction: EscapeDirection, length: float) -> tuple[float, HullPoint]:
        """Return L after a move along the direction, and the point there."""
        Y = retract(append_rank(self.point.Y), length * direction.column)
        candidate = self.function.evaluate(Y)
        return candidate.value, candidate

    def accept(self, trial: HullPoint) -> None:
        """Do nothing: the caller has the point."""
