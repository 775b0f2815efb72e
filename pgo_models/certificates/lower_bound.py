"""Lower bounds on F that hold in exact arithmetic, from any multipliers: grounded at a pose, or with a shift eta.

For feasible X, tr(X^T M X) = tr(X^T S X) + tr(Lambda) with S = M - blockdiag(0, Lambda) and any symmetric Lambda_i.

**Grounded at pose r.** Take any X' with X'_r = (0, I), feasible elsewhere or not, and G = S X'. For feasible X there is
an orthogonal Q with X_r = X'_r Q once X is shifted, which S ignores. Z = X - X' Q vanishes at r, and with S_r, S
without the rows and columns of pose r, positive definite,

    tr(X^T S X) = tr(X'^T S X') + 2 tr((G Q)^T Z) + tr(Z^T S_r Z) >= tr(X'^T S X') - tr(G_r^T S_r^-1 G_r).

X' is the poses moved by -S_r^-1 G, one solve, after which G is rounding. What is then subtracted, all of it bounded:
the rounding of tr(X'^T S X') + tr(Lambda), summed edge by edge (`evaluate_certificate`), and sum (|G| + its error)^2 /
slack with S_r >= diag(slack) proved by one factorisation (`prove_definite`). X' itself spans what S cannot see, so that
without the rotation of pose r the matrix could be definite only by a shift. (Kin: Carlone, Calafiore, Tommolillo &
Dellaert 2016, on when the dual is tight.)

**chi2.** What is bounded here is a quadratic cost tr(X^T M X) + constant; that of a tangent (`PGOProblem.tangent_at`)
is at most chi2 at all poses, and so is its bound. At the minimum of chi2 both have one value and one gradient.

**With a shift.** Where S_r is not positive definite, S_r + eta blockdiag(0, I) may be; the bound then loses
eta sum_i ||X_i - X'_i Q||_F^2 <= eta sum_i (sqrt(8) + ||X'_i - R_i^T||)^2, as rotations are at most sqrt(8) apart. Or,
asking nothing of poses: if S + eta blockdiag(0, I) is positive definite without the row of one translation,
F >= tr(Lambda) - eta n d (Rosen et al. 2019, theorem 7; Carlone et al. 2015).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.certificates.definiteness import DefiniteProof, is_definite_in_doubles, prove_definite, smallest_eta
from pgo_models.certificates.dual_variables import check_multipliers
from pgo_models.certificates.rounding_errors import Evaluation, evaluate_certificate, has_safe_scale
from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, orthogonality_error
from pgo_models.graphs.pose_graph import IntArray, middle_pose
from pgo_models.problem.floating_point import OUTWARD, UNIT_ROUNDOFF
from pgo_models.problem.matrices import inner, rotation_columns
from pgo_models.problem.problem import PGOProblem

_ETA_SHARE = 0.5  # of the wanted gap is spent on eta; the rest is for poses a little off the optimum
UNGROUNDED_SHIFT = 1e-11  # of the diagonal: with eta, what is subtracted for rounding has to be made up for
MOST_MOVES = 3
SETTLED, HIDDEN = 1e-13, 0.1  # of the value, and of the loss with rounding: G adds less, moving again gains nothing
NEGLIGIBLE = 0.01  # of what moving has gained, about the gap of the poses


@dataclass(frozen=True)
class LowerBound:
    """A proven lower bound on F over all poses."""

    value: float  # never negative: F is a sum of squares
    eta: float  # shift with which it was proved; nan when nothing better than F >= 0 was
    is_grounded: bool  # whether the proof leaves out one whole pose; else it is one with eta alone
    rounding: float  # sum of all that was subtracted because of rounding
    cap: float = math.inf  # condition that the information matrices were cut down to (`certificates.tangent`)
    is_definite: bool = False  # whether S_r is in doubles, where it could not be proved: no other poses would help


NO_BOUND = LowerBound(0.0, math.nan, False, 0.0)


def prove_bound(problem: PGOProblem, Lambda: Array, eta: float = 0.0, poses: Poses | None = None) -> float | None:
    """Bound on F over all poses from multipliers Lambda, shift eta and, if given, poses to ground it at.

    It holds in exact arithmetic for the graph whose measurements and weights are the stored numbers: rounding of the
    entries, of the factorisation and of the sums is bounded and subtracted (this file's opening,
    `pgo_models.certificates.rounding_errors`, `pgo_models.problem.cholesky`). Lambda is made symmetric first.

    Lambda, (n, d, d), may come from anywhere; at a certified optimum those of `multipliers` give a bound equal to F but
    for rounding. The proof is grounded at a pose in the middle of the graph; without poses eta has to make S definite.
    None when the matrix cannot be shown to be positive definite, as without poses at eta = 0 or any eta that rounding
    swallows. A SettingError when eta is negative or not finite, or Lambda has the wrong shape.

    Examples
    --------
    >>> from pgo_models import chordal_start, grid, multipliers, polish
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
    found = _prove(problem, _symmetric(problem, Lambda), eta, point)
    return found.value if found is not None else None


