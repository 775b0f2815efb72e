"""DGS: convergence to the centralised solution, rounds and bytes, further linearisations."""

import dataclasses
from collections.abc import Callable
from itertools import islice, pairwise
from typing import Any

import numpy as np
import pytest
from graphs import (
    OPTIMUM,
    REFERENCE,
    exact_graph,
    random_poses,
    varied_graph,
    varied_problem,
)
from scipy.sparse.linalg import spsolve

from pgo_models import (
    PartitionMethod,
    PGOProblem,
    Poses,
    circle,
    grid,
    partition,
    project_to_rotations,
    random_geometric,
    random_rotations,
)
from pgo_models.geometry.rotations import unstack_transposes
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian
from solvers import GaussSeidel, Status, iterate, polish, run
from solvers.baselines.gauss_seidel import DGSStage
from solvers.baselines.sweep_order import schedule

WANTED = 1e-8


def fixed_by_hand(
    matrix: Any, right: np.ndarray, fixed: np.ndarray, values: np.ndarray
) -> np.ndarray:
    """Solution of matrix x = right with the rows `fixed` of x given, by SuperLU's general LU."""
    free = np.setdiff1d(np.arange(matrix.shape[0]), fixed)
    x = np.zeros((matrix.shape[0], right.shape[1]))
    x[fixed] = values
    b = right[free] - matrix[free][:, fixed] @ values
    x[free] = np.reshape(spsolve(matrix[free][:, free].tocsc(), b), b.shape)
    return x


def relaxed_rotations(problem: PGOProblem, R_0: np.ndarray) -> np.ndarray:
    """Rows of R_1^T, R_2^T, .. that minimise tr(Y^T L Y), solved whole."""
    d = problem.d
    return fixed_by_hand(problem.L, np.zeros((problem.num_poses * d, d)), np.arange(d), R_0.T)[d:]


def gauss_newton_move(problem: PGOProblem, R: np.ndarray) -> np.ndarray:
    """One Gauss-Newton step (v, w) of poses 1, 2, ..

    from (R, 0), solved whole with the matrix of the Hessian room.
    """
    n, d = R.shape[:2]
    origin = Poses(R, np.zeros((n, d)))
    layout = TangentLayout(n, d)
    gradient = layout.join(*problem.riemannian_gradient(origin))
    zero = np.zeros(1, dtype=np.int64)
    fixed = np.concatenate([layout.translations(zero)[0], layout.rotations(zero)[0]])
    hessian = riemannian_hessian(problem.at(origin), None)
    step = fixed_by_hand(hessian, -gradient[:, None], fixed, np.zeros((len(fixed), 1)))
    return np.delete(step, fixed, axis=0)


def centralized(problem: PGOProblem) -> Poses:
    """Both stages, each system solved whole."""
    n = problem.num_poses
    d = problem.d
    projected = project_to_rotations(unstack_transposes(relaxed_rotations(problem, np.eye(d))))
    w, v = TangentLayout(n - 1, d).split(
        gauss_newton_move(problem, np.concatenate([np.eye(d)[None], projected]))[:, 0]
    )
    moved = Poses(projected, np.zeros((n - 1, d))).moved_along(w, v)
    return Poses(
        np.concatenate([np.eye(d)[None], moved.R]), np.concatenate([np.zeros((1, d)), moved.t])
    )


@pytest.mark.parametrize("alpha", [0.7, 1.0, 1.4])
@pytest.mark.parametrize("method", [PartitionMethod.CONTIGUOUS, PartitionMethod.SINGLETONS])
@pytest.mark.parametrize("make", [circle, grid])
def test_the_solver_reaches_its_centralised_counterpart(
    make: Any, method: PartitionMethod, alpha: float
) -> None:
    problem = PGOProblem(make(np.random.default_rng(3)))
    robots = partition(problem.graph, 4, method)
    solver = GaussSeidel(robots=robots, alpha=alpha, tolerance=1e-12, max_iterations=20_000)
    result = run_without_measuring(solver, problem)
    poses = centralized(problem)
    np.testing.assert_allclose(result.R, poses.R, rtol=0, atol=WANTED)
    np.testing.assert_allclose(result.t, poses.t, rtol=0, atol=WANTED * np.abs(poses.t).max())
    assert problem.objective(result) == pytest.approx(problem.objective(poses), rel=WANTED)


def run_without_measuring(solver: GaussSeidel, problem: PGOProblem) -> Poses:
    for state in islice(iterate(solver, problem), solver.max_iterations):
        if state.stage is DGSStage.POSES and state.change <= solver.tolerance:
            return solver.poses(problem, state)
    raise AssertionError("not converged")


