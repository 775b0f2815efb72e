"""The command `pgo`: its commands and their helps, each imported from its module when it is run.

Exit codes: 0 done; 1 bad input, one line on stderr; 2 not converged, the result written all the
same, also of a solve that Ctrl-C has ended; 3 not certified; 130 after Ctrl-C where there is no
result.
"""

import atexit
import gc
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from solvers.cli.help import Helpful
from solvers.cli.shell import run_command
from solvers.reporting.distribution import installed_version

# BLAS reads these once, when a command imports it.
_NUMBERS_OF_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class CommandOfModule:
    """A command that has not been imported: MODULE:FUNCTION, its help, and what that shows.

    `groups` has the names of the arguments of every group of options.
    """

    place: str
    help: str
    groups: Mapping[str, Sequence[str]] = field(default_factory=dict)
    examples: Sequence[str] = ()

    @property
    def short_help(self) -> str:
        """First paragraph of the help."""
        return self.help.partition("\n\n")[0]

    def imported(self, name: str) -> Any:  # noqa: ANN401 - a command of click, which typer carries or imports
        """Import the module of a command, and make the command of its function."""
        module, _, function = self.place.partition(":")
        command = getattr(import_module(module), function)
        app = typer.Typer(add_completion=False, rich_markup_mode=None)
        shown = {"groups": self.groups, "examples": self.examples}
        kind = type(Helpful.__name__, (Helpful,), shown)
        app.command(name, cls=kind, help=self.help)(command)
        return typer.main.get_command(app)


COMMANDS = {
    "solve": CommandOfModule(
        "solvers.cli.solve_command:solve_command",
        "Solve a pose graph: poses, their cost, a proven lower bound on the optimum, and the gap.",
        groups={
            "What is read, and the cost that is minimised": (
                "cost",
                "estimate_noise",
                "rotations",
                "drop_coupling",
                "skip_unknown",
                "trust_folder",
                "largest_component",
                "all_components",
                "drop_edge",
                "robust",
                "known",
                "prove_outliers",
            ),
            "Files that are written": ("out", "report", "film", "covariances", "proof", "times"),
            "How it is solved": (
                "method",
                "start",
                "gap",
                "max_iterations",
                "tolerance",
                "time_limit",
                "anchor",
            ),
            "Robots that share the graph": (
                "robots",
                "split",
                "engine",
                "address",
                "resume",
                "driver_memory",
            ),
            "What is printed": ("verbose", "quiet", "as_json", "help"),
        },
        examples=(
            "pgo solve sphere",
            "pgo solve mine.g2o --out solved.g2o --report solved.html",
            "pgo solve mine.g2o --robust gnc --robots 5",
        ),
    ),
    "certify": CommandOfModule(
        "solvers.cli.certify_command:certify_command",
        "Judge poses from anywhere: how far their cost can be above the global optimum.",
    ),
    "robot": CommandOfModule(
        "solvers.cli.robot_command:robot_command",
        "Solve as one robot of a team: every robot on its machine, with its own file.",
        examples=(
            "head -c 32 /dev/urandom > team.key",
            "pgo robot a.g2o --name a --team a,b --key team.key --listen 0.0.0.0:7447",
            "pgo robot b.g2o --name b --team a,b --key team.key --listen 0.0.0.0:7447 "
            "--connect first:7447",
        ),
    ),
    "info": CommandOfModule(
        "solvers.cli.info_command:info_command",
        "Show what a pose graph is made of, or what this installation has.",
    ),
    "doctor": CommandOfModule(
        "solvers.cli.doctor_command:doctor_command",
        "Ask whether a g2o file means something else than it says: other ends, units, matrices.",
    ),
    "generate": CommandOfModule(
        "solvers.cli.generate_command:generate_command",
        "Generate a scene with known truth, written beside it as NAME.truth.tum.",
    ),
    "verify": CommandOfModule(
        "solvers.cli.verify_command:verify_command",
        "Check the proof of a lower bound, trusting nobody: exact numbers, ball arithmetic.",
    ),
    "tables": CommandOfModule(
        "solvers.cli.study_commands:tables_command",
        "Run the paper's tables 1 to 4, row by row: its figures beside ours, with proven bounds.",
    ),
    "compare": CommandOfModule(
        "solvers.cli.study_commands:compare_command",
        "Run several methods on a graph and hold them against each other and a "
        "proven bound.\n\n"
        "The cost is F, with two precisions an edge, which all of these methods "
        "minimise.",
    ),
}


class ImportedCommands(Mapping[str, Any]):
    """Commands by their names, each imported when it is looked up."""

    def __getitem__(self, name: str) -> Any:  # noqa: ANN401 - as above
        return COMMANDS[name].imported(name)

    def __iter__(self) -> Iterator[str]:
        return iter(COMMANDS)

    def __len__(self) -> int:
        return len(COMMANDS)


class Commands(TyperGroup):
    """The commands of `pgo`; lists and helps of all of them import none."""

    def __init__(self, **settings: Any) -> None:  # noqa: ANN401 - passed on to typer
        super().__init__(**settings)
        self.commands: Any = ImportedCommands()

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ANN401 - of click's Context
        """Names of the commands, in the order of the help."""
        return list(COMMANDS)

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 - as above
        """Write the commands and their helps."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, command.short_help) for name, command in COMMANDS.items()])


# Help is plain text: the boxes of rich take longer to import than the rest of the command line.
app = typer.Typer(
    name="pgo",
    cls=Commands,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def pgo(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Pose graph optimisation by splitting, with a certified distance to the global optimum."""
    if version:
        typer.echo(f"pgo {installed_version()}")


def main(arguments: list[str] | None = None) -> None:
    """Run `pgo` and leave with its exit code.

    Every error and warning of ours is one line on stderr, or one for each wrong line of a file.
    Unless the environment has a number, BLAS gets one thread: the dense blocks of a pose graph are
    small, and more threads take more CPU time and save none.
    """
    # Python's collector looks at all objects once more at the end, unless they are frozen: that is
    # a quarter of the CPU time of `pgo solve sphere`.
    atexit.register(gc.freeze)
    for name in _NUMBERS_OF_THREADS:
        os.environ.setdefault(name, "1")
    given = sys.argv[1:] if arguments is None else arguments
    raise SystemExit(run_command(app, given or ["--help"]))
