"""Robots that load their own files, and a driver that learns only the interface between them.

The driver learns the ids of poses as runs of consecutive ids, so that it can number the poses, and
of the edges between robots their ends, of which it computes a vertex cover. Measurements between
two robots are messages between these robots, which the process of the driver delivers: they pass
through its memory, and nothing of the driver reads them. A pose belongs to the first file with a
VERTEX line of it, or else to the first file that names it. An edge that stands in several files
counts once, as in `read_g2o`.

The orders to a robot stand below in the sequence in which they are given: `read_file`,
`number_poses`, `join_neighbours`, `take_cost`, `place_cover`; where areas of robots interleave
`propose_poses`, `place_larger_cover` and `take_larger_cover`; then, after the solve, `keep_answer`,
`return_to_answer`, `move_answer` and `write_answer`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components

from pgo_models.certificates.fit import Fit
from pgo_models.certificates.rounding_errors import ObjectiveRounding, objective_rounding
from pgo_models.errors import FileFormatError, GraphError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.g2o import edge_rows_to_keep, make_folder, write_g2o
from pgo_models.graphs.g2o_folder import (
    Rows,
    check_measurements,
    check_places,
    measured_edges,
    placed_poses,
)
from pgo_models.graphs.g2o_parser import G2OLines, read_lines
from pgo_models.graphs.g2o_rows import information_of, measurements_of, poses_of
from pgo_models.graphs.pose_graph import (
    WORLD_ID,
    IntArray,
    PoseGraph,
    edge_counts,
    middle_pose,
)
from pgo_models.graphs.precisions import edge_precisions, indefinite_edges
from pgo_models.graphs.written_digits import WrittenDigits, most_digits, written_errors
from pgo_models.problem.weighting import (
    Weighting,
    convex_cost,
    is_isotropic,
)
from solvers.distributed.driver import Driver
from solvers.distributed.elimination_choice import (
    MOST_COUPLED,
    CoverSystem,
    may_leave_poses,
    positions_in_cover,
)
from solvers.distributed.robots.agent import Agent, held_poses, order_interior
from solvers.distributed.robots.interior import Interior, interior_of
from solvers.network.counted_pool import Count, CountedPool
from solvers.network.engine import Engine
from solvers.soc.subgraph import PartProblem, Placement, RobotSummary, Subgraph, place_poses

READ_HERE = (
    "have the graph read in one process: --split given, or solve(read_g2o(folder), robots=..)"
)


RobotFile = tuple[int, Path]  # a robot and its file, on the machine where the robot runs
# What a file names: d, the ids of its VERTEX lines, and the ids that only its edges name; see
# `_runs`. And the digits that it is written with.
Claim = tuple[int, IntArray, IntArray, WrittenDigits]


@dataclass(frozen=True, eq=False)
class OwnedRuns:
    """Runs of consecutive ids, (k,): first id, number of that pose in the whole graph, owner.

    With the digits of all files together, as they are all written in one way.
    """

    first: IntArray
    number: IntArray
    owner: IntArray
    digits: WrittenDigits

    def of(self, ids: IntArray) -> IntArray:
        """The run that each id is in."""
        return np.searchsorted(self.first, ids, side="right") - 1


@dataclass(frozen=True, eq=False)
class Edges:
    """Edges of a file, and the numbers and owners of their ends, (m, 2)."""

    rows: Rows
    numbers: IntArray
    owners: IntArray

    def some(self, chosen: IntArray | BoolArray | slice) -> Edges:
        """Some of the edges."""
        return Edges(self.rows.some(chosen), self.numbers[chosen], self.owners[chosen])


class _JoinedEdges(NamedTuple):
    """Edges of several files: ids, rows of numbers as in `G2OLines`, and as in `Edges`."""

    ids: IntArray
    rows: Array
    numbers: IntArray
    owners: IntArray


@dataclass(frozen=True, eq=False)
class Told:
    """What a robot tells another: edges that touch its poses, and VERTEX lines of these."""

    edges: Edges
    places: Rows


@dataclass(frozen=True, eq=False)
class Border:
    """What a robot reports of its edges to other robots."""

    counts: tuple[int, int]  # own poses, and edges, where a shared edge counts at one end
    pairs: IntArray  # (k, 2): poses that its edges to others join
    owners: IntArray  # (k, 2): owners of these poses
    poses: IntArray  # (h,): all of these poses, ascending
    # (3, h): their components in the graph of all edges, of those with tau > 0, and of those with
    # kappa > 0.
    labels: IntArray
    alone: IntArray  # (3,): number of components without any of these poses
    middle: int  # its middle pose if it has no edge to another robot, else -1
    is_isotropic: bool  # whether chi2 of its edges is F
    has_indefinite: bool  # whether the share of an edge in chi2 can be negative


NO_ROUNDING = ObjectiveRounding(0.0, 0.0, Fit.ROUNDING)  # of no edges


@dataclass(frozen=True, eq=False)
class Answer:
    """Rounding of a robot's part of the cost, and a pose that can hold the frame.

    That pose is its first one with a FIX line, or else its first one.
    """

    rounding: ObjectiveRounding
    held: tuple[bool, int, int]  # whether the pose has a FIX line, its number and id
    solved: Array  # (d + 1, d): rows t and R^T of the pose
    given: Array  # (d + 1, d): the same in the file, nan if it is not there


@dataclass(frozen=True, eq=False)
class MovedAnswer:
    """A robot's part of the cost where its answer was moved to, and of F there."""

    cost: float
    rounding: ObjectiveRounding
    F: float


