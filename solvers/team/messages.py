"""What robots of a team send each other, and errors as messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from pgo_models import errors
from pgo_models.certificates.certificate import Certificate
from pgo_models.errors import PGOError
from solvers.team.wire import Order

_PLAIN_ERRORS = {
    kind.__name__: kind
    for kind in (errors.GraphError, errors.NotPositiveDefiniteError, errors.SettingError)
}


class Priority(IntEnum):
    """What a transport may send first where it cannot send everything at once."""

    URGENT = 0  # others wait for it
    NORMAL = 1


@dataclass(frozen=True, order=True)
class Term:
    """Names a solve: a number that only grows, and the robot that drives."""

    number: int
    driver: str


@dataclass(frozen=True)
class Hello:
    """A robot is there, with measurements of this revision; `term` is the latest that it knows."""

    revision: int
    term: Term


@dataclass(frozen=True, eq=False)
class Ask:
    """Order number `call` to a robot in a solve, with its request; `place` is the robot's number.

    `members` are the robots of the solve by their places, in order number 0.
    """

    term: Term
    call: int
    place: int
    order: Order
    request: Any
    members: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Reply:
    """The answer to order number `call`, or what went wrong.

    `revision` is that of the measurements that the robot takes part with.
    """

    term: Term
    call: int
    revision: int
    answer: Any
    error: tuple[str, str] | None = None  # name and text of a PGOError


@dataclass(frozen=True, eq=False)
class Letter:
    """What a robot tells another one in its answer to order number `call`."""

    term: Term
    call: int
    place: int  # of the sender
    content: Mapping[int, Any]


@dataclass(frozen=True)
class LetterLost:
    """The letter of order number `call` has not arrived at the robot with this place."""

    term: Term
    call: int
    place: int


@dataclass(frozen=True, eq=False)
class TeamOutcome:
    """How a solve of the team has ended.

    Parameters
    ----------
    term : Term
        The solve.
    certificate : Certificate, optional
        Cost, bound, gap and verdict, without poses; None where the solve failed.
    revisions : dict of str to int
        Robots that took part, with how many lines of measurements each.
    absent : tuple of str
        Robots of the team that were not heard of.
    num_absent_poses : int
        Poses that edges name and no robot has: what is found holds for these edges all the same.
    rounds : int
        Rounds of the solve.
    stages : tuple of str
        Names of the stages of the solve.
    note : str
        What went wrong, or what the solution lacks.
    robust : str
        What a robust solve says of the edges that it kept, doubts first.
    is_held : bool
        Whether nothing speaks against these edges.
    """

    term: Term
    certificate: Certificate | None
    revisions: Mapping[str, int]
    absent: tuple[str, ...]
    num_absent_poses: int = 0
    rounds: int = 0
    stages: tuple[str, ...] = ()
    note: str = ""
    robust: str = ""
    is_held: bool = True

    @property
    def covered(self) -> tuple[str, ...]:
        """Robots whose measurements the certificate holds for."""
        return () if self.certificate is None else tuple(sorted(self.revisions))

    @property
    def is_certified(self) -> bool:
        """Whether the gap is within the one asked for, and nothing speaks against the edges kept.

        This holds for the robots in `covered`.
        """
        return self.is_held and self.certificate is not None and self.certificate.is_certified

    @property
    def text(self) -> str:
        """One line: the verdict, the gap, and the robots that it covers."""
        if self.certificate is None:
            return self.note
        names = ", ".join(self.covered)
        said = self.robust or self.certificate.verdict.name
        return f"{said}, for {names}: gap {self.certificate.gap_text}, {self.rounds} rounds"


@dataclass(frozen=True)
class Heard:
    """The outcome of this solve has arrived."""

    term: Term


MESSAGES = (Hello, Ask, Reply, Letter, LetterLost, TeamOutcome, Heard, Term)


def error_as_message(error: PGOError) -> tuple[str, str]:
    """Name and text of an error."""
    return type(error).__name__, str(error)


def error_of_message(message: tuple[str, str], robot: str) -> PGOError:
    """The error of another robot, of its kind where that has a text alone."""
    name, text = message
    kind = _PLAIN_ERRORS.get(name)
    return PGOError(f"{robot}: {text}") if kind is None else kind(text)
