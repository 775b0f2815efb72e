"""The relaxation with complex numbers: its optimum, its bound, and what it rounds to."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import cvxpy as cp
import numpy as np
import pytest
from budget import examples
from exact_arithmetic import ExactGraph
from graphs import SEEDS, best_known, informed, planar_lattice, random_poses, varied_graph
from hypothesis import assume, example, given, settings, strategies as st

import solvers
from pgo_models import NoiseModel, PGOProblem, Weighting
from pgo_models.certificates.certificate import BoundSource
from pgo_models.geometry.rotations import Array
from pgo_models.geometry.stiefel import project_to_tangent, retract
from pgo_models.problem.initialization import spanning_tree
from solvers import Status, certify, iterate, run
from solvers.handedness.complex_relaxation import (
    ComplexCost,
    ComplexRelaxation,
    certificates_of_relaxation,
)

LOUD = NoiseModel(0.3, 1.0)


def random_point(n: int, columns: int, seed: int) -> Array:
    Y = np.random.default_rng(seed).standard_normal((n, 1, 2 * columns))
    return np.asarray(Y / np.linalg.norm(Y, axis=2, keepdims=True))


def hermitian_matrix(problem: PGOProblem) -> Array:
    """The matrix of r alone, with the best translations: that of 16 in the paper's notation."""
    n = problem.num_poses
    E = np.zeros((3 * n, 2 * n), dtype=complex)
    k = np.arange(n)
    E[k, k] = 1.0
    E[n + 2 * k, n + k] = 1.0
    E[n + 2 * k + 1, n + k] = 1j
    M = E.conj().T @ problem.M.toarray() @ E
    M_tt = M[1:n, 1:n]
    M_tr = M[1:n, n:]
    return np.asarray(M[n:, n:] - M_tr.conj().T @ np.linalg.solve(M_tt, M_tr))


def optimum_of_sdp(problem: PGOProblem) -> float:
    n = problem.num_poses
    Q = hermitian_matrix(problem)
    W = cp.Variable((n, n), hermitian=True)
    cost = cp.Minimize(cp.real(cp.trace(0.5 * (Q + Q.conj().T) @ W)))
    program = cp.Problem(cost, [W >> 0, cp.diag(W) == 1])
    value = float(program.solve(solver=cp.CLARABEL))
    assume(program.status == cp.OPTIMAL)
    return value


@given(seed=SEEDS, n=st.integers(2, 8))
def test_one_column_is_the_cost_of_poses(seed: int, n: int) -> None:
    problem = PGOProblem(varied_graph(seed, n, 2, LOUD))
    poses = problem.at_best_translations(random_poses(n, 2, seed))
    Y = poses.R[:, :, 0].reshape(n, 1, 2)
    point = ComplexCost.of(problem).evaluate(Y)
    F = problem.objective(poses)
    assert point.value == pytest.approx(F, rel=1e-9)
    r = poses.R[:, 0, 0] - 1j * poses.R[:, 1, 0]  # conjugate, as P_i is R_i^T
    assert np.real(r @ hermitian_matrix(problem) @ r.conj()) == pytest.approx(F, rel=1e-8)


@given(seed=SEEDS, n=st.integers(2, 8), columns=st.integers(1, 4))
def test_gradient_and_hessian_are_those_of_the_cost(seed: int, n: int, columns: int) -> None:
    cost = ComplexCost.of(PGOProblem(varied_graph(seed, n, 2, LOUD)))
    point = cost.evaluate(random_point(n, columns, seed))
    V = project_to_tangent(point.Y, random_point(n, columns, seed + 1))
    slope = float(np.sum(point.gradient * V))
    curvature = float(np.sum(V * cost.hessian_product(point, V)))
    h = 1e-4
    ahead = cost.evaluate(retract(point.Y, h * V)).value
    behind = cost.evaluate(retract(point.Y, -h * V)).value
    scale = abs(point.value) + abs(slope) + abs(curvature)
    assert (ahead - behind) / (2 * h) == pytest.approx(slope, abs=1e-5 * scale)
    second = (ahead - 2 * point.value + behind) / h**2
    assert second == pytest.approx(curvature, abs=1e-3 * scale)


@pytest.mark.parametrize(("seed", "n"), [(0, 8), (3, 8), (0, 2)])  # the last two are trees
def test_what_rounding_loses_is_a_share_of_the_cost_of_poses(seed: int, n: int) -> None:
    problem = PGOProblem(varied_graph(seed, n, 2, LOUD))
    method = ComplexRelaxation()
    for state in islice(iterate(method, problem), 4):
        found = method.measure(problem, state)
        cost = problem.objective(method.poses(problem, state))
        assert found.objective == cost
        lost = found.primal_residual * max(cost, state.rounding_level)
        expected = max(cost - state.point.value, 0.0)
        assert lost == pytest.approx(expected, abs=state.rounding_level)