def prove_at(problem: PGOProblem, Lambda: Array, poses: Poses) -> LowerBound | None:
    """Bound grounded at poses without a shift, or None."""
    return _prove(problem, _symmetric(problem, Lambda), 0.0, _grounded_at(problem, poses))


def best_bound(problem: PGOProblem, Lambda: Array, poses: Poses | None, gap: float, objective: float) -> LowerBound:
    """Grounded without eta where that goes through; else the better of both forms with the smallest eta found.

    It is grounded at one of the poses, which have their best translations; None leaves the form that asks nothing of
    poses. The smallest eta that is tried follows from gap and objective.
    """
    Lambda = _symmetric(problem, Lambda)
    point = _grounded_at(problem, poses) if poses is not None else None
    found = _prove(problem, Lambda, 0.0, point) if point is not None else None
    if found is not None and found.value > 0.0:
        return found
    count, most = problem.num_poses * problem.d, _trace(Lambda)
    smallest = smallest_shift(gap, objective, count)
    bounds = [search_bound(lambda eta: _prove(problem, Lambda, eta, None), smallest, most, count)]
    if point is not None:
        bounds.append(search_bound(lambda eta: _prove(problem, Lambda, eta, point), smallest, most, count))
    is_definite = point is not None and is_definite_in_doubles(problem, Lambda, point.rows)
    return replace(max([NO_BOUND, *bounds], key=lambda bound: bound.value), is_definite=is_definite)


def search_bound(prove: Callable[[float], LowerBound | None], smallest: float, trace: float, count: int) -> LowerBound:
    """Bound that `prove` gives with the smallest eta found; `NO_BOUND` when tr(Lambda) - eta n d would not be above 0.

    The search begins with the eta `smallest` (`smallest_eta`); trace and count are tr(Lambda) and n d.
    """
    first = max(smallest, UNIT_ROUNDOFF * trace / count)  # at F = 0 the smallest would never grow
    found = smallest_eta(prove, first, below=trace / count)
    return found[1] if found is not None and found[1].value > 0.0 else NO_BOUND


def smallest_shift(gap: float, objective: float, count: int) -> float:
    """Shift eta that spends a fixed share of a relative gap, count = n d."""
    return _ETA_SHARE * gap * objective / count


def quadratic_loss(product: Array, error: Array | float, slack: Array) -> float:
    """Bound on tr(G^T S_r^-1 G), sum (|G| + error)^2 / slack, for S_r >= diag(slack) and G known to an error."""
    return OUTWARD * float(np.sum((np.abs(product) + error) ** 2 / slack[:, None]))


