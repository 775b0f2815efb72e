import itertools
from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from graphs import OPTIMUM, informed, spread_graph, wound_ring
from hypothesis import example, given, settings, strategies as st

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel, Verdict, Weighting
from pgo_models.certificates.certificate import DEFAULT_GAP, BoundSource
from pgo_models.errors import GraphError, SettingError
from pgo_models.graphs.trajectories import read_times
from solvers import SweptScene
from solvers.soc.soc import WARM_START_TOLERANCE
from solvers.studies.tightness import noisy_scene


@pytest.mark.parametrize("name", OPTIMUM)
def test_every_benchmark_file_is_solved_to_the_published_optimum_and_certified(
    name, benchmark_data
):
    graph = pgo.read_g2o(benchmark_data / f"{name}.g2o")
    solution = solvers.solve(pgo.PGOProblem(graph, weighting=pgo.Weighting.ISOTROPIC))
    assert solution.status is solvers.Status.CONVERGED
    assert solution.certificate.verdict is Verdict.CERTIFIED
    assert 0 <= solution.gap <= 1e-10
    # FRH's published figure has nine decimals, the others eight digits and more.
    np.testing.assert_allclose(solution.objective, OPTIMUM[name], rtol=1e-8, atol=0.5e-9)


@pytest.mark.parametrize("name", ["example_4robots", "example_16robots"])
def test_folders_of_robots_are_solved_as_they_are(name, benchmark_data):
    graph = pgo.read_g2o(benchmark_data / name)
    robots = pgo.partition(graph)
    assert robots.num_robots == int("".join(filter(str.isdigit, name)))
    solution = solvers.solve(
        graph, solvers.Pipeline(soc=solvers.SOC(robots=robots, tolerance=WARM_START_TOLERANCE))
    )
    assert solution.is_certified


@settings(deadline=None, max_examples=examples(15))
@given(seed=st.integers(0, 10**6), d=st.sampled_from([2, 3]), rotation_std=st.floats(0.01, 2.0))
def test_the_bound_holds_and_the_solution_is_no_worse_than_the_start_at_any_noise(
    seed, d, rotation_std
):
    rng = np.random.default_rng(seed)
    graph = pgo.random_geometric(20, rng, d=d, noise=NoiseModel(0.3, rotation_std))
    problem = pgo.PGOProblem(graph)
    start = pgo.chordal_start(problem)
    solution = solvers.solve(problem)
    from_truth = problem.objective(solvers.polish(problem, graph.truth))
    assert solution.objective <= problem.objective(start) * (1 + 1e-12)
    assert solution.lower_bound <= min(solution.objective, from_truth) * (1 + 1e-12)
    assert solution.is_certified == (solution.gap <= solution.certificate.wanted_gap)


def test_the_result_is_aligned_with_the_estimate_that_came_with_the_graph():
    graph = pgo.circle(np.random.default_rng(0))
    solution = solvers.solve(graph)
    again = solution.poses.aligned_to(graph.initial)
    np.testing.assert_allclose(solution.poses.t, again.t, rtol=0, atol=1e-10)
    np.testing.assert_allclose(solution.poses.R, again.R, rtol=0, atol=1e-10)


def test_without_an_estimate_pose_0_is_the_identity():
    graph = pgo.circle(np.random.default_rng(0))
    solution = solvers.solve(replace(graph, initial=None))
    np.testing.assert_allclose(solution.poses.R[0], np.eye(3), rtol=0, atol=1e-12)
    np.testing.assert_allclose(solution.poses.t[0], 0, rtol=0, atol=1e-12)


def test_a_bad_start_is_rescued_by_other_starts():
    problem, wound = wound_ring(20, 2)
    stuck = solvers.solve(
        problem, solvers.Pipeline(soc=None, other_starts=False, staircase=None), wound
    )
    rescued = solvers.solve(problem, solvers.Pipeline(soc=None, staircase=None), wound)
    assert not stuck.is_certified
    assert rescued.is_certified
    assert rescued.objective < 0.1 * stuck.objective
    assert stuck.lower_bound <= rescued.objective


