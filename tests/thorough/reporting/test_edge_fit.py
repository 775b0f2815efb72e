"""Edges are judged by the matrices of their file, by the command as in the report."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from graphs import informed
from pages import Page, own_part

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel, Weighting
from solvers.report.fit_plots import explore_fit
from solvers.report.report import report_page
from solvers.reporting.edge_fit import EdgeFit, fit_sentence, judge_edges

Call = Callable[..., tuple[int, str, str]]
NOISE = NoiseModel(0.05, 0.05)


def strained(seed: int, d: int) -> pgo.PoseGraph:
    """A graph whose edges fit at the minimum of chi2, just so, and not at that of F."""
    graph = informed(seed, 30, d, coupled=True, spread=2.0, noise=NOISE)
    problem = pgo.PGOProblem(graph, weighting=Weighting.INFORMATION)
    residuals = solvers.solve(problem).edge_residuals
    worst_edge = (residuals.cost / residuals.allowed).max()
    together = residuals.overall / residuals.overall_allowed
    assert graph.information is not None
    return replace(graph, information=0.9 / max(worst_edge, together) * graph.information)


def with_wrong_closure(graph: pgo.PoseGraph) -> pgo.PoseGraph:
    """The graph with one measurement that is off by 40 m."""
    t_ij = graph.t_ij.copy()
    t_ij[-1] += 40.0
    return replace(graph, t_ij=t_ij)


def solved_fit(graph: pgo.PoseGraph, weighting: Weighting = Weighting.ISOTROPIC) -> EdgeFit:
    solution = solvers.solve(pgo.PGOProblem(graph, weighting=weighting))
    return judge_edges(solution.problem, solution.poses)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("seed", [0])
def test_the_least_F_is_judged_by_chi2_and_advised_to_minimise_it(seed: int, d: int) -> None:
    graph = strained(seed, d)
    fit = solved_fit(graph)
    assert fit.cost == "chi2"
    assert fit.residuals.is_doubtful
    assert fit.lowered is not None
    assert not fit.suspected.is_doubtful
    minimum = solvers.solve(pgo.PGOProblem(graph, weighting=Weighting.INFORMATION))
    assert minimum.lower_bound <= fit.lowered.cost.sum() < fit.residuals.cost.sum()
    (advice,) = fit.advice("pgo solve strained.g2o --cost isotropic", is_robust=False)
    assert advice.command == "pgo solve strained.g2o"
    assert f"{fit.residuals.overall:.3g} times as large as expected" in advice.text
    # At the minimum itself there is nothing left to advise.
    assert (
        solved_fit(graph, Weighting.INFORMATION).advice("pgo solve strained.g2o", is_robust=False)
        == []
    )


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("seed", [0])
def test_edges_that_fit_no_better_in_chi2_are_suspected(seed: int, d: int) -> None:
    fit = solved_fit(with_wrong_closure(strained(seed, d)))
    assert fit.lowered is not None
    solve = "pgo solve g.g2o --cost isotropic"
    commands = [advice.command for advice in fit.advice(solve, is_robust=False)]
    assert commands == ["pgo solve g.g2o", "pgo solve g.g2o --robust gnc"]
    assert [advice.command for advice in fit.advice(solve, is_robust=True)] == commands[:1]


@pytest.mark.parametrize("name", ["sphere", "circle", "grid", "robots"])
def test_where_chi2_is_F_nothing_changes(name: str) -> None:
    solution = solvers.solve(pgo.load(name))
    fit = judge_edges(solution.problem, solution.poses)
    own = solution.edge_residuals
    assert (fit.cost, fit.lowered) == ("F", None)
    np.testing.assert_array_equal(fit.residuals.cost, own.cost)
    np.testing.assert_array_equal(fit.residuals.allowed, own.allowed)
    assert fit.sentence() == fit_sentence(own, "F")
    assert fit.advice("pgo solve", is_robust=False) == []


@pytest.mark.parametrize("is_wrong", [False, True])
def test_page_and_command_give_the_same_advice(
    is_wrong: bool, pgo_command: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("plotly")
    monkeypatch.setenv("COLUMNS", "500")  # for commands with long paths on one line
    graph = strained(0, 2)
    if is_wrong:
        graph = with_wrong_closure(graph)
    path = tmp_path / "strained.g2o"
    pgo.write_g2o(graph, path)
    options = ("--cost", "isotropic")
    _, out, err = pgo_command("solve", path, *options, "--report", tmp_path / "out.html")
    assert err == ""
    fit = solved_fit(pgo.read_g2o(path))
    text = (tmp_path / "out.html").read_text(encoding="utf-8")
    page = Page(text)
    assert f"{fit.residuals.cost.sum():.10g}" in page.text
    assert fit.sentence() in page.text
    assert "Counted in chi2" in page.text
    advice = fit.advice(f"pgo solve {path} --cost isotropic", is_robust=False)
    assert len(advice) == 1 + is_wrong
    printed = " ".join(out.split())
    commands = re.findall("<code>(.*?)</code>", own_part(text))
    for piece in advice:
        assert piece.text in page.text
        assert piece.text in printed
        assert piece.command in commands
        assert f"    {piece.command}" in out.splitlines()
    is_misfit = bool(fit.suspected.is_misfit.any())
    assert any("--drop-edge" in command for command in commands) == is_misfit
    assert ("--drop-edge" in out) == is_misfit


def test_the_page_of_MIT_says_that_its_edges_do_not_fit(benchmark_data: Path) -> None:
    pytest.importorskip("plotly")
    graph = pgo.read_g2o(benchmark_data / "MIT.g2o")
    solution = solvers.solve(pgo.PGOProblem(graph, weighting=Weighting.ISOTROPIC))
    page = Page(report_page(solution))
    assert "4 edges fit worse than their information matrices allow" in page.text
    assert "chi2 of all edges is 39.7 times as large as expected" in page.text
    assert "its minimum is at most 41.16" in page.text
    assert "pgo solve MIT" in page.text
    assert "No edge costs more" not in page.text


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("d", [2, 3])
def test_errors_as_the_matrices_say_lie_along_the_dotted_line(seed: int, d: int) -> None:
    pytest.importorskip("plotly")
    graph = pgo.grid_world(1, 200, seed, d=d)
    solution = solvers.solve(graph)
    bars, line = explore_fit(solution.edge_residuals, graph.d).data
    errors = 10.0 ** np.array(bars.x)
    heights = (np.nan_to_num(np.array(trace.y, dtype=float)) for trace in (bars, line))
    cost, expected = (float(height @ errors**2) for height in heights)
    assert cost / expected == pytest.approx(solution.fit_ratio, rel=0.1)


def test_a_graph_without_errors_has_no_misfit_in_its_histogram() -> None:
    pytest.importorskip("plotly")
    noisy = pgo.grid_world(1, 40, 3, d=2)
    truth = noisy.truth
    assert truth is not None
    turns = np.swapaxes(truth.R[noisy.i], 1, 2) @ truth.R[noisy.j]
    moves = np.einsum("eba,eb->ea", truth.R[noisy.i], truth.t[noisy.j] - truth.t[noisy.i])
    exact = replace(noisy, R_ij=turns, t_ij=moves)
    wrong = exact.with_edges([5], [30], pgo.Poses(np.eye(2)[None], np.zeros((1, 2))), 10.0, 10.0)
    for graph, title in ((exact, "no edge costs more than allowed"), (wrong, "1 of ")):
        figure = explore_fit(solvers.solve(graph).edge_residuals, graph.d)
        assert figure.layout.title.text.startswith(title)
        assert ("misfits" in [trace.name for trace in figure.data]) == (graph is wrong)
