"""The answer that robots keep where no process has the graph: the poses of the cheapest attempt.

The driver knows the interface between the robots (`solvers.robots.setup`), and of the answer its
cost and bound. A certificate is of the poses that the robots keep, is made of their sums, and has
neither poses nor multipliers itself. A bound holds for all poses, and so belongs to whatever the
robots keep.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.certificates.certificate import BoundSource, Certificate, judge_cost
from pgo_models.certificates.fit import Fit
from pgo_models.certificates.lower_bound import NO_BOUND, LowerBound
from pgo_models.certificates.rounding_errors import ObjectiveRounding
from pgo_models.errors import PGOError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.problem.weighting import Weighting
from solvers.carry.counted_pool import Count
from solvers.place import BROKEN_OFF, Attempt
from solvers.result import Stage, StageTable, Status
from solvers.robots.driver import CoverPoses, Driver
from solvers.robots.own_file import Answer, keep_answer, move_answer, return_to_answer


@dataclass(frozen=True, eq=False)
class KeptAnswer:
    """The cheapest poses so far, which the robots keep, as the driver knows them.

    `cover` are the poses of the driver, `status` how the run ended that found them.
    """

    objective: float
    decrement: float
    rounding: ObjectiveRounding
    robots: Sequence[Answer]
    cover: CoverPoses
    status: Status


@dataclass(eq=False)
class AnswerAtRobots:
    """The answer to the graph `name`, for a cost and to a relative `gap`, which the robots hold.

    What they keep now is `kept`. Like the robots it changes whenever an attempt is cheaper.
    """

    table: StageTable
    name: str
    gap: float
    weighting: Weighting
    kept: KeptAnswer | None = None

    @property
    def known(self) -> KeptAnswer:
        """What the robots keep, where it is known that they keep something."""
        assert self.kept is not None
        return self.kept

    def certify(self, driver: Driver, attempt: Attempt, bound: LowerBound) -> Attempt:
        """Have the robots keep the current poses if they are the cheapest, and certify the kept."""
        source = BoundSource.GIVEN
        dual = attempt.dual_bound
        if dual is not None and dual.lower_bound > bound.value:
            bound = dual.bound
            source = BoundSource.RELAXATION
        if self.kept is None or driver.current.objective < self.kept.objective:
            robots = driver.network.ask(keep_answer, driver.poses_of_cover(), Count.ROUND)
            self.kept = KeptAnswer(
                driver.current.objective,
                attempt.decrement,
                _sum_of_roundings([robot.rounding for robot in robots]),
                robots,
                driver.current,
                attempt.status,
            )
        return replace(attempt, certificate=self._certificate(bound, source))

    def _certificate(self, bound: LowerBound, source: BoundSource) -> Certificate:
        """Certificate of the poses that the robots keep."""
        kept = self.known
        no_poses = Poses.identity(0, kept.cover.R.shape[2])
        judgement = judge_cost(self.name, kept.objective, kept.rounding, bound, self.gap)
        return judgement.certificate(
            self.gap, kept.decrement, source, no_poses, no_poses.R, self.weighting
        )

    def better(self, best: Attempt, other: Attempt) -> Attempt:
        """Return the poses that the robots keep, with the best bound that either has."""
        highest = max(best.proof, other.proof, key=lambda known: known.lower_bound)
        certificate = self._certificate(highest.bound, highest.source)
        status = other.status if other.status in BROKEN_OFF else self.known.status
        return replace(best, certificate=certificate, status=status)

    def go_back(self, driver: Driver) -> None:
        """Have robots and driver return to the poses that the robots keep."""
        kept = self.known
        driver.network.ask_all(return_to_answer, None, Count.PIGGYBACKED)
        driver.current = kept.cover

    def salvage(self, reason: Status) -> Attempt:
        """The poses that the robots keep; a PGOError where a matrix had no factor before any."""
        if self.kept is None:
            raise PGOError(f"{self.name}: weights too far apart for doubles; see pgo info FILE")
        self.table.add(Stage.without_steps(reason, self.kept.objective))
        certificate = self._certificate(NO_BOUND, BoundSource.GIVEN)
        return Attempt(status=reason, certificate=certificate)

    def move_to_frame(self, driver: Driver, best: Attempt) -> tuple[Attempt, str, float]:
        """Have the robots move the answer to its frame; which that is, and F there.

        A frame far away rounds the poses, so that their cost is found anew: the certificate is of
        the poses that are written.
        """
        kept = self.known
        turn, shift, frame = _frame(kept.robots)
        parts = driver.network.ask_all(move_answer, (turn, shift), Count.ROUND)
        objective = math.fsum(part.cost for part in parts)
        rounding = _sum_of_roundings([part.rounding for part in parts])
        self.kept = replace(kept, objective=objective, rounding=rounding)
        certificate = self._certificate(best.proof.bound, best.proof.source)
        F = math.fsum(part.F for part in parts)
        return replace(best, certificate=certificate), frame, F


def _sum_of_roundings(parts: Sequence[ObjectiveRounding]) -> ObjectiveRounding:
    """How accurately a sum is known of whose parts that is known."""
    level = math.fsum(part.level for part in parts)
    error = math.fsum(part.error for part in parts)
    weights_error = max(part.weights_error for part in parts)
    return ObjectiveRounding(level, error, Fit.of_all(part.fit for part in parts), weights_error)


def _frame(answers: Sequence[Answer]) -> tuple[Array, Array, str]:
    """Motion (R, t) to the frame of the answer, and which frame that is."""
    first = min(answers, key=lambda answer: (not answer.held[0], answer.held[1]))
    d = first.given.shape[1]
    target = np.concatenate([np.zeros((1, d)), np.eye(d)])
    where = "at the identity"
    if np.isfinite(first.given).all():
        target = first.given
        where = "where its file has it"
    R = target[1:].T @ first.solved[1:]
    t = target[0] - R @ first.solved[0]
    return R, t, f"pose {first.held[2]} {where}"
