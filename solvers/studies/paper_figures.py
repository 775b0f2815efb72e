"""The paper's figures, drawn from our own runs of its method.

They are truth and result of its scenes, results on the benchmarks, and residuals of its SOC.
"""

from __future__ import annotations

import enum
import html
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pgo_models.certificates.certificate import relative_gap
from pgo_models.errors import PGOError, door
from pgo_models.figures import rounded_up
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.published_results import PublishedRow, published_rows, published_run
from pgo_models.plots.graph_plots import plot_panels
from pgo_models.plots.interactive_plots import explore_graph
from pgo_models.plots.pages import save_page
from pgo_models.plots.style import column_figure, plotly, save_figure
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
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
_ORDINARY = "edges and poses"  # name by `explore_graph` of the edges that do not stand out
_EYE = {"x": 1.1, "y": -1.9, "z": 1.25}  # the point of view of matplotlib


class FigureSet(enum.Enum):
    """Figures of the paper: scenes, benchmarks, or residuals of its method."""

    SCENES = "scenes"
    BENCHMARKS = "benchmarks"
    CONVERGENCE = "convergence"

    @property
    def groups(self) -> tuple[tuple[str, ...], ...]:
        """Names of the graphs in each figure, in the paper's order."""
        scenes = ("circle", "sphere", "grid")
        benchmarks = ("parking-garage", "cubicle", "torus3D")
        if self is FigureSet.SCENES:
            return (scenes,)
        if self is FigureSet.BENCHMARKS:
            return (benchmarks,)
        return tuple((name,) for name in (*scenes, *benchmarks))


@dataclass(frozen=True, eq=False)
class PaperRun:
    """A graph with a run of the paper's method on it, and a proven lower bound."""

    graph: PoseGraph
    trial: BenchmarkRun
    lower_bound: float

    @property
    def panels(self) -> list[tuple[str, PoseGraph, Poses]]:
        """Panels with title, graph and poses: the truth if it is known, and the result.

        The result is aligned with the truth, or with the estimate that the graph came with.
        """
        graph = self.graph
        poses = self.trial.poses
        reference = graph.truth if graph.truth is not None else graph.initial
        if reference is not None:
            poses = poses.aligned_to(reference)
        gap = gap_percent(relative_gap(self.trial.objective, self.lower_bound))
        title = f"{graph.name}, SOC: F = {rounded_up(self.trial.objective, 6)}, gap {gap} %"
        panels = [(title, graph, poses)]
        if graph.truth is not None:
            panels.insert(0, (f"{graph.name}, ground truth", graph, graph.truth))
        return panels


@door
def draw_paper_figures(
    folder: Path | str,
    only: tuple[FigureSet, ...] = (),
    *,
    download: bool = False,
    progress: bool | None = None,
) -> tuple[list[Path], list[str]]:
    """Run the paper's SOC on its graphs, and write its figures as PNG and as HTML.

    The runs are those of the tables. A figure is written as soon as its graphs are solved.

    Parameters
    ----------
    folder : Path or str
        Folder of the figures, which is made if it does not exist.
    only : tuple of FigureSet
        Which figures; all unless given.
    download : bool
        Whether to download graphs that are not here.
    progress : bool, optional
        Whether to show a bar on stderr; if not given, it is shown on a terminal.

    Returns
    -------
    written : list of Path
        Files that were written.
    reasons : list of str
        Why graphs were left out, for example because they are not here.

    Raises
    ------
    PGOError
        If a file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> written, _ = draw_paper_figures(tempfile.mkdtemp(), (FigureSet.SCENES,))
    >>> [path.name for path in written]
    ['scenes.png', 'scenes.html']
    """
    sets = only or tuple(FigureSet)
    folder = Path(folder)
    _check_plotting()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PGOError(
            f"cannot make the folder {folder}: {error.strerror}; choose another"
        ) from error
    rows = {row.name: row for row in published_rows()}
    figures = [(kind, names) for kind in sets for names in kind.groups]
    num_graphs = len({name for _, names in figures for name in names})
    runs: dict[str, PaperRun | str] = {}
    written: list[Path] = []
    with JobBar(num_graphs, progress) as bar:
        for kind, names in figures:
            for name in names:
                if name not in runs:
                    bar.name_part(name)
                    runs[name] = _run(rows[name], download)
                    bar.end_part()
            shown = [run for run in map(runs.__getitem__, names) if isinstance(run, PaperRun)]
            if shown:
                write = _write_grid
                if kind is FigureSet.CONVERGENCE:
                    write = _write_convergence
                written += write(kind, shown, folder)
    return written, [run for run in runs.values() if isinstance(run, str)]


