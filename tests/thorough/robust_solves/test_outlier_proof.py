"""What is proven of closures holds for every choice of them, tried one by one on small graphs."""

from __future__ import annotations

from dataclasses import replace
from itertools import chain, combinations

import numpy as np
import pytest
from graphs import informed
from hypothesis import given, settings, strategies as st

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel
from pgo_models.errors import SettingError
from solvers import polish
from solvers.robust.revision import truncated_cost
from solvers.robust_solves.closure_costs import isotropic_below, precisions_below


def walk_with_closures(
    seed: int, d: int, num_right: int, num_wrong: int, noise: float
) -> tuple[pgo.PoseGraph, np.ndarray]:
    """A walk with right closures and wrong ones, and which edges are wrong."""
    rng = np.random.default_rng(seed)
    level = NoiseModel(noise, noise)
    graph = pgo.grid_world(1, 14, rng, d=d, loop_closure_probability=0.0, noise=level)
    chain_alone = graph.without_edges(np.abs(graph.i - graph.j) != 1)
    truth = graph.truth
    i = rng.integers(0, 6, num_right + num_wrong)
    j = rng.integers(8, 14, num_right + num_wrong)
    back = np.swapaxes(truth.R[i], 1, 2)
    R = back @ truth.R[j]
    t = np.einsum("mab,mb->ma", back, truth.t[j] - truth.t[i])
    t[num_right:] += rng.uniform(2.0, 9.0, (num_wrong, d))
    kappa, tau = chain_alone.kappa[0], chain_alone.tau[0]
    spoiled = chain_alone.with_edges(i, j, pgo.Poses(R, t), kappa, tau)
    return spoiled, np.arange(spoiled.num_edges) >= chain_alone.num_edges + num_right


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    d=st.sampled_from([2, 3]),
    num_right=st.integers(0, 2),
    num_wrong=st.integers(1, 3),
    noise=st.sampled_from([0.01, 0.05, 0.3]),
)
def test_no_choice_of_closures_contradicts_the_proof(
    seed: int, d: int, num_right: int, num_wrong: int, noise: float
) -> None:
    graph, _ = walk_with_closures(seed, d, num_right, num_wrong, noise)
    known = solvers.Known.ODOMETRY  # every choice of closures beside it joins the poses
    solution = solvers.prove_outliers(solvers.solve(graph, robust=solvers.GNC(known=known)))
    robust = solution.robust
    proof = robust.proof
    problem = robust.problem
    thresholds = robust.threshold_scale * pgo.chi2_thresholds(problem, robust.quantile)
    at_answer = truncated_cost(problem, robust.known, thresholds, solution.poses)
    assert proof.truncated_cost_bound <= at_answer <= proof.truncated_cost
    closures = np.flatnonzero(~robust.known)
    subsets = chain.from_iterable(combinations(closures, k) for k in range(len(closures) + 1))
    for kept in subsets:
        chosen = robust.known.copy()
        chosen[list(kept)] = True
        inliers = pgo.PGOProblem(graph.without_edges(~chosen), weighting=problem.weighting)
        poses = polish(inliers, solution.poses)
        cost = truncated_cost(problem, robust.known, thresholds, poses)
        assert cost >= proof.truncated_cost_bound
        if cost <= at_answer:
            is_kept = ~robust.known & (problem.edge_costs(poses) <= thresholds)
            assert not (is_kept & proof.proven_wrong).any()
            assert is_kept.sum() <= proof.most_closures


def test_wrong_closures_of_good_odometry_are_proven_wrong_and_right_ones_are_not() -> None:
    graph, is_wrong = walk_with_closures(3, 2, 3, 5, 0.01)
    solution = solvers.prove_outliers(solvers.solve(graph, robust=solvers.GNC()))
    proof = solution.robust.proof
    np.testing.assert_array_equal(proof.proven_wrong, is_wrong)
    assert (proof.most_closures, proof.num_kept) == (3, 3)
    assert proof.is_complete
    text = str(solution)
    assert "5 of 8 closures are proven wrong" in " ".join(text.split())
    assert "rejected, proven wrong on the condition that follows" in " ".join(text.split())
    record = solution.as_json()["robust"]
    assert record["proven_wrong"] == np.flatnonzero(is_wrong).tolist()
    assert record["most_closures"] == 3
    assert 0.0 < record["truncated_cost_bound"] <= record["truncated_cost_at_most"]


def test_where_odometry_can_follow_everything_nothing_is_proven() -> None:
    graph, _ = walk_with_closures(0, 2, 2, 1, 1.0)
    proof = solvers.prove_outliers(solvers.solve(graph, robust=solvers.GNC())).robust.proof
    assert not proof.proven_wrong.any()
    assert proof.truncated_cost_bound == 0.0
    assert "the known inliers may be able to follow every one" in str(proof)


