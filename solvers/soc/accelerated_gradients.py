"""Accelerated gradients for a convex quadratic, min 1/2 <x, H x> - <b, x>.

From y_1 = x_0 on, with a bound L on the largest eigenvalue of H,

    x_k     = y_k - (H y_k - b) / L
    y_{k+1} = x_k + beta_k (x_k - x_{k-1})

Two methods differ in the momentum beta_k:

- `minimize_with_fista`: beta_k = (t_k - 1) / t_{k+1}, which grows to 1 (Beck & Teboulle 2009,
  (4.1) to (4.3); without a term that is not smooth, their step p_L is a gradient step). The paper
  solves step (a) of Algorithm 1 this way. It knows nothing of the strong convexity mu of the
  quadratic.
- `minimize_with_nesterov`: beta = (sqrt(L) - sqrt(mu)) / (sqrt(L) + sqrt(mu)), the constant of
  Nesterov 2004, (2.2.11), left out where it points uphill (the gradient scheme of O'Donoghue &
  Candes 2015). Its iterations grow with sqrt(L / mu), those of FISTA to a fine tolerance with
  L / mu.

A. Beck and M. Teboulle, A fast iterative shrinkage-thresholding algorithm for linear inverse
problems, SIAM Journal on Imaging Sciences 2(1), 2009. Y. Nesterov, Introductory Lectures on Convex
Optimization, 2004. B. O'Donoghue and E. Candes, Adaptive restart for accelerated gradient schemes,
Foundations of Computational Mathematics 15, 2015.
"""

import itertools
import math
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.rotations import Array

TOLERANCE = 1e-12  # well below the 1e-8 to which the back ends of step (a) agree
# So many reach TOLERANCE where L / mu is at most about 900 (FISTA) and 3e6 (Nesterov's method).
MAX_ITERATIONS = 50_000


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
    scheme = _Scheme("FISTA", lipschitz, _fista_momenta(), restarts=False)
    return _minimize(scheme, apply_H, b, start, tolerance, max_iterations)


def minimize_with_nesterov(
    apply_H: Callable[[Array], Array],
    b: Array,
    start: Array,
    lipschitz: float,
    strong_convexity: float,
    tolerance: float = TOLERANCE,
    max_iterations: int = MAX_ITERATIONS,
) -> Array:
    """Solution x of H x = b by Nesterov's constant momentum, otherwise as `minimize_with_fista`.

    The eigenvalues of `apply_H` are in [strong_convexity, lipschitz], strong_convexity > 0.
    """
    root = math.sqrt(strong_convexity / lipschitz)
    constant = itertools.repeat((1.0 - root) / (1.0 + root))
    scheme = _Scheme("Nesterov's method", lipschitz, constant, restarts=True)
    return _minimize(scheme, apply_H, b, start, tolerance, max_iterations)


@dataclass(frozen=True, eq=False)
class _Scheme:
    """One of the two methods: its name, L, the momenta beta_k, and whether they may be left out."""

    name: str
    lipschitz: float
    momenta: Iterable[float]
    restarts: bool


def _fista_momenta() -> Iterator[float]:
    """(t_k - 1) / t_{k+1} with t_1 = 1 and t_{k+1} = (1 + sqrt(1 + 4 t_k^2)) / 2."""
    t = 1.0
    while True:
        following = (1.0 + math.sqrt(1.0 + 4.0 * t**2)) / 2.0
        yield (t - 1.0) / following
        t = following


def _minimize(
    scheme: _Scheme,
    apply_H: Callable[[Array], Array],
    b: Array,
    start: Array,
    tolerance: float,
    max_iterations: int,
) -> Array:
    size = max(float(np.linalg.norm(b)), np.finfo(float).tiny)
    limit = tolerance * size
    x = start
    y = start  # x with momentum
    for momentum in itertools.islice(scheme.momenta, max_iterations):
        gradient = apply_H(y) - b
        if np.linalg.norm(gradient) <= limit:
            return y
        following = y - gradient / scheme.lipschitz
        step = following - x
        points_uphill = scheme.restarts and np.vdot(gradient, step) > 0
        y = following if points_uphill else following + momentum * step
        x = following
    residual = float(np.linalg.norm(apply_H(x) - b))
    if not residual <= limit:
        warnings.warn(
            f"{scheme.name} ended at its {max_iterations} iterations with "
            f"||H x - b|| = {residual / size:.0e} ||b||, asked for was {tolerance:.0e}; "
            "use RStep.FACTORIZED or a larger penalty",
            RuntimeWarning,
            stacklevel=3,
        )
    return x