def _check_plotting() -> None:
    """Raise a MissingExtraError before the runs if a plotting library is missing."""
    with column_figure(height=1.0):
        plotly("graph_objects")


def explore_panels(panels: list[list[tuple[str, PoseGraph, Poses]]]) -> PlotlyFigure:
    """Plotly figure of the panels of `plot_panels` for graphs in space.

    Every panel can be turned on its own.
    """
    columns = max(len(row) for row in panels)
    scenes = [
        [{"type": "scene"} if c < len(row) else None for c in range(columns)] for row in panels
    ]
    titles = [html.escape(title).replace(": ", "<br>") for row in panels for title, _, _ in row]
    figure = plotly("subplots").make_subplots(
        len(panels),
        columns,
        specs=scenes,
        subplot_titles=titles,
        horizontal_spacing=0.02,
        vertical_spacing=0.1,
    )
    named: set[str] = set()
    for r, row in enumerate(panels, 1):
        for c, (_, graph, poses) in enumerate(row, 1):
            picture = explore_graph(graph, poses)
            for trace in picture.data:
                # The legend explains edges that stand out once; its entry shows and hides them in
                # all panels.
                is_known = trace.name in named or trace.name == _ORDINARY
                is_named = bool(trace.showlegend) and not is_known
                if is_named:
                    named.add(trace.name)
                figure.add_trace(trace.update(showlegend=is_named, legendgroup=trace.name), r, c)
            figure.update_scenes(picture.layout.scene.to_plotly_json(), row=r, col=c)
    figure.update_scenes(camera={"eye": _EYE})
    figure.update_annotations(font_size=12)
    figure.update_layout(
        template="none",
        margin={"l": 10, "r": 10, "t": 40, "b": 10},
        height=480 * len(panels),
        legend={"orientation": "h", "y": 0.0},
    )
    return figure


def _run(row: PublishedRow, download: bool) -> PaperRun | str:
    """Run of the paper's method on a graph, or the reason why it is left out."""
    try:
        graph = graph_of_row(row, 0, download)
        problem = PGOProblem(graph, weighting=Weighting.ISOTROPIC)
        bound = solve_whole(problem).lower_bound
        start = graph.initial if row.name in SCENES else None
        settings = BenchmarkSettings(max_rounds=row.soc.iterations)
        trial = run_benchmark(BenchmarkMethod.PAPER, problem, settings, start)
        return PaperRun(graph, trial, bound)
    except PGOError as error:
        return str(error)


def _write_grid(kind: FigureSet, runs: list[PaperRun], folder: Path) -> list[Path]:
    """Write a figure with a column of panels for every graph."""
    columns = [run.panels for run in runs]
    num_rows = max(map(len, columns))
    rows = [[column[r] for column in columns if r < len(column)] for r in range(num_rows)]
    return _write_both(folder, kind.value, plot_panels(rows), explore_panels(rows))


def _write_convergence(kind: FigureSet, runs: list[PaperRun], folder: Path) -> list[Path]:
    """Write the residuals of the one graph in the figure."""
    (run,) = runs
    histories = [_without_start(stage) for stage in run.trial.stages]
    stages = list(zip(_STAGES, histories, strict=True))
    published = published_run(run.graph)
    return _write_both(
        folder,
        f"{kind.value}-{run.graph.name}",
        plot_convergence(stages, run.lower_bound, published),
        explore_convergence(stages, run.lower_bound, published),
    )


def _write_both(folder: Path, name: str, picture: Figure, page: PlotlyFigure) -> list[Path]:
    save_figure(picture, folder / f"{name}.png")
    save_page(page, folder / f"{name}.html")
    return [folder / f"{name}.png", folder / f"{name}.html"]


def _without_start(stage: StageRecord) -> History:
    """History without the primal residual of state 0, where R and omega are the same start.

    It is set to zero, which a logarithmic axis leaves out.
    """
    first, *others = stage.history.records
    measurement = replace(first.measurement, primal_residual=0.0)
    return History((replace(first, measurement=measurement), *others))
