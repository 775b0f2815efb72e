"""A pose graph with terms and constraints of one's own as a cvxpy model with rotations.

    minimise   sum_e kappa ||R_j - R_i R_ij||_F^2 + tau ||t_j - t_i - R_i t_ij||^2 + terms

over rotations R_i and t, the problem that `solvers.ExtendedSOC` goes through. Where the terms are
quadratic, it has the certificate of any such model, `solvers.certify(model, poses.R)`.
"""

import cvxpy as cp
import numpy as np
from scipy.sparse import diags_array

from pgo_models.convex.graph_subproblem import (
    Changer,
    Unknowns,
    change_of,
    check_terms_are_added_to_F,
    pose_variables,
    weights_of_kept_edges,
)
from pgo_models.convex.orthogonality import OrthogonalProblem
from pgo_models.problem.matrices import residual_matrix
from pgo_models.problem.problem import PGOProblem


def graph_model(problem: PGOProblem, changer: Changer | None = None) -> OrthogonalProblem:
    """Pose a graph as a model with one variable for every rotation, and one for all t.

    Parameters
    ----------
    problem : PGOProblem
        The problem of the graph, whose cost is F.
    changer : callable or None
        Given the `PoseVariables`, it returns the `ModelChange`, as for `solvers.ExtendedSOC`.

    Returns
    -------
    OrthogonalProblem
        Its `variables` are the rotations, in the order of the poses, its first other is t, (n, d).

    Raises
    ------
    SettingError
        If the cost of the problem is not F, or a term or constraint is not convex.

    Examples
    --------
    >>> from pgo_models import ModelChange, PGOProblem
    >>> from pgo_models.graphs.scenes import grid
    >>> def level(x) -> ModelChange:
    ...     return ModelChange(terms=[10.0 * cp.sum_squares(x.t[:][:, 2])])
    >>> graph = grid(np.random.default_rng(0))
    >>> model = graph_model(PGOProblem(graph), level)
    >>> len(model.variables) == graph.num_poses
    True
    """
    check_terms_are_added_to_F(problem)
    graph = problem.graph
    n = graph.num_poses
    d = graph.d
    R = [cp.Variable((d, d), name=f"R[{i}]") for i in range(n)]
    t = cp.Variable((n, d), name="t")
    X = cp.vstack([t, *(R_i.T for R_i in R)])
    A = residual_matrix(graph)
    variables = pose_variables(graph, Unknowns.POSES, A, X)
    change = change_of(changer, variables)
    weights = weights_of_kept_edges(graph, change)
    counted = np.flatnonzero(weights)
    roots = diags_array(np.sqrt(weights[counted]))
    J = sum(change.terms, cp.sum_squares(roots @ A[counted] @ X))
    return OrthogonalProblem(cp.Problem(cp.Minimize(J), list(change.constraints)), rotations=R)
