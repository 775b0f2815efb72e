"""Certificate: poses held against a lower bound on the global optimum that holds in exact arithmetic.

The bound and its proof are in `pgo_models.certificates.lower_bound`; here it is decided where to find it, and what it
says of poses. gap = (F - lower_bound) / F: neither the units nor the number of measurements change it.
"""

import enum
import math
from dataclasses import dataclass, replace

from pgo_models.certificates.dual_variables import multipliers
from pgo_models.certificates.lower_bound import NO_BOUND, LowerBound, best_bound
from pgo_models.certificates.newton_polish import STATIONARY_DECREMENT, polish, relative_decrement
from pgo_models.certificates.rounding_errors import ObjectiveRounding, objective_rounding, rounding_level
from pgo_models.certificates.tangent import softened_bound
from pgo_models.errors import ProofError, SettingError
from pgo_models.geometry.arrays import ReadOnly, real_array
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.residuals import check_poses
from pgo_models.html_tables import facts_table
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem, as_problem
from pgo_models.problem.weighting import Weighting

DEFAULT_GAP = 1e-6


class Verdict(enum.Enum):
    """What the certificate says of the poses."""

    CERTIFIED = "globally optimal within the gap asked for"
    EXACT = "globally optimal, exact to rounding: F cannot be told from zero"
    NOT_CERTIFIED = "not shown to be optimal: the bound holds, but the gap is wider than asked for"
    TRIVIAL = "not shown to be optimal: no bound better than zero was found"


class BoundSource(enum.Enum):
    """Where the multipliers of the bound were taken."""

    GIVEN = "at the poses given"
    POLISHED = "after polishing the poses given, which were not stationary"
    CHORDAL = "at the point that the chordal start polishes to, better than the one beside the poses given"
    RELAXATION = "where the staircase solved the semidefinite relaxation, whose optimum is below F if it is not tight"
    SOFTENED = "where smaller information matrices, whose cost is below chi2 at all poses, have their minimum"


@dataclass(frozen=True, eq=False)
class Certificate(ReadOnly):
    """A proven lower bound on the global optimum beside the cost of given poses.

    `objective` is F of the given poses, or chi2, as `weighting` says; `bound` is proven: F(R, t) >= bound.value for all
    poses, in exact arithmetic; `gap` is (objective - lower_bound) / objective, 0 where F is at its `rounding_level`,
    below which it cannot be told from zero (`objective_rounding`). `stationarity` is half the squared Newton decrement
    of the given poses, over F: about the relative decrease of F down to the stationary point beside them.

    The bound was found at `poses`, where F is `poses_objective`, the best value known; `source` says how these poses
    were come by. The multipliers `Lambda`, (n, d, d), are with eta and the poses the proof: anyone can check it with
    `prove_bound`; those of `BoundSource.SOFTENED` are of the smaller matrices. `verdict` is for the gap `wanted_gap`.
    """

    objective: float
    bound: LowerBound
    gap: float
    rounding_level: float
    stationarity: float
    source: BoundSource
    poses: Poses
    poses_objective: float
    Lambda: Array
    wanted_gap: float
    verdict: Verdict
    weighting: Weighting = Weighting.ISOTROPIC

    def __post_init__(self) -> None:
        object.__setattr__(self, "Lambda", real_array(self.Lambda, "Lambda", SettingError))

    @property
    def lower_bound(self) -> float:
        """Proven: F(R, t) >= lower_bound for every choice of poses."""
        return self.bound.value

    @property
    def eta(self) -> float:
        """Shift of the proof: 0 where the certificate grounded at a pose needs none, nan when only F >= 0 is left."""
        return self.bound.eta

    @property
    def is_best_in_doubles(self) -> bool:
        """Whether S_r is definite and the gap below 1e-6: a smaller one takes precision, not other poses."""
        return self.bound.is_grounded and self.eta == 0.0 and self.gap <= DEFAULT_GAP

    @property
    def can_improve(self) -> bool:
        """Whether other poses, or multipliers of another rank, could give what was asked for."""
        return not (self.is_certified or self.is_best_in_doubles or self.bound.is_definite)

    @property
    def digits(self) -> int:
        """Digits of F that are proven: those in which it agrees with the bound."""
        return proven_digits(self.gap)

    @property
    def is_certified(self) -> bool:
        """Whether the gap is within the one asked for, or F exact to rounding."""
        return self.verdict in (Verdict.CERTIFIED, Verdict.EXACT)

    def __repr__(self) -> str:
        return f"Certificate({self.cost}={self.objective:.10g}, gap={self.gap:.3g}, {self.verdict.name})"

    def __str__(self) -> str:
        return "\n".join(f"{label:<12} {text}" for label, text in self.facts())

    def _repr_html_(self) -> str:
        return facts_table(self.facts())

    def facts(self) -> list[tuple[str, str]]:
        """Labels and figures, as they are printed."""
        measured = not math.isnan(self.stationarity)
        stationary = f"   (stationary to {self.stationarity:.2g})" if measured else ""
        facts = [
            (self.cost, f"{self.objective:.10g}{stationary}"),
            ("lower bound", f"{self.lower_bound:.10g}   ({self.proof}; {self.source.value})"),
            ("gap", f"{gap_text(self.gap)}   (asked for: {self.wanted_gap:.3g})"),
            ("verdict", f"{self.verdict.name}: {self.verdict.value}"),
        ]
        if self.source is not BoundSource.GIVEN:
            facts.insert(1, (f"best known {self.cost}", f"{self.poses_objective:.10g}"))
        return facts

    @property
    def cost(self) -> str:
        """Name of the cost, as it is printed."""
        return "chi2" if self.weighting is Weighting.INFORMATION else "F"

    @property
    def proof(self) -> str:
        """How the bound was proved, in a few words."""
        if math.isnan(self.eta):
            why = "; S_r is definite in doubles, by less than rounding can take" if self.bound.is_definite else ""
            return f"{self.cost} is never negative{why}"
        form = "grounded at a pose" if self.bound.is_grounded else "with a shift"
        shift = f", eta = {self.eta:.3g}" if self.eta > 0 else ""
        cap = f", conditions cut to {self.bound.cap:.3g}" if self.bound.cap < math.inf else ""
        return f"proved {form}{shift}{cap}, less {self.bound.rounding:.2g} for rounding"


