"""Linear least squares shared among robots: block Gauss-Seidel, and SOR.

With H = J^T diag(w) J and b = -J^T diag(w) r, the robots of one turn, rows a, set

    x_a <- x_a + alpha H_aa^-1 (b - H x)_a

each by the Cholesky factor of its own diagonal block; of the others' x they need separators only
(Choudhary et al. 2017; Bertsekas & Tsitsiklis, Parallel and Distributed Computation, section 2.4).
Turns of robots that are no neighbours converge for 0 < alpha < 2 and every positive definite H.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csc_array, csr_array

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.cholesky import CholeskyBackend, CholeskyFactor, factorize
from solvers.baselines.sweep_order import Schedule
from solvers.carry.ledger import Ledger, Traffic


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Minimise sum_rows w ||J x + r||^2, every row of one edge and every unknown of one pose."""

    J: csr_array  # (rows, unknowns): Jacobian
    w: Array  # (rows,)
    r: Array  # (rows, columns): residuals at x = 0
    edge: IntArray  # (rows,): edge of every row
    pose: IntArray  # (unknowns,): pose of every unknown


@dataclass(frozen=True, eq=False)
class Turn:
    """Robots that update at once."""

    rows: IntArray  # (rows,): their unknowns
    H: csr_array  # (rows, unknowns): their rows of the normal matrix
    b: Array  # (rows, columns): their rows of the right-hand side
    # of their diagonal blocks, all of the turn in one block-diagonal matrix; None without rows
    factor: CholeskyFactor | None
    traffic: Traffic  # what they send to their neighbours afterwards


def take_turns(
    turns: tuple[Turn, ...], x: Array, alpha: float, ledger: Ledger
) -> tuple[Array, Ledger]:
    """Make one sweep from x, (unknowns, columns).

    In every turn its robots update with over-relaxation alpha, and then send what has changed.
    """
    x = x.copy()
    for turn in turns:
        if turn.factor is not None:
            x[turn.rows] += alpha * turn.factor.solve(turn.b - turn.H @ x)
        if len(turn.traffic.sender):
            ledger = ledger.after_round(turn.traffic)
    return x, ledger


def flagged_turns(
    linear: LeastSquares,
    graph: PoseGraph,
    turns: Schedule,
    count: int,
    backend: CholeskyBackend | None,
) -> tuple[Turn, ...]:
    """Prepare the turns of a first sweep that needs no start.

    An edge between two robots counts for the end that comes later, which uses the estimate of the
    end before it. An edge between two robots of the same turn does not count yet.
    """
    entries = linear.J.tocoo()
    edge = linear.edge[entries.row]
    pose = linear.pose[entries.col]
    other_end = graph.i[edge] + graph.j[edge] - pose
    is_inside = turns.robot[pose] == turns.robot[other_end]
    is_later = turns.first[pose] > turns.first[other_end]
    data = entries.data * (is_inside | is_later)
    counted = coo_array((data, (entries.row, entries.col)), shape=entries.shape)
    return prepare_turns(counted.tocsr(), linear, turns, turns.first, count, backend)


def prepare_turns(
    left: csr_array,
    linear: LeastSquares,
    turns: Schedule,
    group: IntArray,
    count: int,
    backend: CholeskyBackend | None,
) -> tuple[Turn, ...]:
    """Turns of a sweep of left^T diag(w) (J x + r) = 0, with `count` numbers sent for every pose.

    `group`, (n,), is the turn of every pose.
    """
    weighted = (left * linear.w[:, None]).T.tocsr()
    H = (weighted @ linear.J).tocsr()
    b = -(weighted @ linear.r)
    turn_of_row = group[linear.pose]
    robot_of_row = turns.robot[linear.pose]
    prepared = []
    for turn in range(int(group.max()) + 1):
        rows = np.flatnonzero(turn_of_row == turn)
        traffic = turns.traffic(np.flatnonzero(group == turn), count)
        H_rows = H[rows]
        factor = None
        if len(rows):
            factor = factorize(_diagonal_blocks(H_rows, rows, robot_of_row), backend)
        prepared.append(Turn(rows, H_rows, b[rows], factor, traffic))
    return tuple(prepared)


def _diagonal_blocks(H_rows: csr_array, rows: IntArray, robot_of_row: IntArray) -> csc_array:
    """The diagonal blocks of the robots that own some rows of H, in one block-diagonal matrix."""
    position = np.full(H_rows.shape[1], -1)
    position[rows] = np.arange(len(rows))
    entries = H_rows.tocoo()
    is_same_robot = robot_of_row[rows[entries.row]] == robot_of_row[entries.col]
    is_in_block = is_same_robot & (position[entries.col] >= 0)
    positions = entries.row[is_in_block], position[entries.col[is_in_block]]
    return coo_array((entries.data[is_in_block], positions), shape=(len(rows), len(rows))).tocsc()
