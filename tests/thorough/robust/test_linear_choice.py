"""Choice of closures in the linear theory: its model, its search, and maps that were bent."""

from __future__ import annotations

import itertools
from functools import partial

import numpy as np
import pytest
from wrong_edges import spoiled

import pgo_models as pgo
from pgo_models import NoiseModel, exp_map
from pgo_models.problem.hessian import TangentLayout
from solvers import polish
from solvers.robust.chains import measured_covariances
from solvers.robust.clusters import ClosurePairs
from solvers.robust.distances import linearised_errors
from solvers.robust.edge_sets import EdgeSets, with_edges
from solvers.robust.known import odometry
from solvers.robust.linear_choice import LinearChoice
from solvers.robust.linear_search import LinearSearch
from solvers.robust.revision import inlier_problem

ALLOWED = 10.0


def sparse_world(d: int, size: float = 1e-3) -> pgo.PGOProblem:
    """A trajectory with a dozen closures and small errors, so that the linear theory holds."""
    graph = pgo.grid_world(
        1,
        60,
        np.random.default_rng(3),
        d=d,
        loop_closure_probability=0.15,
        noise=NoiseModel(size, size),
    )
    return pgo.PGOProblem(graph, weighting=pgo.Weighting.INFORMATION)


def sets_of(problem: pgo.PGOProblem, *, has_time: bool = True) -> EdgeSets:
    """Sets of closures beside odometry."""
    pairs = ClosurePairs.of(problem.graph, odometry(problem.graph))
    return EdgeSets(problem, pairs, pgo.chi2_thresholds(problem), 1.0, lambda: has_time)


def model_at(
    problem: pgo.PGOProblem, num_kept: int
) -> tuple[LinearChoice, EdgeSets, np.ndarray, np.ndarray, pgo.Poses]:
    """The model at the map of some closures, with all that it is of."""
    graph = problem.graph
    known = odometry(graph)
    closures = np.flatnonzero(~known)[:10]
    kept = np.arange(num_kept)
    sets = sets_of(problem)
    fit = sets.settled(with_edges(known, closures[kept]), pgo.odometry_start(graph))
    measured = measured_covariances(graph)[closures]
    staying = inlier_problem(problem, known)
    model = LinearChoice.of(staying, graph, (closures, measured), kept, fit.poses, ALLOWED)
    return model, sets, closures, kept, fit.poses


@pytest.mark.parametrize("d", [2, 3])
def test_the_derivative_of_the_errors_is_that_of_moves(d: int) -> None:
    graph = sparse_world(d, 0.1).graph
    edges = np.flatnonzero(~odometry(graph))
    poses = pgo.odometry_start(graph)
    errors, (of_first, of_second) = linearised_errors(graph, edges, poses)
    layout = TangentLayout(graph.num_poses, d)
    p = layout.side // graph.num_poses
    rng = np.random.default_rng(0)
    moves = rng.standard_normal((graph.num_poses, p))
    step = 1e-6
    turn = exp_map(step * moves[:, d:])
    moved = pgo.Poses(poses.R @ turn, poses.t + step * moves[:, :d])
    after, _ = linearised_errors(graph, edges, moved)
    predicted = np.einsum("kab,kb->ka", of_first, moves[graph.i[edges]])
    predicted += np.einsum("kab,kb->ka", of_second, moves[graph.j[edges]])
    # The derivative of the logarithm is the identity up to half the error itself.
    size = np.abs(errors[:, d:]).max()
    np.testing.assert_allclose(
        (after - errors) / step, predicted, atol=(1e-4 + size) * np.abs(moves).max(), rtol=0
    )


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("num_kept", [0, 4])
def test_what_a_closure_costs_in_the_model_is_what_the_map_says(d: int, num_kept: int) -> None:
    model, sets, closures, kept, poses = model_at(sparse_world(d), num_kept)
    choice = model.choose(kept)
    changes = choice.changes()
    before = sets.settled(with_edges(sets.known, closures[kept]), poses)
    expected = before.cost + ALLOWED * (len(closures) - num_kept)
    assert choice.cost == pytest.approx(expected, rel=1e-2)
    for e in range(len(closures)):
        edges = with_edges(sets.known, closures[np.setxor1d(kept, [e])])
        inliers = inlier_problem(sets.problem, edges)
        rise = inliers.objective(polish(inliers, poses)) - before.cost
        sign = -1.0 if e in kept else 1.0
        assert changes[e] + sign * ALLOWED == pytest.approx(rise, rel=1e-2, abs=1e-2)


