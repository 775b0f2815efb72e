"""Newton's method by a driver and its robots: `newton_step` on matrices eliminated to separators.

The rules are those of `solvers.riemannian.newton_step`. A step of Newton goes as follows.

1. The driver asks every robot for its part of H y = g, with the interior eliminated
   (`reduce_model`). H is the matrix of a `ModelOrder` at the current poses, and g the gradient
   there. The message goes with the next round.
2. The driver sums up the parts, adds its own blocks, and solves for y on the cover (`model_at`).
3. It sends every robot y on its boundary. The robot solves for its interior, and tries the move
   along -y. A straight move is one round (`move_straight`). Otherwise the robots turn their
   rotations (`move`) and the best translations are solved for (`evaluate_trial`): two rounds.
4. The robots answer F and the gradient at the trial, reduced by the same factor. The driver either
   accepts the trial (`Driver.accept`), or tries another length (`turn`, `go_straight`).

The driver's method stands first; the robot's orders are below it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.hessian import TangentLayout, ground_pose
from pgo_models.relaxations.low_rank import (
    LiftedPoses,
    gradient_at,
    hessian_at,
    poses_from,
    tangent_widths,
)
from solvers.carry.counted_pool import Count
from solvers.carry.moments import Moment
from solvers.carry.registry import order, record
from solvers.carry.serialization import COMPUTED_AGAIN
from solvers.result import Measurement, Status
from solvers.riemannian.newton import Newton, newton_status
from solvers.riemannian.newton_step import (
    ModelOrder,
    NewtonFigures,
    StepRules,
    first_shift,
    newton_step,
    stationary_tolerance,
)
from solvers.riemannian.polish import MOST_FITTING_STEPS, NEARLY_EXACT
from solvers.robots.driver import CoverPoses, Driver
from solvers.robots.elimination import Reduced, RightHandSide
from solvers.robots.interface import InterfaceFactor
from solvers.robots.part import CostParts, Interior, ReducedTranslations, Session
from solvers.robots.poses import reduced_translations, translations


@record("SubstructuredNewtonState")
@dataclass(frozen=True, eq=False, kw_only=True)
class SubstructuredNewtonState(NewtonFigures):
    """Figures of iterate k; the poses are with driver and robots, which hold them at a moment."""

    k: int
    moment: Moment | None = field(default=None, metadata=COMPUTED_AGAIN)
    eta: float = 0.0  # last one that was added to S
    is_convex: bool = True  # whether the last step needed none


@dataclass(frozen=True, eq=False)
class Model:
    """A factored matrix H at poses, and the solution y = H^-1 g on the cover."""

    order: ModelOrder
    factor: InterfaceFactor
    at: CoverPoses
    y: Array
    parts: list[Array]  # of y, at every robot
    square: float  # g^T H^-1 g

    @property
    def objective(self) -> float:
        """F at the poses."""
        return self.at.objective

    @property
    def rounding_level(self) -> float:
        """F where every residual is as large as rounding can make it."""
        return self.at.rounding_level


@dataclass(frozen=True, eq=False)
class CoverTrial:
    """Poses of the cover after a move, and the robots' reduced gradients there."""

    at: CoverPoses
    gradients: list[RightHandSide]

    @property
    def objective(self) -> float:
        """F at the poses."""
        return self.at.objective


