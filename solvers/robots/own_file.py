"""A robot that loads its own file: what it knows, order by order, until it is one like any other.

The orders stand below in the sequence in which they are given: `read_file`, `number_poses`,
`join_neighbours`, `leave_out` where poses are joined with no others, those of `consistency` where
edges are judged, `take_cost`, `place_cover`; then, after the solve, `keep_answer`,
`return_to_answer`, `move_answer` and `write_answer`. Where edges are judged again those of
`revision` follow `keep_answer`, and go on with `take_cost`. `solvers.robots.setup` gives them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import connected_components

from pgo_models.certificates.fit import FITS_WITHOUT_EDGES
from pgo_models.certificates.rounding_errors import ObjectiveRounding, objective_rounding
from pgo_models.errors import GraphError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.g2o import edge_rows_to_keep, make_folder, write_g2o
from pgo_models.graphs.g2o_folder import (
    Owners,
    Rows,
    are_reprinted,
    check_measurements,
    check_places,
    edges_as_first_printed,
    measured_edges,
    placed_poses,
)
from pgo_models.graphs.g2o_parser import G2OLines
from pgo_models.graphs.g2o_rows import information_of, measurements_of, poses_of
from pgo_models.graphs.pose_graph import WORLD_ID, IntArray, PoseGraph, edge_counts, middle_pose
from pgo_models.graphs.precisions import edge_precisions, indefinite_edges
from pgo_models.graphs.written_digits import WrittenDigits, written_errors
from pgo_models.problem.weighting import Weighting, convex_cost, is_isotropic
from solvers.carry.messages import Messages
from solvers.carry.registry import order, record
from solvers.robots.agent import Agent, held_poses, order_interior
from solvers.robots.part import Interior
from solvers.robots.poses import set_poses
from solvers.soc.subgraph import PartProblem, Placement, RobotSummary

READ_HERE = (
    "have the graph read in one process: --split given, or solve(read_g2o(folder), robots=..)"
)


# What a file names: d, the ids of its VERTEX lines, and the ids that only its edges name; see
# `_runs`. And the digits that it is written with.
Claim = tuple[int, IntArray, IntArray, WrittenDigits]


@record("OwnedRuns")
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


@record("NumberedLines")
@dataclass(frozen=True, eq=False)
class NumberedLines:
    """EDGE lines of a file with the numbers and owners of their ends, (m, 2), and VERTEX lines.

    A robot tells another the edges that touch its poses, and the VERTEX lines of these.
    """

    edges: Rows
    numbers: IntArray
    owners: IntArray
    places: Rows

    def some(self, edges: IntArray | BoolArray | slice, places: BoolArray | slice) -> NumberedLines:
        """Some of the lines."""
        return NumberedLines(
            self.edges.some(edges),
            self.numbers[edges],
            self.owners[edges],
            self.places.some(places),
        )


@record("Border")
@dataclass(frozen=True, eq=False)
class Border:
    """What a robot reports of its edges to other robots."""

    counts: tuple[int, int]  # own poses, and edges, where a shared edge counts at one end
    pairs: IntArray  # (k, 2): poses that its edges to others join
    owners: IntArray  # (k, 2): owners of these poses
    num_edges: IntArray  # (k,): how many edges join them
    poses: IntArray  # (h,): all of these poses, ascending
    # (3, h): their components in the graph of all edges, of those with tau > 0, and of those with
    # kappa > 0.
    labels: IntArray
    alone: IntArray  # (3,): number of components without any of these poses
    middle: int  # its middle pose if it has no edge to another robot, else -1
    is_isotropic: bool  # whether chi2 of its edges is F
    has_indefinite: bool  # whether the share of an edge in chi2 can be negative


_NONE = np.zeros(0, dtype=np.int64)
_WITHOUT_EDGES = Border(
    counts=(0, 0),
    pairs=_NONE.reshape(0, 2),
    owners=_NONE.reshape(0, 2),
    num_edges=_NONE,
    poses=_NONE,
    labels=_NONE.reshape(3, 0),
    alone=np.zeros(3, dtype=np.int64),
    middle=-1,
    is_isotropic=True,
    has_indefinite=False,
)

NO_ROUNDING = ObjectiveRounding(0.0, 0.0, FITS_WITHOUT_EDGES)  # of no edges


@record("Answer")
@dataclass(frozen=True, eq=False)
class Answer:
    """Rounding of a robot's part of the cost, and a pose that can hold the frame.

    That pose is its first one with a FIX line, or else its first one.
    """

    rounding: ObjectiveRounding
    held: tuple[bool, int, int]  # whether the pose has a FIX line, its number and id
    solved: Array  # (d + 1, d): rows t and R^T of the pose
    given: Array  # (d + 1, d): the same in the file, nan if it is not there


@record("MovedAnswer")
@dataclass(frozen=True, eq=False)
class MovedAnswer:
    """A robot's part of the cost where its answer was moved to, and of F there."""

    cost: float
    rounding: ObjectiveRounding
    F: float


