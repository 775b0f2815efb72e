"""solve_relaxation: pose the semidefinite relaxation, solve it, round it, and prove its bound."""

import enum
import math
import time
from dataclasses import dataclass, replace

import cvxpy as cp

from pgo_models.certificates.certificate import BoundSource, Certificate, Verdict, certify_with
from pgo_models.convex.convex_solver import ConvexSolver
from pgo_models.errors import PGOError, SettingError, door
from pgo_models.figures import rounded_up
from pgo_models.geometry.poses import Poses
from pgo_models.problem.problem import PGOProblem
from pgo_models.relaxations.clique_decomposition import CliqueRelaxation, clique_relaxation
from pgo_models.relaxations.hull_models import (
    DualHullRelaxation,
    PrimalHullRelaxation,
    dual_hull_relaxation,
    primal_hull_relaxation,
)
from pgo_models.relaxations.plan import (
    DEFAULT_MEMORY_LIMIT,
    RelaxationForm,
    RelaxationPlan,
    plan_relaxation,
)
from pgo_models.relaxations.primal_dual import (
    DualRelaxation,
    PrimalRelaxation,
    dual_relaxation,
    primal_relaxation,
)
from pgo_models.relaxations.rounding import RankReport
from pgo_models.summaries import Summarised

DEFAULT_RELAXATION_GAP = 1e-5
TOLERANCE = 1e-10

# The relaxations with hulls are subclasses of the first two.
Relaxation = PrimalRelaxation | DualRelaxation | CliqueRelaxation


class RelaxationStatus(enum.Enum):
    """How the solver ended."""

    OPTIMAL = "solved to the solver's tolerance"
    INACCURATE = (
        "stopped where rounding lets it go no further, short of tolerance; "
        "the bound is proven all the same"
    )
    LIMIT = (
        "stopped by its limit of time or iterations; "
        "the bound is proven all the same, but may be wide"
    )


@dataclass(frozen=True, eq=False)
class RelaxationSolution(Summarised):
    """Rounded poses, a proven bound, and how the relaxation was solved.

    Parameters
    ----------
    relaxation : PrimalRelaxation, DualRelaxation or CliqueRelaxation
        The model with its variables and duals as solved.
    plan : RelaxationPlan
        Form and solver.
    status : RelaxationStatus
        How the solver ended.
    value : float
        Optimal value as the solver reports it: evidence, not a bound.
    certificate : Certificate
        Of the rounded poses, with multipliers from the duals: its bound holds whatever the solver
        did.
    rank : RankReport
        Rank of the solution.
    iterations : int
        Of the solver.
    seconds : float
        From posing to proof.
    """

    relaxation: Relaxation
    plan: RelaxationPlan
    status: RelaxationStatus
    value: float
    certificate: Certificate
    rank: RankReport
    iterations: int
    seconds: float

    @property
    def poses(self) -> Poses:
        """The rounded poses."""
        return self.certificate.poses

    @property
    def objective(self) -> float:
        """F of the rounded poses."""
        return self.certificate.objective

    @property
    def lower_bound(self) -> float:
        """The proven bound: F of no poses is below it."""
        return self.certificate.lower_bound

    @property
    def gap(self) -> float:
        """(objective - lower_bound) / objective of the rounded poses."""
        return self.certificate.gap

    @property
    def verdict(self) -> Verdict:
        """What the bound says of the rounded poses."""
        return self.certificate.verdict

    def __str__(self) -> str:
        certificate = self.certificate
        eta = rounded_up(certificate.eta, 3)
        lines = [
            f"relaxation   {self.plan}",
            f"status       {self.status.name}: {self.status.value}",
            f"effort       {self.iterations} iterations, {self.seconds:.3g} s",
            f"{f'{certificate.cost} rounded':<12} {certificate.cost_text}",
            f"lower bound  {certificate.bound_text}   (solver: {self.value:.10g}; eta = {eta})",
            f"gap          {certificate.gap_text}   (asked for: {certificate.wanted_gap:.3g})",
            f"rank         {self.rank}",
            f"verdict      {certificate.verdict_text}",
        ]
        return "\n".join(lines)


