"""What bounds on closures give away for rounding is enough, held against rational numbers."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from exact_arithmetic import ExactGraph, exact, is_positive_definite
from graphs import chain_with_closures

import pgo_models as pgo
import solvers
from pgo_models.geometry.rotations import Array
from solvers.robust.chains import Chains
from solvers.robust_solves.chain_sums import ChainSums, EdgeSums
from solvers.robust_solves.closure_costs import precisions_below
from solvers.robust_solves.cycle_bounds import CycleBounds

SEEDS = pytest.mark.parametrize("seed", range(12))


def exact_single_edge(kappa: Array, tau: Array, points: Array) -> tuple[Fraction, Fraction]:
    """1 / kappa and 1 / tau of the edge below others, by the formulas of `chain_sums`."""
    softness = [1 / Fraction(float(k)) for k in kappa]
    total = sum(softness)
    p = [[Fraction(float(x)) for x in point] for point in points]
    center = [
        sum(s * q[a] for s, q in zip(softness, p, strict=True)) / total for a in range(len(p[0]))
    ]
    spread = sum(
        s * sum((x - c) ** 2 for x, c in zip(q, center, strict=True))
        for s, q in zip(softness, p, strict=True)
    )
    return total, spread + sum(1 / Fraction(float(t)) for t in tau)


@SEEDS
@pytest.mark.parametrize("softest", ["turn of a step", "offset of a step", "closure"])
def test_edges_below_others_are_as_soft_as_these_where_sums_lose_digits(
    seed: int, softest: str
) -> None:
    """One edge is softer by far than all others, whose sums lose most of their digits."""
    rng = np.random.default_rng(seed)
    n = 12
    graph = chain_with_closures(seed, n, 2, 0)
    kappa, tau = 10.0 ** rng.uniform(-1.0, 1.0, (2, n - 1))
    if softest == "turn of a step":
        kappa[0] = 1e-12
    elif softest == "offset of a step":
        tau[0] = 1e-14
    chains = Chains.of(graph, np.ones(n - 1, dtype=bool))
    sums = ChainSums(chains, kappa, tau)
    first, last = 3, n - 1
    steps = chains.step_to[first + 1 : last + 1]
    points = chains.motion[1][graph.j[steps]]
    own_kappa = np.array([1e-14 if softest == "closure" else 1.0])
    own_tau = np.array([1e6])
    own_point = 10.0 * rng.standard_normal((1, 2))
    along = sums.along(np.array([first]), np.array([last]))
    total = along + EdgeSums.of(own_kappa, own_tau, own_point)
    kappa = np.append(kappa[steps], own_kappa)
    tau = np.append(tau[steps], own_tau)
    points = np.concatenate([points, own_point])
    edge = sums.single_edges(total, float(np.linalg.norm(points, axis=1).max()))
    softness, of_offsets = exact_single_edge(kappa, tau, points)
    assert Fraction(float(edge.kappa[0])) * softness <= 1
    assert Fraction(float(edge.tau[0])) * of_offsets <= 1


def test_a_thousand_edges_that_vanish_beside_a_soft_one_count() -> None:
    n = 1001
    R = np.tile(np.eye(2), (n - 1, 1, 1))
    kappa = np.full(n - 1, 1e16)
    kappa[0] = 1.0  # 1 + 1e-16 is 1 in doubles
    kappa[-1] = 1e15
    graph = pgo.PoseGraph(
        n, np.arange(n - 1), np.arange(1, n), R, np.zeros((n - 1, 2)), kappa, kappa
    )
    sums = ChainSums(Chains.of(graph, np.ones(n - 1, dtype=bool)), kappa, kappa)
    edge = sums.single_edges(sums.along(np.array([1]), np.array([n - 1])), 0.0)
    softness = (n - 3) / Fraction(10) ** 16 + 1 / Fraction(10) ** 15
    assert edge.kappa[0] > 0.0
    assert Fraction(float(edge.kappa[0])) * softness <= 1
    assert Fraction(float(edge.tau[0])) * softness <= 1


@pytest.mark.parametrize("d", [2, 3])
def test_closures_that_fit_to_rounding_cost_nothing_for_certain(d: int) -> None:
    """However heavy the edges are: the motions along a chain are not known better than that."""
    for seed in range(6):
        n = 40
        chain = chain_with_closures(seed, n, d, 0)
        heavy = np.full(n - 1, 1e30)
        along = pgo.Poses(*Chains.of(chain, np.ones(n - 1, dtype=bool)).motion)
        i, j = np.array([2, 5]), np.array([30, 37])
        back = np.swapaxes(along.R[i], 1, 2)
        t = np.einsum("mab,mb->ma", back, along.t[j] - along.t[i])
        graph = chain.with_weights(heavy, heavy)
        graph = graph.with_edges(i, j, pgo.Poses(back @ along.R[j], t), 1e30, 1e30)
        known = np.arange(n + 1) < n - 1
        sums = ChainSums(Chains.of(graph, known), graph.kappa, graph.tau)
        edges = np.flatnonzero(~known)
        assert not CycleBounds(sums).of_singles(edges).any()
        assert not CycleBounds(sums).of_pairs(edges).any()


@SEEDS
@pytest.mark.parametrize("d", [2, 3])
def test_matrices_are_above_the_precisions_of_an_f_below_them(seed: int, d: int) -> None:
    """Of eigenvalues twelve orders of magnitude apart rounding hides the least ones."""
    rng = np.random.default_rng(seed)
    graph = chain_with_closures(seed, 6, d, 0)
    m = graph.num_edges
    p = 2 * d - 3
    information = np.zeros((m, d + p, d + p))
    for start, size in ((0, d), (d, p)):
        axes = np.linalg.qr(rng.standard_normal((m, size, size)))[0]
        values = 10.0 ** rng.uniform(0.0, 11.0, (m, 1, size))
        block = (axes * values) @ np.swapaxes(axes, 1, 2)
        of_block = slice(start, start + size)
        information[:, of_block, of_block] = 0.5 * (block + np.swapaxes(block, 1, 2))
    informed = pgo.PoseGraph(
        6, graph.i, graph.j, graph.R_ij, graph.t_ij, graph.kappa, graph.tau, information=information
    )
    problem = pgo.PGOProblem(informed, weighting=pgo.Weighting.INFORMATION)
    kappa, tau = precisions_below(problem)
    assert (tau > 0.0).any()
    for e in range(m):
        for block, least in (
            (information[e, :d, :d], tau[e]),
            (information[e, d:, d:], 2.0 * kappa[e]),
        ):
            rows = exact(block) - exact(least) * exact(np.eye(len(block)))
            assert is_positive_definite([dict(enumerate(row)) for row in rows])


def test_the_truncated_cost_is_one_from_above_where_residuals_lose_digits() -> None:
    """Steps of 1,000 km measured to a tenth of a millimetre, in the thick of rounding."""
    rng = np.random.default_rng(1)
    n = 8
    angles = np.linspace(0.0, 2.0, n)
    headings = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    t = 1e6 * np.cumsum(headings, axis=0)
    R = pgo.exp_map(angles[:, None])
    i = np.array([*range(n - 1), 0, 1])
    j = np.array([*range(1, n), n - 1, n - 2])
    back = np.swapaxes(R[i], 1, 2)
    measured = np.einsum("mab,mb->ma", back, t[j] - t[i])
    measured += 1e-4 * rng.standard_normal((n + 1, 2))
    measured[-1, 1] += 1.0
    ones = np.ones(n + 1)
    graph = pgo.PoseGraph(n, i, j, back @ R[j], measured, 1e20 * ones, 1e8 * ones)
    solution = solvers.prove_outliers(solvers.solve(graph, robust=solvers.GNC()))
    robust = solution.robust
    assert robust is not None
    assert robust.proof is not None
    assert np.flatnonzero(robust.rejected).tolist() == [n]
    thresholds = robust.threshold_scale * pgo.chi2_thresholds(robust.problem, robust.quantile)
    inliers = ExactGraph.of_doubles(graph.without_edges(robust.rejected))
    cost = inliers.objective_of(solution.poses) + float(thresholds[n])
    assert cost <= robust.proof.truncated_cost
