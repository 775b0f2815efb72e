"""Initial poses: from odometry, from a spanning tree, and from the chordal relaxation."""

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
from pgo_models.graphs.precisions import partial_edges
from pgo_models.problem.cholesky import analyze, factorize_damped
from pgo_models.problem.costs import EdgeCost
from pgo_models.problem.matrices import assemble, rotation_columns
from pgo_models.problem.ordering import row_order
from pgo_models.problem.problem import PGOProblem


def odometry_start(graph: PoseGraph) -> Poses:
    """Compose the measurements i -> i + 1 from pose 0 at (I, 0) on; of repeated ones the first.

    A GraphError when such an edge is missing; `spanning_tree_start` does not need one.

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
    # Written last to first, so that the first of repeated edges remains.
    backwards = forward[::-1]
    edge = np.full(n - 1, -1)
    edge[graph.i[backwards]] = backwards
    if n > 1 and edge.min() < 0:
        missing = int(np.argmin(edge))
        link = f"from pose {graph.pose_name(missing)} to {graph.pose_name(missing + 1)}"
        raise GraphError(f"no odometry {link}; use spanning_tree_start() or chordal_start()")
    order = np.arange(n)
    parent = np.arange(-1, n - 1)
    is_forward = np.ones(n - 1, dtype=bool)
    return compose_along_tree(graph, order, parent, edge, is_forward)


def spanning_tree_start(graph: PoseGraph, root: int = 0) -> Poses:
    """Compose measurements along a breadth-first spanning tree, as the paper does for SLAM.

    The root is at (I, 0). A GraphError when the graph is not connected, a SettingError when the
    root is no pose.

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
    is_forward = graph.j[edge] == order[1:]
    poses = compose_along_tree(graph, order, parent, edge, is_forward)
    return with_world_fitted(graph, poses)


def spanning_tree(graph: PoseGraph, root: int) -> tuple[IntArray, IntArray, IntArray]:
    """Breadth-first tree: poses in its order, the parent of every pose, and the edges to order[1:].

    The tree has edges with a rotation weight only, so that a world pose of which positions alone
    are known is not in it. Edges that do not measure all of a pose are in it only where the others
    do not lead to every pose.
    """
    n = graph.num_poses
    usable = np.flatnonzero(graph.kappa > 0)
    complete = usable[(graph.tau[usable] > 0) & ~partial_edges(graph)[usable]]
    if len(complete) < len(usable):
        reached = breadth_first_order(
            edge_counts(graph.i[complete], graph.j[complete], n), root, directed=False
        )[0]
        usable = complete if len(reached) == n else usable
    i = graph.i[usable]
    j = graph.j[usable]
    order, parent = breadth_first_order(edge_counts(i, j, n), root, directed=False)
    # Every pair of poses has a number: n times the smaller plus the larger.
    edge_pairs = np.minimum(i, j) * n + np.maximum(i, j)
    distinct_pairs, first_edge = np.unique(edge_pairs, return_index=True)
    child = order[1:]
    parent_of_child = parent[child]
    smaller = np.minimum(child, parent_of_child)
    larger = np.maximum(child, parent_of_child)
    branch_pairs = smaller * np.int64(n) + larger
    places = np.searchsorted(distinct_pairs, branch_pairs)
    return order, parent, usable[first_edge[places]]


