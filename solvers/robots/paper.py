"""Algorithm 1 of the paper by robots on a network: one exchange between neighbours an iteration.

The iterates are those of `solvers.soc.paper` with a block for every robot. All sums that rho and
the residuals need go along with that exchange: a robot does the steps (a) to (c) of an iterate
before it is known how good the last one is, so that R of the one and the residuals of the other
travel together. The last steps of a run are in vain.

A run that does not converge ends with its best iterate. Here that is the one of the least cost of
rotations, in one place the one of least F: best translations would take two more rounds an
iteration.

A robot has its own block of L, and the rotations that its neighbours have sent. It does the steps
(a), (b) and (c) of its own poses, and tells its neighbours its R of the poses that they hold, once
an iteration, in full precision. They repeat (b) and (c) for these poses, and so know omega, too,
which nobody sends.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pgo_models.certificates.dual_variables import multiplier_norms
from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, stack_transposes, unstack_transposes
from pgo_models.problem.matrices import inner, norm
from solvers.carry.counted_pool import Count
from solvers.carry.messages import Messages
from solvers.carry.moments import Moment
from solvers.carry.registry import order, record
from solvers.carry.serialization import COMPUTED_AGAIN
from solvers.result import Measurement, Status
from solvers.robots.agent import Agent, held_poses, order_copies
from solvers.robots.consensus import RobotsOfDriver
from solvers.robots.driver import Driver
from solvers.soc.copies import CopyLayout, Rows
from solvers.soc.paper import Blocks, CommonPenalty, PaperIterate, PaperSOC
from solvers.soc.penalty import PenaltyOrder
from solvers.soc.r_step import RotationStep, RStep


@record("PaperRobotsState")
@dataclass(frozen=True, eq=False)
class PaperRobotsState:
    """Iterate k, whose rows the robots hold at a moment, and what is known of the next one."""

    k: int
    penalty: CommonPenalty  # rho of the next iterate, k + 1, whose steps the robots have done
    root: float  # sqrt(n d)
    scale: float  # mean diagonal of L
    squares: Array  # (3,): of the iterate k + 1: the sums of `PaperReply`
    rows: Sequence[Rows]  # R of the iterate k + 1, from the neighbours of every robot
    objective: float  # <omega, L omega>, the rotations' part of F
    primal_residual: float = math.inf  # p_res
    dual_residual: float = math.inf  # that of `PaperState`
    # when the robots hold this
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


# The robot.


@order("robot.begin_paper")
def begin_paper(agent: Agent, cover: Poses) -> Rows:
    """Start Algorithm 1 at the current poses, of which the driver sends those of the cover."""
    agent.copies = PaperCopies().robot(agent.layout)
    return order_copies(PaperRobot.begin, agent, held_poses(agent, cover))


@record("PaperUnits")
@dataclass(frozen=True, eq=False)
class PaperUnits:
    """A robot's part of what rho and the residuals are measured in: sums over its own poses."""

    rho: float  # first penalties
    diagonal: float  # diagonal of L
    cost: float  # <omega, L omega>, at the start
    num_poses: int  # how many they are


@record("PaperPenalty")
@dataclass(frozen=True)
class PaperPenalty:
    """Order to do steps (a) to (c) with this rho from now on; `r_step` solves (a)."""

    rho: float
    r_step: RStep


@record("PaperReply")
@dataclass(frozen=True, eq=False)
class PaperReply:
    """What a robot tells after the steps (a) to (c)."""

    squares: Array  # (3,): those of `PaperIterate.squares`
    rows: Rows  # R^T of the poses that a neighbour holds, for every neighbour


@record("PaperLast")
@dataclass(frozen=True, eq=False)
class PaperLast:
    """A robot's part of the iterate whose R the neighbours have just sent: sums of its own."""

    gradient: float  # ||2 L R + rho B||^2 over its own rows
    cost: float  # <omega, L omega> over its own rows, which add up to the rotations' part of F


@record("PaperCopies")
@dataclass(frozen=True, eq=False)
class PaperCopies:
    """What orders leave with a robot."""

    # (rows, d): poses at the start, rows as in `CopyLayout`; own ones and those of neighbours
    X: Array = field(default_factory=lambda: np.zeros((0, 0)))
    penalty: PaperPenalty | None = None  # rho of the iterate `ahead`, and who solves (a)
    last: PaperIterate | None = None  # the iterate of the robot's and its neighbours' poses, (n_a)
    # the next one of its own poses, whose R is on its way to the neighbours
    ahead: PaperIterate | None = None

    def robot(self, layout: CopyLayout) -> PaperRobot:
        """The robot in this state."""
        robot = PaperRobot(layout, self)
        return robot if self.penalty is None else robot._prepared()


