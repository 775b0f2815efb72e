"""The safeguard of SOC: when the penalty rho changes, and why.

A rule of `solvers.soc.penalty` asks for other penalties where the recursion stalls or its residuals
are out of balance. Beside it the safeguard goes back to the best iterate and doubles rho where the
recursion diverges or cycles.
"""

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Self, TypeVar

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.summaries import Summarised
from solvers.result import Measurement
from solvers.soc.anderson import AndersonSums
from solvers.soc.penalty import MultiplierPenalty, PenaltyRule
from solvers.soc.separator_stiffness import is_recheck_due

# Doublings of rho in a run. Together they multiply it by 1e6.
MAX_RAISES = 20
# The recursion has diverged when the merit is so many times the smallest one.
_DIVERGED = 10.0
# It cycles when so many steps have brought no new smallest merit.
_PATIENCE = 20
# The run has stalled when so many iterations have not brought the larger residual down to this
# share of the smallest one before. Runs that converge on public graphs take 39 at most (M3500).
STALL_ITERATIONS = 100
_STALL_RATIO = 0.9


class Due(enum.Enum):
    """What the penalty needs before the next step."""

    NOTHING = "it stays"
    RAISE = "back to the best iterate with twice the penalty: the recursion diverges or cycles"
    REFRESH = "the multipliers anew: the recursion has stalled"
    RECHECK = "the same, if the translation penalty then falls as far as it can"
    RESCALE = "another rho, and B with it: the residuals are out of balance"


@dataclass(frozen=True, eq=False, kw_only=True)
class Steps(Summarised):
    """Number and residuals of iterate k, with the history that decides on the penalty.

    The states of all couplings have these fields. The residuals are

        primal  ||x - omega||_rho           / ||omega||_rho
        dual    ||c (omega - omega_last)||_rho / ||omega||_rho,    c = max(1, rho / diagonal of M)

    The factor c is there because a penalty far above M makes short steps anywhere. Extrapolation
    can take omega back to omega_last, so that the dual residual also has the term (c - 1) (x -
    omega).
    """

    k: int = 0
    # What all parties know of the acceleration.
    sums: AndersonSums = field(default_factory=AndersonSums)
    primal_residual: float = np.inf
    dual_residual: float = np.inf
    # Fixed-point residuals ||x - omega_last||_rho of the steps since rho last changed.
    merits: tuple[float, ...] = ()
    # How often the rule of the penalty changed rho, and how often the safeguard raised it.
    refreshes: int = 0
    raises: int = 0
    # The smallest of the larger residuals, as of the last iterate that lowered it by enough.
    least_residual: float = np.inf
    last_progress: int = 0

    def is_best(self, merit: float) -> bool:
        """Whether no merit has been smaller since rho last changed."""
        return merit <= min(self.merits, default=np.inf)

    def after(self, merit: float, squares: Array, size: float, sums: AndersonSums) -> Self:
        """State after a step with this merit, squared residuals (2,) and ||omega||_rho."""
        return replace(self, sums=sums, merits=(*self.merits, merit)).with_residuals(squares, size)

    def with_residuals(self, squares: Array, size: float) -> Self:
        """The next iterate, with these squared residuals, (2,), and ||omega||_rho."""
        primal, dual = (np.sqrt(squares) / size).tolist()
        following = replace(self, k=self.k + 1, primal_residual=primal, dual_residual=dual)
        residual = max(primal, dual)
        if not residual <= _STALL_RATIO * self.least_residual:
            return following
        return replace(following, least_residual=residual, last_progress=following.k)

    def broken(self) -> Self:
        """State after a step that is not finite."""
        return replace(self, k=self.k + 1, primal_residual=np.nan, dual_residual=np.nan)

    def in_place_of(self, before: Self) -> Self:
        """Return this new start as the successor of `before`, with penalties chosen anew."""
        return replace(
            self,
            k=before.k,
            refreshes=before.refreshes + 1,
            raises=before.raises,
            least_residual=before.least_residual,
            last_progress=before.last_progress,
        )

    def measurement(self, objective: float) -> Measurement:
        """F and the residuals."""
        return Measurement(objective, self.primal_residual, self.dual_residual)


