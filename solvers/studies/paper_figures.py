"""The paper's figures, drawn anew: truth and result of its scenes, results on the benchmarks, residuals of its SOC."""

from __future__ import annotations

import enum
import html
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pgo_models.certificates.certificate import relative_gap
from pgo_models.errors import PGOError
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.published_results import PublishedRow, published_rows, published_run
from pgo_models.plots.graph_plots import plot_panels
from pgo_models.plots.interactive_plots import explore_graph, save_page
from pgo_models.plots.style import column_figure, plotly, save_figure
from pgo_models.problem.problem import PGOProblem
from solvers.progress_bars import JobBar
from solvers.reporting.convergence_plots import explore_convergence, plot_convergence
from solvers.reporting.result_table import gap_percent
from solvers.result import History
from solvers.studies.benchmark import BenchmarkMethod, BenchmarkRun, BenchmarkSettings, StageRecord
from solvers.studies.benchmark_runs import run_benchmark, solve_whole
from solvers.studies.paper_tables import SCENES, graph_of_row

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from plotly.graph_objects import Figure as PlotlyFigure

_STAGES = ("SOC", "Gauss-Newton")
_PLAIN = "edges and poses"  # as `explore_graph` names what does not stand out
_EYE = {"x": 1.1, "y": -1.9, "z": 1.25}  # from where matplotlib looks


class FigureSet(enum.Enum):
    """Which of the paper's figures."""

    SCENES = "scenes"
    BENCHMARKS = "benchmarks"
    CONVERGENCE = "convergence"

    @property
    def groups(self) -> tuple[tuple[str, ...], ...]:
        """Graphs of each of its figures, in the paper's order."""
        scenes, benchmarks = ("circle", "sphere", "grid"), ("parking-garage", "cubicle", "torus3D")
        alone = tuple((name,) for name in (*scenes, *benchmarks))
        return {"scenes": (scenes,), "benchmarks": (benchmarks,), "convergence": alone}[self.value]


@dataclass(frozen=True, eq=False)
class Shown:
    """A graph with what the paper's method made of it, and the bound that is proven."""

    graph: PoseGraph
    trial: BenchmarkRun
    lower_bound: float

    @property
    def panels(self) -> list[tuple[str, PoseGraph, Poses]]:
        """Truth, if known, and result, aligned with it or with the estimate that the graph came with."""
        graph, poses = self.graph, self.trial.poses
        reference = graph.truth if graph.truth is not None else graph.initial
        gap = gap_percent(relative_gap(self.trial.objective, self.lower_bound))
        title = f"{graph.name}, SOC: F = {self.trial.objective:.6g}, gap {gap} %"
        shown = [(title, graph, poses if reference is None else poses.aligned_to(reference))]
        if graph.truth is not None:
            shown.insert(0, (f"{graph.name}, ground truth", graph, graph.truth))
        return shown


def draw_paper_figures(
    folder: Path | str, only: tuple[FigureSet, ...] = (), *, download: bool = False, progress: bool | None = None
) -> tuple[list[Path], list[str]]:
    """Run the paper's SOC on its graphs, as the tables do, and write the figures as PNG and interactive HTML.

    Files written, and why graphs were left out: those that are not here, unless `download` fetches them. The folder is
    made if it is not there; `only` are all sets unless given; `progress` shows a bar on stderr, where that is a
    terminal unless given. A figure is written once its graphs are run. A PGOError when a file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> written, _ = draw_paper_figures(tempfile.mkdtemp(), (FigureSet.SCENES,))
    >>> [path.name for path in written]
    ['scenes.png', 'scenes.html']
    """
    sets = only or tuple(FigureSet)
    folder = Path(folder)
    with column_figure(height=1.0):  # both kinds of pictures can be drawn: asked before the runs, not after
        plotly("graph_objects")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PGOError(f"cannot make the folder {folder}: {error.strerror}; choose another") from error
    rows, runs, written = {row.name: row for row in published_rows()}, dict[str, Shown | str](), list[Path]()
    groups = [(one, group) for one in sets for group in one.groups]
    with JobBar(len({name for _, group in groups for name in group}), progress) as bar:
        for one, group in groups:
            for name in group:
                if name not in runs:
                    bar.name_part(name)
                    runs[name] = _run(rows[name], download)
                    bar.end_part()
            here = [run for name in group if isinstance(run := runs[name], Shown)]
            if here:
                written += (_write_convergence if one is FigureSet.CONVERGENCE else _write_grid)(one, here, folder)
    return written, [run for run in runs.values() if isinstance(run, str)]


