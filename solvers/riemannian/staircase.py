"""Riemannian staircase: the semidefinite relaxation by its low-rank factor, certified, rank by rank (SE-Sync).

min tr(Y^T Q Y) over Y in St(d, r)^n, translations marginalised in Q; where S has a negative eigenvalue at a stationary
point, its eigenvector in one more column of Y leads down (Rosen et al. 2019, algorithms 1 to 3; Boumal 2015).
"""

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pgo_models.certificates.certificate import DEFAULT_GAP
from pgo_models.certificates.dual_variables import factorize_certificate
from pgo_models.certificates.lower_bound import NO_BOUND, LowerBound, best_bound, smallest_shift
from pgo_models.certificates.newton_polish import STATIONARY_DECREMENT, scaled_decrement
from pgo_models.certificates.rounding_errors import rounding_level
from pgo_models.certificates.spectrum import NegativeCurvature, negative_curvature
from pgo_models.errors import check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.geometry.stiefel import append_rank, project_to_tangent, retract
from pgo_models.problem.cholesky import CholeskyFactor
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.matrices import inner
from pgo_models.problem.problem import PGOProblem
from pgo_models.relaxations.low_rank import LiftedPoint, hessian_product, lifted_point
from pgo_models.relaxations.rounding import round_factor
from solvers.result import Measurement, Status
from solvers.riemannian.truncated_cg import truncated_conjugate_gradients

_SHIFT = 1e-6  # of the mean diagonal entry of M over the rotations: makes Q, which is singular, definite
_FIRST_RADIUS = 100.0  # times the preconditioned gradient, which soft directions outgrow
_ACCEPTED, _POOR, _GOOD = 0.1, 0.25, 0.75  # ratios of actual to promised decrease
_SHRINK, _GROW = 0.25, 2.0
_LONGEST = 10.0  # norm of a block of the step, which saturates at about 1: beyond, the model says nothing
_FORCING = 0.1
_FLOOR = 0.01  # of the tolerance: conjugate gradients go no deeper
ROUNDING = 1e-14  # relative change of f that is not told apart from none
SUFFICIENT, HALVINGS = 0.25, 40


@dataclass(frozen=True, eq=False)
class DualBound:
    """A proven lower bound on F (`pgo_models.certificates.lower_bound`), and its multipliers Lambda, (n, d, d)."""

    bound: LowerBound
    Lambda: Array

    @property
    def lower_bound(self) -> float:
        """F of no poses is below it."""
        return self.bound.value


@dataclass(frozen=True, eq=False)
class StaircaseState:
    """State k."""

    k: int
    point: LiftedPoint  # Y, its rank, the relaxation's value, multipliers and gradient
    # Of M + eps blockdiag(0, I), whose solves on the rotations are those with Q + eps I; after a climb, of S with a
    # shift.
    preconditioner: CholeskyFactor
    # <g, P g> / 4, less the rounding level of f, over f, g the gradient and P the preconditioner projected to the
    # tangent space: half the squared Newton decrement if the Hessian were twice the preconditioner's matrix.
    decrement: float
    radius: float  # of the trust region, in the preconditioner's norm
    rounding_level: float  # f below it cannot be told from zero; that of the start
    inner_iterations: int = 0  # products with the Hessian so far
    bound: DualBound | None = None  # the best that was proven at a stationary point so far
    is_stationary: bool = False  # whether the next step proves a bound or climbs
    is_solved: bool = False  # whether the value is proven to be the relaxation's optimum, within the gap
    stalled: bool = False  # whether the last step could neither prove nor climb


