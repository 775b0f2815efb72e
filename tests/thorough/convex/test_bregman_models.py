import cvxpy as cp
import numpy as np
import pytest
from budget import examples
from hypothesis import given, settings, strategies as st
from scipy.sparse import csr_array

from pgo_models import BregmanProblem, PGOError
from pgo_models.convex.bregman import (
    block_subproblems,
    bregman_subproblem,
)
from pgo_models.convex.bregman_examples import (
    differences,
    total_variation_denoising,
    total_variation_scale_space,
)
from pgo_models.convex.convex_solver import solve_compiled
from pgo_models.errors import SettingError
from solvers import Bregman, Status, run

SEEDS = st.integers(0, 2**32 - 1)


@pytest.mark.parametrize(
    ("J", "message"),
    [
        (lambda x: -cp.sum_squares(x), "not convex: cvxpy finds it concave"),
        (lambda x: cp.sqrt(cp.sum_squares(x)), "not convex: cvxpy finds it quasiconvex"),
        (lambda x: cp.abs(x), "must be one number"),
        (lambda x: 1.0, "give a cvxpy expression"),
        (lambda x: cp.norm1(x) + cp.norm1(cp.Variable(2, name="stranger")), "stranger"),
    ],
)
def test_bad_objectives_are_refused(J, message: str) -> None:
    x = cp.Variable(3)
    with pytest.raises(SettingError, match=message):
        BregmanProblem(J(x), x, np.ones((1, 3)), [1.0])


@pytest.mark.parametrize(
    ("K", "f", "message"),
    [
        (np.ones((1, 2)), [1.0], r"K has shape \(1, 2\)"),
        (np.ones((2, 3)), [1.0], r"f \(1,\)"),
        (np.full((1, 3), np.nan), [1.0], "K has 3 entries that are not finite"),
        (
            np.ones((1, 3)),
            [np.inf],
            r"f has 1 entries that are not finite, the first at \(0,\): inf",
        ),
        (np.ones((1, 3)), ["one"], "f must be real numbers, got type <U3"),
        (np.ones((1, 3)) * 1j, [1.0], "K must be real numbers, got type complex128"),
        (
            csr_array(np.ones((1, 3)) * 1j),
            [1.0],
            r"the entries of K must be .* numbers, got type complex128",
        ),
        (np.ones((1, 3)), [1.0 + 1j], "f must be real numbers, got type complex128"),
    ],
)
def test_bad_constraints_are_refused(K, f, message: str) -> None:
    x = cp.Variable(3)
    with pytest.raises(SettingError, match=message):
        BregmanProblem(cp.norm1(x), x, K, f)


@pytest.mark.parametrize(
    ("variable", "message"),
    [
        (cp.Variable(3, complex=True), "complex"),
        (cp.Variable(3, boolean=True), "boolean"),
        (np.zeros(3), "give a cvxpy Variable"),
    ],
)
def test_bad_variables_are_refused(variable, message: str) -> None:
    with pytest.raises(SettingError, match=message):
        BregmanProblem(cp.Constant(0.0), [variable], np.ones((1, 3)), [1.0])


def test_a_term_that_couples_the_blocks_is_refused() -> None:
    u = cp.Variable(2, name="u")
    v = cp.Variable(2, name="v")
    problem = BregmanProblem(
        cp.sum_squares(u) + cp.sum_squares(u - v), (u, v), np.zeros((1, 4)), [0.0]
    )
    with pytest.raises(SettingError, match="couples the variables u, v"):
        block_subproblems(problem, 1.0)


def test_unbounded_and_infeasible_subproblems_say_so() -> None:
    x = cp.Variable(2)
    unbounded = bregman_subproblem(BregmanProblem(cp.sum(x), x, [[1.0, 1.0]], [1.0]), 1.0)
    with pytest.raises(
        PGOError, match="unbounded on the Bregman subproblem: its objective has no minimum"
    ):
        unbounded.solve(np.array([0.0, 2.0]))
    infeasible = cp.Problem(cp.Minimize(cp.sum(x)), [x >= 1, x <= 0])
    with pytest.raises(PGOError, match="infeasible on the toy: its constraints contradict"):
        solve_compiled(infeasible, "toy")


@given(seed=SEEDS, height=st.integers(1, 5), width=st.integers(2, 5))
def test_differences_are_numpy_differences(seed: int, height: int, width: int) -> None:
    image = np.random.default_rng(seed).standard_normal((height, width))
    expected = np.concatenate([np.diff(image, axis=0).ravel(), np.diff(image, axis=1).ravel()])
    np.testing.assert_array_equal(differences(image.shape) @ image.ravel(), expected)
    np.testing.assert_array_equal(differences((width,)) @ image[0], np.diff(image[0]))


@settings(max_examples=examples(10), deadline=None)
@given(seed=SEEDS)
def test_total_variation_models_have_the_right_objectives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    noisy, u = rng.standard_normal((2, 4, 3))
    total_variation = np.abs(np.diff(u, axis=0)).sum() + np.abs(np.diff(u, axis=1)).sum()
    split = total_variation_denoising(noisy, 0.7)
    x = split.stacked([u, differences(u.shape) @ u.ravel()])
    assert np.linalg.norm(split.residual(x)) < 1e-14
    assert split.objective(x) == pytest.approx(
        0.5 * np.sum((u - noisy) ** 2) + 0.7 * total_variation, rel=1e-12
    )
    space = total_variation_scale_space(noisy)
    assert space.objective(u.ravel()) == pytest.approx(total_variation, rel=1e-12)
    np.testing.assert_array_equal(space.residual(noisy.ravel()), np.zeros(noisy.size))


def test_a_semidefinite_constraint_in_an_indicator_is_refused_with_one_that_works() -> None:
    Z = cp.Variable((2, 2), symmetric=True)
    K = np.ones((1, 4))
    with pytest.raises(SettingError, match=r"write cp\.lambda_min\(Z\) >= 0 there"):
        BregmanProblem(cp.sum_squares(Z) + cp.transforms.indicator([Z >> 0]), Z, K, [1.0])
    semidefinite = cp.transforms.indicator([cp.lambda_min(Z) >= 0])
    problem = BregmanProblem(cp.sum_squares(Z) + semidefinite, Z, K, [1.0])
    assert run(Bregman(), problem).status is Status.CONVERGED
