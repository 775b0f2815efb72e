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
from typing import NamedTuple

import numpy as np

from pgo_models.errors import PGOError
from solvers.carry.wire import WireError
from solvers.team.measurements import Measurements, Revision
from solvers.team.member import Member
from solvers.team.messages import Ended, Hello, Priority, Term
from solvers.team.news import News, Piece
from solvers.team.pace import MOST_IN_A_PIECE, Correspondence
from solvers.team.packed_lines import MOST_LINES, PackedLines, packed_lines, unpacked_lines
from solvers.team.session import Session
from solvers.team.shared_solve import SharedAnswer, SolverBeside

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


class _Status(NamedTuple):
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
        self._statuses: dict[str, _Status] = {}
        self._reachable: set[str] = set()
        # Lines that were packed last, by owner and revisions between which they are: most are for
        # all others, of which some are a little ahead.
        self._packed: dict[tuple[str, Revision, Revision], PackedLines] = {}
        self._packed_for = ""  # the robot that lines were packed for last: others come first
        # What is on its way, by receiver and owner, and the last piece of all.
        self._flights: defaultdict[tuple[str, str], list[_Flight]] = defaultdict(list)
        # By robot and run.
        self._talks: defaultdict[tuple[str, bytes], Correspondence] = defaultdict(Correspondence)
        # By the robot that lacks lines, and the one that has measured them.
        self._lacking_since: dict[tuple[str, str], float] = {}
        # When robots whose pieces have come are to have an answer: pieces are collected, too.
        self._answers_due: dict[str, float] = {}
        self._keep_theirs: set[str] = set()
        self._solver = SolverBeside(member.settings, session.beside)
        self._changed_at: float | None = None
        self._seconds_of_solve = 0.0  # of the last solve
        self._problems: tuple[str, ...] = ()

    @property
    def _revisions_of_others(self) -> dict[str, Mapping[str, Revision]]:
        """What each of the others has that is within reach."""
        return {
            name: status.has for name, status in self._statuses.items() if name in self._reachable
        }

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
        if outcome is None or outcome.absent or self._solver.is_solving or self._answers_due:
            return False
        revisions = self.revisions
        oldest = self._session.now - _FORGOTTEN * self._session.patience
        waited_for = [status for status in self._statuses.values() if status.when >= oldest]
        is_tried = not self._solver.has_not_tried(revisions)
        return is_tried and all(status.has == revisions for status in waited_for)

    # Lines

    def greeting(self, to: str = "") -> News:
        """What tells others that this robot is there; short where one robot knows the rest."""
        if to:
            return self._news(to, ())
        return News(
            self.revisions,
            tuple(self._revisions_of_others),
            (),
            self._takes_back,
            self._session.twins,
        )

    def _talk(self, to: str) -> Correspondence:
        return self._talks[to, self._session.boot_of(to)]

    def _news(self, to: str, pieces: tuple[Piece, ...]) -> News:
        """The greeting to a robot, with pieces, and as the answer to those that have come."""
        now = self._session.now
        talk = self._talk(to)
        theirs = self.logs[to].revision if to in self.logs else Revision()
        has_all = talk.last_number >= 0 and talk.num_told == theirs.num_lines == talk.num_checked
        news = replace(
            self.greeting(),
            pieces=pieces,
            answers=talk.last_number,
            is_prompt=not talk.is_answered,
            has_all=has_all,
        )
        talk.is_answered = True
        if self._is_told(to, news):
            has = {} if has_all or not theirs.num_lines else {to: theirs}
            news = replace(news, has=has, hears=(), twins=(), is_short=True)
        if news.is_short and not pieces:
            return news
        return replace(news, sent=talk.number(replace(news, pieces=()), self._num_lines, now))

    def _is_told(self, to: str, news: News) -> bool:
        """Whether a robot has answered a message with all of this one but a last piece of lines.

        Lines of others are told again now and then only where this robot does not hear them: those
        who do would pass them on.
        """
        talk = self._talk(to)
        told = {(each.hears, each.twins) for each in talk.told}
        if told != {(news.hears, news.twins)} or news.takes_back:
            return False
        if not news.pieces:
            return all(each.has == news.has for each in talk.told)
        is_of_all = len(news.hears) == len(self._session.team) - 1
        if not is_of_all and self._session.now >= talk.told_at + self._session.patience:
            return False
        known = self._statuses[to].has.get(self.name, Revision())
        is_last = [piece.is_last for piece in news.pieces if piece.owner == self.name] == [True]
        return is_last and len(news.pieces) == 1 and known.num_lines <= talk.num_known

    @property
    def _num_lines(self) -> int:
        return len(self._member.measurements.lines)

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
        for piece in message.pieces:
            self._learn(sender, piece, is_latest)
            pause = self._session.pause(1) / 2 if piece.is_last else 0.0
            when = min(self._session.now + pause, self._answers_due.get(sender, np.inf))
            self._answers_due[sender] = when
        if is_latest:
            self._statuses[sender] = self._status_from(sender, message)
            self._reachable.add(sender)
            if message.takes_back:
                self._give_back(sender, message.has.get(sender, Revision()))

    def _status_from(self, sender: str, news: News) -> _Status:
        """What a robot has and hears; of its own it has all lines that a short message brings."""
        now = self._session.now
        talk = self._talk(sender)
        has = dict(news.has)
        hears = news.hears
        num_known = talk.note_answer(news, now, self._session.pause(1))
        if num_known is not None:
            has[self.name] = self._member.measurements.revision_at(num_known)
        log = self.logs.get(sender, Measurements())
        if not news.is_short and log.begins_with(has.get(sender, Revision())):
            talk.num_checked = max(talk.num_checked, has.get(sender, Revision()).num_lines)
        before = self._statuses.get(sender)
        if news.is_short and before is not None:
            for piece in news.pieces:
                ends = piece.before.num_lines + piece.lines.num_lines
                revision = log.revision
                has[sender] = revision if revision.num_lines == ends else Revision(ends)
            has = {**before.has, **has}
            hears = before.hears
        if news.sent >= 0:
            talk.last_number = news.sent
            talk.num_told = has.get(sender, Revision()).num_lines
            talk.is_answered = talk.is_answered and not news.pieces
        return _Status(has, hears, now)

    def _learn(self, sender: str, piece: Piece, is_latest: bool) -> None:
        """Add lines to those of a robot; of its own that robot alone decides which stand."""
        if piece.owner == self.name:
            self._take_back(piece)
            return
        log = self.logs.setdefault(piece.owner, Measurements())
        talk = self._talk(sender)
        begins = piece.before.num_lines
        is_own = sender == piece.owner
        is_checked = is_own and not piece.before.digest and begins <= talk.num_checked
        if not is_checked and not log.begins_with(piece.before):
            return
        lines = _lines_of(piece, log)
        _add_lines(log, begins, lines, is_final=is_own and is_latest, is_last=piece.is_last)
        ends = begins + len(lines)
        if is_own and log.lines[begins:ends] == lines:
            talk.num_checked = max(talk.num_checked, ends)

    def _take_back(self, piece: Piece) -> None:
        """Take lines that this robot had measured after it was saved."""
        if not self._takes_back or piece.before != self.saved:
            return
        own = self._member.measurements
        own.end_at(piece.before.num_lines, _lines_of(piece, own))
        self.saved = self._member.revision

    def _give_back(self, owner: str, saved: Revision) -> None:
        """Give a robot that was restored from an older state its lines since then."""
        log = self.logs.get(owner)
        if log is None or len(log.lines) <= saved.num_lines:
            return
        if not log.begins_with(saved):  # they are of a run that it does not go on from
            log.end_at(saved.num_lines, [])
            return
        piece = self._piece(owner, log, saved.num_lines, owner, may_pack=True)
        if piece is not None:
            self._session.send(owner, self._news(owner, (piece,)), Priority.NORMAL)

    def tick(self, awake: tuple[str, ...]) -> None:
        """Send what others lack, and solve where something is new."""
        self._reachable &= set(awake)
        self._answers_due = {
            name: when for name, when in self._answers_due.items() if name in awake
        }
        before = next(reversed(self._packed), None)
        for name in sorted(self._reachable, key=lambda name: (name <= self._packed_for, name)):
            # Lines are packed once in a tick, as that takes its time; the next robot has the next.
            may_pack = next(reversed(self._packed), None) == before
            piece = self._piece_for(name, awake, may_pack)
            # Where lines for the robot are being collected, they take the answer along.
            sent = self._flights[name, self.name]
            is_coming = (
                bool(sent) and sent[-1].is_last and sent[-1].ends < len(self.logs[self.name].lines)
            )
            delay = self._session.pause(1) / 2 if is_coming else 0.0
            is_due = self._answers_due.get(name, np.inf) + delay <= self._session.now
            if piece is not None or is_due:
                self._answers_due.pop(name, None)
                priority = Priority.HELLO if piece is None else Priority.NORMAL
                pieces = () if piece is None else (piece,)
                self._session.send(name, self._news(name, pieces), priority)
        self._solver.begin_anew_in_fork()
        is_new = self._solver.has_not_tried(self.revisions)
        if is_new and self._solver.tell(self.logs, self._end):
            self._solve_if_due()

    def _piece_for(self, to: str, awake: tuple[str, ...], may_pack: bool) -> Piece | None:
        """Lines that a robot lacks: this robot's, or those of another that it does not hear."""
        has = self._statuses[to].has
        for owner, log in self.logs.items():
            known = has.get(owner, Revision())
            if owner == to or known == log.revision or not log.lines:
                self._lacking_since.pop((to, owner), None)
                continue
            is_known = log.begins_with(known)
            begins = known.num_lines if is_known else 0
            if owner != self.name and not self._passes_on(to, owner, known, awake):
                continue
            may_come_back = not is_known and known.num_lines > len(log.lines)
            if owner == self.name and self._takes_back and may_come_back:
                continue
            piece = self._piece(to, log, begins, owner, may_pack)
            if piece is not None:
                return piece if is_known else replace(piece, is_last=True)
        return None

    def _passes_on(self, to: str, owner: str, known: Revision, awake: tuple[str, ...]) -> bool:
        """Whether to tell a robot what a third one has measured, which it does not hear.

        One after the other would do it, the first robot that is awake at once for one that is gone:
        others may have met a moment later.
        """
        log = self.logs[owner]
        if owner in self._statuses[to].hears or known.num_lines >= len(log.lines):
            return False
        since = self._lacking_since.setdefault((to, owner), self._session.now)
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
        while ends < most and num_bytes < self._talk(to).pace.num_bytes:
            num_bytes += len(log.lines[ends])
            ends += 1
        if ends == begins:
            return None
        before, after = log.revision_at(begins), log.revision_at(ends)
        packed = self._packed.get((owner, before, after))
        if packed is None:
            if not may_pack:
                return None
            self._packed_for = to
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
        pace = self._talk(to).pace
        pause = pace.pause(now - self._statuses[to].when, self._session.pause(1))
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
        as a message takes to be sent again, or as the last solve took. While lines are missing it
        makes a first attempt alone: a search for more would be for a map that is soon replaced.
        """
        revisions = self.revisions
        solver = self._solver
        if solver.is_solving or self.name not in revisions:
            return
        if self._changed_at is None:
            self._changed_at = self._session.now
        is_first = self.last is None
        pause = max(self._session.pause(1), self._seconds_of_solve)
        if is_first:
            pause = self._session.patience
        is_waited_for = self._session.now - self._changed_at >= pause
        announced = [has.get(name, Revision()) for name, has in self._revisions_of_others.items()]
        is_here = all(each in (Revision(), *revisions.values()) for each in announced)
        if is_first and not self._session.is_complete(revisions):
            return
        if is_here or is_waited_for:
            self._changed_at = None
            solver.solve(revisions, in_full=is_here)

    def _end(self, answer: SharedAnswer | PGOError) -> None:
        revisions = self._solver.tried
        self.term = Term(self.term.number + 1, self.name)
        if isinstance(answer, PGOError):
            self._problems = ()
            self.last = Ended(self.term, revisions, (), None, failure=f"failed: {answer}")
            return
        self._problems = answer.problems
        covered = {name: revisions[name] for name in answer.covered}
        absent = tuple(name for name in self._session.team if name not in covered)
        self.last = Ended(self.term, covered, absent, answer.summary)
        self._member.outcome = self.last
        self._member.known = answer.own
        self._member.solution = answer.solution
        self._seconds_of_solve = answer.summary.seconds


def _add_lines(
    log: Measurements, begins: int, lines: list[str], *, is_final: bool, is_last: bool
) -> None:
    """Add lines after the first ones of a log.

    Only what is final stands in place of other lines, and ends the log where it is the last.
    """
    ends = begins + len(lines)
    known = log.lines[begins:ends]
    if known != lines[: len(known)]:
        if is_final:
            log.end_at(begins, lines)
    elif len(log.lines) < ends:
        log.end_at(begins + len(known), lines[len(known) :])
    elif is_final and is_last and len(log.lines) > ends:
        log.end_at(ends, [])


def _lines_of(piece: Piece, log: Measurements) -> list[str]:
    """The lines of a piece; a WireError for bytes that are none, or more than a robot sends."""
    before = log.lines[: piece.before.num_lines]
    return unpacked_lines(piece.lines, before, 4 * MOST_IN_A_PIECE)
