"""`pgo info`: what a pose graph is made of, or what the installation has."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from pgo_models.errors import SettingError
from pgo_models.files import check_writable
from pgo_models.graphs.datasets import known_datasets
from pgo_models.graphs.g2o import write_g2o
from pgo_models.graphs.g2o_readings import Reading
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.separators import report_partition
from solvers.cli.explanations import explained_by_its_graph
from solvers.cli.inputs import (
    chosen_partition,
    indefinite_matrices,
    load_graph,
    with_estimated_noise,
)
from solvers.cli.options import (
    EstimateNoiseOption,
    LargestComponentOption,
    SkipUnknownOption,
    Split,
    SplitOption,
    TrustFolderOption,
    UnitWeightsOption,
)
from solvers.cli.shell import JsonOption, figures_of_facts, save_then_show, wrapped
from solvers.reporting.graph_facts import describe_graph
from solvers.reporting.versions import installation

_INDENT = 16  # columns of the labels
Facts = list[tuple[str, str]]
Described = tuple[Facts, dict[str, object]]


@explained_by_its_graph
def info_command(
    graph: Annotated[
        str | None,
        typer.Argument(help="A g2o file, folder or data set; without it, versions and data sets."),
    ] = None,
    robots: Annotated[
        int | None, typer.Option(min=1, help="Show what sharing the poses among so many costs.")
    ] = None,
    split: SplitOption = None,
    skip_unknown: SkipUnknownOption = False,
    trust_folder: TrustFolderOption = False,
    largest_component: LargestComponentOption = False,
    unit_weights: UnitWeightsOption = False,
    estimate_noise: EstimateNoiseOption = False,
    reading: Annotated[
        Reading,
        typer.Option(
            metavar="READING",
            help="What the lines of a g2o file mean, if not what its format says (see pgo doctor): "
            f"{', '.join(reading.value for reading in Reading)}.",
        ),
    ] = Reading.AS_WRITTEN,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Write the graph as .g2o, with the tags and information matrices of g2o, whatever "
            "it was read from.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Run `pgo info`."""
    targets: list[tuple[Path, Callable[[Path], object]]] = []
    if graph is None:
        if robots is not None or split is not None or out is not None:
            raise SettingError("--robots, --split and --out are about a graph; give one")
        facts, record = _describe_installation()
    else:
        if out is not None:
            _check_out(out)
        loaded = load_graph(
            graph,
            unit_weights or estimate_noise,
            skip_unknown,
            reading=reading,
            trust_folder=trust_folder,
            largest_component=largest_component,
        )
        if estimate_noise:
            loaded = with_estimated_noise(loaded)
        facts, record = _describe_graph(graph, loaded, robots, split)
        if out is not None:
            targets = [(out, partial(write_g2o, loaded))]
    text = wrapped("\n".join(f"{label:<15} {text}" for label, text in facts), _INDENT)
    save_then_show(targets, lambda: typer.echo(text), (lambda: record) if as_json else None)


def _check_out(out: Path) -> None:
    """Raise a PGOError when no graph can be written there."""
    if out.suffix.lower() != ".g2o":
        raise SettingError(f"cannot write {out}: a graph is written as .g2o; give such a name")
    check_writable(out)


def _describe_installation() -> Described:
    """Versions and data sets, as facts and as a record for JSON."""
    facts = [*installation(), ("data sets", ", ".join(known_datasets()))]
    return facts, dict(facts)


def _describe_graph(
    graph: str, loaded: PoseGraph, robots: int | None, split: Split | None
) -> Described:
    """Facts of a graph, and of a partition if one is asked for, with a record for JSON."""
    facts = describe_graph(loaded, indefinite_matrices(loaded, graph))
    record = figures_of_facts(facts)
    if robots is not None or split is not None:
        partition = chosen_partition(loaded, robots, split)
        costs = report_partition(partition, loaded).facts()
        costs = [("partition", partition.method.value), *costs]
        facts += [("", ""), *costs]
        record["partition"] = figures_of_facts(costs)
    return facts, record
