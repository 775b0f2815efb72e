"""What crosses the network: rounds, messages and bytes by link."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.pose_graph import IntArray

T = TypeVar("T")

DRIVER = -1  # the number that stands for the driver among senders and receivers
BYTES_PER_NUMBER = 8


@dataclass(frozen=True, eq=False)
class Traffic:
    """Messages of one exchange; the same object may be counted many times.

    Attributes
    ----------
    sender, receiver : (q,)
        Robots, or `DRIVER`.
    num_bytes : (q,)
        Payload of every message: eight bytes a number.

    Examples
    --------
    >>> up = Traffic(sender=np.array([0, 1]), receiver=np.array([DRIVER, DRIVER]), num_bytes=np.array([240, 96]))
    >>> int(up.num_bytes.sum())
    336
    """

    sender: IntArray
    receiver: IntArray
    num_bytes: IntArray

    def __post_init__(self) -> None:
        if not self.sender.shape == self.receiver.shape == self.num_bytes.shape:
            raise SettingError(
                f"senders, receivers and bytes have shapes {self.sender.shape}, {self.receiver.shape} and "
                f"{self.num_bytes.shape}; give one of each for every message"
            )


@dataclass(frozen=True, eq=False)
class Ledger:
    """Account of a distributed run.

    A round is one exchange that robots wait for: between neighbours, or to the driver and back. An all-reduce, by which
    all robots come to know a sum of a few numbers, is counted apart.

    Attributes
    ----------
    num_robots : int
    rounds, all_reduces : int
    all_reduce_bytes : int
        Payload of all all-reduces, once up and once down for every robot.
    counted : tuple of (Traffic, int)
        Exchanges, and how often each took place.

    Examples
    --------
    >>> import numpy as np
    >>> both_ways = Traffic(np.array([0, 1]), np.array([1, 0]), np.array([80, 160]))
    >>> ledger = Ledger(2).after_round(both_ways).after_round(both_ways)
    >>> ledger
    Ledger(2 robots, 2 rounds, 4 messages, 480 bytes)
    >>> ledger.bytes_sent
    array([160, 320])
    """

    num_robots: int
    rounds: int = 0
    all_reduces: int = 0
    all_reduce_bytes: int = 0
    counted: tuple[tuple[Traffic, int], ...] = ()

    def after_round(self, *exchanged: Traffic) -> Ledger:
        """Return the ledger after one more round with these exchanges."""
        counted = self.counted
        for traffic in exchanged:
            known = next((p for p, (other, _) in enumerate(counted) if other is traffic), None)
            if known is None:
                counted = (*counted, (traffic, 1))
            else:
                counted = (*counted[:known], (traffic, counted[known][1] + 1), *counted[known + 1 :])
        return replace(self, rounds=self.rounds + 1, counted=counted)

    def after_exchange(self, traffic: Traffic, is_round: bool) -> Ledger:
        """Return the ledger after an exchange; one that is no round is part of the next round or of an all-reduce."""
        after = self.after_round(traffic)
        return after if is_round else replace(after, rounds=self.rounds)

    def after_all_reduce(self, count: int) -> Ledger:
        """Return the ledger after one more all-reduce of `count` numbers."""
        num_bytes = 2 * BYTES_PER_NUMBER * count * self.num_robots
        return replace(self, all_reduces=self.all_reduces + 1, all_reduce_bytes=self.all_reduce_bytes + num_bytes)

    @property
    def messages(self) -> int:
        """Messages in all, all-reduces left out."""
        return sum(times * len(traffic.sender) for traffic, times in self.counted)

    @property
    def num_bytes(self) -> int:
        """Payload in all, all-reduces left out."""
        return int(self.by_link()[3].sum())

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

    def _per_robot(self, robot: IntArray, num_bytes: IntArray) -> IntArray:
        of_robots = robot != DRIVER
        total = np.bincount(robot[of_robots], weights=num_bytes[of_robots], minlength=self.num_robots)
        return total.astype(np.int64)

    def __repr__(self) -> str:
        reduced = f", {self.all_reduces} all-reduces" if self.all_reduces else ""
        return (
            f"Ledger({self.num_robots} robots, {self.rounds} rounds{reduced}, {self.messages} messages, "
            f"{self.num_bytes} bytes)"
        )


@dataclass(frozen=True)
class Faults:
    """What goes wrong between robots, for study; the same seed gives the same faults.

    `Pipeline(faults=..)` runs its CONSENSUS stage with them: robots then do not wait for each other.

    Attributes
    ----------
    loss : float
        Probability that a message is lost.
    max_delay : int
        A message arrives 0 to this many rounds late, each equally likely; one that a later one overtook is dropped.
    silent_robot : int, optional
        A robot that neither sends nor receives ..
    silent_from, silent_rounds : int
        .. from this round on, for so many rounds.
    seed : int

    Raises
    ------
    SettingError
        When a setting is out of its range.

    Examples
    --------
    >>> import numpy as np
    >>> from pgo_models import grid, partition
    >>> from solvers.pipeline import Pipeline, solve
    >>> from solvers.soc import SOC
    >>> graph = grid(np.random.default_rng(0))
    >>> robots = partition(graph, 3)
    >>> pipeline = Pipeline(soc=SOC(robots=robots, tolerance=2e-3), faults=Faults(loss=0.2, seed=1))
    >>> solve(graph, pipeline, robots=robots).is_certified
    True
    """

    loss: float = 0.0
    max_delay: int = 0
    silent_robot: int | None = None
    silent_from: int = 0
    silent_rounds: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.loss < 1:
            raise SettingError(f"loss must be in [0, 1), got {self.loss}")
        for name in ("max_delay", "silent_robot", "silent_from", "silent_rounds"):
            if (getattr(self, name) or 0) < 0:
                raise SettingError(f"{name} must not be negative, got {getattr(self, name)}")

    def is_silent(self, robot: int, number: int) -> bool:
        """Whether a robot is cut off in a round."""
        since = number - self.silent_from
        return robot == self.silent_robot and 0 <= since < self.silent_rounds


class Post(Generic[T]):
    """Carries messages between robots, with faults; the first round is 0."""

    def __init__(self, faults: Faults) -> None:
        self.faults = faults
        self._rng = np.random.default_rng(faults.seed)
        self._number = 0
        self._under_way: list[tuple[int, int, tuple[int, int], T]] = []
        self._newest: dict[tuple[int, int], int] = {}

    def carry(self, letters: Mapping[tuple[int, int], T]) -> dict[tuple[int, int], T]:
        """Take what every (sender, receiver) sends in this round; what arrives in it."""
        faults, number = self.faults, self._number
        for link in sorted(letters):
            is_lost = self._rng.random() < faults.loss
            delay = int(self._rng.integers(faults.max_delay + 1))
            if not is_lost and not any(faults.is_silent(robot, number) for robot in link):
                self._under_way.append((number + delay, number, link, letters[link]))
        arriving = [letter for letter in self._under_way if letter[0] <= number]
        self._under_way = [letter for letter in self._under_way if letter[0] > number]
        arrived: dict[tuple[int, int], T] = {}
        for _, sent, link, letter in sorted(arriving, key=lambda entry: entry[1]):
            if sent >= self._newest.get(link, 0) and not faults.is_silent(link[1], number):
                arrived[link], self._newest[link] = letter, sent
        self._number += 1
        return arrived
