"""The semidefinite relaxation of a sparse graph over the cliques of a chordal extension, in well-scaled coordinates.

Every clique C of `pgo_models.relaxations.clique_tree` has a Gram matrix W_C of its own. With r its first pose among
those it shares with its parent, and centre poses c_i = (R^_i, t^_i) near the optimum, the lifted vectors of W_C are

    P_r,     sigma (P_u - P_r),     sigma_t (t_u - t_r - P_r (t^_u - t^_r))     for every other u in C,

with P_i = R_i R^_i^T. So W_C holds deviations from the centre, scaled to order one, and F is the sum of <H_C, W_C>
without the cancellation of tr(M Z), where entries of order kappa ||t||^2 leave a small F. The centre changes the
coordinates, not the relaxation: its optimum is that of `primal_relaxation` whatever the centre is.

A partial matrix on a chordal pattern has a PSD completion when its cliques are PSD (Grone et al. 1984), so nothing is
lost; and only differences of translations occur, so that none has to be grounded.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cvxpy as cp
import numpy as np
from scipy.sparse import coo_array, csr_array

from pgo_models.certificates.newton_polish import polish
from pgo_models.geometry.arrays import triangle_places
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from pgo_models.relaxations.clique_tree import CliqueTree, build_clique_tree, clique_side
from pgo_models.relaxations.rounding import RankReport, rank_report

_LEAST_SCALE = 1e-6  # of the mean diagonal of L: noise-free graphs have F near zero


@dataclass(frozen=True, eq=False)
class CliqueRelaxation:
    """min sum_C <H_C, W_C> such that every W_C is PSD, separators agree, and R_i^T R_i = I."""

    problem: PGOProblem
    tree: CliqueTree
    centre: Poses
    model: cp.Problem  # its value times `scale` is that of the relaxation
    upper: tuple[cp.Variable, ...]  # upper triangle of every W_C, row by row
    # A w = b for w all of these, clique after clique: R_i^T R_i = I and agreement on separators; its dual gives Lambda.
    equalities: cp.Constraint
    scale: float  # of the objective: F at the centre, or for noise-free graphs a share of L
    _layout: "_Layout"
    _to_Lambda: csr_array

    def W(self, k: int) -> Array:
        """W_C of clique k, (side, side), as solved."""
        return np.asarray(self.upper[k].value[triangle_places(self._layout.sides[k])])

    def Lambda(self) -> Array:
        """Multipliers of R_i^T R_i = I, (n, d, d).

        Every equality of the model is a combination of the constraints P_u^T P_u = I; cvxpy's dual has the other sign.
        """
        n, d, R = self.problem.num_poses, self.problem.d, self.centre.R
        centred = (self._to_Lambda @ (-self.scale * self.equalities.dual_value)).reshape(n, d, d)
        return np.asarray(np.swapaxes(R, 1, 2) @ centred @ R)

    def rounded(self) -> tuple[Poses, RankReport]:
        """Poses by passing the relative rotations of the cliques down the tree, with the worst clique's rank report.

        In clique C, P_r^T P_u = I + W_ru / sigma, which is projected to SO(d).
        """
        n, d, layout = self.problem.num_poses, self.problem.d, self._layout
        P = np.broadcast_to(np.eye(d), (n, d, d)).copy()
        worst: RankReport | None = None
        for k in range(len(self.tree.cliques)):
            W, reference = self.W(k), layout.reference[k]
            for u, column in layout.columns[k].items():
                if layout.home[u] == k:
                    relative = np.eye(d) + W[:d, column : column + d] / layout.sigma
                    P[u] = P[reference] @ project_to_rotations(relative[None])[0]
            report = rank_report(layout.gram(k, W), d)
            worst = report if worst is None or report.tightness > worst.tightness else worst
        assert worst is not None
        return self.problem.with_best_translations(project_to_rotations(P @ self.centre.R)), worst


def clique_relaxation(
    problem: PGOProblem, centre: Poses | None = None, tree: CliqueTree | None = None
) -> CliqueRelaxation:
    """Pose the relaxation over cliques (Fukuda, Kojima, Murota & Nakata, 2001; Vandenberghe & Andersen 2015, ch. 14).

    Unless given, the centre is the stationary point that the chordal start polishes to, and the tree is
    `build_clique_tree(problem.graph)`. A centre far from the optimum costs digits.
    """
    tree = tree if tree is not None else build_clique_tree(problem.graph)
    centre = centre if centre is not None else polish(problem, chordal_start(problem))
    layout = _Layout.of(problem, tree, centre)
    scale = max(problem.objective(centre), _LEAST_SCALE * float(problem.L.diagonal().mean()))
    equations = _Equations(layout)
    _orthogonality(equations)
    _agreement(equations)
    A, b = equations.matrix()
    upper = tuple(cp.Variable(side * (side + 1) // 2, name=f"W_{k}") for k, side in enumerate(layout.sides))
    blocks = tuple(w_k[triangle_places(side)] >> 0 for side, w_k in zip(layout.sides, upper, strict=True))
    w = cp.hstack(upper)
    agree = A @ w == b
    model, to_Lambda = cp.Problem(cp.Minimize((_costs(layout) / scale) @ w), [agree, *blocks]), equations.to_Lambda()
    return CliqueRelaxation(problem, tree, centre, model, upper, agree, scale, layout, to_Lambda)


@dataclass(frozen=True, eq=False)
class _Layout:
    """Where the lifted vectors of every clique stand.

    A coefficient array, (side, k), says how k lifted vectors are combined from those of a clique.
    """

    problem: PGOProblem
    tree: CliqueTree
    centre: Poses
    # sigma, sigma_t: scales of rotation and translation deviations: roots of the median precisions.
    sigma: float
    sigma_t: float
    reference: list[int]  # r of every clique
    columns: list[dict[int, int]]  # first column of every other pose
    # sides, offsets: side of W_C, and where its upper triangle begins in w.
    sides: list[int]
    offsets: list[int]
    num_entries: int
    home: IntArray  # (n,): the clique nearest to the root that holds a pose

    @classmethod
    def of(cls, problem: PGOProblem, tree: CliqueTree, centre: Poses) -> "_Layout":
        d, graph = problem.d, problem.graph
        reference, columns = [], []
        home = np.full(problem.num_poses, -1)
        for k, clique in enumerate(tree.cliques):
            shared = tree.separator(k)
            r = int(shared[0]) if len(shared) else int(clique[0])
            reference.append(r)
            others = [u for u in clique.tolist() if u != r]
            columns.append({u: d + (d + 1) * place for place, u in enumerate(others)})
            home[clique[home[clique] < 0]] = k
        sides = [clique_side(len(clique), d) for clique in tree.cliques]
        lengths = [side * (side + 1) // 2 for side in sides]
        offsets = np.concatenate([[0], np.cumsum(lengths)]).tolist()
        sigma = float(np.sqrt(np.median(graph.kappa[graph.kappa > 0])))
        sigma_t = float(np.sqrt(np.median(graph.tau[graph.tau > 0])))
        ends = offsets[:-1], offsets[-1]
        return cls(problem, tree, centre, sigma, sigma_t, reference, columns, sides, *ends, home)

    def gram(self, k: int, W: Array) -> Array:
        """Gram matrix of the P_u of clique k, (d c_k, d c_k): the clique's part of Z but for a turn of every pose."""
        eye = np.eye(self.problem.d)
        P = [self.reference_rotation(k, eye) + self.rotation_deviation(k, u, eye) for u in self.columns[k]]
        lifted = np.concatenate([self.reference_rotation(k, eye), *P], axis=1)
        return np.asarray(lifted.T @ W @ lifted)

    def reference_rotation(self, k: int, A: Array) -> Array:
        """P_r A for A of shape (d, c)."""
        return self._placed(k, 0, A)

    def rotation_deviation(self, k: int, u: int, A: Array) -> Array:
        """(P_u - P_r) A."""
        return self._placed(k, self.columns[k].get(u), A / self.sigma)

    def translation_deviation(self, k: int, u: int) -> Array:
        """t_u - t_r - P_r (t^_u - t^_r)."""
        column = self.columns[k].get(u)
        return self._placed(k, None if column is None else column + self.problem.d, np.array([[1.0 / self.sigma_t]]))

    def _placed(self, k: int, first: int | None, A: Array) -> Array:
        """A in the rows of clique k from `first` on; zero for its reference, which has none."""
        coefficients = np.zeros((self.sides[k], A.shape[1]))
        if first is not None:
            coefficients[first : first + len(A)] = A
        return coefficients


