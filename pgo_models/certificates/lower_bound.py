"""Lower bounds on F that hold in exact arithmetic, from any multipliers Lambda.

**Notation.** A graph has n poses in dimension d. X, (N, d) with N = (d + 1) n, stacks the rows
t_i^T of all poses and then the blocks R_i^T. It is feasible if every R_i is a rotation. What is
bounded is a quadratic cost F(X) = tr(X^T M X) + constant; the constant is zero but for a tangent of
chi2 (below). A common shift of all translations changes neither M X nor F. Lambda consists of
symmetric blocks Lambda_i, (d, d), and S = M - blockdiag(0, Lambda). As R_i R_i^T = I, every
feasible X has

    F(X) = tr(X^T S X) + tr(Lambda) + constant.

**Grounded at pose r.** Let X' be any matrix whose rows of pose r are (0, I), feasible elsewhere or
not, and G = S X'. An index r on S, G and Z means that pose r is left out: S_r is S without the rows
and columns of pose r, G_r is G without its rows. Shift a feasible X so that its pose r is at the
origin; that leaves S X and F as they are. With the rotation V = R_r^T, X and X' V have the same
rows of pose r, so that Z = X - X' V vanishes there. As V V^T = I,

    tr(X^T S X) = tr(X'^T S X') + 2 tr((G_r V)^T Z_r) + tr(Z_r^T S_r Z_r).

If S_r is positive definite, the right side is least at Z_r = -S_r^-1 G_r V, and V cancels there:

    tr(X^T S X) >= tr(X'^T S X') - tr(G_r^T S_r^-1 G_r).

X' begins at given poses, turned and shifted so that pose r is at (0, I). The rows of the other
poses are moved by -S_r^-1 G_r, at most MOST_MOVES times (`move_until_settled`); after that G_r is
little more than rounding. Then the bound is the computed tr(X'^T S X') + tr(Lambda) + constant less
two upper bounds: one on its rounding error, for it is summed edge by edge (`evaluate_certificate`);
and tr(G_r^T S_r^-1 G_r) <= sum (|G_r| + error of G_r)^2 / slack, where one factorisation proves
that S_r - diag(slack) is positive semidefinite (`prove_definite`).

At an optimum S X' = 0. If only the translation of pose r were left out, S would keep this null
space and need a shift to be positive definite; so the rotation of pose r is left out, too. (Compare
Carlone, Calafiore, Tommolillo & Dellaert 2016, on when the dual is tight.)

**chi2** is not quadratic. What is bounded in its place is its tangent (`PGOProblem.tangent_at`), a
quadratic cost that is at most chi2 at all poses and touches it at given ones, with equal value and
equal gradient there. So a bound on the tangent is one on chi2, and where chi2 has its minimum the
tangent made there is stationary, too.

**With a shift eta.** Where S_r is not positive definite, H = S_r + eta blockdiag(0, I) may be. With
H in place of S_r the bound also loses eta times the squared norm of the rotation blocks of Z,

    sum_i ||R_i^T - P_i V||_F^2 <= sum_i (sqrt(8) + ||P_i - P^_i||_F)^2,

where P_i is the rotation block of X' for pose i, and P^_i the rotation at which it began: the
rotations R_i^T and P^_i V are at most sqrt(8) apart, in the plane and in space. Another form asks
nothing of poses: if S + eta blockdiag(0, I) is positive definite without the row and column of one
translation, F >= tr(Lambda) + constant - eta n d (weak duality: Rosen et al. 2019; Carlone et al.
2015).

**In the plane** Z is known better: its blocks have the form (a, b; -b, a) of sums and products of
rotations, if those of X' have it. So S_r has to be positive on such Z alone, as a Hermitian matrix
of the complex numbers a + b i (`pgo_models.certificates.unknowns`). All else in this proof stays as
it is.

**Rotations alone.** A problem without translations (`PGOProblem.has_translations`) is bounded in
the same way. Its X has zeros in the rows t_i^T, X' as well, and M = blockdiag(M_tt, L), where M_tt
is padding. So Z vanishes in these rows, too, and they are left out as the rows of pose r are: S_r
is what is left of L - Lambda. In the form with eta alone they are left out in place of one
translation.

The word shift is for eta alone. The share of the diagonal that a proof of definiteness subtracts to
make up for rounding is its margin (`pgo_models.certificates.definiteness`).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np

from pgo_models.certificates.axes import AxisTerms, AxisUnknowns, axis_terms, balanced
from pgo_models.certificates.definiteness import (
    ETA_GROWTH,
    DefiniteProof,
    etas_of_rotations,
    is_over,
    prove_definite,
    smallest_eta,
)
from pgo_models.certificates.dual_variables import check_multipliers, scalar_multipliers
from pgo_models.certificates.handedness import HandednessTerms
from pgo_models.certificates.rounding_errors import Evaluation, evaluate_certificate, has_safe_scale
from pgo_models.certificates.unknowns import ComplexUnknowns, RowUnknowns, Unknowns
from pgo_models.errors import SettingError
from pgo_models.geometry.arrays import block_norms
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, MaybeNone, orthogonality_error
from pgo_models.graphs.pose_graph import IntArray, middle_pose
from pgo_models.problem.floating_point import OUTWARD, UNIT_ROUNDOFF, exact_sum
from pgo_models.problem.matrices import inner, rotation_columns
from pgo_models.problem.problem import PGOProblem
from pgo_models.summaries import Summarised

# Share of the wanted gap that eta may cost; the rest is for poses a little off the optimum.
_ETA_SHARE = 0.5
_SHIFTS_OF_AXES = 4  # the last one loses 500 times the gap
# First margin of the form with eta alone, as a share of the diagonal.
UNGROUNDED_MARGIN = 1e-11
MOST_MOVES = 3  # of X', each of which solves with the factor of the proof once
# Stop moving X' once the remaining loss to G_r is below this share of the value of the bound ..
SETTLED = 1e-13
# .. or below this share of the loss that is counted with the rounding of G_r: moving again would
# leave nearly the same loss ..
HIDDEN = 0.1
# .. or below this share of what the moves have gained so far.
NEGLIGIBLE = 0.01


@dataclass(frozen=True)
class LowerBound(Summarised):
    """A proven lower bound on F over all poses.

    Parameters
    ----------
    value : float
        The bound. It is never negative: F is a sum of squares.
    eta : float
        Shift of the rows of rotations with which it was proved; nan when nothing better than F >= 0
        was proved.
    is_grounded : bool
        Whether the proof leaves out one whole pose; otherwise it is the form with eta alone.
    rounding : float
        Sum of what was subtracted for rounding and, when grounded, for the G_r that remains after
        the last move; not the loss to eta.
    cap : float
        Condition that the information matrices were cut down to (`shrunk_information`).
    is_definite : bool
        Whether S_r has a Cholesky factor in doubles although no bound above zero was proved with
        eta = 0. Rounding is then taken to be what is in the way, and no other poses are looked for
        (`Certificate.can_improve`). It is False where such a bound was proved, too: the question is
        asked only where the proof fails.
    terms : HandednessTerms or None
        What was taken off the cost before the proof, if anything.
    is_complex : bool
        Whether the proof takes rotations of the plane as complex numbers
        (`pgo_models.certificates.unknowns`).
    axes : AxisTerms or None
        What a proof with a matrix for every axis of the world has beside Lambda.
    """

    value: float
    eta: float
    is_grounded: bool
    rounding: float
    cap: float = math.inf
    is_definite: bool = False
    terms: HandednessTerms | MaybeNone = None
    is_complex: bool = False
    axes: AxisTerms | MaybeNone = None


NO_BOUND = LowerBound(0.0, math.nan, False, 0.0)


def prove_bound(
    problem: PGOProblem,
    Lambda: Array,
    eta: float = 0.0,
    poses: Poses | None = None,
    is_complex: bool = False,
) -> float | None:
    """Prove a bound on F over all poses from multipliers, a shift eta and, if given, poses.

    It holds in exact arithmetic for the graph whose measurements and weights are the stored
    numbers: F is the sum with `problem.graph.R_ij` as written, rotations but for 64 eps, not with
    the rotations nearest to them. Rounding of the entries, of the factorisation and of the sums is
    bounded and subtracted (this file's opening, `pgo_models.certificates.rounding_errors`,
    `pgo_models.problem.cholesky`). Lambda is made symmetric first. The proof is grounded at the
    poses with their best translations; of chi2 the tangent there is bounded.

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
    is_complex : bool
        Whether rotations are taken as complex numbers, which needs poses in the plane. Then only
        the traces of Lambda count.

    Returns
    -------
    float or None
        The bound. None when the matrix cannot be shown to be positive definite, as without poses at
        eta = 0 or any eta that rounding swallows.

    Raises
    ------
    SettingError
        When eta is negative or not finite, or Lambda has the wrong shape; and for complex numbers
        without poses, in space, or of rotations alone, which they give nothing.

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
    if is_complex and (poses is None or not has_complex_form(problem)):
        raise SettingError(
            "is_complex=True needs poses in the plane, with translations among the unknowns"
        )
    Lambda = _symmetric(problem, Lambda)
    ground = None
    if poses is not None:
        poses = problem.at_best_translations(poses)
        problem = problem.tangent_at(poses)
        ground = _grounded_at(problem, poses, is_complex)
    if is_complex:
        Lambda = scalar_multipliers(Lambda)
    proven = _prove(problem, Lambda, eta, ground)
    return proven.value if proven is not None else None


