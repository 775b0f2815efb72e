"""Bregman iteration for min J(x) subject to K x = f, in the four forms of the paper's section 2.

Each form is a class, to step through and to compare:

    Bregman             p   <- p - alpha K^T (K x - f)    x minimises J - <p, x> + penalty
    TwoLineBregman      b   <- b + K x - f                x minimises J + alpha/2 ||K x - f + b||^2
    MethodOfMultipliers lam <- lam + alpha (f - K x)      x minimises the augmented Lagrangian
    AlternatingBregman  lam <- lam + alpha (f - K x)      x by T passes over its blocks

These are the paper's equations (2), (4), (8), and (9) with (10), whose alpha is the penalty. The
first three forms have the same x, with p = K^T lam and lam = -alpha b; the last one is ADMM for
T = 1. Osher et al. 2005; Yin et al. 2008; Esser 2009.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.convex import bregman as forms
from pgo_models.convex.bregman import BregmanPoint, BregmanProblem, Subproblem
from pgo_models.convex.convex_solver import COLD, TOLERANCE, ConvexSolver, as_solver, finite_array
from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.rotations import Array
from pgo_models.summaries import Summarised
from solvers.result import Measurement, Status

# States.


@dataclass(frozen=True, eq=False)
class _ExactState(Summarised):
    """Iterate k of a form that minimises over the whole of x."""

    k: int
    x: Array  # (m,)
    subproblem: Subproblem  # the x-step, compiled

    @property
    def stationarity(self) -> float:
        """Distance of 0 from the subdifferential of the Lagrangian.

        Every iterate after the first step is stationary; before it the distance is inf.
        """
        return 0.0 if self.k > 0 else math.inf


@dataclass(frozen=True, eq=False)
class BregmanState(_ExactState):
    """Iterate k of `Bregman`."""

    p: Array  # (m,): a subgradient of J at x


@dataclass(frozen=True, eq=False)
class TwoLineState(_ExactState):
    """Iterate k of `TwoLineBregman`."""

    b: Array  # (s,): sum of the residuals so far


@dataclass(frozen=True, eq=False)
class MultiplierState(_ExactState):
    """Iterate k of `MethodOfMultipliers`."""

    lam: Array  # (s,): multiplier of K x = f


@dataclass(frozen=True, eq=False)
class AlternatingState(Summarised):
    """Iterate k of `AlternatingBregman`."""

    k: int
    x: Array  # (m,)
    lam: Array  # (s,): multiplier of K x = f
    subproblems: tuple[Subproblem, ...]  # one for every block
    # Distance of 0 from the subdifferential of the Lagrangian, relative; inf before the first step.
    stationarity: float = math.inf


# Solvers.


@dataclass(frozen=True)
class BregmanSettings:
    """Settings that all forms share; `Bregman` documents them."""

    alpha: float = 1.0
    tolerance: float = 1e-6
    max_iterations: int = 1000
    subproblem_tolerance: float = TOLERANCE
    solver: ConvexSolver | str = COLD

    def __post_init__(self) -> None:
        check_settings(
            self,
            finite=["alpha", "tolerance", "subproblem_tolerance"],
            not_negative=["max_iterations"],
        )
        as_solver(self.solver)  # raises unless it is installed

    def compiled(self, subproblem: Subproblem) -> Subproblem:
        """The subproblem with the solver of these settings."""
        return replace(subproblem, tolerance=self.subproblem_tolerance, solver=self.solver)

    def measure(
        self, problem: BregmanProblem, state: _ExactState | AlternatingState
    ) -> Measurement:
        """J(x), ||K x - f||, relative, and the distance from stationarity, relative."""
        infeasibility = float(np.linalg.norm(problem.residual(state.x)))
        primal_residual = infeasibility / max(1.0, float(np.linalg.norm(problem.f)))
        objective = problem.objective(state.x)
        return Measurement(objective, primal_residual, state.stationarity, infeasibility)

    def converged(
        self, state: _ExactState | AlternatingState, measurement: Measurement
    ) -> Status | None:
        """CONVERGED when both residuals are within tolerance, after at least one step."""
        worst = max(measurement.primal_residual, measurement.dual_residual)
        return Status.CONVERGED if worst <= self.tolerance else None


@dataclass(frozen=True)
class Bregman(BregmanSettings):
    """Bregman iteration with subgradients (equation (2) of the paper; Osher et al. 2005).

        x^{k+1} = argmin J(x) - J(x^k) - <p^k, x - x^k> + alpha/2 ||K x - f||^2
        p^{k+1} = p^k - alpha K^T (K x^{k+1} - f), a subgradient of J at x^{k+1}

    Parameters
    ----------
    alpha : float
        Penalty of the paper's section 2; lam has the unit of alpha K x.
    tolerance : float
        On ||K x - f|| over max(1, ||f||), and on the distance from stationarity over
        max(1, ||K^T lam||).
    max_iterations : int
        Iterations at most.
    subproblem_tolerance : float
        Tolerance of the solver. A loose one shows that errors of the subproblems are forgotten (Yin
        & Osher 2013).
    solver : ConvexSolver or str
        Solver of the subproblems; Clarabel without warm start unless given.

    Raises
    ------
    SettingError
        If a setting is out of its range.

    References
    ----------
    Osher, Burger, Goldfarb, Xu & Yin, An iterative regularization method for total variation-based
    image restoration, 2005.

    Examples
    --------
    The point of a line that is nearest to zero; the multiplier is the gradient there:

    >>> import cvxpy as cp, numpy as np
    >>> from pgo_models import BregmanProblem
    >>> from solvers import run
    >>> x = cp.Variable(2)
    >>> problem = BregmanProblem(cp.sum_squares(x), x, np.array([[1.0, 1.0]]), [2.0])
    >>> result = run(Bregman(), problem)
    >>> result.status.name, result.state.x.round(3).tolist()
    ('CONVERGED', [1.0, 1.0])
    >>> Bregman().point(problem, result.state).lam.round(3).tolist()
    [2.0]
    """

    def init(self, problem: BregmanProblem, start: BregmanPoint | None) -> BregmanState:
        """State 0 at `start`, else at x = 0 and p = 0."""
        point = _checked_start(problem, start)
        subproblem = self.compiled(forms.bregman_subproblem(problem, self.alpha))
        p = np.asarray(problem.K.T @ point.lam)
        return BregmanState(0, point.x, subproblem, p)

    def step(self, problem: BregmanProblem, state: BregmanState) -> BregmanState:
        """Make one iteration."""
        x = state.subproblem.solve(state.p)
        p = state.p - self.alpha * (problem.K.T @ problem.residual(x))
        return BregmanState(state.k + 1, x, state.subproblem, p)

    def point(self, problem: BregmanProblem, state: BregmanState) -> BregmanPoint:
        """Return x and the least-squares lam of p = K^T lam, from which any form can go on."""
        lam = np.linalg.lstsq(problem.K.T.toarray(), state.p, rcond=None)[0]
        return BregmanPoint(state.x, lam)


@dataclass(frozen=True)
class TwoLineBregman(BregmanSettings):
    """Bregman iteration in two lines (equation (4) of the paper; Yin et al. 2008).

        x^{k+1} = argmin J(x) + alpha/2 ||K x - f + b^k||^2
        b^{k+1} = b^k + K x^{k+1} - f

    Parameters
    ----------
    alpha, tolerance, max_iterations, subproblem_tolerance, solver
        As of `Bregman`.

    References
    ----------
    Yin, Osher, Goldfarb & Darbon, Bregman iterative algorithms for l1-minimization with
    applications to compressed sensing, 2008.
    """

    def init(self, problem: BregmanProblem, start: BregmanPoint | None) -> TwoLineState:
        """State 0 at `start`, else at x = 0 and b = 0."""
        point = _checked_start(problem, start)
        subproblem = self.compiled(forms.two_line_subproblem(problem, self.alpha))
        return TwoLineState(0, point.x, subproblem, -point.lam / self.alpha)

    def step(self, problem: BregmanProblem, state: TwoLineState) -> TwoLineState:
        """Make one iteration."""
        x = state.subproblem.solve(problem.f - state.b)
        b = state.b + problem.residual(x)
        return TwoLineState(state.k + 1, x, state.subproblem, b)

    def point(self, problem: BregmanProblem, state: TwoLineState) -> BregmanPoint:
        """Return x, and lam = -alpha b, from which a run of any form can go on."""
        return BregmanPoint(state.x, -self.alpha * state.b)


@dataclass(frozen=True)
class MethodOfMultipliers(BregmanSettings):
    """Method of multipliers (equation (8) of the paper).

        x^{k+1} = argmin L_alpha(x, lam^k)
        lam^{k+1} = lam^k + alpha (f - K x^{k+1})

    with the augmented Lagrangian L_alpha(x, lam) = J(x) + <lam, f - K x> + alpha/2 ||f - K x||^2.

    Parameters
    ----------
    alpha, tolerance, max_iterations, subproblem_tolerance, solver
        As of `Bregman`.
    """

    def init(self, problem: BregmanProblem, start: BregmanPoint | None) -> MultiplierState:
        """State 0 at `start`, else at x = 0 and lam = 0."""
        point = _checked_start(problem, start)
        subproblem = self.compiled(forms.augmented_lagrangian_subproblem(problem, self.alpha))
        return MultiplierState(0, point.x, subproblem, point.lam)

    def step(self, problem: BregmanProblem, state: MultiplierState) -> MultiplierState:
        """Make one iteration."""
        x = state.subproblem.solve(state.lam)
        lam = state.lam - self.alpha * problem.residual(x)
        return MultiplierState(state.k + 1, x, state.subproblem, lam)

    def point(self, problem: BregmanProblem, state: MultiplierState) -> BregmanPoint:
        """Return x and lam, from which a run of any form can go on."""
        return BregmanPoint(state.x, state.lam)


@dataclass(frozen=True)
class AlternatingBregman(BregmanSettings):
    """Method of multipliers whose x-step is T passes over the blocks of x.

    Equations (9) and (10) of the paper:

        T times, for every block i:   x_i = argmin over x_i of L_alpha(x, lam^k)
        lam^{k+1} = lam^k + alpha (f - K x^{k+1})

    T = 1 with two blocks is ADMM, also known as split Bregman (Goldstein & Osher 2009). T to
    infinity is `MethodOfMultipliers`. ADMM need not converge with three blocks or more. J must be a
    sum of terms of one variable each.

    Parameters
    ----------
    alpha, tolerance, max_iterations, subproblem_tolerance, solver
        As of `Bregman`.
    passes : int, at least 1
        T.

    References
    ----------
    Esser, Applications of Lagrangian-based alternating direction methods and connections to split
    Bregman, 2009.

    Examples
    --------
    >>> import cvxpy as cp, numpy as np
    >>> from pgo_models import BregmanProblem
    >>> from solvers import run
    >>> x, y = cp.Variable(), cp.Variable()
    >>> J = cp.square(x - 3.0) + cp.abs(y)
    >>> problem = BregmanProblem(J, (x, y), np.array([[1.0, -1.0]]), [0.0])
    >>> run(AlternatingBregman(passes=1), problem).state.x.round(3).tolist()
    [2.5, 2.5]
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
        """Make T passes, and update the multiplier."""
        x = state.x
        for _ in range(self.passes):
            x_before = x
            x = self._pass_over_blocks(problem, state, x)
        lam = state.lam - self.alpha * problem.residual(x)
        stationarity = self._distance_from_stationarity(problem, x - x_before)
        stationarity /= max(1.0, float(np.linalg.norm(problem.K.T @ lam)))
        return AlternatingState(state.k + 1, x, lam, state.subproblems, stationarity)

    def point(self, problem: BregmanProblem, state: AlternatingState) -> BregmanPoint:
        """Return x and lam, from which a run of any form can go on."""
        return BregmanPoint(state.x, state.lam)

    def _pass_over_blocks(
        self, problem: BregmanProblem, state: AlternatingState, x: Array
    ) -> Array:
        """Minimise the augmented Lagrangian over one block after the other."""
        x = x.copy()
        for block, subproblem in zip(problem.blocks, state.subproblems, strict=True):
            of_other_blocks = problem.K @ x - problem.K[:, block] @ x[block]
            x[block] = subproblem.solve(problem.f + state.lam / self.alpha - of_other_blocks)
        return x

    def _distance_from_stationarity(self, problem: BregmanProblem, change: Array) -> float:
        """||r|| with r_i = alpha K_i^T sum_{j > i} K_j dx_j, dx the change of the last pass.

        Block i was minimised with the old x_j of this pass, j > i. Its optimality condition is that
        K_i^T lam^{k+1} + r_i is in the subdifferential of J_i at x_i (Boyd et al. 2011,
        section 3.3).
        """
        change_of_later_blocks = problem.K @ change
        squares = 0.0
        for block in problem.blocks:
            K_i = problem.K[:, block]
            change_of_later_blocks = change_of_later_blocks - K_i @ change[block]
            squares += float(np.sum((K_i.T @ change_of_later_blocks) ** 2))
        return self.alpha * math.sqrt(squares)


