from dataclasses import replace

import numpy as np
import pytest
from graphs import OPTIMUM, REFERENCE, optimum_tolerance

import pgo_models as pgo
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.graphs.published_results import published_rows
from solvers import BenchmarkMethod, GaussSeidel, reproduce_tables
from solvers.studies.paper_tables import (
    TABLE_CONTENDERS,
    Reproduction,
    ReproductionSettings,
    graph_of_row,
)
from solvers.studies.paper_tables_text import findings, tables_as_text

PAPER = {name: row for name, row in REFERENCE["paper_tables"].items() if isinstance(row, dict)}


def one_row(name):
    return next(row for row in published_rows() if row.name == name)


@pytest.fixture(scope="module")
def scenes():
    return reproduce_tables(ReproductionSettings(only=("circle", "grid", "sphere"), num_seeds=2))


def test_rows_and_figures_are_those_of_the_papers_tables():
    rows = ReproductionSettings().rows
    assert [row.name for row in rows] == list(PAPER)
    for row in rows:
        figures = PAPER[row.name]
        assert (row.num_poses, row.num_edges) == (figures["poses"], figures["measurements"])
        assert (row.se_sync.objective, row.soc.objective) == (figures["F_star"], figures["F_soc"])
        assert row.dgs.objective == figures["F_dgs"]
        assert row.soc.iterations == figures["iterations_soc"]
        assert (row.se_sync.seconds, row.soc.seconds) == (
            figures["seconds_sesync"],
            figures["seconds_soc"],
        )


def test_scenes_show_what_they_should(scenes):
    assert scenes.is_complete
    assert [row.published.name for row in scenes.rows] == [
        n for n in ("circle", "grid", "sphere") for _ in range(4)
    ]
    assert [row.contender for row in scenes.rows[:4]] == list(TABLE_CONTENDERS)
    assert all(len(row.cells) == 2 and not row.reasons for row in scenes.rows)
    claims = findings(scenes)
    assert len(claims) == 2  # fewer rounds than the paper, and DGS where it has none: not of scenes
    assert all(
        finding.failed == () and finding.held == ("circle", "grid", "sphere") for finding in claims
    )
    for row in scenes.rows:
        for optimum, cell in zip(row.optima, row.cells, strict=True):
            assert 0 < optimum.gap < 1e-6
            assert cell.objective >= optimum.lower_bound
            if row.contender in (BenchmarkMethod.STAIRCASE, BenchmarkMethod.CONSENSUS):
                assert cell.gap < 1e-6


def test_findings_fail_where_the_figures_do(scenes):
    def spoiled(row):
        cells = tuple(replace(cell, lower_bound=0.5 * cell.objective) for cell in row.cells)
        return replace(row, cells=cells) if row.published.name == "grid" else row

    claims = findings(Reproduction(scenes.settings, tuple(map(spoiled, scenes.rows)), True))
    assert all(
        finding.failed == ("grid",) and finding.held == ("circle", "sphere") for finding in claims
    )
    assert "NOT on grid" in str(claims[0])


def test_text_has_a_line_a_method_with_the_papers_figures_beside(scenes):
    table = tables_as_text(scenes)
    costs, efforts = table.parts
    assert len(costs.rows) == len(efforts.rows) == len(table.records) == 12
    record = next(
        r
        for r in table.records
        if (r["graph"], r["method"]) == ("sphere", BenchmarkMethod.PAPER.label)
    )
    assert (record["paper_objective"], record["paper_iterations"]) == (PAPER["sphere"]["F_soc"], 38)
    row = next(
        row
        for row in scenes.rows
        if (row.published.name, row.contender) == ("sphere", BenchmarkMethod.PAPER)
    )
    objectives = [cell.objective for cell in row.cells]
    assert record["objective"] == pytest.approx(np.mean(objectives), rel=1e-12)
    assert record["objective_std"] == pytest.approx(np.std(objectives, ddof=1), rel=1e-12)
    shown = next(line for line in costs.rows[8:] if line[5] == BenchmarkMethod.PAPER.label)
    assert shown[6] == f"{np.mean(objectives):.1f} +- {np.std(objectives, ddof=1):.1f}"
    assert shown[9:11] == ("594.23", "6.1")


def failing(monkeypatch, error, first=0):
    """DGS fails from one of its runs on."""
    init = GaussSeidel.init
    runs = []

    def fail(*arguments):
        runs.append(arguments)
        if len(runs) > first:
            raise error
        return init(*arguments)

    monkeypatch.setattr(GaussSeidel, "init", fail)


