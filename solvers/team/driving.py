"""A solve of the team as the robot sees it that drives: what it asks, and who has not answered."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from pgo_models.errors import PGOError
from solvers.carry.ledger import Ledger, Traffic
from solvers.robots.setup import ApartError
from solvers.robots_solution import RobotsSolution
from solvers.team.beside import Beside
from solvers.team.driven_solve import solve_with_team
from solvers.team.measurements import Measurements, Revision
from solvers.team.messages import Ask, Ended, Hello, Reply, Term, error_of_message
from solvers.team.shared_solve import TeamSettings
from solvers.team.sharing import OwnAnswer


class Drive:
    """A solve of the term by the robots `members`, the first of which is this one.

    Of what the solve asks, the robot is told (`tell`), after which `waiting` are the asks without
    an answer, by robot; at the end `outcome` is the solution or error, and `own` are this robot's
    poses.
    """

    def __init__(
        self,
        term: Term,
        members: tuple[str, ...],
        measurements: Measurements,
        settings: TeamSettings,
        beside: Beside,
        tell: Callable[[Drive], None],
    ) -> None:
        self.term = term
        self.members = members
        self.waiting: dict[str, Ask] = {}
        self.outcome: RobotsSolution | PGOError | None = None
        self.own: OwnAnswer | None = None
        self._answers: dict[str, Any] = {}
        self._tell = tell
        self._talk = beside.begin(
            partial(solve_with_team, settings, term, members, measurements),
            self._end,
            "an answer of another robot cannot be computed with",
            self._ask,
        )

    def _ask(self, asks: dict[str, Ask]) -> None:
        self._answers = {}
        self.waiting = asks
        self._tell(self)

    def _end(self, result: tuple[RobotsSolution, OwnAnswer | None] | PGOError) -> None:
        if isinstance(result, PGOError):
            self.outcome = result
        else:
            self.outcome, self.own = result
        self._tell(self)

    def waits_for(self, robot: str, reply: Reply) -> bool:
        """Whether a robot has not yet given this answer, which the solve waits for."""
        ask = self.waiting.get(robot)
        return ask is not None and reply.call == ask.call

    def take(self, robot: str, reply: Reply) -> None:
        """Take an answer; with the last one the solve goes on."""
        if not self.waits_for(robot, reply):
            return
        del self.waiting[robot]
        error = reply.error
        self._answers[robot] = reply.answer if error is None else error_of_message(error, robot)
        if not self.waiting:
            self._talk.tell(self._answers)

    def is_computed(self, robot: str, hello: Hello) -> bool:
        """Whether a robot computes what it was asked, as it says."""
        ask = self.waiting.get(robot)
        return ask is not None and (hello.term, hello.computing) == (self.term, ask.call)

    def abandon(self) -> None:
        """Give the solve up; nothing more is told of it."""
        self.waiting = {}
        self._talk.give_up()

    def ended(
        self,
        absent: tuple[str, ...],
        revisions: Mapping[str, Revision],
        parts: tuple[tuple[str, ...], ...],
    ) -> Ended:
        """How the solve has ended, without `absent` robots, by members with these revisions.

        `parts` are those that were known before, one of which are the members.
        """
        outcome = self.outcome
        if isinstance(outcome, RobotsSolution):
            found = replace(outcome, ledger=_in_few_exchanges(outcome.ledger))
            return Ended(self.term, revisions, absent, found, parts=parts)
        if isinstance(outcome, ApartError):
            apart = tuple(tuple(self.members[k] for k in part) for part in outcome.parts)
            return Ended(self.term, revisions, absent, None, parts=apart)
        return Ended(self.term, revisions, absent, None, failure=f"failed: {outcome}")


def _in_few_exchanges(ledger: Ledger) -> Ledger:
    """The ledger with those exchanges as one that took place equally often.

    All its sums stay. A message describes every exchange, and a long solve has many.
    """
    exchanged: dict[int, list[Traffic]] = {}
    for traffic, times in ledger.counted:
        exchanged.setdefault(times, []).append(traffic)
    counted = []
    for times, parts in exchanged.items():
        sender = np.concatenate([each.sender for each in parts])
        receiver = np.concatenate([each.receiver for each in parts])
        num_bytes = np.concatenate([each.num_bytes for each in parts])
        counted.append((Traffic(sender, receiver, num_bytes), times))
    return replace(ledger, counted=tuple(counted))
