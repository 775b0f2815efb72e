"""DGS: both linear problems, convergence to the centralised solution, flags, rounds, steps."""

import dataclasses
import math
from collections.abc import Callable
from itertools import islice, pairwise
from typing import Any

import numpy as np
import pytest
from budget import examples
from graphs import (
    DIMENSIONS,
    OPTIMUM,
    REFERENCE,
    SEEDS,
    exact_graph,
    random_poses,
    scattered,
    varied_graph,
    varied_problem,
)
from hypothesis import given, settings, strategies as st
from scipy.sparse.linalg import spsolve

from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import project_to_rotations, random_rotations, unstack_transposes
from pgo_models.graphs.partitioning import Partition, PartitionMethod, partition
from pgo_models.graphs.scenes import circle, grid, random_geometric
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian
from pgo_models.problem.problem import PGOProblem
from solvers.baselines.block_relaxation import LeastSquares, flagged_turns, sweep_turns, take_turns
from solvers.baselines.gauss_seidel import DGSStage, GaussSeidel, pose_problem, rotation_problem
from solvers.baselines.sweep_order import Sweep, schedule
from solvers.loop import iterate, run
from solvers.network.ledger import Ledger
from solvers.result import Status
from solvers.riemannian.polish import polish

WANTED = 1e-8
METHODS = {
    "jacobi": (Sweep.JACOBI, 1.0),
    "jor": (Sweep.JACOBI, 0.8),
    "gauss_seidel_colors": (Sweep.COLORS, 1.0),
    "gauss_seidel_robots": (Sweep.ROBOTS, 1.0),
    "sor": (Sweep.COLORS, 1.4),
    "sor_robots": (Sweep.ROBOTS, 0.7),
}
EVERY_METHOD = pytest.mark.parametrize(("sweep", "alpha"), METHODS.values(), ids=METHODS)


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


def squares(linear: LeastSquares, x: np.ndarray) -> float:
    return float(np.sum(linear.w[:, None] * (linear.J @ x + linear.r) ** 2))


def assert_converges(
    linear: LeastSquares,
    exact: np.ndarray,
    problem: PGOProblem,
    robots: Partition,
    sweep: Sweep,
    alpha: float,
) -> None:
    """Sweeps after the flagged one converge to the exact solution, and none raises the squares."""
    turns = schedule(problem.graph, robots, sweep)
    prepared = sweep_turns(linear, turns, 1, problem.backend)
    x = np.zeros_like(exact)
    ledger = Ledger(robots.num_robots)
    x, ledger = take_turns(
        flagged_turns(linear, problem.graph, turns, 1, problem.backend), x, 1.0, ledger
    )
    value = squares(linear, x)
    for _ in range(100_000):
        if np.abs(x - exact).max() <= WANTED * max(1.0, np.abs(exact).max()):
            return
        x, ledger = take_turns(prepared, x, alpha, ledger)
        following = squares(linear, x)
        assert following <= value * (1 + 1e-12) + 1e-12
        value = following
    raise AssertionError(f"{np.abs(x - exact).max()} away after {ledger}")


# The two linear problems.


