"""Graphs that grow: new poses start where their edges put them, and Newton goes on from there.

An update ends where the gap that is asked for is proven, not at rounding level. It mostly takes one
factorisation and the certificate.
"""

from dataclasses import replace

import numpy as np

from pgo_models.errors import GraphError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import project_to_rotations, unstack_transposes
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.cholesky import factorize
from pgo_models.problem.matrices import columns_of
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.pipeline import solve
from solvers.request import Pipeline
from solvers.result import OUT_OF_TIME
from solvers.solution import Solution

# Share of the gap by which Newton may leave F above its minimum: the bound can be ten times as far
# below it.
_SHARE = 0.01


def extend(solution: Solution, graph: PoseGraph, pipeline: Pipeline | None = None) -> Solution:
    """Solve a graph that has grown out of another one, from the solution of that.

    Newton alone comes first. Where its certificate is wider than asked for, the whole pipeline
    follows, and the stages of the solution are those of both.

    Parameters
    ----------
    solution : Solution
        Of the graph before it has grown.
    graph : PoseGraph
        Poses of the solution, recognised by their ids, and new ones.
    pipeline : Pipeline, optional
        Settings of the stages; `Pipeline()` unless given.

    Returns
    -------
    Solution
        Of the whole graph.

    Raises
    ------
    GraphError
        When the graph has no pose of the solution, or is not connected.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> graph = grid(np.random.default_rng(0))
    >>> solution = solve(graph.subgraph(np.arange(18)))
    >>> extend(solution, graph).is_certified
    True
    """
    pipeline = pipeline if pipeline is not None else Pipeline()
    weighting = solution.problem.weighting
    if not isinstance(weighting, Weighting):
        weighting = Weighting.ISOTROPIC
    problem = PGOProblem(graph, solution.problem.backend, weighting)
    start = extended_poses(problem, solution.problem.graph.pose_ids, solution.poses)
    if pipeline.has_added_terms:  # Newton alone would leave them out
        return solve(problem, pipeline, start)
    tolerance = max(pipeline.newton.tolerance, _SHARE * pipeline.gap)
    newton = replace(pipeline.newton, tolerance=tolerance)
    # Terms are sought at the poses alone: the whole solve has the relaxation with hulls.
    search = pipeline.handedness
    terms = None if search is None else replace(search, hulls=None)
    newton_alone = replace(pipeline.with_newton_alone(newton), handedness=terms)
    update = solve(problem, newton_alone, start)
    if update.status in OUT_OF_TIME or not update.certificate.can_improve:
        return update
    whole = solve(problem, pipeline, start)
    stages = update.stages + whole.stages
    return replace(whole, stages=stages, seconds=update.seconds + whole.seconds)


def extended_poses(problem: PGOProblem, ids: IntArray, poses: Poses) -> Poses:
    """Poses of a graph that has grown, from the `poses` with these ids before.

    Rotations of known poses stay. The stacked X of the others minimises tr(X^T M X), and their
    rotations are projected. Then all translations are the best for the rotations. A GraphError when
    no pose of the problem has one of the ids.
    """
    n = problem.num_poses
    d = problem.d
    M = problem.convex_part.M
    _, known, place = np.intersect1d(problem.graph.pose_ids, ids, return_indices=True)
    if not len(known):
        raise GraphError(
            f"{problem.graph.name} has none of the {len(ids)} poses solved before; "
            "solve it on its own"
        )
    R = np.broadcast_to(np.eye(d), (n, d, d)).copy()
    t = np.zeros((n, d))
    R[known] = poses.R[place]
    t[known] = poses.t[place]
    new = np.setdiff1d(np.arange(n), known)
    if len(new):
        # M_new,new X_new = -M_new,known X_known
        X = Poses(R, t).stacked()
        rows = columns_of(new, n, (1, d))
        X[rows] = 0.0
        columns = M[:, rows]
        factor = factorize(columns[rows].tocsc(), problem.backend)
        X[rows] = factor.solve(-(columns.T @ X))
        R[new] = project_to_rotations(unstack_transposes(X[n:])[new])
        t[new] = X[new]
    return problem.at_best_translations(Poses(R, t))
