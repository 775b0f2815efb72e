"""Commands in a shell: exit codes, errors as one line, and what ends every command.

`run_command` runs a command and returns its exit code. An interrupted solve still prints and saves
its best result. `save_then_show` is the end of every command: it writes all files that can be
written, and then prints the result.
"""

import json
import re
import shlex
import shutil
import sys
import tempfile
import textwrap
import warnings
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated

import typer

from pgo_models.errors import PGOError, SettingError, printable
from solvers.cli.help import text_of_usage_error

# Exit codes of commands.
DONE = 0
BAD_INPUT = 1
NOT_CONVERGED = 2
NOT_CERTIFIED = 3
BROKEN_OFF = 130
_LONGEST_LINE = 900  # characters of an error message: eleven lines of a terminal
QuietOption = Annotated[
    bool, typer.Option("--quiet", "-q", help="Print errors and warnings alone.")
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print JSON, and nothing else on standard output.")
]


def run_command(app: typer.Typer, arguments: list[str]) -> int:
    """Run a command, and return its exit code.

    An error is printed on stderr as one line, or a line for each wrong line of a file; a warning
    is one line, which is printed once although a file is read twice.
    """
    seen: set[str] = set()

    def show_warning(message: Warning | str, *_: object, **__: object) -> None:
        if (text := shown(str(message))) not in seen:
            seen.add(text)
            print(f"pgo: warning: {text}", file=sys.stderr)

    warnings.showwarning = show_warning
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            # Characters that the terminal cannot show are escaped.
            stream.reconfigure(errors="backslashreplace")
    code, message = _run(app, arguments)
    if message:
        print(f"pgo: {shown(message)}", file=sys.stderr)
    return code


def shown(message: str) -> str:
    """An error or a warning as a terminal shows it.

    Control characters are made visible, and long lines are cut.
    """
    lines = (printable(line) for line in message.split("\n"))
    return "\n".join(
        line if len(line) <= _LONGEST_LINE else f"{line[:_LONGEST_LINE]} .." for line in lines
    )


def _run(app: typer.Typer, arguments: list[str]) -> tuple[int, str]:
    """Exit code of a command, and the message that goes with it."""
    # All errors in the arguments derive from the base class of typer's BadParameter.
    usage_error: type[Exception] = typer.BadParameter.__mro__[1]
    try:
        if "" in arguments:
            previous = ["pgo", *arguments][arguments.index("")]
            raise SettingError(
                f"the argument after {previous} is empty; give a name, or leave it out"
            )
        # Typer turns Ctrl-C into its exit code, and leaves quietly when a reader closes the pipe.
        code = app(args=arguments, standalone_mode=False) or DONE
        return code, "interrupted before it was done" if code == BROKEN_OFF else ""
    except PGOError as error:
        return BAD_INPUT, str(error)
    except MemoryError:
        return BAD_INPUT, "there is not enough memory; raise the limit, or ask for less"
    except usage_error as error:
        return BAD_INPUT, text_of_usage_error(error)


def wrapped(text: str, indent: int = 0) -> str:
    """Text wrapped to the columns of the terminal, 80 where there is none.

    Lines after the first are indented.
    """
    wrapper = textwrap.TextWrapper(
        shutil.get_terminal_size().columns,
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return "\n".join(wrapper.fill(printable(line)) for line in text.split("\n"))


def figures_of_facts(facts: Sequence[tuple[str, str]]) -> dict[str, object]:
    """Labels and texts for JSON, where a text that is a number becomes one."""
    number = re.compile(r"-?\d+(\.\d+)?(e[-+]\d+)?")
    figures: dict[str, object] = {}
    for label, text in facts:
        figures[label] = json.loads(text) if number.fullmatch(text) else text
    return figures


def command_to_type(command: str) -> str:
    """A command, indented, to be copied as it is.

    It is broken into several lines, with backslashes, where the terminal is narrow.
    """
    width = shutil.get_terminal_size().columns - len(" \\")
    lines = ["   "]
    for word in map(shlex.quote, shlex.split(command)):
        is_full = len(lines[-1]) + 1 + len(word) > width
        if is_full and lines[-1].strip():
            lines.append("       ")
        lines[-1] += f" {word}"
    return " \\\n".join(lines)


def is_standard_output(path: Path) -> bool:
    """Whether the name of an output, "-", stands for standard output."""
    return str(path) == "-"


def print_g2o(save: Callable[[Path], object]) -> None:
    """Print a g2o file on standard output, and nothing else, by the function that writes one."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "printed.g2o")
        save(path)
        typer.echo(path.read_text(encoding="utf-8"), nl=False)


def save_then_show(
    targets: Sequence[tuple[Path, Callable[[Path], object]]],
    show: Callable[[], object],
    record: Callable[[], dict[str, object]] | None = None,
    quiet: bool = False,
) -> None:
    """Write every file that can be written, then print the result and the names of the files.

    `targets` are paths, and functions that write a result there. With `record` its JSON is printed
    instead, and with `quiet` nothing. Raises a PGOError at the end, which names the files that
    could not be written. An error of another kind, a defect of its writer, comes out after all the
    rest is done.
    """
    written: list[Path] = []
    failures: list[str] = []

    def write(path: Path, save: Callable[[Path], object]) -> None:
        try:
            save(path)
            written.append(path)
        except (PGOError, OSError, ValueError, MemoryError) as error:
            reason = getattr(error, "strerror", None) or str(error) or "there is not enough memory"
            is_named = str(path) in reason
            failures.append(reason if is_named else f"cannot write {path}: {reason}")

    def print_result() -> None:
        if record is not None:
            typer.echo(json.dumps(record(), indent=1, allow_nan=False))
        elif not quiet:
            show()
            for path in written:
                typer.echo(printable(f"written: {path}"))
        sys.stdout.flush()

    # The stack calls all its entries, the last one first, even if one of them raises an error.
    with ExitStack() as stack:
        stack.callback(print_result)
        for path, save in reversed(targets):
            stack.callback(write, path, save)
    if failures:
        raise PGOError("; ".join(failures))
