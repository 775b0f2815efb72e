"""A place where a solve runs: the verbs that the plan of a solve needs, and what they pass on.

`solvers.plan` says in which order they are called. A place is `solvers.here.Here`, or robots
with a driver (`solvers.robots.place`) or without one (`solvers.robots.place_without_driver`).
"""

from __future__ import annotations

import enum
import math
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from pgo_models.certificates.certificate import Certificate
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from solvers.carry.ledger import NOTHING_SENT, Ledger
from solvers.handedness.complex_relaxation import ComplexRelaxation
from solvers.handedness.hull_lagrangian import HullLagrangian, HullState
from solvers.handedness.search import HandednessSearch
from solvers.loop import RunMonitor
from solvers.result import OUT_OF_TIME, Stage, StageTable, Status
from solvers.riemannian.newton import Newton
from solvers.riemannian.prefixes import GrowingStart
from solvers.riemannian.staircase import DualBound, Staircase
from solvers.soc.paper import PaperSOC
from solvers.soc.soc import SOC

if TYPE_CHECKING:  # what a plain solve does not need
    from solvers.robust.gnc import GNC, Inliers

BROKEN_OFF = (*OUT_OF_TIME, Status.STOPPED)
# Of the search for a bound after the time limit or Ctrl-C; then the first eta that proves something
# ends it.
SECONDS_FOR_BOUND = 0.1


class Automatic(enum.Enum):
    """What stands for a SOC that the place chooses."""

    AUTO = "SOC with a coarse tolerance, or none where Newton alone is faster"


AUTO = Automatic.AUTO
AnySOC = SOC | PaperSOC
FirstStage = AnySOC | Automatic | None


class OwnStart(enum.Enum):
    """Starts that an attempt finds itself, where it is given no poses."""

    CHORDAL = "chordal start"
    AVERAGED = "averaged start"
    TREE = "spanning tree"


class Step(enum.Enum):
    """Steps of a solve after its first attempt, each of which may improve the answer.

    The value names a step that was skipped or failed. A step that is one stage has the name of that
    stage.
    """

    AGAIN = "complete solve"
    GROWING = "growing start"
    STARTS = "other starts"
    LAST_STEPS = "last steps of Newton"
    STAIRCASE = "Staircase"
    SMALLER_MATRICES = "smaller matrices"
    COMPLEX = "ComplexRelaxation"
    TERMS = "HandednessAscent"
    HULLS = "HullLagrangian"


@dataclass(frozen=True)
class Traits:
    """What the page asks about a graph and its cost, whoever has the graph."""

    d: int  # dimension of the space, 2 or 3
    num_poses: int  # number of poses and landmarks
    num_bodies: int  # number of poses that are no landmarks
    has_translations: bool  # False of rotations alone
    # whether SOC and the semidefinite relaxation are of the cost itself, and not of its convex part
    is_quadratic: bool
    is_chi2: bool  # whether smaller information matrices may give a better bound
    averages: bool  # whether rotations of the plane can be averaged for a start
    has_landmarks: bool = False
    has_robots: bool = False  # whether robots run the attempts
    has_driver: bool = True  # whether Newton and the certificate can be run


@dataclass(frozen=True, eq=False)
class Attempt:
    """The state of an attempt to solve a graph."""

    poses: Poses | None = None  # the poses; None before the start, and while robots hold them
    status: Status = Status.CONVERGED  # how the last run ended that looked for poses
    # half the squared Newton decrement over the cost at the poses; inf where it was not measured
    decrement: float = math.inf
    certificate: Certificate | None = None  # that of the poses; None before the attempt has ended
    # bound on the semidefinite relaxation that led to the poses, with its multipliers
    dual_bound: DualBound | None = None
    # A sentence on every step that failed. Such a step does not change the answer.
    failures: tuple[str, ...] = ()
    hulls: HullState | None = None  # where the relaxation with hulls of rotations was last solved

    @property
    def known_poses(self) -> Poses:
        """The poses, where it is known that there are any."""
        assert self.poses is not None
        return self.poses

    @property
    def proof(self) -> Certificate:
        """The certificate, where it is known that there is one."""
        assert self.certificate is not None
        return self.certificate

    @property
    def has_certificate(self) -> bool:
        """Whether there is a certificate, with which an attempt ends."""
        return self.certificate is not None

    @property
    def is_out_of_time(self) -> bool:
        """Whether the time limit or Ctrl-C has ended it."""
        return self.status in OUT_OF_TIME

    @property
    def is_open(self) -> bool:
        """Whether the certificate could still improve, and there is time for it."""
        return is_open(self.proof, self.status)


def is_open(certificate: Certificate, status: Status) -> bool:
    """Whether an answer could still improve, and neither a time limit nor Ctrl-C has ended it."""
    return certificate.can_improve and status not in OUT_OF_TIME


def after_search(best: Attempt, certificate: Certificate, stage: Stage) -> Attempt:
    """The attempt after a search for a bound; its status is the search's if time ran out."""
    status = stage.status if stage.status in OUT_OF_TIME else best.status
    return replace(best, certificate=certificate, status=status)


