"""Bregman iteration for min J(x) s.t. K x = f, in the forms of the paper's section 2, to step through and compare.

    Bregman             p   <- p - alpha K^T (K x - f)  x minimises the Bregman distance + penalty    (`update B`)
    TwoLineBregman      b   <- b + K x - f              x minimises J + alpha/2 ||Kx - f + b||^2      (`bregman update`)
    MethodOfMultipliers lam <- lam + alpha (f - K x)    x minimises the augmented Lagrangian          (`minbregman`)
    AlternatingBregman  lam <- lam + alpha (f - K x)    x by T passes over its blocks; T = 1 is ADMM  (`bregman ADMM`)

The first three have the same x, with p = K^T lam and lam = -alpha b. Osher et al. 2005; Yin et al. 2008; Esser 2009.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.convex import bregman as forms
from pgo_models.convex.bregman import BregmanPoint, BregmanProblem, Subproblem
from pgo_models.convex.convex_solver import COLD, TOLERANCE, ConvexSolver, finite_array
from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.rotations import Array
from solvers.result import Measurement, Status


@dataclass(frozen=True, eq=False)
class _ExactState:
    """Iterate k of a form that minimises over the whole of x: every one after the first step is stationary."""

    k: int
    x: Array  # (m,)
    subproblem: Subproblem  # compiled

    @property
    def stationarity(self) -> float:
        """Distance of 0 from the subdifferential of the Lagrangian; inf before the first step."""
        return 0.0 if self.k > 0 else math.inf


@dataclass(frozen=True, eq=False)
class BregmanState(_ExactState):
    """Iterate k of `Bregman`."""

    p: Array  # (m,): a subgradient of J at x


@dataclass(frozen=True, eq=False)
class TwoLineState(_ExactState):
    """Iterate k of `TwoLineBregman`."""

    b: Array  # (s,): the residuals added up


@dataclass(frozen=True, eq=False)
class MultiplierState(_ExactState):
    """Iterate k of `MethodOfMultipliers`."""

    lam: Array  # (s,): multiplier of K x = f


@dataclass(frozen=True, eq=False)
class AlternatingState:
    """Iterate k of `AlternatingBregman`."""

    k: int
    x: Array  # (m,)
    lam: Array  # (s,): multiplier of K x = f
    subproblems: tuple[Subproblem, ...]  # one for every block
    # Distance of 0 from the subdifferential of the Lagrangian at x and lam; inf before the first step.
    stationarity: float = math.inf


@dataclass(frozen=True)
class BregmanSettings:
    """Settings that all forms share.

    `alpha` is the penalty of the paper's section 2; lam has the unit of alpha K x. `tolerance` is on ||K x - f|| over
    max(1, ||f||) and the distance from stationarity over max(1, ||K^T lam||). `subproblem_tolerance` is the solver's:
    loosen it to see errors of subproblems forgotten (Yin & Osher 2013). `solver` is Clarabel, cold, unless given.
    """

    alpha: float = 1.0
    tolerance: float = 1e-6
    max_iterations: int = 1000
    subproblem_tolerance: float = TOLERANCE
    solver: ConvexSolver | str = COLD

    def __post_init__(self) -> None:
        check_settings(self, finite=["alpha", "tolerance", "subproblem_tolerance"], not_negative=["max_iterations"])

    def compiled(self, subproblem: Subproblem) -> Subproblem:
        """The subproblem with the solver of these settings."""
        return replace(subproblem, tolerance=self.subproblem_tolerance, solver=self.solver)

    def measure(self, problem: BregmanProblem, state: _ExactState | AlternatingState) -> Measurement:
        """J(x), ||K x - f||, relative, and the distance from stationarity, relative."""
        infeasibility = float(np.linalg.norm(problem.residual(state.x)))
        primal = infeasibility / max(1.0, float(np.linalg.norm(problem.f)))
        return Measurement(problem.objective(state.x), primal, state.stationarity, infeasibility)

    def converged(self, state: _ExactState | AlternatingState, measurement: Measurement) -> Status | None:
        """CONVERGED when both residuals are within tolerance, after at least one step."""
        worst = max(measurement.primal_residual, measurement.dual_residual)
        return Status.CONVERGED if worst <= self.tolerance else None


@dataclass(frozen=True)
class Bregman(BregmanSettings):
    """Bregman iteration with subgradients (paper: `update B`; Osher et al. 2005). Settings: `BregmanSettings`.

    x^{k+1} = argmin J(x) - J(x^k) - <p^k, x - x^k> + alpha/2 ||K x - f||^2
    p^{k+1} = p^k - alpha K^T (K x^{k+1} - f), a subgradient of J at x^{k+1}
    """

    def init(self, problem: BregmanProblem, start: BregmanPoint | None) -> BregmanState:
        """State 0 at `start`, else at x = 0 and p = 0."""
        point = _checked_start(problem, start)
        subproblem = self.compiled(forms.bregman_subproblem(problem, self.alpha))
        return BregmanState(0, point.x, subproblem, np.asarray(problem.K.T @ point.lam))

    def step(self, problem: BregmanProblem, state: BregmanState) -> BregmanState:
        """One iteration."""
        x = state.subproblem.solve(state.p)
        p = state.p - self.alpha * (problem.K.T @ problem.residual(x))
        return BregmanState(state.k + 1, x, state.subproblem, p)

    def point(self, problem: BregmanProblem, state: BregmanState) -> BregmanPoint:
        """x, and the least-squares lam of p = K^T lam."""
        return BregmanPoint(state.x, np.linalg.lstsq(problem.K.T.toarray(), state.p, rcond=None)[0])


@dataclass(frozen=True)
class TwoLineBregman(BregmanSettings):
    """Bregman iteration in two lines (paper: `bregman update`; Yin et al. 2008). Settings: `BregmanSettings`.

    x^{k+1} = argmin J(x) + alpha/2 ||K x - f + b^k||^2,    b^{k+1} = b^k + K x^{k+1} - f
    """

    def init(self, problem: BregmanProblem, start: BregmanPoint | None) -> TwoLineState:
        """State 0 at `start`, else at x = 0 and b = 0."""
        point = _checked_start(problem, start)
        subproblem = self.compiled(forms.two_line_subproblem(problem, self.alpha))
        return TwoLineState(0, point.x, subproblem, -point.lam / self.alpha)

    def step(self, problem: BregmanProblem, state: TwoLineState) -> TwoLineState:
        """One iteration."""
        x = state.subproblem.solve(problem.f - state.b)
        b = state.b + problem.residual(x)
        return TwoLineState(state.k + 1, x, state.subproblem, b)

    def point(self, problem: BregmanProblem, state: TwoLineState) -> BregmanPoint:
        """x, and lam = -alpha b."""
        return BregmanPoint(state.x, -self.alpha * state.b)


@dataclass(frozen=True)
class MethodOfMultipliers(BregmanSettings):
    """Method of multipliers (paper: `minbregman`). Settings: `BregmanSettings`.

        x^{k+1} = argmin L_alpha(x, lam^k),    lam^{k+1} = lam^k + alpha (f - K x^{k+1})

    with L_alpha(x, lam) = J(x) + <lam, f - K x> + alpha/2 ||f - K x||^2.
    """

    def init(self, problem: BregmanProblem, start: BregmanPoint | None) -> MultiplierState:
        """State 0 at `start`, else at x = 0 and lam = 0."""
        point = _checked_start(problem, start)
        subproblem = self.compiled(forms.augmented_lagrangian_subproblem(problem, self.alpha))
        return MultiplierState(0, point.x, subproblem, point.lam)

    def step(self, problem: BregmanProblem, state: MultiplierState) -> MultiplierState:
        """One iteration."""
        x = state.subproblem.solve(state.lam)
        lam = state.lam - self.alpha * problem.residual(x)
        return MultiplierState(state.k + 1, x, state.subproblem, lam)

    def point(self, problem: BregmanProblem, state: MultiplierState) -> BregmanPoint:
        """The state's x and lam."""
        return BregmanPoint(state.x, state.lam)


