"""Rotation averaging: the rotations alone, min sum_e kappa ||R_j - R_i R_ij||_F^2 over SO(d)^n.

It is the rotation part tr(Y^T L Y) of F (the paper's equation (16) without translations;
Rosen et al. 2019, section 4; Dellaert et al. 2020, *Shonan Rotation Averaging*).

X and M keep the layout that they have for poses, so that every method for F applies. X has zeros
for the translations, whatever poses are given, and M is blockdiag(M_tt, L). The rows of M_tt are
padding. They hold the Laplacian of sum_e tau ||t_j - t_i||^2 with a tau > 0 for every kappa > 0,
which is zero at t = 0, where the gradient in t is zero, too: no method moves a translation. What is
proved is about L: proofs leave out the rows of translations.
"""

from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.edge_cost import EdgeCost
from pgo_models.problem.rotation_weights import RotationWeights, ScaledIdentities


@dataclass(frozen=True, eq=False)
class RotationAveraging(EdgeCost):
    """Cost of rotations alone, tr(W delta_R delta_R^T) of every edge: kappa ||delta_R||_F^2 in F.

    Measured translations, and those of poses, are ignored.

    Parameters
    ----------
    tau : (m,) array
        Weights of the padding (see above). Costs, minima and bounds do not depend on them.
    rotation : RotationWeights
        Weights W of the rotation residuals.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import circle
    >>> from pgo_models.problem.problem import PGOProblem
    >>> from pgo_models.problem.weighting import Weighting
    >>> graph = circle(np.random.default_rng(0))
    >>> problem = PGOProblem(graph, weighting=Weighting.ROTATIONS)
    >>> Y = graph.truth.stacked()[25:]
    >>> bool(np.isclose(problem.objective(graph.truth), np.sum(Y * (problem.L @ Y))))
    True
    """

    @classmethod
    def of(cls, graph: PoseGraph) -> "RotationAveraging":
        """Rotation averaging with the precisions kappa of a graph.

        Parameters
        ----------
        graph : PoseGraph
            The graph whose relative rotations are averaged.

        Returns
        -------
        RotationAveraging
            Its cost, that of `Weighting.ROTATIONS`.
        """
        return cls.with_weights(ScaledIdentities(graph.kappa))

    @classmethod
    def with_weights(cls, rotation: RotationWeights) -> "RotationAveraging":
        """Rotation averaging with weights W; tau is the size of W, so that M is well scaled.

        Parameters
        ----------
        rotation : RotationWeights
            Weights of the rotation residuals.

        Returns
        -------
        RotationAveraging
            The cost.
        """
        return cls(rotation.norm_bound, rotation)

    @property
    def has_translations(self) -> bool:
        """False: translations are no unknowns."""
        return False

    def arrays(self, d: int) -> list[Array]:
        """W alone: the padding determines nothing."""
        return [self.W(d)]

    def seen_offsets(self, t_ij: Array) -> Array:
        """Zeros, (m, d): the padding asks for t_j = t_i."""
        return np.zeros_like(t_ij)

    def seen_poses(self, poses: Poses) -> Poses:
        """The poses with zeros for translations; those that have them already as they are."""
        if not poses.t.any():
            return poses
        return poses.with_translations(np.zeros_like(poses.t))

    def is_seen(self) -> tuple[BoolArray, BoolArray]:
        """That the cost depends on no delta_t, and on which delta_R; (m,) each."""
        return np.zeros(len(self.tau), dtype=bool), self.rotation.is_used