def chordal_start(problem: PGOProblem, averaged: bool = False) -> Poses:
    """Solve for rotations without their constraints, project, and take the best translations.

    The sum sum_e kappa ||R_j - R_i R_ij||_F^2 is minimised with R_0 = I. This is the chordal
    relaxation of rotation averaging (Martinec & Pajdla 2007; Carlone, Tron, Daniilidis & Dellaert
    2015). Translations are not among the unknowns: with them the relaxed R_i would shrink, since
    with noise a smaller map fits better, and more so the larger the map is. Where the measurements
    to the world are positions alone, the rotation of the world is fitted to positions that are
    computed without it.

    Parameters
    ----------
    problem : PGOProblem
        A problem with a quadratic cost, such as the convex part of one.
    averaged : bool
        Whether the rotations in the plane take a step of rotation averaging. The result is often
        near the constrained minimum of the same sum, and on large graphs Newton's method needs a
        factorisation less from there.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> along_a_tree = spanning_tree_start(problem.graph)
    >>> bool(problem.objective(chordal_start(problem)) < problem.objective(along_a_tree))
    True
    """
    graph = problem.graph
    if graph.world is not None and graph.is_world_loose:
        return _start_with_loose_world(problem, graph.world, averaged)
    if problem.d == 2 and problem.weights.is_isotropic:
        R = _chordal_rotations_in_the_plane(problem)
    else:
        R = _chordal_rotations(problem)
    stiffness = largest_stiffness(problem.weights) if averaged else None
    if stiffness is not None:
        pull = averaging_pull(problem, R, stiffness)
        R = R @ exp_map(problem.translations.solve(pull))
    return problem.with_best_translations(R)


def _chordal_rotations(problem: PGOProblem) -> Array:
    """Rotations, (n, d, d), of the chordal relaxation with R_0 = I, projected."""
    n = problem.num_poses
    matrix, b = relaxed_rotations(problem, 0)
    of_rotations = matrix[n:, n:].tocsc()
    order = row_order(problem.pose_order, problem.d)
    analysis = analyze(of_rotations, problem.backend, order)
    Y = factorize_damped(analysis, of_rotations).solve(b[n:])
    return project_to_rotations(unstack_transposes(Y))


def _chordal_rotations_in_the_plane(problem: PGOProblem) -> Array:
    """Rotations, (n, 2, 2), of the chordal relaxation in the plane, from n complex numbers.

    W is kappa I, and a rotation is z of modulus one. The sum, 2 sum_e kappa |z_j - z_i z_ij|^2, is
    a Hermitian form z^* H z of n numbers. With the diagonal entry of pose 0 doubled, H z = e_0 has
    the solution with z_0 = 1 times a positive number, which angles do not see: what is left of the
    rows of the other poses is H z = 0.
    """
    graph = problem.graph
    incidence = problem.incidence
    kappa = problem.weights.kappa
    z_ij = graph.R_ij[:, 0, 0] + 1j * graph.R_ij[:, 1, 0]
    coupling = -kappa * z_ij
    diagonal = incidence.begins @ kappa + incidence.ends @ kappa
    diagonal[0] *= 2.0
    poses = np.arange(problem.num_poses)
    blocks = [
        (poses, poses, diagonal),
        (graph.j, graph.i, coupling),
        (graph.i, graph.j, coupling.conj()),
    ]
    H = assemble(blocks, problem.num_poses)
    analysis = analyze(H, problem.backend, problem.pose_order)
    e_0 = np.zeros(problem.num_poses, dtype=complex)
    e_0[0] = diagonal[0]
    z = factorize_damped(analysis, H).solve(e_0)
    angles = np.angle(z)
    return exp_map((angles - angles[0])[:, None])


def _start_with_loose_world(problem: PGOProblem, world: int, averaged: bool) -> Poses:
    """Chordal start without the world pose, to whose positions its rotation is then fitted."""
    graph = problem.graph
    inner_poses = np.delete(np.arange(graph.num_poses), world)
    inner_weights = problem.weights.of_edges(~graph.is_prior)
    inner_graph = graph.subgraph(inner_poses)
    inner_problem = PGOProblem(inner_graph, problem.backend, inner_weights)
    inner_start = chordal_start(inner_problem, averaged)
    R = np.insert(inner_start.R, world, np.eye(problem.d), axis=0)
    t = np.insert(inner_start.t, world, 0.0, axis=0)
    fitted = with_world_fitted(graph, Poses(R, t))
    return problem.with_best_translations(fitted.R)


