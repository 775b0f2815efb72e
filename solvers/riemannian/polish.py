"""Polish: from given poses to the stationary point nearby, by damped Riemannian Newton.

The rules are those of `newton_step`; here is its algebra in one place, with sparse Cholesky. One
factorisation serves several moves.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_array

from pgo_models.certificates.dual_variables import multipliers_at
from pgo_models.certificates.fit import fit_of
from pgo_models.certificates.rounding_errors import rounding_level
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.problem.cholesky import CholeskyFactor, SymbolicCholesky, analyze
from pgo_models.problem.hessian import TangentLayout, ground_pose, riemannian_hessian, tangent_order
from pgo_models.problem.matrices import inner
from pgo_models.problem.problem import LEAST_STIFFNESS, EvaluatedPoses, PGOProblem
from pgo_models.problem.stationarity import STATIONARY_DECREMENT
from solvers.riemannian.newton_step import (
    ModelOrder,
    NewtonFigures,
    StepRules,
    decrement_of,
    factorize_definite,
    newton_step,
    stationary_tolerance,
)

SHORT_MOVE = 1e-4  # decrement up to which the moves that follow hardly turn a pose
NEARLY_EXACT = 1e4  # times its rounding level: then F is what the solve for the translations leaves
MOST_REFINEMENTS = 60  # of translations: each but the last halves F at least
MOST_FITTING_STEPS = 3  # Newton steps at the rounding level of F


@dataclass(frozen=True, eq=False, kw_only=True)
class PolishState(NewtonFigures):
    """Poses on the way to a stationary point, and `NewtonFigures` of them."""

    here: EvaluatedPoses  # of the poses
    # the analysis and the factor of the last matrix are for the next step to reuse
    analysis: SymbolicCholesky | None = None
    factor: CholeskyFactor | None = None

    @property
    def poses(self) -> Poses:
        """Current poses, (n)."""
        return self.here.poses


@dataclass(frozen=True, eq=False)
class PolishTrial:
    """Poses after a move."""

    here: EvaluatedPoses

    @property
    def poses(self) -> Poses:
        """Poses after the move, (n)."""
        return self.here.poses

    @property
    def objective(self) -> float:
        """F after the move."""
        return self.here.value


@dataclass(frozen=True, eq=False, kw_only=True)
class CentralModel(PolishTrial):
    """`newton_step.NewtonModel` in one place."""

    order: ModelOrder
    factor: CholeskyFactor  # of H
    rounding_level: float
    gradient: Array  # g, (side,)
    step: Array  # -H^-1 g, (side,)
    square: float  # minus the slope of F along the step


class CentralAlgebra:
    """`newton_step.NewtonAlgebra` in one place, of one step: from poses, with sparse Cholesky.

    It analyses the pattern of the matrix if no earlier step has, and takes over the memory of an
    earlier factor.
    """

    def __init__(self, problem: PGOProblem, state: PolishState) -> None:
        self.problem = problem
        self.state = state
        self.layout = TangentLayout(problem.num_poses, problem.d)
        self.analysis = state.analysis
        self.rounding_level = rounding_level(problem, state.poses)  # hardly moves with them
        self._short_move_factor: CholeskyFactor | None = None  # of translations

    @property
    def further_moves(self) -> int:
        """Eight: a move costs two triangular solves, far less than a factorisation."""
        return 8

    def factorize(self, order: ModelOrder) -> CentralModel | None:
        """Return the model at the poses of the state."""
        matrix = self._matrix(order)
        if self.analysis is None:
            self.analysis = analyze(matrix, self.problem.backend, tangent_order(self.problem))
        # the memory of a factor can be taken over once
        overwritten = self.state.factor if order.is_newton else None
        try:
            factor = self.analysis.factorize(matrix, overwrite=overwritten)
        except NotPositiveDefiniteError:
            return None
        gradient = self._gradient(self.state.here)
        step = -factor.solve(gradient)
        return CentralModel(
            order=order,
            factor=factor,
            here=self.state.here,
            rounding_level=self.rounding_level,
            gradient=gradient,
            step=step,
            square=-inner(gradient, step),
        )

    def evaluate(self, model: CentralModel, length: float) -> PolishTrial:
        """Return the poses after a move, and their F.

        The translations that are best for the turned rotations lie on the curved path that a
        straight move of both leaves: on parking-garage this saves two thirds of the factorisations.
        """
        problem = self.problem
        w, v = self.layout.split(model.step)
        moved = model.poses.moved_along(length * w, length * v)
        poses = problem.at_best_translations(moved, self._factor_of_translations(model, moved))
        trial = PolishTrial(problem.at(poses))
        is_nearly_exact = trial.objective <= NEARLY_EXACT * model.rounding_level
        if problem.is_quadratic and length == 1.0 and is_nearly_exact:
            return PolishTrial(refine_translations(trial.here))
        return trial

    def _factor_of_translations(self, model: CentralModel, moved: Poses) -> CholeskyFactor | None:
        """Factor for the translations of moved poses, where chi2 needs one.

        That of the first short move serves the others: rotations hardly change from then on.
        """
        if self._short_move_factor is not None:
            return self._short_move_factor
        factor = self.problem.translation_factor(moved)
        if decrement_of(model) <= SHORT_MOVE:
            self._short_move_factor = factor
        return factor

    def model_at(self, model: CentralModel, trial: PolishTrial) -> CentralModel:
        """Return the model at the trial that takes the factor of another one."""
        gradient = self._gradient(trial.here)
        step = -model.factor.solve(gradient)
        return replace(
            model,
            here=trial.here,
            gradient=gradient,
            step=step,
            square=-inner(gradient, step),
        )

    def accept(self, trial: PolishTrial) -> None:
        """Do nothing: the model has the poses."""

    def _gradient(self, here: EvaluatedPoses) -> Array:
        return self.layout.join(*here.riemannian_gradient)

    def _matrix(self, order: ModelOrder) -> csc_array:
        """Return H, with pose 0 grounded."""
        problem = self.problem
        here = self.state.here
        Lambda = None
        if order.second_order:
            Lambda = multipliers_at(here)
            if order.eta:
                Lambda = Lambda - order.eta * np.eye(problem.d)
        matrix = riemannian_hessian(here, Lambda)
        ground_pose(matrix, self.layout)
        if problem.has_partial_edges:
            diagonal = matrix.diagonal()
            sizes = np.maximum(np.abs(diagonal), np.median(np.abs(diagonal)))
            matrix.setdiag(diagonal + LEAST_STIFFNESS * sizes)
        if order.damping:
            matrix.setdiag(matrix.diagonal() * (1.0 + order.damping))
        return matrix


def refine_translations(here: EvaluatedPoses) -> EvaluatedPoses:
    """Return the poses after steps of iterative refinement of the translations.

    A solve leaves errors in proportion to its condition; a step with residuals edge by edge takes
    most of it away. At most `MOST_REFINEMENTS` steps are taken, as many as lower the cost. Another
    one follows only where the last one halved F and left it positive: chi2 may come out below zero
    by rounding, and then every number is less than half of itself. The rotations stay, and t_0.
    """
    problem = here.problem
    for _ in range(MOST_REFINEMENTS):
        step = problem.translations.solve(here.half_gradient[: problem.num_poses])
        refined = problem.at(here.poses.with_translations(here.poses.t - step))
        if not refined.value < here.value:
            break
        was_halved = 0.0 < refined.value < 0.5 * here.value
        here = refined
        if not was_halved:
            break
    return here


def start_polish(problem: PGOProblem, poses: Poses, share: float = 1.0) -> PolishState:
    """Begin at poses; `share` is how many times looser than usual the tolerance is."""
    here = problem.at(poses)
    tolerance = stationary_tolerance(problem.is_quadratic, share)
    return PolishState(here=here, objective=here.value, tolerance=tolerance)


def start_run(problem: PGOProblem, poses: Poses, share: float = 1.0) -> PolishState:
    """Begin a run at poses, for chi2 with their best translations where these cost less.

    The start of chi2 has the translations of another cost. With its own, the Hessian is the better
    model from the first step on, and one factorisation is saved.
    """
    given = start_polish(problem, poses, share)
    if problem.is_quadratic:
        return given
    settled = start_polish(problem, problem.at_best_translations(poses), share)
    return settled if settled.objective < given.objective else given


def polish_step(problem: PGOProblem, state: PolishState, second_order: bool = True) -> PolishState:
    """Take one `newton_step` in one place.

    Where no damping makes the matrix definite, as with weights too far apart for doubles, the poses
    stay as they are.
    """
    algebra = CentralAlgebra(problem, state)
    rules = StepRules(state.tolerance, second_order)
    try:
        result = newton_step(algebra, rules)
    except NotPositiveDefiniteError:
        # Its factor may have been overwritten.
        return replace(state, moved=False, factor=None)
    model = result.model
    now = PolishState(
        here=model.here,
        objective=model.objective,
        decrement=result.decrement,
        moved=result.moved,
        is_at_rounding=result.is_at_rounding,
        tolerance=state.tolerance,
        analysis=algebra.analysis,
        factor=model.factor,
    )
    if now.is_stationary and now.objective <= algebra.rounding_level:
        here = problem.at(_fit_every_edge(problem, now.poses, model.factor))
        now = replace(now, here=here, objective=here.value)
    return now


def _fit_every_edge(problem: PGOProblem, poses: Poses, factor: CholeskyFactor) -> Poses:
    """Move poses with F at its rounding level until every edge fits to its own numbers.

    Where that fails they are returned as they are. F is a sum, in which the rounding of heavy edges
    hides what light ones could still gain. A Newton step sees it all the same; one is enough, as a
    rule.
    """
    moved = poses
    for _ in range(MOST_FITTING_STEPS):
        if fit_of(problem, moved).is_closest:
            return moved
        moved = moved_by(factor, problem.at(moved))
    return moved if fit_of(problem, moved).is_closest else poses


def moved_by(factor: CholeskyFactor, here: EvaluatedPoses) -> Poses:
    """Poses after one step -H^-1 g, with the factor of a matrix H that is there."""
    layout = TangentLayout(here.problem.num_poses, here.problem.d)
    gradient = layout.join(*here.riemannian_gradient)
    return here.poses.moved_along(*layout.split(-factor.solve(gradient)))


def polish(problem: PGOProblem, poses: Poses, max_steps: int = 100) -> Poses:
    """Move poses to the stationary point nearby, where F is no higher (damped Riemannian Newton).

    Parameters
    ----------
    problem : PGOProblem
        The cost F, or chi2.
    poses : Poses
        Where to begin.
    max_steps : int, optional
        Most factorisations.

    Returns
    -------
    Poses
        The stationary poses, or the best ones reached.

    Raises
    ------
    GraphError
        If the poses do not fit the problem.

    References
    ----------
    P.-A. Absil, R. Mahony and R. Sepulchre, Optimization Algorithms on Matrix Manifolds, 2008,
    chapter 6.

    Examples
    --------
    >>> from pgo_models import PGOProblem, chordal_start, grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> start = chordal_start(problem)
    >>> bool(problem.objective(polish(problem, start)) < problem.objective(start))
    True
    """
    return polished(problem, problem.check_poses(poses), max_steps).poses


def polished(problem: PGOProblem, poses: Poses, max_steps: int) -> PolishState:
    """The last state of `polish`, with the factor of its last step."""
    state = start_run(problem, poses)
    for _ in range(max_steps):
        state = polish_step(problem, state)
        if state.is_stationary or not state.moved:
            break
    return state


def relative_decrement(problem: PGOProblem, poses: Poses) -> float:
    """Compute the `scaled_decrement` at poses: what a Newton step promises, as a share of F.

    Where the Hessian is not positive definite, as at saddles, it is that of the damped Gauss-Newton
    matrix, and above `STATIONARY_DECREMENT` in any case; inf where no damping makes that one
    definite.
    """
    state = start_polish(problem, poses)
    algebra = CentralAlgebra(problem, state)
    try:
        model = factorize_definite(algebra, StepRules(state.tolerance))
    except NotPositiveDefiniteError:
        return np.inf
    decrement = decrement_of(model)
    if model.order.is_newton:
        return decrement
    return max(decrement, 2.0 * STATIONARY_DECREMENT)
