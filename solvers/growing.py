"""Graphs that grow: new poses start where their edges put them, and the solution goes on.

Newton comes next. An update ends where the gap that is asked for is proven, not at rounding level;
it mostly takes one factorisation and the certificate.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pgo_models.errors import GraphError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import BoolArray, project_to_rotations, unstack_transposes
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import WORLD_ID, IntArray, PoseGraph
from pgo_models.problem.cholesky import factorize
from pgo_models.problem.matrices import columns_of
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.pipeline import solution_for, warn_of_landmarks_seen_once
from solvers.place import Attempt, Place, Step
from solvers.plan import solve_at, unless_it_fails
from solvers.request import Pipeline, SolveRequest, solution_by
from solvers.robots.settings import Robots
from solvers.robust.consistency import PCM
from solvers.robust.gnc import GNC
from solvers.robust.known import KnownEdges
from solvers.robust.revision import inlier_problem
from solvers.robust.weighted_edges import held_together
from solvers.robust_solves.robust_solve import go_on_robustly
from solvers.solution import Solution

# Share of the gap by which Newton may leave F above its minimum: the bound can be ten times as far
# below it.
_SHARE = 0.01
# Difference, in metres beside the length and in rotations, up to which two edges measure the same.
_SAME = 1e-4


def extend(
    solution: Solution,
    graph: PoseGraph,
    pipeline: Pipeline | None = None,
    *,
    robots: Robots | Partition | None = None,
    robust: GNC | PCM | None = None,
) -> Solution:
    """Solve a graph that has grown out of another one, from the solution of that.

    Newton alone comes first. Where its certificate is wider than asked for, the whole pipeline
    follows, and the stages of the solution are those of both. A solution by robots is extended by
    them.

    Parameters
    ----------
    solution : Solution
        Of the graph before it has grown.
    graph : PoseGraph
        Poses of the solution, recognised by their ids, and new ones.
    pipeline : Pipeline, optional
        Settings of the stages; `Pipeline()` unless given.
    robots : Robots or Partition, optional
        Robots that own the poses of the grown graph. Unless their owners are given, they are those
        of the solution. A new pose goes to the robot that the graph names, or where these are not
        the robots of the solution, to that of the pose that its first edge joins it with.
    robust : GNC or PCM, optional
        How to find wrong edges among the new ones, as in `solve`. Edges that the solution has kept
        stay, and those that it rejected stay out, unless the new ones speak against that: new
        closures are tested in clusters against the map, and so are those rejected and kept before
        (`go_on_robustly`).

    Returns
    -------
    Solution
        Of the whole graph. The ledger of a solve by robots goes on from that of the solution.

    Raises
    ------
    GraphError
        When the graph has no pose of the solution, or is not connected.
    SettingError
        When the robots are not those of the graph's poses.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> from solvers import solve
    >>> graph = grid(np.random.default_rng(0))
    >>> solution = solve(graph.subgraph(np.arange(18)))
    >>> extend(solution, graph).is_certified
    True

    Closures that are new are doubted, one after the other:

    >>> from solvers import GNC
    >>> extend(solution, graph, robust=GNC()).robust.rejected.sum()
    np.int64(0)

    Robots go on with what they own, and so does the account of what they send:

    >>> shared = solve(graph.subgraph(np.arange(18)), robots=3)
    >>> grown = extend(shared, graph)
    >>> grown.robots.num_robots, grown.ledger.rounds > shared.ledger.rounds
    (3, True)
    """
    shared = None if robots is None else Robots.of(robots)
    has_owners = shared is not None and shared.owners is not None
    if not has_owners and solution.robots is not None:
        owners = extended_partition(solution.robots, solution.problem.graph.pose_ids, graph)
        shared = replace(shared or Robots(), owners=owners)
    _check_grown(solution.problem.graph, graph)
    pipeline = pipeline if pipeline is not None else Pipeline()
    weighting = solution.problem.weighting
    if not isinstance(weighting, Weighting):
        weighting = Weighting.ISOTROPIC
    problem = PGOProblem(graph, solution.problem.backend, weighting)
    ids = solution.problem.graph.pose_ids
    if robust is None:
        start = extended_poses(problem, ids, solution.all_poses)
        request = SolveRequest(problem, pipeline, start, robots=shared)
        warn_of_landmarks_seen_once(graph)
        # Newton alone would leave added terms out, and needs a driver.
        has_driver = shared is None or shared.has_driver
        if pipeline.has_added_terms or not has_driver:
            grown = solution_for(request)
        else:
            grown = solution_by(update_at, request)
    else:
        kept, new = _decided_before(solution, graph)
        # Odometry that was rejected before is not taken for right again.
        known = KnownEdges.of(graph, robust.known).edges & (kept | new)
        robust = replace(robust, known=known)
        kept = held_together(graph, kept | known, np.zeros(graph.num_edges))
        start = extended_poses(inlier_problem(problem, kept), ids, solution.all_poses)
        request = SolveRequest(problem, pipeline, start, robots=shared)
        grown = go_on_robustly(robust, kept, new, request)
    return replace(grown, ledger=solution.ledger.joined(grown.ledger))


def _decided_before(solution: Solution, graph: PoseGraph) -> tuple[BoolArray, BoolArray]:
    """Edges of a grown graph, (m,): those that the solution before has kept, and new ones."""
    rejection = solution.robust
    before = solution.problem.graph if rejection is None else rejection.problem.graph
    measured = _measurements(before)
    is_kept = np.ones(len(measured), dtype=bool) if rejection is None else rejection.kept
    decisions = dict(zip(measured, is_kept.tolist(), strict=True))
    decided = [decisions.get(row) for row in _measurements(graph)]
    kept = np.array([decision is True for decision in decided])
    return kept, np.array([decision is None for decision in decided])


def _measurements(graph: PoseGraph) -> list[tuple[int, int, bytes, bytes]]:
    """What tells an edge from others: the ids of its poses, and what it measures."""
    ids = graph.pose_ids
    tails = ids[graph.i].tolist()
    heads = ids[graph.j].tolist()
    turns = [R.tobytes() for R in graph.R_ij]
    shifts = [t.tobytes() for t in graph.t_ij]
    return list(zip(tails, heads, turns, shifts, strict=True))


def _check_grown(before: PoseGraph, graph: PoseGraph) -> None:
    """Raise a GraphError unless a graph has grown out of another one: measures what that does."""
    if graph.d != before.d:
        raise GraphError(
            f"{graph.name} is in {graph.d} dimensions and {before.name}, which was solved, in "
            f"{before.d}; solve it on its own"
        )
    edges_before = _edges_of_ids(before)
    edges = _edges_of_ids(graph)
    shared = [(edges_before[ids], edges[ids]) for ids in edges_before.keys() & edges.keys()]
    if not shared or not _measure_alike(before, graph, np.array(shared)).any():
        raise GraphError(
            f"{graph.name} has none of the measurements of {before.name}, which was solved; "
            "give the whole graph, earlier edges included, or solve it on its own"
        )


def _edges_of_ids(graph: PoseGraph) -> dict[tuple[int, int], int]:
    """Number of the last edge of every pair of poses, by the ids of the poses."""
    ids = graph.pose_ids
    pairs = zip(ids[graph.i].tolist(), ids[graph.j].tolist(), strict=True)
    return {pair: e for e, pair in enumerate(pairs)}


def _measure_alike(before: PoseGraph, graph: PoseGraph, shared: IntArray) -> BoolArray:
    """Whether pairs (k, 2) of edges measure the same, up to the digits of a file, (k,)."""
    e_before, e = shared.T
    shift = np.linalg.norm(graph.t_ij[e] - before.t_ij[e_before], axis=1)
    turn = np.linalg.norm(graph.R_ij[e] - before.R_ij[e_before], axis=(1, 2))
    size = 1.0 + np.linalg.norm(before.t_ij[e_before], axis=1)
    return np.asarray((shift <= _SAME * size) & (turn <= _SAME))


def update_at(place: Place, settings: Pipeline, start: Poses | None) -> Attempt:
    """Solve a graph that has grown, at a place: by Newton alone or, if that fails, as any other.

    Handedness terms are sought at the poses of Newton. The whole solve, which follows where the
    certificate is still wider than asked for, has the relaxation with hulls, too.
    """
    tolerance = max(settings.newton.tolerance, _SHARE * settings.gap)
    newton = replace(settings.newton, tolerance=tolerance)
    search = settings.handedness
    terms = None if search is None else replace(search, hulls=None)
    newton_alone = replace(settings.with_newton_alone(newton), handedness=terms)
    update = solve_at(place, newton_alone, start)
    if not update.is_open:
        return update

    def solve_afresh(place: Place, settings: Pipeline, best: Attempt) -> Attempt:
        return place.better(best, solve_at(place, settings, start))

    return unless_it_fails(Step.AGAIN, solve_afresh, place, settings, update)


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
    graph = problem.graph
    if graph.has_far_priors and WORLD_ID in ids:
        # The poses before are in the frame of their file, their world pose at an origin of its own.
        t[known] -= graph.world_point
        t[graph.world] = 0.0
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


def extended_partition(robots: Partition, ids: IntArray, graph: PoseGraph) -> Partition:
    """Owners of the poses of a graph that has grown, from the `robots` of the poses with these ids.

    If the robots are those that the graph names, a new pose goes to the robot that the graph names
    for it. Otherwise it goes to the robot of the pose that its first edge joins it with. A
    GraphError if no edge joins some of these poses with known ones.
    """
    owner = np.full(graph.num_poses, -1)
    _, known, place = np.intersect1d(graph.pose_ids, ids, return_indices=True)
    owner[known] = robots.robot[place]
    owner = _owners_by_name(owner, robots.num_robots, graph)
    while (owner < 0).any():
        is_open = (owner[graph.i] < 0) != (owner[graph.j] < 0)
        if not is_open.any():
            raise GraphError(
                f"{graph.name} has poses that no edge joins with the {len(ids)} solved before; "
                "solve it on its own"
            )
        i = graph.i[is_open]
        j = graph.j[is_open]
        new = np.where(owner[i] < 0, i, j)
        known_ends = np.where(owner[i] < 0, j, i)
        poses, first = np.unique(new, return_index=True)
        owner[poses] = owner[known_ends[first]]
    return Partition(owner, robots.method)


def _owners_by_name(owner: IntArray, num_robots: int, graph: PoseGraph) -> IntArray:
    """Owners, (n,), with those of new poses (-1) whose robot the graph names.

    The robots are those of the graph if one robot owns all known poses of each that it names. A
    robot that it names for new poses alone gets a number of its own, unless known robots share
    names, as then nothing says whether it is one of them.
    """
    if graph.robot is None:
        return owner
    # Nobody names the owner of the world pose.
    is_known = (owner >= 0) & (np.arange(graph.num_poses) != graph.world)
    names, owners = np.unique(np.stack([graph.robot[is_known], owner[is_known]]), axis=1)
    if len(np.unique(names)) < len(names):
        return owner
    owner_of_name = np.full(graph.num_robots, -1)
    owner_of_name[names] = owners
    if len(np.unique(owners)) == len(owners):
        new_names = np.flatnonzero(owner_of_name < 0)
        owner_of_name[new_names] = num_robots + np.arange(len(new_names))
    return np.where(owner < 0, owner_of_name[graph.robot], owner)
