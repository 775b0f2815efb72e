"""Ascent of the smallest eigenvalue of the certificate matrix, over the P of handedness terms.

The smallest eigenvalue is a concave function of P, and where several are close to it their
eigenvectors z_q count together: with the weights w_q of a soft minimum and D_q = B_e z_q, the
derivative for P_e is

    sum_q w_q (D_q D_q^T - ||D_q||^2 / 2 I) / 4.

A step goes along it as far as the smallest eigenvalue would need to become positive if it were
linear (Polyak 1969), and back to P >= 0.
"""

from dataclasses import dataclass, replace

import numpy as np

from pgo_models.errors import check_settings
from pgo_models.geometry.rotations import Array
from pgo_models.problem.matrices import inner
from pgo_models.problem.stationarity import rotation_scale
from solvers.handedness.certificate_spectrum import HandedMatrix, Spectrum
from solvers.result import Measurement, Status

POSITIVE = 1e-9  # of the mean diagonal of M: an eigenvalue above that is no rounding
_AIM = 0.05  # of the best eigenvalue so far: how far beyond zero a step aims,
_LEAST_AIM = 0.02  # and of the first one at least
_SOFTNESS = 0.1  # temperature of the soft minimum, as a share of the smallest eigenvalue
_WINDOW = 10  # last steps, whose rise tells whether those that are left can reach zero


@dataclass(frozen=True, eq=False)
class AscentState:
    """State k: the matrices, the lowest eigenvalues with them, and the best one of each step."""

    k: int
    P: Array  # (pairs, 3, 3)
    spectrum: Spectrum
    scale: float  # mean diagonal of M over the rotations
    best: tuple[float, ...]  # best smallest eigenvalue up to every step so far

    @property
    def smallest(self) -> float:
        """The smallest eigenvalue."""
        return float(self.spectrum.values[0])


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

    def init(self, matrix: HandedMatrix, start: Array | None) -> AscentState:
        """State 0: the P of all pairs in `start`, (pairs, 3, 3), or zero."""
        P = np.zeros((len(matrix.i), 3, 3)) if start is None else start
        scale = float(rotation_scale(matrix.problem).mean())
        spectrum = matrix.spectrum(P, self._count(matrix), -scale)
        return AscentState(0, P, spectrum, scale, (float(spectrum.values[0]),))

    def step(self, matrix: HandedMatrix, state: AscentState) -> AscentState:
        """One step along the derivative of the soft minimum."""
        best = state.best[-1]
        first = abs(state.best[0])
        smallest = state.smallest
        aim = max(_AIM * abs(best), _LEAST_AIM * first)
        temperature = _SOFTNESS * max(abs(smallest), _LEAST_AIM * first)
        weights = np.exp(-(state.spectrum.values - smallest) / temperature)
        weights /= weights.sum()
        D = state.spectrum.moves * np.sqrt(weights)
        squares = np.sum(D * D, axis=(1, 2))
        derivative = 0.25 * (D @ np.swapaxes(D, 1, 2) - 0.5 * squares[:, None, None] * np.eye(3))
        length = (aim - smallest) / inner(derivative, derivative)
        P = nearest_semidefinite(state.P + length * derivative)
        spectrum = matrix.spectrum(P, self._count(matrix), smallest)
        now = max(best, float(spectrum.values[0]))
        return replace(state, k=state.k + 1, P=P, spectrum=spectrum, best=(*state.best, now))

    def measure(self, matrix: HandedMatrix, state: AscentState) -> Measurement:
        """The cost of the poses, and what the smallest eigenvalue lacks."""
        return measured(matrix, state.smallest, state.scale)

    def converged(self, state: AscentState, measurement: Measurement) -> Status | None:
        """CONVERGED with a positive eigenvalue, STALLED where it rises too slowly to become one.

        Steps gain less and less, so that the rise of the last ones, times those that are left, is
        more than there is to come.
        """
        if state.smallest > POSITIVE * state.scale:
            return Status.CONVERGED
        if len(state.best) <= _WINDOW:
            return None
        rise = (state.best[-1] - state.best[-1 - _WINDOW]) / _WINDOW
        steps_left = self.max_iterations - state.k
        return None if state.best[-1] + steps_left * rise > 0.0 else Status.STALLED

    def _count(self, matrix: HandedMatrix) -> int:
        return min(self.num_eigenvalues, 3 * len(matrix.free) - 1)


def measured(matrix: HandedMatrix, smallest: float, scale: float) -> Measurement:
    """The cost of the poses, and what a smallest eigenvalue lacks to be positive."""
    lacking = max(0.0, POSITIVE - smallest / scale)
    objective = matrix.problem.objective(matrix.poses)
    return Measurement(objective, 0.0, lacking, infeasibility=lacking)


def nearest_semidefinite(P: Array) -> Array:
    """P with its negative eigenvalues raised to zero, (k, 3, 3)."""
    values, axes = np.linalg.eigh(P)
    return np.asarray((axes * np.maximum(values, 0.0)[:, None, :]) @ np.swapaxes(axes, 1, 2))