class FileAgent(Agent):
    """A robot that loads its own file; its attributes are set by the orders below."""

    lines: G2OLines
    own: Told  # what its own file says of its poses
    digits: WrittenDigits  # of all files
    graph: PoseGraph  # of its own poses, and those at the far end of its edges
    numbers: IntArray  # (n_a,): numbers of these poses in the whole graph, ascending
    owners: IntArray  # (n_a,)
    problem: PartProblem  # the cost that is solved, of its edges
    left: IntArray  # numbers of the poses that it proposes to leave to the driver
    larger: Subgraph  # its subgraph if it does
    given: Array  # as in `Answer`
    answer: Poses

    def __init__(self, source: RobotFile) -> None:
        self.robot, self.path = source
        self.backend = None
        self.interior = None
        self.copies = None
        self.front = None
        self.moments = {}


def read_file(agent: FileAgent, _: None) -> Claim:
    """Read the file, and return the ids in it.

    Errors are those of `read_lines`, and a GraphError for priors and landmarks.
    """
    lines = read_lines(agent.path)
    if len(lines.landmarks) or (lines.edge_ids == WORLD_ID).any():
        raise GraphError(
            f"{agent.path} has priors or landmarks, which all robots share; {READ_HERE}"
        )
    agent.lines = lines
    ids_of_edges_alone = np.setdiff1d(lines.edge_ids, lines.vertex_ids)
    runs_of_vertices = _runs(np.unique(lines.vertex_ids))
    return lines.d, runs_of_vertices, _runs(ids_of_edges_alone), lines.digits


def number_poses(agent: FileAgent, runs: OwnedRuns) -> Mapping[int, Told]:
    """Take numbers and owners for the ids; return what others are to be told of their poses.

    They are messages, by the number of the other robot.
    """
    rows = measured_edges(agent.lines)
    run = runs.of(rows.ids)
    numbers = runs.number[run] + rows.ids - runs.first[run]
    owners = runs.owner[run]
    edges = Edges(rows, numbers, owners)
    places = placed_poses(agent.lines)
    owners_of_places = runs.owner[runs.of(places.ids)]
    told = {}
    for robot in np.unique(np.append(owners, owners_of_places)).tolist():
        touches = (owners == robot).any(axis=1)
        told[robot] = Told(edges.some(touches), places.some(owners_of_places == robot))
    agent.digits = runs.digits
    no_lines = slice(0)
    agent.own = told.pop(agent.robot, Told(edges.some(no_lines), places.some(no_lines)))
    return told


