import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from graphs import (
    DIMENSIONS,
    LOUD_NOISE,
    OPTIMUM,
    SEEDS,
    SIZES,
    best_known,
    exact_graph,
    informed,
    optimum_tolerance,
    random_poses,
    rounded_up,
    varied_graph,
    varied_problem,
)
from hypothesis import assume, given, settings, strategies as st

from pgo_models import (
    Certificate,
    NoiseModel,
    PGOProblem,
    PoseGraph,
    Poses,
    Verdict,
    Weighting,
    certify_at,
    chordal_start,
    circle,
    exp_map,
    grid,
    multipliers,
    prove_bound,
    random_geometric,
    random_rotations,
)
from pgo_models.certificates.certificate import DEFAULT_GAP, BoundSource, judge
from pgo_models.certificates.fit import FITS_WITHOUT_EDGES, Fit, fits_to_rounding
from pgo_models.certificates.lower_bound import best_bound
from pgo_models.certificates.rounding_errors import objective_rounding
from pgo_models.errors import SettingError
from pgo_models.graphs.scenes import MILD_NOISE, observe
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.stationarity import STATIONARY_DECREMENT
from solvers import certify, polish
from solvers.riemannian.polish import relative_decrement

NOISES = st.sampled_from([MILD_NOISE, LOUD_NOISE, NoiseModel(0.5, 0.8), NoiseModel(0.1, 2.0)])
BACKENDS = pytest.mark.parametrize("backend", CholeskyBackend)


