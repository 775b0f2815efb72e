"""A place where a solve runs: the verbs that the plan of a solve needs, and what they pass on.

`solvers.plan` says in which order they are called. A place is `solvers.here.Here`, or robots:
`solvers.distributed.robots_of_graph`, `solvers.distributed.robots_alone` and
`solvers.distributed.robots_with_files`.
"""

from __future__ import annotations

import enum
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from pgo_models.certificates.certificate import Certificate
from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from solvers.handedness.complex_relaxation import ComplexRelaxation
from solvers.handedness.hull_lagrangian import HullLagrangian, HullState
from solvers.handedness.search import HandednessSearch
from solvers.loop import RunMonitor
from solvers.network.ledger import Ledger
from solvers.result import OUT_OF_TIME, Stage, Status
from solvers.riemannian.newton import Newton
from solvers.riemannian.prefixes import GrowingStart
from solvers.riemannian.staircase import DualBound, Staircase
from solvers.soc.paper import PaperSOC
from solvers.soc.soc import SOC

if TYPE_CHECKING:  # what a plain solve does not need
    from solvers.robust.gnc import GNC, Inliers

BROKEN_OFF = (*OUT_OF_TIME, Status.STOPPED)
Ending = Callable[[float], Stage]


class Automatic(enum.Enum):
    """What stands for a SOC that the place chooses."""

    AUTO = "SOC with a coarse tolerance, or none where Newton alone is faster"


AUTO = Automatic.AUTO
AnySOC = SOC | PaperSOC
FirstStage = AnySOC | Automatic | None


class Step(enum.Enum):
    """Steps of a solve after its first attempt, each of which may improve the answer."""

    WHOLE = "a whole solve"
    GROWING = "an attempt from a growing start"
    LAST_STEPS = "the last steps of Newton's method"
    SECOND = "a second attempt"
    STAIRCASE = "the Riemannian staircase"
    SMALLER_MATRICES = "smaller information matrices"
    COMPLEX = "the relaxation with complex numbers"
    TERMS = "handedness terms"
    HULLS = "the relaxation with hulls of rotations"


@dataclass(frozen=True, eq=False)
class Attempt:
    """What an attempt to solve a graph has found so far.

    Parameters
    ----------
    poses : Poses or None
        The poses; None before the start, and while robots hold them.
    status : Status
        How the last run ended that looked for poses.
    decrement : float
        Half the squared Newton decrement over the cost at the poses; inf where it was not measured.
    certificate : Certificate or None
        That of the poses, once it was found.
    dual_bound : DualBound or None
        Bound on the semidefinite relaxation that led to the poses, with its multipliers.
    failures : tuple of str
        A sentence on every step that failed, and left the answer as it was.
    not_tried : tuple of Step
        Steps that might have helped, and that the place cannot take.
    """

    poses: Poses | None = None
    status: Status = Status.CONVERGED
    decrement: float = math.inf
    certificate: Certificate | None = None
    dual_bound: DualBound | None = None
    failures: tuple[str, ...] = ()
    not_tried: tuple[Step, ...] = ()

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
        """Whether the certificate has been found."""
        return self.certificate is not None

    @property
    def is_out_of_time(self) -> bool:
        """Whether the time limit or Ctrl-C has ended it."""
        return self.status in OUT_OF_TIME

    @property
    def is_open(self) -> bool:
        """Whether the certificate could still improve, and there is time for it."""
        return self.proof.can_improve and not self.is_out_of_time


def after_search(best: Attempt, certificate: Certificate, stage: Stage) -> Attempt:
    """The same poses after a search for a bound, which counts as an ending if time ran out."""
    status = stage.status if stage.status in OUT_OF_TIME else best.status
    return replace(best, certificate=certificate, status=status)


