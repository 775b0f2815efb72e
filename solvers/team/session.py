"""The session of a robot with its team: who is there, which solve is on, what has no answer yet.

It has no mathematics. It is given what arrives (`receive`) and the time (`tick`), and hands out
what is to be sent (`outbox`). Messages may be lost, late, repeated, or come in any order. The robot
whose name comes first among those that are awake drives, and the terms of solves only grow. What a
robot brings into a solve is its `Member`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from pgo_models.errors import EngineError, PGOError
from solvers.carry.letters import LetterName, Letters
from solvers.carry.wire import MARK, WireError, opened, sealed
from solvers.robots.agent import Agent
from solvers.team.beside import Beside
from solvers.team.driving import Drive
from solvers.team.measurements import Revision
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
from solvers.team.refusals import function_for_teams
from solvers.team.speakers import Envelope, Speakers, Word

PATIENCE = 10.0  # seconds without a sign of a robot, after which it counts as absent
RETRY = 1.0  # seconds after which a message without an answer is sent again
# Patiences after which a robot that is there, and has not answered, is waited for no more.
_MOST_PATIENCES = 10.0
_MOST_STRANGERS = 8  # sentences on messages of nobody in the team
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


@dataclass(eq=False)
class Following:
    """What a robot does in a solve: its agent obeys each order once. The last answer may be lost.

    `waiting` is an order that waits for letters of other robots, and `obeyed` one that the robot
    computes the answer to; `members` are all by their places.
    """

    agent: Agent
    revision: Revision
    letters: Letters
    members: tuple[str, ...]
    call: int = -1
    reply: Reply | None = None
    waiting: Ask | None = None
    obeyed: Ask | None = None


@dataclass(eq=False)
class Presence:
    """Who of the team is awake, with which measurements, and who is to be told hello.

    `last_heard` is when each of the others was last heard of, `revisions` those of their
    measurements, and `known` the terms of the outcomes that they have. `began` is the first moment
    that the robot itself was awake.
    """

    name: str
    team: tuple[str, ...]
    patience: float
    retry: float
    last_heard: dict[str, float] = field(default_factory=dict)
    revisions: dict[str, Revision] = field(default_factory=dict)
    known: dict[str, Term] = field(default_factory=dict)
    began: float | None = None
    _hello_at: float = -np.inf  # when hello was said to all, and to those that are not awake
    _sought_at: float = -np.inf
    _said_revision: Revision | None = None

    def awake(self, now: float) -> tuple[str, ...]:
        """Robots that were heard of lately, and this one, in the order of their names."""
        awake = []
        for name in self.team:
            last = self.last_heard.get(name, -np.inf)
            if name == self.name or now - last <= self.patience:
                awake.append(name)
        return tuple(awake)

    def is_complete(self, now: float, members: Collection[str]) -> bool:
        """Whether the whole team is among the members of a solve, or was waited for."""
        assert self.began is not None
        return len(members) == len(self.team) or now - self.began >= self.patience

    def revisions_of(self, awake: tuple[str, ...], own: Revision) -> dict[str, Revision]:
        """Revisions of the measurements of robots that are awake and have any."""
        revisions = {**self.revisions, self.name: own}
        known = {name: revisions.get(name, Revision()) for name in awake}
        return {name: revision for name, revision in known.items() if revision.num_lines}

    def to_greet(self, now: float, awake: tuple[str, ...], revision: Revision) -> list[str]:
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
        # Revisions and boots of the robots in the last solve.
        self._tried: dict[str, tuple[Revision, str]] = {}
        self._unheard: dict[str, Ended] = {}  # robots that have not confirmed the outcome
        self._out: list[Message] = []
        self._now = 0.0
        self._beside = Beside()
        self._speakers = Speakers(self.name, patience)
        self._strangers: dict[str, None] = {}  # sentences on messages of nobody in the team

    @property
    def is_computing(self) -> bool:
        """Whether something is computed beside the calls."""
        return self._beside.is_busy

    @property
    def heard(self) -> tuple[str, ...]:
        """Robots of the team that have spoken to this one."""
        return tuple(self._presence.last_heard)

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
        except WireError as error:
            self._drop("", "" if data[:3] != MARK else f"{error}; see whether all have the same")
            return
        sender = envelope.sender
        if envelope.receiver != self.name or sender == self.name:
            self._drop("", "")
            return
        if sender not in self.team:
            sentence = f"{sender!r:.80} has the key of the team, and is not in it; name it for all"
            self._drop("", sentence)
            return
        try:
            message = envelope.message
            check_message(message, self.team)
        except WireError:
            self._drop(sender, "")
            return
        word = self._speakers.word_of(envelope, now)
        if word is Word.REPEATED:
            self._drop(sender, "")
            return
        self.ledger = self.ledger.after_receiving(sender, data)
        if word is Word.UNPROVEN:  # answered by a message that does name the boot of the other
            self._send(sender, self._hello(), Priority.URGENT, envelope.boot)
            return
        self._presence.last_heard[sender] = now
        if word is Word.NEW and isinstance(message, Hello):
            self._presence.revisions[sender] = message.revision
            self._presence.known[sender] = message.known
        self._take(sender, message, now)

    def _drop(self, sender: str, sentence: str) -> None:
        """Count what is dropped, and remember a sentence on why."""
        self.ledger = self.ledger.after_dropping(sender)
        if sentence and len(self._strangers) < _MOST_STRANGERS:
            self._strangers[sentence] = None

    @property
    def problems(self) -> list[str]:
        """What is wrong with names, keys or versions of the team, a sentence each."""
        twins = [
            f"two robots are called {name}; give each a name of its own"
            for name in sorted(self._speakers.twins)
        ]
        return [*twins, *self._strangers]

    def _take(self, sender: str, message: object, now: float) -> None:
        """Update what is known of the team by a message, or obey the order in it."""
        if isinstance(message, Hello):
            self._speakers.twins.update(message.twins)
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
        if self._drive is None:
            self._begin_if_due(now, awake)
        self._unheard = {name: ended for name, ended in self._unheard.items() if name in awake}
        self._send_again(self._unheard, Priority.NORMAL, now)

    def _say_hello(self, to: str, priority: Priority) -> None:
        self._send(to, self._hello(), priority)

    def _hello(self) -> Hello:
        part = self._following
        is_computing = part is not None and part.obeyed is not None
        call = part.call + 1 if part is not None and is_computing else -1
        twins = tuple(sorted(self._speakers.twins))
        outcome = self._member.outcome
        known = Term(0, "") if outcome is None else outcome.term
        return Hello(self._member.revision, self.term, known, call, twins)

    def _send(self, to: str, message: object, priority: Priority, heard: str | None = None) -> None:
        """Send a message to a robot, to its run `heard` where that is not the one heard last."""
        data = sealed(self._key, self._speakers.addressed(to, message, heard))
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
            self._tried = {}
            self._unheard.clear()
            self._give_up()

    def _give_up(self) -> None:
        if self._drive is not None:
            self._drive.abandon()
            self._drive = None
            self._tried = {}

    # Driving

    def _begin_if_due(self, now: float, awake: tuple[str, ...]) -> None:
        """Begin a solve if this robot drives: it comes first of those that have measured anything.

        Everybody is there or was waited for, and something is new: measurements, or a robot that
        has begun anew. Where robots have gone, a solve would find less than what is known.
        """
        revisions = self._presence.revisions_of(awake, self._member.revision)
        members = tuple(revisions)
        if not members or members[0] != self.name:
            return
        tried = {}
        lacks_map = False
        for name, revision in revisions.items():
            before = self._tried.get(name)
            tried[name] = (revision, self._speakers.boot_of(name))
            if before is not None and before[1] != tried[name][1]:  # it has begun anew
                has_map = self.last is not None and self._presence.known.get(name) == self.last.term
                tried[name] = (revision, before[1] if has_map else tried[name][1])
                lacks_map |= not has_map
        if self._member.has_more_than(revisions) and not lacks_map:
            return
        if tried != self._tried and self._presence.is_complete(now, members):
            self._begin_drive(members, tried)

    def _begin_drive(
        self, members: tuple[str, ...], tried: dict[str, tuple[Revision, str]]
    ) -> None:
        own_revision = self._member.revision
        self._tried = tried
        self._unheard.clear()  # of the last outcome: there will be another one
        self.term = Term(self.term.number + 1, self.name)
        agent = self._member.new_agent(0)
        assert agent is not None  # as it has measurements
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
                name,
                Reply(
                    ask.term, ask.call, self._presence.revisions.get(name, Revision()), None, error
                ),
            )

    def _take_reply(self, sender: str, reply: Reply) -> None:
        if self._drive is not None and reply.term == self._drive.term:
            self._tried[sender] = (reply.revision, self._speakers.boot_of(sender))
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
        revisions = {name: revision for name, (revision, _) in self._tried.items()}
        outcome = drive.ended(absent, revisions)
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
                answer = function_for_teams(ask.order)(part.agent, request)
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
