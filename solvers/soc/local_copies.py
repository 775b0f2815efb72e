"""Robots in this process: who holds which copies, the local subproblems, and the average over copies.

Robot a holds its own poses and copies of the neighbours' separator poses; an edge between two robots is given half to
each. One robot holds the graph.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csc_array, csr_array
from scipy.sparse.csgraph import connected_components

from pgo_models.certificates.dual_variables import multipliers
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, project_to_rotations, stack_transposes, unstack_transposes
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.cholesky import SymbolicCholesky, analyze
from pgo_models.problem.matrices import joint_matrix, residual_matrix
from pgo_models.problem.problem import PGOProblem
from solvers.soc.penalty import translation_scale
from solvers.soc.r_step import BackEnd, RotationStep, RSubproblem, prepare
from solvers.soc.rotation_block import stationary_B
from solvers.soc.separator_stiffness import GROUND, adapted_penalty, separator_stiffness, travel


@dataclass(frozen=True, eq=False)
class Robot:
    """One robot's share: its local poses, residuals and matrix, and which of its rows it agrees on with omega.

    Attributes
    ----------
    poses : (n_a,)
        Poses it holds, ascending: its own and its neighbours' separators.
    held : (rows_a,)
        Rows of its X with a penalty: separator translations, and all rotations.
    held_global : (rows_a,)
        The same rows in the X of the whole graph.
    A, w, M, analysis
        As in `solvers.soc.r_step.RSubproblem`.
    components : (n_a,)
        Which poses hang together by edges that it knows.
    """

    poses: IntArray
    held: IntArray
    held_global: IntArray
    A: csr_array
    w: Array
    M: csc_array
    analysis: SymbolicCholesky
    components: IntArray


@dataclass(frozen=True, eq=False)
class LocalCopies:
    """All robots, in this process and in order; deterministic.

    A vector over the copies, (rows, d), stacks the held rows of all robots.

    Attributes
    ----------
    robots : tuple of Robot
    row : (rows,)
        Row of the whole graph's X for every row of such a vector.
    multiplicity : (N,)
        How many robots hold a row of X; 0 for translations that only their robot knows.
    slices : tuple of slice
        Rows of every robot in such a vector.
    steps : tuple of RotationStep
        Prepared back ends, empty before `with_penalty`.
    penalty : (rows,)
        Share of rho of every row.
    """

    problem: PGOProblem
    back_end: BackEnd
    robots: tuple[Robot, ...]
    row: IntArray
    multiplicity: IntArray
    slices: tuple[slice, ...]
    steps: tuple[RotationStep, ...] = ()
    penalty: Array | None = None

    def with_penalty(self, rho: Array, rho_t: Array) -> LocalCopies:
        """Return the copies ready to solve with penalties rho (rotations) and rho_t (separator translations), (n,).

        The penalty of a pose is shared equally among its copies.
        """
        d = self.problem.d
        whole = np.concatenate([rho_t, np.repeat(rho, d)])
        share = whole[self.row] / self.multiplicity[self.row]
        steps = []
        for robot, rows in zip(self.robots, self.slices, strict=True):
            penalty = np.zeros(robot.M.shape[0])
            penalty[robot.held] = share[rows]
            steps.append(prepare(self._subproblem(robot, penalty), self.back_end))
        return replace(self, steps=tuple(steps), penalty=share)

    def _subproblem(self, robot: Robot, penalty: Array) -> RSubproblem:
        return RSubproblem(
            A=robot.A,
            w=robot.w,
            M=robot.M,
            d=self.problem.d,
            num_translations=len(robot.poses),
            penalty=penalty,
            analysis=robot.analysis,
            backend=self.problem.backend,
        )

    def solve_all(self, shift: Array) -> Array:
        """Step (a) of every robot: the held rows of X(shift), (rows, d)."""
        solution = np.empty_like(shift)
        for robot, rows, step in zip(self.robots, self.slices, self.steps, strict=True):
            V = np.zeros((robot.M.shape[0], shift.shape[1]))
            V[robot.held] = shift[rows]
            solution[rows] = step.solve(V)[robot.held]
        return solution

    @cached_property
    def separators(self) -> IntArray:
        """Poses that more than one robot holds, ascending."""
        n = self.problem.num_poses
        return np.flatnonzero(self.multiplicity[n :: self.problem.d] > 1)

    @cached_property
    def private(self) -> BoolArray:
        """Whether a row of a vector over the copies is known to its robot alone, (rows,)."""
        return np.asarray(self.multiplicity[self.row] == 1)

    def stiffness(self, rho: Array) -> float:
        """How hard it is to move a separator while rho, (n,), holds the rotations: the median of the robots' stiffness.

        See `solvers.soc.separator_stiffness`. Robots find theirs on their own, and exchange one number each.
        """
        return float(np.median([self._stiffness_of(robot, rho) for robot in self.robots]))

    def _stiffness_of(self, robot: Robot, rho: Array) -> float:
        problem, d = self.problem, self.problem.d
        n, count = problem.num_poses, len(robot.poses)
        held = robot.held[robot.held < count]
        separators = robot.poses[held]
        half_scale = 0.5 * problem.M.data[problem.diagonal_positions[separators]] / self.multiplicity[separators]
        penalty = np.zeros(robot.M.shape[0])
        penalty[count:] = np.repeat(rho[robot.poses] / self.multiplicity[n + d * robot.poses], d)
        penalty[held] = 2.0 * GROUND * half_scale
        factor = robot.analysis.factorize(self._subproblem(robot, penalty).K)
        return separator_stiffness(factor, robot.M.shape[0], held, half_scale, robot.components[held])

    def average(self, vector: Array) -> Array:
        """Mean over the copies of every row of X, (N, d); rows without copies are zero."""
        if len(self.robots) == 1:
            mean = np.zeros((len(self.multiplicity), vector.shape[1]))
            mean[self.row] = vector
            return mean
        total = np.stack(
            [np.bincount(self.row, weights=column, minlength=len(self.multiplicity)) for column in vector.T], axis=1
        )
        return np.asarray(total / np.maximum(self.multiplicity, 1)[:, None])

    def gradients(self, X: Array) -> Array:
        """2 M_a X of every robot on its held rows, (rows, d), at copies that agree with X, (N, d)."""
        gradient = np.empty((len(self.row), X.shape[1]))
        for robot, rows in zip(self.robots, self.slices, strict=True):
            local = X[_global_rows(robot.poses, self.problem)]
            gradient[rows] = 2.0 * (robot.A.T @ (robot.w[:, None] * (robot.A @ local)))[robot.held]
        return gradient


def build_copies(problem: PGOProblem, partition: Partition | None, back_end: BackEnd) -> LocalCopies:
    """Split a problem among robots; None is one robot that holds it all."""
    if partition is None or partition.num_robots == 1:
        robots: tuple[Robot, ...] = (_whole(problem),)
    else:
        separator = np.zeros(problem.num_poses, dtype=bool)
        separator[partition.separators(problem.graph)] = True
        robots = tuple(_share(problem, partition.robot, a, separator) for a in range(partition.num_robots))
    row = np.concatenate([robot.held_global for robot in robots])
    ends = np.cumsum([len(robot.held) for robot in robots])
    slices = tuple(slice(end - len(robot.held), end) for robot, end in zip(robots, ends, strict=True))
    return LocalCopies(problem, back_end, robots, row, np.bincount(row, minlength=problem.side), slices)


def _whole(problem: PGOProblem) -> Robot:
    A, w = problem.residual_matrix
    held = np.arange(problem.num_poses, problem.side)
    poses, together = np.arange(problem.num_poses), np.zeros(problem.num_poses, dtype=np.int64)
    return Robot(poses, held, held, A, w, problem.M, problem.analysis, together)


def _share(problem: PGOProblem, owner: IntArray, a: int, separator: Array) -> Robot:
    graph = problem.graph
    mine_i, mine_j = owner[graph.i] == a, owner[graph.j] == a
    edges = np.flatnonzero(mine_i | mine_j)
    share = np.where(mine_i[edges] & mine_j[edges], 1.0, 0.5)
    poses = np.unique(np.concatenate([np.flatnonzero(owner == a), graph.i[edges], graph.j[edges]]))
    local = PoseGraph(
        num_poses=len(poses),
        i=np.searchsorted(poses, graph.i[edges]),
        j=np.searchsorted(poses, graph.j[edges]),
        R_ij=graph.R_ij[edges],
        t_ij=graph.t_ij[edges],
        kappa=share * graph.kappa[edges],
        tau=share * graph.tau[edges],
    )
    M = joint_matrix(local)
    A, w = residual_matrix(local)
    held = np.concatenate([np.flatnonzero(separator[poses]), np.arange(len(poses), M.shape[0])])
    components = connected_components(local.adjacency, directed=False)[1]
    return Robot(poses, held, _global_rows(poses, problem)[held], A, w, M, analyze(M, problem.backend), components)


def _global_rows(poses: IntArray, problem: PGOProblem) -> IntArray:
    """Rows of the whole X that the X of some poses holds."""
    n, d = problem.num_poses, problem.d
    return np.concatenate([poses, (n + d * poses[:, None] + np.arange(d)).ravel()])


# Vectors over the copies: agreement of the copies, the norms of the residuals, and multipliers in balance.


def stationary_mean(problem: PGOProblem, poses: Poses, rho: Array) -> Array:
    """B of a stationary point, (N, d); zero for translations."""
    rotations = stationary_B(poses.R, multipliers(problem, poses), rho)
    return np.concatenate([np.zeros((problem.num_poses, problem.d)), rotations])


def balanced(copies: LocalCopies, X: Array, mean: Array) -> Array:
    """Local multipliers B, (rows, d), that make every subproblem stationary at X; `mean`, (N, d), is their mean.

    At a stationary point 2 M_a x + rho_a B_a = 0 for every robot a. One robot alone has B = mean.
    """
    assert copies.penalty is not None
    B = -copies.gradients(X) / copies.penalty[:, None]
    return B + (mean - copies.average(B))[copies.row]


def agree(copies: LocalCopies, s: Array, problem: PGOProblem) -> tuple[Array, Array]:
    """Step (b): omega from the mean of the copies, and omega and the mean separator translations handed out again."""
    mean = copies.average(s)
    omega = project_to_rotations(unstack_transposes(mean[problem.num_poses :]))
    mean[problem.num_poses :] = stack_transposes(omega)
    return omega, mean[copies.row]


def norm_of_omega(copies: LocalCopies) -> float:
    """||omega||_rho over all copies: the translations, which depend on the origin of the world, are left out."""
    assert copies.penalty is not None
    rotations = copies.row >= copies.problem.num_poses
    return float(np.sqrt(copies.penalty[rotations].sum()))


def norm_weight(copies: LocalCopies) -> Array:
    """Square roots of the penalties: ||v||_rho is the norm of weight * v."""
    assert copies.penalty is not None
    return np.sqrt(copies.penalty)[:, None]


def stationarity_weight(copies: LocalCopies) -> Array:
    """Root of the penalty, times penalty over the diagonal of M where it is above that."""
    assert copies.penalty is not None
    problem = copies.problem
    diagonal = problem.M.data[problem.diagonal_positions][copies.row] / copies.multiplicity[copies.row]
    return np.asarray(norm_weight(copies) * np.maximum(1.0, copies.penalty / diagonal)[:, None])


def adapted(
    problem: PGOProblem,
    copies: LocalCopies,
    penalty: float,
    origin: tuple[Array, Array] | None,
    now: tuple[Array, Array],
) -> float:
    """Translation penalty, times the diagonal of M, after the way with `penalty` from the first z, s to those now."""
    assert origin is not None
    assert copies.penalty is not None
    at, scale = copies.row < problem.num_poses, translation_scale(problem)
    moved, change = now[0] - origin[0], now[1] - origin[1]
    pulled = copies.penalty[at, None] * (change - moved)[at]  # of B = s - z
    sums = travel(moved[at], pulled, scale[copies.row[at]] / copies.multiplicity[copies.row[at]])
    return adapted_penalty(penalty, sums)
