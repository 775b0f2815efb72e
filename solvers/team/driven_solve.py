"""The solve of robots that keep their measurements, in the processes beside them.

That of the robot that drives is one by robots with own files, whose engine asks the robots of the
team. The others obey its orders.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from pgo_models.errors import PGOError
from solvers.carry.messages import Worker, obey, raise_first_error
from solvers.carry.process import DEFAULT_MEMORY
from solvers.carry.wire import Order
from solvers.loop import RunMonitor
from solvers.robots.agent import Agent, OwnLines
from solvers.robots.own_file import READ_HERE
from solvers.robots.setup import SOLVE_PARTS, ApartError
from solvers.robots_solution import RobotsSolution
from solvers.solves.folder_solve import FilesOfRobots
from solvers.team.beside import Line, result_or_error
from solvers.team.measurements import Measurements
from solvers.team.messages import Ask, Term
from solvers.team.refusals import function_for_teams
from solvers.team.shared_solve import TeamSettings
from solvers.team.sharing import OwnAnswer, answer_of

T = TypeVar("T")
Q = TypeVar("Q")
A = TypeVar("A")
UNKNOWN = "it cannot compute what it was asked"


def solve_with_team(
    settings: TeamSettings,
    term: Term,
    members: tuple[str, ...],
    own: Measurements,
    line: Line,
) -> tuple[RobotsSolution, OwnAnswer | None]:
    """The solution of the term by these robots, the first of which has the measurements.

    An ApartError where no edge joins some of them with the others.
    """
    engine = _Team(term, members, _agent(0, settings.name, own), line)
    files = [OwnLines(place, _path_of(name)) for place, name in enumerate(members)]
    job = FilesOfRobots(
        "team",
        files,
        engine,
        DEFAULT_MEMORY,
        settings.weighting,
        trust_folder=settings.trust_folder,
        robust=settings.robust,
        leaves_out=True,
    )
    try:
        solution = job.solved(settings.pipeline, RunMonitor(progress=False))
    except PGOError as error:
        if isinstance(error, ApartError) and len(error.parts) > 1:
            raise
        raise PGOError(_with_ways_out_of_teams(str(error))) from error
    return solution.without_histories, answer_of(engine.agent)


def obey_orders(place: int, name: str, own: Measurements, line: Line) -> None:
    """Tell the answers to orders, or errors, each with what is known of the robot's poses."""
    agent = _agent(place, name, own)
    while True:
        order, request = line.wait()
        answer = result_or_error(partial(_obeyed, order, agent, request), UNKNOWN)
        line.tell((answer, answer_of(agent)))


def _obeyed(order: Order, agent: Agent, request: object) -> Any:  # noqa: ANN401 - the order chooses
    return function_for_teams(order)(agent, request)


def _agent(place: int, name: str, own: Measurements) -> Agent:
    """The part of a robot in a solve, with its measurements."""
    return Agent(OwnLines(place, _path_of(name), own.text()))


def _path_of(name: str) -> Path:
    """Name of the lines of a robot, as of a file in a folder."""
    return Path("team") / f"{name}.g2o"


@dataclass(eq=False)
class _Team:
    """An engine, and its pool of workers: the robots of a team, which are there already."""

    term: Term
    members: tuple[str, ...]
    agent: Agent
    line: Line
    num_asked: int = 0  # how many orders they have had

    def open(self, make: Callable[[T], Worker], parts: Sequence[T]) -> _Team:
        """Return the pool of the robots, which have their parts."""
        return self

    def ask(self, order: Callable[[Any, Q], A], requests: Sequence[Q]) -> list[A]:
        """Give every robot an order with its request, and wait for all answers."""
        named = Order.of(order)
        number = self.num_asked
        self.num_asked += 1
        members = self.members if number == 0 else ()
        asks = {
            name: Ask(self.term, number, place, named, request, members)
            for place, (name, request) in enumerate(zip(self.members, requests, strict=True))
            if place > 0
        }
        if asks:
            self.line.tell(asks)
        own = obey([self.agent], order, requests[:1])
        answers = self.line.wait() if asks else {}
        return raise_first_error([*own, *(answers.get(name) for name in self.members[1:])])

    def close(self) -> None:
        """Keep the robots: they outlive a solve."""


def _with_ways_out_of_teams(text: str) -> str:
    """A sentence on an error of robots with own files, with what a team can do about it."""
    text = text.replace(READ_HERE, "robots that share their measurements can")
    return text.replace(SOLVE_PARTS, "an edge between them joins them")
