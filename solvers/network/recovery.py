"""Fault tolerance: a failed worker is restarted from its last snapshot, and the requests logged since are replayed.

A worker is deterministic: its state follows from its subgraph and the requests it was given. What a replay sends again
is not in the ledger.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

from pgo_models.errors import EngineError, PGOError, check_settings
from solvers.network.messages import Idle, Snapshot, restore, take_snapshot

T = TypeVar("T")
Q = TypeVar("Q")
A = TypeVar("A")
AnyOrder = Callable[[Any, Any], Any]


class RobotLostError(EngineError):
    """A robot is not there any more, and what it held with it."""


class Place(Protocol[T]):
    """Where robots run that can be lost; T is what stands for an order under way."""

    def start(self, robots: Sequence[int]) -> None:
        """Start robots, or start them again, each from its share; a RobotLostError when one was lost meanwhile."""

    def send(self, robot: int, order: AnyOrder, request: object) -> T:
        """Give a robot an order."""

    def receive(self, robot: int, ticket: T) -> Any:  # noqa: ANN401 - what the order answers
        """Wait for its answer; a RobotLostError when there will be none."""

    def close(self) -> None:
        """Let the robots go."""


@dataclass(frozen=True)
class Recovery:
    """How lost robots are made anew."""

    orders_between_snapshots: int = 40  # an iteration of SOC takes three or four; so many are kept for a robot
    max_restarts: int = 3  # of one robot; then the run ends with an error

    def __post_init__(self) -> None:
        check_settings(self, not_negative=["max_restarts"], at_least_one=["orders_between_snapshots"])


@dataclass(eq=False)
class RecoveringPool(Generic[T]):
    """Robots in a place where they can be lost; answers are those of robots that never are."""

    place: Place[T]  # with all robots started
    num_robots: int
    recovery: Recovery
    restarts: list[int] = field(init=False)  # how often every robot was started again
    _log: list[tuple[AnyOrder, tuple[Any, ...]]] = field(init=False, default_factory=list)
    _snapshots: list[Snapshot] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        self.restarts = [0] * self.num_robots

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
            self.ask(take_snapshot, [None] * self.num_robots)
        return answers

    def close(self) -> None:
        """Let the robots go."""
        self.place.close()

    def _asked(self, order: AnyOrder, requests: Sequence[object]) -> list[Any]:
        working = [robot for robot, request in enumerate(requests) if request is not Idle.IDLE]
        tickets = [self.place.send(robot, order, requests[robot]) for robot in working]
        answers: list[Any] = [None] * len(requests)
        refusal: PGOError | None = None
        for robot, ticket in zip(working, tickets, strict=True):
            try:
                try:
                    answers[robot] = self.place.receive(robot, ticket)
                except RobotLostError as lost:
                    answers[robot] = self._recovered(robot, order, requests[robot], lost)
            except EngineError:
                raise
            except PGOError as error:  # the robot's own; the others' answers are waited for all the same
                refusal = refusal or error
        if refusal is not None:
            raise refusal
        return answers

    def _recovered(self, robot: int, order: AnyOrder, request: object, lost: RobotLostError) -> object:
        """Answer of a robot that was lost before it gave one."""
        while self.restarts[robot] < self.recovery.max_restarts:
            self.restarts[robot] += 1
            try:
                self.place.start([robot])
                if self._snapshots:
                    self._order(robot, restore, self._snapshots[robot])
                for earlier, requests in self._log:
                    if requests[robot] is not Idle.IDLE:
                        self._again(robot, earlier, requests[robot])
                return self._order(robot, order, request)
            except RobotLostError as error:
                lost = error
        way_out = "look at the memory of its machine, or run in this process"
        raise EngineError(f"robot {robot} was lost {self.restarts[robot] + 1} times ({lost}); {way_out}") from lost

    def _order(self, robot: int, order: AnyOrder, request: object) -> object:
        return self.place.receive(robot, self.place.send(robot, order, request))

    def _again(self, robot: int, order: AnyOrder, request: object) -> None:
        try:
            self._order(robot, order, request)
        except EngineError:
            raise
        except PGOError:  # as it was the first time, when the driver was told
            return
