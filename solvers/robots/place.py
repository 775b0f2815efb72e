"""Steps of a solve by a driver and its robots, whether the calling process has the graph or not.

Between two steps the robots hold the poses, and an attempt has none until its certificate is found.
`robots_of_graph` and `robots_with_files` are the places that have these verbs.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from solvers.carry.faults import Faults
from solvers.carry.ledger import Ledger
from solvers.place import AnySOC, Attempt, OwnStart, Place
from solvers.result import History, Outcome, Stage, Status
from solvers.riemannian.newton import Newton
from solvers.riemannian.staircase import Staircase
from solvers.robots.asynchronous import AsynchronousSOC
from solvers.robots.checkpoint import Journal
from solvers.robots.climb import SubstructuredStaircase, round_lifted
from solvers.robots.consensus import ConsensusSOC
from solvers.robots.driver import Driver
from solvers.robots.newton import SubstructuredNewton
from solvers.robots.paper import PaperByRobots
from solvers.robots.soc import SubstructuredSOC
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
    """Robots, the network between them, and the checkpoints of what they do."""

    driver: Driver
    journal: Journal
    faults: Faults | None

    @property
    def ledger(self) -> Ledger:
        """What has crossed the network so far."""
        return self.driver.network.ledger

    def finish(self, best: Attempt) -> None:
        """Remove the checkpoint of a solve that has ended well."""
        if best.status.is_success:
            self.journal.end()


@dataclass(frozen=True, eq=False)
class DriverPlace(PlaceOfRobots):
    """Start, SOC, Newton and staircase by a driver and its robots.

    Where a checkpoint is of a later stage, what comes before it is passed over (`Journal`). The
    `faults` go wrong between the robots of a CONSENSUS stage, which then does not wait.
    """

    def own_start(self, start: OwnStart) -> Attempt:
        """Have the robots relax the rotations, and average them where the start says so."""
        is_averaged = start is OwnStart.AVERAGED

        def go() -> None:
            self.driver.go_to_chordal_start(is_averaged)

        name = OwnStart.AVERAGED if is_averaged else OwnStart.CHORDAL
        return self.begin(name.value, go)

    def begin(self, name: str, go_to_start: Callable[[], None]) -> Attempt:
        """Bring the robots to a start."""
        if self.journal.goes_on_with():
            return Attempt()
        driver = self.driver
        driver.choose_cost(final=False)
        began = time.perf_counter()
        with self.monitor.showing(name):
            go_to_start()
            objective = self._final_objective()
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
        objective = self._final_objective()
        seconds = time.perf_counter() - began
        name = type(soc).__name__
        if driver.is_final:
            name = f"{name}, convex"
        stage = Stage(
            name,
            finished.status,
            finished.iterations,
            objective,
            seconds,
            finished.history,
            soc,
        )
        self.table.add(stage)
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
        driver = self.driver
        if isinstance(soc, PaperSOC):
            by_paper = PaperByRobots(soc)
            ended = self.journal.run(by_paper, driver, self.monitor)
            by_paper.finish(driver, ended.state)
            return ended
        if soc.effective_coupling is not Coupling.CONSENSUS:
            substructured = SubstructuredSOC(soc)
            finished = self.journal.run(substructured, driver, self.monitor)
            substructured.finish(driver, finished.state)
            return finished
        if self.faults is None:
            consensus = ConsensusSOC(soc)
            waiting = self.journal.run(consensus, driver, self.monitor)
            consensus.finish(driver, waiting.state)
            return waiting
        # No checkpoint can hold the messages that are under way.
        asynchronous = AsynchronousSOC(soc, self.faults)
        impatient = self.monitor.run(asynchronous, driver)
        asynchronous.finish(driver, impatient.state)
        return impatient

    def run_newton(self, attempt: Attempt, newton: Newton) -> Attempt:
        """Run Newton from the current poses."""
        driver = self.driver
        driver.choose_cost(final=True)  # again, where a checkpoint is from before
        finished = self.journal.run(SubstructuredNewton(newton), driver, self.monitor)
        stage = Stage(
            "Newton",
            finished.status,
            finished.iterations,
            driver.current.objective,
            finished.seconds,
            finished.history,
            newton,
        )
        self.table.add(stage)
        return replace(attempt, status=finished.status, decrement=finished.state.decrement)

    def climb_from_current(self, staircase: Staircase) -> Attempt:
        """Run the staircase from the current poses, and have the robots round its solution."""
        driver = self.driver
        self.journal.stop_writing()
        driver.save_poses()
        finished = self.monitor.run(SubstructuredStaircase(staircase), driver)
        if finished.status is Status.INTERRUPTED:
            # Some robots may have one dimension more than others.
            driver.restore_poses()
        else:
            round_lifted(driver)
        stage = Stage(
            "Staircase",
            finished.status,
            finished.iterations,
            driver.current.objective,
            finished.seconds,
            finished.history,
            staircase,
        )
        self.table.add(stage)
        return Attempt(status=finished.status, dual_bound=finished.state.bound)

    def _final_objective(self) -> float:
        """The cost that is solved, at the current poses; the driver stays with that cost."""
        self.driver.choose_cost(final=True)
        return self.driver.current.objective
