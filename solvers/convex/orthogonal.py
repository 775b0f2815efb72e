"""SOC for any convex cvxpy objective with orthogonality constraints.

This is the paper's Algorithm 1 without the pose graph:

    (a) X  = argmin J(X) + rho/2 ||X - P + B||^2     convex, cvxpy, compiled once
    (b) P  = projection of X + B                     closed form, SVD or normalisation
    (c) B  = B + X - P

A variable may be in two sets; it then has a copy P and a multiplier B for each.

Ebrahimi & Deghat, Algorithm 1; Lai & Osher 2014, Algorithm 1.
"""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Real

import numpy as np

from pgo_models.convex.convex_solver import COLD, ConvexSolver, as_solver
from pgo_models.convex.orthogonality import (
    OrthogonalPoint,
    OrthogonalProblem,
    SplitProblem,
    norm_of_all,
)
from pgo_models.convex.quadratic_form import NotQuadraticError, quadratic_form
from pgo_models.convex.quadratic_split import QuadraticSplit
from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.rotations import Array
from pgo_models.summaries import Summarised
from solvers.convex.model_newton import ModelNewton
from solvers.result import Measurement, Status
from solvers.soc.anderson import over_relax
from solvers.soc.penalty import PenaltyOrder, PenaltyRule

# The first penalty is found with at most so many solves of step (a). It is right when the relative
# distance of X from the start is between the two numbers: there the gradients at X and at the start
# are alike, and their difference is not rounding.
_MAX_PROBES = 12
_NEAR = 0.1
_FAINT = 1e-6
# Residuals are balanced every `_BALANCE_EVERY` iterations, when one is `_BALANCE_RATIO` times the
# other. After `_BALANCE_UNTIL` iterations rho is only raised, then and every `_RAISE_EVERY`
# iterations, so that the recursion can settle.
_BALANCE_EVERY = 5
_BALANCE_UNTIL = 100
_BALANCE_RATIO = 10.0
_RAISE_EVERY = 50
_HANDED_OVER = 6  # the iterate before which Newton takes its steps

AnySplit = SplitProblem | QuadraticSplit


@dataclass(frozen=True, eq=False)
class OrthogonalState(Summarised):
    """Iterate k.

    Parameters
    ----------
    k : int
        Number of the iterate.
    X : tuple of arrays
        Minimiser of step (a): the constrained variables.
    others : tuple of arrays
        The other variables of the problem there.
    copies : tuple of arrays
        P, one for every term of the problem (a variable in two sets has two).
    B : tuple of arrays
        Scaled multipliers, one for every term.
    rho : float
        Penalty.
    split : SplitProblem or QuadraticSplit
        Step (a), compiled or factored.
    scale : float
        Largest norm of a subgradient of J so far.
    primal_residual : float
        ||X - P|| / ||P||.
    dual_residual : float
        ||G + rho B|| / scale, with G the subgradient of J at X that step (a) gives. Since rho B is
        normal to the set at P, this is the stationarity residual of the KKT conditions. For one set
        a variable it is rho ||P - P_last|| / scale.
    """

    k: int
    X: tuple[Array, ...]
    others: tuple[Array, ...]
    copies: tuple[Array, ...]
    B: tuple[Array, ...]
    rho: float
    split: AnySplit
    scale: float = 0.0
    primal_residual: float = math.inf
    dual_residual: float = math.inf


