"""Ascent of the smallest eigenvalue of the certificate matrix, over the P of handedness terms.

The smallest eigenvalue is a concave function of P, and where several are close to it their
eigenvectors z_q count together: with the weights w_q of a soft minimum and D_q = B_e z_q, the
derivative for P_e is

    sum_q w_q (D_q D_q^T - ||D_q||^2 / 2 I) / 4.

A step goes along it as far as the smallest eigenvalue would need to become positive if it were
linear (Polyak 1969), and back to P >= 0.

How far a step goes, and when to stop, is decided here; the P and the eigenvectors are those of
`solvers.handedness.certificate_spectrum`.
"""

from dataclasses import dataclass, replace

import numpy as np

from pgo_models.errors import check_settings
from solvers.handedness.certificate_spectrum import HandedPoint
from solvers.result import Measurement, Status

POSITIVE = 1e-9  # of the mean diagonal of M: an eigenvalue above that is no rounding
_AIM = 0.05  # of the best eigenvalue so far: how far beyond zero a step aims,
_LEAST_AIM = 0.02  # and of the first one at least,
_SOFTNESS = 0.1  # temperature of the soft minimum, as a share of the smallest eigenvalue
_WINDOW = 10  # last steps, whose rise tells whether those that are left can reach zero


@dataclass(frozen=True, eq=False)
class AscentState:
    """State k: the matrices with the lowest eigenvalues, and the best one of each step so far."""

    k: int
    point: HandedPoint
    best: tuple[float, ...]  # best smallest eigenvalue up to every step so far

    @property
    def smallest(self) -> float:
        """The smallest eigenvalue."""
        return float(self.point.values[0])


@dataclass(frozen=True)
class HandednessAscent:
    """Ascent of the smallest eigenvalue; CONVERGED where it is positive.

    `dual_residual` is what it lacks to be positive, relative to the mean diagonal of M.

    Parameters
    ----------
    max_iterations : int
        Most steps.
    num_eigenvalues : int
        How many of the lowest eigenvalues count.

    Raises
    ------
    SettingError
        If the steps are negative, or there are no eigenvalues.
    """

    max_iterations: int = 100
    num_eigenvalues: int = 8

    def __post_init__(self) -> None:
        check_settings(self, not_negative=["max_iterations"], at_least_one=["num_eigenvalues"])

    def init(self, first: HandedPoint, start: None) -> AscentState:
        """State 0, at the first point."""
        return AscentState(0, first, (float(first.values[0]),))

    def step(self, first: HandedPoint, state: AscentState) -> AscentState:
        """One step along the derivative of the soft minimum."""
        best = state.best[-1]
        # The first one may be zero.
        least = max(_LEAST_AIM * abs(state.best[0]), POSITIVE * first.scale)
        values = state.point.values
        smallest = state.smallest
        aim = max(_AIM * abs(best), least)
        temperature = max(_SOFTNESS * abs(smallest), _SOFTNESS * least)
        weights = np.exp(-(values - smallest) / temperature)
        weights /= weights.sum()
        point = state.point.ascended(weights, aim - smallest)
        now = max(best, float(point.values[0]))
        return replace(state, k=state.k + 1, point=point, best=(*state.best, now))

    def measure(self, first: HandedPoint, state: AscentState) -> Measurement:
        """The cost of the poses, and what the smallest eigenvalue lacks to be positive."""
        lacking = max(0.0, POSITIVE - state.smallest / first.scale)
        return Measurement(first.objective, 0.0, lacking, infeasibility=lacking)

    def converged(self, state: AscentState, measurement: Measurement) -> Status | None:
        """CONVERGED with a positive eigenvalue, STALLED where it rises too slowly to become one.

        Steps gain less and less, so that the rise of the last ones, times those that are left, is
        more than there is to come.
        """
        if state.smallest > POSITIVE * state.point.scale:
            return Status.CONVERGED
        if len(state.best) <= _WINDOW:
            return None
        rise = (state.best[-1] - state.best[-1 - _WINDOW]) / _WINDOW
        steps_left = self.max_iterations - state.k
        return None if state.best[-1] + steps_left * rise > 0.0 else Status.STALLED
