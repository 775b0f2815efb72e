"""The Riemannian staircase by driver and robots: Newton on lifted poses, and from rank to rank by inverse iteration.

`solvers.riemannian.staircase` takes products with Q, each of them two rounds; here a step is the elimination of the
Hessian at lifted poses (`pgo_models.relaxations.low_rank`), as in `solvers.distributed.newton`.
"""

import math
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from pgo_models.certificates.definiteness import smallest_eta
from pgo_models.certificates.lower_bound import UNGROUNDED_SHIFT, smallest_shift
from pgo_models.geometry.rotations import Array, project_to_rotations
from pgo_models.relaxations.low_rank import append_dimension, gram_matrix, move_poses, poses_from
from solvers.distributed.driver import Driver, collect
from solvers.distributed.lower_bound import eliminate_S, prove_with_eta
from solvers.distributed.newton import SubstructuredNewton, SubstructuredNewtonState
from solvers.distributed.robots import climbing
from solvers.distributed.robots.records import Move
from solvers.result import Measurement, Status
from solvers.riemannian.newton import Newton
from solvers.riemannian.staircase import HALVINGS, ROUNDING, SUFFICIENT, DualBound, Staircase

# Decrement at which an indefinite Hessian is left by a climb, not by descent, while the rank is below d + _LOW: a ring
# wound up has plateaus that take 50 steps, and every further rank costs.
_AT_SADDLE, _LOW = 1e-3, 2
_MOST_POWERS, _SETTLED = 60, 1e-2  # inverse iterations, and the relative change of the eigenvalue that ends them


@dataclass(frozen=True)
class SubstructuredStaircaseState:
    """Figures of iterate k; the poses are with driver and robots."""

    k: int
    newton: SubstructuredNewtonState  # at the rank at hand
    bound: DualBound | None = None  # the best that was proven so far; with multipliers where this process has the graph
    is_solved: bool = False
    stalled: bool = False


@dataclass(frozen=True)
class SubstructuredStaircase:
    """Staircase by a driver and its robots, from the poses that they hold; `settings` are those in one place.

    A step is one of Newton or, at a stationary point, the bound and the climb to the next rank.
    """

    settings: Staircase = field(default_factory=Staircase)

    @property
    def max_iterations(self) -> int:
        """Most steps of a run."""
        return self.settings.max_iterations

    @property
    def _newton(self) -> SubstructuredNewton:
        return SubstructuredNewton(Newton(tolerance=self.settings.tolerance), is_shifted=True)

    def init(self, driver: Driver, start: SubstructuredStaircaseState | None) -> SubstructuredStaircaseState:
        """State 0, at the poses that driver and robots hold."""
        return start if start is not None else SubstructuredStaircaseState(0, self._newton.init(driver, None))

    def step(self, driver: Driver, state: SubstructuredStaircaseState) -> SubstructuredStaircaseState:
        """One step of Newton; at a stationary point the bound and, where it falls short, the climb."""
        newton, at = self._newton, state.newton
        is_low = driver.at.R.shape[1] < driver.d + _LOW
        is_saddle = is_low and not at.is_convex and at.decrement <= _AT_SADDLE
        if not is_saddle and newton.converged(at, newton.measure(driver, at)) is None:
            return replace(state, k=state.k + 1, newton=newton.step(driver, state.newton))
        return self._climb(driver, replace(state, k=state.k + 1))

    def measure(self, driver: Driver, state: SubstructuredStaircaseState) -> Measurement:
        """F of the lifted poses, and the relative decrement."""
        return self._newton.measure(driver, state.newton)

    def converged(self, state: SubstructuredStaircaseState, measurement: Measurement) -> Status | None:
        """CONVERGED when the relaxation is solved; STALLED when no way down is found from where it is not."""
        if state.is_solved:
            return Status.CONVERGED
        return Status.STALLED if state.stalled else None

    def _climb(self, driver: Driver, state: SubstructuredStaircaseState) -> SubstructuredStaircaseState:
        F, (_, r, d) = driver.at.objective, driver.at.R.shape
        if driver.at.rounding_level >= F:
            return replace(state, is_solved=True)
        smallest = smallest_shift(self.settings.gap, F, driver.num_poses * d)
        found = smallest_eta(partial(prove_with_eta, driver), smallest)
        if found is None:
            return replace(state, stalled=True)
        eta, proven = found
        if state.bound is None or proven.value > state.bound.lower_bound:
            Lambda = collect(driver)[1] if driver.has_whole else np.zeros((0, d, d))
            state = replace(state, bound=DualBound(proven, Lambda))
        if eta <= smallest:
            return replace(state, is_solved=True)
        if not driver.fits(r + 1):
            return replace(state, stalled=True)
        is_lower = _escape(driver, eta, smallest)
        if is_lower is None:  # what the proof lacks is precision, not a way down
            return replace(state, is_solved=True)
        return replace(state, stalled=not is_lower, newton=replace(self._newton.init(driver, None), eta=eta))