@dataclass(frozen=True, eq=False)
class Place(ABC):
    """Where a solve runs.

    Each verb takes an attempt and returns the next one; none changes an attempt. Where robots hold
    the poses, an attempt goes on from those that they hold now. The verbs of the first attempt are
    abstract. A place that lacks the verb of a later step says so in `missing`, and does not write
    it; then `way_out` says how to have the step taken.

    Parameters
    ----------
    monitor : RunMonitor
        Time limit, callback and progress of the solve.
    stages : list of Stage
        What was done so far, in order. Stages are appended, also those of attempts whose poses are
        dropped.
    """

    monitor: RunMonitor
    stages: list[Stage]

    @property
    @abstractmethod
    def d(self) -> int:
        """Dimension of the space, 2 or 3."""

    @property
    @abstractmethod
    def has_landmarks(self) -> bool:
        """Whether the graph has landmarks."""

    @property
    def ledger(self) -> Ledger | None:
        """What has crossed the network so far; None in one process."""
        return None

    @property
    def missing(self) -> frozenset[Step]:
        """Steps that cannot be taken here, though they might help."""
        return frozenset()

    @property
    def way_out(self) -> str:
        """How to have the missing steps taken."""
        return ""

    def note(self, best: Attempt) -> str:
        """Say which steps failed and, where the gap is too wide, which ones are missing."""
        sentences = list(best.failures)
        if best.not_tried and not best.proof.is_certified:
            steps = ", ".join(step.value for step in best.not_tried)
            sentences.append(f"not tried here: {steps}; {self.way_out}")
        return "; ".join(sentences)

    @abstractmethod
    def start(self, given: Poses | None, soc: FirstStage) -> tuple[Attempt, AnySOC | None]:
        """Find a start, or take the given one; with it goes the SOC to run from there, if any.

        AUTO leaves SOC out where Newton alone is faster.
        """

    @abstractmethod
    def run_soc(self, attempt: Attempt, soc: Any) -> Attempt:  # noqa: ANN401 - as `start` chose it
        """Run SOC from the poses, which stay where SOC finds none that cost less."""

    @abstractmethod
    def run_newton(self, attempt: Attempt, newton: Newton) -> Attempt:
        """Run Newton down to rounding level, on the cost that is asked for."""

    @abstractmethod
    def certify(self, attempt: Attempt) -> Attempt:
        """Find the certificate at the poses as they are."""

    @property
    @abstractmethod
    def has_poses(self) -> bool:
        """Whether there is an answer when the first attempt is interrupted now."""

    @abstractmethod
    def salvage(self, ending: Ending) -> Attempt:
        """Return what there is when the first attempt is broken off, with no bound but F >= 0.

        `ending` makes the stage that says why, from the cost of the poses.
        """

    def finish(self, best: Attempt) -> None:
        """Put away what would only serve to go on with a solve that was broken off."""
        return  # nothing was put aside

    def run_gnc(self, gnc: GNC, start: Poses | None) -> Inliers:
        """Find wrong edges by graduated non-convexity, from a start or along known inliers."""
        raise self._refusal("graduated non-convexity")

    def better(self, best: Attempt, other: Attempt) -> Attempt:
        """Return the cheaper poses with the best bound that either has: after any other step."""
        raise self._refusal(Step.SECOND.value)

    def start_grown(self, growing: GrowingStart) -> Attempt | None:
        """Start at poses that prefixes of the graph lead to; None where it has no prefixes."""
        raise self._refusal(Step.GROWING.value)

    def start_again(self) -> Poses | None:
        """Return where a second attempt starts without SOC; None where it runs SOC once more."""
        raise self._refusal(Step.SECOND.value)

    def climb(self, best: Attempt, staircase: Staircase) -> Attempt | None:
        """Solve the semidefinite relaxation from the best poses, and round its solution to poses.

        None where the cost is not convex and quadratic, and so has no such relaxation.
        """
        raise self._refusal(Step.STAIRCASE.value)

    def bound_by_smaller_matrices(self, best: Attempt) -> Attempt:
        """Return the same poses, with the bound of smaller information matrices if it is better."""
        raise self._refusal(Step.SMALLER_MATRICES.value)

    def solve_in_complex_numbers(self, best: Attempt, method: ComplexRelaxation) -> Attempt:
        """Solve the relaxation with planar rotations as complex numbers.

        Returned are the better poses and the better bound.
        """
        raise self._refusal(Step.COMPLEX.value)

    def bound_by_terms(
        self, best: Attempt, search: HandednessSearch, Pi: Array | None = None
    ) -> Attempt:
        """Return the same poses, with the bound of handedness terms if it is better.

        The ascent begins with the terms of the multipliers Pi, (pairs, 4, 4), or with none.
        """
        raise self._refusal(Step.TERMS.value)

    def hulls(self, search: HandednessSearch) -> HullLagrangian | None:
        """Return the method for the relaxation with hulls of rotations, if it suits the graph."""
        raise self._refusal(Step.HULLS.value)

    def solve_hulls(
        self, best: Attempt, method: HullLagrangian, start: HullState | None
    ) -> tuple[Attempt, HullState]:
        """Solve that relaxation, from a state of it or the best poses.

        Returned are the better poses and the better bound, and the state that it ends at.
        """
        raise self._refusal(Step.HULLS.value)

    def _refusal(self, step: str) -> SettingError:
        return SettingError(f"{step} cannot be taken here; {self.way_out}")