@dataclass(frozen=True, eq=False, kw_only=True)
class SharedSteps(Steps):
    """Steps of a recursion whose rows are spread over robots: what all robots know."""

    size: float  # ||omega||_rho

    def rescaled(self, factor: float) -> Self:
        """State after all robots have multiplied rho by `factor`; the acceleration starts anew."""
        size = math.sqrt(factor) * self.size
        return replace(self, size=size, sums=AndersonSums(), merits=())


T = TypeVar("T", bound=Steps)


def with_due_penalty(
    rule: PenaltyRule,
    state: T,
    rescaled: Callable[[T, float, bool], T],
    refreshed: Callable[[T, Due], T],
) -> T:
    """State with the penalty that the rule or the safeguard asks for; usually unchanged.

    RAISE, from the safeguard, multiplies rho from the best iterate on, RESCALE, from the rule, from
    the current one: `rescaled` is given the state, the factor and which of the two it is. REFRESH
    and RECHECK are left to `refreshed`. `refreshes` counts the changes that the rule has made.
    """
    due, factor = next_penalty(rule, state)
    if due is Due.RAISE:
        return replace(rescaled(state, factor, True), raises=state.raises + 1)
    if due is Due.RESCALE:
        return replace(rescaled(state, factor, False), refreshes=state.refreshes + 1)
    return state if due is Due.NOTHING else refreshed(state, due)


def next_penalty(rule: PenaltyRule, steps: Steps) -> tuple[Due, float]:
    """What is due before the next step, and the factor on rho."""
    merits = steps.merits
    can_raise = steps.raises < MAX_RAISES
    has_diverged = len(merits) >= 2 and merits[-1] > _DIVERGED * min(merits)
    if can_raise and (has_diverged or is_cycling(merits)):
        return Due.RAISE, 2.0
    if isinstance(rule, MultiplierPenalty):
        return _due_of_multipliers(rule, steps), 1.0
    return _due_of_residuals(rule, steps)


def _due_of_multipliers(rule: MultiplierPenalty, steps: Steps) -> Due:
    if steps.refreshes < rule.max_refreshes and has_stalled(rule, steps.merits):
        return Due.REFRESH
    residual = max(steps.primal_residual, steps.dual_residual)
    if is_recheck_due(steps.refreshes, steps.merits, residual):
        return Due.RECHECK
    return Due.NOTHING


def _due_of_residuals(rule: PenaltyRule, steps: Steps) -> tuple[Due, float]:
    residuals = steps.primal_residual, steps.dual_residual
    if not np.isfinite(residuals).all():
        return Due.NOTHING, 1.0
    factor = rule.rescaling(*residuals)
    if not 0 < factor < math.inf:
        raise SettingError(
            f"{type(rule).__name__}.rescaling returned {factor}; it must be positive and finite"
        )
    # Once the safeguard has raised rho, the balance must not lower it again.
    if factor > 1.0 or (factor < 1.0 and steps.raises == 0):
        return Due.RESCALE, factor
    return Due.NOTHING, 1.0


def has_stalled(rule: MultiplierPenalty, merits: tuple[float, ...]) -> bool:
    """Whether the last of `stall_window` merits is not below `stall_ratio` of the first of them."""
    window = rule.stall_window
    return len(merits) >= window and merits[-1] > rule.stall_ratio * merits[-window]


def is_cycling(merits: tuple[float, ...]) -> bool:
    """Whether 20 steps brought no new smallest merit."""
    if len(merits) < 2:
        return False
    steps_since_smallest = len(merits) - 1 - merits.index(min(merits))
    return steps_since_smallest >= _PATIENCE