@pytest.mark.parametrize("d", [2, 3])
def test_a_bad_start_is_rescued_by_the_relaxation(d):
    problem, wound = wound_ring(20, d)
    solution = solvers.solve(problem, solvers.Pipeline(soc=None, other_starts=False), wound)
    relaxation = ["ComplexRelaxation"] if d == 2 else ["Staircase", "Newton"]
    taken = [stage.name for stage in solution.stages if stage.was_taken]
    assert taken == ["given start", "Newton", *relaxation]
    assert solution.is_certified
    assert solution.certificate.source is BoundSource.GIVEN
    assert solution.objective < 0.1 * solution.stages[1].objective
    assert solution.objective == pytest.approx(solvers.solve(problem).objective, rel=1e-10)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_where_the_relaxation_is_not_tight_its_bound_is_reported(seed):
    problem = pgo.PGOProblem(
        noisy_scene(SweptScene.GRID, np.deg2rad(90.0), np.random.default_rng(seed))
    )
    without = solvers.solve(problem, solvers.Pipeline(staircase=None, handedness=None))
    solution = solvers.solve(problem, solvers.Pipeline(handedness=None))
    assert solution.certificate.source is BoundSource.RELAXATION
    assert solution.certificate.verdict is Verdict.NOT_CERTIFIED
    assert solution.objective <= without.objective
    assert without.lower_bound < solution.lower_bound < solution.objective
    assert solution.gap == pytest.approx(
        (solution.objective - solution.lower_bound) / solution.objective
    )
    relaxed = solvers.run(solvers.Staircase(), problem)
    assert solution.lower_bound == pytest.approx(relaxed.state.point.value, rel=2 * DEFAULT_GAP)
    certificate = solution.certificate
    assert pgo.prove_bound(problem, certificate.Lambda, certificate.eta) == solution.lower_bound


def test_a_staircase_that_is_cut_short_gives_a_valid_bound():
    problem, wound = wound_ring(20, 3)
    cut = solvers.Pipeline(
        soc=None,
        growing=None,
        other_starts=False,
        staircase=solvers.Staircase(max_iterations=8),
    )
    solution = solvers.solve(problem, cut, wound)
    assert solution.stages[2].status is solvers.Status.MAX_ITERATIONS
    assert solution.objective <= solution.stages[1].objective
    assert solution.lower_bound <= solvers.solve(problem).objective


def test_a_time_limit_ends_the_run_with_its_status_and_a_valid_bound():
    problem = pgo.PGOProblem(
        pgo.random_geometric(300, np.random.default_rng(0), noise=NoiseModel(0.3, 0.3))
    )
    optimum = solvers.solve(problem).objective
    solution = solvers.solve(problem, time_limit=1e-9)
    assert solution.status is solvers.Status.TIME_LIMIT
    assert solution.lower_bound <= optimum * (1 + 1e-12)


@pytest.mark.parametrize("robots", [None, 2])
def test_out_of_time_the_search_for_a_bound_ends_with_its_first_proof_and_says_so(
    robots, monkeypatch
):
    monkeypatch.setattr("time.perf_counter", itertools.count().__next__)  # a second a call
    noise = NoiseModel(0.2, 0.2)
    problem = pgo.PGOProblem(pgo.random_geometric(1001, np.random.default_rng(0), noise=noise))
    cut = solvers.solve(problem, time_limit=1e-9, robots=robots)
    assert cut.status is solvers.Status.TIME_LIMIT
    assert "out of time for a bound" in cut.note
    best_translations = problem.at_best_translations(cut.poses)
    half_of_trace = 0.5 * problem.objective(best_translations)
    assert cut.lower_bound == pytest.approx(half_of_trace, rel=0.01)
    if robots is None:  # a SOC that was not asked for sets up nothing after the time limit
        assert [stage.name for stage in cut.stages] == ["chordal start", "Newton"]


