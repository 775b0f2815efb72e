"""Lower bounds on F that hold in exact arithmetic, from any multipliers.

They are grounded at a pose, or use a shift eta.

For feasible X, tr(X^T M X) = tr(X^T S X) + tr(Lambda) with S = M - blockdiag(0, Lambda) and any
symmetric Lambda_i.

**Grounded at pose r.** Take any X' with X'_r = (0, I), feasible elsewhere or not, and G = S X'.
Move a feasible X so that its pose r is at the origin, which leaves S X as it is; then X_r = X'_r Q
for an orthogonal Q, and Z = X - X' Q vanishes at r. Here X_r are the rows of pose r, while S_r and
G_r are S and G without the rows (and columns) of pose r. With S_r positive definite,

    tr(X^T S X) = tr(X'^T S X') + 2 tr((G Q)^T Z) + tr(Z^T S_r Z) >= tr(X'^T S X') - tr(G_r^T S_r^-1
    G_r).

X' begins at the poses and is moved by -S_r^-1 G_r, at most MOST_MOVES times
(`move_until_settled`); after that G_r is little more than rounding. What is then subtracted, all of
it bounded: the rounding of tr(X'^T S X') + tr(Lambda), summed edge by edge
(`evaluate_certificate`), and sum (|G_r| + its error)^2 / slack with S_r >= diag(slack) proved by
one factorisation (`prove_definite`). At an optimum S X' = 0. If only the translation of pose r were
left out, S would keep this null space and need a shift to be positive definite; so the rotation of
pose r is left out, too. (Compare Carlone, Calafiore, Tommolillo & Dellaert 2016, on when the dual
is tight.)

**chi2.** What is bounded here is a quadratic cost tr(X^T M X) + constant; that of a tangent
(`PGOProblem.tangent_at`) is at most chi2 at all poses, and so is its bound. At the minimum of chi2
both have one value and one gradient.

**With a shift.** Where S_r is not positive definite, S_r + eta blockdiag(0, I) may be; the bound
then loses eta sum_i ||X_i - X'_i Q||_F^2 <= eta sum_i (sqrt(8) + ||X'_i - R_i^T||)^2, as rotations
are at most sqrt(8) apart. Or, asking nothing of poses: if S + eta blockdiag(0, I) is positive
definite without the row of one translation, F >= tr(Lambda) - eta n d (Rosen et al. 2019, theorem
7; Carlone et al. 2015).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np

from pgo_models.certificates.definiteness import (
    DefiniteProof,
    is_definite_in_doubles,
    prove_definite,
    smallest_eta,
)
from pgo_models.certificates.dual_variables import check_multipliers
from pgo_models.certificates.rounding_errors import Evaluation, evaluate_certificate, has_safe_scale
from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, orthogonality_error
from pgo_models.graphs.pose_graph import IntArray, middle_pose
from pgo_models.problem.floating_point import OUTWARD, UNIT_ROUNDOFF, exact_sum
from pgo_models.problem.matrices import inner, rotation_columns
from pgo_models.problem.problem import PGOProblem

# Share of the wanted gap that eta may cost; the rest is for poses a little off the optimum.
_ETA_SHARE = 0.5
# Shift, relative to the diagonal, of the form with eta alone: it makes up for rounding.
UNGROUNDED_SHIFT = 1e-11
MOST_MOVES = 3
# X' is not moved again once the loss to G_r is below one of these: SETTLED times the value, HIDDEN
# times the loss with the rounding of G_r, or NEGLIGIBLE times what moving has gained.
SETTLED = 1e-13
HIDDEN = 0.1
NEGLIGIBLE = 0.01


@dataclass(frozen=True)
class LowerBound:
    """A proven lower bound on F over all poses.

    Parameters
    ----------
    value : float
        The bound. It is never negative: F is a sum of squares.
    eta : float
        Shift with which it was proved; nan when nothing better than F >= 0 was.
    is_grounded : bool
        Whether the proof leaves out one whole pose; otherwise it is one with eta alone.
    rounding : float
        Sum of what was subtracted for rounding and, when grounded, for the G_r that moving has
        left; not the loss to eta.
    cap : float
        Condition that the information matrices were cut down to (`shrunk_information`).
    is_definite : bool
        Whether S_r is definite in doubles, where this could not be proved: no other poses would
        help.
    """

    value: float
    eta: float
    is_grounded: bool
    rounding: float
    cap: float = math.inf
    is_definite: bool = False


NO_BOUND = LowerBound(0.0, math.nan, False, 0.0)


def prove_bound(
    problem: PGOProblem, Lambda: Array, eta: float = 0.0, poses: Poses | None = None
) -> float | None:
    """Prove a bound on F over all poses from multipliers, a shift and, if given, poses.

    It holds in exact arithmetic for the graph whose measurements and weights are the stored
    numbers: F is the sum with `problem.graph.R_ij` as written, rotations but for 64 eps, not with
    the rotations nearest to them. Rounding of the entries, of the factorisation and of the sums is
    bounded and subtracted (this file's opening, `pgo_models.certificates.rounding_errors`,
    `pgo_models.problem.cholesky`). Lambda is made symmetric first.

    Parameters
    ----------
    problem : PGOProblem
        The problem.
    Lambda : (n, d, d) array
        Multipliers, which may come from anywhere; at a certified optimum those of `multipliers`
        give a bound equal to F but for rounding.
    eta : float
        Shift of the rows of rotations, zero or more.
    poses : Poses, optional
        Where to ground the proof, at a pose in the middle of the graph. Without poses eta has to
        make S definite.

    Returns
    -------
    float or None
        The bound. None when the matrix cannot be shown to be positive definite, as without poses at
        eta = 0 or any eta that rounding swallows.

    Raises
    ------
    SettingError
        When eta is negative or not finite, or Lambda has the wrong shape.

    Examples
    --------
    >>> from pgo_models import chordal_start, grid, multipliers
    >>> from solvers import polish
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> poses = polish(problem, chordal_start(problem))
    >>> Lambda = multipliers(problem, poses)
    >>> bound = prove_bound(problem, Lambda, poses=poses)
    >>> bool(bound <= problem.objective(poses) <= (1 + 1e-11) * bound)
    True
    >>> bool(prove_bound(problem, Lambda, eta=1e-6) < bound), prove_bound(problem, Lambda, eta=0.0)
    (True, None)
    """
    if poses is not None:
        poses = problem.at_best_translations(poses)
        problem = problem.tangent_at(poses)
    point = _grounded_at(problem, poses) if poses is not None else None
    proven = _prove(problem, _symmetric(problem, Lambda), eta, point)
    return proven.value if proven is not None else None


def prove_at(problem: PGOProblem, Lambda: Array, poses: Poses) -> LowerBound | None:
    """Bound grounded at poses without a shift, or None."""
    return _prove(problem, _symmetric(problem, Lambda), 0.0, _grounded_at(problem, poses))


def best_bound(
    problem: PGOProblem, Lambda: Array, poses: Poses | None, gap: float, objective: float
) -> LowerBound:
    """Best bound from multipliers: grounded without eta where that goes through.

    Otherwise it is the better of both forms, each with the smallest eta found.

    It is grounded at one of the poses, which have their best translations; None leaves the form
    that asks nothing of poses. The smallest eta that is tried follows from gap and objective.
    """
    Lambda = _symmetric(problem, Lambda)
    point = _grounded_at(problem, poses) if poses is not None else None
    grounded = _prove(problem, Lambda, 0.0, point) if point is not None else None
    if grounded is not None and grounded.value > 0.0:
        return grounded
    count = problem.num_poses * problem.d
    best = search_forms(
        lambda eta: _prove(problem, Lambda, eta, None),
        (lambda eta: _prove(problem, Lambda, eta, point)) if point is not None else None,
        smallest_shift(gap, objective, count),
        _trace(Lambda),
        count,
    )
    is_definite = point is not None and is_definite_in_doubles(problem, Lambda, point.rows)
    return replace(best, is_definite=is_definite)


def search_forms(
    prove_with_eta: Callable[[float], LowerBound | None],
    prove_grounded: Callable[[float], LowerBound | None] | None,
    smallest: float,
    trace: float,
    count: int,
) -> LowerBound:
    """Return the better of both forms, each with the smallest eta found (`search_bound`).

    `NO_BOUND` where neither gives one above zero. Each takes an eta to a bound, or to None where
    the matrix cannot be shown to be positive definite with it; the grounded one may be missing.
    """
    bounds = [NO_BOUND, search_bound(prove_with_eta, smallest, trace, count)]
    if prove_grounded is not None:
        bounds.append(search_bound(prove_grounded, smallest, trace, count))
    return max(bounds, key=lambda bound: bound.value)


def search_bound(
    prove: Callable[[float], LowerBound | None], smallest: float, trace: float, count: int
) -> LowerBound:
    """Bound that `prove` gives with the smallest eta found.

    It is `NO_BOUND` when tr(Lambda) - eta n d would not be above 0.

    The search begins with the eta `smallest` (`smallest_eta`); trace and count are tr(Lambda) and n
    d.
    """
    first = max(smallest, UNIT_ROUNDOFF * trace / count)  # at F = 0 the smallest would never grow
    smallest_found = smallest_eta(prove, first, below=trace / count)
    if smallest_found is None:
        return NO_BOUND
    _, bound = smallest_found
    return bound if bound.value > 0.0 else NO_BOUND


def smallest_shift(gap: float, objective: float, count: int) -> float:
    """Shift eta that spends a fixed share of a relative gap, count = n d."""
    return _ETA_SHARE * gap * objective / count


def quadratic_loss(product: Array, error: Array | float, slack: Array) -> float:
    """Bound on tr(G^T S_r^-1 G) for S_r >= diag(slack) and G known to an error, rounded up.

    It is sum (|G| + error)^2 / slack.
    """
    return OUTWARD * float(np.sum((np.abs(product) + error) ** 2 / slack[:, None]))


def squared_distances(moved: Array, rotations: Array) -> float:
    """Bound on sum_i ||R_i^T - P_i Q||_F^2 over all rotations R_i and Q, rounded up.

    The blocks P_i were moved away from rotations P^_i.

    Two rotations are at most sqrt(8) apart, P_i is ||P_i - P^_i|| from P^_i, and that ||P^_i P^_i^T
    - I|| from one. Rounding of these, a few u beside sqrt(8), is what `OUTWARD` is for. Rows of P_i
    and of P^_i, (d n, d), are given.
    """
    d = rotations.shape[1]
    blocks = rotations.reshape(-1, d, d)
    away = np.linalg.norm((moved - rotations).reshape(-1, d * d), axis=1)
    apart = math.sqrt(8.0) + orthogonality_error(blocks) + away
    return OUTWARD * float(np.sum(apart**2))


@dataclass(frozen=True, eq=False)
class _Ground:
    """X with pose r at (0, I) exactly, and the rows of that pose."""

    X: Array
    rows: IntArray


def _grounded_at(problem: PGOProblem, poses: Poses) -> _Ground:
    n = problem.num_poses
    d = problem.d
    r = middle_pose(problem.graph)
    X = problem.stacked(poses)
    X[:n] -= poses.t[r]
    X = X @ poses.R[r]
    rows = pose_rows(r, n, d)
    X[rows] = np.concatenate([np.zeros((1, d)), np.eye(d)])
    return _Ground(X, rows)


def pose_rows(pose: int, n: int, d: int) -> IntArray:
    """Rows of one pose in X, (d + 1,)."""
    return np.concatenate([[pose], rotation_columns(np.array([pose]), n, d)[0]])


@np.errstate(over="ignore", invalid="ignore")  # what overflows is inf or nan, which proves nothing
def _prove(
    problem: PGOProblem, Lambda: Array, eta: float, ground: _Ground | None
) -> LowerBound | None:
    if not 0.0 <= eta < math.inf:
        raise SettingError(f"eta is {eta}; a shift must not be negative, and finite")
    if not (np.isfinite(Lambda).all() and has_safe_scale(problem)):
        return None
    return (
        _prove_with_eta(problem, Lambda, eta)
        if ground is None
        else _prove_grounded(problem, Lambda, eta, ground)
    )


def _prove_with_eta(problem: PGOProblem, Lambda: Array, eta: float) -> LowerBound | None:
    first = np.zeros(1, dtype=np.int64)
    proof = prove_definite(problem, Lambda, eta, first, UNGROUNDED_SHIFT)
    if proof is not None and proof.slack() is None:
        # The shift was chosen before the rounding of the factorisation was known.
        error = proof.factor_error()
        proof = prove_definite(problem, Lambda, eta, first, UNGROUNDED_SHIFT, factor_error=error)
    if proof is None:
        return None
    trace = _trace(Lambda)
    constant, constant_error = problem.weights.constant
    count = problem.num_poses * problem.d
    return bound_with_eta([trace], eta, count, constant, constant_error)


def bound_with_eta(
    traces: Sequence[float],
    eta: float,
    count: int,
    constant: float = 0.0,
    constant_error: float = 0.0,
) -> LowerBound:
    """Bound tr(Lambda) + constant - eta n d, from parts of tr(Lambda); count = n d."""
    lost = eta * count
    rounding = OUTWARD * 4.0 * UNIT_ROUNDOFF * (sum(map(abs, traces)) + lost)
    terms = [*traces, constant, -lost]
    return bound_from(terms, rounding + constant_error, eta, is_grounded=False)


def _prove_grounded(
    problem: PGOProblem,
    Lambda: Array,
    eta: float,
    ground: _Ground,
    factor_error: Array | None = None,
) -> LowerBound | None:
    proof = prove_definite(
        problem, Lambda, eta, ground.rows, turned=ground.X, factor_error=factor_error
    )
    if proof is None:
        return None
    point = move_until_settled(
        _first_point(problem, Lambda, ground.X),
        lambda point: _moved(problem, Lambda, proof, point),
    )
    slack = proof.slack()
    if slack is None:
        # The shift was chosen before the rounding of the factorisation was known. Now it is.
        return _prove_grounded(problem, Lambda, eta, ground, proof.factor_error())
    found = point.evaluation
    if found is None:
        found = evaluate_certificate(problem, Lambda, point.X, point.low)
    free = proof.free
    n = problem.num_poses
    # The bound is value - tr(G^T S_r^-1 G) - eta sum_i ||R_i^T - P_i Q||_F^2, G = S X being what
    # the moves have left (this file's opening). Both losses, and the error of the value, are
    # replaced by upper bounds: S_r is at least diag(slack).
    quadratic = quadratic_loss(found.product[free], found.product_error[free], slack[free])
    distances = squared_distances(point.X[n:], ground.X[n:])
    return grounded_bound(found.value, found.value_error, quadratic, eta, distances)


def grounded_bound(
    value: float, value_error: float, quadratic: float, eta: float, distances: float
) -> LowerBound:
    """Bound tr(X'^T S X') + tr(Lambda), the value, less what its error, G and eta can take.

    `quadratic` is that of G (`quadratic_loss`), `distances` are `squared_distances`.
    """
    lost = OUTWARD * eta * distances
    return bound_from([value, -lost], value_error + quadratic, eta, is_grounded=True)


class ProofPoint(Protocol):
    """What decides whether X' of a proof that is grounded at a pose is moved again."""

    @property
    def value(self) -> float:
        """Value of the certificate, tr(X'^T S X') + tr(Lambda)."""

    @property
    def left(self) -> float:
        """About what is lost to G = S X', as `quadratic_loss` without an error."""

    @property
    def quadratic(self) -> float:
        """The same with the error of G."""