def has_complex_form(problem: PGOProblem) -> bool:
    """Whether proofs can gain by complex numbers: in the plane, unless of rotations alone."""
    return problem.d == 2 and problem.has_translations


def prove_at(
    problem: PGOProblem,
    Lambda: Array,
    poses: Poses,
    is_complex: bool = False,
    eta: float = 0.0,
) -> LowerBound | None:
    """Bound grounded at the poses as they are; None where S_r is not proved definite with eta.

    The problem has to be quadratic: for chi2 the caller passes a tangent (`PGOProblem.tangent_at`),
    whose bound is one on chi2. In complex numbers only the traces of Lambda count. With an eta
    above zero it is the better of both forms.
    """
    Lambda = _symmetric(problem, Lambda)
    if is_complex:
        Lambda = scalar_multipliers(Lambda)
    grounded = _prove(problem, Lambda, eta, _grounded_at(problem, poses, is_complex))
    if is_complex or not eta > 0.0:
        return grounded
    bounds = [grounded, _prove(problem, Lambda, eta, None)]
    proven = [bound for bound in bounds if bound is not None]
    return max(proven, key=lambda bound: bound.value, default=None)


def prove_by_axes(
    problem: PGOProblem, Lambda: Array, poses: Poses, gap: float, objective: float
) -> tuple[LowerBound, Array] | None:
    """Bound with a matrix for every axis of the world, and its multipliers Lambda.

    The problem is a tangent (`PGOProblem.tangent_at`), Lambda are its multipliers at the poses,
    which change with gamma (`pgo_models.certificates.axes`). None where no position is measured
    axis by axis, or the proof fails. Where a weak axis needs a shift of its gamma it is the
    smallest that succeeds: the first loses half of the gap, and each further one ten times as much.
    """
    terms = axis_terms(problem)
    if terms is None:
        return None
    X, unknowns = _grounded_at_world(problem, poses, terms)
    in_balance = balanced(unknowns, _symmetric(problem, Lambda), X)
    if in_balance is None:
        return None
    terms, Lambda, weak = in_balance
    shifts = [0.0]
    num_weak = int(weak.sum())  # what a shift of one loses
    if num_weak:
        first = smallest_shift(gap, objective, num_weak)
        shifts += [first * ETA_GROWTH**k for k in range(_SHIFTS_OF_AXES)]
    for shift in shifts:
        shifted = replace(terms, gamma=terms.gamma - shift * weak)
        bound = prove_from_axis_terms(problem, Lambda, poses, shifted)
        if bound is not None:
            return bound, Lambda
    return None