@dataclass(frozen=True)
class EliminatedAlgebra:
    """`newton_step.NewtonAlgebra` by driver and robots.

    A factorisation goes along with the round of the move after it. A move takes two rounds, or one
    if it `is_straight`.
    """

    driver: Driver
    is_straight: bool = False

    @property
    def further_moves(self) -> int:
        """Three: a move takes two rounds, and a new factor goes along with one of them."""
        return 3

    def factorize(self, order: ModelOrder) -> Model | None:
        """Return the model at the current poses."""
        return model_at(self.driver, order)

    def evaluate(self, model: Model, length: float) -> CoverTrial:
        """Return the poses after a move.

        Their translations are the best ones for the rotations. They move straight on if the algebra
        `is_straight`; of chi2, where the matrix of the translations differs from rotations to
        rotations; and where F is near its rounding level (`refine`).
        """
        is_nearly_exact = model.objective <= NEARLY_EXACT * model.rounding_level
        if self.is_straight or self.driver.is_final or is_nearly_exact:
            return self._straight_trial(model, length)
        return self._trial_with_best_translations(model, length)

    def model_at(self, model: Model, trial: CoverTrial) -> Model:
        """Return the model at the trial, from the gradients that the robots sent with it."""
        return _solved(model.order, model.factor, trial.at, trial.gradients)

    def accept(self, trial: CoverTrial) -> None:
        """Go to the trial, here and on the robots."""
        self.driver.accept(trial.at)

    def refine(self, order: ModelOrder) -> None:
        """Take Newton steps at the rounding level of F, as long as they halve it.

        The translations move straight on there: a solve for all of them leaves errors in proportion
        to the last bits of the farthest, which every edge has to fit without (`fit_of`).
        """
        model = self.factorize(order)
        for _ in range(MOST_FITTING_STEPS):
            if model is None:
                return
            trial = self._straight_trial(model, 1.0)
            if trial.objective > 0.5 * model.objective:
                return
            model = self.model_at(model, trial)
            self.accept(trial)

    def _straight_trial(self, model: Model, length: float) -> CoverTrial:
        """Return the trial whose translations move straight on."""
        if length == 1.0:
            moves = [Move(part, length) for part in model.parts]
            answers = self.driver.ask_each(move_straight, moves)
        else:
            answers = self.driver.ask(go_straight, length, Count.PIGGYBACKED)
        R, t = self._moved(model, length)
        return self._trial(R, t, answers)

    def _trial_with_best_translations(self, model: Model, length: float) -> CoverTrial:
        """Return the trial whose translations are the best ones for its rotations."""
        driver = self.driver
        if length == 1.0:
            moves = [Move(part, length) for part in model.parts]
            turned = driver.ask_each(move, moves)
        else:
            turned = driver.ask(turn, length, Count.PIGGYBACKED)
        t, parts = driver.best_translations(turned)
        answers = driver.ask_each(evaluate_trial, parts)
        return self._trial(self._moved(model, length)[0], t, answers)

    def _moved(self, model: Model, length: float) -> tuple[Array, Array]:
        """Return rotations and translations of the cover after a straight move."""
        driver = self.driver
        layout = TangentLayout(len(driver.cover), *driver.tangent)
        w, v = layout.split(-model.y[:, 0])
        moved = poses_from(model.at.R, model.at.t).moved_along(length * w, length * v)
        return moved.R, moved.t

    def _trial(self, R: Array, t: Array, answers: Sequence[TrialEvaluation]) -> CoverTrial:
        at = CoverPoses(R, t, self.driver.current.force)
        at = self.driver.with_cost(at, [answer.at for answer in answers])
        return CoverTrial(at, [answer.gradient for answer in answers])


