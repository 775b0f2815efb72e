"""Solves by robots that keep their measurements: one drives, and the others obey its orders.

The robot whose name comes first among those that are awake and have measured anything drives, and
the terms of solves only grow. Where no edge joins some robots with the others, that is all that a
solve finds. Then each part of robots that are joined solves as if the others were not there, until
somebody has measured something else. What a robot brings into a solve is its `Member`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from pgo_models.errors import EngineError, PGOError
from solvers.carry.letters import LetterName, Letters
from solvers.team.beside import Talk, result_or_error
from solvers.team.driven_solve import UNKNOWN, obey_orders
from solvers.team.driving import Drive
from solvers.team.measurements import Measurements, Revision
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
    error_as_message,
)
from solvers.team.news import News
from solvers.team.pace import Pace, clock
from solvers.team.session import Session
from solvers.team.sharing import OwnAnswer

# Patiences after which a robot that is there, and has not answered, is waited for no more.
_MOST_PATIENCES = 10.0


@dataclass(eq=False)
class Following:
    """What a robot does in a solve: it obeys each order once. The last answer may be lost.

    `waiting` is an order that waits for letters of other robots, and `obeyed` one that the robot
    computes the answer to (`talk`); `members` are all by their places, and `own` is what the solve
    has found of the robot's poses.
    """

    talk: Talk
    revision: Revision
    letters: Letters
    members: tuple[str, ...]
    call: int = -1
    reply: Reply | None = None
    waiting: Ask | None = None
    obeyed: Ask | None = None
    own: OwnAnswer | None = None


class DrivenTeam:
    """The solves that robots of a team carry out together.

    `last` is how the last solve has ended that is more than the parts which robots form, and `term`
    the last solve that is known of.
    """

    def __init__(self, member: Member, session: Session) -> None:
        self.name = session.name
        self.term = Term(0, "")
        self.last: Ended | None = None
        self._member = member
        self._session = session
        self._beside = session.beside
        # The last solve that has found parts of robots, of which each solves for itself as long as
        # no robot has other measurements.
        self._apart: Ended | None = None
        # Robots that are there and have measured anything, this one too.
        self._present: dict[str, Revision] = {}
        # Of the others: the revisions of their measurements, and the terms of their outcomes.
        self._revisions: dict[str, Revision] = {}
        self._known: dict[str, Term] = {}
        self._sent_at: dict[str, float] = {}  # when the last ask or outcome was sent to each
        self._paces: defaultdict[str, Pace] = defaultdict(Pace)
        self._computing: set[str] = set()  # robots that say that they compute what they were asked
        self._waits_since: float | None = None  # for answers to the orders under way
        self._following: Following | None = None
        self._drive: Drive | None = None
        # Revisions and boots of the robots in the last solve.
        self._tried: dict[str, tuple[Revision, bytes]] = {}
        self._unheard: dict[str, Ended] = {}  # robots that have not confirmed the outcome
        self._said: Revision | None = None
        self._share_more: set[str] = set()

    @property
    def others(self) -> dict[str, Measurements]:
        """Measurements of others: they keep theirs."""
        return {}

    def restore(
        self, term: Term, outcome: Ended | None, others: Mapping[str, Measurements]
    ) -> None:
        """Go on from what was saved."""
        self.term = term
        self.last = outcome

    @property
    def _revision(self) -> Revision:
        """Which measurements it has; none before a line has told their dimension."""
        member = self._member
        return Revision() if member.measurements.d is None else member.revision

    @property
    def is_settled(self) -> bool:
        """Whether a solve was of the whole team and all that this robot has measured.

        Nobody waits for this robot then.
        """
        ends = [ended for ended in (self.last, self._member.outcome) if ended is not None]
        own = self._revision
        if not any(not end.absent and end.revisions.get(self.name) == own for end in ends):
            return False
        session = self._session
        is_waited_for = any(session.is_awake(name) for name in self._unheard)
        return self._drive is None and not is_waited_for

    @property
    def problems(self) -> list[str]:
        """Robots that share more than this one, and poses without a map, a sentence each."""
        problems = [
            f"{name} shares its measurements, and {self.name} its interface alone; give all robots "
            "the same sharing"
            for name in sorted(self._share_more)
        ]
        known = self._member.known
        if known is not None and known.num_apart:
            problems.append(f"no edge joins {known.num_apart} poses of {self.name} with its others")
        outcome = self._member.outcome
        if outcome is not None and outcome.solution is not None:
            num_of_others = outcome.solution.num_apart - (0 if known is None else known.num_apart)
            if num_of_others:
                problems.append(
                    f"no edge joins {num_of_others} poses of other robots with most of theirs"
                )
        return problems

    def greeting(self, to: str = "") -> Hello:
        """What tells others that this robot is there."""
        part = self._following
        is_computing = part is not None and part.obeyed is not None
        call = part.call + 1 if part is not None and is_computing else -1
        outcome = self._member.outcome
        known = Term(0, "") if outcome is None else outcome.term
        session = self._session
        apart = Term(0, "") if self._apart is None else self._apart.term
        twins, hears = session.twins, session.hears
        return Hello(self._revision, self.term, known, call, twins, hears, apart)

    def take(self, sender: str, message: object, is_latest: bool) -> None:
        """Update what is known of the team by a message, or obey the order in it."""
        if isinstance(message, Hello):
            self._take_hello(sender, message, is_latest)
        elif isinstance(message, News):
            self._share_more.add(sender)
        elif isinstance(message, Ask):
            self._obey(sender, message)
        elif isinstance(message, Reply):
            self._take_reply(sender, message, is_latest)
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
                self._known[sender] = message.term

    def _take_hello(self, sender: str, hello: Hello, is_latest: bool) -> None:
        if is_latest:
            self._revisions[sender] = hello.revision
            self._known[sender] = hello.known
            apart = self._apart
            is_told = apart is not None and apart.revisions.get(sender) == hello.revision
            if apart is not None and is_told and hello.apart < apart.term:
                self._session.send(sender, apart, Priority.NORMAL)
        asked = () if self._drive is None else self._drive.members
        if sender in (*self._part, *asked) or sender not in self._present:
            self._learn_term(hello.term)  # another part has its own solves
        if self._drive is not None and self._drive.is_computed(sender, hello):
            self._computing.add(sender)
            self._waits_since = self._session.now
            self._sent_at[sender] = self._session.now

    def tick(self, awake: tuple[str, ...]) -> None:
        """Begin a solve, repeat what was not answered, give up."""
        if self._said != self._revision:
            self._said = self._revision
            for name in awake:
                if name != self.name:
                    self._session.say_hello(name)
        self._present = self._present_of(awake)
        if self._drive is not None:
            self._go_on_driving(awake)
        if self._drive is None:
            self._begin_if_due()
        # A robot that is out of reach may come back for the outcome.
        unheard = {name: ended for name, ended in self._unheard.items() if name in awake}
        self._send_again(unheard, Priority.NORMAL)

    def _send_again(self, waiting: Mapping[str, object], priority: Priority) -> None:
        """Send what was not answered, by receiver, as often as the link to it lets expect."""
        now = self._session.now
        for name, message in waiting.items():
            pause = self._paces[name].pause(self._session.silence_of(name), self._session.retry)
            if now - self._sent_at.get(name, -np.inf) >= pause:
                self._sent_at[name] = now
                copy = replace(message, sent=clock(now)) if isinstance(message, Ask) else message
                self._session.send(name, copy, priority)

    def _learn_term(self, term: Term) -> None:
        """Give up a solve that another robot has overtaken, and solve again if this one drives."""
        if term > self.term:
            self.term = term
            self._stop_following()
            self._following = None
            self._tried = {}
            self._unheard.clear()
            self._give_up()

    def _stop_following(self) -> None:
        """End the computation of this robot's part; its last answer can be sent again."""
        if self._following is not None:
            self._following.talk.give_up()

    def _give_up(self) -> None:
        if self._drive is not None:
            self._drive.abandon()
            self._drive = None
            self._tried = {}

    # Parts of the team

    def _present_of(self, awake: tuple[str, ...]) -> dict[str, Revision]:
        """Robots that are awake and have measured anything, and what."""
        present = {}
        for name in awake:
            own = self._revision if name == self.name else Revision()
            revision = self._revisions.get(name, own)
            if revision.num_lines:
                present[name] = revision
        return present

    @property
    def _parts(self) -> tuple[tuple[str, ...], ...]:
        """Parts of the robots that are there; none where they may be joined."""
        apart = self._apart
        if apart is None or not self._present.items() <= apart.revisions.items():
            return ()
        parts = [tuple(name for name in part if name in self._present) for part in apart.parts]
        return tuple(part for part in parts if part)

    @property
    def _part(self) -> dict[str, Revision]:
        """The part that this robot is in: robots by name, and what they have measured."""
        own = next((part for part in self._parts if self.name in part), tuple(self._present))
        return {name: self._present[name] for name in own}

    # Driving

    def _begin_if_due(self) -> None:
        """Begin a solve if this robot drives: it comes first of those that have measured anything.

        Everybody is there or was waited for, and something is new: measurements, or a robot that
        has begun anew. Where robots have gone, a solve would find less than what is known, and
        where all have what they would find, nothing.
        """
        revisions = self._part
        members = tuple(revisions)
        if not members or members[0] != self.name:
            return
        tried = {}
        lacks_map = False
        for name, revision in revisions.items():
            before = self._tried.get(name)
            tried[name] = (revision, self._session.boot_of(name))
            if before is not None and before[1] != tried[name][1]:  # it has begun anew
                has_map = self.last is not None and self._known.get(name) == self.last.term
                tried[name] = (revision, before[1] if has_map else tried[name][1])
                lacks_map |= not has_map
        has_more = self._member.has_more_than(revisions, self._present)
        if not lacks_map and (has_more or self._all_have_map_of(revisions)):
            return
        if tried != self._tried and self._session.is_complete(self._present):
            self._begin_drive(members, tried)

    def _all_have_map_of(self, revisions: Mapping[str, Revision]) -> bool:
        """Whether these robots have the outcome of these measurements, as they say."""
        outcome = self._member.outcome
        if outcome is None or outcome.revisions != revisions:
            return False
        return all(self._known.get(name) == outcome.term for name in revisions if name != self.name)

    def _begin_drive(
        self, members: tuple[str, ...], tried: dict[str, tuple[Revision, bytes]]
    ) -> None:
        self._tried = tried
        self._unheard.clear()  # of the last outcome: there will be another one
        self.term = Term(self.term.number + 1, self.name)
        self._stop_following()
        self._following = None
        member = self._member
        self._drive = Drive(
            self.term,
            members,
            member.measurements,
            member.settings,
            self._beside,
            self._after_step,
        )

    def _go_on_driving(self, awake: tuple[str, ...]) -> None:
        """Ask again where no answer came, and give up where a robot has gone.

        A robot that is there and does not answer, as one that cannot read the order, ends the
        solve with an error.
        """
        assert self._drive is not None
        if not set(self._drive.members) <= set(awake):  # they wait for letters of each other
            self._give_up()
            return
        now = self._session.now
        if self._waits_since is None or not self._drive.waiting:
            self._waits_since = now
        if now - self._waits_since > _MOST_PATIENCES * self._session.patience:
            self._end_without_answers(now)
            return
        self._send_again(self._drive.waiting, Priority.URGENT)

    def _end_without_answers(self, now: float) -> None:
        """End the solve with an error in place of the answers that are missing."""
        assert self._drive is not None
        assert self._waits_since is not None
        seconds = now - self._waits_since
        error = error_as_message(
            EngineError(
                f"it is there, and has not answered for {seconds:.0f} seconds; "
                "see whether all have the same version, and what their ledgers have dropped"
            )
        )
        for name, ask in list(self._drive.waiting.items()):
            self._drive.take(
                name,
                Reply(ask.term, ask.call, self._revisions.get(name, Revision()), None, error),
            )

    def _take_reply(self, sender: str, reply: Reply, is_latest: bool) -> None:
        if is_latest and reply.call == 0:  # it may overtake the hello that says so
            self._revisions[sender] = reply.revision
        drive = self._drive
        if drive is not None and reply.term == drive.term and sender in drive.members:
            self._tried[sender] = (reply.revision, self._session.boot_of(sender))
            # The time of the link alone tells when to send again, not that of a computation.
            if drive.waits_for(sender, reply) and sender not in self._computing:
                session = self._session
                self._paces[sender].note_answer(reply.answers, session.now, session.retry)
            drive.take(sender, reply)

    def _after_step(self, drive: Drive) -> None:
        """Send what the solve asks for, or its outcome if it has ended."""
        self._waits_since = None
        self._computing.clear()
        self._sent_at.clear()
        self._send_again(drive.waiting, Priority.URGENT)
        if drive.outcome is None:
            return
        self._drive = None
        absent = tuple(name for name in self._session.team if name not in drive.members)
        revisions = {name: revision for name, (revision, _) in self._tried.items()}
        outcome = drive.ended(absent, revisions, self._parts)
        if outcome.has_parts_alone:  # whoever misses it says so with the next hello
            self._apart = outcome
            for name in drive.members[1:]:
                self._session.send(name, outcome, Priority.NORMAL)
            return
        self._end_with(outcome, drive.own)
        self._unheard = dict.fromkeys(drive.members[1:], outcome)
        self._send_again(self._unheard, Priority.NORMAL)

    # Following

    def _obey(self, sender: str, ask: Ask) -> None:
        """Obey an order once, and answer it as often as it is asked."""
        if ask.term.driver != sender or ask.term < self.term:
            self._session.say_hello(sender)
            return
        if ask.term > self.term:
            self._learn_term(ask.term)
        if ask.call > (0 if self._following is None else self._following.call + 1):
            self._have_all_begin_again(ask.term)
            return
        if self._following is None:
            if self._member.measurements.d is None:
                return
            self._follow(ask)
        assert self._following is not None
        self._answer(self._following, ask)

    def _follow(self, ask: Ask) -> None:
        """Begin to take part in a solve."""
        talk = self._beside.begin(
            partial(obey_orders, ask.place, self.name, self._member.measurements),
            lambda error: self._lose_part(part, error),
            UNKNOWN,
            lambda told: self._end_answer(part, *told),
        )
        part = Following(talk, self._revision, Letters(ask.place), ask.members)
        self._following = part

    def _lose_part(self, part: Following, error: PGOError) -> None:
        """Answer the order under way with the error that has ended the computation of the part."""
        if part.obeyed is not None:
            self._end_answer(part, error, None)

    def _answer(self, part: Following, ask: Ask) -> None:
        """Begin to obey the next order, or send the last answer again."""
        if part.obeyed is not None:
            self._session.say_hello(ask.term.driver)
        elif ask.call == part.call + 1 and part.talk.is_over:
            self._have_all_begin_again(ask.term)
        elif ask.call == part.call + 1:
            lost = self._begin_answer(part, ask)
            if part.waiting is not None:  # asked again: the letters should be here by now
                for name in lost:
                    message = LetterLost(ask.term, name.call, part.letters.place)
                    self._session.send(part.members[name.other], message, Priority.URGENT)
            part.waiting = ask if lost else None
        elif ask.call == part.call and part.reply is not None:
            reply = replace(part.reply, answers=ask.sent)
            self._session.send(ask.term.driver, reply, Priority.URGENT)

    def _have_all_begin_again(self, term: Term) -> None:
        """Tell the robot that drives that this one has begun anew and has lost its part."""
        self.term = Term(term.number + 1, self.name)
        self._session.say_hello(term.driver)

    def _begin_answer(self, part: Following, ask: Ask) -> set[LetterName]:
        """Begin to obey an order, unless letters are missing."""
        completed = result_or_error(partial(part.letters.put_in, ask.request), UNKNOWN)
        if isinstance(completed, PGOError):
            failure = error_as_message(completed)
            part.reply = Reply(ask.term, ask.call, part.revision, None, failure, ask.sent)
            part.call = ask.call
            self._session.send(ask.term.driver, part.reply, Priority.URGENT)
            return set()
        request, missing = completed
        if missing:
            return {name for name in missing if 0 <= name.other < len(part.members)}
        part.obeyed = ask
        part.talk.tell((ask.order, request))
        return missing

    def _end_answer(
        self,
        part: Following,
        result: Any,  # noqa: ANN401 - the order chooses
        own: OwnAnswer | None,
    ) -> None:
        """Send an answer or an error, and letters with it, unless the solve is given up."""
        ask = part.obeyed
        assert ask is not None
        part.own = own
        part.obeyed = None
        part.call = ask.call
        is_error = isinstance(result, PGOError)
        error = error_as_message(result) if is_error else None
        answer, letters = part.letters.take_out(ask.call, None if is_error else result)
        part.reply = Reply(ask.term, ask.call, part.revision, answer, error, ask.sent)
        if part is not self._following:
            return
        send = partial(self._send_answer, part, ask.term, part.reply, letters)
        unsent = result_or_error(send, UNKNOWN)
        if isinstance(unsent, PGOError):  # an odd order: messages for nobody, or no numbers
            for name in letters:
                del part.letters.sent[name]
            error = error_as_message(unsent)
            part.reply = Reply(ask.term, ask.call, part.revision, None, error, ask.sent)
            self._session.send(ask.term.driver, part.reply, Priority.URGENT)

    def _send_answer(
        self, part: Following, term: Term, reply: Reply, letters: Iterable[LetterName]
    ) -> None:
        for name in letters:
            self._send_letter(part, term, name)
        self._session.send(term.driver, reply, Priority.URGENT)

    def _send_letter(self, part: Following, term: Term, name: LetterName) -> None:
        letter = Letter(term, name.call, part.letters.place, part.letters.sent[name])
        self._session.send(part.members[name.other], letter, Priority.URGENT)

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

    def _take_parts(self, ended: Ended) -> None:
        """Learn which robots are joined, from the one that drove, or from another that knows it."""
        if self._apart is None or ended.term > self._apart.term:
            self._apart = ended
        if ended.term == self.term:
            self._stop_following()

    def _take_outcome(self, sender: str, outcome: Ended) -> None:
        if outcome.has_parts_alone:
            self._take_parts(outcome)
        elif outcome.term == self.term and outcome.term.driver == sender:
            if self.last is None or self.last.term != outcome.term:
                if self._following is None and outcome.solution is not None:
                    self._have_all_begin_again(outcome.term)  # its poses are lost
                    return
                self._end_with(outcome, None if self._following is None else self._following.own)
                self._stop_following()
            self._session.send(sender, Heard(outcome.term), Priority.NORMAL)

    def _end_with(self, outcome: Ended, own: OwnAnswer | None) -> None:
        """Remember how a solve has ended, and have the robot take what was found."""
        self.last = outcome
        self._member.end_with(outcome, own)
