"""Exact arithmetic for tests: numbers of 300 bits, in which doubles and their products lose nothing
that counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
from scipy.sparse import csc_array, csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from pgo_models import PoseGraph, Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.graphs.precisions import proper_information
from pgo_models.problem.matrices import rotation_columns

Exact = Any  # an array of 300-bit numbers, or one of them
Rows = list[dict[int, Any]]  # a sparse symmetric matrix: of every row the entries by column

MP = mpmath.mp.clone()
MP.prec = 300
_SETTLED = MP.mpf(2) ** -280
_to_exact = np.frompyfunc(MP.mpf, 1, 1)
_root = np.frompyfunc(MP.sqrt, 1, 1)


def exact(values: Any) -> Exact:
    """Numbers as they are, without rounding."""
    array = np.asarray(values)
    return _to_exact(array.astype(object)) if array.ndim else MP.mpf(array.item())


def total(values: Exact) -> Exact:
    """Sum of all entries."""
    return MP.fsum(np.asarray(values).ravel())


def transposed(blocks: Exact) -> Exact:
    return np.swapaxes(blocks, -1, -2)


@dataclass(frozen=True, eq=False)
class ExactGraph:
    """Measurements and weights of a pose graph in 300 bits."""

    num_poses: int
    i: IntArray
    j: IntArray
    R_ij: Exact
    t_ij: Exact
    kappa: Exact
    tau: Exact

    @property
    def d(self) -> int:
        return int(self.t_ij.shape[1])

    @classmethod
    def of_doubles(cls, graph: PoseGraph) -> ExactGraph:
        """The graph whose measurements and weights are the stored doubles."""
        numbers = (exact(values) for values in (graph.R_ij, graph.t_ij, graph.kappa, graph.tau))
        return cls(graph.num_poses, graph.i, graph.j, *numbers)

    @classmethod
    def of_text(cls, path: Path, graph: PoseGraph) -> ExactGraph:
        """The graph of the decimals in a g2o file, `graph` being what was read of it."""
        lines = [
            line.split() for line in path.read_text().splitlines() if line.startswith("EDGE_SE")
        ]
        ids = np.array([[int(name) for name in words[1:3]] for words in lines])
        i, j = np.searchsorted(graph.pose_ids, ids).T
        numbers = np.array([[MP.mpf(word) for word in words[3:]] for words in lines], dtype=object)
        d = graph.d
        if d == 2:
            c = np.array([MP.cos(angle) for angle in numbers[:, 2]], dtype=object)
            s = np.array([MP.sin(angle) for angle in numbers[:, 2]], dtype=object)
            R_ij = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
            I_xx = numbers[:, 3]
            I_xy = numbers[:, 4]
            I_yy = numbers[:, 6]
            tau = 2 * (I_xx * I_yy - I_xy**2) / (I_xx + I_yy)
            return cls(graph.num_poses, i, j, R_ij, numbers[:, :2], numbers[:, 8], tau)
        R_ij = _rotations_of_quaternions(numbers[:, 3:7])
        upper = np.zeros((len(lines), 6, 6), dtype=object)
        upper[:, *np.triu_indices(6)] = numbers[:, 7:]
        kappa = MP.mpf(3) / 2 / _trace_of_inverse(upper[:, 3:, 3:])
        return cls(
            graph.num_poses,
            i,
            j,
            R_ij,
            numbers[:, :3],
            kappa,
            3 / _trace_of_inverse(upper[:, :3, :3]),
        )

    def objective(self, R: Exact, t: Exact) -> Exact:
        """F at exact poses."""
        shift = t[self.j] - t[self.i] - (R[self.i] @ self.t_ij[:, :, None])[:, :, 0]
        turn = R[self.j] - R[self.i] @ self.R_ij
        return total(self.tau * (shift**2).sum(axis=1)) + total(
            self.kappa * (turn**2).sum(axis=(1, 2))
        )

    def objective_of(self, poses: Poses) -> Exact:
        """F at the exact rotations nearest to those of poses."""
        return self.objective(nearest_rotations(poses.R), exact(poses.t))

    def residual_rows(self) -> list[tuple[Any, dict[int, Any]]]:
        """Weight and entries of every row of A, in the order of
        `pgo_models.problem.matrices.residual_matrix`.
        """
        n = self.num_poses
        d = self.d
        columns_i = rotation_columns(self.i, n, d)
        columns_j = rotation_columns(self.j, n, d)
        rows = []
        for e, (i, j) in enumerate(zip(self.i.tolist(), self.j.tolist(), strict=True)):
            turned = {int(c): -self.t_ij[e, a] for a, c in enumerate(columns_i[e])}
            rows.append((self.tau[e], {i: MP.mpf(-1), j: MP.mpf(1), **turned}))
        for e in range(len(self.i)):
            for b in range(d):
                turned = {int(c): -self.R_ij[e, a, b] for a, c in enumerate(columns_i[e])}
                rows.append((self.kappa[e], {int(columns_j[e, b]): MP.mpf(1), **turned}))
        return rows

    def certificate_matrix(self, Lambda: Array, eta: float = 0.0) -> Rows:
        """S + eta blockdiag(0, I) = A^T diag(w) A - blockdiag(0, Lambda - eta I)."""
        n = self.num_poses
        d = self.d
        S: Rows = [{} for _ in range((d + 1) * n)]
        for weight, row in self.residual_rows():
            for k, value in row.items():
                for column, other in row.items():
                    S[k][column] = S[k].get(column, 0) + weight * value * other
        blocks = exact(eta) * np.eye(d, dtype=int) - exact(Lambda)
        for rows, block in zip(rotation_columns(np.arange(n), n, d).tolist(), blocks, strict=True):
            for a, k in enumerate(rows):
                for b, column in enumerate(rows):
                    S[k][column] = S[k].get(column, 0) + block[a, b]
        return S


def nearest_rotations(R: Array) -> Exact:
    """Exact rotations nearest to ones in double precision: Newton's iteration X <- (X + X^-T) / 2
    to the end.
    """
    X = exact(R)
    while True:
        inverse_transposed = _cofactors(X) / determinants(X)[:, None, None]
        change = X - inverse_transposed
        X = (X + inverse_transposed) / 2
        if max(abs(value) for value in change.ravel()) < _SETTLED:
            return X


def determinants(X: Exact) -> Exact:
    return (X[:, 0] * _cofactors(X)[:, 0]).sum(axis=-1)


def _cofactors(X: Exact) -> Exact:
    if X.shape[-1] == 2:
        (a, b), (c, d) = np.moveaxis(X, 0, -1)
        return np.stack([np.stack([d, -c], -1), np.stack([-b, a], -1)], -2)
    found = np.empty_like(X)
    for a in range(3):
        for b in range(3):
            p = (a + 1) % 3
            q = (a + 2) % 3
            r = (b + 1) % 3
            s = (b + 2) % 3
            found[:, a, b] = X[:, p, r] * X[:, q, s] - X[:, p, s] * X[:, q, r]
    return found


def _trace_of_inverse(upper: Exact) -> Exact:
    """tr(I^-1) of symmetric 3 x 3 matrices given by their upper triangles."""
    X = upper + np.triu(np.ones((3, 3), dtype=int), 1) * 0
    for a in range(3):
        for b in range(a):
            X[:, a, b] = X[:, b, a]
    return np.einsum("naa->n", _cofactors(X)) / determinants(X)


def _rotations_of_quaternions(q: Exact) -> Exact:
    x, y, z, w = (q / _root((q**2).sum(axis=1))[:, None]).T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], -1),
            np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], -1),
            np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )


def times(matrix: Rows, X: Exact) -> Exact:
    """Product with a dense matrix, (N, k)."""
    return np.array(
        [sum(value * X[column] for column, value in row.items()) for row in matrix], dtype=object
    )


def rows_of(matrix: csc_array | Array) -> Rows:
    """A stored symmetric matrix, its lower triangle counting for both."""
    lower = csc_array(np.tril(matrix)) if isinstance(matrix, np.ndarray) else matrix
    found: Rows = [{} for _ in range(lower.shape[0])]
    for column in range(lower.shape[1]):
        for place in range(lower.indptr[column], lower.indptr[column + 1]):
            row = int(lower.indices[place])
            if row >= column:
                found[row][column] = found[column][row] = MP.mpf(float(lower.data[place]))
    return found


def without(matrix: Rows, left_out: IntArray) -> Rows:
    """The same matrix with rows and columns left out, the others renumbered."""
    kept = np.setdiff1d(np.arange(len(matrix)), left_out).tolist()
    place = {row: k for k, row in enumerate(kept)}
    return [
        {place[column]: value for column, value in matrix[row].items() if column in place}
        for row in kept
    ]


def less_diagonal(matrix: Rows, diagonal: Exact) -> Rows:
    """Matrix - diag(diagonal)."""
    return [{**row, k: row.get(k, 0) - diagonal[k]} for k, row in enumerate(matrix)]


def is_positive_definite(matrix: Rows) -> bool:
    """Whether sparse Cholesky in 300 bits goes through, in an order of small bandwidth.

    A pivot counts as positive when it is above 2^-200 of its diagonal entry, far above the rounding
    of 300 bits.
    """
    side = len(matrix)
    rows = np.repeat(np.arange(side), [len(row) for row in matrix])
    columns = np.concatenate([np.fromiter(row, dtype=np.int64) for row in matrix])
    order = reverse_cuthill_mckee(
        csr_array((np.ones(len(rows)), (rows, columns)), shape=(side, side)), True
    )
    place = np.empty(side, dtype=np.int64)
    place[order] = np.arange(side)
    # Of every column of the factor-to-be the entries at and below the diagonal.
    left: Rows = [{} for _ in range(side)]
    for row, entries in enumerate(matrix):
        k = int(place[row])
        for column, value in entries.items():
            below = int(place[column])
            if below >= k:
                left[k][below] = value
    least = MP.mpf(2) ** -200
    first = [column[k] for k, column in enumerate(left)]
    for k in range(side):
        column = left[k]
        left[k] = {}
        pivot = column.pop(k)
        if not pivot > least * abs(first[k]):
            return False
        entries = sorted(column.items())
        for a, (row, value) in enumerate(entries):
            share = value / pivot
            target = left[row]
            for below, other in entries[a:]:
                target[below] = target.get(below, 0) - share * other
    return True


def largest_share(difference: Exact, diagonal: Array) -> float:
    """Largest eigenvalue of D^-1/2 difference D^-1/2, the difference being known exactly and then
    rounded.
    """
    root = np.sqrt(diagonal)
    scaled = np.asarray(difference / exact(np.outer(root, root)), dtype=float)
    return float(np.linalg.eigvalsh(0.5 * (scaled + scaled.T)).max())


def exact_chi2(graph: PoseGraph, poses: Poses) -> Exact:
    """chi2 in 300 bits at the rotations nearest to those stored, by its definition."""
    d = graph.d
    R = nearest_rotations(poses.R)
    t = exact(poses.t)
    R_ij = nearest_rotations(graph.R_ij)
    information = exact(proper_information(graph))
    R_i = R[graph.i]
    R_j = R[graph.j]
    back = transposed(R_ij)
    r = back @ (
        transposed(R_i) @ (t[graph.j] - t[graph.i])[:, :, None] - exact(graph.t_ij)[:, :, None]
    )
    E = back @ transposed(R_i) @ R_j
    skew = (E - transposed(E)) / 2
    s = (
        skew[:, 1, 0][:, None]
        if d == 2
        else np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], -1)
    )
    I_tt = information[:, :d, :d]
    I_tr = information[:, :d, d:]
    I_rr = information[:, d:, d:]
    cost = total(r * (I_tt @ r)) + 2 * total(r * (I_tr @ s[:, :, None]))
    off = np.eye(d, dtype=int) - E
    trace = sum(I_rr[:, k, k] for k in range(I_rr.shape[1]))
    W = I_rr[:, 0, 0][:, None, None] * np.eye(2, dtype=int) / 2 if d == 2 else None
    W = trace[:, None, None] * np.eye(3, dtype=int) / 2 - I_rr if W is None else W
    return cost + 2 * total(transposed(W) * off)
