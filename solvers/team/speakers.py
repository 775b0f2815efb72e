"""Who speaks: what a message proves beside the key that seals it, and what two runs of a robot are.

The key says that a robot of the team made a message, not when. So every run of a robot draws a
number, its boot, and a message names the boot of its sender and that of its receiver, as the sender
has heard it. A message is of this mission if it names the boot of its receiver, which nobody could
know before; one that does not is answered by a greeting, and believed in nothing. Messages of a run
are numbered, and each number counts once.
"""

from __future__ import annotations

import enum
import secrets
import struct
from dataclasses import dataclass, field
from typing import Any

from solvers.carry.wire import WireError, as_bytes, from_bytes
from solvers.team.news import News

_BOOT_BYTES = 8
NO_BOOT = bytes(_BOOT_BYTES)  # before another robot was heard
# Boots of the sender and of the receiver, number of the message, and lengths of the two names.
_HEAD = struct.Struct(f"<{_BOOT_BYTES}s{_BOOT_BYTES}sIHH")
_NEWS, _OTHER = b"N", b"O"  # kinds of content
_WINDOW = 4096  # a message that comes later than so many after it counts as repeated


@dataclass(frozen=True)
class Envelope:
    """A message as bytes, and who it is from and to: names, boots, and its number in the run.

    `heard` is the boot of the receiver, or none before the sender has heard it.
    """

    sender: str
    receiver: str
    boot: bytes
    heard: bytes
    number: int
    content: bytes

    @property
    def message(self) -> Any:  # noqa: ANN401 - a message of any kind
        """The message; a WireError for bytes that are none."""
        kind, content = self.content[:1], self.content[1:]
        return News.from_bytes(content) if kind == _NEWS else from_bytes(content, object)

    def as_bytes(self) -> bytes:
        """Bytes of which `from_bytes` makes the envelope."""
        names = [name.encode("utf-8") for name in (self.sender, self.receiver)]
        head = _HEAD.pack(self.boot, self.heard, self.number, *map(len, names))
        return b"".join([head, *names, self.content])

    @classmethod
    def from_bytes(cls, data: bytes) -> Envelope:
        """Return the envelope that bytes are; a WireError for others."""
        try:
            boot, heard, number, *lengths = _HEAD.unpack_from(data)
            begins = _HEAD.size
            names = []
            for length in lengths:
                names.append(data[begins : begins + length].decode("utf-8"))
                begins += length
        except (struct.error, ValueError) as error:
            raise WireError(f"a message without addresses: {error}") from error
        sender, receiver = names
        return cls(sender, receiver, boot, heard, number, data[begins:])


class Word(enum.Enum):
    """What a message is worth."""

    NEW = "of this mission, and later than all before of its sender"
    LATE = "of this mission, and overtaken by another"
    REPEATED = "it has come before, or is of a run that another one has followed"
    UNPROVEN = "it does not name the boot of this robot"


@dataclass(eq=False)
class _Run:
    """A run of another robot: the highest number heard, and those within the window."""

    boot: bytes
    since: float
    highest: int = -1
    numbers: set[int] = field(default_factory=set)

    def takes(self, number: int) -> bool:
        """Whether a number has not come before; it has now."""
        if number in self.numbers or number <= self.highest - _WINDOW:
            return False
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
        self._num_sent = 0

    def boot_of(self, robot: str) -> bytes:
        """The boot of another robot, or none before it was heard."""
        return self._runs[robot].boot if robot in self._runs else NO_BOOT

    def addressed(self, receiver: str, message: object, heard: bytes) -> Envelope:
        """A message to the run `heard` of a robot."""
        self._num_sent += 1
        if isinstance(message, News):
            content = _NEWS + message.as_bytes()
        else:
            content = _OTHER + as_bytes(message)
        return Envelope(self.name, receiver, self.boot, heard, self._num_sent, content)

    def word_of(self, envelope: Envelope, now: float) -> Word:
        """What a message is worth, which is remembered."""
        if envelope.heard != self.boot:
            self._note_claim(envelope, now)
            return Word.UNPROVEN
        self.claimed_since = None
        run = self._runs.get(envelope.sender)
        former = self._former.setdefault(envelope.sender, {})
        if envelope.boot in former:
            is_new = former[envelope.boot].takes(envelope.number)
            if is_new and run is not None and now - run.since > self._patience:
                self.twins.add(envelope.sender)
            return Word.REPEATED
        if run is None or envelope.boot != run.boot:
            if run is not None:
                former[run.boot] = run
            run = self._runs[envelope.sender] = _Run(envelope.boot, now)
        highest = run.highest
        if not run.takes(envelope.number):
            return Word.REPEATED
        return Word.NEW if envelope.number > highest else Word.LATE

    def _note_claim(self, envelope: Envelope, now: float) -> None:
        """Note that another robot is spoken to by this name, by one that has heard this one."""
        if envelope.heard != NO_BOOT and self.boot_of(envelope.sender) == envelope.boot:
            self.claimed_since = now if self.claimed_since is None else self.claimed_since
            if now - self.claimed_since > self._patience:
                self.twins.add(self.name)
