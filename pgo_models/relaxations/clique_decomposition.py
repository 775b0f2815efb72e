"""The semidefinite relaxation of a sparse graph over the cliques of a chordal extension.

Every clique C of `pgo_models.relaxations.clique_tree` has a Gram matrix W_C of its own. With r its
first pose among those it shares with its parent, and centre poses c_i = (R^_i, t^_i) near the
optimum, the lifted vectors of W_C are

    P_r,   sigma (P_u - P_r),   sigma_t (t_u - t_r - P_r (t^_u - t^_r))   for every other u in C,

with P_i = R_i R^_i^T. So W_C holds deviations from the centre, scaled to order one, and F is the
sum of <H_C, W_C> without the cancellation of tr(M Z), where entries of order kappa ||t||^2 leave a
small F. The centre changes the coordinates, not the relaxation: its optimum is that of
`primal_relaxation` whatever the centre is.

A partial matrix on a chordal pattern has a PSD completion when its cliques are PSD (Grone et al.
1984), so nothing is lost; and only differences of translations occur, so that none has to be
grounded.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cvxpy as cp
import numpy as np
from scipy.sparse import coo_array, csr_array

from pgo_models.convex.convex_solver import HoldsModel
from pgo_models.geometry.arrays import triangle_places
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from pgo_models.relaxations.clique_tree import CliqueTree, build_clique_tree, clique_side
from pgo_models.relaxations.rounding import RankReport, rank_report

# Least scale of the objective, times the mean diagonal of L: noise-free graphs have F near zero.
_LEAST_SCALE = 1e-6


@dataclass(frozen=True, eq=False)
class CliqueRelaxation(HoldsModel):
    """min sum_C <H_C, W_C> such that every W_C is PSD, separators agree, and R_i^T R_i = I.

    Parameters
    ----------
    problem : PGOProblem
        The problem that is relaxed.
    tree : CliqueTree
        The cliques.
    centre : Poses
        Poses near the optimum, from which deviations are taken.
    model : cp.Problem
        Its value times `scale` is that of the relaxation.
    upper : tuple of cp.Variable
        Upper triangle of every W_C, row by row.
    equalities : cp.Constraint
        A w = b for w all of these triangles, clique after clique: R_i^T R_i = I and agreement on
        separators. Its dual gives Lambda.
    scale : float
        Of the objective: F at the centre, or for noise-free graphs a share of L.
    """

    problem: PGOProblem
    tree: CliqueTree
    centre: Poses
    model: cp.Problem
    upper: tuple[cp.Variable, ...]
    equalities: cp.Constraint
    scale: float
    _layout: "_Layout"
    _to_Lambda: csr_array

    def W(self, k: int) -> Array:
        """W_C of clique k, (side, side), as solved."""
        triangle = self.upper[k].value
        places = triangle_places(self._layout.sides[k])
        return np.asarray(triangle[places])

    def Lambda(self) -> Array:
        """Multipliers of R_i^T R_i = I, (n, d, d).

        Every equality of the model is a combination of the constraints P_u^T P_u = I; cvxpy's dual
        has the other sign.
        """
        n = self.problem.num_poses
        d = self.problem.d
        R = self.centre.R
        R_inverse = np.swapaxes(R, 1, 2)
        multipliers = -self.scale * self.equalities.dual_value
        centred = (self._to_Lambda @ multipliers).reshape(n, d, d)
        return np.asarray(R_inverse @ centred @ R)

    def rounded(self) -> tuple[Poses, RankReport]:
        """Rounded poses, and the rank report of the clique that is farthest from rank d."""
        R = self._rounded_rotations()
        poses = self.problem.with_best_translations(R)
        reports = []
        for k in range(len(self.tree.cliques)):
            gram = self._layout.gram(k, self.W(k))
            reports.append(rank_report(gram, self.problem.d))
        farthest = max(reports, key=lambda report: report.tightness)
        return poses, farthest

    def _rounded_rotations(self) -> Array:
        """Pass the relative rotations of the cliques down the tree.

        In clique C, P_r^T P_u = I + W_ru / sigma, which is projected to SO(d).
        """
        n = self.problem.num_poses
        d = self.problem.d
        layout = self._layout
        identity = np.eye(d)
        P = np.broadcast_to(identity, (n, d, d)).copy()
        for k in range(len(self.tree.cliques)):
            W = self.W(k)
            reference = layout.reference[k]
            for u, column in layout.columns[k].items():
                if layout.home[u] == k:
                    W_ru = W[:d, column : column + d]
                    relative = identity + W_ru / layout.sigma
                    (projected,) = project_to_rotations(relative[None])
                    P[u] = P[reference] @ projected
        return project_to_rotations(P @ self.centre.R)


def clique_relaxation(
    problem: PGOProblem, centre: Poses | None = None, tree: CliqueTree | None = None
) -> CliqueRelaxation:
    """Pose the relaxation over cliques.

    Unless given, the centre is the chordal start, and the tree is
    `build_clique_tree(problem.graph)`. A centre far from the optimum costs digits and iterations.
    Fukuda, Kojima, Murota & Nakata, 2001; Vandenberghe & Andersen 2015, chapter 14.
    """
    if tree is None:
        tree = build_clique_tree(problem.graph)
    if centre is None:
        centre = chordal_start(problem)
    layout = _Layout.of(problem, tree, centre)
    mean_diagonal = float(problem.L.diagonal().mean())
    least_scale = _LEAST_SCALE * mean_diagonal
    scale = max(problem.objective(centre), least_scale)
    equations = _Equations(layout)
    _add_orthogonality(equations)
    _add_agreement(equations)
    A, b = equations.matrix()
    upper = []
    cones = []
    for k, side in enumerate(layout.sides):
        num_entries = side * (side + 1) // 2
        w_k = cp.Variable(num_entries, name=f"W_{k}")
        W_k = w_k[triangle_places(side)]
        upper.append(w_k)
        cones.append(W_k >> 0)
    w = cp.hstack(upper)
    equalities = A @ w == b
    costs = _costs(layout) / scale
    objective = cp.Minimize(costs @ w)
    model = cp.Problem(objective, [equalities, *cones])
    return CliqueRelaxation(
        problem=problem,
        tree=tree,
        centre=centre,
        model=model,
        upper=tuple(upper),
        equalities=equalities,
        scale=scale,
        _layout=layout,
        _to_Lambda=equations.to_Lambda(),
    )


@dataclass(frozen=True, eq=False)
class _Layout:
    """The positions of the lifted vectors in every clique.

    A coefficient array, (side, k), says how k vectors are combined from the lifted vectors of a
    clique.

    Parameters
    ----------
    problem, tree, centre
        As of `CliqueRelaxation`.
    sigma, sigma_t : float
        Scales of rotation and translation deviations: roots of the median precisions.
    reference : list of int
        r of every clique.
    columns : list of dict
        For every clique, the first column of each pose but r.
    sides : list of int
        Side of every W_C.
    offsets : list of int
        Where its upper triangle begins in w.
    num_entries : int
        Length of w.
    home : (n,) array
        The clique nearest to the root that holds a pose.
    """

    problem: PGOProblem
    tree: CliqueTree
    centre: Poses
    sigma: float
    sigma_t: float
    reference: list[int]
    columns: list[dict[int, int]]
    sides: list[int]
    offsets: list[int]
    num_entries: int
    home: IntArray

    @classmethod
    def of(cls, problem: PGOProblem, tree: CliqueTree, centre: Poses) -> "_Layout":
        d = problem.d
        graph = problem.graph
        reference = []
        columns = []
        home = np.full(problem.num_poses, -1)
        for k, clique in enumerate(tree.cliques):
            shared = tree.separator(k)
            candidates = shared if len(shared) else clique
            r = int(candidates[0])
            reference.append(r)
            others = [u for u in clique.tolist() if u != r]
            first_columns = range(d, d + (d + 1) * len(others), d + 1)
            columns.append(dict(zip(others, first_columns, strict=True)))
            is_new = home[clique] < 0
            home[clique[is_new]] = k
        sides = [clique_side(len(clique), d) for clique in tree.cliques]
        lengths = [side * (side + 1) // 2 for side in sides]
        ends = np.cumsum(lengths).tolist()
        median_kappa = np.median(graph.kappa[graph.kappa > 0])
        tau = problem.weights.tau
        median_tau = np.median(tau[tau > 0])
        return cls(
            problem,
            tree,
            centre,
            sigma=float(np.sqrt(median_kappa)),
            sigma_t=float(np.sqrt(median_tau)),
            reference=reference,
            columns=columns,
            sides=sides,
            offsets=[0, *ends[:-1]],
            num_entries=ends[-1],
            home=home,
        )

    def gram(self, k: int, W: Array) -> Array:
        """Gram matrix of the P_u of clique k, (d c_k, d c_k).

        It is the clique's part of Z, with every pose turned by its centre.
        """
        identity = np.eye(self.problem.d)
        P_r = self.reference_rotation(k, identity)
        P = [P_r]
        for u in self.columns[k]:
            P.append(P_r + self.rotation_deviation(k, u, identity))
        lifted = np.concatenate(P, axis=1)
        return np.asarray(lifted.T @ W @ lifted)

    def reference_rotation(self, k: int, A: Array) -> Array:
        """Coefficients of P_r A for A of shape (d, c)."""
        return self._placed(k, 0, A)

    def rotation_deviation(self, k: int, u: int, A: Array) -> Array:
        """Coefficients of (P_u - P_r) A."""
        column = self.columns[k].get(u)
        return self._placed(k, column, A / self.sigma)

    def translation_deviation(self, k: int, u: int) -> Array:
        """Coefficients of t_u - t_r - P_r (t^_u - t^_r)."""
        column = self.columns[k].get(u)
        row = None if column is None else column + self.problem.d
        scale = np.array([[1.0 / self.sigma_t]])
        return self._placed(k, row, scale)

    def _placed(self, k: int, first: int | None, A: Array) -> Array:
        """A in the rows of clique k from `first` on; zero for its reference, which has no rows."""
        num_columns = A.shape[1]
        coefficients = np.zeros((self.sides[k], num_columns))
        if first is not None:
            coefficients[first : first + len(A)] = A
        return coefficients


class _Equations:
    """Linear equations in w, each a sum of terms factor a^T W_C b.

    Beside the equations it collects how their multipliers add up to Lambda.
    """

    def __init__(self, layout: _Layout) -> None:
        self.layout = layout
        # Position in w of every entry of every W_C, (side, side).
        self._positions: list[IntArray] = []
        for offset, side in zip(layout.offsets, layout.sides, strict=True):
            self._positions.append(offset + triangle_places(side))
        self._rows: list[IntArray] = []
        self._columns: list[IntArray] = []
        self._values: list[Array] = []
        self._right: list[float] = []
        self._multipliers: list[tuple[int, int, float]] = []

    def add(self, terms: list[tuple[int, Array, Array, float]], right: float) -> None:
        """Sum of factor a^T W_k b over (k, a, b, factor) equals `right`."""
        equation = len(self._right)
        for k, a, b, factor in terms:
            rows = np.flatnonzero(a)
            columns = np.flatnonzero(b)
            entries = np.ix_(rows, columns)
            positions = self._positions[k][entries].ravel()
            products = np.outer(a[rows], b[columns]).ravel()
            self._rows.append(np.full(len(positions), equation))
            self._columns.append(positions)
            self._values.append(factor * products)
        self._right.append(right)

    def note_orthogonality(self, pose: int, a: int, b: int, factor: float) -> None:
        """Note that the last equation contains factor times (P^T P - I)_ab of a pose."""
        d = self.layout.problem.d
        equation = len(self._right) - 1
        for row, column in ((a, b), (b, a)):
            entry = (pose * d + row) * d + column
            self._multipliers.append((entry, equation, 0.5 * factor))

    def matrix(self) -> tuple[csr_array, Array]:
        """A and b of A w = b."""
        values = np.concatenate(self._values)
        rows = np.concatenate(self._rows)
        columns = np.concatenate(self._columns)
        shape = (len(self._right), self.layout.num_entries)
        A = coo_array((values, (rows, columns)), shape=shape)
        b = np.array(self._right)
        return csr_array(A), b

    def to_Lambda(self) -> csr_array:
        """Matrix from the multipliers of the equations to Lambda, (n d d, equations).

        Lambda is in the coordinates of the centre.
        """
        problem = self.layout.problem
        parts = zip(*self._multipliers, strict=True)
        rows, columns, values = (np.array(part) for part in parts)
        num_entries = problem.num_poses * problem.d**2
        shape = (num_entries, len(self._right))
        matrix = coo_array((values, (rows, columns)), shape=shape)
        return csr_array(matrix)


def _add_orthogonality(equations: _Equations) -> None:
    """Add P_r^T P_r = I in every clique, and the like for every other pose at its home.

    The latter is sigma (P_u^T P_u - P_r^T P_r) = 0. With D = sigma (P_u - P_r) it reads P_r^T D +
    D^T P_r + D^T D / sigma = 0.
    """
    layout = equations.layout
    sigma = layout.sigma
    d = layout.problem.d
    for k, side in enumerate(layout.sides):
        unit = np.eye(side)
        r = layout.reference[k]
        for a, b in _upper_entries(d):
            term = (k, unit[a], unit[b], 1.0)
            entry_of_identity = float(a == b)
            equations.add([term], entry_of_identity)
            equations.note_orthogonality(r, a, b, 1.0)
        for u, column in layout.columns[k].items():
            if layout.home[u] != k:
                continue
            for a, b in _upper_entries(d):
                D_a = unit[column + a]
                D_b = unit[column + b]
                terms = [
                    (k, unit[a], D_b, 1.0),
                    (k, D_a, unit[b], 1.0),
                    (k, D_a, D_b, 1.0 / sigma),
                ]
                equations.add(terms, 0.0)
                equations.note_orthogonality(u, a, b, sigma)
                equations.note_orthogonality(r, a, b, -sigma)


def _add_agreement(equations: _Equations) -> None:
    """Add that the lifted vectors of a separator have the same Gram matrix in clique and parent."""
    layout = equations.layout
    d = layout.problem.d
    for k in range(1, len(layout.tree.cliques)):
        parent = int(layout.tree.parent[k])
        columns, in_parent = _separator_vectors(layout, k, parent)
        unit = np.eye(layout.sides[k])
        for a, b in _upper_entries(len(columns)):
            if b < d:  # P_r^T P_r = I is an equation of its own
                continue
            unit_a = unit[columns[a]]
            unit_b = unit[columns[b]]
            in_clique = (k, unit_a, unit_b, 1.0)
            minus_in_parent = (parent, in_parent[:, a], in_parent[:, b], -1.0)
            equations.add([in_clique, minus_in_parent], 0.0)


def _separator_vectors(layout: _Layout, k: int, parent: int) -> tuple[list[int], Array]:
    """The lifted vectors of a separator: their columns in clique k, coefficients in its parent."""
    t = layout.centre.t
    d = layout.problem.d
    identity = np.eye(d)
    r = layout.reference[k]
    # In the parent P_r itself is a deviation from the parent's reference.
    P_r_deviation = layout.rotation_deviation(parent, r, identity)
    t_r_deviation = layout.translation_deviation(parent, r)
    columns = list(range(d))
    P_parent = layout.reference_rotation(parent, identity)
    in_parent = [P_parent + P_r_deviation]
    others = np.setdiff1d(layout.tree.separator(k), r)
    for u in others.tolist():
        first = layout.columns[k][u]
        columns += range(first, first + d + 1)
        P_u_deviation = layout.rotation_deviation(parent, u, identity)
        rotation = P_u_deviation - P_r_deviation
        in_parent.append(layout.sigma * rotation)
        t_u_deviation = layout.translation_deviation(parent, u)
        shift = (t[u] - t[r])[:, None]
        turned = P_r_deviation @ shift
        translation = t_u_deviation - t_r_deviation - turned
        in_parent.append(layout.sigma_t * translation)
    return columns, np.concatenate(in_parent, axis=1)


def _costs(layout: _Layout) -> Array:
    """Coefficients of w in F.

    Every edge is counted in the clique of its two poses that is nearest to the root.
    """
    graph = layout.problem.graph
    W = layout.problem.weights.W(layout.problem.d)
    H = [np.zeros((side, side)) for side in layout.sides]
    for e in range(graph.num_edges):
        home_of_i = layout.home[graph.i[e]]
        home_of_j = layout.home[graph.j[e]]
        k = int(max(home_of_i, home_of_j))
        H[k] += _cost_of_edge(layout, k, e, W[e])
    costs = []
    for matrix in H:
        rows, columns = np.triu_indices(len(matrix))
        multiplicity = np.where(rows == columns, 1.0, 2.0)
        costs.append(multiplicity * matrix[rows, columns])
    return np.concatenate(costs)


def _cost_of_edge(layout: _Layout, k: int, e: int, W_e: Array) -> Array:
    """Matrix H, (side, side): edge e costs <H, W_C> in clique k, which has both of its poses.

    W_e, (d, d), is the weight of the rotation residual. With E = R^_i R_ij R^_j^T the residuals of
    the edge are P_j - P_i E, up to a rotation, and t_j - t_i - P_i R^_i t_ij.
    """
    problem = layout.problem
    graph = problem.graph
    i = int(graph.i[e])
    j = int(graph.j[e])
    R_i = layout.centre.R[i]
    R_j = layout.centre.R[j]
    identity = np.eye(problem.d)
    E = R_i @ graph.R_ij[e] @ R_j.T
    P_j_deviation = layout.rotation_deviation(k, j, identity)
    P_i_deviation = layout.rotation_deviation(k, i, E)
    rotation = layout.reference_rotation(k, identity - E)
    rotation += P_j_deviation - P_i_deviation
    shift = (layout.centre.t[j] - layout.centre.t[i])[:, None]
    offset = problem.weights.seen_offsets(graph.t_ij[e])
    step = (R_i @ offset)[:, None]
    t_j_deviation = layout.translation_deviation(k, j)
    t_i_deviation = layout.translation_deviation(k, i)
    translation = layout.reference_rotation(k, shift - step)
    translation += t_j_deviation - t_i_deviation
    translation -= layout.rotation_deviation(k, i, step)
    rotation_cost = rotation @ (R_j @ W_e @ R_j.T) @ rotation.T
    translation_cost = problem.weights.tau[e] * translation @ translation.T
    return np.asarray(rotation_cost + translation_cost)


def _upper_entries(side: int) -> Iterator[tuple[int, int]]:
    """Indices (a, b) of the upper triangle of a matrix, row by row."""
    return ((a, b) for a in range(side) for b in range(a, side))