def prove_from_axis_terms(
    problem: PGOProblem, Lambda: Array, poses: Poses, axes: AxisTerms
) -> LowerBound | None:
    """Bound grounded at the world pose with given terms by axis; None where it is not proved."""
    X, unknowns = _grounded_at_world(problem, poses, axes)
    bound = _prove(problem, _symmetric(problem, Lambda), 0.0, _Ground(X, unknowns))
    return None if bound is None else replace(bound, axes=axes)


def _grounded_at_world(
    problem: PGOProblem, poses: Poses, axes: AxisTerms
) -> tuple[Array, AxisUnknowns]:
    """X' of poses moved so that the world pose is at (0, I), and the unknowns of a proof there."""
    world = problem.graph.world
    assert world is not None  # axes have edges that begin there
    rows = pose_rows(world, problem.num_poses, problem.d)
    return _moved_to(problem, poses, world), AxisUnknowns(problem, rows, axes)


def best_bound(
    problem: PGOProblem,
    Lambda: Array,
    poses: Poses | None,
    gap: float,
    objective: float,
    is_complex: bool = False,
    deadline: float = math.inf,
) -> LowerBound:
    """Best bound from multipliers: the one grounded at a pose with eta = 0 if it is above zero.

    Otherwise it is the better of both forms, each with the smallest eta found. Without poses only
    the form with eta alone is tried, in complex numbers only the grounded one. The smallest eta
    that is tried follows from gap and objective. After the `deadline` the search ends early
    (`search_forms`).

    The problem has to be quadratic: for chi2 the caller passes the tangent at the poses. The poses
    are taken as they are; the bound is sharpest if the caller has given them their best
    translations. In complex numbers only the traces of Lambda count.
    """
    Lambda = _symmetric(problem, Lambda)
    if is_complex:
        Lambda = scalar_multipliers(Lambda)
    count = problem.num_poses * problem.d
    smallest = smallest_shift(gap, objective, count)
    trace = _trace(Lambda)

    def prove_with_eta(eta: float) -> LowerBound | None:
        return _prove(problem, Lambda, eta, None)

    if poses is None:
        return search_forms([prove_with_eta], smallest, trace, count, deadline)
    ground = _grounded_at(problem, poses, is_complex)

    def prove_grounded(eta: float) -> LowerBound | None:
        return _prove(problem, Lambda, eta, ground)

    without_shift = prove_grounded(0.0)
    if without_shift is not None and without_shift.value > 0.0:
        return without_shift
    forms = [prove_grounded] if is_complex else [prove_with_eta, prove_grounded]
    best = search_forms(forms, smallest, trace, count, deadline)
    if is_over(deadline):
        return best
    is_definite = ground.unknowns.is_definite_in_doubles(Lambda)
    return replace(best, is_definite=is_definite)


