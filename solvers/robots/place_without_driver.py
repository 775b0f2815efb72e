"""CONSENSUS without a driver: robots alone compute poses, and nothing is proved about them.

Unless poses are given, the robots begin at a spanning tree of the graph. They relax the rotations
and solve for rotations and translations jointly, project the rotations, and solve for the
translations that belong to these. Both are runs of CONSENSUS to a loose tolerance. Then SOC
follows. Best translations of given rotations, Newton and the certificate need a driver.

"Without a driver" is said of the method. One process still has the whole graph: it makes the tree,
delivers all messages, and collects the poses of the result, so that it sees every pose.

The sums that robots need, and so their tests of convergence, go along a tree of robots. For SOC
CONVERGED means that the relative gradient of F over rotations and translations is within its
tolerance at the returned poses. It does not tell how far F is from an optimum. For the start, which
first relaxes the rotations and then holds them, CONVERGED means that the residuals of the recursion
are within `_START_TOLERANCE`.
"""

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.graphs.partitioning import Partition
from pgo_models.problem.initialization import spanning_tree_start
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.carry.counted_pool import Count
from solvers.place import AnySOC, Attempt, OwnStart, Traits
from solvers.result import History, Outcome, Stage, Status
from solvers.riemannian.newton import Newton
from solvers.robots.consensus import (
    AsynchronousSOC,
    AsynchronousState,
    ConsensusSOC,
    RobotsOfDriver,
)
from solvers.robots.driver import Driver
from solvers.robots.place import PlaceOfRobots
from solvers.robots.trees import hand_out_along_tree, robot_tree
from solvers.soc.consensus import ConsensusState, ask_all
from solvers.soc.consensus_robot import ConsensusRobot
from solvers.soc.recursion_block import Rotations
from solvers.soc.soc import SOC

# SOC improves the rotations of the start anyway, so that these limits are loose.
_START_TOLERANCE = 1e-2
_START_ROUNDS = 100
NO_CERTIFICATE = (
    "no driver: Newton and the certificate were left out, "
    "and F >= 0 is all that is known of the optimum"
)


@dataclass(frozen=True, eq=False)
class StartInCopies(Attempt):
    """A start that the robots hold in their copies from the run that led to it."""


