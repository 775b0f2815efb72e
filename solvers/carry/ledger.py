"""Account of what crosses the network: rounds, messages, and bytes by link."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.summaries import Summarised
from solvers.carry.registry import record

DRIVER = -1  # the driver's number as a sender or receiver; robots are 0, 1, ..
BYTES_PER_NUMBER = 8  # of a double


@record("Traffic")
@dataclass(frozen=True, eq=False)
class Traffic(Summarised):
    """Messages of one exchange; pass the same object each time the exchange is repeated.

    Parameters
    ----------
    sender : IntArray, (q,)
        Robot that sends a message, or `DRIVER`.
    receiver : IntArray, (q,)
        Robot that receives it, or `DRIVER`.
    num_bytes : IntArray, (q,)
        Payload of every message, eight bytes a number.
    """

    sender: IntArray
    receiver: IntArray
    num_bytes: IntArray

    def __post_init__(self) -> None:
        if not self.sender.shape == self.receiver.shape == self.num_bytes.shape:
            shapes = f"{self.sender.shape}, {self.receiver.shape} and {self.num_bytes.shape}"
            raise SettingError(
                f"senders, receivers and bytes have shapes {shapes}; "
                "give one of each for every message"
            )


@record("Ledger")
@dataclass(frozen=True, eq=False)
class Ledger(Summarised):
    """Communication of a distributed run; a solve by robots returns it as `Solution.ledger`.

    A round is one exchange that robots wait for: between neighbouring robots, or from the robots to
    the driver, the process that coordinates them, and back. An all-reduce, after which every robot
    knows the sum of a few numbers, is counted in `all_reduces`, not in `rounds`. Where the driver
    does the summing, its messages are in `counted` like any others; elsewhere no single messages
    are known, and only their payload is added to `all_reduce_bytes`.

    Parameters
    ----------
    num_robots : int
        Number of robots.
    rounds : int
        Number of rounds.
    all_reduces : int
        Number of all-reduces.
    all_reduce_bytes : int
        Payload in bytes of the all-reduces that have no messages in `counted`: what every robot
        sends, and the sums that it receives.
    counted : tuple of (Traffic, int)
        Exchanges, and how often each took place.
    snapshot_bytes : int
        Bytes of the snapshots for recovery and checkpoints, which robots send to the driver's
        process. They are not part of an algorithm's communication, and are in none of the other
        figures.
    graph_bytes : int
        Bytes of a list of all edges, each with a relative pose of d (d + 1) / 2 numbers and the two
        precisions of F: what it would take to gather the graph, without information matrices. 0
        where no process knows it.

    Examples
    --------
    >>> import pgo_models as pgo, solvers
    >>> ledger = solvers.solve(pgo.load("circle"), robots=2).ledger
    >>> ledger.num_robots, ledger.rounds > 0, ledger.num_bytes > 0
    (2, True, True)
    """

    num_robots: int
    rounds: int = 0
    all_reduces: int = 0
    all_reduce_bytes: int = 0
    counted: tuple[tuple[Traffic, int], ...] = ()
    snapshot_bytes: int = 0
    graph_bytes: int = 0

    def after_round(self, *exchanged: Traffic) -> Ledger:
        """Return the ledger after one more round with these exchanges.

        Parameters
        ----------
        *exchanged : Traffic
            Messages of the round.

        Returns
        -------
        Ledger
            The ledger with the round and its messages.
        """
        return replace(self.after_messages(*exchanged), rounds=self.rounds + 1)

    def after_messages(self, *exchanged: Traffic) -> Ledger:
        """Return the ledger after exchanges whose round or all-reduce another call counts.

        Parameters
        ----------
        *exchanged : Traffic
            Messages of the exchanges.

        Returns
        -------
        Ledger
            The ledger with the messages.
        """
        # Traffic is hashed by identity: equal but distinct objects get entries of their own, which
        # leaves all totals as they are.
        counted = dict(self.counted)
        for traffic in exchanged:
            counted[traffic] = counted.get(traffic, 0) + 1
        return replace(self, counted=tuple(counted.items()))

    def after_all_reduce(self, count: int) -> Ledger:
        """Return the ledger after one more all-reduce.

        Parameters
        ----------
        count : int
            How many numbers are summed up; 0 if their messages are counted as an exchange.

        Returns
        -------
        Ledger
            The ledger with the all-reduce and its bytes.
        """
        num_bytes = 2 * BYTES_PER_NUMBER * count * self.num_robots
        return replace(
            self,
            all_reduces=self.all_reduces + 1,
            all_reduce_bytes=self.all_reduce_bytes + num_bytes,
        )

    def after_snapshots(self, num_bytes: int) -> Ledger:
        """Return the ledger after snapshots.

        Parameters
        ----------
        num_bytes : int
            Payload of the snapshots in bytes.

        Returns
        -------
        Ledger
            The ledger with these bytes.
        """
        return replace(self, snapshot_bytes=self.snapshot_bytes + num_bytes)

    def joined(self, other: Ledger) -> Ledger:
        """Return the account of this run and another together.

        Parameters
        ----------
        other : Ledger
            Account of another run; of the robots of both, those with the same number are one.

        Returns
        -------
        Ledger
            Sums of both accounts.
        """
        counted = dict(self.counted)
        for traffic, times in other.counted:
            counted[traffic] = counted.get(traffic, 0) + times
        return Ledger(
            max(self.num_robots, other.num_robots),
            rounds=self.rounds + other.rounds,
            all_reduces=self.all_reduces + other.all_reduces,
            all_reduce_bytes=self.all_reduce_bytes + other.all_reduce_bytes,
            counted=tuple(counted.items()),
            snapshot_bytes=self.snapshot_bytes + other.snapshot_bytes,
            graph_bytes=max(self.graph_bytes, other.graph_bytes),
        )

    @property
    def messages(self) -> int:
        """Number of messages in `counted`.

        Messages of all-reduces that the driver carries out are among them. Other all-reduces add
        none; their payload is in `all_reduce_bytes`.
        """
        return sum(times * len(traffic.sender) for traffic, times in self.counted)

    @property
    def num_bytes(self) -> int:
        """Payload of the messages in `counted`, in bytes."""
        return sum(times * int(traffic.num_bytes.sum()) for traffic, times in self.counted)

    @property
    def bytes_sent(self) -> IntArray:
        """Bytes that every robot sent, (num_robots,)."""
        sender, _, _, num_bytes = self.by_link()
        return self._per_robot(sender, num_bytes)

    @property
    def bytes_received(self) -> IntArray:
        """Bytes that every robot received, (num_robots,)."""
        _, receiver, _, num_bytes = self.by_link()
        return self._per_robot(receiver, num_bytes)

    def by_link(self) -> tuple[IntArray, IntArray, IntArray, IntArray]:
        """Sum up messages and bytes of every link that was used.

        Returns
        -------
        sender, receiver : ndarray, (links,)
            Ends of the links, in ascending order; -1 stands for the driver.
        messages : ndarray, (links,)
            Number of messages.
        num_bytes : ndarray, (links,)
            Payload in bytes.
        """
        if not self.counted:
            none = np.zeros(0, dtype=np.int64)
            return none, none, none, none
        times = np.concatenate(
            [np.full(len(traffic.sender), count) for traffic, count in self.counted]
        )
        sender = np.concatenate([traffic.sender for traffic, _ in self.counted])
        receiver = np.concatenate([traffic.receiver for traffic, _ in self.counted])
        num_bytes = np.concatenate([traffic.num_bytes for traffic, _ in self.counted]) * times
        # A link as one number, in which the driver counts as 0 and robot a as a + 1.
        num_parties = self.num_robots + 1
        link_numbers = (sender + 1) * num_parties + receiver + 1
        link, position = np.unique(link_numbers, return_inverse=True)
        messages = np.bincount(position, weights=times, minlength=len(link)).astype(np.int64)
        payload = np.bincount(position, weights=num_bytes, minlength=len(link)).astype(np.int64)
        return link // num_parties - 1, link % num_parties - 1, messages, payload

    def facts(self) -> list[tuple[str, str]]:
        """List labels and figures as they are printed.

        Returns
        -------
        list of (str, str)
            Label and text of every line.
        """
        both_ways = self.bytes_sent + self.bytes_received
        of_one = f"of one robot {both_ways.min():,} to {both_ways.max():,}"
        counts = f"{self.rounds} rounds, {self.all_reduces} all-reduces, {self.messages} messages"
        sent = f"{self.num_bytes:,}"
        if self.graph_bytes:
            sent += f", {self.num_bytes / self.graph_bytes:.2g} times all edges"
        facts = [("network", counts), ("bytes", f"{sent}; {of_one}")]
        if self.snapshot_bytes:
            target = "to the driver's process, interior poses among them"
            facts.append(("snapshots", f"{self.snapshot_bytes:,} bytes {target}"))
        return facts

    def _per_robot(self, robot: IntArray, num_bytes: IntArray) -> IntArray:
        """Sum of `num_bytes` for every robot, (num_robots,), without the driver."""
        is_robot = robot != DRIVER
        total = np.bincount(robot[is_robot], weights=num_bytes[is_robot], minlength=self.num_robots)
        return total.astype(np.int64)

    def __repr__(self) -> str:
        reduced = f", {self.all_reduces} all-reduces" if self.all_reduces else ""
        sent = f"{self.messages} messages, {self.num_bytes} bytes"
        return f"Ledger({self.num_robots} robots, {self.rounds} rounds{reduced}, {sent})"


NOTHING_SENT = Ledger(1)