def best_bound_with_terms(
    problem: PGOProblem,
    Lambda: Array,
    poses: Poses | None,
    gap: float,
    objective: float,
    terms: HandednessTerms,
) -> LowerBound:
    """`best_bound` of the cost less handedness terms, which is one on the cost.

    What rounding can make of the terms (`HandednessTerms.loss`) is subtracted.
    """
    bound_of_rest = best_bound(terms.taken_off(problem), Lambda, poses, gap, objective)
    return less_terms(bound_of_rest, terms)


def less_terms(bound: LowerBound, terms: HandednessTerms) -> LowerBound:
    """The bound on a cost, of one on the cost less handedness terms."""
    lost = terms.loss()
    value = math.nextafter(bound.value - lost, -math.inf)
    if not value > 0.0:
        return NO_BOUND
    return replace(bound, value=value, rounding=bound.rounding + lost, terms=terms)


def search_forms(
    forms: Sequence[Callable[[float], LowerBound | None]],
    smallest: float,
    trace: float,
    count: int,
    deadline: float = math.inf,
) -> LowerBound:
    """Return the best bound of the given forms, each with the smallest eta found.

    A form takes an eta to a bound, or to None where the matrix cannot be shown to be positive
    definite with it. The search begins with the eta `smallest`; trace and count are tr(Lambda) and
    n d. `NO_BOUND` where no form gives a bound above zero, as where tr(Lambda) - eta n d is not.

    After the `deadline`, by `time.perf_counter`, the form under way takes the first eta that proves
    something, half of one that leaves no bound, and no other form is tried.
    """
    best = NO_BOUND
    for prove in forms:
        bound = _search_bound(prove, smallest, trace, count, deadline)
        best = max(best, bound, key=lambda known: known.value)
        if is_over(deadline):
            break
    return best


def _search_bound(
    prove: Callable[[float], LowerBound | None],
    smallest: float,
    trace: float,
    count: int,
    deadline: float,
) -> LowerBound:
    """Bound of one form of `search_forms`.

    Where the first eta fails, one proof with the eta that leaves no bound says whether any eta
    between is worth a proof. Far from an optimum none is.
    """
    # At F = 0 the smallest eta is zero and would never grow.
    least_eta = UNIT_ROUNDOFF * trace / count
    first = max(smallest, least_eta)
    useless_eta = trace / count
    if not first < useless_eta:
        return NO_BOUND
    second = first
    if not is_over(deadline):
        bound = prove(first)
        if bound is not None:
            return bound if bound.value > 0.0 else NO_BOUND
        if not is_over(deadline) and prove(useless_eta) is None:
            return NO_BOUND
        second = ETA_GROWTH * first
    eta_and_bound = smallest_eta(prove, second, useless_eta, first, deadline)
    if eta_and_bound is None:
        return NO_BOUND
    _, bound = eta_and_bound
    return bound if bound.value > 0.0 else NO_BOUND


