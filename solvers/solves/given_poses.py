"""certify: a proven bound for anybody's poses, found at a stationary point near them.

`pgo_models.certificates` bounds at given poses. Here it is decided at which: the poses given, the
stationary points that Newton reaches from them and from the chordal start, and for chi2 the minimum
of a smaller cost. Where the relaxation is loose, what tells rotations from reflections follows:
handedness terms in space, complex numbers in the plane.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, cast, overload

import numpy as np

from pgo_models.certificates.certificate import (
    DEFAULT_GAP,
    BoundSource,
    Certificate,
    Verdict,
    certify_at,
    judge,
    with_terms,
)
from pgo_models.certificates.fit import fit_beside_exact
from pgo_models.certificates.lower_bound import has_complex_form
from pgo_models.certificates.polished import Polished
from pgo_models.errors import FAILURES, GraphWarning, SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.residuals import check_poses
from pgo_models.graphs.written_digits import ALL_DIGITS, WrittenDigits
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem, as_problem
from pgo_models.problem.stationarity import STATIONARY_DECREMENT
from solvers.handedness.complex_relaxation import (
    ComplexRelaxation,
    ComplexState,
    certificates_of_relaxation,
)
from solvers.handedness.search import HandednessSearch
from solvers.loop import RunMonitor
from solvers.result import Outcome
from solvers.riemannian.polish import polish, relative_decrement
from solvers.riemannian.shrunk_bound import bound_is_tight, with_shrunk_information

_HALF = 0.5 * (1.0 + 1e-3)  # of the unit of the last digit, and what Newton leaves

if TYPE_CHECKING:
    from pgo_models.convex.model_certificate import ModelCertificate
    from pgo_models.convex.orthogonality import OrthogonalProblem


@overload
def certify(
    problem: PGOProblem | PoseGraph, poses: Poses | None, gap: float = DEFAULT_GAP
) -> Certificate: ...
@overload
def certify(
    problem: "OrthogonalProblem", poses: Sequence[Array], gap: float = DEFAULT_GAP
) -> "ModelCertificate": ...
def certify(
    problem: "PGOProblem | PoseGraph | OrthogonalProblem",
    poses: Poses | Sequence[Array] | None,
    gap: float = DEFAULT_GAP,
) -> "Certificate | ModelCertificate":
    """Judge anybody's poses, or values of a model, by a proven lower bound on the global optimum.

    The bound is proved at a stationary point. Poses that are not stationary are polished first
    (damped Newton, `polish`). If this point does not give the gap, the chordal start is polished,
    too, and the better bound is taken. `source` says what was done; the gap is always that of the
    poses given. `certify_at` bounds at the poses as they are.

    With `Weighting.INFORMATION` the cost is chi2 instead of F. Its tangent at the stationary point
    is bounded, and if that fails smaller information matrices are (`bound_by_shrinking`). If the
    bound is still wide, handedness terms follow in space (`HandednessAscent`), and the relaxation
    with rotations as complex numbers in the plane (`ComplexRelaxation`).

    Parameters
    ----------
    problem : PGOProblem, PoseGraph or OrthogonalProblem
        The problem; of a graph it is F, of a cvxpy model with rotations its objective.
    poses : Poses or sequence of arrays
        The poses to judge; of a model the values of its constrained `variables`. None, as `truth`
        or `initial` of a graph that came without, is an error.
    gap : float
        The relative gap to certify.

    Returns
    -------
    Certificate or ModelCertificate
        The bound, and how far the cost of the poses is above it.

    Raises
    ------
    SettingError
        Unless the gap is positive and finite.
    GraphError
        When the poses do not fit the graph.

    Examples
    --------
    >>> import numpy as np
    >>> from pgo_models.graphs.scenes import grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> certificate = certify(problem, chordal_start(problem))
    >>> certificate
    Certificate(F=118.6633298, gap=0.183, NOT_CERTIFIED)
    >>> certificate.source.name, bool(0 < certificate.lower_bound <= certificate.poses_objective)
    ('POLISHED', True)
    """
    if not isinstance(problem, PGOProblem | PoseGraph):
        return _certificate_of_model(problem, poses, gap)
    given: object = poses
    if not isinstance(given, Poses):
        why = "the graph came without these" if given is None else f"poses is {given!r:.60}"
        raise SettingError(f"{why}; give Poses, as solve returns them")
    problem = as_problem(problem)
    poses = check_poses(problem.graph, given)
    poses = problem.graph.completed(poses)  # a landmark has no rotation of its own
    near = problem.graph.near_zero(poses)
    certificate = _certificate_near(problem, near, gap)
    # What nothing measures costs nothing, wherever the poses given are.
    measured = problem.measured
    if measured is not problem or problem.graph.has_far_priors:
        certificate = judge(measured, poses, certificate)
    return _beside_polished(problem, near, certificate)


def certify_to_digits(
    problem: PGOProblem, poses: Poses, certificate: Certificate, written: WrittenDigits
) -> Certificate | None:
    """Certificate of the optimum that poses of a file are, to the digits that they are written in.

    A few digits of optimal poses cost more than the optimum, most on graphs with little noise.

    Parameters
    ----------
    problem : PGOProblem
        The problem.
    poses : Poses
        The poses of the file.
    certificate : Certificate
        Theirs, which has the poses that Newton leads to.
    written : WrittenDigits
        Digits of the file.

    Returns
    -------
    Certificate or None
        That of the polished poses; None where they are not certified, or do not round to the poses
        given.
    """
    if written == ALL_DIGITS:
        return None
    near = problem.graph.near_zero(problem.graph.completed(poses))
    polished = certificate.poses
    if not _round_to(polished.aligned_to(near), near, written, problem.graph):
        return None
    of_polished = judge(problem.measured, polished, certificate)
    return of_polished if of_polished.is_certified else None


def _round_to(poses: Poses, given: Poses, written: WrittenDigits, graph: PoseGraph) -> bool:
    """Whether poses, moved as a whole, round to the given ones.

    A file mostly has some pose at the identity, exactly: then that is where both agree. Else they
    are aligned, which takes another half of a unit of the last digit.
    """
    chosen = graph.in_files
    is_identity = (given.t == 0.0).all(axis=1) & (np.eye(graph.d) == given.R).all(axis=(1, 2))
    anchors = chosen[is_identity[chosen] & ~np.isin(chosen, graph.landmarks)]
    halves = 1.0 if len(anchors) else 2.0
    moved = poses.anchored_to(given, int(anchors[0])) if len(anchors) else poses.aligned_to(given)
    t = given.t[chosen]
    sizes = np.abs(t + graph.world_point).max(axis=1)
    units_t = written.units(np.where(sizes > 0.0, sizes, np.abs(t).max(initial=1.0)))
    if not len(anchors):
        units_t = np.maximum(units_t, np.median(units_t))
    if (np.abs(moved.t[chosen] - t).max(axis=1) > _HALF * halves * units_t).any():
        return False
    # An angle has up to pi, and the numbers of a quaternion up to one turn by twice their errors.
    unit_R = float(written.units(np.array([np.pi if graph.d == 2 else 0.5]))[0])
    bodies = graph.bodies
    turns = np.swapaxes(given.R[bodies], 1, 2) @ moved.R[bodies] - np.eye(graph.d)
    angles = np.linalg.norm(turns, axis=(1, 2)) / np.sqrt(2.0)
    most = _HALF * halves * unit_R * (1.0 if graph.d == 2 else 4.0)
    return bool(angles.max() <= most)


def _certificate_of_model(
    problem: object, values: Poses | Sequence[Array] | None, gap: float
) -> "ModelCertificate":
    # cvxpy is slow to import, and poses need none of it
    from pgo_models.convex.orthogonality import OrthogonalProblem
    from solvers.convex.certify_model import certify_model

    if not isinstance(problem, OrthogonalProblem):
        raise SettingError(
            f"problem is {problem!r:.60}; give a PGOProblem, a PoseGraph or an OrthogonalProblem"
        )
    return certify_model(problem, cast(Sequence[Array], values), gap)


def _certificate_near(problem: PGOProblem, poses: Poses, gap: float) -> Certificate:
    """`certify` for poses that are not far from zero."""
    stationarity = relative_decrement(problem, poses)
    is_stationary = stationarity <= STATIONARY_DECREMENT
    if is_stationary and problem.is_quadratic:
        certificate = certify_at(problem, poses, gap, stationarity)
    else:
        polished = certify_at(problem, polish(problem, poses), gap, stationarity)
        source = BoundSource.REFINED if is_stationary else BoundSource.POLISHED
        certificate = judge(problem, poses, replace(polished, source=source))
    steps = (_beside_the_chordal_start, _by_complex_numbers, _by_smaller_matrices, _by_terms)
    for improve in steps:
        if not bound_is_tight(problem, certificate):
            certificate = _improved(improve, problem, poses, certificate)
    return certificate


def _beside_polished(problem: PGOProblem, given: Poses, certificate: Certificate) -> Certificate:
    """The certificate, with how far poses that are not certified are from the best ones known.

    Where these fit every edge to rounding, poses close to them are exact (`fit_beside_exact`).
    """
    if certificate.is_certified or not certificate.poses_objective < certificate.objective:
        return certificate
    measured = problem.measured
    best = judge(measured, certificate.poses, certificate)
    if best.fit.is_to_rounding:
        fit = fit_beside_exact(measured, given, certificate.objective_at_most)
        if fit.is_exact:
            return replace(certificate, fit=fit, verdict=Verdict.EXACT)
    polished = Polished.of(problem, given, certificate.poses, best.is_certified)
    return replace(certificate, polished=polished)


def _improved(
    improve: Callable[[PGOProblem, Poses, Certificate], Certificate],
    problem: PGOProblem,
    poses: Poses,
    certificate: Certificate,
) -> Certificate:
    """The better certificate of a search for one; the given one, and a warning, where it fails."""
    try:
        return improve(problem, poses, certificate)
    except FAILURES as error:
        text = f"a search for a better bound failed ({error}); the bound before it stands"
        warnings.warn(text, GraphWarning, stacklevel=3)
        return certificate


def _beside_the_chordal_start(
    problem: PGOProblem, poses: Poses, certificate: Certificate
) -> Certificate:
    """The better of the certificate and one from where the chordal start polishes to."""
    start = polish(problem.convex_part, chordal_start(problem.convex_part))
    reached = polish(problem, start)
    other = certify_at(problem, reached, certificate.wanted_gap, certificate.stationarity)
    # Of equal bounds, as two zeros, the one with the better poses.
    if (other.lower_bound, -other.poses_objective) > (
        certificate.lower_bound,
        -certificate.poses_objective,
    ):
        return judge(problem, poses, replace(other, source=BoundSource.CHORDAL))
    return certificate


def _by_smaller_matrices(
    problem: PGOProblem, poses: Poses, certificate: Certificate
) -> Certificate:
    """The certificate, or a better one of chi2 by smaller information matrices."""
    return with_shrunk_information(problem, certificate)


def _by_complex_numbers(problem: PGOProblem, poses: Poses, certificate: Certificate) -> Certificate:
    """The certificate, or a better one by the relaxation with complex numbers, in the plane."""
    if not has_complex_form(problem):
        return certificate
    method = ComplexRelaxation()
    finished: Outcome[ComplexState] = RunMonitor().run(method, problem, certificate.poses)
    gap = certificate.wanted_gap
    candidates = certificates_of_relaxation(problem, method, finished.state, gap)
    best = max(candidates, key=lambda known: known.lower_bound)
    if best.lower_bound <= certificate.lower_bound:
        return certificate
    best = replace(best, stationarity=certificate.stationarity, source=BoundSource.COMPLEX)
    return judge(problem, poses, best)


def _by_terms(problem: PGOProblem, poses: Poses, certificate: Certificate) -> Certificate:
    """The certificate, or a better one in space by handedness terms that an ascent finds.

    They vanish at the poses that the bound was found at.
    """
    if problem.d == 2:
        return certificate
    ground = problem.at_best_translations(certificate.poses)
    at_bound = replace(certificate, objective=certificate.poses_objective)
    terms, _ = HandednessSearch().run(problem, ground, RunMonitor())
    certificate_with_terms = with_terms(problem, at_bound, terms, ground)
    if certificate_with_terms is at_bound:
        return certificate
    return judge(problem, poses, replace(certificate_with_terms, source=certificate.source))