@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")
@settings(max_examples=examples(40))
@given(seed=SEEDS, n=st.integers(3, 9), rotation_std=st.sampled_from([0.5, 1.0, 2.0]))
@example(seed=1294109, n=3, rotation_std=0.5)  # a tree, whose least cost is zero
def test_its_optimum_is_that_of_the_semidefinite_program(
    seed: int, n: int, rotation_std: float
) -> None:
    problem = PGOProblem(varied_graph(seed, n, 2, NoiseModel(0.3, rotation_std)))
    outcome = run(ComplexRelaxation(), problem)
    assert outcome.status is Status.CONVERGED
    known = best_known(problem, seed)
    value = outcome.state.point.value
    assert value <= known * (1 + 1e-9) + 1e-9
    assert value == pytest.approx(optimum_of_sdp(problem), rel=1e-5, abs=1e-6)


@settings(max_examples=examples(40))
@given(seed=SEEDS, n=st.integers(3, 9), rotation_std=st.sampled_from([0.5, 1.0, 2.0]))
def test_its_bound_is_below_the_best_known_poses_and_close_to_its_optimum(
    seed: int, n: int, rotation_std: float
) -> None:
    problem = PGOProblem(varied_graph(seed, n, 2, NoiseModel(0.3, rotation_std)))
    method = ComplexRelaxation()
    outcome = run(method, problem)
    assume(outcome.state.point.value > 1e-6)  # else there is no cycle
    relaxed, rounded = certificates_of_relaxation(problem, method, outcome.state, 1e-6)
    of_doubles = ExactGraph.of_doubles(problem.graph)
    F = min(best_known(problem, seed), float(of_doubles.objective_of(rounded.poses)))
    assert max(relaxed.lower_bound, rounded.lower_bound) <= F * (1 + 1e-12)
    assert relaxed.lower_bound >= (1 - 1e-3) * outcome.state.point.value
    assert relaxed.source is BoundSource.COMPLEX
    assert relaxed.bound.is_complex


@settings(max_examples=examples(40))
@given(seed=SEEDS, n=st.integers(3, 9))
def test_of_a_tree_its_optimum_is_zero(seed: int, n: int) -> None:
    graph = varied_graph(seed, n, 2, LOUD)
    in_tree = np.isin(np.arange(graph.num_edges), spanning_tree(graph, 0)[2])
    problem = PGOProblem(graph.without_edges(~in_tree))
    outcome = run(ComplexRelaxation(), problem)
    assert outcome.status is Status.CONVERGED
    assert outcome.state.point.value <= outcome.state.rounding_level


@settings(max_examples=examples(24))
@given(seed=SEEDS, n=st.integers(3, 8), coupled=st.booleans())
def test_of_chi2_the_tangent_is_relaxed(seed: int, n: int, coupled: bool) -> None:
    graph = informed(seed, n, 2, coupled, 0.5, LOUD)
    problem = PGOProblem(graph, weighting=Weighting.INFORMATION)
    solution = solvers.solve(problem, progress=False)
    method = ComplexRelaxation()
    outcome = run(method, problem, solution.poses)
    for found in certificates_of_relaxation(problem, method, outcome.state, 1e-6):
        assert found.lower_bound <= solution.objective * (1 + 1e-12)


def test_what_it_rounds_to_may_be_better_poses() -> None:
    """Newton from the chordal start, prefixes and SOC ends at 116, and 61.6 is possible."""
    problem = PGOProblem(planar_lattice(19, 4, np.deg2rad(60)))
    one_start = replace(solvers.Pipeline(), other_starts=False)
    without = solvers.solve(problem, replace(one_start, handedness=None), progress=False)
    solution = solvers.solve(problem, one_start, progress=False)
    assert solution.objective < 0.6 * without.objective
    assert solution.stages[-1].name == "ComplexRelaxation"


@pytest.mark.parametrize("robots", [None, 2])
def test_the_staircase_is_left_out_where_it_could_add_nothing(robots: int | None) -> None:
    problem = PGOProblem(planar_lattice(4, 4, 0.5))
    solution = solvers.solve(problem, robots=robots, progress=False)
    assert solution.stages[-1].name.startswith("ComplexRelaxation")
    assert solution.certificate.source is BoundSource.COMPLEX
    assert solution.certificate.proven_gap < 0.01
    certificate = certify(problem, solution.poses)
    assert certificate.source is BoundSource.COMPLEX
    assert certificate.lower_bound == pytest.approx(solution.lower_bound, rel=1e-5)


def test_a_step_leaves_its_state_alone_and_the_same_start_gives_the_same_bits() -> None:
    problem = PGOProblem(planar_lattice(4, 4, 0.5))
    start = random_poses(16, 2, 0)
    states = list(islice(iterate(ComplexRelaxation(), problem, start), 6))
    again = list(islice(iterate(ComplexRelaxation(), problem, start), 6))
    for k, (state, other) in enumerate(zip(states, again, strict=True)):
        assert state.k == k
        np.testing.assert_array_equal(state.point.Y, other.point.Y)
    method = ComplexRelaxation()
    before = states[2].point.Y.copy()
    method.step(problem, states[2])
    np.testing.assert_array_equal(states[2].point.Y, before)


def test_limits_are_reported() -> None:
    problem = PGOProblem(planar_lattice(4, 4, 0.5))
    assert run(ComplexRelaxation(max_iterations=2), problem).status is Status.MAX_ITERATIONS
    assert run(ComplexRelaxation(), problem, time_limit=1e-9).status is Status.TIME_LIMIT
