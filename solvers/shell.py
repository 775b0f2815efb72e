"""What the shell does to a command: signals that break it off, pipes that close and disks that fill up under it."""

import errno
import json
import math
import os
import re
import shutil
import signal
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from io import TextIOWrapper
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, TextIO, cast

import typer
from typer.core import TyperGroup

from pgo_models.errors import PGOError, SettingError
from solvers.progress_bars import JobBar

DONE, BAD_INPUT, BROKEN_OFF = 0, 1, 130
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_SAME_SIGNAL = 0.5  # seconds: who hits Ctrl-C twice means it once, and the answer takes time
_LONGEST_WORD = 300  # of an error message, which is to stay a line
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors and warnings alone.")]
ThreadsOption = Annotated[int | None, typer.Option(min=1, help="Threads of linear algebra; one a core unless given.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else on standard output.")]


class Commands(TyperGroup):
    """Commands of which one that is broken off raises an error of ours, before typer makes it a silent exit."""

    def invoke(self, ctx: Any) -> object:  # noqa: ANN401 - of click's Context, which typer carries or imports
        """Run a command."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as error:
            raise _BrokenOffError from error


class _BrokenOffError(PGOError):
    """A command was broken off and has no result."""


def run_command(app: typer.Typer, arguments: list[str]) -> int:
    """Run a command, say in one line on stderr what was wrong with it, and return its exit code."""
    broken = Broken()
    with outlets() as out:
        with broken.watching():
            code, message = _run(app, arguments)
        out.flush()
        if out.error is not None and out.error.errno != errno.EPIPE:  # who closes a pipe has read enough
            code, message = BAD_INPUT, f"cannot print: {out.error.strerror}; --out is written all the same"
        if code == BROKEN_OFF:
            code, message = broken.code, f"{broken.word} before it was done"
        elif broken.signal is not None and code != BAD_INPUT:
            code, message = broken.code, f"{broken.word}; what is shown and written is the best so far"
        if message:
            shorter = re.sub(rf"\S{{{_LONGEST_WORD},}}", lambda word: f"{word[0][:60]}...{word[0][-60:]}", message)
            print(f"pgo: {shorter}", file=sys.stderr)
    return code


def _run(app: typer.Typer, arguments: list[str]) -> tuple[int, str]:
    """Exit code of a command, and what there is to say of it."""
    # Every error of the command line itself derives from the base of typer's BadParameter.
    usage_error: type[Exception] = typer.BadParameter.__mro__[1]
    try:
        if "" in arguments:
            before = ["pgo", *arguments][arguments.index("")]
            raise SettingError(f"the argument after {before} is empty; give a name, or leave it out")
        return app(args=arguments, standalone_mode=False) or DONE, ""
    except _BrokenOffError:
        return BROKEN_OFF, ""
    except PGOError as error:
        return BAD_INPUT, str(error)
    except usage_error as error:
        text = error.format_message() if isinstance(error, typer.BadParameter) else str(error)
        return BAD_INPUT, f"{text.rstrip('.')}; see pgo --help" if text else ""  # the help has been shown


class Broken:
    """Turns SIGINT and SIGTERM into a KeyboardInterrupt, which the loop of a solve answers with its best iterate."""

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None  # the first that came
        self._last = -math.inf

    @property
    def word(self) -> str:
        """What has been done to the command."""
        return "terminated" if self.signal is signal.SIGTERM else "interrupted"

    @property
    def code(self) -> int:
        """Exit code of the command, as shells give it: 130 or 143."""
        return 128 + (self.signal or signal.SIGINT)

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Watch for signals while the block runs."""

        def arrived(number: int, frame: FrameType | None) -> None:
            earlier, self._last = self._last, time.monotonic()
            if self._last - earlier > _SAME_SIGNAL:
                self.signal = self.signal or signal.Signals(number)
                raise KeyboardInterrupt

        with _handled_by(arrived):
            yield


class Outlet:
    """A stream that goes quiet, and remembers why, once the pipe behind it is closed or the disk is full."""

    def __init__(self, stream: TextIO) -> None:
        self.error: OSError | None = None
        self._stream = stream

    def write(self, text: str) -> int:
        """Write, or lose the text; a result that cannot be shown is still to be saved."""
        return self._tried(self._stream.write, text) or len(text)

    def flush(self) -> None:
        """Flush, or go quiet."""
        self._tried(self._stream.flush)

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)

    def _tried(self, act: Callable[..., int | None], *arguments: str) -> int | None:
        if self.error is None:
            try:
                return act(*arguments)
            except OSError as error:
                self.error = error
                # What is left in the buffer goes nowhere: at the end Python would stumble over it once more.
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())
        return None


@contextmanager
def outlets() -> Iterator[Outlet]:
    """Put outlets before standard output, which is lent, and standard error."""
    with ExitStack() as stack:
        # A stream that the shell has closed is None.
        streams = [stream or stack.enter_context(open(os.devnull, "w")) for stream in (sys.stdout, sys.stderr)]
        for stream in streams:
            if isinstance(stream, TextIOWrapper):  # a name that the terminal has no letters for
                stream.reconfigure(errors="backslashreplace")
        out, err = map(Outlet, streams)
        stack.enter_context(redirect_stdout(cast("TextIO", out)))
        stack.enter_context(redirect_stderr(cast("TextIO", err)))
        try:
            yield out
        finally:
            out.flush()
            err.flush()


def wrapped(text: str, indent: int = 0) -> str:
    """Text within the columns of the terminal, 80 where there is none; what goes on is indented."""
    columns, hang = shutil.get_terminal_size().columns, " " * indent
    fill = textwrap.TextWrapper(columns, subsequent_indent=hang, break_long_words=False, break_on_hyphens=False).fill
    return "\n".join(map(fill, text.splitlines()))


def save_then_show(
    targets: Sequence[tuple[Path, Callable[[Path], object]]],
    show: Callable[[], object],
    record: Callable[[], dict[str, object]] | None = None,
    quiet: bool = False,
) -> None:
    """Write every file that can be written, then print the result and their names, or nothing but a record.

    Signals come too late while files are written, with nothing left to break off. A PGOError at the end: what failed.
    """
    written: list[Path] = []
    failures: list[str] = []
    with _handled_by(signal.SIG_IGN), JobBar(len(targets), None if targets else False) as bar:
        for done, (path, save) in enumerate(targets):
            bar.name_part(f"writing {path}")
            bar.show(done, "")
            try:
                save(path)
                written.append(path)
            except PGOError as error:
                failures.append(str(error))
            except MemoryError:
                failures.append(f"cannot write {path}: there is not enough memory; choose another format")
    if record is not None:
        typer.echo(json.dumps(record(), indent=1, allow_nan=False))
    elif not quiet:
        show()
        typer.echo("".join(f"written: {path}\n" for path in written), nl=False)
    if failures:
        raise PGOError("; ".join(failures))


@contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], object] | signal.Handlers) -> Iterator[None]:
    before = {number: signal.signal(number, handler) for number in _SIGNALS}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)