@pytest.mark.parametrize("backend", CholeskyBackend)
@pytest.mark.parametrize("d", [2, 3])
def test_one_robot_is_exact_and_needs_no_network(d: int, backend: CholeskyBackend) -> None:
    problem = PGOProblem(varied_graph(5, 20, d), backend)
    result = run(GaussSeidel(robots=partition(problem.graph, 1)), problem)
    poses = centralized(problem)
    assert (result.status, result.iterations) == (Status.CONVERGED, 4)
    np.testing.assert_allclose(result.poses.R, poses.R, rtol=0, atol=1e-10)
    assert (result.state.ledger.rounds, result.state.ledger.messages) == (0, 0)


def test_what_was_measured_exactly_is_recovered() -> None:
    for d in (2, 3):
        problem = PGOProblem(exact_graph(1, 12, d))
        robots = partition(problem.graph, 3)
        result = run(GaussSeidel(robots=robots, tolerance=1e-10, max_iterations=50_000), problem)
        assert result.status is Status.CONVERGED
        assert result.objective <= 1e-12


def test_a_flagged_sweep_over_a_tree_is_exact() -> None:
    # On a tree every measurement can be met: composing them, which the flagged sweep does, is the
    # solution.
    rng = np.random.default_rng(0)
    n = 12
    graph = dataclasses.replace(
        varied_graph(0, n, 3),
        i=np.array([rng.integers(0, j) for j in range(1, n)]),
        j=np.arange(1, n),
        R_ij=random_rotations(n - 1, 3, rng),
        t_ij=rng.standard_normal((n - 1, 3)),
        kappa=np.ones(n - 1),
        tau=np.ones(n - 1),
    )
    problem = PGOProblem(graph)
    states = list(islice(iterate(GaussSeidel(), problem), 5))
    assert [state.stage for state in states[1:]] == [DGSStage.ROTATIONS] * 2 + [DGSStage.POSES] * 2
    assert problem.objective(GaussSeidel().poses(problem, states[-1])) <= 1e-20


@pytest.mark.parametrize("d", [2, 3])
def test_pose_0_of_the_start_stays_and_the_gauge_does_not_matter(d: int) -> None:
    problem = varied_problem(4, 8, d)
    start = random_poses(8, d, 4)
    solver = GaussSeidel(robots=partition(problem.graph, 2), tolerance=1e-11, max_iterations=50_000)
    result = run(solver, problem, start)
    np.testing.assert_allclose(result.poses.R[0], start.R[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(result.poses.t[0], start.t[0], rtol=0, atol=1e-12)
    own = centralized(problem)
    np.testing.assert_allclose(result.poses.with_gauge_at(0).R, own.R, rtol=0, atol=1e-6)


def test_rounds_are_turns_and_bytes_are_separators() -> None:
    problem = PGOProblem(grid(np.random.default_rng(0)))
    robots = partition(problem.graph, 5)
    turns = schedule(problem.graph, robots)
    solver = GaussSeidel(robots=robots)
    states = list(islice(iterate(solver, problem), 60))
    per_sweep = int(turns.group.max()) + 1
    first = int(turns.first.max()) + 1
    pairs = len(turns.sent)
    for state, following in pairwise(states):
        begins = following.stage is not state.stage or state.k == 0
        numbers = 9 if following.stage is DGSStage.ROTATIONS else 6
        assert following.ledger.rounds - state.ledger.rounds == (first if begins else per_sweep)
        assert following.ledger.num_bytes - state.ledger.num_bytes == 8 * numbers * pairs
        assert following.ledger.all_reduces == following.k
    assert states[-1].stage is DGSStage.POSES


@pytest.mark.parametrize("d", [2, 3])
def test_more_gauss_newton_steps_go_on_to_a_stationary_point(d: int) -> None:
    problem = PGOProblem(random_geometric(20, np.random.default_rng(0), d=d, mean_degree=5.0))
    solver = GaussSeidel(
        robots=partition(problem.graph, 3), alpha=1.5, tolerance=1e-10, max_iterations=100_000
    )
    results = [
        run(dataclasses.replace(solver, gauss_newton_steps=steps), problem) for steps in (1, 2, 8)
    ]
    assert [result.state.gauss_newton_step for result in results] == [1, 2, 8]
    optimum = problem.objective(polish(problem, results[0].poses))
    assert results[0].objective > results[1].objective
    assert results[2].objective == pytest.approx(optimum, rel=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["torus3D", "cubicle"])
def test_it_answers_where_the_paper_has_no_figure_for_it(
    name: str, benchmark_problem: Callable[[str], PGOProblem]
) -> None:
    problem = benchmark_problem(name)
    figures = REFERENCE["paper_tables"][name]
    assert figures["F_dgs"] is None
    robots = partition(problem.graph, 5, PartitionMethod.CONTIGUOUS)
    poses = run_without_measuring(GaussSeidel(robots=robots, alpha=1.8, tolerance=1e-4), problem)
    exact = run_without_measuring(GaussSeidel(robots=partition(problem.graph, 1)), problem)
    for end in (poses, exact):
        assert OPTIMUM[name] < problem.objective(end) < figures["F_soc"]
    assert problem.objective(poses) == pytest.approx(problem.objective(exact), rel=1e-2)
