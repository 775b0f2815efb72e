"""Robots that load their own files, and a driver that learns nothing of the graph but the interface between them.

Ids reach the driver as runs of consecutive ones, so that it can number the poses; edges between robots by their ends,
of which it takes the vertex cover. What robots measured of each other they send each other. A pose belongs to the first
file with a VERTEX line of it, else to the first that names it; edges of several files are one as of `read_g2o`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import connected_components

from pgo_models.certificates.rounding_errors import objective_rounding
from pgo_models.errors import FileFormatError, GraphError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.g2o import join_edges, make_folder, write_g2o
from pgo_models.graphs.g2o_parser import G2OLines, information_of, poses_of, read_lines
from pgo_models.graphs.measurements import IntArray
from pgo_models.graphs.pose_graph import WORLD_ID, PoseGraph, edge_counts, middle_pose
from pgo_models.graphs.precisions import edge_precisions
from pgo_models.problem.matrices import isotropic_weights
from solvers.distributed.driver import Driver
from solvers.distributed.robots.agent import Agent, held_poses, order_interior
from solvers.distributed.robots.interior import Interior, interior_of
from solvers.network.counted_pool import Count, CountedPool
from solvers.network.engine import Engine
from solvers.soc.subgraph import Outline, Placement, Subgraph, place_poses

READ_HERE = "have the graph read in one process: --split given, or solve(read_g2o(folder), robots=..)"


RobotFile = tuple[int, Path]  # a robot and its file, on the machine where the robot runs
Claim = tuple[int, IntArray, IntArray]  # d, and ids of VERTEX lines, and of edges alone, as `_runs`


@dataclass(frozen=True, eq=False)
class OwnedRuns:
    """Runs of consecutive ids, (k,): the first, its number in the whole graph, and who owns them."""

    first: IntArray
    number: IntArray
    owner: IntArray


@dataclass(frozen=True, eq=False)
class Edges:
    """Edges as of `G2OLines`, and the numbers and owners of their ends, (m, 2)."""

    ids: IntArray
    rows: Array
    numbers: IntArray
    owners: IntArray

    def some(self, chosen: IntArray | BoolArray | slice) -> Edges:
        """Some of them."""
        return Edges(*(values[chosen] for values in vars(self).values()))


@dataclass(frozen=True, eq=False)
class Border:
    """What a robot says of its edges to others."""

    counts: tuple[int, int]  # poses that it owns, and edges, a shared one at one end
    pairs: IntArray  # (k, 2): poses that its edges to others join
    owners: IntArray  # (k, 2): of these
    poses: IntArray  # (h,): all of them
    labels: IntArray  # (3, h): their components by all edges, by those with tau > 0, and with kappa > 0
    alone: IntArray  # (3,): how many components have none of them
    middle: int  # its middle pose, where it has no such edge


@dataclass(frozen=True, eq=False)
class Answer:
    """How well a robot knows its part of F, and a pose to hold the frame: a fixed one, or the first of its own."""

    error: float
    held: tuple[bool, int, int]  # whether that pose is fixed, its number and id
    solved: Array  # (d + 1, d): its rows t and R^T
    given: Array  # (d + 1, d): the same in the file, nan if not there


class FileAgent(Agent):
    """A robot that loads its own file; orders about that are given in the order in which they stand below."""

    lines: G2OLines
    edges: Edges
    graph: PoseGraph  # of its own poses, and those at the far end of its edges
    numbers: IntArray  # (n_a,): of these in the whole graph, ascending
    owners: IntArray  # (n_a,)
    given: Array  # of `Answer`
    answer: Poses

    def __init__(self, source: RobotFile) -> None:
        (self.robot, self.path), self.backend = source, None
        self.interior, self.copies, self.front = None, None, None


def read_file(agent: FileAgent, _: None) -> Claim:
    """Read the file: the ids in it. Errors are those of `read_lines`; a GraphError for priors and landmarks."""
    path = agent.path
    agent.lines = lines = read_lines(path)
    if len(lines.landmarks) or (lines.edge_ids == WORLD_ID).any():
        raise GraphError(f"{path} has priors or landmarks, which all robots share; {READ_HERE}")
    return lines.d, _runs(np.unique(lines.vertex_ids)), _runs(np.setdiff1d(lines.edge_ids, lines.vertex_ids))


def number_poses(agent: FileAgent, runs: OwnedRuns) -> Mapping[int, Edges]:
    """Take numbers and owners for the ids; edges of the file with an end at another robot, by that robot."""
    ids, robot = agent.lines.edge_ids, agent.robot
    at = np.searchsorted(runs.first, ids, side="right") - 1
    numbers, owners = runs.number[at] + ids - runs.first[at], runs.owner[at]
    edges = Edges(ids, agent.lines.edges, numbers, owners)
    agent.edges = edges.some((owners == robot).any(axis=1))
    return {to: edges.some((owners == to).any(axis=1)) for to in np.unique(owners).tolist() if to != robot}


def join_neighbours(agent: FileAgent, received: Mapping[int, Edges]) -> Border:
    """Make the robot's graph of its edges and those that others have of its poses; FIX lines of its own poses count."""
    lines, robot, path = agent.lines, agent.robot, agent.path
    files = [one for _, one in sorted({**received, robot: agent.edges}.items())]
    joined = join_edges([(file.ids, file.rows) for file in files])
    parts = [vars(file.some(kept)).values() for file, kept in zip(files, joined, strict=True)]
    edges = Edges(*map(np.concatenate, zip(*parts, strict=True)))
    if not len(edges.rows):
        raise GraphError(f"{path}: no edge touches a pose of this robot; add one, or take the file away")
    agent.numbers, at, ends = np.unique(edges.numbers, return_index=True, return_inverse=True)
    agent.owners, ids, (i, j) = edges.owners.ravel()[at], edges.ids.ravel()[at], ends.reshape(-1, 2).T
    is_own, information = agent.owners == robot, information_of(lines.d, edges.rows)
    measured = *poses_of(lines.d, edges.rows), *edge_precisions(information), information
    fixed = np.flatnonzero(is_own & np.isin(ids, lines.fixed))
    agent.graph = graph = PoseGraph(len(ids), i, j, *measured, ids, fixed=fixed, name=path.stem)
    given = lines.vertices[lines.vertex_ids == ids[fixed[0] if len(fixed) else np.argmax(is_own)]]
    agent.given = Poses(*poses_of(lines.d, given)).stacked() if len(given) else np.full((lines.d + 1, lines.d), np.nan)
    del agent.lines, agent.edges
    both = np.stack([i, j], axis=1)
    pairs = np.unique(both[agent.owners[i] != agent.owners[j]], axis=0)
    poses, kinds = np.unique(pairs), (graph.tau >= 0, graph.tau > 0, graph.kappa > 0)
    labels = [connected_components(edge_counts(i[kind], j[kind], len(ids)))[1] for kind in kinds]
    alone = np.array([len(np.setdiff1d(label, label[poses])) for label in labels])
    counts = int(is_own.sum()), int((agent.owners[both].min(axis=1) == robot).sum())
    middle = -1 if len(poses) else int(agent.numbers[middle_pose(graph)])
    tied = agent.numbers[poses], np.stack(labels)[:, poses]
    return Border(counts, agent.numbers[pairs], agent.owners[pairs], *tied, alone, middle)


