"""Linear least squares shared among robots: block Jacobi, JOR, Gauss-Seidel and SOR.

With H = J^T diag(w) J and b = -J^T diag(w) r, the robots of one turn, rows a, set

    x_a <- x_a + alpha H_aa^-1 (b - H x)_a

each by the Cholesky factor of its own diagonal block; of the others' x they need separators only (Choudhary et al.
2017; Bertsekas & Tsitsiklis, Parallel and Distributed Computation, section 2.4). Turns of robots that are no neighbours
converge for 0 < alpha < 2 and every positive definite H (SOR). All robots at once converge for 0 < alpha <= 1: with D
the diagonal blocks, 2 D - H is the H of the problem in which one end of every edge between robots has its sign flipped.
That is a sum of squares too, and on a connected graph with a fixed pose positive definite, as each end of an edge
determines its pose.
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


def sweep_turns(
    problem: LeastSquares, turns: Schedule, numbers: int, backend: CholeskyBackend | None
) -> tuple[Turn, ...]:
    """Prepare the turns of a sweep, `numbers` numbers a pose being what is sent."""
    return _prepare(problem.J, problem, turns, turns.group, numbers, backend)


def flagged_turns(
    problem: LeastSquares, graph: PoseGraph, turns: Schedule, numbers: int, backend: CholeskyBackend | None
) -> tuple[Turn, ...]:
    """Prepare the turns of a first sweep that needs no start.

    An edge between two robots counts for the end that comes later, which uses the estimate of the end before it.
    Between two of one turn it does not count yet.
    """
    entries = problem.J.tocoo()
    edge, pose = problem.edge[entries.row], problem.pose[entries.col]
    other = graph.i[edge] + graph.j[edge] - pose
    counts = (turns.robot[pose] == turns.robot[other]) | (turns.first[pose] > turns.first[other])
    counted = coo_array((entries.data * counts, (entries.row, entries.col)), shape=entries.shape).tocsr()
    return _prepare(counted, problem, turns, turns.first, numbers, backend)


def _prepare(
    left: csr_array,
    problem: LeastSquares,
    turns: Schedule,
    turn_of_pose: IntArray,
    numbers: int,
    backend: CholeskyBackend | None,
) -> tuple[Turn, ...]:
    """Turns of left^T diag(w) (J x + r) = 0."""
    weighted = (left * problem.w[:, None]).T.tocsr()
    H, b = (weighted @ problem.J).tocsr(), -(weighted @ problem.r)
    turn_of_row, robot = turn_of_pose[problem.pose], turns.robot[problem.pose]
    number = np.zeros(H.shape[0], dtype=np.int64)
    prepared = []
    for turn in range(int(turn_of_pose.max()) + 1):
        rows = np.flatnonzero(turn_of_row == turn)
        traffic = turns.traffic(np.flatnonzero(turn_of_pose == turn), numbers)
        H_rows = H[rows]
        number[rows] = np.arange(len(rows))
        entries = H_rows.tocoo()
        own = (robot[rows[entries.row]] == robot[entries.col]) & (turn_of_row[entries.col] == turn)
        block = coo_array(
            (entries.data[own], (entries.row[own], number[entries.col[own]])), shape=(len(rows), len(rows))
        )
        factor = factorize(block.tocsc(), backend) if len(rows) else None
        prepared.append(Turn(rows, H_rows, b[rows], factor, traffic))
    return tuple(prepared)
