"""Fault tolerance: a failed worker is restarted from its last snapshot, and the requests logged since are replayed.

A worker is deterministic: its state follows from subgraph and requests. What a replay sends again is not in the ledger.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

from pgo_models.errors import EngineError, check_settings
from solvers.network.messages import Idle, Snapshot, raised, restore, take_snapshot

T = TypeVar("T")
Q = TypeVar("Q")
A = TypeVar("A")
AnyOrder = Callable[[Any, Any], Any]


class RobotLostError(EngineError):
    """A robot is not there any more, and what it held with it."""


class Place(Protocol[T]):
    """Where groups of robots run that can be lost, each as a whole; T is what stands for an order under way."""

    @property
    def groups(self) -> Sequence[Sequence[int]]:
        """Robots of every group."""

    def start(self, groups: Sequence[int]) -> None:
        """Start groups, or start them again, from their parts; a RobotLostError when one was lost meanwhile."""

    def send(self, group: int, order: AnyOrder, requests: Sequence[object]) -> T:
        """Give the robots of a group an order, each with its request."""

    def receive(self, group: int, ticket: T) -> list[Any]:
        """Wait for their answers, see `obey`; a RobotLostError when there will be none."""

    def close(self) -> None:
        """Let the robots go."""


@dataclass(frozen=True)
class Recovery:
    """How lost robots are made anew."""

    orders_between_snapshots: int = 40  # an iteration of SOC takes three or four; so many are kept for a robot
    max_restarts: int = 3  # of one group; then the run ends with an error

    def __post_init__(self) -> None:
        check_settings(self, not_negative=["max_restarts"], at_least_one=["orders_between_snapshots"])


@dataclass(eq=False)
class RecoveringPool(Generic[T]):
    """Robots in a place where they can be lost; answers are those of robots that never are."""

    place: Place[T]  # with all robots started
    recovery: Recovery
    restarts: list[int] = field(init=False)  # how often every group was started again
    _log: list[tuple[AnyOrder, tuple[Any, ...]]] = field(init=False, default_factory=list)
    _snapshots: list[Snapshot] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        self.restarts = [0] * len(self.place.groups)

    def ask(self, order: Callable[[Any, Q], A], requests: Sequence[Q]) -> list[A]:
        """Answers of all robots to an order, each with its request; an EngineError when one is lost too often."""
        try:
            answers: list[Any] = self._asked(order, requests)
        finally:  # an order that failed on one robot was obeyed by the others
            self._log.append((order, tuple(requests)))
        if order is take_snapshot:
            self._snapshots, self._log = answers, []
        elif order is restore:
            self._snapshots, self._log = [*self._log[-1][1]], []
        elif len(self._log) >= self.recovery.orders_between_snapshots:
            self.ask(take_snapshot, [None] * len(requests))
        return answers

    def close(self) -> None:
        """Let the robots go."""
        self.place.close()

    def _asked(self, order: AnyOrder, requests: Sequence[object]) -> list[Any]:
        each = {group: [requests[one] for one in robots] for group, robots in enumerate(self.place.groups)}
        working = {group: mine for group, mine in each.items() if any(one is not Idle.IDLE for one in mine)}
        tickets = {group: self.place.send(group, order, mine) for group, mine in working.items()}
        answers: list[Any] = [None] * len(requests)
        for group, ticket in tickets.items():
            try:
                found = self.place.receive(group, ticket)
            except RobotLostError as lost:
                found = self._recovered(group, order, working[group], lost)
            for robot, answer in zip(self.place.groups[group], found, strict=True):
                answers[robot] = answer
        return raised(answers)

    def _recovered(self, group: int, order: AnyOrder, requests: Sequence[object], lost: RobotLostError) -> list[Any]:
        """Answers of a group that was lost before it gave them; what robots refused they refuse again."""
        robots = self.place.groups[group]
        while self.restarts[group] < self.recovery.max_restarts:
            self.restarts[group] += 1
            try:
                self.place.start([group])
                if self._snapshots:
                    self._order(group, restore, [self._snapshots[one] for one in robots])
                for earlier, asked in self._log:
                    if any(asked[one] is not Idle.IDLE for one in robots):
                        self._order(group, earlier, [asked[one] for one in robots])
                return self._order(group, order, requests)
            except RobotLostError as error:
                lost = error
        times = f"{', '.join(map(str, robots))} was lost {self.restarts[group] + 1} times ({lost})"
        way_out = "look at the memory of its machine, or run in this process"
        raise EngineError(f"the process of robots {times}; {way_out}") from lost

    def _order(self, group: int, order: AnyOrder, requests: Sequence[object]) -> list[Any]:
        return self.place.receive(group, self.place.send(group, order, requests))
