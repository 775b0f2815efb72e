"""Second stage of an extended model: Riemannian Newton by conjugate gradients on F plus smooth terms of one's own.

With G, (N, d), the gradient in X, and V_{R_i} = -hat(w_i) R_i^T, V_{t_i} = v_i^T a move, the gradient in (w, v) is the
adjoint of V on G, and the Hessian that on dG[V] - Lambda V, Lambda_i = sym(G_i R_i), with dG a difference of two G.
"""

from dataclasses import dataclass, replace

import cvxpy as cp
import numpy as np
from cvxpy.atoms.affine.affine_atom import AffAtom
from cvxpy.atoms.affine.index import index
from cvxpy.atoms.elementwise.power import Power
from cvxpy.atoms.pnorm import Pnorm

from pgo_models.certificates import newton_polish as polish
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
from solvers.convex.extended_soc import ExtendedSOC
from solvers.result import Measurement, Status
from solvers.riemannian.truncated_cg import truncated_conjugate_gradients

_DIFFERENCE = 1e-7  # beside the coordinates
_RADIUS = 1e3  # times the preconditioned gradient
_FORCING, _MOST_PRODUCTS = 1e-3, 1000
_KINK = 1e-5  # a norm below it counts as zero
_SMOOTH = (AffAtom, cp.exp, cp.logistic, cp.log_sum_exp, cp.QuadForm)


@dataclass(frozen=True, eq=False)
class ExtendedNewtonState:
    """State k."""

    k: int
    poses: Poses
    objective: float  # with all terms
    direction: Array  # (side,), in the order of `TangentLayout`: where the next step leads
    slope: float  # of the objective along it
    decrement: float  # half the squared Newton decrement less the rounding level, over the objective; inf at saddles
    model: GraphQP
    factor: CholeskyFactor  # of the Gauss-Newton matrix of F at the start, for preconditioning
    moved: bool = True


@dataclass(frozen=True)
class ExtendedNewton:
    """Newton on F plus terms without `kinks`, no constraints; the objective never rises.

    `dual_residual` is the relative decrement, `tolerance` the one on it; `changer` is as of `ExtendedSOC`.
    """

    changer: Changer
    tolerance: float = polish.STATIONARY_DECREMENT
    max_iterations: int = 100

    def __post_init__(self) -> None:
        check_settings(self, positive=["tolerance"], not_negative=["max_iterations"])

    def init(self, problem: PGOProblem, start: Poses | None) -> ExtendedNewtonState:
        """State 0, at `start`, or the chordal relaxation; a SettingError unless the cost is F, and for constraints."""
        start = start if start is not None else chordal_start(problem)
        model = ExtendedSOC(self.changer).model(problem)
        if model.change.constraints:
            raise SettingError("Newton takes terms without constraints; use ExtendedSOC, or write them as terms")
        factor = polish.factorize_model(problem, polish.start_polish(problem, start), second_order=False)[1]
        return _arrive(problem, 0, start, model, factor)

    def step(self, problem: PGOProblem, state: ExtendedNewtonState) -> ExtendedNewtonState:
        """The first of the moves direction, direction/2, .. that lowers the objective enough (Armijo)."""
        w, v = TangentLayout(problem.num_poses, problem.d).split(state.direction)
        for length in 0.5 ** np.arange(polish.HALVINGS):
            poses = polish.move_poses(state.poses, length * w, length * v)
            enough = (
                polish.SUFFICIENT * length * state.slope if length < 1.0 else polish.ROUNDING * abs(state.objective)
            )
            if state.model.cost(poses.stacked()) - state.objective <= enough:
                return _arrive(problem, state.k + 1, poses, state.model, state.factor)
        return replace(state, k=state.k + 1, moved=False)

    def measure(self, problem: PGOProblem, state: ExtendedNewtonState) -> Measurement:
        """Objective with all terms, and the relative decrement."""
        return Measurement(state.objective, 0.0, state.decrement)

    def poses(self, problem: PGOProblem, state: ExtendedNewtonState) -> Poses:
        """Poses of the state."""
        return state.poses

    def converged(self, state: ExtendedNewtonState, measurement: Measurement) -> Status | None:
        """CONVERGED within tolerance; STALLED when the last step could not move."""
        if measurement.dual_residual <= self.tolerance:
            return Status.CONVERGED
        return None if state.moved else Status.STALLED


def kinks(term: cp.Expression, is_flat: bool = False) -> set[str]:
    """Names of the atoms that may have a kink at the value of the variables; `is_flat` says that it is inside a square.

    A square is what is flat at zero, as huber and even powers: norms are smooth in it. Others need x >= 0.
    """
    if term.is_affine():
        return set()
    if isinstance(term, Pnorm):
        is_smooth = term.p == 2 and term.args[0].is_affine() and (is_flat or np.min(term.value) > _KINK)
        return set() if is_smooth else {"norm"}
    is_square = isinstance(term, cp.quad_over_lin) and term.args[1].is_constant()
    is_square |= isinstance(term, cp.huber) or (isinstance(term, Power) and term.p.value >= 2 and term.p.value % 2 == 0)
    if not (is_square or isinstance(term, _SMOOTH)):
        return {type(term).__name__}
    inside = is_square or (is_flat and isinstance(term, cp.multiply | cp.reshape | index))
    return set().union(*(kinks(part, inside) for part in term.args))


def _arrive(problem: PGOProblem, k: int, poses: Poses, model: GraphQP, factor: CholeskyFactor) -> ExtendedNewtonState:
    """State at poses, with the direction from there."""
    n, d, X = problem.num_poses, problem.d, poses.stacked()
    layout, G, objective, R = TangentLayout(n, d), model.gradient(X), model.cost(X), poses.R
    Lambda = G[n:].reshape(n, d, d) @ R
    Lambda = 0.5 * (Lambda + np.swapaxes(Lambda, 1, 2))

    def adjoint(U: Array) -> Array:
        return layout.join(-2.0 * vee(U[n:].reshape(n, d, d) @ R), U[:n])

    def hessian(move: Array) -> Array:
        w, v = layout.split(move)
        V = np.concatenate([v, (-hat(w) @ np.swapaxes(R, 1, 2)).reshape(d * n, d)])
        step = _DIFFERENCE * (1.0 + np.abs(X).max()) / np.abs(V).max()
        U = (model.gradient(X + step * V) - G) / step
        U[n:] -= (Lambda @ V[n:].reshape(n, d, d)).reshape(d * n, d)
        return adjoint(U)

    gradient = adjoint(G)
    radius = _RADIUS * np.sqrt(inner(gradient, factor.solve(gradient)))
    floor = 0.1 * polish.STATIONARY_DECREMENT * abs(objective)
    found = truncated_conjugate_gradients(gradient, hessian, factor.solve, radius, _FORCING, floor, _MOST_PRODUCTS)
    slope = inner(gradient, found.step)
    decrement = polish.scaled_decrement(-slope, abs(objective), rounding_level(problem, poses))
    decrement = np.inf if found.is_at_boundary else decrement
    return ExtendedNewtonState(k, poses, objective, found.step, slope, decrement, model, factor)
