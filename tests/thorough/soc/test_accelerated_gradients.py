import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from graphs import EPS, SEEDS
from hypothesis import given, strategies as st

from pgo_models import PGOProblem
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.scenes import circle
from solvers import SOC, FixedPenalty, RStep
from solvers.loop import run
from solvers.soc.accelerated_gradients import minimize_with_fista, minimize_with_nesterov


def quadratic(seed: int, side: int, condition: float) -> tuple[Array, float, float]:
    """H with eigenvalues from 1 to the condition, and these two."""
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.standard_normal((side, side)))[0]
    values = np.exp(rng.uniform(0.0, np.log(condition), side))
    values[0] = 1.0
    values[-1] = condition
    return (basis * values) @ basis.T, condition, 1.0


class Counted:
    """x -> H x, and how often it was asked for."""

    def __init__(self, H: Array) -> None:
        self.H = H
        self.count = 0

    def __call__(self, x: Array) -> Array:
        self.count += 1
        return self.H @ x


def fista(
    apply_H: Callable[[Array], Array],
    b: Array,
    start: Array,
    lipschitz: float,
    convexity: float,
    **limits: Any,
) -> Array:
    """FISTA with the signature of Nesterov's method; it makes no use of the convexity."""
    return minimize_with_fista(apply_H, b, start, lipschitz, **limits)


METHODS = {"FISTA": fista, "Nesterov's method": minimize_with_nesterov}
each_method = pytest.mark.parametrize("name", METHODS)


def textbook_iterates(
    name: str, H: Array, b: Array, start: Array, lipschitz: float, convexity: float, count: int
) -> list[Array]:
    """x_0, x_1, .. as Beck & Teboulle 2009, (4.1) to (4.3), and Nesterov 2004, (2.2.11), have them.

    Nesterov's momentum is left out in a step that it would begin uphill.
    """
    x = [start]
    y, t = start, 1.0
    for _ in range(count):
        gradient = H @ y - b
        x.append(y - gradient / lipschitz)
        if name == "FISTA":
            t_next = (1 + np.sqrt(1 + 4 * t**2)) / 2
            momentum, t = (t - 1) / t_next, t_next
        else:
            roots = np.sqrt(lipschitz), np.sqrt(convexity)
            momentum = (roots[0] - roots[1]) / (roots[0] + roots[1])
            if np.sum(gradient * (x[-1] - x[-2])) > 0:
                momentum = 0.0
        y = x[-1] + momentum * (x[-1] - x[-2])
    return x


