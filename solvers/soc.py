"""SOC, splitting of orthogonality constraints: the recursion of the paper's Algorithm 1 in three couplings.

    (a) R-step      x     = argmin  f(x) + 1/2 ||x - omega + B||_rho^2      a convex QP
    (b) projection  omega = nearest rotation to x + B                       closed form, SVD
    (c) Bregman     B     = B + x - omega

Ebrahimi & Deghat, Algorithm 1 (`algo1: SOC`); Lai & Osher 2014.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field, replace

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.initialization import chordal_start, spanning_tree_start
from pgo_models.matrices import norm
from pgo_models.multipliers import multipliers
from pgo_models.partition import Partition
from pgo_models.poses import Poses
from pgo_models.problem import PGOProblem
from pgo_models.rotations import Array, project_to_rotations, stack_transposes, unstack_transposes
from solvers.acceleration import Anderson, AndersonMemory, extrapolate, over_relax
from solvers.penalty import BalancedPenalty, MultiplierPenalty, PenaltyRule, rotation_scale, translation_scale
from solvers.result import Measurement, Status
from solvers.rotation_step import BackEnd, RStep
from solvers.soc_paper import PaperState, init_paper, measure_paper, step_paper
from solvers.team import Team, build_team

_DIVERGED = 10.0  # times the smallest merit: go back and double the penalty
_PATIENCE = 20  # steps without a new smallest merit: likewise, unless rho is `_ENOUGH` times m_i in the median
_ENOUGH = 4.0  # 4 ||Lambda_i|| is, and at an optimum that can be certified ||Lambda_i|| is about m_i at most
_MAX_RAISES = 20


class Coupling(enum.Enum):
    """How the R-subproblem is shared."""

    PAPER = "rotations only, every robot with its neighbours frozen (Algorithm 1 to the letter)"
    JOINT = "one robot, all rotations and translations in one QP"
    CONSENSUS = "many robots, omega agreed between the copies of separator poses"


@dataclass(frozen=True, eq=False)
class SOCState:
    """Iterate k of JOINT or CONSENSUS. Team vectors are (rows, d): see `solvers.team.Team`.

    Attributes
    ----------
    k : int
    x : (rows, d)
        Rotations (and separator translations) of step (a), every robot's copy.
    omega : (n, d, d)
        Rotations agreed on.
    z : (rows, d)
        omega and the agreed separator translations, handed out to the copies.
    s : (rows, d)
        x + B before the projection, extrapolated: the variable of the fixed-point map.
    B : (rows, d)
        Scaled multiplier, s - z.
    rho : (n,)
        Penalty of every rotation.
    team : Team
        Robots with their prepared subproblems.
    memory : AndersonMemory
    primal_residual, dual_residual : float
        ||x - z||_rho and ||c (z - z_before)||_rho, both over ||omega||_rho, with c = max(1, rho / diagonal of M): a
        penalty far above M makes short steps anywhere.
    merits : tuple of float
        Fixed-point residual ||x - z_before||_rho of the steps since rho last changed.
    best : (rows, d)
        The s of the smallest merit.
    refreshes, raises : int
        How often the penalty rule, and the safeguard against divergence, changed rho.
    """

    k: int
    x: Array
    omega: Array
    z: Array
    s: Array
    rho: Array
    team: Team
    memory: AndersonMemory = field(default_factory=AndersonMemory)
    primal_residual: float = np.inf
    dual_residual: float = np.inf
    merits: tuple[float, ...] = ()
    best: Array | None = None
    refreshes: int = 0
    raises: int = 0

    @property
    def B(self) -> Array:
        """Scaled multiplier (Bregman variable), (rows, d)."""
        return self.s - self.z


@dataclass(frozen=True)
class SOC:
    """Splitting of orthogonality constraints (Ebrahimi & Deghat, Algorithm 1; Lai & Osher 2014).

    Attributes
    ----------
    coupling : Coupling, optional
        JOINT unless robots are given, then CONSENSUS.
    robots : Partition, optional
        Who owns which pose; for PAPER, one pose a robot unless given.
    penalty : MultiplierPenalty, FixedPenalty or BalancedPenalty, optional
        MultiplierPenalty unless given; for PAPER a BalancedPenalty, the adaptive scheme the paper takes from Boyd.
    alpha : float
        Over-relaxation, in (0, 2). PAPER has none.
    acceleration : Anderson, optional
        None is the plain recursion. PAPER has none.
    r_step : RStep or CustomRStep
        Back end of step (a).
    translation_penalty : float
        Penalty of separator translations in CONSENSUS, times their diagonal in M.
    separator_penalty : float
        Least penalty of separator rotations in CONSENSUS under a MultiplierPenalty, times their mean diagonal in M: on
        graphs with little noise the multipliers alone would hold the copies too loosely together.
    tolerance : float
        On the primal and the dual residual, both relative. For PAPER the primal one is the paper's KKT residual, the
        root mean square over poses of ||omega_i^T omega_i - I||^2 + ||omega_i - R_i||^2, the dual one its stationarity.
    max_iterations : int

    Raises
    ------
    SettingError
        When a setting is out of its range or does not go with the coupling.
    """

    coupling: Coupling | None = None
    robots: Partition | None = None
    penalty: PenaltyRule | None = None
    alpha: float = 1.0
    acceleration: Anderson | None = field(default_factory=Anderson)
    r_step: BackEnd = RStep.FACTORIZED
    translation_penalty: float = 0.05
    separator_penalty: float = 0.3
    tolerance: float = 1e-5
    max_iterations: int = 500

    def __post_init__(self) -> None:
        if not 0 < self.alpha < 2:
            raise SettingError(f"alpha must be in (0, 2), got {self.alpha}")
        if not self.translation_penalty > 0:
            raise SettingError(f"translation_penalty must be positive, got {self.translation_penalty}")
        if not self.separator_penalty >= 0:
            raise SettingError(f"separator_penalty must not be negative, got {self.separator_penalty}")
        if not self.tolerance > 0:
            raise SettingError(f"tolerance must be positive, got {self.tolerance}")
        if self.max_iterations < 0:
            raise SettingError(f"max_iterations must not be negative, got {self.max_iterations}")
        if self.coupling is Coupling.JOINT and self.robots is not None and self.robots.num_robots > 1:
            raise SettingError(f"JOINT has one robot, got {self.robots}; use Coupling.CONSENSUS")
        if self.coupling is Coupling.CONSENSUS and self.robots is None:
            raise SettingError("CONSENSUS needs robots; see pgo_models.partition()")

    @property
    def effective_coupling(self) -> Coupling:
        """The coupling that is used."""
        if self.coupling is not None:
            return self.coupling
        return Coupling.JOINT if self.robots is None else Coupling.CONSENSUS

    def init(self, problem: PGOProblem, start: Poses | None) -> SOCState | PaperState:
        """State 0: omega = R = start, B = 0. JOINT and CONSENSUS start at the chordal relaxation, PAPER at a tree."""
        if self.effective_coupling is Coupling.PAPER:
            poses = start if start is not None else spanning_tree_start(problem.graph)
            return init_paper(problem, poses, self.robots, self._rule, self.r_step)
        poses = start if start is not None else chordal_start(problem)
        rho = self._initial_rho(problem, poses)
        team = build_team(problem, self.robots, self.r_step).with_penalty(rho, self._rho_t(problem))
        X = problem.stacked(poses)
        z = X[team.row]
        return SOCState(k=0, x=z, omega=poses.R, z=z, s=z + _balanced(team, X, np.zeros_like(X)), rho=rho, team=team)

    def step(self, problem: PGOProblem, state: SOCState | PaperState) -> SOCState | PaperState:
        """One iteration: (a), (b), (c)."""
        if isinstance(state, PaperState):
            return step_paper(problem, state, self._rule, self.r_step)
        state = self._with_penalty_due(problem, state)
        team, z, B = state.team, state.z, state.B
        weight = _norm_weight(team)
        x = team.solve_all(z - B)  # (a)
        relaxed = over_relax(x, z, self.alpha)
        s, memory = relaxed + B, state.memory
        merit = norm(weight * (relaxed - z))
        if self.acceleration is not None and np.isfinite(merit):
            s, memory = extrapolate(self.acceleration, memory, weight * (relaxed - z), s)
        if not np.isfinite(s).all():
            return replace(state, k=state.k + 1, x=x, primal_residual=np.nan, dual_residual=np.nan)
        omega, following = _agree(team, s, problem)  # (b), and (c): B = s - z = B + x - z
        size = _size(team)
        return replace(
            state,
            k=state.k + 1,
            x=x,
            omega=omega,
            z=following,
            s=s,
            memory=memory,
            primal_residual=norm(weight * (x - following)) / size,
            dual_residual=norm(_stationarity_weight(team) * (following - z)) / size,
            merits=(*state.merits, merit),
            best=state.s if merit <= min(state.merits, default=np.inf) else state.best,
        )

    def measure(self, problem: PGOProblem, state: SOCState | PaperState) -> Measurement:
        """F at omega with the best translations for it, and the residuals."""
        if isinstance(state, PaperState):
            return measure_paper(problem, state)
        if np.isnan(state.primal_residual):
            return Measurement(np.nan, np.nan, np.nan)
        rows = stack_transposes(state.omega)
        X = np.concatenate([problem.recover_translations(state.omega), rows])
        return Measurement(problem.objective_stacked(X), state.primal_residual, state.dual_residual)

    def poses(self, problem: PGOProblem, state: SOCState | PaperState) -> Poses:
        """Omega with the best translations for it."""
        return problem.with_best_translations(state.omega)

    def converged(self, state: SOCState | PaperState, measurement: Measurement) -> Status | None:
        """CONVERGED when the residuals are within tolerance."""
        worst = max(measurement.primal_residual, measurement.dual_residual)
        return Status.CONVERGED if worst <= self.tolerance else None

    @property
    def _rule(self) -> PenaltyRule:
        if self.penalty is not None:
            return self.penalty
        return BalancedPenalty() if self.effective_coupling is Coupling.PAPER else MultiplierPenalty()

    def _initial_rho(self, problem: PGOProblem, poses: Poses) -> Array:
        rho = self._rule.initial(problem, poses)
        if self.robots is not None and isinstance(self._rule, MultiplierPenalty):
            shared = self.robots.separators(problem.graph)
            rho[shared] = np.maximum(rho[shared], self.separator_penalty * rotation_scale(problem)[shared])
        return rho

    def _rho_t(self, problem: PGOProblem) -> Array:
        return self.translation_penalty * translation_scale(problem)

    def _with_penalty_due(self, problem: PGOProblem, state: SOCState) -> SOCState:
        """State with the penalty that the rule, or the safeguard, wants from now on; mostly the state itself."""
        if self._is_penalty_too_small(problem, state) and state.raises < _MAX_RAISES:
            assert state.best is not None
            back = replace(state, s=state.best, z=_agree(state.team, state.best, problem)[1])
            return replace(self._rescaled(problem, back, 2.0), raises=state.raises + 1)
        rule, merits = self._rule, state.merits
        if isinstance(rule, MultiplierPenalty):
            window = rule.stall_window
            stalled = len(merits) >= window and merits[-1] > rule.stall_ratio * merits[-window]
            if stalled and state.refreshes < rule.max_refreshes:
                return self._refreshed(problem, state)
        if isinstance(rule, BalancedPenalty) and state.k > 0:
            factor = rule.factor(state.primal_residual, state.dual_residual)
            if factor != 1.0 and (factor > 1.0 or state.raises == 0):
                return replace(self._rescaled(problem, state, factor), refreshes=state.refreshes + 1)
        return state

    def _is_penalty_too_small(self, problem: PGOProblem, state: SOCState) -> bool:
        """Whether the merit has grown far, or, the iterates going round in a cycle, has long not been smaller."""
        merits = state.merits
        if len(merits) < 2:
            return False
        if merits[-1] > _DIVERGED * min(merits):
            return True
        steps_since_smallest = len(merits) - 1 - merits.index(min(merits))
        return steps_since_smallest >= _PATIENCE and bool(np.median(state.rho / rotation_scale(problem)) < _ENOUGH)

    def _rescaled(self, problem: PGOProblem, state: SOCState, factor: float) -> SOCState:
        """State with factor * rho and the same unscaled multiplier rho B."""
        rho = factor * state.rho
        before = state.team.penalty
        team = state.team.with_penalty(rho, self._rho_t(problem))
        assert before is not None
        assert team.penalty is not None
        s = state.z + (before / team.penalty)[:, None] * state.B
        return replace(state, s=s, rho=rho, team=team, memory=AndersonMemory(), merits=(), best=None)

    def _refreshed(self, problem: PGOProblem, state: SOCState) -> SOCState:
        """State with rho and B from the multipliers at omega, where the mean B_i is -2 Lambda_i R_i^T / rho_i."""
        poses = problem.with_best_translations(state.omega)
        rho = self._initial_rho(problem, poses)
        team = state.team.with_penalty(rho, self._rho_t(problem))
        X = problem.stacked(poses)
        normal = np.zeros_like(X)
        transposes = np.swapaxes(multipliers(problem, poses) @ np.swapaxes(poses.R, 1, 2), 1, 2)
        normal[problem.num_poses :] = stack_transposes(-2.0 * transposes / rho[:, None, None])
        z = X[team.row]
        return replace(
            state,
            z=z,
            s=z + _balanced(team, X, normal),
            rho=rho,
            team=team,
            memory=AndersonMemory(),
            merits=(),
            best=None,
            refreshes=state.refreshes + 1,
        )


def _balanced(team: Team, X: Array, mean: Array) -> Array:
    """B, (rows, d), whose mean over the copies is `mean`, (N, d), and which holds every robot's forces in balance at X.

    At a stationary point 2 M_a x + rho_a B_a = 0 for every robot a. One robot alone has B = mean.
    """
    assert team.penalty is not None
    B = -team.gradients(X) / team.penalty[:, None]
    return B + (mean - team.average(B))[team.row]


def _agree(team: Team, s: Array, problem: PGOProblem) -> tuple[Array, Array]:
    """Step (b): omega from the mean of the copies, and omega and the mean separator translations handed out again."""
    mean = team.average(s)
    omega = project_to_rotations(unstack_transposes(mean[problem.num_poses :]))
    mean[problem.num_poses :] = stack_transposes(omega)
    return omega, mean[team.row]


def _size(team: Team) -> float:
    """||omega||_rho over all copies: the translations, which depend on the origin of the world, are left out."""
    assert team.penalty is not None
    rotations = team.row >= team.problem.num_poses
    return float(np.sqrt(team.penalty[rotations].sum()))


def _norm_weight(team: Team) -> Array:
    """Square roots of the penalties: ||v||_rho is the norm of weight * v."""
    assert team.penalty is not None
    return np.sqrt(team.penalty)[:, None]


def _stationarity_weight(team: Team) -> Array:
    """Root of the penalty, times penalty over the diagonal of M where it is above that."""
    assert team.penalty is not None
    problem = team.problem
    diagonal = problem.M.data[problem.diagonal_positions][team.row] / team.copies[team.row]
    return np.asarray(_norm_weight(team) * np.maximum(1.0, team.penalty / diagonal)[:, None])
