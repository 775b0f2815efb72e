"""The place where robots solve that have read their own files: no process has the whole graph.

The driver knows the interface between the robots (`solvers.robots.setup`), and of the
answer its cost and bound. The robots keep the poses of the cheapest attempt so far. A certificate
is always of the poses that they keep then, and has neither poses nor multipliers itself. A bound
holds for all poses, and so belongs to whatever they keep.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

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
from solvers.place import (
    BROKEN_OFF,
    AnySOC,
    Attempt,
    Ending,
    OwnStart,
    Step,
    Traits,
)
from solvers.result import Status
from solvers.riemannian.staircase import Staircase
from solvers.robots.driver import CoverPoses
from solvers.robots.own_file import (
    READ_HERE,
    Answer,
    keep_answer,
    move_answer,
    return_to_answer,
)
from solvers.robots.place import DriverPlace
from solvers.robots.proof import best_bound_distributed
from solvers.robots.revision import go_to_poses_found


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


@dataclass(frozen=True, eq=False)
class RobotsWithFiles(DriverPlace):
    """A solve by robots with own files: of the folder `name`, to a relative `gap`.

    `kept` are the answers that the robots have kept; the last one is their current answer. With
    `begins_at`, the name of a start, the solve begins at earlier poses of the robots. While the map
    `is_on_the_way` to another one, shifts of the bound that cost more than the gap are not tried.
    """

    name: str
    gap: float
    weighting: Weighting
    kept: list[KeptAnswer] = field(default_factory=list)
    begins_at: str | None = None
    is_on_the_way: bool = False

    @property
    def traits(self) -> Traits:
        """What the driver knows of them; files with landmarks are refused when they are read."""
        driver = self.driver
        return Traits(
            d=driver.d,
            num_poses=driver.num_poses,
            num_bodies=driver.num_poses,
            has_translations=driver.has_translations,
            is_quadratic=not driver.has_two_costs,
            is_chi2=driver.has_two_costs,
            averages=driver.can_average,
            has_robots=True,
        )

    def lacks(self, step: Step) -> str:
        """Why a step cannot be taken: most need one process with the graph of all robots."""
        if step is Step.SECOND and self.begins_at is not None:
            return "there is no other start"
        return "" if step in (Step.SECOND, Step.STAIRCASE) else "no process has the graph"

    @property
    def way_out(self) -> str:
        """How to have the missing steps taken."""
        return READ_HERE

    def start(self, start: Poses | OwnStart, soc: AnySOC | None) -> Attempt:
        """Start at poses that the robots know of, or else at the own start of robots.

        Nobody could give the poses of all robots.
        """
        assert isinstance(start, OwnStart)
        if self.begins_at is None:
            return self.own_start(start)
        return self.begin(self.begins_at, partial(go_to_poses_found, self.driver))

    def certify(self, attempt: Attempt) -> Attempt:
        """Find a bound, and have the robots keep the current poses if these are the cheapest."""
        driver = self.driver
        goes_on = self.is_on_the_way and not attempt.is_out_of_time
        most_lost = self.gap * driver.current.objective if goes_on else None
        bound = best_bound_distributed(driver, self.gap, most_lost)
        source = BoundSource.GIVEN
        dual = attempt.dual_bound
        if dual is not None and dual.lower_bound > bound.value:
            bound = dual.bound
            source = BoundSource.RELAXATION
        if not self.kept or driver.current.objective < self.kept[-1].objective:
            robots = driver.network.ask(keep_answer, driver.poses_of_cover(), Count.ROUND)
            answer = KeptAnswer(
                driver.current.objective,
                attempt.decrement,
                _sum_of_roundings([robot.rounding for robot in robots]),
                robots,
                driver.current,
                attempt.status,
            )
            self.kept.append(answer)
        return replace(attempt, certificate=self.certificate_of_kept(bound, source))

    def certificate_of_kept(self, bound: LowerBound, source: BoundSource) -> Certificate:
        """Certificate of the poses that the robots keep."""
        kept = self.kept[-1]
        no_poses = Poses.identity(0, self.driver.d)
        judgement = judge_cost(self.name, kept.objective, kept.rounding, bound, self.gap)
        return Certificate(
            objective=judgement.objective,
            bound=judgement.bound,
            gap=judgement.gap,
            rounding_level=kept.rounding.level,
            stationarity=kept.decrement,
            source=source,
            poses=no_poses,
            poses_objective=kept.objective,
            Lambda=no_poses.R,
            wanted_gap=self.gap,
            verdict=judgement.verdict,
            weighting=self.weighting,
            objective_error=kept.rounding.error,
            fit=kept.rounding.fit,
            weights_error=kept.rounding.weights_error,
        )

    def better(self, best: Attempt, other: Attempt) -> Attempt:
        """Return the poses that the robots keep, with the best bound that either has."""
        highest = max(best.proof, other.proof, key=lambda known: known.lower_bound)
        certificate = self.certificate_of_kept(highest.bound, highest.source)
        status = other.status if other.status in BROKEN_OFF else self.kept[-1].status
        return replace(best, certificate=certificate, status=status)

    def start_again(self) -> Poses | None:
        """A second attempt runs SOC once more."""
        return None

    def climb(self, best: Attempt, staircase: Staircase) -> Attempt:
        """Have the robots climb from the poses that they keep."""
        driver = self.driver
        kept = self.kept[-1]
        driver.network.ask(return_to_answer, [None] * len(kept.robots), Count.PIGGYBACKED)
        driver.current = kept.cover
        return self.climb_from_current(staircase)

    @property
    def has_poses(self) -> bool:
        """Whether the robots have kept any."""
        return bool(self.kept)

    def salvage(self, ending: Ending) -> Attempt:
        """The poses that the robots keep; a PGOError where a matrix had no factor before any."""
        if not self.kept:
            raise PGOError(f"{self.name}: weights too far apart for doubles; see pgo info FILE")
        stage = ending(self.kept[-1].objective)
        self.table.add(stage)
        certificate = self.certificate_of_kept(NO_BOUND, BoundSource.GIVEN)
        return Attempt(status=stage.status, certificate=certificate)

    def move_to_frame(self, best: Attempt) -> tuple[Attempt, str, float]:
        """Have the robots move the answer to its frame; which that is, and F there.

        A frame far away rounds the poses, so that their cost is found anew: the certificate is of
        the poses that are written.
        """
        kept = self.kept[-1]
        turn, shift, frame = _frame(kept.robots)
        network = self.driver.network
        parts = network.ask(move_answer, [(turn, shift)] * len(kept.robots), Count.ROUND)
        objective = math.fsum(part.cost for part in parts)
        rounding = _sum_of_roundings([part.rounding for part in parts])
        self.kept.append(replace(kept, objective=objective, rounding=rounding))
        certificate = self.certificate_of_kept(best.proof.bound, best.proof.source)
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