def feasibility_bound(initial_distance: float, alpha: float, k: int) -> float:
    """Bound on ||K x^k - f|| of the exact forms: sqrt(2 D_0 / (alpha k)), for k >= 1.

    D_0 = J(x~) - J(x^0) - <p^0, x~ - x^0> is the Bregman distance from the start to any x~ with K
    x~ = f; from p^0 = 0 and x^0 a minimiser of J it is J(x~) - min J.

    With H(x) = alpha/2 ||K x - f||^2 and D_k the distance at iterate k, optimality of x^{k+1} and
    convexity of H give D_{k+1} + D(x^{k+1}, x^k) + H(x^{k+1}) <= D_k + H(x~), and H(x~) = 0. H(x^k)
    does not rise, because x^{k+1} beats x^k in its own subproblem. Summed over k steps: k H(x^k) <=
    D_0. A SettingError when D_0 is negative, alpha not positive or k below 1. Osher et al. 2005,
    Propositions 3.1 to 3.3, where the penalty is H itself.
    """
    if not (initial_distance >= 0 and alpha > 0 and k >= 1):
        raise SettingError(
            f"need D_0 >= 0, alpha > 0 and k >= 1, got {initial_distance}, {alpha} and {k}"
        )
    return math.sqrt(2.0 * initial_distance / (alpha * k))


def _checked_start(problem: BregmanProblem, start: BregmanPoint | None) -> BregmanPoint:
    """`start`, or zeros; a SettingError unless it fits and J is finite there."""
    s, m = problem.K.shape
    if start is None:
        start = BregmanPoint(np.zeros(m), np.zeros(s))
    x = finite_array(start.x, "the start's x")
    lam = finite_array(start.lam, "the start's lam")
    if x.shape != (m,) or lam.shape != (s,):
        raise SettingError(
            f"the start's x and lam have shapes {x.shape} and {lam.shape}; need {m} and {s}"
        )
    if not math.isfinite(problem.objective(x)):
        raise SettingError(
            "J is not finite at the start; give a start in the domain of J, as a BregmanPoint"
        )
    return BregmanPoint(x, lam)