def place_cover(agent: FileAgent, placement: Placement) -> Outline:
    """Learn which poses the driver solves for, and who else holds which: from now on an agent like any other."""
    known = agent.robot, agent.graph, agent.numbers, agent.owners
    of_edges = np.arange(agent.graph.num_edges), isotropic_weights(agent.graph)
    agent.subgraph = Subgraph(*known, *placement.of(*known), *of_edges)
    agent.interior = interior_of(agent.subgraph, agent.backend)
    return replace(agent.subgraph.outline, part=None)


def keep_answer(agent: FileAgent, cover: Poses) -> Answer:
    """Keep the poses at hand for the answer; of the cover they are the driver's."""
    agent.answer, interior, fixed = held_poses(agent, cover), agent.interior, agent.graph.fixed
    first = int(fixed[0] if len(fixed) else np.argmax(agent.subgraph.is_own))
    error = 0.0 if interior is None else objective_rounding(interior.problem, interior.state.poses).error
    held = len(fixed) > 0, int(agent.numbers[first]), int(agent.graph.pose_ids[first])
    return Answer(error, held, agent.answer[np.array([first])].stacked(), agent.given)


def return_to_answer(agent: FileAgent, _: None) -> None:
    """Go back to the poses that were kept; the driver does likewise."""
    if agent.interior is not None:
        order_interior(Interior.set_poses, agent, agent.answer[_places(agent, agent.interior)])


def move_answer(agent: FileAgent, motion: tuple[Array, Array]) -> Array:
    """Move the poses that were kept by (R, t); parts of F there, of its rounding level and of its error, (3,)."""
    agent.answer = agent.answer.moved(*motion)
    if agent.interior is None:
        return np.zeros(3)
    problem, poses = agent.interior.problem, agent.answer[_places(agent, agent.interior)]
    rounding = objective_rounding(problem, poses)
    return np.array([problem.objective(poses), rounding.level, rounding.error])


