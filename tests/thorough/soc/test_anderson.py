from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from graphs import SEEDS
from hypothesis import given, strategies as st

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from solvers.soc.anderson import Anderson, AndersonShare, AndersonSums, over_relax


@dataclass(frozen=True, eq=False)
class AndersonMemory:
    """What one party that has all rows remembers."""

    share: AndersonShare = field(default_factory=AndersonShare)
    sums: AndersonSums = field(default_factory=AndersonSums)


def extrapolate(
    settings: Anderson, memory: AndersonMemory, residual: Array, image: Array
) -> tuple[Array, AndersonMemory]:
    sums, share = memory.share.observe(residual, image, settings.memory)
    gamma, known = memory.sums.coefficients(settings, sums)
    following, share = share.extrapolated(gamma)
    return following, AndersonMemory(share, known)


def contraction(seed: int, side: int, rate: float = 0.95) -> tuple[Callable[[Array], Array], Array]:
    """An affine map whose eigenvalues lie in [-rate, rate], and its fixed point."""
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.standard_normal((side, side)))[0]
    T = (basis * rng.uniform(-rate, rate, side)) @ basis.T
    fixed = rng.standard_normal((side, 1))
    return lambda s: fixed + T @ (s - fixed), fixed


def accelerated(
    g: Callable[[Array], Array], s: Array, settings: Anderson, steps: int
) -> tuple[Array, AndersonMemory]:
    memory = AndersonMemory()
    for _ in range(steps):
        image = g(s)
        s, memory = extrapolate(settings, memory, image - s, image)
    return s, memory


@given(seed=SEEDS, alpha=st.floats(0.1, 1.9))
def test_over_relaxation_goes_alpha_of_the_way(seed: int, alpha: float) -> None:
    new, old = np.random.default_rng(seed).standard_normal((2, 5, 3))
    np.testing.assert_allclose(
        over_relax(new, old, alpha) - old, alpha * (new - old), rtol=0, atol=1e-14
    )
    assert over_relax(new, old, 1.0) is new


@given(seed=SEEDS, side=st.integers(1, 6))
def test_a_linear_map_is_solved_in_as_many_steps_as_unknowns(seed: int, side: int) -> None:
    # On a linear map it is GMRES (Walker & Ni 2011, theorem 2.2): exact after side + 1 steps, but
    # for rounding.
    g, fixed = contraction(seed, side, rate=0.5)
    s, _ = accelerated(
        g, np.zeros((side, 1)), Anderson(memory=side + 1, restart_ratio=np.inf), side + 2
    )
    np.testing.assert_allclose(s, fixed, rtol=0, atol=1e-4 * np.linalg.norm(fixed))


@given(seed=SEEDS, side=st.integers(2, 30), memory=st.integers(1, 10))
def test_it_reaches_the_fixed_point_of_the_plain_iteration(
    seed: int, side: int, memory: int
) -> None:
    g, fixed = contraction(seed, side)
    start = np.zeros((side, 1))
    s, _ = accelerated(g, start, Anderson(memory=memory), 400)
    np.testing.assert_allclose(s, fixed, rtol=0, atol=1e-6 * np.linalg.norm(fixed))


def test_it_is_faster_than_the_plain_iteration() -> None:
    g, fixed = contraction(0, 50, rate=0.99)
    plain = np.zeros((50, 1))
    for _ in range(40):
        plain = g(plain)
    s, _ = accelerated(g, np.zeros((50, 1)), Anderson(memory=20), 40)
    assert np.linalg.norm(s - fixed) < 1e-3 * np.linalg.norm(plain - fixed)


@given(seed=SEEDS, side=st.integers(1, 10))
def test_the_first_step_is_the_plain_one(seed: int, side: int) -> None:
    residual, image = np.random.default_rng(seed).standard_normal((2, side, 2))
    s, memory = extrapolate(Anderson(), AndersonMemory(), residual, image)
    np.testing.assert_array_equal(s, image)
    assert memory.share.residual_differences == ()
    assert memory.sums.smallest == pytest.approx(np.linalg.norm(residual), rel=1e-14)


