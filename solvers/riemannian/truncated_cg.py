"""Truncated conjugate gradients: about the minimum of a quadratic model in a trust region.

The method is Steihaug's (1983).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.rotations import Array
from pgo_models.problem.matrices import inner


@dataclass(frozen=True, eq=False)
class TruncatedStep:
    """Result of `truncated_conjugate_gradients`."""

    step: Array  # of the shape of the gradient
    decrease: float  # what the model promises: -<g, s> - <s, H s> / 2, positive
    # norm of the step in the preconditioner's metric, the one that measures the trust region
    length: float
    iterations: int  # products with H
    is_at_boundary: bool  # whether the region, or negative curvature, ended it


def truncated_conjugate_gradients(
    gradient: Array,
    hessian: Callable[[Array], Array],
    precondition: Callable[[Array], Array],
    radius: float,
    forcing: float,
    floor: float,
    max_iterations: int,
) -> TruncatedStep:
    """Minimise <g, s> + <s, H s> / 2 over ||s||_P <= radius by preconditioned conjugate gradients.

    It ends inside when the residual has fallen by the factor `forcing`, in the norm of P^-1, or its
    square <r, P^-1 r> to `floor`, and at the boundary along the first direction that leaves the
    region or has no positive curvature. H, `hessian`, is symmetric on the tangent space, P^-1,
    `precondition`, positive definite, too; the radius is in the norm ||s||_P^2 = <s, P s>, in which
    the iterates grow (Steihaug 1983; Toint 1981; Conn, Gould & Toint, Trust-Region Methods,
    algorithm 7.5.1).
    """
    step = np.zeros_like(gradient)
    H_step = np.zeros_like(gradient)
    residual = gradient
    z = precondition(residual)
    direction = -z
    squared = inner(residual, z)
    enough = max(forcing**2 * squared, floor)
    # <s, s>, <s, p> and <p, p> in the norm of P, by recurrence: P itself is never applied.
    step_step = 0.0
    step_direction = 0.0
    direction_direction = squared
    iterations = 0
    is_at_boundary = False
    while squared > enough and iterations < max_iterations:
        H_direction = hessian(direction)
        iterations += 1
        curvature = inner(direction, H_direction)
        length = squared / curvature if curvature > 0 else math.inf
        following = step_step + length * (2.0 * step_direction + length * direction_direction)
        if not following < radius**2:
            is_at_boundary = True
            room = (radius**2 - step_step) * direction_direction
            length = (math.sqrt(step_direction**2 + room) - step_direction) / direction_direction
            following = radius**2
        step = step + length * direction
        H_step = H_step + length * H_direction
        if is_at_boundary:
            step_step = following
            break
        residual = residual + length * H_direction
        z = precondition(residual)
        previous = squared
        squared = inner(residual, z)
        ratio = squared / previous
        step_direction = ratio * (step_direction + length * direction_direction)
        direction_direction = squared + ratio**2 * direction_direction
        step_step = following
        direction = ratio * direction - z
    decrease = -inner(gradient, step) - 0.5 * inner(step, H_step)
    return TruncatedStep(step, decrease, math.sqrt(step_step), iterations, is_at_boundary)
