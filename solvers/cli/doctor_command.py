"""`pgo doctor`: whether a g2o file means something else than what it says."""

import typer

from solvers.cli.explanations import (
    advice_on_reading,
    advice_on_wrong_edges,
    explained_by_its_graph,
    show_advice,
)
from solvers.cli.options import (
    GraphArgument,
    SkipUnknownOption,
    TrustFolderOption,
    UnitWeightsOption,
)
from solvers.cli.shell import JsonOption, save_then_show, wrapped
from solvers.reporting.result_table import finite_or_none
from solvers.studies.readings import ReadingComparison, compare_readings


@explained_by_its_graph
def doctor_command(
    graph: GraphArgument,
    unit_weights: UnitWeightsOption = False,
    skip_unknown: SkipUnknownOption = False,
    trust_folder: TrustFolderOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run `pgo doctor`."""
    comparison = compare_readings(
        graph, unit_weights=unit_weights, skip_unknown=skip_unknown, trust_folder=trust_folder
    )

    def show() -> None:
        typer.echo(str(comparison))
        if comparison.proposed:
            show_advice([advice_on_reading(comparison, graph)])
        elif comparison.is_misfit:
            show_advice([advice_on_wrong_edges(comparison, graph)])
        else:
            typer.echo(f"\n{wrapped(comparison.sentence())}")

    save_then_show((), show, (lambda: _record(comparison)) if as_json else None)


def _record(comparison: ReadingComparison) -> dict[str, object]:
    fits = (comparison.written, *comparison.others)
    return {
        "cost": comparison.cost_name,
        "readings": {
            fit.reading.value: {
                "cost": finite_or_none(fit.cost),
                "times_expected": finite_or_none(fit.times_expected),
                "log_odds": finite_or_none(fit.evidence),
            }
            for fit in fits
        },
        "proposed": [fit.reading.value for fit in comparison.proposed],
        "sentence": comparison.sentence(),
    }
