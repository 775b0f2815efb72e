"""solve() of F with convex terms and constraints of one's own.

Priors are certified, and the note of the solution says which terms the bound leaves out.
"""

import math
import time
from dataclasses import dataclass, replace

import cvxpy as cp

from pgo_models.certificates.certificate import Certificate, relative_gap, verdict_of
from pgo_models.certificates.lower_bound import NO_BOUND
from pgo_models.certificates.rounding_errors import fits_to_rounding
from pgo_models.convex.graph_subproblem import GraphQP, ModelChange
from pgo_models.errors import SettingError
from pgo_models.figures import scaled_above, scaled_below
from pgo_models.geometry.poses import Poses
from pgo_models.problem.problem import PGOProblem
from solvers.convex.extended_newton import ExtendedNewton, kinks
from solvers.convex.extended_soc import ExtendedSOC, with_priors
from solvers.loop import RunMonitor
from solvers.result import Stage
from solvers.riemannian.newton import Newton
from solvers.robust_solves.attempts import SolveOnce
from solvers.solution import Solution, note_of_coupling
from solvers.stages import Answer, Job


def solve_extended(
    problem: PGOProblem,
    soc: ExtendedSOC,
    newton: Newton,
    start: Poses | None,
    monitor: RunMonitor,
    solve_once: SolveOnce,
    asked: list[str],
) -> Solution:
    """Solution of F with the terms and constraints that an ExtendedSOC adds.

    Terms that are priors go into the graph, which `solve_once` solves. With priors alone that is
    the solution, of the graph with them, whose last pose is the world.

    Else the poses are those of ExtendedSOC and, where that leaves all terms smooth and there are no
    constraints, of ExtendedNewton. The objective has all terms. The bound leaves out what the note
    says: terms that are never negative, and constraints, which can only raise the optimum. Where
    edges are replaced there is no bound.

    A SettingError where a term may be negative, and where options of `solve_once` are `asked` for,
    robots or robust, that go with priors alone.
    """
    model = soc.model(problem)
    graph, other_terms = with_priors(model)
    left_out = _left_out(model.change, other_terms)
    if not all(term.is_nonneg() for term in other_terms):
        raise SettingError(
            "a term may be negative, so there is no bound; "
            "use solvers.run(ExtendedSOC(..), problem)"
        )
    if left_out and asked:
        raise SettingError(
            f"{' and '.join(asked)} go with priors alone, and there are {left_out[0]}; "
            "leave that out"
        )
    with_known_priors = PGOProblem(graph, problem.backend, problem.weighting)
    known_start = None if start is None else graph.completed(start)
    solution = solve_once(with_known_priors, start=known_start, time_limit=monitor.left)
    if not left_out:
        return solution
    job = Job(problem, solution.certificate.wanted_gap, monitor, list(solution.stages))
    answer = Answer(solution.poses, decrement=math.nan)
    if not job.is_out_of_time:
        answer = RunWithTerms(job, model, soc).run(Answer(start))
    rough = _atoms_with_kinks(model, answer.current_poses)
    if rough:
        left_out[-1] += (
            "; SOC is the last stage, as Newton needs smooth terms alone, "
            f"and there are {', '.join(rough)}"
        )
    elif not job.is_out_of_time:
        second = ExtendedNewton(soc.changer, newton.tolerance, newton.max_iterations)
        answer = RunWithTerms(job, model, second).run(answer)
    certificate = _certificate_with_terms(
        solution.certificate, model, answer, with_known_priors, is_F=not other_terms
    )
    notes = [note_of_coupling(problem), f"the bound leaves out {', '.join(left_out)}"]
    return replace(
        solution,
        problem=problem,
        poses=answer.current_poses,
        objective=certificate.objective,
        certificate=certificate,
        status=job.status,
        stages=tuple(job.stages),
        seconds=time.perf_counter() - monitor.began,
        note="; ".join(note for note in notes if note),
        frame="that of the added terms",
    )


@dataclass(frozen=True, eq=False)
class RunWithTerms:
    """SOC or Newton with added terms; the objective of the stage has all of them."""

    job: Job
    model: GraphQP
    method: ExtendedSOC | ExtendedNewton

    @property
    def name(self) -> str:
        """Name of the method."""
        return type(self.method).__name__

    def run(self, answer: Answer) -> Answer:
        """Return the poses of the method, from the given ones or from its own start."""
        job = self.job
        decrement = math.nan
        if isinstance(self.method, ExtendedNewton):
            second = job.monitor.run(self.method, job.problem, answer.poses)
            stage = Stage.of(second)
            poses = second.poses
            decrement = second.state.decrement
        else:
            first = job.monitor.run(self.method, job.problem, answer.poses)
            stage = Stage.of(first)
            poses = first.poses
        objective = self.model.cost(poses.stacked())
        job.stages.append(replace(stage, objective=objective))
        return Answer(poses, decrement=decrement)


def _left_out(change: ModelChange, terms: list[cp.Expression]) -> list[str]:
    """What the bound leaves out, and of each how many: terms, constraints and replaced edges."""
    name = "terms other than tau ||t - p||^2 and kappa ||R - P||_F^2"
    counts = {
        name: len(terms),
        "constraints": len(change.constraints),
        "replaced edges": len(change.replaced_edges),
    }
    return [f"{name} ({count})" for name, count in counts.items() if count]


def _atoms_with_kinks(model: GraphQP, poses: Poses) -> list[str]:
    """Names of what Newton cannot take at these poses: atoms that have a kink, and constraints."""
    model.variables.X.value = poses.stacked()
    names = {"constraints"} if model.change.constraints else set[str]()
    for term in model.change.terms:
        names |= kinks(term)
    return sorted(names)


def _certificate_with_terms(
    certificate: Certificate, model: GraphQP, answer: Answer, priors: PGOProblem, is_F: bool
) -> Certificate:
    """Certificate of poses whose objective has all terms.

    `certificate` bounds the problem with the `priors` alone. `is_F` says whether there are no other
    terms. Nothing is known of the rounding error of terms of one's own.
    """
    poses = answer.current_poses
    objective = model.cost(poses.stacked())
    has_replaced_edges = bool(model.change.replaced_edges)
    bound = NO_BOUND if has_replaced_edges else certificate.bound
    is_exact = False
    if is_F and not has_replaced_edges:
        is_exact = fits_to_rounding(priors, priors.graph.completed(poses))
    gap = relative_gap(
        scaled_above(objective, certificate.weights_error),
        scaled_below(bound.value, certificate.weights_error),
        is_exact,
    )
    return replace(
        certificate,
        objective=objective,
        objective_error=math.nan,
        bound=bound,
        gap=gap,
        verdict=verdict_of(is_exact, gap, bound, certificate.wanted_gap),
        stationarity=answer.decrement,
    )
