"""One robot of the CONSENSUS coupling: its own poses, copies of separators, and its part of SOC.

An edge between two robots counts half with each. Two neighbours send each other rows of the poses
that both hold, and the owner of a pose sends the pose's penalty. Messages to the neighbours are a
mapping from the receivers' numbers. Most methods are orders. An order takes a request and returns a
new robot with its answer; the old robot does not change. `solvers.soc.consensus` calls the orders
in turn.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse.csgraph import connected_components

from pgo_models.certificates.dual_variables import multiplier_norms
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import (
    Array,
    project_to_rotations,
    stack_transposes,
    unstack_transposes,
)
from pgo_models.problem.matrices import inner
from pgo_models.problem.stationarity import gradient_squares, rotation_squares
from solvers.carry.messages import Messages
from solvers.carry.registry import order, record
from solvers.soc import copies
from solvers.soc.anderson import AndersonShare
from solvers.soc.penalty import PenaltyOrder
from solvers.soc.r_step import RotationStep, prepare
from solvers.soc.recursion_block import (
    Agreement,
    RecursionBlock,
    Rotations,
    StepSettings,
    block_at,
    nearest_rotations,
    stationary_B,
)
from solvers.soc.rounding import WHOLE, RowChange
from solvers.soc.separator_stiffness import GROUND, stiffness_of_separators, travel

_OVER_RELAXATION = 1.8  # of an asynchronous run
# Such a run makes progress when a merit falls to this share of the smallest so far; it
# stagnates when that has not happened for so many turns.
_PROGRESS = 0.9
_PATIENCE = 20


@record("Waiting")
@dataclass(frozen=True, eq=False)
class Waiting:
    """What a robot of an asynchronous run has received, and how far it relaxes."""

    newest: Mapping[int, Array]  # the newest rows from every neighbour
    waited: Mapping[int, int]  # how many turns ago they arrived
    excess: float = 1.0  # share of the over-relaxation that is left
    least: float = math.inf  # the smallest merit since that share changed
    turns_since: int = 0  # how many turns ago that merit was

    def with_rows(self, rows: copies.Rows) -> Waiting:
        """The record a turn later, with the rows that have arrived."""
        waited = {robot: 0 if robot in rows else turns + 1 for robot, turns in self.waited.items()}
        return replace(self, newest={**self.newest, **rows}, waited=waited)

    def after(self, merit: float) -> Waiting:
        """The record after a turn with this merit; on stagnation the robot relaxes less.

        Over-relaxed steps may cycle.
        """
        if merit <= _PROGRESS * self.least:
            return replace(self, least=merit, turns_since=0)
        if self.turns_since < _PATIENCE:
            return replace(self, turns_since=self.turns_since + 1)
        return replace(self, excess=0.5 * self.excess, least=math.inf, turns_since=0)


@record("ReceivedRows")
@dataclass(frozen=True, eq=False)
class ReceivedRows:
    """Rows of a neighbour's s that the robot shares, and the memory of their acceleration."""

    s: Array
    share: AndersonShare = field(default_factory=AndersonShare)


