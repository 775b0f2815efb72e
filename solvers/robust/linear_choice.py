"""Choice of loop closures in the linear theory: the set of the least truncated cost, by exchange.

A map that few closures hold bends to fit a wrong one, and no change of one closure at a time then
lowers the truncated cost. In the linear theory thousands of sets can be compared in a second. At
the poses of a map let H be half the Hessian of the cost of the edges that stay, r_e the error of a
closure e, A_e its derivative and C_e its covariance. With the closures of a set S the least cost
is, up to a constant and to first order,

    F(S) = u_S^T (C_S + A_S H^-1 A_S^T)^-1 u_S,     u = r - A H^-1 g,

with g half the gradient of the edges that stay. At stationary poses of these and the closures kept,
g = -sum over the kept of A_e^T C_e^-1 r_e. The set of the least F(S) + sum of c^2 over the others
is looked for by tabu search (Glover, "Tabu search, part I", ORSA Journal on Computing 1989): in
every step the best change of one closure is made, even if it raises the cost, and that closure
stays as it is for some steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # and scipy.linalg when it is used

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, hat, log_map, tangent_dimension
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian
from pgo_models.problem.marginals import Marginals
from pgo_models.problem.problem import PGOProblem
from solvers.robust.chains import Motions, inverse, product

# Steps of the search, those in a row without a better set, and those for which a closure stays.
_MOST_STEPS = 300
_MOST_WITHOUT_SUCCESS = 100
_TENURE = 8
# Share of its own variance by which the variance of an error is taken for larger: that of two
# closures that measure the same is singular otherwise.
_LEAST_VARIANCE = 1e-12


@dataclass(frozen=True, eq=False)
class LinearChoice:
    """Model of k closures at the poses of a map.

    `errors` (k, p) are u, and `covariance` (k, p, k, p) is C + A H^-1 A^T. `allowed` is c^2.
    """

    errors: Array
    covariance: Array
    allowed: float

    @classmethod
    def of(
        cls,
        staying: PGOProblem,
        graph: PoseGraph,
        closures: tuple[IntArray, Array],
        kept: IntArray,
        poses: Poses,
        allowed: float,
    ) -> LinearChoice:
        """Model of `closures`, (k,) edges of the graph and their covariances (k, p, p).

        `kept` are places of those that the stationary poses are of, beside the edges that stay.
        A NotPositiveDefiniteError where these do not hold the poses.
        """
        edges, measured = closures
        k, p, _ = measured.shape
        errors, derivative, ends = _linearised(graph, edges, poses)
        hessian = riemannian_hessian(staying.at(poses), None)
        layout = TangentLayout(staying.num_poses, staying.d)
        joint = Marginals(hessian, layout, backend=staying.backend).joint(*ends.tolist())
        moved = (derivative @ joint @ derivative.T).reshape(k, p, k, p)
        forces = np.linalg.solve(measured[kept], errors[kept][:, :, None])[:, :, 0]
        errors = errors + np.einsum("kasb,sb->ka", moved[:, :, kept], forces)
        moved[np.arange(k), :, np.arange(k)] += measured
        return cls(errors, moved, allowed)

    def best(self, chosen: IntArray, excluded: int | None = None) -> IntArray:
        """The best set found from the closures chosen, (s,), without one that is excluded."""
        k = len(self.errors)
        current = chosen if excluded is None else np.setdiff1d(chosen, [excluded])
        best = current
        least_cost = np.inf
        free_at = np.zeros(k, dtype=int)
        best_step = 0
        for step in range(_MOST_STEPS):
            cost, changes = self._changes(current)
            if cost < least_cost:
                least_cost = cost
                best = current
                best_step = step
            if step - best_step >= _MOST_WITHOUT_SUCCESS:
                break
            is_allowed = (free_at <= step) | (cost + changes < least_cost)
            if excluded is not None:
                is_allowed[excluded] = False
            if not is_allowed.any():
                break
            e = int(np.where(is_allowed, changes, np.inf).argmin())
            current = np.setxor1d(current, [e])
            free_at[e] = step + min(_TENURE, k // 4)
        return best

    def _changes(self, chosen: IntArray) -> tuple[float, Array]:
        """Cost of the chosen closures, and how it changes when each, (k,), comes or goes."""
        k, p = self.errors.shape
        own = self.covariance[np.arange(k), :, np.arange(k)]
        size = len(chosen) * p
        among = self.covariance[chosen][:, :, chosen].reshape(size, size)
        factor = np.linalg.cholesky(among)
        solve = scipy.linalg.solve_triangular
        to_all = solve(factor, self.covariance[chosen].reshape(size, k * p), lower=True)
        whitened = solve(factor, self.errors[chosen].reshape(size), lower=True)
        # What the chosen closures leave of the errors of all, and of their variances.
        left = self.errors - (whitened @ to_all).reshape(k, p)
        columns = to_all.reshape(size, k, p).transpose(1, 0, 2)
        variance = own - np.swapaxes(columns, 1, 2) @ columns + _LEAST_VARIANCE * own
        changes = _squared(left, variance) - self.allowed
        inverse_of_chosen = scipy.linalg.cho_solve((factor, True), np.eye(size))
        forces = (inverse_of_chosen @ self.errors[chosen].reshape(size)).reshape(-1, p)
        blocks = inverse_of_chosen.reshape(len(chosen), p, len(chosen), p)
        of_each = blocks[np.arange(len(chosen)), :, np.arange(len(chosen))]
        changes[chosen] = self.allowed - _squared(forces, of_each)
        cost = float(whitened @ whitened) + self.allowed * (k - len(chosen))
        return cost, changes


def _squared(errors: Array, variance: Array) -> Array:
    """Squared Mahalanobis length of every error, (k,)."""
    weighted = np.linalg.solve(variance, errors[:, :, None])[:, :, 0]
    return np.asarray(np.einsum("ka,ka->k", errors, weighted))


def _linearised(graph: PoseGraph, edges: IntArray, poses: Poses) -> tuple[Array, Array, IntArray]:
    """Errors r (k, p) of edges, their derivative (k p, q p), and the q poses that they join.

    r is (R_ij^T (R_i^T (t_j - t_i) - t_ij), log(R_ij^T R_i^T R_j)), in the frame of the measured
    end, which is that of information matrices. Moves of a pose are (v, w) as in `Marginals`.
    """
    d = graph.d
    p = d + tangent_dimension(d)
    k = len(edges)
    i, j = graph.i[edges], graph.j[edges]
    measured: Motions = graph.R_ij[edges], graph.t_ij[edges]
    step = product(inverse((poses.R[i], poses.t[i])), (poses.R[j], poses.t[j]))
    error_R, error_t = product(inverse(measured), step)
    errors = np.concatenate([error_t, log_map(error_R)], axis=1)
    to_end = np.swapaxes(poses.R[i] @ measured[0], 1, 2)
    of_first = np.zeros((k, p, p))
    of_second = np.zeros((k, p, p))
    of_first[:, :d, :d] = -to_end
    of_second[:, :d, :d] = to_end
    if d == 3:
        of_first[:, :d, d:] = np.swapaxes(measured[0], 1, 2) @ hat(step[1])
        of_first[:, d:, d:] = -np.swapaxes(step[0], 1, 2)
        of_second[:, d:, d:] = np.eye(d)
    else:
        turned = np.column_stack([step[1][:, 1], -step[1][:, 0]])
        of_first[:, :d, d] = np.einsum("kba,kb->ka", measured[0], turned)
        of_first[:, d, d] = -1.0
        of_second[:, d, d] = 1.0
    ends, place = np.unique(np.concatenate([i, j]), return_inverse=True)
    derivative = np.zeros((k, p, len(ends), p))
    derivative[np.arange(k), :, place[:k]] += of_first
    derivative[np.arange(k), :, place[k:]] += of_second
    return errors, derivative.reshape(k * p, len(ends) * p), ends
