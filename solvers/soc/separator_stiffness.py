"""Separator stiffness: inverse mean compliance of the separator translations, the scale of their ADMM penalty."""

from collections.abc import Sequence

import numpy as np

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyFactor

GROUND = 1e-7  # of the diagonal of M: holds the shifts that are left out
_PROBES = 32  # vectors that estimate the mean
TRANSLATION_PENALTY = 0.6  # of separators at the start, times their stiffness and the diagonal of M
_LEAST_FACTOR, _ENOUGH = 0.1, 1.0 / 3.0  # by which the translation penalty is lowered at once
_SECOND_LOOK, _FAR_AWAY = 20, 1e-3  # iterations after penalties were taken anew, and residual that is still large then


def stiffness_of_separators(factor: CholeskyFactor, side: int, held: IntArray, D: Array, component: IntArray) -> float:
    """Stiffness of one robot's separators, relative to the diagonal of M.

    The robot pulls at its separator translations, which nothing else holds, while rho holds the rotations:
    C = D^(1/2) (E^T (M_a + rho/2)^-1 E) D^(1/2), with E the separators and D half their shares of the diagonal of M.
    The stiffness is one over the mean diagonal of C, common shifts left out: near 1 where each separator is held by its
    neighbourhood, far below where long soft chains join them. The mean is estimated (Hutchinson 1990), always with the
    same signs. `factor` is of M_a + rho/2, with `GROUND` times D, (s,), on the separator translations, whose rows are
    `held`, (s,); `component`, (s,), says which of them hang together by edges that the robot knows.
    """
    degrees = len(held) - len(np.unique(component))
    if degrees == 0:  # alone in its component, each: nothing but shifts
        return 1.0
    probes = np.random.default_rng(0).choice([-1.0, 1.0], size=(len(held), _PROBES))
    pulled = _without_shifts(probes, D, component)
    force = np.zeros((side, _PROBES))
    force[held] = np.sqrt(D)[:, None] * pulled
    moved = np.sqrt(D)[:, None] * factor.solve(force)[held]
    return _PROBES * degrees / float(np.sum(pulled * moved))


def travel(moved: Array, pulled: Array, scale: Array) -> Array:
    """Sums over copies of how far translations went, and how much their multipliers changed on the way: (3 + d,).

    `moved` and `pulled`, (q, d), are the changes of the translations agreed on, and of the unscaled multipliers,
    `scale`, (q,), the shares of the copies in the diagonal of M.
    """
    weighted = scale[:, None] * moved
    sums = np.sum(pulled * (pulled / scale[:, None])), np.sum(weighted * moved), np.sum(scale)
    return np.array([*sums, *weighted.sum(axis=0)])


def adapted_penalty(penalty: float, sums: Array) -> float:
    """Penalty of separator translations, times their diagonal in M, after the way that they went with it.

    ADMM is fastest where penalties are the ratio of the distances to the optimum of multipliers and of variables; the
    way so far, `travel` of all robots without a common shift, estimates it (Xu, Figueiredo & Goldstein 2017 take the
    ratio of the last steps). Where that is far below the penalty, as after a start with several times the optimal cost,
    the penalty falls by the square of the quotient, to a tenth at most. The square, and the factor of three from which
    on it falls, were chosen on M3500, manhattan and intel, which take fewer rounds with them; city10000 took more where
    a smaller factor was enough, and sphere2500 where the penalty was raised.
    """
    pulled, moved, scale, along = sums[0], sums[1], sums[2], sums[3:]
    distance = moved - along @ along / scale if scale > 0 else 0.0
    if not distance > 0:
        return penalty
    factor = pulled / (penalty**2 * distance)
    return penalty * max(factor, _LEAST_FACTOR) if factor <= _ENOUGH else penalty


def is_second_look(refreshes: int, merits: Sequence[float], residual: float) -> bool:
    """Whether the translation penalty is looked at again, 20 iterations after penalties were taken anew.

    M3500 with 25 contiguous robots stalls before its translations have gone the way that shows how far they have to go.
    Where the residual has fallen to 1e-3 the penalty stays: with another one kitti_00 and parking-garage took longer.
    """
    return refreshes > 0 and len(merits) == _SECOND_LOOK and residual > _FAR_AWAY


def fell_most(before: float, after: float) -> bool:
    """Whether an adapted penalty fell as far as it can at once: reason to take all penalties anew at a second look."""
    return after <= _LEAST_FACTOR * before


def _without_shifts(vectors: Array, D: Array, component: IntArray) -> Array:
    """Vectors, (s, k), less their share in common shifts of the translations of a component."""
    shift, size = np.sqrt(D), np.bincount(component, weights=D)
    along = np.stack([np.bincount(component, weights=shift * column) for column in vectors.T], axis=1)
    return np.asarray(vectors - shift[:, None] * (along / np.where(size > 0, size, 1.0)[:, None])[component])
