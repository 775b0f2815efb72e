"""CONSENSUS without a driver: robots alone find poses, from a start by rounds, and nothing is proved about them.

They begin at a spanning tree, relax rotations and translations jointly, then find translations for the rotations, by
rounds, or begin at given poses; they end as near to the optimum as SOC's tolerance says: best translations of given
rotations, Newton and certificate are a driver's. Sums, and so the tests, go along a tree.
"""

import math
import time
from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order

from pgo_models.certificates.certificate import BoundSource, Certificate, certify_with
from pgo_models.certificates.lower_bound import NO_BOUND
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.initialization import spanning_tree, spanning_tree_start
from pgo_models.problem.problem import PGOProblem
from solvers.distributed.asynchronous import AsynchronousSOC, AsynchronousState
from solvers.distributed.checkpoint import Journal
from solvers.distributed.consensus import ConsensusSOC, RobotsOfDriver
from solvers.distributed.driver import Driver
from solvers.loop import Watch
from solvers.network.counted_pool import Count
from solvers.network.faults import Faults
from solvers.network.ledger import BYTES_PER_NUMBER, Traffic
from solvers.result import OUT_OF_TIME, History, Outcome, Stage, Status
from solvers.soc.consensus import ConsensusState, ask_all
from solvers.soc.consensus_robot import ConsensusRobot
from solvers.soc.recursion_block import Rotations
from solvers.soc.soc import SOC

_TOLERANCE, _MOST_ROUNDS = 1e-2, 100  # of the relaxation: SOC goes on from the rotations nearest to it
NO_CERTIFICATE = "no driver: Newton and the certificate were left out, and F >= 0 is all that is known of the optimum"


def attempt_leaderless(
    driver: Driver,
    problem: PGOProblem,
    robots: Partition,
    gap: float,
    faults: Faults | None,
    journal: Journal,
    watch: Watch,
    soc: SOC | None,
    start: Poses | None,
) -> tuple[Poses, Certificate]:
    """Start and CONSENSUS; what was done goes to the stages of `journal`. The bound is F >= 0.

    Of the whole `problem` nothing is used but the trees, and F of the start and of the poses that are returned.
    """
    assert soc is not None
    driver.network.tree = robot_tree(problem, robots)
    began = time.perf_counter()
    iterations, status, history, goes_on = 0, Status.CONVERGED, History(), False
    before = start if start is not None else spanning_tree_start(problem.graph)
    driver.hand_out(before)
    if start is None:
        for traffic in tree_traffic(problem, robots):
            driver.network.ledger = driver.network.ledger.after_round(traffic)
        few = replace(soc, local_passes=1, tolerance=_TOLERANCE, max_iterations=_MOST_ROUNDS)
        unseen = replace(watch, callback=None, verbose=False, progress=False)
        for rotations in (Rotations.RELAXED, Rotations.FIXED):
            rounds = unseen.run(ConsensusSOC(few, False, rotations is Rotations.FIXED, rotations), driver)
            iterations, status, history = iterations + rounds.iterations, rounds.status, rounds.history
            if not status.is_success:
                break
        found = collect_copies(driver)
        goes_on = status.is_success and problem.objective(found) < problem.objective(before)  # else from the tree
        before = found if goes_on else before
    if not journal.goes_on_with():
        name = "chordal start, by rounds" if goes_on else "given start" if start is not None else "spanning tree"
        objective, seconds = problem.objective(before), time.perf_counter() - began
        journal.stages.append(Stage(name, status, iterations, objective, seconds, history))
    poses = before
    watch.found.append(before)
    if status not in OUT_OF_TIME:
        began = time.perf_counter()
        first: Outcome[AsynchronousState] | Outcome[ConsensusState]
        if faults is not None:
            first = watch.run(AsynchronousSOC(soc, faults, has_driver=False, goes_on=goes_on), driver)
        else:
            first = journal.run(ConsensusSOC(soc, has_driver=False, goes_on=goes_on), driver, watch)
        poses = min(before, collect_copies(driver), key=problem.objective)
        watch.found.append(poses)
        objective, seconds = problem.objective(poses), time.perf_counter() - began
        journal.stages.append(Stage("SOC", first.status, first.iterations, objective, seconds, first.history, soc))
    nothing = np.zeros((problem.num_poses, problem.d, problem.d))
    return poses, certify_with(problem, poses, nothing, gap, math.inf, BoundSource.GIVEN, NO_BOUND)


def collect_copies(driver: Driver) -> Poses:
    """Poses that the robots agreed on, for whoever asked for the solution; off the ledger."""
    n, d = driver.num_poses, driver.d
    R, t = np.empty((n, d, d)), np.empty((n, d))
    for own in ask_all(RobotsOfDriver(driver), ConsensusRobot.own_poses, None, Count.OFF):
        R[own.poses], t[own.poses] = own.R, own.t
    return Poses(R, t)


def robot_tree(problem: PGOProblem, robots: Partition) -> tuple[IntArray, IntArray]:
    """Robots in order of their distance from robot 0, and the neighbour by which each is reached; the root is its own.

    Up it go sums, and figures that are not summed up; down what follows from them.
    """
    links = robots.robot[problem.graph.i], robots.robot[problem.graph.j]
    adjacency = csr_array((np.ones(problem.graph.num_edges), links), shape=(robots.num_robots, robots.num_robots))
    order, parents = breadth_first_order(adjacency, 0, directed=False)
    parents[0] = 0
    return order, parents


def tree_traffic(problem: PGOProblem, robots: Partition) -> list[Traffic]:
    """Messages of every round of a spanning tree: a pose goes along each of its edges that join two robots."""
    order, parent, _ = spanning_tree(problem.graph, 0)
    owner, child = robots.robot, order[1:]
    depth = np.zeros(problem.num_poses, dtype=np.int64)
    is_cut = owner[child] != owner[parent[child]]
    for pose, crosses in zip(child.tolist(), is_cut.tolist(), strict=True):
        depth[pose] = depth[parent[pose]] + crosses
    size = BYTES_PER_NUMBER * problem.d * (problem.d + 1)
    found = []
    for number in range(1, int(depth.max()) + 1):
        at = child[is_cut & (depth[child] == number)]
        links, poses = np.unique(np.stack([owner[parent[at]], owner[at]]), axis=1, return_counts=True)
        found.append(Traffic(links[0], links[1], size * poses))
    return found