def smallest_shift(gap: float, objective: float, count: int) -> float:
    """Shift eta that spends a fixed share of a relative gap, count = n d."""
    return _ETA_SHARE * gap * objective / count


def quadratic_loss(product: Array, error: Array | float, slack: Array) -> float:
    """Bound on tr(G_r^T S_r^-1 G_r), rounded up, for G_r known to an error.

    It is sum (|G_r| + error)^2 / slack, where S_r - diag(slack) is positive semidefinite.
    """
    size = np.abs(product) + error
    terms = size**2 / slack[:, None]
    return OUTWARD * float(np.sum(terms))


def squared_distances(moved: Array, rotations: Array) -> float:
    """Bound on sum_i ||R_i^T - P_i V||_F^2 over all rotations R_i and V, rounded up.

    The blocks P_i were moved away from stored rotations P^_i; rows of both, (d n, d), are given.

    By the triangle inequality the norm is at most a sum of three distances. Two rotations are at
    most sqrt(8) apart. A stored P^_i is at most ||P^_i P^_i^T - I|| from the nearest rotation, and
    P_i is ||P_i - P^_i|| from P^_i. The rounding of these, a few u beside sqrt(8), is covered by
    `OUTWARD`.
    """
    d = rotations.shape[1]
    blocks = rotations.reshape(-1, d, d)
    moves = (moved - rotations).reshape(-1, d * d)
    away = block_norms(moves)
    apart = math.sqrt(8.0) + orthogonality_error(blocks) + away
    return OUTWARD * float(np.sum(apart**2))


@dataclass(frozen=True, eq=False)
class _Ground:
    """X' at which a proof begins, with pose r at (0, I) exactly, and its unknowns."""

    X: Array
    unknowns: Unknowns

    @property
    def rows(self) -> IntArray:
        """The rows that are left out."""
        return self.unknowns.rows


def _grounded_at(problem: PGOProblem, poses: Poses, is_complex: bool = False) -> _Ground:
    """X' of poses moved so that a pose in the middle of the graph is at (0, I)."""
    n = problem.num_poses
    r = middle_pose(problem.graph)
    X = _moved_to(problem, poses, r)
    rows = pose_rows(r, n, problem.d)
    if not problem.has_translations:
        rows = np.union1d(np.arange(n), rows)
    unknowns = ComplexUnknowns(problem, rows) if is_complex else RowUnknowns(problem, rows)
    return _Ground(unknowns.starting_point(X), unknowns)


def _moved_to(problem: PGOProblem, poses: Poses, r: int) -> Array:
    """X of poses that are turned and shifted so that pose r is at (0, I)."""
    n = problem.num_poses
    d = problem.d
    X = problem.at(poses).X.copy()
    X[:n] -= X[r]
    X = np.asarray(X @ poses.R[r])
    X[pose_rows(r, n, d)] = np.concatenate([np.zeros((1, d)), np.eye(d)])
    return X


def pose_rows(pose: int, n: int, d: int) -> IntArray:
    """Rows of one pose in X, (d + 1,)."""
    rotation_rows = rotation_columns(np.array([pose]), n, d)[0]
    return np.concatenate([[pose], rotation_rows])


@np.errstate(over="ignore", invalid="ignore")  # what overflows is inf or nan, which proves nothing
def _prove(
    problem: PGOProblem, Lambda: Array, eta: float, ground: _Ground | None
) -> LowerBound | None:
    """Bound of the form grounded at a pose, or without one of the form with eta alone."""
    if not 0.0 <= eta < math.inf:
        raise SettingError(f"eta is {eta}; a shift must not be negative, and finite")
    if not (np.isfinite(Lambda).all() and has_safe_scale(problem)):
        return None
    if ground is None:
        return _prove_with_eta(problem, Lambda, eta)
    return _prove_grounded(Lambda, eta, ground)


