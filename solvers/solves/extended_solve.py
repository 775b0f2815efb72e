"""solve() of F with convex terms and constraints of one's own.

Priors are certified, and the note of the solution says which terms the bound leaves out.
"""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np

from pgo_models.certificates.certificate import (
    BoundSource,
    Certificate,
    relative_gap,
    verdict_of,
)
from pgo_models.certificates.fit import NO_FIT, fit_of
from pgo_models.certificates.lower_bound import NO_BOUND, LowerBound
from pgo_models.convex.gauge import with_gauge_held
from pgo_models.convex.graph_model import graph_model
from pgo_models.convex.graph_subproblem import GraphQP, ModelChange
from pgo_models.convex.quadratic_form import NotQuadraticError, quadratic_form
from pgo_models.errors import SettingError
from pgo_models.figures import gap_above, scaled_above, scaled_below
from pgo_models.geometry.poses import Poses
from pgo_models.problem.problem import PGOProblem
from solvers.convex.certify_model import certified_point
from solvers.convex.extended_soc import with_priors
from solvers.reporting.notes import joined_notes, note_of_absence, note_of_coupling
from solvers.request import SolveRequest
from solvers.result import OUT_OF_TIME, Stage
from solvers.solution import Solution


def solve_extended(
    request: SolveRequest, solution_for: Callable[[SolveRequest], Solution]
) -> Solution:
    """Solution of F with the terms and constraints that an ExtendedSOC adds.

    Terms that are priors go into the graph, which `solution_for` solves. With priors alone that is
    the solution, of the graph with them, whose last pose is the world.

    Else the poses are those of ExtendedSOC. The objective has all terms. Where they are quadratic,
    the bound is that of the model (`pgo_models.convex.graph_model`), and the poses are its
    stationary point. Else the bound leaves out what the note says: terms that are never negative,
    and constraints, which can only raise the optimum.
    Where edges are replaced there is no bound.

    A SettingError where a term may be negative, and where robots or a robust solve are asked for,
    which go with priors alone.
    """
    problem = request.problem
    monitor = request.monitor
    pipeline = request.pipeline
    soc: Any = pipeline.soc  # an ExtendedSOC
    model = soc.model(problem)
    graph, other_terms = with_priors(model)
    left_out = _left_out(model.change, other_terms)
    if not all(term.is_nonneg() for term in other_terms):
        raise SettingError(
            "a term may be negative, so there is no bound; "
            "use solvers.run(ExtendedSOC(..), problem)"
        )
    given = {"robots": request.robots, "robust": request.robust}
    asked = [name for name, value in given.items() if value is not None]
    if left_out and asked:
        raise SettingError(
            f"{' and '.join(asked)} go with priors alone, and there are {left_out[0]}; "
            "leave that out"
        )
    with_known_priors = PGOProblem(graph, problem.backend, problem.weighting)
    start = request.start
    known_start = None if start is None else graph.completed(start)
    without_terms = replace(pipeline, soc=soc.soc)
    solution = solution_for(
        replace(request, problem=with_known_priors, pipeline=without_terms, start=known_start)
    )
    if not left_out:
        return solution
    stages = list(solution.stages)
    poses = solution.all_poses
    status = solution.status
    if status not in OUT_OF_TIME:
        with_terms = monitor.run(soc, problem, start)
        poses = with_terms.poses
        stage = Stage.of(with_terms)
        status = stage.status
        stages.append(replace(stage, objective=model.cost(poses.stacked())))
    of_model = None
    if status not in OUT_OF_TIME:
        of_model = _certificate_of_model(request, poses, solution.certificate)
    what_is_left_out = f"the bound leaves out {', '.join(left_out)}"
    certificate = _certificate_with_terms(
        solution.certificate, model, poses, with_known_priors, is_F=not other_terms
    )
    if of_model is not None and of_model.lower_bound > certificate.lower_bound:
        certificate = of_model
    else:
        of_model = None
    note = joined_notes(
        note_of_absence(len(problem.graph.absent)),
        note_of_coupling(problem),
        "" if of_model else what_is_left_out,
    )
    return replace(
        solution,
        problem=problem,
        all_poses=poses if of_model is None else of_model.poses,
        objective=certificate.objective,
        certificate=certificate,
        status=status,
        stages=tuple(stages),
        seconds=time.perf_counter() - monitor.began,
        note=note,
        frame="that of the added terms",
    )


def _left_out(change: ModelChange, terms: list[cp.Expression]) -> list[str]:
    """What the bound leaves out, and of each how many: terms, constraints and replaced edges."""
    name = "terms other than tau ||t - p||^2 and kappa ||R - P||_F^2"
    counts = {
        name: len(terms),
        "constraints": len(change.constraints),
        "replaced edges": len(change.replaced_edges),
    }
    return [f"{name} ({count})" for name, count in counts.items() if count]


def _certificate_of_model(
    request: SolveRequest, poses: Poses, certificate: Certificate
) -> Certificate | None:
    """Certificate of the stationary point beside the poses where all terms are quadratic.

    It bounds the objective with all terms. None where they are not, or constraints are no
    equalities that a model takes.
    """
    soc: Any = request.pipeline.soc
    gap = certificate.wanted_gap
    try:
        model = graph_model(request.problem, soc.changer)
        form = with_gauge_held(quadratic_form(model))
        if form.limits_x:
            return None
        judged, u = certified_point(form, [list(poses.R)], gap)
    except NotQuadraticError:
        return None
    if judged.bound is None:
        return None
    t = u[form.num_constrained :][: poses.t.size].reshape(poses.t.shape, order="F")
    best = Poses(np.array(form.values(u)), t)
    bound = LowerBound(judged.lower_bound, 0.0, True, judged.bound.rounding)
    return replace(
        certificate,
        objective=judged.objective,
        objective_error=judged.objective_error,
        bound=bound,
        gap=judged.gap,
        source=BoundSource.POLISHED,
        poses=best,
        poses_objective=judged.objective,
        verdict=judged.verdict,
        fit=NO_FIT,
        stationarity=math.nan,
    )


def _certificate_with_terms(
    certificate: Certificate, model: GraphQP, poses: Poses, priors: PGOProblem, is_F: bool
) -> Certificate:
    """Certificate of poses whose objective has all terms.

    `certificate` bounds the problem with the `priors` alone. `is_F` says whether there are no other
    terms. Nothing is known of the rounding error of terms of one's own.
    """
    objective = model.cost(poses.stacked())
    has_replaced_edges = bool(model.change.replaced_edges)
    bound = NO_BOUND if has_replaced_edges else certificate.bound
    fit = NO_FIT
    if is_F and not has_replaced_edges:
        fit = fit_of(priors, priors.graph.completed(poses))
    at_most = scaled_above(objective, certificate.weights_error)
    at_least = scaled_below(bound.value, certificate.weights_error)
    return replace(
        certificate,
        objective=objective,
        objective_error=math.nan,
        bound=bound,
        gap=relative_gap(at_most, at_least, fit.is_to_rounding),
        verdict=verdict_of(fit, gap_above(at_most, at_least), bound, certificate.wanted_gap),
        fit=fit,
        stationarity=math.nan,
    )
