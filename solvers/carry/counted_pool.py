"""Workers whose messages are counted: those to and from the driver, and those between workers."""

import enum
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar, cast

import numpy as np

from pgo_models.graphs.pose_graph import IntArray
from solvers.carry.faults import LossyChannel
from solvers.carry.ledger import DRIVER, Ledger, Traffic
from solvers.carry.messages import (
    Messages,
    count_bytes,
    snapshot_bytes,
    take_snapshot,
)
from solvers.carry.moments import Moments, obey_after
from solvers.carry.process import WorkerPool

Q = TypeVar("Q")
A = TypeVar("A")


class Count(enum.Enum):
    """How an order is counted on the ledger."""

    ROUND = "robots wait for values at the separators"
    ALL_REDUCE = "sums of a few numbers, and what follows from them"
    GATHER = "likewise, of numbers that are not summed up: figures of all poses"
    PIGGYBACKED = "counted with the next round"
    OFF = "measuring, setting up, and collecting the answer are off the ledger"


class CountedPool:
    """A worker pool and its ledger."""

    def __init__(self, workers: WorkerPool, num_robots: int) -> None:
        self.workers = workers
        self.ledger = Ledger(num_robots)
        # Every exchange that was counted, by its content: equal ones share one object.
        self._traffic: dict[bytes, Traffic] = {}
        # Robots without a driver sum along a tree to its root: all of them, parents first, and the
        # parent of each.
        self.tree: tuple[IntArray, IntArray] | None = None
        self.moments = Moments()

    def ask(
        self,
        order: Callable[[Any, Q], A],
        requests: Sequence[Q],
        count: Count,
        robots: IntArray | None = None,
    ) -> list[A]:
        """Answers of all workers to an order, each with its request.

        The ledger counts what `robots`, all unless given, exchange with the driver. Messages to
        other workers are counted when they are exchanged.
        """
        answers = self._obeyed(order, requests)
        if order is take_snapshot:
            self.ledger = self.ledger.after_snapshots(snapshot_bytes(cast(Any, answers)))
        if count is Count.OFF:
            return answers
        robots = np.arange(len(requests)) if robots is None else robots
        self._count_exchange_with_driver(robots, requests, answers, count)
        if count in (Count.ALL_REDUCE, Count.GATHER):
            self.ledger = self.ledger.after_all_reduce(0)
        return answers

    def ask_all(self, order: Callable[[Any, Q], A], request: Q, count: Count) -> list[A]:
        """Answers of all workers to an order with the same request."""
        return self.ask(order, [request] * self.ledger.num_robots, count)

    def _obeyed(self, order: Callable[[Any, Q], A], requests: Sequence[Q]) -> list[A]:
        """Answers of all workers to an order, before which they are told of moments."""
        recall = self.moments.before_order()
        if recall is None:
            return self.workers.ask(order, requests)
        answers = self.workers.ask(partial(obey_after, recall, order), requests)
        self.moments.after_order()
        return answers

    def _count_exchange_with_driver(
        self, robots: IntArray, requests: Sequence[Any], answers: Sequence[Any], count: Count
    ) -> None:
        """Count requests and answers."""
        request_sizes = [count_bytes(requests[a]) for a in robots.tolist()]
        answer_sizes = [count_bytes(answers[a]) for a in robots.tolist()]
        parent = np.full(len(robots), DRIVER)
        if self.tree is not None:
            outwards, parent = self.tree
            if count is Count.GATHER:  # what is not summed up grows on its way to the root
                for robot in outwards[:0:-1].tolist():
                    answer_sizes[parent[robot]] += answer_sizes[robot]
        sender = np.concatenate([parent, robots])
        receiver = np.concatenate([robots, parent])
        sizes = request_sizes + answer_sizes
        self.count(sender, receiver, sizes, is_round=count is Count.ROUND)

    def exchange(
        self, sent: Sequence[Messages[A]], channel: LossyChannel[A] | None = None
    ) -> list[Messages[A]]:
        """Carry out one round between robots: messages by receiver in, messages by sender out.

        Entry a of `sent` is what robot a sends, entry a of the answer what it receives. Messages
        that `channel` loses are counted, too.
        """
        messages = by_link(sent)
        links = np.array(list(messages), dtype=np.int64).reshape(-1, 2)
        sizes = [count_bytes(value) for value in messages.values()]
        self.count(links[:, 0], links[:, 1], sizes, is_round=True)
        arrived = messages if channel is None else channel.carry(messages)
        return delivered(arrived, len(sent))

    def count(
        self,
        sender: IntArray,
        receiver: IntArray,
        sizes: Sequence[int] | IntArray,
        is_round: bool,
    ) -> None:
        """Count an exchange of messages of `sizes` bytes each, (q,).

        Empty messages, and those of a worker to itself, are left out.
        """
        num_bytes = np.array(sizes, dtype=np.int64)
        is_sent = (num_bytes > 0) & (sender != receiver)
        exchange = sender[is_sent], receiver[is_sent], num_bytes[is_sent]
        key = np.concatenate(exchange).tobytes()
        traffic = self._traffic.setdefault(key, Traffic(*exchange))
        after = self.ledger.after_round if is_round else self.ledger.after_messages
        self.ledger = after(traffic)


def by_link(sent: Sequence[Messages[A]]) -> dict[tuple[int, int], A]:
    """Messages by (sender, receiver), of what every sender sends, by receiver."""
    messages = {}
    for sender, addressed in enumerate(sent):
        for receiver, value in addressed.items():
            messages[sender, receiver] = value
    return messages


def delivered(messages: Mapping[tuple[int, int], A], num_robots: int) -> list[Messages[A]]:
    """Messages by sender for every receiver, of messages by (sender, receiver)."""
    received: list[Messages[A]] = [Messages() for _ in range(num_robots)]
    for (sender, receiver), value in messages.items():
        received[receiver][sender] = value
    return received
