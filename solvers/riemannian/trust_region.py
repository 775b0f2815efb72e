"""A step of a Riemannian trust region on St(d, r)^n (Absil, Mahony & Sepulchre, algorithm 10)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Generic, Protocol, TypeVar

import numpy as np

from pgo_models.geometry.rotations import Array
from pgo_models.geometry.stiefel import retract
from solvers.riemannian.newton_step import ROUNDING
from solvers.riemannian.truncated_cg import TruncatedStep, truncated_conjugate_gradients

_FORCING = 0.1  # the largest share of the residual that conjugate gradients leave
_MOST_ITERATIONS = 1000  # of conjugate gradients in a step
_FLOOR = 0.01  # of the tolerance: conjugate gradients go no deeper
_FIRST_RADIUS = 100.0  # times the preconditioned gradient, which soft directions outgrow
# ratios of actual to promised decrease
_ACCEPTED = 0.1
_POOR = 0.25
_GOOD = 0.75
_SHRINK = 0.25
_GROW = 2.0
# norm of a block of the step, which saturates at about 1: beyond, the model says nothing
_LONGEST = 10.0


class FunctionPoint(Protocol):
    """A point of St(d, r)^n, the value of a function there and its Riemannian gradient."""

    @property
    def Y(self) -> Array:
        """The point, (n, d, r)."""

    @property
    def value(self) -> float:
        """Value of the function."""

    @property
    def gradient(self) -> Array:
        """Gradient, (n, d, r), tangent at Y."""


P = TypeVar("P", bound=FunctionPoint)


class SmoothFunction(Protocol[P]):
    """A function on St(d, r)^n with what a trust region needs of it."""

    def evaluate(self, Y: Array) -> P:
        """Return the point Y, (n, d, r), with value and gradient."""

    def hessian_product(self, point: P, V: Array) -> Array:
        """Apply the Riemannian Hessian at a point to a tangent V, (n, d, r)."""

    def precondition(self, point: P, V: Array) -> Array:
        """Apply a positive definite operator, about the inverse of the Hessian, to a tangent."""


@dataclass(frozen=True)
class Precision:
    """How far the conjugate gradients of a step go, and what they cannot see.

    They end where the residual has fallen by the factor `forcing`, or its square to `floor`, or
    after `max_iterations`. Decreases below `rounding` cannot be told from zero.
    """

    forcing: float
    floor: float
    rounding: float
    max_iterations: int

    @classmethod
    def at(
        cls,
        value: float,
        decrement: float,
        tolerance: float,
        rounding_level: float,
        max_iterations: int = _MOST_ITERATIONS,
    ) -> Precision:
        """Precision of a step from a point of some value: the finer, the smaller the decrement.

        `decrement` is <g, P g> / 4 over the value, for the gradient g and the preconditioner P, and
        `tolerance` is the one at which steps end. Below `rounding_level` a value is as good as 0.
        """
        scale = max(value, rounding_level)
        return cls(
            forcing=min(_FORCING, math.sqrt(decrement)),
            floor=4.0 * scale * _FLOOR * tolerance,
            rounding=ROUNDING * scale + rounding_level,
            max_iterations=max_iterations,
        )


@dataclass(frozen=True, eq=False)
class TrustRegionStep(Generic[P]):
    """What a step came to. `point` is None where it was rejected."""

    point: P | None
    radius: float
    iterations: int  # products with the Hessian
    is_below_rounding: bool  # whether the decrease that was promised cannot be seen


def trust_region_step(
    function: SmoothFunction[P], point: P, radius: float, precision: Precision
) -> TrustRegionStep[P]:
    """Minimise the quadratic model in a trust region, and accept the step if the function falls.

    The radius is measured in the preconditioner's norm.
    """
    rounding = precision.rounding
    trial = truncated_conjugate_gradients(
        point.gradient,
        partial(function.hessian_product, point),
        partial(function.precondition, point),
        radius,
        precision.forcing,
        precision.floor,
        precision.max_iterations,
    )
    longest = float(np.linalg.norm(trial.step, axis=(1, 2)).max())
    if not longest <= _LONGEST:
        radius = trial.length / longest if np.isfinite(longest) else _SHRINK * radius
        return TrustRegionStep(None, radius, trial.iterations, is_below_rounding=False)
    candidate = function.evaluate(retract(point.Y, trial.step))
    # Near the end both decreases are below rounding, and their ratio is made to tend to one (Conn
    # et al., 17.4.2).
    ratio = (point.value - candidate.value + rounding) / (trial.decrease + rounding)
    return TrustRegionStep(
        candidate if ratio > _ACCEPTED else None,
        _next_radius(radius, ratio, trial, longest),
        trial.iterations,
        is_below_rounding=trial.decrease <= rounding,
    )


def first_radius(squared: float) -> float:
    """Radius of the first step, from <g, P g> of the gradient g and the preconditioner P."""
    return _FIRST_RADIUS * math.sqrt(max(squared, 0.0))


def _next_radius(radius: float, ratio: float, trial: TruncatedStep, longest: float) -> float:
    """Radius of the trust region after a step, from the ratio of actual to promised decrease."""
    if not ratio >= _POOR:
        return min(_SHRINK, 1.0 / max(1.0, longest)) * trial.length
    if ratio > _GOOD and trial.is_at_boundary:
        return _GROW * radius
    return radius
