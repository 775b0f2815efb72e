"""MESA: the certified optimum whatever the partition, copies that agree, and what crosses the
network.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, OPTIMUM, SEEDS, optimum_tolerance, random_poses, varied_problem
from hypothesis import given, settings, strategies as st

from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, exp_map, log_map
from pgo_models.graphs.grid_worlds import grid_world
from pgo_models.graphs.partitioning import Partition, PartitionMethod, partition
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.scenes import circle, grid
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from solvers.baselines.mesa import Mesa, MesaState, distance, halfway, held_poses
from solvers.loop import iterate, run
from solvers.pipeline import solve
from solvers.result import Run, Status
from solvers.riemannian.polish import polish

SLACK = 1e-6  # relative, of F where residuals are within 1e-8


def tight(robots: Partition | None, **changes: float) -> Mesa:
    return replace(Mesa(robots, tolerance=1e-8, max_iterations=5000), **changes)


def assert_optimal(problem: PGOProblem, result: Run[MesaState]) -> None:
    """Converged at the optimum that `solve` certifies, where all copies agree."""
    assert result.status is Status.CONVERGED
    certified = solve(problem)
    assert certified.certificate.verdict.name == "CERTIFIED"
    assert result.objective == pytest.approx(certified.objective, rel=SLACK)
    held = result.state.held
    x = result.state.x
    w, v = distance(x[held.copy], x[held.original])
    assert np.abs(w).max() <= 1e-6
    assert np.abs(v).max() <= 1e-6 * np.abs(x.t).max()


# The optimum.


@pytest.mark.parametrize("d", [2, 3])
def test_a_grid_world_ends_at_the_certified_optimum(d: int) -> None:
    world = grid_world(4, 25, np.random.default_rng(d), d=d)
    problem = PGOProblem(world)
    robots = partition(problem.graph, 4, PartitionMethod.CONTIGUOUS)
    assert_optimal(problem, run(tight(robots), problem))


@pytest.mark.parametrize("method", [PartitionMethod.CONTIGUOUS, PartitionMethod.SINGLETONS])
@pytest.mark.parametrize("make", [circle, grid])
def test_the_partition_does_not_change_the_optimum(
    make: Callable[..., PoseGraph], method: PartitionMethod
) -> None:
    problem = PGOProblem(make(np.random.default_rng(3)))
    assert_optimal(problem, run(tight(partition(problem.graph, 4, method)), problem))


@pytest.mark.parametrize("name", ["tinyGrid3D", "smallGrid3D"])
def test_public_graphs_end_at_the_published_optimum(
    name: str, benchmark_problem: Callable[[str], PGOProblem]
) -> None:
    problem = benchmark_problem(name)
    robots = partition(problem.graph, min(5, problem.num_poses), PartitionMethod.CONTIGUOUS)
    result = run(tight(robots), problem)
    assert result.status is Status.CONVERGED
    allowed = max(optimum_tolerance(name), SLACK * OPTIMUM[name])
    assert result.objective == pytest.approx(OPTIMUM[name], rel=0, abs=allowed)


@settings(max_examples=examples(10))
@given(seed=SEEDS, n=st.integers(3, 10), d=DIMENSIONS, backend=st.sampled_from(CholeskyBackend))
def test_what_agrees_and_stays_is_stationary(
    seed: int, n: int, d: int, backend: CholeskyBackend
) -> None:
    problem = PGOProblem(varied_problem(seed, n, d).graph, backend)
    robots = partition(problem.graph, 2, PartitionMethod.CONTIGUOUS)
    solver = replace(tight(robots), max_iterations=20_000)
    result = run(solver, problem)
    assert result.status is Status.CONVERGED
    expected = problem.objective(polish(problem, result.poses))
    assert result.objective == pytest.approx(expected, rel=SLACK, abs=1e-12)


@pytest.mark.parametrize(
    "changes",
    [
        {"is_scaled": False, "penalty": 20.0},
        {"multiplier_step": 1.6},
        {"local_steps": 1},
        {"local_steps": 6},
        {"penalty": 0.5, "growth": 1.01},
    ],
    ids=str,
)
def test_settings_change_the_way_and_not_the_end(changes: dict[str, float]) -> None:
    problem = PGOProblem(grid(np.random.default_rng(1)))
    robots = partition(problem.graph, 3)
    assert_optimal(problem, run(tight(robots, **changes), problem))


def test_a_penalty_that_grows_does_not_pass_for_an_optimum() -> None:
    # It holds the poses where they are, which is no convergence.
    problem = PGOProblem(grid(np.random.default_rng(1)))
    solver = Mesa(partition(problem.graph, 3), growth=1.5, max_iterations=300)
    result = run(solver, problem)
    assert result.status is Status.MAX_ITERATIONS
    assert result.state.raised <= 1e6
    assert result.objective > solve(problem).objective * (1 + SLACK)


# Steps.


def test_one_robot_is_levenberg_marquardt_and_needs_no_network() -> None:
    problem = PGOProblem(grid(np.random.default_rng(0)))
    result = run(tight(partition(problem.graph, 1)), problem)
    assert result.status is Status.CONVERGED
    assert result.objective == pytest.approx(solve(problem).objective, rel=1e-12)
    assert (result.state.ledger.rounds, result.state.ledger.messages) == (0, 0)


@settings(max_examples=examples(20))
@given(seed=SEEDS, n=st.integers(3, 10), d=DIMENSIONS)
def test_every_edge_is_with_one_robot_who_holds_both_ends(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    robots = partition(problem.graph, 3, PartitionMethod.CONTIGUOUS)
    held = held_poses(problem, robots)
    edges = held.problem.graph
    np.testing.assert_array_equal(held.pose[edges.i], problem.graph.i)
    np.testing.assert_array_equal(held.pose[edges.j], problem.graph.j)
    np.testing.assert_array_equal(held.holder[edges.i], held.holder[edges.j])
    np.testing.assert_array_equal(held.pose[held.own], np.arange(n))
    np.testing.assert_array_equal(held.holder[held.own], robots.robot)
    np.testing.assert_array_equal(held.pose[held.copy], held.pose[held.original])
    assert (held.holder[held.copy] != held.holder[held.original]).all()
    poses = random_poses(n, d, seed)
    assert held.problem.objective(poses[held.pose]) == pytest.approx(problem.objective(poses))


def local_gradient(state: MesaState) -> Array:
    """Gradient of what the robots minimise in step (a), by central differences."""
    held = state.held
    step = 1e-5
    gradient = np.empty(held.unknowns.side)
    for k in range(held.unknowns.side):
        values = []
        for sign in (1.0, -1.0):
            move = np.zeros(held.unknowns.side)
            move[k] = sign * step
            values.append(augmented_cost(state, state.x.moved_along(*held.unknowns.split(move))))
        gradient[k] = (values[0] - values[1]) / (2.0 * step)
    return gradient


def augmented_cost(state: MesaState, x: Poses) -> float:
    """F of all edges and the penalties of all pairs, as they are written in the paper."""
    held = state.held
    total = held.problem.objective(x)
    for ends, sign in ((held.original, -1.0), (held.copy, 1.0)):
        for pair, pose in enumerate(ends):
            w = log_map(state.z.R[pair].T @ x.R[pose][None])[0] + sign * state.B_R[pair]
            v = x.t[pose] - state.z.t[pair] + sign * state.B_t[pair]
            total += float(state.rho_R * (w @ w) + state.rho_t * (v @ v))
    return total


@pytest.mark.parametrize("d", [2, 3])
def test_many_local_steps_end_at_the_minimum_of_step_a(d: int) -> None:
    problem = varied_problem(4, 6, d)
    solver = Mesa(partition(problem.graph, 2, PartitionMethod.CONTIGUOUS), local_steps=200)
    state = next(islice(iterate(solver, problem, random_poses(6, d, 1)), 3, None))
    following = solver.step(problem, state)
    before = augmented_cost(state, state.x)
    minimum = replace(state, x=following.x)
    assert augmented_cost(state, following.x) < before
    gradient = local_gradient(minimum)
    assert np.abs(gradient).max() <= 1e-5 * np.abs(local_gradient(state)).max()


@settings(max_examples=examples(20))
@given(seed=SEEDS, d=DIMENSIONS)
def test_the_middle_is_as_far_from_either_end(seed: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    a = random_poses(5, d, seed)
    turn = rng.uniform(-1.0, 1.0, (5, 1 if d == 2 else 3))
    b = Poses(a.R @ exp_map(turn), a.t + rng.standard_normal((5, d)))
    z = halfway(a, b)
    for one, other in zip(distance(a, z), distance(b, z), strict=True):
        np.testing.assert_allclose(one, -other, rtol=0, atol=1e-12)


def test_a_start_at_the_optimum_is_left_and_found_again() -> None:
    # The multipliers are zero at first, as in the paper.
    problem = PGOProblem(grid(np.random.default_rng(0)))
    optimum = solve(problem)
    solver = tight(partition(problem.graph, 3))
    result = run(solver, problem, optimum.poses)
    assert result.history.objective[1] > optimum.objective
    assert result.status is Status.CONVERGED
    assert result.objective == pytest.approx(optimum.objective, rel=SLACK)


# Rounds.


@pytest.mark.parametrize("d", [2, 3])
def test_a_step_is_a_round_and_sends_both_poses_of_every_pair(d: int) -> None:
    problem = varied_problem(0, 12, d)
    graph = problem.graph
    robots = partition(graph, 4, PartitionMethod.CONTIGUOUS)
    cut = robots.cut_edges(graph)
    copies = set(zip(robots.robot[graph.i[cut]].tolist(), graph.j[cut].tolist(), strict=True))
    states = list(islice(iterate(Mesa(robots), problem), 6))
    for k, state in enumerate(states):
        ledger = state.ledger
        assert (ledger.rounds, ledger.all_reduces) == (k, k)
        assert ledger.num_bytes == k * 2 * len(copies) * 8 * d * (d + 1)
        measured = Mesa(robots).measure(problem, state)
        assert (measured.rounds, measured.num_bytes) == (ledger.rounds, ledger.num_bytes)
    links = {(a, int(robots.robot[j])) for a, j in copies}
    sender, receiver, _, _ = states[-1].ledger.by_link()
    assert set(zip(sender.tolist(), receiver.tolist(), strict=True)) == {
        link for a, b in links for link in ((a, b), (b, a))
    }


def test_it_starts_at_the_chordal_relaxation_unless_told_otherwise() -> None:
    problem = PGOProblem(grid(np.random.default_rng(0)))
    state = Mesa().init(problem, None)
    np.testing.assert_array_equal(state.x[state.held.own].R, chordal_start(problem).R)


# Settings.


def test_settings_out_of_range_are_refused() -> None:
    for changes in (
        {"penalty": 0.0},
        {"growth": 0.9},
        {"growth": float("inf")},
        {"multiplier_step": 2.0},
        {"local_steps": 0},
        {"tolerance": 0.0},
    ):
        with pytest.raises(SettingError, match=next(iter(changes))):
            Mesa(**changes)


def test_landmarks_are_refused() -> None:
    graph = varied_problem(0, 6, 2).graph
    seen = graph.with_landmark(np.array([0, 1]), np.ones((2, 2)), tau=1.0)
    with pytest.raises(SettingError, match="no rotation that is determined"):
        run(Mesa(), PGOProblem(seen))
