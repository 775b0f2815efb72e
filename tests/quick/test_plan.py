"""The plan of a solve: the answer stands whatever goes wrong in a step that may improve it."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from graphs import informed, varied_graph

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel, PGOProblem, Weighting
from pgo_models.errors import NotPositiveDefiniteError
from solvers import Status
from solvers.riemannian.prefixes import GrowingStart

LOUD = NoiseModel(translation_std=1.0, rotation_std=1.0)
FIRST_ALONE = solvers.Pipeline(growing=None, other_starts=False, staircase=None, handedness=None)
WITH_STAIRCASE = replace(FIRST_ALONE, staircase=solvers.Staircase())


def loose_problem() -> PGOProblem:
    """A problem whose certificate stays open through all steps."""
    return PGOProblem(varied_graph(1, 10, 3, LOUD), weighting=Weighting.ISOTROPIC)


def loose_problem_of_chi2() -> PGOProblem:
    graph = informed(4, 10, 3, False, 2.0, NoiseModel(1.0, 0.7))
    return PGOProblem(graph, weighting=Weighting.INFORMATION)


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


@pytest.mark.parametrize("error", FAILURES, ids=lambda error: type(error).__name__)
def test_a_step_that_fails_leaves_the_answer_before_it(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = loose_problem()
    before = solvers.solve(problem, FIRST_ALONE)
    assert before.certificate.can_improve  # else the step would not be taken
    monkeypatch.setattr(solvers.Staircase, "init", failing(error))
    solution = solvers.solve(problem, WITH_STAIRCASE)
    assert "Staircase" in [stage.name for stage in solution.stages if stage.status is Status.FAILED]
    assert f"Staircase failed ({error}); the answer before it stands" in solution.note
    np.testing.assert_array_equal(solution.poses.t, before.poses.t)
    assert solution.lower_bound == before.lower_bound
    assert solution.status is before.status
    assert str(error) in str(solution)


def test_ctrl_c_in_a_step_leaves_the_answer_and_its_bound(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = loose_problem()
    before = solvers.solve(problem, FIRST_ALONE)
    monkeypatch.setattr(solvers.Staircase, "init", failing(KeyboardInterrupt()))
    solution = solvers.solve(problem, WITH_STAIRCASE)
    assert solution.status is Status.INTERRUPTED
    assert solution.lower_bound >= before.lower_bound > 0.0
    assert solution.stages[-1].name == "interruption"


def test_ctrl_c_between_the_first_loops_leaves_the_best_poses_without_a_bound(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = PGOProblem(pgo.load("grid"))
    monkeypatch.setattr(solvers.Newton, "init", failing(KeyboardInterrupt()))
    solution = solvers.solve(problem)
    assert solution.status is Status.INTERRUPTED
    assert solution.lower_bound == 0.0
    assert [stage.name for stage in solution.stages] == ["chordal start", "interruption"]
    np.testing.assert_allclose(solution.objective, solution.stages[0].objective, rtol=1e-9)


def test_an_error_of_the_program_is_not_taken_for_a_failure(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(solvers.Staircase, "init", failing(TypeError("a defect")))
    with pytest.raises(TypeError, match="a defect"):
        solvers.solve(loose_problem(), WITH_STAIRCASE)


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
    init = solvers.GNC.init
    calls: list[object] = []

    def first_fails(*arguments: object) -> object:
        calls.append(arguments)
        if len(calls) == 1:
            raise FAILURES[0]
        return init(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(solvers.GNC, "init", first_fails)
    solution = solvers.solve(spoiled, robust=solvers.GNC())
    assert len(calls) > 1
    assert re.search(r"the attempt .* failed", solution.note)
    assert solution.robust is not None
    assert solution.robust.rejected[-1]


def test_a_step_that_does_not_suit_the_graph_has_a_line() -> None:
    """The graph has fewer poses than the first prefix of a start that grows."""
    pipeline = replace(FIRST_ALONE, growing=GrowingStart(), other_starts=True)
    solution = solvers.solve(loose_problem(), pipeline)
    attempts = [(stage.attempt, stage.name) for stage in solution.stages if stage.name != "SOC"]
    assert attempts == [
        (1, "chordal start"),
        (1, "Newton"),
        (0, "growing start"),
        (0, "other starts: none is better"),
        (0, "random starts: none is better"),
    ]
    skipped = solution.stages[2]
    assert skipped.status is Status.SKIPPED
    assert skipped.reason == "no more than 60 poses"
    assert solution.note == "not tried: growing start (no more than 60 poses)"
    text = str(solution)
    assert re.search(r"growing start +skipped: no more than 60 poses", text)
    assert solution.as_json()["stages"][2]["reason"] == "no more than 60 poses"


def test_the_table_of_a_certified_solve_has_neither_numbers_nor_skipped_steps() -> None:
    solution = solvers.solve(pgo.load("grid"))
    assert all(stage.was_taken and stage.attempt == 1 for stage in solution.stages)
    assert "\nstage  " in str(solution)


def test_chi2_that_has_no_relaxation_says_so() -> None:
    solution = solvers.solve(
        loose_problem_of_chi2(), replace(FIRST_ALONE, staircase=solvers.Staircase())
    )
    skipped = [(stage.name, stage.reason) for stage in solution.stages if not stage.was_taken]
    assert skipped == [("Staircase", "the cost is not convex and quadratic")]
    assert solution.stages[-1].name == "smaller matrices"
