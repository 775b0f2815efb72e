"""The Riemannian staircase by driver and robots: Newton on lifted poses, and inverse iteration.

`solvers.riemannian.climb` decides when a rank ends, and how. `solvers.riemannian.staircase` takes
products with Q, each of which would be two rounds; here a step is the elimination of the Hessian at
lifted poses (`pgo_models.relaxations.low_rank`), as in `solvers.robots.newton`.

Where Newton is at a stationary point of a rank, the driver proves a bound
(`solvers.robots.proof`). If the bound is loose, the robots keep their elimination of
S + eta blockdiag(0, I), and inverse iteration with it finds the direction down: one round for the
first vector, and one for every further one (`follow_direction`). The robots then append a dimension
to their poses (`go_upwards`) and try lengths along the direction (`try_climb`), a round each.
`round_lifted` ends the staircase with three rounds more: the sum of R R^T, the rounded rotations,
and their best translations.

The driver's method stands first; the robot's orders (Rosen et al. 2019) are below it.
"""

import math
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from pgo_models.certificates.definiteness import smallest_eta
from pgo_models.certificates.lower_bound import UNGROUNDED_MARGIN, LowerBound, smallest_shift
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations
from pgo_models.relaxations.low_rank import append_dimension, gram_matrix, poses_from
from solvers.carry.moments import Moment
from solvers.carry.registry import order, record
from solvers.result import Measurement, Status
from solvers.riemannian.climb import ClimbEnding, DualBound, climb, staircase_status
from solvers.riemannian.newton import Newton, newton_status
from solvers.riemannian.staircase import Staircase
from solvers.robots.driver import CoverPoses, Driver, collect
from solvers.robots.elimination import RightHandSide
from solvers.robots.newton import (
    DescentSession,
    Move,
    SubstructuredNewton,
    SubstructuredNewtonState,
    moved,
)
from solvers.robots.part import CostParts, Interior, ReducedTranslations
from solvers.robots.poses import reduce_translations
from solvers.robots.proof import eliminate_S, prove_with_eta

# Decrement at which an indefinite Hessian is left by a climb, not by descent, while the rank is
# below d + _LOW: a ring wound up has plateaus that take 50 steps, and every further rank costs.
_AT_SADDLE = 1e-3
_LOW = 2
# inverse iterations, and the relative change of the eigenvalue that ends them
_MOST_POWERS = 60
_SETTLED = 1e-2


@dataclass(frozen=True)
class SubstructuredStaircaseState:
    """Figures of iterate k; the poses are with driver and robots, which hold them at a moment."""

    k: int
    moment: Moment
    newton: SubstructuredNewtonState  # at the current rank
    # the best that was proven so far; with multipliers where this process has the graph
    bound: DualBound | None = None
    is_solved: bool = False
    stalled: bool = False


@dataclass(frozen=True)
class SubstructuredStaircase:
    """Staircase by a driver and its robots, from the poses that they hold.

    `settings` are those in one place. A step is one of Newton or, at a stationary point, the bound
    and the climb to the next rank.
    """

    settings: Staircase = field(default_factory=Staircase)

    @property
    def max_iterations(self) -> int:
        """Most steps of a run."""
        return self.settings.max_iterations

    @property
    def _newton(self) -> SubstructuredNewton:
        return SubstructuredNewton(Newton(tolerance=self.settings.tolerance), is_shifted=True)

    def init(
        self, driver: Driver, start: SubstructuredStaircaseState | None
    ) -> SubstructuredStaircaseState:
        """State 0, or that of a snapshot, at the poses that driver and robots hold."""
        if start is not None:
            newton = self._newton.init(driver, start.newton)
            return replace(start, moment=driver.moment(), newton=newton)
        return SubstructuredStaircaseState(0, driver.moment(), self._newton.init(driver, None))

    def step(
        self, driver: Driver, state: SubstructuredStaircaseState
    ) -> SubstructuredStaircaseState:
        """One step of Newton; at a stationary point the bound and, if that is loose, the climb."""
        driver.return_to(state.moment)
        rank = driver.current.R.shape[1]
        figures = state.newton
        is_low = rank < driver.d + _LOW
        is_saddle = is_low and not figures.is_convex and figures.decrement <= _AT_SADDLE
        if is_saddle or newton_status(figures) is not None:
            following = self._climb(driver, state)
        else:
            following = replace(state, newton=self._newton.step(driver, figures))
        return replace(following, k=state.k + 1, moment=driver.moment())

    def measure(self, driver: Driver, state: SubstructuredStaircaseState) -> Measurement:
        """F of the lifted poses, and the relative decrement."""
        return self._newton.measure(driver, state.newton)

    def converged(
        self, state: SubstructuredStaircaseState, measurement: Measurement
    ) -> Status | None:
        """As `Staircase`."""
        return staircase_status(state.is_solved, state.stalled)

    def _climb(
        self, driver: Driver, state: SubstructuredStaircaseState
    ) -> SubstructuredStaircaseState:
        """Prove that the relaxation is solved, or leave for the next rank."""
        climbed = climb(EliminatedClimb(driver), self.settings.gap, state.bound)
        state = replace(
            state,
            bound=climbed.bound,
            is_solved=climbed.ending is ClimbEnding.SOLVED,
            stalled=climbed.ending is ClimbEnding.STALLED,
        )
        if climbed.direction is None:
            return state
        newton = self._newton.init(driver, None)
        return replace(state, newton=replace(newton, eta=climbed.direction.eta))