def test_after_ctrl_c_the_tables_have_what_is_done(monkeypatch):
    failing(monkeypatch, KeyboardInterrupt(), first=1)
    part = reproduce_tables(ReproductionSettings(only=("circle", "grid"), num_seeds=2))
    assert not part.is_complete
    assert [len(row.cells) for row in part.rows] == [2, 1, 1, 1, 0, 0, 0, 0]
    text = tables_as_text(part)
    assert "interrupted: the runs left out were not done" in text.notes
    remarks = [row[-1] for row in text.parts[0].rows]
    assert all(remark.startswith("1 of 2 not run yet") for remark in remarks[1:4])
    assert remarks[4:] == ["not run yet"] * 4


@pytest.mark.parametrize(
    "error",
    [NotPositiveDefiniteError("no factor"), np.linalg.LinAlgError("singular"), MemoryError()],
)
def test_a_method_that_fails_leaves_its_reason(error, monkeypatch):
    failing(monkeypatch, error)
    tables = reproduce_tables(ReproductionSettings(("grid",), 1))
    assert tables.is_complete
    reason = str(error) or "MemoryError"
    assert tables.rows[1].reasons == (reason,)
    assert [len(row.cells) for row in tables.rows] == [1, 0, 1, 1]
    table = tables_as_text(tables)
    assert table.parts[0].rows[1][5:] == ("DGS", "-", "-", "-", "123.244", "31", reason)
    assert table.records[1]["objective"] is None


def test_a_mistake_of_ours_is_no_reason(monkeypatch):
    failing(monkeypatch, TypeError("ours"))
    with pytest.raises(TypeError, match="ours"):
        reproduce_tables(ReproductionSettings(("grid",), 1))


@pytest.fixture
def no_data(tmp_path, monkeypatch):
    """No benchmark graph is here, and none in a cache."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PGO_DATA", raising=False)
    monkeypatch.setattr("pooch.os_cache", lambda name: tmp_path / "cache")
    return tmp_path


def test_a_graph_that_is_not_here_says_how_to_get_it_and_nothing_is_downloaded(no_data):
    tables = reproduce_tables(ReproductionSettings(only=("rim",)))
    assert tables.is_complete
    assert not any(row.cells for row in tables.rows)
    (line,) = tables_as_text(tables).parts[0].rows
    assert line[:3] == ("rim", "10195", "29743")
    assert "pgo info rim" in line[-1]
    assert "PGO_DATA" in line[-1]
    assert line[9] == "6182.73"
    assert list(no_data.iterdir()) == []


def test_another_graph_is_never_passed_off_as_the_papers(no_data):
    (no_data / "data").mkdir()
    pgo.write_g2o(pgo.grid(np.random.default_rng(0)), no_data / "data" / "rim.g2o")
    tables = reproduce_tables(ReproductionSettings(only=("rim",)))
    assert not any(row.cells for row in tables.rows)
    assert (
        "has 27 poses and 108 edges, the paper's has 10195 and 29743: it is another graph"
        in tables.rows[0].reasons[0]
    )


def test_scenes_are_drawn_from_their_seeds():
    for name in ("circle", "grid", "sphere"):
        made = graph_of_row(one_row(name), 0, False)
        assert made.name == name
        np.testing.assert_allclose(made.t_ij, pgo.load(name).t_ij, rtol=0, atol=1e-12)


def assert_row_shows_what_it_should(name: str) -> None:
    tables = reproduce_tables(ReproductionSettings(only=(name,)))
    assert all(finding.failed == () for finding in findings(tables))
    for row in tables.rows:
        assert abs(row.optima[0].objective - OPTIMUM[name]) <= optimum_tolerance(name)
        assert np.isfinite(row.cells[0].objective)
    by = {row.contender: row.cells[0] for row in tables.rows}
    assert by[BenchmarkMethod.PAPER].objective <= PAPER[name]["F_soc"]
    assert by[BenchmarkMethod.PAPER].rounds <= PAPER[name]["iterations_soc"]
    assert by[BenchmarkMethod.CONSENSUS].gap < 1e-4
    assert by[BenchmarkMethod.CONSENSUS].rounds < PAPER[name]["iterations_soc"]


@pytest.mark.usefixtures("benchmark_data")
@pytest.mark.slow
def test_the_garage_shows_what_it_should():
    assert_row_shows_what_it_should("parking-garage")