class _Equations:
    """Linear equations in w, each a sum of terms factor a^T W_C b, and what their multipliers say of Lambda."""

    def __init__(self, layout: _Layout) -> None:
        self.layout = layout
        # Place in w of every entry of every W_C, (side, side).
        places = zip(layout.offsets, layout.sides, strict=True)
        self._positions = [first + triangle_places(side) for first, side in places]
        self._rows: list[IntArray] = []
        self._columns: list[IntArray] = []
        self._values: list[Array] = []
        self._right: list[float] = []
        self._multipliers: list[tuple[int, int, float]] = []

    def add(self, terms: list[tuple[int, Array, Array, float]], right: float) -> None:
        """Sum of factor a^T W_k b over (k, a, b, factor) equals `right`."""
        for k, a, b, factor in terms:
            rows, columns = np.flatnonzero(a), np.flatnonzero(b)
            place = self._positions[k][np.ix_(rows, columns)].ravel()
            self._rows.append(np.full(len(place), len(self._right)))
            self._columns.append(place)
            self._values.append(factor * np.outer(a[rows], b[columns]).ravel())
        self._right.append(right)

    def last_is(self, pose: int, a: int, b: int, factor: float) -> None:
        """The last equation contains factor times (P^T P - I)_ab of a pose."""
        d = self.layout.problem.d
        for row, column in ((a, b), (b, a)):
            self._multipliers.append(((pose * d + row) * d + column, len(self._right) - 1, 0.5 * factor))

    def matrix(self) -> tuple[csr_array, Array]:
        """A and b of A w = b."""
        entries = (np.concatenate(self._rows), np.concatenate(self._columns))
        shape = (len(self._right), self.layout.num_entries)
        return csr_array(coo_array((np.concatenate(self._values), entries), shape=shape)), np.array(self._right)

    def to_Lambda(self) -> csr_array:
        """Multipliers of the equations to Lambda in the coordinates of the centre, (n d d, equations)."""
        rows, columns, values = (np.array(part) for part in zip(*self._multipliers, strict=True))
        shape = (self.layout.problem.num_poses * self.layout.problem.d**2, len(self._right))
        return csr_array(coo_array((values, (rows, columns)), shape=shape))


