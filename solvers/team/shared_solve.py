"""The solve of a robot that has the measurements of its team: of the connected part that it is in.

It is that of one place, with all options of `solve`. The next one begins at the map before
(`extend`). It runs in a process of its own (`solvers.team.beside`), which has the lines and the
last map, so that a solve begins without handing these over.
"""

from __future__ import annotations

import os
import pickle
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pgo_models.errors import GraphError, GraphWarning, PGOError
from pgo_models.graphs.g2o import graph_of_robots
from pgo_models.graphs.g2o_parser import G2OLines, parse_lines
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.carry.ledger import Ledger
from solvers.growing import extend
from solvers.loop import RunMonitor
from solvers.pipeline import solution_for
from solvers.reporting.notes import joined_notes, note_of_first_attempt, note_of_poses_apart
from solvers.request import Pipeline, SolveRequest
from solvers.robots_solution import RobotsSolution
from solvers.robust.consistency import PCM
from solvers.robust.gnc import GNC
from solvers.solution import Solution
from solvers.team.beside import Beside, Line, Talk, result_or_error
from solvers.team.measurements import Measurements, Revision
from solvers.team.sharing import OwnAnswer

_FAILURE = "the measurements cannot be computed with"
_MOST_TOLD = 1 << 14  # lines that the other process is told in a call


@dataclass(frozen=True, eq=False)
class SharedAnswer:
    """What a robot has found: the solution of its part, its own poses, and whose part it is.

    `summary` is what is told of the solution, which itself is a pickle: it is read where somebody
    asks for it. `problems` are sentences on what was left out.
    """

    summary: RobotsSolution
    solution: bytes
    own: OwnAnswer
    covered: tuple[str, ...]
    problems: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class TeamSettings:
    """Settings of the solves of the robot `name`."""

    name: str
    pipeline: Pipeline
    weighting: Weighting
    robust: GNC | PCM | None
    trust_folder: bool

    def solve_each(self, line: Line) -> None:
        """Solve each time that robots are told, of their lines that were told before.

        Messages are `BeginsAt`, `NewLines`, or `SolveNow`, which has an answer.
        """
        lines: dict[str, list[str]] = {}
        before: bytes | None = None
        while True:
            message: BeginsAt | NewLines | SolveNow = line.wait()
            if isinstance(message, BeginsAt):
                before = message.solution
                continue
            if isinstance(message, NewLines):
                lines.setdefault(message.owner, [])[message.num_before :] = message.lines
                continue
            of_these = {name: lines[name] for name in message.names}
            solve = partial(self.solved, of_these, before, message.in_full)
            answer = result_or_error(solve, _FAILURE)
            if isinstance(answer, SharedAnswer):
                before = answer.solution
            line.tell(answer)

    def solved(
        self, lines: Mapping[str, list[str]], before: bytes | None, in_full: bool
    ) -> SharedAnswer:
        """The solution of the part that the robot is in, of the lines that each robot has measured.

        What cannot be read, or does not fit to the robot's own, is left out. A PGOError where it
        cannot solve its own. Unless it is solved in full, the first attempt is the last.
        """
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", GraphWarning)
            # Poses of absent robots have no estimate, which the outcome says in its own way.
            warnings.filterwarnings("ignore", ".* have no VERTEX line", GraphWarning)
            files, problems = _files_of(lines)
            if self.name not in files:
                raise PGOError(problems[0])
            graph, misfits = self._graph(files)
        problems += [f"what {name} has measured does not fit: {misfits[name]}" for name in misfits]
        part = _part_of(graph, files[self.name])
        pipeline = self.pipeline if in_full else self.pipeline.of_first_attempt
        solution = self._solution(part, pipeline, None if before is None else pickle.loads(before))
        fitting = [name for name in files if name not in misfits]
        covered = [name for name in fitting if _has_poses_of(part, files[name])]
        is_own = np.isin(part.pose_ids, files[self.name].vertex_ids)
        num_apart = {
            name: len(np.setdiff1d(files[name].vertex_ids, part.pose_ids)) for name in covered
        }
        problems += [
            f"no edge joins {count} poses of {name} with its others"
            for name, count in num_apart.items()
            if count
        ]
        own = OwnAnswer.of(solution, is_own)
        sizes = _sizes_in(part, [files[name] for name in covered])
        summary = RobotsSolution.of(solution, Ledger(len(covered)), sizes).without_histories
        of_files = dict.fromkeys(str(warning.message) for warning in caught)
        num_apart_of_all = sum(num_apart.values())
        is_open = not (in_full or solution.is_certified)
        notes = [note_of_poses_apart(num_apart_of_all), note_of_first_attempt(is_open)]
        note = joined_notes(*notes, *of_files, summary.note)
        summary = replace(summary, num_apart=num_apart_of_all, note=note)
        return SharedAnswer(summary, pickle.dumps(solution), own, tuple(covered), tuple(problems))

    def _graph(self, files: Mapping[str, G2OLines]) -> tuple[PoseGraph, dict[str, PGOError]]:
        """The graph of the files that fit to the robot's own, and why the others do not."""
        try:
            return self._graph_of(list(files.values())), {}
        except PGOError:
            if len(files) == 1:
                raise
        fitting = [files[self.name]]
        graph = self._graph_of(fitting)
        misfits = {}
        for name, file in files.items():
            if name != self.name:
                try:
                    graph = self._graph_of([*fitting, file])
                    fitting.append(file)
                except PGOError as error:
                    misfits[name] = error
        return graph, misfits

    def _graph_of(self, files: list[G2OLines]) -> PoseGraph:
        path = Path("team")
        return graph_of_robots(path, files, is_folder=True, trust_folder=self.trust_folder)

    def _solution(self, graph: PoseGraph, pipeline: Pipeline, before: Solution | None) -> Solution:
        """The solution from the map before, or where that is no part of it, from none."""
        if before is not None:
            try:
                return extend(before, graph, pipeline, robust=self.robust)
            except GraphError:
                pass
        problem = PGOProblem(graph, weighting=self.weighting)
        monitor = RunMonitor(progress=False)
        return solution_for(SolveRequest(problem, pipeline, robust=self.robust, monitor=monitor))