def round_lifted(driver: Driver) -> None:
    """Round lifted poses to rotations of the nearest factor of rank d.

    Their translations are the best ones. The factor is turned over if most of the cover reflect.
    """
    d = driver.d
    R = driver.current.R
    if R.shape[1] == d:
        return
    gram = sum(driver.ask(sum_gram, None), gram_matrix(R))
    _, vectors = np.linalg.eigh(gram)
    V = vectors[:, -d:]
    orientations = np.sign(np.linalg.det(V.T @ R))
    if np.median(orientations) <= 0.0:
        V[:, 0] *= -1.0
    rounded = project_to_rotations(V.T @ R)
    driver.current = replace(driver.current, R=rounded, t=driver.current.t @ V)
    driver.set_translations(driver.ask(round_to, V))


@dataclass(frozen=True, eq=False)
class CoverDirection:
    """`climb.ClimbDirection` on the cover; the robots hold their parts of it."""

    value: float
    first_length: float
    eta: float  # shift with which S is definite
    flat: Poses  # poses of the cover in one dimension more
    w: Array  # the move of their rotations
    v: Array  # and of their translations


@dataclass(frozen=True)
class EliminatedClimb:
    """`climb.ClimbAlgebra` by driver and robots, from the poses that they hold."""

    driver: Driver

    @property
    def objective(self) -> float:
        """F at the poses."""
        return self.driver.current.objective

    @property
    def rounding_level(self) -> float:
        """F where every residual is as large as rounding can make it."""
        return self.driver.current.rounding_level

    @property
    def num_rows(self) -> int:
        """Number of rows of the rotations, n d."""
        return self.driver.num_poses * self.driver.d

    @property
    def has_room(self) -> bool:
        """Whether the interface of the next rank fits into the driver's memory."""
        rank = self.driver.current.R.shape[1]
        return self.driver.fits(rank + 1)

    def prove(self, gap: float) -> LowerBound | None:
        """Return the bound with the smallest eta found, without a pose that it is grounded at."""
        smallest = smallest_shift(gap, self.objective, self.num_rows)
        eta_and_bound = smallest_eta(partial(prove_with_eta, self.driver), smallest)
        return eta_and_bound[1] if eta_and_bound is not None else None

    def with_multipliers(self, bound: LowerBound) -> DualBound:
        """Return a bound with all multipliers, where this process has the graph, else without."""
        driver = self.driver
        if driver.has_whole:
            return DualBound(bound, collect(driver)[1])
        return DualBound(bound, np.zeros((0, driver.d, driver.d)))

    def direction(self, proven: LowerBound, smallest: float) -> CoverDirection:
        """Return the direction of the smallest eigenvalue; all poses go to the next dimension."""
        driver = self.driver
        x, moves, length = _direction(driver, proven.eta)
        values = driver.ask_each(go_upwards, moves)
        value_on_cover = pulled(driver.current.multipliers, x[len(driver.cover) :])
        value = math.fsum([*values, -value_on_cover])
        flat = append_dimension(poses_from(driver.current.R, driver.current.t))
        force = np.concatenate(
            [driver.current.force, np.zeros((len(driver.current.force), 1))], axis=1
        )
        driver.current = replace(driver.current, R=flat.R, t=flat.t, force=force)
        w, v = flat.upwards(x[:, 0])
        return CoverDirection(value, length, proven.eta, flat, w, v)

    def evaluate(self, direction: CoverDirection, length: float) -> tuple[float, CoverPoses]:
        """Return F after a move along the direction, and the poses there."""
        driver = self.driver
        answers = driver.ask(try_climb, length)
        moved = direction.flat.moved_along(length * direction.w, length * direction.v)
        trial = driver.with_cost(replace(driver.current, R=moved.R, t=moved.t), answers)
        return trial.objective, trial

    def accept(self, trial: CoverPoses) -> None:
        """Go to the poses, here and on the robots."""
        self.driver.accept(trial)


