import itertools
from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from budget import examples
from hypothesis import given, settings, strategies as st
from signals import sparse_signal

from pgo_models import BregmanProblem, grid, random_rotations
from pgo_models.convex.bregman import BregmanPoint
from pgo_models.convex.bregman_examples import (
    differences,
    total_variation_denoising,
    total_variation_scale_space,
)
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array, stack_transposes
from pgo_models.problem.matrices import connection_laplacian, isotropic_weights, residual_matrix
from solvers import (
    AlternatingBregman,
    Bregman,
    MethodOfMultipliers,
    Status,
    TwoLineBregman,
    iterate,
    run,
)
from solvers.convex.bregman import feasibility_bound

EQUIVALENCE = 1e-7  # state by state, as the forms are stated in the paper
# an interior-point iterate is accurate to the square root of its gap where J is flat
INTERIOR = 1e-5
SEEDS = st.integers(0, 2**32 - 1)
ALPHAS = st.sampled_from([0.3, 1.0, 5.0])
FORMS = [Bregman, TwoLineBregman, MethodOfMultipliers, AlternatingBregman]


def states(method, problem, count: int, start=None):
    return list(itertools.islice(iterate(method, problem, start), count))


def lasso(seed: int, m: int = 6, s: int = 3) -> BregmanProblem:
    """1/2 ||A x - c||^2 + ||x||_1 s.t. K x = f: strongly convex, not smooth."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((m + 2, m)) + 2.0 * np.eye(m + 2, m)
    c = rng.standard_normal(m + 2)
    x = cp.Variable(m, name="x")
    return BregmanProblem(
        0.5 * cp.sum_squares(A @ x - c) + cp.norm1(x),
        x,
        rng.standard_normal((s, m)),
        rng.standard_normal(s),
    )


def split_lasso(seed: int) -> tuple[BregmanProblem, Array, Array]:
    """1/2 ||A u - c||^2 + 0.5 ||v||_1 s.t. u - v = 0."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((8, 5)) + 2.0 * np.eye(8, 5)
    c = rng.standard_normal(8)
    u = cp.Variable(5, name="u")
    v = cp.Variable(5, name="v")
    J = 0.5 * cp.sum_squares(A @ u - c) + 0.5 * cp.norm1(v)
    return BregmanProblem(J, (u, v), np.hstack([np.eye(5), -np.eye(5)]), np.zeros(5)), A, c


@settings(max_examples=examples(8), deadline=None)
@given(seed=SEEDS, alpha=ALPHAS)
def test_p_is_a_subgradient_of_J(seed: int, alpha: float) -> None:
    problem = lasso(seed)
    rng = np.random.default_rng(seed)
    for state in states(Bregman(alpha=alpha), problem, 6)[1:]:
        J = problem.objective(state.x)
        for _ in range(5):
            other = state.x + rng.standard_normal(state.x.shape)
            assert problem.objective(other) >= J + state.p @ (other - state.x) - EQUIVALENCE


def test_many_passes_are_the_method_of_multipliers() -> None:
    problem, _, _ = split_lasso(0)
    many = states(AlternatingBregman(alpha=1.0, passes=80), problem, 4)
    for state, exact in zip(many, states(MethodOfMultipliers(alpha=1.0), problem, 4), strict=True):
        np.testing.assert_allclose(state.x, exact.x, rtol=0, atol=EQUIVALENCE)
        np.testing.assert_allclose(state.lam, exact.lam, rtol=0, atol=EQUIVALENCE)


@settings(max_examples=examples(8), deadline=None)
@given(seed=SEEDS, alpha=ALPHAS)
def test_residual_falls_and_keeps_its_bound(seed: int, alpha: float) -> None:
    problem, solution = sparse_signal(seed, m=20, s=8, nonzeros=3)
    iterates = states(TwoLineBregman(alpha=alpha), problem, 12)
    residuals = [float(np.linalg.norm(problem.residual(state.x))) for state in iterates]
    for k, (before, after) in enumerate(itertools.pairwise(residuals), start=1):
        assert after <= before + INTERIOR
        assert after <= feasibility_bound(problem.objective(solution), alpha, k) + INTERIOR


@pytest.mark.parametrize("seed", range(5))
def test_basis_pursuit_recovers_a_sparse_signal(seed: int) -> None:
    problem, solution = sparse_signal(seed)
    outcome = run(TwoLineBregman(alpha=5.0), problem)
    assert outcome.status is Status.CONVERGED
    assert outcome.iterations <= 10
    np.testing.assert_allclose(outcome.state.x, solution, rtol=0, atol=INTERIOR)


def test_errors_on_the_way_are_forgotten() -> None:
    problem, solution = sparse_signal(0)
    method = TwoLineBregman(alpha=5.0)
    state = method.init(problem, None)
    rng = np.random.default_rng(0)
    errors = []
    for k in range(15):
        state = method.step(problem, state)
        if k < 3:
            error = 0.1 * rng.standard_normal(state.x.shape)
            state = replace(state, x=state.x + error, b=state.b + problem.K @ error)
        errors.append(np.linalg.norm(state.x - solution))
    assert min(errors[:3]) > 0.1
    assert errors[-1] < INTERIOR


def rof(noisy: Array, weight: float) -> tuple[Array, float]:
    u = cp.Variable(noisy.shape)
    J = 0.5 * cp.sum_squares(u - noisy) + weight * cp.norm1(
        differences(noisy.shape) @ cp.vec(u, order="C")
    )
    value = cp.Problem(cp.Minimize(J)).solve(solver=cp.CLARABEL)
    return np.asarray(u.value), float(value)


def steps_signal(rng: np.random.Generator) -> tuple[Array, Array]:
    truth = np.repeat([0.0, 1.0, 0.3, 2.0], 10)
    return truth, truth + 0.1 * rng.standard_normal(truth.shape)


