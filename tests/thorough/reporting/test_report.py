import re
import shlex
import sys
from dataclasses import replace

import numpy as np
import pytest
from graphs import informed
from pages import Page, own_part

import pgo_models as pgo
import solvers
from pgo_models.certificates.certificate import BoundSource
from pgo_models.certificates.fit import FITS_WITHOUT_EDGES, Fit
from pgo_models.certificates.lower_bound import NO_BOUND
from pgo_models.errors import SettingError
from pgo_models.figures import rounded_up
from solvers.carry.ledger import Ledger, Traffic
from solvers.cli import app as cli
from solvers.report.report import report_page
from solvers.report.report_text import advice, headline, meaning
from solvers.reporting.edge_fit import EdgeFit, fit_sentence, judge_edges

pytest.importorskip("plotly")


@pytest.fixture(scope="module")
def page(solution):
    return Page(report_page(solution))


def test_the_numbers_are_those_of_the_solution(solution, page):
    certificate = solution.certificate
    for figure in (certificate.cost_text, certificate.bound_text, certificate.gap_text):
        assert figure in page.text
    assert "CERTIFIED" in page.text
    head, *stages = page.tables["stages"]
    assert head == ["stage", "iterations", "F", "seconds", "ended"]
    assert [row[0] for row in stages] == [stage.name for stage in solution.stages]
    assert [row[2] for row in stages] == [rounded_up(stage.objective) for stage in solution.stages]
    assert (
        f"{pgo.absolute_trajectory_error(solution.poses, solution.problem.graph.truth):.4g} m"
        in page.text
    )


def test_the_worst_edges_come_first_with_their_figures(solution, page):
    graph = solution.problem.graph
    residuals = pgo.edge_residuals(graph, solution.poses)
    head, *rows = page.tables["edges"]
    assert len(rows) == min(100, graph.num_edges)
    costs = [float(row[head.index("cost")]) for row in rows]
    assert costs == sorted(costs, reverse=True)
    for row in rows:
        e = int(row[0])
        figures = [
            residuals.cost[e],
            residuals.allowed[e],
            residuals.translation[e],
            np.rad2deg(residuals.rotation[e]),
        ]
        shown = [
            float(row[head.index(name)]) for name in ("cost", "allowed", "error (m)", "error (deg)")
        ]
        np.testing.assert_allclose(shown, figures, rtol=1e-3, atol=0)
        assert (
            row[head.index("from pose")]
            == f"{'abcd'[graph.robots[graph.i[e]]]}{int(graph.pose_ids[graph.i[e]]) % 2**56}"
        )
        assert int(row[head.index("to robot")]) == graph.robots[graph.j[e]]
    assert max(costs) == pytest.approx(residuals.cost.max(), rel=1e-3)


def test_the_robots_share_everything(solution, page):
    graph = solution.problem.graph
    head, *rows = page.tables["robots"]
    columns = {
        name: [float(row[k].rstrip(" %").replace(",", "")) for row in rows]
        for k, name in enumerate(head)
    }
    assert sum(columns["poses"]) == graph.num_poses
    assert sum(columns["own edges"]) + sum(columns["edges to others"]) / 2 == graph.num_edges
    assert sum(columns["share of F"]) == pytest.approx(100, abs=0.5 * len(rows))
    robots = pgo.partition(graph)
    assert sum(columns["separators"]) == len(robots.separators(graph))


def test_a_solve_by_robots_shows_their_communication():
    graph = pgo.load("sphere")
    solved = solvers.solve(graph, robots=3)
    page = Page(report_page(solved))
    assert [int(row[1]) for row in page.tables["robots"][1:]] == solved.robots.sizes.tolist()
    assert f"{solved.ledger.rounds} rounds" in page.text


def test_communication_is_shown_when_it_was_counted(solution):
    count = solution.problem.graph.num_robots
    ring = np.arange(count)
    traffic = Traffic(ring, (ring + 1) % count, 80 * (1 + ring))
    ledger = Ledger(count).after_round(traffic).after_round(traffic).after_all_reduce(10)
    page = Page(
        report_page(replace(solution, ledger=ledger, robots=pgo.partition(solution.problem.graph)))
    )
    assert f"2 rounds, {2 * count} messages, {ledger.num_bytes:,} bytes, 1 all-reduces" in page.text
    head, *rows = page.tables["robots"]
    for name, expected in (
        ("bytes sent", ledger.bytes_sent),
        ("bytes received", ledger.bytes_received),
    ):
        assert [int(row[head.index(name)].replace(",", "")) for row in rows] == expected.tolist()
    assert "bytes sent" not in Page(report_page(solution)).tables["robots"][0]


@pytest.mark.parametrize(
    "name", ["</script><script>alert(1)</script>", "<img src=x onerror=alert(1)>", "a&b\"c'd"]
)
def test_names_are_escaped_wherever_they_stand(name, solution):
    graph = replace(solution.problem.graph, name=name)
    renamed = replace(solution, problem=pgo.PGOProblem(graph))
    text = own_part(report_page(renamed))
    page = Page(text)
    assert name in page.text
    assert page.scripts == 4
    assert page.asked == ["data:,"]
    assert text.count("</script>") == 4


