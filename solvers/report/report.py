"""The report of a solve: one HTML file that opens offline.

It shows how good the solution is, and what to try next.
"""

import enum
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pgo_models.errors import SettingError, extra_module
from pgo_models.figures import rounded_up
from pgo_models.files import replace_when_done
from pgo_models.geometry.poses import absolute_trajectory_error
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.g2o import pose_names
from pgo_models.graphs.partitioning import Partition, PartitionMethod
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.graphs.published_results import published_run
from pgo_models.plots.graph_plots import MOST_LINES, thinning_step
from pgo_models.plots.interactive_plots import MOST_DOTS, explore_graph
from pgo_models.plots.pages import PAGE_CONFIG
from pgo_models.plots.style import plotly
from pgo_models.problem.thresholds import EdgeResiduals
from solvers.carry.ledger import Ledger
from solvers.report.fit_plots import explore_fit
from solvers.report.report_text import advice, advice_in_doubt, headline, meaning
from solvers.reporting.convergence_plots import explore_convergence
from solvers.reporting.edge_fit import Advice, EdgeFit, judge_edges
from solvers.reporting.versions import installed_versions
from solvers.soc.soc import SOC
from solvers.solution import Solution

# Rows of the tables of edges and of robots: the page of a large graph stays short.
_WORST_EDGES = 100
_MOST_ROBOTS = 200
_PAGE_SUFFIXES = (".html", ".htm")


def write_report(
    solution: Solution, path: Path | str, *, source: str | None = None, fit: EdgeFit | None = None
) -> None:
    """Write the report of a solution as one HTML page, whole or not at all.

    The page contains plotly's script (about 5 MB), so that it opens offline.

    Parameters
    ----------
    solution : Solution
        The solution.
    path : Path or str
        File to write; its name ends in .html or .htm.
    source : str, optional
        What stands for the graph in commands: a file, folder or name, quoted for a shell, and the
        options that change the problem; the graph's name unless given.
    fit : EdgeFit, optional
        Result of `judge_edges`, which is called unless it is given.

    Examples
    --------
    >>> import tempfile
    >>> from pgo_models.graphs.scenes import circle
    >>> from solvers.pipeline import solve
    >>> path = Path(tempfile.mkdtemp()) / "report.html"
    >>> write_report(solve(circle(np.random.default_rng(0))), path)
    >>> text = path.read_text(encoding="utf-8")
    >>> "Certified: the cost of these poses is the least possible" in text
    True
    """
    path = Path(path)
    check_report(path)
    solution.problem.check_positions(str(path))
    text = report_page(solution, source=source, fit=fit)
    with replace_when_done(path) as temporary:
        # Names of poses and files may contain characters that are not UTF-8.
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def check_report(path: Path) -> None:
    """Raise the errors of `write_report` that are known before a solve.

    They are a SettingError for the name, and a MissingExtraError without plotly or Jinja2.
    """
    if path.suffix.lower() not in _PAGE_SUFFIXES:
        raise SettingError(
            f"cannot write {path}: a report is a page; give a name that ends in .html"
        )
    plotly("offline")
    extra_module("jinja2", "plot")


