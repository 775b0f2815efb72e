"""Bounds with a matrix for every axis of the world, where positions are measured axis by axis.

A position measured from the world costs w_k (t_k - p_k)^2 along axis k, as GPS with a poor height.
The tangent of chi2 keeps the smallest w_k for all axes and takes the rest at its tangent, which has
no curvature. The curvature is kept here. Ground the proof at the world pose: poses are moved so
that it is at (0, I), and column k of X has the coordinates along axis k of the world. By columns

    F(X) = sum_k x_k^T M x_k + constant,    x_k, (N,), column k of X,

and M may differ from axis to axis.

**Weights by axis.** Let r = R_0^T (t_j - t_0) - t_ij be the residual of an edge from the world,
with R_ij = I, and let its excess u^T J u (`pgo_models.problem.excess`) have a J_tt that is diagonal
and coupled with nothing. Above the tangent at Z* there remains (u - u*)^T J (u - u*), which is at
least sum_k D_k (r_k - r*_k)^2 for any 0 <= D <= diag(J_tt). This is a quadratic function of column
k alone, and zero with its gradient at Z*: value, gradient and multipliers stay what they are, and
D_k is added to S in the row of t_j for axis k. The share `KEPT_SHARE` of J_tt is taken for D: what
is left still makes up for the rounding of the tangent (`Tangent.loss`).

**Multipliers gamma.** The rows of R_i have length one, too: |p_k| = 1 for column k of P_i = R_i^T.
With multipliers gamma_ik, (n, d), of these the bound is that of

    q(X) = tr(X^T M X) + sum_i <Lambda_i, I - P_i P_i^T> + sum_ik gamma_ik (1 - |p_ik|^2) + ..,

whose matrix for axis k is S_k = S + diag(D_k) - diag(gamma_ik I). For any a, (d,), the multipliers

    gamma_i = a,    Lambda_i - P^_i diag(a) P^_i^T

have the same gradient and value at poses P^ as Lambda_i alone, and add sum_l (a_l - a_k) p^_l
p^_l^T to the block of pose i in S_k: an axis with a small a_k gains what others lose. An axis that
is hardly measured has an S_k that is hardly definite, or not at all, while others have more than
enough. So weak axes have a_k = -c and the strong ones 0, with a share of the largest c for which
the matrices of strong axes are definite: they keep about a sixteenth of themselves.

**The proof** is that of `pgo_models.certificates.lower_bound` with V = I. The unknowns are the
columns of Z, one below the other, (N d, 1), and the matrix is blockdiag(S_1, .., S_d).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh

from pgo_models.certificates.definiteness import (
    FIRST_MARGIN,
    DefiniteProof,
    Factor,
    StoredMatrix,
    etas_of_rotations,
    prove_stored,
    stored_certificate,
)
from pgo_models.certificates.rounding_errors import Evaluation
from pgo_models.certificates.unknowns import Unknowns
from pgo_models.geometry.arrays import ReadOnly
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyFactor
from pgo_models.problem.costs import TangentCost
from pgo_models.problem.floating_point import OUTWARD, UNIT_ROUNDOFF, exact_sum, gamma as rounding
from pgo_models.problem.matrices import rotation_columns
from pgo_models.problem.problem import PGOProblem

# Share of J_tt that D has. The loss of a tangent to the rounding of C is divided by the rest.
KEPT_SHARE = 15.0 / 16.0
# Bound on the rounding of an entry of J_tt, in roundings of the sizes that it is computed from.
_ROUNDINGS_OF_J = 8.0
_GIVEN_SHARE = 15.0 / 16.0  # of the largest c
_EIGENVALUE_TOLERANCE = 1e-2  # relative, of that c: well below what strong axes keep


@dataclass(frozen=True, eq=False)
class AxisTerms(ReadOnly):
    """What a proof by axes has beside the tangent and Lambda.

    Parameters
    ----------
    edges : (k,) array of int
        Edges from the world whose positions are weighed by axis.
    weights : (k, d) array
        D of these edges, zero or more.
    gamma : (n, d) array
        Multipliers of the lengths of the rows of every R_i.
    """

    edges: IntArray
    weights: Array
    gamma: Array


def axis_terms(problem: PGOProblem) -> AxisTerms | None:
    """Terms of a tangent problem with the largest D, and gamma = 0; None where no D is above zero.

    None as well for a cost without a tangent, or without a world pose.
    """
    graph = problem.graph
    cost = problem.weights
    if not isinstance(cost, TangentCost) or graph.world is None:
        return None
    d = graph.d
    excess = cost.tangent.excess
    is_unturned = (graph.R_ij == np.eye(d)).all(axis=(1, 2))
    rows = excess.J[:, :d].copy()
    along_axes = np.einsum("maa->ma", rows[:, :, :d])
    J_tt = along_axes.copy()
    along_axes[:] = 0.0
    chosen = graph.is_prior & is_unturned & ~rows.any(axis=(1, 2))
    error = _ROUNDINGS_OF_J * UNIT_ROUNDOFF * excess.size[:, :1] ** 2
    weights = KEPT_SHARE * (J_tt - error) / OUTWARD
    weights = np.where(chosen[:, None], np.maximum(weights, 0.0), 0.0)
    edges = np.flatnonzero(weights.any(axis=1))
    if not len(edges):
        return None
    return AxisTerms(edges, weights[edges], np.zeros((graph.num_poses, d)))


@dataclass(frozen=True, eq=False)
class AxisUnknowns(Unknowns):
    """The columns of Z one below the other, with a matrix for every axis of the world.

    Parameters
    ----------
    problem, rows
        As of `Unknowns`: a tangent problem, and the rows of the world pose.
    terms : AxisTerms
        Weights by axis and gamma.
    """

    terms: AxisTerms

    @property
    def is_complex(self) -> bool:
        """False."""
        return False

    def starting_point(self, X: Array) -> Array:
        """X' itself."""
        return X

    def other_starts(self, X: Array) -> list[Array]:
        """X' that is flat along axes which one position alone holds, where there are such axes.

        Where nothing but the lengths |p_k| = 1 keeps the map from being flat along an axis, the
        bound of this axis is attained there, as gamma has been lowered.
        """
        graph = self.problem.graph
        tau_of_priors = np.where(graph.is_prior, self.problem.weights.tau, 0.0)
        weights = np.repeat(tau_of_priors[:, None], graph.d, axis=1)
        weights[self.terms.edges] += self.terms.weights
        unmeasured = np.flatnonzero(np.count_nonzero(weights, axis=0) == 1)
        if not len(unmeasured):
            return []
        X = X.copy()
        for axis in unmeasured:
            height = X[graph.j[np.argmax(weights[:, axis])], axis]
            X[: graph.num_poses, axis] = height
            X[graph.num_poses :, axis] = 0.0
            X[self.rows, axis] = np.append(0.0, np.eye(graph.d)[axis])
        return [X]

    def prove_definite(self, Lambda: Array, eta: float, X: Array) -> DefiniteProof | None:
        """Proof that the matrix of every axis is definite without the rows left out."""
        proofs = {}
        # An axis that has been given something is the first to fail.
        for axis in np.argsort(self.terms.gamma.sum(axis=0), kind="stable").tolist():
            matrix = self.stored_matrix(Lambda, eta, axis)
            proof = None if matrix is None else prove_stored(matrix, turned=self._moves(matrix, X))
            if proof is None:
                return None
            proofs[axis] = proof
        by_axis = [proofs[axis] for axis in range(self.problem.d)]
        slack = np.concatenate([proof.slack for proof in by_axis])
        return DefiniteProof(_FactorsOfAxes([proof.factor for proof in by_axis]), slack)

    def _moves(self, matrix: StoredMatrix, X: Array) -> Array:
        """X' with the shifts along the axes that cost least: the softest moves that are known."""
        shift = np.zeros(self.problem.side)
        shift[: self.problem.num_poses] = 1.0
        shift[self.rows] = 0.0
        held = matrix.stored @ shift
        return np.asarray(X - np.outer(shift, (held @ X) / (held @ shift)))

    def is_definite_in_doubles(self, Lambda: Array) -> bool:
        """Whether the matrix of every axis has a Cholesky factor."""
        return all(self.factor_of_axis(Lambda, axis) is not None for axis in range(self.problem.d))

    def factor_of_axis(self, Lambda: Array, axis: int) -> CholeskyFactor | None:
        """Cholesky factor of S_k less a margin, without the rows left out; None without one."""
        matrix = self.stored_matrix(Lambda, 0.0, axis)
        margin = np.full(self.problem.side, FIRST_MARGIN)
        return None if matrix is None else matrix.factor_less(margin)

    def gradient(self, product: Array, error: Array) -> tuple[Array, Array]:
        """The columns of G, one below the other."""
        return product.T.reshape(-1, 1), error.T.reshape(-1, 1)

    def rows_of(self, unknowns: Array) -> Array:
        """Z, (N, d)."""
        return unknowns.reshape(self.problem.d, -1).T

    def stored_matrix(self, Lambda: Array, eta: float, axis: int) -> StoredMatrix | None:
        """S_k + eta blockdiag(0, I) without the rows left out; None where it is out of range.

        D_k is summed rounding down. That gamma is added to Lambda, and D_k to the rows of
        translations, rounds the diagonal alone: `matrix_errors` counts 4 d roundings in a row of a
        block, of which Lambda, eta and a margin make 3 d.
        """
        problem = self.problem
        n = problem.num_poses
        ends = problem.graph.j[self.terms.edges]
        shifts = np.zeros(problem.side)
        np.add.at(shifts, ends, self.terms.weights[:, axis])
        shifts[:n] /= OUTWARD
        shifts[n:] = np.repeat(etas_of_rotations(problem, eta), problem.d)
        multipliers = Lambda + self.terms.gamma[:, axis, None, None] * np.eye(problem.d)
        return stored_certificate(problem, multipliers, shifts, self.rows)

    def added(self, X: Array, low: Array) -> Evaluation:
        """The terms by axis at X, half their gradient, and bounds on the errors of both."""
        return self._of_positions(X, low).plus(self._of_lengths(X))

    def _of_positions(self, X: Array, low: Array) -> Evaluation:
        """Sum of D_k (r_k - r*_k)^2, less what the tangents of these edges may lose.

        That is what they lose to rounding with the share of J_tt that D leaves.
        """
        graph = self.problem.graph
        cost = self.problem.weights
        assert isinstance(cost, TangentCost)
        edges = self.terms.edges
        weights = self.terms.weights
        ends = graph.j[edges]
        residual = X[ends] - graph.t_ij[edges]
        residual_error = UNIT_ROUNDOFF * np.abs(residual)
        for summand in (low[ends], -cost.tangent.Z[edges, 0]):
            residual = residual + summand
            residual_error = residual_error + UNIT_ROUNDOFF * np.abs(residual)
        weighted = weights * residual
        weighted_error = weights * residual_error + UNIT_ROUNDOFF * np.abs(weighted)
        squares = weighted * residual
        square_error = weighted_error * np.abs(residual) + np.abs(weighted) * residual_error
        square_error += weighted_error * residual_error + UNIT_ROUNDOFF * squares
        product = np.zeros_like(X)
        sizes = np.zeros_like(X)
        product_error = np.zeros_like(X)
        np.add.at(product, ends, weighted)
        np.add.at(sizes, ends, np.abs(weighted))
        np.add.at(product_error, ends, weighted_error)
        most_terms = int(np.bincount(ends).max())
        product_error += rounding(most_terms) * sizes
        times_lost = 1.0 / (1.0 - KEPT_SHARE) - 1.0
        lost = OUTWARD * times_lost * float(np.sum(cost.tangent.loss[edges]))
        value = exact_sum([*squares.ravel(), -lost])
        value_error = float(np.sum(square_error)) + UNIT_ROUNDOFF * abs(value)
        return Evaluation(value, OUTWARD * value_error, product, OUTWARD * product_error)

    def _of_lengths(self, X: Array) -> Evaluation:
        """Sum of gamma_ik (1 - |p_ik|^2)."""
        n = self.problem.num_poses
        d = self.problem.d
        gamma = self.terms.gamma
        P = X[n:].reshape(n, d, d)
        lengths = np.einsum("nak,nak->nk", P, P)
        errors = np.abs(gamma) * rounding(d + 3) * (1.0 + lengths)
        value = exact_sum((gamma * (1.0 - lengths)).ravel())
        value_error = float(np.sum(errors)) + UNIT_ROUNDOFF * abs(value)
        product = np.zeros_like(X)
        product[n:] = (-gamma[:, None, :] * P).reshape(-1, d)
        product_error = UNIT_ROUNDOFF * np.abs(product)
        return Evaluation(value, OUTWARD * value_error, product, OUTWARD * product_error)


