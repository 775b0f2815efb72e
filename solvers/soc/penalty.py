"""Rules for the ADMM penalty rho: from the multipliers, fixed, or balanced by the residuals."""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from pgo_models.certificates.dual_variables import multiplier_norms, multipliers
from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, stack_transposes
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.stationarity import rotation_scale
from solvers.carry.registry import record
from solvers.soc.recursion_block import RecursionBlock, StepSettings, block_at, stationary_B

_SMALLEST_RATIO = 1e-6  # of ||Lambda_i|| to m_i; M + D/2 keeps ten digits
BALANCED_RATIO = 5.0  # by which a BalancedPenalty moves


@record("PenaltyOrder")
@dataclass(frozen=True)
class PenaltyOrder:
    """What a party must know to set its penalties.

        rho_i = max(per_norm ||Lambda_i||_2, per_scale m_i, least)

    with m_i the mean diagonal of M over the rotation rows of pose i.
    """

    per_norm: float
    per_scale: float
    least: float
    # Whether B starts at its value at a stationary point, `stationary_B`; else at zero.
    is_stationary: bool = False
    settings: StepSettings = field(default_factory=StepSettings)

    def rho(self, norms: Array, scale: Array) -> Array:
        """Penalties, (n,), from ||Lambda_i||_2 and m_i."""
        scaled = np.maximum(self.per_norm * norms, self.per_scale * scale)
        return np.asarray(np.maximum(scaled, self.least))

    def block(self, R: Array, Lambda: Array, diagonal: Array) -> RecursionBlock:
        """Rows of a party at its rotations R, (k, d, d), with this penalty.

        `diagonal`, (dk,), is that of M on these rows.
        """
        d = R.shape[-1]
        rho = self.rho(multiplier_norms(Lambda), diagonal.reshape(-1, d).mean(axis=1))
        B = stack_transposes(stationary_B(R, Lambda, rho)) if self.is_stationary else 0.0
        return block_at(stack_transposes(R), np.repeat(rho, d), diagonal, self.settings, B)


class PenaltyRule(Protocol):
    """A rule of the penalty: one of those below, or a user's own, for `SOC(penalty=..)`.

    A rule of one's own has both methods, or has this class as its base: the penalties then stay
    where `bounds` puts them, but for the safeguard.
    """

    def bounds(self, ratio: Array) -> tuple[float, float, float]:
        """Return (per_norm, per_scale, least) of the first penalties.

        They are rho_i = max(per_norm ||Lambda_i||_2, per_scale m_i, least). `ratio`, (n,), is
        ||Lambda_i||_2 / m_i of all poses: the norm of the multiplier of a pose at the start, over
        the mean diagonal of M over its rotation rows.
        """

    def rescaling(self, primal_residual: float, dual_residual: float) -> float:
        """Return the factor by which all penalties move before the next step.

        The residuals ||R - omega|| and ||omega - omega_last|| are relative. Each factor other than
        1 costs a factorisation. Once the safeguard has raised the penalties, factors below 1 are
        left out.
        """
        return 1.0


def _balancing(imbalance: float, growth: float, primal: float, dual: float) -> float:
    """`growth` where primal > imbalance dual, 1 / growth where dual > imbalance primal."""
    if primal > imbalance * dual:
        return growth
    if dual > imbalance * primal:
        return 1.0 / growth
    return 1.0


def first_penalties(rule: PenaltyRule, problem: PGOProblem, poses: Poses) -> Array:
    """Penalties rho, (n,), of a rule at poses."""
    norms = multiplier_norms(multipliers(problem, poses))
    scale = rotation_scale(problem)
    return PenaltyOrder(*rule.bounds(norms / scale)).rho(norms, scale)


