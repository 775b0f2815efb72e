"""Commands of `pgo` that hold methods against each other: tables, compare, figures."""

import enum
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from pgo_models.errors import PGOError, SettingError
from pgo_models.files import check_writable
from pgo_models.problem.problem import PGOProblem
from solvers.cli_inputs import load_graph
from solvers.explanations import explained_by_its_graph
from solvers.reporting.result_table import check_table_format
from solvers.shell import BROKEN_OFF, JsonOption, QuietOption, save_then_show
from solvers.studies.benchmark import BenchmarkMethod, BenchmarkSettings
from solvers.studies.comparison import ComparisonSettings, check_plot_format, compare_methods
from solvers.studies.paper_figures import FigureSet, draw_paper_figures
from solvers.studies.paper_tables import ReproductionSettings, reproduce_tables
from solvers.studies.paper_tables_text import tables_as_text

Choice = TypeVar("Choice", bound=enum.Enum)
KEPT_FILE = Path("pgo-tables.json")
DownloadOption = Annotated[
    bool, typer.Option("--download", help="Download the benchmark graphs that are not here; each is checked.")
]
UnitWeightsOption = Annotated[
    bool, typer.Option("--unit-weights", help="Set kappa = tau = 1, the weights of the paper's equation.")
]
DropEdgeOption = Annotated[
    list[str] | None,
    typer.Option(metavar="LINE", help="Leave out the edge on this line of the file (FILE:LINE); may be repeated."),
]
TableOption = Annotated[
    list[Path] | None,
    typer.Option("--out", "-o", help="Write the table: .md, .csv or .json; may be given several times."),
]


def tables_command(
    only: Annotated[
        str,
        typer.Option(help="Rows, with commas between: circle, grid, sphere, parking-garage, cubicle, torus3D, rim."),
    ] = "",
    seeds: Annotated[
        int, typer.Option(min=1, help="Draws of the random scenes circle, grid and sphere.")
    ] = ReproductionSettings.num_seeds,
    robots: Annotated[
        int, typer.Option(min=1, help="Robots that share a graph; SOC as in the paper has one a pose.")
    ] = ReproductionSettings.num_robots,
    out: TableOption = None,
    keep: Annotated[
        Path, typer.Option(help="File that keeps every finished figure: the same command goes on where it was.")
    ] = KEPT_FILE,
    fresh: Annotated[bool, typer.Option("--fresh", help="Leave aside what is kept, and run all anew.")] = False,
    download: DownloadOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run the paper's tables 1 to 4, row for row: its figures beside ours, held against proven bounds."""
    _check(out, check_table_format)
    check_writable(keep)
    settings = ReproductionSettings(_split(only), seeds, robots, download)
    tables = reproduce_tables(settings, keep, is_fresh=fresh, progress=False if quiet else None)
    table = tables_as_text(tables)
    save_then_show([(path, table.save) for path in out or []], table.print, table.as_json if as_json else None, quiet)
    if not tables.is_complete:
        raise typer.Exit(BROKEN_OFF)


@explained_by_its_graph
def compare_command(
    graph: Annotated[
        str, typer.Argument(help="A g2o file, a folder with one file a robot, or the name of a data set.")
    ],
    methods: Annotated[
        str,
        typer.Option(
            help=f"With commas between: {', '.join(one.value for one in BenchmarkMethod)}. "
            "All that run here unless given."
        ),
    ] = "",
    robots: Annotated[int, typer.Option(min=1, help="Robots that share the graph.")] = BenchmarkSettings.num_robots,
    out: TableOption = None,
    plot: Annotated[
        list[Path] | None,
        typer.Option(help="Write the gap against rounds, bytes and seconds: .png, .svg, .pdf or .html."),
    ] = None,
    time_limit: Annotated[float, typer.Option(help="Seconds for every method.")] = math.inf,
    unit_weights: UnitWeightsOption = False,
    drop_edge: DropEdgeOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run several methods on a graph and hold them against each other and a proven bound."""
    _check(out, check_table_format)
    _check(plot, check_plot_format)
    settings = ComparisonSettings(
        _chosen(BenchmarkMethod, methods, "method"), BenchmarkSettings(robots, time_limit=time_limit)
    )
    problem = PGOProblem(load_graph(graph, unit_weights, dropped=drop_edge))
    comparison = compare_methods(problem, settings, progress=False if quiet else None)
    table = comparison.table()
    targets = [(path, table.save) for path in out or []] + [(path, comparison.save_plot) for path in plot or []]
    save_then_show(targets, table.print, table.as_json if as_json else None, quiet)
    if not comparison.is_complete:
        raise typer.Exit(BROKEN_OFF)


def figures_command(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the pictures.")] = Path("figures"),
    only: Annotated[
        str, typer.Option(help=f"With commas between: {', '.join(one.value for one in FigureSet)}. All unless given.")
    ] = "",
    download: DownloadOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Draw the paper's figures anew, as PNG and as pages to explore."""
    sets, progress = _chosen(FigureSet, only, "figure"), False if quiet else None
    written, reasons = draw_paper_figures(out, sets, download=download, progress=progress)
    record: dict[str, object] = {"written": list(map(str, written)), "left_out": reasons}
    text = "\n".join(f"written: {path}" for path in written)
    save_then_show([], lambda: typer.echo(text), (lambda: record) if as_json else None, quiet)
    for reason in reasons:
        typer.echo(f"left out: {reason}", err=True)
    if not written:
        raise PGOError("no figure could be drawn: no graph is here")


def _chosen(choices: type[Choice], names: str, kind: str) -> tuple[Choice, ...]:
    known = {one.value: one for one in choices}
    for name in _split(names):
        if name not in known:
            raise SettingError(f"there is no {kind} {name!r}; there are {', '.join(known)}")
    return tuple(known[name] for name in _split(names))


def _split(names: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name.strip() for name in names.split(",") if name.strip()))


def _check(paths: list[Path] | None, check_format: Callable[[Path], None]) -> None:
    """Refuse files that could not be written: before a long run, not after it."""
    for path in paths or []:
        check_format(path)
        check_writable(path)
