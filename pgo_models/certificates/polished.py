"""Polished: where Newton's method takes poses that are not optimal, and why it moves them.

Poses of GTSAM are the minimum of another residual: the logarithm in SE(d), not the chord. Where a
step of GTSAM's own cost saves far less than a step of chi2, GTSAM had converged.
"""

import math
from dataclasses import dataclass

import numpy as np

from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.figures import rounded_up
from pgo_models.geometry.arrays import block_norms
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import log_map
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.gtsam_cost import gtsam_cost
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting, is_isotropic

_FAR_LESS = 0.1  # of what a step of chi2 saves: most of the gap is the residual's then


@dataclass(frozen=True)
class Polished:
    """Polished poses beside those given, in one frame: that of the priors, or else aligned.

    Parameters
    ----------
    metres, radians : float
        The longest move of a position, and the largest turn of a pose.
    is_certified : bool
        Whether the polished poses are certified.
    gtsam_cost : float
        Twice GTSAM's error of the poses given; nan where chi2 is not the cost, or the graph has
        landmarks or attitudes, which GTSAM measures otherwise.
    gtsam_decrease : float
        What a Gauss-Newton step should save of that, as a share.
    """

    metres: float
    radians: float
    is_certified: bool
    gtsam_cost: float = math.nan
    gtsam_decrease: float = math.nan

    @classmethod
    def of(
        cls, problem: PGOProblem, given: Poses, polished: Poses, is_certified: bool
    ) -> "Polished":
        """Compare poses of one problem, (n) each."""
        graph = problem.graph
        if graph.world is None:
            polished = polished.aligned_to(given)
        else:
            polished = polished.anchored_to(given, graph.world)
        bodies = graph.bodies
        turns = log_map(np.swapaxes(given.R[bodies], 1, 2) @ polished.R[bodies])
        moved = cls(
            float(block_norms(polished.t - given.t).max()) if problem.has_translations else 0.0,
            float(block_norms(turns).max(initial=0.0)),
            is_certified,
        )
        if len(graph.landmarks) or _has_attitudes(graph) or not _is_chi2(problem):
            return moved
        try:
            cost, decrease = gtsam_cost(graph, given)
        except NotPositiveDefiniteError:
            return moved
        return cls(moved.metres, moved.radians, is_certified, cost, decrease)

    @property
    def text(self) -> str:
        """How far the poses move."""
        certified = "certified; " if self.is_certified else ""
        degrees = rounded_up(math.degrees(self.radians), 2)
        return (
            f"{certified}at most {rounded_up(self.metres, 2)} m and {degrees} degrees "
            "from the poses given"
        )

    def as_dict(self) -> dict[str, float | bool | None]:
        """What `.json` files hold of it; None of GTSAM's cost where it is not known."""
        known = not math.isnan(self.gtsam_cost)
        return {
            "metres": self.metres,
            "degrees": math.degrees(self.radians),
            "is_certified": self.is_certified,
            "gtsam_cost": self.gtsam_cost if known else None,
            "gtsam_decrease": self.gtsam_decrease if known else None,
        }

    def reason(self, stationarity: float, cost: str) -> str:
        """Why the poses given are not optimal: GTSAM's cost, and what steps of both costs save."""
        is_minimum = self.gtsam_decrease <= _FAR_LESS * stationarity
        why = (
            "another residual, and near its minimum" if is_minimum else "stopped early, or rounded"
        )
        return (
            f"{self.gtsam_cost:.10g}, twice GTSAM's error; a step saves about "
            f"{self.gtsam_decrease:.2g} of it, and {stationarity:.2g} of {cost}: {why}"
        )


def _has_attitudes(graph: PoseGraph) -> bool:
    """Whether a prior measures a part of a rotation, as gravity does."""
    if graph.information is None:
        return False
    blocks = graph.information[graph.is_prior][:, graph.d :, graph.d :]
    ranks = np.linalg.matrix_rank(blocks, hermitian=True)
    return bool(((ranks > 0) & (ranks < blocks.shape[1])).any())


def _is_chi2(problem: PGOProblem) -> bool:
    """Whether the cost of a problem is that of whole information matrices, which GTSAM has."""
    graph = problem.graph
    if problem.weighting is Weighting.INFORMATION:
        return True
    has_matrices = graph.information is not None
    return problem.weighting is Weighting.ISOTROPIC and has_matrices and is_isotropic(graph)
