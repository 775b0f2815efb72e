"""Second stage: damped Riemannian Newton, or Gauss-Newton, with sparse Cholesky; F never rises (paper: after SOC)."""

from dataclasses import dataclass

from pgo_models.certificates.newton_polish import STATIONARY_DECREMENT, PolishState, polish_step, start_polish
from pgo_models.errors import check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from solvers.result import Measurement, Status

SMALL = 1000  # poses in space


@dataclass(frozen=True, eq=False)
class NewtonState:
    """State k: the poses and factorisations of `pgo_models.certificates.newton_polish`."""

    k: int
    polish: PolishState


@dataclass(frozen=True)
class Newton:
    """Riemannian Newton on SE(d)^n (`pgo_models.certificates.newton_polish`), one factorisation a step.

    `dual_residual` is the relative Newton decrement: half its square, less the rounding level of F, over F.

    `tolerance` is on it: about the relative decrease of F that is left. Without `second_order` it is Gauss-Newton, the
    second layer of the paper's method. With `secants` moves with one factorisation learn from those before (L-BFGS);
    robots do without, as each learned one would cost them a reduction.
    """

    tolerance: float = STATIONARY_DECREMENT
    max_iterations: int = 100
    second_order: bool = True
    secants: bool = True

    def __post_init__(self) -> None:
        check_settings(self, positive=["tolerance"], not_negative=["max_iterations"])

    def init(self, problem: PGOProblem, start: Poses | None) -> NewtonState:
        """State 0: `start`, or the chordal relaxation."""
        poses, share = start if start is not None else chordal_start(problem), self.tolerance / STATIONARY_DECREMENT
        return NewtonState(0, start_polish(problem, poses, share))

    def step(self, problem: PGOProblem, state: NewtonState) -> NewtonState:
        """One factorisation and the moves it serves."""
        return NewtonState(state.k + 1, polish_step(problem, state.polish, self.second_order, self.secants))

    def measure(self, problem: PGOProblem, state: NewtonState) -> Measurement:
        """F and the relative decrement."""
        return Measurement(state.polish.objective, 0.0, state.polish.decrement)

    def poses(self, problem: PGOProblem, state: NewtonState) -> Poses:
        """Poses of the state."""
        return state.polish.poses

    def converged(self, state: NewtonState, measurement: Measurement) -> Status | None:
        """CONVERGED within tolerance or where the gradient is rounding; STALLED when the last step could not move."""
        if state.polish.is_stationary:
            return Status.CONVERGED
        return None if state.polish.moved else Status.STALLED


def gauss_newton(max_iterations: int = Newton.max_iterations) -> Newton:
    """Newton with the Gauss-Newton matrix instead of the Hessian.

    Examples
    --------
    >>> gauss_newton().second_order
    False
    """
    return Newton(max_iterations=max_iterations, second_order=False, secants=False)


def needs_no_soc(problem: PGOProblem) -> bool:
    """Whether Newton alone is faster from the chordal start: in the plane, where its matrix is no larger than SOC's."""
    return problem.d == 2 or problem.num_poses <= SMALL
