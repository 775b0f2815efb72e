"""One robot of the CONSENSUS coupling: its own poses, copies of its neighbours' separators, and its part of SOC.

An edge between two robots counts half with each. What robots send each other, by the number of the receiver, are rows
of poses that both hold, and what the owner of a pose knows of it. Every method is an order: of a robot, which it leaves
alone, and a request it makes the robot after it and the answer. `solvers.soc.consensus` tells in which order.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse.csgraph import connected_components

from pgo_models.certificates.dual_variables import multiplier_norms, multipliers
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations, unstack_transposes
from pgo_models.problem.matrices import inner
from solvers.soc import copies
from solvers.soc.anderson import AndersonShare, AndersonSums, over_relax
from solvers.soc.penalty import PenaltyOrder
from solvers.soc.r_step import RotationStep, prepare
from solvers.soc.recursion_block import Agreement, RecursionBlock, Rotations, block_at, nearest_rotations, stationary_B
from solvers.soc.separator_stiffness import GROUND, stiffness_of_separators, travel


@dataclass(frozen=True, eq=False)
class ConsensusRobot:
    """A robot: its layout, what earlier orders left, and the back end of step (a), which follows from both."""

    layout: copies.CopyLayout
    state: copies.CopiesState
    step_a: RotationStep | None = None

    # Set-up: poses and penalties.

    def begin(self, poses: Poses) -> tuple[ConsensusRobot, copies.Rows]:
        """Start at own poses, (n_a): rows of the others' copies come from their owners."""
        X = poses.stacked()
        return self._with(X=X), {robot: X[self.layout.rows(mine)] for robot, mine in self.layout.told.items()}

    def begin_here(self, _: None) -> tuple[ConsensusRobot, copies.Rows]:
        """Start at omega, with the translations agreed on, and of step (a) in the interior."""
        return self.begin(self.poses)

    def multiplier_norms(self, rows: copies.Rows) -> tuple[ConsensusRobot, copies.Norms]:
        """Take the owners' poses: ||Lambda_i||_2 and m_i of the robot's own."""
        layout, X = self.layout, self.state.X.copy()
        for robot, theirs in layout.heard.items():
            X[layout.rows(theirs)] = rows[robot]
        n, d, whole = layout.problem.num_poses, layout.problem.d, layout.whole
        Lambda = multipliers(whole, Poses(unstack_transposes(X[n:]), X[:n]))
        every = whole.M.data[whole.diagonal_positions]
        diagonal = np.concatenate([every[:n, None], every[n:].reshape(n, d)], axis=1)
        following = self._with(X=X, Lambda=Lambda, diagonal=diagonal)
        return following, copies.Norms(multiplier_norms(Lambda[layout.own]), following._scale[layout.own])

    def penalize(self, order: PenaltyOrder) -> tuple[ConsensusRobot, Mapping[int, copies.Known]]:
        """Set rho of own poses; what their holders must know of them, and the forces on the common ones."""
        layout, state = self.layout, self.state
        n, d = layout.problem.num_poses, layout.problem.d
        rho = order.rho(multiplier_norms(state.Lambda), self._scale)
        pull = np.zeros((n, d * d))
        if order.is_stationary:
            pull = stationary_B(unstack_transposes(state.X[n:]), state.Lambda, np.ones(n)).reshape(n, d * d)
        force = -2.0 * layout.problem.apply_M(state.X)
        known = np.concatenate([rho[:, None], state.diagonal, pull], axis=1)
        none = np.zeros(0, dtype=np.int64)
        own = {robot: known[layout.told.get(robot, none)] for robot in layout.common}
        told = {robot: copies.Known(own[robot], force[rows]) for robot, rows in layout.common.items()}
        return self._with(rho=rho, pull=pull, force=force, settings=order.settings), told

    def stiffness(self, known: Mapping[int, copies.Known]) -> tuple[ConsensusRobot, float]:
        """Take what the owners know, and the forces of others; the stiffness of the robot's separators."""
        layout, state = self.layout, self.state
        n, d, times = layout.problem.num_poses, layout.problem.d, layout.subgraph.copies
        rho, diagonal, pull, total = (v.copy() for v in (state.rho, state.diagonal, state.pull, state.force))
        for robot, theirs in layout.heard.items():
            of_own = known[robot].of_own
            rho[theirs], diagonal[theirs], pull[theirs] = of_own[:, 0], of_own[:, 1 : d + 2], of_own[:, d + 2 :]
        for robot, rows in layout.common.items():
            total[rows] += known[robot].force
        separators = layout.separators
        half_scale = 0.5 * diagonal[separators, 0] / times[separators]
        penalty = np.concatenate([np.zeros(n), np.repeat(rho / times, d)])
        penalty[separators] = 2.0 * GROUND * half_scale
        components = connected_components(layout.subgraph.graph.adjacency, directed=False)[1]
        factor = layout.problem.analysis.factorize(layout.subproblem(penalty).K)
        stiffness = stiffness_of_separators(factor, (d + 1) * n, separators, half_scale, components[separators])
        return self._with(rho=rho, diagonal=diagonal, pull=pull, total_force=total), stiffness

    def start(self, separators: copies.SeparatorPenalty) -> tuple[ConsensusRobot, copies.Started]:
        """Factor, with omega at the poses and B in balance; ||omega||_rho^2 and rho_i / m_i of the own poses."""
        layout, state = self.layout, self.state
        n, d, held, own = layout.problem.num_poses, layout.problem.d, layout.held, layout.own
        floor = separators.rotation * self._scale
        rho = np.where(layout.subgraph.copies > 1, np.maximum(state.rho, floor), state.rho)
        if state.settings.rotations is Rotations.RELAXED:
            rho = np.where(layout.subgraph.poses == 0, np.maximum(rho, self._scale), rho)
        penalty = self._penalty(rho, separators.translation)
        # B makes every subproblem stationary; its mean over the copies is the multiplier of the constraint.
        mean = np.concatenate([np.zeros((n, d)), (state.pull / rho[:, None]).reshape(d * n, d)])
        balanced = (state.force - state.total_force / layout.copies) / np.where(held[:, 0], penalty, 1.0)[:, None]
        z, B = np.where(held, state.X, 0.0), np.where(held, balanced + mean, 0.0)
        diagonal = np.concatenate([state.diagonal[:, 0], state.diagonal[:, 1:].ravel()]) / layout.copies[:, 0]
        block = block_at(z, penalty, diagonal, state.settings, B)
        started = copies.Started(d * float(rho[own].sum()), (rho / self._scale)[own])
        following = self._with(rho=rho, block=block, origin=(z, block.s), sums=AndersonSums(), heard={}, ahead=None)
        return following._prepared(), started

    # The recursion.

    def solve(self, _: None) -> tuple[ConsensusRobot, copies.Solved]:
        """Step (a): rows of s after it, and sums; of those the merit alone where robots accelerate alone."""
        X, z, _B, drift = self._solved_after_local_passes()
        block, sums = self.block.after_solve(np.where(self.layout.held, X, 0.0), z, drift)
        alone, known, s = block.settings.alone, self.state.sums, block.anderson.image
        if alone is not None:
            gamma: Array | None = None
            if np.isfinite(sums).all():
                gamma, known = known.coefficients(alone, sums)
            block, sums = block.extrapolated(Agreement(gamma, is_best=False)), sums[:1]
            s = block.s
        assert s is not None
        rows = {robot: s[rows] for robot, rows in self.layout.common.items()}
        return self._with(ahead=(X, block, known)), copies.Solved(sums, rows)

    def step(self, order: tuple[Agreement, copies.Rows]) -> tuple[ConsensusRobot, copies.Stepped]:
        """Extrapolate what was solved, own rows and the neighbours'; (b) and (c) with them; and (a) of the next step.

        A neighbour extrapolates its rows with the same coefficients: nobody waits for them a second time.
        """
        (agreement, received), before = order, self.block
        assert self.state.ahead is not None
        X, block, sums = self.state.ahead
        memory, heard, rows = before.settings.memory, {}, {}
        if before.settings.alone is not None:
            block, memory = replace(block, best=before.s if agreement.is_best else before.best), 0
        else:
            block = block.extrapolated(agreement)
        for robot, image in received.items():
            known = self.state.heard.get(robot, AndersonShare()).after(np.zeros((0, 0)), image, memory)
            rows[robot], heard[robot] = known.extrapolated(agreement.gamma)
        moved = self._with(X=X, block=block, sums=sums, heard=heard)
        block, squares = block.agreed(moved._mean(rows))
        moved = moved._with(block=block)
        following, solved = moved.solve(None)
        return following, copies.Stepped(squares, moved.cost(None)[1], solved)

    def announce(self, settings: copies.TurnSettings) -> tuple[ConsensusRobot, copies.Rows]:
        """Return the robot's rows for every neighbour, before the first turn."""
        waiting = copies.Waiting(settings, {}, dict.fromkeys(self.layout.common, 0))
        return self._with(waiting=waiting)._sending(self.block)

    def turn(self, rows: copies.Rows) -> tuple[ConsensusRobot, copies.TurnAnswer]:
        """One turn with the newest rows that have arrived: (b), (c) and (a), damped; rows for every neighbour.

        s <- s + damping (T(s) - s) with T the map of the synchronous recursion, the neighbours' rows being old ones: an
        asynchronous fixed-point iteration (Peng et al. 2016). B = s - z is never summed up, so nothing drifts.
        """
        before, waiting = self.block, self.state.waiting
        assert waiting is not None
        waited = {robot: 0 if robot in rows else turns + 1 for robot, turns in waiting.waited.items()}
        waiting = replace(waiting, newest={**waiting.newest, **rows}, waited=waited)
        has_all = len(waiting.newest) == len(self.layout.common)
        block = replace(before, z=self._mean(waiting.newest)) if has_all else before
        X, z, B, _ = self._with(block=block)._solved_after_local_passes()
        alpha = 1.0 + waiting.excess * (waiting.settings.alpha - 1.0)
        moved = over_relax(np.where(self.layout.held, X, 0.0), z, alpha) + B - block.s
        weight = np.sqrt(block.penalty)[:, None]
        primal, dual = weight * moved, weight * (block.z - before.z)
        sums = np.array([inner(primal, primal), inner(dual, dual)])
        block = replace(block, s=block.s + waiting.settings.damping * moved)
        robot, sent = self._with(X=X, waiting=waiting.after(math.sqrt(sums[0])))._sending(block)
        return robot, copies.TurnAnswer(sent, sums, max(waited.values(), default=0))

    def travel(self, _: None) -> tuple[ConsensusRobot, Array]:
        """How far separator translations, and their multipliers, went: see `solvers.soc.separator_stiffness`."""
        assert self.state.origin is not None
        at, block, (z, s) = self.layout.separators, self.block, self.state.origin
        pulled = block.penalty[at, None] * (block.B - s + z)[at]
        return self, travel((block.z - z)[at], pulled, block.diagonal[at])

    def back_at_best(self, _: None) -> tuple[ConsensusRobot, copies.Rows]:
        """Return to the s of the smallest merit; its rows for every neighbour."""
        return self._sending(replace(self.block, s=self.block.best))

    def rescale(self, order: copies.RescaleCopies) -> tuple[ConsensusRobot, None]:
        """Agree on what was sent, if all went back to their best, multiply rho and keep rho B."""
        block = self.block if order.rows is None else replace(self.block, z=self._mean(order.rows))
        rho = order.factor * self.state.rho
        block = block.rescaled(self._penalty(rho, order.translation))
        return self._with(rho=rho, block=block, sums=AndersonSums(), heard={}, ahead=None)._prepared(), None

    # Answers.

    @property
    def block(self) -> RecursionBlock:
        """The robot's rows of the recursion."""
        assert self.state.block is not None
        return self.state.block

    @property
    def omega(self) -> Array:
        """Rotations of the robot's poses, (n_a, d, d); those nearest to a relaxation."""
        R = unstack_transposes(self.block.z[self.layout.problem.num_poses :])
        return project_to_rotations(R) if self.block.settings.rotations is Rotations.RELAXED else R

    @property
    def poses(self) -> Poses:
        """Omega and the translations at hand, (n_a)."""
        X = np.where(self.layout.held, self.block.z, self.state.X)
        return Poses(self.omega, X[: self.layout.problem.num_poses])

    def own_poses(self, _: None) -> tuple[ConsensusRobot, copies.OwnPoses]:
        """Omega and the translations at hand of the own poses, for whoever may see them."""
        mine = self.poses[self.layout.own]
        return self, copies.OwnPoses(self.layout.subgraph.poses[self.layout.own], mine.R, mine.t)

    def cost(self, _: None) -> tuple[ConsensusRobot, float]:
        """Part of F at omega, the translations agreed on, and inside those of step (a)."""
        return self, float(self.layout.whole.edge_costs(self.poses)[self.layout.subgraph.is_counted].sum())

    # What the orders share.

    def restored(self, state: copies.CopiesState) -> ConsensusRobot:
        """Return the robot with all that orders left with it elsewhere."""
        robot = replace(self, state=state)
        return robot if state.block is None else robot._prepared()

    def _with(self, **changes: object) -> ConsensusRobot:
        return replace(self, state=replace(self.state, **changes))  # type: ignore[arg-type] # checked by the class

    def _sending(self, block: RecursionBlock) -> tuple[ConsensusRobot, copies.Rows]:
        return self._with(block=block), {robot: block.s[rows] for robot, rows in self.layout.common.items()}

    @property
    def _scale(self) -> Array:
        return np.asarray(self.state.diagonal[:, 1:].mean(axis=1))

    def _penalty(self, rho: Array, translation: float) -> Array:
        """The robot's shares of the penalties of its rows, (rows,)."""
        whole = np.concatenate([translation * self.state.diagonal[:, 0], np.repeat(rho, self.layout.problem.d)])
        return np.where(self.layout.held[:, 0], whole / self.layout.copies[:, 0], 0.0)

    def _prepared(self) -> ConsensusRobot:
        return replace(self, step_a=prepare(self.layout.subproblem(self.block.penalty), self.layout.r_step))

    def _solved_after_local_passes(self) -> tuple[Array, Array, Array, Array | float]:
        """X of step (a), and z, B and what they moved by, after (a) to (c) on the poses that no other robot holds."""
        assert self.step_a is not None
        block, private = self.block, self.layout.private
        z, B, drift = block.z.copy(), block.B, np.zeros((1, 1))
        passes = block.settings.local_passes - 1
        if passes and private.any() and block.is_finite:
            for _ in range(passes):
                s = (self.step_a.solve(z - B) + B)[private]  # (a)
                z[private] = nearest_rotations(s)  # (b)
                B[private] = s - z[private]  # (c)
            drift = z + B - block.s
        return self.step_a.solve(z - B), z, B, drift

    def _mean(self, received: copies.Rows) -> Array:
        """Rotations omega and the mean translations, from s and the neighbours' rows in the order of robots."""
        block, n = self.block, self.layout.problem.num_poses
        parts = {**received, self.layout.subgraph.robot: block.s}
        total = np.zeros_like(block.s)
        for robot in sorted(parts):
            total[self.layout.common.get(robot, slice(None))] += parts[robot]
        mean = total / self.layout.copies
        z = np.where(self.layout.held, mean, 0.0)
        if block.settings.rotations is Rotations.PROJECTED:
            z[n:] = nearest_rotations(mean[n:])
        else:
            is_relaxed = block.settings.rotations is Rotations.RELAXED
            held = np.flatnonzero(self.layout.subgraph.poses == 0) if is_relaxed else np.arange(n)
            rows = self.layout.rows(held)[len(held) :]
            z[rows] = block.z[rows]
        return z
