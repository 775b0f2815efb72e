"""solve_folder(folder): robots load their own files, solve together, and write their own poses; nobody has the whole.

The process that calls it is the driver: it learns the interface between the robots (`solvers.distributed.own_files`),
and of the answer F, its bound and sums.
"""

import math
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pgo_models.certificates.certificate import BoundSource, Certificate, Verdict, judge_cost
from pgo_models.certificates.lower_bound import NO_BOUND
from pgo_models.certificates.rounding_errors import ObjectiveRounding
from pgo_models.errors import NotPositiveDefiniteError, PGOError, SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.datasets import locate
from pgo_models.graphs.g2o import check_g2o_folder, g2o_files
from pgo_models.graphs.measurements import IntArray
from solvers.distributed.checkpoint import Journal
from solvers.distributed.lower_bound import best_bound_distributed
from solvers.distributed.own_files import (
    READ_HERE,
    Answer,
    keep_answer,
    move_answer,
    open_files,
    return_to_answer,
    write_answer,
)
from solvers.distributed.stages import climb_distributed, refine, start_robots
from solvers.loop import Watch
from solvers.network.counted_pool import Count
from solvers.network.engine import Engine, InProcess
from solvers.network.ledger import Ledger
from solvers.network.ray_engine import RayEngine
from solvers.pipeline import Pipeline, finer
from solvers.result import OUT_OF_TIME, Record, Stage, Status
from solvers.riemannian.staircase import Staircase
from solvers.soc.r_step import RStep
from solvers.soc.settings import Coupling
from solvers.soc.soc import SOC


@dataclass(frozen=True, eq=False)
class FolderSolution:
    """What the driver knows of a solve by robots that have own files, and the poses; `sizes` are (2, num_robots)."""

    name: str
    certificate: Certificate  # without poses and multipliers
    sizes: IntArray  # (2, num_robots): how many poses, and edges, every robot has
    stages: tuple[Stage, ...]
    ledger: Ledger
    frame: str  # of the poses that were written
    seconds: float

    @property
    def status(self) -> Status:
        """How the last stage ended."""
        return self.stages[-1].status

    def __str__(self) -> str:
        poses, edges = self.sizes
        facts = [
            ("graph", f"{self.name}: {poses.sum()} poses, {edges.sum()} edges, {self.certificate.poses.d}D"),
            ("status", f"{self.status.name}: {self.status.value}"),
            *self.certificate.facts(),
            ("frame", self.frame),
            ("seconds", f"{self.seconds:.3g}"),
            ("robots", f"{len(poses)}, {poses.min()} to {poses.max()} poses each, as their own files have them"),
            *self.ledger.facts(),
        ]
        return "\n".join(f"{label:<12} {text}" for label, text in facts if text)


