"""Clusters of closures, their first-order distances, and the search that moves them as units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.special
from wrong_edges import noisy_sphere, ring_road, spoiled

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel, exp_map
from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.edge_groups import EdgeGroups
from pgo_models.graphs.pose_graph import IntArray
from solvers import polish
from solvers.robust.chains import Chains
from solvers.robust.cluster_search import ClusterSearch
from solvers.robust.clusters import ClosurePairs
from solvers.robust.distances import FirstOrder
from solvers.robust.edge_sets import EdgeSets
from solvers.robust.known import odometry
from solvers.robust.revision import Fit, inlier_problem, truncated_cost


def search_of(problem: pgo.PGOProblem, has_time: bool = True, scale: float = 1.0) -> ClusterSearch:
    known = odometry(problem.graph)
    thresholds = scale * pgo.chi2_thresholds(problem)
    pairs = ClosurePairs.of(problem.graph, known)
    return ClusterSearch(EdgeSets(problem, pairs, thresholds, scale, lambda: has_time))


def street(seed: int, share: float = 0.5, kind: str = "random") -> tuple[pgo.PoseGraph, BoolArray]:
    return spoiled(ring_road(seed), share, kind, seed)


@pytest.mark.parametrize("kind", ["random", "aliased"])
def test_a_cluster_is_right_or_wrong_as_a_whole(kind: str) -> None:
    graph, is_wrong = street(0, 0.8, kind)
    known = odometry(graph)
    clusters = ClosurePairs.of(graph, known).clusters()
    np.testing.assert_array_equal(np.sort(np.concatenate(clusters)), np.flatnonzero(~known))
    right = [cluster for cluster in clusters if not is_wrong[cluster].any()]
    assert all(is_wrong[cluster].all() for cluster in clusters if is_wrong[cluster].any())
    assert max(map(len, right)) >= 10


@pytest.mark.parametrize("kind", ["random", "aliased"])
def test_where_closures_agree_by_chance_clusters_are_small(kind: str) -> None:
    """In a crowded world with poor odometry a chain of neighbours that agree would join all."""
    noise = NoiseModel(0.1, 0.1)
    right = pgo.grid_world(
        1, 125, np.random.default_rng(0), d=3, loop_closure_probability=0.5, noise=noise
    )
    graph, is_wrong = spoiled(right, 0.9, kind, 0)
    known = odometry(graph)
    clusters = ClosurePairs.of(graph, known).clusters()
    right_with_wrong = [
        (~is_wrong[cluster]).sum() for cluster in clusters if is_wrong[cluster].any()
    ]
    assert sum(right_with_wrong) <= 3


def test_closures_of_a_road_driven_back_are_one_cluster_whichever_way_they_are_written() -> None:
    graph = ring_road(0)
    turned = np.flatnonzero(~odometry(graph))[::2]
    R = graph.R_ij.copy()
    t = graph.t_ij.copy()
    i = graph.i.copy()
    j = graph.j.copy()
    R[turned] = np.swapaxes(R[turned], 1, 2)
    t[turned] = -np.einsum("mab,mb->ma", R[turned], t[turned])
    i[turned], j[turned] = j[turned], i[turned].copy()
    reversed_graph = pgo.PoseGraph(graph.num_poses, i, j, R, t, graph.kappa, graph.tau)
    of_both = [
        sorted(map(tuple, ClosurePairs.of(each, odometry(each)).clusters()))
        for each in (graph, reversed_graph)
    ]
    assert of_both[0] == of_both[1]


def test_the_rise_by_right_closures_has_its_quantile() -> None:
    """T of k right closures is chi^2 with k d (d + 1) / 2 degrees of freedom."""
    cluster_size = 4
    ratios = []
    for seed in range(40):
        noise = NoiseModel(0.02, 0.005)
        graph = pgo.grid_world(
            1, 60, np.random.default_rng(seed), d=2, loop_closure_probability=0.2, noise=noise
        )
        problem = pgo.PGOProblem(graph)
        cluster = np.flatnonzero(~odometry(graph))[:cluster_size]
        kept = np.ones(graph.num_edges, dtype=bool)
        kept[cluster] = False
        costs = []
        for edges in (kept, np.ones_like(kept)):
            inliers = inlier_problem(problem, edges)
            costs.append(inliers.objective(polish(inliers, graph.truth)))
        median = problem.right_costs.thresholds(EdgeGroups.of([cluster]), 0.5)[0]
        ratios.append((costs[1] - costs[0]) / median)
    # 40 draws above the median or below: within three deviations of half of them
    assert abs(np.mean(np.array(ratios) > 1.0) - 0.5) < 3 * 0.5 / np.sqrt(40)


def test_the_joint_threshold_of_full_matrices_is_that_of_chi2() -> None:
    graph = pgo.grid_world(1, 40, np.random.default_rng(0), d=3, loop_closure_probability=0.2)
    problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.INFORMATION)
    groups = EdgeGroups.of([np.arange(1), np.arange(5)])
    expected = scipy.special.chdtri([6, 30], 0.01)
    np.testing.assert_allclose(problem.right_costs.thresholds(groups, 0.99), expected, rtol=1e-9)


def with_sightings(graph: pgo.PoseGraph, rng: np.random.Generator) -> pgo.PoseGraph:
    """The graph with landmarks, each seen from four poses."""
    truth = graph.truth
    assert truth is not None
    for first in range(0, 40, 4):
        seen_from = np.arange(first, first + 4)
        offsets = truth.t[first] + rng.standard_normal(graph.d) - truth.t[seen_from]
        positions = np.einsum("kba,kb->ka", truth.R[seen_from], offsets)
        positions += 1e-3 * rng.standard_normal(positions.shape)
        graph = graph.with_landmark(seen_from, positions, 1e6)
    return graph


@pytest.mark.parametrize("has_landmarks", [False, True])
@pytest.mark.parametrize("d", [2, 3])
def test_no_map_follows_a_closure_for_less_than_its_distance(d: int, has_landmarks: bool) -> None:
    """To first order, which small errors make exact."""
    noise = NoiseModel(1e-3, 1e-3)
    rng = np.random.default_rng(1)
    graph = pgo.grid_world(1, 60, rng, d=d, loop_closure_probability=0.3, noise=noise)
    if has_landmarks:
        graph = with_sightings(graph, rng)
    problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.INFORMATION)
    known = odometry(graph)
    closures = np.flatnonzero(~known)
    kept = known.copy()
    kept[closures[::2]] = True
    inliers = inlier_problem(problem, kept)
    poses = polish(inliers, pgo.spanning_tree_start(graph))
    edges = closures[1::2][-10:]
    first_order = FirstOrder(Chains.of(graph, known), inliers, poses)
    distances = first_order.least_distances(edges)
    assert (distances > 0.0).all()
    exact = first_order.distances(edges)
    assert (distances <= 1.001 * exact).all()
    for edge, distance in zip(edges, exact, strict=True):
        larger = kept.copy()
        larger[edge] = True
        with_edge = inlier_problem(problem, larger)
        rise = with_edge.objective(polish(with_edge, poses)) - inliers.objective(poses)
        assert distance == pytest.approx(rise, rel=0.05)


@pytest.mark.parametrize("kind", ["random", "aliased"])
def test_runs_come_back_into_a_map_that_has_drifted_away_from_them(kind: str) -> None:
    graph, is_wrong = street(0, 0.5, kind)
    problem = pgo.PGOProblem(graph)
    search = search_of(problem)
    poses = pgo.odometry_start(graph)
    thresholds = pgo.chi2_thresholds(problem)
    fits = problem.edge_costs(poses) <= thresholds
    assert fits[~search.sets.known & ~is_wrong].mean() < 0.2  # one at a time almost nothing would
    fit = search.improved(search.sets.known, poses)
    np.testing.assert_array_equal(fit.kept, ~is_wrong)
    cost = truncated_cost(problem, search.sets.known, thresholds, fit.poses)
    assert search.sets.cost(fit) == cost
    assert cost < truncated_cost(problem, search.sets.known, thresholds, poses)


def test_a_wrong_run_that_is_kept_goes_as_a_whole_and_right_ones_take_its_place() -> None:
    graph, is_wrong = street(0, 0.3, "aliased")
    problem = pgo.PGOProblem(graph)
    search = search_of(problem)
    kept = search.sets.known.copy()
    kept[np.flatnonzero(is_wrong)[:5]] = True
    poses = polish(inlier_problem(problem, kept), pgo.odometry_start(graph))
    np.testing.assert_array_equal(search.improved(kept, poses).kept, ~is_wrong)


def test_right_closures_take_the_place_of_a_wrong_edge_that_alone_joins_two_robots() -> None:
    """No residual speaks against it, and from the map that it makes right ones are far."""
    robots = np.repeat(np.arange(3), 60)
    sphere = noisy_sphere(180, 18, NoiseModel(0.02, 0.02), 0).with_robots(robots)
    graph, is_wrong = spoiled(sphere, 0.3, "random", 0)
    problem = pgo.PGOProblem(graph)
    search = search_of(problem)
    first, second = np.sort([graph.robots[graph.i], graph.robots[graph.j]], axis=0)
    kept = search.sets.known | (~is_wrong & (first == second))
    kept[np.flatnonzero(is_wrong & (first == 0) & (second == 2))[0]] = True
    kept[np.flatnonzero(is_wrong & (first == 0) & (second == 1))[0]] = True
    inliers = inlier_problem(problem, kept)
    poses = polish(inliers, pgo.chordal_start(inliers))
    np.testing.assert_array_equal(search.improved(kept, poses).kept, ~is_wrong)


def few_large_errors(
    seed: int, kind: str, noise: NoiseModel
) -> tuple[pgo.PoseGraph, BoolArray, IntArray]:
    """A spoiled grid world whose matrices claim errors twenty times as large as most of them are.

    The errors of some closures, which are returned too, are ten times as large as the others'.
    """
    rng = np.random.default_rng(seed)
    graph = pgo.grid_world(2, 60, rng, d=3, noise=noise)
    some = np.flatnonzero(~odometry(graph))[::5]
    R_ij = graph.R_ij.copy()
    t_ij = graph.t_ij.copy()
    turns = 10.0 * noise.rotation_std * rng.standard_normal((len(some), 3))
    R_ij[some] = R_ij[some] @ exp_map(turns)
    t_ij[some] += 10.0 * noise.translation_std * rng.standard_normal((len(some), 3))
    kappa = graph.kappa / 20.0**2
    tau = graph.tau / 20.0**2
    claimed = replace(graph, R_ij=R_ij, t_ij=t_ij, kappa=kappa, tau=tau, information=None)
    return *spoiled(claimed, 0.8, kind, seed), some


@pytest.mark.parametrize("kind", ["random", "aliased"])
@pytest.mark.parametrize("seed", range(3))
def test_right_edges_with_large_errors_come_back_where_wrong_ones_are_far(
    kind: str, seed: int
) -> None:
    """Errors of a millimetre, some of a centimetre, and matrices that claim two."""
    graph, is_wrong, some = few_large_errors(seed, kind, NoiseModel(1e-3, 1e-3))
    problem = pgo.PGOProblem(graph)
    kept = ~is_wrong
    kept[some] = False
    search = search_of(problem, scale=0.0025)
    fit = search.improved(kept, solvers.solve(inlier_problem(problem, kept)).poses)
    assert not fit.kept[some].any()
    likely = search.with_likely(fit)
    assert not (likely.kept & is_wrong).any()
    assert likely.kept[some].mean() >= 0.9


@pytest.mark.parametrize("kind", ["random", "aliased"])
@pytest.mark.parametrize("seed", range(3))
def test_what_matrices_allow_stays_out_where_they_allow_wrong_edges(kind: str, seed: int) -> None:
    """Of a metre and more than a radian, which most wrong closures are within."""
    graph, is_wrong, some = few_large_errors(seed, kind, NoiseModel(0.05, 0.05))
    problem = pgo.PGOProblem(graph)
    kept = ~is_wrong
    kept[some] = False
    fit = search_of(problem, scale=0.025).with_likely(
        Fit.of(problem, kept, solvers.solve(inlier_problem(problem, kept)).poses)
    )
    assert not (fit.kept & is_wrong).any()


def test_without_time_the_search_returns_what_it_was_given() -> None:
    graph, _ = street(0)
    search = search_of(pgo.PGOProblem(graph), has_time=False)
    fit = search.improved(search.sets.known, pgo.odometry_start(graph))
    np.testing.assert_array_equal(fit.kept, search.sets.known)
