"""Huber's loss of whole edges as a change of a model: square up to a threshold, linear beyond."""

import cvxpy as cp
import numpy as np

from pgo_models.convex.graph_subproblem import Changer, ModelChange, PoseVariables
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray


def huber_change(edges: IntArray, thresholds: Array) -> Changer:
    """Changer for `graph_qp` and `ExtendedSOC` that gives edges Huber's loss (Huber 1964).

    The cost r_e^2 of an edge becomes 2 c_e r_e - c_e^2 where r_e > c_e.

    Parameters
    ----------
    edges : (k,) array
        Numbers of the edges; the others keep their squares.
    thresholds : (m,) array
        c_e^2 of all edges, as of `chi2_thresholds`.

    Returns
    -------
    Changer
        It raises a SettingError when the program lacks unknowns of these edges.
    """

    def change(unknown: PoseVariables) -> ModelChange:
        graph = unknown.graph
        t_residuals = unknown.translation_residual[edges]
        matrices = unknown.rotation_residual[edges]
        shape_of_rows = (len(edges), graph.d**2)
        R_residuals = cp.reshape(matrices, shape_of_rows, order="C")
        root_tau = np.sqrt(graph.tau[edges])[:, None]
        root_kappa = np.sqrt(graph.kappa[edges])[:, None]
        weighted_t = cp.multiply(root_tau, t_residuals)
        weighted_R = cp.multiply(root_kappa, R_residuals)
        weighted = cp.hstack([weighted_t, weighted_R])
        r = cp.norm(weighted, 2, axis=1)
        c = np.sqrt(thresholds[edges])
        # cp.huber(x) is x^2, and 2 |x| - 1 beyond 1.
        relative = cp.multiply(1.0 / c, r)
        losses = cp.multiply(c**2, cp.huber(relative))
        total = cp.sum(losses)
        return ModelChange(terms=[total], replaced_edges=edges.tolist())

    return change
