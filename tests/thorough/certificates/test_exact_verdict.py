"""EXACT is said where every edge fits to its rounding, in 300 bits.

It is never said where a heavy edge hides light ones.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from exact_arithmetic import MP, Exact, ExactGraph, exact, nearest_rotations
from graphs import DIMENSIONS, SEEDS, exact_graph, informed, random_poses, turned_away, varied_graph
from hypothesis import given, settings, strategies as st
from roads import road

import solvers
from pgo_models import (
    Certificate,
    NoiseModel,
    PGOProblem,
    PoseGraph,
    Poses,
    Verdict,
    Weighting,
    chordal_start,
)
from pgo_models.certificates.certificate import BoundSource, certify_with
from pgo_models.certificates.fit import fits_to_rounding
from pgo_models.certificates.lower_bound import NO_BOUND
from pgo_models.certificates.rounding_errors import objective_rounding, rounding_level
from solvers import certify, polish

SPREADS = st.sampled_from([0.0, 1.0, 3.0, 10.0, 30.0])


def judged(problem: PGOProblem, poses: Poses) -> Certificate:
    """What is said of poses without a bound: EXACT or nothing."""
    nothing = np.zeros_like(poses.R)
    return certify_with(problem, poses, nothing, 1e-6, math.nan, BoundSource.GIVEN, NO_BOUND)


def exact_residuals(graph: PoseGraph, poses: Poses) -> tuple[Exact, Exact]:
    """Squares of ||r_t|| and ||r_R||_F at the exact rotations nearest to the poses, (m,) each."""
    R = nearest_rotations(poses.R)
    t = exact(poses.t)
    R_ij = exact(graph.R_ij)
    moved = (R[graph.i] @ exact(graph.t_ij)[:, :, None])[:, :, 0]
    shift = t[graph.j] - t[graph.i] - moved
    turn = R[graph.j] - R[graph.i] @ R_ij
    return (shift**2).sum(axis=1), (turn**2).sum(axis=(1, 2))


def norms(rows: Exact) -> Exact:
    """Euclidean norms of rows."""
    return np.array([MP.sqrt(square) for square in (rows**2).sum(axis=1)])


def allowed_residuals(problem: PGOProblem, poses: Poses) -> tuple[Exact, Exact]:
    """What residuals are at most where the verdict is EXACT.

    The formula is that of the docstring, its numbers are computed here.
    """
    graph = problem.graph
    d = problem.d
    u = MP.mpf(2) ** -53
    t = exact(poses.t)
    count = 8 * MP.sqrt(graph.num_edges) + 1
    omega = exact(poses.orthogonality_error) + (d * (d + 2) + 1) * u
    length = norms(exact(graph.t_ij))
    distance = norms(t[graph.j] - t[graph.i])
    from_centre = norms(t - exact(np.sort(poses.t, axis=0)[(len(t) - 1) // 2]))
    coordinates = from_centre[graph.i] + from_centre[graph.j]
    e_t = (2 * d + 3) * u * (distance + length) + omega * length + u * coordinates
    e_R = 2 * MP.sqrt(d) * (2 * d + 3) * u + 2 * omega
    rounding_up = 1 + MP.mpf(2) ** -20
    return count * e_t * rounding_up, count * e_R * rounding_up


def assert_exact_is_true(problem: PGOProblem, poses: Poses) -> bool:
    """Whether it is said that poses are exact to rounding, and if so that it is so."""
    certificate = judged(problem, poses)
    if not certificate.fit.is_to_rounding:
        assert certificate.gap > 0.0
        return False
    assert certificate.gap == 0.0
    graph = problem.graph
    (square_t, square_R), (e_t, e_R) = (
        exact_residuals(graph, poses),
        allowed_residuals(problem, poses),
    )
    assert (square_t[graph.tau > 0] <= (e_t**2)[graph.tau > 0]).all()
    assert (square_R[graph.kappa > 0] <= e_R**2).all()
    assert ExactGraph.of_doubles(graph).objective_of(poses) <= 4 * exact(certificate.rounding_level)
    return True


@settings(max_examples=examples(120))
@given(
    seed=SEEDS,
    n=st.integers(2, 8),
    d=DIMENSIONS,
    spread=SPREADS,
    noise=st.floats(-17.0, 0.0),
    away=st.floats(-17.0, 0.0),
)
def test_what_is_said_to_be_exact_is(
    seed: int, n: int, d: int, spread: float, noise: float, away: float
) -> None:
    rng = np.random.default_rng(seed)
    graph = exact_graph(seed, n, d)
    m = graph.num_edges
    t_ij = graph.t_ij + 10.0**noise * rng.standard_normal((m, d)) * (rng.random((m, 1)) < 0.3)
    kappa, tau = 10.0 ** rng.uniform(-spread, spread, (2, m))
    graph = replace(graph, kappa=kappa, tau=tau, t_ij=t_ij)
    problem = PGOProblem(graph)
    assert graph.truth is not None
    off = Poses(graph.truth.R, graph.truth.t + 10.0**away * rng.standard_normal((n, d)))
    for poses in (graph.truth, off, random_poses(n, d, seed)):
        assert_exact_is_true(problem, poses)


@settings(max_examples=examples(60))
@given(
    seed=SEEDS,
    n=st.integers(3, 10),
    d=DIMENSIONS,
    size=st.floats(-9.0, -2.0),
    weight=st.sampled_from([1e15, 1e30]),
)
def test_a_heavy_edge_does_not_hide_light_ones(
    seed: int, n: int, d: int, size: float, weight: float
) -> None:
    """F is nothing but the rounding of one edge, as far as a sum can tell."""
    graph = exact_graph(seed, n, d)
    assert graph.truth is not None
    heavy = np.arange(graph.num_edges) == seed % graph.num_edges
    kappa = np.where(heavy, weight, 1.0)
    problem = PGOProblem(replace(graph, kappa=kappa, tau=np.ones(graph.num_edges)))
    assert judged(problem, graph.truth).verdict is Verdict.EXACT
    i = int(graph.i[heavy][0])
    shift = np.zeros((n, d))
    shift[i, 0] = 10.0**size
    away = Poses(graph.truth.R, graph.truth.t + shift)
    assert weight < 1e30 or problem.objective(away) <= rounding_level(problem, away)
    at_poses = judged(problem, away)
    beside_exact_ones = certify(problem, away)
    assert not at_poses.fit.is_to_rounding
    assert not beside_exact_ones.fit.is_to_rounding
    # A shift of 1e-9 m is of no account beside these edges, and one of 1e-6 m is what an optimiser
    # leaves where Newton's method finds poses that fit to rounding.
    assert not at_poses.fit.is_exact or size < -8.0
    assert not beside_exact_ones.fit.is_exact or size < -5.5


@pytest.mark.parametrize("d", [2, 3])
def test_poses_two_hundred_times_as_expensive_as_the_optimum_are_not_exact(d: int) -> None:
    """One kappa of 1e30: sum kappa e_R^2 is above F of all other edges."""
    graph = varied_graph(0, 10, d, NoiseModel(1e-3, 1e-3))
    ones = np.full(graph.num_edges, 1.0)
    first = np.arange(graph.num_edges) == 0
    problem = PGOProblem(replace(graph, kappa=np.where(first, 1e30, ones), tau=ones))
    assert graph.truth is not None
    R = graph.truth.R.copy()
    i = graph.i[0]
    j = graph.j[0]
    R[j] = R[i] @ graph.R_ij[0]
    near = Poses(R, problem.with_best_translations(R).t)
    poor = Poses(R, near.t + 0.1 * np.random.default_rng(0).standard_normal(near.t.shape))
    assert problem.edge_costs(poor)[1:].sum() > 200.0 * problem.edge_costs(near)[1:].sum()
    for poses in (near, poor):
        assert problem.objective(poses) <= rounding_level(problem, poses)
        assert not fits_to_rounding(problem, poses)
        certificate = certify(problem, poses)
        assert certificate.verdict in (Verdict.TRIVIAL, Verdict.NOT_CERTIFIED)
        assert certificate.gap > 1e-6
    assert solvers.solve(problem, progress=False).certificate.verdict is not Verdict.EXACT


@settings(max_examples=examples(40))
@given(seed=SEEDS, n=st.integers(2, 12), d=DIMENSIONS, spread=st.floats(0.0, 3.0))
def test_graphs_without_noise_are_exact_whatever_their_weights(
    seed: int, n: int, d: int, spread: float
) -> None:
    graph = exact_graph(seed, n, d)
    kappa, tau = 10.0 ** np.random.default_rng(seed).uniform(-spread, spread, (2, graph.num_edges))
    problem = PGOProblem(replace(graph, kappa=kappa, tau=tau))
    poses = polish(problem, chordal_start(problem))
    assert certify(problem, poses).verdict is Verdict.EXACT
    assert assert_exact_is_true(problem, poses)


@settings(max_examples=examples(40))
@given(
    seed=SEEDS, n=st.integers(2, 8), d=DIMENSIONS, coupled=st.booleans(), away=st.floats(-17.0, 0.0)
)
def test_chi2_that_is_said_to_be_exact_is(
    seed: int, n: int, d: int, coupled: bool, away: float
) -> None:
    pattern = informed(seed, n, d, coupled, 2.0)
    rng = np.random.default_rng(seed)
    assert pattern.truth is not None
    R = pattern.truth.R
    t = pattern.truth.t
    back = np.swapaxes(R[pattern.i], 1, 2)
    t_ij = np.einsum("mab,mb->ma", back, t[pattern.j] - t[pattern.i])
    graph = replace(pattern, R_ij=back @ R[pattern.j], t_ij=t_ij)
    problem = PGOProblem(graph, weighting=Weighting.INFORMATION)
    assert judged(problem, pattern.truth).verdict is Verdict.EXACT
    off = Poses(R, t + 10.0**away * rng.standard_normal((n, d)))
    for poses in (pattern.truth, off):
        certificate = judged(problem, poses)
        if certificate.fit.is_to_rounding:
            (square_t, square_R), (e_t, e_R) = (
                exact_residuals(graph, poses),
                allowed_residuals(problem, poses),
            )
            assert (square_t <= e_t**2).all()
            assert (square_R <= e_R**2).all()
    assert (
        judged(problem, turned_away(problem, pattern.truth, 1e-3, seed)).verdict is Verdict.TRIVIAL
    )


def test_an_edge_without_weight_may_be_violated() -> None:
    graph = exact_graph(0, 8, 3)
    assert graph.truth is not None
    i = np.append(graph.i, 0)
    j = np.append(graph.j, 1)
    R_ij = np.concatenate([graph.R_ij, graph.R_ij[:1]])
    t_ij = np.concatenate([graph.t_ij, [[9.0, 9.0, 9.0]]])
    for kappa, tau, expected in ((1.0, 0.0, Verdict.TRIVIAL), (0.0, 1.0, Verdict.TRIVIAL)):
        weights = {"kappa": np.append(graph.kappa, kappa), "tau": np.append(graph.tau, tau)}
        more = replace(graph, i=i, j=j, R_ij=R_ij, t_ij=t_ij, information=None, **weights)
        assert more.truth is not None
        turned = more.truth.R[more.i[-1]].T @ more.truth.R[more.j[-1]]
        R_of_edge = np.concatenate([graph.R_ij, turned[None]])
        fitting = replace(more, R_ij=R_of_edge)
        is_light = tau == 0.0
        verdict = judged(PGOProblem(fitting), more.truth).verdict
        assert verdict is (Verdict.EXACT if is_light else expected)


def test_the_sum_of_all_edges_is_held_against_the_level() -> None:
    """Every edge within its share of the error is not enough: F would be 64 m levels."""
    graph = exact_graph(1, 8, 3)
    assert graph.truth is not None
    problem = PGOProblem(graph)
    rng = np.random.default_rng(0)
    sizes = 2.0 ** np.arange(-56.0, -40.0)
    moves = rng.standard_normal(graph.truth.t.shape)
    found = [Poses(graph.truth.R, graph.truth.t + size * moves) for size in sizes]
    said = [objective_rounding(problem, poses).fit.is_to_rounding for poses in found]
    assert said == sorted(said, reverse=True)
    assert 0 < sum(said) < len(said)
    for poses in found:
        assert_exact_is_true(problem, poses)
    # fits_to_rounding looks at every edge, whatever the whole cost is.
    assert [fits_to_rounding(problem, poses) for poses in found] == said


@settings(max_examples=examples(40))
@given(
    seed=SEEDS,
    n=st.integers(4, 10),
    d=DIMENSIONS,
    distance=st.floats(6.0, 12.0),
    size=st.floats(-7.0, -1.0),
    weight=st.floats(-12.0, 12.0),
)
def test_a_pose_far_away_excuses_no_other(
    seed: int, n: int, d: int, distance: float, size: float, weight: float
) -> None:
    """The error of an edge is that of its own numbers, whichever pose is the first."""
    rng = np.random.default_rng(seed)
    graph = exact_graph(seed, n, d)
    assert graph.truth is not None
    far = int(rng.integers(n))
    t = graph.truth.t.copy()
    t[far] = 10.0**distance
    back = np.swapaxes(graph.truth.R[graph.i], 1, 2)
    t_ij = np.einsum("mab,mb->ma", back, t[graph.j] - t[graph.i])
    same = np.full(graph.num_edges, 10.0**weight)
    problem = PGOProblem(replace(graph, t_ij=t_ij, kappa=same, tau=same))
    assert judged(problem, Poses(graph.truth.R, t)).verdict is Verdict.EXACT
    moved = (far + 1) % n
    near = (graph.i != far) & (graph.j != far)
    hold = near & ((graph.i == moved) | (graph.j == moved))
    t[moved] += 10.0**size
    off = Poses(graph.truth.R, t)
    assert not hold.any() or judged(problem, off).verdict is Verdict.TRIVIAL


@pytest.mark.parametrize("origin", [0, 3])
def test_poses_that_cost_two_where_nothing_is_possible_are_not_exact(origin: int) -> None:
    """One of four poses is 1e9 m away, and pose 2 is off by a millionth of a metre."""
    i = np.array([0, 1, 0, 0])
    j = np.array([1, 2, 2, 3])
    t_ij = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1e9, 0.0]])
    straight = np.tile(np.eye(2), (4, 1, 1))
    weights = np.full(4, 1e12)
    t = np.array([[0.0, 0.0], [1.0, 0.0], [1.0 + 1e-6, 1.0], [1e9, 0.0]])
    order = np.argsort([pose != origin for pose in range(4)], kind="stable")
    number = np.argsort(order)
    problem = PGOProblem(PoseGraph(4, number[i], number[j], straight, t_ij, weights, weights))
    poses = Poses(straight, t[order])
    assert problem.objective(poses) == pytest.approx(2.0, rel=1e-6)
    certificate = certify(problem, poses)
    assert certificate.verdict is Verdict.TRIVIAL
    assert certificate.proven_gap == 1.0
    right = t.copy()
    right[2, 0] = 1.0
    assert certify(problem, Poses(straight, right[order])).verdict is Verdict.EXACT


@pytest.mark.parametrize("robots", [None, 3])
@pytest.mark.parametrize("d", [2, 3])
def test_roads_of_kilometres_are_exact_where_they_have_no_noise(d: int, robots: int | None) -> None:
    """A solve leaves errors in proportion to the last bits of the farthest poses, at first."""
    pattern = road(0, 1000, 10.0, d)
    assert pattern.truth is not None
    truth = pattern.truth
    back = np.swapaxes(truth.R[pattern.i], 1, 2)
    t_ij = np.einsum("mab,mb->ma", back, truth.t[pattern.j] - truth.t[pattern.i])
    graph = replace(pattern, R_ij=back @ truth.R[pattern.j], t_ij=t_ij, truth=None, initial=None)
    solution = solvers.solve(graph, robots=robots, progress=False)
    assert solution.certificate.verdict is Verdict.EXACT


def test_exact_poses_may_cost_more_than_others_by_what_rounding_makes() -> None:
    """So no gap of them is proven; the exact verdict says what is known."""
    graph = exact_graph(0, 8, 3)
    problem = PGOProblem(graph)
    poses = polish(problem, chordal_start(problem))
    certificate = certify(problem, poses)
    assert certificate.verdict is Verdict.EXACT
    assert ExactGraph.of_doubles(graph).objective_of(poses) > 0
    assert (certificate.proven_gap, certificate.digits) == (1.0, 0)
    assert certificate.printed_gap == 0.0
    assert certificate.gap_text == "0: every edge fits to its rounding"
    assert "gap=0, EXACT" in repr(certificate)
