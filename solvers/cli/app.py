"""The command `pgo`: solve, certify, info, generate, verify, and `solvers.cli.study_commands`.

Exit codes: 0 done; 1 bad input, one line on stderr; 2 not converged, the result written all the
same; 3 not certified; 130, 143 and 129 after SIGINT (Ctrl-C), SIGTERM and SIGHUP (the terminal
closed), the best iterate written if there was one.
"""

import sys
from typing import Annotated

import typer

from solvers.cli.certify_command import certify_command
from solvers.cli.generate_command import generate_command
from solvers.cli.info_command import info_command
from solvers.cli.shell import Commands, run_command
from solvers.cli.solve_command import solve_command
from solvers.cli.study_commands import compare_command, figures_command, tables_command
from solvers.cli.verify_command import verify_command
from solvers.reporting.versions import installed_version

app = typer.Typer(
    name="pgo",
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def pgo(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Pose graph optimisation by splitting, with a certified distance to the global optimum."""
    if version:
        typer.echo(f"pgo {installed_version()}")


app.command("solve")(solve_command)
app.command("certify")(certify_command)
app.command("info")(info_command)
app.command("generate")(generate_command)
app.command("verify")(verify_command)
app.command("tables")(tables_command)
app.command("compare")(compare_command)
app.command("figures")(figures_command)


def main(arguments: list[str] | None = None) -> None:
    """Run `pgo` and leave with its exit code.

    Every error and warning of ours is one line on stderr, or one for each wrong line of a file.
    """
    raise SystemExit(run_command(app, sys.argv[1:] if arguments is None else arguments))
