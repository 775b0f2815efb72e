"""The semidefinite relaxation and the staircase with whole rotation information."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from graphs import informed

import solvers
from pgo_models import NoiseModel, PGOProblem, RelaxationForm, Weighting, solve_relaxation
from pgo_models.errors import SettingError
from pgo_models.graphs.precisions import proper_information


def rotations_informed(n: int) -> PGOProblem:
    graph = informed(4, n, 3, coupled=False, spread=0.2, noise=NoiseModel(0.05, 0.05))
    information = proper_information(graph).copy()
    information[:, :3, :3] = graph.tau[:, None, None] * np.eye(3)
    return PGOProblem(replace(graph, information=information), weighting=Weighting.INFORMATION)


@pytest.mark.parametrize("form", RelaxationForm)
def test_every_form_finds_the_minimum_of_chi2(form: RelaxationForm) -> None:
    problem = rotations_informed(7)
    solution = solvers.solve(problem, progress=False)
    assert problem.is_quadratic
    relaxed = solve_relaxation(problem, form)
    assert relaxed.lower_bound == pytest.approx(solution.objective, rel=1e-5)
    assert relaxed.lower_bound <= solution.objective
    assert relaxed.objective == pytest.approx(solution.objective, rel=1e-5)


def test_the_staircase_climbs_on_chi2() -> None:
    problem = rotations_informed(12)
    solution = solvers.solve(problem, progress=False)
    climbed = solvers.run(solvers.Staircase(), problem)
    assert climbed.objective == pytest.approx(solution.objective, rel=1e-6)


def test_costs_that_are_not_quadratic_are_refused() -> None:
    problem = PGOProblem(informed(0, 8, 2, coupled=False), weighting=Weighting.INFORMATION)
    with pytest.raises(SettingError, match="the relaxation needs a cost that is quadratic"):
        solve_relaxation(problem)
    for method in (solvers.SOC(), solvers.PaperSOC(), solvers.Staircase()):
        with pytest.raises(SettingError, match="as F is, and chi2 here is not"):
            solvers.run(method, problem)
