"""The session of a robot with its team: who is there, which solve is on, what has no answer yet.

It has no mathematics. It is given what arrives (`receive`) and the time (`tick`), and hands out
what is to be sent (`outbox`). Messages may be lost, late, repeated, or come in any order. The robot
whose name comes first among those that are awake drives, and the terms of solves only grow. What a
robot brings into a solve is its `Member`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pgo_models.errors import EngineError, PGOError
from solvers.carry.letters import LetterName, Letters
from solvers.carry.registry import record
from solvers.carry.wire import WireError, as_bytes, from_bytes, opened, sealed
from solvers.robots.agent import Agent
from solvers.team.beside import Beside
from solvers.team.driving import Drive
from solvers.team.member import Member
from solvers.team.messages import (
    Ask,
    Ended,
    Heard,
    Hello,
    Letter,
    LetterLost,
    Priority,
    Reply,
    Term,
    check_message,
    error_as_message,
)

PATIENCE = 10.0  # seconds without a sign of a robot, after which it counts as absent
RETRY = 1.0  # seconds after which a message without an answer is sent again
# Patiences after which a robot that is there, and has not answered, is waited for no more.
_MOST_PATIENCES = 10.0
# Share of its patience after which a robot says again that it is there.
_SHARE_OF_PATIENCE = 0.25


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


@record("Envelope")
@dataclass(frozen=True)
class Envelope:
    """A message as bytes, and who it is from and to."""

    sender: str
    receiver: str
    content: NDArray[np.uint8]

    @classmethod
    def of(cls, sender: str, receiver: str, message: object) -> Envelope:
        """Return a message with its addresses."""
        return cls(sender, receiver, np.frombuffer(as_bytes(message), np.uint8))

    @property
    def message(self) -> Any:  # noqa: ANN401 - a message of any kind
        """The message; a WireError for bytes that are none."""
        return from_bytes(self.content.tobytes(), object)


@dataclass(eq=False)
class Following:
    """What a robot does in a solve: its agent obeys each order once. The last answer may be lost.

    `waiting` is an order that waits for letters of other robots, and `obeyed` one that the robot
    computes the answer to; `members` are all by their places.
    """

    agent: Agent
    revision: int
    letters: Letters
    members: tuple[str, ...]
    call: int = -1
    reply: Reply | None = None
    waiting: Ask | None = None
    obeyed: Ask | None = None


@dataclass(eq=False)
class Presence:
    """Who of the team is awake, with which measurements, and who is to be told hello.

    `last_heard` is when each of the others was last heard of, and `revisions` those of their
    measurements. `began` is the first moment that the robot itself was awake.
    """

    name: str
    team: tuple[str, ...]
    patience: float
    retry: float
    last_heard: dict[str, float] = field(default_factory=dict)
    revisions: dict[str, int] = field(default_factory=dict)
    began: float | None = None
    _hello_at: float = -np.inf  # when hello was said to all, and to those that are not awake
    _sought_at: float = -np.inf
    _said_revision: int = -1

    def awake(self, now: float) -> tuple[str, ...]:
        """Robots that were heard of lately, and this one, in the order of their names."""
        awake = []
        for name in self.team:
            last = self.last_heard.get(name, -np.inf)
            if name == self.name or now - last <= self.patience:
                awake.append(name)
        return tuple(awake)

    def is_complete(self, now: float, awake: tuple[str, ...]) -> bool:
        """Whether everybody is awake, or was waited for."""
        assert self.began is not None
        return len(awake) == len(self.team) or now - self.began >= self.patience

    def revisions_of(self, awake: tuple[str, ...], own: int) -> dict[str, int]:
        """Revisions of the measurements of robots that are awake; this one has `own`."""
        others = {name: self.revisions.get(name, 0) for name in awake if name != self.name}
        return {self.name: own, **others}

    def learn_revision(self, robot: str, revision: int) -> None:
        """Take the revision of another robot, which a late message may have of before."""
        self.revisions[robot] = max(revision, self.revisions.get(robot, 0))

    def to_greet(self, now: float, awake: tuple[str, ...], revision: int) -> list[str]:
        """Whom to say hello: often those not awake, now and then and with more lines all."""
        is_due = now - self._hello_at >= _SHARE_OF_PATIENCE * self.patience
        is_due |= self._said_revision != revision
        seeks = now - self._sought_at >= self.retry
        if is_due:
            self._hello_at = now
            self._said_revision = revision
        if seeks:
            self._sought_at = now
        others = [name for name in self.team if name != self.name]
        return [name for name in others if (is_due if name in awake else seeks)]


class Session:
    """The session of a robot with the others of its team, by their names.

    `last` is how the last solve has ended, and `term` the last solve that is known of.
    """

    def __init__(
        self,
        member: Member,
        team: tuple[str, ...],
        key: bytes,
        patience: float,
        retry: float,
    ) -> None:
        self.name = member.name
        self.team = team
        self.retry = retry
        self.ledger = TeamLedger()
        self.term = Term(0, "")
        self.last: Ended | None = None
        self._member = member
        self._key = key
        self._presence = Presence(self.name, team, patience, retry)
        self._sent_at: dict[str, float] = {}  # when the last ask or outcome was sent to each
        self._waits_since: float | None = None  # for answers to the orders under way
        self._following: Following | None = None
        self._drive: Drive | None = None
        self._tried: dict[str, int] | None = None  # revisions of the robots in the last solve
        self._unheard: dict[str, Ended] = {}  # robots that have not confirmed the outcome
        self._out: list[Message] = []
        self._now = 0.0
        self._beside = Beside()

    @property
    def is_computing(self) -> bool:
        """Whether something is computed beside the calls."""
        return self._beside.is_busy

    @property
    def is_settled(self) -> bool:
        """Whether a solve was of the whole team and all that this robot has measured.

        Nobody waits for this robot then.
        """
        ends = [ended for ended in (self.last, self._member.outcome) if ended is not None]
        own = self._member.revision
        if not any(not end.absent and end.revisions.get(self.name) == own for end in ends):
            return False
        return self._drive is None and not self._unheard and not self._out

    def outbox(self) -> list[Message]:
        """Hand out what is to be sent, what others wait for first."""
        self._beside.act()
        messages = sorted(self._out, key=lambda message: message.priority)
        self._out = []
        for message in messages:
            self.ledger = self.ledger.after_sending(message)
        return messages

    def receive(self, data: bytes, now: float) -> None:
        """Take what has arrived: in any order, and any number of times."""
        self._now = now
        self._beside.act()
        try:
            envelope = opened(self._key, data, Envelope)
        except WireError:
            self.ledger = self.ledger.after_dropping("")
            return
        sender = envelope.sender
        if sender not in self.team or sender == self.name or envelope.receiver != self.name:
            self.ledger = self.ledger.after_dropping("")
            return
        try:
            message = envelope.message
            check_message(message, self.team)
        except WireError:
            self.ledger = self.ledger.after_dropping(sender)
            return
        self.ledger = self.ledger.after_receiving(sender, data)
        self._presence.last_heard[sender] = now
        self._take(sender, message, now)

    def _take(self, sender: str, message: object, now: float) -> None:
        """Update what is known of the team by a message, or obey the order in it."""
        if isinstance(message, Hello):
            self._presence.learn_revision(sender, message.revision)
            self._learn_term(message.term)
            if self._drive is not None and self._drive.is_computed(sender, message):
                self._waits_since = now
                self._sent_at[sender] = now
        elif isinstance(message, Ask):
            self._obey(sender, message)
        elif isinstance(message, Reply):
            self._take_reply(sender, message)
        elif isinstance(message, Letter):
            self._take_letter(message)
        elif isinstance(message, LetterLost):
            self._repeat_letter(message)
        elif isinstance(message, Ended):
            self._take_outcome(sender, message)
        elif isinstance(message, Heard):
            outcome = self._unheard.get(sender)
            if outcome is not None and outcome.term == message.term:
                del self._unheard[sender]

    def tick(self, now: float) -> None:
        """Do what is due: say hello, begin a solve, repeat what was not answered, give up."""
        self._now = now
        self._beside.act()
        presence = self._presence
        if presence.began is None:
            presence.began = now
        awake = presence.awake(now)
        for name in presence.to_greet(now, awake, self._member.revision):
            self._say_hello(name, Priority.NORMAL)
        if self._drive is not None:
            self._go_on_driving(now, awake)
        if self._drive is None and awake[0] == self.name and self._is_time(now, awake):
            self._begin_drive(awake)
        self._unheard = {name: ended for name, ended in self._unheard.items() if name in awake}
        self._send_again(self._unheard, Priority.NORMAL, now)

    def _say_hello(self, to: str, priority: Priority) -> None:
        part = self._following
        is_computing = part is not None and part.obeyed is not None
        call = part.call + 1 if part is not None and is_computing else -1
        self._send(to, Hello(self._member.revision, self.term, call), priority)

    def _send(self, to: str, message: object, priority: Priority) -> None:
        data = sealed(self._key, Envelope.of(self.name, to, message))
        self._out.append(Message(to, data, priority))

    def _send_again(self, waiting: Mapping[str, object], priority: Priority, now: float) -> None:
        """Send what was not answered, by receiver, once and then whenever it is due."""
        for name, message in waiting.items():
            if now - self._sent_at.get(name, -np.inf) >= self.retry:
                self._sent_at[name] = now
                self._send(name, message, priority)

    def _learn_term(self, term: Term) -> None:
        """Give up a solve that another robot has overtaken, and solve again if this one drives."""
        if term > self.term:
            self.term = term
            self._following = None
            self._tried = None
            self._unheard.clear()
            self._give_up()

    def _give_up(self) -> None:
        if self._drive is not None:
            self._drive.abandon()
            self._drive = None
            self._tried = None

    # Driving

    def _is_time(self, now: float, awake: tuple[str, ...]) -> bool:
        """Whether a solve should begin: everybody is there or was waited for, and something is new.

        Robots without measurements are waited for, too. Where robots have gone and nothing is new,
        a solve would find less than what is known.
        """
        revisions = self._presence.revisions_of(awake, self._member.revision)
        is_new = min(revisions.values()) > 0 and revisions != self._tried
        if self._member.has_more_than(revisions):
            return False
        return is_new and self._presence.is_complete(now, awake)

    def _begin_drive(self, awake: tuple[str, ...]) -> None:
        own_revision = self._member.revision
        self._tried = self._presence.revisions_of(awake, own_revision)
        self._unheard.clear()  # of the last outcome: there will be another one
        self.term = Term(self.term.number + 1, self.name)
        agent = self._member.new_agent(0)
        assert agent is not None  # as it has measurements
        members = (self.name, *(name for name in awake if name != self.name))
        self._following = Following(agent, own_revision, Letters(0), members)
        self._drive = Drive(
            self.term, members, agent, self._member.solve, self._beside, self._after_step
        )
        self._drive.begin()

    def _go_on_driving(self, now: float, awake: tuple[str, ...]) -> None:
        """Ask again where no answer came, and give up where a robot has gone.

        A robot that is there and does not answer, as one that cannot read the order, ends the
        solve with an error.
        """
        assert self._drive is not None
        if not set(self._drive.needed) <= set(awake):
            self._give_up()
            return
        if self._waits_since is None or not self._drive.waiting:
            self._waits_since = now
        if now - self._waits_since > _MOST_PATIENCES * self._presence.patience:
            self._end_without_answers(now)
            return
        self._send_again(self._drive.waiting, Priority.URGENT, now)

    def _end_without_answers(self, now: float) -> None:
        """End the solve with an error in place of the answers that are missing."""
        assert self._drive is not None
        assert self._waits_since is not None
        seconds = now - self._waits_since
        error = error_as_message(
            EngineError(
                f"it is there, and has not answered for {seconds:.0f} seconds; "
                "see whether all robots have the same version, and what their ledgers have dropped"
            )
        )
        for name, ask in list(self._drive.waiting.items()):
            self._drive.take(
                name, Reply(ask.term, ask.call, self._presence.revisions.get(name, 0), None, error)
            )

    def _take_reply(self, sender: str, reply: Reply) -> None:
        if self._drive is not None and reply.term == self._drive.term:
            if self._tried is not None:
                self._tried[sender] = reply.revision
            self._drive.take(sender, reply)

    def _after_step(self, drive: Drive) -> None:
        """Send what the solve asks for, or its outcome if it has ended."""
        now = self._now
        self._waits_since = None
        self._sent_at.clear()
        self._send_again(drive.waiting, Priority.URGENT, now)
        if drive.outcome is None:
            return
        self._drive = None
        absent = tuple(name for name in self.team if name not in drive.members)
        assert self._tried is not None
        outcome = drive.ended(absent, self._tried)
        self._end_with(outcome)
        self._unheard = dict.fromkeys(drive.members[1:], outcome)
        self._send_again(self._unheard, Priority.NORMAL, now)

    # Following

    def _obey(self, sender: str, ask: Ask) -> None:
        """Obey an order once, and answer it as often as it is asked."""
        if ask.term.driver != sender or ask.term < self.term:
            self._say_hello(sender, Priority.NORMAL)
            return
        if ask.term > self.term:
            self._learn_term(ask.term)
        if ask.call > (0 if self._following is None else self._following.call + 1):
            self._have_all_begin_again(ask.term)
            return
        if self._following is None:
            agent = self._member.new_agent(ask.place)
            if agent is None:
                return
            letters = Letters(ask.place)
            self._following = Following(agent, self._member.revision, letters, ask.members)
        self._answer(self._following, ask)

    def _answer(self, part: Following, ask: Ask) -> None:
        """Begin to obey the next order, or send the last answer again."""
        if part.obeyed is not None:
            self._say_hello(ask.term.driver, Priority.URGENT)
        elif ask.call == part.call + 1:
            lost = self._begin_answer(part, ask)
            if part.waiting is not None:  # asked again: the letters should be here by now
                for name in lost:
                    message = LetterLost(ask.term, name.call, part.letters.place)
                    self._send(part.members[name.other], message, Priority.URGENT)
            part.waiting = ask if lost else None
        elif ask.call == part.call and part.reply is not None:
            self._send(ask.term.driver, part.reply, Priority.URGENT)

    def _have_all_begin_again(self, term: Term) -> None:
        """Tell the robot that drives that this one has begun anew and has lost its part."""
        self.term = Term(term.number + 1, self.name)
        self._say_hello(term.driver, Priority.URGENT)

    def _begin_answer(self, part: Following, ask: Ask) -> set[LetterName]:
        """Begin to obey an order, unless letters are missing."""
        try:
            request, missing = part.letters.put_in(ask.request)
        except (LookupError, TypeError, PGOError) as error:
            part.reply = Reply(ask.term, ask.call, part.revision, None, _as_error(error))
            part.call = ask.call
            self._send(ask.term.driver, part.reply, Priority.URGENT)
            return set()
        if missing:
            return {name for name in missing if 0 <= name.other < len(part.members)}
        part.obeyed = ask

        def compute() -> None:
            answer: Any = None
            error = None
            try:
                answer = ask.order.function()(part.agent, request)
            except Exception as reason:  # another robot may ask for anything
                error = _as_error(reason)
            self._beside.hand_over(lambda: self._end_answer(part, ask, answer, error))

        self._beside.begin(compute)
        return missing

    def _end_answer(
        self,
        part: Following,
        ask: Ask,
        answer: Any,  # noqa: ANN401 - the order chooses
        error: tuple[str, str] | None,
    ) -> None:
        """Send an answer, and letters with it, unless the solve is given up."""
        part.obeyed = None
        part.call = ask.call
        answer, letters = part.letters.take_out(ask.call, answer)
        part.reply = Reply(ask.term, ask.call, part.revision, answer, error)
        if part is not self._following:
            return
        for name in letters:
            self._send_letter(part, ask.term, name)
        self._send(ask.term.driver, part.reply, Priority.URGENT)

    def _send_letter(self, part: Following, term: Term, name: LetterName) -> None:
        letter = Letter(term, name.call, part.letters.place, part.letters.sent[name])
        self._send(part.members[name.other], letter, Priority.URGENT)

    def _take_letter(self, letter: Letter) -> None:
        """Keep a letter, and obey the order that has waited for it."""
        part = self._following
        if part is None or letter.term != self.term:
            return
        part.letters.received[LetterName(letter.place, letter.call)] = letter.content
        if part.obeyed is not None or part.waiting is None:
            return
        if not self._begin_answer(part, part.waiting):
            part.waiting = None

    def _repeat_letter(self, lost: LetterLost) -> None:
        """Send a letter again."""
        if lost.term != self.term:
            return
        name = LetterName(lost.place, lost.call)
        if self._following is None or name not in self._following.letters.sent:
            self._have_all_begin_again(lost.term)
            return
        self._send_letter(self._following, lost.term, name)

    def _take_outcome(self, sender: str, outcome: Ended) -> None:
        if outcome.term == self.term and outcome.term.driver == sender:
            if self.last is None or self.last.term != outcome.term:
                if self._following is None and outcome.solution is not None:
                    self._have_all_begin_again(outcome.term)  # its poses are lost
                    return
                self._end_with(outcome)
            self._send(sender, Heard(outcome.term), Priority.NORMAL)

    def _end_with(self, outcome: Ended) -> None:
        """Remember how a solve has ended, and have the robot take what was found."""
        self.last = outcome
        self._member.end_with(outcome, None if self._following is None else self._following.agent)


def _as_error(error: Exception) -> tuple[str, str]:
    """An error as a message: what is no PGOError comes of what another robot has sent."""
    if isinstance(error, PGOError):
        return error_as_message(error)
    return error_as_message(PGOError(f"it cannot compute what it was asked: {error!r:.200}"))