# What a robot knows of its own lines, until the set-up has made its graph and after.


@dataclass(frozen=True, eq=False)
class NumberedFile:
    """The lines of a robot's file, with the digits of all files, and what they say of own poses."""

    lines: G2OLines
    own: NumberedLines


@dataclass(frozen=True, eq=False)
class OwnGraph:
    """The graph of a robot with own lines: own poses, and those at the far end of its edges.

    The orders of a robust solve leave another one, with some of the edges.
    """

    graph: PoseGraph  # its n_a poses and m_a edges
    # (n_a,): numbers of the poses in the whole graph, which ascend, and which robot owns each
    numbers: IntArray
    owners: IntArray
    given: Array  # as in `Answer`
    # (k, 2): ids of the ends of edges that were left out
    rejected: IntArray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    everything: OwnGraph | None = None  # what was joined at first, with m edges; none if it is this
    # (m_a,): the edges of everything that are left; empty if this is everything
    edges: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    # (m,): of everything in a robust solve: whether an edge agrees pairwise
    agrees: BoolArray | None = None
    before: OwnGraph | None = None  # during a robust solve: what to go back to
    thresholds: Array | None = None  # (m_a,): during a robust solve: those of the edges
    solved: Poses | None = None  # own poses that the solve before has found
    problem: PartProblem | None = None  # the cost that is solved, from `take_cost` to `place_cover`
    answer: Poses | None = None  # poses that `keep_answer` kept
    # (m_a,): during a robust solve: edges within their thresholds, as far as this robot counts them
    within: BoolArray | None = None
    # (m,): during a robust solve: edges of everything that are near the map
    near: BoolArray | None = None

    @property
    def kept(self) -> Poses:
        """The poses that `keep_answer` kept."""
        assert self.answer is not None
        return self.answer


@order("files.read_file")
def read_file(agent: Agent, _: None) -> Claim:
    """Read the file, and return the ids in it.

    Errors are those of `read_lines`, and a GraphError for priors and landmarks.
    """
    lines = lines_without(agent.own_lines.read(), agent.left_out)
    if len(lines.landmarks) or (lines.edge_ids == WORLD_ID).any():
        raise GraphError(
            f"{agent.own_lines.path} has priors or landmarks, which all robots share; {READ_HERE}"
        )
    agent.record = lines
    ids_of_edges_alone = np.setdiff1d(lines.edge_ids, lines.vertex_ids)
    runs_of_vertices = _runs(np.unique(lines.vertex_ids))
    return lines.d, runs_of_vertices, _runs(ids_of_edges_alone), lines.digits


@order("files.number_poses")
def number_poses(agent: Agent, runs: OwnedRuns) -> Messages[NumberedLines]:
    """Take numbers and owners for the ids; return what others are to be told of their poses."""
    lines = agent.known(G2OLines)
    rows = measured_edges(lines)
    run = runs.of(rows.ids)
    numbers = runs.number[run] + rows.ids - runs.first[run]
    owners = runs.owner[run]
    places = placed_poses(lines)
    if agent.own_lines.text is not None:  # a robot of a team
        _refuse_claims(agent, lines, runs)
    numbered = NumberedLines(rows, numbers, owners, places)
    owners_of_places = runs.owner[runs.of(places.ids)]
    messages: Messages[NumberedLines] = Messages()
    for robot in np.unique(np.append(owners, owners_of_places)).tolist():
        touches = (owners == robot).any(axis=1)
        messages[robot] = numbered.some(touches, owners_of_places == robot)
    own_message = messages.pop(agent.robot, numbered.some(slice(0), slice(0)))
    agent.record = NumberedFile(replace(lines, digits=runs.digits), own_message)
    return messages


