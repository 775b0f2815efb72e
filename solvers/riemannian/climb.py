"""From rank to rank of the Riemannian staircase, against an algebra (Rosen et al. 2019, alg. 1).

At a stationary point of rank r the relaxation is solved if a bound proves it. Else Q - Lambda has a
negative eigenvalue, whose eigenvector in one more dimension leads down. When a rank ends, and how,
is decided here; what that needs of poses and matrices is `ClimbAlgebra`. There are two: in
`solvers.riemannian.staircase` in one place, and in `solvers.robots.climb` by a driver and
its robots.

How the points of one rank are improved differs, and is worth it. In one place a product with Q is
cheap, and a step is a trust region with truncated conjugate gradients; robots would need two rounds
for each product, and factor the Hessian of lifted poses instead. A ring of 20 poses that is wound
up takes 181 products in one place, which robots would exchange in 362 rounds; Newton takes them
100. In one place Newton on lifted poses is two to fourteen times slower.
"""

import enum
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from pgo_models.certificates.lower_bound import NO_BOUND, LowerBound, smallest_shift
from pgo_models.geometry.rotations import Array
from solvers.result import Status
from solvers.riemannian.newton_step import HALVINGS, ROUNDING

SUFFICIENT = 0.25  # share of the decrease promised to second order that a move has to bring


@dataclass(frozen=True, eq=False)
class DualBound:
    """A proven lower bound on F (`pgo_models.certificates.lower_bound`), and its multipliers."""

    bound: LowerBound
    Lambda: Array  # (n, d, d)

    @property
    def lower_bound(self) -> float:
        """F of no poses is below it."""
        return self.bound.value


class ClimbDirection(Protocol):
    """An eigenvector v of Q - Lambda, as a move in one more dimension."""

    @property
    def value(self) -> float:
        """v^T (Q - Lambda) v for the norm 1: to second order f falls by s^2 |value| along s v."""

    @property
    def first_length(self) -> float:
        """Length s at which the block of s v that is largest turns by 45 degrees."""


V = TypeVar("V", bound=ClimbDirection)
T = TypeVar("T")


class ClimbAlgebra(Protocol[V, T]):
    """What a climb needs of the stationary point that it begins at."""

    @property
    def objective(self) -> float:
        """Value f at the point."""

    @property
    def rounding_level(self) -> float:
        """Value below which f cannot be told from zero."""

    @property
    def num_rows(self) -> int:
        """Number of rows of the rotations, n d."""

    @property
    def has_room(self) -> bool:
        """Whether the next rank fits into the memory allowed."""

    def prove(self, gap: float) -> LowerBound | None:
        """Return a bound with the smallest shift eta found, or None."""

    def with_multipliers(self, bound: LowerBound) -> DualBound:
        """Return a bound with the multipliers at the point."""

    def direction(self, proven: LowerBound, smallest: float) -> V:
        """Return the direction of the smallest eigenvalue; the proof had an eta > `smallest`."""

    def evaluate(self, direction: V, length: float) -> tuple[float, T]:
        """Return f after a move along the direction, and the point there."""

    def accept(self, trial: T) -> None:
        """Go to a point that `evaluate` returned."""


class ClimbEnding(enum.Enum):
    """How a climb ended."""

    SOLVED = "the value is the relaxation's optimum, within the gap"
    STALLED = "the bound is too wide, and no way down was found"
    ESCAPED = "a point of the next rank has a lower value"


@dataclass(frozen=True, eq=False)
class Climb(Generic[V, T]):
    """What a climb came to: the best bound so far, and where it escaped the direction and point."""

    ending: ClimbEnding
    bound: DualBound | None
    direction: V | None = None
    point: T | None = None


def climb(algebra: ClimbAlgebra[V, T], gap: float, best: DualBound | None) -> Climb[V, T]:
    """Prove that the relaxation is solved, or leave along the eigenvector that shows it is not.

    `gap` is the relative one between f and the bound, `best` the best bound so far.
    """
    if algebra.objective <= algebra.rounding_level:
        trivial = best if best is not None else algebra.with_multipliers(NO_BOUND)
        return Climb(ClimbEnding.SOLVED, trivial)
    proven = algebra.prove(gap)
    if proven is None:
        return Climb(ClimbEnding.STALLED, best)
    if best is None or proven.value > best.lower_bound:
        best = algebra.with_multipliers(proven)
    smallest = smallest_shift(gap, algebra.objective, algebra.num_rows)
    if proven.eta <= smallest:
        return Climb(ClimbEnding.SOLVED, best)
    if not algebra.has_room:
        return Climb(ClimbEnding.STALLED, best)
    direction = algebra.direction(proven, smallest)
    if direction.value >= -smallest:  # what the proof lacks is precision, not a way down
        return Climb(ClimbEnding.SOLVED, best)
    point = _escape(algebra, direction)
    if point is None:
        return Climb(ClimbEnding.STALLED, best)
    algebra.accept(point)
    return Climb(ClimbEnding.ESCAPED, best, direction, point)


def _escape(algebra: ClimbAlgebra[V, T], direction: V) -> T | None:
    """Return the first of the moves s v, s v/2, .. that lowers f enough; None when none does."""
    length = direction.first_length
    noise = ROUNDING * algebra.objective + algebra.rounding_level
    for _ in range(HALVINGS):
        promised = -(length**2) * direction.value
        if promised <= noise:
            return None
        objective, point = algebra.evaluate(direction, length)
        if objective <= algebra.objective - SUFFICIENT * promised:
            return point
        length *= 0.5
    return None


def staircase_status(is_solved: bool, stalled: bool) -> Status | None:
    """Ending of a staircase: CONVERGED when the relaxation is solved; None while it goes on.

    STALLED when no way down is found from where it is not.
    """
    if is_solved:
        return Status.CONVERGED
    return Status.STALLED if stalled else None
