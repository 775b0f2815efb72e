"""What crosses the network: rounds, messages and bytes by link."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.graphs.pose_graph import IntArray

DRIVER = -1  # the number that stands for the driver among senders and receivers
BYTES_PER_NUMBER = 8


@dataclass(frozen=True, eq=False)
class Traffic:
    """Messages of one exchange; the same object may be counted many times."""

    # sender, receiver: (q,); robots, or `DRIVER`.
    sender: IntArray
    receiver: IntArray
    num_bytes: IntArray  # (q,): payload of every message: eight bytes a number
    level: int = 0  # of a tree of robots, 1 at its leaves; 0 between driver and robots, or neighbours

    def __post_init__(self) -> None:
        if not self.sender.shape == self.receiver.shape == self.num_bytes.shape:
            shapes = f"{self.sender.shape}, {self.receiver.shape} and {self.num_bytes.shape}"
            raise SettingError(f"senders, receivers and bytes have shapes {shapes}; give one of each for every message")


@dataclass(frozen=True, eq=False)
class Ledger:
    """Account of a distributed run.

    A round is one exchange that robots wait for: between neighbours, or to the driver and back, level by level where
    there is a tree of robots. An all-reduce, by which all come to know a sum of a few numbers, is counted apart.
    """

    num_robots: int
    rounds: int = 0
    all_reduces: int = 0
    all_reduce_bytes: int = 0  # of all-reduces that no messages are counted of, up and down for every robot
    counted: tuple[tuple[Traffic, int], ...] = ()  # exchanges, and how often each took place

    def after_round(self, *exchanged: Traffic) -> Ledger:
        """Return the ledger after one more round with these exchanges."""
        counted = dict(self.counted)  # by the object: one of equal content is another
        for traffic in exchanged:
            counted[traffic] = counted.get(traffic, 0) + 1
        return replace(self, rounds=self.rounds + 1, counted=tuple(counted.items()))

    def after_exchange(self, traffic: Traffic, is_round: bool) -> Ledger:
        """Return the ledger after an exchange; one that is no round is part of the next round or of an all-reduce."""
        after = self.after_round(traffic)
        return after if is_round else replace(after, rounds=self.rounds)

    def after_all_reduce(self, count: int) -> Ledger:
        """Return the ledger after one more all-reduce of `count` numbers."""
        num_bytes = 2 * BYTES_PER_NUMBER * count * self.num_robots
        return replace(self, all_reduces=self.all_reduces + 1, all_reduce_bytes=self.all_reduce_bytes + num_bytes)

    def joined(self, other: Ledger) -> Ledger:
        """Return the account of this run and another of as many robots."""
        counted = dict(self.counted)
        for traffic, times in other.counted:
            counted[traffic] = counted.get(traffic, 0) + times
        sums = self.rounds + other.rounds, self.all_reduces + other.all_reduces
        return Ledger(self.num_robots, *sums, self.all_reduce_bytes + other.all_reduce_bytes, tuple(counted.items()))

    @property
    def messages(self) -> int:
        """Messages in all, with those by which a driver sums; of other all-reduces `all_reduce_bytes` are counted."""
        return sum(times * len(traffic.sender) for traffic, times in self.counted)

    @property
    def num_bytes(self) -> int:
        """Payload of all messages."""
        return int(self.bytes_by_level.sum())

    @property
    def bytes_by_level(self) -> IntArray:
        """Payload on every level of a tree of robots, (levels + 1,); first what is on none."""
        level = [traffic.level for traffic, _ in self.counted]
        payload = [times * int(traffic.num_bytes.sum()) for traffic, times in self.counted]
        return np.bincount(level, weights=payload, minlength=1).astype(np.int64)

    @property
    def bytes_sent(self) -> IntArray:
        """Payload that every robot sent, (num_robots,)."""
        sender, _, _, num_bytes = self.by_link()
        return self._per_robot(sender, num_bytes)

    @property
    def bytes_received(self) -> IntArray:
        """Payload that every robot received, (num_robots,)."""
        _, receiver, _, num_bytes = self.by_link()
        return self._per_robot(receiver, num_bytes)

    def by_link(self) -> tuple[IntArray, IntArray, IntArray, IntArray]:
        """Sender, receiver, messages and bytes of every link that was used, each (links,), in order of the links."""
        if not self.counted:
            none = np.zeros(0, dtype=np.int64)
            return none, none, none, none
        times = np.concatenate([np.full(len(traffic.sender), count) for traffic, count in self.counted])
        sender = np.concatenate([traffic.sender for traffic, _ in self.counted])
        receiver = np.concatenate([traffic.receiver for traffic, _ in self.counted])
        num_bytes = np.concatenate([traffic.num_bytes for traffic, _ in self.counted]) * times
        side = self.num_robots + 1  # the driver is -1
        link, position = np.unique((sender + 1) * side + receiver + 1, return_inverse=True)
        messages = np.bincount(position, weights=times, minlength=len(link)).astype(np.int64)
        payload = np.bincount(position, weights=num_bytes, minlength=len(link)).astype(np.int64)
        return link // side - 1, link % side - 1, messages, payload

    def facts(self) -> list[tuple[str, str]]:
        """Labels and figures, as they are printed."""
        both_ways = self.bytes_sent + self.bytes_received
        return [
            ("network", f"{self.rounds} rounds, {self.all_reduces} all-reduces, {self.messages} messages"),
            ("bytes", f"{self.num_bytes:,}; of one robot {both_ways.min():,} to {both_ways.max():,}"),
        ]

    def _per_robot(self, robot: IntArray, num_bytes: IntArray) -> IntArray:
        of_robots = robot != DRIVER
        total = np.bincount(robot[of_robots], weights=num_bytes[of_robots], minlength=self.num_robots)
        return total.astype(np.int64)

    def __repr__(self) -> str:
        reduced = f", {self.all_reduces} all-reduces" if self.all_reduces else ""
        sent = f"{self.messages} messages, {self.num_bytes} bytes"
        return f"Ledger({self.num_robots} robots, {self.rounds} rounds{reduced}, {sent})"
