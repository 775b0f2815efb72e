import cvxpy as cp
import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, SEEDS, random_poses, varied_problem
from hypothesis import given, settings, strategies as st

from pgo_models import ModelChange, PGOProblem, graph_qp
from pgo_models.convex.graph_subproblem import PoseVariables, Unknowns
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from solvers import RStep
from solvers.soc.r_step import RSubproblem, prepare

ACCURACY = 1e-8


def drawn(seed: int, n: int, d: int) -> tuple[PGOProblem, Array, Array]:
    """A problem, penalties of the size of its diagonal, and a shift near its poses."""
    problem = varied_problem(seed, n, d)
    rng = np.random.default_rng(seed)
    rho = float(np.median(problem.M.diagonal())) * np.exp(0.3 * rng.standard_normal(n))
    V = random_poses(n, d, seed).stacked()
    return problem, rho, V + 0.1 * rng.standard_normal(V.shape)


@settings(max_examples=examples(10))
@given(seed=SEEDS, n=st.integers(3, 10), d=DIMENSIONS)
def test_the_joint_program_is_the_factorised_step(seed: int, n: int, d: int) -> None:
    problem, rho, V = drawn(seed, n, d)
    A, w = problem.residual_matrix
    D = np.concatenate([np.zeros(n), np.repeat(rho, d)])
    subproblem = RSubproblem(A, w, problem.M, d, n, D, problem.analysis, problem.backend)
    step = prepare(subproblem, RStep.FACTORIZED)
    X = graph_qp(problem.graph, rho).solve(V)
    np.testing.assert_allclose(X[n:], step.solve(V)[n:], rtol=0, atol=ACCURACY)
    # The translations are the best ones for these rotations: the gradient in them is zero.
    gradient_in_t = problem.M[:n] @ X
    scale = float(problem.M.diagonal().max())
    np.testing.assert_allclose(gradient_in_t, 0.0, rtol=0, atol=ACCURACY * scale)


@settings(max_examples=examples(10))
@given(seed=SEEDS, n=st.integers(3, 10), d=DIMENSIONS)
def test_the_rotation_program_solves_its_normal_equations(seed: int, n: int, d: int) -> None:
    problem, rho, V = drawn(seed, n, d)
    X = graph_qp(problem.graph, rho, Unknowns.ROTATIONS).solve(V[n:])
    half = 0.5 * np.repeat(rho, d)
    expected = np.linalg.solve(problem.L.toarray() + np.diag(half), half[:, None] * V[n:])
    np.testing.assert_allclose(X, expected, rtol=0, atol=ACCURACY)


@settings(max_examples=examples(10))
@given(seed=SEEDS, n=st.integers(3, 8), d=DIMENSIONS)
def test_the_named_views_are_the_poses_and_residuals(seed: int, n: int, d: int) -> None:
    problem, rho, _ = drawn(seed, n, d)
    graph = problem.graph
    poses = random_poses(n, d, seed)
    seen: list[PoseVariables] = []

    def look(unknown: PoseVariables) -> ModelChange:
        seen.append(unknown)
        return ModelChange()

    qp = graph_qp(graph, rho, changer=look)
    cost = qp.cost(poses.stacked())
    assert cost == pytest.approx(problem.objective(poses), rel=1e-12)
    total = 0.0
    for e in range(graph.num_edges):
        total += graph.kappa[e] * float(np.sum(seen[0].rotation_residual(e).value ** 2))
        total += graph.tau[e] * float(np.sum(seen[0].translation_residual(e).value ** 2))
    assert total == pytest.approx(cost, rel=1e-10)
    np.testing.assert_array_equal(seen[0].R(1).value, poses.R[1])
    np.testing.assert_array_equal(seen[0].t(n - 1).value, poses.t[n - 1])


@settings(max_examples=examples(10))
@given(seed=SEEDS, n=st.integers(3, 8), d=DIMENSIONS)
def test_many_at_once_are_one_after_the_other(seed: int, n: int, d: int) -> None:
    problem, rho, _ = drawn(seed, n, d)
    seen: list[PoseVariables] = []
    graph_qp(problem.graph, rho, changer=lambda unknown: seen.append(unknown) or ModelChange())
    (unknown,) = seen
    unknown.X.value = random_poses(n, d, seed).stacked()
    rng = np.random.default_rng(seed)
    for stack, count in (
        (unknown.R, n),
        (unknown.t, n),
        (unknown.rotation_residual, problem.graph.num_edges),
        (unknown.translation_residual, problem.graph.num_edges),
    ):
        one_by_one = np.stack([stack[number].value for number in range(count)])
        mask = (rng.random(count) < 0.5) | (np.arange(count) == 0)
        for which in (rng.permutation(count), mask, slice(1, None), [count - 1, 0], slice(None)):
            np.testing.assert_allclose(stack[which].value, one_by_one[which], rtol=0, atol=1e-14)
        assert stack[-1].shape == one_by_one.shape[1:]


def test_replaced_edges_leave_the_cost() -> None:
    problem, rho, _ = drawn(2, 6, 3)
    poses = random_poses(6, 3, 2)
    qp = graph_qp(problem.graph, rho, changer=lambda unknown: ModelChange(replaced_edges=[0, 3]))
    costs = problem.edge_costs(poses)
    expected = float(costs.sum() - costs[0] - costs[3])
    assert qp.cost(poses.stacked()) == pytest.approx(expected, rel=1e-12)


def test_what_is_not_there_is_named() -> None:
    problem, rho, _ = drawn(3, 6, 2)

    def translation(unknown: PoseVariables) -> ModelChange:
        return ModelChange(terms=[cp.sum_squares(unknown.t(0))])

    def concave(unknown: PoseVariables) -> ModelChange:
        return ModelChange(terms=[-cp.sum_squares(unknown.t(0))])

    with pytest.raises(SettingError, match=r"\[0\] needs translations.* Unknowns\.POSES"):
        graph_qp(problem.graph, rho, Unknowns.ROTATIONS, translation)
    with pytest.raises(SettingError, match="not convex"):
        graph_qp(problem.graph, rho, changer=concave)


@pytest.mark.parametrize("value", [-1.0, 0.0, np.nan])
def test_penalties_must_not_be_negative_nor_all_zero(value: float) -> None:
    problem, rho, _ = drawn(3, 6, 2)
    with pytest.raises(SettingError, match="must not be negative, and one must be positive"):
        graph_qp(problem.graph, value)
    with pytest.raises(SettingError, match="one for each of 6 poses"):
        graph_qp(problem.graph, rho[1:])


def test_edges_are_replaced_by_number_by_array_or_by_mask() -> None:
    mask = np.array([False, True, False, True])
    for edges in ([1, 3], range(1, 4, 2), np.array([1, 3]), mask):
        assert ModelChange(replaced_edges=edges).replaced_edges == (1, 3)
    assert ModelChange().replaced_edges == ()
