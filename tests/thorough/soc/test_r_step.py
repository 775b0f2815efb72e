from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, SEEDS, SIZES, translation_scale, varied_problem
from hypothesis import given, settings, strategies as st
from scipy.sparse import csr_array

from pgo_models import PartitionMethod, PGOProblem, PoseGraph
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.partitioning import Partition, partition
from pgo_models.graphs.scenes import circle, grid, sphere
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.stationarity import rotation_scale
from solvers import SOC, FixedPenalty, MultiplierPenalty, PaperSOC, RStep
from solvers.soc.consensus import LocalConsensus
from solvers.soc.penalty import first_penalties
from solvers.soc.r_step import RSubproblem, _largest_eigenvalue_bound, prepare

AGREEMENT = 1e-8  # the contract of the back ends
SCENES = {"circle": circle, "grid": grid, "sphere": sphere}


def subproblem_of(problem: PGOProblem, penalty: Array) -> RSubproblem:
    A, w = problem.residual_matrix
    return RSubproblem(
        A, w, problem.M, problem.d, problem.num_poses, penalty, problem.analysis, problem.backend
    )


def random_penalty(problem: PGOProblem, rng: np.random.Generator, translations: bool) -> Array:
    """Penalties from a hundredth to ten times the diagonal of M."""
    rho = rotation_scale(problem) * 10.0 ** rng.uniform(-2, 1, problem.num_poses)
    rho_t = (
        translation_scale(problem) * 10.0 ** rng.uniform(-2, 1, problem.num_poses) * translations
    )
    return np.concatenate([rho_t, np.repeat(rho, problem.d)])


def largest_difference(solutions: list[Array]) -> float:
    return max(float(np.abs(solution - solutions[0]).max()) for solution in solutions)


@pytest.mark.parametrize("back_end", [RStep.FACTORIZED, RStep.FISTA, RStep.NESTEROV])
@pytest.mark.parametrize("backend", CholeskyBackend)
@settings(max_examples=examples(40))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, translations=st.booleans())
def test_the_solution_satisfies_the_normal_equations(
    back_end: RStep, backend: CholeskyBackend, seed: int, n: int, d: int, translations: bool
) -> None:
    problem = PGOProblem(varied_problem(seed, n, d).graph, backend)
    rng = np.random.default_rng(seed)
    penalty = random_penalty(problem, rng, translations)
    step = prepare(subproblem_of(problem, penalty), back_end)
    K = problem.M.toarray() + 0.5 * np.diag(penalty)
    for _ in range(2):
        V = rng.standard_normal((problem.side, d))
        X = step.solve(V)
        assert np.abs(K @ X - 0.5 * penalty[:, None] * V).max() <= 1e-9 * np.abs(K).max() * (
            1 + np.abs(X).max()
        )
        if not translations:
            np.testing.assert_allclose(X[0], 0.0, rtol=0, atol=1e-12)


@settings(max_examples=examples(25))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, translations=st.booleans())
def test_the_back_ends_agree_on_random_graphs(
    seed: int, n: int, d: int, translations: bool
) -> None:
    problem = varied_problem(seed, n, d)
    rng = np.random.default_rng(seed)
    subproblem = subproblem_of(problem, random_penalty(problem, rng, translations))
    V = rng.standard_normal((problem.side, d))
    assert (
        largest_difference([prepare(subproblem, back_end).solve(V) for back_end in RStep])
        <= AGREEMENT
    )


@pytest.mark.parametrize("translations", [False, True])
@pytest.mark.parametrize("name", [*SCENES, "tinyGrid3D", "smallGrid3D"])
def test_the_back_ends_agree_on_whole_graphs(
    name: str, translations: bool, request: pytest.FixtureRequest
) -> None:
    problem = problem_named(name, request)
    rho = first_penalties(MultiplierPenalty(), problem, chordal_start(problem))
    rho_t = 0.1 * translation_scale(problem) * translations
    subproblem = subproblem_of(problem, np.concatenate([rho_t, np.repeat(rho, 3)]))
    rng = np.random.default_rng(0)
    steps = [prepare(subproblem, back_end) for back_end in RStep]
    for _ in range(3):
        V = rng.standard_normal((problem.side, 3))
        assert largest_difference([step.solve(V) for step in steps]) <= AGREEMENT


