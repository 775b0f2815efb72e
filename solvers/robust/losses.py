"""Robust losses, their surrogates, and weights (Yang, Antonante, Tzoumas & Carlone 2020)."""

from __future__ import annotations

import enum

import numpy as np

from pgo_models.geometry.rotations import Array, BoolArray

# Largest control of the truncated loss, from which on the weights are 0 and 1.
HARD_CONTROL = 1e3


class RobustLoss(enum.Enum):
    """What a large residual costs: the loss over c^2 as a function of r^2 / c^2.

    A loss is approached by surrogates with a control mu. The truncated loss is reached as mu grows
    from nearly 0 to infinity, that of Geman and McClure as mu falls to 1.

    References
    ----------
    Yang, Antonante, Tzoumas & Carlone, "Graduated non-convexity for robust spatial perception: from
    non-minimal solvers to global outlier rejection", IEEE RA-L 2020.

    Examples
    --------
    >>> ratio = np.array([0.25, 4.0])
    >>> RobustLoss.TRUNCATED.values(ratio).tolist()
    [0.25, 1.0]
    >>> RobustLoss.GEMAN_MCCLURE.values(ratio).tolist()
    [0.2, 0.8]
    """

    TRUNCATED = "truncated least squares, min(r^2, c^2)"
    GEMAN_MCCLURE = "Geman-McClure, c^2 r^2 / (c^2 + r^2)"

    def values(self, ratio: Array) -> Array:
        """Evaluate the loss, min(ratio, 1) or ratio / (1 + ratio).

        Parameters
        ----------
        ratio : Array, (m,)
            Squared residuals over their thresholds, r^2 / c^2.

        Returns
        -------
        Array, (m,)
            Loss over c^2.
        """
        if self is RobustLoss.GEMAN_MCCLURE:
            loss = ratio / (1.0 + ratio)
            return np.asarray(loss)
        loss = np.minimum(ratio, 1.0)
        return np.asarray(loss)

    def surrogate(self, ratio: Array, mu: float) -> Array:
        """Evaluate the surrogate of the loss (Yang et al. 2020, equations 5 and 6).

        Parameters
        ----------
        ratio : Array, (m,)
            Squared residuals over their thresholds, r^2 / c^2.
        mu : float
            Control. The surrogate is the loss for mu to infinity (truncated) or for mu = 1
            (Geman-McClure).

        Returns
        -------
        Array, (m,)
            Surrogate over c^2.
        """
        if self is RobustLoss.GEMAN_MCCLURE:
            surrogate = mu * ratio / (mu + ratio)
            return np.asarray(surrogate)
        root = np.sqrt(ratio * mu * (mu + 1.0))
        between = 2.0 * root - mu * (1.0 + ratio)
        lower, upper = _undecided_range(mu)
        surrogate = np.where(ratio <= lower, ratio, between)
        return np.where(ratio >= upper, 1.0, surrogate)

    def weights(self, ratio: Array, mu: float) -> Array:
        """Evaluate the slope of the surrogate, which is the weight (equations 14 and 12).

        Parameters
        ----------
        ratio : Array, (m,)
            Squared residuals over their thresholds, r^2 / c^2.
        mu : float
            Control. From 1000 on the weights of the truncated loss are 0 or 1.

        Returns
        -------
        Array, (m,)
            Weights in [0, 1].
        """
        if self is RobustLoss.GEMAN_MCCLURE:
            root = mu / (ratio + mu)
            return np.asarray(root**2)
        if mu >= HARD_CONTROL:
            is_within = ratio <= 1.0
            return np.asarray(is_within, dtype=float)
        positive = np.maximum(ratio, 1e-300)
        root = np.sqrt(mu * (mu + 1.0) / positive)
        lower, upper = _undecided_range(mu)
        weights = np.where(ratio <= lower, 1.0, root - mu)
        return np.where(ratio >= upper, 0.0, weights)

    def is_undecided(self, ratio: Array, mu: float) -> BoolArray:
        """Whether the surrogate counts an edge neither in full nor as wrong.

        Parameters
        ----------
        ratio : Array, (m,)
            Squared residuals over their thresholds, r^2 / c^2.
        mu : float
            Control.

        Returns
        -------
        BoolArray, (m,)
            True for the edges that are not decided yet.
        """
        if self is RobustLoss.GEMAN_MCCLURE:
            is_soft = mu > 1.0
            return np.full(ratio.shape, is_soft)
        lower, upper = _undecided_range(mu)
        is_above = ratio > lower
        is_below = ratio < upper
        is_soft = mu < HARD_CONTROL
        return np.asarray(is_soft & is_above & is_below)


def _undecided_range(mu: float) -> tuple[float, float]:
    """Ratios between which the truncated surrogate counts an edge neither in full nor as wrong."""
    return mu / (mu + 1.0), (mu + 1.0) / mu