def _refuse_claims(agent: Agent, lines: G2OLines, runs: OwnedRuns) -> None:
    """Raise a GraphError where poses of the robot are said to be another's.

    It would tell that one of edges that are not between the two.
    """
    owners = runs.owner[runs.of(lines.vertex_ids)]
    claimed = np.unique(lines.vertex_ids[owners != agent.robot])
    if len(claimed):
        raise GraphError(
            f"{agent.own_lines.path} has VERTEX lines of {len(claimed)} poses that are said to be "
            f"another robot's, pose {claimed[0]} first; each pose is one robot's, and what is not "
            "at the border of a robot is not told"
        )


@order("files.join_neighbours")
def join_neighbours(
    agent: Agent, request: tuple[Messages[NumberedLines], bool]
) -> tuple[Border, int]:
    """Make the graph of the robot: its own edges, and those that others have of its poses.

    Return its border, and how many edges of its poses stand in another file with another last digit
    (an edge between two robots counts with the first of them). A GraphError where it has no edge;
    a robot of a team has a border without poses then.

    FIX lines of its own poses count. The request is what others told the robot, and whether the
    folder is trusted, so that nothing is asked that `read_g2o` would ask.
    """
    received, is_trusted = request
    known = agent.known(NumberedFile)
    lines = known.lines
    parts = [part for _, part in sorted({**received, agent.robot: known.own}.items())]
    if not is_trusted:
        check_places(lines.d, [part.places for part in parts])
        ids = np.concatenate([part.edges.ids.ravel() for part in parts])
        ids, first = np.unique(ids, return_index=True)
        robots = np.concatenate([part.owners.ravel() for part in parts])[first]
        check_measurements(lines.d, [part.edges for part in parts], Owners(ids, robots))
    ids_of_ends, rows, numbers_of_ends, owners_of_ends, num_copies = _joined_edges(
        lines.d, parts, agent.robot
    )
    if not len(rows) and agent.own_lines.text is not None:  # a robot of a team, in no part of it
        return _WITHOUT_EDGES, num_copies
    if not len(rows):
        raise GraphError(
            f"{agent.own_lines.path}: no edge touches a pose of this robot; "
            "add one, or remove the file"
        )
    numbers, first, ends = np.unique(numbers_of_ends, return_index=True, return_inverse=True)
    owners = owners_of_ends.ravel()[first]
    ids = ids_of_ends.ravel()[first]
    i, j = ends.reshape(-1, 2).T
    is_own = owners == agent.robot
    R_ij, t_ij = poses_of(lines.d, rows)
    information = information_of(lines.d, rows)
    kappa, tau = edge_precisions(information)
    fixed = np.flatnonzero(is_own & np.isin(ids, lines.fixed))
    graph = PoseGraph(
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
        name=agent.own_lines.path.stem,
        written_error=written_errors(measurements_of(lines.d, rows), lines.digits),
        weights_error=lines.weights_error,
    )
    holding = fixed[0] if len(fixed) else np.argmax(is_own)
    joined = OwnGraph(graph, numbers, owners, _given_pose(lines, ids[holding]))
    agent.record = joined
    return border_of(agent.robot, joined), num_copies


def _joined_edges(
    d: int, files: Sequence[NumberedLines], robot: int
) -> tuple[IntArray, Array, IntArray, IntArray, int]:
    """Edges of several files as one, in which an edge of several files counts once.

    They are the ids of the ends, rows as in `G2OLines`, numbers and owners of the ends, and how
    many edges, of which this robot owns the first end, are printed again.
    """
    as_first = edges_as_first_printed(d, [file.edges for file in files])
    num_copies = sum(
        int((are_reprinted(file.edges, rows) & (file.owners.min(axis=1) == robot)).sum())
        for file, rows in zip(files, as_first, strict=True)
    )
    kept = edge_rows_to_keep([(rows.ids, rows.numbers) for rows in as_first])
    parts = [file.some(chosen, slice(0)) for file, chosen in zip(files, kept, strict=True)]
    return (
        np.concatenate([part.edges.ids for part in parts]),
        np.concatenate([part.edges.numbers for part in parts]),
        np.concatenate([part.numbers for part in parts]),
        np.concatenate([part.owners for part in parts]),
        num_copies,
    )


