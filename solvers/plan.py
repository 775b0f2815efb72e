"""What `solve` does: the steps of a solve in their order, wherever it runs.

A place (`solvers.place`) is where a solve runs, and takes every step in its own way: in one
process, by robots of one graph, or by robots that have files of their own. This page has the order
of the steps, and what happens when one of them is interrupted, out of time, or fails.

1. A start.
2. SOC, the splitting of orthogonality constraints, until Newton can take over.
3. Newton, down to rounding level.
4. The certificate of the poses. Steps 1 to 4 are an attempt.
5. Another attempt, from a start that grows; and the end of Newton in the first one, which has few
   steps where a start that grows may follow.
6. A second attempt, by a finer SOC or from another start.
7. The semidefinite relaxation: poses that its solution rounds to, and its bound. In the plane it is
   the one with rotations as complex numbers, which is never worse. For chi2, bounds by smaller
   information matrices, whose cost is below chi2.
8. In space, handedness terms, which are never negative on rotations and tell them from reflections:
   the cost less these terms has a better bound. If need be they begin where the relaxation with
   convex hulls of rotations is solved.

Steps 5 to 8 are taken while the answer is open: its certificate is wider than asked for and could
improve, and neither the time limit nor Ctrl-C has ended the solve. A Newton that was cut short goes
on in any case. They can only improve the answer. What fails in them, as linear algebra does
(`pgo_models.errors.FAILURES`), leaves the answer before it, with a sentence.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from pgo_models.certificates.certificate import BoundSource
from pgo_models.errors import FAILURES, NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from solvers.handedness.hull_lagrangian import HullState
from solvers.network.faults import RobotSilentError
from solvers.place import Attempt, FirstStage, Place, Step
from solvers.request import Pipeline
from solvers.result import Stage, Status
from solvers.riemannian.newton import Newton
from solvers.soc.paper import PaperSOC
from solvers.soc.soc import SOC

# Newton steps of a first attempt on graphs with landmarks. On all graphs tried, those that ended at
# the global minimum took at most as many, and the others 17 to 100.
LANDMARK_STEPS = 16
SECOND_TRY_TOLERANCE = 1e-6
HULL_PASSES = 3
CLOSER = 0.1  # factor on the tolerance of the next pass over the relaxation with hulls
Improvement = Callable[[Place, Pipeline, Attempt], Attempt]


def solve_at(place: Place, settings: Pipeline, start: Poses | None) -> Attempt:
    """Solve at a place, from a start or the place's own: all steps in their order."""
    try:
        first = attempt(place, settings.soc, _first_newton(place, settings), start)  # steps 1 to 4
    except KeyboardInterrupt:
        if not place.has_poses:
            raise
        return place.salvage(Stage.interruption)
    except NotPositiveDefiniteError:
        return place.salvage(Stage.without_factor)
    except RobotSilentError as error:
        return replace(place.salvage(Stage.silence), failures=(str(error),))
    best = improved(Step.GROWING, from_growing_start, place, settings, first)  # step 5
    growth_has_ended_it = first.is_open and not best.is_open  # certified, or out of time
    if _was_cut_short(place, settings, first) and not growth_has_ended_it:
        best = unless_it_fails(Step.LAST_STEPS, _LastSteps(first), place, settings, best)
    best = improved(Step.SECOND, from_second_start, place, settings, best)  # step 6
    best = improved(Step.COMPLEX, from_complex_numbers, place, settings, best)  # step 7
    if best.proof.source is not BoundSource.COMPLEX:
        best = improved(Step.STAIRCASE, from_relaxation, place, settings, best)
    best = improved(Step.SMALLER_MATRICES, by_smaller_matrices, place, settings, best)
    best = improved(Step.TERMS, _Terms(), place, settings, best)  # step 8
    return improved(Step.HULLS, _Hulls(), place, settings, best)


def attempt(place: Place, soc: FirstStage, newton: Newton, start: Poses | None) -> Attempt:
    """Start, SOC where it is asked for or pays, Newton unless time is up, and the certificate."""
    found, soc_to_run = place.start(start, soc)
    if found.has_certificate:  # a checkpoint has the outcome
        return found
    if soc_to_run is not None and not found.is_out_of_time:
        found = place.run_soc(found, soc_to_run)
    return newton_and_certificate(place, newton, found)


def newton_and_certificate(place: Place, newton: Newton, found: Attempt) -> Attempt:
    """Newton from the poses that were found, unless time is up, and the certificate."""
    if not found.is_out_of_time:
        found = place.run_newton(found, newton)
    return place.certify(found)


def improved(
    step: Step, improve: Improvement, place: Place, settings: Pipeline, best: Attempt
) -> Attempt:
    """Take a step if the answer is open and the settings ask for it; return the better answer.

    A step that the place cannot take is remembered, and named by the note of the solution.
    """
    if not (best.is_open and settings.asks_for(step, place.d)):
        return best
    if step in place.missing:
        return replace(best, not_tried=(*best.not_tried, step))
    return unless_it_fails(step, improve, place, settings, best)


def unless_it_fails(
    step: Step, improve: Improvement, place: Place, settings: Pipeline, best: Attempt
) -> Attempt:
    """Take a step; return the answer as it was, marked, where the step is interrupted or fails.

    After Ctrl-C the answer is INTERRUPTED, and so no step follows.
    """
    try:
        return improve(place, settings, best)
    except KeyboardInterrupt:
        place.stages.append(Stage.interruption(best.proof.objective))
        return replace(best, status=Status.INTERRUPTED)
    except FAILURES as error:
        place.stages.append(Stage.failure(step.value, best.proof.objective))
        sentence = f"{step.value} failed ({error}); the answer before it stands"
        return replace(best, failures=(*best.failures, sentence))


