"""Riemannian staircase: the semidefinite relaxation by its low-rank factor, rank by rank (SE-Sync).

min tr(Y^T Q Y) over Y in St(d, r)^n, translations marginalised in Q; where S has a negative
eigenvalue at a stationary point, its eigenvector in one more column of Y leads down (Rosen et al.
2019, algorithms 1 to 3; Boumal 2015).
"""

from dataclasses import dataclass, replace

import numpy as np

from pgo_models.certificates.certificate import DEFAULT_GAP
from pgo_models.certificates.dual_variables import factorize_certificate
from pgo_models.certificates.lower_bound import LowerBound, best_bound
from pgo_models.certificates.rounding_errors import rounding_level
from pgo_models.certificates.spectrum import negative_curvature
from pgo_models.errors import check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.geometry.stiefel import append_rank, project_to_tangent, retract
from pgo_models.problem.cholesky import CholeskyFactor
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.matrices import inner
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.stationarity import STATIONARY_DECREMENT
from pgo_models.relaxations.low_rank import LiftedPoint, hessian_product, lifted_point
from pgo_models.relaxations.rounding import round_factor
from pgo_models.summaries import Summarised
from solvers.result import Measurement, Status
from solvers.riemannian.climb import ClimbEnding, DualBound as DualBound, climb, staircase_status
from solvers.riemannian.newton_step import scaled_decrement
from solvers.riemannian.trust_region import Precision, first_radius, trust_region_step

# of the mean diagonal entry of M over the rotations: makes Q, which is singular, definite
_SHIFT = 1e-6


@dataclass(frozen=True, eq=False)
class StaircaseState(Summarised):
    """State k."""

    k: int
    point: LiftedPoint  # Y, its rank, the relaxation's value, multipliers and gradient
    # Of M + eps blockdiag(0, I), whose solves on the rotations are those with Q + eps I; after a
    # climb, of S with a shift.
    preconditioner: CholeskyFactor
    # <g, P g> / 4, less the rounding level of f, over f, g the gradient and P the preconditioner
    # projected to the tangent space: half the squared Newton decrement if the Hessian were twice
    # the preconditioner's matrix.
    decrement: float
    radius: float  # of the trust region, in the preconditioner's norm
    rounding_level: float  # f below it cannot be told from zero; that of the start
    bound: DualBound | None = None  # the best that was proven at a stationary point so far
    is_stationary: bool = False  # whether the next step proves a bound or climbs
    # whether the value is proven to be the relaxation's optimum, within the gap
    is_solved: bool = False
    stalled: bool = False  # whether the last step could neither prove nor climb


