"""`pgo info`: what a pose graph is made of, or what the installation has."""

from typing import Annotated

import typer

from pgo_models.errors import SettingError
from pgo_models.graphs.datasets import known_datasets
from pgo_models.graphs.separators import report_partition
from solvers.cli.explanations import explained_by_its_graph
from solvers.cli.inputs import indefinite_matrices, load_graph
from solvers.cli.options import SkipUnknownOption, Split, SplitOption, chosen_partition
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
    as_json: JsonOption = False,
) -> None:
    """Show what a pose graph is made of, or what this installation has."""
    if graph is None:
        facts, record = _describe_installation(robots, split)
    else:
        facts, record = _describe_graph(graph, robots, split, skip_unknown)
    text = wrapped("\n".join(f"{label:<15} {text}" for label, text in facts), _INDENT)
    save_then_show([], lambda: typer.echo(text), (lambda: record) if as_json else None)


def _describe_installation(robots: int | None, split: Split | None) -> Described:
    """Versions and data sets, as facts and as a record for JSON."""
    if robots is not None or split is not None:
        raise SettingError("--robots and --split describe a graph; give one")
    facts = [*installation(), ("data sets", ", ".join(known_datasets()))]
    return facts, dict(facts)


def _describe_graph(
    graph: str, robots: int | None, split: Split | None, skip_unknown: bool
) -> Described:
    """Facts of a graph, and of a partition if one is asked for, with a record for JSON."""
    loaded = load_graph(graph, False, skip_unknown)
    facts = describe_graph(loaded, indefinite_matrices(loaded, graph))
    record = figures_of_facts(facts)
    if robots is not None or split is not None:
        partition = chosen_partition(loaded, robots, split)
        costs = report_partition(partition, loaded).facts()
        costs = [("partition", partition.method.value), *costs]
        facts += [("", ""), *costs]
        record["partition"] = figures_of_facts(costs)
    return facts, record
