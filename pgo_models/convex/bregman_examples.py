"""Worked models of the form min J(x) s.t. K x = f, for the Bregman iterations of solvers/convex/bregman.py."""

from dataclasses import dataclass

import cvxpy as cp
import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array, eye_array, hstack, kron, vstack

from pgo_models.convex.bregman import BregmanProblem
from pgo_models.convex.convex_solver import finite_array
from pgo_models.convex.graph_subproblem import Neighbours, robot_qp
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array, stack_transposes, unstack_transposes
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import IntArray, PoseGraph


def basis_pursuit(K: Array, f: Array) -> BregmanProblem:
    """Minimise ||x||_1 s.t. K x = f: the sparsest x, when K is incoherent and x sparse enough.

    Bregman iteration ends after finitely many steps, and forgets errors made on the way (Yin et al. 2008; Yin & Osher
    2013).
    """
    x = cp.Variable(np.shape(K)[-1], name="x")
    return BregmanProblem(cp.norm1(x), x, K, f)


def differences(shape: tuple[int, ...]) -> csr_array:
    """Forward differences of a signal or an image, flattened row by row: down the rows first, then across the columns.

    A SettingError when the shape has not one or two dimensions, or only one entry.
    """
    if len(shape) not in (1, 2) or int(np.prod(shape)) < 2:
        raise SettingError(f"shape is {shape}; give a signal or an image of two entries or more")
    if len(shape) == 1:
        return _forward(shape[0])
    height, width = shape
    down, across = kron(_forward(height), eye_array(width)), kron(eye_array(height), _forward(width))
    return csr_array(vstack([down, across]))


def total_variation_denoising(noisy: Array, weight: float) -> BregmanProblem:
    """Minimise 1/2 ||u - noisy||^2 + weight ||d||_1 s.t. D u - d = 0: ROF, anisotropic in two dimensions.

    D are the forward differences. The variables are u and d, so that AlternatingBregman with T = 1 is split Bregman:
    a least-squares step in u and soft thresholding in d (Rudin, Osher, Fatemi 1992; Goldstein & Osher 2009).
    """
    noisy = finite_array(noisy, "noisy")
    if not 0 <= weight < np.inf:
        raise SettingError(f"weight must not be negative, got {weight}")
    D = differences(noisy.shape)
    u, d = cp.Variable(noisy.shape, name="u"), cp.Variable(D.shape[0], name="d")
    J = 0.5 * cp.sum_squares(u - noisy) + weight * cp.norm1(d)
    return BregmanProblem(J, (u, d), hstack([D, -eye_array(D.shape[0])]), np.zeros(D.shape[0]))


def total_variation_scale_space(noisy: Array) -> BregmanProblem:
    """Minimise TV(u) s.t. u = noisy: K = I, whose Bregman iterates are what is wanted, not its solution.

    They begin over-smoothed and take detail back, large contrasts first and noise last: stop when
    ||u - noisy|| falls below the norm of the noise (Osher et al. 2005).
    """
    noisy = finite_array(noisy, "noisy")
    u = cp.Variable(noisy.shape, name="u")
    J = cp.norm1(differences(noisy.shape) @ cp.vec(u, order="C"))
    return BregmanProblem(J, u, eye_array(noisy.size), noisy.ravel())


@dataclass(frozen=True, eq=False)
class SharedRotationStep:
    """The R-subproblem of several robots that agree on the rotations they share."""

    problem: BregmanProblem  # one variable a robot: the rows R_p^T of the poses it holds
    # (poses,) each: poses that a robot holds, its own and copies of their neighbours, ascending.
    held: tuple[IntArray, ...]
    robot: IntArray  # (n,): owner of every pose
    d: int

    def rotations(self, x: Array) -> Array:
        """The owners' matrices, (n, d, d), of the stacked x; relaxed, not projected."""
        Y = np.zeros((self.d * len(self.robot), self.d))
        for robot, (poses, rows) in enumerate(zip(self.held, self.problem.unstacked(x), strict=True)):
            own = self.robot[poses] == robot
            blocks = rows.reshape(len(poses), self.d, self.d)
            Y.reshape(-1, self.d, self.d)[poses[own]] = blocks[own]
        return unstack_transposes(Y)


def shared_rotation_step(graph: PoseGraph, robots: Partition, V: Array, rho: float) -> SharedRotationStep:
    """Minimise sum_a f_a(x_a) s.t. copies of a pose agree: step (a) of Algorithm 1, split between robots.

    f_a has robot a's edges, kappa ||R_j - R_i R_ij||_F^2, half of those it has with another robot, and of its own poses
    rho/2 ||R_p - V_p||_F^2, with V = omega - B, (n, d, d). Robot a holds its own poses and their neighbours. K x = 0
    says that every copy is what its owner has. With two robots T = 1 is ADMM.

    A SettingError when rho is not positive or V has another shape.
    """
    n, d = graph.num_poses, graph.d
    V = finite_array(V, "V")
    if V.shape != (n, d, d):
        raise SettingError(f"V has shape {V.shape}; it must be {(n, d, d)}")
    if not 0 < rho < np.inf:
        raise SettingError(f"rho must be positive, got {rho}")
    shift, graph = stack_transposes(V), graph.with_robots(robots.robot)
    mine = [robots.robot == robot for robot in range(robots.num_robots)]
    programs = [robot_qp(graph, robot, rho * own, Neighbours.COPIES) for robot, own in enumerate(mine)]
    held = [program.variables.poses for program in programs]
    for own, program in zip(mine, programs, strict=True):
        program.qp.shift.value = np.sqrt(rho) * shift[np.repeat(own, d)]
    K = _agreement(held, robots.robot, d)
    J = sum(program.qp.problem.objective.args[0] for program in programs)
    problem = BregmanProblem(J, [program.variables.X for program in programs], K, np.zeros(K.shape[0]))
    return SharedRotationStep(problem, tuple(held), robots.robot, d)


def _forward(length: int) -> csr_array:
    ones = np.ones(max(length - 1, 0))
    return csr_array(diags_array([-ones, ones], offsets=[0, 1], shape=(len(ones), length)))


def _agreement(held: list[IntArray], robot: IntArray, d: int) -> csr_array:
    """K: for every copy of another robot's pose, owner's entries minus the copy's."""
    starts = np.cumsum([0, *(d * d * len(poses) for poses in held)])
    owners, copies = [], []
    for holder, poses in enumerate(held):
        for place in np.flatnonzero(robot[poses] != holder):
            owner = robot[poses[place]]
            owners.append(starts[owner] + d * d * np.searchsorted(held[owner], poses[place]))
            copies.append(starts[holder] + d * d * place)
    entries = np.arange(d * d)
    plus = (np.array(owners, dtype=int)[:, None] + entries).ravel()
    minus = (np.array(copies, dtype=int)[:, None] + entries).ravel()
    s = len(plus)
    data, rows = np.concatenate([np.ones(s), -np.ones(s)]), np.tile(np.arange(s), 2)
    return csr_array(coo_array((data, (rows, np.concatenate([plus, minus]))), shape=(s, int(starts[-1]))))