@record("CopiesState")
@dataclass(frozen=True, eq=False)
class CopiesState:
    """What orders leave with a robot; rows are those of `CopyLayout`."""

    # (rows, d): the poses at the start, then x of the last step (a) with all translations
    X: Array = field(default_factory=lambda: np.zeros((0, 0)))
    rho: Array = field(default_factory=lambda: np.zeros(0))  # (n_a,): penalties of the poses
    # (n_a, d + 1): diagonal of M of every pose, its translation first
    diagonal: Array = field(default_factory=lambda: np.zeros((0, 0)))
    # (n_a, d, d): multipliers, right for own poses
    Lambda: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))
    # (n_a, d^2): rho_i B_i of a stationary point
    pull: Array = field(default_factory=lambda: np.zeros((0, 0)))
    force: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (rows, d): -2 M_a X
    # (rows, d): the same, summed over robots
    total_force: Array = field(default_factory=lambda: np.zeros((0, 0)))
    settings: StepSettings = field(default_factory=StepSettings)
    block: RecursionBlock | None = None  # the robot's rows of the recursion
    origin: tuple[Array, Array] | None = None  # omega and s when the penalties were set
    # rows of the neighbours, which are extrapolated here as there
    received: Mapping[int, ReceivedRows] = field(default_factory=dict)
    ahead: tuple[Array, RecursionBlock] | None = None  # X and block after the next step (a)
    waiting: Waiting | None = None  # of an asynchronous run

    def robot(self, layout: copies.CopyLayout) -> ConsensusRobot:
        """The robot in this state."""
        robot = ConsensusRobot(layout, self)
        return robot if self.block is None else robot._prepared()