def _prove_with_eta(problem: PGOProblem, Lambda: Array, eta: float) -> LowerBound | None:
    """Form with eta alone, the first translation left out; None where definiteness is not shown."""
    fixed = np.arange(1 if problem.has_translations else problem.num_poses)
    if prove_definite(problem, Lambda, eta, fixed, UNGROUNDED_MARGIN) is None:
        return None
    trace = _trace(Lambda)
    constant, constant_error = problem.weights.constant
    count = (problem.num_poses - len(problem.graph.landmarks)) * problem.d
    return bound_with_eta([trace], eta, count, constant, constant_error)


def bound_with_eta(
    traces: Sequence[float],
    eta: float,
    count: int,
    constant: float = 0.0,
    constant_error: float = 0.0,
) -> LowerBound:
    """Bound tr(Lambda) + constant - eta n d, from parts of tr(Lambda); count = n d.

    Here n counts rotations that eta is added to (`etas_of_rotations`).
    """
    lost = eta * count
    sizes = sum(map(abs, traces)) + lost
    rounding = OUTWARD * 4.0 * UNIT_ROUNDOFF * sizes
    terms = [*traces, constant, -lost]
    return bound_from(terms, rounding + constant_error, eta, is_grounded=False)


def _prove_grounded(Lambda: Array, eta: float, ground: _Ground) -> LowerBound | None:
    """Form grounded at a pose; None where S_r + eta blockdiag(0, I) is not shown to be definite.

    It is the best one of all X' to begin at: the proof of definiteness is the same.
    """
    unknowns = ground.unknowns
    proof = unknowns.prove_definite(Lambda, eta, ground.X)
    if proof is None:
        return None
    starts = [ground.X, *unknowns.other_starts(ground.X)]
    bounds = [_bound_from(start, Lambda, eta, ground, proof) for start in starts]
    return max(bounds, key=lambda bound: bound.value)


def _bound_from(
    X: Array, Lambda: Array, eta: float, ground: _Ground, proof: DefiniteProof
) -> LowerBound:
    """Bound of a proof grounded at a pose, from X' on."""
    unknowns = ground.unknowns
    problem = unknowns.problem

    def move(point: _Point) -> tuple[_Point, float]:
        return _moved(unknowns, Lambda, proof, point)

    point = move_until_settled(_first_point(unknowns, Lambda, X), move)
    evaluation = point.evaluation
    if evaluation is None:
        evaluation = _evaluate(unknowns, Lambda, point.X, point.low)
    free = proof.free
    product, product_error = unknowns.gradient(evaluation.product, evaluation.product_error)
    # The bound is value - tr(G_r^T H^-1 G_r) - eta sum_i ||R_i^T - P_i V||_F^2 with G = S X' after
    # the last move (this file's opening). Both losses, and the error of the value, are replaced by
    # upper bounds: H - diag(slack) is positive semidefinite.
    quadratic = quadratic_loss(product[free], product_error[free], proof.slack[free])
    n = problem.num_poses
    has_eta = np.repeat(etas_of_rotations(problem, eta) > 0.0, problem.d)
    distances = squared_distances(point.X[n:][has_eta], ground.X[n:][has_eta])
    bound = grounded_bound(evaluation.value, evaluation.value_error, quadratic, eta, distances)
    return replace(bound, is_complex=unknowns.is_complex)


def grounded_bound(
    value: float, value_error: float, quadratic: float, eta: float, distances: float
) -> LowerBound:
    """Bound value - eta distances, less the error of the value and the loss to G_r.

    The value is tr(X'^T S X') + tr(Lambda) + constant, as `evaluate_certificate` computes it: the
    constant of a tangent is in the costs of the edges, and nothing is added here. `quadratic` is
    the loss to G_r (`quadratic_loss`), `distances` are `squared_distances`.
    """
    lost = OUTWARD * eta * distances
    return bound_from([value, -lost], value_error + quadratic, eta, is_grounded=True)


class ProofPoint(Protocol):
    """What decides whether X' of a proof that is grounded at a pose is moved again."""

    @property
    def value(self) -> float:
        """Value of the certificate, tr(X'^T S X') + tr(Lambda) + constant."""

    @property
    def estimated_loss(self) -> float:
        """Estimate of the loss tr(G_r^T S_r^-1 G_r): `quadratic_loss` without an error of G_r."""

    @property
    def quadratic(self) -> float:
        """Bound on the loss tr(G_r^T S_r^-1 G_r), with the error of G_r."""


P = TypeVar("P", bound=ProofPoint)