def report_page(
    solution: Solution, *, source: str | None = None, fit: EdgeFit | None = None
) -> str:
    """HTML of the report: `report.html` filled in.

    Parameters and errors are those of `write_report`.
    """
    robots = _partition(solution)
    certificate = solution.certificate
    graph = solution.problem.graph.with_robots(robots.robot)
    fit = fit or judge_edges(solution.problem, solution.all_poses, solution.edge_residuals)
    stage_names = _stage_names(solution)
    plots = _plots(solution, graph, fit, stage_names)
    figures = ",".join(f'"{name}":{figure.to_json()}' for name, figure in plots.items())
    _, name_of_poses_before = solution.before()
    chi2 = fit.residuals.cost.sum() if fit.cost != certificate.cost else None
    robust = solution.robust
    content = {
        "headline": (
            headline(certificate) if robust is None else f"{robust.headline}. {robust.conditional}"
        ),
        "verdict": certificate.verdict if robust is None else robust.standing,
        "fit": solution.fit_text,
        "is_doubtful": robust is None and solution.is_doubtful,
        "meaning": meaning(certificate),
        "ate": _trajectory_error(solution, graph),
        "advice": _advice(solution, graph, fit, source),
        "before": name_of_poses_before,
        "thinned": [
            thinning_step(graph.num_edges, MOST_LINES),
            thinning_step(graph.num_poses, MOST_DOTS),
        ],
        "has_curves": "convergence" in plots,
        "robots": _robots(solution, robots),
        "edges": _worst_edges(solution, robots, fit),
        "chi2": chi2,
        "stages": _stages(solution, stage_names),
        "endings": sorted({(stage.status.name, stage.status.value) for stage in solution.stages}),
        "settings": _settings(solution, stage_names),
        "versions": installed_versions(solution.problem.backend),
        # The figures are in a script element, which </script> would end.
        "plots": f"{{{figures}}}".replace("<", "\\u003c"),
        "plot_settings": PAGE_CONFIG,
        "library": plotly("offline").get_plotlyjs(),
        "solution": solution,
        "graph": graph,
        "certificate": certificate,
        "residuals": fit.residuals,
    }
    jinja2 = extra_module("jinja2", "plot")
    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
    )
    return str(templates.get_template("report.html").render(content))


def _plots(
    solution: Solution, graph: PoseGraph, fit: EdgeFit, stage_names: Sequence[str]
) -> dict[str, Any]:
    """Plotly figures of the page, by the name of their element."""
    before, _ = solution.before()
    picture = explore_graph(
        graph,
        solution.all_poses,
        covariances=solution.covariances,
        residuals=fit.residuals,
        before=before,
    )
    plots = {f"graph{graph.d}d": picture, "fit": explore_fit(fit.residuals, graph.d)}
    histories = [stage.history for stage in solution.stages]
    if any(map(len, histories)):
        stages = list(zip(stage_names, histories, strict=True))
        plots["convergence"] = explore_convergence(
            stages, solution.certificate.lower_bound, published_run(graph)
        )
    return plots


def _trajectory_error(solution: Solution, graph: PoseGraph) -> float | None:
    """Absolute trajectory error; None if the truth is not known."""
    if graph.truth is None:
        return None
    truth = graph.with_world_of(graph.truth)
    return absolute_trajectory_error(solution.all_poses[graph.bodies], truth[graph.bodies])


def _advice(solution: Solution, graph: PoseGraph, fit: EdgeFit, source: str | None) -> list[Advice]:
    if any(stage.name == "ExtendedSOC" for stage in solution.stages):
        return []  # commands would solve the graph without the user's own terms
    robust = solution.robust
    is_robust = robust is not None
    suggestions = advice(graph, solution.certificate, solution.status, fit, source, is_robust)
    if robust is not None:
        return advice_in_doubt(robust) + suggestions
    return suggestions


@dataclass(frozen=True)
class _Cell:
    """A cell of a table: the text shown, and the value to sort by, the text itself unless given."""

    text: str
    value: float | None = None

    @property
    def key(self) -> str:
        return self.text if self.value is None else repr(float(self.value))


@dataclass(frozen=True)
class _Table:
    """Table with an id, sentences above it, and rows that are marked."""

    name: str
    sentences: Sequence[str]
    heads: Sequence[str]
    rows: Sequence[Sequence[_Cell]]
    alarms: Collection[int] = ()


def _partition(solution: Solution) -> Partition:
    """Robots that solved the problem, or else those that the graph names."""
    if solution.robots is not None:
        return solution.robots
    for stage in solution.stages:
        if isinstance(stage.method, SOC) and stage.method.robots is not None:
            return stage.method.robots
    return Partition(solution.problem.graph.robots, PartitionMethod.GIVEN)


