"""Commands of `pgo` that compare methods: tables, compare, figures."""

import enum
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from pgo_models.errors import PGOError, SettingError
from pgo_models.files import check_writable
from solvers.cli.explanations import explained_by_its_graph
from solvers.cli.inputs import check_outputs_differ, load_graph
from solvers.cli.options import DropEdgeOption, TrustFolderOption, UnitWeightsOption
from solvers.cli.shell import BROKEN_OFF, JsonOption, QuietOption, save_then_show, wrapped
from solvers.reporting.result_table import check_table_format
from solvers.studies.benchmark import BenchmarkMethod, BenchmarkSettings
from solvers.studies.comparison import ComparisonSettings, check_plot_format, compare_methods
from solvers.studies.paper_figures import FigureSet, draw_paper_figures
from solvers.studies.paper_tables import ReproductionSettings, reproduce_tables
from solvers.studies.paper_tables_text import tables_as_text

Choice = TypeVar("Choice", bound=enum.Enum)
KEPT_FILE = Path("pgo-tables.json")
JobsOption = Annotated[
    int,
    typer.Option(
        "--jobs",
        "-j",
        min=1,
        help="Runs side by side, each in a process of its own; they take wall time from each "
        "other if there are fewer cores.",
    ),
]
DownloadOption = Annotated[
    bool,
    typer.Option(
        "--download", help="Download the benchmark graphs that are not here; each is checked."
    ),
]
TableOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--out", "-o", help="Write the table: .md, .csv or .json; may be given several times."
    ),
]


def tables_command(
    only: Annotated[
        str,
        typer.Option(
            help="Rows, with commas between: circle, grid, sphere, parking-garage, cubicle, "
            "torus3D, rim."
        ),
    ] = "",
    seeds: Annotated[
        int, typer.Option(min=1, help="Draws of the random scenes circle, grid and sphere.")
    ] = ReproductionSettings.num_seeds,
    robots: Annotated[
        int,
        typer.Option(min=1, help="Robots that share a graph; SOC as in the paper has one a pose."),
    ] = ReproductionSettings.num_robots,
    out: TableOption = None,
    keep: Annotated[
        Path,
        typer.Option(
            help="File that keeps every finished figure; the same command continues from there."
        ),
    ] = KEPT_FILE,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Ignore the kept figures, and run everything again.")
    ] = False,
    download: DownloadOption = False,
    jobs: JobsOption = ReproductionSettings.num_jobs,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run `pgo tables`."""
    check_outputs_differ({"--out": out, "--keep": keep})
    _check(out, check_table_format)
    check_writable(keep)
    settings = ReproductionSettings(_split(only), seeds, robots, download, jobs)
    tables = reproduce_tables(settings, keep, is_fresh=fresh, progress=False if quiet else None)
    table = tables_as_text(tables)
    save_then_show(
        [(path, table.save) for path in out or []],
        table.print,
        table.as_json if as_json else None,
        quiet,
    )
    if not tables.is_complete:
        raise typer.Exit(BROKEN_OFF)


@explained_by_its_graph
def compare_command(
    graph: Annotated[
        str,
        typer.Argument(
            help="A g2o file, a folder with one file a robot, or the name of a data set."
        ),
    ],
    methods: Annotated[
        str,
        typer.Option(
            help=f"With commas between: {', '.join(method.value for method in BenchmarkMethod)}. "
            "All that run here unless given."
        ),
    ] = "",
    robots: Annotated[
        int, typer.Option(min=1, help="Robots that share the graph.")
    ] = BenchmarkSettings.num_robots,
    out: TableOption = None,
    plot: Annotated[
        list[Path] | None,
        typer.Option(
            help="Write the gap against rounds, bytes and seconds: .png, .svg, .pdf or .html."
        ),
    ] = None,
    time_limit: Annotated[float, typer.Option(help="Seconds for every method.")] = math.inf,
    unit_weights: UnitWeightsOption = False,
    drop_edge: DropEdgeOption = None,
    trust_folder: TrustFolderOption = False,
    jobs: JobsOption = ComparisonSettings.num_jobs,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run `pgo compare`."""
    check_outputs_differ({"--out": out, "--plot": plot})
    _check(out, check_table_format)
    _check(plot, check_plot_format)
    settings = ComparisonSettings(
        _chosen(BenchmarkMethod, methods, "method"),
        BenchmarkSettings(robots, time_limit=time_limit),
        jobs,
    )
    loaded = load_graph(graph, unit_weights, dropped=drop_edge, trust_folder=trust_folder)
    comparison = compare_methods(loaded, settings, progress=False if quiet else None)
    table = comparison.table()
    tables = [(path, table.save) for path in out or []]
    plots = [(path, comparison.save_plot) for path in plot or []]
    targets = [*tables, *plots]
    save_then_show(targets, table.print, table.as_json if as_json else None, quiet)
    if not comparison.is_complete:
        raise typer.Exit(BROKEN_OFF)


def figures_command(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the pictures.")] = Path(
        "figures"
    ),
    only: Annotated[
        str,
        typer.Option(
            help=f"With commas between: {', '.join(kind.value for kind in FigureSet)}. "
            "All unless given."
        ),
    ] = "",
    download: DownloadOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run `pgo figures`."""
    sets = _chosen(FigureSet, only, "figure")
    progress = False if quiet else None
    written, reasons = draw_paper_figures(out, sets, download=download, progress=progress)
    record: dict[str, object] = {"written": list(map(str, written)), "left_out": reasons}
    text = "\n".join(f"written: {path}" for path in written)
    save_then_show(
        [], lambda: typer.echo(wrapped(text)), (lambda: record) if as_json else None, quiet
    )
    for reason in reasons:
        typer.echo(f"left out: {reason}", err=True)
    if not written:
        raise PGOError("no figure could be drawn: no graph is here")


def _chosen(choices: type[Choice], names: str, kind: str) -> tuple[Choice, ...]:
    """Members of an enum, of their names with commas between; a SettingError for other names."""
    known = {member.value: member for member in choices}
    chosen = []
    for name in _split(names):
        if name not in known:
            raise SettingError(f"there is no {kind} {name!r}; there are {', '.join(known)}")
        chosen.append(known[name])
    return tuple(chosen)


def _split(names: str) -> tuple[str, ...]:
    """Different names of a list with commas between."""
    stripped = (name.strip() for name in names.split(","))
    return tuple(dict.fromkeys(name for name in stripped if name))


def _check(paths: list[Path] | None, check_format: Callable[[Path], None]) -> None:
    """Refuse files that cannot be written, before a long run instead of after it."""
    for path in paths or []:
        check_format(path)
        check_writable(path)
