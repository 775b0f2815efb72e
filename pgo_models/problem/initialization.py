"""Starts: noisy truth (GPS / IMU), odometry, a spanning tree, and the chordal relaxation."""

from dataclasses import replace

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.csgraph import breadth_first_order

from pgo_models.errors import GraphError, SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import (
    Array,
    BoolArray,
    exp_map,
    project_to_rotations,
    unstack_transposes,
    vee,
)
from pgo_models.graphs.pose_graph import IntArray, PoseGraph, edge_counts
from pgo_models.problem.cholesky import analyze, factorize_damped
from pgo_models.problem.matrices import rotation_columns
from pgo_models.problem.ordering import row_order
from pgo_models.problem.problem import PGOProblem

# poses up to which the analysis of M, which others need, saves more than its larger factor costs
_SHARED = 10_000


def odometry_start(graph: PoseGraph) -> Poses:
    """Compose the measurements i -> i + 1 from pose 0 on; the first of repeated ones counts.

    Parameters
    ----------
    graph : PoseGraph
        A graph with an edge from every pose to the next.

    Returns
    -------
    Poses
        The start, with pose 0 at (I, 0).

    Raises
    ------
    GraphError
        When a link i -> i + 1 is missing: `spanning_tree_start` needs none.

    Examples
    --------
    >>> turn = np.eye(2)[None].repeat(2, axis=0)
    >>> step = np.array([[1.0, 0.0], [1.0, 0.0]])
    >>> graph = PoseGraph(3, [0, 1], [1, 2], turn, step, np.ones(2), np.ones(2))
    >>> odometry_start(graph).t.tolist()
    [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]
    """
    n = graph.num_poses
    forward = np.flatnonzero(graph.j == graph.i + 1)
    edge = np.full(n - 1, -1)
    edge[graph.i[forward][::-1]] = forward[::-1]
    if n > 1 and edge.min() < 0:
        missing = int(np.argmin(edge))
        link = f"from pose {graph.pose_name(missing)} to {graph.pose_name(missing + 1)}"
        raise GraphError(f"no odometry {link}; use spanning_tree_start() or chordal_start()")
    return _compose(graph, np.arange(n), np.arange(-1, n - 1), edge, np.ones(n - 1, dtype=bool))


def spanning_tree_start(graph: PoseGraph, root: int = 0) -> Poses:
    """Compose measurements along a breadth-first spanning tree, as the paper does for SLAM.

    Parameters
    ----------
    graph : PoseGraph
        A connected graph.
    root : int
        The pose at (I, 0).

    Returns
    -------
    Poses
        The start.

    Raises
    ------
    GraphError
        When the graph is not connected.
    SettingError
        When root is no pose.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> graph = grid(np.random.default_rng(0))
    >>> spanning_tree_start(graph).t[0].tolist()
    [0.0, 0.0, 0.0]
    """
    graph.check_connected()
    if not 0 <= root < graph.num_poses:
        raise SettingError(f"root is {root}; give a pose, 0 to {graph.num_poses - 1}")
    if root == graph.world and graph.is_world_loose:
        raise SettingError("root is the world, of which positions alone are known; give a pose")
    order, parent, edge = spanning_tree(graph, root)
    return _with_world_fitted(
        graph, _compose(graph, order, parent, edge, graph.j[edge] == order[1:])
    )


def spanning_tree(graph: PoseGraph, root: int) -> tuple[IntArray, IntArray, IntArray]:
    """Breadth-first tree: poses in its order, the parent of every pose, and the edges to order[1:].

    Of edges that say something of rotations: a loose world pose is not in it.
    """
    n = graph.num_poses
    turning = np.flatnonzero(graph.kappa > 0)
    order, parent = breadth_first_order(
        edge_counts(graph.i[turning], graph.j[turning], n), root, directed=False
    )
    ends = np.stack([graph.i, graph.j])[:, turning]
    child = order[1:]
    pairs, first = np.unique(ends.min(axis=0) * n + ends.max(axis=0), return_index=True)
    branches = np.minimum(child, parent[child]) * np.int64(n) + np.maximum(child, parent[child])
    return order, parent, turning[first[np.searchsorted(pairs, branches)]]


