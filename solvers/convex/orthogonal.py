"""SOC for any convex cvxpy objective with orthogonality constraints: the paper's Algorithm 1 without the pose graph.

    (a) X  = argmin J(X) + rho/2 ||X - P + B||^2     convex, cvxpy, compiled once
    (b) P  = projection of X + B                     closed form, SVD or normalisation
    (c) B  = B + X - P

Ebrahimi & Deghat, Algorithm 1 (`algo1: SOC`); Lai & Osher 2014, Algorithm 1.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.convex import orthogonality
from pgo_models.convex.convex_solver import COLD, ConvexSolver
from pgo_models.convex.orthogonality import OrthogonalPoint, OrthogonalProblem, SplitProblem, norm_of_all
from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.rotations import Array
from solvers.loop import run
from solvers.result import Measurement, Outcome, Status
from solvers.soc.anderson import over_relax

_PROBES = 12
_NEAR = 0.1  # a relative distance at which gradients are alike, and SOC is no longer going round
_FAINT = 1e-6  # their difference is rounding
_BALANCE_EVERY = 5  # iterations
_BALANCE_UNTIL = 500  # then rho is only raised, so that the recursion can settle
_BALANCE_RATIO = 10.0


@dataclass(frozen=True, eq=False)
class OrthogonalState:
    """Iterate k."""

    k: int
    # X, others: minimisers of step (a): the constrained variables, and the other variables of the problem.
    X: tuple[Array, ...]
    others: tuple[Array, ...]
    copies: tuple[Array, ...]  # P, one for every term of the problem (a variable in two sets has two)
    B: tuple[Array, ...]  # scaled multipliers, one for every term
    rho: float  # penalty
    split: SplitProblem  # the compiled step (a)
    scale: float = 0.0  # largest norm of a subgradient of J so far
    primal_residual: float = math.inf  # ||X - P|| / ||P||
    # ||G + rho B|| / scale, G the subgradient of J at X that step (a) gives: since rho B is normal to the set at P,
    # this is the stationarity residual of the KKT conditions. For one set a variable it is rho ||P - P_before||.
    dual_residual: float = math.inf


@dataclass(frozen=True)
class OrthogonalSOC:
    """Splitting of orthogonality constraints for any convex objective (Lai & Osher 2014).

    The problem is not convex: a run ends at a stationary point that depends on the start, see `solve_orthogonal`.

    `penalty` is rho, fixed, as in Algorithm 1. Unless given, rho starts at `safeguard` times the norm of the gradient
    at the start and is adapted: residuals are balanced (Boyd et al. 2011, 3.4.1, as in the paper), and rho is at least
    `safeguard` times the least penalty at which the copies are fixed points of their projection, the largest eigenvalue
    of the multiplier Lambda. Near 1 the recursion may cycle.

    `alpha` is the over-relaxation, in (0, 2), `tolerance` is on the primal and the dual residual, both relative, and
    `solver` is that of step (a): Clarabel, cold, unless given.
    """

    penalty: float | None = None
    alpha: float = 1.0
    safeguard: float = 2.0
    tolerance: float = 1e-6
    max_iterations: int = 1000
    solver: ConvexSolver | str = COLD

    def __post_init__(self) -> None:
        check_settings(self, finite=["penalty", "safeguard", "tolerance"], not_negative=["max_iterations"])
        check_settings(self, above_one=["safeguard"], relaxation=["alpha"])

    def init(self, problem: OrthogonalProblem, start: OrthogonalPoint | None) -> OrthogonalState:
        """State 0: X = P = start, first columns of the identity unless given; a SettingError if it does not fit."""
        if (point := start) is None:
            columns = [np.eye(v.shape[0], v.size // v.shape[0]).reshape(v.shape) for v in problem.variables]
            point = problem.point(columns)
        problem.check_point(point)
        split = problem.split(self.solver)
        rho, others = self._first_penalty(split, point)
        B = tuple(normal / rho for normal in point.normals)
        return OrthogonalState(0, problem.values(point.copies), others, point.copies, B, rho, split)

    def step(self, problem: OrthogonalProblem, state: OrthogonalState) -> OrthogonalState:
        """One iteration: (a), (b), (c)."""
        state = self._with_penalty_due(problem, state)
        rho, copies = state.rho, state.copies
        V = [P - B for P, B in zip(copies, state.B, strict=True)]
        X, others = state.split.solve(V, rho)  # (a)
        spread = [X[term.variable] for term in problem.terms]
        S = [over_relax(x, P, self.alpha) + B for x, P, B in zip(spread, copies, state.B, strict=True)]
        following = tuple(term.constraint.project(s) for term, s in zip(problem.terms, S, strict=True))  # (b)
        B = tuple(s - P for s, P in zip(S, following, strict=True))  # (c)
        G = _summed(problem, [rho * (v - x) for v, x in zip(V, spread, strict=True)])
        N = _summed(problem, [rho * b for b in B])
        scale = max(state.scale, norm_of_all(G), np.finfo(float).tiny)
        primal = norm_of_all([x - P for x, P in zip(spread, following, strict=True)]) / norm_of_all(following)
        dual = norm_of_all([g + n for g, n in zip(G, N, strict=True)]) / scale
        state = replace(state, k=state.k + 1, X=X, others=others, copies=following, B=B)
        return replace(state, scale=scale, primal_residual=primal, dual_residual=dual)

    def measure(self, problem: OrthogonalProblem, state: OrthogonalState) -> Measurement:
        """J at the copies (in a variable's first set) and the other variables, and the residuals."""
        infeasibility = problem.infeasibility(state.copies, state.others)
        objective = problem.objective(problem.values(state.copies), state.others)
        return Measurement(objective, state.primal_residual, state.dual_residual, infeasibility)

    def converged(self, state: OrthogonalState, measurement: Measurement) -> Status | None:
        """CONVERGED when both residuals are within tolerance."""
        worst = max(measurement.primal_residual, measurement.dual_residual)
        return Status.CONVERGED if worst <= self.tolerance else None

    def point(self, problem: OrthogonalProblem, state: OrthogonalState) -> OrthogonalPoint:
        """Copies and multipliers of a state, from which a run can go on."""
        terms = zip(problem.terms, state.copies, state.B, strict=True)
        normals = tuple(term.constraint.normal_part(P, state.rho * B) for term, P, B in terms)
        return OrthogonalPoint(state.copies, normals)

    def _first_penalty(self, split: SplitProblem, point: OrthogonalPoint) -> tuple[float, tuple[Array, ...]]:
        """`penalty`, or `safeguard` times the norm of the gradient at the start; and the other variables there.

        The gradient is minus the multipliers of the start. If it has none, step (a) gives the gradient at X: rho is
        moved by tens until X is near the start, where the gradients are alike, or comes no nearer.
        """
        multiplier = max(_spectral(N) for N in point.normals)
        if self.penalty is not None or multiplier > 0.0:
            rho = self.penalty if self.penalty is not None else self.safeguard * multiplier
            return rho, split.solve([P - N / rho for P, N in zip(point.copies, point.normals, strict=True)], rho)[1]
        rho, was_far, gradient, distance = 1.0, False, 0.0, math.inf
        for _ in range(_PROBES):
            X, others = split.solve(point.copies, rho)
            moves = [P - X[term.variable] for P, term in zip(point.copies, split.terms, strict=True)]
            before, distance = distance, norm_of_all(moves) / norm_of_all(point.copies)
            if was_far and distance > 0.5 * before:
                break  # held away, by convex constraints or by J itself: start low, and let the rule raise rho
            gradient = rho * max(_spectral(move) for move in moves)
            if distance <= _NEAR and (was_far or distance >= _FAINT):
                break
            was_far = was_far or distance > _NEAR
            rho *= 10.0 if distance > _NEAR else 1e-3
        return (self.safeguard * gradient if gradient > 0.0 else 1.0), others

    def _with_penalty_due(self, problem: OrthogonalProblem, state: OrthogonalState) -> OrthogonalState:
        """State with the rho that the rule of `penalty` wants from now on; mostly the state itself."""
        if self.penalty is not None:
            return state
        rho, terms = state.rho, zip(problem.terms, state.copies, state.B, strict=True)
        least = self.safeguard * max(term.constraint.least_penalty(P, rho * B) for term, P, B in terms)
        wanted = max(rho, least)
        if state.k % _BALANCE_EVERY == 0 and 0 < state.k <= _BALANCE_UNTIL:
            if state.primal_residual > min(_NEAR, _BALANCE_RATIO * state.dual_residual):
                wanted = max(2.0 * rho, least)
            elif state.dual_residual > _BALANCE_RATIO * state.primal_residual:
                wanted = max(0.5 * rho, least)
        if wanted == rho:
            return state
        return replace(state, rho=wanted, B=tuple(rho / wanted * scaled for scaled in state.B))


@dataclass(frozen=True, eq=False)
class OrthogonalSolution:
    """The best of several runs."""

    problem: OrthogonalProblem  # its cvxpy variables hold the solution
    # values, others: for every variable in problem.variables and in problem.others, of its shape.
    values: tuple[Array, ...]
    others: tuple[Array, ...]
    objective: float  # J there
    kkt: orthogonality.KKTResiduals  # computed afresh by one convex solve
    outcome: Outcome[OrthogonalState]  # the run it came from: status, history, state
    objectives: tuple[float, ...]  # J of every start, nan where a run did not converge

    @property
    def status(self) -> Status:
        """How the run ended."""
        return self.outcome.status

    def __repr__(self) -> str:
        best = f"J = {self.objective:.10g}, stationarity {self.kkt.stationarity:.1e}"
        kkt = f"{best}, feasibility {self.kkt.feasibility:.1e}"
        return f"OrthogonalSolution({self.status.name}, {kkt}, {len(self.objectives)} starts)"


def solve_orthogonal(
    problem: OrthogonalProblem,
    rng: np.random.Generator,
    soc: OrthogonalSOC | None = None,
    starts: int = 5,
    *,
    verbose: bool = False,
) -> OrthogonalSolution:
    """Run SOC from random starts and keep the best: converged first, then the lowest J.

    Nothing proves that the best of the stationary points found is the global minimum. `verbose` prints every run's
    table. A SettingError when starts is below 1, a PGOError when the convex subproblem has no solution.

    Examples
    --------
    >>> import cvxpy as cp, numpy as np
    >>> x = cp.Variable(2)
    >>> problem = OrthogonalProblem(cp.Problem(cp.Minimize(cp.sum_squares(x - [3.0, 4.0]))), unit_columns=[x])
    >>> solve_orthogonal(problem, np.random.default_rng(0)).values[0].round(4).tolist()
    [0.6, 0.8]
    """
    if starts < 1:
        raise SettingError(f"starts must be at least 1, got {starts}")
    method = soc if soc is not None else OrthogonalSOC()
    outcomes = list[Outcome[OrthogonalState]]()
    for _ in range(starts):
        outcomes.append(run(method, problem, problem.random_point(rng), verbose=verbose))
        if outcomes[-1].status is Status.INTERRUPTED:
            break
    best = min(outcomes, key=lambda outcome: (not outcome.status.is_success, outcome.objective))
    values = problem.values(best.state.copies)
    kkt = orthogonality.kkt_residuals(problem, method.point(problem, best.state), best.state.rho, method.solver)
    problem.assign(values, best.state.others)
    objectives = tuple(outcome.objective if outcome.status.is_success else math.nan for outcome in outcomes)
    return OrthogonalSolution(problem, values, best.state.others, best.objective, kkt, best, objectives)


def _summed(problem: OrthogonalProblem, of_terms: Sequence[Array]) -> list[Array]:
    sums = [np.zeros(variable.shape) for variable in problem.variables]
    for term, array in zip(problem.terms, of_terms, strict=True):
        sums[term.variable] += array
    return sums


def _spectral(array: Array) -> float:
    return float(np.linalg.norm(array.reshape(len(array), -1), 2))
