import itertools
import math
from dataclasses import dataclass, replace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest
from graphs import polar_factor
from orthogonal_models import one_norm_components, smallest_eigenvectors, sparse_low_rank

from pgo_models import OrthogonalProblem, PGOError
from pgo_models.convex.orthogonality import OrthogonalPoint
from pgo_models.convex.orthogonality_examples import procrustes
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array, orthogonality_error
from solvers import OrthogonalSOC, Status, iterate, run, solve_orthogonal

TOLERANCE = OrthogonalSOC.tolerance
BETTER = 100 * TOLERANCE  # residuals bound the error up to the conditioning of the problem


def rng_of(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def assert_solved(solution) -> None:
    assert solution.status is Status.CONVERGED
    assert solution.kkt.feasibility <= BETTER
    # One convex solve at the answer, independent of the run's own residuals.
    assert solution.kkt.stationarity <= BETTER * max(1.0, solution.outcome.state.scale)


def test_a_solution_says_that_its_lower_bound_is_that_of_hulls() -> None:
    x = cp.Variable(2)
    nearest = cp.Problem(cp.Minimize(cp.norm1(x - np.array([3.0, 4.0]))))
    text = str(solve_orthogonal(OrthogonalProblem(nearest, unit_columns=[x]), 0, starts=2))
    assert "the least of 2 starts, which end from " in text
    assert "least J over the sets' hulls, proven" in text


@pytest.mark.parametrize(("seed", "rotation"), [(0, False), (1, True), (2, True)])
def test_balanced_procrustes_is_the_svd(seed: int, rotation: bool) -> None:
    rng = rng_of(seed)
    A = rng.standard_normal((8, 3))
    B = rng.standard_normal((8, 3))
    solution = solve_orthogonal(procrustes(A, B, rotation=rotation), rng, starts=6)
    assert_solved(solution)
    X = polar_factor(A.T @ B, rotation=rotation)
    assert solution.objective == pytest.approx(float(np.sum((A @ X - B) ** 2)), rel=TOLERANCE)
    np.testing.assert_allclose(solution.values[0], X, rtol=0, atol=BETTER)
    if rotation:
        assert orthogonality_error(solution.values[0][None])[0] < 1e-12


def test_unbalanced_procrustes_finds_the_planted_answer() -> None:
    rng = rng_of(0)
    A = rng.standard_normal((10, 5))
    X = np.linalg.qr(rng.standard_normal((5, 2)))[0]
    solution = solve_orthogonal(procrustes(A, A @ X), rng, starts=4)
    assert_solved(solution)
    np.testing.assert_allclose(solution.values[0], X, rtol=0, atol=BETTER)


def inliers_and_outliers(rng: np.random.Generator) -> tuple[Array, Array]:
    normal = np.linalg.qr(rng.standard_normal((4, 1)))[0]
    inliers = rng.standard_normal((40, 4))
    inliers -= inliers @ normal @ normal.T
    return np.vstack([inliers, rng.standard_normal((15, 4)) + 1.0]), normal[:, 0]


@pytest.mark.parametrize("seed", range(3))
def test_one_norm_component_ignores_outliers(seed: int) -> None:
    A, normal = inliers_and_outliers(rng_of(seed))
    solution = solve_orthogonal(one_norm_components(A, 1), rng_of(seed), starts=3)
    assert_solved(solution)
    assert abs(solution.values[0][:, 0] @ normal) > 1.0 - TOLERANCE
    assert solution.objective <= np.abs(A @ normal).sum() * (1.0 + BETTER)
    last = np.linalg.svd(A)[2][-1]
    assert abs(last @ normal) < 0.999


def test_sparse_components_reach_their_bound() -> None:
    values = np.arange(1.0, 9.0)
    solution = solve_orthogonal(smallest_eigenvectors(np.diag(values), 2, 0.5), rng_of(0), starts=4)
    assert_solved(solution)
    bound = values[:2].sum() + 0.5 * 2
    assert bound * (1.0 - TOLERANCE) <= solution.objective <= bound * (1.0 + TOLERANCE)


@pytest.mark.parametrize("seed", range(2))
def test_sparse_low_rank_finds_the_planted_support(seed: int) -> None:
    rng = rng_of(seed)
    B = np.zeros((20, 3))
    for column in range(3):
        B[5 * column : 5 * column + 4, column] = rng.choice([-1.0, 1.0], 4) * rng.uniform(
            0.5, 1.0, 4
        )
    B /= np.linalg.norm(B, axis=0)
    Y = B @ (np.diag([5.0, 4.0, 3.0]) @ rng.standard_normal((3, 50))) + 0.05 * rng.standard_normal(
        (20, 50)
    )
    problem = sparse_low_rank(Y, 3, 12)
    singular = np.linalg.svd(Y)[0][:, :3]
    c = np.linalg.norm(Y, 2) ** 2
    outcome = run(OrthogonalSOC(penalty=3 * c), problem, problem.point([singular]))
    assert outcome.status is Status.CONVERGED
    orthonormal, sparse = outcome.state.copies
    np.testing.assert_allclose(orthonormal, sparse, rtol=0, atol=BETTER)
    np.testing.assert_array_equal(sparse != 0, B != 0)
    # Better than the planted factor, which does not fit the noise, and no better than dense factors
    # can be.
    error = np.sum((Y - orthonormal @ orthonormal.T @ Y) ** 2)
    assert outcome.objective == pytest.approx(error, rel=BETTER)
    assert np.sum((Y - singular @ singular.T @ Y) ** 2) <= error <= np.sum((Y - B @ B.T @ Y) ** 2)


def test_other_variables_and_convex_constraints_take_part() -> None:
    # Nearest unit vector with a nonnegative second entry, through an epigraph variable.
    x = cp.Variable(2, name="x")
    t = cp.Variable(name="t")
    distance = cp.norm(x - np.array([3.0, -4.0]))
    model = OrthogonalProblem(
        cp.Problem(cp.Minimize(t), [distance <= t, x[1] >= 0]), unit_columns=[x]
    )
    solution = solve_orthogonal(model, rng_of(0), starts=3)
    assert solution.status is Status.CONVERGED
    assert solution.kkt.feasibility <= BETTER
    np.testing.assert_allclose(solution.values[0], [1.0, 0.0], rtol=0, atol=BETTER)
    assert solution.objective == pytest.approx(math.hypot(2.0, 4.0), rel=BETTER)
    np.testing.assert_array_equal(x.value, solution.values[0])


def test_unit_rows_solve_a_small_max_cut() -> None:
    # Every edge of the 4-cycle can be cut: with unit rows tr(X^T L X) is at most 16, where
    # neighbours are opposite.
    L = 2.0 * np.eye(4) - np.roll(np.eye(4), 1, 0) - np.roll(np.eye(4), -1, 0)
    X = cp.Variable((4, 3), name="X")
    root = np.linalg.cholesky(4.1 * np.eye(4) - L).T
    solution = solve_orthogonal(
        OrthogonalProblem(cp.Problem(cp.Minimize(cp.sum_squares(root @ X))), unit_rows=[X]),
        rng_of(0),
        starts=2,
    )
    assert_solved(solution)
    rows = solution.values[0]
    np.testing.assert_allclose(
        rows @ rows.T, np.outer([1, -1, 1, -1], [1, -1, 1, -1]), rtol=0, atol=BETTER
    )


def test_fixed_penalty_is_the_papers_recursion() -> None:
    rng = rng_of(1)
    A = rng.standard_normal((6, 3))
    B = rng.standard_normal((6, 3))
    rho = 50.0
    omega = np.eye(3)
    scaled = np.zeros((3, 3))
    iterates = iterate(OrthogonalSOC(penalty=rho), procrustes(A, B, rotation=True))
    next(iterates)
    for state in itertools.islice(iterates, 10):
        R = np.linalg.solve(2.0 * A.T @ A + rho * np.eye(3), 2.0 * A.T @ B + rho * (omega - scaled))
        omega = polar_factor(R + scaled, rotation=True)
        scaled = scaled + R - omega
        np.testing.assert_allclose(state.copies[0], omega, rtol=0, atol=1e-9)
        np.testing.assert_allclose(state.B[0], scaled, rtol=0, atol=1e-9)


# The contract of every solver.


def example() -> OrthogonalProblem:
    rng = rng_of(5)
    return procrustes(rng.standard_normal((8, 3)), rng.standard_normal((8, 3)))


def test_warm_start_at_the_solution_stays() -> None:
    problem = example()
    method = OrthogonalSOC(tolerance=1e-9)
    first = run(method, problem)
    assert first.status is Status.CONVERGED
    again = run(OrthogonalSOC(), problem, method.point(problem, first.state))
    assert again.status is Status.CONVERGED
    assert again.iterations == 1
    np.testing.assert_allclose(again.state.copies[0], first.state.copies[0], rtol=0, atol=TOLERANCE)


def test_limits_are_reported() -> None:
    problem = example()
    outcome = run(OrthogonalSOC(max_iterations=2), problem)
    assert outcome.status is Status.MAX_ITERATIONS
    assert (outcome.iterations, len(outcome.history)) == (2, 3)
    assert run(OrthogonalSOC(), problem, time_limit=1e-9).status is Status.TIME_LIMIT


def test_unfinished_starts_are_told_apart() -> None:
    solution = solve_orthogonal(example(), rng_of(0), OrthogonalSOC(max_iterations=1), starts=2)
    assert solution.status is Status.MAX_ITERATIONS
    assert all(math.isnan(objective) for objective in solution.objectives)
    assert "MAX_ITERATIONS" in repr(solution)


def test_starts_are_checked() -> None:
    with pytest.raises(SettingError, match="starts must be at least 1"):
        solve_orthogonal(example(), rng_of(0), starts=0)
    with pytest.raises(SettingError, match="shapes"):
        run(OrthogonalSOC(), example(), OrthogonalPoint((np.eye(2),), (np.zeros((2, 2)),)))


def test_ctrl_c_ends_all_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    step = OrthogonalSOC.step
    calls = list[int]()

    def interrupted(self: OrthogonalSOC, *args: object) -> object:
        calls.append(len(calls))
        if len(calls) == 3:
            raise KeyboardInterrupt
        return step(self, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(OrthogonalSOC, "step", interrupted)
    x = cp.Variable(2)
    problem = OrthogonalProblem(
        cp.Problem(cp.Minimize(cp.sum_squares(x - [3.0, 4.0]))), unit_columns=[x]
    )
    solution = solve_orthogonal(problem, np.random.default_rng(0), starts=5)
    assert len(solution.objectives) == 1
    assert solution.outcome.status is Status.INTERRUPTED


@dataclass(frozen=True)
class StepBesideRotations:
    """Step (a) of matrices whose determinant is not negative; of others it fails."""

    step: Any

    def solve(self, V: list[np.ndarray], rho: float) -> Any:
        if np.linalg.det(V[0]) < 0.0:
            raise PGOError("the solver ended without a solution")
        return self.step.solve(V, rho)


@pytest.mark.parametrize("starts", [1, 4])  # one start leads on to a reflected one
def test_runs_whose_step_fails_leave_the_others(starts: int) -> None:
    X = cp.Variable((2, 2))
    nearest = cp.Problem(cp.Minimize(cp.sum_squares(X - np.eye(2))))
    problem = OrthogonalProblem(nearest, orthogonal=[X])
    split = problem.split()
    soc = OrthogonalSOC(x_step=replace(split, step=StepBesideRotations(split.step)))
    solution = solve_orthogonal(problem, rng_of(0), soc, starts=starts)
    assert solution.is_certified
    assert len(solution.objectives) == starts
    assert np.isnan(solution.objectives).any() == (starts > 1)