def chordal_start(problem: PGOProblem, averaged: bool = False) -> Poses:
    """Solve for rotations without their constraints, project, and take the best translations.

    The sum sum_e kappa ||R_j - R_i R_ij||_F^2 is minimised with R_0 = I. This is the chordal
    relaxation of rotation averaging (Martinec & Pajdla 2007; Carlone, Tron, Daniilidis & Dellaert
    2015). Jointly with translations the relaxed R_i would shrink, as noise makes a smaller map fit
    better, the more the larger it is. Position measurements alone leave the rotation of the world
    open: it is fitted to positions found without.

    Parameters
    ----------
    problem : PGOProblem
        A problem with a quadratic cost, such as the convex part of one.
    averaged : bool
        Whether in the plane the rotations take a step of rotation averaging, too: the constrained
        minimum of the same sum is often near, and Newton from it needs a factorisation less on
        large graphs.

    Returns
    -------
    Poses
        The start.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> along_a_tree = spanning_tree_start(problem.graph)
    >>> bool(problem.objective(chordal_start(problem)) < problem.objective(along_a_tree))
    True
    """
    graph = problem.graph
    world = problem.graph.world
    if world is not None and graph.is_world_loose:
        inner = np.delete(np.arange(graph.num_poses), world)
        weights = problem.weights.of_edges(~graph.is_prior)
        inner_start = chordal_start(
            replace(problem, graph=graph.subgraph(inner), weighting=weights), averaged
        )
        poses = Poses(
            np.insert(inner_start.R, world, np.eye(problem.d), axis=0),
            np.insert(inner_start.t, world, 0.0, axis=0),
        )
        return problem.with_best_translations(_with_world_fitted(graph, poses).R)
    n = problem.num_poses
    (K, b) = relaxed_rotations(problem, 0)
    if n <= _SHARED:
        Y = factorize_damped(problem.analysis, K).solve(b)[n:]
    else:
        K_RR = K[n:, n:].tocsc()
        analysis = analyze(K_RR, problem.backend, row_order(problem.pose_order, problem.d))
        Y = factorize_damped(analysis, K_RR).solve(b[n:])
    R = project_to_rotations(unstack_transposes(Y))
    return problem.with_best_translations(_averaged(problem, R) if averaged else R)


def _averaged(problem: PGOProblem, R: Array) -> Array:
    """Rotations, (n, 2, 2), at the minimum of a majorant of sum_e kappa ||R_j - R_i R_ij||^2.

    The sum is no larger there.

    An edge off by the angle r costs 4 kappa (1 - cos r), whose second derivative is at most 4
    kappa. Where that is 4 s tau instead, s the largest kappa / tau, the turns of least cost have
    the matrix of the translations, M_tt.
    """
    graph = problem.graph
    weights = problem.weights
    if problem.d != 2 or weights.rotation.has_own_axes or not (weights.tau > 0.0).all():
        return R
    sine = vee(np.swapaxes(R[graph.i] @ graph.R_ij, 1, 2) @ R[graph.j])
    pull = weights.kappa[:, None] * sine / (weights.kappa / weights.tau).max()
    return R @ exp_map(
        problem.solve_translations(problem.incidence.begins @ pull - problem.incidence.ends @ pull)
    )


def relaxed_rotations(problem: PGOProblem, held: int | None) -> tuple[csc_array, Array]:
    """K, (N, N), and b, (N, d), with K X = b where tr(Y^T L Y) is least.

    The `held` pose, if there is one, has R = I.

    Y are the rotations of X. K has the pattern of M: L where that has rotations, and the identity
    for translations.
    """
    graph = problem.graph
    n = problem.num_poses
    d = problem.d
    _, own_i, _, own_j = problem.weights.matrix_blocks(graph.R_ij, np.zeros_like(graph.t_ij))
    data = problem.M.data.copy()
    b = np.zeros((problem.side, d))
    data[problem.block_positions] = problem.incidence.at_both(own_i, own_j)
    problem.leave_out(data, np.arange(n), 1.0)
    if held is not None:
        fixed = rotation_columns(np.array([held]), n, d)[0]
        b -= problem.with_pattern_of_M(data)[:, fixed].toarray()
        problem.leave_out(data, fixed, 1.0)
        b[fixed] = np.eye(d)
    return problem.with_pattern_of_M(data), b


def _with_world_fitted(graph: PoseGraph, poses: Poses) -> Poses:
    """Poses with that of a loose world where the positions fit.

    There sum_e ||t_j - t_w - R_w t_wj||^2 is least.
    """
    if graph.world is None or not graph.is_world_loose:
        return poses
    measured = Poses.of_points(graph.t_ij[graph.is_prior])
    R = poses.R.copy()
    t = poses.t.copy()
    fitted = measured.aligned_to(Poses.of_points(t[graph.j[graph.is_prior]]))
    R[graph.world] = fitted.R[0]
    t[graph.world] = fitted.t[0] - fitted.R[0] @ measured.t[0]
    return Poses(R, t)


def _compose(
    graph: PoseGraph, order: IntArray, parent: IntArray, edge: IntArray, forward: BoolArray
) -> Poses:
    """Poses of a tree: order[k] hangs on its parent by edge[k-1], which ends at it if forward[k-1].

    Pointer jumping: every pose holds its transform from an ancestor, which doubles its distance
    until it is the root.
    """
    n = graph.num_poses
    d = graph.d
    root = order[0]
    child = order[1:]
    R = np.broadcast_to(np.eye(d), (n, d, d)).copy()
    t = np.zeros((n, d))
    R_step = graph.R_ij[edge]
    t_step = graph.t_ij[edge]
    back = ~forward
    R_step[back] = np.swapaxes(R_step[back], 1, 2)
    t_step[back] = -np.einsum("nab,nb->na", R_step[back], t_step[back])
    R[child] = R_step
    t[child] = t_step
    ancestor = np.where(parent >= 0, parent, root)
    while (ancestor != root).any():
        t = t[ancestor] + np.einsum("nab,nb->na", R[ancestor], t)
        R = project_to_rotations(R[ancestor] @ R)
        ancestor = ancestor[ancestor]
    return Poses(R, t)
