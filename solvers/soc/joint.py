"""JOINT: splitting of orthogonality constraints, on all rotations and translations together.

Every rotation R_i is split in two: a d x d matrix x_i that enters the cost and need not be a
rotation, and a rotation omega_i, with the constraint x_i = omega_i and its scaled multiplier B_i.
One iteration is

    (a) R-step      x     = argmin_x min_t  F(x, t) + 1/2 sum_i rho_i ||x_i - omega_i + B_i||_F^2
    (b) projection  omega = the rotations nearest to x + B
    (c) Bregman     B     = B + x - omega

F is the cost of rotations and translations, here evaluated at matrices x. Step (a) is a convex
quadratic program over all matrices x_i and all translations t_i. Step (b) projects every pose on
its own (`project_to_rotations`): in the plane by an angle, in space by an SVD, or from 20 poses on
by Newton's polar iteration, whose limit is the same. `Joint.step` is one iteration. The parts
around it have files of their own:

- `anderson`: over-relaxation and acceleration, which replace x by `x_ahead` in (b) and (c);
- `penalty`: the rules that choose the penalties rho;
- `safeguard`: when rho changes during a run, and when the recursion returns to its best iterate.

The norm in which the recursion measures is ||v||_rho = sqrt(sum_i rho_i ||v_i||_F^2).

These are the three steps of the paper's Algorithm 1, whose (a) has the rotations alone, every robot
with its neighbours frozen, one rho for all poses and edges without weights. Here (a) has the
translations as well, all poses move at once, every pose has a rho_i, and edges have the precisions
kappa and tau. `solvers.soc.paper` is Algorithm 1 itself.

Ebrahimi & Deghat, Algorithm 1; Lai & Osher 2014.
"""

import math
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from pgo_models.certificates.dual_variables import multiplier_norms, multipliers
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.stationarity import rotation_scale
from solvers.result import Measurement, Status
from solvers.soc.anderson import AndersonShare, AndersonSums, extrapolate, over_relax
from solvers.soc.r_step import JointStep, prepare_joint
from solvers.soc.recursion_block import squared_residuals, stationary_B
from solvers.soc.safeguard import Due, Steps, with_due_penalty
from solvers.soc.settings import SOCSettings


@dataclass(frozen=True, eq=False)
class SOCState(Steps):
    """Iterate k of JOINT: x, omega, B and rho as above, acceleration and safeguard."""

    # (n, d, d): solution of step (a): matrices that need not be orthogonal. At k = 0 the rotations
    # of the start.
    x: Array
    # (n, d, d): the rotations nearest to x_ahead + B: x_ahead is x after over-relaxation and
    # acceleration, B is that of iterate k - 1. At k = 0 the rotations of the start.
    omega: Array
    # (n, d, d): scaled multiplier of x = omega (Bregman variable); rho B is the unscaled one
    B: Array
    rho: Array  # (n,): penalty of every pose
    r_step: JointStep  # back end of step (a), prepared for this rho
    # earlier steps, for the acceleration
    memory: AndersonShare = field(default_factory=AndersonShare)
    # (n, d, d): the omega + B with the smallest merit, to which the safeguard returns; None before
    # the first step
    best: Array | None = None