def proven_digits(gap: float) -> int:
    """Digits of F that a relative gap leaves no doubt of; none where it is 0, as F is rounding then."""
    return max(0, math.floor(-math.log10(gap))) if gap > 0 else 0


def gap_text(gap: float) -> str:
    """A relative gap for tables, with the digits that it proves."""
    if gap == 0.0:
        return "0: F is at its rounding level"
    digits = proven_digits(gap)
    return f"{gap:.3g}, proven to {digits} digits" if digits > 3 else f"{gap:.3g}"


def certify(problem: PGOProblem | PoseGraph, poses: Poses, gap: float = DEFAULT_GAP) -> Certificate:
    """Judge anybody's poses: a proven lower bound on the global optimum, and how far F is above it.

    The bound is found at a stationary point. Poses that are not stationary are polished first (damped Newton,
    `polish`); where that point does not give the gap, the one that the chordal start polishes to is tried, and the
    better bound is taken. `source` says what was done; the gap is always that of the poses given. `certify_at` bounds
    at the poses as they are. Of a problem with `Weighting.INFORMATION` all of this is chi2 instead of F, bounded by its
    tangent at the stationary point, and where that fails by smaller information matrices (`softened_bound`).

    A SettingError unless gap, the relative one to certify, is positive and finite; a GraphError when poses do not fit.

    Examples
    --------
    >>> import numpy as np
    >>> from pgo_models.graphs.scenes import grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> certificate = certify(problem, chordal_start(problem))
    >>> certificate
    Certificate(F=118.6633297, gap=0.182, NOT_CERTIFIED)
    >>> certificate.source.name, bool(0 < certificate.lower_bound <= certificate.poses_objective)
    ('POLISHED', True)
    """
    problem = as_problem(problem)
    stationarity = relative_decrement(problem, poses)
    if stationarity <= STATIONARY_DECREMENT and problem.is_quadratic:
        certificate = certify_at(problem, poses, gap, stationarity)
    else:
        polished = certify_at(problem, polish(problem, poses), gap, stationarity)
        certificate = judge(problem, poses, replace(polished, source=BoundSource.POLISHED))
    if not _bound_is_tight(certificate):
        start = polish(problem.convex_part, chordal_start(problem.convex_part))
        other = certify_at(problem, polish(problem, start), gap, stationarity)
        # Of equal bounds, as two zeros, the one with the better poses.
        if (other.lower_bound, -other.poses_objective) > (certificate.lower_bound, -certificate.poses_objective):
            certificate = judge(problem, poses, replace(other, source=BoundSource.CHORDAL))
        certificate = soften(problem, certificate)
    return certificate


def certify_at(
    problem: PGOProblem, poses: Poses, gap: float = DEFAULT_GAP, stationarity: float = math.nan
) -> Certificate:
    """Certificate from the multipliers at the poses as they are: valid anywhere, and sharp near an optimum.

    `stationarity`, the relative decrement there, is reported as it is; nan where not measured. Errors as of `certify`.

    Examples
    --------
    >>> import numpy as np
    >>> from pgo_models.graphs.scenes import grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> certificate = certify_at(problem, polish(problem, chordal_start(problem), max_steps=3))
    >>> bool(0.9 * certificate.objective < certificate.lower_bound <= certificate.objective)
    True
    """
    check_poses(problem.graph, poses)
    best = poses if stationarity <= STATIONARY_DECREMENT else problem.at_best_translations(poses)
    return certify_with(problem, poses, multipliers(problem, best), gap, stationarity, BoundSource.GIVEN, ground=best)