class _FactorsOfAxes:
    """Factors of the matrices of all axes, as one of the matrix with these blocks."""

    def __init__(self, factors: list[Factor]) -> None:
        self._factors = factors

    def solve(self, right_hand_side: Array) -> Array:
        """Solution, (N d, 1), of the columns one below the other."""
        columns = right_hand_side.reshape(len(self._factors), -1)
        solved = [f.solve(column) for f, column in zip(self._factors, columns, strict=True)]
        return np.concatenate(solved)[:, None]


def balanced(
    unknowns: AxisUnknowns, Lambda: Array, X: Array
) -> tuple[AxisTerms, Array, Array] | None:
    """Terms and multipliers with what strong axes have given to weak ones, and which these are.

    An axis is strong if its matrix has a Cholesky factor; None where none is. X are poses with the
    world pose at (0, I), where value and gradient stay what they are. Last come ones, (n, d), at
    the weak axes of poses that turn, and zeros elsewhere. Along an axis that no position is
    measured along, as a height, the relief of the map can be stretched at no cost, and the matrix
    is singular. It is definite with gamma less eta there, which loses eta for every one.
    """
    problem = unknowns.problem
    n = problem.num_poses
    d = problem.d
    factors = [unknowns.factor_of_axis(Lambda, axis) for axis in range(d)]
    strong = [factor for factor in factors if factor is not None]
    if not strong:
        return None
    is_weak = np.array([factor is None for factor in factors])
    turns = np.ones((n, 1))
    turns[problem.graph.landmarks] = 0.0
    turns[problem.graph.world] = 0.0
    weak = np.asarray(turns * is_weak)
    if not is_weak.any():
        return unknowns.terms, Lambda, weak
    P = X[n:].reshape(n, d, d)
    lost = turns[:, :, None] * P[:, :, is_weak]
    gamma = -_GIVEN_SHARE * min(_most_given(factor, lost) for factor in strong) * weak
    changed = Lambda - (P * gamma[:, None, :]) @ np.swapaxes(P, 1, 2)
    Lambda = 0.5 * (changed + np.swapaxes(changed, 1, 2))
    return replace(unknowns.terms, gamma=gamma), Lambda, weak


