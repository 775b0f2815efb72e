"""What `solve` does: the steps of a solve in their order, wherever it runs.

A place (`solvers.place`) is where a solve runs, and takes every step in its own way: in one
process, by robots of one graph, or by robots that have files of their own. This page has the order
of the steps, and what happens when one of them is interrupted, out of time, or fails.

1. A start: given poses, or else the chordal relaxation. In the plane its rotations are averaged
   where no SOC is asked for. PaperSOC starts at a spanning tree.
2. SOC, the splitting of orthogonality constraints, until Newton can take over. `soc_to_run` says
   where it is left out; one that nobody asked for is left out, too, where the start took all the
   time.
3. Newton, down to rounding level.
4. The certificate of the poses. Steps 1 to 4 are an attempt.
5. Another attempt, from a start that grows: prefixes of the graph, each solved from the one before.
   On graphs with landmarks Newton of the first attempt has few steps from the place's own start, as
   this attempt may follow, and after it one from the chordal relaxation.
6. Newton from other starts: the estimate of the file, a spanning tree, the chordal relaxation or,
   where the cost is another, the optimum of F, and on small graphs random poses. The table of
   stages says which of them is the best. If it is the first attempt's, whose Newton had few steps,
   Newton goes on from there.
7. A relaxation of the cost: poses that its solution rounds to, and its bound. In the plane it has
   rotations as complex numbers, and is never worse than the semidefinite one, which the staircase
   solves. For chi2, bounds by smaller information matrices, whose cost is below chi2.
8. In space, handedness terms, which are never negative on rotations and tell them from reflections:
   the cost less these terms has a better bound. If need be they begin where the relaxation with
   convex hulls of rotations is solved. They are left out where the Hessian of the tangent of chi2
   says that no terms raise the bound.

Steps 5 to 8 are taken while the answer is open, where the settings ask for them and nothing stands
against them (`improved`). They can only improve the answer. What fails in them, as linear algebra
does (`pgo_models.errors.FAILURES`), leaves the answer before it, with a sentence. A step that is
asked for and cannot be taken has a line in the table of stages, which says why.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from pgo_models.certificates.certificate import BoundSource
from pgo_models.errors import FAILURES, NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from solvers.carry.faults import RobotSilentError
from solvers.handedness.hull_lagrangian import HullLagrangian
from solvers.place import AUTO, AnySOC, Attempt, FirstStage, OwnStart, Place, Step, Traits
from solvers.request import Pipeline
from solvers.result import Stage, Status
from solvers.riemannian.newton import Newton
from solvers.soc.paper import PaperSOC
from solvers.soc.soc import WARM_START

# Poses in space up to which Newton alone is faster than SOC and Newton in one process.
SMALL = 1000
# Newton steps of a first attempt on graphs with landmarks. On all graphs tried, those that ended at
# the global minimum took at most as many, and the others 17 to 100.
LANDMARK_STEPS = 16
HULL_PASSES = 3  # with CLOSER the last one has a hundredth of the first tolerance
CLOSER = 0.1  # factor on the tolerance of the next pass over the relaxation with hulls
Improvement = Callable[[Place, Pipeline, Attempt], Attempt]


def solve_at(place: Place, settings: Pipeline, start: Poses | None) -> Attempt:
    """Solve at a place, from a start or the place's own: all steps in their order."""
    newton = _first_newton(place.traits, settings, start)
    try:
        first = attempt(place, settings.first_stage, newton, start)  # steps 1 to 4
    except KeyboardInterrupt:
        if not place.has_poses:
            raise
        return place.salvage(Status.INTERRUPTED)
    except NotPositiveDefiniteError:
        return place.salvage(Status.NOT_FACTORED)
    except RobotSilentError as error:
        return replace(place.salvage(Status.SILENT), failures=(str(error),))
    if not place.traits.has_driver:
        return first
    best = improved(Step.GROWING, from_growing_start, place, settings, first)  # step 5
    best = improved(Step.STARTS, from_other_starts, place, settings, best)  # step 6
    if newton != settings.newton and best.status is Status.MAX_ITERATIONS:
        best = unless_it_fails(Step.LAST_STEPS, with_last_steps, place, settings, best)
    best = by_relaxation(place, settings, best)  # step 7
    return by_handedness(place, settings, best)  # step 8


def attempt(place: Place, asked: FirstStage, newton: Newton, start: Poses | None) -> Attempt:
    """Start, SOC where it is asked for or pays, Newton unless time is up, and the certificate."""
    place.table.begin_attempt()
    soc = soc_to_run(asked, place.traits, start)
    current = place.start(_start_of(asked, soc, place.traits, start), soc)
    if current.has_certificate:  # a checkpoint has the outcome
        return current
    has_time = asked is not AUTO or place.traits.has_robots or not place.monitor.is_late
    if soc is not None and has_time and not current.is_out_of_time:
        current = place.run_soc(current, soc)
    return newton_and_certificate(place, newton, current)


