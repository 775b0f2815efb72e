"""Levenberg-Marquardt on SE(d)^n: Gauss-Newton with a damping that the actual decrease controls.

The baseline of g2o and GTSAM, with the damping rule of Nielsen (Madsen, Nielsen & Tingleff 2004,
Methods for Non-Linear Least Squares Problems, algorithm 3.16) and the scaling of Marquardt (1963):
rotations and translations differ in units.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import csc_array

from pgo_models.certificates.rounding_errors import rounding_level
from pgo_models.errors import NotPositiveDefiniteError, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.problem.cholesky import SymbolicCholesky, analyze
from pgo_models.problem.hessian import TangentLayout, ground_pose, riemannian_hessian, tangent_order
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.matrices import inner
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.stationarity import STATIONARY_DECREMENT
from pgo_models.summaries import Summarised
from solvers.result import Measurement, Status
from solvers.riemannian.newton_step import scaled_decrement

_SMALLEST_FACTOR = 1.0 / 3.0  # on the damping, after a step that the model predicted well
_GROWTH = 2.0  # of the damping after a refused step; it doubles with each refusal in a row
_FIRST_DAMPING = 1e-3  # relative to the diagonal of the Gauss-Newton matrix
# Shares of the diagonal. Less damping changes no digit of the matrix; more leaves no step.
_MIN_DAMPING = 1e-15
_MAX_DAMPING = 1e15
_TRUSTED_DAMPING = 1e-4  # above it the decrement is that of the damping, not of F
_ROUNDING = 1e-14  # relative change of F that counts as none


@dataclass(frozen=True, eq=False)
class LevenbergMarquardtState(Summarised):
    """Iterate k, and the next step."""

    k: int
    poses: Poses
    objective: float  # F there
    level: float  # rounding level of F
    matrix: csc_array  # (side, side): A, the Gauss-Newton matrix at the poses, pose 0 grounded
    gradient: Array  # (side,): g, the gradient of F
    analysis: SymbolicCholesky  # ordering and pattern of the factor
    damping: float  # mu of the next step, which solves (A + mu diag(A)) h = -g
    growth: float  # factor on mu if that step is refused
    # (side,): h, nan where the damped matrix has no Cholesky factor
    step: Array = field(default_factory=lambda: np.empty(0))
    decrement: float = math.inf  # -<g, h> / 2, less the rounding level of F, over F


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Levenberg-Marquardt on the full poses: one factorisation a step, and F never rises.

    `dual_residual` is the relative decrement of the damped step: half of -<g, h>, less the rounding
    level of F, over F. Damping follows Madsen, Nielsen & Tingleff, Methods for non-linear least
    squares problems, 2004.

    Examples
    --------
    >>> import pgo_models as pgo
    >>> from solvers import run
    >>> run(LevenbergMarquardt(), pgo.PGOProblem(pgo.load("grid"))).status.name
    'CONVERGED'
    """

    tolerance: float = STATIONARY_DECREMENT  # on the decrement, once the damping is small
    max_iterations: int = 200  # refused steps count

    def __post_init__(self) -> None:
        check_settings(self, positive=["tolerance"], not_negative=["max_iterations"])

    def init(self, problem: PGOProblem, start: Poses | None) -> LevenbergMarquardtState:
        """State 0: `start`, or the chordal relaxation."""
        poses = start if start is not None else chordal_start(problem)
        return _linearized(problem, 0, poses, problem.objective(poses), _FIRST_DAMPING)

    def step(self, problem: PGOProblem, state: LevenbergMarquardtState) -> LevenbergMarquardtState:
        """Take the step if F falls, and set the damping by how well the model predicted it."""
        ratio, candidate, objective = self._tried(problem, state)
        if not ratio > 0:
            damping = min(state.growth * state.damping, _MAX_DAMPING)
            growth = _GROWTH * state.growth
            return _with_step(replace(state, k=state.k + 1, damping=damping, growth=growth))
        factor = max(_SMALLEST_FACTOR, 1.0 - (2.0 * min(ratio, 1.0) - 1.0) ** 3)
        damping = max(factor * state.damping, _MIN_DAMPING)
        return _linearized(problem, state.k + 1, candidate, objective, damping, state.analysis)

    def measure(self, problem: PGOProblem, state: LevenbergMarquardtState) -> Measurement:
        """F and the relative decrement."""
        return Measurement(state.objective, 0.0, state.decrement)

    def poses(self, problem: PGOProblem, state: LevenbergMarquardtState) -> Poses:
        """Return the poses of a state."""
        return state.poses

    def converged(self, state: LevenbergMarquardtState, measurement: Measurement) -> Status | None:
        """CONVERGED within tolerance under a small damping; STALLED at the largest damping."""
        if measurement.dual_residual <= self.tolerance and state.damping <= _TRUSTED_DAMPING:
            return Status.CONVERGED
        return Status.STALLED if state.damping >= _MAX_DAMPING else None

    def _tried(
        self, problem: PGOProblem, state: LevenbergMarquardtState
    ) -> tuple[float, Poses, float]:
        """Ratio of actual to predicted decrease, and the poses after the step with their F."""
        if not np.isfinite(state.step).all():
            return -math.inf, state.poses, state.objective
        w, v = TangentLayout(problem.num_poses, problem.d).split(state.step)
        poses = state.poses.moved_along(w, v)
        objective = problem.objective(poses)
        actual = state.objective - objective
        damped = state.damping * inner(state.step, state.matrix.diagonal() * state.step)
        predicted = 0.5 * (damped - inner(state.gradient, state.step))
        # Below the rounding of F both decreases are noise, and their ratio is made to tend to one.
        rounding = _ROUNDING * state.objective + state.level
        return (actual + rounding) / (predicted + rounding), poses, objective


def _linearized(
    problem: PGOProblem,
    k: int,
    poses: Poses,
    objective: float,
    mu: float,
    analysis: SymbolicCholesky | None = None,
) -> LevenbergMarquardtState:
    matrix = riemannian_hessian(problem.at(poses), None)
    layout = TangentLayout(problem.num_poses, problem.d)
    ground_pose(matrix, layout)
    gradient = layout.join(*problem.riemannian_gradient(poses))
    if analysis is None:
        analysis = analyze(matrix, problem.backend, tangent_order(problem))
    state = LevenbergMarquardtState(
        k=k,
        poses=poses,
        objective=objective,
        level=rounding_level(problem, poses),
        matrix=matrix,
        gradient=gradient,
        analysis=analysis,
        damping=mu,
        growth=_GROWTH,
    )
    return _with_step(state)


def _with_step(state: LevenbergMarquardtState) -> LevenbergMarquardtState:
    """The state with the step that its damping gives."""
    damped = state.matrix.copy()
    damped.setdiag((1.0 + state.damping) * state.matrix.diagonal())
    try:
        step = -state.analysis.factorize(damped).solve(state.gradient)
    except NotPositiveDefiniteError:
        return replace(state, step=np.full_like(state.gradient, np.nan), decrement=math.inf)
    squared_decrement = -inner(state.gradient, step)
    decrement = scaled_decrement(squared_decrement, state.objective, state.level)
    return replace(state, step=step, decrement=decrement)
