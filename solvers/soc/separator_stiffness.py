"""Separator stiffness: the inverse mean compliance of the separator translations.

It is the scale of their ADMM penalty in the coupling CONSENSUS.
"""

from collections.abc import Sequence

import numpy as np

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyFactor

GROUND = 1e-7  # of the diagonal of M: holds the shifts that are left out
_NUM_PROBES = 32  # vectors that estimate the mean
TRANSLATION_PENALTY = 0.6  # of separators at the start, times their stiffness and the diagonal of M
# The translation penalty is lowered only if the quotient of the distances is at most the first
# number; it is never lowered by more than the second number at once.
_WORTHWHILE_FACTOR = 1.0 / 3.0
_SMALLEST_FACTOR = 0.1
# The penalty is checked once more so many iterations after penalties were chosen anew, where the
# residual is still above this.
_RECHECK_STEPS = 20
_RECHECK_RESIDUAL = 1e-3


def stiffness_of_separators(
    factor: CholeskyFactor, side: int, held: IntArray, D: Array, component: IntArray
) -> float:
    """Stiffness of one robot's separators, relative to the diagonal of M.

    The robot pulls at its separator translations, which nothing else holds, while rho holds the
    rotations: C = D^(1/2) (E^T (M_a + rho/2)^-1 E) D^(1/2), with E the separators and D half their
    shares of the diagonal of M. The stiffness is one over the mean diagonal of C, common shifts
    left out: near 1 where each separator is held by its neighbourhood, far below where long soft
    chains join them. The mean is estimated (Hutchinson 1990), always with the same signs. `factor`
    is of M_a + rho/2, with `GROUND` times D, (s,), on the separator translations, whose rows are
    `held`, (s,); `component`, (s,), says which of them hang together by edges that the robot knows.
    """
    degrees_of_freedom = len(held) - len(np.unique(component))
    if degrees_of_freedom == 0:  # each is alone in its component and can only be shifted
        return 1.0
    root = np.sqrt(D)[:, None]
    rng = np.random.default_rng(0)
    signs = rng.choice([-1.0, 1.0], size=(len(held), _NUM_PROBES))
    probes = _without_shifts(signs, D, component)
    force = np.zeros((side, _NUM_PROBES))
    force[held] = root * probes
    displacement = root * factor.solve(force)[held]
    return _NUM_PROBES * degrees_of_freedom / float(np.sum(probes * displacement))


def travel(moved: Array, pulled: Array, scale: Array) -> Array:
    """Sums over copies of how far translations and their multipliers have gone, (3 + d,).

    `moved` and `pulled`, (q, d), are the changes of the translations agreed on, and of the unscaled
    multipliers, `scale`, (q,), the shares of the copies in the diagonal of M. The sums are those of
    pulled^2 / scale, scale moved^2, scale, and scale moved, of which `adapted_penalty` takes a
    common shift out.
    """
    weighted = scale[:, None] * moved
    sum_pulled = np.sum(pulled * (pulled / scale[:, None]))
    sum_moved = np.sum(weighted * moved)
    return np.array([sum_pulled, sum_moved, np.sum(scale), *weighted.sum(axis=0)])


def adapted_penalty(penalty: float, sums: Array) -> float:
    """Penalty of separator translations over their diagonal in M, adapted to how far they went.

    ADMM is fastest where penalties are the ratio of the distances to the optimum of multipliers and
    of variables; the way so far, `travel` of all robots without a common shift, estimates it (Xu,
    Figueiredo & Goldstein 2017 take the ratio of the last steps). Where that is far below the
    penalty, as after a start with several times the optimal cost, the penalty falls by the square
    of the quotient, to a tenth at most. The square, and the factor of three from which on it falls,
    were chosen on M3500, manhattan and intel, which take fewer rounds with them; city10000 took
    more where a smaller factor was enough, and sphere2500 where the penalty was raised.
    """
    sum_pulled, sum_moved, sum_scale = sums[:3]
    shift = sums[3:]
    distance = sum_moved - shift @ shift / sum_scale if sum_scale > 0 else 0.0
    if not distance > 0:
        return penalty
    factor = sum_pulled / (penalty**2 * distance)
    if factor > _WORTHWHILE_FACTOR:
        return penalty
    return float(penalty * max(factor, _SMALLEST_FACTOR))


def is_recheck_due(refreshes: int, merits: Sequence[float], residual: float) -> bool:
    """Whether the translation penalty is checked once more, after penalties were chosen anew.

    M3500 with 25 contiguous robots stalls before its translations have gone the way that shows how
    far they have to go. Where the residual has fallen to 1e-3 the penalty stays: with another one
    kitti_00 and parking-garage took longer.
    """
    return refreshes > 0 and len(merits) == _RECHECK_STEPS and residual > _RECHECK_RESIDUAL


def fell_most(before: float, after: float) -> bool:
    """Whether an adapted penalty fell as far as it can at once.

    A recheck then chooses all penalties anew.
    """
    return after <= _SMALLEST_FACTOR * before


def _without_shifts(vectors: Array, D: Array, component: IntArray) -> Array:
    """Vectors, (s, k), less their share in common shifts of the translations of a component."""
    shift = np.sqrt(D)
    size = np.bincount(component, weights=D)
    size = np.where(size > 0, size, 1.0)
    sums = [np.bincount(component, weights=shift * column) for column in vectors.T]
    mean_shift = np.stack(sums, axis=1) / size[:, None]
    return np.asarray(vectors - shift[:, None] * mean_shift[component])
