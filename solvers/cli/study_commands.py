"""Commands of `pgo` that compare methods: tables, compare."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from pgo_models.errors import SettingError
from pgo_models.files import check_writable
from solvers.cli.explanations import explained_by_its_graph
from solvers.cli.inputs import check_outputs_differ, load_graph
from solvers.cli.options import DropEdgeOption, TrustFolderOption, UnitWeightsOption
from solvers.cli.shell import BROKEN_OFF, JsonOption, QuietOption, save_then_show
from solvers.reporting.result_table import check_table_format
from solvers.studies.benchmark import BenchmarkMethod, BenchmarkSettings
from solvers.studies.comparison import ComparisonSettings, check_plot_format, compare_methods
from solvers.studies.paper_tables import ReproductionSettings, reproduce_tables
from solvers.studies.paper_tables_text import tables_as_text

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
    download: DownloadOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run `pgo tables`."""
    check_outputs_differ({"--out": out})
    _check(out, check_table_format)
    settings = ReproductionSettings(_split(only), seeds, robots, download)
    tables = reproduce_tables(settings, progress=False if quiet else None)
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
        typer.Option(help="Write the gap against rounds, bytes and seconds: .png, .svg or .pdf."),
    ] = None,
    time_limit: Annotated[float, typer.Option(help="Seconds for every method.")] = math.inf,
    unit_weights: UnitWeightsOption = False,
    drop_edge: DropEdgeOption = None,
    trust_folder: TrustFolderOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run `pgo compare`."""
    check_outputs_differ({"--out": out, "--plot": plot})
    _check(out, check_table_format)
    _check(plot, check_plot_format)
    settings = ComparisonSettings(
        _methods(methods), BenchmarkSettings(robots, time_limit=time_limit)
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


def _methods(names: str) -> tuple[BenchmarkMethod, ...]:
    """Methods by their names with commas between; a SettingError for other names."""
    known = {method.value: method for method in BenchmarkMethod}
    chosen = []
    for name in _split(names):
        if name not in known:
            raise SettingError(f"there is no method {name!r}; there are {', '.join(known)}")
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
