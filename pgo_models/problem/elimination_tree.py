"""A block Cholesky factor that follows its matrix: only the fronts above a change are made again.

The matrix H is that of a network of springs: a pair of poses (i, j) with the stiffness G, (k, k),
adds G to the blocks (i, i) and (j, j) and -G to (i, j) and (j, i). To hold pose 0, its pairs add G
to the block (0, 0) twice.

A front eliminates a few poses at once (multifrontal method, Liu 1992). With E its eliminated poses,
B the later ones that they are joined with, and

    [H_EE  H_EB]   what its pairs add, and the Schur complements of the fronts below it,
    [H_BE  H_BB]

it holds P = L^-1 for H_EE = L L^T, W = P H_EB, and the Schur complement H_BB - W^T W, which is
added to the front above, the one that eliminates the first pose of B.

A changed pair changes the front that it is in and those above. `EliminationTree.updated` takes
these apart, orders their poses anew, the newest last, and eliminates them again; the fronts below
keep what they hold. It is the update of a Bayes tree (Kaess et al. 2012, algorithm 4): with the
newest poses last, what is measured next is mostly near the root.

References
----------
M. Kaess, H. Johannsson, R. Roberts, V. Ila, J. Leonard and F. Dellaert, iSAM2: Incremental
smoothing and mapping using the Bayes tree, IJRR 2012; J. W. H. Liu, The multifrontal method for
sparse matrix solution: theory and practice, SIAM Review 1992.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtri
from scipy.sparse import csc_array

from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import minimum_degree

# Rows up to which a front is joined with the one above whatever zeros that stores: below, the calls
# of a front cost more than its arithmetic.
_SMALL = 48
# Share of its entries that a front may store as zeros when it is joined with the one above.
_ZEROS = 0.15


@dataclass(frozen=True, eq=False)
class Front:
    """Poses that are eliminated together, and what is left of them."""

    eliminated: IntArray  # (e,)
    boundary: IntArray  # (b,): later poses
    above: int  # the one of them that is eliminated first, or -1 where there is none
    own_rows: IntArray  # (e k,): those of its poses, in vectors with k entries a pose
    later_rows: IntArray  # (b k,): those of its boundary
    pairs: IntArray  # whose blocks are added here
    inverse: Array  # P, (e k, e k), lower triangular
    coupling: Array  # W, (e k, b k)
    complement: Array  # (b k, b k)


class _Symbolic(NamedTuple):
    """Poses and boundary of a front that is to be made, as places in the poses to eliminate."""

    eliminated: list[int]
    boundary: list[int]
    num_blocks: int  # blocks of the factor that are not zero, at most


@dataclass(frozen=True, eq=False)
class EliminationTree:
    """Factor of H in fronts, those below before those above.

    Parameters
    ----------
    fronts : tuple of Front
        All of them.
    front_of : list of Front
        The one that eliminates a pose, for every pose.
    width : int
        k, the rows of a block.
    """

    fronts: tuple[Front, ...]
    front_of: list[Front]
    width: int

    @classmethod
    def empty(cls, width: int) -> EliminationTree:
        """Return the factor of a matrix without poses, for blocks of k rows."""
        return cls((), [], width)

    def updated(
        self,
        i: IntArray,
        j: IntArray,
        changed: IntArray,
        last: int,
        stiffness: Callable[[IntArray], Array],
    ) -> EliminationTree:
        """Return the factor after some pairs have changed or come up.

        Parameters
        ----------
        i, j : (m,) array of int
            First and second pose of every pair; those that were there are as they were.
        changed : (c,) array of int
            Pairs whose blocks have changed, and all new ones, which come last.
        last : int
            How many of the highest poses are eliminated last.
        stiffness : callable
            G of some pairs, (e, k, k). It is asked for all pairs of the fronts that are made again.

        Returns
        -------
        EliminationTree
            It shares the fronts that do not change. A NotPositiveDefiniteError when H has no
            Cholesky factor in doubles.
        """
        num_poses = 1 + int(max(i.max(), j.max()))
        touched = np.unique(np.concatenate([i[changed], j[changed]]))
        affected = self._fronts_above(touched.tolist())
        kept: list[Front] = []
        below: list[Front] = []  # those next below the affected ones
        for front in self.fronts:
            if id(front) in affected:
                continue
            is_next = front.above >= 0 and id(self.front_of[front.above]) in affected
            (below if is_next else kept).append(front)
        new_poses = np.arange(len(self.front_of), num_poses)
        poses = np.concatenate([new_poses, *(front.eliminated for front in affected.values())])
        poses.sort()
        pairs = np.unique(np.concatenate([changed, *(f.pairs for f in affected.values())]))
        task = _Elimination(num_poses, poses, pairs, i[pairs], j[pairs], below, self.width)
        moved, made = task.fronts(last, stiffness(pairs))
        front_of = self.front_of + made[:1] * len(new_poses)
        for front in (*moved, *made):
            for pose in front.eliminated.tolist():
                front_of[pose] = front
        return EliminationTree((*kept, *moved, *made), front_of, self.width)

    def _fronts_above(self, poses: list[int]) -> dict[int, Front]:
        """Fronts that eliminate some poses, and all above them, by their identity."""
        affected: dict[int, Front] = {}
        for pose in poses:
            if pose >= len(self.front_of):
                continue
            front = self.front_of[pose]
            while id(front) not in affected:
                affected[id(front)] = front
                if front.above < 0:
                    break
                front = self.front_of[front.above]
        return affected

    def solve(self, right_hand_side: Array) -> tuple[Array, float]:
        """Return H^-1 b, (n, k), and b^T H^-1 b, for b of shape (n, k)."""
        b = right_hand_side.ravel()
        x = b.copy()
        halves = []
        for front in self.fronts:
            y = front.inverse.dot(x[front.own_rows])
            halves.append(y)
            x[front.later_rows] -= y.dot(front.coupling)
        for front, y in zip(reversed(self.fronts), reversed(halves), strict=True):
            rest = y - front.coupling.dot(x[front.later_rows])
            x[front.own_rows] = rest.dot(front.inverse)
        return x.reshape(right_hand_side.shape), float(b.dot(x))


class _Elimination:
    """Poses that are eliminated anew: their order, the fronts that this gives, and their factors.

    Inside, poses and pairs are named by their places in `poses` and `pairs`.
    """

    def __init__(
        self,
        num_poses: int,
        poses: IntArray,
        pairs: IntArray,
        i: IntArray,
        j: IntArray,
        below: list[Front],
        width: int,
    ) -> None:
        place = np.zeros(num_poses, dtype=np.int64)
        place[poses] = np.arange(len(poses))
        self.poses = poses
        self.pairs = pairs
        self.i = place[i]
        self.j = place[j]
        self.below = below
        self.boundaries = [place[front.boundary] for front in below]
        self.width = width

    def fronts(self, last: int, stiffness: Array) -> tuple[list[Front], list[Front]]:
        """Return the fronts below, which go to other ones above, and the new fronts in order."""
        order = self._order(last)
        rank = np.empty(len(order), dtype=np.int64)
        rank[order] = np.arange(len(order))
        symbolic = self._eliminate(order.tolist(), rank.tolist())
        moved = []
        for front, boundary in zip(self.below, self.boundaries, strict=True):
            first = boundary[np.argmin(rank[boundary])]
            moved.append(replace(front, above=int(self.poses[first])))
        return moved, self._factorize(symbolic, rank, stiffness)

    def _order(self, last: int) -> IntArray:
        """Order of elimination: minimum degree, but for the newest poses, which come last."""
        num_poses = len(self.poses)
        num_first = num_poses - min(last, num_poses)
        rows = [np.arange(num_poses), np.maximum(self.i, self.j)]
        columns = [np.arange(num_poses), np.minimum(self.i, self.j)]
        for boundary in self.boundaries:  # a clique
            first, second = np.tril_indices(len(boundary), -1)
            rows.append(np.maximum(boundary[first], boundary[second]))
            columns.append(np.minimum(boundary[first], boundary[second]))
        all_rows = np.concatenate(rows)
        all_columns = np.concatenate(columns)
        is_first = all_rows < num_first
        entries = (all_rows[is_first], all_columns[is_first])
        ones = np.ones(len(entries[0]))
        order = minimum_degree(csc_array((ones, entries), shape=(num_first, num_first)))
        return np.concatenate([order, np.arange(num_first, num_poses)])

    def _eliminate(self, order: list[int], rank: list[int]) -> list[_Symbolic]:
        """Eliminate pose by pose, and join poses to fronts where that stores few zeros."""
        later = self._later_neighbours(rank)
        waiting: list[list[_Symbolic]] = [[] for _ in order]  # fronts by the pose above them
        made: list[_Symbolic] = []
        for pose in order:
            boundary = later[pose]
            boundary.discard(pose)
            front = _Symbolic([pose], list(boundary), 1 + len(boundary))
            for below in waiting[pose]:
                joined = _joined(below, front)
                if self._is_dense(joined):
                    front = joined
                else:
                    made.append(below)
            if boundary:
                above = min(boundary, key=rank.__getitem__)
                later[above] |= boundary
                waiting[above].append(front)
            else:
                made.append(front)
        return made

    def _later_neighbours(self, rank: list[int]) -> list[set[int]]:
        """Poses that come later, of every pose, by its pairs and the fronts below it."""
        later: list[set[int]] = [set() for _ in rank]
        for a, b in zip(self.i.tolist(), self.j.tolist(), strict=True):
            if rank[a] < rank[b]:
                later[a].add(b)
            else:
                later[b].add(a)
        for boundary in self.boundaries:
            poses = boundary.tolist()
            first = min(poses, key=rank.__getitem__)
            later[first].update(poses)
        return later

    def _is_dense(self, front: _Symbolic) -> bool:
        """Whether a front is small, or stores few zeros."""
        num_eliminated = len(front.eliminated)
        if num_eliminated * self.width <= _SMALL:
            return True
        stored = num_eliminated * (0.5 * (num_eliminated + 1) + len(front.boundary))
        return stored - front.num_blocks <= _ZEROS * stored

    def _factorize(
        self, symbolic: list[_Symbolic], rank: IntArray, stiffness: Array
    ) -> list[Front]:
        """Return the new fronts, each with the Schur complements of those below it."""
        rows = [_rows_of(front, rank) for front in symbolic]
        number = np.empty(len(rank), dtype=np.int64)  # of the front that eliminates a pose
        for front, symbols in enumerate(symbolic):
            number[symbols.eliminated] = front
        pairs_of, matrices = self._assemble(rows, number, rank, stiffness)
        waiting: list[list[tuple[IntArray, Array]]] = [[] for _ in rows]
        for boundary, below in zip(self.boundaries, self.below, strict=True):
            first = boundary[np.argmin(rank[boundary])]
            waiting[number[first]].append((boundary, below.complement))
        place = np.empty(len(rank), dtype=np.int64)  # in the rows of a front
        made: list[Front] = []
        for front, poses in enumerate(rows):
            H = matrices[front]
            place[poses] = np.arange(len(poses))
            for joined, complement in waiting[front]:
                _add(complement, H, _entries(place[joined], self.width).ravel())
            num_eliminated = len(symbolic[front].eliminated)
            P, W, left = _eliminate_first(H, self.width * num_eliminated)
            own = poses[:num_eliminated]
            later = poses[num_eliminated:]
            above = -1
            if len(later):
                above = int(self.poses[later[0]])
                waiting[number[later[0]]].append((later, left))
            made.append(
                Front(
                    eliminated=self.poses[own],
                    boundary=self.poses[later],
                    above=above,
                    own_rows=_entries(self.poses[own], self.width).ravel(),
                    later_rows=_entries(self.poses[later], self.width).ravel(),
                    pairs=self.pairs[pairs_of[front]],
                    inverse=P,
                    coupling=W,
                    complement=left,
                )
            )
        return made

    def _assemble(
        self, rows: list[IntArray], number: IntArray, rank: IntArray, stiffness: Array
    ) -> tuple[list[IntArray], list[Array]]:
        """Pairs of every front, and its matrix before those below are added.

        A pair is in the front that eliminates the first of its poses.
        """
        earlier = np.where(rank[self.i] < rank[self.j], self.i, self.j)
        front = number[earlier]
        by_front = np.argsort(front, kind="stable")
        ends = np.searchsorted(front[by_front], np.arange(len(rows) + 1))
        pairs_of: list[IntArray] = [by_front[ends[a] : ends[a + 1]] for a in range(len(rows))]
        place = np.empty(len(rank), dtype=np.int64)
        place_i = np.empty_like(front)
        place_j = np.empty_like(front)
        for poses, pairs in zip(rows, pairs_of, strict=True):
            place[poses] = np.arange(len(poses))
            place_i[pairs] = place[self.i[pairs]]
            place_j[pairs] = place[self.j[pairs]]
        # All entries of all matrices are summed up at once, one matrix after the other.
        side = np.array([self.width * len(poses) for poses in rows])
        start = np.append(0, np.cumsum(side**2))
        row_i = _entries(place_i, self.width)
        row_j = _entries(place_j, self.width)
        begin = start[front][:, None, None]
        side_of_pair = side[front][:, None, None]
        entries = []
        for row, column in ((row_i, row_i), (row_j, row_j), (row_i, row_j), (row_j, row_i)):
            entries.append(begin + row[:, :, None] * side_of_pair + column[:, None, :])
        times_i = np.where(self.poses[self.i] == 0, 2.0, 1.0)[:, None, None]
        times_j = np.where(self.poses[self.j] == 0, 2.0, 1.0)[:, None, None]
        values = np.stack([times_i * stiffness, times_j * stiffness, -stiffness, -stiffness])
        all_entries = np.stack(entries).ravel()
        sums = np.bincount(all_entries, weights=values.ravel(), minlength=int(start[-1]))
        parts: list[Any] = np.split(sums, start[1:-1])
        return pairs_of, [part.reshape(size, size) for part, size in zip(parts, side, strict=True)]


def _rows_of(front: _Symbolic, rank: IntArray) -> IntArray:
    """Poses of a front: the eliminated ones, then its boundary in the order of elimination."""
    boundary = np.array(front.boundary, dtype=np.int64)
    boundary = boundary[np.argsort(rank[boundary])]
    return np.concatenate([np.array(front.eliminated, dtype=np.int64), boundary])


def _entries(places: IntArray, width: int) -> IntArray:
    """Rows (p, k) of the blocks at some places, (p,)."""
    return width * places[:, None] + np.arange(width)


def _add(complement: Array, H: Array, rows: IntArray) -> None:
    """Add a matrix to the same rows and columns of a contiguous one, by places in its memory.

    This takes less than half the time of `H[np.ix_(rows, rows)] += complement`.
    """
    entries = H.reshape(-1)
    places = (len(H) * rows[:, None] + rows).ravel()
    entries[places] = entries.take(places) + complement.ravel()


def _eliminate_first(H: Array, size: int) -> tuple[Array, Array, Array]:
    """P, W and the Schur complement of a front that eliminates its first rows."""
    L, failed = dpotrf(H[:size, :size], lower=1)
    if failed:
        raise NotPositiveDefiniteError(
            "a front of the elimination tree is not positive definite; check the weights"
        )
    P = np.ascontiguousarray(dtrtri(L, lower=1)[0])
    W = P @ H[:size, size:]
    return P, W, H[size:, size:] - W.T @ W


def _joined(below: _Symbolic, above: _Symbolic) -> _Symbolic:
    """A front and the one above it as one."""
    eliminated = below.eliminated + above.eliminated
    return _Symbolic(eliminated, above.boundary, below.num_blocks + above.num_blocks)
