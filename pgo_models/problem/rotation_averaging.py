"""Rotation averaging: the rotations alone, min sum_e kappa ||R_j - R_i R_ij||_F^2 over SO(d)^n.

It is the rotation part tr(Y^T L Y) of F (the paper's equation `min overall` without translations;
Rosen et al. 2019, section 4; Dellaert et al. 2020, *Shonan Rotation Averaging*).
"""

from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.edge_cost import EdgeCost
from pgo_models.problem.rotation_weights import ScaledIdentities


@dataclass(frozen=True, eq=False)
class RotationAveraging(EdgeCost):
    """Cost kappa ||R_j - R_i R_ij||_F^2 + tau ||t_j - t_i||^2 of every edge.

    Measured translations are ignored. For any rotations the second term is zero at its minimum,
    where all translations are equal. So minima and lower bounds over poses are those over rotations
    alone. All methods for F apply: M is block diagonal, with a positive semidefinite Laplacian for
    the translations and L for the rotations.

    Parameters
    ----------
    tau : (m,) array
        Positive weights of ||t_j - t_i||^2; the minimum does not depend on them.
    rotation : RotationWeights
        Weights kappa I of the rotation residuals.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import circle
    >>> from pgo_models.problem.problem import PGOProblem
    >>> graph = circle(np.random.default_rng(0))
    >>> problem = PGOProblem(graph, weighting=RotationAveraging.of(graph))
    >>> truth = graph.truth.with_translations(np.zeros((25, 3)))
    >>> Y = truth.stacked()[25:]
    >>> bool(np.isclose(problem.objective(truth), np.sum(Y * (problem.L @ Y))))
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
            Its cost, to be given to a `PGOProblem` as its weighting.
        """
        rotation = ScaledIdentities(graph.kappa)
        return cls(graph.tau, rotation)

    def seen_offsets(self, t_ij: Array) -> Array:
        """Zeros, (m, d): every edge asks for t_j = t_i."""
        return np.zeros_like(t_ij)