def join_neighbours(agent: FileAgent, request: tuple[Mapping[int, Told], bool]) -> Border:
    """Make the graph of the robot: its own edges, and those that others have of its poses.

    FIX lines of its own poses count. The request is what others told the robot, and whether the
    folder is trusted, so that nothing is asked that `read_g2o` would ask.
    """
    received, is_trusted = request
    lines = agent.lines
    told = [part for _, part in sorted({**received, agent.robot: agent.own}.items())]
    if not is_trusted:
        check_places(lines.d, [part.places for part in told])
        check_measurements(lines.d, [part.edges.rows for part in told])
    edges = _joined_edges([part.edges for part in told])
    if not len(edges.numbers):
        raise GraphError(
            f"{agent.path}: no edge touches a pose of this robot; add one, or remove the file"
        )
    agent.numbers, first, ends = np.unique(edges.numbers, return_index=True, return_inverse=True)
    agent.owners = edges.owners.ravel()[first]
    ids = edges.ids.ravel()[first]
    i, j = ends.reshape(-1, 2).T
    is_own = agent.owners == agent.robot
    R_ij, t_ij = poses_of(lines.d, edges.rows)
    information = information_of(lines.d, edges.rows)
    kappa, tau = edge_precisions(information)
    fixed = np.flatnonzero(is_own & np.isin(ids, lines.fixed))
    agent.graph = PoseGraph(
        len(ids),
        i,
        j,
        R_ij,
        t_ij,
        kappa,
        tau,
        information=information,
        ids=ids,
        fixed=fixed,
        name=agent.path.stem,
        written_error=written_errors(measurements_of(lines.d, edges.rows), agent.digits),
        weights_error=lines.weights_error,
    )
    holding = fixed[0] if len(fixed) else np.argmax(is_own)
    agent.given = _given_pose(lines, ids[holding])
    del agent.lines, agent.own
    return _border(agent)


def _joined_edges(files: Sequence[Edges]) -> _JoinedEdges:
    """Edges of several files as one, in which an edge of several files counts once."""
    kept_of_files = edge_rows_to_keep([(file.rows.ids, file.rows.numbers) for file in files])
    parts = [file.some(kept) for file, kept in zip(files, kept_of_files, strict=True)]
    return _JoinedEdges(
        np.concatenate([part.rows.ids for part in parts]),
        np.concatenate([part.rows.numbers for part in parts]),
        np.concatenate([part.numbers for part in parts]),
        np.concatenate([part.owners for part in parts]),
    )


def _given_pose(lines: G2OLines, pose_id: int) -> Array:
    """Rows t and R^T of a pose in the file, (d + 1, d); nan if it is not there."""
    rows = lines.vertices[lines.vertex_ids == pose_id]
    if len(rows) == 0:
        return np.full((lines.d + 1, lines.d), np.nan)
    return Poses(*poses_of(lines.d, rows)).stacked()


def _border(agent: FileAgent) -> Border:
    """Border of a robot whose graph is known."""
    graph = agent.graph
    owners = agent.owners
    ends = np.stack([graph.i, graph.j], axis=1)
    pairs = np.unique(ends[owners[graph.i] != owners[graph.j]], axis=0)
    poses = np.unique(pairs)
    labels = []
    for kind in (graph.tau >= 0, graph.tau > 0, graph.kappa > 0):
        adjacency = edge_counts(graph.i[kind], graph.j[kind], graph.num_poses)
        labels.append(connected_components(adjacency)[1])
    # A shared edge counts with the owner of the lower number.
    num_poses = int((owners == agent.robot).sum())
    num_edges = int((owners[ends].min(axis=1) == agent.robot).sum())
    return Border(
        counts=(num_poses, num_edges),
        pairs=agent.numbers[pairs],
        owners=owners[pairs],
        poses=agent.numbers[poses],
        labels=np.stack(labels)[:, poses],
        alone=np.array([len(np.setdiff1d(label, label[poses])) for label in labels]),
        middle=-1 if len(poses) else int(agent.numbers[middle_pose(graph)]),
        is_isotropic=is_isotropic(graph),
        has_indefinite=bool(indefinite_edges(graph).any()),
    )


