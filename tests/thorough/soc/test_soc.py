from dataclasses import dataclass
from itertools import islice, pairwise

import numpy as np
import pytest
from budget import examples
from graphs import (
    DIMENSIONS,
    LOUD_NOISE,
    SEEDS,
    exact_graph,
    translation_scale,
    varied_graph,
    varied_problem,
)
from hypothesis import assume, given, settings, strategies as st

from pgo_models import (
    PartitionMethod,
    PGOProblem,
    PoseGraph,
    chordal_start,
    grid,
    multipliers,
    partition,
)
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import (
    orthogonality_error,
    project_by_svd,
    stack_transposes,
    unstack_transposes,
)
from pgo_models.graphs.partitioning import Partition
from pgo_models.problem.matrices import joint_matrix
from pgo_models.problem.stationarity import rotation_scale
from solvers import SOC, Coupling, FixedPenalty, Measurement, PaperSOC, Status, iterate, polish, run
from solvers.riemannian.polish import relative_decrement
from solvers.soc.anderson import Anderson

SIZES = st.integers(3, 12)
METHODS = st.sampled_from(
    [PartitionMethod.CONTIGUOUS, PartitionMethod.METIS, PartitionMethod.SINGLETONS]
)


def robots_of(problem: PGOProblem, seed: int, method: PartitionMethod) -> Partition:
    robots = partition(problem.graph, 2 + seed % (problem.num_poses - 1), method)
    assume(robots.num_robots > 1)  # METIS may leave all poses to one
    return robots


def fixed_penalty(problem: PGOProblem) -> FixedPenalty:
    return FixedPenalty(float(np.median(rotation_scale(problem))))


# The recursion, literally.


@dataclass
class Part:
    """What one robot knows, written down from the graph: half of the edges between two robots."""

    matrix: np.ndarray  # M of its edges
    known: np.ndarray  # rows of X of its poses
    held: np.ndarray  # those with a penalty: rotations, and translations of separators


def part_of(problem: PGOProblem, robots: Partition, robot: int) -> Part:
    graph = problem.graph
    n = graph.num_poses
    d = graph.d
    separators = set(robots.separators(graph).tolist())
    num_ends = (robots.robot[graph.i] == robot).astype(float) + (robots.robot[graph.j] == robot)
    kept = num_ends > 0
    kappa, tau = (0.5 * (num_ends * weight)[kept] for weight in (graph.kappa, graph.tau))
    edges = PoseGraph(
        n, graph.i[kept], graph.j[kept], graph.R_ij[kept], graph.t_ij[kept], kappa, tau
    )
    own = np.flatnonzero(robots.robot == robot).tolist()
    poses = sorted({*own, *edges.i.tolist(), *edges.j.tolist()})
    rotations = [n + d * i + r for i in poses for r in range(d)]
    translations = [i for i in poses if i in separators]
    known = np.array([*poses, *rotations])
    return Part(joint_matrix(edges).toarray(), known, np.array([*translations, *rotations]))


