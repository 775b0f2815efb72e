"""Bounds in closed form are below the cost of cycles, whatever the poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, chain_with_closures
from hypothesis import given, strategies as st

import pgo_models as pgo
from solvers import polish
from solvers.robust.chains import Chains
from solvers.robust_solves.chain_sums import ChainSums
from solvers.robust_solves.cycle_bounds import CycleBounds


def bounds_of(graph: pgo.PoseGraph, known: np.ndarray) -> CycleBounds:
    return CycleBounds(ChainSums(Chains.of(graph, known), graph.kappa, graph.tau))


def least_cost(graph: pgo.PoseGraph, chosen: np.ndarray) -> float:
    """The least F of chosen edges that was found from two starts."""
    problem = pgo.PGOProblem(graph.without_edges(~chosen))
    along = Chains.of(graph, np.arange(graph.num_edges) < graph.num_poses - 1).motion
    starts = [pgo.chordal_start(problem), pgo.Poses(*along)]
    return min(problem.objective(polish(problem, start)) for start in starts)


@given(seed=SEEDS, n=st.integers(3, 30), d=DIMENSIONS, is_quiet=st.booleans())
def test_they_are_below_every_cost(seed: int, n: int, d: int, is_quiet: bool) -> None:
    graph = chain_with_closures(seed, n, d, 2)
    if is_quiet:
        R = pgo.exp_map(0.05 * pgo.log_map(graph.R_ij))
        graph = replace(graph, R_ij=R)
    known = np.arange(graph.num_edges) < n - 1
    bounds = bounds_of(graph, known)
    edges = np.flatnonzero(~known)
    singles = bounds.of_singles(edges)
    pairs = bounds.of_pairs(edges)
    assert pairs[0, 1] == pairs[1, 0]
    assert not pairs.diagonal().any()
    assert (singles > 0.0).all()
    for k, e in enumerate(edges):
        chosen = known.copy()
        chosen[e] = True
        assert singles[k] <= least_cost(graph, chosen) * (1 + 1e-9)
    assert pairs[0, 1] <= least_cost(graph, np.ones(n + 1, dtype=bool)) * (1 + 1e-9)


@pytest.mark.parametrize("d", [2, 3])
def test_of_small_errors_they_are_about_half_of_the_cost_or_more(d: int) -> None:
    graph = pgo.grid_world(1, 40, np.random.default_rng(0), d=d)
    graph = graph.without_edges(np.abs(graph.i - graph.j) != 1)
    along = Chains.of(graph, np.ones(39, dtype=bool)).motion
    i, j = np.array([3, 5]), np.array([35, 33])
    back = along[0][i].swapaxes(1, 2)
    R = back @ along[0][j]
    t = np.einsum("mab,mb->ma", back, along[1][j] - along[1][i])
    t[1, 0] += 0.2
    graph = graph.with_edges(i, j, pgo.Poses(R, t), graph.kappa[0], graph.tau[0])
    known = np.arange(41) < 39
    bounds = bounds_of(graph, known)
    chosen = known.copy()
    chosen[40] = True
    least = least_cost(graph, chosen)
    assert 0.45 * least < bounds.of_singles(np.array([40]))[0] < least
    least = least_cost(graph, np.ones(41, dtype=bool))
    assert 0.4 * least < bounds.of_pairs(np.array([39, 40]))[0, 1] < least


def test_an_edge_that_is_passed_twice_pays_once() -> None:
    """Two closures over the same piece of the chain, which both want to be shorter."""
    graph = pgo.grid_world(1, 12, np.random.default_rng(1), d=2)
    graph = graph.without_edges(np.abs(graph.i - graph.j) != 1)
    graph = graph.with_edges(np.array([0, 8]), np.array([9, 2]), pgo.Poses.identity(2, 2), 1e3, 1e3)
    known = np.arange(13) < 11
    pair = bounds_of(graph, known).of_pairs(np.array([11, 12]))[0, 1]
    assert pair <= least_cost(graph, np.ones(13, dtype=bool))


def pair_bound_on_a_line(ends: list[tuple[int, int]], longer: list[float]) -> float:
    """The bound for two closures of a straight chain whose steps can be stretched alone."""
    t = np.stack([np.arange(9.0), np.zeros(9)], axis=1)
    i, j = np.array([*((k, k + 1) for k in range(8)), *ends]).T
    measured = t[j] - t[i]
    measured[8:, 0] += longer
    R = np.tile(np.eye(2), (10, 1, 1))
    tau = np.concatenate([np.ones(8), [1e9, 1e9]])
    graph = pgo.PoseGraph(9, i, j, R, measured, np.full(10, 1e12), tau)
    return float(bounds_of(graph, np.arange(10) < 8).of_pairs(np.array([8, 9]))[0, 1])


def test_closures_that_share_a_pose_and_no_step_keep_all_of_their_bound() -> None:
    """The cycle of both has six steps, none of them twice."""
    assert pair_bound_on_a_line([(0, 3), (3, 6)], [1.0, 0.0]) == pytest.approx(1 / 6, rel=1e-3)


@pytest.mark.parametrize(("ends", "num_passed"), [((5, 8), 10), ((8, 4), 9), ((2, 8), 7)])
def test_steps_between_closures_that_a_cycle_passes_twice_count_twice(
    ends: tuple[int, int], num_passed: int
) -> None:
    """One closure wants three steps to be longer by one, the other its own to be shorter by one."""
    shorter = -1.0 if ends[0] < ends[1] else 1.0
    bound = pair_bound_on_a_line([(0, 3), ends], [1.0, shorter])
    assert bound == pytest.approx(4.0 / num_passed, rel=1e-3)


@given(seed=SEEDS, d=DIMENSIONS, gap=st.integers(1, 4))
def test_of_closures_apart_they_are_below_the_sum_of_both_costs(
    seed: int, d: int, gap: int
) -> None:
    """Nothing but the steps between them ties one to the other, and these cost nothing."""
    n = 7 + gap
    graph = chain_with_closures(seed, n, d, 2)
    i, j = graph.i.copy(), graph.j.copy()
    i[-2:], j[-2:] = (0, n - 4), (3, n - 1)
    graph = replace(graph, i=i, j=j)
    known = np.arange(n + 1) < n - 1
    pair = bounds_of(graph, known).of_pairs(np.array([n - 1, n]))[0, 1]
    first = known | (np.arange(n + 1) == n - 1)
    second = known | (np.arange(n + 1) == n)
    least = least_cost(graph, first) + least_cost(graph, second)
    assert pair <= least * (1 + 1e-9)


@pytest.mark.parametrize("size", [1e-150, 1e-4, 1e150])
def test_the_unit_of_the_weights_does_not_matter(size: float) -> None:
    graph = chain_with_closures(5, 20, 2, 2)
    known = np.arange(21) < 19
    edges = np.array([19, 20])
    chains = Chains.of(graph, known)
    scaled = CycleBounds(ChainSums(chains, size * graph.kappa, size * graph.tau))
    expected = bounds_of(graph, known)
    np.testing.assert_allclose(scaled.of_singles(edges) / size, expected.of_singles(edges))
    np.testing.assert_allclose(scaled.of_pairs(edges) / size, expected.of_pairs(edges))


def test_nothing_is_known_of_edges_without_precisions_and_of_ends_that_are_apart() -> None:
    graph = chain_with_closures(0, 20, 3, 1)
    graph = graph.with_edges(np.array([1]), np.array([4]), pgo.Poses.identity(1, 3), 1.0, 1.0)
    known = np.arange(21) < 19
    first = min(graph.i[19], graph.j[19])
    tau = graph.tau.copy()
    tau[first] = 0.0
    chains = Chains.of(graph, known)
    missing = CycleBounds(ChainSums(chains, graph.kappa, tau)).of_singles(np.array([19, 20]))
    assert missing[0] == 0.0
    assert (missing[1] > 0.0) == (not 1 <= first < 4)
    broken = bounds_of(graph, known & (np.arange(21) != first))
    assert broken.of_singles(np.array([19]))[0] == 0.0
