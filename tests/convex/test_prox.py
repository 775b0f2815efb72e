"""Every closed form is what cvxpy finds when it minimises s f(x) + ||x - v||^2 / 2 itself."""

from collections.abc import Callable

import cvxpy as cp
import numpy as np
import pytest
from budget import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pgo_models.convex import prox
from pgo_models.convex.convex_solver import ConvexSolver
from pgo_models.geometry.rotations import Array, quaternions_from_rotations

SEEDS = st.integers(0, 2**32 - 1)
STEPS = st.sampled_from([0.01, 0.5, 1.0, 4.0])
TOLERANCE = 1e-12  # of the gap; points are as near as its root where the objective is strongly convex
ACCURACY = 1e-5


def minimised(shape: tuple[int, ...], v: Array, added: Callable[[cp.Variable], tuple[object, list[object]]]) -> Array:
    x = cp.Variable(shape)
    term, constraints = added(x)
    problem = cp.Problem(cp.Minimize(term + 0.5 * cp.sum_squares(x - v)), constraints)
    ConvexSolver().run(problem, TOLERANCE)
    assert problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)
    return np.asarray(x.value)


OPERATORS = {
    "soft_threshold": lambda x: cp.sum(cp.abs(x)),
    "group_soft_threshold": lambda x: cp.sum(cp.norm(x, 2, axis=1)),
    "singular_value_threshold": cp.normNuc,
    "shrink": lambda x: 0.5 * cp.sum_squares(x),
}
PROJECTIONS = {
    "box": (lambda v, s: prox.project_box(v, -s, 0.3), lambda x, s: [x >= -s, x <= 0.3]),
    "ball": (prox.project_ball, lambda x, s: [cp.norm(x, "fro") <= s]),
    "psd": (lambda v, _: prox.project_psd(v), lambda x, _: [x >> 0, x == x.T]),
}


@settings(max_examples=examples(10), deadline=None)
@pytest.mark.parametrize("name", OPERATORS)
@given(seed=SEEDS, step=STEPS)
def test_a_prox_minimises(name: str, seed: int, step: float) -> None:
    v = np.random.default_rng(seed).standard_normal((4, 3))
    closed, found = getattr(prox, name)(v, step), minimised(v.shape, v, lambda x: (step * OPERATORS[name](x), []))
    at = [float((step * OPERATORS[name](cp.Constant(x)) + 0.5 * cp.sum_squares(x - v)).value) for x in (closed, found)]
    # Strongly convex: any point costs at least ||x - closed||^2 / 2 more. Where a group shrinks to a hair of zero,
    # Clarabel's own can be 1e-3 away.
    assert at[1] - at[0] >= 0.5 * np.sum((found - closed) ** 2) - ACCURACY**2
    assert at[1] - at[0] <= ACCURACY


@settings(max_examples=examples(10), deadline=None)
@pytest.mark.parametrize("name", PROJECTIONS)
@given(seed=SEEDS, size=STEPS)
def test_a_projection_is_the_nearest_point_of_its_set(name: str, seed: int, size: float) -> None:
    v = np.random.default_rng(seed).standard_normal((3, 3))
    project, constraints = PROJECTIONS[name]
    expected = minimised(v.shape, v, lambda x: (0.0, constraints(x, size)))
    np.testing.assert_allclose(project(v, size), expected, rtol=0, atol=ACCURACY)
    np.testing.assert_allclose(project(project(v, size), size), project(v, size), rtol=0, atol=1e-14)


@settings(max_examples=examples(10), deadline=None)
@given(seed=SEEDS, columns=st.integers(1, 3))
def test_the_nearest_orthonormal_columns_maximise_over_their_convex_hull(seed: int, columns: int) -> None:
    v = np.random.default_rng(seed).standard_normal((3, columns))
    x = cp.Variable(v.shape)
    hull = cp.Problem(cp.Maximize(cp.sum(cp.multiply(v, x))), [cp.sigma_max(x) <= 1])
    ConvexSolver().run(hull, TOLERANCE)
    P = prox.project_stiefel(v)
    np.testing.assert_allclose(P.T @ P, np.eye(columns), rtol=0, atol=1e-14)
    assert np.sum(v * P) == pytest.approx(hull.value, rel=1e-7)


@settings(max_examples=examples(10), deadline=None)
@given(seed=SEEDS)
def test_the_nearest_rotation_maximises_over_its_convex_hull(seed: int) -> None:
    v = np.random.default_rng(seed).standard_normal((3, 3))
    q = cp.Variable((4, 4), PSD=True)  # q q^T of a unit quaternion (x, y, z, w), without its rank
    off = [(2, 1, 0), (0, 2, 1), (1, 0, 2)]
    R: dict[tuple[int, int], object] = {(k, k): 2 * q[k, k] + 2 * q[3, 3] - 1 for k in range(3)}
    for i, j, axis in off:
        R[i, j] = 2 * (q[i, j] + q[axis, 3])
        R[j, i] = 2 * (q[i, j] - q[axis, 3])
    value = sum(v[place] * entry for place, entry in R.items())
    hull = cp.Problem(cp.Maximize(value), [cp.trace(q) == 1])
    ConvexSolver().run(hull, TOLERANCE)
    P = prox.project_to_rotations(v[None])[0]
    assert np.linalg.det(P) == pytest.approx(1.0, rel=1e-12)
    assert np.sum(v * P) == pytest.approx(hull.value, rel=1e-7, abs=1e-7)
    unit = quaternions_from_rotations(P[None])[0]
    q.value = np.outer(unit, unit)
    np.testing.assert_allclose([[np.sum(R[i, j].value) for j in range(3)] for i in range(3)], P, rtol=0, atol=1e-12)


@given(seed=SEEDS, nonzeros=st.integers(1, 12))
def test_hard_thresholding_leaves_the_least_that_it_can(seed: int, nonzeros: int) -> None:
    v = np.random.default_rng(seed).standard_normal((4, 3))
    x = prox.project_sparse(v, nonzeros)
    assert np.count_nonzero(x) == nonzeros
    assert np.sum((v - x) ** 2) == pytest.approx(np.sum(np.sort(v**2, axis=None)[: 12 - nonzeros]), abs=1e-14)


def test_zero_stays_zero_or_goes_into_the_set() -> None:
    zero = np.zeros((3, 2))
    for name in OPERATORS:
        np.testing.assert_array_equal(getattr(prox, name)(zero, 1.0), zero)
    np.testing.assert_array_equal(prox.project_ball(zero, 0.0), zero)
    np.testing.assert_array_equal(prox.project_unit_columns(zero), [[1.0, 1.0], [0.0, 0.0], [0.0, 0.0]])
