"""Dual certificate: multipliers Lambda, matrix S, a proof that S + eta I is PSD, and the lower bound it gives.

For every feasible X, tr(X^T M X) = tr(X^T S X) + sum_i tr(Lambda_i) with S = M - blockdiag(0, Lambda) and any symmetric
Lambda_i. If S + eta blockdiag(0, I) is positive semidefinite, then F >= tr(Lambda) - eta n d for every feasible point,
however Lambda was found (Rosen et al. 2019, theorem 7; Carlone et al. 2015).
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.errors import NotPositiveDefiniteError, SettingError
from pgo_models.html_tables import facts_table
from pgo_models.initialization import chordal_start
from pgo_models.multipliers import factorize_certificate, multipliers
from pgo_models.polish import STATIONARY_DECREMENT, polish, relative_decrement
from pgo_models.poses import Poses
from pgo_models.problem import PGOProblem
from pgo_models.rotations import Array

DEFAULT_GAP = 1e-6
_ETA_SHARE = 0.5  # of the wanted gap is spent on eta; the rest is for poses a little off the optimum
_ETA_GROWTH, _ETA_BISECTIONS = 10.0, 3
_ROUNDING_FLOOR = 10.0 * float(np.finfo(float).eps)  # of the largest diagonal entry of M: below, a proof proves nothing


class Verdict(enum.Enum):
    """What the certificate says of the poses.

    Examples
    --------
    >>> from pgo_models.scenes import grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> certify(problem, polish(problem, chordal_start(problem))).verdict.name
    'CERTIFIED'
    """

    CERTIFIED = "globally optimal within the gap asked for"
    NOT_CERTIFIED = "not shown to be optimal: the bound holds, but the gap is wider than asked for"
    TRIVIAL = "not shown to be optimal: no bound better than zero was found"


class BoundSource(enum.Enum):
    """Where the multipliers of the bound were taken.

    Examples
    --------
    >>> from pgo_models.scenes import grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> certify(problem, chordal_start(problem)).source.name
    'POLISHED'
    """

    GIVEN = "at the poses given"
    POLISHED = "after polishing the poses given, which were not stationary"
    CHORDAL = "at the point that the chordal start polishes to, better than the one beside the poses given"
    RELAXATION = (
        "where the staircase solved the semidefinite relaxation, whose optimum is below F of all poses if not tight"
    )


@dataclass(frozen=True, eq=False)
class Certificate:
    """A proven lower bound on the global optimum beside the cost of given poses.

    Attributes
    ----------
    objective : float
        F of the poses that were given.
    lower_bound : float
        Proven: F(R, t) >= lower_bound for every choice of poses.
    gap : float
        (objective - lower_bound) / max(1, objective).
    eta : float
        Shift with which the factorisation of S + eta I went through; nan when only F >= 0 is left.
    stationarity : float
        Half the squared Newton decrement of the given poses, over max(1, F): about the relative decrease of F down to
        the stationary point beside them.
    source : BoundSource
    poses : Poses
        Where the bound was found.
    poses_objective : float
        F there: the best value known.
    Lambda : (n, d, d)
        Multipliers, which with eta are the proof: anyone can check it with `prove_bound`.
    wanted_gap : float
    verdict : Verdict

    Examples
    --------
    >>> from pgo_models.scenes import grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> certificate = certify(problem, chordal_start(problem))
    >>> certificate
    Certificate(F=110.9926545, gap=0.126, NOT_CERTIFIED)
    >>> bool(certificate.lower_bound <= certificate.poses_objective <= certificate.objective)
    True
    """

    objective: float
    lower_bound: float
    gap: float
    eta: float
    stationarity: float
    source: BoundSource
    poses: Poses
    poses_objective: float
    Lambda: Array
    wanted_gap: float
    verdict: Verdict

    @property
    def is_certified(self) -> bool:
        """Whether the gap is within the one asked for."""
        return self.verdict is Verdict.CERTIFIED

    def __repr__(self) -> str:
        return f"Certificate(F={self.objective:.10g}, gap={self.gap:.3g}, {self.verdict.name})"

    def __str__(self) -> str:
        return "\n".join(f"{label:<12} {text}" for label, text in self._facts())

    def _repr_html_(self) -> str:
        return facts_table(self._facts())

    def _facts(self) -> list[tuple[str, str]]:
        proof = "F is a sum of squares" if math.isnan(self.eta) else f"proved with eta = {self.eta:.3g}"
        facts = [
            ("F", f"{self.objective:.10g}   (stationary to {self.stationarity:.2g})"),
            ("lower bound", f"{self.lower_bound:.10g}   ({proof}; {self.source.value})"),
            ("gap", f"{self.gap:.3g}   (asked for: {self.wanted_gap:.3g})"),
            ("verdict", f"{self.verdict.name}: {self.verdict.value}"),
        ]
        if self.source is not BoundSource.GIVEN:
            facts.insert(1, ("best known F", f"{self.poses_objective:.10g}"))
        return facts


def prove_bound(problem: PGOProblem, Lambda: Array, eta: float) -> float | None:
    """tr(Lambda) - eta n d if S + eta blockdiag(0, I) is positive definite with t_0 grounded, else None.

    The proof is one sparse Cholesky factorisation that goes through (`factorize_certificate`), so it is as exact as
    double precision; `smallest_shift` is above its level.
    Lambda is made symmetric first.

    Raises
    ------
    SettingError
        When eta is negative or Lambda has the wrong shape.

    Examples
    --------
    >>> from pgo_models.scenes import grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> poses = polish(problem, chordal_start(problem))
    >>> bound = prove_bound(problem, multipliers(problem, poses), eta=1e-6)
    >>> bool(bound < problem.objective(poses) < bound + 1e-3)
    True
    """
    n, d = problem.num_poses, problem.d
    if not eta >= 0:
        raise SettingError(f"eta is {eta}; a shift must not be negative")
    if Lambda.shape != (n, d, d):
        raise SettingError(f"Lambda has shape {Lambda.shape}; give one block for every pose, {(n, d, d)}")
    symmetric = 0.5 * (Lambda + np.swapaxes(Lambda, 1, 2))
    try:
        factorize_certificate(problem, symmetric, eta)
    except NotPositiveDefiniteError:
        return None
    return _trace(symmetric) - eta * n * d


def certify(problem: PGOProblem, poses: Poses, gap: float = DEFAULT_GAP) -> Certificate:
    """Judge anybody's poses: a proven lower bound on the global optimum, and how far F is above it.

    The bound is found at a stationary point. Poses that are not stationary are polished first (damped Newton,
    `polish`); where that point does not give the gap, the one that the chordal start polishes to is tried, and the
    better bound is taken. `source` says what was done; the gap is always that of the poses given.

    Parameters
    ----------
    problem : PGOProblem
    poses : Poses
    gap : float
        The relative gap to certify; the smallest eta that is tried follows from it.

    Returns
    -------
    Certificate

    Raises
    ------
    SettingError
        When gap is not positive.
    GraphError
        When the poses do not fit the graph.

    Examples
    --------
    >>> import numpy as np
    >>> from pgo_models.scenes import grid
    >>> graph = grid(np.random.default_rng(0))
    >>> certificate = certify(PGOProblem(graph), graph.truth)
    >>> certificate.verdict.name, certificate.source.name, bool(0 < certificate.lower_bound < certificate.objective)
    ('NOT_CERTIFIED', 'POLISHED', True)
    """
    stationarity = relative_decrement(problem, poses)
    if stationarity <= STATIONARY_DECREMENT:
        certificate = certify_stationary(problem, poses, gap, stationarity)
    else:
        polished = certify_stationary(problem, polish(problem, poses), gap, stationarity)
        certificate = judge(problem, poses, replace(polished, source=BoundSource.POLISHED))
    if not _bound_is_tight(certificate):
        other = certify_stationary(problem, polish(problem, chordal_start(problem)), gap, stationarity)
        # Of equal bounds, as two zeros, the one with the better poses.
        if (other.lower_bound, -other.poses_objective) > (certificate.lower_bound, -certificate.poses_objective):
            certificate = judge(problem, poses, replace(other, source=BoundSource.CHORDAL))
    return certificate


def certify_stationary(problem: PGOProblem, poses: Poses, gap: float, stationarity: float) -> Certificate:
    """Certificate at poses known to be stationary; it holds for any, but is wide elsewhere.

    Parameters
    ----------
    stationarity : float
        Relative decrement there, reported as it is.
    """
    # With the best translations, the trace of the multipliers is F to rounding.
    Lambda = multipliers(problem, problem.with_best_translations(poses.R))
    return certify_with(problem, poses, Lambda, gap, stationarity, BoundSource.GIVEN)


def certify_with(
    problem: PGOProblem, poses: Poses, Lambda: Array, gap: float, stationarity: float, source: BoundSource
) -> Certificate:
    """Certificate of poses with multipliers from anywhere: the proof asks nothing of them.

    Raises
    ------
    SettingError
        When gap is not positive or Lambda has the wrong shape.
    """
    if not gap > 0:
        raise SettingError(f"gap is {gap}; give a positive relative gap, as 1e-6")
    objective = problem.objective(poses)
    eta, lower_bound = smallest_provable(problem, Lambda, gap, objective)
    unjudged = Certificate(
        objective=objective,
        lower_bound=lower_bound,
        gap=math.nan,
        eta=eta,
        stationarity=stationarity,
        source=source,
        poses=poses,
        poses_objective=objective,
        Lambda=Lambda,
        wanted_gap=gap,
        verdict=Verdict.TRIVIAL,
    )
    return judge(problem, poses, unjudged)


def judge(problem: PGOProblem, poses: Poses, certificate: Certificate) -> Certificate:
    """Hold other poses of the same problem against the bound of a certificate."""
    objective = problem.objective(poses)
    gap = relative_gap(objective, certificate.lower_bound)
    if gap <= certificate.wanted_gap:
        verdict = Verdict.CERTIFIED
    else:
        verdict = Verdict.TRIVIAL if math.isnan(certificate.eta) else Verdict.NOT_CERTIFIED
    return replace(certificate, objective=objective, gap=gap, verdict=verdict)


def relative_gap(objective: float, lower_bound: float) -> float:
    """(objective - lower_bound) / max(1, objective)."""
    return (objective - lower_bound) / max(1.0, objective)


def _bound_is_tight(certificate: Certificate) -> bool:
    return relative_gap(certificate.poses_objective, certificate.lower_bound) <= certificate.wanted_gap


def smallest_provable(problem: PGOProblem, Lambda: Array, gap: float, objective: float) -> tuple[float, float]:
    """Smallest eta found, from what the wanted gap allows upwards, and its bound; (nan, 0) when only F >= 0 is left."""
    smallest = smallest_shift(problem, gap, objective)
    count = problem.num_poses * problem.d
    return search_bound(lambda eta: prove_bound(problem, Lambda, eta), smallest, _trace(Lambda), count)


def search_bound(
    prove: Callable[[float], float | None], smallest: float, trace: float, count: int
) -> tuple[float, float]:
    """Smallest eta found for which `prove` gives a bound, and the bound; (nan, 0) when tr(Lambda) - eta n d is not > 0.

    Parameters
    ----------
    prove : callable
        tr(Lambda) - eta n d, or None where S + eta I is not positive definite.
    smallest : float
        First eta; from there on it grows until there is a bound, then the last step is bisected.
    trace, count : float, int
        tr(Lambda) and n d.
    """
    eta, too_small = smallest, math.nan
    bound = None
    while bound is None:
        if not trace - eta * count > 0.0:
            return math.nan, 0.0
        bound = prove(eta)
        if bound is None:
            too_small, eta = eta, _ETA_GROWTH * eta
    for _ in range(0 if math.isnan(too_small) else _ETA_BISECTIONS):
        middle = math.sqrt(too_small * eta)
        tighter = prove(middle)
        if tighter is None:
            too_small = middle
        else:
            eta, bound = middle, tighter
    return eta, bound


def smallest_shift(problem: PGOProblem, gap: float, objective: float) -> float:
    """Shift eta that spends a fixed share of a relative gap, and is no smaller than a factorisation can tell from 0."""
    largest = float(problem.M.data[problem.diagonal_positions].max())
    return shift_of_gap(largest, problem.num_poses * problem.d, gap, objective)


def shift_of_gap(largest_diagonal: float, count: int, gap: float, objective: float) -> float:
    """`smallest_shift` from the largest diagonal entry of M and count = n d."""
    return max(_ETA_SHARE * gap * max(1.0, objective) / count, _ROUNDING_FLOOR * largest_diagonal)


def _trace(Lambda: Array) -> float:
    return math.fsum(np.einsum("naa->na", Lambda).ravel())
