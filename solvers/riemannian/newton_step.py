"""One step of damped Riemannian Newton, written once against an algebra (Absil et al. 2008, ch. 6).

The rules of the method are here: which matrix is factored, how far a move goes, when another move
takes the same factor, and when the iteration has come to its end. What they need of poses and
matrices is `NewtonAlgebra`. There are two: `solvers.riemannian.polish` in one place,
with sparse Cholesky, and `solvers.robots.newton` by a driver and its robots, which eliminate
to separators and send messages.
"""

import math
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

import numpy as np

from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.problem.stationarity import STATIONARY_DECREMENT
from solvers.carry.registry import record

# Decrement of a stationary point of chi2. A decrement lowers the bound on chi2 more than that on F,
# because the tangent is softer than chi2 itself.
STATIONARY_FOR_TANGENTS = 1e-16
SMALL_DECREMENT = 1e-9  # decrement that a Newton step squares
ROUNDING = 1e-14  # relative change of F that is not told apart from none
SUFFICIENT = 1e-4  # Armijo's constant
HALVINGS = 40  # of a move, at most, to 2^-40 of it
# damping, as a share of the diagonal: the least one, its growth, and the largest one
DAMPING_START = 1e-8
DAMPING_GROWTH = 10.0
DAMPING_MAX = 1e6
FIRST_SHIFT = 1e-3  # first shift of a run, as a share of F / (n d)
SHIFT_DECAY = 0.25  # first shift of a step, as a share of the last one
SHIFT_GROWTH = 4.0  # of the shift, while the matrix is not positive definite
PROGRESS = 0.1  # share of the decrement that a move leaves, at most, before another is worth it


@record("ModelOrder")
@dataclass(frozen=True)
class ModelOrder:
    """Which matrix a model of F has.

    Newton's, the Hessian; that with S + eta blockdiag(0, I) for S, which follows negative
    curvature; or the Gauss-Newton matrix with `damping` times its diagonal added.
    """

    second_order: bool
    damping: float
    eta: float = 0.0

    @property
    def is_newton(self) -> bool:
        """Whether the matrix is the Hessian, neither shifted nor Gauss-Newton."""
        return self.second_order and not self.eta


class NewtonModel(Protocol):
    """A quadratic model of F at a point: a factored matrix H and the gradient g there."""

    @property
    def order(self) -> ModelOrder:
        """The order that H was factored by: Newton's matrix, a shifted or a damped one."""

    @property
    def objective(self) -> float:
        """F at the point."""

    @property
    def rounding_level(self) -> float:
        """F where every residual is as large as rounding can make it."""

    @property
    def square(self) -> float:
        """g^T H^-1 g, minus the slope of F along the step -H^-1 g."""


class Trial(Protocol):
    """A point that a move may go to."""

    @property
    def objective(self) -> float:
        """F at the trial point."""


M = TypeVar("M", bound=NewtonModel)
T = TypeVar("T", bound=Trial)


class NewtonAlgebra(Protocol[M, T]):
    """What a step needs of the poses it begins at."""

    @property
    def further_moves(self) -> int:
        """How many moves after the first take the same factor, at most (chord steps)."""

    def factorize(self, order: ModelOrder) -> M | None:
        """Return the model at the poses; None where its matrix is not positive definite."""

    def evaluate(self, model: M, length: float) -> T:
        """Return the trial at -length H^-1 g, with F; the first length of a model is 1."""

    def model_at(self, model: M, trial: T) -> M:
        """Return the model at the trial that takes the factor of another one."""

    def accept(self, trial: T) -> None:
        """Go to the trial."""


@dataclass(frozen=True)
class StepRules:
    """What a caller decides about a step.

    `tolerance` is the decrement at which a point is stationary. `second_order` asks for the
    Hessian, not for its Gauss-Newton part. `first_shift`, of S, is where shifts begin; None stands
    for the damped Gauss-Newton matrix where the Hessian is not positive definite. Below the
    decrement `enough` a factor serves no further move; it matters only above the tolerance.
    """

    tolerance: float
    second_order: bool = True
    first_shift: float | None = None
    enough: float = 0.0


@dataclass(frozen=True, eq=False)
class NewtonStep(Generic[M]):
    """What a step came to: the model at the last point, and the figures of `NewtonFigures`."""

    model: M
    decrement: float
    moved: bool
    is_at_rounding: bool


@dataclass(frozen=True, eq=False)
class NewtonFigures:
    """What decides whether a run of Newton goes on.

    `decrement` is half the squared Newton decrement at the poses, less the rounding level of F,
    over F: the relative decrease that the quadratic model still promises and F can show. It is inf
    before the first factorisation. `moved` tells whether the last step changed the poses, and
    `is_at_rounding` whether a Newton step hardly cut a small decrement, which it squares elsewhere.
    `tolerance` is on the decrement.
    """

    objective: float
    decrement: float = math.inf
    moved: bool = True
    is_at_rounding: bool = False
    tolerance: float = STATIONARY_DECREMENT

    @property
    def is_stationary(self) -> bool:
        """Whether no further move can lower F by more than its rounding."""
        return self.decrement <= self.tolerance or self.is_at_rounding


