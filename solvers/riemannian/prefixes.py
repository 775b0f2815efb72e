"""A start that grows: Newton solves prefixes of a graph, each from the solution of the last one.

The chordal relaxation, a spanning tree and odometry give poses of the whole graph at once. Where
odometry is poor, or landmarks tie the poses together, Newton goes from them to a local minimum that
may cost many times the least. A prefix has the poses 0 .. k - 1 alone. Its start is the solution of
a shorter prefix, continued by odometry over so few poses that it has no time to drift away.

Whether it has is seen: where S_r, the certificate matrix grounded at a pose, is positive definite,
the prefix is solved to its global minimum (`pgo_models.certificates.lower_bound`). Where it is not,
the prefix is dropped, and a shorter one is tried from the same solution.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.certificates.definiteness import is_definite_in_doubles
from pgo_models.certificates.dual_variables import multipliers
from pgo_models.errors import GraphError, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.initialization import compose_along_tree, with_world_fitted
from pgo_models.problem.matrices import columns_of
from pgo_models.problem.problem import PGOProblem
from solvers.carry.registry import record
from solvers.result import Measurement, Status
from solvers.riemannian.polish import polish_step, start_polish

_LEAST_GROWTH = 0.03  # share of new poses below which no shorter prefix is tried
_MOST_STEPS = 10  # factorisations of a prefix


@dataclass(frozen=True, eq=False)
class EntryTree:
    """The order in which poses enter the prefixes, and the edge by which each of them does.

    A pose enters by its edge to the latest earlier pose that it shares one with, as odometry does.
    A landmark enters with the pose that saw it first, and the world pose with the first pose that
    has a prior of its rotation, or with the last pose if there is none.
    """

    graph: PoseGraph
    # (n,): position in the order of the poses, 0, 1, ..; that of the pose that they enter with for
    # landmarks and the world
    rank: IntArray
    # (n,): the pose at the other end of that edge; -1 for the first pose, and for a world without
    # one
    parent: IntArray
    poses: Poses  # the measurements of these edges composed, with the first pose at (I, 0)

    @property
    def num_ranks(self) -> int:
        """Number of poses without landmarks and the world."""
        return len(self.graph.bodies)

    def members(self, size: int) -> IntArray:
        """Poses of the prefix with the ranks 0 .. size - 1, ascending."""
        return np.flatnonzero(self.rank < size)

    def continued(self, members: IntArray, solved: Poses) -> Poses:
        """Poses of the graph: the solved ones of a prefix, and the rest by their entry edges."""
        graph = self.graph
        tree = self.poses
        is_solved = np.zeros(graph.num_poses, dtype=bool)
        is_solved[members] = True
        nearest = self._nearest(is_solved)
        R = tree.R.copy()
        t = tree.t.copy()
        R[members] = solved.R
        t[members] = solved.t
        # What lies behind a solved pose moves with it, as a rigid body.
        turn = R[nearest] @ np.swapaxes(tree.R[nearest], 1, 2)
        offset = np.einsum("nab,nb->na", turn, tree.t - tree.t[nearest])
        new = ~is_solved
        t[new] = (t[nearest] + offset)[new]
        R[new] = (turn @ tree.R)[new]
        poses = Poses(R, t)
        return poses if is_solved.all() else with_world_fitted(graph, poses)

    def _nearest(self, is_solved: BoolArray) -> IntArray:
        """The nearest solved pose on the way from every pose to the root, by pointer jumping."""
        itself = np.arange(len(is_solved))
        has_no_parent = self.parent < 0
        nearest = np.where(is_solved | has_no_parent, itself, self.parent)
        while True:
            further = nearest[nearest]
            if np.array_equal(further, nearest):
                return nearest
            nearest = further


def entry_tree(graph: PoseGraph) -> EntryTree | None:
    """Return the entry tree of a graph, or None where odometry does not join its poses."""
    rank = np.full(graph.num_poses, -1)
    rank[graph.bodies] = np.arange(len(graph.bodies))
    later, edge = _entry_edges(graph, rank)
    if len(later) != len(graph.bodies) - 1:
        return None
    first_prior = _first_prior_of_rotation(graph, rank)
    if graph.world is not None:
        if len(first_prior):
            rank[graph.world] = rank[graph.j[first_prior[0]]]
        else:
            rank[graph.world] = len(graph.bodies) - 1
    sights = graph.first_sights
    rank[graph.j[sights]] = rank[graph.i[sights]]
    worlds = np.full(len(first_prior), graph.world, dtype=np.int64)
    child = np.concatenate([later, worlds, graph.j[sights]])
    edge = np.concatenate([edge, first_prior, sights])
    is_forward = graph.j[edge] == child
    parent = np.full(graph.num_poses, -1)
    parent[child] = np.where(is_forward, graph.i[edge], graph.j[edge])
    root = graph.bodies[:1]
    order = np.concatenate([root, child])
    poses = compose_along_tree(graph, order, parent, edge, is_forward)
    return EntryTree(graph, rank, parent, with_world_fitted(graph, poses))


def _entry_edges(graph: PoseGraph, rank: IntArray) -> tuple[IntArray, IntArray]:
    """Poses with an edge to an earlier pose, and of these edges the one to the latest."""
    joins = (graph.kappa > 0) & (graph.tau > 0) & (rank[graph.i] >= 0) & (rank[graph.j] >= 0)
    candidates = np.flatnonzero(joins)
    ends = np.stack([rank[graph.i[candidates]], rank[graph.j[candidates]]])
    earlier = ends.min(axis=0)
    later = ends.max(axis=0)
    order = np.lexsort((-earlier, later))
    entering, first = np.unique(later[order], return_index=True)
    return graph.bodies[entering], candidates[order[first]]


def _first_prior_of_rotation(graph: PoseGraph, rank: IntArray) -> IntArray:
    """The prior of position and rotation of the earliest pose that has one, (1,) or (0,)."""
    measures_both = (graph.kappa > 0) & (graph.tau > 0) & (rank[graph.j] >= 0)
    priors = np.flatnonzero(graph.is_prior & measures_both)
    earliest_first = np.argsort(rank[graph.j[priors]], kind="stable")
    return np.asarray(priors[earliest_first[:1]])


@dataclass(frozen=True, eq=False)
class PrefixState:
    """State k: poses of the whole graph after k prefixes have been tried.

    The ranks 0 .. `num_solved` - 1 are solved, and the others continue them by odometry. The next
    prefix has `size` poses; `share` is the number of new ones over `num_solved`. `is_at_minimum`
    says whether the solved poses are at the global minimum of their prefix. If they are, and the
    next prefix misses its own, that prefix is dropped.
    """

    k: int
    tree: EntryTree
    poses: Poses
    size: int
    share: float
    num_solved: int = 0
    is_at_minimum: bool = True


@record("GrowingStart")
@dataclass(frozen=True)
class GrowingStart:
    """Poses to start from, by solving prefixes of a graph that grow.

    The poses have to be joined by odometry: every one has an edge to an earlier one. A landmark
    enters with the pose that saw it first, at the measured place. Priors of positions alone count
    when all poses are there.

    A prefix is accepted if Newton reaches its global minimum. Otherwise a prefix with half as many
    new poses takes its place. With wrong edges, or a relaxation that is not tight, even a prefix
    with hardly any new poses may fail. It is accepted all the same, and so are the next ones until
    one reaches its global minimum again.

    Parameters
    ----------
    first_size : int
        Poses of the first prefix, without landmarks.
    growth : float
        New poses of the next prefix, as a share of those that are solved.
    tolerance : float
        Relative Newton decrement to which prefixes are solved.
    max_iterations : int
        Most prefixes.

    Examples
    --------
    >>> import numpy as np
    >>> from pgo_models import victoria_park
    >>> from solvers import run
    >>> run(GrowingStart(), victoria_park(np.random.default_rng(0))).status.name
    'CONVERGED'
    """

    first_size: int = 60
    growth: float = 0.5
    tolerance: float = 1e-3
    max_iterations: int = 200

    def __post_init__(self) -> None:
        check_settings(
            self,
            positive=["growth", "tolerance"],
            at_least_one=["first_size"],
            not_negative=["max_iterations"],
        )

    def init(self, problem: PGOProblem, start: Poses | None) -> PrefixState:
        """State 0: `start`, or odometry."""
        tree = entry_tree(problem.graph)
        if tree is None:
            raise GraphError(
                f"{problem.graph.name}: odometry does not join the poses; "
                "give every pose an edge to an earlier one, or use chordal_start()"
            )
        poses = tree.poses
        if start is not None:
            poses = start
        size = min(self.first_size, tree.num_ranks)
        return PrefixState(0, tree, poses, size, self.growth)

    def step(self, problem: PGOProblem, state: PrefixState) -> PrefixState:
        """Solve one prefix, and accept it or drop it."""
        tree = state.tree
        if state.num_solved == tree.num_ranks:
            return replace(state, k=state.k + 1)
        members = tree.members(state.size)
        prefix = _prefix_problem(problem, members)
        solved = self._solved(prefix, state.poses[members])
        is_at_minimum = _is_at_global_minimum(prefix, solved)
        smaller = 0.5 * state.share
        can_retreat = state.num_solved > 0 and smaller >= _LEAST_GROWTH
        if state.is_at_minimum and not is_at_minimum and can_retreat:
            size = _grown(state.num_solved, smaller, tree.num_ranks)
            return replace(state, k=state.k + 1, size=size, share=smaller)
        share = min(2.0 * state.share, self.growth) if is_at_minimum else self.growth
        return PrefixState(
            k=state.k + 1,
            tree=tree,
            poses=tree.continued(members, solved),
            size=_grown(state.size, share, tree.num_ranks),
            share=share,
            num_solved=state.size,
            is_at_minimum=is_at_minimum,
        )

    def measure(self, problem: PGOProblem, state: PrefixState) -> Measurement:
        """F of all poses, and the share of the poses that are not solved yet."""
        unsolved = 1.0 - state.num_solved / state.tree.num_ranks
        return Measurement(problem.objective(state.poses), 0.0, unsolved)

    def poses(self, problem: PGOProblem, state: PrefixState) -> Poses:
        """The poses of a state, whose F `measure` reports."""
        return state.poses

    def converged(self, state: PrefixState, measurement: Measurement) -> Status | None:
        """CONVERGED when the last prefix, which is the whole graph, is solved."""
        return Status.CONVERGED if state.num_solved == state.tree.num_ranks else None

    def _solved(self, prefix: PGOProblem, poses: Poses) -> Poses:
        """Poses of a prefix after Newton steps."""
        state = start_polish(prefix, poses)
        for _ in range(_MOST_STEPS):
            state = polish_step(prefix, state)
            if state.decrement <= self.tolerance or not state.moved:
                break
        return state.poses


def _prefix_problem(problem: PGOProblem, members: IntArray) -> PGOProblem:
    """The cost of the edges among some poses; the problem itself where these are all."""
    graph = problem.graph
    if len(members) == graph.num_poses:
        return problem
    is_member = np.zeros(graph.num_poses, dtype=bool)
    is_member[members] = True
    weights = problem.weights.of_edges(is_member[graph.i] & is_member[graph.j])
    return PGOProblem(graph.subgraph(members), problem.backend, weights)


def _is_at_global_minimum(problem: PGOProblem, poses: Poses) -> bool:
    """Whether S_r, grounded at pose 0, has a Cholesky factor at nearly stationary poses.

    It is no proof, which a start does not need.
    """
    Lambda = multipliers(problem, poses)
    pose_0 = np.zeros(1, dtype=np.int64)
    rows = columns_of(pose_0, problem.num_poses, (1, problem.d))
    return is_definite_in_doubles(problem.tangent_at(poses), Lambda, rows)


def _grown(size: int, share: float, most: int) -> int:
    """Size of the prefix that follows one, by a share of its poses and at least one."""
    return min(size + max(math.ceil(share * size), 1), most)