@dataclass(frozen=True)
class Staircase:
    """SE-Sync: Riemannian trust region on St(d, r)^n, dual certificate, escape to rank r + 1 (Rosen et al. 2019).

    A step is one trust-region iteration or, at a stationary point, the certificate and the climb to the next rank.
    `primal_residual` is what rounding to poses loses, (F - f) / F, and 0 at rank d; `dual_residual` is the
    decrement of `StaircaseState`. When it has converged, f is the optimum of the relaxation, within the gap: F of the
    poses can still be above it, where the relaxation is not tight.

    `tolerance` is on the decrement, at which a point counts as stationary, `gap` is the relative one between f and the
    bound that is proven at the end; a trust-region step has at most `max_inner_iterations` of conjugate gradients.
    """

    tolerance: float = STATIONARY_DECREMENT
    gap: float = DEFAULT_GAP
    max_iterations: int = 300
    max_inner_iterations: int = 1000

    def __post_init__(self) -> None:
        check_settings(self, positive=["tolerance", "gap"])
        check_settings(self, not_negative=["max_iterations"], at_least_one=["max_inner_iterations"])

    def init(self, problem: PGOProblem, start: Poses | None) -> StaircaseState:
        """State 0: rank d, at the rotations of `start`, or of the chordal relaxation."""
        problem.check_quadratic("the staircase")
        poses = start if start is not None else chordal_start(problem)
        problem.stacked(poses)
        rotation_diagonal = problem.M.data[problem.diagonal_positions[problem.num_poses :]]
        shift = _SHIFT * float(rotation_diagonal.mean())
        no_multipliers = np.zeros((problem.num_poses, problem.d, problem.d))
        preconditioner = factorize_certificate(problem, no_multipliers, shift)
        level = rounding_level(problem, problem.with_best_translations(poses.R))
        return self._arrive(problem, 0, lifted_point(problem, np.swapaxes(poses.R, 1, 2)), preconditioner, level)

    def step(self, problem: PGOProblem, state: StaircaseState) -> StaircaseState:
        """One trust-region iteration; at a stationary point the certificate and, if it fails, the climb."""
        if state.is_solved or state.stalled:
            return replace(state, k=state.k + 1)
        return self._climb(problem, state) if state.is_stationary else self._descend(problem, state)

    def measure(self, problem: PGOProblem, state: StaircaseState) -> Measurement:
        """F of the rounded poses, what rounding loses, and the decrement."""
        objective = problem.objective(self.poses(problem, state))
        lost = 0.0
        if state.point.rank > problem.d:
            lost = max(objective - state.point.value, 0.0) / max(objective, state.rounding_level)
        return Measurement(objective, lost, state.decrement)

    def poses(self, problem: PGOProblem, state: StaircaseState) -> Poses:
        """Y rounded to rotations, and the best translations for them."""
        return round_factor(problem, state.point.Y)[0]

    def converged(self, state: StaircaseState, measurement: Measurement) -> Status | None:
        """CONVERGED when the relaxation is solved; STALLED when no way down is found from where it is not."""
        if state.is_solved:
            return Status.CONVERGED
        return Status.STALLED if state.stalled else None

    def _descend(self, problem: PGOProblem, state: StaircaseState) -> StaircaseState:
        """One iteration of the trust region (Absil, Mahony & Sepulchre, algorithm 10)."""
        point, scale = state.point, max(state.point.value, state.rounding_level)
        trial = truncated_conjugate_gradients(
            point.gradient,
            partial(hessian_product, problem, point),
            partial(_precondition, problem, state.preconditioner, point.Y),
            state.radius,
            min(_FORCING, math.sqrt(state.decrement)),
            4.0 * scale * _FLOOR * self.tolerance,
            self.max_inner_iterations,
        )
        spent = state.inner_iterations + trial.iterations
        longest = float(np.linalg.norm(trial.step, axis=(1, 2)).max())
        if not longest <= _LONGEST:
            radius = trial.length / longest if np.isfinite(longest) else _SHRINK * state.radius
            return replace(state, k=state.k + 1, radius=radius, inner_iterations=spent)
        candidate = lifted_point(problem, retract(point.Y, trial.step))
        # Near the end both decreases are below rounding, and their ratio is made to tend to one (Conn et al., 17.4.2).
        rounding = ROUNDING * scale + state.rounding_level
        ratio = (point.value - candidate.value + rounding) / (trial.decrease + rounding)
        radius = state.radius
        if not ratio >= _POOR:
            radius = min(_SHRINK, 1.0 / max(1.0, longest)) * trial.length
        elif ratio > _GOOD and trial.is_at_boundary:
            radius = _GROW * radius
        if not ratio > _ACCEPTED:
            # Nothing to gain that double precision can see.
            stuck = trial.decrease <= rounding
            return replace(state, k=state.k + 1, radius=radius, inner_iterations=spent, is_stationary=stuck)
        arrived = self._arrive(problem, state.k + 1, candidate, state.preconditioner, state.rounding_level)
        stuck = trial.decrease <= rounding and arrived.decrement > 0.5 * state.decrement
        stuck = stuck or arrived.is_stationary
        return replace(arrived, radius=radius, inner_iterations=spent, bound=state.bound, is_stationary=stuck)

    def _climb(self, problem: PGOProblem, state: StaircaseState) -> StaircaseState:
        """Prove that the relaxation is solved, or leave along the eigenvector that shows it is not."""
        point, eta = state.point, smallest_shift(self.gap, state.point.value, problem.num_poses * problem.d)
        if point.value <= state.rounding_level:
            return replace(state, k=state.k + 1, bound=DualBound(NO_BOUND, point.Lambda), is_solved=True)
        at_poses = self.poses(problem, state) if point.rank == problem.d else None
        proven = best_bound(problem, point.Lambda, at_poses, self.gap, point.value)
        bound = state.bound
        if bound is None or proven.value > bound.lower_bound:
            bound = DualBound(proven, point.Lambda)
        if proven.eta <= eta:
            return replace(state, k=state.k + 1, bound=bound, is_solved=True)
        found = negative_curvature(problem, point.Lambda, eta, np.random.default_rng(state.k))
        if found.value >= -eta:  # what the proof lacks is precision, not a way down
            return replace(state, k=state.k + 1, bound=bound, is_solved=True)
        below = _escape(problem, point, found, state.rounding_level)
        if below is None:
            return replace(state, k=state.k + 1, bound=bound, stalled=True)
        # S with the smallest definite shift is nearer to the Hessian than Q, and the nearer the less there is to climb.
        arrived = self._arrive(problem, state.k + 1, below, found.factor, state.rounding_level)
        return replace(arrived, inner_iterations=state.inner_iterations, bound=bound)

    def _arrive(
        self, problem: PGOProblem, k: int, point: LiftedPoint, preconditioner: CholeskyFactor, level: float
    ) -> StaircaseState:
        """State at a point, with the first radius of a rank."""
        squared = inner(point.gradient, _precondition(problem, preconditioner, point.Y, point.gradient))
        # An F below its rounding level is zero, whatever the gradient of its rounding is relative to it.
        decrement = scaled_decrement(0.5 * squared, point.value, level) if point.value > level else 0.0
        radius, is_stationary = _FIRST_RADIUS * math.sqrt(max(squared, 0.0)), decrement <= self.tolerance
        return StaircaseState(k, point, preconditioner, decrement, radius, level, is_stationary=is_stationary)