class BeginsAt(NamedTuple):
    """The solution that the next solve begins at, as bytes; None where there is none yet."""

    solution: bytes | None


class NewLines(NamedTuple):
    """Lines that come after the first ones of a robot, in place of those that were there."""

    owner: str
    num_before: int
    lines: list[str]


class SolveNow(NamedTuple):
    """Solve for robots, with the lines that they have: in full, or by a first attempt alone."""

    names: tuple[str, ...]
    in_full: bool


class SolverBeside:
    """The solves of a robot, which a computation in another process runs: it keeps all lines.

    `tried` are the revisions that the last solve began with. If that was a first attempt alone and
    is not certified, the same revisions are solved again, in full, unless new lines come first.
    """

    def __init__(self, settings: TeamSettings, beside: Beside) -> None:
        self.is_solving = False
        self.tried: Mapping[str, Revision] = {}
        self._may_find_more = False  # as the last solve was a first attempt, and not certified
        self._settings = settings
        self._beside = beside
        self._last: bytes | None = None  # the last solution, which another process begins at
        self._begin_anew()

    def _begin_anew(self) -> None:
        """Have no computation: that of another robot or process, or one that ended, is none."""
        self._pid = os.getpid()
        self._talk: Talk | None = None
        self._has: dict[str, Revision] = {}  # what it was told, by robot

    def __getstate__(self) -> dict[str, Any]:
        """A copy has no computations: what this one is solving, it solves again."""
        tried = {} if self.is_solving else self.tried
        without = {"is_solving": False, "tried": tried, "_talk": None, "_has": {}}
        return {**self.__dict__, **without}

    def has_not_tried(self, revisions: Mapping[str, Revision]) -> bool:
        """Whether these are new, or the last solve may find more with them."""
        return revisions != self.tried or self._may_find_more

    def begin_anew_in_fork(self) -> None:
        """In a fork, begin what the parent is solving anew, as a copy does."""
        if self._pid != os.getpid():
            self.__dict__.update(self.__getstate__())
            self._begin_anew()

    def tell(
        self, logs: Mapping[str, Measurements], end: Callable[[SharedAnswer | PGOError], None]
    ) -> bool:
        """Tell it lines that are new, `_MOST_TOLD` at most; whether it has all.

        What is solved with them ends with `end`.
        """
        num_left = _MOST_TOLD
        for name, log in logs.items():
            known = self._has.get(name, Revision())
            if known == log.revision:
                continue
            if num_left == 0:
                return False
            begins = known.num_lines if log.begins_with(known) else 0
            lines = log.lines[begins : begins + num_left]
            num_left -= len(lines)
            self._begun(end).tell(NewLines(name, begins, lines))
            self._has[name] = log.revision_at(begins + len(lines))
        return all(self._has.get(name, Revision()) == log.revision for name, log in logs.items())

    def _begun(self, end: Callable[[SharedAnswer | PGOError], None]) -> Talk:
        """The computation, which is begun where there is none."""
        if self._talk is None:

            def take(answer: SharedAnswer | PGOError) -> None:
                if self._talk is not talk or not self.is_solving:
                    return
                self.is_solving = False
                if isinstance(answer, SharedAnswer):
                    self._last = answer.solution
                    self._may_find_more &= not answer.summary.is_certified
                end(answer)

            def lose(error: PGOError) -> None:
                """The process has ended; what it had is told to the next one."""
                take(error)
                if self._talk is talk:
                    self._begin_anew()

            talk = self._beside.begin(self._settings.solve_each, lose, _FAILURE, take)
            self._talk = talk
            talk.tell(BeginsAt(self._last))
        return self._talk

    def solve(self, revisions: Mapping[str, Revision], in_full: bool) -> None:
        """Solve for robots whose lines it has all.

        A robust solve is always in full, as later ones keep what it decides of edges.
        """
        assert self._talk is not None
        in_full = in_full or self._settings.robust is not None or revisions == self.tried
        self.tried = revisions
        self.is_solving = True
        self._may_find_more = not in_full
        self._talk.tell(SolveNow(tuple(revisions), in_full))


