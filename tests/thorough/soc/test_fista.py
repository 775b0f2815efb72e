import warnings
from dataclasses import replace

import numpy as np
import pytest
from graphs import EPS, SEEDS
from hypothesis import given, strategies as st

from pgo_models import PGOProblem, circle
from pgo_models.geometry.rotations import Array
from solvers import SOC, FixedPenalty, RStep, run
from solvers.soc.fista import minimize_with_fista


def quadratic(seed: int, side: int, condition: float) -> Array:
    """H with eigenvalues from 1 to the condition."""
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.standard_normal((side, side)))[0]
    values = np.exp(rng.uniform(0.0, np.log(condition), side))
    values[0] = 1.0
    values[-1] = condition
    return (basis * values) @ basis.T


def textbook_iterates(
    H: Array, b: Array, start: Array, lipschitz: float, count: int
) -> list[Array]:
    """x_0, x_1, .. as Beck & Teboulle 2009, (4.1) to (4.3), have them."""
    x = [start]
    y, t = start, 1.0
    for _ in range(count):
        x.append(y - (H @ y - b) / lipschitz)
        t_next = (1 + np.sqrt(1 + 4 * t**2)) / 2
        y = x[-1] + (t - 1) / t_next * (x[-1] - x[-2])
        t = t_next
    return x


def last_iterate(H: Array, b: Array, start: Array, lipschitz: float, k: int) -> Array:
    """x_k, whatever its accuracy."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return minimize_with_fista(
            lambda x: H @ x, b, start, lipschitz, tolerance=0, max_iterations=k
        )


@given(seed=SEEDS, side=st.integers(2, 20), condition=st.floats(1.0, 1e3))
def test_its_iterates_are_those_of_the_textbook(seed: int, side: int, condition: float) -> None:
    H = quadratic(seed, side, condition)
    b, start = np.random.default_rng(seed).standard_normal((2, side, 2))
    expected = textbook_iterates(H, b, start, condition, 30)
    for k in (0, 1, 2, 3, 10, 30):
        x = last_iterate(H, b, start, condition, k)
        np.testing.assert_allclose(x, expected[k], rtol=0, atol=1e-10 * np.abs(expected).max())


@given(
    seed=SEEDS, side=st.integers(2, 20), columns=st.integers(1, 3), condition=st.floats(1.0, 100.0)
)
def test_it_solves_to_its_tolerance(seed: int, side: int, columns: int, condition: float) -> None:
    H = quadratic(seed, side, condition)
    b, start = np.random.default_rng(seed).standard_normal((2, side, columns))
    for tolerance in (1e-3, 1e-9):
        x = minimize_with_fista(lambda x: H @ x, b, start, condition, tolerance=tolerance)
        # The residual as the iteration computed it, and what its rounding may hide.
        assert np.linalg.norm(H @ x - b) <= (tolerance + 64 * EPS * condition) * np.linalg.norm(b)


def test_a_run_that_ends_too_early_says_so() -> None:
    graph = circle(np.random.default_rng(0))
    problem = PGOProblem(replace(graph, kappa=np.logspace(-5, 5, graph.num_edges)))
    soc = SOC(r_step=RStep.FISTA, penalty=FixedPenalty(1e-7), max_iterations=1)
    with pytest.warns(
        RuntimeWarning,
        match=r"FISTA ended at its 50000 iterations with .*; use RStep\.FACTORIZED or",
    ):
        run(soc, problem)
