"""Each doubt of a robust solve: a small graph that it is said of, and one that it is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from wrong_edges import joined_by, ring_road, spoiled

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel
from solvers.robust.rejection import Support


def with_slip(graph: pgo.PoseGraph, edge: int, shift: float) -> pgo.PoseGraph:
    t_ij = graph.t_ij.copy()
    t_ij[edge] += shift
    return replace(graph, t_ij=t_ij)


def given(graph: pgo.PoseGraph) -> solvers.GNC:
    """Settings that take odometry for right, whatever speaks against it."""
    return solvers.GNC(known=np.arange(graph.num_edges) < graph.truth.num_poses - 1)


def test_the_only_edge_between_two_robots() -> None:
    doubt = "one edge is the only one between two parts of the map, and nothing checks it"
    assert solvers.solve(joined_by(1), robust=solvers.GNC()).robust.doubts == (doubt,)
    assert solvers.solve(joined_by(2), robust=solvers.GNC()).robust.doubts == ()


@pytest.mark.parametrize("claim", [1.0, 2.5])
def test_errors_larger_than_claimed(claim: float) -> None:
    graph = ring_road(0, 45, 30)
    graph = replace(graph, kappa=claim * graph.kappa, tau=claim * graph.tau)
    robust = solvers.solve(graph, robust=given(graph)).robust
    doubt = "the edges kept do not fit together"
    assert robust.doubts == ((doubt,) if claim > 1.0 else ())


@pytest.mark.parametrize("share", [0.4, 0.85])
def test_wrong_closures_that_fit_by_chance(share: float) -> None:
    """Twenty poses, whose odometry is so poor that it follows many a wrong closure."""
    noise = NoiseModel(0.4, 0.15)
    rng = np.random.default_rng(0)
    right = pgo.grid_world(1, 20, rng, d=2, loop_closure_probability=0.1, noise=noise)
    graph, _ = spoiled(right, share, "random", 0)
    robust = solvers.solve(graph, robust=given(graph)).robust
    is_doubted = any("expected to fit this map by chance" in doubt for doubt in robust.doubts)
    assert is_doubted == (robust.by_chance > 1.0) == (share > 0.5)


def test_without_a_slipped_step_more_edges_fit() -> None:
    graph = with_slip(ring_road(0, 45, 30), 38, 1.0)
    solution = solvers.solve(graph, robust=given(graph))
    robust = solution.robust
    assert not solution.is_certified
    doubt = f"DOUBTFUL, {graph.edge_label(38)} is taken for right, and without it 6 more edges fit"
    assert robust.headline.startswith(doubt)
    rival = solution.as_json()["robust"]["rival"]
    assert rival["edge"] == 38
    assert rival["others"] == robust.num_closures - robust.num_closures_kept
    every_closure = solvers.solve(graph.without_edges(np.arange(graph.num_edges) == 38))
    assert every_closure.objective < robust.cost - rival["gain"]


def test_a_slip_that_costs_every_closure_is_said_of_a_tree() -> None:
    graph = with_slip(ring_road(0, 45, 30), 20, 30.0)
    solution = solvers.solve(graph, robust=given(graph))
    assert solution.verdict is Support.UNCHECKED
    assert solution.robust.rival.others == solution.robust.num_closures == 15
    assert solution.robust.headline.endswith("and without it 15 more edges fit")


@pytest.mark.parametrize("num_wrong", [pytest.param(2, marks=pytest.mark.slow), 3])
def test_more_than_half_of_the_fixes_rejected_is_doubted(num_wrong: int) -> None:
    """Wrong fixes are far from each other, and the right ones agree."""
    graph = ring_road(0, 24, 16)
    poses = np.arange(0, 20, 4)
    positions = graph.truth.t[poses]
    positions[:num_wrong] += np.random.default_rng(0).uniform(50.0, 500.0, (num_wrong, 2))
    graph = graph.with_position_prior(poses, positions, 4.0)
    robust = solvers.solve(graph, robust=given(graph)).robust
    assert robust.rejected.sum() == num_wrong
    assert robust.doubts == (("3 of 5 fixes are rejected",) if num_wrong == 3 else ())


@pytest.mark.parametrize("num_wrong", [1, 2])
def test_two_maps_that_explain_the_closures_about_as_well(num_wrong: int) -> None:
    """Two right closures, and wrong ones under one other motion that odometry allows, too."""
    graph = ring_road(0, 45, 30)
    others = np.arange(graph.num_edges) >= graph.truth.num_poses - 1 + 2
    graph = graph.without_edges(others)
    closures = np.flatnonzero(~given(graph).known)[:num_wrong]
    moved = pgo.Poses(graph.R_ij[closures], graph.t_ij[closures] + np.array([0.8, 0.0]))
    i, j = graph.i[closures], graph.j[closures]
    graph = graph.with_edges(i, j, moved, graph.kappa[closures], graph.tau[closures])
    robust = solvers.solve(graph, robust=given(graph)).robust
    assert robust.rejected.sum() == num_wrong
    if num_wrong == 1:
        assert robust.doubts == ()
        return
    doubt = "another map, with 2 edges rejected here, fits about as well"
    assert robust.headline.startswith(f"DOUBTFUL, {doubt}: CERTIFIED")
    assert robust.rival.others == 2


def test_a_step_that_alone_ties_rotations_is_no_suspect() -> None:
    """Without a step the fixes tie the positions of a chain, and nothing its rotations."""
    graph = ring_road(0, 24, 16)
    poses = np.arange(0, 24, 5)
    positions = graph.truth.t[poses]
    positions[:2] += 100.0
    chain = graph.without_edges(~given(graph).known)
    chain = chain.with_position_prior(poses, positions, 4.0)
    robust = solvers.solve(chain, robust=given(chain)).robust
    assert robust.rejected.any()
    assert robust.rival is None or robust.rival.edge is None
