"""Who speaks: what a message proves beside the key that seals it, and what two runs of a robot are.

The key says that a robot of the team made a message, not when. So every run of a robot draws a
number, its boot, and a message names the boot of its sender and that of its receiver, as the sender
has heard it. A message is of this mission if it names the boot of its receiver, which nobody could
know before; one that does not is answered by a greeting, and believed in nothing. Messages of a run
are numbered, and each number counts once. A run is followed by another one, and comes back where it
speaks on and that one is silent: a late message of an earlier run does not end one that lives.
Where both know both boots, these and the names are in the seal alone; where there were two runs of
a name, they are sent once in each patience, too, which tells the others of that name who is spoken
to.
"""

from __future__ import annotations

import enum
import math
import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from solvers.carry.serialization import serialize
from solvers.carry.wire import (
    MARK,
    WireError,
    deflated,
    from_plain,
    hint_of,
    implied_ends,
    inflated,
    leb128,
    opened,
    opened_between,
    packed,
    read_leb128,
    sealed,
    sealed_between,
)
from solvers.team.messages import check_message
from solvers.team.news import News

_BOOT_BYTES = 8
NO_BOOT = bytes(_BOOT_BYTES)  # before another robot was heard
_OTHER = b"O"  # begins content that is no News, which begins with another byte
_WINDOW = 4096  # a message that comes later than so many after it counts as repeated


@dataclass(frozen=True)
class Envelope:
    """A message as bytes, and who it is from and to: names, boots, and its number in the run.

    `receiver_boot` is that of its run, or none before the sender has heard it.
    """

    sender: str
    receiver: str
    boot: bytes
    receiver_boot: bytes
    number: int
    content: bytes

    def plain(self, most_bytes: int) -> bytes | None:
        """The content, not compressed; None for more than so many bytes."""
        if self.content[:1] == _OTHER:
            return inflated(self.content[1:], most_bytes)
        return self.content if len(self.content) <= most_bytes else None

    def message_of(self, plain: bytes) -> Any:  # noqa: ANN401 - a message of any kind
        """The message of the plain content; a WireError for bytes that are none."""
        if self.content[:1] == _OTHER:
            return from_plain(plain, object)
        return News.from_bytes(plain, self.sender, self.receiver)

    @property
    def ends(self) -> bytes:
        """What stands for the two runs that it goes from and to."""
        return implied_ends(replace(self, number=0, content=b"").as_bytes())

    def as_bytes(self) -> bytes:
        """Bytes of which `from_bytes` makes the envelope."""
        parts = [self.boot, self.receiver_boot, leb128(self.number)]
        for name in (self.sender.encode("utf-8"), self.receiver.encode("utf-8")):
            parts += [leb128(len(name)), name]
        return b"".join([*parts, self.content])

    @classmethod
    def from_bytes(cls, data: bytes) -> Envelope:
        """Return the envelope that bytes are; a WireError for others."""
        boot = data[:_BOOT_BYTES]
        receiver_boot = data[_BOOT_BYTES : 2 * _BOOT_BYTES]
        names = []
        try:
            number, begins = read_leb128(data, 2 * _BOOT_BYTES)
            for _ in range(2):
                length, begins = read_leb128(data, begins)
                names.append(data[begins : begins + length].decode("utf-8"))
                begins += length
        except (IndexError, ValueError) as error:
            raise WireError(f"a message without addresses: {error}") from error
        sender, receiver = names
        return cls(sender, receiver, boot, receiver_boot, number, data[begins:])


class Writing(NamedTuple):
    """A message that is to be sent: its address, its plain content, and how that is packed.

    `is_short` says that the seal alone has the address.
    """

    address: Envelope
    is_news: bool
    plain: bytes
    is_short: bool

    def sealed(self, key: bytes) -> bytes:
        """Bytes of the message, compressed and sealed."""
        content = self.plain if self.is_news else _OTHER + deflated(self.plain)
        if self.is_short:
            number = leb128(self.address.number)
            return sealed_between(key, self.address.ends, number + content)
        return sealed(key, replace(self.address, content=content).as_bytes())


class Ends(NamedTuple):
    """An address without a number and content, and what stands for it in seals."""

    address: Envelope
    ends: bytes


class Reading(NamedTuple):
    """What has arrived: who has sealed it, and the message, or None and why it is dropped.

    `is_long` says that the message was not read, as it has more than so many bytes; `num_bytes` are
    those of its plain content.
    """

    envelope: Envelope | None = None
    message: Any = None
    sentence: str = ""
    is_long: bool = False
    num_bytes: int = 0


def read(
    key: bytes,
    name: str,
    team: tuple[str, ...],
    ends_at: Callable[[int], Sequence[Ends]],
    data: bytes,
    most_bytes: int,
) -> Reading:
    """A message to the robot `name` of the team, of so many bytes at most.

    `ends_at` has the runs that speak to this one in messages with a hint.
    """
    try:
        envelope = _envelope_in(key, ends_at, data)
    except WireError as error:
        is_ours = data[:3] == MARK
        return Reading(sentence=f"{error}; see whether all have the same" if is_ours else "")
    sender = envelope.sender
    if envelope.receiver != name or sender == name:
        return Reading()
    if sender not in team:
        sentence = f"{sender!r:.80} has the key of the team, and is not in it; name it for all"
        return Reading(sentence=sentence)
    try:
        plain = envelope.plain(most_bytes)
        if plain is None:
            return Reading(envelope, is_long=True)
        message = envelope.message_of(plain)
        check_message(message, team)
    except WireError:
        return Reading(envelope)
    return Reading(envelope, message, num_bytes=len(plain))


