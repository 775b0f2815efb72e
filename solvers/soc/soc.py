"""SOC, splitting of orthogonality constraints: the paper's Algorithm 1 (`algo1: SOC`).

Every rotation R_i has a copy omega_i that carries the constraint, and a scaled multiplier B_i. One
iteration is

    (a) R-step      x     = argmin_R min_t  f(R, t) + 1/2 sum_i rho_i ||R_i - omega_i + B_i||_F^2
    (b) projection  omega = the rotations nearest to x + B
    (c) Bregman     B     = B + x - omega

f is the cost F. Step (a) is a convex quadratic program over all translations t_i and all d x d
matrices R_i, which need not be rotations; step (b) is an SVD for every pose. `Joint.step` is one
iteration. What wraps it has files of its own:

- `anderson`: the acceleration, which moves x on before the projection;
- `penalty`: the rules that choose the penalties rho;
- `safeguard`: when rho changes during a run, and when the recursion returns to its best iterate.

The coupling CONSENSUS, in which robots hold copies of their neighbours' poses, is `consensus`.

Ebrahimi & Deghat, Algorithm 1; Lai & Osher 2014.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pgo_models.certificates.dual_variables import multiplier_norms, multipliers
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations, stack_transposes
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.stationarity import rotation_scale
from solvers.result import Measurement
from solvers.soc.anderson import AndersonShare, AndersonSums, extrapolate, over_relax
from solvers.soc.consensus import LocalConsensus
from solvers.soc.r_step import JointStep, prepare_joint
from solvers.soc.recursion_block import squared_residuals, stationary_B
from solvers.soc.safeguard import Due, Steps, next_penalty
from solvers.soc.settings import SOCSettings


@dataclass(frozen=True, eq=False)
class SOCState(Steps):
    """Iterate k of JOINT: x, omega, B and rho of Algorithm 1, and what wraps them.

    The fields of `Steps` (k, residuals, merits) come on top of these.

    Parameters
    ----------
    x : (n, d, d) array
        Solution R of step (a), which is not orthogonal.
    omega : (n, d, d) array
        The rotations nearest to x + B, with x as the acceleration has moved it on and the B before
        this step; at k = 0 those of the start.
    B : (n, d, d) array
        Scaled multiplier of R = omega (Bregman variable); rho B is the unscaled one.
    rho : (n,) array
        Penalty of every pose.
    r_step : JointStep
        Back end of step (a), prepared for this rho.
    memory : AndersonShare
        Earlier steps, for the acceleration.
    best : (n, d, d) array or None
        The omega + B with the smallest merit, to which the safeguard returns.
    """

    x: Array
    omega: Array
    B: Array
    rho: Array
    r_step: JointStep
    memory: AndersonShare = field(default_factory=AndersonShare)
    best: Array | None = None


@dataclass(frozen=True)
class Joint:
    """Algorithm 1 on the whole graph, with one quadratic program; `soc` has the settings."""

    soc: SOCSettings

    def init(self, problem: PGOProblem, start: Poses) -> SOCState:
        """State 0: omega = the rotations of `start`, B = 0."""
        problem.stacked(start)  # raises unless the poses fit
        return self._state_at(problem, start, is_stationary=False)

    def step(self, problem: PGOProblem, state: SOCState) -> SOCState:
        """One iteration of Algorithm 1; `x_ahead` is x unless accelerated or over-relaxed."""
        state = self._with_due_penalty(problem, state)
        x = state.r_step.solve(state.omega - state.B)  # (a) R-step
        x_ahead, following = self._accelerated(state, x)
        if not np.isfinite(x_ahead).all():
            return replace(state.broken(), x=x)
        omega = project_to_rotations(x_ahead + state.B)  # (b) projection
        B = state.B + x_ahead - omega  # (c) Bregman update
        return self._with_residuals(state, replace(following, x=x, omega=omega, B=B))

    def measure(self, problem: PGOProblem, state: SOCState) -> Measurement:
        """F at omega with the best translations for it, and the residuals."""
        if math.isnan(state.primal_residual):
            return Measurement(np.nan, np.nan, np.nan)
        R = state.omega
        X = np.concatenate([problem.recover_translations(R), stack_transposes(R)])
        return state.measurement(problem.objective_stacked(X))

    def poses(self, problem: PGOProblem, state: SOCState) -> Poses:
        """Omega with the best translations for it."""
        return problem.with_best_translations(state.omega)

    # What wraps the step.

    def _accelerated(self, state: SOCState, x: Array) -> tuple[Array, SOCState]:
        """Return x moved on, and the state with what the acceleration remembers of this step.

        The recursion is a fixed-point iteration in s = omega + B: a plain step takes s to x + B, an
        over-relaxed or accelerated step to a combination of this and earlier steps. The merit of a
        step is the rho-norm of the over-relaxed change of s, alpha ||x - omega||_rho, with the
        omega before the step. The safeguard compares merits.
        """
        s = state.omega + state.B
        step = over_relax(x, state.omega, self.soc.alpha) - state.omega
        residual = np.sqrt(state.rho)[:, None, None] * step
        accelerated = extrapolate(
            self.soc.acceleration, state.memory, state.sums, residual, s + step
        )
        following = replace(
            state,
            sums=accelerated.sums,
            memory=accelerated.share,
            best=s if state.is_best(accelerated.merit) else state.best,
            merits=(*state.merits, accelerated.merit),
        )
        return accelerated.image - state.B, following

    def _with_residuals(self, before: SOCState, state: SOCState) -> SOCState:
        """Count the step, with residuals relative to ||omega||_rho = sqrt(d sum_i rho_i)."""
        rho = state.rho[:, None, None]
        squares = squared_residuals(state.x, state.omega, before.omega, rho, state.r_step.stiffness)
        size = math.sqrt(state.omega.shape[1] * float(state.rho.sum()))
        return state.with_residuals(squares, size)

    def _state_at(self, problem: PGOProblem, poses: Poses, is_stationary: bool) -> SOCState:
        """State 0 at poses, with B = 0, or with the B of a stationary point (`stationary_B`)."""
        Lambda = multipliers(problem, poses)
        norms = multiplier_norms(Lambda)
        scale = rotation_scale(problem)
        rho = self.soc.penalty_order(norms / scale, is_stationary).rho(norms, scale)
        B = stationary_B(poses.R, Lambda, rho) if is_stationary else np.zeros_like(poses.R)
        r_step = prepare_joint(problem, rho, self.soc.r_step)
        return SOCState(x=poses.R, omega=poses.R, B=B, rho=rho, r_step=r_step)

    def _with_due_penalty(self, problem: PGOProblem, state: SOCState) -> SOCState:
        """State with the penalty that the rule or the safeguard asks for; usually unchanged.

        RAISE goes back to the best iterate with a larger rho. REFRESH chooses rho and B anew from
        the multipliers at omega. RESCALE multiplies rho by a factor; it counts as a refresh.
        """
        due, factor = next_penalty(self.soc.penalty, state.rho / rotation_scale(problem), state)
        if due is Due.RAISE and state.best is not None:
            omega = project_to_rotations(state.best)
            at_best = replace(state, omega=omega, B=state.best - omega)
            return replace(self._rescaled(problem, at_best, factor), raises=state.raises + 1)
        if due is Due.REFRESH:
            poses = problem.with_best_translations(state.omega)
            return self._state_at(problem, poses, is_stationary=True).in_place_of(state)
        if due is Due.RESCALE:
            return replace(self._rescaled(problem, state, factor), refreshes=state.refreshes + 1)
        return state

    def _rescaled(self, problem: PGOProblem, state: SOCState, factor: float) -> SOCState:
        """State with factor * rho and the same rho B; its acceleration starts anew."""
        rho = factor * state.rho
        return replace(
            state,
            B=state.B / factor,
            rho=rho,
            r_step=prepare_joint(problem, rho, self.soc.r_step),
            memory=AndersonShare(),
            sums=AndersonSums(),
            merits=(),
        )


@dataclass(frozen=True)
class SOC(SOCSettings):
    """Splitting of orthogonality constraints (Ebrahimi & Deghat, Algorithm 1; Lai & Osher 2014).

    Parameters
    ----------
    coupling : Coupling or None
        Who solves step (a). Unless given, JOINT without `robots` and CONSENSUS with them.
        SUBSTRUCTURED has the iterates of JOINT: this class runs it as JOINT, and
        `solve(.., robots=..)` runs it on robots.
    robots : Partition or None
        Which robot owns which poses.
    penalty : MultiplierPenalty, FixedPenalty or BalancedPenalty
        Rule of the ADMM penalty rho.
    alpha : float in (0, 2)
        Over-relaxation; 1 is none.
    acceleration : Anderson or None
        Settings of the acceleration; None is the plain recursion.
    r_step : RStep or CustomRStep
        Back end of step (a).
    local_passes : int, at least 1
        Of CONSENSUS alone: how often a robot does (a) to (c) in a round; all but the last of them
        move only the poses that no other robot holds, and cost no message. 1 is the plain
        recursion.
    translation_penalty : float or None
        Of CONSENSUS alone: penalty of the translations of separators, the poses that several robots
        hold, as a multiple of their diagonal in M. Unless given, 0.6 times the stiffness of the
        separators, the inverse of their mean compliance (`solvers.soc.separator_stiffness`). It
        is lowered when the penalties are chosen anew, if the translations have moved far compared
        with the change of their multipliers.
    separator_penalty : float or None
        Of CONSENSUS alone: the least penalty of separator rotations under a MultiplierPenalty,
        times their mean diagonal in M. On graphs with little noise the multipliers alone would hold
        the copies too loosely together. Unless given, 0.7 times the square root of the translation
        penalty, at most 0.3.
    tolerance : float
        On the primal and on the dual residual, both relative.
    max_iterations : int
        Iterations at most.

    Raises
    ------
    SettingError
        If a setting is out of its range or does not go with the coupling.

    Notes
    -----
    CONVERGED means, for JOINT and SUBSTRUCTURED, that R agrees with omega and that omega has
    stopped moving, each within the tolerance in the norm of rho; F and the poses are those of omega
    with the best translations for it. For CONSENSUS it means that R agrees with omega, and that the
    relative gradient of F over rotations and translations (`pgo_models.problem.stationarity`) is
    within the tolerance at the poses that the robots hold; F and the poses are those. Neither says
    how far F is above an optimum, nor that the optimum is a global one.

    Examples
    --------
    >>> import pgo_models as pgo
    >>> from solvers.loop import run
    >>> result = run(SOC(), pgo.PGOProblem(pgo.load("grid")))
    >>> result.status.name, round(result.objective, 2)
    ('CONVERGED', 97.01)

    The recursion of the paper, without acceleration and with one penalty for all poses:

    >>> from solvers import FixedPenalty
    >>> plain = SOC(penalty=FixedPenalty(30.0), acceleration=None)
    >>> run(plain, pgo.PGOProblem(pgo.load("grid"))).status.name
    'CONVERGED'
    """

    def init(self, problem: PGOProblem, start: Poses | None) -> Any:  # noqa: ANN401
        """State 0: R = omega = `start`, the chordal relaxation unless given, and B = 0.

        With many robots and a MultiplierPenalty B starts at its value at a stationary point.
        """
        problem.check_quadratic("SOC", convex=True)
        return self._recursion.init(problem, start if start is not None else chordal_start(problem))

    def step(self, problem: PGOProblem, state: Any) -> Any:  # noqa: ANN401
        """Make one iteration: (a), (b), (c)."""
        return self._recursion.step(problem, state)

    def measure(self, problem: PGOProblem, state: Any) -> Measurement:  # noqa: ANN401
        """F of `poses`, and the residuals.

        The dual residual of CONSENSUS is the relative gradient of F at these poses.
        """
        measurement: Measurement = self._recursion.measure(problem, state)
        return measurement

    def poses(self, problem: PGOProblem, state: Any) -> Poses:  # noqa: ANN401
        """Return the poses that a state stands for.

        Parameters
        ----------
        problem : PGOProblem
            The problem that is solved.
        state : SOCState or ConsensusIterate
            A state of this solver.

        Returns
        -------
        Poses
            Omega with the best translations for it; in CONSENSUS with those that the robots hold.
        """
        poses: Poses = self._recursion.poses(problem, state)
        return poses

    @property
    def _recursion(self) -> Any:  # noqa: ANN401 - each has a state of its own
        return LocalConsensus(self) if self.is_split else Joint(self)
