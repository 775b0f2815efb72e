"""Chains with few poses cost less than the chains, whatever the poses."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, chain_with_closures, informed
from hypothesis import given, strategies as st

import pgo_models as pgo
from pgo_models import NoiseModel
from solvers import polish
from solvers.robust.chains import Chains
from solvers.robust_solves.chain_sums import ChainSums
from solvers.robust_solves.closure_costs import precisions_below
from solvers.robust_solves.coarse_chains import CoarseChains


def costs_of(problem: pgo.PGOProblem, coarse: CoarseChains, edges: list[int], num_steps: int):
    """For poses of the problem: F of the coarse graph less its rounding, and of the edges.

    Between the ends the poses of the coarse graph are those with the same rotations and the best
    positions, as the origins of their frames lie elsewhere.
    """
    graph = problem.graph
    found = coarse.with_closures(edges, num_steps)
    assert found is not None
    small, rounding = found
    ends = np.unique(np.concatenate([graph.i[edges], graph.j[edges]]))
    lines = [np.arange(low, high + 1) for low, high in pairwise(ends)]
    nodes = np.unique(np.concatenate([ends, *coarse._pieces(ends, num_steps)]))
    chosen = np.zeros(graph.num_edges, dtype=bool)
    chosen[edges] = True
    inside = np.unique(np.concatenate(lines))
    step = np.abs(graph.i - graph.j) == 1
    is_closure = np.arange(graph.num_edges) >= graph.num_poses - 1
    chosen |= step & ~is_closure & np.isin(graph.i, inside) & np.isin(graph.j, inside)
    small_problem = pgo.PGOProblem(small)
    between = ~np.isin(nodes, ends)
    incidence = np.zeros((small.num_edges, small.num_poses))
    incidence[np.arange(small.num_edges), small.j] += 1.0
    incidence[np.arange(small.num_edges), small.i] -= 1.0
    weighted = np.sqrt(small.tau)[:, None] * incidence

    def costs(poses: pgo.Poses) -> tuple[float, float]:
        R = poses.R[nodes]
        t = np.where(between[:, None], 0.0, poses.t[nodes])
        steps = np.einsum("mab,mb->ma", R[small.i], small.t_ij) - incidence @ t
        t[between] = np.linalg.lstsq(
            weighted[:, between], np.sqrt(small.tau)[:, None] * steps, rcond=None
        )[0]
        below = small_problem.objective(pgo.Poses(R, t)) - rounding
        return below, float(problem.edge_costs(poses)[chosen].sum())

    return costs


@given(
    seed=SEEDS,
    n=st.integers(3, 40),
    d=DIMENSIONS,
    num_closures=st.integers(1, 2),
    num_steps=st.integers(1, 12),
)
def test_they_cost_less_at_all_poses(
    seed: int, n: int, d: int, num_closures: int, num_steps: int
) -> None:
    graph = chain_with_closures(seed, n, d, num_closures)
    problem = pgo.PGOProblem(graph)
    known = np.arange(graph.num_edges) < n - 1
    coarse = CoarseChains(ChainSums(Chains.of(graph, known), graph.kappa, graph.tau))
    edges = np.flatnonzero(~known).tolist()
    costs = costs_of(problem, coarse, edges, num_steps)
    rng = np.random.default_rng(seed)
    along = coarse.sums.chains.motion
    start = pgo.Poses(*along)
    tried = [start, polish(problem, start)]
    for size in (1e-3, 0.1, 1.0, 10.0):
        R = tried[1].R @ pgo.exp_map(size * rng.standard_normal((n, 2 * d - 3)))
        tried.append(pgo.Poses(R, tried[1].t + size * rng.standard_normal((n, d))))
    for poses in tried:
        below, cost = costs(poses)
        assert below <= cost * (1 + 1e-9) + 1e-9


@pytest.mark.parametrize("kappa_of_others", [1e6, 1.0])
def test_a_turn_far_from_the_end_costs_as_much_as_it_did(kappa_of_others: float) -> None:
    """A bend at the first step of a long straight chain, seen from its last pose."""
    n = 12
    t = np.stack([np.arange(float(n)), np.zeros(n)], axis=1)
    i, j = np.array([*((k, k + 1) for k in range(n - 1)), (0, n - 1)]).T
    kappa = np.full(n, kappa_of_others)
    kappa[0] = 1.0
    R = np.tile(np.eye(2), (n, 1, 1))
    graph = pgo.PoseGraph(n, i, j, R, t[j] - t[i], kappa, np.full(n, 1e6))
    sums = ChainSums(Chains.of(graph, np.arange(n) < n - 1), graph.kappa, graph.tau)
    costs = costs_of(pgo.PGOProblem(graph), CoarseChains(sums), [n - 1], 1)
    turn = pgo.exp_map(np.full((1, 1), 0.1))
    bent = np.concatenate([t[:1], t[1] + (t[1:] - t[1]) @ turn[0].T])
    below, cost = costs(pgo.Poses(np.concatenate([R[:1], np.tile(turn, (n - 1, 1, 1))]), bent))
    closure = 1e6 * ((bent[-1] - t[-1]) ** 2).sum() + 2.0 * kappa_of_others * 2 * (1 - np.cos(0.1))
    assert cost - closure == pytest.approx(4.0 * (1.0 - np.cos(0.1)), rel=1e-4)
    assert below - closure <= cost - closure + 1e-9 * cost
    if kappa_of_others > 1.0:
        assert below - closure >= 0.95 * (cost - closure)


def test_many_steps_lose_little() -> None:
    """Of a closure that is wrong: the more steps, the closer are the least costs."""
    graph = chain_with_closures(7, 60, 2, 0)
    graph = replace(graph, R_ij=np.tile(np.eye(2), (59, 1, 1)), kappa=np.full(59, 1e3))
    along = Chains.of(graph, np.ones(59, dtype=bool)).motion
    R = along[0][[5]].swapaxes(1, 2) @ along[0][[50]]
    t = (along[1][[50]] - along[1][[5]]) @ along[0][5] + 0.5
    graph = graph.with_edges(np.array([5]), np.array([50]), pgo.Poses(R, t), 1e3, 1e3)
    known = np.arange(60) < 59
    coarse = CoarseChains(ChainSums(Chains.of(graph, known), graph.kappa, graph.tau))

    def least(problem: pgo.PGOProblem, start: pgo.Poses | None = None) -> float:
        return problem.objective(polish(problem, start or pgo.chordal_start(problem)))

    whole = least(pgo.PGOProblem(graph), pgo.Poses(*along))
    costs = []
    for num_steps in (1, 3, 10, 45):
        found = coarse.with_closures([59], num_steps)
        assert found is not None
        costs.append(least(pgo.PGOProblem(found[0])))
    assert np.all(np.diff(costs) > 0)
    assert costs[0] > 0.3 * whole
    assert costs[-1] == pytest.approx(whole, rel=0.02)  # edges j -> i turn at their first pose


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


@pytest.mark.parametrize("size", [1e-150, 1e-4, 1.0, 1e200])
def test_the_unit_of_the_weights_does_not_matter(size: float) -> None:
    graph = chain_with_closures(5, 20, 2, 1)
    known = np.arange(20) < 19
    chains = Chains.of(graph, known)
    scaled = ChainSums(chains, size * graph.kappa, size * graph.tau)
    found = CoarseChains(scaled).with_closures([19], 3)
    expected = CoarseChains(ChainSums(chains, graph.kappa, graph.tau)).with_closures([19], 3)
    assert found is not None
    assert expected is not None
    np.testing.assert_allclose(found[0].kappa / size, expected[0].kappa, rtol=1e-9)
    np.testing.assert_allclose(found[0].tau / size, expected[0].tau, rtol=1e-9)


def test_nothing_is_said_where_a_step_has_no_precision_or_the_ends_are_apart() -> None:
    graph = chain_with_closures(0, 20, 2, 1)
    known = np.arange(20) < 19
    tau = graph.tau.copy()
    tau[min(graph.i[19], graph.j[19])] = 0.0
    chains = Chains.of(graph, known)
    assert CoarseChains(ChainSums(chains, graph.kappa, tau)).with_closures([19], 4) is None
    broken = Chains.of(graph, known & (np.arange(20) != min(graph.i[19], graph.j[19])))
    found = CoarseChains(ChainSums(broken, graph.kappa, graph.tau)).with_closures([19], 4)
    assert found is not None
    assert found[0].num_edges == 1  # the closure, which costs nothing by itself
    two = graph.with_edges(np.array([0]), np.array([1]), pgo.Poses.identity(1, 2), 1.0, 1.0)
    apart = CoarseChains(ChainSums(Chains.of(two, np.zeros(21, dtype=bool)), two.kappa, two.tau))
    assert apart.with_closures([19, 20], 4) is None