def _files_of(lines: Mapping[str, list[str]]) -> tuple[dict[str, G2OLines], list[str]]:
    """The lines of each robot, read, and sentences on those that cannot be."""
    measured = {name: Measurements(its) for name, its in lines.items()}
    dimensions = [its.told_dimension for its in measured.values()]
    d = next((each for each in dimensions if each is not None), None)
    if d is None:
        raise GraphError("nobody has measured an edge; there is nothing to solve")
    files = {}
    problems = []
    for name, its in measured.items():
        text = its.text(its.told_dimension or d)
        try:
            files[name] = parse_lines(Path("team") / f"{name}.g2o", [text])
        except PGOError as error:
            problems.append(f"what {name} has measured cannot be read: {error}")
    return files, problems


def _part_of(graph: PoseGraph, own: G2OLines) -> PoseGraph:
    """The connected part of a graph in which most poses of a robot are."""
    parts = graph.components()
    if len(parts) == 1:
        return graph
    num_own = [int(np.isin(graph.pose_ids[part], own.vertex_ids).sum()) for part in parts]
    return graph.subgraph(np.sort(parts[int(np.argmax(num_own))]))


def _has_poses_of(graph: PoseGraph, file: G2OLines) -> bool:
    """Whether a pose of a robot is in a graph, or one that it has measured."""
    named = np.concatenate([file.vertex_ids, file.edge_ids.ravel()])
    return bool(np.isin(graph.pose_ids, named).any())


def _sizes_in(graph: PoseGraph, files: Sequence[G2OLines]) -> IntArray:
    """Number of poses, and of edges, that each file brings into a connected part, (2, files)."""
    sizes = []
    for file in files:
        poses = np.union1d(file.vertex_ids, file.edge_ids)
        num_poses = np.isin(poses, graph.pose_ids[graph.in_files]).sum()
        sizes.append([num_poses, np.isin(file.edge_ids[:, 1], graph.pose_ids).sum()])
    return np.array(sizes).T
