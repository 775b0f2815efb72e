"""The search for handedness terms: an ascent at given poses, and the relaxation with hulls."""

from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from scipy.sparse import csc_array

from pgo_models.certificates.dual_variables import multipliers
from pgo_models.certificates.handedness import HandednessTerms, distinct_pairs
from pgo_models.errors import NotPositiveDefiniteError, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import middle_pose
from pgo_models.problem.cholesky import factorize
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian
from pgo_models.problem.problem import PGOProblem
from pgo_models.relaxations.rotation_hull import matrices_at
from solvers.handedness.ascent import AscentState, HandednessAscent
from solvers.handedness.certificate_spectrum import HandedMatrix, HandedPoint
from solvers.handedness.complex_relaxation import ComplexRelaxation
from solvers.handedness.hull_lagrangian import HullLagrangian
from solvers.loop import RunMonitor
from solvers.result import Outcome, Stage

S = TypeVar("S")


@dataclass(frozen=True)
class HandednessSearch:
    """Settings of what tells rotations from reflections where the relaxation is loose.

    In space terms are sought, in the plane the relaxation with complex numbers is solved.

    Parameters
    ----------
    ascent : HandednessAscent
        What is tried first: terms that vanish at the poses.
    hulls : HullLagrangian or None
        The relaxation with hulls of rotations, where the ascent does not find such terms. It gives
        the best bound that multipliers and terms have, poses that the staircase may miss, and terms
        that the ascent begins with once more. None leaves it out.
    most_hull_poses : int
        Poses up to which that relaxation is solved; it takes about 55 CPU seconds of 1,000 poses.
    plane : ComplexRelaxation
        The relaxation with rotations as complex numbers, for graphs in the plane.

    Raises
    ------
    SettingError
        If `most_hull_poses` is negative.
    """

    ascent: HandednessAscent = field(default_factory=HandednessAscent)
    hulls: HullLagrangian | None = field(default_factory=HullLagrangian)
    most_hull_poses: int = 3000
    plane: ComplexRelaxation = field(default_factory=ComplexRelaxation)

    def __post_init__(self) -> None:
        check_settings(self, not_negative=["most_hull_poses"])

    def run(
        self, problem: PGOProblem, poses: Poses, monitor: RunMonitor, Pi: Array | None = None
    ) -> tuple[HandednessTerms, Stage]:
        """Return the best terms found at stationary poses, and the stage of the search.

        The poses have their best translations; of chi2 the terms are for the tangent there. The
        ascent begins with those of the multipliers Pi, (pairs, 4, 4), or with none.
        """
        i, j = distinct_pairs(problem.graph).T
        tangent = problem.tangent_at(poses)
        matrix = HandedMatrix(tangent, multipliers(problem, poses), poses, i, j)
        P = None if Pi is None else matrices_at(matrix.T, Pi)
        first = HandedPoint.first(matrix, P, self.ascent.num_eigenvalues)
        ascent: Outcome[AscentState] = monitor.run(self.ascent, first)
        return HandednessTerms.at(poses, i, j, ascent.state.point.P), stage_of_search(ascent)


def terms_can_help(problem: PGOProblem, poses: Poses, lower_bound: float) -> bool:
    """Whether handedness terms that are zero at stationary poses may raise a bound.

    Along moves of the poses by rotations and shifts, terms that are zero there are zero or more to
    second order. So they leave no more of S there than the second derivative of the cost. A bound
    above the given one needs S definite with an eta that costs less than the gap: it needs the
    Hessian to be so, of chi2 that of its tangent. A cost that is quadratic has a minimum there.
    """
    if problem.is_quadratic:
        return True
    n = problem.num_poses
    d = problem.d
    num_rotations = n - len(problem.graph.landmarks)
    gap = problem.objective(poses) - lower_bound
    eta = np.full(n, max(gap, 0.0) / (d * num_rotations))
    eta[problem.graph.landmarks] = 0.0
    Lambda = multipliers(problem, poses) - eta[:, None, None] * np.eye(d)
    tangent = problem.tangent_at(poses)
    ground = np.array([middle_pose(problem.graph)])
    layout = TangentLayout(n, d)
    of_ground = np.concatenate([layout.translations(ground)[0], layout.rotations(ground)[0]])
    free = np.delete(np.arange(layout.side), of_ground)
    hessian = csc_array(riemannian_hessian(tangent.at(poses), Lambda)[free][:, free])
    try:
        factorize(hessian, problem.backend)
    except NotPositiveDefiniteError:
        return False
    return True


def stage_of_search(outcome: Outcome[S]) -> Stage:
    """Stage of a search for a bound, which a time limit or Ctrl-C may end, but no failure."""
    return replace(Stage.of(outcome), finds_poses=False)