@pytest.mark.parametrize(
    ("num_robots", "method"),
    [(1, PartitionMethod.CONTIGUOUS), (3, PartitionMethod.CONTIGUOUS), (3, PartitionMethod.METIS)],
)
@pytest.mark.parametrize("name", [*SCENES, "tinyGrid3D", "smallGrid3D"])
def test_the_back_ends_agree_on_the_shares_of_a_team(
    name: str, num_robots: int, method: PartitionMethod, request: pytest.FixtureRequest
) -> None:
    problem = problem_named(name, request)
    assert_teams_agree(problem, partition(problem.graph, num_robots, method))


@pytest.mark.parametrize("name", ["grid", "tinyGrid3D"])
def test_the_back_ends_agree_with_one_pose_a_robot(
    name: str, request: pytest.FixtureRequest
) -> None:
    problem = problem_named(name, request)
    assert_teams_agree(problem, partition(problem.graph, method=PartitionMethod.SINGLETONS))


@pytest.mark.parametrize("num_robots", [1, 4, None])
@pytest.mark.parametrize("name", [*SCENES, "tinyGrid3D", "smallGrid3D"])
def test_the_back_ends_agree_on_the_paper_s_blocks(
    name: str, num_robots: int | None, request: pytest.FixtureRequest
) -> None:
    problem = problem_named(name, request)
    robots = None if num_robots is None else partition(problem.graph, num_robots)
    rule = FixedPenalty(0.3 * float(problem.L.diagonal().mean()))
    start = chordal_start(problem)
    steps = [PaperSOC(robots, rule, back_end).init(problem, start).r_step for back_end in RStep]
    rng = np.random.default_rng(0)
    for _ in range(3):
        V = rng.standard_normal((3 * problem.num_poses, 3))
        assert largest_difference([step.solve(V) for step in steps]) <= AGREEMENT


@pytest.mark.parametrize("d", [2, 3])
def test_measurements_without_a_turn_hide_nothing_from_the_gradients(d: int) -> None:
    # The eigenvector that an estimate of the Lipschitz constant starts from is orthogonal to the
    # one it looks for.
    i = np.arange(5)
    turn = np.broadcast_to(np.eye(d), (5, d, d))
    problem = PGOProblem(PoseGraph(6, i, i + 1, turn, np.zeros((5, d)), np.ones(5), np.ones(5)))
    subproblem = subproblem_of(problem, np.concatenate([np.zeros(6), np.full(6 * d, 1e-2)]))
    V = np.random.default_rng(0).standard_normal((problem.side, d))
    assert (
        largest_difference([prepare(subproblem, back_end).solve(V) for back_end in RStep])
        <= AGREEMENT
    )