@dataclass(frozen=True)
class Joint:
    """Algorithm 1 with one quadratic program over all poses; `soc` has the settings."""

    soc: SOCSettings

    def init(self, problem: PGOProblem, start: Poses) -> SOCState:
        """State 0: omega = the rotations of `start`, B = 0."""
        return self._state_at(problem, start, treat_as_stationary=False)

    def step(self, problem: PGOProblem, state: SOCState) -> SOCState:
        """One iteration: (a), (b) and (c).

        `x_ahead` is x after over-relaxation and acceleration; it is x itself without them.
        """
        state = self._with_due_penalty(problem, state)
        x = state.r_step.solve(state.omega - state.B)  # (a) R-step
        x_ahead, updated = self._accelerated(state, x)
        if not np.isfinite(x_ahead).all():
            return replace(state.broken(), x=x)
        omega = project_to_rotations(x_ahead + state.B)  # (b) projection
        B = state.B + x_ahead - omega  # (c) Bregman update
        return self._with_residuals(state, replace(updated, x=x, omega=omega, B=B))

    def measure(self, problem: PGOProblem, state: SOCState) -> Measurement:
        """F at omega with the best translations for it, and the residuals."""
        if math.isnan(state.primal_residual):
            return Measurement(np.nan, np.nan, np.nan)
        return state.measurement(problem.objective(self.poses(problem, state)))

    def poses(self, problem: PGOProblem, state: SOCState) -> Poses:
        """Omega with the best translations for it."""
        return problem.with_best_translations(state.omega)

    def converged(self, state: SOCState, measurement: Measurement) -> Status | None:
        """CONVERGED when both residuals are within tolerance, or as `SOCSettings.stall_of` says."""
        return self.soc.status_at(measurement) or self.soc.stall_of(state)

    # Acceleration, residuals and penalties.

    def _accelerated(self, state: SOCState, x: Array) -> tuple[Array, SOCState]:
        """Return `x_ahead`, and the state with the updated memory of the acceleration.

        The recursion is a fixed-point iteration in s = omega + B. Its map, with over-relaxation, is

            s -> s + alpha (x - omega)

        where omega and B are those before the step, and x solves (a) for them; alpha = 1 gives
        x + B, the argument of the plain projection. Anderson acceleration combines the images of
        this and earlier steps; `x_ahead` is the result less B. The merit of a step is the length of
        the residual of the map, ||alpha (x - omega)||_rho. The safeguard compares merits.
        """
        s = state.omega + state.B
        change = over_relax(x, state.omega, self.soc.alpha) - state.omega
        # With the factor sqrt(rho) plain inner products of residuals are those of the rho-norm.
        weighted_residual = np.sqrt(state.rho)[:, None, None] * change
        next_s, merit, memory, sums = extrapolate(
            self.soc.acceleration, state.memory, state.sums, weighted_residual, s + change
        )
        updated = replace(
            state,
            sums=sums,
            memory=memory,
            best=s if state.is_best(merit) else state.best,
            merits=(*state.merits, merit),
        )
        return next_s - state.B, updated

    def _with_residuals(self, before: SOCState, state: SOCState) -> SOCState:
        """Count the step, and set its residuals, relative to ||omega||_rho = sqrt(d sum_i rho_i).

        Before the division their squares are

            primal  ||x - omega||_rho^2
            dual    ||c (omega - omega_before)||_rho^2 + ||(c - 1) (x - omega)||_rho^2

        with c = max(1, rho_i / diagonal of M) for every row of R_i^T, which is `r_step.stiffness`.
        A penalty far above M makes short steps everywhere, not only near a minimum; the factor c
        keeps the dual residual from being small there.
        """
        rho = state.rho[:, None, None]
        squares = squared_residuals(state.x, state.omega, before.omega, rho, state.r_step.stiffness)
        size = math.sqrt(state.omega.shape[1] * float(state.rho.sum()))
        return state.with_residuals(squares, size)

    def _state_at(self, problem: PGOProblem, poses: Poses, treat_as_stationary: bool) -> SOCState:
        """First state of a recursion at poses: of the run (k = 0), or after a refresh.

        B is 0, or, if the poses are treated as stationary, the multiplier that belongs to a
        stationary point (`stationary_B`). The penalties rho are the same in both cases.
        """
        Lambda = multipliers(problem, poses)
        norms = multiplier_norms(Lambda)
        scale = rotation_scale(problem)  # m_i: mean diagonal of M over the rows of R_i^T
        order = self.soc.penalty_order(norms / scale, treat_as_stationary)
        rho = order.rho(norms, scale)
        B = stationary_B(poses.R, Lambda, rho) if treat_as_stationary else np.zeros_like(poses.R)
        r_step = prepare_joint(problem, rho, self.soc.r_step)
        return SOCState(x=poses.R, omega=poses.R, B=B, rho=rho, r_step=r_step)

    def _with_due_penalty(self, problem: PGOProblem, state: SOCState) -> SOCState:
        """State with the penalty that the rule or the safeguard asks for; usually unchanged."""
        rescaled = partial(self._rescaled, problem)
        refreshed = partial(self._refreshed, problem)
        return with_due_penalty(self.soc.penalty, state, rescaled, refreshed)

    def _refreshed(self, problem: PGOProblem, state: SOCState, due: Due) -> SOCState:
        """State with rho and B chosen anew, from the multipliers at omega.

        RECHECK concerns the translation penalty, which JOINT does not have.
        """
        if due is Due.RECHECK:
            return state
        poses = problem.with_best_translations(state.omega)
        return self._state_at(problem, poses, treat_as_stationary=True).in_place_of(state)

    def _rescaled(
        self, problem: PGOProblem, state: SOCState, factor: float, from_best: bool
    ) -> SOCState:
        """State with factor * rho and the same rho B; its acceleration starts anew.

        From the best iterate on it goes to omega + B there, which the first step has set. The list
        of merits is emptied, because merits of different rho cannot be compared. `best` still
        belongs to the old rho; the next step is the best one of an empty list, and replaces it.
        """
        if from_best:
            assert state.best is not None
            omega = project_to_rotations(state.best)
            state = replace(state, omega=omega, B=state.best - omega)
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