@dataclass(frozen=True, eq=False)
class ConsensusRobot:
    """A robot: its layout, the state that earlier orders left, and the back end of step (a)."""

    layout: copies.CopyLayout
    state: CopiesState
    step_a: RotationStep | None = None  # follows from layout and state

    # Set-up: poses and penalties.

    def begin(self, poses: Poses) -> tuple[ConsensusRobot, copies.Rows]:
        """Start at own poses, (n_a), and send them to the neighbours that hold copies."""
        X = poses.stacked()
        return self._with(X=X), self.layout.rows_of_own_poses(X)

    @order("consensus.begin_here")
    def begin_here(self, _: None) -> tuple[ConsensusRobot, copies.Rows]:
        """Start at omega with the robot's translations."""
        return self.begin(self.poses)

    @order("consensus.multiplier_ratios")
    def multiplier_ratios(self, rows: copies.Rows) -> tuple[ConsensusRobot, Array]:
        """Take the owners' poses; return ||Lambda_i||_2 / m_i of the robot's own."""
        layout = self.layout
        X = layout.with_rows_of_others(self.state.X.copy(), rows)
        Lambda = layout.multipliers(X)
        following = self._with(X=X, Lambda=Lambda, diagonal=layout.diagonal)
        norms = multiplier_norms(Lambda[layout.own_poses])
        return following, norms / following._scale[layout.own_poses]

    @order("consensus.penalize")
    def penalize(
        self, order: PenaltyOrder
    ) -> tuple[ConsensusRobot, Messages[copies.NeighbourMessage]]:
        """Set rho of own poses; tell their holders about them, and the forces on common poses."""
        layout = self.layout
        state = self.state
        n = layout.problem.num_poses
        d = layout.problem.d
        rho = order.rho(multiplier_norms(state.Lambda), self._scale)
        pull = np.zeros((n, d * d))
        if order.is_stationary:
            B = stationary_B(unstack_transposes(state.X[n:]), state.Lambda, np.ones(n))
            pull = stack_transposes(B).reshape(n, d * d)
        force = -2.0 * layout.problem.at_point(state.X).half_gradient
        no_force = np.zeros_like(force)
        force, sent = self._as_sent(force, no_force, order.settings.bytes_per_number)
        of_poses = np.concatenate([rho[:, None], state.diagonal, pull], axis=1)
        no_poses = np.zeros(0, dtype=np.int64)
        messages: Messages[copies.NeighbourMessage] = Messages()
        for robot, rows in sent.items():
            common = layout.sent.get(robot, no_poses)
            messages[robot] = copies.NeighbourMessage(of_poses[common], rows)
        return self._with(rho=rho, pull=pull, force=force, settings=order.settings), messages

    @order("consensus.stiffness")
    def stiffness(
        self, messages: Messages[copies.NeighbourMessage]
    ) -> tuple[ConsensusRobot, float]:
        """Take the neighbours' messages; return the stiffness of the robot's separators."""
        layout = self.layout
        n = layout.problem.num_poses
        d = layout.problem.d
        num_copies = layout.subgraph.copies
        rho = self.state.rho.copy()
        diagonal = self.state.diagonal.copy()
        pull = self.state.pull.copy()
        total_force = self.state.force.copy()
        for robot, theirs in layout.received.items():
            of_poses = messages[robot].of_own
            rho[theirs] = of_poses[:, 0]
            diagonal[theirs] = of_poses[:, 1 : d + 2]
            pull[theirs] = of_poses[:, d + 2 :]
        for robot, rows in layout.common.items():
            total_force[rows] += _updated_rows(messages[robot].force, np.zeros((len(rows), d)))
        separators = layout.separators
        half_scale = 0.5 * diagonal[separators, 0] / num_copies[separators]
        penalty = np.concatenate([np.zeros(n), np.repeat(rho / num_copies, d)])
        penalty[separators] = 2.0 * GROUND * half_scale
        components = connected_components(layout.subgraph.graph.adjacency, directed=False)[1]
        factor = layout.problem.analysis.factorize(layout.subproblem(penalty).matrix)
        stiffness = stiffness_of_separators(
            factor, (d + 1) * n, separators, half_scale, components[separators]
        )
        following = self._with(rho=rho, diagonal=diagonal, pull=pull, total_force=total_force)
        return following, stiffness

    @order("consensus.start")
    def start(self, separators: copies.SeparatorPenalty) -> tuple[ConsensusRobot, copies.InitReply]:
        """Set omega to the poses and B in balance, and prepare step (a)."""
        layout = self.layout
        state = self.state
        n = layout.problem.num_poses
        d = layout.problem.d
        held = layout.held
        own_poses = layout.own_poses
        floor = separators.rotation * self._scale
        rho = np.where(layout.subgraph.copies > 1, np.maximum(state.rho, floor), state.rho)
        if state.settings.rotations is Rotations.RELAXED:
            rho = np.where(layout.subgraph.poses == 0, np.maximum(rho, self._scale), rho)
        rho_of_rows = self._rho_of_rows(rho, separators.translation)
        # B makes every subproblem stationary: it balances the difference between the robot's force
        # and the mean force. Its mean over the copies is the multiplier of the constraint.
        mean_B_of_rotations = (state.pull / rho[:, None]).reshape(d * n, d)
        mean_B = np.concatenate([np.zeros((n, d)), mean_B_of_rotations])
        excess_force = state.force - state.total_force / layout.copies
        balanced_B = excess_force / np.where(held[:, 0], rho_of_rows, 1.0)[:, None]
        omega = np.where(held, state.X, 0.0)
        B = np.where(held, balanced_B + mean_B, 0.0)
        diagonal_of_M = np.concatenate([state.diagonal[:, 0], state.diagonal[:, 1:].ravel()])
        share_of_diagonal = diagonal_of_M / layout.copies[:, 0]
        block = block_at(omega, rho_of_rows, share_of_diagonal, state.settings, B)
        following = self._with(
            rho=rho,
            block=block,
            origin=(omega, block.s),
            received={},
            ahead=None,
        )
        rotations = float(rotation_squares(layout.full_problem)[own_poses].sum())
        stationarity = replace(following.stationarity, rotations=rotations)
        size = d * float(rho[own_poses].sum())
        reply = copies.InitReply(size, stationarity)
        return following._prepared(), reply

    # The recursion.

    @order("consensus.solve")
    def solve(self, _: None) -> tuple[ConsensusRobot, copies.SolveReply]:
        """Step (a); return rows of s after it, and sums for the acceleration."""
        before = self.block
        X, local = self._solved_after_local_passes()
        x = np.where(self.layout.held, X, 0.0)
        step = before.step_of_map(x, local, before.settings.alpha)
        # Neighbours have s, or the first time with these penalties omega.
        known = before.omega if before.anderson.image is None else before.s
        image, sent = self._as_sent(before.s + step, known, before.settings.bytes_per_number)
        shared = self.layout.shared
        step[shared] = image[shared] - before.s[shared]
        block, sums = before.after_map(x, step, image)
        return self._with(ahead=(X, block)), copies.SolveReply(sums, sent)

    def _as_sent(
        self, X: Array, known: Array, bytes_per_number: int
    ) -> tuple[Array, copies.RowMessages]:
        """X, (rows, d), as the neighbours will have it, and the messages to them.

        The messages have the change from `known`, which the neighbours have; without rounding, or
        where X is not finite, they have X itself.
        """
        shared = self.layout.shared
        change = None
        if bytes_per_number < WHOLE:
            change = RowChange.of(X[shared] - known[shared], bytes_per_number)
        if change is None:
            return X, Messages({**self._common_rows(X)})
        X = X.copy()
        X[shared] = change.added_to(known[shared])
        places = self.layout.common_among_shared
        return X, Messages({robot: change.some(rows) for robot, rows in places.items()})

    def _common_rows(self, X: Array) -> copies.Rows:
        """Rows of X for every neighbour, of the poses that both hold."""
        return Messages({robot: X[rows] for robot, rows in self.layout.common.items()})

    @order("consensus.step")
    def step(
        self, order: tuple[Agreement, copies.RowMessages]
    ) -> tuple[ConsensusRobot, copies.StepReply]:
        """One iteration: (b) and (c) with the neighbours' rows, and (a) of the next one."""
        agreement, messages = order
        ahead, rows = self._accelerated(agreement, messages)  # s = x_ahead + B, here and there
        omega = ahead._agreed_omega(rows)  # (b) projection, of the mean over the copies
        block, squares = ahead.block.agreed(omega)  # (c) Bregman update, B = s - omega
        robot = ahead._with(block=block)
        following, reply_of_solve = robot.solve(None)  # (a) R-step
        return following, copies.StepReply(squares, robot.stationarity, reply_of_solve)

    def _accelerated(
        self, agreement: Agreement, messages: copies.RowMessages
    ) -> tuple[ConsensusRobot, Mapping[int, Array]]:
        """Take the step (a) that was done ahead; extrapolate its s, and the neighbours' rows of s.

        A neighbour extrapolates its rows with the same coefficients, so that nobody waits for them
        a second time.
        """
        before = self.block
        assert self.state.ahead is not None
        X, block = self.state.ahead
        block = block.extrapolated(agreement)
        memory = before.settings.memory
        received = {}
        rows = {}
        for robot, message in messages.items():
            known = self.state.received.get(robot)
            if known is None:
                known = ReceivedRows(before.omega[self.layout.common[robot]])
            share = known.share.after(np.zeros((0, 0)), _updated_rows(message, known.s), memory)
            rows[robot], share = share.extrapolated(agreement.gamma)
            received[robot] = ReceivedRows(rows[robot], share)
        return self._with(X=X, block=block, received=received), rows

    @order("consensus.announce")
    def announce(self, _: None) -> tuple[ConsensusRobot, copies.Rows]:
        """Send the robot's rows to every neighbour, before the first turn."""
        waiting = Waiting({}, dict.fromkeys(self.layout.common, 0))
        return self._with(waiting=waiting)._sending(self.block)

    @order("consensus.turn")
    def turn(self, rows: copies.Rows) -> tuple[ConsensusRobot, copies.TurnAnswer]:
        """Make one turn, (b), (c) and (a), with the newest rows that have arrived.

        s <- T(s) with T the map of the synchronous recursion, and the neighbours' rows as old as
        they are: an asynchronous fixed-point iteration (Peng et al. 2016). The answer has rows for
        every neighbour.
        """
        before = self.block
        waiting = self.state.waiting
        assert waiting is not None
        waiting = waiting.with_rows(rows)
        has_all = len(waiting.newest) == len(self.layout.common)
        block = before
        if has_all:
            block = replace(before, omega=self._agreed_omega(waiting.newest))  # (b), (c)
        X, local = self._with(block=block)._solved_after_local_passes()  # (a)
        alpha = 1.0 + waiting.excess * (_OVER_RELAXATION - 1.0)
        change = block.step_of_map(np.where(self.layout.held, X, 0.0), local, alpha)
        weight = np.sqrt(block.rho)[:, None]
        primal = weight * change
        dual = weight * (block.omega - before.omega)
        sums = np.array([inner(primal, primal), inner(dual, dual)])
        block = replace(block, s=block.s + change)
        waiting = waiting.after(math.sqrt(sums[0]))
        robot, sent = self._with(X=X, waiting=waiting)._sending(block)
        age = max(waiting.waited.values(), default=0)
        return robot, copies.TurnAnswer(sent, sums, robot.stationarity, age)

    @order("consensus.travel")
    def travel(self, _: None) -> tuple[ConsensusRobot, Array]:
        """How far separator translations and their multipliers have gone."""
        assert self.state.origin is not None
        separators = self.layout.separators
        block = self.block
        first_omega, first_s = self.state.origin
        moved = (block.omega - first_omega)[separators]
        change_of_B = (block.B - first_s + first_omega)[separators]
        pulled = block.rho[separators, None] * change_of_B
        return self, travel(moved, pulled, block.diagonal[separators])

    @order("consensus.back_at_best")
    def back_at_best(self, _: None) -> tuple[ConsensusRobot, copies.Rows]:
        """Return to the s of the smallest merit, and send its rows to every neighbour."""
        return self._sending(replace(self.block, s=self.block.best))

    @order("consensus.rescale")
    def rescale(self, order: copies.RescaleCopies) -> tuple[ConsensusRobot, None]:
        """Multiply rho and keep rho B; agree first on what was sent, if all are at their best."""
        block = self.block
        if order.rows is not None:
            block = replace(block, omega=self._agreed_omega(order.rows))
        rho = order.factor * self.state.rho
        block = block.rescaled(self._rho_of_rows(rho, order.translation))
        following = self._with(rho=rho, block=block, received={}, ahead=None)
        return following._prepared(), None

    # Answers.

    @property
    def block(self) -> RecursionBlock:
        """The robot's rows of the recursion."""
        assert self.state.block is not None
        return self.state.block

    @property
    def omega(self) -> Array:
        """Rotations of the robot's poses, (n_a, d, d); a relaxation is projected to them."""
        R = unstack_transposes(self.block.omega[self.layout.problem.num_poses :])
        return project_to_rotations(R) if self.block.settings.rotations is Rotations.RELAXED else R

    @property
    def x(self) -> Array:
        """Solution of the last step (a), (n_a, d, d)."""
        return unstack_transposes(self.block.x[self.layout.problem.num_poses :])

    @property
    def B(self) -> Array:
        """Scaled multiplier of x = omega, (n_a, d, d)."""
        return unstack_transposes(self.block.B[self.layout.problem.num_poses :])

    @property
    def poses(self) -> Poses:
        """The robot's poses, (n_a): omega and the current translations."""
        X = np.where(self.layout.held, self.block.omega, self.state.X)
        return Poses(self.omega, X[: self.layout.problem.num_poses])

    @order("consensus.own_poses")
    def own_poses(self, _: None) -> tuple[ConsensusRobot, copies.OwnPoses]:
        """Poses that the robot owns, with their numbers in the whole graph."""
        positions = self.layout.own_poses
        poses = self.poses[positions]
        return self, copies.OwnPoses(self.layout.subgraph.poses[positions], poses.R, poses.t)

    @order("consensus.held_rows")
    def held_rows(self, _: None) -> tuple[ConsensusRobot, copies.Rows]:
        """Rows of the own poses, for every neighbour that holds copies of them."""
        return self, self.layout.rows_of_own_poses(self.poses.stacked())

    @order("consensus.stationarity_beside")
    def stationarity_beside(self, rows: copies.Rows) -> tuple[ConsensusRobot, copies.Stationarity]:
        """As `stationarity`, with the owners' rows in place of the robot's copies."""
        X = self.layout.with_rows_of_others(self.poses.stacked(), rows)
        n = self.layout.problem.num_poses
        return self, self._stationarity_at(Poses(unstack_transposes(X[n:]), X[:n]))

    @property
    def stationarity(self) -> copies.Stationarity:
        """The robot's part of F, and of the squared gradient on own poses beside its copies."""
        return self._stationarity_at(self.poses)

    # What the orders share.

    def _with(self, **changes: object) -> ConsensusRobot:
        """The robot with changed fields of its state, whose types mypy cannot check."""
        return replace(self, state=replace(self.state, **changes))  # type: ignore[arg-type]

    def _stationarity_at(self, poses: Poses) -> copies.Stationarity:
        problem = self.layout.full_problem
        cost = float(problem.edge_costs(poses)[self.layout.subgraph.is_counted].sum())
        gradient = float(gradient_squares(problem, poses)[self.layout.own_poses].sum())
        return copies.Stationarity(gradient, cost)

    def _sending(self, block: RecursionBlock) -> tuple[ConsensusRobot, copies.Rows]:
        return self._with(block=block), self._common_rows(block.s)

    @property
    def _scale(self) -> Array:
        """m_i, the mean diagonal of M over the rotation rows of pose i, (n_a,)."""
        return np.asarray(self.state.diagonal[:, 1:].mean(axis=1))

    def _rho_of_rows(self, rho: Array, translation: float) -> Array:
        """The robot's shares of the penalties of its rows, (rows,), with rho of all poses."""
        of_translations = translation * self.state.diagonal[:, 0]
        of_rotations = np.repeat(rho, self.layout.problem.d)
        penalties = np.concatenate([of_translations, of_rotations])
        return np.where(self.layout.held[:, 0], penalties / self.layout.copies[:, 0], 0.0)

    def _prepared(self) -> ConsensusRobot:
        subproblem = self.layout.subproblem(self.block.rho)
        return replace(self, step_a=prepare(subproblem, self.layout.r_step))

    def _solved_after_local_passes(self) -> tuple[Array, RecursionBlock]:
        """X of step (a), and the block that the local passes before it have led to."""
        assert self.step_a is not None
        local = self.block.after_local_passes(self.step_a.solve, self.layout.private)
        return self.step_a.solve(local.shift), local

    def _agreed_omega(self, received: Mapping[int, Array]) -> Array:
        """Step (b): omega and the mean translations, from s and the neighbours' rows.

        The rows are summed in the order of the robots, so that all get the same bits.
        """
        block = self.block
        n = self.layout.problem.num_poses
        parts = {**received, self.layout.subgraph.robot: block.s}
        total = np.zeros_like(block.s)
        for robot in sorted(parts):
            total[self.layout.common.get(robot, slice(None))] += parts[robot]
        mean = total / self.layout.copies
        omega = np.where(self.layout.held, mean, 0.0)
        if block.settings.rotations is Rotations.PROJECTED:
            omega[n:] = nearest_rotations(mean[n:])
        else:
            is_relaxed = block.settings.rotations is Rotations.RELAXED
            fixed = np.flatnonzero(self.layout.subgraph.poses == 0) if is_relaxed else np.arange(n)
            rotation_rows = self.layout.rows(fixed)[len(fixed) :]
            omega[rotation_rows] = block.omega[rotation_rows]
        return omega


def _updated_rows(message: Array | RowChange, known: Array) -> Array:
    """Rows of a neighbour, from its message and the rows that the message may change."""
    return message.added_to(known) if isinstance(message, RowChange) else message