@pytest.mark.parametrize("translation_penalty", [0.0, 1e4])
@pytest.mark.parametrize(("d", "num_poses"), [(2, 400), (3, 100)])
def test_a_loop_along_a_diagonal_hides_nothing_from_the_gradients(
    d: int, num_poses: int, translation_penalty: float
) -> None:
    # There and back along (1, -1, 0): the top eigenvectors are orthogonal to ones, and the stiff
    # edge tops all others.
    i = np.arange(num_poses)
    kappa = np.ones(num_poses)
    kappa[num_poses // 3] = 4.0
    t_ij = np.zeros((num_poses, d))
    t_ij[:, 0] = 1.6 * np.where(i < num_poses // 2, 1.0, -1.0)
    t_ij[:, 1] = -t_ij[:, 0]
    turn = np.broadcast_to(np.eye(d), (num_poses, d, d))
    problem = PGOProblem(
        PoseGraph(num_poses, i, (i + 1) % num_poses, turn, t_ij, kappa, np.ones(num_poses))
    )
    penalty = np.concatenate([np.full(num_poses, translation_penalty), np.ones(num_poses * d)])
    subproblem = subproblem_of(problem, penalty)
    V = np.random.default_rng(0).standard_normal((problem.side, d))
    assert (
        largest_difference([prepare(subproblem, back_end).solve(V) for back_end in RStep])
        <= AGREEMENT
    )


@given(
    seed=SEEDS, side=st.integers(1, 20), density=st.floats(0.0, 1.0), exponent=st.integers(-12, 12)
)
def test_the_lipschitz_constant_is_a_bound(
    seed: int, side: int, density: float, exponent: int
) -> None:
    rng = np.random.default_rng(seed)
    factor = rng.standard_normal((side, side)) * (rng.uniform(size=(side, side)) < density)
    H = factor @ factor.T * 10.0**exponent + 0.5 * np.eye(side)
    bound = _largest_eigenvalue_bound(csr_array(H))
    assert np.linalg.eigvalsh(H)[-1] <= bound * (1 + 64 * np.finfo(float).eps)
    assert bound <= np.abs(H).sum(axis=1).max() * (1 + 64 * np.finfo(float).eps)  # Gershgorin


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_a_shift_that_is_optimal_is_returned(seed: int, n: int, d: int) -> None:
    # X(V) = V where the residuals vanish: the poses themselves are then the minimiser.
    graph = varied_problem(seed, n, d).graph
    assert graph.truth is not None
    R_inverse = np.swapaxes(graph.truth.R[graph.i], 1, 2)
    t_ij = np.einsum("mab,mb->ma", R_inverse, graph.truth.t[graph.j] - graph.truth.t[graph.i])
    exact = PGOProblem(
        PoseGraph(
            n, graph.i, graph.j, R_inverse @ graph.truth.R[graph.j], t_ij, graph.kappa, graph.tau
        )
    )
    penalty = random_penalty(exact, np.random.default_rng(seed), translations=True)
    V = graph.truth.stacked()
    X = prepare(subproblem_of(exact, penalty), RStep.FACTORIZED).solve(V)
    np.testing.assert_allclose(X, V, rtol=0, atol=1e-9 * (1 + np.abs(V).max()))


def test_K_is_M_plus_half_the_penalty_grounded_where_needed() -> None:
    problem = varied_problem(0, 6, 3)
    rng = np.random.default_rng(0)
    for translations in (False, True):
        penalty = random_penalty(problem, rng, translations)
        subproblem = subproblem_of(problem, penalty)
        assert subproblem.needs_ground is not translations
        expected = problem.M.toarray() + 0.5 * np.diag(penalty)
        if not translations:
            expected[0, 0] *= 2
        np.testing.assert_allclose(subproblem.matrix.toarray(), expected, rtol=1e-15, atol=0)
        np.testing.assert_array_equal(subproblem.matrix.indices, problem.M.indices)


def problem_named(name: str, request: pytest.FixtureRequest) -> PGOProblem:
    if name in SCENES:
        return PGOProblem(SCENES[name](np.random.default_rng(0)))
    load: Callable[[str], PGOProblem] = request.getfixturevalue("benchmark_problem")
    return load(name)


def assert_teams_agree(problem: PGOProblem, robots: Partition) -> None:
    start = chordal_start(problem)
    rng = np.random.default_rng(0)
    soc = SOC(robots=robots, translation_penalty=0.1, separator_penalty=0.0)
    teams = [
        LocalConsensus(replace(soc, r_step=back_end)).init(problem, start).robots
        for back_end in RStep
    ]
    for same in zip(*teams, strict=True):
        held = same[0].layout.held
        shift = np.where(held, rng.standard_normal(same[0].block.omega.shape), 0.0)
        steps = [robot.step_a for robot in same if robot.step_a is not None]
        assert largest_difference([step.solve(shift)[held[:, 0]] for step in steps]) <= AGREEMENT