P = TypeVar("P", bound=ProofPoint)


def move_until_settled(point: P, move: Callable[[P], tuple[P, float]]) -> P:
    """Move X' by -S_r^-1 G, again while that helps.

    `move` gives the next point, and the gain tr(G^T S_r^-1 G) that was expected of it.
    """
    gained = 0.0
    for _ in range(MOST_MOVES):
        negligible = max(SETTLED * abs(point.value), NEGLIGIBLE * gained, HIDDEN * point.quadratic)
        if point.left <= negligible:
            break
        moved, gain = move(point)
        gained += gain
        if not moved.left < point.left:
            break
        point = moved
    return point


@dataclass(frozen=True, eq=False)
class _Point:
    """X' and S X' there, to be moved; `low` is to be added to its translations."""

    X: Array
    low: Array
    product: Array
    evaluation: Evaluation | None  # of the certificate; None at the poses, where nothing is lost
    value: float = 0.0
    left: float = math.inf
    quadratic: float = 0.0
    last_gain: float = math.inf


def _first_point(problem: PGOProblem, Lambda: Array, X: Array) -> _Point:
    n = problem.num_poses
    d = problem.d
    product = problem.apply_M(X)
    product[n:] -= (Lambda @ X[n:].reshape(n, d, d)).reshape(-1, d)
    return _Point(X, np.zeros((n, d)), product, None)


