"""`solve`, step by step: what it returns, how it ends, and how it goes on with a larger graph."""

import pickle

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, varied_graph
from hypothesis import given, settings, strategies as st

import pgo_models as pgo
import solvers


@pytest.fixture(scope="module")
def solution() -> solvers.Solution:
    return solvers.solve(pgo.load("grid"))


@given(seed=SEEDS, n=st.integers(3, 12), d=DIMENSIONS)
def test_a_solution_is_certified_and_its_numbers_agree(seed, n, d):
    problem = pgo.PGOProblem(varied_graph(seed, n, d))
    found = solvers.solve(problem)
    assert found.verdict in (pgo.Verdict.CERTIFIED, pgo.Verdict.EXACT)
    assert found.objective == pytest.approx(problem.objective(found.poses), rel=1e-9, abs=1e-20)
    assert found.lower_bound <= found.objective
    assert found.gap == found.certificate.gap


def test_stages_are_steps_of_the_solve_in_their_order(solution):
    names = [stage.name for stage in solution.stages]
    assert names.index("chordal start") < names.index("Newton")
    assert all(np.isfinite(stage.objective) for stage in solution.stages)


@pytest.mark.parametrize("method", [solvers.SOC(), solvers.PaperSOC()], ids=["SOC", "PaperSOC"])
def test_a_first_stage_that_is_asked_for_runs(method):
    found = solvers.solve(pgo.load("circle"), solvers.Pipeline(soc=method))
    assert found.is_certified
    assert any(type(method).__name__ in stage.name for stage in found.stages)


def test_a_start_near_the_optimum_is_used(solution):
    again = solvers.solve(solution.problem, start=solution.poses)
    assert again.objective == pytest.approx(solution.objective, rel=1e-12)
    assert again.is_certified


def test_out_of_time_returns_the_best_poses_and_says_so():
    found = solvers.solve(pgo.load("sphere"), time_limit=1e-9)
    assert not found.status.is_success
    assert np.isfinite(found.objective)
    assert "TIME_LIMIT" in str(found.status)


def test_a_callback_ends_the_stage_that_runs():
    seen = []

    def callback(state, record):
        seen.append(record.k)
        return len(seen) > 1

    found = solvers.solve(pgo.load("sphere"), callback=callback)
    assert solvers.Status.STOPPED in {stage.status for stage in found.stages}
    assert np.isfinite(found.objective)


def test_a_solution_is_printed_pickled_and_written(solution, tmp_path):
    assert "CERTIFIED" in str(solution)
    assert "\n" not in repr(solution)
    copy = pickle.loads(pickle.dumps(solution))
    np.testing.assert_array_equal(copy.poses.R, solution.poses.R)
    solution.save(tmp_path / "solved.g2o")
    written = pgo.read_g2o(tmp_path / "solved.g2o")
    assert pgo.chi2(written, written.initial) == pytest.approx(solution.objective, rel=1e-9)
    record = solution.as_json()
    assert record["verdict"] == "CERTIFIED"


def test_an_anchor_stays_where_the_estimate_has_it():
    graph = pgo.load("grid")
    found = solvers.solve(graph, anchor=4)
    assert found.anchor == 4
    assert found.is_certified


def test_a_graph_that_grows_is_solved_again_from_the_solution_before():
    graph = pgo.grid_world(1, 60, 2, d=2)
    before = solvers.solve(graph.without_edges(np.arange(graph.num_edges) == graph.num_edges - 1))
    after = solvers.extend(before, graph)
    afresh = solvers.solve(graph)
    assert after.is_certified
    assert after.objective == pytest.approx(afresh.objective, rel=1e-6)


def test_another_graph_is_no_extension(solution):
    with pytest.raises(pgo.PGOError, match="none of the measurements"):
        solvers.extend(solution, pgo.load("circle"))


def test_readings_of_a_file_are_compared(tmp_path):
    pgo.write_g2o(pgo.grid_world(1, 40, 0, d=2), tmp_path / "house.g2o")
    comparison = solvers.compare_readings(tmp_path / "house.g2o")
    assert comparison.written.times_expected == pytest.approx(1.0, abs=0.5)
    assert comparison.proposed == ()


def test_noise_is_estimated_from_residuals():
    graph = pgo.grid_world(1, 200, 0, noise=pgo.NoiseModel(0.1, 0.05))
    for level in solvers.estimate_noise(graph).levels:
        assert level.translation_std == pytest.approx(0.1, rel=0.4)
        assert level.rotation_std == pytest.approx(0.05, rel=0.4)


@given(seed=SEEDS)
@settings(max_examples=5)
def test_the_same_seed_gives_the_same_bits(seed):
    one, other = (solvers.solve(varied_graph(seed, 8, 3)) for _ in range(2))
    np.testing.assert_array_equal(one.poses.R, other.poses.R)
    assert one.lower_bound == other.lower_bound


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda: solvers.solve("sphere"), "PoseGraph"),
        (lambda: solvers.solve(pgo.load("grid"), robots=0), "robots"),
        (lambda: solvers.solve(pgo.load("grid"), solvers.SOC()), "Pipeline"),
        (lambda: solvers.solve(pgo.load("grid"), start=pgo.circle(0).truth), "pose"),
    ],
)
def test_a_wrong_thing_is_answered_in_one_sentence(wrong, words):
    with pytest.raises(pgo.PGOError, match=words) as caught:
        wrong()
    assert "\n" not in str(caught.value)
