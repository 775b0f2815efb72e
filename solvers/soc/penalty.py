"""Rules for the ADMM penalty rho: from the multipliers, fixed, or balanced by residuals, relative or Boyd's."""

import enum
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from pgo_models.certificates.dual_variables import multiplier_norms, multipliers
from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, stack_transposes
from pgo_models.problem.problem import PGOProblem
from solvers.result import Measurement
from solvers.soc.anderson import AndersonSums
from solvers.soc.recursion_block import RecursionBlock, StepSettings, block_at, stationary_B
from solvers.soc.separator_stiffness import is_second_look

MAX_RAISES = 20
_DIVERGED = 10.0  # times the smallest merit: go back and double the penalty
_PATIENCE = 20  # steps without a new smallest merit: likewise, unless rho is `_ENOUGH` times m_i in the median
_ENOUGH = 4.0  # 4 ||Lambda_i|| is, and at an optimum that can be certified ||Lambda_i|| is about m_i at most
_SMALLEST_RATIO = 1e-6  # of ||Lambda_i|| to m_i; M + D/2 keeps ten digits


@dataclass(frozen=True)
class PenaltyOrder:
    """rho_i = max(per_norm ||Lambda_i||_2, per_scale m_i, least): what a party must know to set its penalties."""

    per_norm: float
    per_scale: float
    least: float
    is_stationary: bool = False  # B starts at its value at a stationary point, -2 Lambda_i R_i^T / rho_i; else at zero
    settings: StepSettings = field(default_factory=StepSettings)

    def rho(self, norms: Array, scale: Array) -> Array:
        """rho, (n,), from ||Lambda_i||_2 and m_i."""
        return np.asarray(np.maximum(np.maximum(self.per_norm * norms, self.per_scale * scale), self.least))

    def block(self, R: Array, Lambda: Array, diagonal: Array) -> RecursionBlock:
        """Rows of a party at its rotations R, (k, d, d), with this penalty; `diagonal`, (dk,), is that of M there."""
        d = R.shape[-1]
        rho = self.rho(multiplier_norms(Lambda), diagonal.reshape(-1, d).mean(axis=1))
        B = stationary_B(R, Lambda, rho) if self.is_stationary else 0.0
        return block_at(stack_transposes(R), np.repeat(rho, d), diagonal, self.settings, B)


class _Rule(ABC):
    """A rule that says the three numbers of a `PenaltyOrder`."""

    @abstractmethod
    def bounds(self, ratio: Array) -> tuple[float, float, float]:
        """(per_norm, per_scale, least), from ||Lambda_i||_2 / m_i, the `ratio` of all poses, (n,)."""

    def initial(self, problem: PGOProblem, poses: Poses) -> Array:
        """rho, (n,), at poses."""
        norms, scale = multiplier_norms(multipliers(problem, poses)), rotation_scale(problem)
        return PenaltyOrder(*self.bounds(norms / scale)).rho(norms, scale)


@dataclass(frozen=True)
class MultiplierPenalty(_Rule):
    """rho_i = factor max(||Lambda_i||_2, q m_i), one for every pose.

    m_i is the mean diagonal of M over the rotation rows of pose i and q a quantile of ||Lambda_i||_2 / m_i over all
    poses. The multipliers measure how far from convex the constraint makes each pose. They are taken at the start, and
    once more where the recursion stalls; B then restarts at its stationary value there, -2 Lambda_i R_i^T / rho_i.
    Stalled: the residual of the last `stall_window` iterations has not fallen below `stall_ratio` of what it was.
    """

    factor: float = 8.0
    quantile: float = 0.8
    stall_window: int = 6
    stall_ratio: float = 0.5
    max_refreshes: int = 1

    def __post_init__(self) -> None:
        check_settings(self, positive=["factor"], not_negative=["max_refreshes"])
        if not 0 <= self.quantile <= 1:
            raise SettingError(f"quantile must be in [0, 1], got {self.quantile}")
        if self.stall_window < 1 or not 0 < self.stall_ratio < 1:
            got = f"got {self.stall_window} and {self.stall_ratio}"
            raise SettingError(f"stall_window must be at least 1 and stall_ratio in (0, 1), {got}")

    def bounds(self, ratio: Array) -> tuple[float, float, float]:
        """(per_norm, per_scale, least), from ||Lambda_i||_2 / m_i, the `ratio` of all poses, (n,)."""
        # Where the multipliers are zero but for rounding (measurements without noise) any penalty works that M + D/2
        # does not lose to rounding.
        floor = max(float(np.quantile(ratio, self.quantile)), _SMALLEST_RATIO)
        return self.factor, self.factor * floor, 0.0


