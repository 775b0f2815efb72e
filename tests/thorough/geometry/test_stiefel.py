"""The geometry of St(d, r)^n."""

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS
from hypothesis import given, strategies as st

from pgo_models.geometry.stiefel import project_to_tangent, retract, row_products

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
