from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from graphs import SEEDS
from hypothesis import given, strategies as st

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from solvers.soc.anderson import Anderson, AndersonShare, AndersonSums


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


@given(seed=SEEDS, side=st.integers(1, 6))
def test_a_linear_map_is_solved_in_as_many_steps_as_unknowns(seed: int, side: int) -> None:
    # On a linear map it is GMRES (Walker & Ni 2011, theorem 2.2): exact after side + 1 steps, but
    # for rounding.
    g, fixed = contraction(seed, side, rate=0.5)
    s, _ = accelerated(
        g, np.zeros((side, 1)), Anderson(memory=side + 1, restart_ratio=np.inf), side + 2
    )
    np.testing.assert_allclose(s, fixed, rtol=0, atol=1e-4 * np.linalg.norm(fixed))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"memory": 0}, "memory must be at least 1, got 0"),
        ({"memory": -3}, "memory must be at least 1"),
        ({"restart_ratio": 1.0}, r"restart_ratio must be above 1, got 1\.0"),
        ({"restart_ratio": np.nan}, "restart_ratio must be above 1"),
    ],
)
def test_settings_are_checked(settings: dict[str, float], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        Anderson(**settings)
    with pytest.raises(ValueError, match=message):
        Anderson(**settings)