@settings(max_examples=examples(30))
@given(seed=SEEDS, n=st.integers(2, 12), d=DIMENSIONS)
def test_least_squares_are_F_without_orthogonality_and_F_linearized(
    seed: int, n: int, d: int
) -> None:
    problem = varied_problem(seed, n, d)
    rng = np.random.default_rng(seed)
    R = random_rotations(n, d, rng)
    rotations = rotation_problem(problem, R[0])
    Y = rng.standard_normal(((n - 1) * d, d))
    X = np.concatenate([R[0].T, Y])
    value = np.sum(rotations.w[:, None] * (rotations.J @ Y + rotations.r) ** 2)
    assert value == pytest.approx(np.sum(X * (problem.L @ X)), rel=1e-10)
    linear = pose_problem(problem, R)
    assert np.sum(linear.w[:, None] * linear.r**2) == pytest.approx(
        problem.objective(Poses(R, np.zeros((n, d))))
    )
    layout = TangentLayout(n, d)
    free = np.concatenate(
        [np.arange(d, n * d), np.arange(n * d + (layout.side - n * d) // n, layout.side)]
    )
    hessian = riemannian_hessian(problem.at(Poses(R, np.zeros((n, d)))), None).toarray()[
        np.ix_(free, free)
    ]
    np.testing.assert_allclose(
        2 * (linear.J.T @ (linear.J * linear.w[:, None])).toarray(),
        hessian,
        rtol=0,
        atol=1e-12 * np.abs(hessian).max(),
    )
    gradient = layout.join(*problem.riemannian_gradient(Poses(R, np.zeros((n, d)))))[free]
    np.testing.assert_allclose(
        2 * (linear.J.T @ (linear.w[:, None] * linear.r))[:, 0],
        gradient,
        rtol=0,
        atol=1e-11 * np.abs(gradient).max(),
    )


# Convergence to the centralised counterpart.


@EVERY_METHOD
@settings(max_examples=examples(6))
@given(seed=SEEDS, n=st.integers(2, 10), d=DIMENSIONS)
def test_sweeps_settle_at_the_exact_solutions(
    sweep: Sweep, alpha: float, seed: int, n: int, d: int
) -> None:
    problem = PGOProblem(varied_graph(seed, n, d, weights=0.3))
    robots = scattered(problem.graph, 1 + seed % n, seed)
    R = random_rotations(n, d, np.random.default_rng(seed))
    exact = relaxed_rotations(problem, R[0])
    assert_converges(rotation_problem(problem, R[0]), exact, problem, robots, sweep, alpha)
    R[1:] = project_to_rotations(unstack_transposes(exact))
    assert_converges(
        pose_problem(problem, R), gauss_newton_move(problem, R), problem, robots, sweep, alpha
    )


@EVERY_METHOD
@pytest.mark.parametrize("method", [PartitionMethod.CONTIGUOUS, PartitionMethod.SINGLETONS])
@pytest.mark.parametrize("make", [circle, grid])
def test_the_solver_reaches_its_centralised_counterpart(
    make: Any, method: PartitionMethod, sweep: Sweep, alpha: float
) -> None:
    problem = PGOProblem(make(np.random.default_rng(3)))
    robots = partition(problem.graph, 4, method)
    solver = GaussSeidel(
        robots=robots, sweep=sweep, alpha=alpha, tolerance=1e-12, max_iterations=20_000
    )
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


def test_too_much_over_relaxation_of_jacobi_diverges_and_says_so() -> None:
    problem = PGOProblem(grid(np.random.default_rng(0)))
    result = run(GaussSeidel(sweep=Sweep.JACOBI, alpha=1.9), problem)
    assert result.status is Status.NOT_FINITE
    assert math.isfinite(result.objective)
    assert math.isnan(result.history.objective[-1])
    assert run(GaussSeidel(sweep=Sweep.COLORS, alpha=1.9), problem).status is Status.CONVERGED


# Flags and starts.


@pytest.mark.parametrize("sweep", Sweep)
@settings(max_examples=examples(15))
@given(seed=SEEDS, n=st.integers(2, 25), d=DIMENSIONS)
def test_a_flagged_sweep_ignores_where_it_begins(sweep: Sweep, seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    robots = scattered(problem.graph, 1 + seed % n, seed)
    turns = schedule(problem.graph, robots, sweep)
    R = random_rotations(n, d, np.random.default_rng(seed))
    for linear in (rotation_problem(problem, R[0]), pose_problem(problem, R)):
        prepared = flagged_turns(linear, problem.graph, turns, 1, problem.backend)
        begin = np.random.default_rng(seed).standard_normal((linear.J.shape[1], linear.r.shape[1]))
        from_random, ledger = take_turns(prepared, begin, 1.0, Ledger(robots.num_robots))
        from_zero, _ = take_turns(prepared, np.zeros_like(begin), 1.0, Ledger(robots.num_robots))
        atol = 1e-9 * max(1.0, np.abs(from_random).max())
        np.testing.assert_allclose(from_random, from_zero, rtol=0, atol=atol)
        assert ledger.rounds <= turns.first.max() + 1


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


def test_without_flags_the_first_sweep_listens_to_everybody() -> None:
    problem = PGOProblem(circle(np.random.default_rng(0)))
    flagged, plain = (
        next(islice(iterate(GaussSeidel(is_flagged=f), problem), 1, None)) for f in (True, False)
    )
    assert not np.allclose(flagged.x, plain.x)
    with_flags, without_flags = (
        run(GaussSeidel(is_flagged=f, tolerance=1e-10), problem) for f in (True, False)
    )
    assert with_flags.objective == pytest.approx(without_flags.objective, rel=1e-7)


@settings(max_examples=examples(10))
@given(seed=SEEDS, n=st.integers(3, 12), d=DIMENSIONS)
def test_pose_0_of_the_start_stays_and_the_gauge_does_not_matter(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    start = random_poses(n, d, seed)
    solver = GaussSeidel(
        robots=partition(problem.graph, min(2, n)), tolerance=1e-11, max_iterations=50_000
    )
    result = run(solver, problem, start)
    np.testing.assert_allclose(result.poses.R[0], start.R[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(result.poses.t[0], start.t[0], rtol=0, atol=1e-12)
    own = centralized(problem)
    np.testing.assert_allclose(result.poses.with_gauge_at(0).R, own.R, rtol=0, atol=1e-6)


# Rounds.


@pytest.mark.parametrize("sweep", Sweep)
def test_rounds_are_turns_and_bytes_are_separators(sweep: Sweep) -> None:
    problem = PGOProblem(grid(np.random.default_rng(0)))
    robots = partition(problem.graph, 5)
    turns = schedule(problem.graph, robots, sweep)
    solver = GaussSeidel(robots=robots, sweep=sweep)
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


# Outer iterations.


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


def test_settings_out_of_range_are_refused() -> None:
    for changes in ({"alpha": 0.0}, {"alpha": 2.0}, {"gauss_newton_steps": 0}, {"tolerance": 0.0}):
        with pytest.raises(SettingError, match=next(iter(changes))):
            GaussSeidel(**changes)
