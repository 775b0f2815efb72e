"""A robot of a team that solves together: an object without sockets, threads or a clock.

Whoever has a network gives the robot what arrives (`receive`) and the time (`tick`), and sends what
it has to say (`outbox`). Every robot keeps its own measurements. The robot whose name comes first
among those that are awake drives: it runs the solve of robots with files of their own
(`solvers.solves.folder_solve`), and learns the interface between the robots. What two robots tell
each other goes from one to the other. Any robot can drive. Messages may be lost, late, repeated, or
come in any order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pgo_models.errors import EngineError, PGOError, SettingError, door, extra_module
from pgo_models.files import replace_when_done
from pgo_models.geometry.rotations import Array
from pgo_models.problem.weighting import Weighting
from solvers.carry.serialization import deserialize, serialize
from solvers.request import Pipeline
from solvers.robots.own_file import READ_HERE
from solvers.robots.setup import SOLVE_PARTS
from solvers.robots_solution import RobotsSolution
from solvers.robust.consistency import PCM
from solvers.robust.gnc import GNC
from solvers.robust.known import takes_odometry
from solvers.team.agent import OwnAnswer, Sharing, TeamAgent
from solvers.team.driving import Drive
from solvers.team.letters import LetterName, Letters
from solvers.team.measurements import Measurements
from solvers.team.messages import (
    MESSAGES,
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
from solvers.team.wire import WireError, opened, packed, records_of_rooms, sealed, unpacked

PATIENCE = 10.0  # seconds without a sign of a robot, after which it counts as absent
RETRY = 1.0  # seconds after which a message without an answer is sent again
# Patiences after which a robot that is there, and has not answered, is waited for no more.
_MOST_PATIENCES = 10.0
# Share of its patience after which a robot says again that it is there.
_SHARE_OF_PATIENCE = 0.25
_FEWEST_KEY_BYTES = 16  # 128 bits, which nobody can guess


class Message(NamedTuple):
    """A message to be sent: the robot that it is for, its bytes, and what goes first."""

    to: str
    data: bytes
    priority: Priority


@dataclass(frozen=True, eq=False)
class TeamLedger:
    """Bytes that a robot has handed out for others and received from them, by robot.

    `messages` counts those handed out, `dropped` those received that were none of the team.
    """

    sent: Mapping[str, int] = field(default_factory=dict)
    received: Mapping[str, int] = field(default_factory=dict)
    messages: int = 0
    dropped: int = 0

    def after_sending(self, message: Message) -> TeamLedger:
        """Return the ledger after one more message."""
        sent = _with_more(self.sent, message.to, len(message.data))
        return replace(self, sent=sent, messages=self.messages + 1)

    def after_receiving(self, robot: str, data: bytes) -> TeamLedger:
        """Return the ledger after a message of another robot."""
        return replace(self, received=_with_more(self.received, robot, len(data)))

    def after_dropping(self) -> TeamLedger:
        """Return the ledger after bytes that were no message of the team."""
        return replace(self, dropped=self.dropped + 1)


def _with_more(counts: Mapping[str, int], name: str, more: int) -> Mapping[str, int]:
    return {**counts, name: counts.get(name, 0) + more}


@dataclass(frozen=True)
class Envelope:
    """A message and who it is from and to."""

    sender: str
    receiver: str
    message: object


@dataclass(frozen=True, eq=False)
class Saved:
    """What `Robot.save` keeps."""

    name: str
    team: tuple[str, ...]
    weighting: Weighting
    sharing: Sharing
    measurements: Measurements
    term: Term
    outcome: Ended | None
    known: OwnAnswer | None


@dataclass(eq=False)
class _Part:
    """The part of this robot in a solve: its agent, and its last answer, which may be lost.

    `waiting` is an order that waits for letters of other robots; `members` are these by place.
    """

    agent: TeamAgent
    revision: int
    letters: Letters
    members: tuple[str, ...]
    call: int = -1
    reply: Reply | None = None
    waiting: Ask | None = None


class Robot:
    """A robot of a team, with its measurements, its messages, and what is known of its poses.

    Parameters
    ----------
    name : str
        Name of the robot, unique in the team.
    team : sequence of str
        Names of all robots of the team, with its own.
    key : bytes
        Secret of the team, 16 bytes or more, which seals messages.
    pipeline : Pipeline, optional
        Settings of a solve that this robot drives.
    weighting : Weighting
        Cost of such a solve: F, chi2, or the own one of the measurements.
    sharing : Sharing
        What this robot tells others: its INTERFACE, so that its measurements stay with it, or its
        MEASUREMENTS, compressed, which mostly are fewer bytes. Then the robot that drives solves
        alone, with all that `solve` can: priors and GPS, landmarks, robust solves, covariances.
    robust : GNC or PCM, optional
        How the team finds wrong edges. A team that does not share its measurements does it as
        robots with own files do (`solve_folder`).
    patience : float
        Seconds after which a robot that was not heard of counts as absent.
    retry : float
        Seconds after which a message that was not answered is sent again.

    Attributes
    ----------
    outcome : Ended, optional
        How the last solve that succeeded has ended: which one it was, who took part with which
        measurements, and the `solution`.
    last : Ended, optional
        How the last solve has ended, also if it has failed (`failure` says why).
    ledger : TeamLedger
        Bytes by robot.

    Raises
    ------
    SettingError
        For a name that is not in the team, a name twice, a short key, times that are not positive,
        or known inliers of robots that do not share their measurements.
    MissingExtraError
        Without the package greenlet, which the extra `team` brings.

    Examples
    --------
    Two robots in one process, and a loop in place of a network:

    >>> import numpy as np
    >>> key = b"sixteen or more bytes"
    >>> robots = {name: Robot(name, ["a", "b"], key) for name in ("a", "b")}
    >>> ahead = np.array([1.0, 0.0])
    >>> for name, first in (("a", 0), ("b", 2)):
    ...     robots[name].add_pose(first)
    ...     robots[name].add_pose(first + 1)
    ...     robots[name].add_edge(first, first + 1, np.eye(2), ahead, kappa=100.0, tau=100.0)
    >>> robots["a"].add_edge(1, 2, np.eye(2), ahead, kappa=100.0, tau=100.0)
    >>> robots["b"].add_edge(3, 0, np.eye(2), np.array([-2.9, 0.0]), kappa=100.0, tau=100.0)
    >>> for step in range(200):
    ...     now = 0.1 * step
    ...     for robot in robots.values():
    ...         robot.tick(now)
    ...         for message in robot.outbox():
    ...             robots[message.to].receive(message.data, now)
    >>> robots["b"].solution.verdict.name, robots["b"].covered
    ('CERTIFIED', ('a', 'b'))
    >>> sorted(robots["b"].poses)
    [2, 3]
    """

    @door
    def __init__(
        self,
        name: str,
        team: Sequence[str],
        key: bytes,
        *,
        pipeline: Pipeline | None = None,
        weighting: Weighting = Weighting.OWN,
        sharing: Sharing = Sharing.INTERFACE,
        robust: GNC | PCM | None = None,
        patience: float = PATIENCE,
        retry: float = RETRY,
    ) -> None:
        self.name = name
        self.team = tuple(sorted(team))
        extra_module("greenlet", "team")  # which a solve needs
        _check_settings(name, self.team, key, patience, retry)
        self._key = key
        self._pipeline = pipeline if pipeline is not None else Pipeline()
        self._weighting = weighting
        self._sharing = sharing
        self._robust = robust
        has_known = robust is not None and not takes_odometry(robust.known)
        if has_known and sharing is not Sharing.MEASUREMENTS:
            raise SettingError(
                "a team that does not share its measurements takes its odometry to be right; "
                "other known edges need sharing=Sharing.MEASUREMENTS"
            )
        self._patience = patience
        self.retry = retry
        self._measurements = Measurements()
        # The others: when each was last heard of, and the revision of its measurements.
        self._last_heard: dict[str, float] = {}
        self._revisions: dict[str, int] = {}
        self._began: float | None = None
        self._hello_at = -np.inf  # when hello was said to all, and to those that are not awake
        self._sought_at = -np.inf
        self._said_revision = -1
        self._sent_at: dict[str, float] = {}  # when the last ask or outcome was sent to each
        self._waits_since: float | None = None  # for answers to the orders under way
        self._term = Term(0, "")
        self._part: _Part | None = None
        self._drive: Drive | None = None
        self._tried: dict[str, int] | None = None  # revisions of the robots in the last solve
        self._unheard: dict[str, Ended] = {}  # robots that have not confirmed the outcome
        self._out: list[Message] = []
        self._known: OwnAnswer | None = None
        self.last: Ended | None = None
        self.outcome: Ended | None = None
        self.ledger = TeamLedger()

    # Measurements

    @door
    def add_pose(
        self,
        pose_id: int,
        R: Array | None = None,
        t: Array | None = None,
        *,
        fixed: bool = False,
    ) -> None:
        """Add a pose of this robot; its position is where the answer is placed if it is `fixed`.

        Parameters
        ----------
        pose_id : int
            Id of the pose, unique in the team.
        R : Array, (d, d), optional
            Estimate of its rotation; the identity unless given.
        t : Array, (d,), optional
            Estimate of its position, metres; the origin unless given.
        fixed : bool
            Whether the frame of the answer is that of this pose.
        """
        self._measurements.add_pose(pose_id, R, t, fixed)

    @door
    def add_edge(
        self,
        i: int,
        j: int,
        R: Array,
        t: Array,
        *,
        information: Array | None = None,
        kappa: float | None = None,
        tau: float | None = None,
    ) -> None:
        """Add a measurement of pose j as seen from pose i; either may be another robot's.

        Parameters
        ----------
        i, j : int
            Ids of the poses.
        R : Array, (d, d)
            Measured rotation.
        t : Array, (d,)
            Measured position of j in the frame of i, metres.
        information : Array, (3, 3) or (6, 6), optional
            Information matrix, of (x, y, theta) or (x, y, z, rotation).
        kappa, tau : float, optional
            Precisions in place of a matrix, per radian^2 and metre^2. They are those of F
            (`weighting=Weighting.ISOTROPIC`); the matrix that stands for them is that of
            `write_g2o`, of which `Weighting.OWN` is chi2.

        Raises
        ------
        SettingError
            Unless there is either a matrix or both precisions.
        GraphError
            For shapes that are of no pose.
        """
        self._measurements.add_edge(i, j, R, t, information, kappa, tau)

    @door
    def read(self, path: Path | str) -> None:
        """Add the lines of a g2o file: VERTEX lines of this robot's poses, and its EDGE lines.

        Parameters
        ----------
        path : Path or str
            Path of the file. Errors are those of `read_g2o`.
        """
        self._measurements.read(Path(path))

    @property
    def revision(self) -> int:
        """How many lines its measurements are, so that others notice when it has more."""
        return len(self._measurements.lines)

    # Answers

    @property
    def poses(self) -> dict[int, tuple[Array, Array]]:
        """Rotation (d, d) and position (d,) of every pose of this robot, by id; none before."""
        if self._known is None:
            return {}
        poses = self._known.poses
        return dict(zip(self._known.ids.tolist(), zip(poses.R, poses.t, strict=True), strict=True))

    @property
    def solution(self) -> RobotsSolution | None:
        """What the last solve that succeeded has found, for the robots that are `covered`."""
        return None if self.outcome is None else self.outcome.solution

    @property
    def covariances(self) -> dict[int, Array]:
        """Covariance (p, p) of every pose of this robot, by id, of teams that share measurements.

        Where they are not known, there are none.
        """
        if self._known is None or self._known.covariances is None:
            return {}
        return dict(zip(self._known.ids.tolist(), self._known.covariances, strict=True))

    @property
    def rejected(self) -> list[tuple[int, int]]:
        """Ids of the ends of edges at this robot's poses that a robust solve has left out."""
        if self._known is None:
            return []
        return [(i, j) for i, j in self._known.rejected.tolist()]

    @property
    def covered(self) -> tuple[str, ...]:
        """Robots whose measurements the last outcome holds for."""
        return () if self.outcome is None else self.outcome.covered

    @property
    def absent(self) -> tuple[str, ...]:
        """Robots of the team that the last outcome is without."""
        return self.team if self.outcome is None else self.outcome.absent

    @property
    def failure(self) -> str:
        """What went wrong in the last solve; empty if nothing did. `outcome` is one before it."""
        return "" if self.last is None else self.last.failure

    @property
    def is_settled(self) -> bool:
        """Whether the last solve was of the whole team, and nobody waits for this robot.

        It was of all measurements that this robot has.
        """
        last = self.last
        if last is None or last.absent or last.revisions.get(self.name) != self.revision:
            return False
        return self._drive is None and not self._unheard and not self._out

    @property
    def is_certified(self) -> bool:
        """Whether the last outcome is certified, for the robots that it covers."""
        return self.solution is not None and self.solution.is_certified

    def facts(self) -> list[tuple[str, str]]:
        """Return what is known, as it is printed, with labels.

        Returns
        -------
        list of (str, str)
            Pairs of a label and a text.
        """
        facts = [("robot", f"{self.name} of {', '.join(self.team)}")]
        facts.append(("failure", self.failure))
        solution = self.solution
        if solution is None:
            facts.append(("outcome", "none: no solve has succeeded"))
        else:
            facts += solution.certificate.facts()
            left_out = ", ".join(f"{i} to {j}" for i, j in self.rejected)
            facts += [("closures", solution.robust), ("left out", left_out)]
            facts += [("covered", ", ".join(self.covered)), ("note", solution.note)]
            facts += [("stages", ", ".join(_names_of_stages(solution)))]
            facts += [("rounds", str(solution.ledger.rounds))]
        facts.append(("absent", ", ".join(self.absent)))
        sent = sum(self.ledger.sent.values())
        received = sum(self.ledger.received.values())
        traffic = f"{sent} sent, {received} received, {self.ledger.dropped} messages dropped"
        facts.append(("bytes", traffic))
        return [(label, text) for label, text in facts if text]

    def as_json(self) -> dict[str, object]:
        """Return what is known as JSON has it.

        Returns
        -------
        dict
            Names, cost, bound, verdict, who is covered and absent, and bytes by robot.
        """
        solution = self.solution
        known: dict[str, object] = {}
        if solution is not None:
            certificate = solution.certificate
            known = {
                "cost": certificate.cost,
                "objective": certificate.objective,
                "lower_bound": certificate.lower_bound,
                "proven_gap": certificate.proven_gap,
                "verdict": certificate.verdict.name,
            }
        return {
            "robot": self.name,
            "team": list(self.team),
            **known,
            "covered": list(self.covered),
            "absent": list(self.absent),
            "rounds": 0 if solution is None else solution.ledger.rounds,
            "stages": [] if solution is None else _names_of_stages(solution),
            "note": "" if solution is None else solution.note,
            "failure": self.failure,
            "revisions": {} if self.outcome is None else dict(self.outcome.revisions),
            "robust": "" if solution is None else solution.robust,
            "is_certified": self.is_certified,
            "rejected": [list(pair) for pair in self.rejected],
            "sent": dict(self.ledger.sent),
            "received": dict(self.ledger.received),
            "dropped": self.ledger.dropped,
        }

    def write(self, path: Path | str) -> None:
        """Write this robot's poses and edges as a g2o file; the poses are those of the outcome.

        Parameters
        ----------
        path : Path or str
            Path of the file. Errors are those of `write_g2o`.

        Raises
        ------
        SettingError
            When there are no poses yet.
        """
        if self._known is None:
            raise SettingError(f"{self.name} has no poses yet; a solve has to end before")
        text = self._measurements.text_at(self._known.ids, self._known.poses)
        with replace_when_done(path) as temporary:
            temporary.write_text(text, encoding="utf-8")

    def __repr__(self) -> str:
        size = f"{self.revision} lines"
        solution = self.solution
        if solution is None:
            return f"Robot({self.name!r}, {size}, {self.failure or 'no outcome yet'})"
        held = "" if solution.is_held else "DOUBTFUL, "
        verdict = f"{held}{solution.verdict.name}"
        return f"Robot({self.name!r}, {size}, {verdict}, covered={self.covered})"

    # Messages

    def outbox(self) -> list[Message]:
        """Hand out what is to be sent, what others wait for first.

        Returns
        -------
        list of Message
            Messages, each once; those that are not answered come again.
        """
        messages = sorted(self._out, key=lambda message: message.priority)
        self._out = []
        for message in messages:
            self.ledger = self.ledger.after_sending(message)
        return messages

    def receive(self, data: bytes, now: float) -> None:
        """Take what has arrived: in any order, and any number of times.

        Parameters
        ----------
        data : bytes
            A message of another robot. Other bytes are dropped, and counted.
        now : float
            The time in seconds, of any clock that does not go back.
        """
        try:
            envelope = opened(self._key, data, (Envelope, OwnAnswer, *MESSAGES))
            if not isinstance(envelope, Envelope) or envelope.receiver != self.name:
                raise WireError("a message for another robot")
            if envelope.sender not in self.team or envelope.sender == self.name:
                raise WireError("a message of nobody in the team")
        except WireError:
            self.ledger = self.ledger.after_dropping()
            return
        sender = envelope.sender
        self.ledger = self.ledger.after_receiving(sender, data)
        self._last_heard[sender] = now
        self._take(sender, envelope.message, now)

    def _take(self, sender: str, message: object, now: float) -> None:
        """Update what is known of the team by a message, or obey the order in it."""
        if isinstance(message, Hello):
            self._revisions[sender] = max(message.revision, self._revisions.get(sender, 0))
            self._learn_term(message.term)
        elif isinstance(message, Ask):
            self._obey(sender, message)
        elif isinstance(message, Reply):
            self._take_reply(sender, message, now)
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
        """Do what is due: say hello, begin a solve, repeat what was not answered, give up.

        Parameters
        ----------
        now : float
            The time in seconds, as for `receive`. Call it a few times in `retry` seconds.
        """
        if self._began is None:
            self._began = now
        awake = self._awake(now)
        self._say_hello(now, awake)
        if self._drive is not None:
            self._go_on_driving(now, awake)
        if self._drive is None and awake[0] == self.name and self._is_time(now, awake):
            self._begin_drive(awake, now)
        for name, outcome in list(self._unheard.items()):
            if name not in awake:
                del self._unheard[name]
            elif now - self._sent_at.get(name, -np.inf) >= self.retry:
                self._sent_at[name] = now
                self._send(name, outcome, Priority.NORMAL)

    @property
    def others(self) -> list[str]:
        """Names of the other robots."""
        return [name for name in self.team if name != self.name]

    def _awake(self, now: float) -> tuple[str, ...]:
        """Robots that were heard of lately, and this one, in the order of their names."""
        awake = []
        for name in self.team:
            last = self._last_heard.get(name, -np.inf)
            if name == self.name or now - last <= self._patience:
                awake.append(name)
        return tuple(awake)

    def _say_hello(self, now: float, awake: tuple[str, ...]) -> None:
        """Say hello, often to those that are not awake, now and then and with more lines to all."""
        is_due = now - self._hello_at >= _SHARE_OF_PATIENCE * self._patience
        is_due |= self._said_revision != self.revision
        seeks = now - self._sought_at >= self.retry
        for name in self.others:
            if (seeks and name not in awake) or (is_due and name in awake):
                self._send(name, Hello(self.revision, self._term), Priority.NORMAL)
        if is_due:
            self._hello_at = now
            self._said_revision = self.revision
        if seeks:
            self._sought_at = now

    def _send(self, to: str, message: object, priority: Priority) -> None:
        data = sealed(self._key, Envelope(self.name, to, message))
        self._out.append(Message(to, data, priority))

    def _learn_term(self, term: Term) -> None:
        """Give up a solve that another robot has overtaken, and solve again if this one drives."""
        if term > self._term:
            self._term = term
            self._part = None
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

        Robots without measurements are waited for, too.
        """
        assert self._began is not None
        revisions = self._current_revisions(awake)
        has_waited = now - self._began >= self._patience
        is_ready = len(awake) == len(self.team) or has_waited
        return is_ready and min(revisions.values()) > 0 and revisions != self._tried

    def _current_revisions(self, awake: tuple[str, ...]) -> dict[str, int]:
        others = {name: self._revisions.get(name, 0) for name in awake if name != self.name}
        return {self.name: self.revision, **others}

    def _begin_drive(self, awake: tuple[str, ...], now: float) -> None:
        self._tried = self._current_revisions(awake)
        self._unheard.clear()  # of the last outcome: there will be another one
        self._term = Term(self._term.number + 1, self.name)
        agent = self._new_agent(0)
        members = (self.name, *(name for name in awake if name != self.name))
        self._part = _Part(agent, self.revision, Letters(0), members)
        self._drive = Drive(
            self._term, members, agent, self._pipeline, self._weighting, self._robust
        )
        self._drive.begin()
        self._after_step(now)

    def _go_on_driving(self, now: float, awake: tuple[str, ...]) -> None:
        """Ask again where no answer came, and give up where a robot has gone.

        A robot that is there and does not answer, as one that cannot read the order, ends the
        solve with an error.
        """
        assert self._drive is not None
        if not set(self._drive.needed) <= set(awake):
            self._give_up()
            return
        if self._waits_since is None:  # a step may have taken longer than any patience
            self._waits_since = now
        if now - self._waits_since > _MOST_PATIENCES * self._patience:
            self._end_without_answers(now)
            return
        for name, ask in self._drive.waiting.items():
            if now - self._sent_at.get(name, -np.inf) >= self.retry:
                self._sent_at[name] = now
                self._send(name, ask, Priority.URGENT)

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
                name, Reply(ask.term, ask.call, self._revisions.get(name, 0), None, error)
            )
        self._after_step(now)

    def _take_reply(self, sender: str, reply: Reply, now: float) -> None:
        if self._drive is not None and reply.term == self._drive.term:
            if self._tried is not None:
                self._tried[sender] = reply.revision
            before = self._drive.call
            self._drive.take(sender, reply)
            if self._drive.call != before or self._drive.outcome is not None:
                self._after_step(now)

    def _after_step(self, now: float) -> None:
        """Send what the page of the solve asks for, or its outcome if it has ended."""
        drive = self._drive
        assert drive is not None
        self._waits_since = None
        for name, ask in drive.waiting.items():
            self._sent_at[name] = now
            self._send(name, ask, Priority.URGENT)
        if drive.outcome is None:
            return
        self._drive = None
        absent = tuple(name for name in self.team if name not in drive.members)
        assert self._tried is not None
        outcome = _ended(drive, absent, self._tried)
        self._end_with(outcome)
        self._unheard = {name: outcome for name in drive.members[1:]}
        for name in self._unheard:
            self._sent_at[name] = now
            self._send(name, outcome, Priority.NORMAL)

    # Following

    def _obey(self, sender: str, ask: Ask) -> None:
        """Obey an order once, and answer it as often as it is asked."""
        if ask.term.driver != sender or ask.term < self._term:
            self._send(sender, Hello(self.revision, self._term), Priority.NORMAL)
            return
        if ask.term > self._term:
            self._learn_term(ask.term)
        if ask.call > (0 if self._part is None else self._part.call + 1):
            self._have_all_begin_again(ask.term)
            return
        if self._part is None:
            if self._measurements.d is None:
                return
            agent = self._new_agent(ask.place)
            self._part = _Part(agent, self.revision, Letters(ask.place), ask.members)
        part = self._part
        if ask.call == part.call + 1:
            lost = self._answer(part, ask)
            if part.waiting is not None:  # asked again: the letters should be here by now
                for name in lost:
                    message = LetterLost(ask.term, name.call, part.letters.place)
                    self._send(part.members[name.other], message, Priority.URGENT)
            part.waiting = ask if lost else None
        elif ask.call == part.call and part.reply is not None:
            self._send(sender, part.reply, Priority.URGENT)

    def _have_all_begin_again(self, term: Term) -> None:
        """Tell the robot that drives that this one has begun anew and has lost its part."""
        self._term = Term(term.number + 1, self.name)
        self._send(term.driver, Hello(self.revision, self._term), Priority.URGENT)

    def _answer(self, part: _Part, ask: Ask) -> set[LetterName]:
        """Obey an order and send the answer, and letters with it, unless letters are missing."""
        request, missing = part.letters.put_in(ask.request)
        if missing:
            return missing
        part.call = ask.call
        try:
            answer = ask.order.function()(part.agent, request)
        except PGOError as error:
            part.reply = Reply(ask.term, ask.call, part.revision, None, error_as_message(error))
        else:
            answer, letters = part.letters.take_out(ask.call, answer)
            part.reply = Reply(ask.term, ask.call, part.revision, answer)
            for name in letters:
                self._send_letter(part, ask.term, name)
        self._send(ask.term.driver, part.reply, Priority.URGENT)
        return missing

    def _send_letter(self, part: _Part, term: Term, name: LetterName) -> None:
        letter = Letter(term, name.call, part.letters.place, part.letters.sent[name])
        self._send(part.members[name.other], letter, Priority.URGENT)

    def _take_letter(self, letter: Letter) -> None:
        """Keep a letter, and obey the order that has waited for it."""
        part = self._part
        if part is None or letter.term != self._term:
            return
        part.letters.received[LetterName(letter.place, letter.call)] = letter.content
        if part.waiting is not None and not self._answer(part, part.waiting):
            part.waiting = None

    def _repeat_letter(self, lost: LetterLost) -> None:
        """Send a letter again."""
        if lost.term != self._term:
            return
        name = LetterName(lost.place, lost.call)
        if self._part is None or name not in self._part.letters.sent:
            self._have_all_begin_again(lost.term)
            return
        self._send_letter(self._part, lost.term, name)

    def _take_outcome(self, sender: str, outcome: Ended) -> None:
        if outcome.term == self._term and outcome.term.driver == sender:
            if self.last is None or self.last.term != outcome.term:
                if self._part is None and outcome.solution is not None:
                    self._have_all_begin_again(outcome.term)  # its poses are lost
                    return
                self._end_with(outcome)
            self._send(sender, Heard(outcome.term), Priority.NORMAL)

    def _end_with(self, outcome: Ended) -> None:
        """Keep an outcome and the poses with it; where a solve has failed, those before it."""
        self.last = outcome
        answer = None if self._part is None else self._part.agent.answer
        if outcome.solution is not None and answer is not None:
            self.outcome = outcome
            self._known = answer

    def _new_agent(self, place: int) -> TeamAgent:
        """The part of this robot in a solve, with its measurements as they are now."""
        return TeamAgent(place, self.name, self._measurements.text(), self._sharing)

    # On disk

    def save(self) -> bytes:
        """Return the measurements and the last outcome as bytes, without the key.

        Returns
        -------
        bytes
            What `Robot.load` takes. A solve that is under way begins again.
        """
        saved = Saved(
            self.name,
            self.team,
            self._weighting,
            self._sharing,
            self._measurements,
            self._term,
            self.outcome,
            self._known,
        )
        return packed(serialize(saved))

    @classmethod
    def load(
        cls,
        data: bytes,
        key: bytes,
        *,
        pipeline: Pipeline | None = None,
        robust: GNC | PCM | None = None,
        patience: float = PATIENCE,
        retry: float = RETRY,
    ) -> Robot:
        """Return a robot that `save` has made bytes of.

        Cost and sharing are as saved; the settings of solves that it drives are given again.

        Parameters
        ----------
        data : bytes
            The bytes.
        key : bytes
            Secret of the team.
        pipeline, robust, patience, retry
            As of `Robot`.

        Returns
        -------
        Robot
            With the same measurements, outcome and poses.

        Raises
        ------
        SettingError
            For other bytes.
        """
        try:
            saved = deserialize(unpacked(data), (*records_of_rooms(), *MESSAGES, *_SAVED))
        except ValueError as error:
            raise SettingError(f"these bytes are no saved robot: {error}") from error
        robot = cls(
            saved.name,
            saved.team,
            key,
            pipeline=pipeline,
            weighting=saved.weighting,
            sharing=saved.sharing,
            robust=robust,
            patience=patience,
            retry=retry,
        )
        saved_measurements = saved.measurements
        robot._measurements = Measurements(list(saved_measurements.lines), saved_measurements.d)
        robot._term = saved.term
        robot.outcome = saved.outcome
        robot.last = saved.outcome
        robot._known = saved.known
        return robot


_SAVED = (Measurements, OwnAnswer, Saved, Sharing, Weighting)


def _names_of_stages(solution: RobotsSolution) -> list[str]:
    """Names of the stages that were taken."""
    return [stage.name for stage in solution.stages if stage.was_taken]


def _check_settings(
    name: str, team: tuple[str, ...], key: bytes, patience: float, retry: float
) -> None:
    if len(set(team)) < len(team):
        raise SettingError(f"the team {', '.join(team)} has a name twice; give each robot its own")
    if name not in team:
        raise SettingError(f"{name!r} is not in the team {', '.join(team)}; add it")
    if not isinstance(key, bytes) or len(key) < _FEWEST_KEY_BYTES:
        raise SettingError(
            f"the key of a team is bytes, {_FEWEST_KEY_BYTES} or more: secrets.token_bytes(32)"
        )
    if not (patience > 0.0 and retry > 0.0):
        raise SettingError(f"patience is {patience} and retry {retry}; give positive seconds")


def _ended(drive: Drive, absent: tuple[str, ...], revisions: Mapping[str, int]) -> Ended:
    """How a solve has ended."""
    outcome = drive.outcome
    if isinstance(outcome, RobotsSolution):
        return Ended(drive.term, revisions, absent, outcome.without_histories)
    # What robots with own files lack, a team that shares its measurements has; and parts may meet.
    text = str(outcome).replace(READ_HERE, "robots that share their measurements can")
    text = text.replace(SOLVE_PARTS, "an edge between them joins them")
    return Ended(drive.term, revisions, absent, None, failure=f"failed: {text}")