@dataclass(frozen=True, eq=False)
class PaperRobot:
    """A robot: its layout, the state that earlier orders left, and what follows from both."""

    layout: CopyLayout
    state: PaperCopies
    blocks: Blocks | None = None
    step_a: RotationStep | None = None

    def begin(self, poses: Poses) -> tuple[PaperRobot, Rows]:
        """Start at own poses, (n_a), and send them to the neighbours that hold copies."""
        X = poses.stacked()
        return self._with(X=X), self.layout.rows_of_own_poses(X)

    @order("paper.ratios")
    def ratios(self, rows: Rows) -> tuple[PaperRobot, Array]:
        """Take the owners' poses; return ||Lambda_i||_2 / m_i of the robot's own."""
        following = self._with(X=self.layout.with_rows_of_others(self.state.X.copy(), rows))
        norms, scale = following._norms_and_scale
        return following, norms / scale

    @order("paper.units")
    def units(self, order: PenaltyOrder) -> tuple[PaperRobot, PaperUnits]:
        """Return the sums that rho and the residuals are measured in."""
        norms, scale = self._norms_and_scale
        rho = float(order.rho(norms, scale).sum())
        blocks = self._blocks
        cost = self._cost_at(self._R_of_start)
        units = PaperUnits(rho, float(blocks.own.diagonal().sum()), cost, len(norms))
        return replace(self, blocks=blocks), units

    @order("paper.start")
    def start(self, penalty: PaperPenalty) -> tuple[PaperRobot, PaperReply]:
        """Set R = omega to the poses and B = 0, and do the first steps (a) to (c)."""
        last = PaperIterate.first(self._R_of_start)
        return self._with(last=last, penalty=penalty)._prepared()._with_next()

    @order("paper.step")
    def step(
        self, order: tuple[PaperPenalty, Rows]
    ) -> tuple[PaperRobot, tuple[PaperLast, PaperReply]]:
        """Take the neighbours' R of the iterate that was ahead, and do the steps of the next one.

        The order has rho of the next iterate. The steps of the last one have used the rho before.
        """
        penalty, rows = order
        assert self.state.penalty is not None
        rho = self.state.penalty.rho
        last = self._completed(rows)
        own_iterate = last.of(self.layout.own_poses)
        gradient = self._blocks.gradient(own_iterate, last.R, rho)
        last_figures = PaperLast(float(norm(gradient) ** 2), self._cost_at(last.omega))
        factor = penalty.rho / rho
        following = self._with(last=last.with_scaled_penalty(factor), penalty=penalty)
        if factor != 1.0:
            following = following._prepared()
        following, reply = following._with_next()
        return following, (last_figures, reply)

    @property
    def omega(self) -> Array:
        """Rotations of the robot's and its neighbours' poses, (n_a, d, d)."""
        assert self.state.last is not None
        return self.state.last.omega

    def _with(self, **changes: object) -> PaperRobot:
        """The robot with changed fields of its state, whose types mypy cannot check."""
        return replace(self, state=replace(self.state, **changes))  # type: ignore[arg-type]

    def _completed(self, rows: Rows) -> PaperIterate:
        """The iterate that was ahead, completed by the R that the neighbours have sent."""
        state = self.state
        assert state.last is not None
        assert state.ahead is not None
        own_poses = self.layout.own_poses
        R = state.last.R.copy()
        omega = state.last.omega.copy()
        B = state.last.B.copy()
        R[own_poses], omega[own_poses], B[own_poses] = (
            state.ahead.R,
            state.ahead.omega,
            state.ahead.B,
        )
        for robot, theirs in self.layout.received.items():
            arrived = state.last.of(theirs).with_R(unstack_transposes(rows[robot]))
            R[theirs], omega[theirs], B[theirs] = arrived.R, arrived.omega, arrived.B
        return PaperIterate(R, omega, B)

    def _with_next(self) -> tuple[PaperRobot, PaperReply]:
        """The robot with the next iterate, and what it tells of it."""
        state = self.state
        assert self.step_a is not None
        assert state.penalty is not None
        assert state.last is not None
        own_iterate = state.last.of(self.layout.own_poses)
        ahead = self._blocks.iteration(self.step_a, state.penalty.rho, own_iterate, state.last.R)
        reply = PaperReply(ahead.squares(own_iterate), self._sent(ahead.R))
        return self._with(ahead=ahead), reply

    def _cost_at(self, R: Array) -> float:
        """<R, L R> over own rows, from R of the robot's and its neighbours' poses, (n_a, d, d)."""
        own_R = R[self.layout.own_poses]
        return inner(stack_transposes(own_R), self._blocks.pull(own_R, R))

    @property
    def _R_of_start(self) -> Array:
        return unstack_transposes(self.state.X[self.layout.problem.num_poses :])

    def _sent(self, R: Array) -> Rows:
        """R^T of the poses that a neighbour holds, from R of own poses, for every neighbour."""
        place = np.cumsum(self.layout.subgraph.is_own) - 1
        sent = self.layout.sent.items()
        return Messages({robot: stack_transposes(R[place[mine]]) for robot, mine in sent})

    def _prepared(self) -> PaperRobot:
        """The robot with step (a) for its penalty."""
        assert self.state.penalty is not None
        penalty = self.state.penalty
        blocks = self._blocks
        return replace(self, blocks=blocks, step_a=blocks.prepared(penalty.rho, penalty.r_step))

    @property
    def _blocks(self) -> Blocks:
        if self.blocks is not None:
            return self.blocks
        layout = self.layout
        graph = layout.subgraph.graph
        is_own = layout.subgraph.is_own
        is_cut = ~(is_own[graph.i] & is_own[graph.j])
        return Blocks.of(layout.full_problem, is_cut, layout.own_poses)

    @property
    def _norms_and_scale(self) -> tuple[Array, Array]:
        """||Lambda_i||_2 and m_i of own poses, at the start."""
        own_poses = self.layout.own_poses
        norms = multiplier_norms(self.layout.multipliers(self.state.X)[own_poses])
        return norms, np.asarray(self.layout.diagonal[own_poses, 1:].mean(axis=1))
