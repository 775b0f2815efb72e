"""What objects print is short: at most ten lines of a terminal, and a table in a notebook."""

import subprocess
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cvxpy as cp
import numpy as np
import pytest
from public_results import RESULTS

import pgo_models as pgo
import solvers
from pgo_models.certificates.handedness import HandednessTerms
from pgo_models.html_tables import facts_table, rows_table
from pgo_models.problem.marginals import Marginals

LINES = 10
COLUMNS = 100
# Settings, of few fields each; what users make themselves.
METHODS: list[Any] = [
    solvers.SOC(),
    solvers.PaperSOC(),
    solvers.Newton(),
    solvers.Staircase(),
    solvers.GaussSeidel(),
    solvers.GNC(),
    solvers.IRLS(),
    solvers.ExtendedSOC(lambda unknown: pgo.ModelChange()),
]


def of_pose_graphs() -> Iterator[object]:
    graph = pgo.load("grid")
    problem = pgo.PGOProblem(graph)
    robots = pgo.partition(graph, 3)
    solution = solvers.solve(graph)
    shared = solvers.solve(graph, robots=3)
    yield from (graph, problem, robots, solution, shared.ledger, shared.ledger.counted[0][0])
    yield from (solution.poses, solution.certificate, solution.certificate.bound)
    yield from (solution.stages[-1], solution.stages[-1].history, problem.at(solution.poses))
    yield pgo.edge_residuals(problem, solution.poses)
    yield Marginals(problem.M, None)  # type: ignore[arg-type]
    yield HandednessTerms(*robots.robot[:2, None], np.eye(3)[None], np.eye(3)[None])
    qp = pgo.graph_qp(graph, 12.0)
    yield from (qp, qp.variables, qp.change, qp.qp)
    relaxed = pgo.solve_relaxation(graph)
    yield from (relaxed, relaxed.rank)
    rejecting = solvers.prove_outliers(solvers.solve(graph, robust=solvers.GNC()))
    yield from (rejecting.robust, rejecting.robust.proof)
    estimate = solvers.estimate_noise(graph)
    yield from (estimate, estimate.levels[0])
    compared = solvers.compare_readings(Path(__file__).parents[1] / "cases/degrees.g2o")
    yield from (compared, compared.written)
    yield solvers.noise_sweep("grid", [0.1], 1, 0)  # type: ignore[arg-type]
    for method in (*METHODS, solvers.SOC(robots=robots)):
        yield method
        yield list(islice(solvers.iterate(method, problem), 3))[-1]
        run = solvers.run(method, problem)
        yield from (run, run.history.records[-1], run.history.records[-1].measurement)


def of_convex_problems() -> Iterator[object]:
    x = cp.Variable(2)
    J = cp.sum_squares(x - np.array([3.0, 4.0]))
    constrained = pgo.BregmanProblem(J, x, np.ones((1, 2)), np.ones(1))
    on_circle = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J)), unit_columns=[x])
    forms = (solvers.Bregman, solvers.TwoLineBregman, solvers.MethodOfMultipliers)
    for method in (*(form() for form in forms), solvers.AlternatingBregman()):
        yield list(islice(solvers.iterate(method, constrained), 3))[-1]
        yield solvers.run(method, constrained)
    best = solvers.solve_orthogonal(on_circle, 0)
    yield from (constrained, on_circle, on_circle.terms[0], best, best.kkt, best.outcome.state)
    yield from (pgo.quadratic_form(on_circle), best.certificate)


@pytest.fixture(scope="module")
def made() -> list[object]:
    return [*of_pose_graphs(), *of_convex_problems()]


def test_an_object_is_shown_in_ten_lines(made) -> None:
    for shown in made:
        lines = repr(shown).splitlines()
        assert len(lines) <= LINES, type(shown)
        is_setting = not hasattr(shown, "_repr_html_")
        assert is_setting or max(map(len, lines)) <= COLUMNS, type(shown)


def test_a_notebook_shows_a_table(made) -> None:
    for shown in made:
        if hasattr(shown, "_repr_html_"):
            text = shown._repr_html_()
            assert text.count("<table>") >= 1, type(shown)
            assert len(text) < 10_000, type(shown)


def test_tables_are_well_formed_and_escaped() -> None:
    nasty = "<b>&\"'</td>"
    for table in (facts_table([(nasty, "1")]), rows_table([nasty, "F"], [["b", nasty]])):
        texts = ["".join(cell.itertext()) for cell in ElementTree.fromstring(table).iter()]
        assert nasty in texts


def test_every_result_is_shown_here(made) -> None:
    shown = {kind.__name__ for result in made for kind in type(result).__mro__}
    assert set(RESULTS) <= shown


@pytest.mark.parametrize("name", sorted(RESULTS))
def test_a_result_has_a_table(name: str) -> None:
    public = getattr(pgo, name, None) or getattr(solvers, name)
    assert hasattr(public, "_repr_html_")


def test_the_packages_complete_public_names_alone() -> None:
    for package in (pgo, solvers):
        assert dir(package) == sorted(package.__all__)
    program = "import pgo_models as pgo; print(dir(pgo) == sorted(pgo.__all__))"
    finished = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert finished.stdout == "True\n"
