"""Methods side by side, the noise sweep, the paper's tables; reports, films and plots."""

import pytest

import pgo_models as pgo
import solvers
from solvers.studies.paper_tables import ReproductionSettings

pytest.importorskip("matplotlib")
pytest.importorskip("plotly")


@pytest.fixture(scope="module")
def solution() -> solvers.Solution:
    return solvers.solve(pgo.load("circle"))


def test_methods_are_compared_against_one_bound():
    methods = (solvers.BenchmarkMethod.JOINT, solvers.BenchmarkMethod.GAUSS_SEIDEL)
    settings = solvers.ComparisonSettings(methods, solvers.BenchmarkSettings(3))
    compared = solvers.compare_methods(pgo.grid(1), settings)
    assert compared.is_complete
    for trial in compared.trials:
        assert trial.objective >= compared.lower_bound
    assert [record["method"] for record in compared.table().records] == [m.value for m in methods]


def test_a_row_of_the_papers_tables_is_reproduced():
    settings = ReproductionSettings(only=("circle",), num_seeds=1)
    reproduction = solvers.reproduce_tables(settings)
    assert reproduction.is_complete
    assert len(reproduction.rows) > 0


def test_a_report_is_one_page_that_needs_no_network(solution, tmp_path):
    solvers.write_report(solution, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "CERTIFIED" in page
    assert 'src="http' not in page


def test_a_film_has_a_frame_for_every_iterate():
    figure = solvers.film(pgo.load("circle"))
    assert len(figure.frames) > 3


def test_graphs_and_covariances_are_drawn(solution):
    figure = pgo.plot_graph(solution.problem.graph, solution.poses, "circle")
    assert len(figure.axes) >= 1
    panels = [("solved", solution.poses), ("truth", solution.problem.graph.truth)]
    assert len(pgo.compare_poses(solution.problem.graph, panels).axes) == 2
    explored = pgo.explore_graph(solution.problem.graph, solution.poses)
    assert len(explored.data) > 0


def test_iterates_are_animated(solution):
    graph = solution.problem.graph
    figure = pgo.animate_poses(graph, [graph.truth, solution.poses], ["truth", "solved"])
    assert len(figure.frames) == 2
