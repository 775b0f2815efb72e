import warnings
from dataclasses import replace

import numpy as np
import pytest
from graphs import EPS, SEEDS
from hypothesis import given, strategies as st

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.scenes import circle
from pgo_models.problem.problem import PGOProblem
from solvers.loop import run
from solvers.soc.fista import minimize_with_fista
from solvers.soc.penalty import FixedPenalty
from solvers.soc.r_step import RStep
from solvers.soc.soc import SOC


def quadratic(seed: int, side: int, condition: float) -> tuple[Array, float, float]:
    """H with eigenvalues from 1 to the condition, and these two."""
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.standard_normal((side, side)))[0]
    values = np.exp(rng.uniform(0.0, np.log(condition), side))
    values[0] = 1.0
    values[-1] = condition
    return (basis * values) @ basis.T, condition, 1.0


@given(
    seed=SEEDS, side=st.integers(2, 20), columns=st.integers(1, 3), condition=st.floats(1.0, 1e3)
)
def test_it_solves_to_its_tolerance(seed: int, side: int, columns: int, condition: float) -> None:
    H, lipschitz, convexity = quadratic(seed, side, condition)
    b, start = np.random.default_rng(seed).standard_normal((2, side, columns))
    for tolerance in (1e-3, 1e-9):
        x = minimize_with_fista(lambda x: H @ x, b, start, lipschitz, convexity, tolerance)
        # The residual as the iteration computed it, and what its rounding may hide.
        assert np.linalg.norm(H @ x - b) <= (tolerance + 64 * EPS * condition) * np.linalg.norm(b)


@given(seed=SEEDS, side=st.integers(2, 20), condition=st.floats(1.0, 1e3))
def test_it_stays_at_the_solution(seed: int, side: int, condition: float) -> None:
    H, lipschitz, convexity = quadratic(seed, side, condition)
    solution = np.random.default_rng(seed).standard_normal((side, 2))
    b = H @ solution
    np.testing.assert_array_equal(
        minimize_with_fista(lambda x: H @ x, b, solution, lipschitz, convexity), solution
    )


@given(seed=SEEDS, side=st.integers(2, 20))
def test_it_takes_about_the_root_of_the_condition_in_steps(seed: int, side: int) -> None:
    # O(sqrt(L / mu) log(1 / tolerance)); plain gradients would take O(L / mu), a hundred times as
    # many here.
    condition = 1e4
    tolerance = 1e-8
    H, lipschitz, convexity = quadratic(seed, side, condition)
    b = np.random.default_rng(seed).standard_normal((side, 1))
    count = 0

    def counted(x: Array) -> Array:
        nonlocal count
        count += 1
        return H @ x

    minimize_with_fista(counted, b, np.zeros_like(b), lipschitz, convexity, tolerance)
    # (1 - 1 / sqrt(condition))^(k/2) in the residual, which starts at most condition too high.
    assert count <= 2 * np.sqrt(condition) * np.log(condition / tolerance) + 10


@given(seed=SEEDS, side=st.integers(2, 20), limit=st.integers(0, 10))
def test_the_limit_is_kept(seed: int, side: int, limit: int) -> None:
    H, lipschitz, convexity = quadratic(seed, side, 1e3)
    b, start = np.random.default_rng(seed).standard_normal((2, side, 1))
    count = 0

    def counted(x: Array) -> Array:
        nonlocal count
        count += 1
        return H @ x

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        x = minimize_with_fista(counted, b, start, lipschitz, convexity, max_iterations=limit)
    assert count <= limit + 1  # the last one is for what is said
    assert np.isfinite(x).all()
    reached = np.linalg.norm(H @ x - b) / np.linalg.norm(b)
    assert len(said) == (reached > 1e-12)
    if said:
        assert said[0].category is RuntimeWarning
        assert (
            f"ended at its {limit} iterations with ||H x - b|| = {reached:.0e} ||b||, asked"
            in str(said[0].message)
        )


def test_a_run_that_ends_too_early_says_so() -> None:
    graph = circle(np.random.default_rng(0))
    problem = PGOProblem(replace(graph, kappa=np.logspace(-5, 5, graph.num_edges)))
    soc = SOC(r_step=RStep.FISTA, penalty=FixedPenalty(1e-7), max_iterations=1)
    with pytest.warns(
        RuntimeWarning,
        match=r"FISTA ended at its 20000 iterations with .*; use RStep\.FACTORIZED or",
    ):
        run(soc, problem)


def test_inputs_are_left_alone() -> None:
    H, lipschitz, convexity = quadratic(0, 5, 10.0)
    b, start = np.random.default_rng(0).standard_normal((2, 5, 2))
    kept = b.copy(), start.copy()
    minimize_with_fista(lambda x: H @ x, b, start, lipschitz, convexity)
    np.testing.assert_array_equal(b, kept[0])
    np.testing.assert_array_equal(start, kept[1])


def test_nothing_on_the_right_hand_side() -> None:
    H, lipschitz, convexity = quadratic(0, 5, 10.0)
    b = np.zeros((5, 1))
    np.testing.assert_array_equal(
        minimize_with_fista(lambda x: H @ x, b, b, lipschitz, convexity), b
    )


@pytest.mark.parametrize(
    ("lipschitz", "convexity"), [(1.0, 2.0), (1.0, 0.0), (1.0, -1.0), (np.nan, 1.0), (1.0, np.nan)]
)
def test_the_constants_are_checked(lipschitz: float, convexity: float) -> None:
    b = np.ones((2, 1))
    with pytest.raises(SettingError, match="need lipschitz >= strong_convexity > 0"):
        minimize_with_fista(lambda x: x, b, b, lipschitz, convexity)
