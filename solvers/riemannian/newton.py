"""Second stage, after SOC: damped Riemannian Newton, or Gauss-Newton, with sparse Cholesky.

F never rises but by rounding.
"""

from dataclasses import dataclass

from pgo_models.errors import check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.stationarity import STATIONARY_DECREMENT
from pgo_models.summaries import Summarised
from solvers.carry.registry import record
from solvers.result import Measurement, Status
from solvers.riemannian.newton_step import NewtonFigures
from solvers.riemannian.polish import PolishState, polish_step, start_run


@dataclass(frozen=True, eq=False)
class NewtonState(Summarised):
    """State k: the poses and factorisations of `solvers.riemannian.polish`."""

    k: int
    polish: PolishState


@record("Newton")
@dataclass(frozen=True)
class Newton:
    """Riemannian Newton on SE(d)^n, one factorisation a step.

    `dual_residual` is the relative Newton decrement: half its square, less the rounding level of F,
    over F (`solvers.riemannian.newton_step`).

    Parameters
    ----------
    tolerance : float
        On `dual_residual`: about the relative decrease of F that is left.
    max_iterations : int
        Most factorisations.
    second_order : bool
        Whether the matrix is the Hessian; else it is Gauss-Newton, the second layer of the paper's
        method.

    References
    ----------
    P.-A. Absil, R. Mahony and R. Sepulchre, Optimization Algorithms on Matrix Manifolds, 2008,
    chapter 6.

    Examples
    --------
    >>> import numpy as np
    >>> from pgo_models import grid
    >>> from solvers import run
    >>> run(Newton(), grid(np.random.default_rng(0))).status.name
    'CONVERGED'
    """

    tolerance: float = STATIONARY_DECREMENT
    max_iterations: int = 100
    second_order: bool = True

    def __post_init__(self) -> None:
        check_settings(self, positive=["tolerance"], not_negative=["max_iterations"])

    @property
    def share(self) -> float:
        """How many times looser than usual the tolerance is."""
        return self.tolerance / STATIONARY_DECREMENT

    def init(self, problem: PGOProblem, start: Poses | None) -> NewtonState:
        """State 0: `start`, or the chordal relaxation; of chi2 with the best translations."""
        poses = start if start is not None else chordal_start(problem)
        return NewtonState(0, start_run(problem, poses, self.share))

    def step(self, problem: PGOProblem, state: NewtonState) -> NewtonState:
        """One factorisation and the moves it serves."""
        return NewtonState(state.k + 1, polish_step(problem, state.polish, self.second_order))

    def measure(self, problem: PGOProblem, state: NewtonState) -> Measurement:
        """F and the relative decrement."""
        return Measurement(state.polish.objective, 0.0, state.polish.decrement)

    def poses(self, problem: PGOProblem, state: NewtonState) -> Poses:
        """The poses of a state, whose F `measure` reports."""
        return state.polish.poses

    def converged(self, state: NewtonState, measurement: Measurement) -> Status | None:
        """As `newton_status` says."""
        return newton_status(state.polish)


def newton_status(figures: NewtonFigures) -> Status | None:
    """Ending of a run of Newton: CONVERGED within tolerance or where the gradient is rounding.

    STALLED when the last step could not move; None while it goes on.
    """
    if figures.is_stationary:
        return Status.CONVERGED
    return None if figures.moved else Status.STALLED


def gauss_newton() -> Newton:
    """Return Newton with the Gauss-Newton matrix instead of the Hessian.

    Examples
    --------
    >>> gauss_newton().second_order
    False
    """
    return Newton(second_order=False)