def cost_of(model: LinearChoice, chosen: tuple[int, ...]) -> float:
    """Cost of a set of closures, by solving for it."""
    k, p = model.errors.shape
    rows = np.arange(k * p).reshape(k, p)[list(chosen)].ravel()
    u = model.errors.ravel()[rows]
    K = model.covariance[np.ix_(rows, rows)]
    return float(u @ np.linalg.solve(K, u)) + ALLOWED * (k - len(chosen))


def test_the_search_finds_the_best_of_all_sets() -> None:
    """Eight closures whose errors go together: all 256 sets are compared."""
    num_found = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        k, p = 8, 3
        root = rng.standard_normal((k * p, k * p))
        covariance = root @ root.T / (k * p) + 0.1 * np.eye(k * p)
        errors = rng.standard_normal((k, p)) * rng.choice([1.0, 4.0], k)[:, None]
        model = LinearChoice(errors, covariance, ALLOWED)

        cost = partial(cost_of, model)
        sets = itertools.chain.from_iterable(
            itertools.combinations(range(k), size) for size in range(k + 1)
        )
        least = min(map(cost, sets))
        best = model.best(np.zeros(0, dtype=int))
        num_found += cost(tuple(best)) <= (1.0 + 1e-9) * least
    assert num_found == 8


@pytest.mark.parametrize(("k", "seed"), [(3, 103), (8, 5), (8, 11), (8, 36)])
def test_a_changed_closure_stays_as_it_is_for_a_time_that_grows_with_their_number(
    k: int, seed: int
) -> None:
    """Closures that hang together closely; no or another such time misses the best set."""
    rng = np.random.default_rng([k, seed])
    rank = int(rng.integers(2, 3 * k + 1))
    root = rng.standard_normal((3 * k, rank))
    covariance = root @ root.T / rank * rng.choice([1.0, 5.0, 30.0]) + 0.1 * np.eye(3 * k)
    errors = rng.standard_normal((k, 3)) * rng.choice([1.0, 4.0], k)[:, None]
    errors *= rng.choice([1.0, 2.0])
    model = LinearChoice(errors, covariance, ALLOWED)
    sets = [kept for size in range(k + 1) for kept in itertools.combinations(range(k), size)]
    least = min(cost_of(model, kept) for kept in sets)
    best = model.best(np.zeros(0, dtype=int))
    assert cost_of(model, tuple(best)) == pytest.approx(least, rel=1e-9)


def test_a_map_that_was_bent_to_a_wrong_closure_comes_back() -> None:
    """One of the closures kept is wrong, and most right ones are out: no single change helps."""
    num_back = 0
    for seed in range(4):
        noise = NoiseModel(0.02, 0.05)
        right = pgo.grid_world(
            1, 300, np.random.default_rng(seed), d=2, loop_closure_probability=0.02, noise=noise
        )
        graph, is_wrong = spoiled(right, 0.5, "random", seed)
        problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.INFORMATION)
        known = odometry(graph)
        sets = sets_of(problem)
        planted = sets.settled(~is_wrong, graph.truth)
        wrong = np.flatnonzero(is_wrong)[:1]
        fit = sets.settled(with_edges(known, wrong), pgo.odometry_start(graph))
        assert LinearSearch.of(sets_of(problem, has_time=False)).exchanged(fit) is None
        search = LinearSearch.of(sets)
        while True:
            other = search.exchanged(fit)
            if other is None:
                break
            assert sets.is_better(other, fit)
            fit = other
        num_back += sets.cost(fit) <= 1.001 * sets.cost(planted)
    assert num_back >= 3
