"""FISTA for a strongly convex quadratic, min 1/2 <x, H x> - <b, x>, with gradients only.

The paper solves step (a) of Algorithm 1 this way (Beck & Teboulle 2009). With the Lipschitz
constant and the strong convexity known, the momentum is constant (Nesterov 2004, scheme 2.2.22); it
is restarted when it points uphill (O'Donoghue & Candes 2015).
"""

import warnings
from collections.abc import Callable

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array


def minimize_with_fista(
    apply_H: Callable[[Array], Array],
    b: Array,
    start: Array,
    lipschitz: float,
    strong_convexity: float,
    tolerance: float = 1e-12,
    max_iterations: int = 20_000,
) -> Array:
    """Solution x of H x = b, to `tolerance` on ||H x - b|| / ||b||.

    `apply_H` is symmetric with eigenvalues in [strong_convexity, lipschitz], lipschitz >=
    strong_convexity > 0, else a SettingError; a lipschitz that is too small diverges. `b` and
    `start` have one shape. Where `max_iterations` are not enough the last iterate is returned, and
    a RuntimeWarning says which accuracy was reached and what to do.
    """
    if not lipschitz >= strong_convexity > 0:
        raise SettingError(
            f"need lipschitz >= strong_convexity > 0, got {lipschitz} and {strong_convexity}"
        )
    root = np.sqrt(strong_convexity / lipschitz)
    momentum = (1.0 - root) / (1.0 + root)
    size = max(float(np.linalg.norm(b)), np.finfo(float).tiny)
    limit = tolerance * size
    x = start
    y = start  # x with momentum
    for _ in range(max_iterations):
        gradient = apply_H(y) - b
        if np.linalg.norm(gradient) <= limit:
            return y
        following = y - gradient / lipschitz
        step = following - x
        points_uphill = np.vdot(gradient, step) > 0
        y = following if points_uphill else following + momentum * step
        x = following
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