def test_the_page_asks_for_nothing_online(solution):
    text = report_page(solution)
    assert text.count("plotly.js v") == 1
    page = Page(own_part(text))
    assert page.asked == ["data:,"]  # the icon, which browsers would else ask for
    assert "default-src 'none'" in text
    assert "@import" not in own_part(text)
    assert "url(" not in own_part(text)


def test_ten_thousand_poses_take_less_than_five_megabytes_beside_the_library(solution):
    graph = pgo.random_geometric(10_000, np.random.default_rng(0), d=3, mean_degree=6.0)
    large = replace(solution, problem=pgo.PGOProblem(graph), all_poses=graph.truth)
    assert graph.num_edges > 20_000
    assert len(own_part(report_page(large)).encode()) < 5e6


def test_a_report_is_written_whole_under_a_pages_name_only(solution, tmp_path):
    solvers.write_report(solution, tmp_path / "out.html")
    assert [file.name for file in tmp_path.iterdir()] == ["out.html"]
    with pytest.raises(SettingError, match=r"ends in \.html"):
        solvers.write_report(solution, tmp_path / "out.pdf")
    with pytest.raises(pgo.PGOError, match="cannot write"):
        solvers.write_report(solution, tmp_path / "no" / "out.html")


@pytest.mark.parametrize("package", ["plotly", "jinja2"])
def test_without_its_package_one_line_names_the_extra_before_anything_is_solved(
    package, monkeypatch, tmp_path, capsys
):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(SystemExit) as end:
        cli.main(["solve", "no-such-graph", "--report", str(tmp_path / "out.html")])
    err = capsys.readouterr().err
    assert (end.value.code, err.count("\n")) == (1, 1)
    assert f"{package} is not installed" in err
    assert "pgo-splitting[plot]" in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("unit_weights", [False, True])
def test_the_command_line_writes_one_whose_commands_can_be_typed(unit_weights, tmp_path, capsys):
    options = ["--cost", "unit"] if unit_weights else []
    with pytest.raises(SystemExit) as end:
        cli.main(["solve", "grid", *options, "--report", str(tmp_path / "out.html")])
    assert end.value.code == 0
    assert f"written: {tmp_path / 'out.html'}" in capsys.readouterr().out
    commands = re.findall(
        "<code>(.*?)</code>", own_part((tmp_path / "out.html").read_text(encoding="utf-8"))
    )
    assert commands[0].split()[:3] == ["pgo", "solve", "grid"]
    assert all(("--cost unit" in command) == unit_weights for command in commands)


def with_gap(certificate, gap):
    """The certificate with a lower bound, and so with a wider gap."""
    bound = replace(certificate.bound, value=(1.0 - gap) * certificate.objective)
    return replace(certificate, bound=bound, gap=gap, verdict=pgo.Verdict.NOT_CERTIFIED)


def cases(solution, uncertain):
    graph = solution.problem.graph
    certificate = solution.certificate
    yield graph, certificate, solvers.Status.CONVERGED
    yield graph, replace(certificate, wanted_gap=1e-9), solvers.Status.CONVERGED
    for fit in (FITS_WITHOUT_EDGES, Fit(is_exact=True, share=1e-10)):
        exact = replace(certificate, verdict=pgo.Verdict.EXACT, fit=fit)
        yield graph, exact, solvers.Status.CONVERGED
    for status in solvers.Status:
        yield uncertain.problem.graph, uncertain.certificate, status
    wide = with_gap(certificate, 0.25)
    yield graph, wide, solvers.Status.CONVERGED
    yield graph, replace(wide, source=BoundSource.RELAXATION), solvers.Status.CONVERGED
    nearly = replace(with_gap(certificate, 3e-9), wanted_gap=1e-12)
    yield graph, nearly, solvers.Status.CONVERGED
    yield (
        graph,
        replace(wide, verdict=pgo.Verdict.TRIVIAL, gap=1.0, bound=NO_BOUND),
        solvers.Status.CONVERGED,
    )