def _robots(solution: Solution, robots: Partition) -> _Table:
    """Table of the robots: poses, edges, communication, and share of the cost."""
    graph = solution.problem.graph
    num_robots = robots.num_robots
    share = _share_of_robots(solution, robots)
    columns = _columns_of_robots(graph, robots)
    sentence = "One robot holds the whole graph."
    if num_robots > 1:
        sentence = f"{num_robots} robots, {robots.method.value}."
    sentences = [sentence]
    ledger = solution.ledger
    if solution.robots is not None:
        sentences += _communication(ledger)
        if ledger.num_robots == num_robots:
            columns["bytes sent"] = ledger.bytes_sent
            columns["bytes received"] = ledger.bytes_received
    shown = np.arange(num_robots)
    cost = solution.certificate.cost
    if num_robots > _MOST_ROBOTS:
        shown = np.argsort(-share, kind="stable")[:_MOST_ROBOTS]
        sentences.append(f"Shown are the {_MOST_ROBOTS} with the largest share of {cost}.")
    rows = []
    for robot in shown.tolist():
        counts = [int(column[robot]) for column in columns.values()]
        row = [_Cell(f"{count:,}", count) for count in counts]
        row.append(_percentage(share[robot]))
        rows.append(row)
    return _Table("robots", sentences, [*columns, f"share of {cost}"], rows)


def _share_of_robots(solution: Solution, robots: Partition) -> Array:
    """Share of every robot in the cost, (num_robots,); an edge counts half at either end."""
    graph = solution.problem.graph
    half = 0.5 * solution.edge_residuals.share
    at_i = np.bincount(robots.robot[graph.i], half, robots.num_robots)
    at_j = np.bincount(robots.robot[graph.j], half, robots.num_robots)
    return np.asarray(at_i + at_j, dtype=float)


def _columns_of_robots(graph: PoseGraph, robots: Partition) -> dict[str, IntArray]:
    """Numbers of poses and edges of every robot, (num_robots,), by the head of their column."""
    owner = robots.robot
    is_cut = robots.cut_edges(graph)

    def count(owners: IntArray) -> IntArray:
        return np.bincount(owners, minlength=robots.num_robots)

    return {
        "robot": np.arange(robots.num_robots),
        "poses": robots.sizes,
        "own edges": count(owner[graph.i[~is_cut]]),
        "edges to others": count(owner[graph.i[is_cut]]) + count(owner[graph.j[is_cut]]),
        "separators": count(owner[robots.separators(graph)]),
    }


def _communication(ledger: Ledger) -> list[str]:
    """Sentences on the messages of a solve, and on its snapshots if there are any."""
    text = f"{ledger.rounds} rounds, {ledger.messages:,} messages, {ledger.num_bytes:,} bytes"
    if ledger.all_reduces:
        text += f", {ledger.all_reduces} all-reduces"
    if ledger.all_reduce_bytes:
        text += f" ({ledger.all_reduce_bytes:,} bytes)"
    sentences = [f"Communication: {text}."]
    if ledger.snapshot_bytes:
        sentences.append(
            f"Snapshots, to the process of the driver: {ledger.snapshot_bytes:,} bytes."
        )
    return sentences


