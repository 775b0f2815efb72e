"""Linear least squares shared among robots: block Jacobi, JOR, Gauss-Seidel and SOR.

With H = J^T diag(w) J and b = -J^T diag(w) r, the robots of one turn, rows a, set

    x_a <- x_a + alpha H_aa^-1 (b - H x)_a

each by the Cholesky factor of its own diagonal block; of the others' x they need separators only (Choudhary et al.
2017; Bertsekas & Tsitsiklis, Parallel and Distributed Computation, section 2.4). Turns of robots that are no neighbours
converge for 0 < alpha < 2 and every positive definite H (SOR). All robots at once converge for 0 < alpha <= 1: with D
the diagonal blocks, 2 D - H is the H of the problem in which one end of every edge between robots has its sign flipped.
It is a sum of squares, positive definite if connected with a fixed pose, as each end of an edge determines its pose.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.cholesky import CholeskyBackend, CholeskyFactor, factorize
from solvers.baselines.sweep_order import Schedule
from solvers.network.ledger import Ledger, Traffic


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Minimise sum_rows w ||J x + r||^2, every row of one edge and every unknown of one pose."""

    J: csr_array  # sparse (rows, unknowns)
    w: Array  # (rows,)
    r: Array  # (rows, columns)
    edge: IntArray  # (rows,)
    pose: IntArray  # (unknowns,)


@dataclass(frozen=True, eq=False)
class Turn:
    """Robots that update at once."""

    rows: IntArray  # (rows,): their unknowns
    H: csr_array  # sparse (rows, unknowns)
    b: Array  # (rows, columns)
    factor: CholeskyFactor | None  # of the robots' diagonal blocks, all of the turn in one block-diagonal matrix
    traffic: Traffic  # what they send to their neighbours afterwards


def take_turns(turns: tuple[Turn, ...], x: Array, alpha: float, ledger: Ledger) -> tuple[Array, Ledger]:
    """One sweep from x, (unknowns, columns): every turn with over-relaxation alpha, then its exchange."""
    x = x.copy()
    for turn in turns:
        if turn.factor is not None:
            x[turn.rows] += alpha * turn.factor.solve(turn.b - turn.H @ x)
        if len(turn.traffic.sender):
            ledger = ledger.after_round(turn.traffic)
    return x, ledger


def sweep_turns(linear: LeastSquares, turns: Schedule, count: int, backend: CholeskyBackend | None) -> tuple[Turn, ...]:
    """Prepare the turns of a sweep, `count` numbers a pose being what is sent."""
    return _prepare(linear.J, linear, turns, turns.group, count, backend)


def flagged_turns(
    linear: LeastSquares, graph: PoseGraph, turns: Schedule, count: int, backend: CholeskyBackend | None
) -> tuple[Turn, ...]:
    """Prepare the turns of a first sweep that needs no start.

    An edge between two robots counts for the end that comes later, which uses the estimate of the end before it.
    Between two of one turn it does not count yet.
    """
    entries = linear.J.tocoo()
    edge, pose = linear.edge[entries.row], linear.pose[entries.col]
    other = graph.i[edge] + graph.j[edge] - pose
    counts = (turns.robot[pose] == turns.robot[other]) | (turns.first[pose] > turns.first[other])
    counted = coo_array((entries.data * counts, (entries.row, entries.col)), shape=entries.shape).tocsr()
    return _prepare(counted, linear, turns, turns.first, count, backend)


def _prepare(
    left: csr_array, linear: LeastSquares, turns: Schedule, group: IntArray, count: int, backend: CholeskyBackend | None
) -> tuple[Turn, ...]:
    """Turns of left^T diag(w) (J x + r) = 0; `group`, (n,), is the turn of every pose."""
    weighted = (left * linear.w[:, None]).T.tocsr()
    H, b = (weighted @ linear.J).tocsr(), -(weighted @ linear.r)
    turn_of_row, robot = group[linear.pose], turns.robot[linear.pose]
    number = np.zeros(H.shape[0], dtype=np.int64)
    prepared = []
    for turn in range(int(group.max()) + 1):
        rows = np.flatnonzero(turn_of_row == turn)
        traffic = turns.traffic(np.flatnonzero(group == turn), count)
        H_rows, number[rows] = H[rows], np.arange(len(rows))
        entries = H_rows.tocoo()
        own = (robot[rows[entries.row]] == robot[entries.col]) & (turn_of_row[entries.col] == turn)
        block = coo_array((entries.data[own], (entries.row[own], number[entries.col[own]])), shape=(len(rows),) * 2)
        factor = factorize(block.tocsc(), backend) if len(rows) else None
        prepared.append(Turn(rows, H_rows, b[rows], factor, traffic))
    return tuple(prepared)