def squared_distances(moved: Array, rotations: Array) -> float:
    """Bound on sum_i ||R_i^T - P_i Q||_F^2 over all rotations R_i, Q, for blocks P_i moved away from rotations P^_i.

    Two rotations are at most sqrt(8) apart, P_i is ||P_i - P^_i|| from P^_i, and that ||P^_i P^_i^T - I|| from one.
    Rounding of these, a few u beside sqrt(8), is what `OUTWARD` is for. Rows of P_i and of P^_i, (d n, d), are given.
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
    n, d = problem.num_poses, problem.d
    r, X = middle_pose(problem.graph), problem.stacked(poses)
    X[:n] -= poses.t[r]
    X = X @ poses.R[r]
    rows = pose_rows(r, n, d)
    X[rows] = np.concatenate([np.zeros((1, d)), np.eye(d)])
    return _Ground(X, rows)


def pose_rows(pose: int, n: int, d: int) -> IntArray:
    """Rows of one pose in X, (d + 1,)."""
    return np.concatenate([[pose], rotation_columns(np.array([pose]), n, d)[0]])


def _prove(problem: PGOProblem, Lambda: Array, eta: float, ground: _Ground | None) -> LowerBound | None:
    if not 0.0 <= eta < math.inf:
        raise SettingError(f"eta is {eta}; a shift must not be negative, and finite")
    if not (np.isfinite(Lambda).all() and has_safe_scale(problem)):
        return None
    return _prove_with_eta(problem, Lambda, eta) if ground is None else _prove_grounded(problem, Lambda, eta, ground)


def _prove_with_eta(problem: PGOProblem, Lambda: Array, eta: float) -> LowerBound | None:
    first = np.zeros(1, dtype=np.int64)
    proof = prove_definite(problem, Lambda, eta, first, UNGROUNDED_SHIFT)
    if proof is not None and proof.slack() is None:
        proof = prove_definite(problem, Lambda, eta, first, UNGROUNDED_SHIFT)
    if proof is None:
        return None
    trace, lost = _trace(Lambda), eta * problem.num_poses * problem.d
    rounding = OUTWARD * 4.0 * UNIT_ROUNDOFF * (abs(trace) + lost)
    constant, constant_error = problem.weights.constant
    return bound_from([trace, constant, -lost], rounding + constant_error, eta, is_grounded=False)


def _prove_grounded(problem: PGOProblem, Lambda: Array, eta: float, ground: _Ground) -> LowerBound | None:
    proof = prove_definite(problem, Lambda, eta, ground.rows, turned=ground.X)
    if proof is None:
        return None
    X, found = _move(problem, Lambda, ground.X, proof)
    slack = proof.slack()
    if slack is None:  # now the rounding of the factorisation is known
        return _prove_grounded(problem, Lambda, eta, ground)
    free, n = proof.free, problem.num_poses
    lost = OUTWARD * eta * squared_distances(X[n:], ground.X[n:])
    rounding = found.value_error + quadratic_loss(found.product[free], found.product_error[free], slack[free])
    return bound_from([found.value, -lost], rounding, eta, is_grounded=True)


def _move(problem: PGOProblem, Lambda: Array, X: Array, proof: DefiniteProof) -> tuple[Array, Evaluation]:
    """X - S_r^-1 S X, again while that helps, and the certificate there."""
    n, d, free = problem.num_poses, problem.d, proof.free
    weight = (proof.shift * proof.diagonal)[free]
    low, left, gained, last, found = np.zeros((n, d)), math.inf, 0.0, math.inf, None
    product = problem.apply_M(X)
    product[n:] -= (Lambda @ X[n:].reshape(n, d, d)).reshape(-1, d)
    for _ in range(MOST_MOVES):
        step = proof.solve(product)
        gain = inner(step, product)
        if gain > last:  # the shift takes most of the softest energy
            step = replace(proof, is_marginal=True).solve(product)
            gain = inner(step, product)
        last, gained = gain, gained + gain
        there = X.copy(), low - step[:n]
        there[0][n:] -= step[n:]
        moved = evaluate_certificate(problem, Lambda, *there)
        after = quadratic_loss(moved.product[free], 0.0, weight)
        if not after < left:
            break
        (X, low), found, product, left = there, moved, moved.product, after
        hidden = HIDDEN * quadratic_loss(product[free], found.product_error[free], weight)
        if left <= max(SETTLED * abs(found.value), NEGLIGIBLE * gained, hidden):
            break
    return X, found if found is not None else evaluate_certificate(problem, Lambda, X, low)


def bound_from(terms: list[float], rounding: float, eta: float, is_grounded: bool) -> LowerBound:
    """Sum of terms less what rounding can take, rounded down."""
    value = math.nextafter(math.fsum([*terms, -rounding]), -math.inf)
    return LowerBound(max(0.0, value), eta, is_grounded, rounding)


def _symmetric(problem: PGOProblem, Lambda: Array) -> Array:
    check_multipliers(problem, Lambda)
    return np.asarray(0.5 * (Lambda + np.swapaxes(Lambda, 1, 2)))


def _trace(Lambda: Array) -> float:
    return math.fsum(np.einsum("naa->na", Lambda).ravel())
