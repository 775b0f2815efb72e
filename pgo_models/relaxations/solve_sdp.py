"""solve_relaxation: pose the semidefinite relaxation, solve it, round it, and prove the bound that its duals give."""

import enum
import math
import time
from dataclasses import dataclass

import cvxpy as cp

from pgo_models.certificates.certificate import BoundSource, Certificate, Verdict, certify_with, gap_text
from pgo_models.convex.convex_solver import ConvexSolver
from pgo_models.errors import PGOError, SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.problem.problem import PGOProblem
from pgo_models.relaxations.clique_decomposition import CliqueRelaxation, clique_relaxation
from pgo_models.relaxations.plan import DEFAULT_MEMORY_LIMIT, RelaxationForm, RelaxationPlan, plan_relaxation
from pgo_models.relaxations.primal_dual import DualRelaxation, PrimalRelaxation, dual_relaxation, primal_relaxation
from pgo_models.relaxations.rounding import RankReport

DEFAULT_RELAXATION_GAP = 1e-5
TOLERANCE = 1e-10

Relaxation = PrimalRelaxation | DualRelaxation | CliqueRelaxation


class RelaxationStatus(enum.Enum):
    """How the solver ended."""

    OPTIMAL = "solved to the solver's tolerance"
    INACCURATE = "stopped where rounding lets it go no further, short of tolerance; the bound is proven all the same"
    LIMIT = "stopped by its limit of time or iterations; the bound is proven all the same, but may be wide"


@dataclass(frozen=True, eq=False)
class RelaxationSolution:
    """What the relaxation says of a pose graph.

    The certificate is of the rounded poses, with multipliers from the duals: its bound holds whatever the solver did.
    """

    relaxation: Relaxation  # the model with its variables and duals as solved
    plan: RelaxationPlan
    status: RelaxationStatus
    value: float  # optimal value as the solver reports it: evidence, not a bound
    certificate: Certificate
    rank: RankReport
    iterations: int
    seconds: float  # from posing to proof

    @property
    def poses(self) -> Poses:
        """Rounded."""
        return self.certificate.poses

    @property
    def objective(self) -> float:
        """F of the rounded poses."""
        return self.certificate.objective

    @property
    def lower_bound(self) -> float:
        """Proven: F of no poses is below it."""
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
        lines = [
            f"relaxation   {self.plan}",
            f"status       {self.status.name}: {self.status.value}",
            f"effort       {self.iterations} iterations, {self.seconds:.3g} s",
            f"F rounded    {self.objective:.10g}",
            f"lower bound  {self.lower_bound:.10g}   (solver: {self.value:.10g}; eta = {self.certificate.eta:.3g})",
            f"gap          {gap_text(self.gap)}   (asked for: {self.certificate.wanted_gap:.3g})",
            f"rank         {self.rank}",
            f"verdict      {self.verdict.name}: {self.verdict.value}",
        ]
        return "\n".join(lines)


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

    Form and solver, any of cvxpy that takes semidefinite cones, are chosen by `plan_relaxation` unless given. The
    relative `gap` is for the verdict; where the proof needs a shift eta, the smallest that is tried follows from it.
    An estimate above `memory_limit`, in bytes, is refused before anything is formed; `time_limit`, in seconds, is for
    the solver. With `verbose`, the plan with its reason, the solver's table, and the result are printed.

    A SettingError when a limit or the gap is not positive, or memory would not do; a PGOError when there is no iterate.

    Examples
    --------
    >>> from pgo_models.graphs.datasets import load
    >>> solution = solve_relaxation(PGOProblem(load("circle")))
    >>> solution.status.name, solution.verdict.name, solution.rank.rank
    ('OPTIMAL', 'CERTIFIED', 3)
    """
    for name, given in (("gap", gap), ("time_limit", time_limit)):
        if not given > 0 or (name == "gap" and math.isinf(given)):
            raise SettingError(f"{name} is {given}; it must be positive, the gap finite")
    problem.check_quadratic("the relaxation")
    began = time.perf_counter()
    plan = plan_relaxation(problem, form, solver, memory_limit)
    if verbose:
        print(plan)
    if plan.form is RelaxationForm.CLIQUES:
        relaxation: Relaxation = clique_relaxation(problem, tree=plan.tree)
    else:
        relaxation = primal_relaxation(problem) if plan.form is RelaxationForm.PRIMAL else dual_relaxation(problem)
    status = _solve(relaxation.model, plan.solver, time_limit, verbose)
    poses, rank = relaxation.rounded()
    certificate = certify_with(problem, poses, relaxation.Lambda(), gap, math.nan, BoundSource.RELAXATION, ground=poses)
    value, iterations = float(relaxation.model.value) * relaxation.scale, relaxation.model.solver_stats.num_iters or 0
    seconds = time.perf_counter() - began
    solution = RelaxationSolution(relaxation, plan, status, value, certificate, rank, int(iterations), seconds)
    if verbose:
        print(solution)
    return solution


def _solve(model: cp.Problem, solver: ConvexSolver, time_limit: float, verbose: bool) -> RelaxationStatus:
    try:
        solver.run(model, TOLERANCE, time_limit=time_limit, verbose=verbose)
    except cp.SolverError as error:
        raise PGOError(f"{solver.name} failed on the relaxation: {error}; try another solver or form") from error
    if model.value is None or not math.isfinite(model.value):
        ended = f"{solver.name} ended with status {model.status} on the relaxation and gave no iterate"
        raise PGOError(f"{ended}; raise time_limit, or try another solver or form")
    if model.status == cp.OPTIMAL:
        return RelaxationStatus.OPTIMAL
    # SCS calls inaccurate what its limits stopped.
    stalled = model.status == cp.OPTIMAL_INACCURATE and not solver.is_first_order
    return RelaxationStatus.INACCURATE if stalled else RelaxationStatus.LIMIT
