"""The recursion of many robots: the rows of it that one party answers for, from (a) to (c).

The party is a robot that holds copies (CONSENSUS), or a robot's interior or the driver's cover
(SUBSTRUCTURED). Steps (a), (b) and (c) are those of `solvers.soc.joint`, written for rows of the
stacked rotations. The parties need of each other the rows that they agree on in (b), and sums of
squares and of products for the acceleration.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from pgo_models.geometry.rotations import (
    Array,
    BoolArray,
    project_to_rotations,
    stack_transposes,
    unstack_transposes,
)
from pgo_models.problem.matrices import inner
from pgo_models.problem.stationarity import quotient
from solvers.carry.registry import record
from solvers.soc.anderson import AndersonShare, over_relax
from solvers.soc.rounding import WHOLE


@record("Rotations")
class Rotations(enum.Enum):
    """What step (b) does with the rotations.

    The chordal start relaxes them first, and then fixes what it has projected to find translations.
    """

    PROJECTED = "projected to the nearest rotations"
    RELAXED = "left as means, except pose 0, which is held at the identity"
    FIXED = "all held as they are"


@record("StepSettings")
@dataclass(frozen=True)
class StepSettings:
    """The settings of SOC that a robot needs; they are sent once."""

    alpha: float = 1.0  # over-relaxation
    memory: int = 0  # differences that the acceleration keeps; 0 for no acceleration
    local_passes: int = 1
    bytes_per_number: int = WHOLE  # of the rows that robots send each other
    rotations: Rotations = Rotations.PROJECTED


@record("Agreement")
@dataclass(frozen=True)
class Agreement:
    """What all parties learn from the sums of step (a)."""

    gamma: Array | None  # (q,): coefficients of the acceleration; None restarts it
    is_best: bool  # whether the s before this step has the smallest merit


@record("RecursionBlock")
@dataclass(frozen=True, eq=False)
class RecursionBlock:
    """Rows of x, omega, B and rho: the rows of every R_i^T, and of separator translations."""

    rho: Array  # (rows,): penalty of every row; zero for rows that have no part in the iterates
    diagonal: Array  # (rows,): diagonal of M on these rows
    # (rows, d): what the parties have agreed on: rotations, and the translations of separators
    omega: Array
    # (rows, d): omega + B, the variable of the fixed-point map, which is accelerated; what (b) is
    # applied to. B itself is not summed up from step to step, so that nothing drifts.
    s: Array
    x: Array  # (rows, d): solution of the last step (a)
    best: Array  # (rows, d): the s with the smallest merit
    settings: StepSettings = field(default_factory=StepSettings)
    # rows of what the acceleration remembers
    anderson: AndersonShare = field(default_factory=AndersonShare)

    @property
    def B(self) -> Array:
        """Scaled multiplier (Bregman variable), (rows, d)."""
        return self.s - self.omega

    @property
    def shift(self) -> Array:
        """Omega - B, (rows, d), towards which step (a) pulls x."""
        return 2.0 * self.omega - self.s

    @property
    def is_finite(self) -> bool:
        """Whether all entries of s are finite."""
        return bool(np.isfinite(self.s).all())

    def after_solve(self, x: Array) -> tuple[RecursionBlock, Array]:
        """Block with the x of step (a), (rows, d), and this party's sums for the acceleration."""
        step = self.step_of_map(x, self, self.settings.alpha)
        return self.after_map(x, step, self.s + step)

    def after_local_passes(
        self, solve: Callable[[Array], Array], private: BoolArray
    ) -> RecursionBlock:
        """Block after all but the last of the local passes: (a) to (c) on private rows, (rows,).

        No other party holds these rows. `solve` is step (a), from omega - B.
        """
        passes = self.settings.local_passes - 1
        if not (passes and private.any() and self.is_finite):
            return self
        omega = self.omega.copy()
        s = self.s.copy()
        for _ in range(passes):
            x = solve(2.0 * omega - s)  # (a)
            s[private] += (x - omega)[private]  # s = x + B
            omega[private] = nearest_rotations(s[private])  # (b), and (c) B = s - omega
        return replace(self, omega=omega, s=s)

    def step_of_map(self, x: Array, local: RecursionBlock, alpha: float) -> Array:
        """Step from s of the fixed-point map, (rows, d), where step (a) gives x.

        `local` is the block after local passes, from which step (a) started; this block itself if
        there were none.
        """
        return over_relax(x, local.omega, alpha) - local.omega + (local.s - self.s)

    def after_map(self, x: Array, step: Array, image: Array) -> tuple[RecursionBlock, Array]:
        """Block with x, and the sums, where the fixed-point map takes s to `image` = s + step."""
        residual = np.sqrt(self.rho)[:, None] * step
        sums, anderson = self.anderson.observe(residual, image, self.settings.memory)
        return replace(self, x=x, anderson=anderson), sums

    def extrapolated(self, agreement: Agreement) -> RecursionBlock:
        """Block with the next s, before it is agreed on."""
        s, anderson = self.anderson.extrapolated(agreement.gamma)
        best = self.s if agreement.is_best else self.best
        return replace(self, s=s, best=best, anderson=anderson)

    def agreed(self, omega: Array) -> tuple[RecursionBlock, Array]:
        """Block after step (b), which gives omega, and (c), B = s - omega = B + x - omega.

        The sums, (2,), are this party's part of the squared residuals (`squared_residuals`).
        """
        stiffness = np.maximum(1.0, quotient(self.rho, self.diagonal))[:, None]
        squares = squared_residuals(self.x, omega, self.omega, self.rho[:, None], stiffness)
        return replace(self, omega=omega), squares

    def projected(self) -> tuple[RecursionBlock, Array]:
        """Block after (b) and (c), where all rows are rotations that no other party holds."""
        return self.agreed(nearest_rotations(self.s) if self.is_finite else self.s)

    def rescaled(self, rho: Array) -> RecursionBlock:
        """Block with another penalty and the same unscaled multiplier rho B."""
        ratio = np.divide(self.rho, rho, out=np.ones_like(rho), where=rho > 0)
        s = self.omega + ratio[:, None] * self.B
        return replace(self, rho=rho, s=s, anderson=AndersonShare())

    def back_at_best(self) -> RecursionBlock:
        """Block at the s of the smallest merit."""
        return replace(self, s=self.best, omega=nearest_rotations(self.best))