def from_growing_start(place: Place, settings: Pipeline, best: Attempt) -> Attempt:
    """Step 5: the better of the answer and an attempt from prefixes of the graph that grow.

    It is made after an attempt that ended well, or whose Newton took the few steps it was given.
    """
    growing = settings.growing
    ended_well = best.status.is_success or _was_cut_short(place, settings, best)
    begun = place.start_grown(growing) if growing is not None and ended_well else None
    if begun is None:
        return best
    if not begun.has_certificate:
        begun = newton_and_certificate(place, settings.newton, begun)
    return place.better(best, begun)


@dataclass(frozen=True, eq=False)
class _LastSteps:
    """Newton of the first attempt to its end, so that no answer is worse for having cut it short.

    It goes on from the poses of the first attempt, whose place in the answer it takes.
    """

    first: Attempt

    def __call__(self, place: Place, settings: Pipeline, best: Attempt) -> Attempt:
        finished = newton_and_certificate(place, settings.newton, self.first)
        return finished if best is self.first else place.better(best, finished)


def from_second_start(place: Place, settings: Pipeline, best: Attempt) -> Attempt:
    """Step 6: the better of the answer and an attempt by a finer SOC, or from another start.

    An attempt that did not end well has reached a limit, and a second one would reach it, too.
    """
    if not best.status.is_success:
        return best
    start = place.start_again()
    soc = finer(settings.soc) if start is None else None
    return place.better(best, attempt(place, soc, settings.newton, start))


def finer(soc: FirstStage) -> SOC | PaperSOC:
    """SOC of a second attempt: a finer tolerance, and as many iterations as that may take."""
    known = soc if isinstance(soc, SOC | PaperSOC) else SOC()
    tolerance = min(known.tolerance, SECOND_TRY_TOLERANCE)
    return replace(known, tolerance=tolerance, max_iterations=SOC.max_iterations)


def from_relaxation(place: Place, settings: Pipeline, best: Attempt) -> Attempt:
    """Step 7: the better of the answer and what the solution of the relaxation rounds to.

    The bound is the best of three: that of the answer, of the rounded poses, of the relaxation.
    """
    assert settings.staircase is not None
    rounded = place.climb(best, replace(settings.staircase, gap=settings.gap))
    if rounded is None:
        return best
    return place.better(best, newton_and_certificate(place, settings.newton, rounded))


def by_smaller_matrices(place: Place, settings: Pipeline, best: Attempt) -> Attempt:
    """Step 7 for chi2: the answer with the best bound that smaller information matrices give."""
    return place.bound_by_smaller_matrices(best)


def from_complex_numbers(place: Place, settings: Pipeline, best: Attempt) -> Attempt:
    """Step 7 in the plane: the better of the answer and what the relaxation rounds to."""
    search = settings.handedness
    return best if search is None else place.solve_in_complex_numbers(best, search.plane)


@dataclass(frozen=True, eq=False)
class _Terms:
    """Step 8: the answer with the best bound that handedness terms at its poses give.

    The search begins with the terms of the multipliers Pi, (pairs, 4, 4), or with none.
    """

    Pi: Array | None = None

    def __call__(self, place: Place, settings: Pipeline, best: Attempt) -> Attempt:
        search = settings.handedness
        return best if search is None else place.bound_by_terms(best, search, self.Pi)


@dataclass(frozen=True, eq=False)
class _Hulls:
    """Step 8, continued: terms that begin where the relaxation with hulls of rotations is solved.

    It is solved in passes. Each goes on from the `state` of the one before, with the tolerance of
    the settings times a smaller factor. A pass that fails leaves the answer of the one before.
    """

    passes_left: int = HULL_PASSES
    state: HullState | None = None
    tolerance_factor: float = 1.0

    def __call__(self, place: Place, settings: Pipeline, best: Attempt) -> Attempt:
        method = None if settings.handedness is None else place.hulls(settings.handedness)
        if method is None:
            return best
        method = replace(method, tolerance=self.tolerance_factor * method.tolerance)
        before = best
        best, state = place.solve_hulls(best, method, self.state)
        is_close = state.closeness <= method.tolerance
        has_moved = best.poses is not before.poses
        if not best.is_open or not (is_close or has_moved):
            return best
        best = unless_it_fails(Step.TERMS, _Terms(state.Pi), place, settings, best)
        if not best.is_open or not is_close or self.passes_left == 1:
            return best
        closer = _Hulls(self.passes_left - 1, state, CLOSER * self.tolerance_factor)
        return unless_it_fails(Step.HULLS, closer, place, settings, best)


def _first_newton(place: Place, settings: Pipeline) -> Newton:
    """Newton of the first attempt, with few steps where a growing start may follow soon."""
    newton = settings.newton
    may_grow = settings.growing is not None and Step.GROWING not in place.missing
    if not (place.has_landmarks and may_grow):
        return newton
    return replace(newton, max_iterations=min(newton.max_iterations, LANDMARK_STEPS))


def _was_cut_short(place: Place, settings: Pipeline, first: Attempt) -> bool:
    """Whether Newton of the first attempt was given few steps, and took them all."""
    has_more = _first_newton(place, settings) != settings.newton
    return has_more and first.status is Status.MAX_ITERATIONS