def _most_given(factor: CholeskyFactor, lost: Array) -> float:
    """Largest c for which S_k - c B is definite in doubles, with B = sum of v v^T.

    The vectors v are the columns of `lost`, (n, d, k), in the rows of every pose. 1 / c is the
    largest eigenvalue of V^T S_k^-1 V, V the matrix of all v; the factor is that of S_k. Zero where
    that eigenvalue is not found.
    """
    n, d, k = lost.shape
    rotation_rows = rotation_columns(np.arange(n), n, d)

    def apply(coefficients: Array) -> Array:
        vector = np.zeros((d + 1) * n)
        vector[rotation_rows] = np.einsum("ndk,nk->nd", lost, coefficients.reshape(n, k))
        solved = factor.solve(vector)
        return np.asarray(np.einsum("ndk,nd->nk", lost, solved[rotation_rows]).ravel())

    operator = LinearOperator((n * k, n * k), matvec=apply, dtype=np.float64)
    try:
        largest = eigsh(
            operator,
            k=1,
            which="LA",
            tol=_EIGENVALUE_TOLERANCE,
            v0=np.ones(n * k),
            return_eigenvectors=False,
        )
    except ArpackError:
        return 0.0
    return 1.0 / float(largest[0]) if largest[0] > 0.0 else 0.0
