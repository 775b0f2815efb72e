"""The report of a solve: one HTML file that opens offline and says how good the answer is and what to try next."""

import enum
import html
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np

from pgo_models.certificates.certificate import gap_text
from pgo_models.errors import SettingError
from pgo_models.files import replace_when_done
from pgo_models.geometry.poses import absolute_trajectory_error
from pgo_models.graphs.g2o import pose_names
from pgo_models.graphs.partitioning import Partition, PartitionMethod
from pgo_models.graphs.published_results import published_run
from pgo_models.plots.interactive_plots import PAGE_CONFIG, explore_graph
from pgo_models.plots.style import plotly
from pgo_models.problem.thresholds import EdgeResiduals, edge_residuals
from solvers.reporting.convergence_plots import explore_convergence
from solvers.reporting.report_html import PageCell, facts, page, paragraph, section, sortable_table
from solvers.reporting.report_text import Solved, advice, fit, headline, meaning
from solvers.reporting.versions import installed_versions
from solvers.soc.soc import SOC

_WORST_EDGES = 100
_MOST_ROBOTS = 200
_PAGE_SUFFIXES = (".html", ".htm")


def write_report(solution: Solved, path: Path | str, *, source: str | None = None) -> None:
    """Write the report of a solution as one HTML page, whole or not at all.

    Verdict and gap in words, what to try next, the graph to turn and hover over, convergence, a table of robots, the
    worst edges in a table that sorts, stages, settings and versions. Plotly's script is inside (about 5 MB).

    Parameters
    ----------
    path : Path or str
        Ends in .html or .htm.
    source : str, optional
        What stands for the graph in commands: a file, folder or name, quoted where a shell needs it, and options that
        change the problem; the graph's name unless given.

    Errors as `check_report` and `replace_when_done`.

    Examples
    --------
    >>> import tempfile
    >>> from pgo_models.graphs.scenes import circle
    >>> from solvers.pipeline import solve
    >>> path = Path(tempfile.mkdtemp()) / "report.html"
    >>> write_report(solve(circle(np.random.default_rng(0))), path)
    >>> "Certified: the cost of these poses is the least possible" in path.read_text(encoding="utf-8")
    True
    """
    path = Path(path)
    check_report(path)
    text = report_page(solution, source=source)
    with replace_when_done(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def check_report(path: Path) -> None:
    """Raise what `write_report` would before it writes: a SettingError on another suffix, else if plotly is missing."""
    if path.suffix.lower() not in _PAGE_SUFFIXES:
        raise SettingError(f"cannot write {path}: a report is a page; give a name that ends in .html")
    plotly("offline")


def report_page(solution: Solved, *, source: str | None = None) -> str:
    """HTML of the report; parameters and errors as for `write_report`."""
    script = plotly("offline").get_plotlyjs()
    robots = _partition(solution)
    graph = solution.problem.graph.with_robots(robots.robot)
    residuals = edge_residuals(solution.problem, solution.poses)
    place = "graph3d" if graph.d == 3 else "graph2d"
    picture = explore_graph(graph, solution.poses, covariances=solution.covariances, residuals=residuals)
    figures = {place: picture.to_json()}
    sections = [
        _header(solution),
        _verdict(solution),
        *([] if solution.robust is None else [section("Wrong edges", facts(solution.robust.facts()))]),
        _next(solution, residuals, source),
        section("The graph", paragraph(_GRAPH_HINT, quiet=True), f'<div class="plot" id="{place}"></div>'),
    ]
    stages = list(zip(_stage_names(solution), (stage.history for stage in solution.stages), strict=True))
    if any(len(history) for _, history in stages):
        published = published_run(graph)
        figures["convergence"] = explore_convergence(stages, solution.certificate.lower_bound, published).to_json()
        sections.append(
            section("Convergence", paragraph(_CURVE_HINT, True), '<div class="plot" id="convergence"></div>')
        )
    sections += [
        _robots(solution, robots, residuals),
        _worst_edges(solution, robots, residuals),
        _stages(solution),
        _settings(solution),
        section("Versions", facts(list(installed_versions(solution.problem.backend).items()))),
        section("How to read this", facts(_GLOSSARY)),
    ]
    return page(f"{graph.name}: report", sections, figures, PAGE_CONFIG, script)


_GRAPH_HINT = (
    "Drag to turn or to zoom, point at a pose or a misfit to see its name, click on the legend to hide and show. "
    "Vermilion: edges that cost more than they may. Dotted: uncertain edges. Positions in metres."
)
_CURVE_HINT = (
    "The stages one after the other. Gap: how far F is above the proven bound, relative. Residuals: primal, distance "
    "from the constraints; dual, distance from stationarity, both relative."
)
_GLOSSARY = [
    ("F", "cost: sum over edges of kappa ||R_j - R_i R_ij||^2 + tau ||t_j - t_i - R_i t_ij||^2"),
    ("chi2", "cost: sum over edges of squared errors weighed with the information matrices of the file"),
    ("lower bound", "proven: no poses cost less"),
    ("gap", "(F - lower bound) / F"),
    ("kappa", "precision of an edge's rotation, per rad^2: the larger, the surer"),
    ("tau", "precision of an edge's translation, per m^2"),
    ("separator", "pose with an edge to another robot: what robots have to tell each other"),
    ("allowed", "what right edges cost more than in one graph of 100 (chi-square quantile 1 - 0.01 / edges)"),
    ("share of F, chi2", "of an edge: its summand; of a robot: its own edges and half of those to other robots"),
    (
        "error",
        "of an edge: what the poses say beside what was measured: metres between positions, degrees between rotations",
    ),
]


def _partition(solution: Solved) -> Partition:
    """Robots that solved the problem, else those that the graph names."""
    if solution.robots is not None:
        return solution.robots
    for stage in solution.stages:
        if isinstance(stage.method, SOC) and stage.method.robots is not None:
            return stage.method.robots
    return Partition(solution.problem.graph.robots, PartitionMethod.GIVEN)


def _header(solution: Solved) -> str:
    graph = solution.problem.graph
    size = f"{len(graph.bodies)} poses, {graph.num_edges} edges{graph.extras}, {graph.d}D"
    about = f"{size}; solved in {solution.seconds:.3g} s"
    return f"<header><h1>{html.escape(graph.name)}</h1>{paragraph(about, quiet=True)}</header>"


def _verdict(solution: Solved) -> str:
    certificate = solution.certificate
    figures = [
        (f"cost {certificate.cost}", f"{solution.objective:.10g}"),
        ("lower bound", f"{certificate.lower_bound:.10g}"),
        ("gap", gap_text(certificate.gap)),
        ("gap asked for", f"{certificate.wanted_gap:.3g}"),
        ("solve ended", solution.status.name),
    ]
    truth = solution.problem.graph.truth
    if truth is not None:
        bodies = solution.problem.graph.bodies
        ate = absolute_trajectory_error(solution.poses[bodies], truth[bodies])
        figures.append(("error to truth (ATE)", f"{ate:.4g} m"))
    boxes = "".join(
        f'<div><span class="quiet">{label}</span><b>{html.escape(text)}</b></div>' for label, text in figures
    )
    name = certificate.verdict.name
    given = "" if solution.robust is None else f" {solution.robust.conditional}"
    return (
        f'<section class="verdict {name}" id="verdict"><div class="word">{name.replace("_", " ")}</div>'
        f'<p class="head">{html.escape(headline(certificate) + given)}</p><div class="figures">{boxes}</div>'
        + "".join(paragraph(sentence) for sentence in meaning(certificate))
        + "</section>"
    )


def _next(solution: Solved, residuals: EdgeResiduals, source: str | None) -> str:
    items, is_robust = [], solution.robust is not None
    for one in advice(solution.problem.graph, solution.certificate, solution.status, residuals, source, is_robust):
        command = f"<br><code>{html.escape(one.command)}</code>" if one.command else ""
        items.append(f"<li>{html.escape(one.text)}{command}</li>")
    return section("What to try next", f"<ol>{''.join(items)}</ol>")


def _robots(solution: Solved, robots: Partition, residuals: EdgeResiduals) -> str:
    graph, count, owner = solution.problem.graph, robots.num_robots, robots.robot
    cut = robots.cut_edges(graph)
    half = 0.5 * residuals.share
    share = np.bincount(owner[graph.i], half, count) + np.bincount(owner[graph.j], half, count)
    own = np.bincount(owner[graph.i[~cut]], minlength=count)
    between = np.bincount(owner[graph.i[cut]], minlength=count) + np.bincount(owner[graph.j[cut]], minlength=count)
    separators = np.bincount(owner[robots.separators(graph)], minlength=count)
    columns: list[tuple[str, Sequence[float]]] = [
        ("robot", range(count)),
        ("poses", robots.sizes.tolist()),
        ("own edges", own.tolist()),
        ("edges to others", between.tolist()),
        ("separators", separators.tolist()),
    ]
    lines = [f"{count} robots, {robots.method.value}." if count > 1 else "One robot holds the whole graph."]
    ledger = solution.ledger
    if ledger is not None:
        sent = f"{ledger.rounds} rounds, {ledger.messages:,} messages, {ledger.num_bytes:,} bytes"
        sums = f", {ledger.all_reduces} all-reduces ({ledger.all_reduce_bytes:,} bytes)" if ledger.all_reduces else ""
        lines.append(f"Communication: {sent}{sums}.")
        if ledger.num_robots == count:
            columns.append(("bytes sent", ledger.bytes_sent.tolist()))
            columns.append(("bytes received", ledger.bytes_received.tolist()))
    shown = np.argsort(-share, kind="stable")[:_MOST_ROBOTS] if count > _MOST_ROBOTS else np.arange(count)
    if count > _MOST_ROBOTS:
        lines.append(f"Shown are the {_MOST_ROBOTS} with the largest share of {solution.certificate.cost}.")
    rows = [
        [
            *(PageCell(f"{values[a]:,}", values[a]) for _, values in columns),
            PageCell(f"{100 * share[a]:.3g} %", share[a]),
        ]
        for a in shown.tolist()
    ]
    heads = [*(head for head, _ in columns), f"share of {solution.certificate.cost}"]
    return section("Robots", *map(paragraph, lines), sortable_table("robots", heads, rows, [False] * len(rows)))


def _worst_edges(solution: Solved, robots: Partition, residuals: EdgeResiduals) -> str:
    graph, names = solution.problem.graph, pose_names(solution.problem.graph)
    worst = np.argsort(-residuals.cost, kind="stable")[:_WORST_EDGES]
    share = residuals.share
    degrees = np.rad2deg(residuals.rotation)
    rows = []
    for e in worst.tolist():
        i, j = int(graph.i[e]), int(graph.j[e])
        row = [PageCell(str(e), e), PageCell(names[i]), PageCell(names[j])]
        if robots.num_robots > 1:
            row[1:] = [_number(robots.robot[i], "d"), row[1], _number(robots.robot[j], "d"), row[2]]
        row += [
            _number(residuals.cost[e], ".4g"),
            _number(residuals.allowed[e], ".4g"),
            PageCell(f"{100 * share[e]:.3g} %", share[e]),
            _number(residuals.translation[e], ".4g"),
            _number(degrees[e], ".4g"),
            _number(graph.kappa[e], ".4g"),
            _number(graph.tau[e], ".4g"),
        ]
        rows.append(row)
    ends = ["from robot", "from pose", "to robot", "to pose"] if robots.num_robots > 1 else ["from pose", "to pose"]
    share_of = f"share of {solution.certificate.cost}"
    heads = ["edge", *ends, "cost", "allowed", share_of, "error (m)", "error (deg)", "kappa (1/rad^2)", "tau (1/m^2)"]
    tested = fit(residuals, solution.certificate.cost)
    text = (
        f"The {len(rows)} of {graph.num_edges} edges that cost most, {100 * share[worst].sum():.3g} % "
        f"of {solution.certificate.cost} together. {tested} Half of all edges fit to "
        f"{np.median(residuals.translation):.3g} m and {np.median(degrees):.3g} degrees. Click on a head to sort."
    )
    table = sortable_table("edges", heads, rows, residuals.is_misfit[worst].tolist())
    return section("Worst edges", paragraph(text), table)


def _stages(solution: Solved) -> str:
    rows = [
        [
            PageCell(name),
            _number(stage.iterations, "d"),
            _number(stage.objective, ".10g"),
            _number(stage.seconds, ".3f"),
            PageCell(stage.status.name),
        ]
        for name, stage in zip(_stage_names(solution), solution.stages, strict=True)
    ]
    heads = ["stage", "iterations", solution.certificate.cost, "seconds", "ended"]
    explained = sorted({(stage.status.name, stage.status.value) for stage in solution.stages})
    return section("Stages", sortable_table("stages", heads, rows, [False] * len(rows)), facts(explained))


def _settings(solution: Solved) -> str:
    parts = [facts([("gap asked for", f"{solution.certificate.wanted_gap:.3g}")])]
    seen: set[str] = set()
    for name, stage in zip(_stage_names(solution), solution.stages, strict=True):
        method = stage.method
        if is_dataclass(method) and not isinstance(method, type) and repr(method) not in seen:
            seen.add(repr(method))
            rows = [(field.name, _setting(getattr(method, field.name))) for field in fields(method)]
            parts.append(f"<h3>{html.escape(name)}</h3>{facts(rows)}")
    return section("Settings", *parts)


def _stage_names(solution: Solved) -> list[str]:
    """Names of the stages; those that come again are numbered."""
    names = [stage.name for stage in solution.stages]
    earlier = [names[:place].count(name) for place, name in enumerate(names)]
    return [f"{name} ({before + 1})" if before else name for name, before in zip(names, earlier, strict=True)]


def _setting(value: object) -> str:
    if value is None:
        return "default"
    return value.name if isinstance(value, enum.Enum) else str(value)


def _number(value: float, form: str) -> PageCell:
    return PageCell(format(value, form), float(value))
