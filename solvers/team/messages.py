"""What robots of a team send each other, and errors as messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from pgo_models import errors
from pgo_models.errors import PGOError
from solvers.carry.registry import record
from solvers.carry.wire import Order, WireError
from solvers.robots_solution import RobotsSolution
from solvers.team.measurements import Revision
from solvers.team.news import News

_MOST = 1 << 62  # no number of a message is higher
_NUMBERS = ("call", "place", "computing", "sent", "answers")
_PLAIN_ERRORS = {
    kind.__name__: kind
    for kind in (errors.GraphError, errors.NotPositiveDefiniteError, errors.SettingError)
}


class Priority(IntEnum):
    """What a transport may send first where it cannot send everything at once."""

    HELLO = 0  # short, and a robot that is not heard counts as absent
    URGENT = 1  # others wait for it
    NORMAL = 2


@record("Term")
@dataclass(frozen=True, order=True)
class Term:
    """Names a solve: a number that only grows, and the robot that drives."""

    number: int
    driver: str


@record("Hello")
@dataclass(frozen=True)
class Hello:
    """A robot is there, with measurements of this revision; `term` is the latest that it knows.

    `known` is that of the outcome that it has, `computing` the order of the term that it computes
    the answer to, or -1; `twins` are names that two robots have, and `hears` are robots that it has
    heard of lately, not through others. `apart` is the solve by which it knows which robots no edge
    joins.
    """

    revision: Revision
    term: Term
    known: Term
    computing: int = -1
    twins: tuple[str, ...] = ()
    hears: tuple[str, ...] = ()
    apart: Term = Term(0, "")


@record("Relayed")
@dataclass(frozen=True, eq=False)
class Relayed:
    """A sealed message, (k,) bytes, for a robot that its sender does not hear, through a third."""

    receiver: str
    data: np.ndarray


@record("Ask")
@dataclass(frozen=True, eq=False)
class Ask:
    """Order number `call` to a robot in a solve, with its request; `place` is the robot's number.

    `members` are the robots of the solve by their places, in order number 0; `sent` is when this
    copy was sent, by the `clock` of its sender.
    """

    term: Term
    call: int
    place: int
    order: Order
    request: Any
    members: tuple[str, ...] = ()
    sent: int = 0


@record("Reply")
@dataclass(frozen=True, eq=False)
class Reply:
    """The answer to order number `call`, or what went wrong.

    `revision` is that of the measurements that the robot takes part with, `answers` when the copy
    of the order was sent that has led to it.
    """

    term: Term
    call: int
    revision: Revision
    answer: Any
    error: tuple[str, str] | None = None  # name and text of a PGOError
    answers: int = 0


@record("Letter")
@dataclass(frozen=True, eq=False)
class Letter:
    """What a robot tells another one in its answer to order number `call`."""

    term: Term
    call: int
    place: int  # of the sender
    content: Mapping[int, Any]


@record("LetterLost")
@dataclass(frozen=True)
class LetterLost:
    """The letter of order number `call` has not arrived at the robot with this place."""

    term: Term
    call: int
    place: int


@record("Ended")
@dataclass(frozen=True, eq=False)
class Ended:
    """A solve of the team has ended.

    Where no edge joins some of its robots with the others, it has found their `parts` alone, and
    each part solves for itself.

    Parameters
    ----------
    term : Term
        The solve.
    revisions : dict of str to Revision
        Robots that took part, each with the revision of its measurements.
    absent : tuple of str
        Robots of the team that were not heard of, or that no edge joins with these.
    solution : RobotsSolution, optional
        What was found; None where the solve failed, or has found parts.
    failure : str
        What went wrong; empty where nothing did.
    parts : tuple of tuple of str
        The robots that were there, in the parts that edges join, where there are several.
    """

    term: Term
    revisions: Mapping[str, Revision]
    absent: tuple[str, ...]
    solution: RobotsSolution | None
    failure: str = ""
    parts: tuple[tuple[str, ...], ...] = ()

    @property
    def has_parts_alone(self) -> bool:
        """Whether it has found which robots are joined, and each part solves for itself."""
        return self.solution is None and bool(self.parts)

    @property
    def covered(self) -> tuple[str, ...]:
        """Robots whose measurements the solution holds for."""
        return () if self.solution is None else tuple(sorted(self.revisions))

    @property
    def text(self) -> str:
        """One line: the verdict, the gap, and the robots that it covers."""
        solution = self.solution
        if solution is None:
            return self.failure
        names = ", ".join(self.covered)
        said = solution.robust or solution.verdict.name
        gap = solution.certificate.gap_text
        rounds = f", {solution.ledger.rounds} rounds" if solution.ledger.rounds else ""
        return f"{said}, for {names}: gap {gap}{rounds}"


@record("Heard")
@dataclass(frozen=True)
class Heard:
    """The outcome of this solve has arrived."""

    term: Term


_OfASolve = Hello | Ask | Reply | Letter | LetterLost | Ended | Heard  # messages with a term


def check_message(message: object, team: tuple[str, ...]) -> None:
    """Raise a WireError for names and numbers that no robot of the team sends."""
    if isinstance(message, Relayed):
        if message.receiver not in team:
            raise WireError("a message to be passed on to nobody")
        return
    if not isinstance(message, News | _OfASolve):
        raise WireError(f"a {type(message).__name__} is no message")
    is_known = set(_names_in(message)) <= set(team)
    if not is_known or not all(-1 <= number < _MOST for number in _numbers_in(message)):
        raise WireError(f"a {type(message).__name__} with names or numbers of nobody")
    if isinstance(message, Ask) and message.members:
        is_numbered = 0 < message.place < len(message.members)
        if not is_numbered or message.members[0] != message.term.driver:
            raise WireError("an order with other places than those of its robots")


def _names_in(message: News | _OfASolve) -> list[str]:
    """All names of robots in a message."""
    names: list[str] = []
    for field in ("members", "revisions", "absent", "twins", "has", "hears"):
        names += getattr(message, field, ())
    for part in getattr(message, "parts", ()):
        names += part
    if isinstance(message, News):
        return names + [piece.owner for piece in message.pieces]
    return names + [term.driver for term in _terms_in(message) if term.driver]


def _numbers_in(message: News | _OfASolve) -> list[int]:
    """All numbers in a message that count something."""
    numbers = [getattr(message, field, 0) for field in _NUMBERS]
    if isinstance(message, News):
        return numbers + [piece.before.num_lines for piece in message.pieces]
    return numbers + [term.number for term in _terms_in(message)]


def _terms_in(message: _OfASolve) -> list[Term]:
    return [message.term, getattr(message, "apart", message.term)]


def error_as_message(error: PGOError) -> tuple[str, str]:
    """Name and text of an error."""
    return type(error).__name__, str(error)


def error_of_message(message: tuple[str, str], robot: str) -> PGOError:
    """The error of another robot, of its kind where that has a text alone."""
    name, text = message
    kind = _PLAIN_ERRORS.get(name)
    return PGOError(f"{robot}: {text}") if kind is None else kind(text)
