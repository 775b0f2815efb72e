"""Algorithm 1 of the paper by robots on a network: one exchange between neighbours an iteration.

The iterates are those of `solvers.soc.paper` with a block for every robot. All sums that rho and
the residuals need go along with that exchange: a robot does the steps (a) to (c) of an iterate
before it is known how good the last one is, so that R of the one and the residuals of the other
travel together. The last steps of a run are in vain.

A run that does not converge ends with its best iterate. Here that is the one of the least cost of
rotations, in one place the one of least F: best translations would take two more rounds an
iteration.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from solvers.carry.counted_pool import Count
from solvers.carry.moments import Moment
from solvers.carry.registry import record
from solvers.carry.serialization import COMPUTED_AGAIN
from solvers.result import Measurement, Status
from solvers.robots.agent import begin_paper
from solvers.robots.consensus import RobotsOfDriver
from solvers.robots.driver import Driver
from solvers.soc.copies import Rows
from solvers.soc.paper import CommonPenalty, PaperSOC
from solvers.soc.paper_robot import PaperPenalty, PaperReply, PaperRobot
from solvers.soc.penalty import PenaltyOrder
from solvers.soc.r_step import RStep


@record("PaperRobotsState")
@dataclass(frozen=True, eq=False)
class PaperRobotsState:
    """Iterate k, whose rows the robots hold at a moment, and what is known of the next one.

    Parameters
    ----------
    k : int
        Number of the iterate.
    penalty : CommonPenalty
        rho of the next iterate, k + 1, whose steps the robots have done.
    root : float
        sqrt(n d).
    scale : float
        Mean diagonal of L.
    squares : (3,) array
        Of the iterate k + 1: the sums of `PaperReply`.
    rows : sequence of mappings
        R of the iterate k + 1, from the neighbours of every robot.
    objective : float
        <omega, L omega>, the rotations' part of F.
    primal_residual : float
        p_res.
    dual_residual : float
        That of `PaperState`.
    moment : Moment or None
        When the robots hold this.
    """

    k: int
    penalty: CommonPenalty
    root: float
    scale: float
    squares: Array
    rows: Sequence[Rows]
    objective: float
    primal_residual: float = math.inf
    dual_residual: float = math.inf
    moment: Moment | None = field(default=None, metadata=COMPUTED_AGAIN)


@dataclass(frozen=True)
class PaperByRobots:
    """Algorithm 1 by robots, from the poses that they and the driver hold."""

    soc: PaperSOC

    @property
    def max_iterations(self) -> int:
        """Maximal number of steps of a run."""
        return self.soc.max_iterations

    def init(self, driver: Driver, start: PaperRobotsState | None) -> PaperRobotsState:
        """State 0: R = omega = the current rotations, B = 0; two rounds."""
        if start is not None:
            return replace(start, moment=driver.moment())
        robots = RobotsOfDriver(driver)
        poses_of_cover = driver.poses_of_cover()
        poses = robots.exchange(driver.network.ask(begin_paper, poses_of_cover, Count.PIGGYBACKED))
        ratios = robots.ask(PaperRobot.ratios, poses, Count.GATHER)
        order = PenaltyOrder(*self.soc.penalty.bounds(np.concatenate(ratios)))
        parts = robots.ask(PaperRobot.units, [order] * len(poses), Count.ALL_REDUCE)
        num_poses = sum(part.num_poses for part in parts)
        num_rows = num_poses * driver.d
        penalty = CommonPenalty(math.fsum(part.rho for part in parts) / num_poses)
        orders = [self._order(penalty)] * len(poses)
        replies = robots.ask(PaperRobot.start, orders, Count.ALL_REDUCE)
        state = PaperRobotsState(
            k=0,
            penalty=penalty,
            root=math.sqrt(num_rows),
            scale=math.fsum(part.diagonal for part in parts) / num_rows,
            squares=np.zeros(3),
            rows=(),
            objective=math.fsum(part.cost for part in parts),
        )
        return _ahead_by(driver, state, replies)

    def step(self, driver: Driver, state: PaperRobotsState) -> PaperRobotsState:
        """Make one iteration: one round between neighbours, and with it an all-reduce."""
        driver.return_to(state.moment)
        p_res = math.sqrt(state.squares[2] * driver.d) / state.root
        following = replace(state, k=state.k + 1, primal_residual=p_res)
        if not math.isfinite(p_res):
            return replace(following, dual_residual=math.nan, objective=math.nan)
        primal, change, _ = np.sqrt(state.squares) / state.root
        penalty = state.penalty.after(self.soc.penalty, float(primal), float(change))
        order = self._order(penalty)
        orders = [(order, rows) for rows in state.rows]
        answers = RobotsOfDriver(driver).ask(PaperRobot.step, orders, Count.ALL_REDUCE)
        gradient = math.sqrt(math.fsum(last.gradient for last, _ in answers))
        following = replace(
            following,
            penalty=penalty,
            objective=math.fsum(last.cost for last, _ in answers),
            dual_residual=gradient / (state.root * state.scale),
        )
        return _ahead_by(driver, following, [reply for _, reply in answers])

    def measure(self, driver: Driver, state: PaperRobotsState) -> Measurement:
        """The rotations' part of F, the residuals, and what crossed the network.

        Best translations for omega, and F with them, would take two more rounds.
        """
        return driver.measured(
            Measurement(state.objective, state.primal_residual, state.dual_residual)
        )

    def converged(self, state: PaperRobotsState, measurement: Measurement) -> Status | None:
        """CONVERGED when the residuals that `PaperSOC.stop` names are within tolerance."""
        return self.soc.status_at(state.k, measurement)

    def finish(self, driver: Driver, state: PaperRobotsState) -> None:
        """Give driver and robots omega, and the best translations for it: two rounds."""
        driver.return_to(state.moment)
        RobotsOfDriver(driver).finish()

    def _order(self, penalty: CommonPenalty) -> PaperPenalty:
        assert isinstance(self.soc.r_step, RStep)  # as `check_paper` has seen
        return PaperPenalty(penalty.rho, self.soc.r_step)


def check_paper(soc: PaperSOC) -> None:
    """Raise a SettingError for a PaperSOC that robots cannot run."""
    if not isinstance(soc.r_step, RStep):
        raise SettingError(
            f"robots are sent the name of a back end, got {soc.r_step!r}; use an RStep, "
            "or leave out the robots of solve()"
        )


def _ahead_by(
    driver: Driver, state: PaperRobotsState, replies: Sequence[PaperReply]
) -> PaperRobotsState:
    """State with what robots told of the next iterate, its R delivered to the neighbours."""
    rows = driver.network.exchange([reply.rows for reply in replies])
    squares = np.sum([reply.squares for reply in replies], axis=0)
    return replace(state, squares=squares, rows=rows, moment=driver.moment())