@dataclass(frozen=True)
class SubstructuredNewton:
    """Newton by a driver and its robots, from the poses that they hold; `newton` has the settings.

    A Hessian that is not positive definite is replaced. If the model `is_shifted`, the Hessian of
    S + eta blockdiag(0, I) takes its place, with a small eta that makes it definite: the move then
    follows negative curvature. Otherwise the damped Gauss-Newton matrix does. If `is_straight`,
    translations move along with the rotations, one round a move; else they are solved for, two
    rounds a move. `enough` is as in `StepRules`.
    """

    newton: Newton = field(default_factory=Newton)
    is_shifted: bool = False
    is_straight: bool = False
    enough: float = 0.0

    @property
    def max_iterations(self) -> int:
        """Most steps of a run."""
        return self.newton.max_iterations

    def init(
        self, driver: Driver, start: SubstructuredNewtonState | None
    ) -> SubstructuredNewtonState:
        """State 0, at the poses that driver and robots hold."""
        moment = driver.moment()
        if start is not None:
            return replace(start, moment=moment)
        return SubstructuredNewtonState(k=0, moment=moment, objective=driver.current.objective)

    def step(self, driver: Driver, state: SubstructuredNewtonState) -> SubstructuredNewtonState:
        """One factorisation and the moves it serves."""
        driver.return_to(state.moment)
        tolerance = stationary_tolerance(not driver.is_final, self.newton.share)
        shift = None
        if self.is_shifted:
            num_rows = driver.num_poses * driver.d
            shift = first_shift(state.eta, driver.current.objective, num_rows)
        rules = StepRules(tolerance, self.newton.second_order, shift, self.enough)
        algebra = EliminatedAlgebra(driver, self.is_straight)
        result = newton_step(algebra, rules)
        is_stationary = result.decrement <= tolerance or result.is_at_rounding
        if is_stationary and driver.current.objective <= driver.current.rounding_level:
            algebra.refine(result.model.order)
        eta = result.model.order.eta
        return SubstructuredNewtonState(
            k=state.k + 1,
            moment=driver.moment(),
            objective=driver.current.objective,
            decrement=result.decrement,
            moved=result.moved,
            is_at_rounding=result.is_at_rounding,
            tolerance=tolerance,
            eta=eta or state.eta,
            is_convex=not eta,
        )

    def measure(self, driver: Driver, state: SubstructuredNewtonState) -> Measurement:
        """F and the relative decrement."""
        return driver.measured(Measurement(state.objective, 0.0, state.decrement))

    def converged(self, state: SubstructuredNewtonState, measurement: Measurement) -> Status | None:
        """As `Newton`."""
        return newton_status(state)


def model_at(driver: Driver, order: ModelOrder) -> Model | None:
    """Return the model at the current poses.

    None when a robot's interior, or the sum of what they reduce to, is not positive definite.
    """
    answers = driver.ask(reduce_model, order, Count.PIGGYBACKED)
    reduced = [answer for answer in answers if answer is not None]
    if len(reduced) < len(answers):
        return None
    interface = driver.interface(*driver.tangent)
    try:
        blocks = _blocks_of_driver(driver, reduced, order)
        factor = interface.factorize([answer.schur for answer in reduced], blocks)
    except NotPositiveDefiniteError:
        return None
    return _solved(order, factor, driver.current, [answer.right for answer in reduced])


def _blocks_of_driver(
    driver: Driver, reduced: Sequence[Reduced], order: ModelOrder
) -> list[tuple[IntArray, Array]]:
    """What the driver adds: the multipliers of the cover, the ground, the damping."""
    g = len(driver.cover)
    at = LiftedPoses(driver.current.R, driver.current.t)
    interface = driver.interface(*driver.tangent)
    layout = at.layout
    blocks: list[tuple[IntArray, Array]] = []
    diagonal = interface.gather([answer.diagonal[:, None] for answer in reduced])[:, 0]
    columns = layout.rotations(np.arange(g))
    if order.second_order:
        curvature = -at.curvature(driver.current.multipliers - order.eta * np.eye(driver.d))
        blocks.append((columns, curvature))
        diagonal[columns] += np.einsum("naa->na", curvature)
    extra = np.zeros_like(diagonal)
    zero = driver.columns_of_pose_0(*driver.tangent)
    extra[zero] = abs(diagonal[zero])
    extra += order.damping * (diagonal + extra)
    blocks.append((np.arange(interface.side)[:, None], extra[:, None, None]))
    return blocks


def _solved(
    order: ModelOrder, factor: InterfaceFactor, at: CoverPoses, right: Sequence[RightHandSide]
) -> Model:
    """Solution y = H^-1 g on the cover, and g^T H^-1 g."""
    y, parts, energy = factor.solve([part.b for part in right])
    square = math.fsum(part.energy for part in right) + energy
    return Model(order, factor, at, y, parts, square)


# The robot's orders.


@record("Move")
@dataclass(frozen=True, eq=False)
class Move:
    """H^-1 g on the boundary, (w g, 1), and how far to go along minus it."""

    x: Array
    length: float


@record("TrialEvaluation")
@dataclass(frozen=True, eq=False)
class TrialEvaluation:
    """`CostParts` at a trial, and the reduced gradient there."""

    at: CostParts
    gradient: RightHandSide


