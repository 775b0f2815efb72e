"""A solve that one robot drives, step by step, as the answers of the others arrive.

The page of a solve (`solvers.plan`) asks robots and waits. Here it runs in a coroutine of the
package greenlet: where it would wait, it stops, and goes on when the last answer is there. So the
robot that drives has neither threads nor sockets, and the page is the one of every other place. In
a team that shares its measurements the driving robot solves alone, with all options of `solve`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from pgo_models.errors import GraphWarning, PGOError, extra_module
from pgo_models.graphs.g2o import graph_of_robots
from pgo_models.graphs.g2o_parser import parse_lines
from pgo_models.graphs.precisions import RotationWeight
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.carry.counted_pool import Count, CountedPool
from solvers.carry.messages import Idle, Worker, obey, raise_first_error
from solvers.carry.process import DEFAULT_MEMORY
from solvers.loop import RunMonitor
from solvers.pipeline import solution_for
from solvers.request import Pipeline, SolveRequest
from solvers.robots.own_file import READ_HERE
from solvers.robots.setup import SOLVE_PARTS
from solvers.robots_solution import RobotsSolution
from solvers.robust.consistency import PCM
from solvers.robust.gnc import GNC
from solvers.solves.folder_solve import FilesOfRobots, check_robust
from solvers.team.agent import OwnAnswer, Sharing, TeamAgent, give_measurements, take_answer
from solvers.team.messages import Ask, Ended, Reply, Term, error_of_message
from solvers.team.wire import Order

T = TypeVar("T")
Q = TypeVar("Q")
A = TypeVar("A")


class _AbandonedError(BaseException):
    """Raised in the page of a solve that is given up; no page catches it."""


@dataclass(eq=False)
class Drive:
    """A solve of the term by the robots `members`, the first of which is this one, with its agent.

    `waiting` are the asks without an answer, by robot, `num_asked` says how many orders each has
    had (not all are for everybody), `outcome` is the solution or error at the end.
    """

    term: Term
    members: tuple[str, ...]
    agent: TeamAgent
    pipeline: Pipeline
    weighting: Weighting
    robust: GNC | PCM | None = None
    call: int = -1
    waiting: dict[str, Ask] = field(default_factory=dict)
    num_asked: dict[str, int] = field(default_factory=dict)
    outcome: RobotsSolution | PGOError | None = None
    _answers: list[Any] = field(default_factory=list)
    _page: Any = None

    @property
    def needed(self) -> Sequence[str]:
        """Robots without which the solve cannot go on.

        Robots that share their interface wait for letters of each other, too.
        """
        shares_all = self.agent.sharing is Sharing.MEASUREMENTS
        return list(self.waiting) if shares_all else self.members[1:]

    def begin(self) -> None:
        """Run the page until it waits for answers, or ends."""
        self._page = extra_module("greenlet", "team").greenlet(self._solve)
        self._page.switch()

    def take(self, robot: str, reply: Reply) -> None:
        """Take an answer; with the last one the page goes on."""
        ask = self.waiting.get(robot)
        if ask is None or reply.call != ask.call:
            return
        del self.waiting[robot]
        place = self.members.index(robot)
        error = reply.error
        self._answers[place] = reply.answer if error is None else error_of_message(error, robot)
        if not self.waiting:
            self._page.switch()

    def abandon(self) -> None:
        """Give the solve up."""
        if self._page is not None and not self._page.dead:
            self._page.throw(_AbandonedError)
        self.waiting.clear()

    def ended(self, absent: tuple[str, ...], revisions: Mapping[str, int]) -> Ended:
        """How the solve has ended, without `absent` robots, by members with these revisions."""
        outcome = self.outcome
        if isinstance(outcome, RobotsSolution):
            return Ended(self.term, revisions, absent, outcome.without_histories)
        # What robots with own files lack, a team that shares its measurements has; parts may meet.
        text = str(outcome).replace(READ_HERE, "robots that share their measurements can")
        text = text.replace(SOLVE_PARTS, "an edge between them joins them")
        return Ended(self.term, revisions, absent, None, failure=f"failed: {text}")

    def _solve(self) -> None:
        try:
            if self.agent.sharing is Sharing.MEASUREMENTS:
                self.outcome = self._solved_in_one_place()
            else:
                self.outcome = self._solved_by_robots()
        except PGOError as error:
            self.outcome = error
        except _AbandonedError:
            pass

    def _solved_by_robots(self) -> RobotsSolution:
        """The solution by robots with files of their own."""
        files = [(k, Path("team") / f"{name}.g2o") for k, name in enumerate(self.members)]
        check_robust(self.robust)
        job = FilesOfRobots("team", files, self, DEFAULT_MEMORY, self.weighting, robust=self.robust)
        return job.solved(self.pipeline, RunMonitor(progress=False))

    def _solved_in_one_place(self) -> RobotsSolution:
        """The solution of the graph of all measurements; each robot is told of its poses."""
        nothing = [None] * len(self.members)
        network = CountedPool(self, len(self.members))
        texts = network.ask(give_measurements, nothing, Count.ROUND)
        with warnings.catch_warnings():
            # Poses of absent robots have no estimate, which the outcome says in its own way.
            warnings.simplefilter("ignore", GraphWarning)
            files = [
                parse_lines(Path("team") / f"{name}.g2o", [text.tobytes().decode("utf-8")])
                for name, text in zip(self.members, texts, strict=True)
            ]
            graph = graph_of_robots(Path("team"), files, RotationWeight.SE_SYNC, is_folder=True)
        request = SolveRequest(
            PGOProblem(graph, weighting=self.weighting),
            self.pipeline,
            robust=self.robust,
            monitor=RunMonitor(progress=False),
        )
        solution = solution_for(request)
        answers = [OwnAnswer.of(solution, robot) for robot in range(len(self.members))]
        network.ask(take_answer, answers, Count.ROUND)
        return RobotsSolution.of(solution, network.ledger)

    # An engine, and its pool of workers: the robots are there already.

    def open(self, make: Callable[[T], Worker], parts: Sequence[T]) -> Drive:
        """Return the pool of the robots, which have their parts."""
        return self

    def ask(self, order: Callable[[Any, Q], A], requests: Sequence[Q]) -> list[A]:
        """Give every robot an order with its request, and wait for all answers."""
        self.call += 1
        named = Order.of(order)
        self._answers = [None] * len(requests)
        for place, (name, request) in enumerate(zip(self.members, requests, strict=True)):
            if place > 0 and request is not Idle.IDLE:
                number = self.num_asked.get(name, 0)
                self.num_asked[name] = number + 1
                members = self.members if number == 0 else ()
                self.waiting[name] = Ask(self.term, number, place, named, request, members)
        self._answers[:1] = obey([self.agent], order, requests[:1])
        if self.waiting:
            self._page.parent.switch()
        return raise_first_error(self._answers)

    def close(self) -> None:
        """Keep the robots: they outlive a solve."""
