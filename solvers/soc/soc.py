"""SOC, splitting of orthogonality constraints: the recursion of the paper's Algorithm 1 in three couplings.

    (a) R-step      x     = argmin  f(x) + 1/2 ||x - omega + B||_rho^2      a convex QP
    (b) projection  omega = nearest rotation to x + B                       closed form, SVD
    (c) Bregman     B     = B + x - omega

Ebrahimi & Deghat, Algorithm 1 (`algo1: SOC`); Lai & Osher 2014.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field, replace

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations, stack_transposes, unstack_transposes
from pgo_models.graphs.partitioning import Partition
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.matrices import norm
from pgo_models.problem.problem import PGOProblem
from solvers.result import Measurement, Status
from solvers.soc.anderson import Anderson, extrapolate_parts, over_relax
from solvers.soc.local_copies import (
    LocalCopies,
    adapted,
    agree,
    balanced,
    build_copies,
    norm_of_omega,
    norm_weight,
    stationarity_weight,
    stationary_mean,
)
from solvers.soc.penalty import (
    Due,
    FixedPenalty,
    MultiplierPenalty,
    PenaltyRule,
    next_penalty,
    rotation_scale,
    translation_scale,
)
from solvers.soc.r_step import BackEnd, RStep
from solvers.soc.separator_stiffness import fell_most, translation_penalty_for
from solvers.soc.state import SOCState

_SEPARATOR_PENALTY, _MOST_SEPARATOR_PENALTY = 0.7, 0.3  # times the root of the translation penalty, and no more


class Coupling(enum.Enum):
    """How the R-subproblem is shared."""

    JOINT = "one robot, all rotations and translations in one QP"
    CONSENSUS = "many robots, omega agreed between the copies of separator poses"
    SUBSTRUCTURED = "many robots and a driver: the program of JOINT, split by elimination to the separators"


@dataclass(frozen=True)
class SOC:
    """Splitting of orthogonality constraints (Ebrahimi & Deghat, Algorithm 1; Lai & Osher 2014).

    Attributes
    ----------
    coupling : Coupling, optional
        JOINT unless robots are given, then CONSENSUS. SUBSTRUCTURED has the iterates of JOINT: here it is run as JOINT
        is, by `solve(.., robots=..)` on robots.
    robots : Partition, optional
        Who owns which pose.
    penalty : MultiplierPenalty, FixedPenalty or BalancedPenalty
    alpha : float
        Over-relaxation, in (0, 2).
    acceleration : Anderson, optional
        None is the plain recursion.
    r_step : RStep or CustomRStep
        Back end of step (a).
    local_passes : int
        CONSENSUS only: how often a robot does (a) to (c) in a round, on the poses that it alone knows in all but the
        last of them. It costs no message. 1 is the plain recursion.
    translation_penalty : float, optional
        Penalty of separator translations in CONSENSUS, times their diagonal in M. Unless given, 0.6 times the stiffness
        of the separators (`LocalCopies.stiffness`), the inverse of their mean compliance; lowered where the penalties
        are taken anew, if the translations went far for what changed in their multipliers
        (`solvers.soc.separator_stiffness`).
    separator_penalty : float, optional
        Least penalty of separator rotations in CONSENSUS under a MultiplierPenalty, times their mean diagonal in M: on
        graphs with little noise the multipliers alone would hold the copies too loosely together. Unless given, 0.7
        times the root of the translation penalty, at most 0.3.
    tolerance : float
        On the primal and the dual residual, both relative.
    max_iterations : int

    Raises
    ------
    SettingError
        When a setting is out of its range or does not go with the coupling.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> from solvers.loop import run
    >>> run(SOC(tolerance=1e-4), PGOProblem(grid(np.random.default_rng(0)))).status.name
    'CONVERGED'
    """

    coupling: Coupling | None = None
    robots: Partition | None = None
    penalty: PenaltyRule = field(default_factory=MultiplierPenalty)
    alpha: float = 1.0
    acceleration: Anderson | None = field(default_factory=Anderson)
    r_step: BackEnd = RStep.FACTORIZED
    local_passes: int = 10
    translation_penalty: float | None = None
    separator_penalty: float | None = None
    tolerance: float = 1e-5
    max_iterations: int = 500

    def __post_init__(self) -> None:
        if not 0 < self.alpha < 2:
            raise SettingError(f"alpha must be in (0, 2), got {self.alpha}")
        if self.local_passes < 1:
            raise SettingError(f"local_passes must be at least 1, got {self.local_passes}")
        if self.translation_penalty is not None and not self.translation_penalty > 0:
            raise SettingError(f"translation_penalty must be positive, got {self.translation_penalty}")
        if self.separator_penalty is not None and not self.separator_penalty >= 0:
            raise SettingError(f"separator_penalty must not be negative, got {self.separator_penalty}")
        if not self.tolerance > 0:
            raise SettingError(f"tolerance must be positive, got {self.tolerance}")
        if self.max_iterations < 0:
            raise SettingError(f"max_iterations must not be negative, got {self.max_iterations}")
        if self.coupling is Coupling.JOINT and self.robots is not None and self.robots.num_robots > 1:
            raise SettingError(f"JOINT has one robot, got {self.robots}; use Coupling.CONSENSUS")
        if self.coupling is Coupling.CONSENSUS and self.robots is None:
            raise SettingError("CONSENSUS needs robots; see pgo_models.partition()")
        if not isinstance(self.penalty, PenaltyRule):
            raise SettingError(f"{self.penalty} has one rho for all poses; use it with PaperSOC, or a BalancedPenalty")

    @property
    def effective_coupling(self) -> Coupling:
        """The coupling that is used."""
        if self.coupling is not None:
            return self.coupling
        return Coupling.JOINT if self.robots is None else Coupling.CONSENSUS

    @property
    def _copies(self) -> Partition | None:
        """Robots that hold copies; None for one that holds all."""
        return self.robots if self.effective_coupling is Coupling.CONSENSUS else None

    def init(self, problem: PGOProblem, start: Poses | None) -> SOCState:
        """State 0: omega = R = start, the chordal relaxation unless given.

        B = 0, but for many robots under a MultiplierPenalty the stationary one, as after a refresh.
        """
        poses = start if start is not None else chordal_start(problem)
        copies = build_copies(problem, self._copies, self.r_step)
        rho = self.penalty.initial(problem, poses)
        relative = self.translation_penalty
        if relative is None and len(copies.robots) > 1:
            relative = translation_penalty_for(copies.stiffness(rho))
        rho_t, separator_rho = self._separator_penalties(problem, copies, relative)
        rho = np.maximum(rho, separator_rho)
        copies = copies.with_penalty(rho, rho_t)
        X = problem.stacked(poses)
        z = X[copies.row]
        is_stationary = len(copies.robots) > 1 and isinstance(self.penalty, MultiplierPenalty)
        mean = stationary_mean(problem, poses, rho) if is_stationary else np.zeros_like(X)
        s = z + balanced(copies, X, mean)
        return SOCState(0, z, poses.R, z, s, rho, rho_t, separator_rho, copies, origin=(z, s))

    def step(self, problem: PGOProblem, state: SOCState) -> SOCState:
        """One iteration: (a), (b), (c)."""
        state = self._with_penalty_due(problem, state)
        copies, weight = state.copies, norm_weight(state.copies)
        z, B, drift = self._between_exchanges(copies, state)
        x = copies.solve_all(z - B)  # (a)
        relaxed = over_relax(x, z, self.alpha)
        s, memory = relaxed + B, state.memory
        residual = weight * (relaxed - z + drift)
        merit = norm(residual)
        if self.acceleration is not None and np.isfinite(merit):
            s, memory = extrapolate_parts(self.acceleration, memory, residual, s, copies.slices)
        if not np.isfinite(s).all():
            return replace(state, k=state.k + 1, x=x, primal_residual=np.nan, dual_residual=np.nan)
        omega, following = agree(copies, s, problem)  # (b), and (c): B = s - z = B + x - z
        size = norm_of_omega(copies)
        return replace(
            state,
            k=state.k + 1,
            x=x,
            omega=omega,
            z=following,
            s=s,
            memory=memory,
            primal_residual=norm(weight * (x - following)) / size,
            dual_residual=norm(stationarity_weight(copies) * (following - state.z)) / size,
            merits=(*state.merits, merit),
            best=state.s if merit <= min(state.merits, default=np.inf) else state.best,
        )

    def measure(self, problem: PGOProblem, state: SOCState) -> Measurement:
        """F at omega with the best translations for it, and the residuals."""
        if np.isnan(state.primal_residual):
            return Measurement(np.nan, np.nan, np.nan)
        rows = stack_transposes(state.omega)
        X = np.concatenate([problem.recover_translations(state.omega), rows])
        return Measurement(problem.objective_stacked(X), state.primal_residual, state.dual_residual)

    def poses(self, problem: PGOProblem, state: SOCState) -> Poses:
        """Omega with the best translations for it."""
        return problem.with_best_translations(state.omega)

    def converged(self, state: SOCState, measurement: Measurement) -> Status | None:
        """CONVERGED when the residuals are within tolerance."""
        worst = max(measurement.primal_residual, measurement.dual_residual)
        return Status.CONVERGED if worst <= self.tolerance else None

    def penalty_rule(self, norms: Array, scales: Array) -> Array:
        """(a, b, c) of rho_i = max(a ||Lambda_i||_2, b m_i, c), from ||Lambda_i||_2 and m_i of all poses, (n,) each."""
        rule = self.penalty
        if isinstance(rule, MultiplierPenalty):
            return np.array([rule.factor, rule.factor * rule.floor(norms / scales), 0.0])
        if isinstance(rule, FixedPenalty):
            return np.array([0.0, 0.0, rule.rho])
        return np.array([0.0, rule.scale, 0.0])

    def _between_exchanges(self, copies: LocalCopies, state: SOCState) -> tuple[Array, Array, Array | float]:
        """Return z and B after all but the last of the local passes, and by how much z + B has moved."""
        z, B, private = state.z.copy(), state.B.copy(), copies.private
        is_alone = len(copies.robots) == 1
        if is_alone or self.local_passes == 1 or not private.any() or not np.isfinite(state.s).all():
            return z, B, 0.0
        for _ in range(self.local_passes - 1):
            s = (copies.solve_all(z - B) + B)[private]  # (a)
            z[private] = stack_transposes(project_to_rotations(unstack_transposes(s)))  # (b)
            B[private] = s - z[private]  # (c)
        return z, B, z + B - state.s

    def _separator_penalties(
        self, problem: PGOProblem, copies: LocalCopies, relative: float | None
    ) -> tuple[Array, Array]:
        """Penalty of separator translations and least penalty of separator rotations, (n,) each."""
        if relative is None or len(copies.robots) == 1:
            return translation_scale(problem), np.zeros(problem.num_poses)
        separator_rho = np.zeros(problem.num_poses)
        if isinstance(self.penalty, MultiplierPenalty):
            separator = copies.separators
            separator_rho[separator] = self.separator_penalty_for(relative) * rotation_scale(problem)[separator]
        return relative * translation_scale(problem), separator_rho

    def separator_penalty_for(self, translation_penalty: float) -> float:
        """Least penalty of separator rotations, times m_i, beside a penalty of their translations."""
        if self.separator_penalty is not None:
            return self.separator_penalty
        return min(_SEPARATOR_PENALTY * math.sqrt(translation_penalty), _MOST_SEPARATOR_PENALTY)

    def _with_penalty_due(self, problem: PGOProblem, state: SOCState) -> SOCState:
        """State with the penalty that the rule, or the safeguard, wants from now on; mostly the state itself."""
        due, factor = next_penalty(self.penalty, state.rho / rotation_scale(problem), state)
        if due is Due.RAISE:
            assert state.best is not None
            back = replace(state, s=state.best, z=agree(state.copies, state.best, problem)[1])
            return replace(self._rescaled(problem, back, factor), raises=state.raises + 1)
        if due in (Due.REFRESH, Due.SECOND_LOOK):
            before, after = self._adapted(problem, state)
            if due is Due.REFRESH or fell_most(before, after):
                return self._refreshed(problem, state, after)
        if due is Due.RESCALE:
            return replace(self._rescaled(problem, state, factor), refreshes=state.refreshes + 1)
        return state

    def _rescaled(self, problem: PGOProblem, state: SOCState, factor: float) -> SOCState:
        """State with factor * rho and the same unscaled multiplier rho B."""
        rho = factor * state.rho
        before = state.copies.penalty
        copies = state.copies.with_penalty(rho, state.rho_t)
        assert before is not None
        assert copies.penalty is not None
        s = state.z + (before / copies.penalty)[:, None] * state.B
        return replace(state, s=s, rho=rho, copies=copies, memory=(), merits=(), best=None)

    def _adapted(self, problem: PGOProblem, state: SOCState) -> tuple[float, float]:
        """Translation penalty, times the diagonal of M, and what the way so far suggests instead."""
        if self.translation_penalty is not None or len(state.copies.robots) == 1:
            given = self.translation_penalty if self.translation_penalty is not None else 1.0
            return given, given
        relative = float(state.rho_t[0] / translation_scale(problem)[0])
        return relative, adapted(problem, state.copies, relative, state.origin, (state.z, state.s))

    def _refreshed(self, problem: PGOProblem, state: SOCState, relative: float) -> SOCState:
        """State with rho and B from the multipliers at omega, where the mean B_i is -2 Lambda_i R_i^T / rho_i."""
        poses = problem.with_best_translations(state.omega)
        rho_t, separator_rho = self._separator_penalties(problem, state.copies, relative)
        rho = np.maximum(self.penalty.initial(problem, poses), separator_rho)
        copies = state.copies.with_penalty(rho, rho_t)
        X = problem.stacked(poses)
        z = X[copies.row]
        s = z + balanced(copies, X, stationary_mean(problem, poses, rho))
        return replace(
            state,
            z=z,
            s=s,
            origin=(z, s),
            rho=rho,
            rho_t=rho_t,
            separator_rho=separator_rho,
            copies=copies,
            memory=(),
            merits=(),
            best=None,
            refreshes=state.refreshes + 1,
        )