def take_cost(agent: FileAgent, weighting: Weighting) -> bool:
    """Learn which cost is solved: F or chi2. Return whether SOC can run on the robot's part of it.

    A GraphError for a matrix that chi2 cannot have, and where chi2 is one of rotations alone.
    """
    agent.problem = PartProblem(agent.graph, weighting=weighting)
    try:
        cost = agent.problem.weights
    except GraphError as error:
        raise GraphError(f"{agent.path}: {error}") from error
    if not cost.has_translations:
        raise GraphError(f"{agent.path}: no edge measures a translation; {READ_HERE}")
    return cost.is_quadratic and cost.is_convex


def place_cover(agent: FileAgent, place: tuple[Placement, bool]) -> RobotSummary:
    """Learn which poses the driver solves for, and which robots hold which of them.

    `place` also says whether SOC runs on another cost than the one that is solved. From now on the
    robot is an agent like any other.
    """
    placement, has_two_costs = place
    graph = agent.graph
    known = agent.robot, graph, agent.numbers, agent.owners
    edges = np.arange(graph.num_edges)
    problem = agent.problem
    weights = problem.weights
    final = None
    if has_two_costs:
        final = weights
        weights = convex_cost(problem.information, graph.d)
    del agent.problem
    agent.subgraph = Subgraph(*known, *placement.of(*known), edges, weights, final)
    agent.interior = interior_of(agent.subgraph, agent.backend)
    return replace(agent.subgraph.summary, part=None)


def propose_poses(agent: FileAgent, most_coupled: int) -> IntArray:
    """Propose poses to leave to the driver; return those of the cover, with them, that it holds."""
    agent.left = agent.subgraph.poses_left(most_coupled)
    return agent.subgraph.held_cover(agent.left)


def place_larger_cover(agent: FileAgent, positions: IntArray) -> RobotSummary:
    """Learn where these poses would be in the cover."""
    agent.larger = agent.subgraph.with_larger_cover(agent.left, positions)
    return replace(agent.larger.summary, part=None)


def take_larger_cover(agent: FileAgent, _: None) -> None:
    """Leave the poses to the driver."""
    agent.subgraph = agent.larger
    agent.interior = interior_of(agent.subgraph, agent.backend)


def keep_answer(agent: FileAgent, cover: Poses) -> Answer:
    """Keep the current poses for the answer; the driver sends those of the cover."""
    agent.answer = held_poses(agent, cover)
    interior = agent.interior
    fixed = agent.graph.fixed
    holding = int(fixed[0] if len(fixed) else np.argmax(agent.subgraph.is_own))
    rounding = NO_ROUNDING
    if interior is not None:
        rounding = objective_rounding(interior.problem, interior.state.poses)
    number = int(agent.numbers[holding])
    pose_id = int(agent.graph.pose_ids[holding])
    solved = agent.answer[np.array([holding])].stacked()
    return Answer(rounding, (len(fixed) > 0, number, pose_id), solved, agent.given)


def return_to_answer(agent: FileAgent, _: None) -> None:
    """Return to the poses that were kept; the driver does likewise."""
    if agent.interior is not None:
        order_interior(Interior.set_poses, agent, _interior_answer(agent, agent.interior))


def move_answer(agent: FileAgent, motion: tuple[Array, Array]) -> MovedAnswer:
    """Move the poses that were kept by (R, t); return the part of the cost there."""
    agent.answer = agent.answer.moved(*motion)
    if agent.interior is None:
        return MovedAnswer(0.0, NO_ROUNDING, 0.0)
    problem = agent.interior.problem
    poses = _interior_answer(agent, agent.interior)
    graph = problem.graph
    F = PartProblem(graph, problem.backend, Weighting.ISOTROPIC).objective(poses)
    return MovedAnswer(problem.objective(poses), objective_rounding(problem, poses), F)


def _interior_answer(agent: FileAgent, interior: Interior) -> Poses:
    """Poses that were kept, of those that the interior's problem has."""
    return agent.answer[np.searchsorted(agent.subgraph.poses, interior.part.poses)]


def write_answer(folder: Path, agent: FileAgent, _: None) -> None:
    """Write the poses that were kept, and the robot's edges."""
    make_folder(folder)
    write_g2o(agent.graph, folder / f"{agent.robot}.g2o", agent.answer, agent.subgraph.is_own)


