"""Iterate of SOC in one place: what is carried from step to step."""

from __future__ import annotations

from dataclasses import dataclass

from pgo_models.geometry.rotations import Array
from solvers.soc.anderson import AndersonMemory
from solvers.soc.local_copies import LocalCopies
from solvers.soc.penalty import Steps


@dataclass(frozen=True, eq=False)
class SOCState(Steps):
    """Iterate k of JOINT or CONSENSUS; rows are those of vectors over the copies (`solvers.soc.local_copies`).

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
    rho_t : (n,)
        Penalty of the translations of separators.
    separator_rho : (n,)
        Least penalty of the rotations of separators under a MultiplierPenalty.
    copies : LocalCopies
        Robots with their prepared subproblems.
    memory : tuple of AndersonMemory
        One for all robots, one for every robot, or none yet.
    best : (rows, d)
        The s of the smallest merit.
    origin : tuple of two (rows, d), optional
        z and s when the penalty rule last set rho.
    """

    k: int
    x: Array
    omega: Array
    z: Array
    s: Array
    rho: Array
    rho_t: Array
    separator_rho: Array
    copies: LocalCopies
    memory: tuple[AndersonMemory, ...] = ()
    best: Array | None = None
    origin: tuple[Array, Array] | None = None

    @property
    def B(self) -> Array:
        """Scaled multiplier (Bregman variable), (rows, d)."""
        return self.s - self.z
