"""The second stage by driver and robots: `pgo_models.certificates.newton_polish` without secants, step for step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pgo_models.certificates.newton_polish import (
    CHORD_STEPS,
    DAMPING_GROWTH,
    DAMPING_MAX,
    DAMPING_START,
    HALVINGS,
    PROGRESS,
    ROUNDING,
    STATIONARY_DECREMENT,
    SUFFICIENT,
    move_poses,
    reached_rounding,
    scaled_decrement,
)
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.hessian import TangentLayout
from pgo_models.problem.matrices import inner
from solvers.distributed.driver import Count, Driver
from solvers.distributed.interface import InterfaceFactor
from solvers.network.messages import Message
from solvers.result import Measurement, Status
from solvers.riemannian.newton import Newton


@dataclass(frozen=True)
class SubstructuredNewtonState:
    """Figures of iterate k; the poses are with driver and robots."""

    k: int
    objective: float
    decrement: float = math.inf
    moved: bool = True
    is_at_rounding: bool = False


@dataclass(frozen=True, eq=False)
class Model:
    """A factored model at the poses at hand, Newton's or another, and the solution y = H^-1 g on the cover."""

    is_newton: bool
    factor: InterfaceFactor
    y: Array
    square: float  # g^T H^-1 g


@dataclass(frozen=True)
class SubstructuredNewton:
    """Newton by a driver and its robots, from the poses that they hold; `newton` has the settings."""

    newton: Newton = field(default_factory=Newton)

    @property
    def max_iterations(self) -> int:
        """Most steps of a run."""
        return self.newton.max_iterations

    def init(self, driver: Driver, start: SubstructuredNewtonState | None) -> SubstructuredNewtonState:
        """State 0, at the poses that driver and robots hold."""
        return start if start is not None else SubstructuredNewtonState(0, driver.objective)

    def step(self, driver: Driver, state: SubstructuredNewtonState) -> SubstructuredNewtonState:
        """One factorisation and the moves it serves, two rounds each."""
        model = self._factorize(driver)
        at_rounding = False
        decrement = scaled_decrement(model.square, driver.objective, driver.rounding_level)
        moved = False
        for _ in range(1 + CHORD_STEPS):
            if decrement <= STATIONARY_DECREMENT:
                break
            found = _backtrack(driver, model)
            if found is None:
                break
            trial, answers = found
            following = _solved(driver, model.is_newton, model.factor, answers)
            after = scaled_decrement(following.square, trial.objective, trial.rounding_level)
            at_rounding = reached_rounding(decrement, after, model.is_newton and not moved)
            if trial.objective >= driver.objective and after > 0.5 * decrement:
                break
            driver.ask("accept", count=Count.PIGGYBACKED)
            driver.R, driver.t, driver.force = trial.R, trial.t, trial.force
            driver.objective, driver.rounding_level = trial.objective, trial.rounding_level
            enough = after <= PROGRESS * decrement
            model, decrement, moved = following, after, True
            if not enough:
                break
        return SubstructuredNewtonState(state.k + 1, driver.objective, decrement, moved, at_rounding)

    def measure(self, driver: Driver, state: SubstructuredNewtonState) -> Measurement:
        """F and the relative decrement."""
        return driver.measured(state.objective, 0.0, state.decrement)

    def converged(self, state: SubstructuredNewtonState, measurement: Measurement) -> Status | None:
        """CONVERGED within tolerance or where the gradient is rounding; STALLED when the last step could not move."""
        if measurement.dual_residual <= self.newton.tolerance or state.is_at_rounding:
            return Status.CONVERGED
        return None if state.moved else Status.STALLED

    def _factorize(self, driver: Driver) -> Model:
        """Factor the Hessian if it is positive definite, else the Gauss-Newton matrix with the least damping."""
        if self.newton.second_order:
            model = model_at(driver, second_order=True, damping=0.0)
            if model is not None:
                return model
        damping = 0.0
        while True:
            model = model_at(driver, second_order=False, damping=damping)
            if model is not None:
                return model
            damping = max(DAMPING_START, DAMPING_GROWTH * damping)
            if damping > DAMPING_MAX:
                raise NotPositiveDefiniteError("the damped Gauss-Newton matrix is not positive definite")


