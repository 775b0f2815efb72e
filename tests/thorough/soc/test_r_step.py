import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, SEEDS, SIZES, translation_scale, varied_problem
from hypothesis import given, settings, strategies as st

from pgo_models import PGOProblem, PoseGraph
from pgo_models.geometry.rotations import Array
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.stationarity import rotation_scale
from solvers import RStep
from solvers.soc.r_step import RSubproblem, prepare

AGREEMENT = 1e-8  # the contract of the back ends


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


@pytest.mark.parametrize("back_end", [RStep.FACTORIZED, RStep.FISTA])
@pytest.mark.parametrize("backend", CholeskyBackend)
@settings(max_examples=examples(10))
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


@settings(max_examples=examples(15))
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
