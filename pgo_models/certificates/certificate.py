"""Certificate: poses held against a lower bound on the global optimum.

The bound holds in exact arithmetic.

The bound and its proof are in `pgo_models.certificates.lower_bound`; here it is decided where to
find it, and what it says of poses. gap = (F - lower_bound) / F: neither the units nor the number of
measurements change it.
"""

import enum
import math
from dataclasses import dataclass, replace

from pgo_models.certificates.definiteness import is_over
from pgo_models.certificates.dual_variables import multipliers, scalar_multipliers
from pgo_models.certificates.fit import NO_FIT, Fit
from pgo_models.certificates.handedness import HandednessTerms, closed_form_terms
from pgo_models.certificates.lower_bound import (
    NO_BOUND,
    LowerBound,
    best_bound,
    best_bound_with_terms,
    has_complex_form,
    less_terms,
    prove_at,
    prove_by_axes,
)
from pgo_models.certificates.polished import Polished
from pgo_models.certificates.rounding_errors import (
    ObjectiveRounding,
    rounding_of,
)
from pgo_models.errors import ProofError, SettingError
from pgo_models.figures import (
    gap_above,
    proven_digits,
    rounded_down,
    rounded_up,
    scaled_above,
    scaled_below,
    sum_above,
)
from pgo_models.geometry.arrays import ReadOnly, real_array
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.residuals import check_poses
from pgo_models.html_tables import facts_table
from pgo_models.problem.problem import PGOProblem, as_problem
from pgo_models.problem.stationarity import STATIONARY_DECREMENT
from pgo_models.problem.weighting import Weighting, name_of_cost

DEFAULT_GAP = 1e-6  # relative gap up to which a solution counts as certified, unless given


class Verdict(enum.Enum):
    """What the certificate says of the poses."""

    CERTIFIED = "globally optimal within the gap asked for"
    EXACT = "globally optimal: every edge fits as closely as its numbers can tell"
    NOT_CERTIFIED = "not shown to be optimal: the bound holds, but the gap is wider than asked for"
    TRIVIAL = "not shown to be optimal: no bound better than zero was found"


class BoundSource(enum.Enum):
    """Where the multipliers of the bound were taken."""

    GIVEN = "at the poses given"
    REFINED = "after polishing the poses given, which were stationary, to rounding"
    POLISHED = "after polishing the poses given, which were not stationary"
    CHORDAL = (
        "at the point that the chordal start polishes to, "
        "better than the one beside the poses given"
    )
    RELAXATION = (
        "where the staircase solved the semidefinite relaxation, "
        "whose optimum is below F if it is not tight"
    )
    HULLS = (
        "where the semidefinite relaxation with hulls of rotations was solved, "
        "whose optimum is below F if it is not tight"
    )
    COMPLEX = (
        "where the relaxation with rotations as complex numbers was solved, "
        "whose optimum is below F if it is not tight"
    )
    SOFTENED = (
        "where smaller information matrices, whose cost is below chi2 at all poses, "
        "have their minimum"
    )

    @property
    def is_of_relaxation(self) -> bool:
        """Whether the multipliers are those of a semidefinite relaxation as solved."""
        return self in (BoundSource.RELAXATION, BoundSource.HULLS, BoundSource.COMPLEX)


