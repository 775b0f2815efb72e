"""`pgo robot`: one robot of a team, on its own machine, with its own file."""

import enum
import math
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pgo_models.errors import FileFormatError, SettingError
from pgo_models.files import check_writable
from pgo_models.problem.weighting import Weighting
from solvers.cli.choices import chosen_robust, pipeline_of_robots
from solvers.cli.options import Cost, CostOption, FirstStage, Robust, TrustFolderOption
from solvers.cli.shell import (
    DONE,
    NOT_CERTIFIED,
    JsonOption,
    QuietOption,
    save_then_show,
    wrapped,
)

if TYPE_CHECKING:
    from solvers.team.messages import Ended
    from solvers.team.robot import Robot

_INDENT = 13  # columns of the labels
_WEIGHTINGS = {
    None: Weighting.OWN,
    Cost.CHI2: Weighting.INFORMATION,
    Cost.ISOTROPIC: Weighting.ISOTROPIC,
}


class MethodOfTeam(enum.Enum):
    """First stage of robots that keep their measurements."""

    SUBSTRUCTURED = "substructured"
    CONSENSUS = "consensus"
    PAPER = "paper"
    NEWTON = "newton"


class SharingOfTeam(enum.Enum):
    """What robots tell each other."""

    MEASUREMENTS = "measurements"
    INTERFACE = "interface"


def robot_command(
    graph: Annotated[
        Path,
        typer.Argument(help="The g2o file of this robot: its poses and edges."),
    ],
    name: Annotated[str, typer.Option("--name", help="Name of this robot.")],
    team: Annotated[str, typer.Option("--team", help="Names of all robots, as a,b,c.")],
    key: Annotated[
        Path, typer.Option("--key", help="File with the secret of the team, 16 bytes or more.")
    ],
    listen: Annotated[
        str, typer.Option("--listen", metavar="HOST:PORT", help="Where others reach this robot.")
    ],
    connect: Annotated[
        list[str] | None,
        typer.Option(
            "--connect",
            metavar="HOST:PORT",
            help="Where another robot listens; may be given again. One is enough.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Write this robot's poses and edges as .g2o.")
    ] = None,
    cost: CostOption = None,
    method: Annotated[
        MethodOfTeam | None,
        typer.Option(help="First stage of robots that keep their measurements; newton for none."),
    ] = None,
    sharing: Annotated[
        SharingOfTeam,
        typer.Option(
            help="What others are told: the measurements, each once, or the interface alone, so "
            "that measurements stay with this robot, which takes many more bytes."
        ),
    ] = SharingOfTeam.MEASUREMENTS,
    robust: Annotated[
        Robust | None,
        typer.Option(help="Find wrong edges; as pgo solve does where measurements are shared."),
    ] = None,
    patience: Annotated[
        float,
        typer.Option("--patience", help="Seconds after which a silent robot counts as absent."),
    ] = 10.0,
    retry: Annotated[
        float,
        typer.Option(
            "--retry",
            help="Seconds after which a message without an answer is repeated, at the earliest.",
        ),
    ] = 1.0,
    trust_folder: TrustFolderOption = False,
    wait: Annotated[
        float, typer.Option("--wait", help="Seconds to wait for robots that are absent.")
    ] = math.inf,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run `pgo robot`."""
    from solvers.team.robot import Robot
    from solvers.team.sharing import Sharing
    from solvers.team.zenoh_link import ZenohLink, carry  # Zenoh is of an extra

    if out is not None:
        check_writable(out)
    if cost not in _WEIGHTINGS:
        raise SettingError("robots of a team minimise chi2 or F; give --cost chi2 or isotropic")
    if method is not None and sharing is not SharingOfTeam.INTERFACE:
        raise SettingError("--method is for robots that keep theirs; give --sharing interface")
    names = [word.strip() for word in team.split(",")]
    robot = Robot(
        name,
        names,
        _secret(key),
        pipeline=None if method is None else pipeline_of_robots(FirstStage(method.value)),
        weighting=_WEIGHTINGS[cost],
        sharing=Sharing[sharing.name],
        robust=chosen_robust(robust),
        trust_folder=trust_folder,
        patience=patience,
        retry=retry,
    )
    robot.read(graph)
    reporter = _Reporter(quiet)
    with ZenohLink(robot, listen, connect or []) as link, _interrupt_noted() as interrupted:
        reporter.say(f"{name} listens at {listen}, and waits for {', '.join(robot.others)}")
        carry(robot, link, wait, reporter, interrupted.is_set)
        if interrupted.is_set() and robot.outcome is None:
            raise KeyboardInterrupt
        # Before the network is closed: others who have gone may keep it from that.
        writers = [(out, robot.write)] if out is not None and robot.poses else []
        record = robot.as_json if as_json else None
        text = wrapped("\n".join(f"{label:<12} {value}" for label, value in robot.facts()), _INDENT)
        save_then_show(writers, lambda: typer.echo(text), record, quiet)
    is_whole = not robot.absent and not robot.problems
    is_done = robot.is_certified and is_whole and not interrupted.is_set()
    raise typer.Exit(DONE if is_done else NOT_CERTIFIED)


@contextmanager
def _interrupt_noted() -> Iterator[threading.Event]:
    """Yield an event that the first Ctrl-C sets; the next one is as always.

    An exception in its place might come up in a callback of the network, which would swallow it.
    """
    noted = threading.Event()
    as_always = signal.getsignal(signal.SIGINT)

    def note(*_: object) -> None:
        noted.set()
        signal.signal(signal.SIGINT, as_always)

    signal.signal(signal.SIGINT, note)
    try:
        yield noted
    finally:
        signal.signal(signal.SIGINT, as_always)


def _secret(path: Path) -> bytes:
    """The secret of a team, from its file."""
    try:
        return path.read_bytes()
    except OSError as error:
        problem = f"the key of the team cannot be read: {error.strerror}"
        raise FileFormatError(path, None, problem) from error


class _Reporter:
    """Says on stderr who is there, and how solves end."""

    def __init__(self, is_silent: bool) -> None:
        self._is_silent = is_silent
        self._said: set[str] = set()
        self._outcome: Ended | None = None
        self._failure = ""

    def __call__(self, robot: "Robot") -> None:
        """Say what is new of a robot."""
        for other in robot.heard:
            if other not in self._said:
                self._said.add(other)
                self.say(f"{other} is there")
        for problem in robot.problems:
            if problem not in self._said:
                self._said.add(problem)
                self.say(problem)
        if robot.outcome is not self._outcome and robot.outcome is not None:
            self._outcome = robot.outcome
            self.say(robot.outcome.text)
        if robot.failure != self._failure:
            self._failure = robot.failure
            self.say(robot.failure or "what went wrong is mended")

    def say(self, text: str) -> None:
        """Print a line on stderr."""
        if not self._is_silent:
            typer.echo(f"pgo: {text}", err=True)