def _precondition(problem: PGOProblem, factor: CholeskyFactor, Y: Array, V: Array) -> Array:
    """P (Q + eps I)^-1 V for V tangent at Y, P the projection to the tangent space; after a climb, with S for Q."""
    n, d, r = V.shape
    right_hand_side = np.zeros((problem.side, r))
    right_hand_side[n:] = V.reshape(n * d, r)
    return project_to_tangent(Y, factor.solve(right_hand_side)[n:].reshape(n, d, r))


def _escape(problem: PGOProblem, point: LiftedPoint, found: NegativeCurvature, level: float) -> LiftedPoint | None:
    """First of the moves s v, s v/2, .. in a new column of Y that lowers f enough; None when none does.

    The block of v that is largest turns by 45 degrees at first. To second order f falls by s^2 |value|.
    """
    Y, column = append_rank(point.Y), append_rank(np.zeros_like(point.Y), found.v)
    length = 1.0 / float(np.linalg.norm(found.v, axis=1).max())
    for _ in range(HALVINGS):
        promised = -(length**2) * found.value
        if promised <= ROUNDING * point.value + level:
            return None
        candidate = lifted_point(problem, retract(Y, length * column))
        if candidate.value <= point.value - SUFFICIENT * promised:
            return candidate
        length *= 0.5
    return None
