"""The session of a robot with its team: who is there, who speaks, and what is to be sent.

It has no mathematics. It is given what arrives (`receive`) and the time (`tick`), and hands out
what is to be sent (`outbox`). Messages may be lost, late, repeated, or come in any order. What they
say is for a way to solve together: `SharedMap` or `DrivenTeam`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from pgo_models.errors import PGOError
from solvers.carry.wire import MOST_BYTES, WireError
from solvers.team.beside import OTHER_PROCESS, Beside
from solvers.team.messages import Hello, Priority, Relayed
from solvers.team.speakers import Reading, Speakers, Word, read

PATIENCE = 10.0  # seconds without a sign of a robot, after which it counts as absent
RETRY = 1.0  # seconds after which a message without an answer is sent again, at first
# Share of its patience after which a robot says again that it is there, where it says nothing else.
_SHARE_OF_PATIENCE = 0.3
# Bytes of a message, not compressed, that are written or read in a call; more are beside the calls.
_IN_A_CALL = 1 << 16
_MOST_STRANGERS = 8  # sentences on messages of nobody in the team


class Message(NamedTuple):
    """A message to be sent: the robot that it is for, its bytes, and what goes first."""

    to: str
    data: bytes
    priority: Priority


@dataclass(frozen=True, eq=False)
class TeamLedger:
    """Bytes that a robot has handed out for others and received from them, by robot.

    `messages` counts those handed out, `dropped_by` those received that could not be read, by the
    robot that sealed them, or "" where none of the team did.
    """

    sent: Mapping[str, int] = field(default_factory=dict)
    received: Mapping[str, int] = field(default_factory=dict)
    messages: int = 0
    dropped_by: Mapping[str, int] = field(default_factory=dict)

    @property
    def dropped(self) -> int:
        """How many messages were dropped."""
        return sum(self.dropped_by.values())

    def after_sending(self, message: Message) -> TeamLedger:
        """Return the ledger after one more message."""
        sent = _with_more(self.sent, message.to, len(message.data))
        return replace(self, sent=sent, messages=self.messages + 1)

    def after_receiving(self, robot: str, data: bytes) -> TeamLedger:
        """Return the ledger after a message of another robot."""
        return replace(self, received=_with_more(self.received, robot, len(data)))

    def after_dropping(self, robot: str) -> TeamLedger:
        """Return the ledger after bytes that could not be read, which a robot has sealed, or ""."""
        return replace(self, dropped_by=_with_more(self.dropped_by, robot, 1))


def _with_more(counts: Mapping[str, int], name: str, more: int) -> Mapping[str, int]:
    return {**counts, name: counts.get(name, 0) + more}


class Way(Protocol):
    """A way to solve together."""

    @property
    def is_settled(self) -> bool:
        """Whether nothing is to be done."""

    @property
    def problems(self) -> list[str]:
        """What is wrong, a sentence each."""

    def greeting(self, to: str = "") -> object:
        """The message that tells others that this robot is there; short where one robot knows."""

    def take(self, sender: str, message: object, is_latest: bool) -> None:
        """Take a message; the latest one of its sender, or one that others have overtaken."""

    def tick(self, awake: tuple[str, ...]) -> None:
        """Do what is due, with the robots that are awake."""


class Session:
    """The session of a robot with the others of its team, by their names.

    `now` is the time of the last call, `began` that of the first one.
    """

    def __init__(
        self,
        name: str,
        team: tuple[str, ...],
        key: bytes,
        patience: float,
        retry: float,
    ) -> None:
        self.name = name
        self.team = team
        self.patience = patience
        self.retry = retry
        self.now = -np.inf
        self.ledger = TeamLedger()
        self.beside = Beside()
        self.way: Way
        self._key = key
        self._began: float | None = None
        self._last_heard: dict[str, float] = {}
        self._heard_directly: dict[str, float] = {}
        self._reach: dict[str, tuple[str, ...]] = {}  # whom others hear, as they say
        self._greeted: dict[str, tuple[float, int]] = {}  # when, and how often without an answer
        self._out: list[Message] = []
        self._speakers = Speakers(name, patience)
        self._strangers: dict[str, None] = {}  # sentences on messages of nobody in the team
        OTHER_PROCESS.start()

    @property
    def heard(self) -> tuple[str, ...]:
        """Robots of the team that have spoken to this one."""
        return tuple(self._last_heard)

    @property
    def hears(self) -> tuple[str, ...]:
        """Robots of the team that were heard of lately, not through others."""
        oldest = self.now - self.patience
        return tuple(name for name, when in self._heard_directly.items() if when >= oldest)

    @property
    def is_settled(self) -> bool:
        """Whether nothing is to be solved or to be sent."""
        return self.way.is_settled and not self._out and not self.beside.num_in_thread

    @property
    def problems(self) -> list[str]:
        """What is wrong with names, keys or versions of the team, a sentence each."""
        twins = [f"two robots are called {name}; give each its own name" for name in self.twins]
        return [*twins, *self._strangers, *self.way.problems]

    # Bytes

    def outbox(self) -> list[Message]:
        """Hand out what is to be sent, what others wait for first."""
        self.beside.act()
        messages = sorted(self._out, key=lambda message: message.priority)
        self._out = []
        for message in messages:
            self.ledger = self.ledger.after_sending(message)
        return messages

    def receive(self, data: bytes, now: float) -> None:
        """Take what has arrived: in any order, and any number of times."""
        self.now = now
        self.beside.act()
        self._take(data, is_direct=True)

    def _take(self, data: bytes, *, is_direct: bool) -> None:
        """Take a message that has come from its sender, or through a third robot.

        A long one is read beside the calls.
        """
        if len(data) <= _IN_A_CALL:
            reading = self._read(data, _IN_A_CALL)
            if not reading.is_long:
                self._take_read(data, is_direct, reading)
                return
        if self.beside.bytes_in_thread + len(data) > MOST_BYTES:
            self._drop("", "")
            return
        self.beside.begin_in_thread(
            lambda: self._read_long(data), partial(self._take_long, data, is_direct), len(data)
        )

    def _read(self, data: bytes, most_bytes: int) -> Reading:
        return read(self._key, self.name, self.team, self._speakers.ends_at, data, most_bytes)

    def _read_long(self, data: bytes) -> Reading:
        """Read a message, in the thread beside the calls.

        Those that wait to be taken, and this one, have `MOST_BYTES` at most.
        """
        reading = self._read(data, MOST_BYTES - (self.beside.num_read - self.beside.num_taken))
        self.beside.num_read += reading.num_bytes
        return reading

    def _take_long(self, data: bytes, is_direct: bool, reading: Reading | PGOError) -> None:
        if isinstance(reading, PGOError):
            self._drop("", "")
            return
        self.beside.num_taken += reading.num_bytes
        self._take_read(data, is_direct, reading)

    def _take_read(self, data: bytes, is_direct: bool, reading: Reading) -> None:
        """Take a message that was read."""
        envelope, message = reading.envelope, reading.message
        if envelope is None:
            self._drop("", reading.sentence)
            return
        sender = envelope.sender
        if message is None:
            self._drop(sender, "")
            return
        is_relayed_twice = isinstance(message, Relayed) and not is_direct
        word = self._speakers.word_of(envelope, self.now)
        if word is Word.REPEATED or is_relayed_twice:
            self._drop(sender, "")
            return
        if is_direct:
            self.ledger = self.ledger.after_receiving(sender, data)
        if word is Word.UNPROVEN:  # answered by a message that does name the boot of the other
            self._send(sender, self.way.greeting(), Priority.HELLO, envelope.boot)
            return
        self._last_heard[sender] = self.now
        if is_direct:
            self._heard_directly[sender] = self.now
        if isinstance(message, Relayed):
            self._relay(message)
            return
        self._speakers.twins.update(getattr(message, "twins", ()))
        if isinstance(message, Hello) and word is Word.NEW:
            self._reach[sender] = message.hears
        try:
            self.way.take(sender, message, word is Word.NEW)
        except WireError:
            self.ledger = self.ledger.after_dropping(sender)

    def _relay(self, message: Relayed) -> None:
        """Take what has come through a third robot, or pass it on."""
        if message.receiver == self.name:
            self._take(message.data.tobytes(), is_direct=False)
        elif message.receiver in self.hears:
            self.send(message.receiver, message, Priority.URGENT)

    def _drop(self, sender: str, sentence: str) -> None:
        """Count what is dropped, and remember a sentence on why."""
        self.ledger = self.ledger.after_dropping(sender)
        if sentence and len(self._strangers) < _MOST_STRANGERS:
            self._strangers[sentence] = None

    # Who is there

    def tick(self, now: float) -> None:
        """Do what is due: say hello, and what the way to solve together has to do."""
        self.now = now
        self.beside.act()
        if self._began is None:
            self._began = now
        awake = tuple(name for name in self.team if self.is_awake(name))
        self.way.tick(awake)
        for name in self.team:
            if name != self.name and self._is_greeted(name, name in awake):
                self.say_hello(name)

    def is_awake(self, name: str) -> bool:
        """Whether a robot was heard of lately, or is this one."""
        return name == self.name or self.silence_of(name) <= self.patience

    def silence_of(self, name: str) -> float:
        """Seconds since a robot was heard of."""
        return float(self.now - self._last_heard.get(name, -np.inf))

    def _is_greeted(self, name: str, is_awake: bool) -> bool:
        """Whether it is time to say hello to a robot: at first often to those not awake."""
        when, num_sent = self._greeted.get(name, (-np.inf, 0))
        often = _SHARE_OF_PATIENCE * self.patience
        if self._third_to(name) is not None:  # two ways to it, and each may lose the greeting
            often = min(often, self.retry)
        pause = often if is_awake else min(self.pause(num_sent), often)
        is_due = self.now - when >= pause
        if is_due:
            self._greeted[name] = (self.now, 0 if is_awake else num_sent + 1)
        return is_due

    # What a way to solve together needs

    @property
    def twins(self) -> tuple[str, ...]:
        """Names that two robots have."""
        return tuple(sorted(self._speakers.twins))

    def boot_of(self, robot: str) -> bytes:
        """The boot of another robot."""
        return self._speakers.boot_of(robot)

    def is_complete(self, members: Collection[str]) -> bool:
        """Whether these are the whole team, or the others were waited for."""
        assert self._began is not None
        return len(members) == len(self.team) or self.now - self._began >= self.patience

    def pause(self, num_sent: int) -> float:
        """Seconds until a message that was sent so often, and not answered, is sent again.

        They double, up to the patience.
        """
        return float(min(self.retry * 2.0 ** (num_sent - 1), max(self.patience, self.retry)))

    def say_hello(self, to: str) -> None:
        """Tell a robot that this one is there."""
        self.send(to, self.way.greeting(to), Priority.HELLO)

    def send(self, to: str, message: object, priority: Priority) -> None:
        """Send a message to a robot."""
        if isinstance(message, type(self.way.greeting())):
            _, num_sent = self._greeted.get(to, (self.now, 0))
            self._greeted[to] = (self.now, num_sent)
        self._send(to, message, priority, self._speakers.boot_of(to))

    def _send(self, to: str, message: object, priority: Priority, boot: bytes) -> None:
        """Send a message to a run of a robot; a long one is sealed beside the calls."""
        writing = self._speakers.addressed(to, message, boot, self.now)
        seal = partial(writing.sealed, self._key)
        if len(writing.plain) <= _IN_A_CALL:
            self._post(to, priority, seal())
        else:
            self.beside.begin_in_thread(seal, partial(self._post_long, to, priority))

    def _post_long(self, to: str, priority: Priority, data: bytes | PGOError) -> None:
        if not isinstance(data, PGOError):
            self._post(to, priority, data)

    def _post(self, to: str, priority: Priority, data: bytes) -> None:
        """Put a sealed message with those that are handed out, or send it through a third robot."""
        third = self._third_to(to)
        if third is None:
            self._out.append(Message(to, data, priority))
        else:
            self.send(third, Relayed(to, np.frombuffer(data, np.uint8)), priority)

    def _third_to(self, to: str) -> str | None:
        """A robot that hears one that this one has not heard for the patience; None if it has."""
        hears = self.hears
        if to in hears or self._began is None or self.now - self._began < self.patience:
            return None
        return next((name for name in hears if to in self._reach.get(name, ())), None)
