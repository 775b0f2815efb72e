"""The cost that grows edge by edge, beside that of the whole problem."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from graphs import exact_graph, varied_graph

from pgo_models.geometry.twists import moved_by_twists
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.scenes import random_geometric
from pgo_models.problem.growing_cost import GrowingCost
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.matrices import isotropic_weights
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting


def quadratic(d: int) -> PoseGraph:
    """A graph whose chi2 is quadratic: only the rotations have axes of their own."""
    graph = varied_graph(4, 30, d)
    root = 0.3 * np.random.default_rng(4).normal(size=(graph.num_edges, d, d)) + 2.0 * np.eye(d)
    information = np.tile(np.diag(np.arange(1.0, d * (d + 1) // 2 + 1)), (graph.num_edges, 1, 1))
    information[:, :d, :d] = graph.tau[:, None, None] * np.eye(d)
    if d == 3:
        information[:, d:, d:] = root @ np.swapaxes(root, 1, 2)
    return replace(graph, information=information)


def halves(problem: PGOProblem) -> GrowingCost:
    """The cost of a problem, its edges in two parts."""
    graph = problem.graph
    is_first = np.arange(graph.num_edges) % 3 > 0
    parts = [graph.without_edges(~is_first), graph.without_edges(is_first)]
    costs = []
    for part, chosen in zip(parts, (is_first, ~is_first), strict=True):
        costs.append(GrowingCost.of(part, problem.weights.of_edges(chosen)))
    return costs[0].with_edges(costs[1], np.arange(graph.num_poses), graph.num_poses)


@pytest.mark.parametrize("weighting", [Weighting.ISOTROPIC, Weighting.INFORMATION])
@pytest.mark.parametrize("d", [2, 3])
def test_value_and_gradient_are_those_of_the_problem(d: int, weighting: Weighting) -> None:
    problem = PGOProblem(quadratic(d), weighting=weighting)
    assert problem.is_quadratic
    poses = chordal_start(problem.convex_part)
    cost = halves(problem)
    value, gradient = cost.evaluate(poses.R, poses.t)
    assert value == pytest.approx(problem.objective(poses), rel=1e-12)
    # Taylor: the error of the slope along a twist falls with the square of its length
    twist = np.random.default_rng(0).normal(size=gradient.shape)
    errors = []
    for length in (1e-3, 1e-4):
        moved = moved_by_twists(poses.R, poses.t, length * twist[:, :d], length * twist[:, d:])
        change = cost.evaluate(*moved)[0] - value
        errors.append(abs(change - length * np.sum(gradient * twist)))
    assert errors[1] == pytest.approx(errors[0] / 100.0, rel=0.1)


@pytest.mark.parametrize("d", [2, 3])
def test_where_edges_fit_the_springs_are_the_hessian(d: int) -> None:
    rng = np.random.default_rng(2)
    graph = exact_graph(2, 12, d)
    assert graph.truth is not None
    R = graph.truth.R
    t = graph.truth.t
    cost = GrowingCost.of(graph, isotropic_weights(graph))
    edges = np.arange(cost.num_edges)
    hessian = riemannian_hessian(PGOProblem(graph).at(graph.truth), None)
    twist = rng.normal(size=(12, d * (d + 1) // 2))
    difference = twist[cost.i] - twist[cost.j]
    by_springs = np.einsum("ma,mab,mb->", difference, cost.stiffness(R, t, edges), difference)
    # the same move in the unknowns of the Hessian, by its derivative
    step = 1e-6
    moved_R, moved_t = moved_by_twists(R, t, step * twist[:, :d], step * twist[:, d:])
    from_R = np.swapaxes(R, 1, 2) @ moved_R
    w = np.stack([from_R[:, 1, 0]], axis=1)
    if d == 3:
        w = np.stack([from_R[:, 2, 1], from_R[:, 0, 2], from_R[:, 1, 0]], axis=1)
    move = TangentLayout(12, d).join(w, moved_t - t) / step
    assert by_springs == pytest.approx(move @ (hessian @ move), rel=1e-4)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1e-3, 1.0, 6.0])
def test_one_twist_moves_all_poses_as_a_rigid_body(d: int, angle: float) -> None:
    graph = random_geometric(8, np.random.default_rng(1), d=d)
    assert graph.truth is not None
    twist = np.random.default_rng(0).normal(size=d * (d + 1) // 2)
    v = np.tile(twist[:d], (8, 1))
    w = np.tile(angle * twist[d:] / np.linalg.norm(twist[d:]), (8, 1))
    R, t = moved_by_twists(graph.truth.R, graph.truth.t, v, w)
    cost = GrowingCost.of(graph, isotropic_weights(graph))
    before = cost.evaluate(graph.truth.R, graph.truth.t)[0]
    assert cost.evaluate(R, t)[0] == pytest.approx(before, rel=1e-10)
    # and back again
    R_back, t_back = moved_by_twists(R, t, -v, -w)
    np.testing.assert_allclose(R_back, graph.truth.R, rtol=0, atol=1e-12)
    np.testing.assert_allclose(t_back, graph.truth.t, rtol=0, atol=1e-11)