def largest_stiffness(weights: EdgeCost) -> float | None:
    """Largest kappa / tau of edges, 0 if there are none.

    None if their rotations cannot be averaged by `averaging_pull`.
    """
    if weights.d != 2 or not (weights.is_isotropic and (weights.tau > 0.0).all()):
        return None
    return float((weights.kappa / weights.tau).max(initial=0.0))


def averaging_pull(problem: PGOProblem, R: Array, stiffness: float) -> Array:
    """b, (n, 1), for a step of rotation averaging in the plane: turn R_i by x_i, M_tt x = b.

    Turned so, the rotations (n, 2, 2) are at the minimum of a majorant of sum_e kappa ||R_j - R_i
    R_ij||^2, which is no larger there than before. An edge with the residual angle r costs
    4 kappa (1 - cos r), whose second derivative is at most 4 kappa. The majorant has 4 s tau in its
    place, s the `stiffness`, at least kappa / tau of every edge, so that its minimum solves a
    system with the matrix of the translations, M_tt, whose factor is known.
    """
    graph = problem.graph
    kappa = problem.weights.kappa
    predicted_R_j = R.take(graph.i, axis=0) @ graph.R_ij
    sine = vee(np.swapaxes(predicted_R_j, 1, 2) @ R.take(graph.j, axis=0))
    of_edges = kappa[:, None] * sine / stiffness
    incidence = problem.incidence
    return np.asarray(incidence.begins @ of_edges - incidence.ends @ of_edges)


def relaxed_rotations(problem: PGOProblem, held: int | None) -> tuple[csc_array, Array]:
    """Matrix, (N, N), and b, (N, d), with matrix X = b where tr(Y^T L Y) is least.

    The `held` pose, if there is one, has R = I.

    Y are the rotations of X. The matrix has the pattern of M: L where that has rotations, and the
    identity for translations.
    """
    graph = problem.graph
    n = problem.num_poses
    d = problem.d
    no_offsets = np.zeros_like(graph.t_ij)
    _, diagonal_i, _, diagonal_j = problem.weights.matrix_blocks(graph.R_ij, no_offsets)
    data = problem.M.data.copy()
    data[problem.block_positions] = problem.incidence.at_both(diagonal_i, diagonal_j)
    problem.leave_out(data, np.arange(n), 1.0)
    b = np.zeros((problem.side, d))
    if held is not None:
        # R = I of the held pose: its columns go to the right-hand side.
        fixed = rotation_columns(np.array([held]), n, d)[0]
        b -= problem.with_pattern_of_M(data)[:, fixed].toarray()
        problem.leave_out(data, fixed, 1.0)
        b[fixed] = np.eye(d)
    return problem.with_pattern_of_M(data), b


def with_world_fitted(graph: PoseGraph, poses: Poses) -> Poses:
    """Poses with a loose world pose w at the minimum of sum_e ||t_j - t_w - R_w t_wj||^2."""
    if graph.world is None or not graph.is_world_loose:
        return poses
    seen_poses = graph.j[graph.is_prior]
    measured = Poses.of_points(graph.t_ij[graph.is_prior])
    estimated = Poses.of_points(poses.t[seen_poses])
    fitted = measured.aligned_to(estimated)
    R = poses.R.copy()
    t = poses.t.copy()
    R[graph.world] = fitted.R[0]
    t[graph.world] = fitted.t[0] - fitted.R[0] @ measured.t[0]
    return Poses(R, t)


def compose_along_tree(
    graph: PoseGraph, order: IntArray, parent: IntArray, edge: IntArray, forward: BoolArray
) -> Poses:
    """Poses of a tree: edge[k-1] joins order[k] with its parent and ends at it if forward[k-1].

    The method is pointer jumping: R and t of a pose are relative to one of its ancestors. Every
    round replaces the ancestor by the ancestor of the ancestor, until it is the root.
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
        R_ancestor = R[ancestor]
        t = t[ancestor] + np.einsum("nab,nb->na", R_ancestor, t)
        R = project_to_rotations(R_ancestor @ R)
        ancestor = ancestor[ancestor]
    return Poses(R, t)
