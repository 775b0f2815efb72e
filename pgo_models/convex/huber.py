"""Huber's loss of whole edges as a change of the cvxpy model: squares up to a threshold, straight on beyond."""

import cvxpy as cp
import numpy as np

from pgo_models.convex.graph_subproblem import Changer, ModelChange, PoseVariables, Unknowns
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.matrices import residual_matrix


def huber_change(edges: IntArray, thresholds: Array) -> Changer:
    """Changer for `graph_qp` and `ExtendedSOC`: r_e^2 becomes 2 c_e r_e - c_e^2 beyond r_e^2 = c_e^2 (Huber 1964).

    Parameters
    ----------
    edges : (k,)
        Those with this loss; the others keep their squares.
    thresholds : (m,)
        c_e^2 of all edges, as of `chi2_thresholds`.

    Raises
    ------
    SettingError
        When the program has no translations.
    """

    def change(unknown: PoseVariables) -> ModelChange:
        graph = unknown.graph
        if unknown.unknowns is Unknowns.ROTATIONS or len(unknown.poses) < graph.num_poses:
            raise SettingError("the loss is of whole edges of the whole graph; use graph_qp with Unknowns.POSES")
        A, w = residual_matrix(graph)
        d, m = graph.d, graph.num_edges
        rows = np.concatenate([edges[:, None], m + d * edges[:, None] + np.arange(d)], axis=1).ravel()
        rho = cp.multiply(np.sqrt(w[rows])[:, None], A[rows] @ unknown.X)
        c = np.sqrt(thresholds[edges])
        r = cp.norm(cp.reshape(rho, (len(edges), (d + 1) * d), order="C"), 2, axis=1)
        loss = cp.sum(cp.multiply(c**2, cp.huber(cp.multiply(1.0 / c, r))))
        return ModelChange(terms=[loss], replaced_edges=edges.tolist())

    return change