@dataclass(frozen=True, eq=False)
class OpenedFiles:
    """Robots that have read their files, and what their driver knows of the graph.

    Parameters
    ----------
    driver : Driver
        The driver of the robots.
    sizes : (2, num_robots) array
        How many poses, and edges, every robot has.
    weighting : Weighting
        The cost that is solved: ISOTROPIC or INFORMATION.
    has_indefinite : bool
        Whether the share of any edge in chi2 can be negative.
    num_absent : int
        Number of poses of robots without a file, as `PoseGraph.absent`.
    """

    driver: Driver
    sizes: IntArray
    weighting: Weighting
    has_indefinite: bool
    num_absent: int


def open_files(
    files: Sequence[RobotFile],
    engine: Engine,
    memory: float,
    weighting: Weighting,
    trust_folder: bool = False,
) -> OpenedFiles:
    """Have robots read these files, and agree on the cost that `weighting` stands for.

    Raises a FileFormatError for a file that cannot be read or has no pose of its own, and, unless
    the folder is trusted, for files that speak against being of one graph. Raises a GraphError if
    the graph is not connected, or has a matrix that chi2 cannot have. All messages but the start of
    the robots are counted.
    """
    network = CountedPool(engine.open(FileAgent, files), len(files))
    try:
        claims = network.ask(read_file, [None] * len(files), Count.ROUND)
        numbered = number_ids(claims, files)
        num_poses = numbered.num_poses
        sent = network.ask(number_poses, numbered.runs, Count.PIGGYBACKED)
        received = [(told, trust_folder) for told in network.exchange(sent)]
        borders = network.ask(join_neighbours, received, Count.PIGGYBACKED)
        sizes = np.array([border.counts for border in borders]).T
        num_without_edge = num_poses - int(sizes[0].sum())
        _check_connected(borders, num_without_edge, files[0][1].parent)
        pairs = np.concatenate([border.pairs for border in borders])
        owners = np.concatenate([border.owners for border in borders])
        placements = place_poses(pairs, owners, len(files), borders[0].middle)
        has_indefinite = any(border.has_indefinite for border in borders)
        if weighting is Weighting.OWN:
            weighting = _own_weighting(borders)
        can_run_soc = network.ask(take_cost, [weighting] * len(files), Count.ROUND)
        has_two_costs = not all(can_run_soc)
        places = [(placement, has_two_costs) for placement in placements]
        summaries = network.ask(place_cover, places, Count.PIGGYBACKED)
        if memory != 0:
            summaries = _chosen_elimination(network, summaries)
        driver = Driver(summaries, num_poses, lambda: network, memory)
        return OpenedFiles(driver, sizes, weighting, has_indefinite, numbered.num_absent)
    except BaseException:  # also Ctrl-C: no robot stays behind
        network.workers.close()
        raise


def _chosen_elimination(network: CountedPool, summaries: list[RobotSummary]) -> list[RobotSummary]:
    """Have robots leave poses to the driver where that is cheaper, as `choose_elimination`."""
    system = CoverSystem.of(summaries)
    if not may_leave_poses(system):
        return summaries
    held = network.ask(propose_poses, [MOST_COUPLED] * len(summaries), Count.ROUND)
    larger = network.ask(place_larger_cover, positions_in_cover(held), Count.ROUND)
    if CoverSystem.of(larger).flops >= system.flops:
        return summaries
    network.ask(take_larger_cover, [None] * len(summaries), Count.PIGGYBACKED)
    return larger


def _own_weighting(borders: Sequence[Border]) -> Weighting:
    """The cost that is the own one of all robots' files together, as `weighting.own_weighting`."""
    is_F = all(border.is_isotropic for border in borders)
    if is_F or any(border.has_indefinite for border in borders):
        return Weighting.ISOTROPIC
    return Weighting.INFORMATION


class NumberedIds(NamedTuple):
    """Numbers and owners of the ids that every file names.

    Of the `num_poses` different ids `num_absent` are poses of robots without a file.
    """

    runs: list[OwnedRuns]
    num_poses: int
    num_absent: int


