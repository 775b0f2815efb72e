"""The report of a solve: one HTML file that opens offline and says how good the answer is and what to try next."""

import enum
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path

import numpy as np

from pgo_models.certificates.certificate import gap_text
from pgo_models.errors import SettingError, extra_module
from pgo_models.files import replace_when_done
from pgo_models.geometry.poses import absolute_trajectory_error
from pgo_models.graphs.g2o import pose_names
from pgo_models.graphs.partitioning import Partition, PartitionMethod
from pgo_models.graphs.published_results import published_run
from pgo_models.plots.graph_plots import MOST_LINES, thinning_step
from pgo_models.plots.interactive_plots import MOST_DOTS, PAGE_CONFIG, explore_graph
from pgo_models.plots.style import plotly
from pgo_models.problem.thresholds import EdgeResiduals, edge_residuals
from solvers.reporting.convergence_plots import explore_convergence
from solvers.reporting.fit_plots import explore_fit
from solvers.reporting.report_text import Solved, advice, fit, headline, meaning
from solvers.reporting.versions import installed_versions
from solvers.soc.soc import SOC

_WORST_EDGES = 100
_MOST_ROBOTS = 200
_PAGE_SUFFIXES = (".html", ".htm")


def write_report(solution: Solved, path: Path | str, *, source: str | None = None) -> None:
    """Write the report of a solution as one HTML page, whole or not at all.

    Plotly's script is inside (about 5 MB). The path ends in .html or .htm; `source` is what stands for the graph in
    commands: a file, folder or name, quoted where a shell needs it, and options that change the problem; the graph's
    name unless given. Errors as `check_report` and `replace_when_done`.

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
    """Raise what `write_report` would before it writes: a SettingError, or if plotly or Jinja2 is missing."""
    if path.suffix.lower() not in _PAGE_SUFFIXES:
        raise SettingError(f"cannot write {path}: a report is a page; give a name that ends in .html")
    plotly("offline")
    extra_module("jinja2", "plot")


def report_page(solution: Solved, *, source: str | None = None) -> str:
    """HTML of the report, `report.html` filled in; parameters and errors as for `write_report`."""
    robots, certificate = _partition(solution), solution.certificate
    graph = solution.problem.graph.with_robots(robots.robot)
    residuals = edge_residuals(solution.problem, solution.poses)
    before, before_name = solution.before()
    truth = None if graph.truth is None else graph.truth[graph.bodies]
    picture = explore_graph(graph, solution.poses, covariances=solution.covariances, residuals=residuals, before=before)
    plots = {f"graph{graph.d}d": picture, "fit": explore_fit(residuals, graph.d)}
    names = _stage_names(solution)
    stages = list(zip(names, (stage.history for stage in solution.stages), strict=True))
    if any(len(history) for _, history in stages):
        plots["convergence"] = explore_convergence(stages, certificate.lower_bound, published_run(graph))
    figures = ",".join(f'"{name}":{figure.to_json()}' for name, figure in plots.items())
    suggested = advice(graph, certificate, solution.status, residuals, source, solution.robust is not None)
    content = {
        "headline": headline(certificate) + (f" {solution.robust.conditional}" if solution.robust else ""),
        "meaning": meaning(certificate),
        "gap": gap_text(certificate.gap),
        "ate": None if truth is None else absolute_trajectory_error(solution.poses[graph.bodies], truth),
        # Commands solve the graph without terms of one's own.
        "advice": [] if any(stage.name == "ExtendedSOC" for stage in solution.stages) else suggested,
        "before": before_name,
        "thinned": [thinning_step(graph.num_edges, MOST_LINES), thinning_step(graph.num_poses, MOST_DOTS)],
        "has_curves": "convergence" in plots,
        "robots": _robots(solution, robots, residuals),
        "edges": _worst_edges(solution, robots, residuals),
        "stages": _stages(solution, names),
        "endings": sorted({(stage.status.name, stage.status.value) for stage in solution.stages}),
        "settings": _settings(solution, names),
        "versions": installed_versions(solution.problem.backend),
        "plots": f"{{{figures}}}".replace("<", "\\u003c"),  # in a script element, which </script> would end
        "plot_settings": PAGE_CONFIG,
        "library": plotly("offline").get_plotlyjs(),
    }
    jinja2, here = extra_module("jinja2", "plot"), Path(__file__).parent
    pages = jinja2.Environment(loader=jinja2.FileSystemLoader(here), autoescape=True, undefined=jinja2.StrictUndefined)
    page = pages.get_template("report.html")
    return str(page.render(content, solution=solution, graph=graph, certificate=certificate, residuals=residuals))


@dataclass(frozen=True)
class _Cell:
    """A cell of a table: what is shown, and what it is sorted by (the text itself unless given)."""

    text: str
    value: float | None = None

    @property
    def key(self) -> str:
        return self.text if self.value is None else repr(float(self.value))


@dataclass(frozen=True)
class _Table:
    """Table of an id, what is said above it, and which of its rows are marked."""

    name: str
    said: Sequence[str]
    heads: Sequence[str]
    rows: Sequence[Sequence[_Cell]]
    alarms: Collection[int] = ()


def _partition(solution: Solved) -> Partition:
    """Robots that solved the problem, else those that the graph names."""
    if solution.robots is not None:
        return solution.robots
    for stage in solution.stages:
        if isinstance(stage.method, SOC) and stage.method.robots is not None:
            return stage.method.robots
    return Partition(solution.problem.graph.robots, PartitionMethod.GIVEN)


def _robots(solution: Solved, robots: Partition, residuals: EdgeResiduals) -> _Table:
    graph, count, owner = solution.problem.graph, robots.num_robots, robots.robot
    cut = robots.cut_edges(graph)
    half = 0.5 * residuals.share
    share = np.bincount(owner[graph.i], half, count) + np.bincount(owner[graph.j], half, count)
    own = np.bincount(owner[graph.i[~cut]], minlength=count)
    between = np.bincount(owner[graph.i[cut]], minlength=count) + np.bincount(owner[graph.j[cut]], minlength=count)
    separators = np.bincount(owner[robots.separators(graph)], minlength=count)
    heads = ["robot", "poses", "own edges", "edges to others", "separators"]
    columns = [list(range(count)), *(column.tolist() for column in (robots.sizes, own, between, separators))]
    lines = [f"{count} robots, {robots.method.value}." if count > 1 else "One robot holds the whole graph."]
    ledger = solution.ledger
    if ledger is not None:
        sent = f"{ledger.rounds} rounds, {ledger.messages:,} messages, {ledger.num_bytes:,} bytes"
        sums = f", {ledger.all_reduces} all-reduces" if ledger.all_reduces else ""
        sums += f" ({ledger.all_reduce_bytes:,} bytes)" if ledger.all_reduce_bytes else ""
        lines.append(f"Communication: {sent}{sums}.")
        if ledger.num_robots == count:
            heads += ["bytes sent", "bytes received"]
            columns += [ledger.bytes_sent.tolist(), ledger.bytes_received.tolist()]
    shown = np.argsort(-share, kind="stable")[:_MOST_ROBOTS] if count > _MOST_ROBOTS else np.arange(count)
    if count > _MOST_ROBOTS:
        lines.append(f"Shown are the {_MOST_ROBOTS} with the largest share of {solution.certificate.cost}.")
    shares = [_Cell(f"{100 * one:.3g} %", one) for one in share]
    rows = [[*(_Cell(f"{values[a]:,}", values[a]) for values in columns), shares[a]] for a in shown.tolist()]
    return _Table("robots", lines, [*heads, f"share of {solution.certificate.cost}"], rows)


def _worst_edges(solution: Solved, robots: Partition, residuals: EdgeResiduals) -> _Table:
    graph, names = solution.problem.graph, pose_names(solution.problem.graph)
    worst = np.argsort(-residuals.cost, kind="stable")[:_WORST_EDGES]
    share, degrees, name = residuals.share, np.rad2deg(residuals.rotation), solution.certificate.cost
    rows = []
    for e in worst.tolist():
        i, j = int(graph.i[e]), int(graph.j[e])
        row = [_Cell(str(e), e), _Cell(names[i]), _Cell(names[j])]
        if robots.num_robots > 1:
            row[1:] = [_number(robots.robot[i], "d"), row[1], _number(robots.robot[j], "d"), row[2]]
        cost = residuals.cost[e], residuals.allowed[e]
        errors = [(residuals.translation[e], graph.tau[e]), (degrees[e], graph.kappa[e])]
        fits = [_number(value, ".4g") if precision > 0 else _Cell("-", -1.0) for value, precision in errors]
        costs, weights = (
            [_number(value, ".4g") for value in values] for values in (cost, (graph.kappa[e], graph.tau[e]))
        )
        rows.append([*row, *costs, _Cell(f"{100 * share[e]:.3g} %", share[e]), *fits, *weights])
    ends = ["from robot", "from pose", "to robot", "to pose"] if robots.num_robots > 1 else ["from pose", "to pose"]
    share_of = f"share of {name}"
    heads = ["edge", *ends, "cost", "allowed", share_of, "error (m)", "error (deg)", "kappa (1/rad^2)", "tau (1/m^2)"]
    most = f"{len(rows)} of {graph.num_edges} edges that cost most, {100 * share[worst].sum():.3g} % of {name} together"
    halves = [("m", residuals.translation[graph.tau > 0]), ("degrees", degrees[graph.kappa > 0])]
    half = " and ".join(f"{np.median(error):.3g} {unit}" for unit, error in halves if error.size)
    text = f"The {most}. {fit(residuals, name)} Half of what was measured fits to {half}. Click on a head to sort."
    return _Table("edges", [text], heads, rows, np.flatnonzero(residuals.is_misfit[worst]).tolist())


def _stages(solution: Solved, names: Sequence[str]) -> _Table:
    rows = []
    for name, stage in zip(names, solution.stages, strict=True):
        figures = _number(stage.iterations, "d"), _number(stage.objective, ".10g"), _number(stage.seconds, ".3f")
        rows.append([_Cell(name), *figures, _Cell(stage.status.name)])
    return _Table("stages", [], ["stage", "iterations", solution.certificate.cost, "seconds", "ended"], rows)


def _settings(solution: Solved, names: Sequence[str]) -> list[tuple[str, list[tuple[str, str]]]]:
    parts = [("", [("gap asked for", f"{solution.certificate.wanted_gap:.3g}")])]
    seen: set[str] = set()
    for name, stage in zip(names, solution.stages, strict=True):
        method = stage.method
        if is_dataclass(method) and not isinstance(method, type) and repr(method) not in seen:
            seen.add(repr(method))
            parts.append((name, [(field.name, _setting(getattr(method, field.name))) for field in fields(method)]))
    return parts


def _stage_names(solution: Solved) -> list[str]:
    """Names of the stages; those that come again are numbered."""
    names = [stage.name for stage in solution.stages]
    earlier = [names[:place].count(name) for place, name in enumerate(names)]
    return [f"{name} ({before + 1})" if before else name for name, before in zip(names, earlier, strict=True)]


def _setting(value: object) -> str:
    if value is None:
        return "default"
    return value.name if isinstance(value, enum.Enum) else str(value)


def _number(value: float, form: str) -> _Cell:
    return _Cell(format(value, form), float(value))