@dataclass(frozen=True)
class OrthogonalSOC:
    """Splitting of orthogonality constraints for any convex objective (Lai & Osher 2014).

    The problem is not convex: a run ends at a stationary point that depends on the start, see
    `solve_orthogonal`.

    Parameters
    ----------
    penalty : float, PenaltyRule or None
        rho, fixed, as in Algorithm 1; or a rule as for `SOC`: `bounds` is given the norms of the
        gradient at the start, one a term, over the largest of them, m, and the largest of the rho_i
        is the first rho; `rescaling` moves it. Unless given, rho starts at `safeguard` times the
        norm of the gradient at the start and is adapted: residuals are balanced (Boyd et al. 2011,
        section 3.4.1, as in the paper), and rho is at least `safeguard` times the least penalty at
        which the copies are fixed points of their projection, the largest eigenvalue of the
        multiplier Lambda.
    alpha : float in (0, 2)
        Over-relaxation.
    safeguard : float above 1
        See `penalty`. Near 1 the recursion may cycle.
    tolerance : float
        On the primal and on the dual residual, both relative.
    max_iterations : int
        Iterations at most.
    solver : ConvexSolver or str
        Solver of step (a). Unless one is given, matrices of a quadratic model make step (a), and
        Clarabel without warm start that of others.
    x_step : SplitProblem, QuadraticSplit or None
        Step (a) of the problem, compiled or factored, in place of the one that `solver` gives.
    newton : ModelNewton or None
        Newton for the same quadratic model. It moves an early iterate to the stationary point
        nearby, which is a fixed point of SOC with the multipliers that it has there. SOC alone
        takes hundreds of iterations where J is flat.

    Raises
    ------
    SettingError
        If a setting is out of its range.

    References
    ----------
    Lai & Osher, A splitting method for orthogonality constrained problems, 2014.

    Examples
    --------
    The point of the unit circle that is nearest to (3, 4):

    >>> import cvxpy as cp
    >>> from solvers import run
    >>> x = cp.Variable(2)
    >>> distance = cp.Problem(cp.Minimize(cp.sum_squares(x - np.array([3.0, 4.0]))))
    >>> result = run(OrthogonalSOC(), OrthogonalProblem(distance, unit_columns=[x]))
    >>> result.status.name, result.state.copies[0].round(3).tolist()
    ('CONVERGED', [0.6, 0.8])
    """

    penalty: float | PenaltyRule | None = None
    alpha: float = 1.0
    safeguard: float = 2.0
    tolerance: float = 1e-6
    max_iterations: int = 1000
    solver: ConvexSolver | str = COLD
    x_step: AnySplit | None = None
    newton: ModelNewton | None = None

    def __post_init__(self) -> None:
        finite = ["safeguard", "tolerance"]
        penalty: object = self.penalty  # a number of any type, as 3
        if isinstance(penalty, Real):
            object.__setattr__(self, "penalty", float(penalty))
            finite.insert(0, "penalty")
        check_settings(self, finite=finite, not_negative=["max_iterations"])
        check_settings(self, above_one=["safeguard"], relaxation=["alpha"])
        as_solver(self.solver)  # raises unless it is installed

    def init(self, problem: OrthogonalProblem, start: OrthogonalPoint | None) -> OrthogonalState:
        """State 0: X = P = start, the first columns of the identity unless given.

        A SettingError if the start does not fit.
        """
        if start is None:
            start = problem.point([_identity(variable.shape) for variable in problem.variables])
        problem.check_point(start)
        split = self.split(problem)
        rho = self._first_penalty(split, start)
        X = problem.values(start.copies)
        B = tuple(normal / rho for normal in start.normals)
        V = [P - b for P, b in zip(start.copies, B, strict=True)]
        _, others = split.solve(V, rho)
        return OrthogonalState(0, X, others, start.copies, B, rho, split.at(rho))

    def step(self, problem: OrthogonalProblem, state: OrthogonalState) -> OrthogonalState:
        """Make one iteration: (a), (b), (c)."""
        if self.newton is not None and state.k + 1 == _HANDED_OVER:
            state = self._handed_over(self.newton, problem, state)
        state = self._with_due_penalty(problem, state)
        # One P, B, V and x for every term; x is the X of the term's variable.
        V = [P - B for P, B in zip(state.copies, state.B, strict=True)]
        X, others = state.split.solve(V, state.rho)  # (a)
        S = []
        for term, P, B in zip(problem.terms, state.copies, state.B, strict=True):
            S.append(over_relax(X[term.variable], P, self.alpha) + B)
        terms = zip(problem.terms, S, strict=True)
        copies = tuple(term.constraint.project(s) for term, s in terms)  # (b)
        multipliers = tuple(s - P for s, P in zip(S, copies, strict=True))  # (c)
        following = replace(state, k=state.k + 1, X=X, others=others, copies=copies, B=multipliers)
        return _with_residuals(problem, V, following)

    def measure(self, problem: OrthogonalProblem, state: OrthogonalState) -> Measurement:
        """J at the copies (those in a variable's first set), and the residuals."""
        objective, infeasibility = state.split.measured(state.copies, state.others)
        return Measurement(objective, state.primal_residual, state.dual_residual, infeasibility)

    def converged(self, state: OrthogonalState, measurement: Measurement) -> Status | None:
        """CONVERGED when both residuals are within tolerance."""
        worst = max(measurement.primal_residual, measurement.dual_residual)
        return Status.CONVERGED if worst <= self.tolerance else None

    def split(self, problem: OrthogonalProblem) -> AnySplit:
        """Make step (a) of a problem: matrices of a quadratic model, or the convex solver."""
        if self.x_step is not None:
            return self.x_step
        if self.solver == COLD:
            with contextlib.suppress(NotQuadraticError):
                form = quadratic_form(problem)
                if not form.limits_x:  # constraints beside the sets are left to a convex solver
                    return QuadraticSplit(problem, form)
        return problem.split(self.solver)

    def _handed_over(
        self, newton: ModelNewton, problem: OrthogonalProblem, state: OrthogonalState
    ) -> OrthogonalState:
        """The state at which SOC begins from where Newton ends, with a penalty that holds it."""
        if not isinstance(state.split, QuadraticSplit):
            raise SettingError("newton is for step (a) by matrices; leave x_step and solver alone")
        u = newton.polish(newton.form.u_of(problem.values(state.copies)))
        start = state.split.stationary_point(u)
        return replace(self.init(problem, start), k=state.k, scale=state.scale)

    def point(self, problem: OrthogonalProblem, state: OrthogonalState) -> OrthogonalPoint:
        """Return the copies and the multipliers rho B of a state, from which a run can go on."""
        normals = []
        for term, P, B in zip(problem.terms, state.copies, state.B, strict=True):
            normals.append(term.constraint.normal_part(P, state.rho * B))
        return OrthogonalPoint(state.copies, tuple(normals))

    # The penalty.

    def _first_penalty(self, split: AnySplit, point: OrthogonalPoint) -> float:
        """The first rho, from the norms of the gradient at the start, one a term.

        The gradient is minus the multipliers of the start, if it has any. Of zero ones rho is 1.
        """
        if isinstance(self.penalty, float):
            return self.penalty
        norms = np.array([_spectral_norm(normal) for normal in point.normals])
        if not norms.any():
            norms = _probed_gradient(split, point)
        largest = float(norms.max())
        if largest == 0.0:
            return 1.0
        if self.penalty is None:
            return self.safeguard * largest
        order = PenaltyOrder(*self.penalty.bounds(norms / largest))
        return float(order.rho(norms, np.full(len(norms), largest)).max())

    def _with_due_penalty(
        self, problem: OrthogonalProblem, state: OrthogonalState
    ) -> OrthogonalState:
        """State with the penalty for the next step; usually unchanged."""
        if isinstance(self.penalty, float):
            return state
        if self.penalty is not None:
            is_first = state.k == 0
            residuals = state.primal_residual, state.dual_residual
            rho = state.rho if is_first else state.rho * self.penalty.rescaling(*residuals)
        else:
            rho = self._adapted_penalty(problem, state)
        if rho == state.rho:
            return state
        B = tuple(state.rho / rho * B for B in state.B)
        return replace(state, rho=rho, B=B, split=state.split.at(rho))

    def _adapted_penalty(self, problem: OrthogonalProblem, state: OrthogonalState) -> float:
        least_penalties = []
        for term, P, B in zip(problem.terms, state.copies, state.B, strict=True):
            least_penalties.append(term.constraint.least_penalty(P, state.rho * B))
        least = self.safeguard * max(least_penalties)
        primal = state.primal_residual
        dual = state.dual_residual
        if state.k > _BALANCE_UNTIL and state.k % _RAISE_EVERY == 0:
            return max(2.0 * state.rho, least)
        if state.k % _BALANCE_EVERY == 0 and 0 < state.k <= _BALANCE_UNTIL:
            if primal > min(_NEAR, _BALANCE_RATIO * dual):
                return max(2.0 * state.rho, least)
            if dual > _BALANCE_RATIO * primal:
                return max(0.5 * state.rho, least)
        return max(state.rho, least)