def test_a_proof_that_is_out_of_time_says_so() -> None:
    graph, is_wrong = walk_with_closures(3, 2, 3, 5, 0.1)
    solution = solvers.solve(graph, robust=solvers.GNC())
    proof = solvers.prove_outliers(solution, time_limit=1e-9).robust.proof
    assert not proof.is_complete
    assert not proof.proven_wrong.any()
    assert proof.most_closures == 8
    assert "the time did not suffice to try all" in str(proof)
    proof = solvers.prove_outliers(solution).robust.proof
    assert proof.is_complete
    np.testing.assert_array_equal(proof.proven_wrong, is_wrong)
    with pytest.raises(SettingError, match=r"give solve\(.., robust=GNC\(\)\)"):
        solvers.prove_outliers(solvers.solve(graph))


def test_between_two_robots_one_closure_against_many_is_proven_wrong() -> None:
    """It costs nothing by itself; what it excludes is more than any map as good can give up."""
    rng = np.random.default_rng(0)
    t = np.zeros((20, 2))
    t[:, 0] = np.tile(np.arange(10), 2)
    t[10:, 1] = 3.0
    steps = [(a, a + 1) for a in range(19) if a != 9]
    i, j = np.array([*steps, *((k, 10 + k) for k in (0, 2, 4, 6, 8)), (3, 13)]).T
    measured = t[j] - t[i] + 0.005 * rng.standard_normal((len(i), 2))
    measured[-1] += (40.0, 30.0)
    R = pgo.exp_map(0.005 * rng.standard_normal((len(i), 1)))
    ones = np.ones(len(i))
    graph = pgo.PoseGraph(20, i, j, R, measured, 2e4 * ones, 4e4 * ones)
    graph = graph.with_robots(np.repeat([0, 1], 10))
    proof = solvers.prove_outliers(solvers.solve(graph, robust=solvers.GNC())).robust.proof
    assert np.flatnonzero(proof.proven_wrong).tolist() == [len(i) - 1]
    assert (proof.most_closures, proof.num_kept) == (5, 5)


@pytest.mark.parametrize("world", [30, 0])
def test_priors_are_closures_wherever_the_pose_of_the_world_stands(world: int) -> None:
    rng = np.random.default_rng(0)
    body = np.delete(np.arange(31), world)
    t = np.zeros((31, 2))
    t[body, 0] = np.arange(30)
    pairs = [(body[k], body[k + 1]) for k in range(29)] + [(world, body[3]), (world, body[20])]
    i, j = np.array([*pairs, (body[2], body[25]), (body[4], body[29])]).T
    measured = t[j] - t[i] + 0.01 * rng.standard_normal((len(i), 2))
    measured[-2:] += (4.0, 0.0)
    R = pgo.exp_map(0.01 * rng.standard_normal((len(i), 1)))
    ones = np.ones(len(i))
    graph = pgo.PoseGraph(31, i, j, R, measured, 2e3 * ones, 4e3 * ones, world=world)
    proof = solvers.prove_outliers(solvers.solve(graph, robust=solvers.GNC())).robust.proof
    assert np.flatnonzero(proof.proven_wrong).tolist() == [31, 32]


def test_priors_that_all_contradict_odometry_are_counted_as_far_as_they_hold_the_map() -> None:
    graph = pgo.grid_world(1, 30, np.random.default_rng(0), d=2)
    graph = graph.without_edges(np.abs(graph.i - graph.j) != 1)
    far = graph.truth.t[[0, 20]] + np.array([[0.0, 0.0], [80.0, 0.0]])
    graph = graph.with_position_prior(np.array([0, 20]), far, 1e4)
    proof = solvers.prove_outliers(solvers.solve(graph, robust=solvers.GNC())).robust.proof
    assert proof.truncated_cost_bound <= proof.truncated_cost


def test_of_rotations_alone_no_offset_proves_anything() -> None:
    """The closure turns as it should; how far it says that its ends lie apart costs nothing."""
    chain = pgo.grid_world(1, 30, np.random.default_rng(0), d=2)
    chain = chain.without_edges(np.abs(chain.i - chain.j) != 1)
    turn = chain.truth.R[2].T @ chain.truth.R[25]
    far = pgo.Poses(turn[None], np.array([[300.0, 400.0]]))
    graph = chain.with_edges(np.array([2]), np.array([25]), far, 1e4, 1e4)
    for given_graph in (graph, replace(graph, information=None)):
        problem = pgo.PGOProblem(given_graph, weighting=pgo.Weighting.ROTATIONS)
        assert not precisions_below(problem)[0].any()
        solution = solvers.prove_outliers(solvers.solve(problem, robust=solvers.GNC()))
        assert not solution.robust.rejected.any()
        assert not solution.robust.proof.proven_wrong.any()