def _given_pose(lines: G2OLines, pose_id: int) -> Array:
    """Rows t and R^T of a pose in the file, (d + 1, d); nan if it is not there."""
    rows = lines.vertices[lines.vertex_ids == pose_id]
    if len(rows) == 0:
        return np.full((lines.d + 1, lines.d), np.nan)
    return Poses(*poses_of(lines.d, rows)).stacked()


def border_of(robot: int, joined: OwnGraph) -> Border:
    """Border of a robot whose graph is known."""
    graph = joined.graph
    numbers = joined.numbers
    owners = joined.owners
    ends = np.stack([graph.i, graph.j], axis=1)
    between = ends[owners[graph.i] != owners[graph.j]]
    pairs, num_of_pair = np.unique(between, axis=0, return_counts=True)
    poses = np.unique(pairs)
    labels = []
    for kind in (graph.tau >= 0, graph.tau > 0, graph.kappa > 0):
        adjacency = edge_counts(graph.i[kind], graph.j[kind], graph.num_poses)
        labels.append(connected_components(adjacency)[1])
    # A shared edge counts with the owner of the lower number.
    num_poses = int((owners == robot).sum())
    num_edges = int((owners[ends].min(axis=1) == robot).sum())
    return Border(
        counts=(num_poses, num_edges),
        pairs=numbers[pairs],
        owners=owners[pairs],
        num_edges=num_of_pair,
        poses=numbers[poses],
        labels=np.stack(labels)[:, poses],
        alone=np.array([len(np.setdiff1d(label, label[poses])) for label in labels]),
        middle=-1 if len(poses) else int(numbers[middle_pose(graph)]),
        is_isotropic=is_isotropic(graph),
        has_indefinite=bool(indefinite_edges(graph).any()),
    )


@order("files.leave_out")
def leave_out(agent: Agent, components: IntArray) -> Claim:
    """Leave out the poses that no edge joins with most of the robot's own; read what is left.

    `components`, (h,), are those of the poses at its border in the graph of all robots.
    """
    own = agent.known(OwnGraph)
    graph = own.graph
    is_own = own.owners == agent.robot
    ends = np.stack([graph.i, graph.j], axis=1)
    border = np.unique(ends[is_own[graph.i] != is_own[graph.j]])
    _, label = connected_components(edge_counts(graph.i, graph.j, graph.num_poses))
    component = label + 1 + components.max(initial=0)  # those without a pose at the border
    for pose, number in zip(border.tolist(), components.tolist(), strict=True):
        component[label == label[pose]] = number
    numbers, counts = np.unique(component[is_own], return_counts=True)
    kept = graph.pose_ids[is_own & (component == numbers[np.argmax(counts)])]
    own_ids = np.union1d(agent.own_lines.read().vertex_ids, graph.pose_ids[is_own])
    agent.left_out = np.setdiff1d(own_ids, kept)
    return read_file(agent, None)


def lines_without(lines: G2OLines, left_out: IntArray) -> G2OLines:
    """Lines without those of some poses."""
    if not len(left_out):
        return lines
    vertices = ~np.isin(lines.vertex_ids, left_out)
    edges = ~np.isin(lines.edge_ids, left_out).any(axis=1)
    fixed = ~np.isin(lines.fixed, left_out)
    return replace(
        lines,
        vertex_ids=lines.vertex_ids[vertices],
        vertex_lines=lines.vertex_lines[vertices],
        vertices=lines.vertices[vertices],
        edge_ids=lines.edge_ids[edges],
        edges=lines.edges[edges],
        edge_lines=lines.edge_lines[edges],
        fixed=lines.fixed[fixed],
        fixed_lines=lines.fixed_lines[fixed],
    )


