"""The best bound on chi2 that smaller information matrices give, sought by bisection.

The matrices are those of `pgo_models.certificates.shrunk_information`, which keeps the condition of
every I'_tt below a cap. A larger cap leaves more of the cost, but with it the tangent at the
minimum may prove nothing without a shift.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.certificates.certificate import BoundSource, Certificate, judge, judge_cost
from pgo_models.certificates.dual_variables import multipliers
from pgo_models.certificates.lower_bound import NO_BOUND, LowerBound, has_complex_form, prove_at
from pgo_models.certificates.rounding_errors import ObjectiveRounding
from pgo_models.certificates.shrunk_information import shrink_and_join, without_singular_blocks
from pgo_models.errors import GraphError, NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.precisions import filled
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.riemannian.polish import polish

BISECTIONS = 5  # of the range of log(cap), which is then known to 1/32 of that range


@dataclass(frozen=True, eq=False)
class ShrunkBound:
    """A bound on chi2 by smaller information matrices, and the point at which it was proved."""

    bound: LowerBound
    poses: Poses  # the minimum of the smaller cost
    Lambda: Array  # (n, d, d): the multipliers there


def bound_by_shrinking(problem: PGOProblem, poses: Poses) -> ShrunkBound:
    """Bound on chi2 with the largest cap that gives one, by bisection of its logarithm.

    The search for the minima of the smaller costs begins at the poses given.
    """
    best = ShrunkBound(NO_BOUND, poses, np.zeros_like(poses.R))
    d = problem.d
    whole = without_singular_blocks(problem.information, d)
    I_tt = filled(whole[:, :d, :d])
    low = 0.0
    high = math.log(1.0 + float(np.linalg.cond(I_tt).max()))
    by_positions = True
    has_bound, best = _try_cap(problem, whole, math.exp(low), best, by_positions)
    if not has_bound:
        by_positions = False
        has_bound, best = _try_cap(problem, whole, math.exp(low), best, by_positions)
    if not has_bound:
        return best
    has_all, best = _try_cap(problem, whole, math.exp(high), best, by_positions)
    if has_all:
        return best
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        has_bound, best = _try_cap(problem, whole, math.exp(middle), best, by_positions)
        if has_bound:
            low = middle
        else:
            high = middle
    return best


def _try_cap(
    problem: PGOProblem, whole: Array, cap: float, best: ShrunkBound, by_positions: bool
) -> tuple[bool, ShrunkBound]:
    """Whether a cap gives a bound without a shift, and the better one of it and the best so far."""
    try:
        graph = shrink_and_join(problem.graph, whole, cap, by_positions)
        smaller = PGOProblem(graph, problem.backend, problem.weighting)
        minimum = polish(smaller, best.poses)
    except (GraphError, NotPositiveDefiniteError):
        return False, best
    Lambda = multipliers(smaller, minimum)
    tangent = smaller.tangent_at(minimum)
    bound = prove_at(tangent, Lambda, minimum)
    if bound is None and has_complex_form(smaller):
        bound = prove_at(tangent, Lambda, minimum, is_complex=True)
    if bound is None:
        return False, best
    if bound.value <= best.bound.value:
        return True, best
    return True, ShrunkBound(replace(bound, cap=cap), minimum, Lambda)


def with_shrunk_information(problem: PGOProblem, certificate: Certificate) -> Certificate:
    """The certificate, or a better one by `bound_by_shrinking` where its bound on chi2 is loose."""
    if problem.weighting is not Weighting.INFORMATION or bound_is_tight(problem, certificate):
        return certificate
    shrunk = bound_by_shrinking(problem, certificate.poses)
    if shrunk.bound.value <= certificate.bound.value:
        return certificate
    by_smaller_cost = replace(certificate, Lambda=shrunk.Lambda, source=BoundSource.SOFTENED)
    # Rounding is that of the given poses, at which the bound need not have been proved.
    rounding = ObjectiveRounding(
        certificate.rounding_level,
        certificate.objective_error,
        certificate.fit,
        certificate.weights_error,
    )
    judgement = judge_cost(
        repr(problem), certificate.objective, rounding, shrunk.bound, certificate.wanted_gap
    )
    return judgement.of(by_smaller_cost)


def bound_is_tight(problem: PGOProblem, certificate: Certificate) -> bool:
    """Whether the gap at the poses of the certificate is at most the wanted one, or rounding."""
    judged = judge(problem, certificate.poses, certificate)
    return judged.is_certified or judged.is_hidden_by_rounding
