"""Choice of loop closures in the linear theory: the set of the least truncated cost, by exchange.

A map that few closures hold bends to fit a wrong one, and no change of one closure at a time then
lowers the truncated cost. In the linear theory thousands of sets can be compared in a second. At
the poses of a map let H be half the Hessian of the cost of the edges that stay, r_e the error of a
closure e, A_e its derivative and C_e its covariance. With the closures of a set S the least cost
is, up to a constant and to first order,

    F(S) = u_S^T (C_S + A_S H^-1 A_S^T)^-1 u_S,     u = r - A H^-1 g,

with g half the gradient of the edges that stay. At stationary poses of these and the closures kept,
g = -sum over the kept of A_e^T C_e^-1 r_e. With c^2 the threshold of the truncated cost, the set of
the least F(S) + sum of c^2 over the others is looked for by tabu search (Glover, "Tabu search, part
I", ORSA Journal on Computing 1989): in every step the best change of one closure is made, even if
it raises the cost, and that closure stays as it is for some steps, whose number varies (Taillard,
"Robust taboo search for the quadratic assignment problem", Parallel Computing 1991).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian
from pgo_models.problem.marginals import Marginals
from pgo_models.problem.problem import PGOProblem
from solvers.robust.chains import squared_lengths
from solvers.robust.distances import linearised_errors

# Steps of the search, those in a row without a better set, and those for which a closure stays as
# it is at most.
_MOST_STEPS = 300
_MOST_WITHOUT_SUCCESS = 100
_TENURE = 7


@dataclass(frozen=True, eq=False)
class LinearChoice:
    """Model of k closures at the poses of a map.

    `errors` (k, p) are u, `covariance` (k p, k p) is C + A H^-1 A^T, and `allowed` is c^2.
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

        The poses are stationary for the edges that stay and the closures `kept`, (s,) places among
        the k.
        A NotPositiveDefiniteError where these do not hold the poses.
        """
        edges, measured = closures
        k, p, _ = measured.shape
        errors, of_ends = linearised_errors(graph, edges, poses)
        ends, place = np.unique([graph.i[edges], graph.j[edges]], return_inverse=True)
        blocks = np.zeros((k, p, len(ends), p))
        for of_end, places in zip(of_ends, place.reshape(2, k), strict=True):
            blocks[np.arange(k), :, places] += of_end
        derivative = blocks.reshape(k * p, len(ends) * p)
        hessian = riemannian_hessian(staying.at(poses), None)
        layout = TangentLayout(staying.num_poses, staying.d)
        joint = Marginals(hessian, layout, backend=staying.backend).joint(*ends.tolist())
        moved = (derivative @ joint @ derivative.T).reshape(k, p, k, p)
        forces = np.linalg.solve(measured, errors[:, :, None])[:, :, 0]
        errors = errors + np.einsum("kasb,sb->ka", moved[:, :, kept], forces[kept])
        moved[np.arange(k), :, np.arange(k)] += measured
        return cls(errors, moved.reshape(k * p, k * p), allowed)

    def best(self, chosen: IntArray, has_time: Callable[[], bool] = lambda: True) -> IntArray:
        """The best set found from the closures chosen, (s,).

        The search ends early once `has_time` is false.
        """
        k = len(self.errors)
        current = self.choose(chosen)
        best = current.chosen.copy()
        least_cost = np.inf
        best_step = 0
        free_at = np.zeros(k, dtype=int)
        for step in range(_MOST_STEPS):
            if current.cost < least_cost:
                least_cost = current.cost
                best = current.chosen.copy()
                best_step = step
            if step - best_step >= _MOST_WITHOUT_SUCCESS or not has_time():
                break
            changes = current.changes()
            # A closure that has to stay as it is may change all the same for a new best set.
            is_allowed = (free_at <= step) | (current.cost + changes < least_cost)
            if not is_allowed.any():
                break
            e = int(np.where(is_allowed, changes, np.inf).argmin())
            current.change(e)
            # One step more now and then, so that no cycle of changes comes round again and again.
            free_at[e] = step + 1 + max(1, min(_TENURE, k // 4)) + (step % 3 == 0)
        return np.flatnonzero(best)

    def choose(self, chosen: IntArray) -> SweptChoice:
        """The model with some closures chosen, (s,)."""
        k = len(self.errors)
        none = np.zeros(k, dtype=bool)
        choice = SweptChoice(
            self.covariance.copy(), self.errors.copy(), none, self.allowed, k * self.allowed
        )
        for e in chosen.tolist():
            choice.change(e)
        return choice


@dataclass(eq=False)
class SweptChoice:
    """A choice of closures, which is changed in place, one closure at a time.

    With the chosen closures S and the others J, and V the covariance, the sweep operator
    (Goodnight, "A tutorial on the SWEEP operator", The American Statistician 1979) keeps
    V_JJ - V_JS V_SS^-1 V_SJ and -V_SS^-1 on the diagonal of `matrix`, (k p, k p), V_SS^-1 V_SJ
    beside them, and u_J - V_JS V_SS^-1 u_S and V_SS^-1 u_S in `errors`, (k, p). `chosen` (k,) says
    which are in S; `cost` is F(S) and `allowed` for each of the others.
    """

    matrix: Array
    errors: Array
    chosen: BoolArray
    allowed: float
    cost: float

    def changes(self) -> Array:
        """How the cost changes when each closure, (k,), comes or goes."""
        # The blocks of chosen closures are negative definite.
        k, p = self.errors.shape
        blocks = self.matrix.reshape(k, p, k, p)[np.arange(k), :, np.arange(k)]
        return squared_lengths(self.errors, blocks) + np.where(
            self.chosen, self.allowed, -self.allowed
        )

    def change(self, e: int) -> None:
        """Take closure e in, or out if it is chosen."""
        p = self.errors.shape[1]
        block = slice(e * p, (e + 1) * p)
        sign = -1.0 if self.chosen[e] else 1.0
        inverse_block = np.linalg.inv(self.matrix[block, block])
        rows = inverse_block @ self.matrix[block]
        columns = self.matrix[:, block].copy()
        error = inverse_block @ self.errors[e]
        self.cost += float(self.errors[e] @ error) - sign * self.allowed
        self.matrix -= columns @ rows
        self.errors -= (columns @ error).reshape(self.errors.shape)
        self.matrix[block] = sign * rows
        self.matrix[:, block] = sign * columns @ inverse_block
        self.matrix[block, block] = -inverse_block
        self.errors[e] = sign * error
        self.chosen[e] = not self.chosen[e]
