"""A robot of a team that solves together: an object without sockets or a clock.

Whoever has a network gives the robot what arrives (`receive`) and the time (`tick`), and sends what
it has to say (`outbox`). Messages may be lost, late, repeated, or come in any order. Robots tell
each other what they have measured, and each finds the map of all (`SharedMap`). Or every robot
keeps its measurements, and one of them drives the solves of all (`DrivenTeam`).
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from pgo_models.errors import PGOError, SettingError, door
from pgo_models.files import replace_when_done
from pgo_models.geometry.rotations import Array
from pgo_models.problem.weighting import Weighting
from solvers.carry.registry import record
from solvers.carry.serialization import deserialize, serialize
from solvers.carry.wire import packed, unpacked
from solvers.request import Pipeline
from solvers.robots_solution import RobotsSolution
from solvers.robust.consistency import PCM
from solvers.robust.gnc import GNC
from solvers.robust.known import takes_odometry
from solvers.solution import Solution
from solvers.team.driven import DrivenTeam
from solvers.team.measurements import Measurements, Revision
from solvers.team.member import Member
from solvers.team.messages import Ended, Term
from solvers.team.session import PATIENCE, RETRY, Message, Session, TeamLedger
from solvers.team.shared_map import SharedMap
from solvers.team.shared_solve import TeamSettings
from solvers.team.sharing import OwnAnswer, Sharing

_FEWEST_KEY_BYTES = 16  # 128 bits, which nobody can guess


@record("SavedRobot")
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
    others: Mapping[str, Measurements]


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
        What this robot tells others: its MEASUREMENTS, each once, so that every robot solves alone,
        with all that `solve` can: priors and GPS, landmarks, robust solves, covariances. Or its
        INTERFACE, so that its measurements stay with it, which takes many more bytes.
    robust : GNC or PCM, optional
        How the team finds wrong edges. A team that does not share its measurements does it as
        robots with own files do (`solve_folder`).
    trust_folder : bool
        As of `read_g2o`: whether measurements of several robots are taken as they are, also where
        they speak against being of one graph.
    patience : float
        Seconds after which a robot that was not heard of counts as absent.
    retry : float
        Seconds after which a message that was not answered is sent again, at the earliest: links
        may be slow. New measurements are collected for as long.

    Raises
    ------
    SettingError
        For a name that is not in the team, a name twice, a short key, times that are not positive,
        settings that cannot be pickled, or known inliers of robots that do not share their
        measurements.

    Examples
    --------
    Two robots in one process, and a loop in place of a network:

    >>> import time
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
    >>> while not all(robot.is_settled for robot in robots.values()):
    ...     for robot in robots.values():
    ...         robot.tick(time.monotonic())
    ...         for message in robot.outbox():
    ...             robots[message.to].receive(message.data, time.monotonic())
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
        sharing: Sharing = Sharing.MEASUREMENTS,
        robust: GNC | PCM | None = None,
        trust_folder: bool = False,
        patience: float = PATIENCE,
        retry: float = RETRY,
    ) -> None:
        self.name = name
        self.team = tuple(sorted(team))
        _check_settings(name, self.team, key, patience, retry)
        has_known = robust is not None and not takes_odometry(robust.known)
        if has_known and sharing is not Sharing.MEASUREMENTS:
            raise SettingError(
                "a team that does not share its measurements takes its odometry to be right; "
                "other known edges need sharing=Sharing.MEASUREMENTS"
            )
        pipeline = pipeline if pipeline is not None else Pipeline()
        try:
            pickle.dumps((pipeline, robust))
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise SettingError(
                f"{error}; a robot computes in another process, which has copies of its settings"
            ) from error
        self._sharing = sharing
        self._member = Member(TeamSettings(name, pipeline, weighting, robust, trust_folder))
        self._session = Session(name, self.team, key, patience, retry)
        self._way: SharedMap | DrivenTeam
        if sharing is Sharing.MEASUREMENTS:
            self._way = SharedMap(self._member, self._session)
        else:
            self._way = DrivenTeam(self._member, self._session)
        self._session.way = self._way

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
        self._member.measurements.add_pose(pose_id, R, t, fixed)

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
            For shapes that are of no pose, ids beyond 64 bits, an edge to itself, numbers that are
            not finite, and a matrix or precision that is negative.
        """
        self._member.measurements.add_edge(i, j, R, t, information, kappa, tau)

    @door
    def remove_edge(self, i: int, j: int) -> None:
        """Take all measurements of pose j as seen from pose i back that this robot has added.

        Parameters
        ----------
        i, j : int
            Ids of the poses.

        Raises
        ------
        GraphError
            Where there is none.
        """
        self._member.measurements.remove_edge(i, j)

    @door
    def read(self, path: Path | str) -> None:
        """Add the lines of a g2o file: VERTEX lines of this robot's poses, and its EDGE lines.

        Parameters
        ----------
        path : Path or str
            Path of the file. Errors are those of `read_g2o`.
        """
        self._member.measurements.read(Path(path))

    @property
    def revision(self) -> Revision:
        """Which measurements it has: how many lines, and a hash of what they say."""
        return self._member.revision

    # Answers

    @property
    def poses(self) -> dict[int, tuple[Array, Array]]:
        """Rotation (d, d) and position (d,) of every pose of this robot, by id; none before."""
        known = self._member.known
        if known is None:
            return {}
        poses = zip(known.poses.R, known.poses.t, strict=True)
        return dict(zip(known.ids.tolist(), poses, strict=True))

    @property
    def solution(self) -> RobotsSolution | None:
        """What the last solve that succeeded has found, for the robots that are `covered`."""
        return None if self.outcome is None else self.outcome.solution

    @property
    def map(self) -> Solution | None:
        """The last solve of the measurements of all, in teams that share them; else None.

        It has the graph and the poses of all robots that are `covered`, so that any robot can
        compute the certificate again: `certify(robot.map.problem, robot.map.poses)`.
        """
        data = self._member.solution
        return None if data is None else cast(Solution, pickle.loads(data))

    @property
    def covariances(self) -> dict[int, Array]:
        """Covariance (p, p) of every pose of this robot, by id, of teams that share measurements.

        Where they are not known, there are none. They are computed when they are asked for.
        """
        solution = self.map
        if solution is None:
            return {}
        try:
            graph = solution.problem.graph
            ids = graph.pose_ids[graph.in_files].tolist()
            covariances = dict(zip(ids, solution.marginals(), strict=True))
        except PGOError:
            return {}
        return {pose: covariances[pose] for pose in self.poses}

    @property
    def rejected(self) -> list[tuple[int, int]]:
        """Ids of the ends of edges at this robot's poses that a robust solve has left out."""
        known = self._member.known
        return [] if known is None else [(i, j) for i, j in known.rejected.tolist()]

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
    def problems(self) -> list[str]:
        """Sentences on what is wrong with the team, or was left out; none where nothing is.

        They are of messages that arrive: of two robots with one name, of a robot that is not in
        the team, and of one with another key or version. And they are of what the outcome is
        without, as poses of any robot that no edge joins with most of its others.
        """
        return self._session.problems

    @property
    def is_settled(self) -> bool:
        """Whether a solve was of the whole team, and nobody waits for this robot.

        It was of all measurements that this robot has. In teams that keep theirs it may have failed
        (`failure`): nothing is solved again before something is new.
        """
        return self._session.is_settled

    @property
    def is_computing(self) -> bool:
        """Whether it computes, beside the calls, which hand on what it has found."""
        return self._session.beside.is_busy

    @property
    def outcome(self) -> Ended | None:
        """How the last solve that succeeded has ended: which one, of whom, and its `solution`.

        A solve of fewer robots without new measurements does not replace one that is certified.
        """
        return self._member.outcome

    @property
    def last(self) -> Ended | None:
        """How the last solve has ended, also if it has failed (`failure` says why)."""
        return self._way.last

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
        facts += [("problem", problem) for problem in self.problems]
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
        if self.last is not None and self.last is not self.outcome and not self.failure:
            facts.append(("last solve", self.last.text))
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
        revisions = {} if self.outcome is None else self.outcome.revisions
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
            "revisions": {name: str(revision) for name, revision in revisions.items()},
            "problems": self.problems,
            "robust": "" if solution is None else solution.robust,
            "is_certified": self.is_certified,
            "rejected": [list(pair) for pair in self.rejected],
            "sent": dict(self.ledger.sent),
            "received": dict(self.ledger.received),
            "dropped": self.ledger.dropped,
            "dropped_by": dict(self.ledger.dropped_by),
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
        known = self._member.known
        if known is None:
            raise SettingError(f"{self.name} has no poses yet; a solve has to end before")
        text = self._member.measurements.text_at(known.ids, known.poses)
        with replace_when_done(path) as temporary:
            temporary.write_text(text, encoding="utf-8")

    def __repr__(self) -> str:
        size = f"{self.revision.num_lines} lines"
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
        return self._session.outbox()

    def receive(self, data: bytes, now: float) -> None:
        """Take what has arrived: in any order, and any number of times.

        Parameters
        ----------
        data : bytes
            A message of another robot. Other bytes are dropped, and counted.
        now : float
            The time in seconds, of any clock that does not go back.
        """
        self._session.receive(data, now)

    def tick(self, now: float) -> None:
        """Do what is due: say hello, begin a solve, repeat what was not answered, give up.

        Parameters
        ----------
        now : float
            The time in seconds, as for `receive`. Call it a few times in `retry` seconds.
        """
        self._session.tick(now)

    @property
    def others(self) -> list[str]:
        """Names of the other robots."""
        return [name for name in self.team if name != self.name]

    @property
    def heard(self) -> tuple[str, ...]:
        """Names of the other robots that have spoken to this one."""
        return self._session.heard

    @property
    def retry(self) -> float:
        """Seconds after which a message that was not answered is sent again."""
        return self._session.retry

    @property
    def ledger(self) -> TeamLedger:
        """Bytes by robot."""
        return self._session.ledger

    # On disk

    def save(self) -> bytes:
        """Return the measurements and the last outcome as bytes, without the key.

        Those of other robots are among them, as far as this one has them.

        Returns
        -------
        bytes
            What `Robot.load` takes. A solve that is under way begins again.
        """
        saved = Saved(
            self.name,
            self.team,
            self._member.settings.weighting,
            self._sharing,
            self._member.measurements,
            self._way.term,
            self.outcome,
            self._member.known,
            self._way.others,
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
        trust_folder: bool = False,
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
        pipeline, robust, trust_folder, patience, retry
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
            saved = deserialize(unpacked(data))
        except ValueError as error:
            raise SettingError(f"these bytes are no saved robot: {error}") from error
        if not isinstance(saved, Saved):
            raise SettingError(f"these bytes are a {type(saved).__name__}, and no saved robot")
        robot = cls(
            saved.name,
            saved.team,
            key,
            pipeline=pipeline,
            weighting=saved.weighting,
            sharing=saved.sharing,
            robust=robust,
            trust_folder=trust_folder,
            patience=patience,
            retry=retry,
        )
        robot._member.measurements.restore(saved.measurements)
        robot._member.outcome = saved.outcome
        robot._member.known = saved.known
        robot._way.restore(saved.term, saved.outcome, saved.others)
        return robot


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
