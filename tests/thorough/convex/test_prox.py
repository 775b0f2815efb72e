"""Every closed form is what cvxpy finds when it minimises s f(x) + ||x - v||^2 / 2 itself."""

from collections.abc import Callable

import cvxpy as cp
import numpy as np
import pytest
from budget import examples
from hypothesis import given, settings, strategies as st

from pgo_models import ConvexSolver
from pgo_models.convex import prox
from pgo_models.geometry.rotations import Array, quaternions_from_rotations

SEEDS = st.integers(0, 2**32 - 1)
STEPS = st.sampled_from([0.01, 0.5, 1.0, 4.0])
# Tolerance of the gap. Where the objective is strongly convex points are as accurate as its root.
TOLERANCE = 1e-12
ACCURACY = 1e-5


def random_point(seed: int, *shape: int) -> Array:
    return np.random.default_rng(seed).standard_normal(shape)


def minimised(
    v: Array, added: Callable[[cp.Variable], tuple[object, list[cp.Constraint]]]
) -> Array:
    """Minimiser of the added term + ||x - v||^2 / 2 under the added constraints."""
    x = cp.Variable(v.shape)
    term, constraints = added(x)
    distance = 0.5 * cp.sum_squares(x - v)
    problem = cp.Problem(cp.Minimize(term + distance), constraints)
    ConvexSolver().run(problem, TOLERANCE)
    assert problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)
    return np.asarray(x.value)


def maximum(value: cp.Expression, constraint: cp.Constraint) -> float:
    problem = cp.Problem(cp.Maximize(value), [constraint])
    ConvexSolver().run(problem, TOLERANCE)
    return float(problem.value)


OPERATORS = {
    "soft_threshold": lambda x: cp.sum(cp.abs(x)),
    "group_soft_threshold": lambda x: cp.sum(cp.norm(x, 2, axis=1)),
    "singular_value_threshold": cp.normNuc,
    "shrink": lambda x: 0.5 * cp.sum_squares(x),
}


@settings(max_examples=examples(10), deadline=None)
@pytest.mark.parametrize("name", OPERATORS)
@given(seed=SEEDS, step=STEPS)
def test_a_prox_minimises(name: str, seed: int, step: float) -> None:
    f = OPERATORS[name]
    v = random_point(seed, 4, 3)

    def cost(x: Array) -> float:
        return step * float(f(cp.Constant(x)).value) + 0.5 * np.sum((x - v) ** 2)

    closed_form = getattr(prox, name)(v, step)
    numerical = minimised(v, lambda x: (step * f(x), []))
    excess = cost(numerical) - cost(closed_form)
    # Strongly convex: any point costs at least ||x - closed_form||^2 / 2 more. Where a group
    # shrinks to nearly zero, Clarabel's solution can be 1e-3 away.
    assert excess >= 0.5 * np.sum((numerical - closed_form) ** 2) - ACCURACY**2
    assert excess <= ACCURACY


@settings(max_examples=examples(10), deadline=None)
@given(seed=SEEDS, columns=st.integers(1, 3))
def test_the_nearest_orthonormal_columns_maximise_over_their_convex_hull(
    seed: int, columns: int
) -> None:
    v = random_point(seed, 3, columns)
    x = cp.Variable(v.shape)
    over_hull = maximum(cp.sum(cp.multiply(v, x)), cp.sigma_max(x) <= 1)
    P = prox.project_stiefel(v)
    np.testing.assert_allclose(P.T @ P, np.eye(columns), rtol=0, atol=1e-14)
    assert np.sum(v * P) == pytest.approx(over_hull, rel=1e-7)


@settings(max_examples=examples(10), deadline=None)
@given(seed=SEEDS)
def test_the_nearest_rotation_maximises_over_its_convex_hull(seed: int) -> None:
    v = random_point(seed, 3, 3)
    q = cp.Variable((4, 4), PSD=True)  # q q^T of a unit quaternion (x, y, z, w), without its rank
    R: dict[tuple[int, int], cp.Expression] = {}
    for k in range(3):
        R[k, k] = 2 * q[k, k] + 2 * q[3, 3] - 1
    for i, j, axis in ((2, 1, 0), (0, 2, 1), (1, 0, 2)):
        R[i, j] = 2 * (q[i, j] + q[axis, 3])
        R[j, i] = 2 * (q[i, j] - q[axis, 3])
    value = sum(v[entry] * expression for entry, expression in R.items())
    over_hull = maximum(value, cp.trace(q) == 1)
    P = prox.project_to_rotations(v[None])[0]
    assert np.linalg.det(P) == pytest.approx(1.0, rel=1e-12)
    assert np.sum(v * P) == pytest.approx(over_hull, rel=1e-7, abs=1e-7)
    unit = quaternions_from_rotations(P[None])[0]
    q.value = np.outer(unit, unit)
    for entry, expression in R.items():
        assert np.sum(expression.value) == pytest.approx(P[entry], rel=0, abs=1e-12)


@given(seed=SEEDS, nonzeros=st.integers(1, 12))
def test_hard_thresholding_leaves_the_least_that_it_can(seed: int, nonzeros: int) -> None:
    v = random_point(seed, 4, 3)
    x = prox.project_sparse(v, nonzeros)
    assert np.count_nonzero(x) == nonzeros
    smallest_squares = np.sort(v**2, axis=None)[: v.size - nonzeros]
    assert np.sum((v - x) ** 2) == pytest.approx(np.sum(smallest_squares), abs=1e-14)


def test_zero_stays_zero_or_goes_into_the_set() -> None:
    zero = np.zeros((3, 2))
    for name in OPERATORS:
        np.testing.assert_array_equal(getattr(prox, name)(zero, 1.0), zero)
    first_unit_vectors = [[1.0, 1.0], [0.0, 0.0], [0.0, 0.0]]
    np.testing.assert_array_equal(prox.project_unit_columns(zero), first_unit_vectors)