@dataclass(frozen=True)
class FixedPenalty(_Rule):
    """rho_i = rho for all poses, unless the safeguard of `solvers.soc.soc` raises it."""

    rho: float

    def __post_init__(self) -> None:
        check_settings(self, positive=["rho"])

    def bounds(self, ratio: Array) -> tuple[float, float, float]:
        """(0, 0, rho), whatever the `ratio`, (n,)."""
        return 0.0, 0.0, self.rho


class _ScaledRule(_Rule):
    """A rule that begins at `scale` times m_i, and balances residuals from there."""

    scale: float

    def bounds(self, ratio: Array) -> tuple[float, float, float]:
        """(0, scale, 0)."""
        return 0.0, self.scale, 0.0


@dataclass(frozen=True)
class BalancedPenalty(_ScaledRule):
    """rho that balances relative residuals (after OSQP, Stellato et al. 2020, section 5.2).

    It starts at `scale` times m_i, the mean diagonal of M over the rotation rows of the pose. The balance asks for rho
    times sqrt(primal / dual); rho moves that way by `refactor_ratio`, and the matrices are factored again, once that is
    asked for or more: once one residual is `refactor_ratio`^2 times the other. B is rescaled with it. A rise of the
    merit puts rho up again (the safeguard of `solvers.soc.soc`).

    This is not the rule of Boyd et al. 2011, which is `BoydPenalty`: its dual residual has the factor rho, and so the
    unit of the weights. Here both are lengths of rotations: ||R - omega|| and, without rho, ||omega - omega_last||.
    They seldom differ by `refactor_ratio`^2; on the paper's scenes rho stays where it starts.
    """

    scale: float = 0.3
    refactor_ratio: float = 5.0

    def __post_init__(self) -> None:
        check_settings(self, positive=["scale"], above_one=["refactor_ratio"])

    def factor(self, primal_residual: float, dual_residual: float) -> float:
        """Factor by which rho moves now; 1 for not at all."""
        worth_it = self.refactor_ratio**2
        if primal_residual > 0 and primal_residual >= worth_it * dual_residual:
            return self.refactor_ratio
        return 1.0 / self.refactor_ratio if dual_residual > 0 and dual_residual >= worth_it * primal_residual else 1.0


@dataclass(frozen=True)
class BoydPenalty(_ScaledRule):
    """One rho for all poses that balances residuals as in Boyd et al. 2011, section 3.4.1, (3.13); for PaperSOC.

    rho <- growth rho where ||r|| > imbalance ||s||, rho / growth where ||s|| > imbalance ||r||, with r = R - omega and
    s = rho (omega - omega_last), and with it B. There is no safeguard. s has the weights' unit: iterates vary with it.
    """

    scale: float = 1.0  # first rho over the mean of m_i; Boyd gives none, and the paper neither
    imbalance: float = 10.0  # Boyd's mu
    growth: float = 2.0  # Boyd's tau

    def __post_init__(self) -> None:
        check_settings(self, positive=["scale"], above_one=["imbalance", "growth"])

    def factor(self, primal_residual: float, dual_residual: float) -> float:
        """Factor by which rho moves now, from ||r|| and ||s||; 1 for not at all."""
        if primal_residual > self.imbalance * dual_residual:
            return self.growth
        return 1.0 / self.growth if dual_residual > self.imbalance * primal_residual else 1.0


PenaltyRule = MultiplierPenalty | FixedPenalty | BalancedPenalty


def rotation_scale(problem: PGOProblem) -> Array:
    """m_i, (n,): the mean diagonal of M over the rotation rows of every pose."""
    diagonal = problem.M.data[problem.diagonal_positions[problem.num_poses :]]
    return np.asarray(diagonal.reshape(problem.num_poses, problem.d).mean(axis=1))


class Due(enum.Enum):
    """What the penalty needs before the next step."""

    NOTHING = "it stays"
    RAISE = "back to the best iterate with twice the penalty: the recursion diverges or cycles"
    REFRESH = "the multipliers anew: the recursion has stalled"
    SECOND_LOOK = "the same, if the translation penalty then falls as far as it can"
    RESCALE = "another rho, and B with it: the residuals are out of balance"