def number_ids(claims: Sequence[Claim], files: Sequence[RobotFile]) -> NumberedIds:
    """Numbers and owners of the ids that every file names.

    The ends of all runs cut the ids into intervals. All ids of an interval are named by the same
    files, or by none.
    """
    runs = np.concatenate([np.concatenate(claim[1:3]) for claim in claims])
    bounds = np.unique(np.concatenate([runs[:, 0], runs[:, 1] + 1]))
    first = bounds[:-1]
    size = np.diff(bounds)
    # Whether a file has VERTEX lines of an interval, and names it at all: (files, intervals).
    has_vertex = np.stack([_covers(vertices, bounds) for _, vertices, _, _ in claims])
    has_edge_alone = np.stack([_covers(others, bounds) for _, _, others, _ in claims])
    is_named = has_vertex | has_edge_alone
    claimants = np.where(has_vertex.any(axis=0), has_vertex, is_named)
    owner = claimants.argmax(axis=0)  # the first of them
    known = is_named.any(axis=0)
    _check_claims(claims, files, owner[known])
    known_size = np.where(known, size, 0)
    number = np.cumsum(known_size) - known_size
    digits = most_digits(digits for *_, digits in claims)
    owned = [OwnedRuns(first[named], number[named], owner[named], digits) for named in is_named]
    # As `absent_ids`: a file without VERTEX lines places all that it names.
    is_file_placed = np.array([len(vertices) > 0 for _, vertices, _, _ in claims])
    is_placed = (has_vertex | (is_named & ~is_file_placed[:, None])).any(axis=0)
    num_absent = int(known_size[~is_placed].sum())
    return NumberedIds(owned, int(known_size.sum()), num_absent)


def _covers(runs: IntArray, bounds: IntArray) -> BoolArray:
    """Whether runs of ids cover the intervals between bounds, (intervals,)."""
    start = np.searchsorted(bounds, runs[:, 0])
    end = np.searchsorted(bounds, runs[:, 1] + 1)
    num_started = np.bincount(start, minlength=len(bounds))
    num_ended = np.bincount(end, minlength=len(bounds))
    return np.asarray(np.cumsum(num_started - num_ended)[:-1] > 0)


def _check_claims(claims: Sequence[Claim], files: Sequence[RobotFile], owners: IntArray) -> None:
    """Refuse a file of another dimension than the first, and one without a pose of its own."""
    d_of_first = claims[0][0]
    for (robot, path), (d, *_) in zip(files, claims, strict=True):
        if d != d_of_first:
            raise FileFormatError(path, None, "2D beside 3D; put it into a folder of its own")
        if robot not in owners:
            problem = f"no pose in it is of this robot; remove it, or {READ_HERE}"
            raise FileFormatError(path, None, problem)


def _check_connected(borders: Sequence[Border], num_without_edge: int, folder: Path) -> None:
    """Raise a GraphError unless the robots' graphs together are connected.

    Positions have to be connected by edges with tau > 0, rotations by edges with kappa > 0. A
    component of one robot that has a shared pose is a vertex, as the shared poses are; the rest are
    components of their own.
    """
    shared = np.concatenate([border.poses for border in borders])
    poses, pose = np.unique(shared, return_inverse=True)
    num_shared = [len(border.poses) for border in borders]
    robot = np.repeat(np.arange(len(borders)), num_shared)
    for kind, what in enumerate(("graph", "positions", "rotations")):
        label = np.concatenate([border.labels[kind] for border in borders])
        parts, part = np.unique(np.stack([robot, label]), axis=1, return_inverse=True)
        num_vertices = len(poses) + parts.shape[1]
        tied = edge_counts(pose, len(poses) + part.ravel(), num_vertices)
        count = num_without_edge + sum(int(border.alone[kind]) for border in borders)
        if len(poses):
            count += connected_components(tied)[0]
        if count > 1:
            problem = f"the {what} of all robots fall into {count} parts, no edge between"
            raise GraphError(f"{folder}: {problem}; {READ_HERE}")


def _runs(ids: IntArray) -> IntArray:
    """First and last id of every run of consecutive ids, (k, 2), of ids in ascending order."""
    is_first = np.diff(ids, prepend=ids[:1] - 2) != 1
    is_last = np.diff(ids, append=ids[-1:] + 2) != 1
    return np.stack([ids[is_first], ids[is_last]], axis=1)
