"""`pgo verify`: a written proof of a lower bound, checked in ball arithmetic."""

from pathlib import Path
from typing import Annotated

import typer

from pgo_models.graphs.datasets import locate
from solvers.cli.options import SkipUnknownOption
from solvers.cli.shell import DONE, JsonOption, QuietOption, save_then_show, wrapped

NOT_VERIFIED = 3  # exit code, as of a solve without a certificate
_INDENT = 13  # columns of the labels of a verification


def verify_command(
    graph: Annotated[
        str,
        typer.Argument(
            help="The g2o file or robot log, or the name of a data set; or the proof of a cvxpy "
            "model alone."
        ),
    ],
    proof: Annotated[
        Path | None, typer.Argument(help="The proof of a graph, of pgo solve --proof.")
    ] = None,
    skip_unknown: SkipUnknownOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run `pgo verify`."""
    from pgo_models.verification.verify import verify_proof  # needs the extra `verify`

    path = Path(graph) if proof is None else locate(graph)
    verification = verify_proof(path, proof, skip_unknown=skip_unknown)
    text = wrapped(str(verification), _INDENT)
    record = verification.as_json if as_json else None
    save_then_show([], lambda: typer.echo(text), record, quiet)
    raise typer.Exit(DONE if verification.is_verified else NOT_VERIFIED)