def soften(problem: PGOProblem, certificate: Certificate) -> Certificate:
    """The certificate, or where it grants but a loose bound on chi2 the better one of `softened_bound`."""
    if problem.weighting is not Weighting.INFORMATION or _bound_is_tight(certificate):
        return certificate
    bound, _, Lambda = softened_bound(problem, certificate.poses)
    if bound.value <= certificate.lower_bound:
        return certificate
    softer = replace(certificate, bound=bound, Lambda=Lambda, source=BoundSource.SOFTENED)
    return judge_cost(problem, softer, certificate.objective, objective_rounding(problem, certificate.poses))


def certify_with(
    problem: PGOProblem,
    poses: Poses,
    Lambda: Array,
    gap: float,
    stationarity: float,
    source: BoundSource,
    bound: LowerBound | None = None,
    ground: Poses | None = None,
) -> Certificate:
    """Certificate of poses with multipliers from anywhere: the proof asks nothing of them.

    Unless a bound is given that was proved with these multipliers already, it is found here, grounded at one of the
    poses `ground`: the given ones with their best translations, unless given. A SettingError when gap is not positive
    and finite, or Lambda has the wrong shape.
    """
    if not 0 < gap < math.inf:
        raise SettingError(f"gap is {gap}; give a positive relative gap, as 1e-6")
    objective, rounding = problem.objective(poses), objective_rounding(problem, poses)
    if bound is None:
        is_exact = objective <= rounding.level
        ground = ground if ground is not None else problem.at_best_translations(poses)
        tangent = problem.tangent_at(ground)
        bound = NO_BOUND if is_exact else best_bound(tangent, Lambda, ground, gap, objective)
    weighting = problem.weighting if isinstance(problem.weighting, Weighting) else Weighting.ISOTROPIC
    figures = objective, bound, math.nan, rounding.level, stationarity  # the gap comes with the verdict
    unjudged = Certificate(*figures, source, poses, objective, Lambda, gap, Verdict.TRIVIAL, weighting)
    return judge_cost(problem, unjudged, objective, rounding)


def judge(problem: PGOProblem, poses: Poses, certificate: Certificate) -> Certificate:
    """Hold other poses of the same problem against the bound of a certificate.

    A ProofError when F of the poses is below it by more than the rounding of F: then one of the two is wrong.
    """
    F = problem.objective(poses)
    is_below = certificate.lower_bound < F  # then nobody asks for the error of F, which takes longer than F
    level = ObjectiveRounding(rounding_level(problem, poses), 0.0)
    rounding = level if is_below else objective_rounding(problem, poses)
    return judge_cost(problem, certificate, F, rounding)


def judge_cost(problem: PGOProblem | str, given: Certificate, F: float, rounding: ObjectiveRounding) -> Certificate:
    """The given certificate of poses that cost F instead, held against its bound; errors as of `judge`."""
    bound, level = given.bound, rounding.level
    if bound.value > F + rounding.error:
        above = f"lower bound {bound.value!r} is above F = {F!r} of {problem!r}, which is known to {rounding.error:.2g}"
        raise ProofError(f"{above}: a defect of pgo_models; please report it with the graph")
    # F may come out below a true bound by its own rounding, which is then what the gap is known to.
    gap = relative_gap(F, bound.value if bound.value < F else F - rounding.error, level)
    bound = replace(bound, value=min(bound.value, F))
    verdict = verdict_of(F, level, gap, bound, given.wanted_gap)
    return replace(given, objective=F, bound=bound, gap=gap, rounding_level=level, verdict=verdict)


def verdict_of(objective: float, level: float, gap: float, bound: LowerBound, wanted_gap: float) -> Verdict:
    """Verdict on poses: F, its rounding level, their gap, and the bound."""
    if objective <= level:
        return Verdict.EXACT
    if math.isnan(bound.eta):
        return Verdict.TRIVIAL
    return Verdict.CERTIFIED if gap <= wanted_gap else Verdict.NOT_CERTIFIED


def relative_gap(objective: float, lower_bound: float, rounding_level: float = 0.0) -> float:
    """(objective - lower_bound) / objective; 0 where F is at its rounding level, 1 where it overflows."""
    if not math.isfinite(objective):
        return 1.0
    return (objective - lower_bound) / objective if objective > rounding_level else 0.0


def _bound_is_tight(certificate: Certificate) -> bool:
    F, level = certificate.poses_objective, certificate.rounding_level
    return relative_gap(F, certificate.lower_bound, level) <= certificate.wanted_gap