@dataclass(frozen=True, eq=False)
class Certificate(ReadOnly):
    """A proven lower bound on the global optimum beside the cost of given poses.

    `lower_bound` is proven: F(R, t) >= lower_bound for all poses, in exact arithmetic. Where the
    weights are inverses of the covariances of a file, that is F of the exact inverses. What is
    printed holds of the exact cost: `objective_at_most` rounded up, `lower_bound` rounded down, and
    `proven_gap` rounded up.

    Parameters
    ----------
    objective : float
        F of the given poses, or chi2, as `weighting` says, as computed.
    bound : LowerBound
        The proven bound.
    gap : float
        (objective - lower_bound) / objective, as computed; 0 where the poses fit to rounding.
    rounding_level : float
        F of poses whose residuals are as large as rounding can make each. Where the poses fit to
        rounding, F of them is at most four times that, in exact arithmetic (`fit_of`).
    stationarity : float
        Half the squared Newton decrement of the given poses, over F: about the relative decrease of
        F down to the stationary point beside them.
    source : BoundSource
        Where the poses come from at which the bound was proved.
    poses : Poses
        The poses at which the bound was proved.
    poses_objective : float
        F of these, the best value known.
    Lambda : (n, d, d) array
        Multipliers. With eta and these poses they are the proof, which `prove_bound` checks; its
        `is_complex` is that of the bound. A bound with `axes` needs these, too: its proof file has
        them. Those of `BoundSource.SOFTENED` belong to the smaller
        matrices.
    wanted_gap : float
        The gap that was asked for.
    verdict : Verdict
        What is proven of the given poses, for that gap.
    weighting : Weighting
        Which cost this is.
    objective_error : float
        Bound on the distance of the objective from the exact cost of the poses (of the rotations
        nearest to theirs); nan where none is known.
    has_translations : bool
        Whether this is said of poses; otherwise of rotations alone.
    fit : Fit
        How closely the poses fit every edge; the verdict is EXACT where that `is_exact`.
    weights_error : float
        The cost of the file is between 1 - weights_error and 1 + weights_error times that of the
        weights as they are stored (`PoseGraph.weights_error`), of which `objective` and `bound`
        are. `lower_bound`, `objective_at_most` and what follows from them count it.
    polished : Polished, optional
        How far the poses given are from those at which the bound was proved, which cost less;
        `certify` says so of poses that are not certified.
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
    objective_error: float = math.nan
    has_translations: bool = True
    fit: Fit = NO_FIT
    weights_error: float = 0.0
    polished: Polished | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "Lambda", real_array(self.Lambda, "Lambda", SettingError))

    @property
    def lower_bound(self) -> float:
        """Proven: F(R, t) >= lower_bound for every choice of poses."""
        return scaled_below(self.bound.value, self.weights_error)

    @property
    def eta(self) -> float:
        """Shift of the proof, nan when nothing better than F >= 0 is proven.

        It is 0 where the certificate grounded at a pose needs none.
        """
        return self.bound.eta

    @property
    def is_best_in_doubles(self) -> bool:
        """Whether S_r is definite and the gap below 1e-6, or below the one asked for.

        A smaller gap takes more precision, not other poses. What is not known of the weights does
        not count.
        """
        small = max(DEFAULT_GAP + 2.0 * self.weights_error, self.wanted_gap)
        return self.bound.is_grounded and self.eta == 0.0 and self.gap <= small

    @property
    def is_hidden_by_rounding(self) -> bool:
        """Whether nothing but rounding keeps the gap that was asked for from being proven.

        That of the bound, or that of the cost: then the gap as computed is the one asked for.
        """
        has_bound = not math.isnan(self.eta)
        is_close = has_bound and self.gap <= self.wanted_gap
        return not self.is_certified and (self.is_best_in_doubles or is_close)

    @property
    def can_improve(self) -> bool:
        """Whether other poses, or multipliers of another rank, could give what was asked for."""
        return not (self.is_certified or self.is_hidden_by_rounding or self.bound.is_definite)

    @property
    def digits(self) -> int:
        """Number of digits that are proven.

        It is the largest k with lower_bound >= (1 - 10^-k) objective_at_most, exactly.
        """
        return proven_digits(self.objective_at_most, self.lower_bound)

    @property
    def objective_at_most(self) -> float:
        """What the poses cost at most: the objective and the bound on its error.

        It is the objective as computed where no such bound is known.
        """
        return _cost_at_most(self.objective, self.objective_error, self.weights_error)

    @property
    def proven_gap(self) -> float:
        """What the gap of the exact cost is at most.

        No poses cost less than (1 - proven_gap) of what these do.

        (C - lower_bound) / C of C = objective_at_most, rounded up. It is 1 where nothing better
        than zero is known of the least cost, also of poses that fit every edge.
        """
        return gap_above(self.objective_at_most, self.lower_bound)

    @property
    def printed_gap(self) -> float:
        """The proven gap as tables show it: 0 of poses that fit to rounding, whose cost is none."""
        return 0.0 if self.fit.is_to_rounding else self.proven_gap

    @property
    def cost_text(self) -> str:
        """What the poses cost, as it is printed: rounded up."""
        return rounded_up(self.objective_at_most)

    @property
    def bound_text(self) -> str:
        """The lower bound as it is printed: rounded down."""
        return rounded_down(self.lower_bound)

    @property
    def gap_text(self) -> str:
        """The proven gap as it is printed, rounded up.

        From four digits on, it says how many are proven.
        """
        if self.fit.is_to_rounding:
            return "0: every edge fits to its rounding"
        text = rounded_up(self.proven_gap, 3)
        if self.fit.is_exact:
            return f"{text}, of a cost that {self.fit.cause} explain"
        return f"{text}, proven to {self.digits} digits" if self.digits > 3 else text

    @property
    def is_certified(self) -> bool:
        """Whether the gap is proven to be within the one asked for, or the poses are exact."""
        return self.verdict in (Verdict.CERTIFIED, Verdict.EXACT)

    def __repr__(self) -> str:
        gap = rounded_up(self.printed_gap, 3)
        return f"Certificate({self.cost}={self.cost_text}, gap={gap}, {self.verdict.name})"

    def __str__(self) -> str:
        return "\n".join(f"{label:<12} {text}" for label, text in self.facts())

    def _repr_html_(self) -> str:
        return facts_table(self.facts())

    def facts(self) -> list[tuple[str, str]]:
        """Return the figures as they are printed, with their labels.

        Returns
        -------
        list of (str, str)
            Pairs of a label and a figure.
        """
        measured = not math.isnan(self.stationarity)
        stationary = (
            f"   (a Newton step saves about {self.stationarity:.2g} of it)" if measured else ""
        )
        facts = [
            (self.cost, f"{self.cost_text}{stationary}"),
            ("lower bound", f"{self.bound_text}   ({self.proof}; {self.source.value})"),
            ("gap", f"{self.gap_text}   (asked for: {self.wanted_gap:.3g})"),
            ("verdict", self.verdict_text),
        ]
        if self.source is not BoundSource.GIVEN:
            best_known = rounded_up(self.poses_objective)
            if self.polished is not None:
                best_known += f"   ({self.polished.text})"
            facts.insert(1, (f"best known {self.cost}", best_known))
        if self.polished is not None and not math.isnan(self.polished.gtsam_cost):
            facts.append(("by GTSAM", self.polished.reason(self.stationarity, self.cost)))
        return facts

    @property
    def cost(self) -> str:
        """Name of the cost, as it is printed."""
        return name_of_cost(self.weighting, self.has_translations)

    @property
    def verdict_text(self) -> str:
        """The verdict as printed; a verdict on rotations alone says `rotations`."""
        subject = "" if self.has_translations else "rotations "
        return f"{self.verdict.name}: {subject}{self._verdict_sentence}"

    @property
    def _verdict_sentence(self) -> str:
        """What the verdict says, with how closely exact poses fit and what hides a gap."""
        if self.verdict is Verdict.EXACT and self.fit.is_exact:
            return f"globally optimal: {self.fit.text}"
        if self.verdict is Verdict.NOT_CERTIFIED and self.is_hidden_by_rounding:
            return f"{self.verdict.value}, and rounding in doubles leaves no smaller one"
        return self.verdict.value

    @property
    def proof(self) -> str:
        """How the bound was proved, in a few words."""
        if math.isnan(self.eta):
            why = (
                "; S_r is definite in doubles, by less than rounding can take"
                if self.bound.is_definite
                else ""
            )
            return f"{self.cost} is never negative{why}"
        form = "grounded at a pose" if self.bound.is_grounded else "with a shift"
        shift = f", eta = {rounded_up(self.eta, 3)}" if self.eta > 0 else ""
        cap = f", conditions cut to {self.bound.cap:.3g}" if self.bound.cap < math.inf else ""
        rounding = rounded_up(self.bound.rounding, 2)
        subtracted = f"less {rounding} for rounding"
        if self.weights_error > 0.0:
            subtracted += f" and {rounded_up(self.weights_error, 2)} of it for that of the weights"
        numbers = ", with rotations as complex numbers" if self.bound.is_complex else ""
        if self.bound.axes is not None:
            numbers = ", with a matrix for every axis of the world"
        return f"proved {form}{numbers}{shift}{cap}{self._terms_text}, {subtracted}"

    @property
    def _terms_text(self) -> str:
        """What the proof says of handedness terms, if it has any."""
        terms = self.bound.terms
        return "" if terms is None else f", with handedness terms of {terms.num_pairs} pairs"


def certify_at(
    problem: PGOProblem,
    poses: Poses,
    gap: float = DEFAULT_GAP,
    stationarity: float = math.nan,
    deadline: float = math.inf,
) -> Certificate:
    """Judge poses by the bound of the multipliers at these poses as they are.

    It is valid anywhere, and sharp near an optimum. `solvers.certify` moves poses that are not
    stationary to the stationary point nearby, and bounds there. Where the bound leaves a wider gap,
    one proof more is tried: in the plane with rotations as complex numbers, in space with
    handedness terms in closed form.

    Parameters
    ----------
    problem : PGOProblem
        The problem.
    poses : Poses
        The poses to judge.
    gap : float
        The relative gap to certify.
    stationarity : float
        The relative decrement there, which is reported as it is; nan where it was not measured.
    deadline : float
        When the search for a bound ends, by `time.perf_counter`: after it, with the first eta that
        proves something. The bound holds, but a longer search may prove more.

    Returns
    -------
    Certificate
        The bound, and how far the cost of the poses is above it.

    Raises
    ------
    SettingError
        Unless the gap is positive and finite, or for a tangent (`PGOProblem.tangent_at`).
    GraphError
        When the poses do not fit the graph.

    Examples
    --------
    >>> import numpy as np
    >>> from pgo_models.graphs.scenes import grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> certificate = certify_at(problem, problem.graph.truth)
    >>> bool(0 < certificate.lower_bound <= certificate.objective)
    True
    """
    problem = as_problem(problem)
    poses = check_poses(problem.graph, poses)
    poses = problem.graph.completed(poses)  # a landmark has no rotation of its own
    if problem.graph.has_far_priors:
        near = problem.graph.near_zero(poses)
        return judge(problem, poses, _certificate_at(problem, near, gap, stationarity, deadline))
    return _certificate_at(problem, poses, gap, stationarity, deadline)


def _certificate_at(
    problem: PGOProblem, poses: Poses, gap: float, stationarity: float, deadline: float
) -> Certificate:
    """`certify_at` for poses that are not far from zero."""
    best = poses if stationarity <= STATIONARY_DECREMENT else problem.at_best_translations(poses)
    certificate = certify_with(
        problem,
        poses,
        multipliers(problem, best),
        gap,
        stationarity,
        BoundSource.GIVEN,
        ground=best,
        deadline=deadline,
    )
    if not certificate.can_improve or is_over(deadline):
        return certificate
    if problem.d == 2:
        certificate = with_complex_numbers(problem, certificate, best)
    else:
        terms = closed_form_terms(problem.tangent_at(best), best)
        if terms is not None:
            certificate = with_terms(problem, certificate, terms, best)
    return certificate if is_over(deadline) else with_axes(problem, certificate, best)


def with_axes(problem: PGOProblem, certificate: Certificate, ground: Poses) -> Certificate:
    """The certificate, or a better one with a matrix for every axis of the world.

    Handedness terms of the certificate are taken off the cost here, too.
    """
    if problem.graph.world is None or not certificate.can_improve:
        return certificate
    tangent = problem.tangent_at(ground)
    terms = certificate.bound.terms
    if terms is not None:
        tangent = terms.taken_off(tangent)
    Lambda = multipliers(problem, ground)
    gap = certificate.wanted_gap
    proven = prove_by_axes(tangent, Lambda, ground, gap, certificate.objective)
    if proven is None:
        return certificate
    bound, Lambda = proven
    if terms is not None:
        bound = less_terms(bound, terms)
    return with_better(problem, certificate, Lambda, bound)


def with_terms(
    problem: PGOProblem, certificate: Certificate, terms: HandednessTerms, ground: Poses
) -> Certificate:
    """The certificate, or a better one by handedness terms that vanish at the poses `ground`.

    These are the poses of the certificate with their best translations.
    """
    Lambda = multipliers(problem, ground)
    gap = certificate.wanted_gap
    tangent = problem.tangent_at(ground)
    bound = best_bound_with_terms(tangent, Lambda, ground, gap, certificate.objective, terms)
    return with_better(problem, certificate, Lambda, bound)


def with_complex_numbers(
    problem: PGOProblem, certificate: Certificate, ground: Poses
) -> Certificate:
    """The certificate, or a better one that takes rotations of the plane as complex numbers.

    It is grounded at the poses `ground`, with the multipliers there and eta = 0.
    """
    if not has_complex_form(problem):
        return certificate
    Lambda = scalar_multipliers(multipliers(problem, ground))
    bound = prove_at(problem.tangent_at(ground), Lambda, ground, is_complex=True)
    return certificate if bound is None else with_better(problem, certificate, Lambda, bound)


def with_better(
    problem: PGOProblem, certificate: Certificate, Lambda: Array, bound: LowerBound
) -> Certificate:
    """The certificate, or one of the same poses with a better bound, proved with these Lambda."""
    if bound.value <= certificate.bound.value:
        return certificate
    gap = certificate.wanted_gap
    stationarity = certificate.stationarity
    return certify_with(
        problem, certificate.poses, Lambda, gap, stationarity, BoundSource.GIVEN, bound
    )


def certify_with(
    problem: PGOProblem,
    poses: Poses,
    Lambda: Array,
    gap: float,
    stationarity: float,
    source: BoundSource,
    bound: LowerBound | None = None,
    ground: Poses | None = None,
    terms: HandednessTerms | None = None,
    deadline: float = math.inf,
) -> Certificate:
    """Certificate of poses with multipliers from anywhere: the proof asks nothing of them.

    Unless a bound is given that was proved with these multipliers already, it is found here,
    grounded at one of the poses `ground`: the given ones with their best translations, unless
    given, and the search ends after the `deadline`. Handedness terms, if any, are taken off the
    cost. A SettingError when gap is not positive and finite, or Lambda has the wrong shape.
    """
    if not 0 < gap < math.inf:
        raise SettingError(f"gap is {gap}; give a positive relative gap, as 1e-6")
    at = problem.at(poses)
    objective = at.value
    rounding = rounding_of(at)
    if bound is None:
        ground = ground if ground is not None else problem.at_best_translations(poses)
        tangent = problem.tangent_at(ground)
        if rounding.fit.is_to_rounding:
            bound = NO_BOUND
        elif terms is None:
            bound = best_bound(tangent, Lambda, ground, gap, objective, deadline=deadline)
        else:
            bound = best_bound_with_terms(tangent, Lambda, ground, gap, objective, terms)
    weighting = (
        problem.weighting if isinstance(problem.weighting, Weighting) else Weighting.ISOTROPIC
    )
    judgement = judge_cost(repr(problem), objective, rounding, bound, gap)
    return judgement.certificate(
        gap, stationarity, source, poses, Lambda, weighting, problem.has_translations
    )


def judge(problem: PGOProblem, poses: Poses, certificate: Certificate) -> Certificate:
    """Hold other poses of the same problem against the bound of a certificate.

    A ProofError when F of the poses is below it by more than the rounding of F: then one of the two
    is wrong.
    """
    at = problem.at(poses)
    objective = at.value
    rounding = rounding_of(at)
    judgement = judge_cost(
        repr(problem), objective, rounding, certificate.bound, certificate.wanted_gap
    )
    return judgement.of(certificate)


@dataclass(frozen=True)
class Judgement:
    """What a bound says of poses with a given cost."""

    objective: float
    rounding: ObjectiveRounding
    bound: LowerBound
    gap: float
    verdict: Verdict

    def certificate(
        self,
        wanted_gap: float,
        stationarity: float,
        source: BoundSource,
        poses: Poses,
        Lambda: Array,
        weighting: Weighting,
        has_translations: bool = True,
    ) -> Certificate:
        """Certificate of the poses that were judged; the rest as in `Certificate`."""
        return Certificate(
            objective=self.objective,
            bound=self.bound,
            gap=self.gap,
            rounding_level=self.rounding.level,
            stationarity=stationarity,
            source=source,
            poses=poses,
            poses_objective=self.objective,
            Lambda=Lambda,
            wanted_gap=wanted_gap,
            verdict=self.verdict,
            weighting=weighting,
            objective_error=self.rounding.error,
            has_translations=has_translations,
            fit=self.rounding.fit,
            weights_error=self.rounding.weights_error,
        )

    def of(self, certificate: Certificate) -> Certificate:
        """The certificate with this judgement of its poses in place of its own."""
        return replace(
            certificate,
            objective=self.objective,
            objective_error=self.rounding.error,
            rounding_level=self.rounding.level,
            fit=self.rounding.fit,
            weights_error=self.rounding.weights_error,
            bound=self.bound,
            gap=self.gap,
            verdict=self.verdict,
        )


def judge_cost(
    subject: str, F: float, rounding: ObjectiveRounding, bound: LowerBound, wanted_gap: float
) -> Judgement:
    """Hold the cost F of poses, which is known to its rounding, against a bound.

    Errors are those of `judge`, and name the subject: a problem.
    """
    if bound.value > F + rounding.error:
        raise ProofError(
            f"lower bound {bound.value!r} is above F = {F!r} of {subject}, "
            f"which is known to {rounding.error:.2g}: "
            "a defect of pgo_models; please report it with the graph"
        )
    # F may come out below a true bound by its own rounding, which is then what the gap is known to.
    known = bound.value if bound.value < F else F - rounding.error
    weights_error = rounding.weights_error
    gap = relative_gap(
        scaled_above(F, weights_error),
        scaled_below(known, weights_error),
        rounding.fit.is_to_rounding,
    )
    # chi2, which is never negative, may come out below zero.
    bound = replace(bound, value=min(bound.value, max(F, 0.0)))
    proven_gap = gap_above(
        _cost_at_most(F, rounding.error, weights_error), scaled_below(bound.value, weights_error)
    )
    verdict = verdict_of(rounding.fit, proven_gap, bound, wanted_gap)
    return Judgement(F, rounding, bound, gap, verdict)


def verdict_of(fit: Fit, proven_gap: float, bound: LowerBound, wanted_gap: float) -> Verdict:
    """Verdict on poses that fit the edges so closely and have that `Certificate.proven_gap`.

    What was asked for has to be proven.
    """
    if fit.is_exact:
        return Verdict.EXACT
    if math.isnan(bound.eta):
        return Verdict.TRIVIAL
    return Verdict.CERTIFIED if proven_gap <= wanted_gap else Verdict.NOT_CERTIFIED


def relative_gap(objective: float, lower_bound: float, is_exact: bool = False) -> float:
    """(objective - lower_bound) / objective; 0 of exact poses, 1 where F is not finite or positive.

    Of other poses an F that comes out as zero, or chi2 below zero, is unknown to its last digit.
    """
    if is_exact:
        return 0.0
    return (objective - lower_bound) / objective if 0.0 < objective < math.inf else 1.0


def _cost_at_most(objective: float, error: float, weights_error: float) -> float:
    """A cost and the bounds on its error; the cost as computed where none is known of rounding."""
    at_most = objective if math.isnan(error) else sum_above(objective, error)
    return scaled_above(at_most, weights_error)
