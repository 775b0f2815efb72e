"""Second stage of an extended model: Riemannian Newton on F plus smooth added terms.

The Newton steps are computed by conjugate gradients. With G, (N, d), the gradient in X, and V_{R_i}
= -hat(w_i) R_i^T, V_{t_i} = v_i^T a move, the gradient in (w, v) is the adjoint of V applied to G.
The Hessian is the adjoint applied to dG[V] - Lambda V, with Lambda_i = sym(G_i R_i) and dG the
difference of two gradients.
"""

from dataclasses import dataclass, replace

import cvxpy as cp
import numpy as np
from cvxpy.atoms.affine.affine_atom import AffAtom
from cvxpy.atoms.affine.index import index
from cvxpy.atoms.elementwise.power import Power
from cvxpy.atoms.pnorm import Pnorm

from pgo_models.certificates.rounding_errors import rounding_level
from pgo_models.convex.graph_subproblem import Changer, GraphQP
from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, hat, vee
from pgo_models.problem.cholesky import CholeskyFactor
from pgo_models.problem.hessian import TangentLayout
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.matrices import inner
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.stationarity import STATIONARY_DECREMENT
from pgo_models.summaries import Summarised
from solvers.convex.extended_soc import ExtendedSOC
from solvers.result import Measurement, Status
from solvers.riemannian import newton_step
from solvers.riemannian.polish import factorize_gauss_newton
from solvers.riemannian.truncated_cg import truncated_conjugate_gradients

_DIFFERENCE = 1e-7  # step of the differences of gradients, relative to the coordinates
_RADIUS = 1e3  # trust radius of the conjugate gradients, times the preconditioned gradient
_FORCING = 1e-3  # relative residual at which the conjugate gradients stop
_MAX_PRODUCTS = 1000
_KINK = 1e-5  # a norm below it counts as zero
_SMOOTH = (AffAtom, cp.exp, cp.logistic, cp.log_sum_exp, cp.QuadForm)


@dataclass(frozen=True, eq=False)
class ExtendedNewtonState(Summarised):
    """Iterate k.

    Parameters
    ----------
    k : int
        Number of the iterate.
    poses : Poses
        Current poses.
    objective : float
        F with all terms there.
    direction : (side,) array
        Direction of the next step, in the order of `TangentLayout`.
    slope : float
        Slope of the objective in this direction.
    decrement : float
        Half the squared Newton decrement less the rounding level, over the objective; inf at
        saddles.
    model : GraphQP
        The model with its terms.
    factor : CholeskyFactor
        Of the Gauss-Newton matrix of F at the start, for preconditioning.
    moved : bool
        Whether the last step found a lower objective.
    """

    k: int
    poses: Poses
    objective: float
    direction: Array
    slope: float
    decrement: float
    model: GraphQP
    factor: CholeskyFactor
    moved: bool = True


@dataclass(frozen=True)
class ExtendedNewton:
    """Newton's method on F plus terms without `kinks` and without constraints.

    The objective never rises. `dual_residual` is the relative decrement.

    Parameters
    ----------
    changer : callable
        As of `ExtendedSOC`.
    tolerance : float
        On the relative decrement.
    max_iterations : int
        Iterations at most.
    """

    changer: Changer
    tolerance: float = STATIONARY_DECREMENT
    max_iterations: int = 100

    def __post_init__(self) -> None:
        check_settings(self, positive=["tolerance"], not_negative=["max_iterations"])

    def init(self, problem: PGOProblem, start: Poses | None) -> ExtendedNewtonState:
        """State 0 at `start`, the chordal relaxation unless given.

        A SettingError unless the cost is F, or if the model has constraints.
        """
        start = start if start is not None else chordal_start(problem)
        model = ExtendedSOC(self.changer).model(problem)
        if model.change.constraints:
            raise SettingError(
                "Newton takes terms without constraints; use ExtendedSOC, or write them as terms"
            )
        return _state_at(problem, 0, start, model, factorize_gauss_newton(problem, start))

    def step(self, problem: PGOProblem, state: ExtendedNewtonState) -> ExtendedNewtonState:
        """Make the first of the moves 1, 1/2, 1/4, .. of the direction that descends enough.

        The condition is Armijo's; the full move may also stay level to rounding.
        """
        w, v = TangentLayout(problem.num_poses, problem.d).split(state.direction)
        for length in 0.5 ** np.arange(newton_step.HALVINGS):
            poses = state.poses.moved_along(length * w, length * v)
            change = state.model.cost(poses.stacked()) - state.objective
            allowed_change = newton_step.SUFFICIENT * length * state.slope
            if length == 1.0:
                allowed_change = newton_step.ROUNDING * abs(state.objective)
            if change <= allowed_change:
                return _state_at(problem, state.k + 1, poses, state.model, state.factor)
        return replace(state, k=state.k + 1, moved=False)

    def measure(self, problem: PGOProblem, state: ExtendedNewtonState) -> Measurement:
        """Objective with all terms, and the relative decrement."""
        return Measurement(state.objective, 0.0, state.decrement)

    def poses(self, problem: PGOProblem, state: ExtendedNewtonState) -> Poses:
        """The poses of a state."""
        return state.poses

    def converged(self, state: ExtendedNewtonState, measurement: Measurement) -> Status | None:
        """CONVERGED within tolerance; STALLED when the last step could not move."""
        if measurement.dual_residual <= self.tolerance:
            return Status.CONVERGED
        return None if state.moved else Status.STALLED