def ring(seed: int, n: int, d: int, noise: NoiseModel) -> PoseGraph:
    """One loop of n poses: the graph that binds its poses least."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(n) / n
    t = np.zeros((n, d))
    t[:, :2] = n / (2 * np.pi) * np.column_stack([np.cos(angle), np.sin(angle)])
    truth = Poses(random_rotations(n, d, rng), t)
    i = np.arange(n)
    return observe("ring", truth, i, (i + 1) % n, noise, noise.kappa(d), noise.tau, rng)


def wound(truth: Poses) -> Poses:
    """The truth of a ring in the plane, with one more turn around the loop.

    Beside it lies a local minimum.
    """
    n = truth.num_poses
    extra = exp_map(2 * np.pi * np.arange(n)[:, None] / n)
    return Poses(truth.R @ extra, truth.t)


def assert_holds_together(
    problem: PGOProblem, poses: Poses, certificate: Certificate, known: float
) -> None:
    """A certificate says only what is so, whatever its verdict is."""
    objective = problem.objective(poses)
    assert certificate.objective == objective
    assert certificate.lower_bound <= min(known, objective)
    if certificate.verdict is Verdict.EXACT:
        assert (fits_to_rounding(problem, poses), certificate.gap) == (True, 0.0)
    else:
        assert certificate.gap == (objective - certificate.lower_bound) / objective
        is_within = certificate.proven_gap <= certificate.wanted_gap
        assert certificate.is_certified == (is_within and not math.isnan(certificate.eta))
    assert certificate.poses_objective == problem.objective(certificate.poses)
    assert certificate.stationarity == relative_decrement(problem, poses)
    if math.isnan(certificate.eta):
        assert certificate.lower_bound == 0.0
        assert certificate.verdict in (Verdict.TRIVIAL, Verdict.EXACT)
    else:
        assert certificate.lower_bound > 0.0
        at = certificate.poses if certificate.bound.is_grounded else None
        terms = certificate.bound.terms
        less_terms = problem if terms is None else terms.taken_off(problem)
        is_complex = certificate.bound.is_complex
        proven = prove_bound(less_terms, certificate.Lambda, certificate.eta, at, is_complex)
        assert proven is not None
        if terms is not None:
            proven -= terms.loss()
        assert certificate.lower_bound == pytest.approx(min(proven, objective), rel=1e-9)


# Anybody's poses.


@settings(max_examples=examples(60))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, noise=NOISES, spread=st.sampled_from([1.0, 1e3, 1e6]))
def test_certificates_of_any_poses_hold(
    seed: int, n: int, d: int, noise: NoiseModel, spread: float
) -> None:
    problem = PGOProblem(varied_graph(seed, n, d, noise))
    known = best_known(problem, seed)
    assert problem.graph.truth is not None
    assert problem.graph.initial is not None
    far = Poses(problem.graph.truth.R, problem.graph.truth.t + spread)
    for poses in (
        problem.graph.truth,
        problem.graph.initial,
        random_poses(n, d, seed, spread),
        far,
    ):
        assert_holds_together(problem, poses, certify(problem, poses), known)


@settings(max_examples=examples(30))
@given(seed=SEEDS, n=st.integers(3, 12), d=DIMENSIONS, noise=NOISES)
def test_certificates_on_a_loop_hold(seed: int, n: int, d: int, noise: NoiseModel) -> None:
    problem = PGOProblem(ring(seed, n, d, noise))
    known = best_known(problem, seed)
    for poses in (chordal_start(problem), random_poses(n, d, seed)):
        assert_holds_together(problem, poses, certify(problem, poses), known)


@pytest.mark.parametrize("name", ["tinyGrid3D", "smallGrid3D"])
@settings(max_examples=examples(10))
@given(seed=SEEDS, spread=st.sampled_from([1.0, 1e6]))
def test_certificates_of_hostile_poses_hold_on_benchmarks(
    name: str, seed: int, spread: float, benchmark_problem: Callable[[str], PGOProblem]
) -> None:
    problem = benchmark_problem(name)
    poses = random_poses(problem.num_poses, problem.d, seed, spread)
    certificate = certify(problem, poses)
    assert_holds_together(problem, poses, certificate, OPTIMUM[name] + optimum_tolerance(name))
    # The chordal start polishes to the optimum there, so that the bound is as good as can be.
    assert certificate.lower_bound >= OPTIMUM[name] * (1 - DEFAULT_GAP)
    assert certificate.verdict is Verdict.NOT_CERTIFIED
    assert certificate.source in (BoundSource.POLISHED, BoundSource.CHORDAL)


@pytest.mark.parametrize("name", OPTIMUM)
def test_the_optimum_of_every_benchmark_is_certified(
    name: str,
    benchmark_problem: Callable[[str], PGOProblem],
    benchmark_optimum: Callable[[str], Poses],
) -> None:
    problem = benchmark_problem(name)
    poses = benchmark_optimum(name)
    certificate = certify(problem, poses)
    assert certificate.verdict is Verdict.CERTIFIED
    assert certificate.source is BoundSource.GIVEN
    assert certificate.stationarity <= STATIONARY_DECREMENT
    assert_holds_together(problem, poses, certificate, OPTIMUM[name] + optimum_tolerance(name))
    assert (
        certificate.lower_bound
        >= OPTIMUM[name] - optimum_tolerance(name) - DEFAULT_GAP * OPTIMUM[name]
    )


@BACKENDS
@pytest.mark.parametrize("scene", [circle, grid])
@pytest.mark.parametrize("seed", range(3))
def test_the_paper_s_networks_are_certified(
    backend: CholeskyBackend, scene: Callable[[np.random.Generator], PoseGraph], seed: int
) -> None:
    problem = PGOProblem(scene(np.random.default_rng(seed)), backend)
    poses = polish(problem, chordal_start(problem))
    certificate = certify(problem, poses)
    assert certificate.is_certified
    assert_holds_together(problem, poses, certificate, best_known(problem))


@settings(max_examples=examples(40))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_graphs_without_noise_are_certified(seed: int, n: int, d: int) -> None:
    graph = exact_graph(seed, n, d)
    problem = PGOProblem(graph)
    assert graph.truth is not None
    certificate = certify(problem, graph.truth)
    assert certificate.verdict is Verdict.EXACT
    assert (certificate.gap, certificate.lower_bound) == (0.0, 0.0)
    assert "fits to its last bits" in str(certificate)
    # A linear solve may leave a little more than the rounding of residuals.
    certificate = certify(problem, chordal_start(problem))
    assert certificate.verdict is Verdict.EXACT
    assert certificate.lower_bound == 0.0
    assert "fits to its last bits" in str(certificate) or certificate.objective_at_most < 1e-12
    # Poses elsewhere have no bound but zero.
    certificate = certify(problem, random_poses(n, d, seed))
    assert (certificate.verdict, certificate.lower_bound) == (Verdict.TRIVIAL, 0.0)


# What was done is said.


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_poses_that_are_not_stationary_are_polished_and_said_so(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    start = chordal_start(problem)
    stationary = polish(problem, start)
    given_ones = certify(problem, stationary)
    assume(given_ones.is_certified)  # as nearly all are with this noise
    assert given_ones.source is BoundSource.GIVEN
    assert given_ones.poses is stationary
    nudged = Poses(start.R, start.t + 1e-3 * np.random.default_rng(seed).standard_normal((n, d)))
    polished = certify(problem, nudged)
    assert polished.source is BoundSource.POLISHED
    assert polished.stationarity > STATIONARY_DECREMENT
    assert polished.objective == problem.objective(nudged) > polished.poses_objective
    assert polished.lower_bound == pytest.approx(
        given_ones.lower_bound, rel=DEFAULT_GAP, abs=DEFAULT_GAP
    )


def test_beside_a_bad_local_minimum_the_chordal_start_gives_the_bound() -> None:
    graph = ring(0, 12, 2, NoiseModel(0.05, 0.01))
    problem = PGOProblem(graph)
    assert graph.truth is not None
    start = wound(graph.truth)
    local = polish(problem, start)
    best = polish(problem, chordal_start(problem))
    assert relative_decrement(problem, local) <= STATIONARY_DECREMENT
    assert problem.objective(local) > 10 * problem.objective(best)
    for poses in (local, start):
        certificate = certify(problem, poses)
        assert certificate.source is BoundSource.CHORDAL
        assert certificate.verdict is Verdict.NOT_CERTIFIED
        assert certificate.poses_objective == pytest.approx(problem.objective(best), rel=1e-12)
        assert_holds_together(problem, poses, certificate, rounded_up(problem, best))
    alone = certify_at(problem, local)
    assert alone.source is BoundSource.GIVEN
    assert not alone.is_certified
    assert alone.lower_bound < certificate.lower_bound


def test_beside_a_saddle_the_chordal_start_gives_better_poses() -> None:
    # Newton stays at an exact saddle; no bound but zero is to be had, at either point, as the
    # optimum is zero.
    i = np.zeros(1, dtype=int)
    j = np.ones(1, dtype=int)
    turn = np.eye(2)[None]
    problem = PGOProblem(PoseGraph(2, i, j, turn, np.zeros((1, 2)), np.ones(1), np.ones(1)))
    saddle = Poses(exp_map(np.array([[0.0], [np.pi]])), np.zeros((2, 2)))
    certificate = certify(problem, saddle)
    assert certificate.objective == pytest.approx(8.0)
    assert certificate.lower_bound == 0.0
    assert certificate.verdict is Verdict.TRIVIAL
    assert certificate.source is BoundSource.CHORDAL
    assert certificate.poses_objective <= 1e-20


# Measurements that are plain wrong, and noise beyond what the relaxation bears.


@settings(max_examples=examples(40))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_a_measurement_turned_by_half_a_turn_does_not_break_the_bound(
    seed: int, n: int, d: int
) -> None:
    graph = varied_graph(seed, n, d)
    rng = np.random.default_rng(seed)
    R_ij = graph.R_ij.copy()
    axis = np.pi * (np.ones((1, 1)) if d == 2 else np.eye(3)[rng.integers(3)][None])
    R_ij[rng.integers(graph.num_edges)] @= exp_map(axis)[0]
    problem = PGOProblem(replace(graph, R_ij=R_ij))
    assert graph.truth is not None
    known = best_known(problem, seed)
    for poses in (chordal_start(problem), graph.truth, polish(problem, graph.truth)):
        assert_holds_together(problem, poses, certify(problem, poses), known)


@pytest.mark.parametrize("d", [2, 3])
def test_a_measurement_turned_by_half_a_turn_changes_the_verdict(d: int) -> None:
    graph = ring(0, 8, d, NoiseModel(0.05, 0.05))
    problem = PGOProblem(graph)
    assert certify(problem, polish(problem, chordal_start(problem))).is_certified
    R_ij = graph.R_ij.copy()
    R_ij[3] @= exp_map(np.pi * np.eye(d)[:1, : d * (d - 1) // 2])[0]
    turned = PGOProblem(replace(graph, R_ij=R_ij))
    poses = polish(turned, chordal_start(turned))
    certificate = certify(turned, poses)
    assert not certificate.is_certified
    assert_holds_together(turned, poses, certificate, best_known(turned))


@pytest.mark.parametrize(
    ("seed", "n", "d", "is_certified"),
    [(15, 6, 2, True), (29, 6, 2, False), (22, 6, 3, True), (17, 10, 3, True)],
)
def test_where_the_relaxation_is_not_tight_the_bound_holds(
    seed: int, n: int, d: int, is_certified: bool
) -> None:
    """Complex numbers in the plane and handedness terms in space certify more than it can."""
    problem = PGOProblem(ring(seed, n, d, NoiseModel(0.1, 0.5)))
    starts = [chordal_start(problem), *(random_poses(n, d, k) for k in range(40))]
    candidates = [polish(problem, start) for start in starts]
    best = min(candidates, key=problem.objective)
    known = problem.objective(best)
    relaxed = best_bound(problem, multipliers(problem, best), best, 1e-6, known)
    assert relaxed.value < 0.99 * known
    certificate = certify(problem, best)
    assert certificate.is_certified == is_certified
    assert (certificate.bound.terms is not None) == (d == 3)
    assert certificate.bound.is_complex == (d == 2)
    assert ("rotations as complex numbers" in certificate.proof) == (d == 2)
    assert_holds_together(problem, best, certificate, known)


# Settings and wrong inputs.


@pytest.mark.parametrize("gap", [1e-9, 1e-6, 1e-3, 0.1])
def test_the_bound_does_not_depend_on_the_gap_asked_for(gap: float) -> None:
    problem = PGOProblem(grid(np.random.default_rng(0)))
    certificate = certify(problem, polish(problem, chordal_start(problem)), gap)
    assert certificate.is_certified
    assert certificate.wanted_gap == gap
    assert (certificate.eta, certificate.bound.is_grounded) == (0.0, True)
    assert certificate.gap <= 1e-13
    assert certificate.digits >= 13


@pytest.mark.parametrize("gap", [1.0, 2.0, 1e300])
def test_no_gap_is_so_wide_that_the_trivial_bound_certifies(gap: float) -> None:
    problem = varied_problem(0, 8, 3)
    certificate = certify_at(problem, random_poses(8, 3, 0), gap)
    assert (certificate.verdict, certificate.lower_bound) == (Verdict.TRIVIAL, 0.0)


def test_a_gap_below_rounding_is_not_certified_but_bounded() -> None:
    problem = PGOProblem(grid(np.random.default_rng(0)))
    poses = polish(problem, chordal_start(problem))
    certificate = certify(problem, poses, 1e-18)
    assert not certificate.is_certified
    assert certificate.gap <= 1e-13
    assert_holds_together(problem, poses, certificate, rounded_up(problem, poses))


@pytest.mark.parametrize("seed", [0, 1])
def test_after_the_deadline_the_first_shift_that_proves_something_ends_the_search(
    seed: int,
) -> None:
    problem = PGOProblem(
        random_geometric(60, np.random.default_rng(seed), noise=NoiseModel(0.3, 0.3))
    )
    start = chordal_start(problem)
    full = certify_at(problem, start)
    cut = certify_at(problem, start, deadline=0.0)
    optimum = polish(problem, start)
    assert full.eta > 0.0
    assert 0.0 < cut.lower_bound <= full.lower_bound <= problem.objective(optimum)
    half_of_trace = 0.5 * problem.objective(problem.at_best_translations(start))
    assert cut.lower_bound == pytest.approx(half_of_trace, rel=1e-9)
    assert certify_at(problem, optimum, deadline=0.0).is_certified


def test_other_poses_are_judged_against_a_certificate() -> None:
    problem = varied_problem(0, 8, 3)
    best = polish(problem, chordal_start(problem))
    certificate = certify(problem, best)
    other = random_poses(8, 3, 0)
    judged = judge(problem, other, certificate)
    assert judged.lower_bound == certificate.lower_bound
    assert judged.objective == problem.objective(other)
    assert judged.gap == pytest.approx(1.0 - certificate.lower_bound / judged.objective)
    assert (certificate.verdict, judged.verdict) == (Verdict.CERTIFIED, Verdict.NOT_CERTIFIED)


@pytest.mark.parametrize("gap", [0.0, -1e-6, math.nan, math.inf])
def test_the_gap_must_be_positive(gap: float) -> None:
    problem = varied_problem(0, 4, 3)
    with pytest.raises(SettingError, match="give a positive relative gap"):
        certify(problem, Poses.identity(4, 3), gap)


def test_it_prints_what_it_says() -> None:
    problem = varied_problem(0, 8, 3)
    poses = polish(problem, chordal_start(problem))
    text = str(certify(problem, poses))
    assert "CERTIFIED: globally optimal within the gap asked for" in text
    assert "at the poses given" in text
    assert "best known F" not in text
    text = str(certify(problem, random_poses(8, 3, 0)))
    assert "NOT_CERTIFIED" in text
    assert "best known F" in text
    exact = PGOProblem(exact_graph(0, 5, 2))
    assert "F is never negative" in str(certify(exact, chordal_start(exact)))


def test_a_graph_is_judged_like_its_problem() -> None:
    problem = varied_problem(0, 8, 3)
    poses = chordal_start(problem)
    assert certify(problem.graph, poses).lower_bound == certify(problem, poses).lower_bound


def test_multipliers_of_a_certificate_cannot_be_changed() -> None:
    problem = varied_problem(0, 8, 3)
    certificate = certify_at(problem, polish(problem, chordal_start(problem)))
    with pytest.raises(ValueError, match="read-only"):
        certificate.Lambda[:] = 0.0


def test_a_gap_is_written_with_the_digits_that_it_proves() -> None:
    found = certify(
        grid(np.random.default_rng(0)), chordal_start(PGOProblem(grid(np.random.default_rng(0))))
    )
    whole = replace(found, objective=2.0**60, objective_error=0.0)
    near = replace(whole, bound=replace(found.bound, value=2.0**60 - 2.0**20))
    assert near.gap_text == "9.1e-13, proven to 12 digits"
    far = replace(whole, bound=replace(found.bound, value=0.75 * 2.0**60))
    assert (far.gap_text, far.digits) == ("0.25", 0)
    to_rounding = replace(near, verdict=Verdict.EXACT, fit=FITS_WITHOUT_EDGES)
    assert to_rounding.gap_text == "0: every edge fits to its rounding"
    assert to_rounding.verdict_text.endswith("globally optimal: every edge fits to its last bits")
    to_digits = replace(near, verdict=Verdict.EXACT, fit=Fit(is_exact=True, share=2e-9, units=0.7))
    assert to_digits.gap_text == "9.1e-13, of a cost that the last digits of the edges explain"
    assert "to 0.7 units of the last digit" in to_digits.verdict_text
    # Of exact poses, too, no more is said to be proven than is.
    for exact in (to_rounding, to_digits):
        assert (exact.digits, exact.proven_gap) == (near.digits, near.proven_gap)
    assert (to_rounding.printed_gap, to_digits.printed_gap) == (0.0, near.proven_gap)


def test_the_verdict_compares_what_is_proven() -> None:
    """The gap as computed leaves out the rounding of the cost."""
    problem = PGOProblem(grid(np.random.default_rng(0)))
    poses = polish(problem, chordal_start(problem))
    first = certify(problem, poses)
    assert 0.0 < first.gap < first.proven_gap < 1e-12
    enough = certify(problem, poses, first.proven_gap)
    assert enough.verdict is Verdict.CERTIFIED
    for gap in (first.gap, 0.5 * (first.gap + first.proven_gap), 0.1 * first.gap):
        certificate = certify(problem, poses, gap)
        assert certificate.verdict is Verdict.NOT_CERTIFIED
        assert certificate.verdict_text.endswith("and rounding in doubles leaves no smaller one")
        # No time is spent on other poses, whose rounding is the same.
        assert (certificate.is_hidden_by_rounding, certificate.can_improve) == (True, False)
        assert certificate.source is BoundSource.GIVEN


def test_a_gap_that_other_poses_may_close_is_no_matter_of_rounding() -> None:
    problem = varied_problem(0, 8, 3)
    certificate = certify(problem, random_poses(8, 3, 0))
    assert (certificate.verdict, certificate.is_hidden_by_rounding) == (
        Verdict.NOT_CERTIFIED,
        False,
    )
    assert certificate.can_improve
    assert certificate.verdict_text == f"NOT_CERTIFIED: {Verdict.NOT_CERTIFIED.value}"


@settings(max_examples=examples(30))
@given(seed=SEEDS, d=DIMENSIONS, noise=st.floats(-9.0, -5.0), gap=st.sampled_from([1e-6, 1e-9]))
def test_no_printed_gap_of_a_certified_solution_is_above_the_one_asked_for(
    seed: int, d: int, noise: float, gap: float
) -> None:
    """Where noise is small the rounding of the cost is as large as the gap."""
    graph = varied_graph(seed, 10, d, NoiseModel(10.0**noise, 10.0**noise))
    problem = PGOProblem(graph)
    certificate = certify(problem, polish(problem, chordal_start(problem)), gap)
    if certificate.verdict is Verdict.CERTIFIED:
        assert certificate.proven_gap <= gap
        assert float(certificate.gap_text.split(",")[0]) <= gap * (1.0 + 1e-2)


@pytest.mark.parametrize("seed", range(5))
def test_the_error_of_the_cost_is_that_of_the_poses_judged(seed: int) -> None:
    problem = varied_problem(seed, 8, 3)
    poses = random_poses(8, 3, seed)
    certificate = certify(problem, poses)  # bound elsewhere, at polished poses
    rounding = objective_rounding(problem, poses)
    assert certificate.objective_error == rounding.error
    assert (
        certificate.objective
        < certificate.objective_at_most
        <= certificate.objective + 2.0 * rounding.error
    )
    assert certificate.proven_gap >= certificate.gap


@settings(max_examples=examples(10))
@given(seed=SEEDS, d=DIMENSIONS)
def test_stationary_poses_are_not_called_others(seed: int, d: int) -> None:
    """The bound on chi2 is found at the stationary point to the last digit, all the same."""
    graph = informed(seed, 8, d, coupled=True, spread=0.5)
    problem = PGOProblem(graph, weighting=Weighting.INFORMATION)
    start = chordal_start(problem.convex_part)
    stationary = polish(problem, start)
    for poses in (start, stationary):
        certificate = certify(problem, poses)
        text = str(certificate)
        is_stationary = certificate.stationarity <= STATIONARY_DECREMENT
        assert "which were not stationary" not in text or not is_stationary
        assert "which were stationary" not in text or is_stationary
    assert certificate.source in (BoundSource.REFINED, BoundSource.CHORDAL, BoundSource.SOFTENED)
