"""Step (a) of Algorithm 1 split between robots that agree on copies, as min J(x) s.t.

K x = f for Bregman iteration.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array

from pgo_models import BregmanProblem, PoseGraph
from pgo_models.convex.convex_solver import finite_array
from pgo_models.convex.graph_subproblem import Neighbours, robot_qp
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array, stack_transposes, unstack_transposes
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import IntArray


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
        for robot, (poses, rows) in enumerate(
            zip(self.held, self.problem.unstacked(x), strict=True)
        ):
            own = self.robot[poses] == robot
            blocks = rows.reshape(len(poses), self.d, self.d)
            Y.reshape(-1, self.d, self.d)[poses[own]] = blocks[own]
        return unstack_transposes(Y)


def shared_rotation_step(
    graph: PoseGraph, robots: Partition, V: Array, rho: float
) -> SharedRotationStep:
    """Minimise sum_a f_a(x_a) s.t.

    copies of a pose agree: step (a) of Algorithm 1, split between robots.

    f_a has robot a's edges, kappa ||R_j - R_i R_ij||_F^2, half of those it has with another robot,
    and of its own poses rho/2 ||R_p - V_p||_F^2, with V = omega - B, (n, d, d). Robot a holds its
    own poses and their neighbours. K x = 0 says that every copy is what its owner has. With two
    robots T = 1 is ADMM.

    A SettingError when rho is not positive or V has another shape.
    """
    n = graph.num_poses
    d = graph.d
    V = finite_array(V, "V")
    if V.shape != (n, d, d):
        raise SettingError(f"V has shape {V.shape}; it must be {(n, d, d)}")
    if not 0 < rho < np.inf:
        raise SettingError(f"rho must be positive, got {rho}")
    shift = stack_transposes(V)
    graph = graph.with_robots(robots.robot)
    mine = [robots.robot == robot for robot in range(robots.num_robots)]
    programs = [
        robot_qp(graph, robot, rho * own, Neighbours.COPIES) for robot, own in enumerate(mine)
    ]
    held = [program.variables.poses for program in programs]
    for own, program in zip(mine, programs, strict=True):
        program.qp.shift.value = np.sqrt(rho) * shift[np.repeat(own, d)]
    K = _agreement(held, robots.robot, d)
    J = sum(program.qp.problem.objective.args[0] for program in programs)
    problem = BregmanProblem(
        J, [program.variables.X for program in programs], K, np.zeros(K.shape[0])
    )
    return SharedRotationStep(problem, tuple(held), robots.robot, d)


def _agreement(held: list[IntArray], robot: IntArray, d: int) -> csr_array:
    """K: for every copy of another robot's pose, owner's entries minus the copy's."""
    starts = np.cumsum([0, *(d * d * len(poses) for poses in held)])
    owners = []
    copies = []
    for holder, poses in enumerate(held):
        for place in np.flatnonzero(robot[poses] != holder):
            owner = robot[poses[place]]
            owners.append(starts[owner] + d * d * np.searchsorted(held[owner], poses[place]))
            copies.append(starts[holder] + d * d * place)
    entries = np.arange(d * d)
    plus = (np.array(owners, dtype=int)[:, None] + entries).ravel()
    minus = (np.array(copies, dtype=int)[:, None] + entries).ravel()
    s = len(plus)
    data = np.concatenate([np.ones(s), -np.ones(s)])
    rows = np.tile(np.arange(s), 2)
    return csr_array(
        coo_array((data, (rows, np.concatenate([plus, minus]))), shape=(s, int(starts[-1])))
    )
