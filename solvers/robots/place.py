"""The place where robots solve with a driver, beside the graph of all robots or without it.

Robots hold the poses between two steps, and an attempt has none until its certificate is found.
Where this process has the graph, it collects the poses then, and takes the steps that robots lack
(`solvers.here`). Elsewhere the robots keep the answer (`solvers.robots.kept_answer`). Without a
driver there is `solvers.robots.place_without_driver`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from pgo_models.certificates.certificate import BoundSource, certify_with, with_axes
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.partitioning import Partition
from pgo_models.problem.initialization import chordal_start, spanning_tree_start
from solvers.carry.faults import Faults
from solvers.carry.ledger import Ledger
from solvers.handedness.complex_relaxation import ComplexRelaxation
from solvers.handedness.hull_lagrangian import HullLagrangian
from solvers.handedness.search import HandednessSearch
from solvers.here import Here
from solvers.place import AnySOC, Attempt, OwnStart, Place, Step, Traits
from solvers.result import History, Outcome, Stage, Status
from solvers.riemannian.newton import Newton
from solvers.riemannian.prefixes import GrowingStart
from solvers.riemannian.staircase import Staircase
from solvers.robots.checkpoint import Journal
from solvers.robots.climb import SubstructuredStaircase, round_lifted
from solvers.robots.consensus import AsynchronousSOC, ConsensusSOC
from solvers.robots.driver import Driver, collect
from solvers.robots.kept_answer import AnswerAtRobots
from solvers.robots.newton import SubstructuredNewton
from solvers.robots.own_file import READ_HERE
from solvers.robots.paper import PaperByRobots
from solvers.robots.proof import best_bound_distributed
from solvers.robots.revision import go_to_poses_found
from solvers.robots.reweigh import SharedGNC, inliers_of
from solvers.robots.soc import SubstructuredSOC
from solvers.robots.trees import hand_out_along_tree
from solvers.robust.gnc import GNC, Inliers
from solvers.robust.known import KnownEdges
from solvers.robust.weighted_edges import first_poses
from solvers.soc.paper import PaperSOC
from solvers.soc.settings import Coupling


@dataclass(frozen=True, eq=False)
class AttemptWithFaults(Attempt):
    """An attempt whose SOC had faults. Rounds are numbered on from those of SOC.

    `offset` is the number of the current round less the rounds on the ledger. For `patience` rounds
    the driver waits for a robot that is silent, and then gives it up.
    """

    offset: int = 0
    patience: int = 0

    def check_heard(self, faults: Faults, rounds: int) -> None:
        """Raise a RobotSilentError where a robot is silent now, and stays silent for too long."""
        faults.check_heard(rounds + self.offset, self.patience)


@dataclass(frozen=True, eq=False)
class PlaceOfRobots(Place):
    """A solve by robots and their driver."""

    driver: Driver  # the driver, with the network of its robots
    # Checkpoints. Where one is of a later stage, what comes before it is passed over.
    journal: Journal
    # who holds the answer: this process, which has the graph of all robots, collects the poses for
    # a certificate, and takes the steps that robots lack (the names of their stages say so), or the
    # robots, of whose poses this process knows nothing
    holder: Here | AnswerAtRobots
    owners: Partition | None = None  # who owns which poses of the graph in this process
    # what goes wrong between the robots of a CONSENSUS stage, which then does not wait
    faults: Faults | None = None
    # name of a start at poses that the robots have found before; their own start unless given
    begins_at: str | None = None
    # Whether the map is on the way to another one. Shifts of the bound that cost more than the gap
    # are then not tried.
    is_on_the_way: bool = False

    @property
    def here(self) -> Here | None:
        """The solve of the graph of all robots in this process, if it has that graph."""
        return self.holder if isinstance(self.holder, Here) else None

    @property
    def known_here(self) -> Here:
        """The solve in this process, where it is known that there is one: see `lacks`."""
        assert isinstance(self.holder, Here)
        return self.holder

    # What the page asks

    @property
    def traits(self) -> Traits:
        """Traits of the graph; its rotations are averaged if all robots can average theirs.

        Files with landmarks are refused when robots read them.
        """
        driver = self.driver
        if self.here is not None:
            # The rotation of a loose world depends on positions alone.
            averages = driver.can_average and not self.here.problem.graph.is_world_loose
            return replace(self.here.traits, averages=averages, has_robots=True)
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

    @property
    def odometry_joins(self) -> bool:
        """Whether every pose but the first has an edge to an earlier one."""
        return self.here is not None and self.here.odometry_joins

    def lacks(self, step: Step) -> str:
        """Why a step cannot be taken: most need one process with the graph of all robots."""
        if self.here is not None:
            return ""
        return "" if step is Step.STAIRCASE else "no process has the graph"

    @property
    def way_out(self) -> str:
        """How to have the missing steps taken."""
        return READ_HERE if self.here is None else ""

    @property
    def ledger(self) -> Ledger:
        """What has crossed the network so far."""
        return self.driver.network.ledger

    def finish(self, best: Attempt) -> None:
        """Remove the checkpoint of a solve that has ended well."""
        if best.status.is_success:
            self.journal.end()

    # An attempt

    def start(self, start: Poses | OwnStart, soc: AnySOC | None) -> Attempt:
        """Start at given poses, at an own start, or at the outcome that a checkpoint has.

        The spanning tree is found in one place, and so is the start of a graph with a loose world.
        Where no process has the graph, nobody could give the poses of all robots.
        """
        known = self._known_outcome()
        if known is not None:
            return known
        if self.begins_at is not None:
            return self._begin(self.begins_at, partial(go_to_poses_found, self.driver))
        if self.here is not None:
            problem = self.here.problem
            if not isinstance(start, OwnStart):
                return self._start_at("given start", problem.seen_poses(start))
            if problem.graph.is_world_loose:
                name = f"{OwnStart.CHORDAL.value}{self.here.where}"
                return self._start_at(name, chordal_start(problem.convex_part))
            if start is OwnStart.TREE:
                name = f"{OwnStart.TREE.value}{self.here.where}"
                return self._start_at(name, spanning_tree_start(problem.convex_part.graph))
        is_averaged = start is OwnStart.AVERAGED
        name = (OwnStart.AVERAGED if is_averaged else OwnStart.CHORDAL).value
        return self._begin(name, partial(self.driver.go_to_chordal_start, is_averaged))

    def _known_outcome(self) -> Attempt | None:
        """Outcome of the attempt that begins, if a checkpoint is of a later one."""
        outcome = self.journal.take_outcome()
        if outcome is None:
            return None
        poses, certificate = outcome
        return Attempt(poses, certificate=certificate)

    def _start_at(self, name: str, poses: Poses) -> Attempt:
        """Bring the robots to poses that this process has."""
        return self._begin(name, partial(self.driver.set_poses, poses))

    def _begin(self, name: str, go_to_start: Callable[[], None]) -> Attempt:
        """Bring the robots to a start."""
        if self.journal.goes_on_with():
            return Attempt()
        driver = self.driver
        driver.choose_cost(final=False)
        began = time.perf_counter()
        with self.monitor.showing(name):
            go_to_start()
            driver.choose_cost(final=True)
            objective = driver.current.objective
            driver.choose_cost(final=False)
        seconds = time.perf_counter() - began
        self.table.add(Stage(name, Status.CONVERGED, 0, objective, seconds, History()))
        return Attempt()

    def run_soc(self, attempt: Attempt, soc: AnySOC) -> Attempt:
        """Run SOC from the current poses, and return to them if its poses cost more."""
        journal = self.journal
        if journal.goes_on_with(SubstructuredNewton):
            return attempt
        driver = self.driver
        began = time.perf_counter()
        if not journal.goes_on_with():
            driver.save_poses()
        finished = self._run_coupling(soc)
        if not driver.current.objective <= driver.saved.objective:
            driver.restore_poses()
        driver.choose_cost(final=True)
        seconds = time.perf_counter() - began
        name = type(soc).__name__
        if driver.has_two_costs:
            name = f"{name}, convex"
        self._add_stage(name, replace(finished, seconds=seconds), soc)
        if self.faults is None:
            return replace(attempt, status=finished.status)
        rounds = driver.network.ledger.rounds
        offset = finished.iterations - rounds
        with_faults = AttemptWithFaults(
            status=finished.status, offset=offset, patience=soc.max_iterations
        )
        with_faults.check_heard(self.faults, rounds)
        return with_faults

    def _run_coupling(self, soc: AnySOC) -> Outcome[Any]:
        """Run the coupling that the settings name, or the paper's; its factors go with it."""
        coupling = _coupling_of(soc, self.faults)
        finished: Outcome[Any]
        if isinstance(coupling, AsynchronousSOC):
            # No checkpoint can hold the messages that are under way.
            finished = self.monitor.run(coupling, self.driver)
        else:
            finished = self.journal.run(coupling, self.driver, self.monitor)
        coupling.finish(self.driver, finished.state)
        return finished

    def run_newton(self, attempt: Attempt, newton: Newton) -> Attempt:
        """Run Newton from the current poses."""
        driver = self.driver
        driver.choose_cost(final=True)  # again, where a checkpoint is from before
        finished = self.journal.run(SubstructuredNewton(newton), driver, self.monitor)
        driver.return_to(finished.state.moment)  # the best iterate, where the run was broken off
        self._add_stage("Newton", finished, newton)
        return replace(attempt, status=finished.status, decrement=finished.state.decrement)

    def _add_stage(self, name: str, finished: Outcome[Any], method: object) -> None:
        """Write down a run that has ended at the current poses, with the settings of its method."""
        objective = self.driver.current.objective
        stage = replace(Stage.of(finished), name=name, objective=objective, method=method)
        self.table.add(stage)

    def certify(self, attempt: Attempt) -> Attempt:
        """Prove the certificate of the current poses by driver and robots.

        Where this process has the graph, the poses are collected, and the whole problem serves for
        their cost, and for a proof by axes where the bound of the robots leaves too wide a gap.
        """
        driver = self.driver
        goes_on = self.is_on_the_way and not attempt.is_out_of_time
        most_lost = self.holder.gap * driver.current.objective if goes_on else None
        with self.monitor.showing("certificate"):
            deadline = self.proof_deadline(attempt)
            bound = best_bound_distributed(driver, self.holder.gap, most_lost, deadline)
            if isinstance(self.holder, AnswerAtRobots):
                return self.holder.certify(driver, attempt, bound)
            here = self.holder
            poses, Lambda = collect(driver)
            certificate = certify_with(
                here.problem, poses, Lambda, here.gap, attempt.decrement, BoundSource.GIVEN, bound
            )
            if not attempt.is_out_of_time:
                certificate = with_axes(here.problem, certificate, poses)
        if self.faults is not None and isinstance(attempt, AttemptWithFaults):
            # A robot may have fallen silent since SOC ended.
            attempt.check_heard(self.faults, self.ledger.rounds)
        self.journal.end_attempt((poses, certificate))
        return replace(attempt, poses=poses, certificate=certificate)

    def better(self, best: Attempt, other: Attempt) -> Attempt:
        """Return the cheaper poses with the best bound that either has."""
        return self.holder.better(best, other)

    @property
    def has_poses(self) -> bool:
        """Whether the robots have begun and, where no process has the graph, have kept any."""
        if isinstance(self.holder, AnswerAtRobots):
            return self.holder.kept is not None
        return bool(self.table.stages)

    def salvage(self, reason: Status) -> Attempt:
        """The best poses known, those of the robots among them, with the bound F >= 0."""
        robots_have_poses = reason in (Status.INTERRUPTED, Status.SILENT)
        if self.here is not None and robots_have_poses:
            self.monitor.poses_found.append(collect(self.driver)[0])
        return self.holder.salvage(reason)

    # Steps after the first attempt

    def climb(self, best: Attempt, staircase: Staircase) -> Attempt:
        """Have the robots climb the staircase from the best poses, and round its solution."""
        driver = self.driver
        if isinstance(self.holder, AnswerAtRobots):
            self.holder.go_back(driver)
        else:
            driver.set_poses(best.known_poses)
        self.journal.stop_writing()
        driver.save_poses()
        finished = self.monitor.run(SubstructuredStaircase(staircase), driver)
        if finished.status is Status.INTERRUPTED:
            # Some robots may have one dimension more than others.
            driver.restore_poses()
        else:
            round_lifted(driver)
        self._add_stage("Staircase", finished, staircase)
        return Attempt(status=finished.status, dual_bound=finished.state.bound)

    def start_grown(self, growing: GrowingStart) -> Attempt:
        """Start the robots at poses that prefixes lead to, which are solved in one place."""
        known = self._known_outcome()
        if known is not None:
            return known
        if self.journal.goes_on_with():
            return Attempt()
        grown = self.known_here.start_grown(growing)
        self.driver.choose_cost(final=True)
        self.driver.set_poses(grown.known_poses)
        return Attempt(status=grown.status)

    def try_other_starts(self, best: Attempt, newton: Newton) -> Attempt:
        """Try other starts, in one place."""
        return self.known_here.try_other_starts(best, newton)

    def bound_by_smaller_matrices(self, best: Attempt) -> Attempt:
        """Try smaller information matrices, in one place."""
        return self.known_here.bound_by_smaller_matrices(best)

    def solve_in_complex_numbers(self, best: Attempt, method: ComplexRelaxation) -> Attempt:
        """Solve the relaxation with complex numbers in one place."""
        return self.known_here.solve_in_complex_numbers(best, method)

    def solve_hulls(self, best: Attempt, method: HullLagrangian) -> Attempt:
        """Solve the relaxation with hulls in one place."""
        return self.known_here.solve_hulls(best, method)

    def terms_can_help(self, best: Attempt) -> bool:
        """Ask the one place that has the graph."""
        return self.known_here.terms_can_help(best)

    def bound_by_terms(
        self, best: Attempt, search: HandednessSearch, Pi: Array | None = None
    ) -> Attempt:
        """Search for handedness terms in one place."""
        return self.known_here.bound_by_terms(best, search, Pi)

    def run_gnc(self, gnc: GNC, start: Poses | None) -> Inliers:
        """Run graduated non-convexity by the robots, which have the thresholds of their edges."""
        assert self.owners is not None
        driver = self.driver
        problem = self.known_here.problem
        if start is None:
            known = KnownEdges.of(problem.graph, gnc.known).edges
            hand_out_along_tree(driver, problem, self.owners, first_poses(problem.graph, known))
        else:
            driver.hand_out(start)
        driver.choose_cost(final=True)
        finished = self.monitor.run(SharedGNC.of(gnc, driver, problem.graph, has_map=False), driver)
        return inliers_of(problem, gnc, driver, finished)


def _coupling_of(soc: AnySOC, faults: Faults | None) -> Any:  # noqa: ANN401 - methods of any state
    """The method by which robots run SOC: the coupling that the settings name, or the paper's."""
    if isinstance(soc, PaperSOC):
        return PaperByRobots(soc)
    if soc.effective_coupling is not Coupling.CONSENSUS:
        return SubstructuredSOC(soc)
    return ConsensusSOC(soc) if faults is None else AsynchronousSOC(soc, faults)
