"""What the driver asks a robot's interior, and what it answers.

Shapes are those of a robot with g boundary poses, and of vectors with w unknowns per pose.
"""

from dataclasses import dataclass, field

import numpy as np

from pgo_models.geometry.rotations import Array
from solvers.carry.registry import record
from solvers.robust.losses import RobustLoss
from solvers.robust.weighted_edges import RatioSums
from solvers.soc.copies import OwnPoses
from solvers.soc.recursion_block import Agreement


@record("RightHandSide")
@dataclass(frozen=True, eq=False)
class RightHandSide:
    """b on the boundary with the interior eliminated, (w g, k), and b_I . K_II^-1 b_I."""

    b: Array
    energy: float


@record("Reduced")
@dataclass(frozen=True, eq=False)
class Reduced:
    """A robot's matrix and right-hand side with the interior eliminated."""

    schur: Array  # as `Elimination.schur`
    diagonal: Array  # (w g,): of the matrix before the elimination
    right: RightHandSide


@record("ReducedTranslations")
@dataclass(frozen=True, eq=False)
class ReducedTranslations:
    """Right-hand side of the best translations, (g, d), and the first time their matrix."""

    b: Array
    schur: Array | None


@record("CostParts")
@dataclass(frozen=True, eq=False)
class CostParts:
    """Part of F and of its rounding level, and the rows of M X on the boundary, ((d+1) g, d).

    In a robust solve, `ratios` are the sums that belong to the last `Reweigh`.
    """

    objective: float
    level: float
    force: Array
    ratios: RatioSums | None = None


@record("Reweigh")
@dataclass(frozen=True)
class Reweigh:
    """How edges are weighed by their residuals in a robust solve."""

    is_truncated: bool
    mu: float  # control of the robust loss's surrogate
    scale: float  # of the thresholds
    least: float  # weight under which an edge hardly counts
    left_out: float  # weight of such an edge, which keeps its place in the matrices

    @property
    def loss(self) -> RobustLoss:
        """The robust loss."""
        return RobustLoss.TRUNCATED if self.is_truncated else RobustLoss.GEMAN_MCCLURE


@record("Reweighed")
@dataclass(frozen=True, eq=False)
class Reweighed:
    """The cost with new weights, and the diagonal of its M on the boundary."""

    diagonal: Array
    at: CostParts


@record("RescaleInterior")
@dataclass(frozen=True)
class RescaleInterior:
    """Change of the penalty in SOC."""

    factor: float  # on rho
    from_best: bool  # whether all go back to their best iterate


@record("Agree")
@dataclass(frozen=True, eq=False)
class Agree:
    """What all parties learn from step (a)."""

    agreement: Agreement
    measured_at: Array  # (dg, d): rows of the next omega on the boundary


@record("Agreed")
@dataclass(frozen=True, eq=False)
class Agreed:
    """What a robot answers to `Agree`."""

    sums: Array  # (2,): squared residuals
    right: RightHandSide  # of the next step (a)
    measured: float  # part of F at omega


@record("RobotAscent")
@dataclass(frozen=True, eq=False)
class RobotAscent:
    """Where a robot is in an ascent of handedness terms, with the k pairs that its edges join."""

    P: Array  # (k, 3, 3)
    best: Array  # (k, 3, 3): the P that had the largest smallest eigenvalue
    derivative: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))
    X: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (side, q): inverse iteration's


@record("VectorsOrder")
@dataclass(frozen=True, eq=False)
class VectorsOrder:
    """A step of inverse iteration: the right-hand sides become X C, with the solution x."""

    x: Array  # ((d+1) g, q): on the boundary
    C: Array  # (q, q)


@record("VectorsAnswer")
@dataclass(frozen=True, eq=False)
class VectorsAnswer:
    """Vectors X of inverse iteration, of right-hand sides b.

    Sums are over the rotations of the robot's interior.
    """

    b: Array  # ((d+1) g, q): the next right-hand side on the boundary, the interior eliminated
    energies: Array  # (q, q): X^T b
    products: Array  # (q, q): X^T X


@record("TermsAnswer")
@dataclass(frozen=True, eq=False)
class TermsAnswer:
    """Handedness terms of a robot's edges, before a proof with them."""

    num_pairs: int
    diagonal: Array  # ((d+1) g,): of M less the terms, on the boundary


@record("InteriorPoses")
@dataclass(frozen=True, eq=False)
class InteriorPoses(OwnPoses):
    """Interior poses, and their multipliers."""

    Lambda: Array