def local_passes_of(
    part: Part,
    penalty: np.ndarray,
    count: np.ndarray,
    z: np.ndarray,
    B: np.ndarray,
    passes: int,
    n: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x of the last pass, and z and B before it: (b) and (c) on the poses of this robot alone."""
    d = z.shape[1]
    held = part.held
    share = penalty[held] / count[held]
    positions = np.searchsorted(part.known, held)
    assert (part.known[positions] == held).all()
    z = z.copy()
    B = B.copy()
    for remaining in range(passes)[::-1]:
        K = part.matrix[np.ix_(part.known, part.known)].copy()
        b = np.zeros((len(part.known), d))
        K[positions, positions] += 0.5 * share
        b[positions] = 0.5 * share[:, None] * (z - B)
        x = np.linalg.solve(K, b)[positions]
        for row in range(len(held) if remaining else 0):
            if held[row] < n or (held[row] - n) % d or count[held[row]] > 1:
                continue
            # No other robot knows this pose: its omega is its robot's own affair.
            pose = slice(row, row + d)
            s = (x + B)[pose]
            z[pose] = project_by_svd(s.T[None])[0].T
            B[pose] = s - z[pose]
    return x, z, B


@settings(max_examples=examples(40))
@given(
    seed=SEEDS,
    n=SIZES,
    d=DIMENSIONS,
    method=METHODS,
    alpha=st.sampled_from([1.0, 1.5]),
    local_passes=st.sampled_from([1, 3]),
)
def test_consensus_is_its_recursion_robot_by_robot(
    seed: int, n: int, d: int, method: PartitionMethod, alpha: float, local_passes: int
) -> None:
    problem = varied_problem(seed, n, d)
    rule = fixed_penalty(problem)
    robots = robots_of(problem, seed, method)
    soc = SOC(
        robots=robots,
        penalty=rule,
        alpha=alpha,
        acceleration=None,
        local_passes=local_passes,
        bytes_per_number=8,
        translation_penalty=0.1,
    )
    states = iterate(soc, problem)
    first = next(states)
    penalty = np.concatenate([0.1 * translation_scale(problem), np.full(d * n, rule.rho)])
    parts = [part_of(problem, robots, robot) for robot in range(robots.num_robots)]
    count = np.bincount(np.concatenate([part.held for part in parts]), minlength=problem.side)
    z = [robot.block.omega[robot.layout.held[:, 0]] for robot in first.robots]
    B = [robot.block.B[robot.layout.held[:, 0]] for robot in first.robots]
    for state in islice(states, 8):
        total = np.zeros((problem.side, d))
        relaxed = []
        for a, part in enumerate(parts):
            x, z_a, B_a = local_passes_of(part, penalty, count, z[a], B[a], local_passes, n)
            relaxed.append(alpha * x + (1 - alpha) * z_a + B_a)
            total[part.held] += relaxed[a]
        mean = total / np.maximum(count, 1)[:, None]
        mean[n:] = stack_transposes(project_by_svd(unstack_transposes(mean[n:])))
        z = [mean[part.held] for part in parts]
        B = [s - z_a for s, z_a in zip(relaxed, z, strict=True)]
        atol = 1e-7 * (1 + np.abs(mean).max())
        for a, robot in enumerate(state.robots):
            held = robot.layout.held[:, 0]
            np.testing.assert_allclose(robot.block.omega[held], z[a], rtol=0, atol=atol)
            np.testing.assert_allclose(robot.block.B[held], B[a], rtol=0, atol=atol)
        np.testing.assert_allclose(stack_transposes(state.omega), mean[n:], rtol=0, atol=atol)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, accelerated=st.booleans())
def test_what_a_state_says_of_itself(seed: int, n: int, d: int, accelerated: bool) -> None:
    problem = varied_problem(seed, n, d)
    soc = SOC(penalty=fixed_penalty(problem), acceleration=Anderson() if accelerated else None)
    states = list(islice(iterate(soc, problem), 8))
    for k, state in enumerate(states):
        assert state.k == k
        assert orthogonality_error(state.omega).max() <= 1e-13
        poses = soc.poses(problem, state)
        np.testing.assert_array_equal(poses.R, state.omega)
        assert soc.measure(problem, state).objective == problem.objective(poses)
        if k:
            before = states[k - 1]
            root = np.sqrt(state.rho)[:, None, None]
            size = np.linalg.norm(root * state.omega)
            primal = root * (state.x - state.omega)
            assert state.primal_residual == pytest.approx(np.linalg.norm(primal) / size)
            # Row b of R_i^T is column b of R_i.
            stiff = np.maximum(1.0, root**2 / problem.M.diagonal()[n:].reshape(n, 1, d))
            change = root * (state.omega - before.omega)
            back = primal
            dual = np.hypot(np.linalg.norm(stiff * change), np.linalg.norm((stiff - 1.0) * back))
            assert state.dual_residual == pytest.approx(dual / size)
            assert state.merits[-1] == pytest.approx(
                np.linalg.norm(root * (state.x - before.omega))
            )


@settings(max_examples=examples(40))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, method=METHODS)
def test_graphs_without_noise_end_at_zero(
    seed: int, n: int, d: int, method: PartitionMethod
) -> None:
    problem = PGOProblem(exact_graph(seed, n, d))
    for robots in (None, robots_of(problem, seed, method)):
        for start in (None, problem.graph.truth):
            result = run(SOC(robots=robots), problem, start)
            assert result.status is Status.CONVERGED
            assert result.objective <= 1e-12


def test_positions_on_an_axis_leave_turns_that_cost_nothing() -> None:
    """M has zeros on its diagonal then, by which the stiffness of step (a) was a penalty over."""
    graph = exact_graph(0, 8, 3)
    on_an_axis = np.arange(8.0)[:, None] * np.eye(3)[0]
    problem = PGOProblem(graph.with_position_prior(np.arange(8), on_an_axis, tau=1.0))
    for robots in (None, partition(problem.graph, 2)):
        assert np.isfinite(run(SOC(robots=robots, max_iterations=3), problem).objective)


# Endings and settings.


def test_the_refreshed_multiplier_is_the_stationary_one() -> None:
    # At a stationary point 2 Lambda_i R_i^T + rho_i B_i = 0, which makes it a fixed point of the
    # recursion.
    problem = PGOProblem(varied_graph(0, 10, 3, LOUD_NOISE))
    best = polish(problem, chordal_start(problem))
    soc = SOC(tolerance=1e-10, max_iterations=2000)
    state = run(soc, problem, best).state
    poses = soc.poses(problem, state)
    B = np.swapaxes(state.B, 1, 2)
    expected = (
        -2.0 * multipliers(problem, poses) @ np.swapaxes(poses.R, 1, 2) / state.rho[:, None, None]
    )
    np.testing.assert_allclose(B, expected, rtol=0, atol=1e-6)
    assert relative_decrement(problem, poses) <= 1e-12


def test_couplings_follow_from_the_robots() -> None:
    graph = grid(np.random.default_rng(0))
    assert SOC().effective_coupling is Coupling.JOINT
    assert SOC(robots=partition(graph, 3)).effective_coupling is Coupling.CONSENSUS
    assert (
        SOC(coupling=Coupling.JOINT, robots=partition(graph, 1)).effective_coupling
        is Coupling.JOINT
    )


def test_robots_of_another_graph_are_refused() -> None:
    problem = varied_problem(0, 8, 3)
    for robots in (partition(varied_graph(0, 9, 3), 3), partition(varied_graph(0, 7, 3), 3)):
        for method in (SOC(robots=robots), PaperSOC(robots=robots)):
            with pytest.raises(SettingError, match="give one robot for every pose"):
                method.init(problem, None)


@pytest.mark.parametrize("num_robots", [1, 3])
def test_states_of_every_coupling_have_the_letters_of_algorithm_1(num_robots: int) -> None:
    problem = varied_problem(0, 12, 3)
    robots = partition(problem.graph, num_robots)
    plain = SOC(
        robots=robots,
        acceleration=None,
        local_passes=1,
        bytes_per_number=8,
        penalty=FixedPenalty(30.0),
    )
    for state, following in pairwise(islice(iterate(plain, problem), 6)):
        expected = state.B + following.x - following.omega  # (c)
        np.testing.assert_allclose(following.B, expected, rtol=0, atol=1e-12)
        assert orthogonality_error(following.omega).max() <= 1e-12
        assert np.abs(following.x - following.omega).max() > 1e-6
        np.testing.assert_array_equal(following.rho, np.full(12, 30.0))


def test_tolerance_is_on_both_residuals() -> None:
    soc = SOC(tolerance=1e-3)
    state = soc.init(varied_problem(0, 5, 2), None)
    assert soc.converged(state, Measurement(1.0, 1e-3, 1e-3)) is Status.CONVERGED
    assert soc.converged(state, Measurement(1.0, 2e-3, 0.0)) is None
    assert soc.converged(state, Measurement(1.0, 0.0, 2e-3)) is None