def last_iterate(name: str, H: Array, b: Array, start: Array, *constants: float, k: int) -> Array:
    """x_k, whatever its accuracy."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return METHODS[name](lambda x: H @ x, b, start, *constants, tolerance=0, max_iterations=k)


@each_method
@given(seed=SEEDS, side=st.integers(2, 20), condition=st.floats(1.0, 1e3))
def test_its_iterates_are_those_of_the_textbook(
    name: str, seed: int, side: int, condition: float
) -> None:
    H, lipschitz, convexity = quadratic(seed, side, condition)
    b, start = np.random.default_rng(seed).standard_normal((2, side, 2))
    expected = textbook_iterates(name, H, b, start, lipschitz, convexity, 30)
    for k in (0, 1, 2, 3, 10, 30):
        x = last_iterate(name, H, b, start, lipschitz, convexity, k=k)
        np.testing.assert_allclose(x, expected[k], rtol=0, atol=1e-10 * np.abs(expected).max())


@given(seed=SEEDS, side=st.integers(2, 20), rank=st.integers(1, 20), k=st.integers(1, 200))
def test_fista_keeps_its_rate_where_nothing_is_strongly_convex(
    seed: int, side: int, rank: int, k: int
) -> None:
    # F(x_k) - F(x*) <= 2 L ||x_0 - x*||^2 / (k + 1)^2 (Beck & Teboulle 2009, theorem 4.4).
    rng = np.random.default_rng(seed)
    factor = rng.standard_normal((side, rank))
    H = factor @ factor.T
    lipschitz = float(np.linalg.eigvalsh(H)[-1])
    start, solution = rng.standard_normal((2, side, 1))
    error = last_iterate("FISTA", H, H @ solution, start, lipschitz, 0.0, k=k) - solution
    excess = 0.5 * np.vdot(error, H @ error)
    bound = 2 * lipschitz * np.sum((start - solution) ** 2) / (k + 1) ** 2
    assert excess <= bound * (1 + 1e-9)


@each_method
@given(
    seed=SEEDS, side=st.integers(2, 20), columns=st.integers(1, 3), condition=st.floats(1.0, 100.0)
)
def test_it_solves_to_its_tolerance(
    name: str, seed: int, side: int, columns: int, condition: float
) -> None:
    H, lipschitz, convexity = quadratic(seed, side, condition)
    b, start = np.random.default_rng(seed).standard_normal((2, side, columns))
    for tolerance in (1e-3, 1e-9):
        x = METHODS[name](lambda x: H @ x, b, start, lipschitz, convexity, tolerance=tolerance)
        # The residual as the iteration computed it, and what its rounding may hide.
        assert np.linalg.norm(H @ x - b) <= (tolerance + 64 * EPS * condition) * np.linalg.norm(b)


@each_method
@given(seed=SEEDS, side=st.integers(2, 20), condition=st.floats(1.0, 1e3))
def test_it_stays_at_the_solution(name: str, seed: int, side: int, condition: float) -> None:
    H, lipschitz, convexity = quadratic(seed, side, condition)
    solution = np.random.default_rng(seed).standard_normal((side, 2))
    b = H @ solution
    np.testing.assert_array_equal(
        METHODS[name](lambda x: H @ x, b, solution, lipschitz, convexity), solution
    )


@given(seed=SEEDS, side=st.integers(2, 20))
def test_nesterov_takes_about_the_root_of_the_condition_in_steps(seed: int, side: int) -> None:
    # O(sqrt(L / mu) log(1 / tolerance)); plain gradients would take O(L / mu), a hundred times as
    # many here.
    condition = 1e4
    tolerance = 1e-8
    H, lipschitz, convexity = quadratic(seed, side, condition)
    b = np.random.default_rng(seed).standard_normal((side, 1))
    counted = Counted(H)
    minimize_with_nesterov(counted, b, np.zeros_like(b), lipschitz, convexity, tolerance)
    # (1 - 1 / sqrt(condition))^(k/2) in the residual, which starts at most condition too high.
    assert counted.count <= 2 * np.sqrt(condition) * np.log(condition / tolerance) + 10


@each_method
@given(seed=SEEDS, side=st.integers(2, 20), limit=st.integers(0, 10))
def test_the_limit_is_kept(name: str, seed: int, side: int, limit: int) -> None:
    H, lipschitz, convexity = quadratic(seed, side, 1e3)
    b, start = np.random.default_rng(seed).standard_normal((2, side, 1))
    counted = Counted(H)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        x = METHODS[name](counted, b, start, lipschitz, convexity, max_iterations=limit)
    assert counted.count <= limit + 1  # the last one is for what is said
    assert np.isfinite(x).all()
    reached = np.linalg.norm(H @ x - b) / np.linalg.norm(b)
    assert len(said) == (reached > 1e-12)
    if said:
        assert said[0].category is RuntimeWarning
        assert (
            f"{name} ended at its {limit} iterations with ||H x - b|| = {reached:.0e} ||b||, asked"
            in str(said[0].message)
        )


def test_a_run_that_ends_too_early_says_so() -> None:
    graph = circle(np.random.default_rng(0))
    problem = PGOProblem(replace(graph, kappa=np.logspace(-5, 5, graph.num_edges)))
    soc = SOC(r_step=RStep.FISTA, penalty=FixedPenalty(1e-7), max_iterations=1)
    with pytest.warns(
        RuntimeWarning,
        match=r"FISTA ended at its 50000 iterations with .*; use RStep\.FACTORIZED or",
    ):
        run(soc, problem)


@each_method
def test_inputs_are_left_alone(name: str) -> None:
    H, lipschitz, convexity = quadratic(0, 5, 10.0)
    b, start = np.random.default_rng(0).standard_normal((2, 5, 2))
    kept = b.copy(), start.copy()
    METHODS[name](lambda x: H @ x, b, start, lipschitz, convexity)
    np.testing.assert_array_equal(b, kept[0])
    np.testing.assert_array_equal(start, kept[1])


@each_method
def test_nothing_on_the_right_hand_side(name: str) -> None:
    H, lipschitz, convexity = quadratic(0, 5, 10.0)
    b = np.zeros((5, 1))
    np.testing.assert_array_equal(METHODS[name](lambda x: H @ x, b, b, lipschitz, convexity), b)


@pytest.mark.parametrize(
    ("lipschitz", "convexity"), [(1.0, 2.0), (1.0, 0.0), (1.0, -1.0), (np.nan, 1.0), (1.0, np.nan)]
)
def test_the_constants_of_nesterov_are_checked(lipschitz: float, convexity: float) -> None:
    b = np.ones((2, 1))
    with pytest.raises(SettingError, match="need lipschitz >= strong_convexity > 0"):
        minimize_with_nesterov(lambda x: x, b, b, lipschitz, convexity)


@pytest.mark.parametrize("lipschitz", [0.0, -1.0, np.nan])
def test_the_constant_of_fista_is_checked(lipschitz: float) -> None:
    b = np.ones((2, 1))
    with pytest.raises(SettingError, match="need lipschitz > 0"):
        minimize_with_fista(lambda x: x, b, b, lipschitz)
