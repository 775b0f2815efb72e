"""An engine whose robots are there already: those of a team, one of which drives a solve.

A solve asks robots and waits. Here it runs in a coroutine of the package greenlet: where it would
wait, it stops, and goes on when the last answer is there. So the robot that drives has neither
threads nor sockets, and its solve is that of every other place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from pgo_models.errors import PGOError, extra_module
from solvers.carry.messages import Idle, Worker, obey, raise_first_error
from solvers.carry.wire import Order
from solvers.robots.agent import Agent
from solvers.robots_solution import RobotsSolution
from solvers.team.messages import Ask, Ended, Reply, Term, error_of_message

T = TypeVar("T")
Q = TypeVar("Q")
A = TypeVar("A")


class _AbandonedError(BaseException):
    """Raised in a solve that is given up; nothing in a solve catches it."""


@dataclass(eq=False)
class Drive:
    """A solve of the term by the robots `members`, the first of which is this one, with its agent.

    `solve` is what is solved, with this engine. `waiting` are the asks without an answer, by robot,
    `num_asked` says how many orders each has had (not all are for everybody), `outcome` is the
    solution or error at the end.
    """

    term: Term
    members: tuple[str, ...]
    agent: Agent
    solve: Callable[[Drive], RobotsSolution]
    call: int = -1
    waiting: dict[str, Ask] = field(default_factory=dict)
    num_asked: dict[str, int] = field(default_factory=dict)
    outcome: RobotsSolution | PGOError | None = None
    _answers: list[Any] = field(default_factory=list)
    _page: Any = None

    @property
    def needed(self) -> Sequence[str]:
        """Robots without which the solve cannot go on.

        Robots that share their interface wait for letters of each other, too.
        """
        return list(self.waiting) if self.agent.own_lines.is_shared else self.members[1:]

    def begin(self) -> None:
        """Run the solve until it waits for answers, or ends."""
        self._page = extra_module("greenlet", "team").greenlet(self._run)
        self._page.switch()

    def _run(self) -> None:
        try:
            self.outcome = self.solve(self)
        except PGOError as error:
            self.outcome = error
        except _AbandonedError:
            pass

    def take(self, robot: str, reply: Reply) -> None:
        """Take an answer; with the last one the solve goes on."""
        ask = self.waiting.get(robot)
        if ask is None or reply.call != ask.call:
            return
        del self.waiting[robot]
        place = self.members.index(robot)
        error = reply.error
        self._answers[place] = reply.answer if error is None else error_of_message(error, robot)
        if not self.waiting:
            self._page.switch()

    def abandon(self) -> None:
        """Give the solve up."""
        if self._page is not None and not self._page.dead:
            self._page.throw(_AbandonedError)
        self.waiting.clear()

    def ended(self, absent: tuple[str, ...], revisions: Mapping[str, int]) -> Ended:
        """How the solve has ended, without `absent` robots, by members with these revisions."""
        outcome = self.outcome
        if isinstance(outcome, RobotsSolution):
            return Ended(self.term, revisions, absent, outcome.without_histories)
        return Ended(self.term, revisions, absent, None, failure=f"failed: {outcome}")

    # An engine, and its pool of workers

    def open(self, make: Callable[[T], Worker], parts: Sequence[T]) -> Drive:
        """Return the pool of the robots, which have their parts."""
        return self

    def ask(self, order: Callable[[Any, Q], A], requests: Sequence[Q]) -> list[A]:
        """Give every robot an order with its request, and wait for all answers."""
        self.call += 1
        named = Order.of(order)
        self._answers = [None] * len(requests)
        for place, (name, request) in enumerate(zip(self.members, requests, strict=True)):
            if place > 0 and request is not Idle.IDLE:
                number = self.num_asked.get(name, 0)
                self.num_asked[name] = number + 1
                members = self.members if number == 0 else ()
                self.waiting[name] = Ask(self.term, number, place, named, request, members)
        self._answers[:1] = obey([self.agent], order, requests[:1])
        if self.waiting:
            self._page.parent.switch()
        return raise_first_error(self._answers)

    def close(self) -> None:
        """Keep the robots: they outlive a solve."""
