"""solve() of F with convex terms and constraints of one's own: priors are certified, what is left out is said."""

import math
import time
from dataclasses import replace
from typing import Any

from pgo_models.certificates.certificate import relative_gap, verdict_of
from pgo_models.certificates.lower_bound import NO_BOUND
from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.problem.problem import PGOProblem
from solvers.convex.extended_newton import ExtendedNewton, kinks
from solvers.convex.extended_soc import with_priors
from solvers.loop import Watch
from solvers.result import OUT_OF_TIME, Run, Stage
from solvers.robust_solve import Plain
from solvers.solution import Solution


def solve_extended(
    problem: PGOProblem,
    pipeline: Any,  # noqa: ANN401 - a Pipeline
    start: Poses | None,
    watch: Watch,
    plain: Plain,
    asked: list[str],
) -> Solution:
    """Solve with priors for the terms that are such by `plain`, and where there is more run the ExtendedSOC, too.

    With priors alone the solution is that of the graph with them, whose last pose is the world. Else poses are of
    ExtendedSOC and, where that leaves all terms smooth and there are no constraints, of ExtendedNewton; the objective
    has all terms, and the bound leaves out what its note says: terms that are never negative (a SettingError where one
    might be) and constraints, which can only raise it. Replaced edges leave none. What is `asked` of `plain`, robots
    and robust, goes with priors alone: a SettingError else.
    """
    model = pipeline.soc.model(problem)
    graph, left = with_priors(model)
    if not all(term.is_nonneg() for term in left):
        raise SettingError("a term may be negative, so there is no bound; use solvers.run(ExtendedSOC(..), problem)")
    change, terms = model.change, "terms other than tau ||t - p||^2 and kappa ||R - P||_F^2"
    parts = (terms, left), ("constraints", change.constraints), ("replaced edges", change.replaced_edges)
    left_out = [f"{name} ({len(several)})" for name, several in parts if several]
    if left_out and asked:
        raise SettingError(f"{' and '.join(asked)} go with priors alone, and there are {left_out[0]}; leave that out")
    first, start_of_it = replace(pipeline, soc=pipeline.soc.soc), None if start is None else graph.completed(start)
    solution = plain(replace(problem, graph=graph), first, start_of_it, time_limit=watch.left)
    if not left_out:
        return solution
    certificate, poses, status = solution.certificate, solution.poses, solution.status
    level, stationarity, runs = certificate.rounding_level, math.nan, list[Run[Any]]()
    if status not in OUT_OF_TIME:
        runs.append(watch.run(pipeline.soc, problem, start))
        poses, status = runs[0].poses, runs[0].status
    model.variables.X.value = poses.stacked()
    if not_smooth := sorted(set(["constraints"] * bool(change.constraints)).union(*map(kinks, change.terms))):
        why = f"as Newton needs smooth terms alone, and there are {', '.join(not_smooth)}"
        left_out[-1] += f"; SOC is the last stage, {why}"
    elif status not in OUT_OF_TIME:
        newton = pipeline.newton
        second = ExtendedNewton(pipeline.soc.changer, newton.tolerance, newton.max_iterations)
        runs.append(watch.run(second, problem, poses))
        poses, status, stationarity = runs[1].poses, runs[1].status, runs[1].state.decrement
    objective = model.cost(poses.stacked())
    bound = NO_BOUND if change.replaced_edges else certificate.bound
    gap = relative_gap(objective, bound.value, level)
    verdict = verdict_of(objective, level, gap, bound, certificate.wanted_gap)
    found = replace(certificate, objective=objective, bound=bound, gap=gap, verdict=verdict, stationarity=stationarity)
    return replace(
        solution,
        problem=problem,
        poses=poses,
        objective=objective,
        certificate=found,
        status=status,
        stages=(*solution.stages, *(replace(Stage.of(r), objective=model.cost(r.poses.stacked())) for r in runs)),
        seconds=time.perf_counter() - watch.began,
        note=f"the bound leaves out {', '.join(left_out)}",
        frame="that of the added terms",
    )
