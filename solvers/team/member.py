"""What a robot of a team brings into its solves, how it solves when it drives, and what it keeps.

Robots that share their interface solve as robots with own files do. In a team that shares its
measurements the robot that drives solves alone, with all options of `solve`.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pgo_models.errors import GraphWarning, PGOError
from pgo_models.graphs.g2o import graph_of_robots
from pgo_models.graphs.g2o_parser import parse_lines
from pgo_models.graphs.precisions import RotationWeight
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.carry.counted_pool import Count, CountedPool
from solvers.carry.process import DEFAULT_MEMORY
from solvers.loop import RunMonitor
from solvers.pipeline import solution_for
from solvers.request import Pipeline, SolveRequest
from solvers.robots.agent import Agent, OwnLines
from solvers.robots.own_file import READ_HERE
from solvers.robots.setup import SOLVE_PARTS
from solvers.robots_solution import RobotsSolution
from solvers.robust.consistency import PCM
from solvers.robust.gnc import GNC
from solvers.solves.folder_solve import FilesOfRobots
from solvers.team.driving import Drive
from solvers.team.measurements import Measurements, Revision
from solvers.team.messages import Ended
from solvers.team.sharing import (
    OwnAnswer,
    Sharing,
    answer_of,
    give_measurements,
    take_answer,
)


@dataclass(eq=False)
class Member:
    """A robot as its session sees it: measurements, settings of solves, and what was found.

    `outcome` is how the last solve that succeeded has ended, and `known` what it has found of the
    robot's own poses.
    """

    name: str
    pipeline: Pipeline
    weighting: Weighting
    sharing: Sharing
    robust: GNC | PCM | None
    measurements: Measurements = field(default_factory=Measurements)
    outcome: Ended | None = None
    known: OwnAnswer | None = None

    @property
    def revision(self) -> Revision:
        """Which measurements it has, so that others notice when they change."""
        return self.measurements.revision

    def new_agent(self, place: int) -> Agent | None:
        """Its part in a solve, with its measurements as they are now; None where it has none."""
        if self.measurements.d is None:
            return None
        is_shared = self.sharing is Sharing.MEASUREMENTS
        path = Path(f"{self.name}.g2o")
        return Agent(OwnLines(place, path, self.measurements.text(), is_shared))

    def solve(self, drive: Drive) -> RobotsSolution:
        """Solve with the robots of a drive, in the way that the measurements are shared."""
        try:
            if self.sharing is Sharing.MEASUREMENTS:
                return self._solve_in_one_place(drive)
            return self._solve_by_robots(drive)
        except PGOError as error:
            raise PGOError(_with_ways_out_of_teams(str(error))) from error

    def _solve_by_robots(self, drive: Drive) -> RobotsSolution:
        """The solution by robots with files of their own."""
        files = [OwnLines(place, _path_of(name)) for place, name in enumerate(drive.members)]
        job = FilesOfRobots(
            "team", files, drive, DEFAULT_MEMORY, self.weighting, robust=self.robust
        )
        return job.solved(self.pipeline, RunMonitor(progress=False))

    def _solve_in_one_place(self, drive: Drive) -> RobotsSolution:
        """The solution of the graph of all measurements; each robot is told of its poses."""
        num_robots = len(drive.members)
        network = CountedPool(drive, num_robots)
        texts = network.ask(give_measurements, [None] * num_robots, Count.ROUND)
        with warnings.catch_warnings():
            # Poses of absent robots have no estimate, which the outcome says in its own way.
            warnings.simplefilter("ignore", GraphWarning)
            files = [
                parse_lines(_path_of(name), [text.tobytes().decode("utf-8")])
                for name, text in zip(drive.members, texts, strict=True)
            ]
            graph = graph_of_robots(Path("team"), files, RotationWeight.SE_SYNC, is_folder=True)
        request = SolveRequest(
            PGOProblem(graph, weighting=self.weighting),
            self.pipeline,
            robust=self.robust,
            monitor=RunMonitor(progress=False),
        )
        solution = solution_for(request)
        answers = [OwnAnswer.of(solution, robot) for robot in range(num_robots)]
        network.ask(take_answer, answers, Count.ROUND)
        return RobotsSolution.of(solution, network.ledger)

    def has_more_than(self, revisions: Mapping[str, Revision]) -> bool:
        """Whether what was certified holds for measurements of these revisions, and for more."""
        outcome = self.outcome
        if outcome is None or outcome.solution is None or not outcome.solution.is_certified:
            return False
        return outcome.revisions.items() > revisions.items()

    def end_with(self, ended: Ended, agent: Agent | None) -> None:
        """Keep an outcome and the poses with it, unless what was certified before holds for more.

        Where a solve has failed, those before it stay. The agent was its part in the solve.
        """
        answer = None if agent is None else answer_of(agent)
        if self.has_more_than(ended.revisions):
            return
        if ended.solution is not None and answer is not None:
            self.outcome = ended
            self.known = answer


def _path_of(name: str) -> Path:
    """Name of the lines of a robot, as of a file in a folder."""
    return Path("team") / f"{name}.g2o"


def _with_ways_out_of_teams(text: str) -> str:
    """A sentence on an error of robots with own files, with what a team can do about it."""
    text = text.replace(READ_HERE, "robots that share their measurements can")
    return text.replace(SOLVE_PARTS, "an edge between them joins them")
