from dataclasses import dataclass, field

import numpy as np
from budget import examples
from graphs import SEEDS
from hypothesis import given, settings, strategies as st

from pgo_models.geometry.rotations import Array
from pgo_models.problem.matrices import inner, norm
from solvers.soc.anderson import Anderson, AndersonShare, AndersonSums


@dataclass(frozen=True, eq=False)
class AndersonMemory:
    """What one party remembers that has all rows: written down apart from the package."""

    residual_differences: tuple[Array, ...] = ()
    image_differences: tuple[Array, ...] = ()
    gram: Array = field(default_factory=lambda: np.zeros((0, 0)))
    residual: Array | None = None
    image: Array | None = None
    smallest: float = np.inf


def extrapolate(
    settings: Anderson, memory: AndersonMemory, residual: Array, image: Array
) -> tuple[Array, AndersonMemory]:
    size = norm(residual)
    if size > settings.restart_ratio * memory.smallest:
        memory = AndersonMemory()
    smallest = min(memory.smallest, size)
    if memory.residual is None or memory.image is None:
        return image, AndersonMemory(residual=residual, image=image, smallest=smallest)
    keep = settings.memory - 1
    older = memory.residual_differences[-keep:] if keep else ()
    older_images = memory.image_differences[-keep:] if keep else ()
    newest = residual - memory.residual
    gram = np.empty((len(older) + 1, len(older) + 1))
    gram[:-1, :-1] = memory.gram[len(memory.gram) - len(older) :, len(memory.gram) - len(older) :]
    gram[-1, :] = [inner(newest, other) for other in (*older, newest)]
    gram[:, -1] = gram[-1]
    residuals = (*older, newest)
    images = (*older_images, image - memory.image)
    right_hand_side = np.array([inner(other, residual) for other in residuals])
    damped = gram + 1e-12 * np.trace(gram) * np.eye(len(gram))
    gamma = np.linalg.lstsq(damped, right_hand_side, rcond=None)[0]
    following = image.copy()
    for coefficient, difference in zip(gamma, images, strict=True):
        following -= coefficient * difference
    return following, AndersonMemory(residuals, images, gram, residual, image, smallest)


class Parties:
    """Rows spread over parties at random, and the sums by which they accelerate together."""

    def __init__(self, rng: np.random.Generator, rows: int, number: int) -> None:
        self.owner = rng.integers(0, number, rows)  # some may own none
        self.shares = [AndersonShare() for _ in range(number)]
        self.sums = AndersonSums()
        self.restarts = 0

    def extrapolate(self, settings: Anderson, residual: Array, image: Array) -> Array:
        sums_of_parties = []
        for party, share in enumerate(self.shares):
            rows = self.owner == party
            sums, self.shares[party] = share.observe(residual[rows], image[rows], settings.memory)
            sums_of_parties.append(sums)
        gamma, self.sums = self.sums.coefficients(settings, np.sum(sums_of_parties, axis=0))
        self.restarts += gamma is None
        following = np.empty_like(image)
        for party, share in enumerate(self.shares):
            rows, self.shares[party] = share.extrapolated(gamma)
            following[self.owner == party] = rows
        return following


@settings(max_examples=examples(40))
@given(seed=SEEDS, rows=st.integers(1, 40), number=st.integers(1, 6), memory=st.integers(1, 8))
def test_parties_take_the_steps_that_one_would_take(
    seed: int, rows: int, number: int, memory: int
) -> None:
    # Residuals without order, so that the memory fills, is emptied again and again, and fills
    # again.
    rng = np.random.default_rng(seed)
    rule = Anderson(memory=memory, restart_ratio=3.0)
    parties = Parties(rng, rows, number)
    alone = AndersonMemory()
    restarts = 0
    for _ in range(40):
        residual = np.exp(rng.normal(0.0, 0.7)) * rng.standard_normal((rows, 3)) / np.sqrt(3 * rows)
        image = rng.standard_normal((rows, 3))
        before = alone
        expected, alone = extrapolate(rule, alone, residual, image)
        restarts += before.residual is not None and not alone.residual_differences
        shared = parties.extrapolate(rule, residual, image)
        np.testing.assert_allclose(
            shared, expected, rtol=0, atol=1e-9 * (1 + np.abs(expected).max())
        )
        assert parties.restarts == restarts
        for share in parties.shares:
            assert (
                len(share.residual_differences)
                == len(share.image_differences)
                == len(alone.residual_differences)
            )
    np.testing.assert_allclose(parties.sums.gram, alone.gram, rtol=1e-9, atol=1e-9)


@given(seed=SEEDS, side=st.integers(1, 6), number=st.integers(1, 5))
def test_a_linear_map_is_solved_in_as_many_steps_as_unknowns(
    seed: int, side: int, number: int
) -> None:
    # On a linear map it is GMRES (Walker & Ni 2011, theorem 2.2): exact after side + 1 steps, but
    # for rounding.
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.standard_normal((side, side)))[0]
    T = (basis * rng.uniform(-0.5, 0.5, side)) @ basis.T
    fixed = rng.standard_normal((side, 1))
    s = np.zeros((side, 1))
    rule = Anderson(memory=side + 1, restart_ratio=np.inf)
    parties = Parties(rng, side, number)
    for _ in range(side + 2):
        image = fixed + T @ (s - fixed)
        s = parties.extrapolate(rule, image - s, image)
    np.testing.assert_allclose(s, fixed, rtol=0, atol=1e-4 * np.linalg.norm(fixed))