@dataclass(frozen=True)
class Staircase:
    """SE-Sync: Riemannian trust region on St(d, r)^n, dual certificate, escape to rank r + 1.

    A step is one trust-region iteration or, at a stationary point, the certificate and the climb to
    the next rank. `primal_residual` is what rounding to poses loses, (F - f) / F, and 0 at rank d;
    `dual_residual` is the decrement of `StaircaseState`. When it has converged, f is the optimum of
    the relaxation, within the gap: F of the poses can still be above it, where the relaxation is
    not tight.

    Parameters
    ----------
    tolerance : float
        On the decrement, at which a point counts as stationary.
    gap : float
        Relative gap between f and the bound that is proven at the end.
    max_iterations : int
        Most steps.

    References
    ----------
    D. Rosen, L. Carlone, A. Bandeira and J. Leonard, SE-Sync: A certifiably correct algorithm for
    synchronization over the special Euclidean group, IJRR 38, 2019.

    Examples
    --------
    >>> import numpy as np
    >>> from pgo_models import grid
    >>> from solvers import run
    >>> run(Staircase(), grid(np.random.default_rng(0))).status.name
    'CONVERGED'
    """

    tolerance: float = STATIONARY_DECREMENT
    gap: float = DEFAULT_GAP
    max_iterations: int = 300

    def __post_init__(self) -> None:
        check_settings(self, positive=["tolerance", "gap"], not_negative=["max_iterations"])

    def init(self, problem: PGOProblem, start: Poses | None) -> StaircaseState:
        """State 0: rank d, at the rotations of `start`, or of the chordal relaxation."""
        problem.check_quadratic("the staircase")
        poses = start if start is not None else chordal_start(problem)
        rotation_diagonal = problem.M.data[problem.diagonal_positions[problem.num_poses :]]
        shift = _SHIFT * float(rotation_diagonal.mean())
        no_multipliers = np.zeros((problem.num_poses, problem.d, problem.d))
        preconditioner = factorize_certificate(problem, no_multipliers, shift)
        level = rounding_level(problem, problem.with_best_translations(poses.R))
        point = lifted_point(problem, np.swapaxes(poses.R, 1, 2))
        return self._arrive(problem, 0, point, preconditioner, level)

    def step(self, problem: PGOProblem, state: StaircaseState) -> StaircaseState:
        """One trust-region iteration; at a stationary point the certificate or the climb."""
        if state.is_solved or state.stalled:
            return replace(state, k=state.k + 1)
        if state.is_stationary:
            return self._climb(problem, state)
        return self._descend(problem, state)

    def measure(self, problem: PGOProblem, state: StaircaseState) -> Measurement:
        """F of the rounded poses, what rounding loses, and the decrement."""
        objective = problem.objective(self.poses(problem, state))
        lost = 0.0
        if state.point.rank > problem.d:
            lost = max(objective - state.point.value, 0.0) / max(objective, state.rounding_level)
        return Measurement(objective, lost, state.decrement)

    def poses(self, problem: PGOProblem, state: StaircaseState) -> Poses:
        """Y rounded to rotations, with the best translations for them."""
        return round_factor(problem, state.point.Y)[0]

    def converged(self, state: StaircaseState, measurement: Measurement) -> Status | None:
        """As `staircase_status` says."""
        return staircase_status(state.is_solved, state.stalled)

    def _descend(self, problem: PGOProblem, state: StaircaseState) -> StaircaseState:
        """One iteration of the trust region."""
        point = state.point
        precision = Precision.at(point.value, state.decrement, self.tolerance, state.rounding_level)
        function = _LiftedCost(problem, state.preconditioner)
        step = trust_region_step(function, point, state.radius, precision)
        if step.point is None:
            # Below rounding there is nothing to gain that double precision can see.
            return replace(
                state, k=state.k + 1, radius=step.radius, is_stationary=step.is_below_rounding
            )
        arrived = self._arrive(
            problem, state.k + 1, step.point, state.preconditioner, state.rounding_level
        )
        is_stuck = step.is_below_rounding and arrived.decrement > 0.5 * state.decrement
        return replace(
            arrived,
            radius=step.radius,
            bound=state.bound,
            is_stationary=is_stuck or arrived.is_stationary,
        )

    def _climb(self, problem: PGOProblem, state: StaircaseState) -> StaircaseState:
        """Prove that the relaxation is solved, or leave for the next rank."""
        rng = np.random.default_rng(state.k)
        algebra = CentralClimb(problem, state.point, state.rounding_level, rng)
        climbed = climb(algebra, self.gap, state.bound)
        if climbed.direction is None or climbed.point is None:
            return replace(
                state,
                k=state.k + 1,
                bound=climbed.bound,
                is_solved=climbed.ending is ClimbEnding.SOLVED,
                stalled=climbed.ending is ClimbEnding.STALLED,
            )
        # S with the smallest definite shift is nearer to the Hessian than Q, and the nearer the
        # less there is to climb.
        preconditioner = climbed.direction.factor
        arrived = self._arrive(
            problem, state.k + 1, climbed.point, preconditioner, state.rounding_level
        )
        return replace(arrived, bound=climbed.bound)

    def _arrive(
        self,
        problem: PGOProblem,
        k: int,
        point: LiftedPoint,
        preconditioner: CholeskyFactor,
        level: float,
    ) -> StaircaseState:
        """State at a point, with the first radius of a rank."""
        preconditioned = precondition(problem, preconditioner, point.Y, point.gradient)
        squared = inner(point.gradient, preconditioned)
        # An F below its rounding level is zero, whatever the gradient of its rounding is relative
        # to it.
        decrement = 0.0
        if point.value > level:
            decrement = scaled_decrement(0.5 * squared, point.value, level)
        return StaircaseState(
            k=k,
            point=point,
            preconditioner=preconditioner,
            decrement=decrement,
            radius=first_radius(squared),
            rounding_level=level,
            is_stationary=decrement <= self.tolerance,
        )


