"""A robust solve by robots with own files: passes of graduated non-convexity, each from a map.

`solvers.robots.revision` makes a pass, and `solvers.plan` solves for the edges that it keeps. No
process has the graph, so that attempts and clusters of `solvers.robust_solves.robust_solve` are
missing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from solvers.place import Attempt
from solvers.plan import solve_at
from solvers.request import Pipeline
from solvers.robots.kept_answer import AnswerAtRobots
from solvers.robots.place import PlaceOfRobots
from solvers.robots.revision import ComesBack, Pass, revised
from solvers.robots.setup import OpenedFiles
from solvers.robust.gnc import GNC
from solvers.robust_solves.attempts import TIGHT_SCALES, with_tight_thresholds


@dataclass(frozen=True, eq=False)
class RobotsAnswer:
    """What was found so far: robots with the edges kept, their place, and the attempt there."""

    opened: OpenedFiles
    place: PlaceOfRobots
    best: Attempt
    rejected_by: str = "do not agree pairwise with others"

    @property
    def holder(self) -> AnswerAtRobots:
        """The robots, as holders of the answer."""
        assert isinstance(self.place.holder, AnswerAtRobots)
        return self.place.holder

    @property
    def name_of_poses(self) -> str:
        """Name of the robots' poses, for the stage that starts at them."""
        return self.place.begins_at or "poses found before GNC"

    def solved_from(self, start: str, pipeline: Pipeline) -> RobotsAnswer:
        """The answer solved for from poses that the robots have found, the start of this name."""
        anew = replace(self.holder, kept=None)
        place = replace(self.place, driver=self.opened.driver, holder=anew, begins_at=start)
        return replace(self, place=place, best=solve_at(place, pipeline, None))


def answer_by_passes(
    opened: OpenedFiles, place: PlaceOfRobots, gnc: GNC, pipeline: Pipeline
) -> RobotsAnswer:
    """The answer by a first attempt, and passes of GNC, each from the poses of the one before.

    The first attempt is of the edges that agree pairwise, and GNC continues from it in either case.
    After a certified attempt one last pass judges the edges near its poses, with the settings of
    the pass before. Otherwise passes judge the edges that agree pairwise, then all edges, then all
    edges with tighter thresholds; with `gnc.consistent` every pass judges those that agree. The
    `threshold_scale` of the robots multiplies the thresholds. If the last attempt is not certified,
    the other steps of the pipeline follow.
    """
    newton_alone = pipeline.with_newton_alone(pipeline.newton)
    place = replace(place, is_on_the_way=True)
    best = solve_at(place, replace(newton_alone, soc=pipeline.soc), None)
    answer = RobotsAnswer(opened, place, best)
    scale = answer.opened.threshold_scale
    settings = gnc if scale == 1.0 else with_tight_thresholds(gnc, scale)
    tight = [with_tight_thresholds(settings, factor) for factor in TIGHT_SCALES]
    all_edges, near = ComesBack.EVERYTHING, ComesBack.NEAR
    if gnc.consistent:
        all_edges = near = ComesBack.AGREEING
    without_map = [(settings, ComesBack.AGREEING)]
    without_map += [(each, all_edges) for each in (settings, *tight)]
    is_first = True
    while not answer.best.is_out_of_time:
        has_map = answer.best.proof.is_certified
        if has_map:
            comes_back = near
        elif without_map:
            settings, comes_back = without_map.pop(0)
        else:
            break
        answer = _after_pass(answer, Pass(settings, comes_back, has_map, is_first), newton_alone)
        if has_map:
            break
        is_first = False
    if not (answer.best.proof.is_certified or answer.best.is_out_of_time):
        answer = replace(answer, place=replace(answer.place, is_on_the_way=False))
        answer = answer.solved_from(answer.name_of_poses, replace(pipeline, soc=None))
    return answer


def _after_pass(answer: RobotsAnswer, job: Pass, pipeline: Pipeline) -> RobotsAnswer:
    """The answer after one pass and another solve.

    If the pass finds nothing better, that solve is of the edges before.
    """
    revision = revised(answer.opened, job, answer.place.monitor)
    answer.place.table.add(revision.stage)
    start = "poses of GNC" if revision.is_better else answer.name_of_poses
    answer = replace(answer, opened=revision.opened)
    if revision.is_better:
        answer = replace(answer, rejected_by="the map of the others contradicts")
    return answer.solved_from(start, pipeline)