@record("DescentSession")
@dataclass(frozen=True, eq=False, kw_only=True)
class DescentSession(Session):
    """Newton, or a climb of the staircase: a direction, and the trial that it led to.

    A climb has no system: its direction comes from a proof's.
    """

    step: tuple[Array, Array] | None = None  # (p, .), (p, d): of rotations, of translations


@order("newton.reduce_model")
def reduce_model(robot: Interior, order: ModelOrder) -> tuple[Interior, Reduced | None]:
    """Eliminate the matrix of the order, and the gradient; None where K_II is not definite.

    The robot grounds and damps the rows of its interior, the driver those of the separators.
    """
    Lambda = None
    if order.second_order:
        identity = np.eye(robot.part.problem.d)
        Lambda = robot.multipliers() - order.eta * identity
        Lambda[robot.part.boundary] = 0.0  # the driver knows the whole force there
    H = hessian_at(robot.at(robot.poses), Lambda)
    if robot.factored.grounds:
        ground_pose(H, _layout(robot))
    diagonal = H.diagonal()
    widths = tangent_widths(robot.poses.R)
    interior = robot.factored.cut(widths).interior
    diagonal[interior] *= 1.0 + order.damping
    H.setdiag(diagonal)
    try:
        eliminated, system = robot.eliminate(H, widths, _gradient(robot, robot.poses))
    except NotPositiveDefiniteError:
        return robot, None
    return eliminated.in_session(DescentSession(system=system)), system.reduced(system.right)


@order("newton.move")
def move(robot: Interior, order: Move) -> tuple[Interior, ReducedTranslations]:
    """Direction -H^-1 g from H^-1 g on the boundary; then `turn`."""
    return turn(_directed(robot, order), order.length)


@order("newton.move_straight")
def move_straight(robot: Interior, order: Move) -> tuple[Interior, TrialEvaluation]:
    """Direction -H^-1 g from H^-1 g on the boundary; then `go_straight`."""
    return go_straight(_directed(robot, order), order.length)


@order("newton.turn")
def turn(robot: Interior, length: float) -> tuple[Interior, ReducedTranslations]:
    """Turn a length along the direction: the right-hand side of the best translations there."""
    trial = moved(robot, length).with_translations(robot.poses.t)
    return reduced_translations(robot.at_trial(trial), trial.R)


@order("newton.go_straight")
def go_straight(robot: Interior, length: float) -> tuple[Interior, TrialEvaluation]:
    """Move a length along the direction, translations too: F, force and gradient there."""
    return _evaluated(robot, moved(robot, length))


@order("newton.evaluate_trial")
def evaluate_trial(robot: Interior, t: Array) -> tuple[Interior, TrialEvaluation]:
    """Take the trial's best translations, t on the boundary: F, force and gradient there."""
    trial = robot.trial
    return _evaluated(robot, trial.with_translations(translations(robot, trial.R, t)))


def moved(robot: Interior, length: float) -> Poses:
    """Return the current poses, moved a length along the direction."""
    step = robot.session(DescentSession).step
    assert step is not None
    w, v = step
    return robot.poses.moved_along(length * w, length * v)


def _directed(robot: Interior, order: Move) -> Interior:
    """The robot with the direction that belongs to H^-1 g on the boundary."""
    step = -robot.system.back_substitute(order.x)[:, 0]
    session = replace(robot.session(DescentSession), step=_layout(robot).split(step))
    return robot.in_session(session)


def _evaluated(robot: Interior, trial: Poses) -> tuple[Interior, TrialEvaluation]:
    """Evaluate a trial; its gradient is reduced by the last factor."""
    at_trial = robot.at_trial(trial)
    following, gradient = at_trial.with_right(_gradient(at_trial, trial))
    return following, TrialEvaluation(following.evaluation(trial), gradient)


def _gradient(robot: Interior, poses: Poses) -> Array:
    """Gradient of the current cost at poses, (unknowns, 1)."""
    w, v = gradient_at(robot.at(poses))
    return _layout(robot).join(w, v)[:, None]


def _layout(robot: Interior) -> TangentLayout:
    """Layout of the unknowns of a move from the current poses."""
    return TangentLayout(robot.part.problem.num_poses, *tangent_widths(robot.poses.R))
