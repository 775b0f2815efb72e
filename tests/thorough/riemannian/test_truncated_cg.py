"""Truncated conjugate gradients on dense quadratic models."""

import numpy as np
import pytest
from graphs import SEEDS
from hypothesis import given, strategies as st

from solvers.riemannian.truncated_cg import TruncatedStep, truncated_conjugate_gradients

SIDE = 12


def spectrum(seed: int, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Symmetric matrix with eigenvalues between the two, and a gradient."""
    rng = np.random.default_rng(seed)
    V = np.linalg.qr(rng.standard_normal((SIDE, SIDE)))[0]
    return (V * rng.uniform(low, high, SIDE)) @ V.T, rng.standard_normal(SIDE)


def solve(
    H: np.ndarray, P: np.ndarray, g: np.ndarray, radius: float, forcing: float = 1e-10
) -> TruncatedStep:
    return truncated_conjugate_gradients(
        g, lambda v: H @ v, lambda v: np.linalg.solve(P, v), radius, forcing, 0.0, 200
    )


@given(seed=SEEDS)
def test_in_a_wide_region_it_is_the_newton_step(seed: int) -> None:
    H, g = spectrum(seed, 0.5, 20.0)
    P, _ = spectrum(seed + 1, 0.5, 5.0)
    found = solve(H, P, g, 1e6)
    newton = -np.linalg.solve(H, g)
    np.testing.assert_allclose(found.step, newton, rtol=0, atol=1e-7 * np.linalg.norm(newton))
    assert found.decrease == pytest.approx(-0.5 * g @ newton, rel=1e-8)
    assert found.length == pytest.approx(np.sqrt(newton @ P @ newton), rel=1e-6)
    assert not found.is_at_boundary


@given(seed=SEEDS, low=st.sampled_from([-5.0, 0.5]), radius=st.floats(1e-3, 1.0))
def test_at_the_boundary_it_is_better_than_the_cauchy_point(
    seed: int, low: float, radius: float
) -> None:
    H, g = spectrum(seed, low, 10.0)
    P, _ = spectrum(seed + 1, 0.5, 5.0)
    found = solve(H, P, g, radius)
    s = found.step
    assert found.length == pytest.approx(np.sqrt(s @ P @ s), rel=1e-6)
    assert found.length <= radius * (1 + 1e-12)
    assert found.decrease == pytest.approx(-(g @ s + 0.5 * s @ H @ s), rel=1e-9)
    p = -np.linalg.solve(P, g)
    longest = radius / np.sqrt(p @ P @ p)
    length = min(longest, -(g @ p) / (p @ H @ p)) if p @ H @ p > 0 else longest
    assert found.decrease >= -(length * g @ p + 0.5 * length**2 * p @ H @ p) * (1 - 1e-9)
    if found.is_at_boundary:
        assert found.length == pytest.approx(radius)
