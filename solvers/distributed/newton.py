"""The second stage by driver and robots: `pgo_models.certificates.newton_polish` without secants, step for step."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pgo_models.certificates import newton_polish as central
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.hessian import TangentLayout
from pgo_models.relaxations.low_rank import LiftedPoses, move_poses, poses_from
from solvers.distributed.driver import CoverPoses, Driver
from solvers.distributed.interface import Interface
from solvers.distributed.robots.interior import Interior
from solvers.distributed.robots.records import ModelOrder, Move, Reduced, RightHandSide, TrialEvaluation
from solvers.network.counted_pool import Count
from solvers.result import Measurement, Status
from solvers.riemannian.newton import Newton

_FIRST_ETA, _SHRINK, _GROWTH = 1e-3, 0.25, 4.0  # of F / (n d), of the last one, and in turn


@dataclass(frozen=True)
class SubstructuredNewtonState:
    """Figures of iterate k; the poses are with driver and robots."""

    k: int
    objective: float
    decrement: float = math.inf
    moved: bool = True
    is_at_rounding: bool = False
    tolerance: float = central.STATIONARY_DECREMENT
    eta: float = 0.0  # last one that was added to S
    is_convex: bool = True  # whether the last step needed none


@dataclass(frozen=True, eq=False)
class Model:
    """A factored model at the poses at hand, Newton's or another, and the solution y = H^-1 g on the cover."""

    order: ModelOrder
    factor: Interface
    y: Array
    parts: list[Array]  # of y, at every robot
    square: float  # g^T H^-1 g


@dataclass(frozen=True)
class SubstructuredNewton:
    """Newton by a driver and its robots, from the poses that they hold; `newton` has the settings.

    Where the Hessian is not positive definite it is that of S + eta blockdiag(0, I), with a small eta that makes it so,
    if the model `is_shifted`, which follows negative curvature; else the damped Gauss-Newton matrix.
    """

    newton: Newton = field(default_factory=Newton)
    is_shifted: bool = False

    @property
    def max_iterations(self) -> int:
        """Most steps of a run."""
        return self.newton.max_iterations

    def init(self, driver: Driver, start: SubstructuredNewtonState | None) -> SubstructuredNewtonState:
        """State 0, at the poses that driver and robots hold."""
        return start if start is not None else SubstructuredNewtonState(0, driver.at.objective)

    def step(self, driver: Driver, state: SubstructuredNewtonState) -> SubstructuredNewtonState:
        """One factorisation and the moves it serves, two rounds each."""
        model = self._factorize(driver, state.eta)
        at_rounding = False
        decrement = central.scaled_decrement(model.square, driver.at.objective, driver.at.rounding_level)
        moved, tolerance = False, central.STATIONARY_FOR_TANGENTS if driver.is_final else central.STATIONARY_DECREMENT
        for _ in range(1 + central.CHORD_STEPS):
            if decrement <= tolerance:
                break
            found = _backtrack(driver, model)
            if found is None:
                break
            trial, answers = found
            gradients = [answer.gradient for answer in answers]
            following = _solved(model.order, model.factor, gradients)
            after = central.scaled_decrement(following.square, trial.objective, trial.rounding_level)
            at_rounding = central.reached_rounding(decrement, after, model.order.is_newton and not moved)
            if trial.objective >= driver.at.objective and after > 0.5 * decrement:
                break
            driver.accept(trial)
            enough = after <= central.PROGRESS * decrement
            model, decrement, moved = following, after, True
            if not enough:
                break
        figures = driver.at.objective, decrement, moved, at_rounding, tolerance, model.order.eta or state.eta
        return SubstructuredNewtonState(state.k + 1, *figures, not model.order.eta)

    def measure(self, driver: Driver, state: SubstructuredNewtonState) -> Measurement:
        """F and the relative decrement."""
        return driver.measured(Measurement(state.objective, 0.0, state.decrement))

    def converged(self, state: SubstructuredNewtonState, measurement: Measurement) -> Status | None:
        """CONVERGED within tolerance or where the gradient is rounding; STALLED when the last step could not move."""
        share = state.tolerance / central.STATIONARY_DECREMENT if state.moved else 1.0
        if measurement.dual_residual <= share * self.newton.tolerance or state.is_at_rounding:
            return Status.CONVERGED
        return None if state.moved else Status.STALLED

    def _factorize(self, driver: Driver, eta: float) -> Model:
        """Factor the Hessian if it is positive definite, else with the least shift or damping; `eta` was the last."""
        order = ModelOrder(self.newton.second_order, 0.0)
        first = _SHRINK * eta or _FIRST_ETA * driver.at.objective / (driver.num_poses * driver.d)
        while (model := model_at(driver, order)) is None:
            if self.is_shifted:
                order = replace(order, eta=max(first, _GROWTH * order.eta))
            elif order.second_order:
                order = replace(order, second_order=False)
            else:
                order = replace(order, damping=max(central.DAMPING_START, central.DAMPING_GROWTH * order.damping))
            if order.damping > central.DAMPING_MAX or math.isinf(order.eta):
                raise NotPositiveDefiniteError("no damping or shift makes Newton's matrix positive definite")
        return model