@door
def solve_relaxation(
    problem: PGOProblem,
    form: RelaxationForm | None = None,
    solver: ConvexSolver | str | None = None,
    *,
    gap: float = DEFAULT_RELAXATION_GAP,
    memory_limit: float = DEFAULT_MEMORY_LIMIT,
    time_limit: float = math.inf,
    verbose: bool = False,
) -> RelaxationSolution:
    """Solve the semidefinite relaxation of a pose graph.

    Parameters
    ----------
    problem : PGOProblem
        The problem; its cost must be quadratic in the poses.
    form : RelaxationForm or None
        How the relaxation is posed; chosen by the sizes of its cones unless given.
    solver : ConvexSolver, str or None
        A solver of cvxpy that takes semidefinite cones; chosen with the form unless given.
    gap : float
        Relative gap for the verdict. Where the proof needs a shift eta, the smallest that is tried
        follows from it.
    memory_limit : float, in bytes
        An estimate above it is refused before anything is formed.
    time_limit : float, in seconds
        For the solver.
    verbose : bool
        Whether the plan with its reason, the solver's table, and the result are printed.

    Returns
    -------
    RelaxationSolution
        The rounded poses with their certificate.

    Raises
    ------
    SettingError
        If a limit or the gap is not positive, the cost is not quadratic, or the memory limit is
        exceeded.
    PGOError
        If the solver gives no iterate.

    References
    ----------
    Rosen, Carlone, Bandeira & Leonard, SE-Sync, 2019.

    Examples
    --------
    >>> from pgo_models.graphs.datasets import load
    >>> solution = solve_relaxation(PGOProblem(load("circle")))
    >>> solution.status.name, solution.verdict.name, solution.rank.rank
    ('OPTIMAL', 'CERTIFIED', 3)
    """
    if not 0 < gap < math.inf:
        raise SettingError(f"gap is {gap}; it must be positive, the gap finite")
    if not time_limit > 0:
        raise SettingError(f"time_limit is {time_limit}; it must be positive, the gap finite")
    problem.check_quadratic("the relaxation")
    began = time.perf_counter()
    plan = plan_relaxation(problem, form, solver, memory_limit)
    if verbose:
        print(plan)
    solution = _solve_posed(problem, plan, None, gap, time_limit, verbose)
    if plan.form is RelaxationForm.CLIQUES and not solution.certificate.is_certified:
        # Cliques lose digits where their centre is far from the optimum: once more around the poses
        # that were found, in the time that is left.
        seconds_left = time_limit - (time.perf_counter() - began)
        if seconds_left > 0:
            centre = solution.poses
            again = _solve_posed(problem, plan, centre, gap, seconds_left, verbose)
            solution = max(solution, again, key=lambda found: found.lower_bound)
    solution = replace(solution, seconds=time.perf_counter() - began)
    if verbose:
        print(solution)
    return solution


def _solve_posed(
    problem: PGOProblem,
    plan: RelaxationPlan,
    centre: Poses | None,
    gap: float,
    time_limit: float,
    verbose: bool,
) -> RelaxationSolution:
    """Pose the relaxation, that over cliques around a centre, solve it, round it and prove it."""
    began = time.perf_counter()
    relaxation = _posed(problem, plan, centre)
    status = _solve(relaxation.model, plan.solver, time_limit, verbose)
    poses, rank = relaxation.rounded()
    terms = None
    source = BoundSource.RELAXATION
    if isinstance(relaxation, PrimalHullRelaxation | DualHullRelaxation):
        terms = relaxation.terms()
        source = BoundSource.HULLS
    certificate = certify_with(
        problem,
        poses,
        relaxation.Lambda(),
        gap,
        math.nan,
        source,
        ground=poses,
        terms=terms,
    )
    value = float(relaxation.model.value) * relaxation.scale
    iterations = int(relaxation.model.solver_stats.num_iters or 0)
    seconds = time.perf_counter() - began
    return RelaxationSolution(
        relaxation, plan, status, value, certificate, rank, iterations, seconds
    )


def _posed(problem: PGOProblem, plan: RelaxationPlan, centre: Poses | None) -> Relaxation:
    if plan.form is RelaxationForm.CLIQUES:
        return clique_relaxation(problem, centre, plan.tree)
    if plan.form is RelaxationForm.PRIMAL:
        return primal_relaxation(problem)
    if plan.form is RelaxationForm.HULL:
        return primal_hull_relaxation(problem)
    if plan.form is RelaxationForm.HULL_DUAL:
        return dual_hull_relaxation(problem)
    return dual_relaxation(problem)


def _solve(
    model: cp.Problem, solver: ConvexSolver, time_limit: float, verbose: bool
) -> RelaxationStatus:
    try:
        solver.run(model, TOLERANCE, time_limit=time_limit, verbose=verbose)
    except cp.SolverError as error:
        raise PGOError(
            f"{solver.name} failed on the relaxation: {error}; try another solver or form"
        ) from error
    if model.value is None or not math.isfinite(model.value):
        raise PGOError(
            f"{solver.name} ended with status {model.status} on the relaxation and gave no "
            "iterate; raise time_limit, or try another solver or form"
        )
    if model.status == cp.OPTIMAL:
        return RelaxationStatus.OPTIMAL
    # SCS calls inaccurate what its limits stopped.
    if model.status == cp.OPTIMAL_INACCURATE and not solver.is_first_order:
        return RelaxationStatus.INACCURATE
    return RelaxationStatus.LIMIT