def test_every_case_has_a_verdict_and_something_to_try(solution, uncertain, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    known = {option for command in ("solve", "certify") for option in options_of(command)} | {
        "--robust"
    }
    residuals = solution.edge_residuals
    doubtful = replace(residuals, allowed=np.where(np.arange(212) < 3, -1.0, np.inf))
    for graph, certificate, status in cases(solution, uncertain):
        assert certificate.is_certified == headline(certificate).startswith("Certified")
        assert certificate.cost_text in meaning(certificate)[0]
        suggestions = advice(graph, certificate, status, EdgeFit("F", doubtful))
        says_what_does_not_fit = any(
            piece.command.endswith("--robust gnc") and "3 edges fit worse" in piece.text
            for piece in suggestions
        )
        # Poses of a solve that was broken off say nothing of edges, unless they are optimal.
        assert says_what_does_not_fit == (status.is_success or certificate.is_certified)
        for piece in suggestions:
            words = shlex.split(piece.command)
            assert not words or words[0] == "pgo"
            assert {word for word in words if word.startswith("--")} <= known
        assert (
            status.is_success or "run" in suggestions[0].text or "overflowed" in suggestions[0].text
        )


def options_of(command):
    import typer

    return [
        text
        for parameter in typer.main.get_command(cli.app).commands[command].params
        for text in parameter.opts
    ]


def test_what_the_edges_say_together_is_said(solution):
    residuals = replace(
        solution.edge_residuals, allowed=np.full(212, np.inf), scale=1.0, overall=1.0
    )
    assert not residuals.is_doubtful
    assert fit_sentence(residuals, "F").startswith(
        "No edge fits worse than its information matrix allows. F of all edges is as large as"
    )
    assert "by chance" not in fit_sentence(residuals, "F")
    bent = replace(residuals, overall=2.0, scale=7.0)
    assert bent.is_doubtful
    assert "with 7 times the cost allowed, as the median edge needs" in fit_sentence(bent, "chi2")
    assert (
        "chi2 of all edges is 2 times as large as expected; by chance it exceeds "
        f"{bent.overall_allowed:.3g} times that" in fit_sentence(bent, "chi2")
    )
    assert "the errors are 10 times smaller than the matrices say, which can hide" in fit_sentence(
        replace(residuals, overall=0.01), "F"
    )
    with_one_misfit = replace(residuals, allowed=np.where(np.arange(212) == 7, -1.0, np.inf))
    assert fit_sentence(with_one_misfit, "F").startswith("1 edge fits")


def test_exact_measurements_are_reported_too():
    graph = pgo.circle(np.random.default_rng(0))
    exact = replace(
        graph,
        R_ij=np.swapaxes(graph.truth.R[graph.i], 1, 2) @ graph.truth.R[graph.j],
        t_ij=np.einsum(
            "mba,mb->ma", graph.truth.R[graph.i], graph.truth.t[graph.j] - graph.truth.t[graph.i]
        ),
        information=None,
    )
    solution = solvers.solve(exact)
    assert solution.is_certified
    page = Page(report_page(solution))
    assert solution.certificate.verdict is pgo.Verdict.EXACT
    assert "F cannot be told from zero" in page.text
    assert "nan" not in page.text


def test_what_is_exact_to_the_digits_of_a_file_is_reported_as_that(tmp_path):
    edges = [f"EDGE_SE2 {i} {(i + 1) % 4} 1 0 1.570796327 1 0 0 1 0 1" for i in range(4)]
    (tmp_path / "square.g2o").write_text("\n".join(edges))
    page = Page(report_page(solvers.solve(pgo.read_g2o(tmp_path / "square.g2o"))))
    assert "Certified: the poses fit every measurement as closely as its numbers" in page.text
    assert "no more than what the last digits of the measurements make of it" in page.text
    assert "Ask for a tighter proof" not in page.text


def test_a_map_without_absent_robots_is_first_advised_to_have_them():
    graph = pgo.load("robots")
    part = replace(
        graph.subgraph(np.arange(60)),
        absent=np.arange(40, 60),
        name="robots, only robots with a file here",
    )
    certificate = solvers.certify(part, part.initial)
    first, *_ = advice(part, certificate, solvers.Status.CONVERGED, judge_edges_of(part))
    assert first.text.startswith("Put the files of all robots into the folder")
    assert first.command == "pgo solve robots --cost isotropic"


def judge_edges_of(graph):
    return judge_edges(pgo.PGOProblem(graph), graph.initial)


def test_the_fit_is_that_of_the_cost_solved_as_it_is_printed() -> None:
    """F of this graph is another multiple of what is expected than chi2 at its minimum."""
    graph = informed(0, 20, 2, coupled=False, spread=2.0, noise=pgo.NoiseModel(1e-2, 1e-2))
    problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.ISOTROPIC)
    solution = solvers.solve(problem)
    fit = judge_edges(problem, solution.poses)
    assert f"{fit.suspected.overall:.3g}" != f"{solution.fit_ratio:.3g}"
    page = report_page(solution)
    assert f"Fit: {solution.fit_text}." in page
    assert ("of measurements that do not fit" in page) == solution.is_doubtful


def test_the_word_above_a_robust_solve_says_of_which_edges_it_is() -> None:
    graph = pgo.grid_world(1, 80, 2, d=2)
    at_once = pgo.Poses(np.eye(2)[None], np.zeros((1, 2)))
    wrong = graph.with_edges([5], [61], at_once, kappa=100.0, tau=100.0)
    solution = solvers.solve(wrong, robust=solvers.GNC())
    assert solution.is_certified
    assert "CERTIFIED for the edges kept" in report_page(solution)
