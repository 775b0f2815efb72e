"""Workers whose messages are counted: what the driver asks of them, and what they send each other."""

import enum
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from pgo_models.graphs.pose_graph import IntArray
from solvers.network.engine import WorkerPool
from solvers.network.faults import LossyChannel
from solvers.network.ledger import BYTES_PER_NUMBER, DRIVER, Ledger, Traffic
from solvers.network.messages import count_numbers

Q = TypeVar("Q")
A = TypeVar("A")


class Count(enum.Enum):
    """What an order costs on the network."""

    ROUND = "robots wait for values at the separators"
    ALL_REDUCE = "sums of a few numbers, and what follows from them"
    GATHER = "likewise, of numbers that are not summed up: figures of all poses"
    PIGGYBACKED = "counted with the next round"
    OFF = "measuring, setting up, and collecting the answer are off the ledger"


class CountedPool:
    """A worker pool and its ledger."""

    def __init__(self, workers: WorkerPool, num_robots: int) -> None:
        self.workers, self.ledger = workers, Ledger(num_robots)
        self._traffic: dict[bytes, Traffic] = {}
        self.elsewhere: tuple[str, ...] = ()  # fields that go along a tree of workers
        # Of robots without a driver, whose sums go along a tree to its root: all, parents first, and their parents.
        self.tree: tuple[IntArray, IntArray] | None = None

    def ask(
        self,
        order: Callable[[Any, Q], A],
        requests: Sequence[Q],
        count: Count,
        robots: IntArray | None = None,
        is_along: bool = False,
    ) -> list[A]:
        """Answers of all workers to an order; of them `robots`, all unless given, exchange something with the driver.

        What goes to other workers is counted when it is handed on; if along a tree, so are requests that `is_along`.
        """
        answers = self.workers.ask(order, requests)
        if count is Count.OFF:
            return answers
        robots = np.arange(len(requests)) if robots is None else robots
        asked = requests if not (is_along and self.elsewhere) else [None] * len(requests)
        sizes = [count_numbers(asked[robot], self.elsewhere) for robot in robots.tolist()]
        sizes += [count_numbers(answers[robot], self.elsewhere) for robot in robots.tolist()]
        driver = np.full(len(robots), DRIVER)
        if self.tree is not None:
            outwards, driver = self.tree
            for robot in outwards[:0:-1].tolist() if count is Count.GATHER else ():
                sizes[len(robots) + driver[robot]] += sizes[len(robots) + robot]
        sender, receiver = np.concatenate([driver, robots]), np.concatenate([robots, driver])
        self.count(sender, receiver, sizes, is_round=count is Count.ROUND)
        if count in (Count.ALL_REDUCE, Count.GATHER):
            self.ledger = self.ledger.after_all_reduce(0)
        return answers

    def hand_on(self, sent: Sequence[Mapping[int, A]], channel: LossyChannel[A] | None = None) -> list[Mapping[int, A]]:
        """What all receive, by sender, of what each sent, by receiver: a round; what `channel` loses is counted too."""
        messages = by_link(sent)
        links = np.array(list(messages), dtype=np.int64).reshape(-1, 2)
        self.count(links[:, 0], links[:, 1], [count_numbers(value) for value in messages.values()], is_round=True)
        return delivered(messages if channel is None else channel.carry(messages), len(sent))

    def count(
        self, sender: IntArray, receiver: IntArray, numbers: Sequence[int] | IntArray, is_round: bool, level: int = 0
    ) -> None:
        """Count an exchange, without what a worker has itself; equal ones are one object, which the ledger counts."""
        num_bytes = BYTES_PER_NUMBER * np.array(numbers, dtype=np.int64)
        used = (num_bytes > 0) & (sender != receiver)
        exchange = sender[used], receiver[used], num_bytes[used]
        key = np.append(np.concatenate(exchange), level).tobytes()
        traffic = self._traffic.setdefault(key, Traffic(*exchange, level))
        self.ledger = self.ledger.after_exchange(traffic, is_round)


def by_link(sent: Sequence[Mapping[int, A]]) -> dict[tuple[int, int], A]:
    """Messages by (sender, receiver), of what every sender sent by its receiver."""
    return {(robot, to): value for robot, addressed in enumerate(sent) for to, value in addressed.items()}


def delivered(messages: Mapping[tuple[int, int], A], num_robots: int) -> list[Mapping[int, A]]:
    """Messages of every link (sender, receiver) for each of the receivers, by their senders."""
    received: list[dict[int, A]] = [{} for _ in range(num_robots)]
    for (sender, receiver), value in messages.items():
        received[receiver][sender] = value
    return list(received)