def _direction(driver: Driver, eta: float) -> tuple[Array, list[Move], float]:
    """Find the eigenvector of the smallest eigenvalue of Q - Lambda, whose rotations have norm 1.

    The answer is that vector on the cover, (side, 1), what robots find theirs by, and the length at
    which its largest block turns by 45 degrees. It is inverse iteration, a round each, with an
    eta that hardly makes Q - Lambda + eta I definite: the eigenvalue of its inverse is far above
    all others. The translations are the best ones.
    """
    proof = eliminate_S(driver, None, eta, UNGROUNDED_MARGIN)
    assert proof is not None  # it has just been proven
    g = len(driver.cover)
    d = driver.d
    no_translations = np.zeros((g, 1))
    rng = np.random.default_rng(g)
    vector_on_cover = np.concatenate([no_translations, rng.standard_normal((d * g, 1))])
    answers = driver.ask(begin_direction, None)
    value = math.inf
    scale = 1.0
    for _ in range(_MOST_POWERS):
        own_square = float(np.sum(vector_on_cover**2))
        norm = math.sqrt(math.fsum([own_square, *(answer.square for answer in answers)]))
        x, parts, energy = proof.factor.solve(
            [answer.right.b for answer in answers], vector_on_cover
        )
        energy = math.fsum([energy, *(answer.right.energy for answer in answers)])
        last_value = value
        value = norm**2 / energy
        scale = value / norm
        if abs(value - last_value) <= _SETTLED * value:
            break
        moves = [Move(part, scale) for part in parts]
        answers = driver.ask_each(follow_direction, moves)
        vector_on_cover = np.concatenate([no_translations, scale * x[g:]])
    own_blocks = vector_on_cover[g:].reshape(-1, d)
    own_largest = float(np.sum(own_blocks**2, axis=1).max())
    largest = max([own_largest, *(answer.largest for answer in answers)])
    return scale * x, [Move(part, scale) for part in parts], norm / math.sqrt(largest)


# The robot's orders.


@record("PowerStep")
@dataclass(frozen=True, eq=False)
class PowerStep:
    """Right-hand side of the next inverse iteration, and figures of the interior part of v."""

    right: RightHandSide
    square: float  # squared norm of the interior part
    largest: float  # largest squared norm of a block


@order("climb.begin_direction")
def begin_direction(robot: Interior, _: None) -> tuple[Interior, PowerStep]:
    """Begin inverse iteration at a random direction of the interior's rotations."""
    rng = np.random.default_rng(robot.part.poses[0])
    num_rows = len(robot.interior_rows)
    v = rng.standard_normal(num_rows)
    return _power_step(robot, v)


@order("climb.follow_direction")
def follow_direction(robot: Interior, order: Move) -> tuple[Interior, PowerStep]:
    """Take one inverse iteration, from its solution on the boundary, times a length."""
    x = robot.system.back_substitute(order.x)
    v = order.length * x[robot.interior_rows, 0]
    return _power_step(robot, v)


@order("climb.go_upwards")
def go_upwards(robot: Interior, order: Move) -> tuple[Interior, float]:
    """Go to one dimension more, with a direction x in it; answer the robot's part of x^T S x.

    The order has the solution on the boundary that gives x, and the length that it is scaled by.
    """
    x = order.length * robot.system.back_substitute(order.x)
    poses = append_dimension(robot.poses)
    Lambda = robot.multipliers()[robot.part.interior]
    own_rows = x[robot.interior_rows]
    objective = robot.problem.at_point(x).value
    value = objective - pulled(Lambda, own_rows)
    descent = DescentSession(step=poses.upwards(x[:, 0]))
    return robot.in_session(descent).at_poses(poses), value


def pulled(Lambda: Array, x: Array) -> float:
    """Compute sum_i x_i^T Lambda_i x_i of Lambda, (n, d, d), and rows x, (d n, 1)."""
    d = Lambda.shape[-1]
    blocks = x.reshape(-1, d)
    return float(np.einsum("na,nab,nb->", blocks, Lambda, blocks))


@order("climb.try_climb")
def try_climb(robot: Interior, length: float) -> tuple[Interior, CostParts]:
    """Move a length along the direction: a trial, and the parts of F there."""
    trial = moved(robot, length)
    following = robot.at_trial(trial)
    return following, following.evaluation(trial)


@order("climb.sum_gram")
def sum_gram(robot: Interior, _: None) -> tuple[Interior, Array]:
    """Compute the sum of R_i R_i^T over the interior, (r, r)."""
    interior = robot.part.interior
    return robot, gram_matrix(robot.poses.R[interior])


@order("climb.round_to")
def round_to(robot: Interior, V: Array) -> tuple[Interior, ReducedTranslations]:
    """Project the poses V^T R_i to rotations; then as `reduce_translations`."""
    poses = robot.poses
    R = project_to_rotations(V.T @ poses.R)
    rounded = Poses(R, poses.t @ V)
    state = replace(robot.state, poses=rounded, saved=rounded, session=None)
    return reduce_translations(robot.with_state(state), None)


def _power_step(robot: Interior, v: Array) -> tuple[Interior, PowerStep]:
    """Reduce the right-hand side that is v on the rotations of the interior, zero elsewhere."""
    problem = robot.part.problem
    b = np.zeros((problem.side, 1))
    b[robot.interior_rows, 0] = v
    following, right = robot.with_right(b)
    blocks = v.reshape(-1, problem.d)
    squares = np.sum(blocks**2, axis=1)
    square = float(squares.sum())
    largest = float(squares.max(initial=0.0))
    step = PowerStep(right, square, largest)
    return following, step
