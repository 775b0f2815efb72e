"""Growing graphs with wrong closures: a decision stands until later edges contradict it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from wrong_edges import spoiled

import pgo_models as pgo
import solvers
from pgo_models import PoseGraph, exp_map
from pgo_models.geometry.rotations import Array, BoolArray


def beginning(graph: PoseGraph, is_wrong: BoolArray, n: int) -> tuple[PoseGraph, BoolArray]:
    """The first n poses with their edges, and which of these are wrong."""
    return graph.subgraph(np.arange(n)), is_wrong[(graph.i < n) & (graph.j < n)]


def stream(
    graph: PoseGraph, is_wrong: BoolArray, sizes: list[int], robust: solvers.GNC | solvers.PCM
) -> solvers.Solution:
    """The solution of the whole graph, which grows to one size after the other."""
    solution = solvers.solve(beginning(graph, is_wrong, sizes[0])[0], robust=robust)
    for n in sizes[1:]:
        solution = solvers.extend(solution, beginning(graph, is_wrong, n)[0], robust=robust)
    return solution


@pytest.mark.parametrize("kind", ["random", "aliased"])
@pytest.mark.parametrize("d", [2, 3])
def test_a_stream_rejects_the_wrong_closures_and_keeps_the_right_ones(d: int, kind: str) -> None:
    world = pgo.grid_world(1, 150, 1, d=d)
    graph, is_wrong = spoiled(world, 0.5, kind, 1)
    solution = stream(graph, is_wrong, [50, 75, 100, 125, 150], solvers.GNC())
    rejection = solution.robust
    assert rejection is not None
    np.testing.assert_array_equal(rejection.rejected, is_wrong)
    assert solution.is_certified
    best = solvers.solve(graph.without_edges(is_wrong))
    assert solution.objective == pytest.approx(best.objective, rel=1e-5)


def chain(closures: list[tuple[int, int, float]]) -> PoseGraph:
    """Steps of a metre, known to 0.1 m, and closures i, j known to 1 cm, but for a shift each."""
    n = 30
    i = [*range(n - 1), *(first for first, _, _ in closures)]
    j = [*range(1, n), *(second for _, second, _ in closures)]
    along: Array = np.array([float(b - a) for a, b in zip(i, j, strict=True)])
    across = np.array([*np.zeros(n - 1), *(shift for _, _, shift in closures)])
    m = len(i)
    return PoseGraph(
        num_poses=n,
        i=np.array(i),
        j=np.array(j),
        R_ij=exp_map(np.zeros((m, 1))),
        t_ij=np.stack([along, across], axis=1),
        kappa=np.full(m, 1e6),
        tau=np.where(np.arange(m) < n - 1, 1e2, 1e4),
    )


def test_a_later_closure_revises_what_was_kept() -> None:
    # Twelve steps of odometry allow one closure that is off by 0.8 m. Four others between the same
    # places say that it was wrong: two steps do not allow that.
    first = [(0, 12, 0.8)]
    later = [(0, 14, 0.0), (1, 13, 0.0), (2, 12, 0.0), (1, 15, 0.0)]
    whole = chain(first + later)
    known = np.arange(whole.num_edges) < 29
    before = chain(first).subgraph(np.arange(13))
    solution = solvers.solve(before, robust=solvers.GNC(known=np.arange(before.num_edges) < 12))
    assert solution.robust is not None
    assert solution.robust.kept.all()
    grown = solvers.extend(solution, whole, robust=solvers.GNC(known=known))
    assert grown.robust is not None
    np.testing.assert_array_equal(np.flatnonzero(grown.robust.rejected), [29])


def test_a_later_closure_brings_back_what_was_rejected() -> None:
    # As if one of three had been rejected when the others were not there yet.
    graph = chain([(0, 12, 0.0), (0, 14, 0.0), (1, 13, 0.0)])
    solution = solvers.solve(graph, robust=solvers.GNC())
    rejection = solution.robust
    assert rejection is not None
    assert rejection.kept.all()
    kept = rejection.kept.copy()
    kept[-1] = False
    without_one = replace(solution, robust=replace(rejection, kept=kept))
    grown = solvers.extend(without_one, graph, robust=solvers.GNC())
    assert grown.robust is not None
    assert grown.robust.kept.all()


# With seed 1 a right closure is beyond its quantile, as one in a hundred is.
@pytest.mark.parametrize("seed", [2, 3, 4])
def test_pairwise_consistency_and_robots_go_on_too(seed: int) -> None:
    graph, is_wrong = spoiled(pgo.grid_world(1, 60, seed, d=2), 0.3, "random", seed)
    by_consistency = stream(graph, is_wrong, [40, 60], solvers.PCM())
    assert by_consistency.robust is not None
    assert not (by_consistency.robust.kept & is_wrong).any()
    first, _ = beginning(graph, is_wrong, 40)
    shared = solvers.solve(first, robots=2, robust=solvers.GNC())
    grown = solvers.extend(shared, graph, robust=solvers.GNC())
    assert grown.robust is not None
    np.testing.assert_array_equal(grown.robust.rejected, is_wrong)
    assert grown.ledger.rounds > shared.ledger.rounds


def test_priors_are_suspects_of_a_stream_too() -> None:
    world = pgo.grid_world(1, 60, 1, d=2)
    assert world.truth is not None
    seen = np.array([0, 10, 20, 30])
    positions = world.truth.t[seen].copy()
    first = world.subgraph(np.arange(31)).with_position_prior(seen, positions, 100.0)
    fixes = np.array([0, 10, 20, 30, 40, 50])
    positions = world.truth.t[fixes].copy()
    positions[4] += 20.0
    whole = world.with_position_prior(fixes, positions, 100.0)
    solution = solvers.solve(first, robust=solvers.GNC())
    grown = solvers.extend(solution, whole, robust=solvers.GNC())
    assert grown.robust is not None
    expected = np.flatnonzero(whole.is_prior)[[4]]
    np.testing.assert_array_equal(np.flatnonzero(grown.robust.rejected), expected)
