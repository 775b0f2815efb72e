"""The rank-restricted relaxation, its derivatives and its rounding."""

from collections.abc import Callable

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, random_poses, varied_problem
from hypothesis import given, strategies as st

from pgo_models import PGOProblem, multipliers
from pgo_models.geometry.rotations import Array
from pgo_models.geometry.stiefel import append_rank, project_to_tangent, retract
from pgo_models.relaxations.low_rank import (
    LiftedPoses,
    append_dimension,
    hessian_product,
    lifted_point,
)
from pgo_models.relaxations.rounding import round_factor, round_gram

SIZES = st.integers(2, 8)
EXTRA = st.integers(0, 3)


def drawn(seed: int, n: int, d: int, extra: int) -> tuple[PGOProblem, Array, Array]:
    """A problem, a point and a unit tangent at the point."""
    rng = np.random.default_rng(seed)
    columns = np.linalg.qr(rng.standard_normal((n, d + extra, d)))[0]
    Y = np.swapaxes(columns, 1, 2)
    V = project_to_tangent(Y, rng.standard_normal(Y.shape))
    return varied_problem(seed, n, d), Y, V / np.linalg.norm(V)


def differences(value: Callable[[float], float], h: float) -> tuple[float, float]:
    """First and second derivative at 0 by central differences."""
    after = value(h)
    before = value(-h)
    return (after - before) / (2 * h), (after - 2 * value(0.0) + before) / h**2


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, extra=EXTRA)
def test_the_value_is_that_of_the_dense_marginalised_matrix(
    seed: int, n: int, d: int, extra: int
) -> None:
    problem, Y, _ = drawn(seed, n, d, extra)
    point = lifted_point(problem, Y)
    rows = Y.reshape(n * d, -1)
    product = problem.Q @ rows
    atol = 1e-11 * n * np.abs(problem.Q).max()
    assert point.value == pytest.approx(np.sum(rows * product), abs=atol)
    assert np.einsum("naa->", point.Lambda) == pytest.approx(point.value, abs=atol)
    np.testing.assert_allclose(problem.translations.apply_Q(rows), product, rtol=0, atol=atol)
    assert point.rank == d + extra


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_at_rank_d_it_is_F_with_its_multipliers(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    poses = problem.with_best_translations(random_poses(n, d, seed).R)
    point = lifted_point(problem, np.swapaxes(poses.R, 1, 2))
    assert point.value == pytest.approx(problem.objective(poses), rel=1e-12)
    expected = multipliers(problem, poses)
    atol = 1e-12 * np.abs(expected).max()
    np.testing.assert_allclose(point.Lambda, expected, rtol=0, atol=atol)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, extra=EXTRA)
def test_the_gradient_and_the_hessian_are_the_derivatives(
    seed: int, n: int, d: int, extra: int
) -> None:
    problem, Y, V = drawn(seed, n, d, extra)
    point = lifted_point(problem, Y)
    first, second = differences(lambda h: lifted_point(problem, retract(Y, h * V)).value, 1e-4)
    scale = max(1.0, point.value, float(np.abs(problem.Q).sum(axis=0).max()))
    slope = np.sum(point.gradient * V)
    curvature = np.sum(V * hessian_product(problem, point, V))
    assert first == pytest.approx(slope, abs=1e-6 * scale)
    assert second == pytest.approx(curvature, abs=1e-5 * scale)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, extra=EXTRA)
def test_the_hessian_is_symmetric_and_tangent(seed: int, n: int, d: int, extra: int) -> None:
    problem, Y, V = drawn(seed, n, d, extra)
    W = project_to_tangent(Y, np.random.default_rng([seed, 7]).standard_normal(Y.shape))
    point = lifted_point(problem, Y)
    HV = hessian_product(problem, point, V)
    HW = hessian_product(problem, point, W)
    scale = max(1.0, float(np.abs(problem.Q).sum(axis=0).max()))
    assert np.sum(W * HV) == pytest.approx(np.sum(V * HW), abs=1e-10 * scale * n)
    np.testing.assert_allclose(project_to_tangent(Y, HV), HV, rtol=0, atol=1e-11 * scale)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, extra=st.integers(1, 3))
def test_rotations_that_were_lifted_and_turned_are_rounded_back(
    seed: int, n: int, d: int, extra: int
) -> None:
    problem = varied_problem(seed, n, d)
    rng = np.random.default_rng(seed)
    R = random_poses(n, d, seed).R
    Y = np.swapaxes(R, 1, 2)
    for _ in range(extra):
        Y = append_rank(Y)
    turn = np.linalg.qr(rng.standard_normal((d + extra, d + extra)))[0]
    expected = R[0].T @ R
    poses, report = round_factor(problem, Y @ turn)
    np.testing.assert_allclose(poses.with_gauge_at(0).R, expected, rtol=0, atol=1e-9)
    assert report.is_tight
    rows = Y.reshape(n * d, -1)
    by_gram, _ = round_gram(problem, rows @ rows.T)
    np.testing.assert_allclose(by_gram.with_gauge_at(0).R, expected, rtol=0, atol=1e-6)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, extra=EXTRA)
def test_gradient_and_hessian_of_lifted_poses_are_the_derivatives(
    seed: int, n: int, d: int, extra: int
) -> None:
    problem, Y, _ = drawn(seed, n, d, extra)
    rng = np.random.default_rng(seed)
    poses = LiftedPoses(np.swapaxes(Y, 1, 2), rng.standard_normal((n, d + extra)))
    layout = poses.layout
    M_sum = float(abs(problem.M).sum())
    step = rng.standard_normal(layout.side)
    step /= np.linalg.norm(step)
    w, v = layout.split(step)
    scale = problem.objective(poses) + M_sum
    first, second = differences(lambda h: problem.objective(poses.moved_along(h * w, h * v)), 1e-4)
    slope = layout.join(*poses.gradient(problem.at(poses).half_gradient)) @ step
    assert first == pytest.approx(slope, abs=1e-6 * scale)
    Lambda = multipliers(problem, poses)
    H = poses.hessian(problem, Lambda)
    assert second == pytest.approx(step @ (H @ step), abs=1e-5 * scale)
    assert abs(H - H.T).max() <= 1e-12 * M_sum
    # Multipliers change the diagonal blocks alone, by the curvature of the constraints.
    change = (poses.hessian(problem, None) - H).toarray()
    columns = layout.rotations(np.arange(n))
    blocks = change[columns[:, :, None], columns[:, None, :]]
    np.testing.assert_allclose(blocks, poses.curvature(Lambda), rtol=0, atol=1e-11 * M_sum)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_a_new_dimension_costs_nothing_and_a_way_up_begins_flat(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    poses = random_poses(n, d, seed)
    lifted = append_dimension(poses)
    x = np.random.default_rng(seed).standard_normal((d + 1) * n)
    assert problem.objective(lifted) == pytest.approx(problem.objective(poses), rel=1e-12)
    Lambda = multipliers(problem, poses)
    np.testing.assert_allclose(multipliers(problem, lifted), Lambda, rtol=1e-9, atol=1e-9)
    w, v = lifted.upwards(x)
    step = np.einsum("nrak,nk->nra", lifted.basis, w)
    np.testing.assert_allclose(step[:, -1].ravel(), x[n:], rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.abs(step[:, :-1]).max(), 0.0, atol=1e-12)
    np.testing.assert_array_equal(v[:, -1], x[:n])
    gradient = lifted.layout.join(*lifted.gradient(problem.at(lifted).half_gradient))
    assert abs(gradient @ lifted.layout.join(w, v)) <= 1e-9
