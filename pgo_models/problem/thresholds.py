"""Chi-square thresholds: what an edge may cost before its measurement is doubted, in either weighting."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.precisions import LEAST_SCALED, proper_information
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting


def chi2_thresholds(problem: PGOProblem, quantile: float = 0.99) -> Array:
    """Values, (m,), that the `problem.edge_costs` at the true poses exceed with probability 1 - quantile.

    Measurement errors r = (r_t, r_r) are N(0, Sigma), Sigma the inverse of the edge's information matrix I (of kappa
    and tau where the graph has none). The cost with these matrices, r^T I r, is then chi^2 with rank(I) degrees of
    freedom: 3 in the plane, 6 in space, d of a position. F and other quadratic costs are tau ||r_t||^2 + r_r^T V r_r
    to second order, V = tr(W) I - W, or 2 kappa: a sum of chi^2_1 weighted with the eigenvalues w of
    Sigma^1/2 blockdiag(tau I, V) Sigma^1/2. Its quantile is that of the shifted and scaled chi^2 with the same
    first three cumulants (Hall-Buckley-Eagleson; Liu, Tang & Zhang 2009 find the same where no mean is shifted):

        c_1 + c_3 / c_2 (chi^2_l - l),  c_k = sum w^k,  l = c_2^3 / c_3^2,

    exact where the w are equal; else at the quantile 0.99 within 7 %, at 1 - 2e-6 within 2.5 times, of 1 - quantile.
    F of SE-Sync's kappa in the plane has w = 2 of the angle. Least squares fits the poses to the errors, so that the
    residuals of an optimum are smaller than these where few edges say the same.

    Raises
    ------
    SettingError
        When quantile is not between 0 and 1.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import circle
    >>> problem = PGOProblem(circle(np.random.default_rng(0)), weighting=Weighting.INFORMATION)
    >>> round(float(chi2_thresholds(problem)[0]), 3)  # of six degrees of freedom
    16.812
    """
    if not 0.0 < quantile < 1.0:
        raise SettingError(f"quantile is {quantile!r}; give a probability between 0 and 1, such as 0.99")
    w = _chi2_weights(problem)
    c_1, c_2, c_3 = (np.sum(w**k, axis=1) for k in (1, 2, 3))
    ratio = c_3 / np.where(c_2 > 0.0, c_2, 1.0)  # of an edge without weight all are zero
    dof = c_2 / np.where(ratio > 0.0, ratio, 1.0) ** 2
    return np.asarray(c_1 + ratio * (chdtri(np.maximum(dof, 1.0), 1.0 - quantile) - dof))


def _chi2_weights(problem: PGOProblem) -> Array:
    """Weights w, (m, k), of the chi^2_1 that an edge's cost is a sum of; of chi2 itself ones, as many as its rank."""
    d, weights, information = problem.d, problem.weights, proper_information(problem.graph)
    diagonal = np.einsum("mkk->mk", information)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, axes = np.linalg.eigh(information * scale[:, :, None] * scale[:, None, :])
    is_known = values > LEAST_SCALED
    if problem.weighting is Weighting.INFORMATION or weights.excess is not None or weights.tangent is not None:
        return is_known.astype(float)
    half = scale[:, :, None] * axes * (is_known / np.sqrt(np.where(is_known, values, 1.0)))[:, None, :]
    W = weights.W(d)
    trace = np.einsum("mkk->m", W)[:, None, None]
    V = trace if d == 2 else trace * np.eye(3) - W
    r_t, r_r = half[:, :d], half[:, d:]
    form = weights.tau[:, None, None] * np.swapaxes(r_t, 1, 2) @ r_t + np.swapaxes(r_r, 1, 2) @ V @ r_r
    return np.asarray(np.maximum(np.linalg.eigvalsh(form), 0.0))