def test_a_search_for_a_bound_that_takes_no_time_is_not_cut_by_the_time_limit(monkeypatch):
    seconds = itertools.count()
    monkeypatch.setattr("time.perf_counter", lambda: 1e-6 * next(seconds))
    noise = NoiseModel(0.3, 0.3)
    problem = pgo.PGOProblem(pgo.random_geometric(300, np.random.default_rng(0), noise=noise))
    solution = solvers.solve(problem, time_limit=1e-9)
    assert solution.status is solvers.Status.TIME_LIMIT
    full = pgo.certify_at(problem, solution.poses)
    assert full.eta > 0.0
    assert solution.lower_bound == pytest.approx(full.lower_bound, rel=1e-12)


def test_a_disconnected_graph_is_refused_with_its_components_named():
    R = np.broadcast_to(np.eye(2), (2, 2, 2))
    t = np.ones((2, 2))
    graph = pgo.PoseGraph(4, np.array([0, 2]), np.array([1, 3]), R, t, np.ones(2), np.ones(2))
    with pytest.raises(GraphError, match="2 components"):
        solvers.solve(graph)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda problem: solvers.solve("grid"),
            r"solve: problem must be a PGOProblem or a PoseGraph, got 'grid'; .*load\(\.\.\)",
        ),
        (
            lambda problem: solvers.run(solvers.Newton(), "grid"),
            "Newton: problem must be a PGOProblem, got 'grid'",
        ),
        (
            lambda problem: solvers.solve(problem, solvers.SOC()),
            r"pipeline must be a Pipeline .* got SOC.*; give Pipeline\(soc=SOC\(..\)\)",
        ),
        (
            lambda problem: solvers.solve(problem, robots=True),
            "robots must be .* a whole number or None, got True",
        ),
        (
            lambda problem: solvers.solve(problem, robots=2.5),
            r"robots must be .* a whole number or None, got 2\.5",
        ),
        (
            lambda problem: solvers.solve(problem, robots="2"),
            "robots must be .* a whole number or None, got '2'",
        ),
        (
            lambda problem: solvers.certify(problem, problem.graph.truth.R),
            r"poses must be Poses .*, got an array of shape \(27, 3, 3\).*; give Poses\(R, t\), or",
        ),
        (
            lambda problem: solvers.solve(problem, start=problem.graph.truth.R),
            "start must be Poses or None, got an array .*; give Poses",
        ),
        (lambda problem: problem.objective(None), "poses are a NoneType; give Poses"),
    ],
)
def test_what_is_given_in_the_wrong_place_is_named_with_the_right_call(call, message):
    with pytest.raises(pgo.PGOError, match=message):
        call(pgo.PGOProblem(pgo.grid(np.random.default_rng(0))))


@pytest.mark.parametrize("factor", [1 - 2e-7, 1 - 1e-10])
def test_poses_that_are_nearly_rotations_are_not_below_the_optimum(factor):
    problem = pgo.PGOProblem(pgo.grid(np.random.default_rng(0)))
    optimum = solvers.solve(problem, solvers.Pipeline(gap=1e-12))
    shrunk = factor * optimum.poses.R
    near = pgo.Poses(shrunk, optimum.poses.t)
    # In the equation itself, at the matrices as they are given, F is lower by about that factor.
    X = np.concatenate(
        [problem.with_best_translations(shrunk).t, np.swapaxes(shrunk, 1, 2).reshape(-1, 3)]
    )
    assert problem.at_point(X).value < optimum.objective * (1 - 1e-11)
    assert problem.objective(near) >= optimum.objective * (1 - 1e-14)
    assert problem.objective(problem.with_best_translations(shrunk)) >= optimum.objective * (
        1 - 1e-14
    )