def move_until_settled(point: P, move: Callable[[P], tuple[P, float]]) -> P:
    """Move X' by -S_r^-1 G_r, again while that lowers the loss to G_r.

    `move` gives the next point, and the gain tr(G_r^T S_r^-1 G_r) that was expected of it.
    """
    gained = 0.0
    for _ in range(MOST_MOVES):
        of_value = SETTLED * abs(point.value)
        of_gains = NEGLIGIBLE * gained
        of_rounding = HIDDEN * point.quadratic
        if point.estimated_loss <= max(of_value, of_gains, of_rounding):
            break
        moved, gain = move(point)
        gained += gain
        if not moved.estimated_loss < point.estimated_loss:
            break
        point = moved
    return point


@dataclass(frozen=True, eq=False)
class _Point:
    """X' and S X' there, to be moved (`ProofPoint`).

    X' has the translations X[:n] + low. A move adds to `low` alone, so that one that is small
    beside the coordinates is not rounded away.
    """

    X: Array
    low: Array
    product: Array
    # Of the certificate. None at the first point, whose losses are not known: `estimated_loss` is
    # infinite there, so that the first point is moved in any case.
    evaluation: Evaluation | None
    value: float = 0.0
    estimated_loss: float = math.inf
    quadratic: float = 0.0


def _first_point(unknowns: Unknowns, Lambda: Array, X: Array) -> _Point:
    """The point before any move; its S X' is computed without a bound on its error."""
    problem = unknowns.problem
    n = problem.num_poses
    d = problem.d
    product = problem.at_point(X).half_gradient.copy()
    of_multipliers = Lambda @ X[n:].reshape(n, d, d)
    product[n:] -= of_multipliers.reshape(-1, d)
    no_move = np.zeros((n, d))
    added = unknowns.added(X, no_move)
    if added is not None:
        product += added.product
    return _Point(X, no_move, product, None)


def _evaluate(unknowns: Unknowns, Lambda: Array, X: Array, low: Array) -> Evaluation:
    """`evaluate_certificate`, with what the unknowns have beside it."""
    evaluation = evaluate_certificate(unknowns.problem, Lambda, X, low)
    added = unknowns.added(X, low)
    return evaluation if added is None else evaluation.plus(added)


def _moved(
    unknowns: Unknowns, Lambda: Array, proof: DefiniteProof, point: _Point
) -> tuple[_Point, float]:
    """Point at X' - H^-1 S X', where H = S_r + eta blockdiag(0, I), and the gain."""
    problem = unknowns.problem
    n = problem.num_poses
    gradient, _ = unknowns.gradient(point.product, np.zeros_like(point.product))
    step = proof.solve(gradient)
    gain = inner(step, gradient)
    Z = unknowns.rows_of(step)
    X = point.X.copy()
    X[n:] -= Z[n:]
    low = point.low - Z[:n]
    evaluation = _evaluate(unknowns, Lambda, X, low)
    free = proof.free
    product, product_error = unknowns.gradient(evaluation.product, evaluation.product_error)
    slack = proof.slack[free]
    estimated_loss = quadratic_loss(product[free], 0.0, slack)
    quadratic = quadratic_loss(product[free], product_error[free], slack)
    moved = _Point(
        X=X,
        low=low,
        product=evaluation.product,
        evaluation=evaluation,
        value=evaluation.value,
        estimated_loss=estimated_loss,
        quadratic=quadratic,
    )
    return moved, gain


def bound_from(terms: list[float], rounding: float, eta: float, is_grounded: bool) -> LowerBound:
    """Bound from terms: their sum less what rounding can take, rounded down.

    A sum that is nan or negative gives the trivial bound 0.
    """
    total = exact_sum([*terms, -rounding])
    value = math.nextafter(total, -math.inf)
    if not value > 0.0:
        value = 0.0
    return LowerBound(value, eta, is_grounded, rounding)


@np.errstate(over="ignore", invalid="ignore")  # as of `_prove`
def _symmetric(problem: PGOProblem, Lambda: Array) -> Array:
    """Symmetric part of each block, (n, d, d)."""
    check_multipliers(problem, Lambda)
    transposed = np.swapaxes(Lambda, 1, 2)
    return np.asarray(0.5 * (Lambda + transposed))


def _trace(Lambda: Array) -> float:
    """Trace of all blocks together, rounded once."""
    diagonals = np.einsum("naa->na", Lambda)
    return exact_sum(diagonals.ravel())
