"""Newton for models with constraints beside the sets: on the conditions of Lagrange.

Unknown are u, where nothing fixes it, and the multipliers l of the equations u^T A_k u = 0 that say
what the sets are, of the equalities, and of the inequalities that are active:

    S u = 0,  u^T A_k u = 0,   S = Q - sum_k l_k A_k   (Nocedal & Wright 2006, section 18.1).

An inequality leaves the active ones where its multiplier is negative, and joins them where a point
that is found does not hold it.
"""

import numpy as np

from pgo_models.convex.model_relaxation import active_inequalities
from pgo_models.convex.quadratic_form import QuadraticForm
from pgo_models.convex.set_equations import SetEquations
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray

_MOST_STEPS = 30
_MOST_CHANGES = 8  # of the active inequalities
_LARGEST = 600  # coordinates; the systems are dense
_FAR = 1.0  # a step that moves u by this share of its size leaves the neighbourhood of the start
_ZERO = 1e-9  # a multiplier or a step, as a share of the largest multiplier or of u


def constrained_stationary_point(form: QuadraticForm, equations: SetEquations, u: Array) -> Array:
    """The stationary point beside u, to rounding; u itself where none is found or u is long."""
    if form.side > _LARGEST:
        return u
    active = active_inequalities(equations, u)
    always = np.concatenate([np.arange(equations.num_basic), equations.of_equalities])
    for _ in range(_MOST_CHANGES):
        point, multipliers = _stationary(form, equations, np.concatenate([always, active]), u)
        if point is None:
            return u
        of_active = multipliers[len(always) :]
        is_negative = of_active < -_ZERO * abs(multipliers).max(initial=0.0)
        violated = np.setdiff1d(active_inequalities(equations, point), active)
        if not is_negative.any() and not len(violated):
            return point
        active = np.concatenate([active[~is_negative], violated])
    return u


def _stationary(
    form: QuadraticForm, equations: SetEquations, used: IntArray, u: Array
) -> tuple[Array | None, Array]:
    """A point with S u = 0 where the used equations hold, and their multipliers."""
    free = np.flatnonzero(form.is_free)
    Q = form.Q.toarray()
    point = u.copy()
    last = np.inf
    multipliers = np.zeros(equations.number)
    for _ in range(_MOST_STEPS):
        columns = equations.times(point)[free][:, used].toarray()
        multipliers[used] = np.linalg.lstsq(columns, Q[free] @ point)[0]
        S = Q - equations.combined(multipliers).toarray()
        corner = np.zeros((len(used), len(used)))
        conditions = np.block([[S[np.ix_(free, free)], -columns], [columns.T, corner]])
        left = np.concatenate([-S[free] @ point, -0.5 * equations.values(point)[used]])
        step = np.linalg.lstsq(conditions, left)[0][: len(free)]
        length = float(np.linalg.norm(step) / np.linalg.norm(point))
        if not length <= _FAR:
            return None, multipliers[used]
        if length >= 0.5 * last and length < _ZERO:
            break  # what is left is rounding
        point[free] += step
        last = length
    return point, multipliers[used]
