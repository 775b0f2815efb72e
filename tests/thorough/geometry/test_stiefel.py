"""The geometry of St(d, r)^n."""

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS
from hypothesis import given, strategies as st

from pgo_models.geometry.rotations import random_rotations
from pgo_models.geometry.stiefel import append_rank, project_to_tangent, retract, row_products

EXTRA = st.integers(0, 4)


def stacks(seed: int, d: int, extra: int, n: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """A point and a matrix of the same shape."""
    rng = np.random.default_rng(seed)
    Y = np.swapaxes(np.linalg.qr(rng.standard_normal((n, d + extra, d)))[0], 1, 2)
    return Y, rng.standard_normal((n, d, d + extra))


@given(seed=SEEDS, d=DIMENSIONS, extra=EXTRA)
def test_the_projection_is_the_nearest_tangent(seed: int, d: int, extra: int) -> None:
    Y, V = stacks(seed, d, extra)
    P = project_to_tangent(Y, V)
    np.testing.assert_allclose(row_products(P, Y), 0, rtol=0, atol=1e-13)
    np.testing.assert_allclose(project_to_tangent(Y, P), P, rtol=0, atol=1e-13)
    other = project_to_tangent(Y, stacks(seed + 1, d, extra)[1])
    assert np.sum((V - P) * other) == pytest.approx(0, abs=1e-11)


@given(seed=SEEDS, d=DIMENSIONS, extra=EXTRA, length=st.sampled_from([1e-8, 1.0, 1e5]))
def test_a_retraction_stays_on_the_manifold(seed: int, d: int, extra: int, length: float) -> None:
    Y, V = stacks(seed, d, extra)
    moved = retract(Y, length * project_to_tangent(Y, V))
    np.testing.assert_allclose(
        row_products(moved, moved), np.broadcast_to(np.eye(d), (6, d, d)), rtol=0, atol=1e-10
    )


@given(seed=SEEDS, d=DIMENSIONS, extra=EXTRA)
def test_a_retraction_is_the_nearest_point(seed: int, d: int, extra: int) -> None:
    Y, V = stacks(seed, d, extra)
    A = Y + project_to_tangent(Y, V)
    U, _, Vt = np.linalg.svd(A, full_matrices=False)
    np.testing.assert_allclose(retract(Y, A - Y), U @ Vt, rtol=0, atol=1e-12)


@given(seed=SEEDS, d=DIMENSIONS, extra=EXTRA)
def test_a_retraction_has_no_acceleration_in_the_tangent_space(
    seed: int, d: int, extra: int
) -> None:
    Y, V = stacks(seed, d, extra)
    V = project_to_tangent(Y, V)
    h = np.logspace(-1.5, -3, 4)
    error = [np.linalg.norm(project_to_tangent(Y, retract(Y, x * V) - Y - x * V)) for x in h]
    assert np.polyfit(np.log(h), np.log(error), 1)[0] == pytest.approx(3, abs=0.2)


@given(seed=SEEDS, d=DIMENSIONS, length=st.floats(0.1, 100.0))
def test_rotations_stay_rotations(seed: int, d: int, length: float) -> None:
    rng = np.random.default_rng(seed)
    Y = random_rotations(6, d, rng)
    moved = retract(Y, length * project_to_tangent(Y, rng.standard_normal(Y.shape)))
    np.testing.assert_allclose(np.linalg.det(moved), 1, rtol=0, atol=1e-10)


def test_a_column_is_appended() -> None:
    Y, _ = stacks(0, 3, 1)
    column = np.arange(18.0).reshape(6, 3)
    np.testing.assert_array_equal(append_rank(Y, column)[..., -1], column)
    np.testing.assert_array_equal(append_rank(Y)[..., :-1], Y)
    assert not append_rank(Y)[..., -1].any()
