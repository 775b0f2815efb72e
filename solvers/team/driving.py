"""An engine whose robots are there already: those of a team, one of which drives a solve.

A solve asks robots and waits. Here it runs in a thread beside the robot that drives, which hands on
what it asks, and the answers when the last one is there. So its solve is that of every other place.
"""

from __future__ import annotations

import queue
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from pgo_models.errors import PGOError
from solvers.carry.messages import Idle, Worker, obey, raise_first_error
from solvers.carry.wire import Order
from solvers.robots.agent import Agent
from solvers.robots_solution import RobotsSolution
from solvers.team.beside import Beside
from solvers.team.measurements import Revision
from solvers.team.messages import Ask, Ended, Hello, Reply, Term, error_of_message

T = TypeVar("T")
Q = TypeVar("Q")
A = TypeVar("A")


class _AbandonedError(BaseException):
    """Raised in a solve that is given up; nothing in a solve catches it."""


@dataclass(eq=False)
class Drive:
    """A solve of the term by the robots `members`, the first of which is this one, with its agent.

    `solve` is what is solved, with this engine, beside the robot. Of what it asks the robot is told
    (`tell`), after which `waiting` are the asks without an answer, by robot; at the end `outcome`
    is the solution or error. `call` and `num_asked`, how many orders each has had, as not all are
    for everybody, belong to the thread of the solve.
    """

    term: Term
    members: tuple[str, ...]
    agent: Agent
    solve: Callable[[Drive], RobotsSolution]
    beside: Beside
    tell: Callable[[Drive], None]
    call: int = -1
    waiting: dict[str, Ask] = field(default_factory=dict)
    num_asked: dict[str, int] = field(default_factory=dict)
    outcome: RobotsSolution | PGOError | None = None
    _answers: list[Any] = field(default_factory=list)
    _arrived: queue.SimpleQueue[list[Any] | None] = field(default_factory=queue.SimpleQueue)

    def begin(self) -> None:
        """Run the solve."""
        self.beside.begin(
            self._run, self._end, "an answer of another robot cannot be computed with"
        )

    def _run(self) -> RobotsSolution | None:
        """The solution; None of a solve that is given up."""
        try:
            return self.solve(self)
        except _AbandonedError:
            return None

    def _end(self, outcome: RobotsSolution | PGOError | None) -> None:
        self.outcome = outcome
        self.tell(self)

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
            self.beside.count(1)
            self._arrived.put(self._answers)

    def is_computed(self, robot: str, hello: Hello) -> bool:
        """Whether a robot computes what it was asked, as it says."""
        ask = self.waiting.get(robot)
        return ask is not None and (hello.term, hello.computing) == (self.term, ask.call)

    def abandon(self) -> None:
        """Give the solve up, where it asks next; nothing more is told of it."""
        self.tell = lambda _: None
        self.waiting = {}
        self._arrived.put(None)

    def ended(self, absent: tuple[str, ...], revisions: Mapping[str, Revision]) -> Ended:
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
        asks = {}
        for place, (name, request) in enumerate(zip(self.members, requests, strict=True)):
            if place > 0 and request is not Idle.IDLE:
                number = self.num_asked.get(name, 0)
                self.num_asked[name] = number + 1
                members = self.members if number == 0 else ()
                asks[name] = Ask(self.term, number, place, named, request, members)
        if not asks:
            answers = obey([self.agent], order, requests[:1])
            return raise_first_error([*answers, *(None for _ in requests[1:])])
        self.beside.hand_over(lambda: self._ask_others(asks))
        answers = obey([self.agent], order, requests[:1])  # others may answer before this one
        self.beside.count(-1)
        arrived = self._arrived.get()
        if arrived is None:
            self.beside.count(1)
            raise _AbandonedError
        return raise_first_error([*answers, *arrived[1:]])

    def _ask_others(self, asks: dict[str, Ask]) -> None:
        self._answers = [None] * len(self.members)
        self.waiting = asks
        self.tell(self)

    def close(self) -> None:
        """Keep the robots: they outlive a solve."""