def _worst_edges(solution: Solution, robots: Partition, fit: EdgeFit) -> _Table:
    """Table of the edges that cost most, with their errors and weights."""
    graph = solution.problem.graph
    names = pose_names(graph)
    residuals = fit.residuals
    worst = np.argsort(-residuals.cost, kind="stable")[:_WORST_EDGES]
    degrees = np.rad2deg(residuals.rotation)
    has_robots = robots.num_robots > 1
    heads = [
        "edge",
        *(["from robot"] if has_robots else []),
        "from pose",
        *(["to robot"] if has_robots else []),
        "to pose",
        "cost",
        "allowed",
        f"share of {fit.cost}",
        "error (m)",
        "error (deg)",
        "kappa (1/rad^2)",
        "tau (1/m^2)",
    ]
    rows = []
    for e in worst.tolist():
        row = [_Cell(str(e), e)]
        for pose in (int(graph.i[e]), int(graph.j[e])):
            if has_robots:
                row.append(_number(robots.robot[pose], "d"))
            row.append(_Cell(names[pose]))
        row += [
            _number(residuals.cost[e], ".4g"),
            _number(residuals.allowed[e], ".4g"),
            _percentage(residuals.share[e]),
            _error(residuals.translation[e], graph.tau[e]),
            _error(degrees[e], graph.kappa[e]),
            _number(graph.kappa[e], ".4g"),
            _number(graph.tau[e], ".4g"),
        ]
        rows.append(row)
    share = 100 * residuals.share[worst].sum()
    text = (
        f"The {len(rows)} of {graph.num_edges} edges that cost most, {share:.3g} % of {fit.cost} "
        f"together. {fit.sentence()} Half of all errors are below "
        f"{_median_errors(graph, residuals)}. Click on a head to sort."
    )
    misfits = np.flatnonzero(residuals.is_misfit[worst]).tolist()
    return _Table("edges", [text], heads, rows, misfits)


def _error(value: float, precision: float) -> _Cell:
    """Error of a measurement, a dash if it has no precision."""
    return _number(value, ".4g") if precision > 0 else _Cell("-", -1.0)


def _median_errors(graph: PoseGraph, residuals: EdgeResiduals) -> str:
    """Median errors of the translations and rotations that were measured."""
    medians = []
    translations = residuals.translation[graph.tau > 0]
    if translations.size:
        medians.append(f"{np.median(translations):.3g} m")
    rotations = np.rad2deg(residuals.rotation)[graph.kappa > 0]
    if rotations.size:
        medians.append(f"{np.median(rotations):.3g} degrees")
    return " and ".join(medians)


def _stages(solution: Solution, names: Sequence[str]) -> _Table:
    """Table of the stages and how they ended."""
    rows = []
    for name, stage in zip(names, solution.stages, strict=True):
        figures = [_Cell("")] * 3
        if stage.was_taken:
            figures = [
                _number(stage.iterations, "d"),
                _Cell(rounded_up(stage.objective), stage.objective),
                _number(stage.seconds, ".3f"),
            ]
        rows.append([_Cell(name), *figures, _Cell(stage.ending)])
    heads = ["stage", "iterations", solution.certificate.cost, "seconds", "ended"]
    return _Table("stages", [], heads, rows)


def _settings(solution: Solution, names: Sequence[str]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Settings of the solve and of every method: a title, then names and values.

    A method with the settings of an earlier stage is left out.
    """
    parts = [("", [("gap asked for", f"{solution.certificate.wanted_gap:.3g}")])]
    seen: set[str] = set()
    for name, stage in zip(names, solution.stages, strict=True):
        method = stage.method
        if not is_dataclass(method) or isinstance(method, type) or repr(method) in seen:
            continue
        seen.add(repr(method))
        rows = []
        for setting in fields(method):
            rows.append((setting.name, _setting(getattr(method, setting.name))))
        parts.append((name, rows))
    return parts


def _stage_names(solution: Solution) -> list[str]:
    """Names of the stages, with the number of a later attempt; repeated names are numbered."""
    count: Counter[str] = Counter()
    names = []
    for stage in solution.stages:
        name = f"{stage.name}, attempt {stage.attempt}" if stage.attempt > 1 else stage.name
        count[name] += 1
        names.append(f"{name} ({count[name]})" if count[name] > 1 else name)
    return names


def _setting(value: object) -> str:
    if value is None:
        return "default"
    return value.name if isinstance(value, enum.Enum) else str(value)


def _number(value: float, form: str) -> _Cell:
    return _Cell(format(value, form), float(value))


def _percentage(fraction: float) -> _Cell:
    return _Cell(f"{100 * fraction:.3g} %", fraction)