def _orthogonality(equations: _Equations) -> None:
    """P_r^T P_r = I in every clique, and sigma (P_u^T P_u - P_r^T P_r) = 0 for every other pose at its home."""
    layout, d = equations.layout, equations.layout.problem.d
    for k, side in enumerate(layout.sides):
        unit, r = np.eye(side), layout.reference[k]
        for a, b in _upper(d):
            equations.add([(k, unit[a], unit[b], 1.0)], float(a == b))
            equations.last_is(r, a, b, 1.0)
        for u, column in layout.columns[k].items():
            if layout.home[u] != k:
                continue
            for a, b in _upper(d):
                first, second, share = unit[column + a], unit[column + b], 1.0 / layout.sigma
                equations.add([(k, unit[a], second, 1.0), (k, first, unit[b], 1.0), (k, first, second, share)], 0.0)
                equations.last_is(u, a, b, layout.sigma)
                equations.last_is(r, a, b, -layout.sigma)


def _agreement(equations: _Equations) -> None:
    """The lifted vectors of a separator have the same Gram matrix in the clique and in its parent."""
    layout, tree, t = equations.layout, equations.layout.tree, equations.layout.centre.t
    d, sigma, sigma_t = layout.problem.d, layout.sigma, layout.sigma_t
    for k in range(1, len(tree.cliques)):
        parent, r = int(tree.parent[k]), layout.reference[k]
        to_reference = layout.rotation_deviation(parent, r, np.eye(d))
        mine = list(range(d))
        theirs = [layout.reference_rotation(parent, np.eye(d)) + to_reference]
        for u in np.setdiff1d(tree.separator(k), r).tolist():
            mine += range(layout.columns[k][u], layout.columns[k][u] + d + 1)
            theirs.append(sigma * (layout.rotation_deviation(parent, u, np.eye(d)) - to_reference))
            turned = to_reference @ (t[u] - t[r])[:, None]
            moved = layout.translation_deviation(parent, u) - layout.translation_deviation(parent, r)
            theirs.append(sigma_t * (moved - turned))
        T, unit = np.concatenate(theirs, axis=1), np.eye(layout.sides[k])
        for a, b in _upper(len(mine)):
            if b >= d:  # P_r^T P_r = I is an equation of its own
                terms = [(k, unit[mine[a]], unit[mine[b]], 1.0), (parent, T[:, a], T[:, b], -1.0)]
                equations.add(terms, 0.0)


def _costs(layout: _Layout) -> Array:
    """Coefficients of w in F: every edge in the clique of its two poses that is nearest to the root.

    With E = R^_i R_ij R^_j^T the residuals of an edge are P_j - P_i E, up to a rotation, and t_j - t_i - P_i R^_i t_ij.
    """
    graph, R, t, d = layout.problem.graph, layout.centre.R, layout.centre.t, layout.problem.d
    weights, W = layout.problem.weights, layout.problem.weights.W(layout.problem.d)
    H = [np.zeros((side, side)) for side in layout.sides]
    for e in range(graph.num_edges):
        i, j = int(graph.i[e]), int(graph.j[e])
        k = int(max(layout.home[i], layout.home[j]))
        E, step = R[i] @ graph.R_ij[e] @ R[j].T, (R[i] @ graph.t_ij[e])[:, None]
        rotation = layout.reference_rotation(k, np.eye(d) - E)
        rotation += layout.rotation_deviation(k, j, np.eye(d)) - layout.rotation_deviation(k, i, E)
        translation = layout.reference_rotation(k, (t[j] - t[i])[:, None] - step)
        translation += layout.translation_deviation(k, j) - layout.translation_deviation(k, i)
        translation -= layout.rotation_deviation(k, i, step)
        H[k] += rotation @ (R[j] @ W[e] @ R[j].T) @ rotation.T + weights.tau[e] * translation @ translation.T
    costs = []
    for matrix in H:
        rows, columns = np.triu_indices(len(matrix))
        costs.append(np.where(rows == columns, 1.0, 2.0) * matrix[rows, columns])
    return np.concatenate(costs)


def _upper(side: int) -> Iterator[tuple[int, int]]:
    return ((a, b) for a in range(side) for b in range(a, side))