def _envelope_in(key: bytes, ends_at: Callable[[int], Sequence[Ends]], data: bytes) -> Envelope:
    for address, ends in ends_at(data[0]) if data else ():
        body = opened_between(key, ends, data)
        if body is not None:
            try:
                number, begins = read_leb128(body, 0)
            except (IndexError, ValueError) as error:
                raise WireError(f"a message without a number: {error}") from error
            return replace(address, number=number, content=body[begins:])
    return Envelope.from_bytes(opened(key, data))


class Word(enum.Enum):
    """What a message is worth."""

    NEW = "of this mission, and later than all before of its sender"
    LATE = "of this mission, and overtaken by another"
    REPEATED = "it has come before, or is of a run that another one has followed"
    UNPROVEN = "it does not name the boot of this robot"


@dataclass(eq=False)
class _Run:
    """A run of another robot: the highest number heard, and those within the window.

    It is the current one `since` it began or came back.
    """

    boot: bytes
    since: float
    last_heard: float
    highest: int = -1
    numbers: set[int] = field(default_factory=set)

    def takes(self, number: int, now: float) -> bool:
        """Whether a number has not come before; it has now."""
        if number in self.numbers or number <= self.highest - _WINDOW:
            return False
        self.last_heard = now
        self.numbers.add(number)
        self.highest = max(number, self.highest)
        if len(self.numbers) > 2 * _WINDOW:
            self.numbers = {each for each in self.numbers if each > self.highest - _WINDOW}
        return True


class Speakers:
    """The boot of a robot, and the runs of the others that it hears.

    `twins` are names that two robots have: one of its runs speaks on after another has begun, for
    longer than `patience`. `claimed_since` is when others have first spoken to another robot of
    this name.
    """

    def __init__(self, name: str, patience: float) -> None:
        self.name = name
        self.boot = secrets.token_bytes(_BOOT_BYTES)
        self.twins: set[str] = set()
        self.claimed_since: float | None = None
        self._patience = patience
        self._runs: dict[str, _Run] = {}
        self._former: dict[str, dict[bytes, _Run]] = {}
        self._ends: dict[int, tuple[Ends, ...]] = {}  # of all runs that were heard, by hint
        self._named_until: dict[tuple[str, bytes], float] = {}  # since names and boots were sent
        self._num_sent = 0

    def boot_of(self, robot: str) -> bytes:
        """The boot of another robot, or none before it was heard."""
        return self._runs[robot].boot if robot in self._runs else NO_BOOT

    def ends_at(self, hint: int) -> tuple[Ends, ...]:
        """The runs that speak to this one in messages with a hint."""
        return self._ends.get(hint, ())

    def addressed(self, receiver: str, message: object, boot: bytes, now: float) -> Writing:
        """A message to the run of a robot with this boot."""
        self._num_sent += 1
        address = Envelope(self.name, receiver, self.boot, boot, self._num_sent, b"")
        # Where it answers a message of that run, which named this one, both know both ends.
        is_short = isinstance(message, News) and message.answers >= 0
        named_until = self._named_until.get((receiver, boot), -math.inf)
        if self._former.get(receiver) and now >= named_until:
            is_short = False
            self._named_until[receiver, boot] = now + self._patience
        if isinstance(message, News):
            return Writing(address, True, message.as_bytes(), is_short)
        return Writing(address, False, packed(serialize(message)), is_short)

    def word_of(self, envelope: Envelope, now: float) -> Word:
        """What a message is worth, which is remembered."""
        if envelope.receiver_boot != self.boot:
            self._note_claim(envelope, now)
            return Word.UNPROVEN
        self.claimed_since = None
        run = self._runs.get(envelope.sender)
        former = self._former.setdefault(envelope.sender, {})
        if run is not None and envelope.boot in former:
            return self._word_of_former(envelope, run, now)
        if run is None or envelope.boot != run.boot:
            if run is not None:
                former[run.boot] = run
            run = self._runs[envelope.sender] = _Run(envelope.boot, now, now)
            address = replace(envelope, number=0, content=b"")
            hint = hint_of(envelope.ends)
            self._ends[hint] = (*self.ends_at(hint), Ends(address, envelope.ends))
        highest = run.highest
        if not run.takes(envelope.number, now):
            return Word.REPEATED
        return Word.NEW if envelope.number > highest else Word.LATE

    def _word_of_former(self, envelope: Envelope, run: _Run, now: float) -> Word:
        """What a message of a former run is worth, with the `run` that is the current one.

        If nothing was heard of that for the patience, the former one is the current one again: what
        was heard of the other was a late message of an earlier run.
        """
        former = self._former[envelope.sender]
        other = former[envelope.boot]
        highest = other.highest
        if not other.takes(envelope.number, now):
            return Word.REPEATED
        if now - run.last_heard > self._patience:
            former[run.boot] = run
            self._runs[envelope.sender] = former.pop(envelope.boot)
            other.since = now
            return Word.NEW if envelope.number > highest else Word.LATE
        if now - run.since > self._patience:
            self.twins.add(envelope.sender)
        return Word.REPEATED

    def _note_claim(self, envelope: Envelope, now: float) -> None:
        """Note that another robot is spoken to by this name, by one that has heard this one."""
        if envelope.receiver_boot != NO_BOOT and self.boot_of(envelope.sender) == envelope.boot:
            self.claimed_since = now if self.claimed_since is None else self.claimed_since
            if now - self.claimed_since > self._patience:
                self.twins.add(self.name)