def _probed_gradient(split: AnySplit, point: OrthogonalPoint) -> Array:
    """Norms of the gradient at a start without multipliers, one a term.

    Step (a) gives the gradient at its solution X. rho is moved by tens until X is near the start,
    where the gradients are alike, or comes no nearer.
    """
    rho = 1.0
    size = _size_of(point.copies)
    was_far = False
    norms = np.zeros(len(point.copies))
    distance = math.inf
    for _ in range(_MAX_PROBES):
        X, _ = split.solve(point.copies, rho)
        moves = [
            P - X[term.variable] for P, term in zip(point.copies, split.problem.terms, strict=True)
        ]
        distance_before = distance
        distance = norm_of_all(moves) / size
        if was_far and distance > 0.5 * distance_before:
            # Convex constraints, or J itself, hold X away from the start: begin with a low penalty
            # and let the rule raise it.
            break
        norms = rho * np.array([_spectral_norm(move) for move in moves])
        is_far = distance > _NEAR
        if not is_far and (was_far or distance >= _FAINT):
            break
        was_far = was_far or is_far
        rho *= 10.0 if is_far else 1e-3
    return norms


def _size_of(copies: Sequence[Array]) -> float:
    """What a distance of copies is relative to; 1 at zero, which a set of one's own may hold."""
    return norm_of_all(copies) or 1.0


def _with_residuals(
    problem: OrthogonalProblem, V: Sequence[Array], state: OrthogonalState
) -> OrthogonalState:
    """State after the step from shifts V, with its residuals."""
    X_of_terms = [state.X[term.variable] for term in problem.terms]
    subgradients = [state.rho * (v - x) for v, x in zip(V, X_of_terms, strict=True)]
    G = problem.sums(subgradients)
    N = problem.sums([state.rho * B for B in state.B])
    scale = max(state.scale, norm_of_all(G), np.finfo(float).tiny)
    disagreement = [x - P for x, P in zip(X_of_terms, state.copies, strict=True)]
    imbalance = [g + n for g, n in zip(G, N, strict=True)]
    return replace(
        state,
        scale=scale,
        primal_residual=norm_of_all(disagreement) / _size_of(state.copies),
        dual_residual=norm_of_all(imbalance) / scale,
    )


def _identity(shape: tuple[int, ...]) -> Array:
    """First columns of the identity, in the shape of a variable, which may be a vector."""
    rows = shape[0]
    columns = math.prod(shape) // rows
    return np.eye(rows, columns).reshape(shape)


def _spectral_norm(array: Array) -> float:
    """Largest singular value; of a vector its norm."""
    return float(np.linalg.norm(array.reshape(len(array), -1), 2))
