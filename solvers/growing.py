"""Graphs that grow: new poses start where their edges to the known ones put them, and Newton goes on from there.

An update ends where the gap asked for is proven, not at rounding level: mostly one factorisation, and the certificate.
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
from solvers.pipeline import Pipeline, solve
from solvers.result import OUT_OF_TIME
from solvers.solution import Solution

_SHARE = 0.01  # of the gap that Newton may leave F above its minimum: the bound can be ten times as far below it


def extend(solution: Solution, graph: PoseGraph, pipeline: Pipeline | None = None) -> Solution:
    """Solve a graph that has grown out of the solution's, from the solution.

    `graph` has poses of the solution, told by their ids, and new ones. Newton alone first; where its certificate fails,
    the whole pipeline: the stages are those of both. A GraphError when it has none of its poses, or is not connected.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> graph = grid(np.random.default_rng(0))
    >>> solution = solve(graph.subgraph(np.arange(18)))
    >>> extend(solution, graph).is_certified
    True
    """
    weighting, pipeline = solution.problem.weighting, pipeline if pipeline is not None else Pipeline()
    known = weighting if isinstance(weighting, Weighting) else Weighting.ISOTROPIC
    problem = PGOProblem(graph, solution.problem.backend, known)
    start = extended_poses(problem, solution.problem.graph.pose_ids, solution.poses)
    if getattr(pipeline.soc, "changer", None) is not None:  # Newton alone would leave out its terms
        return solve(problem, pipeline, start)
    newton = replace(pipeline.newton, tolerance=max(pipeline.newton.tolerance, _SHARE * pipeline.gap))
    update = solve(problem, replace(pipeline, soc=None, newton=newton, second_try=False, staircase=None), start)
    if update.status in OUT_OF_TIME or not update.certificate.can_improve:
        return update
    whole = solve(problem, pipeline, start)
    return replace(whole, stages=update.stages + whole.stages, seconds=update.seconds + whole.seconds)


def extended_poses(problem: PGOProblem, ids: IntArray, poses: Poses) -> Poses:
    """Rotations of poses with ids stay, X of the others minimises tr(X^T M X), then all translations are the best.

    A GraphError when no pose of the problem has one of the ids.
    """
    n, d, convex = problem.num_poses, problem.d, problem.convex_part
    _, old, place = np.intersect1d(problem.graph.pose_ids, ids, return_indices=True)
    if not len(old):
        raise GraphError(f"{problem.graph.name} has none of the {len(ids)} poses solved before; solve it on its own")
    R, t = np.broadcast_to(np.eye(d), (n, d, d)).copy(), np.zeros((n, d))
    R[old], t[old] = poses.R[place], poses.t[place]
    X, new = Poses(R, t).stacked(), np.setdiff1d(np.arange(n), old)
    if len(new):
        rows = columns_of(new, n, (1, d))
        X[rows], columns = 0.0, convex.M[:, rows]
        X[rows] = factorize(columns[rows].tocsc(), problem.backend).solve(-(columns.T @ X))
        R[new], t[new] = project_to_rotations(unstack_transposes(X[n:])[new]), X[new]
    return problem.at_best_translations(Poses(R, t))
