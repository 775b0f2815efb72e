"""Polish: from given poses to the stationary point nearby, by damped Riemannian Newton with sparse Cholesky.

One factorisation serves several moves. After the first, the factored matrix is the one that L-BFGS begins with
(Nocedal & Wright 2006, algorithm 7.4), which learns from every move what has changed: sphere2500 needs one
factorisation where moves with the factor alone need two.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_array

from pgo_models.certificates.dual_variables import multipliers
from pgo_models.certificates.rounding_errors import rounding_level
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, exp_map, project_to_rotations, vee
from pgo_models.problem.cholesky import CholeskyFactor, SymbolicCholesky, analyze
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian, tangent_order
from pgo_models.problem.matrices import inner
from pgo_models.problem.problem import PGOProblem

STATIONARY_DECREMENT = 1e-13
STATIONARY_FOR_TANGENTS = 1e-16  # what is left of chi2 weighs more in the bound: its tangent is softer than chi2 itself
SMALL_DECREMENT = 1e-9
ROUNDING = 1e-14  # relative change of F that is not told apart from none
NEARLY_STRAIGHT = 1e-7  # decrement below which the path of the best translations of chi2 is a line
SUFFICIENT = 1e-4  # Armijo's constant
HALVINGS = 40
NEARLY_EXACT = 1e4  # times its rounding level: then F is what the solve for the translations leaves
DAMPING_START, DAMPING_GROWTH, DAMPING_MAX = 1e-8, 10.0, 1e6
CHORD_STEPS, SECANT_STEPS = 3, 8  # further moves with one factor, as it is and with the secants of the moves before
PROGRESS = 0.1  # what a move has to leave at most of the decrement for another one with the same factor


@dataclass(frozen=True, eq=False)
class PolishState:
    """Poses on the way to a stationary point."""

    poses: Poses
    objective: float
    # Half the squared Newton decrement at the poses, less the rounding level of F, over F: the relative decrease that
    # the quadratic model still promises and F can show. inf before the first factorisation.
    decrement: float = np.inf
    is_newton: bool = False  # whether the last factored matrix was the Hessian, not its damped Gauss-Newton part
    moved: bool = True  # whether the last step changed the poses
    is_at_rounding: bool = False  # whether a Newton step hardly cut a small decrement, which it squares: rounding
    tolerance: float = STATIONARY_DECREMENT  # on the decrement
    analysis: SymbolicCholesky | None = None  # it and the last factor are for the next step to reuse
    factor: CholeskyFactor | None = None

    @property
    def is_stationary(self) -> bool:
        """Whether nothing is left to gain above the rounding level."""
        return self.decrement <= self.tolerance or self.is_at_rounding


def start_polish(problem: PGOProblem, poses: Poses, share: float = 1.0) -> PolishState:
    """State before the first step; `share` is how many times looser than usual its tolerance is."""
    tolerance = share * (STATIONARY_DECREMENT if problem.is_quadratic else STATIONARY_FOR_TANGENTS)
    return PolishState(poses=poses, objective=problem.objective(poses), tolerance=tolerance)


def polish_step(
    problem: PGOProblem, state: PolishState, second_order: bool = True, secants: bool = True
) -> PolishState:
    """Factor once, then move as long as the same factor serves; F never rises.

    The first move solves H y = -g with the Riemannian Hessian H, or, where H is not positive definite or
    `second_order` is False, with its Gauss-Newton part, damped until it is; that part is the better model of chi2 far
    from its minimum, where the first step begins. Backtracking (Armijo) keeps F monotone.
    Further moves take the same factor, with the secants of those before (L-BFGS) or, without `secants`, as it is (chord
    steps), while each cuts the decrement to a tenth, or by so much that those left would bring it within tolerance.
    """
    is_far = state.analysis is None and not problem.is_quadratic
    analysis, factor, is_newton = factorize_model(problem, state, second_order and not is_far)
    layout = TangentLayout(problem.num_poses, problem.d)
    now = replace(state, analysis=analysis, factor=factor, is_newton=is_newton, moved=False)
    level = rounding_level(problem, state.poses)  # hardly moves with them
    gradient, learned = layout.join(*problem.riemannian_gradient(state.poses)), list[tuple[Array, Array]]()
    direction = -factor.solve(gradient)
    now = replace(now, decrement=scaled_decrement(-inner(gradient, direction), now.objective, level))
    for _ in range(1 + (SECANT_STEPS if secants else CHORD_STEPS)):
        if now.is_stationary:
            break
        candidate = _backtrack(problem, now, direction, inner(gradient, direction), level)
        if candidate is None:
            break
        before, gradient = gradient, layout.join(*problem.riemannian_gradient(candidate.poses))
        if secants:
            turn = vee(np.swapaxes(now.poses.R, 1, 2) @ candidate.poses.R)
            learned.append((layout.join(turn, candidate.poses.t - now.poses.t), gradient - before))
        direction = -_apply_inverse(factor, learned, gradient)
        decrement = scaled_decrement(-inner(gradient, direction), candidate.objective, level)
        at_rounding = reached_rounding(now.decrement, decrement, is_newton and not now.moved)
        if candidate.objective >= now.objective and decrement > 0.5 * now.decrement:
            now = replace(now, is_at_rounding=at_rounding)
            break
        cut, left = decrement / now.decrement, SECANT_STEPS - len(learned)
        enough = cut <= PROGRESS or (secants and decrement * cut**left <= now.tolerance)
        now = replace(candidate, decrement=decrement, moved=True, is_at_rounding=at_rounding)
        if not enough:
            break
    return now


def polish(problem: PGOProblem, poses: Poses, max_steps: int = 100) -> Poses:
    """Stationary poses near the given ones, with F no higher; the best reached after `max_steps` factorisations.

    Examples
    --------
    >>> from pgo_models import chordal_start, grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> start = chordal_start(problem)
    >>> bool(problem.objective(polish(problem, start)) < problem.objective(start))
    True
    """
    state = start_polish(problem, poses)
    for _ in range(max_steps):
        state = polish_step(problem, state)
        if state.is_stationary or not state.moved:
            break
    return state.poses


def reached_rounding(before: float, after: float, is_newton_step: bool) -> bool:
    """Whether a decrement so small that a Newton step squares it was not even cut to a tenth by one."""
    return is_newton_step and before <= SMALL_DECREMENT and after > PROGRESS * before


def relative_decrement(problem: PGOProblem, poses: Poses) -> float:
    """Half the squared Newton decrement of F at poses, less the rounding level of F, over F (`scaled_decrement`).

    Where the Hessian is not positive definite, as at saddles, it is that of the damped Gauss-Newton matrix, and above
    `STATIONARY_DECREMENT` in any case.
    """
    state = start_polish(problem, poses)
    _, factor, is_newton = factorize_model(problem, state, second_order=True)
    gradient = TangentLayout(problem.num_poses, problem.d).join(*problem.riemannian_gradient(poses))
    square = inner(gradient, factor.solve(gradient))
    decrement = scaled_decrement(square, state.objective, rounding_level(problem, poses))
    return decrement if is_newton else max(decrement, 2.0 * STATIONARY_DECREMENT)


def move_poses(poses: Poses, w: Array, v: Array) -> Poses:
    """Poses (R_i Exp(hat(w_i)), t_i + v_i), the rotations cleaned of rounding."""
    return Poses(project_to_rotations(poses.R @ exp_map(w)), poses.t + v)


def factorize_model(
    problem: PGOProblem, state: PolishState, second_order: bool
) -> tuple[SymbolicCholesky, CholeskyFactor, bool]:
    """Factor the Hessian if it is positive definite, else the Gauss-Newton matrix with the least damping that works."""
    analysis = state.analysis
    order = None if analysis is not None else tangent_order(problem)
    if second_order:
        hessian = riemannian_hessian(problem, state.poses, multipliers(problem, state.poses))
        ground_pose(hessian, problem)
        analysis = analysis or analyze(hessian, problem.backend, order)
        try:
            return analysis, analysis.factorize(hessian, overwrite=state.factor), True
        except NotPositiveDefiniteError:
            pass
    gauss_newton = riemannian_hessian(problem, state.poses, None)
    ground_pose(gauss_newton, problem)
    analysis = analysis or analyze(gauss_newton, problem.backend, order)
    diagonal, damping = gauss_newton.diagonal(), 0.0
    while True:
        try:
            return analysis, analysis.factorize(gauss_newton), False
        except NotPositiveDefiniteError:
            damping = max(DAMPING_START, DAMPING_GROWTH * damping)
            if damping > DAMPING_MAX:
                raise
            gauss_newton.setdiag(diagonal * (1.0 + damping))


def ground_pose(matrix: csc_array, problem: PGOProblem) -> None:
    """Double the diagonal of pose 0: rigid motions leave F as it is, so at a stationary point the step keeps pose 0."""
    layout = TangentLayout(problem.num_poses, problem.d)
    zero = np.zeros(1, dtype=np.int64)
    for column in np.concatenate([layout.translations(zero)[0], layout.rotations(zero)[0]]):
        begin, end = matrix.indptr[column], matrix.indptr[column + 1]
        position = begin + np.searchsorted(matrix.indices[begin:end], column)
        matrix.data[position] += abs(matrix.data[position])


def _apply_inverse(factor: CholeskyFactor, secants: list[tuple[Array, Array]], gradient: Array) -> Array:
    """H^-1 g by the two loops of L-BFGS, from H the factored matrix; secants are moves and changes of g along them."""
    curved = [(move, change) for move, change in secants if inner(move, change) > 0.0]
    g, shares = gradient.copy(), []
    for move, change in reversed(curved):
        shares.append(inner(move, g) / inner(move, change))
        g -= shares[-1] * change
    step = factor.solve(g)
    for (move, change), share in zip(curved, reversed(shares), strict=True):
        step += (share - inner(change, step) / inner(move, change)) * move
    return step


def scaled_decrement(square: float, objective: float, rounding_level: float) -> float:
    """(g^T H^-1 g / 2 - level) / F, or 0 where that is not positive: what is left to gain, as a share of F."""
    left = 0.5 * square - rounding_level
    return left / objective if left > 0.0 else 0.0


def _backtrack(problem: PGOProblem, state: PolishState, step: Array, slope: float, level: float) -> PolishState | None:
    """First of the moves step, step/2, .. that lowers F enough, for its slope along them; None when none does."""
    w, v = TangentLayout(problem.num_poses, problem.d).split(step)
    length = 1.0
    for _ in range(HALVINGS):
        # The translations that are best for the turned rotations lie on the curved path that a straight move of both
        # leaves: on parking-garage this saves two thirds of the factorisations.
        poses = move_poses(state.poses, length * w, length * v)
        if problem.is_quadratic or state.decrement > NEARLY_STRAIGHT:
            poses = problem.at_best_translations(poses)
        objective = problem.objective(poses)
        if problem.is_quadratic and length == 1.0 and objective <= NEARLY_EXACT * level:
            poses = problem.with_refined_translations(poses)
            objective = problem.objective(poses)
        is_lower = objective <= state.objective + SUFFICIENT * length * slope
        # Where it is too near for F to tell, the decrement decides in the caller.
        if is_lower or (length == 1.0 and objective <= state.objective * (1.0 + ROUNDING)):
            return replace(state, poses=poses, objective=objective)
        length *= 0.5
    return None
