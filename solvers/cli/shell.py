"""Commands in a shell: signals that interrupt them, pipes that close, and disks that fill up.

`run_command` runs a command and returns its exit code. An interrupted command still prints and
saves its best result. `save_then_show` is the end of every command: it writes all files that can be
written, and then prints the result.
"""

import errno
import json
import math
import os
import re
import shlex
import shutil
import signal
import sys
import tempfile
import textwrap
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from io import TextIOWrapper
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, TextIO, cast

import typer
from typer.core import TyperGroup

from pgo_models.errors import PGOError, SettingError, printable
from solvers.cli.help import text_of_usage_error
from solvers.progress_bars import JobBar

# Exit codes of commands.
DONE = 0
BAD_INPUT = 1
NOT_CONVERGED = 2
NOT_CERTIFIED = 3
BROKEN_OFF = 130
HANGUP = getattr(signal, "SIGHUP", None)  # Windows has no such signal
_SIGNALS = tuple(number for number in (signal.SIGINT, signal.SIGTERM, HANGUP) if number is not None)
# A signal that follows another within so many seconds is ignored: the answer to Ctrl-C takes time,
# and a user who sees nothing happen presses it again.
_SAME_SIGNAL = 0.5
# Characters of an error message. A longer word is shortened to its two ends.
_LONGEST_WORD = 300
_END_OF_WORD = 60
_LONGEST_LINE = 2000
QuietOption = Annotated[
    bool, typer.Option("--quiet", "-q", help="Print errors and warnings alone.")
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print JSON, and nothing else on standard output.")
]


class CommandGroup(TyperGroup):
    """Commands that raise a PGOError when they are interrupted; typer alone would exit silently."""

    def invoke(self, ctx: Any) -> object:  # noqa: ANN401 - of click's Context, which typer carries or imports
        """Run a command."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as error:
            raise _BrokenOffError from error


class _BrokenOffError(PGOError):
    """A command was interrupted and has no result."""


def run_command(app: typer.Typer, arguments: list[str]) -> int:
    """Run a command, and return its exit code.

    An error is printed on stderr as one line, or a line for each wrong line of a file; a warning
    is one line.
    """
    warnings.showwarning = _show_warning
    interruption = Interruption()
    with outlets() as out:
        with interruption.watching():
            code, message = _run(app, arguments)
        out.flush()
        if _is_output_lost(out, interruption):
            assert out.error is not None
            code = BAD_INPUT
            message = f"cannot print: {out.error.strerror}; --out is written all the same"
        if code == BROKEN_OFF:
            code = interruption.code
            message = f"{interruption.cause} before it was done"
        elif interruption.signal is not None and code != BAD_INPUT:
            code = interruption.code
            message = f"{interruption.cause}; what is shown and written is the best so far"
        if message:
            print(f"pgo: {shown(message)}", file=sys.stderr)
    return code


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    print(f"pgo: warning: {shown(str(message))}", file=sys.stderr)


def _is_output_lost(out: "Outlet", interruption: "Interruption") -> bool:
    """Whether output failed that its reader still wants.

    A reader that closes the pipe has read enough, and a terminal that is closed reads no more.
    """
    if out.error is None or interruption.is_hangup:
        return False
    return out.error.errno != errno.EPIPE


def shown(message: str) -> str:
    """An error or a warning as a terminal shows it.

    Control characters are made visible, and long words and long lines are shortened.
    """
    return "\n".join(map(_shown_line, message.split("\n")))


def _shown_line(line: str) -> str:
    text = re.sub(rf"\S{{{_LONGEST_WORD},}}", _ends_of_word, printable(line))
    if len(text) <= _LONGEST_LINE:
        return text
    return f"{text[:_LONGEST_LINE]} .."


def _ends_of_word(match: re.Match[str]) -> str:
    word = match[0]
    return f"{word[:_END_OF_WORD]}..{word[-_END_OF_WORD:]}"


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
        return app(args=arguments, standalone_mode=False) or DONE, ""
    except _BrokenOffError:
        return BROKEN_OFF, ""
    except PGOError as error:
        return BAD_INPUT, str(error)
    except MemoryError:
        return BAD_INPUT, "there is not enough memory; raise the limit, or ask for less"
    except usage_error as error:
        return BAD_INPUT, text_of_usage_error(error)


class Interruption:
    """Turns SIGINT, SIGTERM and SIGHUP into a KeyboardInterrupt.

    A solve answers a KeyboardInterrupt with its best iterate.
    """

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None  # the first that arrived
        self._last = -math.inf  # when the last one arrived, by time.monotonic()

    @property
    def is_hangup(self) -> bool:
        """Whether the terminal of the command was closed."""
        return self.signal is not None and self.signal == HANGUP

    @property
    def cause(self) -> str:
        """What has happened to the command, for its message."""
        if self.is_hangup:
            return "its terminal was closed"
        return "terminated" if self.signal is signal.SIGTERM else "interrupted"

    @property
    def code(self) -> int:
        """Exit code of the command by the convention of shells: 130, 143 or 129."""
        return 128 + (self.signal or signal.SIGINT)

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Watch for signals while the block runs.

        Once one has arrived, those after the block are ignored: only a line is left to print.
        """

        def interrupt(number: int, frame: FrameType | None) -> None:
            earlier = self._last
            self._last = time.monotonic()
            if self._last - earlier > _SAME_SIGNAL:
                self.signal = self.signal or signal.Signals(number)
                raise KeyboardInterrupt

        before = _new_handlers(interrupt)
        try:
            yield
        finally:
            for number, earlier in before.items():
                signal.signal(number, earlier if self.signal is None else signal.SIG_IGN)