def kinks(term: cp.Expression, is_flat: bool = False) -> set[str]:
    """Names of the atoms that may have a kink at the value of the variables.

    `is_flat` says that the term is inside a square: a function that is flat at zero, as Huber's
    loss and even powers are, so that norms are smooth inside. Other convex functions of a norm are
    not.
    """
    if term.is_affine():
        return set()
    if isinstance(term, Pnorm):
        is_euclidean = term.p == 2 and term.args[0].is_affine()
        is_smooth = is_euclidean and (is_flat or np.min(term.value) > _KINK)
        return set() if is_smooth else {"norm"}
    is_square = _is_square(term)
    if not (is_square or isinstance(term, _SMOOTH)):
        return {type(term).__name__}
    inside = is_square or (is_flat and isinstance(term, cp.multiply | cp.reshape | index))
    return set().union(*(kinks(part, inside) for part in term.args))


def _is_square(term: cp.Expression) -> bool:
    """Whether a term is flat where its argument is zero."""
    if isinstance(term, cp.quad_over_lin):
        return bool(term.args[1].is_constant())
    if isinstance(term, Power):
        return bool(term.p.value >= 2 and term.p.value % 2 == 0)
    return isinstance(term, cp.huber)


@dataclass(frozen=True, eq=False)
class _TangentModel:
    """Gradient and Hessian of the objective in the tangent coordinates (w, v) at poses."""

    model: GraphQP
    poses: Poses
    layout: TangentLayout
    X: Array  # (N, d): the poses, stacked
    G: Array  # (N, d): gradient in X

    @property
    def gradient(self) -> Array:
        """Gradient in (w, v), (side,)."""
        return self._adjoint(self.G)

    def hessian(self, move: Array) -> Array:
        """Hessian times a move, (side,)."""
        R = self.poses.R
        n, d, _ = R.shape
        w, v = self.layout.split(move)
        V_R = -hat(w) @ np.swapaxes(R, 1, 2)
        V = np.concatenate([v, V_R.reshape(d * n, d)])
        step = _DIFFERENCE * (1.0 + np.abs(self.X).max()) / np.abs(V).max()
        U = (self.model.gradient(self.X + step * V) - self.G) / step
        Lambda = self.G[n:].reshape(n, d, d) @ R
        Lambda = 0.5 * (Lambda + np.swapaxes(Lambda, 1, 2))
        U[n:] -= (Lambda @ V_R).reshape(d * n, d)
        return self._adjoint(U)

    def _adjoint(self, U: Array) -> Array:
        n, d, _ = self.poses.R.shape
        U_R = U[n:].reshape(n, d, d)
        return self.layout.join(-2.0 * vee(U_R @ self.poses.R), U[:n])


def _state_at(
    problem: PGOProblem, k: int, poses: Poses, model: GraphQP, factor: CholeskyFactor
) -> ExtendedNewtonState:
    """State k at poses, with the direction of the next step."""
    X = poses.stacked()
    layout = TangentLayout(problem.num_poses, problem.d)
    tangent = _TangentModel(model, poses, layout, X, model.gradient(X))
    objective = model.cost(X)
    gradient = tangent.gradient
    radius = _RADIUS * np.sqrt(inner(gradient, factor.solve(gradient)))
    floor = 0.1 * STATIONARY_DECREMENT * abs(objective)
    solution = truncated_conjugate_gradients(
        gradient, tangent.hessian, factor.solve, radius, _FORCING, floor, _MAX_PRODUCTS
    )
    slope = inner(gradient, solution.step)
    decrement = newton_step.scaled_decrement(-slope, abs(objective), rounding_level(problem, poses))
    if solution.is_at_boundary:
        decrement = np.inf
    return ExtendedNewtonState(k, poses, objective, solution.step, slope, decrement, model, factor)
