"""A map of all that the team has measured, which every robot finds for itself.

A robot tells each other one what it has measured, every line once: the others say which revisions
they have (`News.has`), and it sends the lines after these. What a robot that is not heard has
measured others pass on. So nothing has to be agreed on: whoever has the same lines has the same
map. It stays when robots go, and lost messages are sent again.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from pgo_models.errors import PGOError
from solvers.carry.wire import WireError
from solvers.team.measurements import Measurements, Revision
from solvers.team.member import Member
from solvers.team.messages import Ended, Hello, Priority, Term
from solvers.team.news import News, Piece
from solvers.team.pace import MOST_IN_A_PIECE, Pace, clock
from solvers.team.packed_lines import MOST_LINES, PackedLines, packed_lines, unpacked_lines
from solvers.team.session import Session
from solvers.team.shared_solve import SharedAnswer

_MOST_FLIGHTS = 4  # pieces on their way to a robot that has not answered the first of them
_MOST_PACKED = 8  # pieces that are kept for others
_FORGOTTEN = 10.0  # patiences without a sign, after which a robot is not waited for any more


@dataclass(frozen=True)
class _Flight:
    """A piece that was sent: its lines, when, and whether it was the last."""

    begins: int
    ends: int
    when: float
    is_last: bool


class _Said(NamedTuple):
    """What a robot has, whom it hears, and when it said so."""

    has: Mapping[str, Revision]
    hears: tuple[str, ...]
    when: float


class SharedMap:
    """The measurements of the team as far as a robot has them, by robot, and the map of them.

    `last` is how the last solve has ended, and `term` its number.
    """

    def __init__(self, member: Member, session: Session) -> None:
        self.name = session.name
        self.term = Term(0, "")
        self.last: Ended | None = None
        self.logs: dict[str, Measurements] = {session.name: member.measurements}
        # Whether the robot comes from what was saved and has measured nothing since: then it takes
        # back what others still have of it.
        self.saved: Revision | None = None
        self._member = member
        self._session = session
        # What the others have last said, also those that are out of reach, and who is within it.
        self._said: dict[str, _Said] = {}
        self._near: set[str] = set()
        # Lines that were packed last, by owner and revisions between which they are: most are for
        # all others, of which some are a little ahead.
        self._packed: dict[tuple[str, Revision, Revision], PackedLines] = {}
        self._turn = ""  # the robot that lines were packed for last: others come first
        # What the others were told beside revisions, and when they are told again.
        self._told: dict[str, tuple[bytes, tuple[str, ...], tuple[str, ...]]] = {}
        self._tell_again: dict[str, float] = {}
        # What is on its way, by receiver and owner, and the last piece of all.
        self._flights: defaultdict[tuple[str, str], list[_Flight]] = defaultdict(list)
        self._paces: defaultdict[str, Pace] = defaultdict(Pace)
        self._lags: dict[tuple[str, str], float] = {}  # since when a robot lacks lines of another
        # When an answer is owed to robots whose pieces have come: they are collected, too.
        self._owed: dict[str, float] = {}
        self._keep_theirs: set[str] = set()
        self._tried: Mapping[str, Revision] = {}
        self._changed_at: float | None = None
        self._is_solving = False
        self._problems: tuple[str, ...] = ()

    @property
    def _has(self) -> dict[str, Mapping[str, Revision]]:
        """What each of the others has that is within reach."""
        return {name: said.has for name, said in self._said.items() if name in self._near}

    @property
    def others(self) -> dict[str, Measurements]:
        """Measurements of others, by robot."""
        return {name: log for name, log in self.logs.items() if name != self.name}

    def restore(
        self, term: Term, outcome: Ended | None, others: Mapping[str, Measurements]
    ) -> None:
        """Go on from what was saved, and solve again: the solution is not saved."""
        self.term = term
        self.last = outcome
        self.saved = self._member.revision
        for name, saved in others.items():
            if name in self._session.team:
                self.logs[name] = Measurements()
                self.logs[name].restore(saved)

    @property
    def problems(self) -> list[str]:
        """What was left out, and robots that keep their measurements, a sentence each."""
        kept = [
            f"{name} shares its interface alone; give all robots the same sharing"
            for name in sorted(self._keep_theirs)
        ]
        return [*kept, *self._problems]

    @property
    def revisions(self) -> dict[str, Revision]:
        """Which measurements this robot has, by robot."""
        revisions = {name: log.revision for name, log in sorted(self.logs.items())}
        return {name: revision for name, revision in revisions.items() if revision.num_lines}

    @property
    def is_settled(self) -> bool:
        """Whether the map is one of all, and everybody has all that it is of.

        A robot that is out of reach may come back for it, and is waited for.
        """
        outcome = self._member.outcome
        if outcome is None or outcome.absent or self._is_solving or self._owed:
            return False
        revisions = self.revisions
        oldest = self._session.now - _FORGOTTEN * self._session.patience
        waited_for = [said for said in self._said.values() if said.when >= oldest]
        return revisions == self._tried and all(said.has == revisions for said in waited_for)

    # Lines

    def greeting(self) -> News:
        """What tells others that this robot is there."""
        return News(self.revisions, tuple(self._has), (), self._takes_back, self._session.twins)

    def _news(self, to: str, pieces: tuple[Piece, ...]) -> News:
        """The greeting to a robot, with pieces, and as the answer to those that have come.

        It is short where the robot was told the rest of late, and new lines of this one go along.
        """
        sent = clock(self._session.now)
        answers, self._paces[to].heard = self._paces[to].heard, -1
        news = replace(self.greeting(), pieces=pieces, sent=sent, answers=answers)
        told = (self._session.boot_of(to), news.hears, news.twins)
        is_told = self._told.get(to) == told and self._session.now < self._tell_again[to]
        if not is_told or [piece.is_last for piece in pieces if piece.owner == self.name] != [True]:
            self._told[to] = told
            self._tell_again[to] = self._session.now + self._session.patience
            return news
        has = {name: revision for name, revision in news.has.items() if name == to}
        return replace(news, has=has, hears=(), twins=(), is_short=True)

    @property
    def _takes_back(self) -> bool:
        return self.saved is not None and self.saved == self._member.revision

    def take(self, sender: str, message: object, is_latest: bool) -> None:
        """Learn which measurements a robot has, and lines that it gives."""
        if isinstance(message, Hello):
            self._keep_theirs.add(sender)
        if not isinstance(message, News):
            return
        if len(message.pieces) > 1:  # nobody sends more, as each takes its time to be read
            raise WireError(f"{len(message.pieces)} pieces")
        pace = self._paces[sender]
        for piece in message.pieces:
            self._learn(sender, piece, is_latest)
            pause = self._session.pause(1) / 2 if piece.is_last else 0.0
            when = min(self._session.now + pause, self._owed.get(sender, np.inf))
            self._owed[sender] = when
        if is_latest:
            if message.pieces:
                pace.heard = message.sent
            if message.answers >= 0:
                pace.note_answer(message.answers, self._session.now, self._session.pause(1))
            self._said[sender] = self._said_in(sender, message)
            self._near.add(sender)
            if message.takes_back:
                self._give_back(sender, message.has.get(sender, Revision()))

    def _said_in(self, sender: str, news: News) -> _Said:
        """What a robot has and hears; of its own it has all lines that a short message brings."""
        now = self._session.now
        before = self._said.get(sender)
        if not news.is_short or before is None:
            return _Said(news.has, news.hears, now)
        own = {}
        for piece in news.pieces:
            if piece.owner == sender:
                revision = self.logs[sender].revision
                ends = piece.before.num_lines + piece.lines.num_lines
                own[sender] = revision if revision.num_lines == ends else Revision(ends)
        return _Said({**before.has, **news.has, **own}, before.hears, now)

    def _learn(self, sender: str, piece: Piece, is_latest: bool) -> None:
        """Add lines to those of a robot; of its own that robot alone decides which stand."""
        if piece.owner == self.name:
            if self._takes_back and piece.before == self.saved:
                own = self._member.measurements
                own.end_at(piece.before.num_lines, _lines_of(piece, own))
                self.saved = self._member.revision
            return
        log = self.logs.setdefault(piece.owner, Measurements())
        if not log.begins_with(piece.before):
            return
        begins = piece.before.num_lines
        lines = _lines_of(piece, log)
        known = log.lines[begins : begins + len(lines)]
        is_final = sender == piece.owner and is_latest
        ends = begins + len(lines)
        if known != lines[: len(known)]:
            if is_final:
                log.end_at(begins, lines)
        elif len(log.lines) < ends:
            log.end_at(begins + len(known), lines[len(known) :])
        elif is_final and piece.is_last and len(log.lines) > ends:
            log.end_at(ends, [])

    def _give_back(self, owner: str, saved: Revision) -> None:
        """Give a robot that was restored from an older state its lines since then."""
        log = self.logs.get(owner)
        if log is not None and log.begins_with(saved) and len(log.lines) > saved.num_lines:
            piece = self._piece(owner, log, saved.num_lines, owner, may_pack=True)
            if piece is not None:
                self._session.send(owner, self._news(owner, (piece,)), Priority.NORMAL)

    def tick(self, awake: tuple[str, ...]) -> None:
        """Send what others lack, and solve where something is new."""
        self._near &= set(awake)
        self._owed = {name: when for name, when in self._owed.items() if name in awake}
        before = next(reversed(self._packed), None)
        for name in sorted(self._near, key=lambda name: (name <= self._turn, name)):
            # Lines are packed once in a tick, as that takes its time; the next robot has the next.
            may_pack = next(reversed(self._packed), None) == before
            piece = self._piece_for(name, awake, may_pack)
            # Where lines for the robot are being collected, they take the answer along.
            sent = self._flights[name, self.name]
            is_coming = (
                bool(sent) and sent[-1].is_last and sent[-1].ends < len(self.logs[self.name].lines)
            )
            delay = self._session.pause(1) / 2 if is_coming else 0.0
            if piece is not None or self._owed.get(name, np.inf) + delay <= self._session.now:
                self._owed.pop(name, None)
                priority = Priority.HELLO if piece is None else Priority.NORMAL
                pieces = () if piece is None else (piece,)
                self._session.send(name, self._news(name, pieces), priority)
        self._solve_if_due()

    def _piece_for(self, to: str, awake: tuple[str, ...], may_pack: bool) -> Piece | None:
        """Lines that a robot lacks: this robot's, or those of another that it does not hear."""
        has = self._said[to].has
        for owner, log in self.logs.items():
            known = has.get(owner, Revision())
            if owner == to or known == log.revision or not log.lines:
                self._lags.pop((to, owner), None)
                continue
            begins = known.num_lines if log.begins_with(known) else 0
            if owner != self.name and not self._passes_on(to, owner, known, awake):
                continue
            if owner == self.name and self._takes_back and not log.begins_with(known):
                continue
            piece = self._piece(to, log, begins, owner, may_pack)
            if piece is not None:
                return piece
        return None

    def _passes_on(self, to: str, owner: str, known: Revision, awake: tuple[str, ...]) -> bool:
        """Whether to tell a robot what a third one has measured, which it does not hear.

        One after the other would do it, the first robot that is awake at once for one that is gone:
        others may have met a moment later.
        """
        log = self.logs[owner]
        if owner in self._said[to].hears or known.num_lines >= len(log.lines):
            return False
        since = self._lags.setdefault((to, owner), self._session.now)
        rank = [name for name in awake if name not in (to, owner)].index(self.name)
        rank += owner in awake
        is_due = self._session.now - since >= rank * self._session.patience / 2
        return is_due and log.begins_with(known)

    def _piece(
        self, to: str, log: Measurements, known: int, owner: str, may_pack: bool
    ) -> Piece | None:
        """Lines after those known, cut to a length; None where it is not yet time.

        They are those packed last, unless others may be packed.
        """
        flights = self._on_their_way(to, owner, known)
        if flights is None:
            return None
        begins = ends = flights[-1].ends if flights else known
        num_bytes = 0
        most = min(len(log.lines), begins + MOST_LINES)
        while ends < most and num_bytes < self._paces[to].num_bytes:
            num_bytes += len(log.lines[ends])
            ends += 1
        if ends == begins:
            return None
        before, after = log.revision_at(begins), log.revision_at(ends)
        packed = self._packed.get((owner, before, after))
        if packed is None:
            if not may_pack:
                return None
            self._turn = to
            packed = packed_lines(log.lines[begins:ends], log.lines[:begins])
            self._packed[owner, before, after] = packed
            if len(self._packed) > _MOST_PACKED:
                del self._packed[next(iter(self._packed))]
        ends = begins + packed.num_lines
        is_last = ends == len(log.lines)
        self._flights[to, owner] = [*flights, _Flight(begins, ends, self._session.now, is_last)]
        return Piece(owner, before, packed, is_last)

    def _on_their_way(self, to: str, owner: str, known: int) -> list[_Flight] | None:
        """Pieces that lines may follow now, after those known; None where they may not yet.

        There are none where all have arrived, and where the first was not answered in time.
        """
        now = self._session.now
        sent = self._flights[to, owner]
        flights = [flight for flight in sent if known < flight.ends]
        if flights and known < flights[0].begins:
            flights = []
        pace = self._paces[to]
        pause = pace.pause(now - self._said[to].when, self._session.pause(1))
        if flights and now - flights[0].when >= pause:
            pace.shorten()
            return []
        if flights and (len(flights) == _MOST_FLIGHTS or not flights[-1].is_last):
            return None
        collected_until = (
            sent[-1].when + self._session.pause(1) if sent and sent[-1].is_last else now
        )
        return flights if collected_until <= now else None

    # Solves

    def _solve_if_due(self) -> None:
        """Solve where lines are new, once those that others have announced are there.

        A robot waits for these for as long as it waits for a robot, at first, and later for as long
        as a message takes to be sent again.
        """
        revisions = self.revisions
        if self._is_solving or self.name not in revisions or revisions == self._tried:
            return
        if self._changed_at is None:
            self._changed_at = self._session.now
        is_first = self.last is None
        pause = self._session.patience if is_first else self._session.pause(1)
        is_waited_for = self._session.now - self._changed_at >= pause
        announced = [has.get(name, Revision()) for name, has in self._has.items()]
        is_here = all(each in (Revision(), *revisions.values()) for each in announced)
        if is_first and not self._session.is_complete(revisions):
            return
        if is_here or is_waited_for:
            self._begin(revisions)

    def _begin(self, revisions: Mapping[str, Revision]) -> None:
        """Solve in the process beside the robot."""
        self._tried = revisions
        self._changed_at = None
        self._is_solving = True
        lines = {name: "".join(self.logs[name].lines) for name in revisions}
        solve = partial(self._member.settings.solved, lines, self._member.solution)
        self._session.beside.begin(
            solve,
            lambda answer: self._end(revisions, answer),
            "the measurements cannot be computed with",
        )

    def _end(self, revisions: Mapping[str, Revision], answer: SharedAnswer | PGOError) -> None:
        self._is_solving = False
        self.term = Term(self.term.number + 1, self.name)
        if isinstance(answer, PGOError):
            self._problems = ()
            self.last = Ended(self.term, revisions, (), None, failure=f"failed: {answer}")
            return
        self._problems = answer.problems
        covered = {name: revisions[name] for name in answer.covered}
        absent = tuple(name for name in self._session.team if name not in covered)
        self.last = Ended(self.term, covered, absent, answer.found)
        self._member.outcome = self.last
        self._member.known = answer.own
        self._member.solution = answer.solution


def _lines_of(piece: Piece, log: Measurements) -> list[str]:
    """The lines of a piece; a WireError for bytes that are none, or more than a robot sends."""
    before = log.lines[: piece.before.num_lines]
    return unpacked_lines(piece.lines, before, 4 * MOST_IN_A_PIECE)