@given(seed=SEEDS, side=st.integers(2, 10), size=st.integers(1, 6), steps=st.integers(2, 12))
def test_the_memory_holds_the_last_differences(seed: int, side: int, size: int, steps: int) -> None:
    rng = np.random.default_rng(seed)
    residuals, images = rng.standard_normal((2, steps, side, 2))
    memory = AndersonMemory()
    for residual, image in zip(residuals, images, strict=True):
        before = memory
        kept = [
            part.copy()
            for part in (
                *before.share.residual_differences,
                *before.share.image_differences,
                before.sums.gram,
            )
        ]
        _, memory = extrapolate(Anderson(memory=size, restart_ratio=1e9), memory, residual, image)
        after = (
            *before.share.residual_differences,
            *before.share.image_differences,
            before.sums.gram,
        )
        for array_before, array_after in zip(kept, after, strict=True):
            np.testing.assert_array_equal(array_before, array_after)
    count = min(size, steps - 1)
    assert len(memory.share.residual_differences) == len(memory.share.image_differences) == count
    for k in range(count):
        np.testing.assert_array_equal(
            memory.share.residual_differences[-1 - k], residuals[-1 - k] - residuals[-2 - k]
        )
        np.testing.assert_array_equal(
            memory.share.image_differences[-1 - k], images[-1 - k] - images[-2 - k]
        )
    gram = [
        [np.vdot(a, b) for b in memory.share.residual_differences]
        for a in memory.share.residual_differences
    ]
    np.testing.assert_allclose(memory.sums.gram, gram, rtol=0, atol=1e-12)


@given(seed=SEEDS, side=st.integers(5, 20), steps=st.integers(2, 5))
def test_the_combination_is_the_least_squares_one(seed: int, side: int, steps: int) -> None:
    rng = np.random.default_rng(seed)
    residuals, images = rng.standard_normal((2, steps, side, 1))
    memory = AndersonMemory()
    for residual, image in zip(residuals, images, strict=True):
        s, memory = extrapolate(Anderson(restart_ratio=1e9), memory, residual, image)
    df = np.concatenate(memory.share.residual_differences, axis=1)
    dg = np.concatenate(memory.share.image_differences, axis=1)
    gamma = np.linalg.lstsq(df, residuals[-1], rcond=None)[0]
    np.testing.assert_allclose(
        s, images[-1] - dg @ gamma, rtol=0, atol=1e-6 * (1 + np.abs(gamma).max())
    )


def test_a_residual_that_grows_empties_the_memory() -> None:
    settings = Anderson(restart_ratio=2.0)
    rng = np.random.default_rng(0)
    direction = rng.standard_normal((4, 1))
    images = rng.standard_normal((4, 4, 1))
    direction /= np.linalg.norm(direction)
    memory = AndersonMemory()
    for size, image, length in zip((1.0, 0.5, 0.99, 1.01), images, (0, 1, 2, 0), strict=True):
        s, memory = extrapolate(settings, memory, size * direction, image)
        assert len(memory.share.residual_differences) == length
    np.testing.assert_array_equal(s, images[-1])
    assert memory.sums.smallest == pytest.approx(1.01)


def test_differences_that_vanish_do_no_harm() -> None:
    residual = np.ones((3, 1))
    image = np.arange(3.0)[:, None]
    memory = AndersonMemory()
    for _ in range(4):
        s, memory = extrapolate(Anderson(), memory, residual, image)
        np.testing.assert_array_equal(s, image)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"memory": 0}, "memory must be at least 1, got 0"),
        ({"memory": -3}, "memory must be at least 1"),
        ({"restart_ratio": 1.0}, r"restart_ratio must be above 1, got 1\.0"),
        ({"restart_ratio": np.nan}, "restart_ratio must be above 1"),
        ({"regularization": -1e-12}, "regularization must not be negative"),
        ({"regularization": np.nan}, "regularization must not be negative"),
    ],
)
def test_settings_are_checked(settings: dict[str, float], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        Anderson(**settings)
    with pytest.raises(ValueError, match=message):
        Anderson(**settings)
