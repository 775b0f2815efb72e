"""solve_relaxation: pose the semidefinite relaxation, solve it, round it, and prove its bound."""

import enum
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import cvxpy as cp

from pgo_models.certificates.certificate import BoundSource, Certificate, Verdict, certify_with
from pgo_models.convex.convex_solver import ConvexSolver, as_solver
from pgo_models.errors import PGOError, SettingError
from pgo_models.figures import rounded_up
from pgo_models.geometry.poses import Poses
from pgo_models.problem.problem import PGOProblem
from pgo_models.relaxations.hull_models import DualHullRelaxation, dual_hull_relaxation
from pgo_models.relaxations.primal_dual import (
    DualRelaxation,
    PrimalRelaxation,
    dual_relaxation,
    primal_relaxation,
)
from pgo_models.relaxations.rounding import RankReport
from pgo_models.summaries import Summarised

# The verdict allows for what interior points leave; the tolerance of the solver is far below it.
DEFAULT_RELAXATION_GAP = 1e-5
TOLERANCE = 1e-10
# Sides up to which the dense primal is solved by SCS, which decomposes its cone at every iteration:
# sphere, with side 600, takes 1.1 s. Beyond, Clarabel decomposes the sparse dual over cliques.
LARGEST_DENSE_CONE = 1000

# The relaxation with hulls is a subclass of the dual.
Relaxation = PrimalRelaxation | DualRelaxation


class RelaxationForm(enum.Enum):
    """How the relaxation is posed."""

    PRIMAL = "min tr(Q Z), Z_ii = I, Z PSD: one dense cone, translations marginalised out"
    DUAL = "max tr(Lambda), M - blockdiag(0, Lambda) PSD: one sparse linear matrix inequality"
    HULL_DUAL = "DUAL, with a multiplier of the convex hull of SO(3) at every edge"


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
    form : RelaxationForm
        How the relaxation was posed.
    solver : ConvexSolver
        What solved it.
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

    form: RelaxationForm
    solver: ConvexSolver
    status: RelaxationStatus
    value: float
    certificate: Certificate
    rank: RankReport
    iterations: int
    seconds: float

    @property
    def poses(self) -> Poses:
        """Poses that `rounding` makes of the solution; the certificate judges them."""
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
            f"relaxation   {self.form.name} with {self.solver.name}",
            f"status       {self.status.name}: {self.status.value}",
            f"effort       {self.iterations} iterations, {self.seconds:.3g} s",
            f"{f'{certificate.cost} rounded':<12} {certificate.cost_text}",
            f"lower bound  {certificate.bound_text}   (solver: {self.value:.10g}; eta = {eta})",
            f"gap          {certificate.gap_text}   (asked for: {certificate.wanted_gap:.3g})",
            f"rank         {self.rank}",
            f"verdict      {certificate.verdict_text}",
        ]
        return "\n".join(lines)


def solve_relaxation(
    problem: PGOProblem,
    form: RelaxationForm | None = None,
    solver: ConvexSolver | str | None = None,
    *,
    gap: float = DEFAULT_RELAXATION_GAP,
    time_limit: float = math.inf,
    verbose: bool = False,
) -> RelaxationSolution:
    """Solve the semidefinite relaxation of a pose graph.

    Parameters
    ----------
    problem : PGOProblem
        The problem; its cost must be quadratic in the poses.
    form : RelaxationForm or None
        How the relaxation is posed. Unless given, PRIMAL for a first-order method where its cone
        has at most 1000 rows, and else DUAL.
    solver : ConvexSolver, str or None
        A solver of cvxpy that takes semidefinite cones. Unless given, SCS for PRIMAL and Clarabel
        for the others. An interior point on the dense cone of PRIMAL takes about 14 (d n)^4 bytes.
    gap : float
        Relative gap for the verdict. Where the proof needs a shift eta, the smallest that is tried
        follows from it.
    time_limit : float, in seconds
        For the solver.
    verbose : bool
        Whether the solver's table and the result are printed.

    Raises
    ------
    SettingError
        If the time limit or the gap is not positive, or the cost is not quadratic.
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
    form, solver = _form_and_solver(problem, form, solver)
    relaxation = _POSE[form](problem)
    status = _solve(relaxation.model, solver, time_limit, verbose)
    poses, rank = relaxation.rounded()
    terms = None
    source = BoundSource.RELAXATION
    if isinstance(relaxation, DualHullRelaxation):
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
    solution = RelaxationSolution(
        form, solver, status, value, certificate, rank, iterations, seconds
    )
    if verbose:
        print(solution)
    return solution


def _form_and_solver(
    problem: PGOProblem, form: RelaxationForm | None, solver: ConvexSolver | str | None
) -> tuple[RelaxationForm, ConvexSolver]:
    """Form and solver, where they are not given."""
    chosen = None if solver is None else as_solver(solver)
    if form is None:
        is_small = problem.d * problem.num_poses <= LARGEST_DENSE_CONE
        is_rough = chosen is None or chosen.is_first_order
        form = RelaxationForm.PRIMAL if is_small and is_rough else RelaxationForm.DUAL
    if chosen is None:
        chosen = ConvexSolver("SCS" if form is RelaxationForm.PRIMAL else "CLARABEL")
    return form, chosen


_POSE: dict[RelaxationForm, Callable[[PGOProblem], Relaxation]] = {
    RelaxationForm.PRIMAL: primal_relaxation,
    RelaxationForm.DUAL: dual_relaxation,
    RelaxationForm.HULL_DUAL: dual_hull_relaxation,
}


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
