from dataclasses import replace

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, random_poses, rounding_of_objective, varied_problem
from hypothesis import given
from hypothesis import strategies as st

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.partitioning import Partition, PartitionMethod, partition
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.problem import PGOProblem
from solvers.soc.local_copies import LocalCopies, build_copies
from solvers.soc.penalty import rotation_scale, translation_scale
from solvers.soc.r_step import RStep

SIZES = st.integers(3, 14)
METHODS = st.sampled_from([PartitionMethod.CONTIGUOUS, PartitionMethod.METIS, PartitionMethod.SINGLETONS])


def team_of(seed: int, n: int, d: int, method: PartitionMethod) -> tuple[PGOProblem, Partition, LocalCopies]:
    problem = varied_problem(seed, n, d)
    robots = partition(problem.graph, 1 + seed % n, method)
    return problem, robots, build_copies(problem, robots, RStep.FACTORIZED)


def rows_of(problem: PGOProblem, poses: Array) -> Array:
    """Rows of the X of the whole graph that the X of some poses holds."""
    n, d = problem.num_poses, problem.d
    return np.array([*poses, *(n + d * pose + row for pose in poses for row in range(d))])


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, method=METHODS)
def test_every_edge_is_shared_completely(seed: int, n: int, d: int, method: PartitionMethod) -> None:
    problem, _, copies = team_of(seed, n, d, method)
    X = np.random.default_rng(seed).standard_normal((problem.side, d))  # whatever the rotations are
    for stacked in (X, random_poses(n, d, seed).stacked()):
        total = squares = 0.0
        for robot in copies.robots:
            local = stacked[rows_of(problem, robot.poses)]
            total += float(np.sum(local * (robot.M @ local)))
            squares += float(robot.w @ np.sum((robot.A @ local) ** 2, axis=1))
        allowed = rounding_of_objective(problem, stacked)
        assert abs(total - problem.objective_stacked(stacked)) <= allowed
        assert squares == pytest.approx(problem.objective_stacked(stacked), rel=1e-12)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, method=METHODS)
def test_a_robot_knows_its_own_edges_and_nothing_else(seed: int, n: int, d: int, method: PartitionMethod) -> None:
    problem, robots, copies = team_of(seed, n, d, method)
    graph = problem.graph
    assert len(copies.robots) == robots.num_robots
    for a, robot in enumerate(copies.robots):
        own = set(np.flatnonzero(robots.robot == a).tolist())
        edges = [e for e in range(graph.num_edges) if {int(graph.i[e]), int(graph.j[e])} & own]
        expected = own.union(*({int(graph.i[e]), int(graph.j[e])} for e in edges))
        assert robot.poses.tolist() == sorted(expected)
        assert robot.A.shape == ((d + 1) * len(edges), (d + 1) * len(expected))
        inner = np.array([{int(graph.i[e]), int(graph.j[e])} <= own for e in edges])
        np.testing.assert_allclose(
            robot.w[: len(edges)], graph.tau[edges] * np.where(inner, 1.0, 0.5), rtol=1e-15, atol=0
        )


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, method=METHODS)
def test_held_rows_are_rotations_and_separator_translations(seed: int, n: int, d: int, method: PartitionMethod) -> None:
    problem, robots, copies = team_of(seed, n, d, method)
    separators = set(robots.separators(problem.graph).tolist())
    for robot, rows in zip(copies.robots, copies.slices, strict=True):
        np.testing.assert_array_equal(rows_of(problem, robot.poses)[robot.held], robot.held_global)
        np.testing.assert_array_equal(copies.row[rows], robot.held_global)
        translations = robot.held_global[robot.held_global < n]
        assert set(translations.tolist()) == separators & set(robot.poses.tolist())
        assert (robot.held_global >= n).sum() == d * len(robot.poses)
    np.testing.assert_array_equal(copies.multiplicity, np.bincount(copies.row, minlength=problem.side))
    assert (copies.multiplicity[n:] >= 1).all()


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, method=METHODS)
def test_the_average_is_over_the_copies(seed: int, n: int, d: int, method: PartitionMethod) -> None:
    problem, _, copies = team_of(seed, n, d, method)
    rng = np.random.default_rng(seed)
    X = rng.standard_normal((problem.side, d))
    known = copies.multiplicity > 0
    # Equal copies give back what they copy; others their mean.
    np.testing.assert_allclose(copies.average(X[copies.row])[known], X[known], rtol=0, atol=1e-15)
    assert (copies.average(X[copies.row])[~known] == 0).all()
    vector = rng.standard_normal((len(copies.row), d))
    for row in np.flatnonzero(known):
        np.testing.assert_allclose(
            copies.average(vector)[row], vector[copies.row == row].mean(axis=0), rtol=0, atol=1e-14
        )


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, method=METHODS)
def test_the_penalty_of_a_pose_is_shared_among_its_copies(seed: int, n: int, d: int, method: PartitionMethod) -> None:
    problem, _, copies = team_of(seed, n, d, method)
    rng = np.random.default_rng(seed)
    rho, rho_t = np.exp(rng.standard_normal((2, n)))
    ready = copies.with_penalty(rho, rho_t)
    assert copies.penalty is None
    assert copies.steps == ()
    assert ready.penalty is not None
    total = np.bincount(ready.row, weights=ready.penalty, minlength=problem.side)
    known = copies.multiplicity > 0
    np.testing.assert_allclose(total[known], np.concatenate([rho_t, np.repeat(rho, d)])[known], rtol=1e-14, atol=0)
    for row in np.flatnonzero(known):
        assert np.ptp(ready.penalty[ready.row == row]) == 0.0


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, method=METHODS)
def test_gradients_of_the_robots_add_up(seed: int, n: int, d: int, method: PartitionMethod) -> None:
    problem, _, copies = team_of(seed, n, d, method)
    X = random_poses(n, d, seed).stacked()
    shares = copies.gradients(X)
    total = np.stack([np.bincount(copies.row, weights=column, minlength=problem.side) for column in shares.T], axis=1)
    known = copies.multiplicity > 0
    scale = float(abs(problem.M).sum(axis=0).max())
    np.testing.assert_allclose(total[known], 2.0 * problem.apply_M(X)[known], rtol=0, atol=1e-13 * scale)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, method=METHODS)
