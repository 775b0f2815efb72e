import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from graphs import EPS, SEEDS
from hypothesis import given, strategies as st

from pgo_models import PGOProblem, circle
from pgo_models.geometry.rotations import Array
from solvers import SOC, FixedPenalty, RStep, run
from solvers.soc.accelerated_gradients import minimize_with_fista, minimize_with_nesterov


def quadratic(seed: int, side: int, condition: float) -> tuple[Array, float, float]:
    """H with eigenvalues from 1 to the condition, and these two."""
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.standard_normal((side, side)))[0]
    values = np.exp(rng.uniform(0.0, np.log(condition), side))
    values[0] = 1.0
    values[-1] = condition
    return (basis * values) @ basis.T, condition, 1.0


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


def test_a_run_that_ends_too_early_says_so() -> None:
    graph = circle(np.random.default_rng(0))
    problem = PGOProblem(replace(graph, kappa=np.logspace(-5, 5, graph.num_edges)))
    soc = SOC(r_step=RStep.FISTA, penalty=FixedPenalty(1e-7), max_iterations=1)
    with pytest.warns(
        RuntimeWarning,
        match=r"FISTA ended at its 50000 iterations with .*; use RStep\.FACTORIZED or",
    ):
        run(soc, problem)