@dataclass(frozen=True, eq=False)
class RobotsAlone(PlaceOfRobots):
    """A solve by robots of one graph without a driver.

    It has a start and CONSENSUS. The whole problem serves for the trees alone, and for F of the
    start and of the returned poses. With `faults`, messages between robots are lost or late, and
    the robots do not wait.
    """

    @property
    def traits(self) -> Traits:
        """Traits of the graph; there are robots and no driver."""
        return replace(self.known_here.traits, has_robots=True, has_driver=False)

    def note(self, best: Attempt) -> str:
        """What a solution lacks for want of a driver, and why its cost is F."""
        problem = self.known_here.problem
        if problem.graph.information is None or problem.weighting is not Weighting.ISOTROPIC:
            return NO_CERTIFICATE
        reason = "the cost is F, as SOC alone needs one that is convex and quadratic"
        return f"{NO_CERTIFICATE}; {reason}"

    def start(self, start: Poses | OwnStart, soc: AnySOC | None) -> Attempt:
        """Start at given poses, or by CONSENSUS with relaxed rotations from a spanning tree."""
        assert isinstance(soc, SOC)  # as the request has checked
        assert self.owners is not None
        self.driver.network.tree = robot_tree(self.known_here.problem, self.owners)
        began = time.perf_counter()
        name = "given start"
        iterations = 0
        history = History()
        if not isinstance(start, OwnStart):
            self.driver.hand_out(start)
            begun = Attempt(start)
        else:
            name, begun, iterations, history = self._start_by_rounds(soc, self.owners)
        poses = begun.known_poses
        if not self.journal.goes_on_with():
            objective = self.known_here.problem.objective(poses)
            seconds = time.perf_counter() - began
            self.table.add(Stage(name, begun.status, iterations, objective, seconds, history))
        self.monitor.poses_found.append(poses)
        return begun

    def _start_by_rounds(self, soc: SOC, owners: Partition) -> tuple[str, Attempt, int, History]:
        """Start at a spanning tree, and run the chordal relaxation from there.

        The relaxation is two runs of CONSENSUS: with relaxed rotations, then with these rotations,
        projected and held. The poses of the tree are kept if they cost less.
        """
        problem = self.known_here.problem
        driver = self.driver
        tree_poses = spanning_tree_start(problem.graph)
        hand_out_along_tree(driver, problem, owners, tree_poses)
        loose = replace(
            soc, local_passes=1, tolerance=_START_TOLERANCE, max_iterations=_START_ROUNDS
        )
        silent = replace(self.monitor, callback=None, verbose=False, progress=False)
        relaxed = ConsensusSOC(loose, has_driver=False, goes_on=False, rotations=Rotations.RELAXED)
        outcome = silent.run(relaxed, driver)
        iterations = outcome.iterations
        if outcome.status.is_success:
            held = replace(relaxed, goes_on=True, rotations=Rotations.FIXED)
            outcome = silent.run(held, driver)
            iterations += outcome.iterations
        poses = collect_copies(driver)
        cost_of_tree = problem.objective(tree_poses)
        if outcome.status.is_success and problem.objective(poses) < cost_of_tree:
            begun: Attempt = StartInCopies(poses, outcome.status)
            return "chordal start, by rounds", begun, iterations, outcome.history
        begun = Attempt(tree_poses, outcome.status)
        return "spanning tree", begun, iterations, outcome.history

    def run_soc(self, attempt: Attempt, soc: AnySOC) -> Attempt:
        """Run SOC, asynchronously if there are faults, and keep the cheaper of start and end."""
        assert isinstance(soc, SOC)  # as the request has checked
        began = time.perf_counter()
        goes_on = isinstance(attempt, StartInCopies)
        outcome: Outcome[AsynchronousState] | Outcome[ConsensusState]
        if self.faults is not None:
            asynchronous = AsynchronousSOC(soc, self.faults, has_driver=False, goes_on=goes_on)
            outcome = self.monitor.run(asynchronous, self.driver)
        else:
            consensus = ConsensusSOC(soc, has_driver=False, goes_on=goes_on)
            outcome = self.journal.run(consensus, self.driver, self.monitor)
        problem = self.known_here.problem
        end = collect_copies(self.driver)
        poses, status = cheaper_end(problem, attempt.known_poses, end, outcome, soc.tolerance)
        objective = problem.objective(poses)
        seconds = time.perf_counter() - began
        stage = replace(Stage.of(outcome), name="SOC", status=status, objective=objective)
        self.table.add(replace(stage, seconds=seconds, method=soc))
        self.monitor.poses_found.append(poses)
        return Attempt(poses, status)

    def run_newton(self, attempt: Attempt, newton: Newton) -> Attempt:
        """Return the same poses: Newton needs a driver."""
        return attempt

    def certify(self, attempt: Attempt) -> Attempt:
        """Return the certificate with the bound F >= 0: another needs a driver."""
        return self.known_here.without_bound(attempt)

    def salvage(self, reason: Status) -> Attempt:
        """The best poses known, with the bound F >= 0."""
        return self.known_here.salvage(reason)


def cheaper_end(
    problem: PGOProblem, start: Poses, end: Poses, outcome: Outcome[Any], tolerance: float
) -> tuple[Poses, Status]:
    """Start or end of a run, whichever costs less, and the status of these poses.

    If the start costs less than the end of a run that has converged, the start itself has not
    converged, unless its gradient is within tolerance. The robots have summed up that gradient
    before the first step: it is in the first row of the history, which is of the start.
    """
    if not problem.objective(start) < problem.objective(end):
        return end, outcome.status
    gradient = outcome.history.records[0].measurement.dual_residual
    is_stationary = gradient <= tolerance
    if outcome.status.is_success and not is_stationary:
        return start, Status.START_KEPT
    return start, outcome.status


def collect_copies(driver: Driver) -> Poses:
    """Poses that the robots agreed on, for the result; off the ledger."""
    R = np.empty((driver.num_poses, driver.d, driver.d))
    t = np.empty((driver.num_poses, driver.d))
    for answer in ask_all(RobotsOfDriver(driver), ConsensusRobot.own_poses, None, Count.OFF):
        R[answer.poses] = answer.R
        t[answer.poses] = answer.t
    return Poses(R, t)