def solve_folder(
    folder: Path | str,
    pipeline: Pipeline | None = None,
    *,
    engine: Engine | None = None,
    out: Path | str | None = None,
    callback: Callable[[Any, Record], bool | None] | None = None,
    time_limit: float = math.inf,
    verbose: bool = False,
    progress: bool | None = None,
) -> FolderSolution:
    """Solve and certify F of a folder with one g2o file a robot, of which every robot reads its own, and nobody more.

    A pose belongs to the first file with a VERTEX line of it, else to the first that names it; an edge between two
    robots may stand in the file of either, or of both. Start, SOC, Newton, certificate and staircase are those of
    `solve(.., robots=..)`. CONSENSUS, robust losses, chi2, priors, landmarks and checkpoints take `solve`. A lost robot
    reads its file again, and is told all that it had been told. The frame is that of the first pose with a FIX line, or
    else the first of all, where its file has it.

    `folder` is its path, on every machine where robots run, or its name as of `load`; the calling process reads none of
    it. Robots run where `engine` says, a `RayEngine`, or in this process. To the folder `out`, there, every robot
    writes its poses and edges as 0.g2o, 1.g2o, .., each file whole or not. The other settings, and errors, are as of
    `solve`, with those of `read_g2o`; a SettingError for another first stage.

    Examples
    --------
    >>> solve_folder("robots").certificate.verdict.name
    'CERTIFIED'
    """
    watch, pipeline = Watch(time_limit, verbose, progress, callback), pipeline if pipeline is not None else Pipeline()
    folder, soc, gap = locate(folder).absolute(), pipeline.soc, pipeline.gap
    if soc is not None and (type(soc) is not SOC or soc.effective_coupling is Coupling.CONSENSUS):
        raise SettingError(f"robots with files of their own run SUBSTRUCTURED SOC, got {soc}; {READ_HERE}")
    if soc is not None and (soc.robots is not None or soc.r_step is not RStep.FACTORIZED):
        raise SettingError(f"robots are those of the files, and factor their subproblems, got {soc}; {READ_HERE}")
    files = list(enumerate(g2o_files(folder)))
    if isinstance(engine, RayEngine):  # a process for every robot; snapshots would be here, of all that they have
        recovery = replace(engine.recovery, orders_between_snapshots=sys.maxsize)
        engine = replace(engine, recovery=recovery, actors=engine.actors or len(files))
    if out is not None:
        check_g2o_folder(out, len(files))
    stages: list[Stage] = []
    answers: list[Answer] = []
    bound, source, F, rounding, decrement = NO_BOUND, BoundSource.GIVEN, math.inf, ObjectiveRounding(0.0, 0.0), math.inf
    driver, sizes = open_files(files, engine if engine is not None else InProcess(), pipeline.driver_memory)
    nowhere = Poses(np.zeros((0, driver.d, driver.d)), np.zeros((0, driver.d)))
    with closing(driver), closing(Journal(None, {}, stages)) as journal:
        best, tries = driver.at, [soc, finer(soc or SOC())][: 1 + pipeline.second_try]

        def judged() -> Certificate:
            figures = F, bound, math.nan, rounding.level, decrement, source
            unjudged = Certificate(*figures, nowhere, F, nowhere.R, gap, Verdict.TRIVIAL)
            return judge_cost(folder.name, unjudged, F, rounding)

        try:
            for attempt in (*tries, *([pipeline.staircase] if pipeline.staircase is not None else [])):
                is_climb = isinstance(attempt, Staircase)
                if stages and (stages[-1].status in OUT_OF_TIME if is_climb else not stages[-1].status.is_success):
                    continue
                relaxed = NO_BOUND
                if isinstance(attempt, Staircase):
                    driver.network.ask(return_to_answer, [None] * len(files), Count.PIGGYBACKED)
                    driver.at = best
                    last, dual = climb_distributed(driver, replace(attempt, gap=gap), pipeline.newton, watch, stages)
                    relaxed = dual.bound if dual is not None else NO_BOUND
                else:
                    stages.append(start_robots(driver, None))
                    last = refine(driver, pipeline.newton, journal, watch, attempt)
                bound = max(bound, best_bound_distributed(driver, gap), key=lambda found: found.value)
                source = BoundSource.RELAXATION if relaxed.value > bound.value else BoundSource.GIVEN
                bound = relaxed if source is BoundSource.RELAXATION else bound
                if driver.at.objective < F or not answers:
                    answers, best = driver.network.ask(keep_answer, driver.poses_of_cover(), Count.ROUND), driver.at
                    F, decrement = best.objective, last
                    rounding = ObjectiveRounding(best.rounding_level, math.fsum(answer.error for answer in answers))
                if not judged().can_improve:
                    break
        except NotPositiveDefiniteError as error:
            raise PGOError(f"{folder}: weights too far apart for doubles ({error}); see pgo info FILE") from error
        except KeyboardInterrupt:  # between the loops, which answer it themselves
            if not answers:
                raise
            stages.append(Stage.interruption(F))
        turn, shift, frame = _frame(answers)
        # A frame far away rounds the poses; what is said is of those that are written.
        parts = driver.network.ask(move_answer, [(turn, shift)] * len(files), Count.ROUND)
        F, *rest = map(math.fsum, zip(*parts, strict=True))
        rounding = ObjectiveRounding(*rest)
        certificate = judged()
        if out is not None:
            driver.network.ask(partial(write_answer, Path(out).absolute()), [None] * len(files), Count.PIGGYBACKED)
    told = tuple(stages), driver.network.ledger, frame, time.perf_counter() - watch.began
    return FolderSolution(folder.name, certificate, sizes, *told)


def _frame(answers: Sequence[Answer]) -> tuple[Array, Array, str]:
    """Motion (R, t) to the frame of the answer, and what that is."""
    first = min(answers, key=lambda answer: (not answer.held[0], answer.held[1]))
    has_given, d = bool(np.isfinite(first.given).all()), first.given.shape[1]
    goal = first.given if has_given else np.concatenate([np.zeros((1, d)), np.eye(d)])
    R = goal[1:].T @ first.solved[1:]
    where = "where its file has it" if has_given else "at the identity"
    return R, goal[0] - R @ first.solved[0], f"pose {first.held[2]} {where}"
