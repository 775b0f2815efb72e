"""One robot of the CONSENSUS coupling: its own poses, copies of its neighbours' separators, and its part of SOC.

An edge between two robots counts half with each. What robots send each other are rows of poses that both hold, and what
the owner of a pose knows of it; `solvers.soc.soc` is the recursion, with all robots in one place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components

from pgo_models.certificates.dual_variables import multipliers
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations, stack_transposes, unstack_transposes
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.cholesky import CholeskyBackend, CholeskyFactor
from pgo_models.problem.matrices import inner
from solvers.distributed.robots.elimination import columns_of
from solvers.distributed.robots.subgraph import PartProblem, Subgraph
from solvers.network.messages import Message
from solvers.soc.anderson import Anderson, over_relax
from solvers.soc.rotation_block import stationary_B
from solvers.soc.separator_stiffness import GROUND, separator_stiffness, travel
from solvers.soc.shared_anderson import AndersonShare, AndersonSums

# What follows from the subgraph, and the factor: all other attributes are remembered.
_FIXED = {"subgraph", "d", "problem", "is_own", "own", "neighbours", "held", "copies", "_factor"}
_FIXED |= {"_common", "_mine", "_theirs", "_common_rows"}
_NOTHING: Message = {}  # what a robot without neighbours is sent

_PROGRESS, _PATIENCE = 0.9, 20  # a merit that is smaller, and how many turns of an asynchronous run it may take


class ConsensusRobot:
    """A robot, what it holds, and its rows of SOC's iterates.

    Rows are those of X for the robot's poses, (d + 1) n_a of them: translations, then rotations. Translations of poses
    that no other robot holds have no penalty and no part in the iterates; they are zero there.
    """

    def __init__(self, subgraph: Subgraph, backend: CholeskyBackend | None) -> None:
        graph, d = subgraph.graph, subgraph.graph.d
        self.subgraph, self.d = subgraph, d
        halved = np.where(subgraph.is_own[graph.i] & subgraph.is_own[graph.j], 1.0, 0.5)
        self.problem = PartProblem(_weighted(graph, halved), backend)
        self.is_own = subgraph.is_own
        self.own = np.flatnonzero(self.is_own)
        n = graph.num_poses
        self.neighbours = tuple(robot for robot, _ in subgraph.common)
        self._common = tuple(poses for _, poses in subgraph.common)
        self._mine = tuple(poses[subgraph.owner[poses] == subgraph.robot] for _, poses in subgraph.common)
        self._theirs = tuple(poses[subgraph.owner[poses] == robot] for robot, poses in subgraph.common)
        self._common_rows = tuple(columns_of(poses, n, (1, d)) for poses in self._common)
        is_shared = subgraph.copies > 1
        self.held = np.concatenate([is_shared, np.ones(d * n, dtype=bool)])[:, None]
        self.copies = np.concatenate([subgraph.copies, np.repeat(subgraph.copies, d)])[:, None]
        self.X = np.zeros(((d + 1) * n, d))
        self.rho, self.diagonal, self.pull = np.ones(n), np.ones((n, d + 1)), np.zeros((n, d * d))
        self.penalty = np.zeros((d + 1) * n)
        self.z = self.s = self.x = self.best = self.X
        self._origin = self.z, self.s
        self.anderson, self.sums = AndersonShare(), AndersonSums()
        self._gamma: Array | None = None
        self._Lambda, self._force = np.zeros((n, d, d)), self.X
        self._factor: CholeskyFactor | None = None
        self._newest: dict[int, Array] = {}
        self._excess, self._least, self._turns_since = 1.0, math.inf, 0
        self._waited: dict[int, int] = {}

    # Set-up: poses and penalties.

    def begin(self, poses: Poses) -> Message:
        """Start at own poses, (n_a): rows of the others' copies come from their owners."""
        self.X = poses.stacked()
        return self._to_holders(lambda mine: self.X[columns_of(mine, len(self.is_own), (1, self.d))])

    def begin_here(self) -> Message:
        """Start at omega, with the translations agreed on, and of step (a) in the interior."""
        return self.begin(self._poses)

    def multiplier_norms(self, message: Message = _NOTHING) -> Message:
        """Take the owners' poses: ||Lambda_i||_2 and m_i of the robot's own."""
        self._from_owners(message, lambda theirs, rows: self._set_rows(self.X, theirs, rows))
        n, d = len(self.is_own), self.d
        whole = PartProblem(self.subgraph.graph, self.problem.backend)  # own poses have all their edges here
        R = unstack_transposes(self.X[n:])
        self._Lambda = multipliers(whole, Poses(R, self.X[:n]))
        diagonal = whole.M.data[whole.diagonal_positions]
        self.diagonal = np.concatenate([diagonal[:n, None], diagonal[n:].reshape(n, d)], axis=1)
        return {"norms": _norms(self._Lambda[self.own]), "scale": self._scale[self.own]}

    def penalize(self, message: Message) -> Message:
        """Set rho of own poses; what their holders must know of them, and the forces on the common ones."""
        a, b, c = message["rule"]
        self.rho = np.maximum(np.maximum(a * _norms(self._Lambda), b * self._scale), c)
        n, d = len(self.is_own), self.d
        self.pull = np.zeros((n, d * d))
        if message["is_stationary"][0]:
            R = unstack_transposes(self.X[n:])
            self.pull = stationary_B(R, self._Lambda, np.ones(n)).reshape(n, d * d)
        self._force = -2.0 * self.problem.apply_M(self.X)
        known = self._to_holders(
            lambda mine: np.concatenate([self.rho[mine, None], self.diagonal[mine], self.pull[mine]], axis=1)
        )
        forces = {
            f"force>{robot}": self._force[rows] for robot, rows in zip(self.neighbours, self._common_rows, strict=True)
        }
        return {**known, **forces}

    def stiffness(self, message: Message = _NOTHING) -> Message:
        """Take what the owners know, and the forces of others; the stiffness of the robot's separators."""
        n, d = len(self.is_own), self.d

        def take(theirs: IntArray, known: Array) -> None:
            self.rho[theirs], self.diagonal[theirs] = known[:, 0], known[:, 1 : d + 2]
            self.pull[theirs] = known[:, d + 2 :]

        self._from_owners(message, take)
        self._total_force = self._force.copy()
        for robot, rows in zip(self.neighbours, self._common_rows, strict=True):
            self._total_force[rows] += message[f"force<{robot}"]
        separators = np.flatnonzero(self.subgraph.copies > 1)
        half_scale = 0.5 * self.diagonal[separators, 0] / self.subgraph.copies[separators]
        penalty = np.zeros((d + 1) * n)
        penalty[n:] = np.repeat(self.rho / self.subgraph.copies, d)
        penalty[separators] = 2.0 * GROUND * half_scale
        components = connected_components(self.subgraph.graph.adjacency, directed=False)[1]
        factor = self._factored(penalty)
        stiffness = separator_stiffness(factor, (d + 1) * n, separators, half_scale, components[separators])
        return {"stiffness": np.array([stiffness])}

    def start(self, message: Message) -> Message:
        """Factor, with omega at the poses and B in balance; ||omega||_rho^2 and rho_i / m_i of the own poses."""
        n, d = len(self.is_own), self.d
        floor = message["separator_penalty"][0] * self._scale
        self.rho = np.where(self.subgraph.copies > 1, np.maximum(self.rho, floor), self.rho)
        self._factorize(float(message["translation_penalty"][0]))
        # B makes every subproblem stationary; its mean over the copies is the multiplier of the constraint.
        rotations = (self.pull / self.rho[:, None]).reshape(d * n, d)
        mean = np.concatenate([np.zeros((n, d)), rotations])
        penalty = np.where(self.held[:, 0], self.penalty, 1.0)[:, None]
        balanced = (self._force - self._total_force / self.copies) / penalty
        self.z = self.x = np.where(self.held, self.X, 0.0)
        self.s = self.best = self.z + np.where(self.held, balanced + mean, 0.0)
        self.anderson, self.sums = AndersonShare(), AndersonSums()
        self._origin = self.z, self.s
        return {"size": np.array([d * self.rho[self.own].sum()]), "ratio": (self.rho / self._scale)[self.own]}

    # The recursion.

    def solve(self, message: Message) -> Message:
        """Step (a); this robot's sums for the acceleration, or the merit alone where it accelerates alone."""
        image = self._moved(int(message["passes"][0]), message["alpha"][0])
        residual = np.sqrt(self.penalty)[:, None] * (image - self.s)
        sums, self.anderson = self.anderson.observe(residual, image, int(message["memory"][0]))
        self._gamma = None
        if "alone" not in message:
            return {"sums": sums}
        if np.isfinite(sums).all():
            regularization, restart_ratio = message["alone"]
            settings = Anderson(int(message["memory"][0]), float(regularization), float(restart_ratio))
            self._gamma, self.sums = self.sums.coefficients(settings, sums)
            if self._gamma is None:
                self._gamma, self.anderson = np.zeros(0), self.anderson.restarted()
        return {"sums": sums[:1]}

    def _moved(self, passes: int, alpha: float) -> Array:
        """X + B after `passes` - 1 times (a) to (c) on the poses that no other robot holds, and (a) on all."""
        z, B = self.z.copy(), self.s - self.z
        inside = self.held[:, 0] & (self.copies[:, 0] == 1)
        is_split = bool(self.neighbours) and inside.any() and np.isfinite(self.s).all()
        for _ in range(passes - 1 if is_split else 0):
            s = (self._solved(z - B) + B)[inside]  # (a)
            z[inside] = stack_transposes(project_to_rotations(unstack_transposes(s)))  # (b)
            B[inside] = s - z[inside]  # (c)
        self.X = self._solved(z - B)
        self.x = np.where(self.held, self.X, 0.0)
        return over_relax(self.x, z, alpha) + B

    def extrapolate(self, message: Message) -> Message:
        """Extrapolate s; its rows for every neighbour."""
        if message["is_best"][0]:
            self.best = self.s
        if message["restart"][0]:
            self.anderson = self.anderson.restarted()
        self.s = self.anderson.combine(message["gamma"] if self._gamma is None else self._gamma)
        return self._to_neighbours(self.s)

    def agree(self, message: Message = _NOTHING) -> Message:
        """Steps (b) and (c) with the neighbours' rows: sums of the residuals."""
        before = self.z
        self.z = self._agreed(message)
        weight = np.sqrt(self.penalty)
        diagonal = np.concatenate([self.diagonal[:, 0], self.diagonal[:, 1:].ravel()]) / self.copies[:, 0]
        primal = weight[:, None] * (self.x - self.z)
        dual = (weight * np.maximum(1.0, self.penalty / diagonal))[:, None] * (self.z - before)
        return {"sums": np.array([inner(primal, primal), inner(dual, dual)])}

    def turn(self, message: Message) -> Message:
        """One turn with the newest rows that have arrived: (b), (c) and (a), damped; rows for every neighbour.

        s <- s + damping (T(s) - s) with T the map of the synchronous recursion, the neighbours' rows being old ones: an
        asynchronous fixed-point iteration (Peng et al. 2016). B = s - z is never summed up, so nothing drifts.
        """
        for robot in self.neighbours:
            if f"rows<{robot}" in message:
                self._newest[robot], self._waited[robot] = message[f"rows<{robot}"], 0
            else:
                self._waited[robot] += 1
        before = self.z
        if len(self._newest) == len(self.neighbours):
            self.z = self._agreed({f"rows<{robot}": rows for robot, rows in self._newest.items()})
        moved = self._moved(int(message["passes"][0]), 1.0 + self._excess * (message["alpha"][0] - 1.0)) - self.s
        weight = np.sqrt(self.penalty)[:, None]
        primal, dual = weight * moved, weight * (self.z - before)
        self.s = self.s + message["damping"][0] * moved
        sums = np.array([inner(primal, primal), inner(dual, dual)])
        self._watch_over(math.sqrt(sums[0]))
        waited = np.array([max(self._waited.values(), default=0)])
        return {**self._to_neighbours(self.s), "sums": sums, "waited": waited}

    def _watch_over(self, merit: float) -> None:
        """Relax less on stagnation (no new best residual): over-relaxed steps may cycle."""
        if merit <= _PROGRESS * self._least:
            self._least, self._turns_since = merit, 0
        elif self._turns_since < _PATIENCE:
            self._turns_since += 1
        else:
            self._excess, self._least, self._turns_since = 0.5 * self._excess, math.inf, 0

    def announce(self) -> Message:
        """Return the robot's rows for every neighbour, before the first turn."""
        self._newest, self._waited = {}, dict.fromkeys(self.neighbours, 0)
        self._excess, self._least, self._turns_since = 1.0, math.inf, 0
        return self._to_neighbours(self.s)

    def travel(self) -> Message:
        """How far separator translations, and their multipliers, went: see `solvers.soc.separator_stiffness`."""
        at, (z, s) = np.flatnonzero(self.subgraph.copies > 1), self._origin
        pulled = self.penalty[at, None] * (self.s - self.z - s + z)[at]
        return {"travel": travel((self.z - z)[at], pulled, self.diagonal[at, 0] / self.subgraph.copies[at])}

    def back_at_best(self) -> Message:
        """Return to the s of the smallest merit; its rows for every neighbour."""
        self.s = self.best
        return self._to_neighbours(self.s)

    def rescale(self, message: Message) -> Message:
        """Agree on what was sent, if all went back to their best, multiply rho and keep rho B."""
        if message["is_back"][0]:  # one robot alone is sent no rows
            self.z = self._agreed(message)
        factor = float(message["factor"][0])
        self.rho = factor * self.rho
        held = np.where(self.held[:, 0], self.penalty, 1.0)
        self._factorize(float(message["translation_penalty"][0]))
        after = np.where(self.held[:, 0], self.penalty, 1.0)
        self.s = self.z + (held / after)[:, None] * (self.s - self.z)
        self.anderson, self.sums = AndersonShare(), AndersonSums()
        return {}

    # Answers.

    @property
    def omega(self) -> Array:
        """Rotations of the robot's poses, (n_a, d, d)."""
        return unstack_transposes(self.z[len(self.is_own) :])

    @property
    def _poses(self) -> Poses:
        return Poses(self.omega, np.where(self.held, self.z, self.X)[: len(self.is_own)])

    def own_poses(self) -> Message:
        """Omega and the translations at hand of the own poses, for whoever may see them."""
        mine = self._poses[self.own]
        return {"poses": self.subgraph.poses[self.own], "R": mine.R, "t": mine.t}

    def cost(self) -> Message:
        """Part of F at omega, the translations agreed on, and inside those of step (a)."""
        n = len(self.is_own)
        counted = self.subgraph.is_counted
        if not counted.any():
            return {"objective": np.zeros(1)}
        X = np.where(self.held, self.z, self.X)
        graph = self.subgraph.graph
        i, j, R, t = graph.i[counted], graph.j[counted], self.omega, X[:n]
        rotation = R[j] - R[i] @ graph.R_ij[counted]
        translation = t[j] - t[i] - np.einsum("eab,eb->ea", R[i], graph.t_ij[counted])
        squares = graph.kappa[counted] @ np.einsum("eab,eab->e", rotation, rotation)
        squares += graph.tau[counted] @ np.einsum("ea,ea->e", translation, translation)
        return {"objective": np.array([squares])}

    # What is remembered.

    def remembered(self) -> dict[str, object]:
        """All that earlier orders left here, except the factor; see `solvers.network.serialization`."""
        kept = {name: value for name, value in vars(self).items() if name not in _FIXED}
        return {"kept": kept, "has_factor": self._factor is not None}

    def remember(self, remembered: Mapping[str, Any]) -> None:
        """Go on from what was remembered; the factor is found again."""
        for name, value in remembered["kept"].items():
            setattr(self, name, value)
        self._factor = self._factored(self.penalty) if remembered["has_factor"] else None

    # What the orders share.

    @property
    def _scale(self) -> Array:
        return np.asarray(self.diagonal[:, 1:].mean(axis=1))

    def _factorize(self, translation_penalty: float) -> None:
        whole = np.concatenate([translation_penalty * self.diagonal[:, 0], np.repeat(self.rho, self.d)])
        self.penalty = np.where(self.held[:, 0], whole / self.copies[:, 0], 0.0)
        self._factor = self._factored(self.penalty)

    def _factored(self, penalty: Array) -> CholeskyFactor:
        """Factor of M_a + D/2."""
        problem = self.problem
        data = problem.M.data.copy()
        data[problem.diagonal_positions] += 0.5 * penalty
        if not (self.subgraph.copies > 1).any():
            data[problem.diagonal_positions[0]] *= 2.0  # one robot alone: a common shift costs nothing
        return problem.analysis.factorize(problem.with_pattern_of_M(data), overwrite=self._factor)

    def _solved(self, shift: Array) -> Array:
        assert self._factor is not None
        return self._factor.solve((0.5 * self.penalty)[:, None] * shift)

    def _agreed(self, message: Message) -> Array:
        """Rotations omega and the mean translations, from s and the neighbours' rows in the order of robots."""
        n = len(self.is_own)
        total, is_added = np.zeros_like(self.s), False
        for robot, rows in zip(self.neighbours, self._common_rows, strict=True):
            if robot > self.subgraph.robot and not is_added:
                total, is_added = total + self.s, True
            total[rows] += message[f"rows<{robot}"]
        mean = (total if is_added else total + self.s) / self.copies
        z = np.where(self.held, mean, 0.0)
        z[n:] = stack_transposes(project_to_rotations(unstack_transposes(mean[n:])))
        return z

    def _to_neighbours(self, rows: Array) -> Message:
        return {f"rows>{robot}": rows[common] for robot, common in zip(self.neighbours, self._common_rows, strict=True)}

    def _to_holders(self, known: Callable[[IntArray], Array]) -> Message:
        """What the owner of poses tells the robots that hold copies of them."""
        return {
            f"known>{robot}": known(mine) for robot, mine in zip(self.neighbours, self._mine, strict=True) if len(mine)
        }

    def _from_owners(self, message: Message, take: Callable[[IntArray, Array], None]) -> None:
        for robot, theirs in zip(self.neighbours, self._theirs, strict=True):
            if len(theirs):
                take(theirs, message[f"known<{robot}"])

    def _set_rows(self, X: Array, poses: IntArray, rows: Array) -> None:
        X[columns_of(poses, len(self.is_own), (1, self.d))] = rows


def _weighted(graph: PoseGraph, weight: Array) -> PoseGraph:
    return replace(graph, kappa=weight * graph.kappa, tau=weight * graph.tau)


def _norms(Lambda: Array) -> Array:
    return np.asarray(np.abs(np.linalg.eigvalsh(Lambda)).max(axis=1))