def soc_to_run(asked: FirstStage, traits: Traits, start: Poses | None) -> AnySOC | None:
    """SOC of an attempt: the one that is asked for; AUTO stands for the fastest way.

    That is SOC with a coarse tolerance, or none where Newton alone is faster: from the averaged
    start, and in one process from the chordal start of a small graph or of rotations alone, and for
    a cost that is not convex and quadratic. SOC then runs on the convex part, whose minimum is no
    nearer to that of the cost than the start is.
    """
    if asked is not AUTO:
        return asked
    has_own_start = start is None
    if has_own_start and traits.averages:
        return None
    is_small = traits.num_poses <= SMALL or not traits.has_translations
    newton_alone = not traits.is_quadratic or (has_own_start and is_small)
    return None if newton_alone and not traits.has_robots else WARM_START


def _start_of(
    asked: FirstStage, soc: AnySOC | None, traits: Traits, start: Poses | None
) -> Poses | OwnStart:
    """Start of an attempt: given poses, or else the one that suits what runs from it."""
    if start is not None:
        return start
    if isinstance(soc, PaperSOC):
        return OwnStart.TREE
    is_averaged = asked is AUTO and soc is None and traits.averages
    return OwnStart.AVERAGED if is_averaged else OwnStart.CHORDAL


def newton_and_certificate(place: Place, newton: Newton, current: Attempt) -> Attempt:
    """Newton from the current poses, unless time is up, and the certificate."""
    if not current.is_out_of_time:
        current = place.run_newton(current, newton)
    return place.certify(current)


def improved(
    step: Step, improve: Improvement, place: Place, settings: Pipeline, best: Attempt
) -> Attempt:
    """Take a step where the answer is open, the settings ask for it, and nothing is against it.

    What is against it has a line in the table of stages.
    """
    if not (best.is_open and settings.asks_for(step)):
        return best
    reason = obstacle(step, place, settings, best)
    if reason:
        place.table.skip(step.value, reason, best.proof.objective)
        return best
    return unless_it_fails(step, improve, place, settings, best)


def obstacle(step: Step, place: Place, settings: Pipeline, best: Attempt) -> str:
    """Why a step cannot be taken, in a few words; "" where it can."""
    reason = place.lacks(step) or _misfit(step, place, settings)
    if not reason and step is Step.TERMS and not place.terms_can_help(best):
        return "turns of the poses lower the tangent of chi2, with any terms"
    return reason


def _misfit(step: Step, place: Place, settings: Pipeline) -> str:
    """Why a step does not suit the graph or its cost, in a few words; "" where it does."""
    traits = place.traits
    if step is Step.GROWING and settings.growing is not None:
        if traits.num_bodies <= settings.growing.first_size:
            return f"no more than {settings.growing.first_size} poses"
        return "" if place.odometry_joins else "odometry does not join the poses"
    if step is Step.COMPLEX and not traits.has_translations:
        return "rotations alone do not gain by it"
    if step in (Step.STAIRCASE, Step.HULLS) and not traits.is_quadratic:
        return "the cost is not convex and quadratic"
    search = settings.handedness
    if step is Step.HULLS and search is not None and traits.num_poses > search.most_hull_poses:
        return f"more than {search.most_hull_poses} poses"
    return ""


def unless_it_fails(
    step: Step, improve: Improvement, place: Place, settings: Pipeline, best: Attempt
) -> Attempt:
    """Take a step; return the answer as it was, marked, where the step is interrupted or fails.

    After Ctrl-C the answer is INTERRUPTED, and so no step follows.
    """
    try:
        return improve(place, settings, best)
    except KeyboardInterrupt:
        place.table.add(Stage.without_steps(Status.INTERRUPTED, best.proof.objective))
        return replace(best, status=Status.INTERRUPTED)
    except FAILURES as error:
        failure = Stage.without_steps(Status.FAILED, best.proof.objective, step.value)
        place.table.add(failure)
        sentence = f"{step.value} failed ({error}); the answer before it stands"
        return replace(best, failures=(*best.failures, sentence))


def from_growing_start(place: Place, settings: Pipeline, best: Attempt) -> Attempt:
    """Step 5: the better of the answer and an attempt from prefixes of the graph that grow."""
    assert settings.growing is not None
    place.table.begin_attempt()
    grown = place.start_grown(settings.growing)
    if not grown.has_certificate:
        grown = newton_and_certificate(place, settings.newton, grown)
    return place.better(best, grown)


