"""FISTA for a convex quadratic, min 1/2 <x, H x> - <b, x> (Beck & Teboulle 2009, (4.1) to (4.3)).

From y_1 = x_0 and t_1 = 1 on, with a bound L on the largest eigenvalue of H,

    x_k     = y_k - (H y_k - b) / L
    t_{k+1} = (1 + sqrt(1 + 4 t_k^2)) / 2
    y_{k+1} = x_k + (t_k - 1) / t_{k+1} (x_k - x_{k-1})

The paper solves step (a) of Algorithm 1 this way. Without a term that is not smooth, the step p_L
of Beck & Teboulle is a gradient step. Iterations to a fine tolerance grow with L / mu, mu being the
least eigenvalue of H.

A. Beck and M. Teboulle, A fast iterative shrinkage-thresholding algorithm for linear inverse
problems, SIAM Journal on Imaging Sciences 2(1), 2009.
"""

import math
import warnings
from collections.abc import Callable

import numpy as np

from pgo_models.geometry.rotations import Array

TOLERANCE = 1e-12  # well below the 1e-8 to which the back ends of step (a) agree
MAX_ITERATIONS = 50_000  # so many reach TOLERANCE where L / mu is at most about 900


def minimize_with_fista(
    apply_H: Callable[[Array], Array],
    b: Array,
    start: Array,
    lipschitz: float,
    tolerance: float = TOLERANCE,
    max_iterations: int = MAX_ITERATIONS,
) -> Array:
    """Solution x of H x = b by FISTA, to `tolerance` on ||H x - b|| / ||b||.

    `apply_H` is symmetric and positive semidefinite with eigenvalues of at most `lipschitz` > 0; a
    lipschitz that is too small diverges. `b` and `start` have one shape.
    Where `max_iterations` are not enough the last iterate is returned, and a RuntimeWarning says
    which accuracy was reached and what to do.
    """
    size = max(float(np.linalg.norm(b)), np.finfo(float).tiny)
    limit = tolerance * size
    x = start
    y = start  # x with momentum
    t = 1.0
    for _ in range(max_iterations):
        gradient = apply_H(y) - b
        if np.linalg.norm(gradient) <= limit:
            return y
        x_before = x
        t_before = t
        x = y - gradient / lipschitz
        t = (1.0 + math.sqrt(1.0 + 4.0 * t**2)) / 2.0
        y = x + (t_before - 1.0) / t * (x - x_before)
    residual = float(np.linalg.norm(apply_H(x) - b))
    if not residual <= limit:
        warnings.warn(
            f"FISTA ended at its {max_iterations} iterations with "
            f"||H x - b|| = {residual / size:.0e} ||b||, asked for was {tolerance:.0e}; "
            "use RStep.FACTORIZED or a larger penalty",
            RuntimeWarning,
            stacklevel=2,
        )
    return x
