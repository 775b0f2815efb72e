"""Robots that hold copies: shares of costs and penalties, agreement, and multipliers in balance."""

from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, LOUD_NOISE, SEEDS, random_poses, translation_scale, varied_problem
from hypothesis import assume, given, settings, strategies as st
from robots import PARTITIONERS, Partitioner

from pgo_models import PartitionMethod, PGOProblem, PoseGraph, Poses
from pgo_models.geometry.rotations import (
    Array,
    project_by_svd,
    stack_transposes,
    unstack_transposes,
)
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.matrices import columns_of
from pgo_models.problem.stationarity import rotation_scale
from solvers import SOC, FixedPenalty, MultiplierPenalty
from solvers.network.counted_pool import Count
from solvers.riemannian.polish import polish
from solvers.soc.consensus import ConsensusState, LocalConsensus, LocalRobots
from solvers.soc.consensus_robot import ConsensusRobot
from solvers.soc.penalty import first_penalties
from solvers.soc.recursion_block import Agreement

SIZES = st.integers(2, 14)
RHO = 3.0
FEWER = settings(max_examples=examples(40))  # each example splits a graph and starts a run


def started(
    problem: PGOProblem, parts: Partition, poses: Poses, soc: SOC | None = None
) -> ConsensusState:
    """Robots at poses with penalties; B in balance as under a MultiplierPenalty.

    What they send is not rounded.
    """
    settings = replace(soc if soc is not None else SOC(), robots=parts, bytes_per_number=8)
    return LocalConsensus(settings).init(problem, poses)


def drawn(seed: int, n: int, d: int, partitioner: Partitioner) -> tuple[PGOProblem, ConsensusState]:
    problem = varied_problem(seed, n, d, LOUD_NOISE)
    soc = SOC(penalty=FixedPenalty(RHO), translation_penalty=0.3)
    return problem, started(
        problem, partitioner(problem.graph, seed), random_poses(n, d, seed), soc
    )


def rows_of(robot: ConsensusRobot, problem: PGOProblem) -> IntArray:
    """Rows of the whole graph's X that a robot's X has."""
    return columns_of(robot.layout.subgraph.poses, problem.num_poses, (1, problem.d))


def sums_over(problem: PGOProblem, robots: tuple[ConsensusRobot, ...], parts: list[Array]) -> Array:
    """Sum over robots of values on their rows."""
    total = np.zeros((problem.side, *parts[0].shape[1:]))
    for robot, part in zip(robots, parts, strict=True):
        np.add.at(total, rows_of(robot, problem), part)
    return total


def held_by(problem: PGOProblem, robots: tuple[ConsensusRobot, ...]) -> Array:
    """How many robots hold a row with a penalty, (N,)."""
    return sums_over(problem, robots, [robot.layout.held[:, 0].astype(float) for robot in robots])


