"""Rows of the recursion of `solvers.soc.soc` that one party answers for: a robot's interior, or the driver's cover.

Sums over parties (of squares, and for the acceleration) are all that they need of each other.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pgo_models.geometry.rotations import Array, project_to_rotations, stack_transposes, unstack_transposes
from pgo_models.problem.matrices import inner
from solvers.soc.anderson import over_relax
from solvers.soc.shared_anderson import AndersonShare


@dataclass(frozen=True, eq=False)
class RotationBlock:
    """k rotations of the recursion; arrays are (dk, d), the rows of every R_i^T, as in `solvers.soc.soc.SOCState`.

    Attributes
    ----------
    rho : (k,)
    diagonal : (dk,)
        Diagonal of M on these rows.
    z : (dk, d)
        omega.
    s : (dk, d)
        x + B before the projection.
    x : (dk, d)
        Of the last step (a).
    best : (dk, d)
        The s of the smallest merit.
    anderson : AndersonShare
    """

    rho: Array
    diagonal: Array
    z: Array
    s: Array
    x: Array
    best: Array
    anderson: AndersonShare = field(default_factory=AndersonShare)

    @property
    def shift(self) -> Array:
        """Omega - B, what step (a) pulls x towards."""
        return 2.0 * self.z - self.s

    @property
    def penalty(self) -> Array:
        """Rho of every row, (dk,)."""
        return np.repeat(self.rho, self.z.shape[1])

    def after_solve(self, x: Array, alpha: float, memory: int) -> tuple[RotationBlock, Array]:
        """Block with the x of step (a), and this party's sums for the acceleration."""
        step = over_relax(x, self.z, alpha) - self.z
        residual = np.sqrt(self.penalty)[:, None] * step
        sums, anderson = self.anderson.observe(residual, step + self.s, memory)
        return replace(self, x=x, anderson=anderson), sums

    def after_agreement(self, gamma: Array | None, is_best: bool) -> tuple[RotationBlock, Array]:
        """Steps (b) and (c) with the coefficients of the acceleration; None restarts it.

        Returns
        -------
        block : RotationBlock
        sums : (2,)
            ||x - z||_rho^2 and ||c (z - z_before)||_rho^2.
        """
        anderson = self.anderson if gamma is not None else self.anderson.restarted()
        s = anderson.combine(gamma if gamma is not None else np.zeros(0))
        z = stack_transposes(project_to_rotations(unstack_transposes(s))) if np.isfinite(s).all() else s
        weight = np.sqrt(self.penalty)
        primal = weight[:, None] * (self.x - z)
        dual = (weight * np.maximum(1.0, self.penalty / self.diagonal))[:, None] * (z - self.z)
        best = self.s if is_best else self.best
        return replace(self, z=z, s=s, best=best, anderson=anderson), np.array(
            [inner(primal, primal), inner(dual, dual)]
        )

    def rescaled(self, factor: float) -> RotationBlock:
        """Block with factor * rho and the same unscaled multiplier rho B."""
        s = self.z + (self.s - self.z) / factor
        return replace(self, rho=factor * self.rho, s=s, anderson=AndersonShare())

    def back_at_best(self) -> RotationBlock:
        """Block at the s of the smallest merit."""
        return replace(self, s=self.best, z=stack_transposes(project_to_rotations(unstack_transposes(self.best))))


def block_at(R: Array, rho: Array, diagonal: Array, B: Array | None = None) -> RotationBlock:
    """Block with omega = R, (k, d, d), and B, zero unless given."""
    z = stack_transposes(R)
    s = z if B is None else z + B
    return RotationBlock(rho, diagonal, z, s, z, s)


def stationary_B(R: Array, Lambda: Array, rho: Array) -> Array:
    """B, (dk, d), of a stationary point: the rows of every (-2 Lambda_i R_i^T / rho_i)."""
    return stack_transposes(np.swapaxes(Lambda @ np.swapaxes(R, 1, 2), 1, 2) * (-2.0 / rho)[:, None, None])
