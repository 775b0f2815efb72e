"""The place where robots of one graph and a driver solve: each robot has the edges of its poses.

The calling process has the whole graph, cuts it into the robots' parts, and asks the result of
them. Robots hold the poses between two steps. What they are asked is counted (`solvers.carry`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

from pgo_models.certificates.certificate import BoundSource, certify_with
from pgo_models.certificates.handedness import distinct_pairs
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.initialization import chordal_start, spanning_tree_start
from pgo_models.problem.problem import PGOProblem
from solvers.carry.counted_pool import Count
from solvers.carry.ledger import BYTES_PER_NUMBER
from solvers.carry.process import DEFAULT_MEMORY, Engine
from solvers.handedness.ascent import AscentState
from solvers.handedness.complex_relaxation import ComplexRelaxation
from solvers.handedness.hull_lagrangian import HullLagrangian
from solvers.handedness.search import HandednessSearch, stage_of_search
from solvers.here import Here
from solvers.place import AnySOC, Attempt, Ending, OwnStart, Traits, after_search
from solvers.result import Outcome, Stage
from solvers.riemannian.prefixes import GrowingStart
from solvers.riemannian.staircase import Staircase
from solvers.robots.agent import Agent
from solvers.robots.driver import Driver, collect
from solvers.robots.handedness import (
    RobotsPoint,
    begin_without_terms,
    hand_out_terms,
    return_to_best,
)
from solvers.robots.place import AttemptWithFaults, DriverPlace
from solvers.robots.place_without_driver import tree_traffic
from solvers.robots.proof import best_bound_distributed, best_bound_with_terms
from solvers.robots.reweigh import SharedGNC, inliers_of
from solvers.robots.translations import reduce_translations
from solvers.robust.gnc import GNC, Inliers
from solvers.robust.known import KnownEdges
from solvers.robust.weighted_edges import first_poses
from solvers.soc.subgraph import middle_separator, split_graph


def open_driver(
    problem: PGOProblem,
    robots: Partition,
    engine: Engine,
    memory: float = DEFAULT_MEMORY,
    thresholds: Array | None = None,
) -> Driver:
    """Driver and robots for a problem.

    A robust solve gives the `thresholds`, (m,), of its edges.
    """
    subgraphs = split_graph(problem, robots, thresholds)
    if memory != 0:
        subgraphs = tuple(subgraph.for_driver() for subgraph in subgraphs)
    summaries = [subgraph.summary for subgraph in subgraphs]
    grounded = middle_separator(problem.graph, summaries)
    start = partial(engine.open, partial(Agent, backend=problem.backend), subgraphs)
    driver = Driver(summaries, problem.num_poses, start, memory, grounded, problem.backend)
    ledger = driver.network.ledger
    driver.network.ledger = replace(ledger, graph_bytes=bytes_of_edges(problem.graph))
    return driver


def bytes_of_edges(graph: PoseGraph) -> int:
    """Bytes of a list of all edges, each a relative pose and the two precisions of F."""
    return BYTES_PER_NUMBER * graph.num_edges * (graph.d * (graph.d + 1) // 2 + 2)


@dataclass(frozen=True, eq=False)
class RobotsOfGraph(DriverPlace):
    """A solve by a driver and robots of one graph.

    What has no counterpart by robots is done `here`, in the calling process, and the name of its
    stage says so.
    """

    here: Here
    robots: Partition

    @property
    def traits(self) -> Traits:
        """Traits of the graph; its rotations are averaged if all robots can average theirs."""
        # The rotation of a loose world depends on positions alone.
        averages = self.driver.can_average and not self.here.problem.graph.is_world_loose
        return replace(self.here.traits, averages=averages, has_robots=True)

    @property
    def odometry_joins(self) -> bool:
        """Whether every pose but the first has an edge to an earlier one."""
        return self.here.odometry_joins

    def start(self, start: Poses | OwnStart, soc: AnySOC | None) -> Attempt:
        """Start at given poses, at an own start, or at the outcome that a checkpoint has.

        The spanning tree is found in one place, and so is the start of a graph with a loose world.
        """
        known = self._known_outcome()
        if known is not None:
            return known
        problem = self.here.problem
        if not isinstance(start, OwnStart):
            return self._start_at("given start", problem.seen_poses(start))
        if problem.graph.is_world_loose:
            return self._start_at("chordal start, in one place", chordal_start(problem.convex_part))
        if start is OwnStart.TREE:
            poses = spanning_tree_start(problem.convex_part.graph)
            return self._start_at("spanning tree, in one place", poses)
        return self.own_start(start)

    def _start_at(self, name: str, poses: Poses) -> Attempt:
        """Bring the robots to poses that this process has."""
        return self.begin(name, partial(self.driver.set_poses, poses))

    def _known_outcome(self) -> Attempt | None:
        """Outcome of the attempt that begins, if a checkpoint is of a later one."""
        outcome = self.journal.take_outcome()
        if outcome is None:
            return None
        poses, certificate = outcome
        return Attempt(poses, certificate=certificate)

    def certify(self, attempt: Attempt) -> Attempt:
        """Collect the poses from the robots, and prove their certificate by driver and robots.

        The whole problem serves for F of these poses alone.
        """
        here = self.here
        with self.monitor.showing("certificate"):
            bound = best_bound_distributed(self.driver, here.gap)
            poses, Lambda = collect(self.driver)
            certificate = certify_with(
                here.problem, poses, Lambda, here.gap, attempt.decrement, BoundSource.GIVEN, bound
            )
        if self.faults is not None and isinstance(attempt, AttemptWithFaults):
            # A robot may have fallen silent since SOC ended.
            attempt.check_heard(self.faults, self.driver.network.ledger.rounds)
        self.journal.end_attempt((poses, certificate))
        return replace(attempt, poses=poses, certificate=certificate)

    def run_gnc(self, gnc: GNC, start: Poses | None) -> Inliers:
        """Run graduated non-convexity by the robots, which have the thresholds of their edges."""
        driver = self.driver
        problem = self.here.problem
        if start is None:
            known = KnownEdges.of(problem.graph, gnc.known).edges
            driver.hand_out(first_poses(problem.graph, known))
            for traffic in tree_traffic(problem, self.robots):
                driver.network.ledger = driver.network.ledger.after_round(traffic)
        else:
            driver.hand_out(start)
        driver.choose_cost(final=True)
        finished = self.monitor.run(SharedGNC.of(gnc, problem.graph), driver)
        return inliers_of(problem, gnc, driver, finished)

    def better(self, best: Attempt, other: Attempt) -> Attempt:
        """Return the cheaper poses with the best bound that either has."""
        return self.here.better(best, other)

    def start_grown(self, growing: GrowingStart) -> Attempt:
        """Start the robots at poses that prefixes lead to, which are solved in one place."""
        known = self._known_outcome()
        if known is not None:
            return known
        if self.journal.goes_on_with():
            return Attempt()
        grown = self.here.start_grown(growing)
        self.driver.choose_cost(final=True)
        self.driver.set_poses(grown.known_poses)
        return Attempt(status=grown.status)

    def start_again(self) -> Poses | None:
        """The optimum of F, found in one place, where the cost is another; else None."""
        return self.here.start_again()

    def climb(self, best: Attempt, staircase: Staircase) -> Attempt:
        """Have the robots climb the staircase from the best poses, and round its solution."""
        self.driver.set_poses(best.known_poses)
        return self.climb_from_current(staircase)

    def bound_by_smaller_matrices(self, best: Attempt) -> Attempt:
        """Try smaller information matrices, in one place."""
        return self.here.bound_by_smaller_matrices(best)

    def solve_in_complex_numbers(self, best: Attempt, method: ComplexRelaxation) -> Attempt:
        """Solve the relaxation with complex numbers in one place."""
        return self.here.solve_in_complex_numbers(best, method)

    def bound_by_terms(
        self, best: Attempt, search: HandednessSearch, Pi: Array | None = None
    ) -> Attempt:
        """Return the same poses, with the bound of terms that the robots have of their edges."""
        driver = self.driver
        here = self.here
        poses = best.known_poses
        driver.choose_cost(final=True)
        driver.set_poses(poses)
        driver.set_translations(driver.ask(reduce_translations, None, Count.PIGGYBACKED))
        driver.describe(Count.PIGGYBACKED)
        if Pi is None:
            begin_without_terms(driver)
        else:
            hand_out_terms(driver, distinct_pairs(here.problem.graph), poses, Pi)
        first = RobotsPoint.first(driver, search.ascent.num_eigenvalues)
        outcome: Outcome[AscentState[RobotsPoint]] = self.monitor.run(search.ascent, first)
        stage = stage_of_search(outcome)
        self.table.add(stage)
        bound = best_bound_with_terms(driver, here.gap, return_to_best(driver))
        certificate = best.proof
        if bound.value > certificate.bound.value:
            certificate = certify_with(
                here.problem,
                poses,
                collect(driver)[1],
                here.gap,
                certificate.stationarity,
                BoundSource.GIVEN,
                bound,
            )
        return after_search(best, certificate, stage)

    def solve_hulls(self, best: Attempt, method: HullLagrangian) -> Attempt:
        """Solve the relaxation with hulls in one place."""
        return self.here.solve_hulls(best, method)

    @property
    def has_poses(self) -> bool:
        """Whether the robots have begun."""
        return bool(self.table.stages)

    def salvage(self, ending: Ending) -> Attempt:
        """The best poses known, those of the robots among them, with the bound F >= 0."""
        if ending in (Stage.interruption, Stage.silence):
            self.monitor.poses_found.append(collect(self.driver)[0])
        return self.here.salvage(ending)