@FEWER
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_every_edge_is_shared_completely(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    problem, state = drawn(seed, n, d, partitioner)
    X = np.random.default_rng(seed).standard_normal((problem.side, d))  # whatever the rotations are
    shares = [
        robot.layout.problem.objective_stacked(X[rows_of(robot, problem)]) for robot in state.robots
    ]
    assert sum(shares) == pytest.approx(problem.objective_stacked(X), rel=1e-12)
    products = [robot.layout.problem.apply_M(X[rows_of(robot, problem)]) for robot in state.robots]
    scale = float(abs(problem.M).sum(axis=0).max())
    total = sums_over(problem, state.robots, products)
    np.testing.assert_allclose(
        total, problem.apply_M(X), rtol=0, atol=1e-13 * scale * np.abs(X).max()
    )


@FEWER
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_held_rows_are_rotations_and_separator_translations(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    problem, state = drawn(seed, n, d, partitioner)
    parts = partitioner(problem.graph, seed)
    separators = parts.separators(problem.graph)
    count = held_by(problem, state.robots)
    for robot in state.robots:
        layout = robot.layout
        poses = robot.layout.subgraph.poses
        np.testing.assert_array_equal(layout.held[: len(poses), 0], np.isin(poses, separators))
        assert layout.held[len(poses) :].all()
        np.testing.assert_array_equal(poses[layout.separators], np.intersect1d(poses, separators))
        np.testing.assert_array_equal(
            poses[layout.own], np.flatnonzero(parts.robot == layout.subgraph.robot)
        )
        alone = layout.held[:, 0] & (count[rows_of(robot, problem)] == 1)
        np.testing.assert_array_equal(layout.private, alone & (len(layout.common) > 0))
        np.testing.assert_array_equal(
            layout.copies[layout.held[:, 0], 0], count[rows_of(robot, problem)][layout.held[:, 0]]
        )


@FEWER
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_the_penalty_of_a_pose_is_shared_among_its_copies(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    problem, state = drawn(seed, n, d, partitioner)
    penalties = [robot.block.rho for robot in state.robots]
    total = sums_over(problem, state.robots, penalties)
    known = held_by(problem, state.robots) > 0
    whole = np.concatenate([0.3 * translation_scale(problem), np.full(d * n, RHO)])
    np.testing.assert_allclose(total[known], whole[known], rtol=1e-14, atol=0)
    assert (total[~known] == 0).all()
    np.testing.assert_allclose(state.rho, RHO, rtol=1e-15)
    assert state.size == pytest.approx(np.sqrt(d * RHO * n), rel=1e-12)


@FEWER
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_every_robot_minimises_its_own_subproblem(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    _, state = drawn(seed, n, d, partitioner)
    for robot in state.robots:
        assert robot.step_a is not None
        penalty = robot.block.rho
        shift = np.random.default_rng(seed).standard_normal(robot.block.omega.shape)
        K = robot.layout.problem.M.toarray() + np.diag(0.5 * penalty)
        if not len(robot.layout.separators):
            K[0, 0] *= 2  # no translation is held: t_0 = 0
        expected = np.linalg.solve(K, 0.5 * penalty[:, None] * shift)
        x = robot.step_a.solve(shift)
        np.testing.assert_allclose(x, expected, rtol=0, atol=1e-8 * (1 + np.abs(expected).max()))


@FEWER
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_agreement_is_the_mean_and_its_nearest_rotation(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    problem, state = drawn(seed, n, d, partitioner)
    rng = np.random.default_rng(seed)
    moved = []
    for robot in state.robots:
        s = np.where(robot.layout.held, rng.standard_normal(robot.block.s.shape), 0.0)
        block = replace(robot.block, s=s, anderson=replace(robot.block.anderson, image=s))
        moved.append(replace(robot, state=replace(robot.state, ahead=(s, block, robot.state.sums))))
    here = LocalRobots(problem, tuple(moved))
    told = [
        {to: robot.state.ahead[0][rows] for to, rows in robot.layout.common.items()}
        for robot in moved
    ]
    agreement = Agreement(np.zeros(0), is_best=True)
    here.ask(ConsensusRobot.step, [(agreement, rows) for rows in here.exchange(told)], Count.OFF)
    count = np.maximum(held_by(problem, here.robots), 1.0)[:, None]
    mean = sums_over(problem, here.robots, [robot.state.ahead[0] for robot in moved]) / count
    mean[n:] = stack_transposes(project_by_svd(unstack_transposes(mean[n:])))
    for robot, before in zip(here.robots, state.robots, strict=True):
        expected = np.where(robot.layout.held, mean[rows_of(robot, problem)], 0.0)
        np.testing.assert_allclose(robot.block.omega, expected, rtol=0, atol=1e-9)
        np.testing.assert_allclose(robot.block.B, robot.block.s - expected, rtol=0, atol=1e-9)
        assert before.block.omega is not robot.block.omega
    omega = replace(state, robots=here.robots).omega
    np.testing.assert_allclose(stack_transposes(omega), mean[n:], rtol=0, atol=1e-9)


@FEWER
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_balanced_multipliers_have_the_stationary_mean_and_pull_all_copies_alike(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    problem = varied_problem(seed, n, d, LOUD_NOISE)
    poses = random_poses(n, d, seed)
    state = started(problem, partitioner(problem.graph, seed), poses)
    assume(len(state.robots) > 1)
    forces = []
    for robot in state.robots:
        pull = robot.block.rho[:, None] * robot.block.B
        forces.append(2.0 * robot.layout.problem.apply_M(robot.state.X) + pull)
    count = held_by(problem, state.robots)
    scale = 1 + max(np.abs(force).max() for force in forces)
    total = sums_over(problem, state.robots, forces)
    share = total / np.maximum(count, 1)[:, None]
    for robot, force in zip(state.robots, forces, strict=True):
        held = robot.layout.held[:, 0]
        expected = share[rows_of(robot, problem)][held]
        np.testing.assert_allclose(force[held], expected, rtol=0, atol=1e-12 * scale)
    # The multiplier of the constraint at these poses balances the symmetric part of the gradient;
    # the antisymmetric part is the total force.
    gradient = 2.0 * problem.apply_M(poses.stacked())[n:]
    product = np.swapaxes(unstack_transposes(gradient), 1, 2) @ poses.R
    antisymmetric = 0.5 * (product - np.swapaxes(product, 1, 2)) @ np.swapaxes(poses.R, 1, 2)
    expected = stack_transposes(np.swapaxes(antisymmetric, 1, 2))
    np.testing.assert_allclose(total[n:], expected, rtol=0, atol=1e-11 * scale)
    assert (count[n:] > 0).all()


@FEWER
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_at_an_optimum_nothing_pulls_at_any_copy(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    problem = varied_problem(seed, n, d, LOUD_NOISE)
    best = polish(problem, chordal_start(problem))
    state = started(problem, partitioner(problem.graph, seed), best)
    assume(len(state.robots) > 1)
    for robot in state.robots:
        gradient = 2.0 * robot.layout.problem.apply_M(robot.state.X)
        force = gradient + robot.block.rho[:, None] * robot.block.B
        scale = float(np.abs(gradient).max()) + float(problem.M.diagonal().max())
        assert np.abs(force[robot.layout.held[:, 0]]).max() <= 1e-6 * scale


# The stiffness of separators, and the penalties that follow from it.


def stiffness_of(problem: PGOProblem, parts: Partition) -> float:
    """Stiffness that the translation penalty at the start is 0.6 times of."""
    soc = SOC(penalty=FixedPenalty(float(rotation_scale(problem).mean())))
    return started(problem, parts, chordal_start(problem), soc).separators.translation / 0.6


@FEWER
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS, exponent=st.integers(-10, 10))
def test_stiffness_has_no_unit(
    seed: int, n: int, d: int, partitioner: Partitioner, exponent: int
) -> None:
    problem = varied_problem(seed, n, d)
    parts = partitioner(problem.graph, seed)
    stiffness = stiffness_of(problem, parts)
    assert 0 < stiffness < np.inf
    graph = problem.graph
    scale = 2.0**exponent
    scaled = PGOProblem(replace(graph, kappa=scale * graph.kappa, tau=scale * graph.tau))
    assert stiffness_of(scaled, parts) == pytest.approx(stiffness, rel=1e-6)


@pytest.mark.parametrize("links", [1, 5, 40])
def test_stiffness_is_that_of_springs_in_series(links: int) -> None:
    # Two chains of equal springs, joined at both ends. A robot holds its chain and, by half a
    # spring, the other's ends.
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
    parts = Partition(np.repeat([0, 1], n), PartitionMethod.CONTIGUOUS)
    state = started(problem, parts, Poses.identity(2 * n, 2), SOC(penalty=FixedPenalty(1.0)))
    compliances = np.array([2.0, links, 2.0])  # between the four separators, in a row
    incidence = np.diff(np.eye(4), axis=0)
    C = np.linalg.pinv(incidence.T @ np.diag(1 / compliances) @ incidence)
    half_scale = np.full(4, 0.5 * 2.0 / 2)  # two springs at every end, two copies
    root = half_scale**0.5
    without_shift = np.eye(4) - np.full((4, 4), 0.25)
    C = without_shift @ (root[:, None] * C * root) @ without_shift
    # An estimate of the trace: its standard deviation is at most a quarter.
    assert state.separators.translation / 0.6 == pytest.approx(3.0 / np.trace(C), rel=0.5)


@FEWER
@given(seed=SEEDS, n=st.integers(3, 12), d=DIMENSIONS, partitioner=PARTITIONERS)
def test_separator_penalties_follow_from_the_stiffness(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    problem = varied_problem(seed, n, d)
    parts = partitioner(problem.graph, seed)
    start = chordal_start(problem)
    state = started(problem, parts, start)
    wanted = first_penalties(MultiplierPenalty(), problem, start)
    relative = state.separators.translation
    shared = parts.separators(problem.graph)
    wanted[shared] = np.maximum(
        wanted[shared], min(0.7 * relative**0.5, 0.3) * rotation_scale(problem)[shared]
    )
    np.testing.assert_allclose(state.rho, wanted, rtol=1e-12, atol=0)
    given_state = started(
        problem, parts, start, SOC(translation_penalty=0.02, separator_penalty=5.0)
    )
    assert given_state.separators.translation == 0.02
    assert (given_state.rho[shared] >= 5.0 * rotation_scale(problem)[shared] * (1 - 1e-12)).all()