def block_at(
    omega: Array, rho: Array, diagonal: Array, settings: StepSettings, B: Array | float = 0.0
) -> RecursionBlock:
    """Block of parties that agree on omega, (rows, d), with the multipliers B."""
    s = omega + B
    return RecursionBlock(rho, diagonal, omega, s, omega, s, settings)


def nearest_rotations(rows: Array) -> Array:
    """Project rows of R_i^T, (dk, d), to the nearest rotations: step (b), in closed form."""
    return stack_transposes(project_to_rotations(unstack_transposes(rows)))


def squared_residuals(
    x: Array, omega: Array, omega_before: Array, rho: Array, stiffness: Array
) -> Array:
    """Squares of the primal and the dual residual, (2,), times ||omega||_rho^2.

    The residuals are those of `solvers.soc.safeguard.Steps`. rho and `stiffness`, max(1, rho /
    diagonal of M), are broadcast against the other arrays.
    """
    weight = np.sqrt(rho)
    primal = weight * (x - omega)
    change = stiffness * (weight * (omega - omega_before))
    taken_back = (stiffness - 1.0) * primal
    return np.array([inner(primal, primal), inner(change, change) + inner(taken_back, taken_back)])


def stationary_B(R: Array, Lambda: Array, rho: Array) -> Array:
    """B of a stationary point, (k, d, d): every B_i is -2 / rho_i times (Lambda_i R_i^T)^T."""
    products = Lambda @ np.swapaxes(R, 1, 2)
    factors = (-2.0 / rho)[:, None, None]
    return np.swapaxes(products, 1, 2) * factors
