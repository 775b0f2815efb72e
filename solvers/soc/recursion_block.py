"""The kernel of every coupling: rows of the recursion that one party answers for, from step (a) to step (c).

The party is the whole graph (JOINT), a robot that holds copies (CONSENSUS), a robot's interior or the driver's cover
(SUBSTRUCTURED). It solves (a) and says what its rows agree on in (b); sums over the parties (of squares, and for the
acceleration) are all that they need of each other.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field, replace

import numpy as np

from pgo_models.geometry.rotations import Array, project_to_rotations, stack_transposes, unstack_transposes
from pgo_models.problem.matrices import inner
from solvers.soc.anderson import Anderson, AndersonShare, over_relax


class Rotations(enum.Enum):
    """What step (b) does with them; the chordal start relaxes them, then finds translations for what it projects."""

    PROJECTED = "to the nearest ones"
    RELAXED = "means, but for pose 0, which is held at the identity"
    FIXED = "all are held"


@dataclass(frozen=True)
class StepSettings:
    """What a robot must know of SOC's settings, sent once."""

    alpha: float = 1.0  # over-relaxation
    memory: int = 0  # of the acceleration; 0 for none
    local_passes: int = 1
    alone: Anderson | None = None  # given where every robot extrapolates its own rows
    rotations: Rotations = Rotations.PROJECTED


@dataclass(frozen=True)
class Agreement:
    """What all parties learn from the sums of step (a)."""

    gamma: Array | None  # (q,): coefficients of the acceleration; None restarts it
    is_best: bool  # whether the s before this step has the smallest merit


@dataclass(frozen=True, eq=False)
class RecursionBlock:
    """Rows of the recursion: of every R_i^T, and of separator translations; arrays are (rows, d)."""

    penalty: Array  # (rows,): rho of every row; zero for rows that have no part in the iterates
    diagonal: Array  # (rows,): diagonal of M on these rows
    z: Array  # (rows, d): what is agreed on: omega, and the translations of separators
    s: Array  # (rows, d): x + B before the projection, extrapolated: the variable of the fixed-point map
    x: Array  # (rows, d): of the last step (a)
    best: Array  # (rows, d): the s of the smallest merit
    settings: StepSettings = field(default_factory=StepSettings)
    anderson: AndersonShare = field(default_factory=AndersonShare)

    @property
    def B(self) -> Array:
        """Scaled multiplier (Bregman variable)."""
        return self.s - self.z

    @property
    def shift(self) -> Array:
        """Omega - B, what step (a) pulls x towards."""
        return 2.0 * self.z - self.s

    @property
    def is_finite(self) -> bool:
        """Whether there is something to go on from."""
        return bool(np.isfinite(self.s).all())

    def after_solve(self, x: Array, z: Array | None = None, drift: Array | float = 0.0) -> tuple[RecursionBlock, Array]:
        """Block with the x of step (a), (rows, d), and this party's sums for the acceleration.

        Where local passes came first, z after them and by how much they moved z + B, `drift`, both (rows, d).
        """
        z = self.z if z is None else z
        step = over_relax(x, z, self.settings.alpha) - z + drift
        residual = np.sqrt(self.penalty)[:, None] * step
        sums, anderson = self.anderson.observe(residual, self.s + step, self.settings.memory)
        return replace(self, x=x, anderson=anderson), sums

    def extrapolated(self, agreement: Agreement) -> RecursionBlock:
        """Block with the next s, before it is agreed on."""
        s, anderson = self.anderson.extrapolated(agreement.gamma)
        return replace(self, s=s, best=self.s if agreement.is_best else self.best, anderson=anderson)

    def agreed(self, z: Array) -> tuple[RecursionBlock, Array]:
        """Block after step (b), which gives z, and (c): B = s - z = B + x - z.

        With it sums, (2,): the squares of the residuals times ||omega||_rho, as in `solvers.soc.penalty.Steps`.
        """
        weight, c = np.sqrt(self.penalty)[:, None], np.maximum(1.0, self.penalty / self.diagonal)[:, None]
        primal, change = weight * (self.x - z), c * weight * (z - self.z)
        taken_back = (c - 1.0) * primal
        squares = [inner(primal, primal), inner(change, change) + inner(taken_back, taken_back)]
        return replace(self, z=z), np.array(squares)

    def projected(self) -> tuple[RecursionBlock, Array]:
        """Block after (b) and (c) where all rows are rotations that no other party holds."""
        return self.agreed(nearest_rotations(self.s) if self.is_finite else self.s)

    def rescaled(self, penalty: Array) -> RecursionBlock:
        """Block with another penalty and the same unscaled multiplier rho B."""
        ratio = np.divide(self.penalty, penalty, out=np.ones_like(penalty), where=penalty > 0)
        return replace(self, penalty=penalty, s=self.z + ratio[:, None] * self.B, anderson=AndersonShare())

    def back_at_best(self) -> RecursionBlock:
        """Block at the s of the smallest merit."""
        return replace(self, s=self.best, z=nearest_rotations(self.best))


def block_at(z: Array, rho: Array, diagonal: Array, settings: StepSettings, B: Array | float = 0.0) -> RecursionBlock:
    """Block where all is agreed on z, with B."""
    s = z + B
    return RecursionBlock(rho, diagonal, z, s, z, s, settings)


def nearest_rotations(rows: Array) -> Array:
    """Step (b), closed form by SVD: rows of every R_i^T, (dk, d), of the rotations nearest to given ones."""
    return stack_transposes(project_to_rotations(unstack_transposes(rows)))


def stationary_B(R: Array, Lambda: Array, rho: Array) -> Array:
    """B, (dk, d), of a stationary point: the rows of every (-2 Lambda_i R_i^T / rho_i)."""
    return stack_transposes(np.swapaxes(Lambda @ np.swapaxes(R, 1, 2), 1, 2) * (-2.0 / rho)[:, None, None])
