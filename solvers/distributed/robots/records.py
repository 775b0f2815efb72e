"""What the driver asks a robot's interior, and what it answers; g boundary poses, vectors of w unknowns a pose."""

from dataclasses import dataclass

from pgo_models.geometry.rotations import Array
from solvers.distributed.robots.proof import ProofSums
from solvers.soc.copies import OwnPoses
from solvers.soc.recursion_block import Agreement

ALONG_TREE = ("b", "schur", "x")  # fields of what goes between a robot and the front above it


@dataclass(frozen=True, eq=False)
class RightHandSide:
    """b on the boundary with the interior eliminated, (w g, k), and b_I . K_II^-1 b_I."""

    b: Array
    energy: float


@dataclass(frozen=True, eq=False)
class Reduced:
    """A robot's matrix and right-hand side with the interior eliminated."""

    schur: Array  # (w g (w g + 1) / 2,): lower triangle, packed
    diagonal: Array  # (w g,): of the matrix before the elimination
    right: RightHandSide


@dataclass(frozen=True, eq=False)
class ReducedTranslations:
    """Right-hand side of the best translations, (g, d), and the first time their matrix."""

    b: Array
    schur: Array | None


@dataclass(frozen=True, eq=False)
class CostParts:
    """Part of F and of its rounding level, and the rows of M X on the boundary, ((d+1) g, d)."""

    objective: float
    level: float
    force: Array


@dataclass(frozen=True)
class Reweigh:
    """Control mu of a robust loss's surrogate, scale of the thresholds, weight under which an edge hardly counts."""

    is_truncated: bool
    mu: float
    scale: float
    least: float


@dataclass(frozen=True, eq=False)
class Reweighed:
    """The cost with new weights, and the diagonal of its M on the boundary."""

    diagonal: Array
    at: CostParts


@dataclass(frozen=True)
class RatioSums:
    """Of the edges that may be wrong: counts, and the least and largest r^2 / c^2; and the robust cost of all."""

    count: float
    undecided: float
    kept: float
    least: float
    largest: float
    largest_kept: float
    cost: float


@dataclass(frozen=True, eq=False)
class TrialEvaluation:
    """`CostParts` at a trial, and the reduced gradient there."""

    at: CostParts
    gradient: RightHandSide


@dataclass(frozen=True)
class RescaleInterior:
    """Factor on rho, and whether all go back to their best iterate."""

    factor: float
    from_best: bool


@dataclass(frozen=True, eq=False)
class Agree:
    """What all parties learn from step (a), and the rows of the next omega on the boundary, (dg, d)."""

    agreement: Agreement
    measured_at: Array


@dataclass(frozen=True, eq=False)
class Agreed:
    """Squared residuals, (2,), the right-hand side of the next step (a), and part of F at omega."""

    sums: Array
    right: RightHandSide
    measured: float


@dataclass(frozen=True)
class ModelOrder:
    """Newton's matrix, that of S + eta blockdiag(0, I), or the Gauss-Newton one with a share of its diagonal added."""

    second_order: bool
    damping: float
    eta: float = 0.0

    @property
    def is_newton(self) -> bool:
        """Whether it is the Hessian."""
        return self.second_order and not self.eta


@dataclass(frozen=True, eq=False)
class Move:
    """H^-1 g on the boundary, (w g, 1), and how far to go along minus it."""

    x: Array
    length: float


@dataclass(frozen=True, eq=False)
class ProofOrder:
    """How S is eliminated for a proof."""

    eta: float
    share: float  # at least so much of the diagonal is subtracted
    fixed: Array  # ((d+1) g,): 1 for rows on the boundary that are left out
    diagonal: Array  # ((d+1) g,): of S there, summed over robots, or more
    point: Array | None  # ((d+1) g, d): X there, where a proof begins


@dataclass(frozen=True, eq=False)
class ProofStep:
    """Parts of the bound, and the right-hand side of the next move."""

    sums: ProofSums
    right: RightHandSide


@dataclass(frozen=True, eq=False)
class ProofAnswer:
    """S with the interior eliminated, None where it is not definite; part of tr(Lambda); the first step of a proof."""

    schur: Array | None
    sizes: Array | None  # ((d+1) g,): `row_sums` of it
    trace: float
    step: ProofStep | None


@dataclass(frozen=True, eq=False)
class InteriorPoses(OwnPoses):
    """Interior poses, and their multipliers."""

    Lambda: Array
