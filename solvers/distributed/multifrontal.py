"""The driver's matrix, eliminated in a tree of groups of robots: dense fronts, the multifrontal method (Liu 1992).

Recursive bisection of the robot adjacency graph, by how many separators robots share. A separator pose is eliminated at
the smallest group that holds every robot which touches it: no dense matrix over all separators is formed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cholesky, solve_triangular
from scipy.sparse import csr_array

from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray

_SPECTRAL = 300  # robots; more are halved in their order
_AT_WORK = 4.25  # times a front: itself, and copies of what is added to it or split off from it


@dataclass(frozen=True, eq=False)
class Front:
    """One group of robots."""

    robots: tuple[int, ...]  # whose contributions are added here: one robot at a leaf, none above
    children: tuple[int, ...]  # earlier fronts, whose Schur complements are added here
    # eliminated, boundary: (e,), (b,); separators that only this group touches and that no child has eliminated; those
    # left to groups above.
    eliminated: IntArray
    boundary: IntArray

    @property
    def poses(self) -> IntArray:
        """Rows of the front: eliminated, then boundary."""
        return np.concatenate([self.eliminated, self.boundary])


def separator_tree(touched: Sequence[IntArray], num_separators: int) -> tuple[Front, ...]:
    """Fronts in an order in which children come first; the last one holds all robots.

    `touched` are the separators, 0 .. num_separators - 1, that every robot touches, (g_a,) each.
    """
    robot = np.repeat(np.arange(len(touched)), [len(poses) for poses in touched])
    pose = np.concatenate([*touched, np.zeros(0, dtype=np.int64)])
    touches = csr_array((np.ones(len(pose)), (robot, pose)), shape=(len(touched), num_separators))
    shared = (touches @ touches.T).toarray()
    left_to_touch = np.bincount(pose, minlength=num_separators)
    fronts: list[Front] = []

    def grow(group: IntArray) -> tuple[int, IntArray, IntArray]:
        """Front of a group: its number, the separators it leaves, and how many of the group touch each."""
        if len(group) == 1:
            poses, counts = touched[group[0]], np.ones(len(touched[group[0]]), dtype=np.int64)
            members, children = [int(group[0])], []
        else:
            grown = [grow(half) for half in _halves(group, shared)]
            members, children = [], [number for number, _, _ in grown]
            poses, place = np.unique(np.concatenate([left for _, left, _ in grown]), return_inverse=True)
            counts = np.bincount(place, weights=np.concatenate([count for _, _, count in grown])).astype(np.int64)
        is_inside = counts == left_to_touch[poses]
        fronts.append(Front(tuple(members), tuple(children), poses[is_inside], poses[~is_inside]))
        return len(fronts) - 1, poses[~is_inside], counts[~is_inside]

    if touched:
        grow(np.arange(len(touched)))
    return tuple(fronts)


def _halves(group: IntArray, shared: Array) -> tuple[IntArray, IntArray]:
    """Two halves of a group that share few separators: by the Fiedler vector of who shares with whom."""
    middle = len(group) // 2
    if not 2 < len(group) <= _SPECTRAL:
        return group[:middle], group[middle:]
    weight = shared[np.ix_(group, group)]
    np.fill_diagonal(weight, 0.0)
    fiedler = np.linalg.eigh(np.diag(weight.sum(axis=0)) - weight)[1][:, 1]
    order = np.lexsort((group, np.round(fiedler, 9)))
    return np.sort(group[order[:middle]]), np.sort(group[order[middle:]])


def tree_bytes(tree: Sequence[Front], width: int) -> int:
    """Largest memory while a matrix with `width` unknowns a separator is factored, bytes: factor and fronts."""
    kept = waiting = 0
    most = 0.0
    for front in tree:
        e, b = len(front.eliminated), len(front.boundary)
        most = max(most, kept + waiting + _AT_WORK * (e + b) ** 2)
        waiting += b**2 - sum(len(tree[child].boundary) ** 2 for child in front.children)
        kept += e * (e + b)
    return int(8 * width**2 * most)


@dataclass(frozen=True, eq=False)
class TreeFactor:
    """Cholesky factor, a pair (L_EE, L_BE) for every front, E its eliminated and B its boundary unknowns."""

    tree: tuple[Front, ...]
    width: int
    blocks: tuple[tuple[Array, Array], ...]

    def solve(self, b: Array) -> Array:
        """Solution x, (side, k), for b whose rows are separator by separator."""
        x = np.array(b, dtype=float)
        rows = [(_rows(f.eliminated, self.width), _rows(f.boundary, self.width)) for f in self.tree]
        for (eliminated, boundary), (L_EE, L_BE) in zip(rows, self.blocks, strict=True):
            if len(eliminated):
                x[eliminated] = solve_triangular(L_EE, x[eliminated], lower=True, check_finite=False)
                x[boundary] -= L_BE @ x[eliminated]
        for (eliminated, boundary), (L_EE, L_BE) in zip(reversed(rows), reversed(self.blocks), strict=True):
            if len(eliminated):
                known = x[eliminated] - L_BE.T @ x[boundary]
                x[eliminated] = solve_triangular(L_EE, known, lower=True, trans="T", check_finite=False)
        return x


def factorize_tree(tree: tuple[Front, ...], width: int, contribution: Callable[[int], Array], own: Array) -> TreeFactor:
    """Factor the sum of the robots' contributions and of diagonal blocks, for `width` unknowns a separator.

    `contribution` gives the matrix of a robot, (width g_a, width g_a), its rows separator by separator, ascending;
    `own`, (num_separators, width, width), are diagonal blocks that are added. A NotPositiveDefiniteError when the sum
    is not positive definite.
    """
    schur: dict[int, Array] = {}
    blocks = []
    for number, front in enumerate(tree):
        poses = front.poses
        ascending = np.argsort(poses)
        F = np.zeros((width * len(poses), width * len(poses)))
        for robot in front.robots:
            rows = _rows(ascending, width)
            F[np.ix_(rows, rows)] += contribution(robot)
        for child in front.children:
            rows = _rows(ascending[np.searchsorted(poses, tree[child].boundary, sorter=ascending)], width)
            F[np.ix_(rows, rows)] += schur.pop(child)
        e = width * len(front.eliminated)
        inside = np.arange(e).reshape(-1, width)
        F[inside[:, :, None], inside[:, None, :]] += own[front.eliminated]
        if e:
            L_EE = _cholesky(F[:e, :e])
            L_BE = np.ascontiguousarray(solve_triangular(L_EE, F[e:, :e].T, lower=True, check_finite=False).T)
            schur[number] = F[e:, e:] - L_BE @ L_BE.T
        else:
            L_EE, L_BE = np.zeros((0, 0)), np.zeros((len(F), 0))
            schur[number] = F
        blocks.append((L_EE, L_BE))
        del F  # before the next front is allocated
    return TreeFactor(tree, width, tuple(blocks))


def tree_counts(tree: Sequence[Front], width: int, num_separators: int) -> tuple[IntArray, int]:
    """Terms that are summed for an entry in the column of a separator, at most, (num_separators,); most in a row of R.

    Eliminated unknowns of every front that the separator is in, and one for every addition of a front.
    """
    in_column, most = np.zeros(num_separators, dtype=np.int64), 0
    for front in tree:
        in_column[front.poses] += width * len(front.eliminated) + 1
        most = max(most, width * len(front.poses))
    return in_column, most


def _rows(poses: IntArray, width: int) -> IntArray:
    return (width * poses[:, None] + np.arange(width)).ravel()


def _cholesky(matrix: Array) -> Array:
    if not np.isfinite(matrix).all():
        raise NotPositiveDefiniteError("the matrix has nan or inf; check the weights and measurements")
    try:
        return np.asarray(cholesky(matrix, lower=True, check_finite=False))
    except LinAlgError as error:
        raise NotPositiveDefiniteError("the matrix has a pivot that is not positive") from error
