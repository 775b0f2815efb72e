"""Certificate of a model's values: their objective beside a lower bound over all values.

A pose graph's is `pgo_models.certificates.certificate`; verdicts and gaps are the same.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pgo_models.certificates.certificate import DEFAULT_GAP, Verdict
from pgo_models.convex.hull_bound import HullBound
from pgo_models.convex.model_bound import ModelBound
from pgo_models.convex.model_proof_file import write_hull_proof, write_model_proof
from pgo_models.convex.orthogonality import OrthogonalProblem
from pgo_models.convex.quadratic_form import QuadraticForm
from pgo_models.errors import ProofError, SettingError
from pgo_models.figures import gap_above, rounded_down, rounded_up, sum_above
from pgo_models.geometry.arrays import ReadOnly
from pgo_models.geometry.rotations import Array

# J of values whose residuals are that many times what rounding makes them counts as zero
_ROUNDING_MULTIPLE = 4.0
FEASIBLE = 1e-5  # largest violation of values that may be certified; SOC leaves 1e-6


@dataclass(frozen=True, eq=False)
class ModelCertificate(ReadOnly):
    """A proven lower bound on J over all points of the sets, beside J of given values.

    Parameters
    ----------
    objective : float
        J of the values, projected onto the sets, with the best values of all other variables.
    objective_error : float
        Bound on its rounding, and on what J gains where values violate constraints. Of a model that
        is not quadratic J is taken as computed.
    violation : float
        How much the values violate the sets and the constraints: the largest share of the terms of
        an equation. Of a model that is not quadratic, the norm of all violations.
    bound : ModelBound, HullBound or None
        The proof; None where no bound was proven.
    is_exact : bool
        Whether J is a sum of squares whose residuals are all zero to rounding, at feasible values.
    wanted_gap : float
        The gap that was asked for.
    form : QuadraticForm or None
        The model; None where it is not quadratic.
    reason : str
        Why there is no bound, or none but that of the hulls.
    is_nonnegative : bool
        Whether J of a model that is not quadratic is never negative, by cvxpy's rules of signs.
    """

    objective: float
    objective_error: float
    violation: float
    bound: ModelBound | HullBound | None
    is_exact: bool
    wanted_gap: float = DEFAULT_GAP
    form: QuadraticForm | None = None
    reason: str = ""
    is_nonnegative: bool = False

    @property
    def lower_bound(self) -> float:
        """Proven in exact arithmetic: J >= lower_bound at all points of the sets.

        It is -inf where nothing is proven.
        """
        is_sum = self.form is not None and self.form.is_sum_of_squares
        least = 0.0 if is_sum or self.is_nonnegative else -math.inf
        if self.bound is not None:
            least = max(least, self.bound.value)
        return min(least, self.objective)

    @property
    def gap(self) -> float:
        """(objective - lower_bound) / |objective|, rounded up; 0 where the values are exact."""
        if self.is_exact:
            return 0.0
        at_most = sum_above(self.objective, self.objective_error)
        if at_most > 0.0 and self.lower_bound >= 0.0:
            return gap_above(at_most, self.lower_bound)
        if at_most == 0.0 or math.isinf(self.lower_bound):
            return math.inf
        return float(np.nextafter((at_most - self.lower_bound) / abs(at_most), math.inf))

    @property
    def verdict(self) -> Verdict:
        """What is proven of the values."""
        if self.is_exact:
            return Verdict.EXACT
        if self.bound is None:
            return Verdict.TRIVIAL
        is_closed = self.gap <= self.wanted_gap and self.violation <= FEASIBLE
        return Verdict.CERTIFIED if is_closed else Verdict.NOT_CERTIFIED

    @property
    def is_certified(self) -> bool:
        """Whether the values are globally optimal within the gap that was asked for."""
        return self.verdict in (Verdict.CERTIFIED, Verdict.EXACT)

    def save_proof(self, path: Path | str) -> None:
        """Write what proves the bound, as JSON; `verify_proof` checks it exactly.

        Parameters
        ----------
        path : Path or str
            The file; it is written whole or not at all.

        Raises
        ------
        SettingError
            When there is no bound, or a variable is in several sets.
        PGOError
            When the file cannot be written.
        """
        if self.bound is None:
            raise SettingError("no proof to write: no bound was found")
        if isinstance(self.bound, HullBound):
            write_hull_proof(self.bound, path)
        elif self.form is not None:
            write_model_proof(self.form, self.bound, path)

    def facts(self) -> list[tuple[str, str]]:
        """Return the figures as they are printed, with their labels."""
        if self.bound is None and self.reason and not self.is_nonnegative:
            return [("lower bound", f"none: {self.reason}")]
        bound = rounded_down(self.lower_bound) if math.isfinite(self.lower_bound) else "none"
        rounding = "   (J is never negative)" if self.lower_bound == 0.0 else ""
        if self.bound is not None and not self.bound.value < self.lower_bound:
            of_hulls = "least J over the sets' hulls, " if self.reason else ""
            rounding = (
                f"   ({of_hulls}proven, less {rounded_up(self.bound.rounding, 2)} for rounding)"
            )
        gap = f"{rounded_up(self.gap, 3)}   (asked for: {self.wanted_gap:.3g})"
        facts = [
            ("lower bound", f"{bound}{rounding}"),
            ("gap", "0: every residual is zero to rounding" if self.is_exact else gap),
            ("verdict", f"{self.verdict.name}: {_SENTENCES[self.verdict]}"),
        ]
        if self.is_certified:
            return facts
        if self.bound is not None and self.bound.value > self.objective:
            facts.append(("no more, as", f"no J is below {self.bound.value:.6g}: {_VIOLATED}"))
        elif not self.violation <= FEASIBLE:
            reason = f"the values violate constraints by {self.violation:.2g}"
            facts.append(("no more, as", reason))
        if self.reason:
            facts.append(("no more, as", self.reason))
        return facts

    def __str__(self) -> str:
        facts = [("J", f"{self.objective:.12g}"), *self.facts()]
        return "\n".join(f"{label:<12} {text}" for label, text in facts)

    def __repr__(self) -> str:
        gap = rounded_up(self.gap, 3) if math.isfinite(self.gap) else "inf"
        return f"ModelCertificate(J={self.objective:.10g}, gap={gap}, {self.verdict.name})"


_VIOLATED = "the values violate constraints, which may contradict each other on the sets"
_SENTENCES = {
    Verdict.EXACT: "globally optimal: J is a sum of squares, and zero to rounding",
    Verdict.CERTIFIED: Verdict.CERTIFIED.value,
    Verdict.NOT_CERTIFIED: Verdict.NOT_CERTIFIED.value,
    Verdict.TRIVIAL: "not shown to be optimal: no bound was found",
}


def judge_by_hulls(
    problem: OrthogonalProblem,
    objective: float,
    violation: float,
    bound: HullBound | None,
    reason: str,
    gap: float = DEFAULT_GAP,
) -> ModelCertificate:
    """Hold J of values against the bound by hulls; `reason` is why there is no other.

    `violation` is the norm by which they violate constraints; the dual point says what J gains.
    """
    error = 0.0
    if bound is not None:
        error = violation * float(np.linalg.norm(bound.y[bound.program.of_model]))
    is_nonnegative = bool(problem.J.is_nonneg())
    return ModelCertificate(
        objective, error, violation, bound, False, gap, None, reason, is_nonnegative
    )


def judge_values(
    form: QuadraticForm,
    u: Array,
    violation: float,
    bound: ModelBound | None,
    gap: float = DEFAULT_GAP,
) -> ModelCertificate:
    """Hold a point of the sets against a bound.

    `violation` is that of the sets and constraints at the point. A ProofError where J is below the
    bound by more than rounding: then one of the two is wrong.
    """
    if not 0 < gap < math.inf:
        raise SettingError(f"gap is {gap}; give a positive relative gap, as 1e-6")
    objective, error = form.evaluated(u)
    # x is in the sets to a few roundings alone
    gradient = 2.0 * (form.Q @ u)
    error += 64.0 * float(np.finfo(float).eps) * float(abs(gradient) @ abs(u))
    error += gained(bound, u)
    level = form.rounding_level(u)
    is_zero = form.is_sum_of_squares and objective <= _ROUNDING_MULTIPLE * level
    is_exact = is_zero and violation <= FEASIBLE
    if bound is not None and bound.value > objective + error:
        raise ProofError(
            f"lower bound {bound.value!r} is above J = {objective!r}, which is known to "
            f"{error:.2g}: a defect of pgo_models; please report it with the model"
        )
    return ModelCertificate(objective, error, violation, bound, is_exact, gap, form)


def gained(bound: ModelBound | None, u: Array) -> float:
    """What J gains, by the multipliers of a bound, where a point violates equations."""
    if bound is None:
        return 0.0
    return max(0.0, -float(np.sum(bound.equations.terms(bound.multipliers, u))))
