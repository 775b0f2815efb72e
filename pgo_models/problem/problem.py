"""PGOProblem: the cost of a pose graph with its gradients, matrices and exact translations.

The cost is equation (16) of the paper, weighted, or chi2 of information matrices.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
from scipy.sparse import csc_array, csr_array

from pgo_models.errors import GraphError, SettingError, check_settings
from pgo_models.geometry.arrays import ReadOnly, read_only
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, stack_transposes, vee
from pgo_models.graphs.free_directions import with_free_directions_held
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.graphs.precisions import edge_precisions, partial_edges, proper_information
from pgo_models.graphs.residuals import check_poses
from pgo_models.problem import matrices
from pgo_models.problem.cholesky import (
    CholeskyBackend,
    CholeskyFactor,
    SymbolicCholesky,
    analyze,
)
from pgo_models.problem.costs import EdgeCost, EdgePoint, TangentCost, rotation_cost
from pgo_models.problem.incidence import Incidence
from pgo_models.problem.ordering import most_counts, pose_order, row_order
from pgo_models.problem.right_costs import RightCosts
from pgo_models.problem.translations import TranslationLaplacian, TranslationSystem
from pgo_models.problem.weighting import (
    Weighting,
    convex_cost,
    information_cost,
    name_of_cost,
    own_weighting,
)

# Share of the largest entries that is added where a matrix may be singular because edges do not
# measure every direction. It shortens steps along these directions, and hardly any other.
LEAST_STIFFNESS = 1e-9


@dataclass(frozen=True, eq=False)
class PGOProblem(ReadOnly):
    """Minimise a cost of the edges, F or chi2, over the poses of a graph, SE(d)^n.

    F(R, t) = sum_e kappa ||R_j - R_i R_ij||_F^2 + tau ||t_j - t_i - R_i t_ij||^2. With X, (N, d), N
    = (d+1) n, the rows t_i and then the rows of every R_i^T, F = tr(X^T M X).

    The cost of a graph with information matrices is their chi2, unless `Weighting.ISOTROPIC` asks
    for F. chi2 is quadratic in X, too, where all matrices of translations are multiples of the
    identity and nothing couples them with rotations; else M is the quadratic part, and `tangent_at`
    gives quadratic problems that touch chi2 from below (`problem.excess`).

    Parameters
    ----------
    graph : PoseGraph
        A connected graph, whose precisions kappa and tau are those of F. The paper's equation is
        that of `graph.unit_weights()`.
    backend : CholeskyBackend, optional
        The sparse Cholesky to use; `default_backend()` unless given.
    weighting : Weighting or EdgeCost
        F, chi2, the rotation part of F, or a cost of the edges; unless given the graph's own: chi2
        if it has information matrices, else F (`Weighting.OWN`).

    Raises
    ------
    GraphError
        When the graph is not connected, or of rotations alone not by measured rotations.
    SettingError
        When the backend or the weighting is none.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import circle
    >>> problem = PGOProblem(circle(np.random.default_rng(0)))
    >>> problem
    PGOProblem('circle', d=3, poses=25, edges=300)
    >>> problem.M.shape
    (100, 100)
    """

    graph: PoseGraph
    backend: CholeskyBackend | None = None
    weighting: Weighting | EdgeCost = Weighting.OWN

    _way_out = "PGOProblem(graph) makes one, and pgo_models.load(..) reads a graph"

    @classmethod
    def _from_given(cls, given: object) -> "PGOProblem | None":
        """The problem of a graph, which stands for it at the doors."""
        return PGOProblem(given) if isinstance(given, PoseGraph) else None

    def __post_init__(self) -> None:
        check_settings(self)
        if self.weighting in (Weighting.OWN, Weighting.ISOTROPIC, Weighting.INFORMATION):
            object.__setattr__(self, "graph", with_free_directions_held(self.graph))
        if self.weighting is Weighting.OWN:
            object.__setattr__(self, "weighting", own_weighting(self.graph))
        if self.weighting is Weighting.ROTATIONS:
            self.graph.check_rotations_connected()
        else:
            self.graph.check_connected()
        if self.weighting is Weighting.ISOTROPIC and not self.graph.has_translations:
            object.__setattr__(self, "weighting", Weighting.ROTATIONS)

    def __repr__(self) -> str:
        cost = ", chi2" if self.weighting is Weighting.INFORMATION else ""
        if not self.has_translations:
            cost += ", rotations alone"
        size = f"d={self.d}, poses={self.num_poses}, edges={self.graph.num_edges}"
        return f"PGOProblem({self.graph.name!r}, {size}{cost})"

    @property
    def num_poses(self) -> int:
        """Number of poses, n."""
        return self.graph.num_poses

    @property
    def d(self) -> int:
        """Dimension of space: 2 or 3."""
        return self.graph.d

    @property
    def side(self) -> int:
        """N = (d + 1) n, the rows of X."""
        return (self.d + 1) * self.num_poses

    @cached_property
    def weights(self) -> EdgeCost:
        """The cost of the edges."""
        if isinstance(self.weighting, EdgeCost):
            return self.weighting
        if self.weighting is Weighting.ISOTROPIC:
            return matrices.isotropic_weights(self.graph)
        if self.weighting is Weighting.ROTATIONS:
            kappa = self.graph.kappa
            return rotation_cost(kappa, np.zeros_like(kappa), self.d)
        return information_cost(self.graph, self.information)

    @cached_property
    def information(self) -> Array:
        """Information matrices of chi2, (m, k, k)."""
        return proper_information(self.graph)

    @property
    def has_free_directions(self) -> bool:
        """Whether nothing may measure some direction of the map."""
        return bool(self.graph.free) or self.has_partial_edges

    @cached_property
    def has_partial_edges(self) -> bool:
        """Whether chi2 has edges that do not measure every direction."""
        is_chi2 = self.weighting is Weighting.INFORMATION or self.weights.is_chi2
        return is_chi2 and bool(partial_edges(self.graph).any())

    @property
    def measured(self) -> "PGOProblem":
        """The problem without conventions for what no edge measures (`PoseGraph.free`)."""
        unheld = self.graph.unheld
        if unheld is None:
            return self
        if self.weighting is Weighting.INFORMATION:
            cost = information_cost(self.graph, unheld)
        else:
            kappa, tau = edge_precisions(unheld)
            is_held = (unheld != self.information).any(axis=(1, 2))
            kappa = np.where(is_held, kappa, self.graph.kappa)
            tau = np.where(is_held, tau, self.graph.tau)
            cost = matrices.isotropic_weights(replace(self.graph, kappa=kappa, tau=tau))
        return _SameGraph(self.graph, self.backend, cost, original=self)

    @cached_property
    def right_costs(self) -> RightCosts:
        """Distribution of what the edges cost where their errors are those of their matrices."""
        is_chi2 = self.weighting is Weighting.INFORMATION or self.weights.is_chi2
        return RightCosts.of(self.graph, self.weights, is_chi2)

    @property
    def has_translations(self) -> bool:
        """Whether translations are among the unknowns; else these are the rotations alone."""
        return self.weights.has_translations

    @property
    def cost_name(self) -> str:
        """Name of the cost, as it is printed: F or chi2, of rotations alone F(R) or chi2(R)."""
        return name_of_cost(self.weighting, self.has_translations)

    @property
    def is_quadratic(self) -> bool:
        """Whether the cost is tr(X^T M X) of X alone."""
        return self.weights.is_quadratic

    @property
    def convex_part(self) -> "PGOProblem":
        """The problem that SOC is run on: this one, if its cost is convex and quadratic in (R, t).

        Otherwise it is one with a convex quadratic cost near this one.
        """
        # Not cached: a problem that refers to itself stays in memory until a late collection.
        if self.is_quadratic and self.weights.is_convex:
            return self
        return self._convex_neighbour

    @cached_property
    def _convex_neighbour(self) -> "PGOProblem":
        cost = convex_cost(self.information, self.d)
        return _SameGraph(self.graph, self.backend, cost, original=self)

    def check_quadratic(self, method: str, convex: bool = False) -> None:
        """Raise a SettingError, with a method's name, unless the cost is quadratic in (R, t).

        With `convex` it has to be convex, too.
        """
        if not self.is_quadratic or (convex and not self.weights.is_convex):
            kind = "convex and quadratic in (R, t)" if convex else "quadratic in (R, t)"
            raise SettingError(
                f"{method} needs a cost that is {kind}, as F is, and chi2 here is not; "
                "use convex_part"
            )

    def check_positions(self, purpose: str) -> None:
        """Raise a SettingError where something needs positions of a problem of rotations alone."""
        if not self.has_translations:
            raise SettingError(
                f"{purpose} needs positions, and the unknowns are rotations alone; "
                "leave it out, and write .g2o, .tum or .json"
            )

    def tangent_at(self, poses: Poses) -> "PGOProblem":
        """Return the quadratic problem that touches the cost from below at poses.

        Its cost F(X) is at most chi2(X) for all poses, and has the value and the gradient of chi2
        at the given ones. A quadratic problem is its own tangent.
        """
        return self.at(poses).tangent

    def with_rotation_terms(self, i: IntArray, j: IntArray, R_ij: Array, W: Array) -> "PGOProblem":
        """Return the problem with terms tr(W delta_R delta_R^T), delta_R = R_j^T - R_ij^T R_i^T.

        The k terms are of pairs of poses whose blocks are in the pattern of M already. R_ij are
        rotations, and W symmetric weights of either sign, (k, d, d) both.
        """
        graph = self.graph
        ones = np.ones(len(i))
        extended = replace(
            graph,
            i=np.concatenate([graph.i, i]),
            j=np.concatenate([graph.j, j]),
            R_ij=np.concatenate([graph.R_ij, R_ij]),
            t_ij=np.concatenate([graph.t_ij, np.zeros((len(i), graph.d))]),
            kappa=np.concatenate([graph.kappa, ones]),
            tau=np.concatenate([graph.tau, ones]),
            information=None,
            unheld=None,
            initial=None,
            truth=None,
            written_error=None,
        )
        cost = self.weights.with_rotation_terms(R_ij, W)
        return _SamePattern(extended, self.backend, cost, original=self)

    # Matrices, each built when first asked for, read-only: what follows from them is kept, too.

    @cached_property
    def M(self) -> csc_array:
        """Matrix M, (N, N), of the quadratic part: F = tr(X^T M X)."""
        return read_only(matrices.joint_matrix(self.graph, self.weights))

    @cached_property
    def L(self) -> csc_array:
        """Connection Laplacian L, (dn, dn): the rotation part of F is tr(Y^T L Y).

        Y are the rows R_i^T.
        """
        return read_only(matrices.connection_laplacian(self.graph, self.weights))

    @cached_property
    def Q(self) -> Array:
        """Matrix Q, (dn, dn), dense, for small graphs: min over t of F is tr(Y^T Q Y).

        Y are the rows R_i^T.
        """
        return read_only(matrices.marginalized_matrix(self.graph, self.weights))

    @cached_property
    def A(self) -> csr_array:
        """Matrix A, ((d+1) m, N), of the residuals of all edges, A X."""
        return read_only(matrices.residual_matrix(self.graph, self.has_translations))

    @cached_property
    def A_transposed(self) -> csc_array:
        """A^T, (N, (d+1) m)."""
        return self.A.T

    @cached_property
    def residual_matrix(self) -> tuple[csr_array, Array]:
        """Rows, ((d+1) m, N), and their weights w: F = sum_rows w ||rows X||^2.

        The rows are those of A where W = kappa I. Else W = U diag(kappa) U^T: the rotation rows of
        an edge are multiplied by U^T, and their weights are its d eigenvalues.
        """
        weights = self.weights
        rows = self.A
        if not weights.is_isotropic:
            _, U = weights.eigenbasis
            rows = matrices.residual_matrix(self.graph, self.has_translations, U)
        return read_only(rows), read_only(weights.row_weights)

    @cached_property
    def analysis(self) -> SymbolicCholesky:
        """Symbolic factorisation of the pattern of M, shared by every matrix that has it."""
        if self.convex_part is not self:
            return self.convex_part.analysis
        return self._analyze()

    def _analyze(self) -> SymbolicCholesky:
        order = row_order(self.pose_order, 1, self.d)
        counts = partial(most_counts, self.translations.analysis, 1, self.d)
        return analyze(self.M, self.backend, order, counts)

    @cached_property
    def pose_order(self) -> IntArray:
        """Order of elimination of the poses, (n,), in all matrices that are factored."""
        return pose_order(self.graph)

    @cached_property
    def diagonal_positions(self) -> IntArray:
        """Positions in `M.data` of the diagonal of M, (N,)."""
        return read_only(matrices.diagonal_positions(self.M))

    @cached_property
    def block_positions(self) -> IntArray:
        """Positions in `M.data` of the diagonal d x d rotation blocks of M, (n, d, d)."""
        d = self.d
        # The rows of a block follow each other in each of its columns.
        from_diagonal = np.arange(d)[:, None] - np.arange(d)
        diagonal = self.diagonal_positions[self.num_poses :].reshape(-1, 1, d)
        return read_only(diagonal + from_diagonal)

    def with_pattern_of_M(self, data: Array) -> csc_array:
        """Return the matrix, (N, N), with the pattern of M and values in the order of `M.data`."""
        matrix = csc_array((data, self.M.indices, self.M.indptr), shape=self.M.shape)
        matrix.has_canonical_format = True
        return matrix

    def leave_out(self, data: Array, rows: IntArray, diagonal: Array | float) -> None:
        """Overwrite rows, (k,), and the same columns of a matrix by a diagonal, (k,) or one number.

        `data` are the values of the matrix, which has the pattern of M. They are changed.
        """
        data[matrices.meets(self.M, rows)] = 0.0
        data[self.diagonal_positions[rows]] = diagonal

    # The cost and its derivatives.

    def objective(self, poses: Poses) -> float:
        """Return the cost of poses: F (equation (16) of the paper, weighted), or chi2.

        Examples
        --------
        >>> from pgo_models.graphs.scenes import circle
        >>> graph = circle(np.random.default_rng(0))
        >>> problem = PGOProblem(graph)
        >>> bool(np.isclose(problem.objective(graph.truth), problem.edge_costs(graph.truth).sum()))
        True
        """
        return self.at(poses).value

    def edge_costs(self, poses: Poses) -> Array:
        """Return the share of every edge in the cost, (m,). Their sum is the objective."""
        return self.at(poses).edge_costs

    def riemannian_gradient(self, poses: Poses) -> tuple[Array, Array]:
        """Return the gradient of F(R_i Exp(hat(w_i)), t_i + v_i) in (w, v) at zero.

        With G = 2 M X it is (-2 vee(G_i R_i), G_{t_i}): (n, 1 or 3) per radian, (n, d) per metre.
        """
        return self.at(poses).riemannian_gradient

    # Exact translations for given rotations.

    @cached_property
    def translations(self) -> TranslationSystem:
        """The rows of M for translations, which give the best ones for given rotations."""
        return TranslationSystem(self.M, self.pose_order, self.backend)

    def with_best_translations(self, R: Array) -> Poses:
        """Return poses with rotations R, (n, d, d), and translations that minimise F, t_0 = 0."""
        return Poses(R, self.translations.best_for(stack_transposes(R)))

    def translation_factor(self, poses: Poses) -> CholeskyFactor | None:
        """Factor the matrix of the translations, for `at_best_translations`.

        None of a quadratic cost: its matrix does not depend on the rotations, and the factor is
        kept.
        """
        of_edges = self.weights.translation_matrices(poses.R[self.graph.i])
        if of_edges is None:
            return None
        if self.has_partial_edges:
            # No direction may be left open, in which rounding would move poses far away.
            traces = np.einsum("mkk->m", of_edges)
            least = LEAST_STIFFNESS * float(traces.max()) * np.eye(self.d)
            of_edges = of_edges + least
        return self._translation_laplacian.factorize(of_edges)

    @cached_property
    def _translation_laplacian(self) -> TranslationLaplacian:
        return TranslationLaplacian(self.incidence, self.d, self.pose_order, self.backend)

    def at_best_translations(self, poses: Poses, factor: CholeskyFactor | None = None) -> Poses:
        """Return the poses with the translations of least cost for their rotations.

        For given rotations the cost is a quadratic function of the translations, so that one step
        of Newton's method is exact.

        Parameters
        ----------
        poses : Poses
            Their translations count only where chi2 is not quadratic: t_0 stays where it is.
        factor : CholeskyFactor, optional
            The `translation_factor` of these poses. That of poses with nearly the same rotations
            gives nearly the best translations.
        """
        poses = self.check_poses(poses)
        if not self.has_translations:
            return self.seen_poses(poses)
        if self.is_quadratic:
            return self.with_best_translations(poses.R)
        if factor is None:
            factor = self.translation_factor(poses)
        assert factor is not None  # the cost is not quadratic
        of_edges = self.weights.translation_gradients(self.at(poses).point)
        half_gradient = self.incidence.ends @ of_edges - self.incidence.begins @ of_edges
        step = factor.solve(half_gradient.ravel()).reshape(-1, self.d)
        return poses.with_translations(poses.t - (step - step[0]))

    def seen_poses(self, poses: Poses) -> Poses:
        """Return the poses as the cost sees them: of rotations alone the translations are zero."""
        if self.has_translations or not poses.t.any():
            return poses
        return poses.with_translations(np.zeros_like(poses.t))

    def check_poses(self, poses: Poses) -> Poses:
        """Return poses with the world pose; a GraphError unless they are poses of the graph."""
        if not isinstance(poses, Poses):
            raise GraphError(
                f"poses are a {type(poses).__name__}; "
                "give Poses(R, t), or use with_best_translations(R)"
            )
        return check_poses(self.graph, poses)

    def at(self, poses: Poses) -> "EvaluatedPoses":
        """Return the cost at poses with what belongs to it: residuals, gradient, minorant.

        Each is computed when it is first asked for, and kept there.

        Examples
        --------
        >>> from pgo_models.graphs.scenes import grid
        >>> problem = PGOProblem(grid(np.random.default_rng(0)))
        >>> here = problem.at(problem.graph.truth)
        >>> bool(np.isclose(here.value, np.sum(here.X * here.half_gradient)))
        True
        """
        poses = self.check_poses(poses)
        return EvaluatedPoses(self, read_only(self.seen_poses(poses).stacked()), poses)

    def at_point(self, X: Array) -> "EvaluatedPoint":
        """Return the cost at any X, (N, k), as `at` does at poses.

        Value and gradient go by way of the residuals, which is accurate where the edges fit,
        however large the translations are.
        """
        return EvaluatedPoint(self, X)

    @cached_property
    def incidence(self) -> Incidence:
        """Which edges begin and end at a pose."""
        return Incidence.of(self.graph)


@dataclass(frozen=True, eq=False)
class EvaluatedPoint(ReadOnly):
    """A point X with the cost of a problem, residuals and gradient, each computed when asked for.

    Nothing else evaluates a cost. What was computed is kept here: who asks several things of the
    same point holds on to this.
    """

    problem: PGOProblem
    X: Array  # (N, k): the rows t_i and then the rows of every R_i^T, or any others

    @cached_property
    def point(self) -> EdgePoint:
        """X as the edges see it."""
        problem = self.problem
        residuals = np.asarray(problem.A @ self.X)
        weighted = problem.weights.weigh_rows(residuals)
        P = self.X[problem.num_poses :].reshape(problem.num_poses, problem.d, -1)
        return EdgePoint(residuals, weighted, P, problem.graph.i)

    @cached_property
    def minorant(self) -> EdgeCost:
        """The quadratic cost of the edges that touches theirs from below at the point.

        A quadratic cost is its own minorant.
        """
        return self.problem.weights.minorant(self.point)

    @cached_property
    def value(self) -> float:
        """F, or chi2, of which the minorant has computed most."""
        if self.problem.is_quadratic:
            return self.problem.weights.value(self.point)
        return self.minorant.value_at_contact(self.point)

    @property
    def edge_costs(self) -> Array:
        """The share of every edge in the cost, (m,)."""
        return self.problem.weights.edge_values(self.point)

    @cached_property
    def half_gradient(self) -> Array:
        """M X, (N, k), half the gradient in X; for chi2 M is that of the tangent."""
        problem = self.problem
        in_residuals, in_P_i = self.minorant.edge_gradients(self.point)
        half_gradient = np.asarray(problem.A_transposed @ in_residuals)
        if in_P_i is not None:
            half_gradient[problem.num_poses :] += problem.incidence.at_beginning(in_P_i)
        return read_only(half_gradient)


@dataclass(frozen=True, eq=False)
class EvaluatedPoses(EvaluatedPoint):
    """Poses with their cost in a problem, residuals and gradient; X stacks `seen_poses`."""

    poses: Poses  # one for every pose of the graph, as `PGOProblem.at` checks

    @cached_property
    def tangent(self) -> PGOProblem:
        """The problem with the minorant for its cost; a quadratic one is its own tangent."""
        problem = self.problem
        if problem.is_quadratic:
            return problem
        return _SameGraph(problem.graph, problem.backend, self.minorant, original=problem)

    @property
    def riemannian_gradient(self) -> tuple[Array, Array]:
        """Gradient of F(R_i Exp(hat(w_i)), t_i + v_i) in w, (n, 1 or 3), and in v, (n, d), at zero.

        With G = 2 M X it is (-2 vee(G_i R_i), G_{t_i}).
        """
        n = self.problem.num_poses
        d = self.problem.d
        G = 2.0 * self.half_gradient
        return -2.0 * vee(G[n:].reshape(n, d, d) @ self.poses.R), G[:n]


@dataclass(frozen=True, eq=False)
class _SamePattern(PGOProblem):
    """A problem whose M has the pattern of that of an `original`, and so has every factor."""

    original: PGOProblem = field(kw_only=True)

    def __post_init__(self) -> None:
        """Accept what the original was accepted with."""

    @cached_property
    def pose_order(self) -> IntArray:
        """Order of elimination of the poses."""
        return self.original.pose_order

    @cached_property
    def analysis(self) -> SymbolicCholesky:
        """Symbolic factorisation of the pattern of M, which both have."""
        return self.original.analysis


@dataclass(frozen=True, eq=False)
class _SameGraph(_SamePattern):
    """Another cost of the graph of an `original`: a tangent of chi2, or its convex neighbour."""

    @cached_property
    def A(self) -> csr_array:
        """Matrix of the residuals."""
        return self.original.A

    @cached_property
    def A_transposed(self) -> csc_array:
        """A^T."""
        return self.original.A_transposed

    @cached_property
    def incidence(self) -> Incidence:
        """Which edges begin and end at a pose."""
        return self.original.incidence

    @cached_property
    def analysis(self) -> SymbolicCholesky:
        """Symbolic factorisation of the pattern of M, which all costs of the graph have."""
        analysed = self.original.convex_part
        return self._analyze() if analysed is self else analysed.analysis

    @property
    def _convex_neighbour(self) -> PGOProblem:
        return self.original.convex_part


def as_problem(given: PGOProblem | PoseGraph) -> PGOProblem:
    """Return the problem that is given, or that of the graph that is given.

    A SettingError for a tangent, whose values may be negative: zero bounds chi2, and not it.
    """
    problem = given if isinstance(given, PGOProblem) else PGOProblem(given)
    if isinstance(problem.weighting, TangentCost):
        raise SettingError(
            f"{problem!r} is a tangent, a lower bound on chi2 and not a cost of its own; "
            "give the problem that it is a tangent of"
        )
    return problem