def write_answer(folder: Path, agent: FileAgent, _: None) -> None:
    """Write the poses that were kept, and the robot's edges."""
    make_folder(folder)
    write_g2o(agent.graph, folder / f"{agent.robot}.g2o", agent.answer, agent.subgraph.is_own)


def open_files(files: Sequence[RobotFile], engine: Engine, memory: float) -> tuple[Driver, IntArray]:
    """Driver of robots with these files, and how many poses, and edges, every robot has, (2, num_robots).

    A FileFormatError for a file that cannot be read or has no pose of its own, a GraphError when the graph is not
    connected. All but the start of the robots is counted.
    """
    network = CountedPool(engine.open(FileAgent, files), len(files))
    try:
        runs, num_poses = number_ids(network.ask(read_file, [None] * len(files), Count.ROUND), files)
        sent = network.ask(number_poses, runs, Count.PIGGYBACKED)
        borders = network.ask(join_neighbours, network.hand_on(sent), Count.PIGGYBACKED)
        sizes = np.array([border.counts for border in borders]).T
        _check_connected(borders, num_poses - int(sizes[0].sum()), files[0][1].parent)
        pairs, owners = (np.concatenate([getattr(one, name) for one in borders]) for name in ("pairs", "owners"))
        outlines = network.ask(place_cover, place_poses(pairs, owners, len(files), borders[0].middle), Count.ROUND)
        most = max(int(outline.in_cover.max(initial=0)) for outline in outlines)
        return Driver(outlines, num_poses, lambda: network, memory, grounded=(most + 1) // 2), sizes
    except BaseException:  # also Ctrl-C: nothing stays behind
        network.workers.close()
        raise


def number_ids(claims: Sequence[Claim], files: Sequence[RobotFile]) -> tuple[list[OwnedRuns], int]:
    """Numbers and owners of the ids that every file names, and how many ids there are."""
    ends = np.concatenate([runs for _, *both in claims for runs in both])
    marks = np.unique(np.concatenate([ends[:, 0], ends[:, 1] + 1]))
    first, size = marks[:-1], np.diff(marks)  # between two marks all ids are of the same files, or of none

    def covered(runs: IntArray) -> BoolArray:
        at = np.searchsorted(marks, runs + np.array([0, 1]))
        change = np.bincount(at[:, 0], minlength=len(marks)) - np.bincount(at[:, 1], minlength=len(marks))
        return np.asarray(np.cumsum(change)[:-1] > 0)

    has_vertex = np.stack([covered(vertices) for _, vertices, _ in claims])
    names = has_vertex | np.stack([covered(others) for _, _, others in claims])
    owner, known = np.where(has_vertex.any(axis=0), has_vertex, names).argmax(axis=0), np.flatnonzero(names.any(axis=0))
    for (robot, path), (d, *_) in zip(files, claims, strict=True):
        if d != claims[0][0] or robot not in owner[known]:
            problem = "no pose in it is of this robot" if d == claims[0][0] else "2D beside 3D"
            raise FileFormatError(path, None, f"{problem}; take it away, or {READ_HERE}")
    number = np.cumsum(np.where(names.any(axis=0), size, 0)) - size
    return [OwnedRuns(first[own], number[own], owner[own]) for own in names], int(size[known].sum())


def _places(agent: FileAgent, interior: Interior) -> IntArray:
    """Places of the interior's poses among those that the robot holds."""
    return np.searchsorted(agent.subgraph.poses, interior.part.poses)


def _check_connected(borders: Sequence[Border], without_edge: int, folder: Path) -> None:
    """Raise a GraphError when the robots' graphs are not tied together to one."""
    poses, pose = np.unique(np.concatenate([border.poses for border in borders]), return_inverse=True)
    robot = np.repeat(np.arange(len(borders)), [len(border.poses) for border in borders])
    for kind, what in enumerate(("graph", "positions", "rotations")):
        label = np.stack([robot, np.concatenate([border.labels[kind] for border in borders])])
        parts, part = np.unique(label, axis=1, return_inverse=True)
        tied = edge_counts(pose, len(poses) + part.ravel(), len(poses) + parts.shape[1])
        alone = without_edge + sum(int(border.alone[kind]) for border in borders)
        count = alone + (connected_components(tied)[0] if len(poses) else 0)
        if count > 1:
            problem = f"the {what} of all robots fall into {count} parts, no edge between"
            raise GraphError(f"{folder}: {problem}; {READ_HERE}")


def _runs(ids: IntArray) -> IntArray:
    """First and last of all runs of consecutive ids, (k, 2), of ids in ascending order."""
    first, last = np.diff(ids, prepend=ids[:1] - 2) != 1, np.diff(ids, append=ids[-1:] + 2) != 1
    return np.stack([ids[first], ids[last]], axis=1)
