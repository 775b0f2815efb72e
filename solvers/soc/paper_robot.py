"""One robot of Algorithm 1: its own block of L, and the rotations that its neighbours have sent.

Orders are as in `solvers.soc.consensus_robot`. A robot does the steps (a), (b) and (c) of its own
poses, and tells its neighbours its R of the poses that they hold, once an iteration, in full
precision. They repeat (b) and (c) for these poses, and so know omega, too, which nobody sends.
`solvers.robots.paper` gives the orders.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pgo_models.certificates.dual_variables import multiplier_norms
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, stack_transposes, unstack_transposes
from pgo_models.problem.matrices import inner, norm
from solvers.carry.messages import Messages
from solvers.carry.registry import order, record
from solvers.soc.copies import CopyLayout, Rows
from solvers.soc.paper import Blocks, PaperIterate
from solvers.soc.penalty import PenaltyOrder
from solvers.soc.r_step import RotationStep, RStep


@record("PaperUnits")
@dataclass(frozen=True, eq=False)
class PaperUnits:
    """A robot's part of what rho and the residuals are measured in: sums over its own poses.

    Parameters
    ----------
    rho : float
        First penalties.
    diagonal : float
        Diagonal of L.
    cost : float
        <omega, L omega>, at the start.
    num_poses : int
        How many they are.
    """

    rho: float
    diagonal: float
    cost: float
    num_poses: int


@record("PaperPenalty")
@dataclass(frozen=True)
class PaperPenalty:
    """Order to do steps (a) to (c) with this rho from now on; `r_step` solves (a)."""

    rho: float
    r_step: RStep


@record("PaperReply")
@dataclass(frozen=True, eq=False)
class PaperReply:
    """What a robot tells after the steps (a) to (c).

    Parameters
    ----------
    squares : (3,) array
        Those of `PaperIterate.squares`.
    rows : mapping
        R^T of the poses that a neighbour holds, for every neighbour.
    """

    squares: Array
    rows: Rows


@record("PaperLast")
@dataclass(frozen=True, eq=False)
class PaperLast:
    """A robot's part of the iterate whose R the neighbours have just sent: sums of its own.

    Parameters
    ----------
    gradient : float
        ||2 L R + rho B||^2 over its own rows.
    cost : float
        <omega, L omega> over its own rows, which add up to the rotations' part of F.
    """

    gradient: float
    cost: float


@record("PaperCopies")
@dataclass(frozen=True, eq=False)
class PaperCopies:
    """What orders leave with a robot.

    Parameters
    ----------
    X : (rows, d) array
        Poses at the start, rows as in `CopyLayout`; own ones and those of neighbours.
    penalty : PaperPenalty or None
        rho of the iterate `ahead`, and who solves (a).
    last : PaperIterate or None
        The iterate of the robot's and its neighbours' poses, (n_a).
    ahead : PaperIterate or None
        The next one of its own poses, whose R is on its way to the neighbours.
    """

    X: Array = field(default_factory=lambda: np.zeros((0, 0)))
    penalty: PaperPenalty | None = None
    last: PaperIterate | None = None
    ahead: PaperIterate | None = None


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

    def restored(self, state: PaperCopies) -> PaperRobot:
        """The robot with the state of a checkpoint or of another process."""
        robot = replace(self, state=state)
        return robot if state.penalty is None else robot._prepared()

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