@dataclass(frozen=True, eq=False)
class Place(ABC):
    """Where a solve runs.

    Each verb takes an attempt and returns the next one; none changes an attempt. Where robots hold
    the poses, an attempt goes on from those that they hold now. `lacks` says which steps cannot be
    taken at a place, and why.
    """

    monitor: RunMonitor  # time limit, callback and progress of the solve
    table: StageTable  # where every stage is written down when it has ended

    @property
    @abstractmethod
    def traits(self) -> Traits:
        """What the page asks about the graph and its cost."""

    @property
    def ledger(self) -> Ledger:
        """What has crossed the network so far: nothing in one process."""
        return NOTHING_SENT

    @property
    def way_out(self) -> str:
        """How to have the steps taken that this place cannot take."""
        return ""

    def note(self, best: Attempt) -> str:
        """Say, where the gap is too wide, which steps failed, and which were skipped and why."""
        if best.proof.is_certified:
            return ""
        sentences = list(best.failures)
        if best.is_out_of_time and self.traits.has_driver and best.proof.can_improve:
            sentences.append("out of time for a bound; a longer search may prove more")
        skipped: dict[str, list[str]] = {}
        for stage in self.table.stages:
            if not stage.was_taken:
                skipped.setdefault(stage.reason, []).append(stage.name)
        if skipped:
            parts = [f"{', '.join(names)} ({reason})" for reason, names in skipped.items()]
            sentences.append(f"not tried: {', '.join(parts)}")
            sentences += [self.way_out] if self.way_out else []
        return "; ".join(sentences)

    @abstractmethod
    def start(self, start: Poses | OwnStart, soc: AnySOC | None) -> Attempt:
        """Take the given start, or find one; `soc` is the SOC that will run from there, if any."""

    @property
    def odometry_joins(self) -> bool:
        """Whether every pose but the first has an edge to an earlier one."""
        return False

    def lacks(self, step: Step) -> str:
        """Why no graph could have a step taken here, in a few words; "" where some could."""
        return ""

    @abstractmethod
    def run_soc(self, attempt: Attempt, soc: Any) -> Attempt:  # noqa: ANN401 - as the page chose it
        """Run SOC from the poses, and return to them if its poses cost more."""

    @abstractmethod
    def run_newton(self, attempt: Attempt, newton: Newton) -> Attempt:
        """Run Newton down to rounding level, on the cost that is asked for."""

    def proof_deadline(self, attempt: Attempt) -> float:
        """When the search for a bound ends: soon after the time limit, or after Ctrl-C."""
        is_interrupted = attempt.status is Status.INTERRUPTED
        ended = time.perf_counter() if is_interrupted else self.monitor.deadline
        return ended + SECONDS_FOR_BOUND

    @abstractmethod
    def certify(self, attempt: Attempt) -> Attempt:
        """Find the certificate at the poses as they are."""

    @property
    @abstractmethod
    def has_poses(self) -> bool:
        """Whether there is an answer when the first attempt is interrupted now."""

    @abstractmethod
    def salvage(self, reason: Status) -> Attempt:
        """Return what there is when the first attempt is broken off, with no bound but F >= 0."""

    def finish(self, best: Attempt) -> None:
        """Put away what would only serve to go on with a solve that was broken off."""
        return  # nothing was put aside

    @abstractmethod
    def run_gnc(self, gnc: GNC, start: Poses | None) -> Inliers:
        """Find wrong edges by graduated non-convexity, from a start or along known inliers."""

    @abstractmethod
    def better(self, best: Attempt, other: Attempt) -> Attempt:
        """Return the cheaper poses with the best bound that either has: after any other step."""

    @abstractmethod
    def start_grown(self, growing: GrowingStart) -> Attempt:
        """Start at poses that prefixes of the graph lead to."""

    @abstractmethod
    def try_other_starts(self, best: Attempt, newton: Newton) -> Attempt:
        """Return the better of the answer and an attempt from the best of some other starts."""

    @abstractmethod
    def climb(self, best: Attempt, staircase: Staircase) -> Attempt:
        """Solve the semidefinite relaxation from the best poses, and round its solution."""

    @abstractmethod
    def bound_by_smaller_matrices(self, best: Attempt) -> Attempt:
        """Return the same poses, with the bound of smaller information matrices if it is better."""

    @abstractmethod
    def solve_in_complex_numbers(self, best: Attempt, method: ComplexRelaxation) -> Attempt:
        """Solve the relaxation with planar rotations as complex numbers.

        Returned are the better poses and the better bound.
        """

    @abstractmethod
    def bound_by_terms(
        self, best: Attempt, search: HandednessSearch, Pi: Array | None = None
    ) -> Attempt:
        """Return the same poses, with the bound of handedness terms if it is better.

        The ascent begins with the terms of the multipliers Pi, (pairs, 4, 4), or with none.
        """

    @abstractmethod
    def terms_can_help(self, best: Attempt) -> bool:
        """Whether `bound_by_terms` may raise the bound."""

    @abstractmethod
    def solve_hulls(self, best: Attempt, method: HullLagrangian) -> Attempt:
        """Solve the relaxation with hulls of rotations, from where it was last solved.

        The first time it begins at the best poses. Returned are the better poses and the better
        bound, with the state that the method ends at.
        """