@record("MultiplierPenalty")
@dataclass(frozen=True)
class MultiplierPenalty(PenaltyRule):
    """A penalty of every pose from its multiplier: rho_i = factor max(||Lambda_i||_2, q m_i).

    m_i is the mean diagonal of M over the rotation rows of pose i, and q a quantile of
    ||Lambda_i||_2 / m_i over all poses. The multipliers measure how far from convex the constraint
    makes each pose. They are taken at the start, and once more where the recursion stalls: where
    the residual of the last `stall_window` iterations has not fallen below `stall_ratio` of what it
    was. B then restarts at its stationary value there, -2 Lambda_i R_i^T / rho_i.

    Parameters
    ----------
    factor : float
        Penalty over the norm of the multiplier.
    quantile : float in [0, 1]
        Which quantile of ||Lambda_i||_2 / m_i bounds the penalties from below.
    stall_window : int, at least 1
        Number of iterations over which progress is judged.
    stall_ratio : float in (0, 1)
        The recursion has stalled when the residual fell by less than this over the window.
    max_refreshes : int
        How often the multipliers are taken anew.

    Examples
    --------
    >>> from solvers import SOC
    >>> SOC(penalty=MultiplierPenalty(factor=4.0)).penalty.factor
    4.0
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
        """(factor, factor q, 0), with q the quantile of ||Lambda_i||_2 / m_i."""
        # Where the multipliers are zero but for rounding (measurements without noise), any penalty
        # works that M + D/2 does not lose to rounding.
        q = max(float(np.quantile(ratio, self.quantile)), _SMALLEST_RATIO)
        return self.factor, self.factor * q, 0.0


@record("FixedPenalty")
@dataclass(frozen=True)
class FixedPenalty(PenaltyRule):
    """The same penalty for all poses, rho_i = rho, unless the safeguard raises it.

    Parameters
    ----------
    rho : float
        The penalty, in the unit of kappa.

    Examples
    --------
    >>> FixedPenalty(10.0)
    FixedPenalty(rho=10.0)
    """

    rho: float

    def __post_init__(self) -> None:
        check_settings(self, positive=["rho"])

    def bounds(self, ratio: Array) -> tuple[float, float, float]:
        """(0, 0, rho), whatever the multipliers are."""
        return 0.0, 0.0, self.rho


@record("BalancedPenalty")
@dataclass(frozen=True)
class BalancedPenalty(PenaltyRule):
    """A penalty that balances the relative residuals, after OSQP (Stellato et al. 2020).

    It starts at `scale` times m_i, the mean diagonal of M over the rotation rows of the pose. The
    balance asks for rho times sqrt(primal / dual). To save factorisations rho only moves when that
    factor reaches 5 or its inverse, and then by just this ratio: when one residual is 25 times the
    other. B is rescaled with it. A rise of the merit puts rho up again (`solvers.soc.safeguard`).

    This is not the rule of Boyd et al. 2011, which is `BoydPenalty`: its dual residual has the
    factor rho, and so the unit of the weights. Here both are lengths of rotations: ||R - omega||
    and, without rho, ||omega - omega_last||. They seldom differ so much; on the paper's scenes rho
    stays where it starts.

    Parameters
    ----------
    scale : float
        First rho_i over m_i.

    References
    ----------
    Stellato et al., OSQP: an operator splitting solver for quadratic programs, 2020, section 5.2.
    """

    scale: float = 0.3

    def __post_init__(self) -> None:
        check_settings(self, positive=["scale"])

    def bounds(self, ratio: Array) -> tuple[float, float, float]:
        """(0, scale, 0), whatever the multipliers are."""
        return 0.0, self.scale, 0.0

    def rescaling(self, primal_residual: float, dual_residual: float) -> float:
        """Return `BALANCED_RATIO`, its inverse, or 1 where rho stays."""
        return _balancing(BALANCED_RATIO**2, BALANCED_RATIO, primal_residual, dual_residual)


@record("BoydPenalty")
@dataclass(frozen=True)
class BoydPenalty(PenaltyRule):
    """One penalty for all poses that balances residuals as Boyd et al. 2011, (3.13); for PaperSOC.

    rho <- 2 rho where ||r|| > 10 ||s||, and rho / 2 where ||s|| > 10 ||r||, with r = R - omega and
    s = rho (omega - omega_last); B is rescaled with it. The numbers are Boyd's tau and mu. There is
    no safeguard. s has the weights' unit: iterates vary with it.

    Parameters
    ----------
    scale : float
        First rho over the mean of m_i. Neither Boyd nor the paper gives one.

    References
    ----------
    Boyd et al., Distributed optimization and statistical learning via the alternating direction
    method of multipliers, 2011, section 3.4.1.
    """

    scale: float = 1.0

    def __post_init__(self) -> None:
        check_settings(self, positive=["scale"])

    def bounds(self, ratio: Array) -> tuple[float, float, float]:
        """(0, scale, 0), whatever the multipliers are."""
        return 0.0, self.scale, 0.0

    def rescaling(self, primal_residual: float, dual_residual: float) -> float:
        """Return 2, 1 / 2, or 1 where rho stays, from ||r|| and ||s||."""
        return _balancing(10.0, 2.0, primal_residual, dual_residual)