@dataclass(frozen=True, eq=False, kw_only=True)
class Steps:
    """Iterate k, and what the steps so far say of the penalty: what the states of all couplings have."""

    k: int = 0
    sums: AndersonSums = field(default_factory=AndersonSums)  # what all parties know of the acceleration
    # primal_residual, dual_residual: ||x - z||_rho and ||c (z - z_before)||_rho, both over ||omega||_rho, with c =
    # max(1, rho / diagonal of M): a penalty far above M makes short steps anywhere. It also takes extrapolated z back
    # to z_before, so that the dual residual has (c - 1) (x - z), too.
    primal_residual: float = np.inf
    dual_residual: float = np.inf
    merits: tuple[float, ...] = ()  # fixed-point residual ||x - z_before||_rho of the steps since rho last changed
    # refreshes, raises: how often the penalty rule, and the safeguard against divergence, changed rho.
    refreshes: int = 0
    raises: int = 0

    def is_best(self, merit: float) -> bool:
        """Whether no merit has been smaller since rho last changed."""
        return merit <= min(self.merits, default=np.inf)

    def after(self, merit: float, squares: Array, size: float, sums: AndersonSums) -> Self:
        """State after a step with this merit, squared residuals (2,) and ||omega||_rho."""
        primal, dual = (np.sqrt(squares) / size).tolist()
        merits = (*self.merits, merit)
        return replace(self, k=self.k + 1, sums=sums, primal_residual=primal, dual_residual=dual, merits=merits)

    def broken(self) -> Self:
        """State after a step that is not finite."""
        return replace(self, k=self.k + 1, primal_residual=np.nan, dual_residual=np.nan)

    def in_place_of(self, before: Self) -> Self:
        """State that follows `before` without a step: its penalties are taken anew."""
        return replace(self, k=before.k, refreshes=before.refreshes + 1, raises=before.raises)

    def measurement(self, objective: float) -> Measurement:
        """F and the residuals."""
        return Measurement(objective, self.primal_residual, self.dual_residual)


@dataclass(frozen=True, eq=False, kw_only=True)
class SharedSteps(Steps):
    """What is known of all robots' rows, which are theirs."""

    ratio: Array  # (n,): rho_i / m_i of all poses, in no order
    size: float  # ||omega||_rho

    def rescaled(self, factor: float) -> Self:
        """State after all have multiplied rho, and forgotten what was accelerated."""
        ratio, size = factor * self.ratio, math.sqrt(factor) * self.size
        return replace(self, ratio=ratio, size=size, sums=AndersonSums(), merits=())


def next_penalty(rule: PenaltyRule, ratio: Array, steps: Steps) -> tuple[Due, float]:
    """What is due before the next step, and the factor on rho; `ratio` is rho_i / m_i of all poses."""
    merits, refreshes, raises = steps.merits, steps.refreshes, steps.raises
    residuals = steps.primal_residual, steps.dual_residual
    if raises < MAX_RAISES and (has_diverged(merits) or is_going_round(merits, ratio)):
        return Due.RAISE, 2.0
    if isinstance(rule, MultiplierPenalty):
        if has_stalled(rule, merits) and refreshes < rule.max_refreshes:
            return Due.REFRESH, 1.0
        if is_second_look(refreshes, merits, max(residuals)):
            return Due.SECOND_LOOK, 1.0
    if isinstance(rule, BalancedPenalty) and np.isfinite(residuals).all():
        factor = rule.factor(*residuals)
        if factor != 1.0 and (factor > 1.0 or raises == 0):
            return Due.RESCALE, factor
    return Due.NOTHING, 1.0


def has_stalled(rule: MultiplierPenalty, merits: tuple[float, ...]) -> bool:
    """Whether the last of `stall_window` merits is not below `stall_ratio` of the first of them."""
    window = rule.stall_window
    return len(merits) >= window and merits[-1] > rule.stall_ratio * merits[-window]


def has_diverged(merits: tuple[float, ...]) -> bool:
    """Whether the merit has grown far above the smallest."""
    return len(merits) >= 2 and merits[-1] > _DIVERGED * min(merits)


def is_going_round(merits: tuple[float, ...], ratio: Array) -> bool:
    """Stagnation: no new best residual in 20 iterations, with rho_i / m_i so small that cycling is suspected."""
    if len(merits) < 2:
        return False
    steps_since_smallest = len(merits) - 1 - merits.index(min(merits))
    return steps_since_smallest >= _PATIENCE and bool(np.median(ratio) < _ENOUGH)