UNITS = {
    "seed": st.integers(0, 2**32 - 1),
    "weights": st.sampled_from([1e-9, 1e-3, 1e3, 1e9]),
    "metres": st.sampled_from([1e-3, 1.0, 1e3]),
    "d": st.sampled_from([2, 3]),
}


@settings(max_examples=examples(20))
@given(**UNITS)
def test_units_change_neither_verdict_nor_iterations_nor_digits(seed, weights, metres, d):
    graph = pgo.random_geometric(30, np.random.default_rng(seed), d=d)
    kappa = weights * graph.kappa
    tau = weights * graph.tau / metres**2
    scaled = replace(
        graph, kappa=kappa, tau=tau, t_ij=metres * graph.t_ij, initial=None, truth=None
    )
    one = solvers.solve(replace(graph, initial=None, truth=None))
    other = solvers.solve(scaled)
    assert other.certificate.verdict is one.certificate.verdict
    assert [stage.iterations for stage in other.stages] == [
        stage.iterations for stage in one.stages
    ]
    assert other.objective == pytest.approx(weights * one.objective, rel=1e-9)
    assert abs(other.certificate.digits - one.certificate.digits) <= 1
    for poses in (pgo.spanning_tree_start(graph), pgo.chordal_start(one.problem)):
        theirs = solvers.certify(one.problem, poses)
        moved = solvers.certify(other.problem, pgo.Poses(poses.R, metres * poses.t))
        assert moved.verdict is theirs.verdict
        assert moved.gap == pytest.approx(theirs.gap, rel=1e-6)


@settings(max_examples=examples(20))
@given(
    **UNITS,
    coupled=st.booleans(),
    spread=st.sampled_from([0.1, 0.3, 1.0]),
    robots=st.sampled_from([None, 2]),
)
@example(seed=3173635, weights=1e-9, metres=1e-3, d=3, coupled=False, spread=1.0, robots=2)
def test_units_change_nothing_of_chi2_either(seed, weights, metres, d, coupled, spread, robots):
    graph = replace(
        informed(seed, 15, d, coupled, spread, NoiseModel(0.01, 0.01)), initial=None, truth=None
    )
    unit = np.ones(graph.information.shape[1])
    unit[:d] = 1.0 / metres
    information = weights * unit[:, None] * graph.information * unit
    precisions = {"kappa": weights * graph.kappa, "tau": weights * graph.tau / metres**2}
    scaled = replace(graph, information=information, t_ij=metres * graph.t_ij, **precisions)
    one, other = (
        solvers.solve(pgo.PGOProblem(g, weighting=Weighting.INFORMATION), robots=robots)
        for g in (graph, scaled)
    )
    assert other.certificate.verdict is one.certificate.verdict
    assert [stage.name for stage in other.stages] == [stage.name for stage in one.stages]
    for stage, same in zip(other.stages, one.stages, strict=True):
        # Newton goes down to rounding, where one iteration more or less is rounding, too.
        assert abs(stage.iterations - same.iterations) <= (stage.name == "Newton")
    level = 10.0 * other.certificate.rounding_level  # of trees, whose measurements agree
    assert other.objective == pytest.approx(weights * one.objective, rel=1e-9, abs=level)
    assert abs(other.certificate.digits - one.certificate.digits) <= 1


def test_several_fixed_poses_are_refused_unless_one_is_chosen():
    graph = replace(pgo.grid(np.random.default_rng(0)), fixed=np.array([7, 3]))
    with pytest.raises(SettingError, match=r"FIX lines hold 2 poses, 7 and 3 .*--anchor 7"):
        solvers.solve(graph)
    assert solvers.solve(graph, anchor=3).anchor == 3
    beside_priors = graph.with_position_prior(np.arange(5), graph.truth.t[:5], tau=1.0)
    with pytest.raises(SettingError, match="remove them, as the priors hold the frame"):
        solvers.solve(beside_priors)


