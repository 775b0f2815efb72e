import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, SEEDS, SIZES, varied_problem
from hypothesis import given, settings, strategies as st

from pgo_models.convex.rotation_subproblem import RotationQP, rotation_qp
from pgo_models.errors import SettingError

PENALISE_TRANSLATIONS = st.booleans()


def posed(
    seed: int, n: int, d: int, with_translations: bool
) -> tuple[RotationQP, np.ndarray, np.random.Generator]:
    """The QP of a whole graph, its dense M + D/2, and the generator for shifts."""
    problem = varied_problem(seed, n, d)
    rng = np.random.default_rng(seed)
    penalty = np.exp(rng.standard_normal(problem.side)) * float(np.median(problem.M.diagonal()))
    if not with_translations:
        penalty[:n] = 0.0
    A, w = problem.residual_matrix
    return rotation_qp(A, w, penalty, d), problem.M.toarray() + 0.5 * np.diag(penalty), rng


@settings(max_examples=examples(25))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, with_translations=PENALISE_TRANSLATIONS)
def test_the_solution_satisfies_the_normal_equations(
    seed: int, n: int, d: int, with_translations: bool
) -> None:
    qp, K, rng = posed(seed, n, d, with_translations)
    for _ in range(2):  # the second shift reuses what the first compiled
        V = rng.standard_normal((len(K), d))
        X = qp.solve(V)
        b = 0.5 * qp.penalty[:, None] * V
        # The tolerance of the solver, on the scale of its terms.
        assert np.abs(K @ X - b).max() <= 1e-8 * np.abs(K).max() * (1.0 + np.abs(X).max())


@settings(max_examples=examples(10))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_the_objective_is_the_R_subproblem(seed: int, n: int, d: int) -> None:
    qp, K, rng = posed(seed, n, d, with_translations=True)
    V, X = rng.standard_normal((2, len(K), d))
    M = K - 0.5 * np.diag(qp.penalty)
    qp.shift.value = np.sqrt(qp.penalty)[:, None] * V
    qp.X.value = X
    expected = np.sum(X * (M @ X)) + 0.5 * np.sum(qp.penalty[:, None] * (X - V) ** 2)
    assert qp.problem.objective.value == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("value", [-1.0, np.nan])
def test_penalties_must_not_be_negative(value: float) -> None:
    problem = varied_problem(0, 4, 2)
    penalty = np.ones(problem.side)
    penalty[3] = value
    with pytest.raises(SettingError, match="must not be negative, and one must be positive"):
        rotation_qp(*problem.residual_matrix, penalty, 2)
    with pytest.raises(SettingError, match="one must be positive"):
        rotation_qp(*problem.residual_matrix, np.zeros(problem.side), 2)