def round_lifted(driver: Driver) -> None:
    """Rotations of the nearest factor of rank d, turned over if most of the cover reflect, and their translations."""
    d, R = driver.d, driver.at.R
    if R.shape[1] == d:
        return
    V = np.linalg.eigh(sum(driver.ask(climbing.gram, None), gram_matrix(R)))[1][:, -d:]
    V[:, 0] *= 1.0 if np.median(np.sign(np.linalg.det(V.T @ R))) > 0.0 else -1.0
    driver.at = replace(driver.at, R=project_to_rotations(V.T @ R), t=driver.at.t @ V)
    driver.set_translations(driver.ask(climbing.round_to, V))


def _escape(driver: Driver, eta: float, least: float) -> bool | None:
    """Whether a move along the eigenvector v of the smallest eigenvalue of Q - Lambda, in a new dimension, lowers F.

    It is the first of s v, s v/2, .. that lowers F enough, to second order by s^2 |value|; None where the eigenvalue is
    not below -least.
    """
    x, moves, length = _direction(driver, eta)
    values = driver.ask_each(climbing.climb, moves, is_along=True)
    value = math.fsum([*values, -climbing.pulled(driver.at.multipliers, x[len(driver.cover) :])])
    flat = append_dimension(poses_from(driver.at.R, driver.at.t))
    force = np.concatenate([driver.at.force, np.zeros((len(driver.at.force), 1))], axis=1)
    at = driver.at = replace(driver.at, R=flat.R, t=flat.t, force=force)
    if value >= -least:
        return None
    w, v = flat.upwards(x[:, 0])
    for _ in range(HALVINGS):
        promised = -(length**2) * value
        if promised <= ROUNDING * at.objective + at.rounding_level:
            break
        answers, there = driver.ask(climbing.try_climb, length), move_poses(flat, length * w, length * v)
        trial = driver.with_sums(replace(at, R=there.R, t=there.t), answers)
        if trial.objective <= at.objective - SUFFICIENT * promised:
            driver.accept(trial)
            return True
        length *= 0.5
    return False


def _direction(driver: Driver, eta: float) -> tuple[Array, list[Move], float]:
    """That eigenvector on the cover, (side, 1), what robots find theirs by, and the s that turns a block by 45 degrees.

    Inverse iteration, two rounds each, with an eta that hardly makes Q - Lambda + eta I definite: the eigenvalue of its
    inverse is far above all others. The translations are the best ones; the norm of the rest is 1.
    """
    proof = eliminate_S(driver, driver.ground(1).ravel(), eta, UNGROUNDED_SHIFT)
    assert proof is not None  # it has just been proven
    g, d = len(driver.cover), driver.d
    own = np.concatenate([np.zeros((g, 1)), np.random.default_rng(g).standard_normal((d * g, 1))])
    answers, value, scale = driver.ask(climbing.begin_direction, None), math.inf, 1.0
    for _ in range(_MOST_POWERS):
        norm = math.sqrt(math.fsum([float(np.sum(own**2)), *(answer.square for answer in answers)]))
        x, parts, energy = proof.factor.solve([answer.right.b for answer in answers], own)
        before, value = value, norm**2 / math.fsum([energy, *(answer.right.energy for answer in answers)])
        scale = value / norm
        if abs(value - before) <= _SETTLED * value:
            break
        moves = [Move(part, scale) for part in parts]
        answers = driver.ask_each(climbing.follow_direction, moves, is_along=True)
        own = np.concatenate([np.zeros((g, 1)), scale * x[g:]])
    largest = [float(np.sum(own[g:].reshape(-1, d) ** 2, axis=1).max()), *(answer.largest for answer in answers)]
    return scale * x, [Move(part, scale) for part in parts], norm / math.sqrt(max(largest))
