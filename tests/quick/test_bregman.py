"""Bregman iteration, its other forms, and their equivalence to ADMM, state by state."""

import itertools

import cvxpy as cp
import numpy as np
import pytest

import pgo_models as pgo
import solvers

EQUIVALENCE = 1e-6  # interior-point solutions of the same subproblem in two forms
ALPHAS = pytest.mark.parametrize("alpha", [0.3, 1.0, 5.0])
SEEDS = pytest.mark.parametrize("seed", range(2))


def states(method, problem, count):
    return list(itertools.islice(solvers.iterate(method, problem), count))


def lasso(seed: int) -> pgo.BregmanProblem:
    """1/2 ||A x - c||^2 + ||x||_1 s.t. K x = f: strongly convex, not smooth."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((8, 6)) + 2.0 * np.eye(8, 6)
    c = rng.standard_normal(8)
    x = cp.Variable(6)
    J = 0.5 * cp.sum_squares(A @ x - c) + cp.norm1(x)
    return pgo.BregmanProblem(J, x, rng.standard_normal((3, 6)), rng.standard_normal(3))


@SEEDS
@ALPHAS
def test_three_forms_have_the_same_states(seed, alpha):
    problem = lasso(seed)
    forms = (solvers.Bregman, solvers.TwoLineBregman, solvers.MethodOfMultipliers)
    films = [states(form(alpha=alpha), problem, 8) for form in forms]
    for bregman, two_line, multipliers in zip(*films, strict=True):
        np.testing.assert_allclose(bregman.x, two_line.x, rtol=0, atol=EQUIVALENCE)
        np.testing.assert_allclose(bregman.x, multipliers.x, rtol=0, atol=EQUIVALENCE)
        np.testing.assert_allclose(multipliers.lam, -alpha * two_line.b, rtol=0, atol=EQUIVALENCE)


@SEEDS
@ALPHAS
def test_one_pass_over_the_blocks_is_admm(seed, alpha):
    """min 1/2 ||A u - c||^2 + 0.5 ||v||_1 s.t. u = v, and ADMM written down beside it."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((8, 5)) + 2.0 * np.eye(8, 5)
    c = rng.standard_normal(8)
    u, v = cp.Variable(5), cp.Variable(5)
    J = 0.5 * cp.sum_squares(A @ u - c) + 0.5 * cp.norm1(v)
    problem = pgo.BregmanProblem(J, (u, v), np.hstack([np.eye(5), -np.eye(5)]), np.zeros(5))
    v_k, scaled = np.zeros(5), np.zeros(5)
    for state in states(solvers.AlternatingBregman(alpha=alpha), problem, 8)[1:]:
        u_k = np.linalg.solve(A.T @ A + alpha * np.eye(5), A.T @ c + alpha * (v_k - scaled))
        shifted = u_k + scaled
        v_k = np.sign(shifted) * np.maximum(np.abs(shifted) - 0.5 / alpha, 0.0)
        scaled = scaled + u_k - v_k
        np.testing.assert_allclose(state.x, np.concatenate([u_k, v_k]), rtol=0, atol=1e-5)


@SEEDS
def test_every_form_ends_at_the_constrained_minimum(seed):
    problem = lasso(seed)
    equality = problem.K @ problem.variables[0] == problem.f
    constrained = cp.Problem(cp.Minimize(problem.J), [equality])
    least = constrained.solve(solver=cp.CLARABEL)
    for form in (solvers.Bregman, solvers.TwoLineBregman, solvers.MethodOfMultipliers):
        outcome = solvers.run(form(alpha=5.0), problem)
        assert outcome.status is solvers.Status.CONVERGED
        assert outcome.objective == pytest.approx(least, rel=1e-4)


def test_the_residual_is_added_back():
    problem = lasso(0)
    film = states(solvers.TwoLineBregman(alpha=1.0), problem, 6)
    for before, after in itertools.pairwise(film):
        added = before.b + problem.K @ after.x - problem.f
        opposite = before.b - problem.K @ after.x + problem.f
        closest = min(np.abs(after.b - added).max(), np.abs(after.b - opposite).max())
        assert closest <= 1e-9


def test_a_model_that_is_not_convex_is_refused():
    x = cp.Variable(2)
    with pytest.raises(pgo.PGOError, match="convex"):
        pgo.BregmanProblem(-cp.sum_squares(x), x, np.ones((1, 2)), np.ones(1))


def test_the_wrong_kind_of_problem_is_answered_with_the_right_one():
    with pytest.raises(pgo.PGOError, match="BregmanProblem"):
        solvers.run(solvers.Bregman(), pgo.PGOProblem(pgo.circle(0)))