@dataclass(frozen=True)
class AlternatingBregman(BregmanSettings):
    """Method of multipliers whose x-step is T passes over the blocks of x (paper: `bregman ADMM`; Esser 2009).

        T times, for every block i:   x_i = argmin over x_i of L_alpha(x, lam^k)
        lam^{k+1} = lam^k + alpha (f - K x^{k+1})

    T = 1 with two blocks is ADMM, also known as split Bregman (Goldstein & Osher 2009). T to infinity is
    `MethodOfMultipliers`. ADMM need not converge with three blocks or more. J must be a sum of terms of one variable
    each. `passes` is T; further settings: `BregmanSettings`.
    """

    passes: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        check_settings(self, at_least_one=["passes"])

    def init(self, problem: BregmanProblem, start: BregmanPoint | None) -> AlternatingState:
        """State 0 at `start`, else at x = 0 and lam = 0."""
        point = _checked_start(problem, start)
        subproblems = map(self.compiled, forms.block_subproblems(problem, self.alpha))
        return AlternatingState(0, point.x, point.lam, tuple(subproblems))

    def step(self, problem: BregmanProblem, state: AlternatingState) -> AlternatingState:
        """T passes and the multiplier."""
        x = state.x
        for _ in range(self.passes):
            before, x = x, x.copy()
            for block, subproblem in zip(problem.blocks, state.subproblems, strict=True):
                others = problem.K @ x - problem.K[:, block] @ x[block]
                x[block] = subproblem.solve(problem.f + state.lam / self.alpha - others)
        lam = state.lam - self.alpha * problem.residual(x)
        stationarity = self._stationarity(problem, x - before) / max(1.0, float(np.linalg.norm(problem.K.T @ lam)))
        return AlternatingState(state.k + 1, x, lam, state.subproblems, stationarity)

    def point(self, problem: BregmanProblem, state: AlternatingState) -> BregmanPoint:
        """The state's x and lam."""
        return BregmanPoint(state.x, state.lam)

    def _stationarity(self, problem: BregmanProblem, change: Array) -> float:
        """||r||, r_i = alpha K_i^T sum_{j > i} K_j dx_j: block i was minimised with the old x_j of the last pass.

        Its optimality condition is K_i^T lam^{k+1} + r_i in the subdifferential of J_i at x_i (Boyd et al. 2011, 3.3).
        """
        moved, squares = problem.K @ change, 0.0
        for block in problem.blocks:
            K_i = problem.K[:, block]
            moved = moved - K_i @ change[block]
            squares += float(np.sum((K_i.T @ moved) ** 2))
        return self.alpha * math.sqrt(squares)