def stationary_tolerance(is_quadratic: bool, share: float = 1.0) -> float:
    """Tolerance on the decrement, `share` times looser than usual, of F or of chi2."""
    return share * (STATIONARY_DECREMENT if is_quadratic else STATIONARY_FOR_TANGENTS)


def newton_step(algebra: NewtonAlgebra[M, T], rules: StepRules) -> NewtonStep[M]:
    """Factor once, then move as long as the same factor serves; F rises by its rounding at most.

    Further moves take the same factor (chord steps). They end where a move does not cut the
    decrement to a tenth, unless this cut, repeated in the remaining moves, brings the decrement
    within tolerance. A NotPositiveDefiniteError is raised where no damping or shift makes the
    matrix positive definite, as with weights too far apart for doubles.
    """
    model = factorize_definite(algebra, rules)
    decrement = decrement_of(model)
    moved = False
    is_at_rounding = False
    for moves_left in range(algebra.further_moves, -1, -1):
        if decrement <= rules.tolerance or is_at_rounding:
            break
        trial = backtrack(algebra, model)
        if trial is None:
            break
        following = algebra.model_at(model, trial)
        after = decrement_of(following)
        is_first_newton_move = model.order.is_newton and not moved
        is_at_rounding = reached_rounding(decrement, after, is_first_newton_move)
        if trial.objective >= model.objective and after > 0.5 * decrement:
            break
        algebra.accept(trial)
        cut = after / decrement
        model = following
        decrement = after
        moved = True
        if decrement <= rules.enough:
            break
        if cut > PROGRESS:
            foreseen = decrement * cut ** (moves_left - 1)
            if foreseen > rules.tolerance:
                break
    return NewtonStep(model, decrement, moved, is_at_rounding)


def factorize_definite(algebra: NewtonAlgebra[M, T], rules: StepRules) -> M:
    """Return the model with the Hessian, or with the next matrix that is positive definite.

    A NotPositiveDefiniteError where the largest damping or shift is not enough.
    """
    order = ModelOrder(rules.second_order, 0.0)
    model = algebra.factorize(order)
    while model is None:
        order = _next_order(order, rules.first_shift)
        if order.damping > DAMPING_MAX or math.isinf(order.eta):
            raise NotPositiveDefiniteError(
                "no damping or shift makes Newton's matrix positive definite"
            )
        model = algebra.factorize(order)
    return model


def _next_order(order: ModelOrder, first_shift: float | None) -> ModelOrder:
    """Return what is tried after a matrix that was not positive definite."""
    if first_shift is not None:
        return replace(order, eta=max(first_shift, SHIFT_GROWTH * order.eta))
    if order.second_order:
        return replace(order, second_order=False)
    return replace(order, damping=max(DAMPING_START, DAMPING_GROWTH * order.damping))


def first_shift(last_shift: float, objective: float, num_rows: int) -> float:
    """Shift that a step tries first: less than the last one, or a share of F / (n d).

    `num_rows` is n d. The shift is positive, as zero would never grow.
    """
    shift = SHIFT_DECAY * last_shift or FIRST_SHIFT * objective / num_rows
    return max(shift, float(np.finfo(float).tiny))


def backtrack(algebra: NewtonAlgebra[M, T], model: M) -> T | None:
    """Return the first of the moves -y, -y/2, .. that lowers F enough, y = H^-1 g, or None.

    Moves whose decrease would be below the rounding of F are not tried, but for the full one.
    """
    length = 1.0
    for _ in range(HALVINGS):
        trial = algebra.evaluate(model, length)
        if is_low_enough(model, trial.objective, length):
            return trial
        length *= 0.5
        if length * model.square <= ROUNDING * model.objective:
            break
    return None


def is_low_enough(model: NewtonModel, objective: float, length: float) -> bool:
    """Whether F after a move is low enough for its slope (Armijo).

    The full move is accepted also where F rises by no more than rounding: F cannot tell then
    whether the move helps, and the decrement decides in `newton_step`.
    """
    if objective <= model.objective - SUFFICIENT * length * model.square:
        return True
    return length == 1.0 and objective <= model.objective * (1.0 + ROUNDING)


def reached_rounding(before: float, after: float, is_newton_step: bool) -> bool:
    """Whether a Newton step did not cut a small decrement, which it would square, to a tenth."""
    return is_newton_step and before <= SMALL_DECREMENT and after > PROGRESS * before


def decrement_of(model: NewtonModel) -> float:
    """Relative decrease of F that the quadratic model promises (`scaled_decrement`)."""
    return scaled_decrement(model.square, model.objective, model.rounding_level)


def scaled_decrement(square: float, objective: float, rounding_level: float) -> float:
    """Compute (g^T H^-1 g / 2 - level) / F, the decrease of F to be expected as a share of F.

    It is 0 where the expected decrease or F is not positive. A computed F of zero, or chi2 below
    zero, is nothing but rounding.
    """
    decrease = 0.5 * square - rounding_level
    return decrease / objective if decrease > 0.0 and objective > 0.0 else 0.0
