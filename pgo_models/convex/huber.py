"""Huber's loss of whole edges as a change of the cvxpy model: squares up to a threshold, straight on beyond."""

import cvxpy as cp
import numpy as np

from pgo_models.convex.graph_subproblem import Changer, ModelChange, PoseVariables
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray


def huber_change(edges: IntArray, thresholds: Array) -> Changer:
    """Changer for `graph_qp` and `ExtendedSOC`: r_e^2 becomes 2 c_e r_e - c_e^2 beyond r_e^2 = c_e^2 (Huber 1964).

    For `edges`, (k,); the others keep their squares. `thresholds`, (m,), are c_e^2 of all edges, as of
    `chi2_thresholds`. A SettingError when the program lacks unknowns of these edges.
    """

    def change(unknown: PoseVariables) -> ModelChange:
        graph = unknown.graph
        turned = cp.reshape(unknown.rotation_residual[edges], (len(edges), graph.d**2), order="C")
        weighted = zip((graph.tau, graph.kappa), (unknown.translation_residual[edges], turned), strict=True)
        rho = cp.hstack([cp.multiply(np.sqrt(precision[edges])[:, None], rows) for precision, rows in weighted])
        c = np.sqrt(thresholds[edges])
        loss = cp.sum(cp.multiply(c**2, cp.huber(cp.multiply(1.0 / c, cp.norm(rho, 2, axis=1)))))
        return ModelChange(terms=[loss], replaced_edges=edges.tolist())

    return change
