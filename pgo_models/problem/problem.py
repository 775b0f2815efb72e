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
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.graphs.precisions import proper_information
from pgo_models.problem import matrices
from pgo_models.problem.cholesky import (
    CholeskyBackend,
    CholeskyFactor,
    SymbolicCholesky,
    analyze,
    factorize_damped,
)
from pgo_models.problem.costs import EdgeCost, EdgePoint, rotation_cost
from pgo_models.problem.incidence import Incidence
from pgo_models.problem.ordering import most_counts, pose_order, row_order
from pgo_models.problem.right_costs import RightCosts
from pgo_models.problem.weighting import (
    Weighting,
    convex_cost,
    information_cost,
    name_of_cost,
    own_weighting,
)

MOST_REFINEMENTS = 60  # of translations: each but the last halves F at least


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
        return _SharingProblem(self.graph, self.backend, cost, original=self)

    def check_quadratic(self, method: str, convex: bool = False) -> None:
        """Raise an error where a method needs a cost that is quadratic, or convex, and it is not.

        Parameters
        ----------
        method : str
            Name of the method, for the message.
        convex : bool
            Whether the cost has to be convex in (R, t), too.

        Raises
        ------
        SettingError
            When the cost is not what the method needs.
        """
        if not self.is_quadratic or (convex and not self.weights.is_convex):
            kind = "convex and quadratic in (R, t)" if convex else "quadratic in (R, t)"
            raise SettingError(
                f"{method} needs a cost that is {kind}, as F is, and chi2 here is not; "
                "use convex_part"
            )

    def check_positions(self, purpose: str) -> None:
        """Raise an error where something needs positions, and rotations alone are the unknowns.

        Parameters
        ----------
        purpose : str
            What needs them, for the message.

        Raises
        ------
        SettingError
            When the problem is one of rotations alone.
        """
        if not self.has_translations:
            raise SettingError(
                f"{purpose} needs positions, and the unknowns are rotations alone; "
                "leave it out, and write .g2o, .tum or .json"
            )

    def tangent_at(self, poses: Poses) -> "PGOProblem":
        """Return the quadratic problem that touches the cost from below at poses.

        Its cost F(X) is at most chi2(X) for all poses, and has the value and the gradient of chi2
        at the given ones. A quadratic problem is its own tangent.

        Parameters
        ----------
        poses : Poses
            Where they touch.

        Returns
        -------
        PGOProblem
            A new one, unless the cost is quadratic: its matrices are built when first asked for.
        """
        return self.at(poses).tangent

    def with_rotation_terms(self, i: IntArray, j: IntArray, R_ij: Array, W: Array) -> "PGOProblem":
        """Return the problem with terms tr(W delta_R delta_R^T), delta_R = R_j^T - R_ij^T R_i^T.

        Parameters
        ----------
        i, j : (k,) array of int
            The poses of every term; its block is in the pattern of M already.
        R_ij : (k, d, d) array
            Rotations, as measurements are.
        W : (k, d, d) array
            Symmetric weights of either sign.

        Returns
        -------
        PGOProblem
            Its cost is quadratic if that of this one is.
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
            initial=None,
            truth=None,
            written_error=None,
        )
        cost = self.weights.with_rotation_terms(R_ij, W)
        return _ExtendedProblem(extended, self.backend, cost, original=self)

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
        order = row_order(self.pose_order, 1, self.d)
        counts = partial(most_counts, self._pose_analysis, 1, self.d)
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
        """Return the matrix that has the pattern of M and given values.

        Parameters
        ----------
        data : (nnz,) array
            Values of the entries, in the order of `M.data`.

        Returns
        -------
        (N, N) csc_array
            A sparse matrix that shares the pattern.
        """
        matrix = csc_array((data, self.M.indices, self.M.indptr), shape=self.M.shape)
        matrix.has_canonical_format = True
        return matrix

    def leave_out(self, data: Array, rows: IntArray, diagonal: Array | float) -> None:
        """Overwrite rows and columns of a matrix with the pattern of M by a diagonal.

        Parameters
        ----------
        data : (nnz,) array
            Stored values of the matrix, which are changed.
        rows : (k,) array of int
            The rows, and columns, to leave out.
        diagonal : (k,) array or float
            What their diagonal entries become.
        """
        data[matrices.meets(self.M, rows)] = 0.0
        data[self.diagonal_positions[rows]] = diagonal

    # The cost and its derivatives.

    def residuals(self, X: Array) -> Array:
        """Return A X: the translation residuals of the edges, then their rotation residuals.

        Parameters
        ----------
        X : (N, d) array
            Poses, stacked, or any other point.

        Returns
        -------
        ((d+1) m, d) array
            The residuals.
        """
        return np.asarray(self.A @ X)

    def point(self, X: Array) -> EdgePoint:
        """Return X as the edges see it: what their cost is evaluated at.

        Parameters
        ----------
        X : (N, d) array
            Poses, stacked, or any other point.

        Returns
        -------
        EdgePoint
            Residuals and rotations.
        """
        P = X[self.num_poses :].reshape(self.num_poses, self.d, -1)
        residuals = self.residuals(X)
        return EdgePoint(residuals, self.weights.weigh_rows(residuals), P, self.graph.i)

    def objective_stacked(self, X: Array) -> float:
        """Return the cost at any X, as a weighted sum of squares of residuals.

        Parameters
        ----------
        X : (N, d) array
            The point.

        Returns
        -------
        float
            F = tr(X^T M X), or chi2.
        """
        return self.weights.value(self.point(X))

    def objective(self, poses: Poses) -> float:
        """Return the cost of poses: F (equation (16) of the paper, weighted), or chi2.

        Parameters
        ----------
        poses : Poses
            One pose for every pose of the graph.

        Returns
        -------
        float
            It has no unit.

        Raises
        ------
        GraphError
            When the poses do not fit the graph.

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
        """Return the share of every edge in the cost.

        Parameters
        ----------
        poses : Poses
            One pose for every pose of the graph.

        Returns
        -------
        (m,) array
            Their sum is the objective.
        """
        return self.weights.edge_values(self.at(poses).point)

    def apply_M(self, X: Array) -> Array:
        """Return M X = A^T (D A X) by way of the residuals.

        That is accurate where the edges fit, however large the translations are.

        Parameters
        ----------
        X : (N, d) array
            The point.

        Returns
        -------
        (N, d) array
            In the rows of X.
        """
        return self.sum_gradients(*self.weights.edge_gradients(self.point(X)))

    def sum_gradients(self, in_residuals: Array, in_P_i: Array | None) -> Array:
        """Return the half gradient in X of edges with these (`EdgeCost.edge_gradients`).

        Parameters
        ----------
        in_residuals : ((d + 1) m, d) array
            Half gradients in the rows of A X.
        in_P_i : (m, d, d) array or None
            Half gradients in the rows of R_i^T beside them; None for zeros.

        Returns
        -------
        (N, d) array
            In the rows of X.
        """
        half_gradient = self.residual_adjoint @ in_residuals
        if in_P_i is not None:
            half_gradient[self.num_poses :] += self.incidence.at_beginning(in_P_i)
        return np.asarray(half_gradient)

    def apply_Q(self, Y: Array) -> Array:
        """Return Q Y without forming Q: M applied to Y and its best translations.

        Parameters
        ----------
        Y : (dn, k) array
            Rows of rotations, or any others.

        Returns
        -------
        (dn, k) array
            In the rows of Y.
        """
        return np.asarray(self._M_rotation_rows @ np.concatenate([self.translations_for(Y), Y]))

    def riemannian_gradient(self, poses: Poses) -> tuple[Array, Array]:
        """Return the gradient of F(R_i Exp(hat(w_i)), t_i + v_i) in (w, v) at zero.

        With G = 2 M X it is (-2 vee(G_i R_i), G_{t_i}).

        Parameters
        ----------
        poses : Poses
            One pose for every pose of the graph.

        Returns
        -------
        (n, 1 or 3) array
            Gradient in w, per radian.
        (n, d) array
            Gradient in v, per metre.
        """
        return self.at(poses).riemannian_gradient

    # Exact translations for given rotations.

    def recover_translations(self, R: Array) -> Array:
        """Return the translations that minimise F for given rotations, with t_0 = 0.

        They solve M_tt t = -M_tR Y, Y the rows R_i^T: one sparse solve.

        Parameters
        ----------
        R : (n, d, d) array
            Rotations.

        Returns
        -------
        (n, d) array
            Translations, in metres.
        """
        return self.translations_for(stack_transposes(R))

    def translations_for(self, Y: Array) -> Array:
        """Return the rows t that minimise tr(X^T M X) for X = (t, Y), with t_0 = 0.

        Parameters
        ----------
        Y : (dn, k) array
            Rows R_i^T of rotations, or any others.

        Returns
        -------
        (n, k) array
            The rows t.
        """
        return self.solve_translations(-(self._M_tR @ Y))

    def solve_translations(self, b: Array) -> Array:
        """Return t with M_tt t = b but for the row of pose 0, and t_0 = 0.

        Parameters
        ----------
        b : (n, k) array
            Right-hand sides.

        Returns
        -------
        (n, k) array
            Solutions.
        """
        without_pose_0 = b.copy()
        without_pose_0[0] = 0.0
        return self._translation_factor.solve(without_pose_0)

    def with_best_translations(self, R: Array) -> Poses:
        """Return poses with given rotations and the translations of `recover_translations`.

        Parameters
        ----------
        R : (n, d, d) array
            Rotations.

        Returns
        -------
        Poses
            (R, t).
        """
        return Poses(R, self.recover_translations(R))

    def translation_factor(self, poses: Poses) -> CholeskyFactor | None:
        """Factor the matrix of the translations where it depends on the rotations.

        Parameters
        ----------
        poses : Poses
            Their rotations count.

        Returns
        -------
        CholeskyFactor or None
            For `at_best_translations`; None of a quadratic cost, whose factor is kept.
        """
        of_edges = self.weights.translation_matrices(poses.R[self.graph.i])
        if of_edges is None:
            return None
        laplacian = self._translation_laplacian.matrix(of_edges)
        return factorize_damped(self._translation_analysis, laplacian)

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

        Returns
        -------
        Poses
            With the same rotations.
        """
        if not self.has_translations:
            return self.seen_poses(poses)
        if self.is_quadratic:
            return self.with_best_translations(poses.R)
        if factor is None:
            factor = self.translation_factor(poses)
        assert factor is not None  # the cost is not quadratic
        of_edges = self.weights.translation_gradients(self.point(poses.stacked()))
        half_gradient = self.incidence.ends @ of_edges - self.incidence.begins @ of_edges
        step = factor.solve(half_gradient.ravel()).reshape(-1, self.d)
        return poses.with_translations(poses.t - (step - step[0]))

    def with_refined_translations(self, poses: Poses) -> Poses:
        """Return the poses after steps of iterative refinement of the translations.

        A solve leaves errors in proportion to its condition; a step with residuals edge by edge
        takes most of it away. At most `MOST_REFINEMENTS` steps are taken, as many as lower the
        cost. Another one follows only where the last one halved F and left it positive: chi2 may
        come out below zero by rounding, and then every number is less than half of itself.

        Parameters
        ----------
        poses : Poses
            One pose for every pose of the graph.

        Returns
        -------
        Poses
            With the same rotations, and t_0 where it is.
        """
        here = self.at(poses)
        for _ in range(MOST_REFINEMENTS):
            step = self.solve_translations(here.half_gradient[: self.num_poses])
            refined = self.at(here.poses.with_translations(here.poses.t - step))
            if not refined.value < here.value:
                break
            was_halved = 0.0 < refined.value < 0.5 * here.value
            here = refined
            if not was_halved:
                break
        return here.poses

    def seen_poses(self, poses: Poses) -> Poses:
        """Return the poses that the cost is evaluated at.

        Parameters
        ----------
        poses : Poses
            One pose for every pose of the graph.

        Returns
        -------
        Poses
            The given ones; in a problem of rotations alone with zeros for translations.
        """
        if self.has_translations or not poses.t.any():
            return poses
        return poses.with_translations(np.zeros_like(poses.t))

    def stacked(self, poses: Poses) -> Array:
        """Return X of poses: the rows t_i, then the rows of every R_i^T.

        Parameters
        ----------
        poses : Poses
            One pose for every pose of the graph.

        Returns
        -------
        (N, d) array
            X.

        Raises
        ------
        GraphError
            When they are no poses, or their number or dimension is not the graph's.
        """
        self._check_poses(poses)
        return self.seen_poses(poses).stacked()

    def _check_poses(self, poses: Poses) -> None:
        if not isinstance(poses, Poses):
            raise GraphError(
                f"poses are a {type(poses).__name__}; "
                "give Poses(R, t), or use with_best_translations(R)"
            )
        if (poses.num_poses, poses.d) != (self.num_poses, self.d):
            raise GraphError(
                f"{poses} beside {self}; give one pose for every pose of the graph, in its order"
            )

    def at(self, poses: Poses) -> "EvaluatedPoses":
        """Return the cost at poses with what belongs to it: residuals, gradient, minorant.

        Parameters
        ----------
        poses : Poses
            One pose for every pose of the graph.

        Returns
        -------
        EvaluatedPoses
            Each thing is computed when it is first asked for, and kept there.

        Raises
        ------
        GraphError
            When the poses do not fit the graph.

        Examples
        --------
        >>> from pgo_models.graphs.scenes import grid
        >>> problem = PGOProblem(grid(np.random.default_rng(0)))
        >>> here = problem.at(problem.graph.truth)
        >>> bool(np.isclose(here.value, np.sum(here.X * here.half_gradient)))
        True
        """
        self._check_poses(poses)
        return EvaluatedPoses(self, poses)

    @cached_property
    def residual_adjoint(self) -> csc_array:
        """A^T, (N, (d+1) m)."""
        return self.A.T

    @cached_property
    def incidence(self) -> Incidence:
        """Which edges begin and end at a pose."""
        return Incidence.of(self.graph)

    @cached_property
    def _M_tt(self) -> csc_array:
        return self.M[: self.num_poses, : self.num_poses].tocsc()

    @cached_property
    def _pose_analysis(self) -> SymbolicCholesky:
        """Symbolic factorisation of the pattern of M_tt, with one entry for a block of poses."""
        return analyze(self._M_tt, self.backend, self.pose_order)

    @cached_property
    def _translation_factor(self) -> CholeskyFactor:
        """Factor of M_tt, in which pose 0 has its diagonal entry alone."""
        grounded = self._M_tt.copy()
        of_pose_0 = matrices.meets(grounded, np.zeros(1, dtype=np.int64))
        of_pose_0[matrices.diagonal_positions(grounded)] = False
        grounded.data[of_pose_0] = 0.0
        return factorize_damped(self._pose_analysis, grounded)

    @cached_property
    def _translation_laplacian(self) -> matrices.BlockLaplacian:
        """Laplacian of the translations, with the block of pose 0 doubled: so it is definite."""
        return matrices.BlockLaplacian.of(self.incidence, self.d)

    @cached_property
    def _translation_analysis(self) -> SymbolicCholesky:
        """Symbolic factorisation of that Laplacian, whose pattern the graph alone gives."""
        ones = np.broadcast_to(np.eye(self.d), self.graph.R_ij.shape)
        order = row_order(self.pose_order, self.d)
        return analyze(self._translation_laplacian.matrix(ones), self.backend, order)

    @cached_property
    def _M_tR(self) -> csr_array:
        return self.M[: self.num_poses, self.num_poses :].tocsr()

    @cached_property
    def _M_rotation_rows(self) -> csr_array:
        return self.M[self.num_poses :].tocsr()


@dataclass(frozen=True, eq=False)
class EvaluatedPoses(ReadOnly):
    """Poses with their cost in a problem, residuals and gradient, each computed when asked for.

    What was computed is kept here: who asks several things of the same poses holds on to this.
    Arrays are read-only.

    Parameters
    ----------
    problem : PGOProblem
        The problem.
    poses : Poses
        One pose for every pose of its graph (`PGOProblem.at` checks that).

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> here = problem.at(problem.graph.truth)
    >>> bool(here.value == problem.objective(problem.graph.truth))
    True
    """

    problem: PGOProblem
    poses: Poses

    @cached_property
    def X(self) -> Array:
        """The poses as the cost sees them: the rows t_i, then the rows of every R_i^T, (N, d)."""
        return read_only(self.problem.seen_poses(self.poses).stacked())

    @cached_property
    def point(self) -> EdgePoint:
        """X as the edges see it."""
        return self.problem.point(self.X)

    @property
    def residuals(self) -> Array:
        """A X, ((d+1) m, d)."""
        return read_only(self.point.residuals)

    @cached_property
    def minorant(self) -> EdgeCost:
        """The quadratic cost of the edges that touches theirs from below at the poses.

        A quadratic cost is its own minorant.
        """
        problem = self.problem
        if problem.is_quadratic:
            return problem.weights
        return problem.weights.minorant(self.point)

    @cached_property
    def tangent(self) -> PGOProblem:
        """The problem with the minorant for its cost; a quadratic one is its own tangent."""
        problem = self.problem
        if problem.is_quadratic:
            return problem
        return _TangentProblem(problem.graph, problem.backend, self.minorant, original=problem)

    @cached_property
    def value(self) -> float:
        """F, or chi2, of which the minorant has computed most."""
        if self.problem.is_quadratic:
            return self.problem.weights.value(self.point)
        return self.minorant.value_at_contact(self.point)

    @cached_property
    def half_gradient(self) -> Array:
        """M X, (N, d), half the gradient in X; for chi2 M is that of the tangent."""
        of_edges = self.minorant.edge_gradients(self.point)
        return read_only(self.problem.sum_gradients(*of_edges))

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
class _SharingProblem(PGOProblem):
    """Another cost of the graph of an `original`, which has what follows from the graph alone."""

    original: PGOProblem = field(kw_only=True)

    def __post_init__(self) -> None:
        """Accept what the original was accepted with."""

    @cached_property
    def incidence(self) -> Incidence:
        """Which edges begin and end at a pose."""
        return self.original.incidence

    @cached_property
    def pose_order(self) -> IntArray:
        """Order of elimination of the poses."""
        return self.original.pose_order


@dataclass(frozen=True, eq=False)
class _TangentProblem(_SharingProblem):
    """A tangent of chi2."""

    @cached_property
    def A(self) -> csr_array:
        """A, which both have."""
        return self.original.A

    @cached_property
    def convex_part(self) -> PGOProblem:
        """The tangent itself if it is convex in (R, t), else the problem near chi2 that is."""
        return self if self.weights.is_convex else self.original.convex_part

    @cached_property
    def residual_adjoint(self) -> csc_array:
        """A^T."""
        return self.original.residual_adjoint

    @cached_property
    def analysis(self) -> SymbolicCholesky:
        """Symbolic factorisation of the pattern of M, which both have."""
        return self.original.analysis


@dataclass(frozen=True, eq=False)
class _ExtendedProblem(PGOProblem):
    """A problem with further terms between poses that share an edge in the `original`.

    Its M has the pattern of the original's, and so has every factor.
    """

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


def as_problem(given: PGOProblem | PoseGraph) -> PGOProblem:
    """Return the problem that is given, or that of the graph that is given."""
    return given if isinstance(given, PGOProblem) else PGOProblem(given)