@dataclass(frozen=True, eq=False)
class _LiftedCost:
    """f(Y), as a function for the trust region."""

    problem: PGOProblem
    preconditioner: CholeskyFactor

    def evaluate(self, Y: Array) -> LiftedPoint:
        """Return the point Y with value and gradient."""
        return lifted_point(self.problem, Y)

    def hessian_product(self, point: LiftedPoint, V: Array) -> Array:
        """Apply the Riemannian Hessian at a point to a tangent."""
        return hessian_product(self.problem, point, V)

    def precondition(self, point: LiftedPoint, V: Array) -> Array:
        """Apply the preconditioner to a tangent."""
        return precondition(self.problem, self.preconditioner, point.Y, V)


def precondition(problem: PGOProblem, factor: CholeskyFactor, Y: Array, V: Array) -> Array:
    """Apply P (Q + eps I)^-1 to V tangent at Y, with P the projection to the tangent space.

    After a climb it is with S for Q.
    """
    n, d, r = V.shape
    right_hand_side = np.zeros((problem.side, r))
    right_hand_side[n:] = V.reshape(n * d, r)
    return project_to_tangent(Y, factor.solve(right_hand_side)[n:].reshape(n, d, r))


@dataclass(frozen=True, eq=False)
class EscapeDirection:
    """`climb.ClimbDirection` in one place."""

    value: float
    first_length: float
    column: Array  # (n, d, r + 1): v in the last column, zero elsewhere
    factor: CholeskyFactor  # of S with the smallest definite shift


@dataclass(frozen=True, eq=False)
class CentralClimb:
    """`climb.ClimbAlgebra` in one place; `rng` draws the first Lanczos vector."""

    problem: PGOProblem
    point: LiftedPoint
    rounding_level: float
    rng: np.random.Generator

    @property
    def objective(self) -> float:
        """Value f at the point."""
        return self.point.value

    @property
    def num_rows(self) -> int:
        """Number of rows of the rotations, n d."""
        return self.problem.num_poses * self.problem.d

    @property
    def has_room(self) -> bool:
        """Whether the next rank fits into memory: always."""
        return True

    def prove(self, gap: float) -> LowerBound:
        """Return the best bound, at rank d grounded at a pose."""
        problem = self.problem
        point = self.point
        poses = round_factor(problem, point.Y)[0] if point.rank == problem.d else None
        return best_bound(problem, point.Lambda, poses, gap, point.value)

    def with_multipliers(self, bound: LowerBound) -> DualBound:
        """Return a bound with the multipliers at the point."""
        return DualBound(bound, self.point.Lambda)

    def direction(self, proven: LowerBound, smallest: float) -> EscapeDirection:
        """Return the direction of the smallest eigenvalue, by Lanczos."""
        point = self.point
        return escape_direction(self.problem, point.Lambda, point.Y, smallest, self.rng)

    def evaluate(self, direction: EscapeDirection, length: float) -> tuple[float, LiftedPoint]:
        """Return f after a move along the direction, and the point there."""
        Y = retract(append_rank(self.point.Y), length * direction.column)
        candidate = lifted_point(self.problem, Y)
        return candidate.value, candidate

    def accept(self, trial: LiftedPoint) -> None:
        """Do nothing: the caller has the point."""


def escape_direction(
    problem: PGOProblem, Lambda: Array, Y: Array, smallest: float, rng: np.random.Generator
) -> EscapeDirection:
    """Direction of the smallest eigenvalue of Q - blockdiag(Lambda), which is below -`smallest`."""
    curvature = negative_curvature(problem, Lambda, smallest, rng)
    column = append_rank(np.zeros_like(Y), curvature.v)
    length = 1.0 / float(np.linalg.norm(curvature.v, axis=1).max())  # that of 45 degrees
    return EscapeDirection(curvature.value, length, column, curvature.factor)