def test_every_robot_minimises_its_own_subproblem(seed: int, n: int, d: int, method: PartitionMethod) -> None:
    problem, _, copies = team_of(seed, n, d, method)
    ready = copies.with_penalty(0.3 * rotation_scale(problem), 0.1 * translation_scale(problem))
    assert ready.penalty is not None
    shift = np.random.default_rng(seed).standard_normal((len(copies.row), d))
    kept = shift.copy()
    x = ready.solve_all(shift)
    np.testing.assert_array_equal(shift, kept)
    for robot, rows in zip(copies.robots, copies.slices, strict=True):
        K = robot.M.toarray()
        b = np.zeros((len(K), d))
        K[robot.held, robot.held] += 0.5 * ready.penalty[rows]
        b[robot.held] = 0.5 * ready.penalty[rows, None] * shift[rows]
        if len(copies.robots) == 1:
            K[0, 0] *= 2  # no translation is held: t_0 = 0
        expected = np.linalg.solve(K, b)[robot.held]
        np.testing.assert_allclose(x[rows], expected, rtol=0, atol=1e-8 * (1 + np.abs(expected).max()))


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_one_robot_is_the_whole_graph(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    for robots in (None, partition(problem.graph, 1)):
        (whole,) = build_copies(problem, robots, RStep.FACTORIZED).robots
        assert whole.M is problem.M
        assert whole.analysis is problem.analysis
        np.testing.assert_array_equal(whole.held, np.arange(n, problem.side))


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, method=METHODS)
def test_what_is_shared_and_what_is_private(seed: int, n: int, d: int, method: PartitionMethod) -> None:
    problem, robots, copies = team_of(seed, n, d, method)
    np.testing.assert_array_equal(copies.separators, robots.separators(problem.graph))
    for robot, rows in zip(copies.robots, copies.slices, strict=True):
        others = np.concatenate([[-1], *(other.held_global for other in copies.robots if other is not robot)])
        np.testing.assert_array_equal(copies.private[rows], ~np.isin(robot.held_global, others))


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, method=METHODS, exponent=st.integers(-10, 10))
def test_stiffness_has_no_unit(seed: int, n: int, d: int, method: PartitionMethod, exponent: int) -> None:
    problem, robots, copies = team_of(seed, n, d, method)
    rho = rotation_scale(problem)
    stiffness = copies.stiffness(rho)
    assert 0 < stiffness < np.inf
    graph, scale = problem.graph, 2.0**exponent
    scaled = PGOProblem(replace(graph, kappa=scale * graph.kappa, tau=scale * graph.tau))
    again = build_copies(scaled, robots, RStep.FACTORIZED).stiffness(scale * rho)
    assert again == pytest.approx(stiffness, rel=1e-6)


@pytest.mark.parametrize("links", [1, 5, 40])
def test_stiffness_is_that_of_springs_in_series(links: int) -> None:
    # Two chains of equal springs, joined at both ends. A robot holds its chain and, by half a spring, the other's ends.
    n = links + 1
    chain = np.arange(links)
    graph = PoseGraph(
        num_poses=2 * n,
        i=np.concatenate([chain, n + chain, [0, links]]),
        j=np.concatenate([chain + 1, n + chain + 1, [n, n + links]]),
        R_ij=np.tile(np.eye(2), (2 * n, 1, 1)),
        t_ij=np.zeros((2 * n, 2)),
        kappa=np.ones(2 * n),
        tau=np.ones(2 * n),
    )
    problem = PGOProblem(graph)
    copies = build_copies(problem, Partition(np.repeat([0, 1], n), PartitionMethod.CONTIGUOUS), RStep.FACTORIZED)
    compliances = np.array([2.0, links, 2.0])  # between the four separators, in a row
    incidence = np.diff(np.eye(4), axis=0)
    C = np.linalg.pinv(incidence.T @ np.diag(1 / compliances) @ incidence)
    half_scale = np.full(4, 0.5 * 2.0 / 2)  # two springs at every end, two copies
    shift = np.full((4, 4), 0.25)
    C = (np.eye(4) - shift) @ (half_scale[:, None] ** 0.5 * C * half_scale**0.5) @ (np.eye(4) - shift)
    # An estimate of the trace: its standard deviation is at most a quarter.
    assert copies.stiffness(np.ones(2 * n)) == pytest.approx(3.0 / np.trace(C), rel=0.5)