def test_a_solution_says_in_which_frame_it_is():
    graph = pgo.grid(np.random.default_rng(0))
    bare = replace(graph, initial=None)
    near = graph.truth.moved(
        pgo.random_rotations(1, 3, np.random.default_rng(1))[0], np.array([1.0, 2.0, 3.0])
    )
    known = replace(graph, initial=near)
    for start, anchor, frame, held in (
        (bare, None, "pose 0 at the identity", 0),
        (bare, 5, "pose 5 at the identity, as asked for", 5),
        (replace(bare, fixed=np.array([7])), None, "pose 7 at the identity, by its FIX line", 7),
        (known, None, "aligned with the estimate that came with the graph", None),
        (known, 5, "pose 5 where the estimate has it, as asked for", 5),
        (
            replace(known, fixed=np.array([7])),
            5,
            "pose 5 where the estimate has it, as asked for",
            5,
        ),
        (
            replace(known, fixed=np.array([7, 3])),
            3,
            "pose 3 where the estimate has it, as asked for",
            3,
        ),
    ):
        solution = solvers.solve(start, anchor=anchor)
        assert solution.frame == frame
        assert f"frame        {frame}" in str(solution)
        assert solution.as_json()["frame"] == frame
        assert solution.objective == pytest.approx(solution.certificate.objective, rel=1e-12)
        if held is not None:
            pose = (
                start.initial[np.array([held])]
                if start.initial is not None
                else pgo.Poses.identity(1, 3)
            )
            np.testing.assert_allclose(solution.poses.R[held], pose.R[0], rtol=0, atol=1e-14)
            np.testing.assert_allclose(solution.poses.t[held], pose.t[0], rtol=0, atol=1e-14)
    for anchor in (-1, 27):
        with pytest.raises(SettingError, match=f"anchor is {anchor}; give a pose, 0 to 26"):
            solvers.solve(graph, anchor=anchor)


def test_times_go_along_and_are_written(tmp_path):
    graph = pgo.circle(np.random.default_rng(0))
    times = 100.0 + 0.1 * np.arange(graph.num_poses)
    solution = solvers.solve(replace(graph, times=times))
    solution.save(tmp_path / "poses.tum")
    np.testing.assert_array_equal(read_times(tmp_path / "poses.tum"), times)
    np.testing.assert_array_equal(
        replace(graph, times=times).subgraph(np.array([3, 1])).times, times[[1, 3]]
    )
    with pytest.raises(GraphError, match="times do not ascend"):
        replace(graph, times=times[::-1])
    with pytest.raises(GraphError, match="times has shape"):
        replace(graph, times=times[1:])


@pytest.mark.parametrize(
    ("robots", "d", "seed"),
    [(None, 2, 5), (None, 2, 16), (None, 3, 4), (None, 3, 8), (2, 2, 5), (2, 2, 16), (2, 3, 8)],
)
def test_weights_too_far_apart_for_doubles_end_in_a_solution(robots, d, seed):
    problem = pgo.PGOProblem(spread_graph(seed, 9, d))
    solution = solvers.solve(problem, robots=robots, progress=False)
    assert solution.objective == problem.objective(solution.poses)
    assert solution.objective <= 1e18  # of poses, not of what overflowed
    assert solution.lower_bound <= solution.objective


@pytest.mark.parametrize("seed", [141, 181])
def test_newton_of_a_graph_with_landmarks_goes_on_to_its_end(seed: int) -> None:
    """The first attempt's has few steps, and no other attempt follows where they close the gap."""
    rng = np.random.default_rng(seed)
    num_poses = int(rng.integers(20, 55))
    spread = float(rng.choice([0.5, 1.5, 4.0]))
    noise = pgo.NoiseModel(spread, float(rng.choice([0.3, 0.8, 2.0])))
    graph = pgo.victoria_park(rng, num_poses=num_poses, noise=noise)
    problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.INFORMATION)
    assert solvers.solve(problem).status is solvers.Status.CONVERGED
