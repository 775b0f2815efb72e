"""Fault tolerance: a lost worker starts again from its last snapshot.

The requests since that snapshot are replayed.

A worker is deterministic: its state follows from its subgraph and the requests. Messages that a
replay sends again are not in the ledger. The process of the driver keeps the snapshots, so that
they outlast a robot's machine. They contain all that a robot has computed, its interior poses too;
none of the driver's methods reads them. The ledger counts their bytes apart.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

from pgo_models.errors import EngineError, check_settings
from solvers.carry.messages import (
    Idle,
    Snapshot,
    raise_first_error,
    restore,
    snapshot_bytes,
    take_snapshot,
)

T = TypeVar("T")
Q = TypeVar("Q")
A = TypeVar("A")
AnyOrder = Callable[[Any, Any], Any]


class RobotLostError(EngineError):
    """A robot is lost, and with it all that it held."""


class RobotGroups(Protocol[T]):
    """A place where groups of robots run. A group is lost with all its robots.

    T is the type of a ticket, which stands for an order under way.
    """

    @property
    def groups(self) -> Sequence[Sequence[int]]:
        """Robots of every group."""

    def start(self, groups: Sequence[int]) -> None:
        """Start groups, or start them again, from their parts.

        Raises a RobotLostError when a group is lost meanwhile.
        """

    def send(self, group: int, order: AnyOrder, requests: Sequence[object]) -> T:
        """Give the robots of a group an order, each with its request."""

    def receive(self, group: int, ticket: T) -> list[Any]:
        """Wait for the answers to an order, as `obey` gives them.

        Raises a RobotLostError when there will be none.
        """

    def close(self) -> None:
        """Close the pool."""


@dataclass(frozen=True)
class Recovery:
    """Settings of how lost robots are started again.

    Parameters
    ----------
    orders_between_snapshots : int
        Number of orders that are kept for a robot, to be replayed; an iteration of SOC takes three
        or four.
    max_restarts : int
        Number of restarts of one group after which the run ends with an error.
    """

    orders_between_snapshots: int = 40
    max_restarts: int = 3

    def __post_init__(self) -> None:
        check_settings(
            self, not_negative=["max_restarts"], at_least_one=["orders_between_snapshots"]
        )


@dataclass(eq=False)
class RecoveringPool(Generic[T]):
    """Robots in a place where they can be lost; answers are the same as if they never were."""

    place: RobotGroups[T]  # with all robots started
    recovery: Recovery
    restarts: list[int] = field(init=False)  # how often every group was started again
    # Payload in bytes of the snapshots that the pool took of its own accord.
    snapshot_bytes: int = field(init=False, default=0)
    # Orders and requests since the last snapshots.
    _log: list[tuple[AnyOrder, tuple[Any, ...]]] = field(init=False, default_factory=list)
    _snapshots: list[Snapshot] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        self.restarts = [0] * len(self.place.groups)

    def ask(self, order: Callable[[Any, Q], A], requests: Sequence[Q]) -> list[A]:
        """Answers of all robots to an order, each with its request.

        Raises an EngineError when a robot is lost too often.
        """
        try:
            answers: list[Any] = self._ask_groups(order, requests)
        finally:
            # An order that failed on one robot was obeyed by the others, so it is replayed, too.
            self._log.append((order, tuple(requests)))
        if order is take_snapshot:
            self._snapshots = answers
            self._log = []
        elif order is restore:
            _, snapshots = self._log[-1]
            self._snapshots = [*snapshots]
            self._log = []
        elif len(self._log) >= self.recovery.orders_between_snapshots:
            self.snapshot_bytes += snapshot_bytes(self.ask(take_snapshot, [None] * len(requests)))
        return answers

    def close(self) -> None:
        """Close the pool."""
        self.place.close()

    def _ask_groups(self, order: AnyOrder, requests: Sequence[object]) -> list[Any]:
        """Give the order to all groups that are not idle, then wait for their answers."""
        tickets: dict[int, T] = {}
        for group, robots in enumerate(self.place.groups):
            if _is_working(robots, requests):
                tickets[group] = self.place.send(group, order, _chosen(requests, robots))
        answers: list[Any] = [None] * len(requests)
        for group, ticket in tickets.items():
            robots = self.place.groups[group]
            try:
                received = self.place.receive(group, ticket)
            except RobotLostError as lost:
                received = self._recover(group, order, _chosen(requests, robots), lost)
            for robot, answer in zip(robots, received, strict=True):
                answers[robot] = answer
        return raise_first_error(answers)

    def _recover(
        self, group: int, order: AnyOrder, requests: Sequence[object], lost: RobotLostError
    ) -> list[Any]:
        """Answers of a group that was lost before it gave them.

        A request that raised an error raises it again in the replay.
        """
        while self.restarts[group] < self.recovery.max_restarts:
            self.restarts[group] += 1
            try:
                self.place.start([group])
                self._replay(group)
                return self._order(group, order, requests)
            except RobotLostError as error:
                lost = error
        robots = ", ".join(map(str, self.place.groups[group]))
        times = f"{robots} was lost {self.restarts[group] + 1} times ({lost})"
        way_out = "look at the memory of its machine, or run in this process"
        raise EngineError(f"the process of robots {times}; {way_out}") from lost

    def _replay(self, group: int) -> None:
        """Bring a group that was started again to where it was: last snapshot, then the log."""
        robots = self.place.groups[group]
        if self._snapshots:
            self._order(group, restore, _chosen(self._snapshots, robots))
        for earlier_order, earlier_requests in self._log:
            if _is_working(robots, earlier_requests):
                self._order(group, earlier_order, _chosen(earlier_requests, robots))

    def _order(self, group: int, order: AnyOrder, requests: Sequence[object]) -> list[Any]:
        ticket = self.place.send(group, order, requests)
        return self.place.receive(group, ticket)


def _chosen(requests: Sequence[Any], robots: Sequence[int]) -> list[Any]:
    return [requests[robot] for robot in robots]


def _is_working(robots: Sequence[int], requests: Sequence[object]) -> bool:
    """Whether at least one of the robots gets an order."""
    return any(requests[robot] is not Idle.IDLE for robot in robots)