def _moved(
    problem: PGOProblem, Lambda: Array, proof: DefiniteProof, point: _Point
) -> tuple[_Point, float]:
    """Point at X - S_r^-1 S X, and the gain."""
    n = problem.num_poses
    step = proof.solve(point.product)
    gain = inner(step, point.product)
    if gain > point.last_gain:  # the shift takes most of the softest energy
        step = replace(proof, is_marginal=True).solve(point.product)
        gain = inner(step, point.product)
    X = point.X.copy()
    X[n:] -= step[n:]
    low = point.low - step[:n]
    found = evaluate_certificate(problem, Lambda, X, low)
    free = proof.free
    weight = (proof.shift * proof.diagonal)[free]
    left = quadratic_loss(found.product[free], 0.0, weight)
    quadratic = quadratic_loss(found.product[free], found.product_error[free], weight)
    return _Point(X, low, found.product, found, found.value, left, quadratic, gain), gain


def bound_from(terms: list[float], rounding: float, eta: float, is_grounded: bool) -> LowerBound:
    """Bound from terms: their sum less what rounding can take, rounded down.

    It is 0, which is trivial, where that is nan or negative.
    """
    value = math.nextafter(exact_sum([*terms, -rounding]), -math.inf)
    return LowerBound(value if value > 0.0 else 0.0, eta, is_grounded, rounding)


@np.errstate(over="ignore", invalid="ignore")  # as of `_prove`
def _symmetric(problem: PGOProblem, Lambda: Array) -> Array:
    check_multipliers(problem, Lambda)
    return np.asarray(0.5 * (Lambda + np.swapaxes(Lambda, 1, 2)))


def _trace(Lambda: Array) -> float:
    return exact_sum(np.einsum("naa->na", Lambda).ravel())