def model_at(driver: Driver, order: ModelOrder) -> Model | None:
    """Model at the poses at hand; None when a robot's interior, or the sum, is not positive definite."""
    answers = driver.ask(Interior.model, order, Count.PIGGYBACKED)
    reduced = [answer for answer in answers if answer is not None]
    if len(reduced) < len(answers):
        return None
    interface = driver.interface(*driver.tangent)
    try:
        own = _own(driver, reduced, order)
        factor = interface.factorize([answer.schur for answer in reduced], own)
    except NotPositiveDefiniteError:
        return None
    return _solved(order, factor, [answer.right for answer in reduced])


def _own(driver: Driver, reduced: Sequence[Reduced], order: ModelOrder) -> list[tuple[IntArray, Array]]:
    """What the driver adds: the multipliers of the cover, the ground, the damping."""
    g, at = len(driver.cover), LiftedPoses(driver.at.R, driver.at.t)
    interface, layout = driver.interface(*driver.tangent), at.layout
    own: list[tuple[IntArray, Array]] = []
    diagonal = interface.gather([answer.diagonal[:, None] for answer in reduced])[:, 0]
    columns = layout.rotations(np.arange(g))
    if order.second_order:
        curvature = -at.curvature(driver.at.multipliers - order.eta * np.eye(driver.d))
        own.append((columns, curvature))
        diagonal[columns] += np.einsum("naa->na", curvature)
    extra = np.zeros_like(diagonal)
    zero = driver.ground(*driver.tangent)
    extra[zero] = abs(diagonal[zero])
    extra += order.damping * (diagonal + extra)
    own.append((np.arange(interface.side)[:, None], extra[:, None, None]))
    return own


def _solved(order: ModelOrder, factor: Interface, right: Sequence[RightHandSide]) -> Model:
    """Solution y = H^-1 g on the cover, and g^T H^-1 g."""
    y, parts, energy = factor.solve([part.b for part in right])
    return Model(order, factor, y, parts, math.fsum(part.energy for part in right) + energy)


def _backtrack(driver: Driver, model: Model) -> tuple[CoverPoses, list[TrialEvaluation]] | None:
    """First of the moves -y, -y/2, .. that lowers F enough, and the robots' answers there; None when none does."""
    now = poses_from(driver.at.R, driver.at.t)
    layout = TangentLayout(len(driver.cover), *driver.tangent)
    w, v = layout.split(-model.y[:, 0])
    length = 1.0
    moves = [Move(part, length) for part in model.parts]
    for _ in range(central.HALVINGS):
        there = move_poses(now, length * w, length * v)
        R, t, is_first = there.R, there.t, length == 1.0
        if driver.is_final:  # chi2, whose best translations have another matrix at all rotations
            straight, further = Interior.move_straight, Interior.go_straight
            answers = driver.ask_each(straight, moves) if is_first else driver.ask(further, length, Count.PIGGYBACKED)
        else:
            turn = Interior.turn
            turned = driver.ask_each(Interior.move, moves) if is_first else driver.ask(turn, length, Count.PIGGYBACKED)
            t, parts = driver.best_translations(turned)
            answers = driver.ask_each(Interior.evaluate_trial, parts, is_along=True)
        trial = driver.with_sums(CoverPoses(R, t, driver.at.force), [answer.at for answer in answers])
        objective, before = trial.objective, driver.at.objective
        is_within_rounding = is_first and objective <= before * (1.0 + central.ROUNDING)
        if is_within_rounding or objective <= before - central.SUFFICIENT * length * model.square:
            return trial, answers
        length *= 0.5
    return None