class Outlet:
    """A stream that writes nothing more after its first error, and remembers that error.

    Errors are those of a closed pipe or a full disk.
    """

    def __init__(self, stream: TextIO) -> None:
        self.error: OSError | None = None
        self._stream = stream

    def write(self, text: str) -> int:
        """Write the text, or lose it: a result that cannot be shown can still be saved."""
        return self._try(self._stream.write, text) or len(text)

    def flush(self) -> None:
        """Flush the stream, unless it has failed."""
        self._try(self._stream.flush)

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)

    def _try(self, act: Callable[..., int | None], *arguments: str) -> int | None:
        """Write or flush; None once the stream has failed."""
        if self.error is not None:
            return None
        try:
            return act(*arguments)
        except OSError as error:
            self.error = error
            # Python flushes the buffer once more when it exits, which would fail again. So the rest
            # goes to the null device.
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())
            return None


@contextmanager
def outlets() -> Iterator[Outlet]:
    """Redirect standard output and standard error to outlets; yield that of standard output."""
    with ExitStack() as stack:
        streams = []
        for stream in (sys.stdout, sys.stderr):
            if stream is None:  # the shell has closed it
                stream = stack.enter_context(open(os.devnull, "w"))
            if isinstance(stream, TextIOWrapper):
                # Characters that the terminal cannot show are escaped.
                stream.reconfigure(errors="backslashreplace")
            streams.append(Outlet(stream))
        out, err = streams
        stack.enter_context(redirect_stdout(cast("TextIO", out)))
        stack.enter_context(redirect_stderr(cast("TextIO", err)))
        try:
            yield out
        finally:
            out.flush()
            err.flush()


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
    instead, and with `quiet` nothing. Signals are ignored while files are written: the solve is
    over, and there is nothing to interrupt. Raises a PGOError at the end, which names the files
    that could not be written. An error of another kind, which is a defect of its writer, is raised
    after all the rest is done.
    """
    saving = _Saving(len(targets))

    def print_result() -> None:
        if record is not None:
            typer.echo(json.dumps(record(), indent=1, allow_nan=False))
        elif not quiet:
            show()
            lines = [f"{printable(f'written: {path}')}\n" for path in saving.written]
            typer.echo("".join(lines), nl=False)

    # The stack calls all its entries, the last one first, even if one of them raises an error.
    with ExitStack() as stack:
        stack.callback(print_result)
        stack.enter_context(_unheard_signals())
        stack.enter_context(saving.bar)
        for path, save in reversed(targets):
            stack.callback(saving.write, path, save)
    if saving.failures:
        raise PGOError("; ".join(saving.failures))


class _Saving:
    """Files that a command writes: which are written, which are not, and a bar that shows it."""

    def __init__(self, num_files: int) -> None:
        self.written: list[Path] = []
        self.failures: list[str] = []
        self.bar = JobBar(num_files, progress=None if num_files else False)

    def write(self, path: Path, save: Callable[[Path], object]) -> None:
        """Write a file."""
        self.bar.name_part(f"writing {path}")
        self.bar.show(len(self.written) + len(self.failures), "")
        failure = _failure_to_write(path, save)
        if failure:
            self.failures.append(failure)
        else:
            self.written.append(path)


def _failure_to_write(path: Path, save: Callable[[Path], object]) -> str:
    """Write a file; return why it could not be written, or an empty string."""
    try:
        save(path)
    except PGOError as error:
        text = str(error)
        return text if str(path) in text else f"cannot write {path}: {text}"
    except MemoryError:
        return f"cannot write {path}: there is not enough memory; choose another format"
    except OSError as error:
        return f"cannot write {path}: {error.strerror or error}; choose another place"
    except ValueError as error:
        return f"cannot write {path}: {error}; choose another format"
    return ""


@contextmanager
def _unheard_signals() -> Iterator[None]:
    """Ignore the signals while the block runs."""
    before = _new_handlers(signal.SIG_IGN)
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def _new_handlers(
    handler: Callable[[int, FrameType | None], object] | signal.Handlers,
) -> dict[signal.Signals, Any]:
    """Give the signals another handler, and return their earlier ones."""
    handled = list(_SIGNALS)
    if HANGUP is not None and signal.getsignal(HANGUP) is signal.SIG_IGN:
        handled.remove(HANGUP)  # nohup asks for it to be ignored
    return {number: signal.signal(number, handler) for number in handled}
