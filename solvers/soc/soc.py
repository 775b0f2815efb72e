"""SOC, splitting of orthogonality constraints: the recursion of the paper's Algorithm 1.

    (a) R-step      x     = argmin  f(x) + 1/2 ||x - omega + B||_rho^2      a convex QP
    (b) projection  omega = nearest rotation to x + B                       closed form, SVD
    (c) Bregman     B     = B + x - omega

`Joint` is the whole graph in one program; `solvers.soc.consensus` shares it among robots that hold copies.
Ebrahimi & Deghat, Algorithm 1 (`algo1: SOC`); Lai & Osher 2014.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pgo_models.certificates.dual_variables import multiplier_norms, multipliers
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, stack_transposes, unstack_transposes
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from solvers.result import Measurement
from solvers.soc.anderson import AndersonSums
from solvers.soc.consensus import LocalConsensus
from solvers.soc.penalty import Due, Steps, next_penalty, rotation_scale
from solvers.soc.r_step import RotationStep, RSubproblem, prepare
from solvers.soc.recursion_block import Agreement, RecursionBlock
from solvers.soc.settings import SOCSettings


@dataclass(frozen=True, eq=False)
class SOCState(Steps):
    """Iterate k of JOINT."""

    block: RecursionBlock  # rows of every R_i^T: x, z, s, B
    r_step: RotationStep  # back end of step (a), prepared for the present rho

    @property
    def steps(self) -> "SOCState":
        """Residuals, and what they say of the penalty."""
        return self

    @property
    def omega(self) -> Array:
        """Rotations, (n, d, d)."""
        return unstack_transposes(self.block.z)

    @property
    def rho(self) -> Array:
        """Penalty of every rotation, (n,)."""
        return self.block.penalty[:: self.block.z.shape[1]]

    @property
    def x(self) -> Array:
        """Rotations of step (a), rows of every R_i^T, (dn, d)."""
        return self.block.x

    @property
    def B(self) -> Array:
        """Scaled multiplier (Bregman variable), (dn, d)."""
        return self.block.B


@dataclass(frozen=True)
class Joint:
    """The recursion for the whole graph in one quadratic program; `soc` has the settings."""

    soc: SOCSettings

    def init(self, problem: PGOProblem, start: Poses) -> SOCState:
        """State 0: omega = the rotations of `start`, B = 0."""
        problem.stacked(start)  # raises unless the poses fit
        return self._penalized(problem, start, is_stationary=False)

    def step(self, problem: PGOProblem, state: SOCState) -> SOCState:
        """One iteration: (a), (b), (c)."""
        state = self._with_penalty_due(problem, state)
        n, d = problem.num_poses, problem.d
        V = np.concatenate([np.zeros((n, d)), state.block.shift])  # translations have no penalty
        block, sums = state.block.after_solve(state.r_step.solve(V)[n:])  # (a)
        merit = math.sqrt(sums[0])
        if not math.isfinite(merit):
            return replace(state.broken(), block=block)
        gamma, anderson = state.sums.coefficients(self.soc.acceleration, sums)
        block, squares = block.extrapolated(Agreement(gamma, state.is_best(merit))).projected()  # (b), (c)
        return replace(state.after(merit, squares, math.sqrt(block.penalty.sum()), anderson), block=block)

    def _penalized(self, problem: PGOProblem, poses: Poses, is_stationary: bool) -> SOCState:
        """State 0 at poses, B zero or stationary."""
        Lambda = multipliers(problem, poses)
        order = self.soc.penalty_order(multiplier_norms(Lambda) / rotation_scale(problem), is_stationary)
        block = order.block(poses.R, Lambda, problem.M.data[problem.diagonal_positions[problem.num_poses :]])
        return SOCState(block, self._prepared(problem, block))

    def _with_penalty_due(self, problem: PGOProblem, state: SOCState) -> SOCState:
        """State with the penalty that the rule, or the safeguard, wants from now on; mostly the state itself."""
        due, factor = next_penalty(self.soc.penalty, state.rho / rotation_scale(problem), state)
        if due is Due.RAISE:
            back = replace(state, block=state.block.back_at_best())
            return replace(self._rescaled(problem, back, factor), raises=state.raises + 1)
        if due is Due.REFRESH:
            fresh = self._penalized(problem, problem.with_best_translations(state.omega), is_stationary=True)
            return fresh.in_place_of(state)
        if due is Due.RESCALE:
            return replace(self._rescaled(problem, state, factor), refreshes=state.refreshes + 1)
        return state

    def _rescaled(self, problem: PGOProblem, state: SOCState, factor: float) -> SOCState:
        """State with factor * rho and the same unscaled multiplier rho B."""
        block = state.block.rescaled(factor * state.block.penalty)
        return replace(state, block=block, r_step=self._prepared(problem, block), sums=AndersonSums(), merits=())

    def _prepared(self, problem: PGOProblem, block: RecursionBlock) -> RotationStep:
        (A, w), n = problem.residual_matrix, problem.num_poses
        penalty = np.concatenate([np.zeros(n), block.penalty])
        subproblem = RSubproblem(A, w, problem.M, problem.d, n, penalty, problem.analysis, problem.backend)
        return prepare(subproblem, self.soc.r_step)


@dataclass(frozen=True)
class SOC(SOCSettings):
    """Splitting of orthogonality constraints (Ebrahimi & Deghat, Algorithm 1; Lai & Osher 2014).

    A SettingError when a setting is out of its range or does not go with the coupling.

    `coupling` is JOINT unless `robots`, who own the poses, are given, then CONSENSUS. SUBSTRUCTURED has the iterates of
    JOINT: here it is run as JOINT is, by `solve(.., robots=..)` on robots. `alpha` is the over-relaxation, in (0, 2);
    `acceleration` None is the plain recursion; `r_step` is the back end of step (a), and `tolerance` is on the primal
    and the dual residual, both relative. CONSENSUS alone has three more:

    `local_passes`: how often a robot does (a) to (c) in a round, on the poses that it alone knows in all but the last
    of them. It costs no message. 1 is the plain recursion.

    `translation_penalty`: that of separator translations, times their diagonal in M. Unless given, 0.6 times the
    stiffness of the separators, the inverse of their mean compliance; lowered where the penalties are taken anew, if
    the translations went far for what changed in their multipliers (`solvers.soc.separator_stiffness`).

    `separator_penalty`: the least of separator rotations under a MultiplierPenalty, times their mean diagonal in M: on
    graphs with little noise the multipliers alone would hold the copies too loosely together. Unless given, 0.7 times
    the root of the translation penalty, at most 0.3.
    """

    @property
    def _recursion(self) -> Any:  # noqa: ANN401 - each has a state of its own
        return LocalConsensus(self) if self.is_split else Joint(self)

    def init(self, problem: PGOProblem, start: Poses | None) -> Any:  # noqa: ANN401
        """State 0: omega = R = start, or chordal; B = 0, stationary for many robots under a MultiplierPenalty."""
        problem.check_quadratic("SOC", convex=True)
        return self._recursion.init(problem, start if start is not None else chordal_start(problem))

    def step(self, problem: PGOProblem, state: Any) -> Any:  # noqa: ANN401
        """One iteration: (a), (b), (c)."""
        return self._recursion.step(problem, state)

    def measure(self, problem: PGOProblem, state: Any) -> Measurement:  # noqa: ANN401
        """F at omega with the best translations for it, and the residuals."""
        if math.isnan(state.steps.primal_residual):
            return Measurement(np.nan, np.nan, np.nan)
        R = state.omega
        X = np.concatenate([problem.recover_translations(R), stack_transposes(R)])
        measurement: Measurement = state.steps.measurement(problem.objective_stacked(X))
        return measurement

    def poses(self, problem: PGOProblem, state: Any) -> Poses:  # noqa: ANN401
        """Omega with the best translations for it."""
        return problem.with_best_translations(state.omega)