def test_a_matrix_that_rounding_hides_elsewhere_takes_no_proof_away() -> None:
    chain = pgo.grid_world(1, 30, np.random.default_rng(0), d=2)
    chain = chain.without_edges(np.abs(chain.i - chain.j) != 1)
    far = pgo.Poses(np.eye(2)[None], np.array([[30.0, 40.0]]))
    graph = chain.with_edges(np.array([2]), np.array([25]), far, 1e4, 1e4)
    information = np.tile(np.diag([1e4, 1e4, 2e4]), (graph.num_edges, 1, 1))
    information[28, [0, 2], [2, 0]] = (1.0 - 1e-9) * np.sqrt(2e8)
    problem = pgo.PGOProblem(
        replace(graph, information=information), weighting=pgo.Weighting.INFORMATION
    )
    solution = solvers.prove_outliers(solvers.solve(problem, robust=solvers.GNC()))
    assert np.flatnonzero(solution.robust.proof.proven_wrong).tolist() == [graph.num_edges - 1]


def test_of_matrices_that_are_singular_or_hidden_other_edges_keep_their_precisions() -> None:
    graph = informed(3, 12, 2, coupled=True, spread=2.0, noise=NoiseModel(0.1, 0.1))
    expected = precisions_below(pgo.PGOProblem(graph, weighting=pgo.Weighting.INFORMATION))
    information = graph.information.copy()
    information[[2, 7]] = np.diag([1e4, 1e4, 2e4])
    information[2, [0, 2], [2, 0]] = np.sqrt(2e8)  # singular
    information[7, [0, 2], [2, 0]] = (1.0 - 1e-9) * np.sqrt(2e8)  # hidden
    spoiled = pgo.PGOProblem(
        replace(graph, information=information), weighting=pgo.Weighting.INFORMATION
    )
    others = np.delete(np.arange(graph.num_edges), [2, 7])
    for found, known in zip(precisions_below(spoiled), expected, strict=True):
        assert (known > 0.0).all()
        np.testing.assert_allclose(found[others], known[others], rtol=1e-9)
        assert found[2] == 0.0


def test_the_precisions_are_those_of_an_f_below_chi2() -> None:
    graph = informed(3, 12, 3, coupled=False, spread=2.0, noise=NoiseModel(0.5, 0.5))
    problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.INFORMATION)
    kappa, tau = precisions_below(problem)
    assert kappa.shape == tau.shape == (graph.num_edges,)
    rng = np.random.default_rng(0)
    below = pgo.PGOProblem(replace(graph.with_weights(kappa, tau), information=None))
    for spread in (1e-3, 1.0):
        R = graph.truth.R @ pgo.exp_map(spread * rng.standard_normal((12, 3)))
        poses = replace(graph.truth, R=R, t=graph.truth.t + spread * rng.standard_normal((12, 3)))
        assert (below.edge_costs(poses) <= problem.edge_costs(poses) * (1 + 1e-12)).all()


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("d", [2, 3])
def test_the_isotropic_cost_is_below_chi2_at_all_poses(d: int, coupled: bool) -> None:
    graph = informed(3, 12, d, coupled=coupled, spread=2.0, noise=NoiseModel(0.5, 0.5))
    problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.INFORMATION)
    below = isotropic_below(problem)
    assert (below.graph.tau > 0.0).any()
    rng = np.random.default_rng(0)
    for spread in (1e-3, 0.1, 1.0, 10.0):
        R = graph.truth.R @ pgo.exp_map(spread * rng.standard_normal((12, 2 * d - 3)))
        poses = replace(graph.truth, R=R, t=graph.truth.t + spread * rng.standard_normal((12, d)))
        assert (below.edge_costs(poses) <= problem.edge_costs(poses) * (1 + 1e-12)).all()


def test_odometry_that_cycles_contradict_and_the_answer_keeps_counts_in_full() -> None:
    graph = pgo.grid_world(1, 60, np.random.default_rng(0), d=2, loop_closure_probability=0.1)
    rng = np.random.default_rng(0)
    i = rng.integers(0, 45, 11)
    j = i + rng.integers(11, 15, 11)
    gross = pgo.Poses(pgo.random_rotations(11, 2, rng), rng.uniform(-16.0, 16.0, (11, 2)))
    spoiled = graph.with_edges(i, j, gross, graph.kappa[0], graph.tau[0])
    solution = solvers.prove_outliers(solvers.solve(spoiled, robust=solvers.GNC()))
    assert solution.robust.known[np.abs(spoiled.i - spoiled.j) == 1].all()
    assert solution.robust.proof.proven_wrong.sum() >= 10  # four where some odometry is doubted