def from_other_starts(place: Place, settings: Pipeline, best: Attempt) -> Attempt:
    """Step 6: the better of the answer and an attempt from the best of some other starts."""
    return place.try_other_starts(best, settings.newton)


def with_last_steps(place: Place, settings: Pipeline, best: Attempt) -> Attempt:
    """Newton from the best poses to its end, where that of the first attempt was cut short."""
    return place.better(best, attempt(place, None, settings.newton, best.known_poses))


def by_relaxation(place: Place, settings: Pipeline, best: Attempt) -> Attempt:
    """Step 7: the relaxation that suits the cost and, for chi2, smaller information matrices."""
    traits = place.traits
    if traits.d == 2:
        best = improved(Step.COMPLEX, from_complex_numbers, place, settings, best)
    if best.proof.source is not BoundSource.COMPLEX:
        best = improved(Step.STAIRCASE, from_staircase, place, settings, best)
    if traits.is_chi2:
        best = improved(Step.SMALLER_MATRICES, by_smaller_matrices, place, settings, best)
    return best


def from_complex_numbers(place: Place, settings: Pipeline, best: Attempt) -> Attempt:
    """The better of the answer and what the relaxation in complex numbers rounds to."""
    assert settings.handedness is not None
    return place.solve_in_complex_numbers(best, settings.handedness.plane)


def from_staircase(place: Place, settings: Pipeline, best: Attempt) -> Attempt:
    """The better of the answer and an attempt from what the semidefinite relaxation rounds to.

    The bound is the best of three: that of the answer, of the rounded poses, of the relaxation.
    """
    assert settings.staircase is not None
    place.table.begin_attempt()
    rounded = place.climb(best, replace(settings.staircase, gap=settings.gap))
    return place.better(best, newton_and_certificate(place, settings.newton, rounded))


def by_smaller_matrices(place: Place, settings: Pipeline, best: Attempt) -> Attempt:
    """The answer with the best bound that smaller information matrices give."""
    return place.bound_by_smaller_matrices(best)


def by_handedness(place: Place, settings: Pipeline, best: Attempt) -> Attempt:
    """Step 8: handedness terms at the poses, and then from the relaxation with hulls.

    That relaxation is solved in passes. Each goes on from where the one before has ended, to a
    smaller tolerance, and ends with handedness terms from there. The last pass is the one that does
    not come within its tolerance, or fails.
    """
    if place.traits.d == 2:
        return best
    best = improved(Step.TERMS, by_terms, place, settings, best)
    for _ in range(HULL_PASSES):
        before = best
        best = improved(Step.HULLS, from_hulls, place, settings, before)
        state = best.hulls
        if state is None or state is before.hulls:  # the pass was not taken, or failed
            return best
        is_close = state.closeness <= _hulls(settings).tolerance
        if is_close or best.poses is not before.poses:
            best = improved(Step.TERMS, by_terms, place, settings, best)
        if not is_close:
            return best
        settings = _with_closer_hulls(settings)
    return best


def by_terms(place: Place, settings: Pipeline, best: Attempt) -> Attempt:
    """The answer with the best bound of terms, which begin where the hulls were solved, if ever."""
    assert settings.handedness is not None
    Pi = None if best.hulls is None else best.hulls.Pi
    return place.bound_by_terms(best, settings.handedness, Pi)


def from_hulls(place: Place, settings: Pipeline, best: Attempt) -> Attempt:
    """One pass over the relaxation with hulls: the better of the answer and what it rounds to."""
    return place.solve_hulls(best, replace(_hulls(settings), gap=settings.gap))


def _hulls(settings: Pipeline) -> HullLagrangian:
    """Method for the relaxation with hulls, where the settings ask for it."""
    assert settings.handedness is not None
    assert settings.handedness.hulls is not None
    return settings.handedness.hulls


def _with_closer_hulls(settings: Pipeline) -> Pipeline:
    """The settings of the next pass over the relaxation with hulls."""
    assert settings.handedness is not None
    hulls = _hulls(settings)
    closer = replace(hulls, tolerance=CLOSER * hulls.tolerance)
    return replace(settings, handedness=replace(settings.handedness, hulls=closer))


def _first_newton(traits: Traits, settings: Pipeline, start: Poses | None) -> Newton:
    """Newton of the first attempt, with few steps from a start that other attempts make up for."""
    newton = settings.newton
    others_follow = settings.growing is not None and settings.other_starts
    if not (start is None and traits.has_landmarks and others_follow):
        return newton
    return replace(newton, max_iterations=min(newton.max_iterations, LANDMARK_STEPS))