def test_split_bregman_denoises_a_signal() -> None:
    truth, noisy = steps_signal(np.random.default_rng(0))
    problem = total_variation_denoising(noisy, 0.3)
    outcome = run(AlternatingBregman(alpha=1.0), problem)
    assert outcome.status is Status.CONVERGED
    u = problem.unstacked(outcome.state.x)[0]
    expected, value = rof(noisy, 0.3)
    assert outcome.objective == pytest.approx(value, rel=1e-5)
    np.testing.assert_allclose(u, expected, rtol=0, atol=1e-4)
    assert np.linalg.norm(u - truth) < np.linalg.norm(noisy - truth)


def test_scale_space_stopped_at_the_noise_beats_the_data() -> None:
    truth, noisy = steps_signal(np.random.default_rng(0))
    noise = np.linalg.norm(noisy - truth)
    problem = total_variation_scale_space(noisy)
    outcome = run(
        TwoLineBregman(alpha=0.05),
        problem,
        callback=lambda state, record: record.measurement.infeasibility <= noise,
    )
    assert outcome.status is Status.STOPPED
    assert np.linalg.norm(outcome.state.x - truth) < 0.5 * noise
    full = run(TwoLineBregman(alpha=10.0), problem)
    np.testing.assert_allclose(full.state.x, noisy, rtol=0, atol=1e-5)


def test_an_indicator_adds_constraints() -> None:
    x = cp.Variable(3)
    J = cp.sum_squares(x - np.array([-1.0, 2.0, 3.0])) + cp.transforms.indicator([x >= 0])
    solved = run(MethodOfMultipliers(alpha=10.0), BregmanProblem(J, x, np.ones((1, 3)), [4.0]))
    assert solved.status is Status.CONVERGED
    # without it: -1, 2, 3
    np.testing.assert_allclose(solved.state.x, [0.0, 1.5, 2.5], rtol=0, atol=1e-5)


@pytest.mark.parametrize("form", [AlternatingBregman, MethodOfMultipliers])
def test_two_robots_agree_on_the_r_step(form) -> None:
    rng = np.random.default_rng(0)
    graph = grid(rng)
    n = graph.num_poses
    m = graph.num_edges
    A = residual_matrix(graph)[m:, n:]
    half_of_each = 0.5 * isotropic_weights(graph).row_weights[m:]
    own_weights = half_of_each * (1.0 + rng.uniform(-1.0, 1.0, len(half_of_each)))
    V = stack_transposes(random_rotations(n, 3, rng))
    rho = 20.0
    copies = [cp.Variable((3 * n, 3)) for _ in range(2)]
    J = sum(
        cp.sum_squares(cp.multiply(np.sqrt(w)[:, None], A @ X)) + rho / 4 * cp.sum_squares(X - V)
        for w, X in zip((own_weights, 2.0 * half_of_each - own_weights), copies, strict=True)
    )
    identity = np.eye(V.size)
    problem = BregmanProblem(J, copies, np.hstack([identity, -identity]), np.zeros(V.size))
    outcome = run(form(alpha=10.0), problem)
    assert outcome.status is Status.CONVERGED
    L = connection_laplacian(graph).toarray()
    expected = np.linalg.solve(L + 0.5 * rho * np.eye(len(L)), 0.5 * rho * V)
    for X in copies:
        np.testing.assert_allclose(X.value, expected, rtol=0, atol=10 * form.tolerance)


# The contract of every solver.


@pytest.mark.parametrize("form", FORMS)
def test_warm_start_at_the_solution_stays(form) -> None:
    problem = lasso(2) if form is not AlternatingBregman else split_lasso(2)[0]
    method = form(alpha=5.0, tolerance=1e-9)
    first = run(method, problem)
    again = run(form(alpha=5.0, tolerance=1e-7), problem, method.point(problem, first.state))
    assert again.status is Status.CONVERGED
    assert again.iterations <= 1
    np.testing.assert_allclose(again.state.x, first.state.x, rtol=0, atol=1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_limits_are_reported(form) -> None:
    problem = lasso(3) if form is not AlternatingBregman else split_lasso(3)[0]
    outcome = run(form(alpha=0.1, tolerance=1e-12, max_iterations=2), problem)
    assert outcome.status is Status.MAX_ITERATIONS
    assert (outcome.iterations, len(outcome.history)) == (2, 3)
    # The best iterate is the least infeasible one, not the start, where J is smaller.
    assert np.linalg.norm(problem.residual(outcome.state.x)) == min(
        record.measurement.infeasibility for record in outcome.history.records
    )
    assert run(form(tolerance=1e-12), problem, time_limit=1e-9).status is Status.TIME_LIMIT


def test_passes_are_checked() -> None:
    with pytest.raises(SettingError, match="passes must be at least 1"):
        AlternatingBregman(passes=0)


def test_starts_are_checked() -> None:
    problem = lasso(0)
    with pytest.raises(SettingError, match="shapes"):
        Bregman().init(problem, BregmanPoint(np.zeros(2), np.zeros(3)))
    with pytest.raises(SettingError, match="not finite"):
        Bregman().init(problem, BregmanPoint(np.full(6, np.nan), np.zeros(3)))
    x = cp.Variable(2, name="x")
    barrier = BregmanProblem(-cp.sum(cp.log(x)), x, [[1.0, 1.0]], [1.0])
    with pytest.raises(SettingError, match="J is not finite at the start"):
        Bregman().init(barrier, None)
    outcome = run(TwoLineBregman(alpha=10.0), barrier, BregmanPoint(np.ones(2), np.zeros(1)))
    np.testing.assert_allclose(outcome.state.x, [0.5, 0.5], rtol=0, atol=1e-5)
