"""The plan of a solve: the answer stands whatever goes wrong in a step that may improve it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from graphs import informed, planar_lattice, varied_graph

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel, PGOProblem, Weighting
from pgo_models.errors import GraphWarning, NotPositiveDefiniteError
from pgo_models.graphs.g2o import write_g2o_folder
from solvers import Status
from solvers.distributed.robots_of_graph import RobotsOfGraph
from solvers.distributed.robots_with_files import RobotsWithFiles
from solvers.handedness.ascent import HandednessAscent
from solvers.handedness.hull_lagrangian import HullLagrangian
from solvers.handedness.search import HandednessSearch
from solvers.here import Here
from solvers.place import Attempt, Place, Step
from solvers.plan import solve_at
from solvers.riemannian.prefixes import GrowingStart
from solvers.robust_solves.attempts import Estimate, PlacesOfEdges, Plan
from solvers.robust_solves.robust_solve import _RobustSolve

LOUD = NoiseModel(translation_std=1.0, rotation_std=1.0)
FIRST_ALONE = solvers.Pipeline(growing=None, second_try=False, staircase=None, handedness=None)
SHORT_SEARCH = HandednessSearch(
    HandednessAscent(max_iterations=2), HullLagrangian(max_iterations=2)
)
# Settings with which a step follows the first attempt at once, and the verb that it begins with.
PIPELINES = {
    Step.GROWING: replace(FIRST_ALONE, growing=GrowingStart(first_size=5)),
    Step.SECOND: replace(FIRST_ALONE, second_try=True),
    Step.STAIRCASE: replace(FIRST_ALONE, staircase=solvers.Staircase()),
    Step.SMALLER_MATRICES: replace(FIRST_ALONE, staircase=solvers.Staircase(max_iterations=1)),
    Step.COMPLEX: replace(FIRST_ALONE, staircase=solvers.Staircase(), handedness=SHORT_SEARCH),
    Step.TERMS: replace(FIRST_ALONE, handedness=SHORT_SEARCH),
    Step.HULLS: replace(FIRST_ALONE, handedness=SHORT_SEARCH),
}


def loose_problem(step: Step | None = None) -> PGOProblem:
    """A problem whose certificate stays open through all steps, and that suits a step.

    Complex numbers are for graphs in the plane, smaller matrices for chi2.
    """
    if step is Step.SMALLER_MATRICES:
        return loose_problem_of_chi2()
    graph = varied_graph(1, 10, 3, LOUD)
    if step is Step.COMPLEX:
        graph = planar_lattice(4, 4, 0.5)
    return PGOProblem(graph, weighting=Weighting.ISOTROPIC)


def loose_problem_of_chi2() -> PGOProblem:
    graph = informed(4, 10, 3, False, 2.0, NoiseModel(1.0, 0.7))
    return PGOProblem(graph, weighting=Weighting.INFORMATION)


VERBS = {
    Step.GROWING: "start_grown",
    Step.SECOND: "start_again",
    Step.STAIRCASE: "climb",
    Step.SMALLER_MATRICES: "bound_by_smaller_matrices",
    Step.COMPLEX: "solve_in_complex_numbers",
    Step.TERMS: "bound_by_terms",
    Step.HULLS: "solve_hulls",
}
FAILURES = [
    np.linalg.LinAlgError("the leading minor of order 3 of B is not positive definite"),
    ZeroDivisionError("float division by zero"),
    MemoryError("no room for the factor"),
    RuntimeError("Factor is exactly singular"),
    NotPositiveDefiniteError("no shift makes the matrix positive definite"),
]


def failing(error: BaseException) -> Callable[..., None]:
    def fail(*_: object) -> None:
        raise error

    return fail


@pytest.mark.parametrize("place", [Here, RobotsOfGraph])
@pytest.mark.parametrize("step", VERBS)
def test_a_step_that_fails_leaves_the_answer_before_it(
    step: Step, place: type[Place], monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = loose_problem(step)
    robots = 2 if place is RobotsOfGraph else None
    before = solvers.solve(problem, FIRST_ALONE, robots=robots)
    assert before.certificate.can_improve  # else the step would not be taken
    error = FAILURES[list(VERBS).index(step) % len(FAILURES)]
    monkeypatch.setattr(place, VERBS[step], failing(error))
    solution = solvers.solve(problem, PIPELINES[step], robots=robots)
    assert step.value in [stage.name for stage in solution.stages if stage.status is Status.FAILED]
    assert f"{step.value} failed ({error}); the answer before it stands" in solution.note
    assert solution.objective <= before.objective * (1 + 1e-12)
    assert solution.lower_bound >= before.lower_bound * (1 - 1e-9)
    assert solution.status is before.status
    assert str(error) in str(solution)


@pytest.mark.parametrize("error", FAILURES)
def test_no_failure_in_any_step_loses_the_answer(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = loose_problem()
    for verb in VERBS.values():
        monkeypatch.setattr(Here, verb, failing(error))
    solution = solvers.solve(problem)
    first = solvers.solve(problem, FIRST_ALONE)
    np.testing.assert_array_equal(solution.poses.t, first.poses.t)
    assert solution.certificate.verdict is first.certificate.verdict


@pytest.mark.parametrize("step", [Step.SECOND, Step.STAIRCASE])
def test_robots_with_own_files_keep_their_answer_too(
    step: Step, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = varied_graph(1, 10, 3, LOUD)
    write_g2o_folder(graph.with_robots(pgo.partition(graph, 3).robot), tmp_path)
    isotropic = Weighting.ISOTROPIC
    before = solvers.solve_folder(tmp_path, FIRST_ALONE, weighting=isotropic)
    monkeypatch.setattr(RobotsWithFiles, VERBS[step], failing(FAILURES[0]))
    solution = solvers.solve_folder(tmp_path, PIPELINES[step], weighting=isotropic)
    assert step.value in [stage.name for stage in solution.stages]
    assert f"{step.value} failed" in solution.note
    assert solution.certificate.objective <= before.certificate.objective * (1 + 1e-12)
    assert solution.status is before.status


@pytest.mark.parametrize("step", VERBS)
def test_ctrl_c_in_a_step_leaves_the_answer_and_its_bound(
    step: Step, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = loose_problem(step)
    before = solvers.solve(problem, FIRST_ALONE)
    monkeypatch.setattr(Here, VERBS[step], failing(KeyboardInterrupt()))
    solution = solvers.solve(problem, PIPELINES[step])
    assert solution.status is Status.INTERRUPTED
    assert solution.lower_bound >= before.lower_bound
    assert before.lower_bound > 0.0 or step is Step.COMPLEX
    assert solution.stages[-1].name == "interruption"


def test_an_error_of_the_program_is_not_taken_for_a_failure(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Here, "climb", failing(TypeError("a defect")))
    with pytest.raises(TypeError, match="a defect"):
        solvers.solve(loose_problem(), PIPELINES[Step.STAIRCASE])


def test_a_failure_in_smaller_matrices_leaves_the_bound_on_chi2(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = loose_problem_of_chi2()
    before = solvers.solve(problem, FIRST_ALONE)
    assert before.certificate.can_improve
    monkeypatch.setattr("solvers.here.with_shrunk_information", failing(FAILURES[0]))
    solution = solvers.solve(problem, PIPELINES[Step.SMALLER_MATRICES])
    assert Step.SMALLER_MATRICES.value in [stage.name for stage in solution.stages]
    assert solution.lower_bound >= before.lower_bound


@pytest.mark.parametrize("verb", ["chordal_start", "HandednessSearch.run"])
def test_certify_keeps_its_bound_where_a_search_for_a_better_one_fails(
    verb: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = loose_problem()
    poses = solvers.solve(problem, FIRST_ALONE).poses
    before = pgo.certify_at(problem, poses)
    monkeypatch.setattr(f"solvers.solves.given_poses.{verb}", failing(FAILURES[0]))
    with pytest.warns(GraphWarning, match="a search for a better bound failed"):
        certificate = solvers.certify(problem, poses)
    assert certificate.lower_bound >= before.lower_bound * (1 - 1e-9) > 0.0


def test_a_robust_solve_keeps_its_attempt_where_a_revision_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    graph = varied_graph(5, 30, 2, NoiseModel(0.01, 0.01))
    measured = pgo.Poses(np.eye(2)[None], np.array([[30.0, 40.0]]))
    spoiled = graph.with_edges(np.array([2]), np.array([25]), measured, 1e4, 1e4)
    monkeypatch.setattr(_RobustSolve, "_improved", failing(FAILURES[0]))
    solution = solvers.solve(spoiled, robust=solvers.GNC())
    assert solution.robust is not None
    assert solution.robust.rejected[-1]
    assert "a revision failed" in solution.note


def test_a_robust_solve_that_rejects_nothing_proves_what_a_plain_one_does() -> None:
    """A positioned graph in space whose relaxation is loose: handedness terms certify it."""
    graph = pgo.read_g2o(Path(__file__).parents[1] / "cases/utm_3d.g2o")
    robust = solvers.solve(graph, robust=solvers.GNC())
    assert robust.robust is not None
    assert not robust.robust.rejected.any()
    assert robust.is_certified
    assert robust.certificate.bound.terms is not None
    np.testing.assert_allclose(robust.objective, solvers.solve(graph).objective, rtol=1e-9, atol=0)


def test_an_attempt_of_a_robust_solve_that_fails_is_passed_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    graph = varied_graph(5, 30, 2, NoiseModel(0.01, 0.01))
    measured = pgo.Poses(np.eye(2)[None], np.array([[30.0, 40.0]]))
    spoiled = graph.with_edges(np.array([2]), np.array([25]), measured, 1e4, 1e4)
    attempt = PlacesOfEdges.attempt
    plans: list[str] = []

    def first_fails(place: PlacesOfEdges, plan: Plan, start: pgo.Poses | None) -> Estimate:
        plans.append(plan.name)
        if len(plans) == 1:
            raise FAILURES[0]
        return attempt(place, plan, start)

    monkeypatch.setattr(PlacesOfEdges, "attempt", first_fails)
    solution = solvers.solve(spoiled, robust=solvers.GNC())
    assert len(plans) > 1
    assert f"the attempt {plans[0]} failed" in solution.note
    assert solution.robust is not None
    assert solution.robust.rejected[-1]


def test_an_update_stands_where_the_whole_solve_after_it_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = loose_problem()
    solution = solvers.solve(problem, FIRST_ALONE)
    calls: list[object] = []

    def second_fails(place: Place, settings: solvers.Pipeline, start: pgo.Poses | None) -> Attempt:
        calls.append(place)
        if len(calls) == 2:
            raise FAILURES[0]
        return solve_at(place, settings, start)

    monkeypatch.setattr("solvers.growing.solve_at", second_fails)
    pipeline = replace(PIPELINES[Step.STAIRCASE], handedness=None)
    grown = solvers.extend(solution, problem.graph, pipeline=pipeline)
    assert len(calls) == 2
    assert "complete solve failed" in grown.note
    assert grown.lower_bound > 0.0


def test_attempts_are_numbered_and_a_step_that_does_not_suit_the_graph_has_a_line() -> None:
    """The graph has fewer poses than the first prefix of a start that grows."""
    pipeline = replace(FIRST_ALONE, growing=GrowingStart(), second_try=True)
    solution = solvers.solve(loose_problem(), pipeline)
    attempts = [(stage.attempt, stage.name) for stage in solution.stages if stage.name != "SOC"]
    assert attempts == [
        (1, "chordal start"),
        (1, "Newton"),
        (0, "growing start"),
        (2, "chordal start"),
        (2, "Newton"),
    ]
    skipped = solution.stages[2]
    assert skipped.status is Status.SKIPPED
    assert skipped.reason == "no more than 60 poses"
    assert solution.note == "not tried: growing start (no more than 60 poses)"
    text = str(solution)
    assert "growing start   skipped: no more than 60 poses" in text
    assert "attempt stage" in text
    assert solution.as_json()["stages"][2]["reason"] == "no more than 60 poses"


def test_a_first_attempt_at_its_limit_is_why_no_other_is_made() -> None:
    few_steps = replace(PIPELINES[Step.SECOND], newton=solvers.Newton(max_iterations=1))
    solution = solvers.solve(loose_problem(), few_steps)
    assert solution.stages[-1].ending == "skipped: the attempt before it ended with MAX_ITERATIONS"


def test_the_table_of_a_certified_solve_has_neither_numbers_nor_skipped_steps() -> None:
    solution = solvers.solve(pgo.load("grid"))
    assert all(stage.was_taken and stage.attempt == 1 for stage in solution.stages)
    assert "\nstage  " in str(solution)


def test_chi2_that_has_no_relaxation_says_so() -> None:
    solution = solvers.solve(
        loose_problem_of_chi2(), replace(FIRST_ALONE, staircase=solvers.Staircase())
    )
    skipped = [(stage.name, stage.reason) for stage in solution.stages if not stage.was_taken]
    assert skipped == [("staircase", "the cost is not convex and quadratic")]
    assert solution.stages[-1].name == "smaller matrices"
