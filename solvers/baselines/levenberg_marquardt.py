"""Levenberg-Marquardt on SE(d)^n: the Gauss-Newton matrix with a damping that the actual decrease steers.

The baseline of g2o and GTSAM, with the damping rule of Nielsen (Madsen, Nielsen & Tingleff 2004, Methods for Non-Linear
Least Squares Problems, algorithm 3.16) and the scaling of Marquardt (1963): rotations and translations differ in units.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import csc_array

from pgo_models.certificates.newton_polish import STATIONARY_DECREMENT, ground_pose, move_poses, scaled_decrement
from pgo_models.certificates.rounding_errors import rounding_level
from pgo_models.errors import NotPositiveDefiniteError, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.problem.cholesky import SymbolicCholesky, analyze
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian, tangent_order
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.matrices import inner
from pgo_models.problem.problem import PGOProblem
from solvers.result import Measurement, Status

_SMALLEST_FACTOR = 1.0 / 3.0  # of the damping, after a step that the model foresaw
_GROWTH = 2.0  # of the damping after the first step that was refused in a row; squared after the second, and so on
_DAMPING_LIMITS = 1e-15, 1e15
_TRUSTED_DAMPING = 1e-4  # above, the decrement is that of the damping, not of F
_ROUNDING = 1e-14  # relative change of F that is not told apart from none


@dataclass(frozen=True, eq=False)
class LevenbergMarquardtState:
    """State k."""

    k: int
    poses: Poses
    objective: float  # F
    level: float  # its rounding level
    matrix: csc_array  # A, the Gauss-Newton matrix at the poses, pose 0 grounded
    gradient: Array
    analysis: SymbolicCholesky
    damping: float  # mu, of the next step: it solves (A + mu diag(A)) h = -g
    growth: float  # factor on mu if that step is refused
    # h, nan where the matrix with this damping has no Cholesky factor.
    step: Array = field(default_factory=lambda: np.empty(0))
    decrement: float = math.inf  # -<g, h> / 2, less the rounding level of F, over F


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Levenberg-Marquardt on the full poses, one factorisation a step, F never rises.

    `dual_residual` is the relative decrement of the damped step: half of -<g, h>, less the rounding level of F, over F.
    """

    tolerance: float = STATIONARY_DECREMENT  # on the decrement, once the damping is small
    max_iterations: int = 200  # refused steps count
    damping: float = 1e-3  # first mu, relative to the diagonal of the Gauss-Newton matrix

    def __post_init__(self) -> None:
        check_settings(self, positive=["tolerance", "damping"], not_negative=["max_iterations"])

    def init(self, problem: PGOProblem, start: Poses | None) -> LevenbergMarquardtState:
        """State 0: `start`, or the chordal relaxation."""
        poses = start if start is not None else chordal_start(problem)
        return _linearized(problem, 0, poses, problem.objective(poses), self.damping)

    def step(self, problem: PGOProblem, state: LevenbergMarquardtState) -> LevenbergMarquardtState:
        """Take the step if F falls, and set the damping by how well the model foresaw it."""
        ratio, candidate, objective = self._tried(problem, state)
        if not ratio > 0:
            damping = min(state.growth * state.damping, _DAMPING_LIMITS[1])
            return _with_step(replace(state, k=state.k + 1, damping=damping, growth=_GROWTH * state.growth))
        factor = max(_SMALLEST_FACTOR, 1.0 - (2.0 * min(ratio, 1.0) - 1.0) ** 3)
        damping = max(factor * state.damping, _DAMPING_LIMITS[0])
        return _linearized(problem, state.k + 1, candidate, objective, damping, state.analysis)

    def measure(self, problem: PGOProblem, state: LevenbergMarquardtState) -> Measurement:
        """F and the relative decrement."""
        return Measurement(state.objective, 0.0, state.decrement)

    def poses(self, problem: PGOProblem, state: LevenbergMarquardtState) -> Poses:
        """Poses of the state."""
        return state.poses

    def converged(self, state: LevenbergMarquardtState, measurement: Measurement) -> Status | None:
        """CONVERGED within tolerance under a small damping; STALLED when no damping is large enough."""
        if measurement.dual_residual <= self.tolerance and state.damping <= _TRUSTED_DAMPING:
            return Status.CONVERGED
        return Status.STALLED if state.damping >= _DAMPING_LIMITS[1] else None

    def _tried(self, problem: PGOProblem, state: LevenbergMarquardtState) -> tuple[float, Poses, float]:
        """Ratio of actual to foreseen decrease, and the poses after the step with their F."""
        if not np.isfinite(state.step).all():
            return -math.inf, state.poses, state.objective
        poses = move_poses(state.poses, *TangentLayout(problem.num_poses, problem.d).split(state.step))
        objective = problem.objective(poses)
        damped = state.damping * inner(state.step, state.matrix.diagonal() * state.step)
        foreseen = 0.5 * (damped - inner(state.gradient, state.step))
        # Below the rounding of F both decreases are noise, and their ratio is made to tend to one.
        rounding = _ROUNDING * state.objective + state.level
        return (state.objective - objective + rounding) / (foreseen + rounding), poses, objective


def _linearized(
    problem: PGOProblem, k: int, poses: Poses, objective: float, mu: float, analysis: SymbolicCholesky | None = None
) -> LevenbergMarquardtState:
    matrix = riemannian_hessian(problem, poses, None)
    ground_pose(matrix, problem)
    gradient = TangentLayout(problem.num_poses, problem.d).join(*problem.riemannian_gradient(poses))
    analysis = analysis if analysis is not None else analyze(matrix, problem.backend, tangent_order(problem))
    level = rounding_level(problem, poses)
    return _with_step(LevenbergMarquardtState(k, poses, objective, level, matrix, gradient, analysis, mu, _GROWTH))


def _with_step(state: LevenbergMarquardtState) -> LevenbergMarquardtState:
    damped = state.matrix.copy()
    damped.setdiag((1.0 + state.damping) * state.matrix.diagonal())
    try:
        step = -state.analysis.factorize(damped).solve(state.gradient)
    except NotPositiveDefiniteError:
        return replace(state, step=np.full_like(state.gradient, np.nan), decrement=math.inf)
    foreseen = -inner(state.gradient, step)
    return replace(state, step=step, decrement=scaled_decrement(foreseen, state.objective, state.level))