def feasibility_bound(initial_distance: float, alpha: float, k: int) -> float:
    """Bound on ||K x^k - f|| of the exact forms: sqrt(2 D_0 / (alpha k)), for k >= 1.

    D_0 = J(x~) - J(x^0) - <p^0, x~ - x^0> is the Bregman distance from the start to any x~ with K x~ = f; from p^0 = 0
    and x^0 a minimiser of J it is J(x~) - min J.

    With H(x) = alpha/2 ||K x - f||^2 and D_k the distance at iterate k, optimality of x^{k+1} and convexity of H give
    D_{k+1} + D(x^{k+1}, x^k) + H(x^{k+1}) <= D_k + H(x~), and H(x~) = 0. H(x^k) does not rise, because x^{k+1} beats
    x^k in its own subproblem. Summed over k steps: k H(x^k) <= D_0. A SettingError when D_0 is negative, alpha not
    positive or k below 1. Osher et al. 2005, Propositions 3.1 to 3.3, where the penalty is H itself.
    """
    if not (initial_distance >= 0 and alpha > 0 and k >= 1):
        raise SettingError(f"need D_0 >= 0, alpha > 0 and k >= 1, got {initial_distance}, {alpha} and {k}")
    return math.sqrt(2.0 * initial_distance / (alpha * k))


def _checked_start(problem: BregmanProblem, start: BregmanPoint | None) -> BregmanPoint:
    """`start` or zeros, checked; J must be finite there."""
    s, m = problem.K.shape
    point = start if start is not None else BregmanPoint(np.zeros(m), np.zeros(s))
    point = BregmanPoint(finite_array(point.x, "the start's x"), finite_array(point.lam, "the start's lam"))
    if point.x.shape != (m,) or point.lam.shape != (s,):
        raise SettingError(f"the start's x and lam have shapes {point.x.shape} and {point.lam.shape}; need {m} and {s}")
    if not math.isfinite(problem.objective(point.x)):
        raise SettingError("J is not finite at the start; give a start in the domain of J, as a BregmanPoint")
    return point