@dataclass(frozen=True, eq=False)
class _Trial:
    R: Array
    t: Array
    objective: float
    rounding_level: float
    force: Array


def model_at(driver: Driver, second_order: bool, damping: float) -> Model | None:
    """Model at the poses at hand; None when a robot's interior, or the sum, is not positive definite."""
    settings = np.array([float(second_order), damping])
    answers = driver.ask("model", {"settings": settings}, Count.PIGGYBACKED)
    if not all(answer["definite"][0] for answer in answers):
        return None
    interface = driver.interface(*driver.tangent)
    try:
        factor = interface.factorize([a["schur"] for a in answers], _own(driver, answers, second_order, damping))
    except NotPositiveDefiniteError:
        return None
    return _solved(driver, second_order, factor, answers)


def _own(
    driver: Driver, answers: Sequence[Message], second_order: bool, damping: float
) -> list[tuple[IntArray, Array]]:
    """What the driver adds: the multipliers of the cover, the ground, the damping."""
    g, d = len(driver.cover), driver.d
    interface, layout = driver.interface(*driver.tangent), TangentLayout(g, d)
    own: list[tuple[IntArray, Array]] = []
    diagonal = interface.gather([answer["diagonal"][:, None] for answer in answers])[:, 0]
    columns = layout.rotations(np.arange(g))
    if second_order:
        Lambda = driver.multipliers
        trace = np.einsum("naa->n", Lambda)[:, None, None]
        curvature = -2.0 * trace if d == 2 else -2.0 * (trace * np.eye(3) - Lambda)
        own.append((columns, curvature))
        diagonal[columns] += np.einsum("naa->na", curvature)
    extra = np.zeros_like(diagonal)
    zero = driver.ground(*driver.tangent)
    extra[zero] = abs(diagonal[zero])
    extra += damping * (diagonal + extra)
    own.append((np.arange(interface.side)[:, None], extra[:, None, None]))
    return own


def _solved(driver: Driver, is_newton: bool, factor: InterfaceFactor, answers: Sequence[Message]) -> Model:
    """Solution y = H^-1 g on the cover, and g^T H^-1 g."""
    b = driver.interface(*driver.tangent).gather([answer["b"] for answer in answers])
    y = factor.solve(b)
    return Model(is_newton, factor, y, math.fsum(float(answer["energy"][0]) for answer in answers) + inner(b, y))


def _backtrack(driver: Driver, model: Model) -> tuple[_Trial, list[Message]] | None:
    """First of the moves -y, -y/2, .. that lowers F enough, and the robots' answers there; None when none does."""
    now, layout = Poses(driver.R, driver.t), TangentLayout(len(driver.cover), driver.d)
    w, v = layout.split(-model.y[:, 0])
    length = 1.0
    for _ in range(HALVINGS):
        message = np.array([length])
        if length == 1.0:
            parts = driver.interface(*driver.tangent).scatter(model.y)
            answers = driver.ask("move", [{"x": part, "length": message} for part in parts])
        else:
            answers = driver.ask("turn", {"length": message}, Count.PIGGYBACKED)
        R = move_poses(now, length * w, length * v).R
        t, answers = driver.best_translations(answers, "evaluate_trial")
        objective, level, force = driver.state_of(answers)
        trial = _Trial(R, t, objective, level, force)
        if objective <= driver.objective - SUFFICIENT * length * model.square:
            return trial, answers
        if length == 1.0 and objective <= driver.objective * (1.0 + ROUNDING):
            return trial, answers
        length *= 0.5
    return None