@order("files.take_cost")
def take_cost(agent: Agent, weighting: Weighting) -> bool:
    """Learn which cost is solved: F or chi2. Return whether SOC can run on the robot's part of it.

    A GraphError for a matrix that chi2 cannot have, and where chi2 is one of rotations alone.
    """
    joined = agent.known(OwnGraph)
    problem = PartProblem(joined.graph, weighting=weighting)
    try:
        cost = problem.weights
    except GraphError as error:
        raise GraphError(f"{agent.own_lines.path}: {error}") from error
    if not cost.has_translations:
        raise GraphError(f"{agent.own_lines.path}: no edge measures a translation; {READ_HERE}")
    agent.record = replace(joined, problem=problem)
    return cost.is_quadratic and cost.is_convex


@order("files.place_cover")
def place_cover(agent: Agent, place: tuple[Placement, bool]) -> RobotSummary:
    """Learn which poses the driver solves for, and which robots hold which of them.

    `place` also says whether SOC runs on another cost than the one that is solved. From now on the
    robot is an agent like any other.
    """
    placement, has_two_costs = place
    own = agent.known(OwnGraph)
    problem = own.problem
    assert problem is not None
    weights = problem.weights
    final = None
    if has_two_costs:
        final = weights
        weights = convex_cost(problem.information, own.graph.d)
    subgraph = placement.subgraph(
        agent.robot,
        own.graph,
        own.numbers,
        own.owners,
        np.arange(own.graph.num_edges),
        weights,
        final,
        own.thresholds,
    ).for_driver()
    agent.record = replace(own, problem=None)  # the subgraph has its weights
    agent.take_part(subgraph)
    return replace(subgraph.summary, part=None)


@order("files.keep_answer")
def keep_answer(agent: Agent, cover: Poses) -> Answer:
    """Keep the current poses for the answer; the driver sends those of the cover."""
    own = agent.known(OwnGraph)
    answer = held_poses(agent, cover)
    agent.record = replace(own, answer=answer)
    interior = agent.interior
    fixed = own.graph.fixed
    holding = int(fixed[0] if len(fixed) else np.argmax(agent.subgraph.is_own))
    rounding = NO_ROUNDING
    if interior is not None:
        rounding = objective_rounding(interior.problem, interior.poses)
    number = int(own.numbers[holding])
    pose_id = int(own.graph.pose_ids[holding])
    solved = answer[np.array([holding])].stacked()
    return Answer(rounding, (len(fixed) > 0, number, pose_id), solved, own.given)


@order("files.return_to_answer")
def return_to_answer(agent: Agent, _: None) -> None:
    """Return to the poses that were kept; the driver does likewise."""
    if agent.interior is not None:
        answer = _interior_answer(agent, agent.interior)
        order_interior(set_poses, agent, answer)


@order("files.move_answer")
def move_answer(agent: Agent, motion: tuple[Array, Array]) -> MovedAnswer:
    """Move the poses that were kept by (R, t); return the part of the cost there."""
    own = agent.known(OwnGraph)
    agent.record = replace(own, answer=own.kept.moved(*motion))
    if agent.interior is None:
        return MovedAnswer(0.0, NO_ROUNDING, 0.0)
    problem = agent.interior.problem
    poses = _interior_answer(agent, agent.interior)
    graph = problem.graph
    F = PartProblem(graph, problem.backend, Weighting.ISOTROPIC).objective(poses)
    return MovedAnswer(problem.objective(poses), objective_rounding(problem, poses), F)


def _interior_answer(agent: Agent, interior: Interior) -> Poses:
    """Poses that were kept, of those that the interior's problem has."""
    kept = agent.known(OwnGraph).kept
    return kept[np.searchsorted(agent.subgraph.poses, interior.part.poses)]


@order("files.write_answer")
def write_answer(folder: Path, agent: Agent, _: None) -> None:
    """Write the poses that were kept, and the robot's edges."""
    make_folder(folder)
    own = agent.known(OwnGraph)
    path = folder / f"{agent.robot}.g2o"
    write_g2o(own.graph, path, own.kept, agent.subgraph.is_own)


def _runs(ids: IntArray) -> IntArray:
    """First and last id of every run of consecutive ids, (k, 2), of ids in ascending order."""
    is_first = np.diff(ids, prepend=ids[:1] - 2) != 1
    is_last = np.diff(ids, append=ids[-1:] + 2) != 1
    return np.stack([ids[is_first], ids[is_last]], axis=1)