def explore_panels(panels: list[list[tuple[str, PoseGraph, Poses]]]) -> PlotlyFigure:
    """Plotly figure of what `plot_panels` shows of graphs in space, each picture to turn on its own."""
    columns, spacing = max(len(row) for row in panels), {"horizontal_spacing": 0.02, "vertical_spacing": 0.1}
    scenes = [[{"type": "scene"} if c < len(row) else None for c in range(columns)] for row in panels]
    titles = [html.escape(title).replace(": ", "<br>") for row in panels for title, _, _ in row]
    figure = plotly("subplots").make_subplots(len(panels), columns, specs=scenes, subplot_titles=titles, **spacing)
    named: set[str] = set()
    for r, row in enumerate(panels, 1):
        for c, (_, graph, poses) in enumerate(row, 1):
            picture = explore_graph(graph, poses)
            for trace in picture.data:
                # Of edges that stand out the legend says once why; it shows and hides them everywhere.
                is_named = trace.showlegend and trace.name not in named and trace.name != _PLAIN
                named |= {trace.name} if is_named else set()
                figure.add_trace(trace.update(showlegend=is_named, legendgroup=trace.name), r, c)
            figure.update_scenes(picture.layout.scene.to_plotly_json(), row=r, col=c)
    figure.update_scenes(camera={"eye": _EYE})
    figure.update_annotations(font_size=12)
    legend, margin = {"orientation": "h", "y": 0.0}, {"l": 10, "r": 10, "t": 40, "b": 10}
    figure.update_layout(template="none", margin=margin, height=480 * len(panels), legend=legend)
    return figure


def _run(row: PublishedRow, download: bool) -> Shown | str:
    """The paper's method on a graph, or why it is left out."""
    try:
        graph = graph_of_row(row, 0, download)
        problem = PGOProblem(graph)
        bound = solve_whole(problem).lower_bound
        start = graph.initial if row.name in SCENES else None
        settings = BenchmarkSettings(max_rounds=row.soc.iterations)
        return Shown(graph, run_benchmark(BenchmarkMethod.PAPER, problem, settings, start), bound)
    except PGOError as error:
        return str(error)


def _write_grid(one: FigureSet, here: list[Shown], folder: Path) -> list[Path]:
    columns = [shown.panels for shown in here]
    panels = [[column[r] for column in columns if r < len(column)] for r in range(max(map(len, columns)))]
    return _write_both(folder, one.value, plot_panels(panels), explore_panels(panels))


def _write_convergence(one: FigureSet, here: list[Shown], folder: Path) -> list[Path]:
    (shown,) = here
    stages = [(name, _from_step_one(leg)) for name, leg in zip(_STAGES, shown.trial.legs, strict=True)]
    curves = stages, shown.lower_bound, published_run(shown.graph)
    name = f"{one.value}-{shown.graph.name}"
    return _write_both(folder, name, plot_convergence(*curves), explore_convergence(*curves))


def _write_both(folder: Path, name: str, picture: Figure, page: PlotlyFigure) -> list[Path]:
    save_figure(picture, folder / f"{name}.png")
    save_page(page, folder / f"{name}.html")
    return [folder / f"{name}.png", folder / f"{name}.html"]


def _from_step_one(leg: StageRecord) -> History:
    """History in which state 0 of SOC, where R and omega are the same start, has no primal residual but zero."""
    first, *others = leg.history.records
    return History((replace(first, measurement=replace(first.measurement, primal_residual=0.0)), *others))
