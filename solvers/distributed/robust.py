"""Graduated non-convexity by driver and robots: residuals and weights stay with the robots, the control is sent."""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import bridges
from pgo_models.problem.problem import PGOProblem
from solvers.distributed.driver import Driver, collect
from solvers.distributed.leaderless import tree_traffic
from solvers.distributed.newton import SubstructuredNewton
from solvers.distributed.robots.records import RatioSums, Reweigh
from solvers.distributed.robots.reweighting import count_below, edges_within, sum_ratios
from solvers.distributed.stages import open_driver
from solvers.loop import Watch
from solvers.network.counted_pool import Count
from solvers.network.engine import Engine
from solvers.network.ledger import Ledger
from solvers.result import Measurement, Stage, Status
from solvers.robust.gnc import GNC, GNCSchedule, RobustLoss, first_poses, known_inliers, left_out

_HALVINGS = 26  # of an interval of 24 factors of ten, for a median to 1e-6 of itself


@dataclass(frozen=True)
class SharedGNCState:
    """State k; see `solvers.robust.gnc.GNCState`. The poses are with driver and robots."""

    k: int
    schedule: GNCSchedule
    sums: RatioSums

    @property
    def objective(self) -> float:
        """The robust cost."""
        return self.sums.cost


@dataclass(frozen=True)
class SharedGNC:
    """`GNC` by a driver and its robots, from the poses that they hold."""

    gnc: GNC
    least: float

    @property
    def max_iterations(self) -> int:
        """Most sets of weights."""
        return self.gnc.max_iterations

    def init(self, driver: Driver, start: SharedGNCState | None) -> SharedGNCState:
        """State 0, at the poses that driver and robots hold."""
        sums = self._sums(driver, 1.0, self.gnc.scale)
        mu = self.gnc.first_control(sums.largest, self.least**2 * min(1.0, sums.least))
        return SharedGNCState(0, GNCSchedule(mu, self.gnc.scale, self.gnc.scalings), sums)

    def step(self, driver: Driver, state: SharedGNCState) -> SharedGNCState:
        """Weights for the residuals at hand, Newton steps with them, and the next control."""
        gnc, schedule = self.gnc, state.schedule
        if schedule.rescaled and gnc.is_settled(schedule):
            of_kept = (self._median(driver, state), state.sums.largest_kept) if state.sums.kept else None
            schedule = gnc.rescaled(driver.d, schedule, of_kept)
        driver.reweigh(self._order(schedule.mu, schedule.scale))
        before, newton = driver.at.objective, SubstructuredNewton()
        moving = newton.init(driver, None)
        for _ in range(gnc.inner_steps):
            moving = newton.step(driver, moving)
            if gnc.follows(moving.decrement, moving.moved):
                break
        sums = self._sums(driver, schedule.mu, schedule.scale)
        lost = before / driver.at.objective - 1.0 if driver.at.objective else 0.0
        undecided = sums.undecided / max(1.0, sums.count)
        following = gnc.following(schedule, undecided, moving.decrement + lost, moving.moved)
        return SharedGNCState(state.k + 1, following, sums)

    def measure(self, driver: Driver, state: SharedGNCState) -> Measurement:
        """The robust cost, the share of undecided edges, and the decrement."""
        return driver.measured(Measurement(state.objective, state.schedule.undecided, state.schedule.decrement))

    def converged(self, state: SharedGNCState, measurement: Measurement) -> Status | None:
        """As the central run."""
        return self.gnc.ending(state.schedule)

    def _order(self, mu: float, scale: float) -> Reweigh:
        return Reweigh(self.gnc.loss is RobustLoss.TRUNCATED, mu, scale, self.least)

    def _sums(self, driver: Driver, mu: float, scale: float) -> RatioSums:
        answers = driver.ask(sum_ratios, self._order(mu, scale))
        names = ("count", "undecided", "kept", "cost")
        sums = {name: math.fsum(getattr(one, name) for one in answers) for name in names}
        most = {name: max(getattr(one, name) for one in answers) for name in ("largest", "largest_kept")}
        return RatioSums(**sums, **most, least=min(one.least for one in answers))

    def _median(self, driver: Driver, state: SharedGNCState) -> float:
        """Median ratio of the edges kept, by counts."""
        low, high = -24.0, 0.0
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            below = math.fsum(driver.ask(count_below, (state.schedule.scale, 10.0**middle)))
            low, high = (low, middle) if below >= 0.5 * state.sums.kept else (middle, high)
        return float(10.0**high)


@dataclass(frozen=True, eq=False)
class SharedEstimate:
    """What robots found: poses, the edges kept, (m,), the scale of the thresholds, and the account of it."""

    poses: Poses
    kept: BoolArray
    scale: float
    stage: Stage
    ledger: Ledger


def estimate_by_robots(
    problem: PGOProblem,
    gnc: GNC,
    thresholds: Array,
    start: Poses | None,
    watch: Watch,
    robots: Partition,
    engine: Engine,
    memory: float,
) -> SharedEstimate:
    """Graduated non-convexity by robots, from `start` or along a tree of known inliers.

    Edges that connect what those kept leave apart are kept, too; as all that is handed back they are off the ledger.
    """
    known = known_inliers(problem.graph, gnc.known)
    allowed = np.where(known, np.inf, thresholds)
    with closing(open_driver(problem, robots, engine, memory, allowed)) as driver:
        driver.hand_out(start if start is not None else first_poses(problem.graph, known))
        if start is None:
            for traffic in tree_traffic(problem, robots):
                driver.network.ledger = driver.network.ledger.after_round(traffic)
        driver.choose_cost(final=True)
        run = watch.run(SharedGNC(gnc, left_out(problem.graph, known)), driver)
        scale = run.state.schedule.scale
        kept = np.zeros(problem.graph.num_edges, dtype=bool)
        kept[np.concatenate(driver.ask(edges_within, scale, Count.OFF))] = True
        poses = collect(driver)[0]
        kept[bridges(problem.graph, kept, problem.edge_costs(poses) / thresholds)] = True
        stage = Stage("GNC", run.status, run.iterations, run.objective, run.seconds, run.history, gnc)
        return SharedEstimate(poses, kept, scale, stage, driver.network.ledger)
