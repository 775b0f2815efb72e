"""The set-up of a driver and its robots: of a graph in memory, or of robots with own lines.

`open_driver` cuts a graph that this process has, and gives every robot its part. `open_files` has
robots read their own lines. The driver then learns the ids of poses as runs of consecutive ids, so
that it can number the poses; of the edges between robots their ends, of which it computes a vertex
cover; counts of poses and edges, and which poses are connected; and in a robust solve how large the
errors of each robot are and how many edges agree. Measurements between two robots are messages
between these robots, which the process of the driver delivers: they pass through its memory, and
nothing of the driver reads them. A pose belongs to the first file with a VERTEX line of it, or else
to the first file that names it. An edge that stands in several files counts once, as in `read_g2o`.
What robots do is in `solvers.robots.own_file`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import connected_components

from pgo_models.errors import FileFormatError, GraphError
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import IntArray, edge_counts, least_tree
from pgo_models.graphs.written_digits import most_digits
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.carry.counted_pool import Count, CountedPool
from solvers.carry.ledger import BYTES_PER_NUMBER
from solvers.carry.process import DEFAULT_MEMORY, Engine
from solvers.robots.agent import Agent, OwnLines
from solvers.robots.consistency import (
    AgreeingCounts,
    ConsistentPart,
    judge_closures,
    keep_agreeing,
    tell_error_scale,
    tell_trajectories,
)
from solvers.robots.driver import Driver
from solvers.robots.own_file import (
    READ_HERE,
    Border,
    Claim,
    OwnedRuns,
    join_neighbours,
    leave_out,
    number_poses,
    place_cover,
    read_file,
    take_cost,
)
from solvers.robust.consistency import PCM
from solvers.robust.gnc import GNC
from solvers.robust.revision import threshold_scale
from solvers.soc.subgraph import place_poses, split_graph

SOLVE_PARTS = "solve each part in a folder of its own"


class ApartError(GraphError):
    """A graph that is not connected; `parts` are the robots, by number, that edges join."""

    def __init__(self, problem: str, parts: tuple[tuple[int, ...], ...]) -> None:
        """Say what the `problem` is, and which robots are joined."""
        super().__init__(problem)
        self.parts = parts
        self._given = (problem, parts)

    def __reduce__(self) -> tuple[type[ApartError], tuple[str, tuple[tuple[int, ...], ...]]]:
        return type(self), self._given


def open_driver(
    problem: PGOProblem,
    robots: Partition,
    engine: Engine,
    memory: float = DEFAULT_MEMORY,
    thresholds: Array | None = None,
) -> Driver:
    """Driver and robots for a problem.

    A robust solve gives the `thresholds`, (m,), of its edges.
    """
    subgraphs = split_graph(problem, robots, thresholds)
    if memory != 0:
        subgraphs = tuple(subgraph.for_driver() for subgraph in subgraphs)
    summaries = [subgraph.summary for subgraph in subgraphs]

    def start() -> CountedPool:
        make = partial(Agent, backend=problem.backend)
        return CountedPool(engine.open(make, subgraphs), len(subgraphs))

    driver = Driver(summaries, problem.num_poses, start, memory, problem.backend)
    # A list of all edges has of each a relative pose and the two precisions of F.
    numbers_of_edge = problem.d * (problem.d + 1) // 2 + 2
    graph_bytes = BYTES_PER_NUMBER * problem.graph.num_edges * numbers_of_edge
    driver.network.ledger = replace(driver.network.ledger, graph_bytes=graph_bytes)
    return driver


@dataclass(frozen=True, eq=False)
class OpenedFiles:
    """Robots that have read their files, and what their driver knows of the graph."""

    driver: Driver  # the driver of the robots
    borders: Sequence[Border]  # what the robots have told of their edges to others
    folder: Path  # where the files are
    weighting: Weighting  # the cost that is solved: ISOTROPIC or INFORMATION
    has_indefinite: bool  # whether the share of any edge in chi2 can be negative
    num_absent: int  # number of poses of robots without a file, as `PoseGraph.absent`
    num_copies: int  # edges of two files that count once, as they differ by printing alone
    num_apart: int  # poses that robots leave out, as no edge joins them with most of their own
    num_rejected: int = 0  # edges that robots have left out, as they do not agree with others
    # factor on the thresholds of GNC, below 1 where the closures within robots have clearly smaller
    # errors than their files claim
    threshold_scale: float = 1.0

    @property
    def sizes(self) -> IntArray:
        """Numbers of poses with an edge, and of edges, of every robot, (2, num_robots)."""
        return np.array([border.counts for border in self.borders]).T

    def with_edges(self, borders: Sequence[Border], num_rejected: int) -> OpenedFiles:
        """The same robots with other edges; `borders` are their borders with these."""
        old = self.driver
        driver = _placed(
            old.network, borders, old.num_poses, old.memory, self.weighting, self.folder
        )
        return replace(self, driver=driver, borders=borders, num_rejected=num_rejected)

    def with_parts(self, parts: Sequence[ConsistentPart]) -> OpenedFiles:
        """The same robots with the edges that remain in their reports."""
        return self.with_edges(*borders_of(parts))


def open_files(
    files: Sequence[OwnLines],
    engine: Engine,
    memory: float,
    weighting: Weighting,
    trust_folder: bool = False,
    robust: GNC | PCM | None = None,
    leaves_out: bool = False,
) -> OpenedFiles:
    """Have robots read these files, and agree on the cost that `weighting` stands for.

    With `leaves_out` each leaves out what no edge joins with most of its poses, where edges join
    the robots.

    In a robust solve they leave out edges that do not agree pairwise. GNC judges these again later.
    It begins with the edges of `strongest_neighbours` if they connect the graph, and otherwise with
    those of all pairs of robots.

    Raises a FileFormatError for a file that cannot be read or has no pose of its own, and, unless
    the folder is trusted, for files that speak against being of one graph. Raises a GraphError if
    the graph is not connected, or has a matrix that chi2 cannot have. All messages but the start of
    the robots are counted.
    """
    network = CountedPool(engine.open(Agent, files), len(files))
    try:
        claims = network.ask_all(read_file, None, Count.ROUND)
        joined = _joined(network, files, claims, trust_folder)
        components = _components_to_leave_out(*joined[:2]) if leaves_out else None
        num_named = joined[1]
        if components is not None:
            claims = network.ask(leave_out, components, Count.PIGGYBACKED)
            joined = _joined(network, files, claims, trust_folder)
        borders, num_poses, num_absent, num_copies = joined
        num_apart = num_named - num_poses
        has_indefinite = any(border.has_indefinite for border in borders)
        if weighting is Weighting.OWN:
            weighting = _own_weighting(borders)
        folder = files[0].path.parent
        _check_connected(borders, num_poses, folder)
        scale = 1.0  # of the errors
        if isinstance(robust, GNC):
            scale = _error_scale(network, weighting, robust.quantile)

        def opened(borders: Sequence[Border], num_rejected: int = 0) -> OpenedFiles:
            driver = _placed(network, borders, num_poses, memory, weighting, folder)
            return OpenedFiles(
                driver,
                borders,
                folder,
                weighting,
                has_indefinite,
                num_absent,
                num_copies,
                num_apart,
                num_rejected,
                threshold_scale(scale),
            )

        if robust is None:
            return opened(borders)
        agreements = _agreements(network, robust.quantile, scale)
        if isinstance(robust, GNC) and not robust.consistent:
            try:
                return opened(*_agreeing(network, strongest_neighbours(agreements)))
            except GraphError:  # poses of a robot need what is left out
                pass
        return opened(*_agreeing(network, [each.neighbours for each in agreements]))
    except BaseException:  # also Ctrl-C: no robot stays behind
        network.workers.close()
        raise


def _joined(
    network: CountedPool, files: Sequence[OwnLines], claims: Sequence[Claim], trust_folder: bool
) -> tuple[list[Border], int, int, int]:
    """Have robots number the ids of these claims, and join the edges between them.

    Borders, numbers of poses and of absent ones as of `number_ids`, and how many edges stand in two
    files.
    """
    runs, num_poses, num_absent = number_ids(claims, files)
    sent = network.ask(number_poses, runs, Count.PIGGYBACKED)
    received = [(lines, trust_folder) for lines in network.exchange(sent)]
    joined = network.ask(join_neighbours, received, Count.PIGGYBACKED)
    borders = [border for border, _ in joined]
    if not any(border.counts[1] for border in borders):
        folder = files[0].path.parent
        raise GraphError(f"{folder}: nobody has measured an edge; there is nothing to solve")
    return borders, num_poses, num_absent, sum(count for _, count in joined)


def _placed(
    network: CountedPool,
    borders: Sequence[Border],
    num_poses: int,
    memory: float,
    weighting: Weighting,
    folder: Path,
) -> Driver:
    """Driver of robots with these borders.

    Where the cost that is solved is not convex and quadratic for some robot, SOC runs on another.
    """
    _check_connected(borders, num_poses, folder)
    pairs = np.concatenate([border.pairs for border in borders])
    owners = np.concatenate([border.owners for border in borders])
    placements = place_poses(pairs, owners, len(borders), borders[0].middle)
    can_run_soc = network.ask_all(take_cost, weighting, Count.ROUND)
    has_two_costs = not all(can_run_soc)
    places = [(placement, has_two_costs) for placement in placements]
    summaries = network.ask(place_cover, places, Count.PIGGYBACKED)
    return Driver(summaries, num_poses, lambda: network, memory)


def _error_scale(network: CountedPool, weighting: Weighting, quantile: float) -> float:
    """Scale of the errors among the own poses of most robots, where thresholds have to follow.

    It is 1 where the errors are not clearly smaller than claimed, or robots have few closures of
    their own.
    """
    request = (weighting, quantile)
    scales = np.array(network.ask_all(tell_error_scale, request, Count.PIGGYBACKED))
    known = scales[np.isfinite(scales)]
    scale = float(np.median(known)) if len(known) else 1.0
    return scale if threshold_scale(scale) < 1.0 else 1.0


def _agreements(network: CountedPool, quantile: float, scale: float) -> list[AgreeingCounts]:
    """Have every two robots judge the edges between them, with errors of a scale."""
    trajectories_sent = network.ask_all(tell_trajectories, None, Count.PIGGYBACKED)
    requests = [
        (trajectories, quantile, scale) for trajectories in network.exchange(trajectories_sent)
    ]
    return network.ask(judge_closures, requests, Count.PIGGYBACKED)


def strongest_neighbours(agreements: Sequence[AgreeingCounts]) -> list[IntArray]:
    """Neighbours of every robot with whom most edges agree.

    An edge agrees with itself, so that two robots keep some even if all between them are wrong. The
    pairs of robots here are those of a spanning tree with the largest numbers of edges that agree,
    and those with as many as the weakest of the tree.
    """
    num_robots = len(agreements)
    a = np.repeat(np.arange(num_robots), [len(each.neighbours) for each in agreements])
    b = np.concatenate([each.neighbours for each in agreements])
    num = np.concatenate([each.num_agreeing for each in agreements])
    tree = least_tree(a, b, num_robots, -num)
    weakest = num[tree].min(initial=num.max(initial=0))
    return [b[(a == robot) & (num >= weakest)] for robot in range(num_robots)]


def _agreeing(network: CountedPool, neighbours: list[IntArray]) -> tuple[list[Border], int]:
    """Have robots keep the edges to these neighbours that agree; borders, and how many go."""
    return borders_of(network.ask(keep_agreeing, neighbours, Count.ROUND))


def borders_of(parts: Sequence[ConsistentPart]) -> tuple[list[Border], int]:
    """Borders of what is left, and how many edges are not."""
    return [part.border for part in parts], sum(part.num_rejected for part in parts)


def _own_weighting(borders: Sequence[Border]) -> Weighting:
    """The cost that is the own one of all robots' files together, as `weighting.own_weighting`.

    No process has all matrices: every robot has reported of its own.
    """
    is_F = all(border.is_isotropic for border in borders)
    if is_F or any(border.has_indefinite for border in borders):
        return Weighting.ISOTROPIC
    return Weighting.INFORMATION


def number_ids(
    claims: Sequence[Claim], files: Sequence[OwnLines]
) -> tuple[list[OwnedRuns], int, int]:
    """Numbers and owners of the ids that every file names.

    Beside them stand how many different ids there are, and how many of robots without a file.
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
    return owned, int(known_size.sum()), num_absent


def _covers(runs: IntArray, bounds: IntArray) -> BoolArray:
    """Whether runs of ids cover the intervals between bounds, (intervals,)."""
    start = np.searchsorted(bounds, runs[:, 0])
    end = np.searchsorted(bounds, runs[:, 1] + 1)
    num_started = np.bincount(start, minlength=len(bounds))
    num_ended = np.bincount(end, minlength=len(bounds))
    return np.asarray(np.cumsum(num_started - num_ended)[:-1] > 0)


def _check_claims(claims: Sequence[Claim], files: Sequence[OwnLines], owners: IntArray) -> None:
    """Refuse a file of another dimension than the first, and one without a pose of its own."""
    d_of_first = claims[0][0]
    for file, (d, *_) in zip(files, claims, strict=True):
        if d != d_of_first:
            raise FileFormatError(file.path, None, "2D beside 3D; put it into a folder of its own")
        if file.robot not in owners:
            problem = f"no pose in it is of this robot; remove it, or {READ_HERE}"
            raise FileFormatError(file.path, None, problem)


def _check_connected(borders: Sequence[Border], num_poses: int, folder: Path) -> None:
    """Raise an ApartError unless the robots' graphs together are connected.

    `PoseGraph.check_connected` is for a graph that one process has; here none has the edges within
    the robots, which have reported the components of their own graphs.
    Positions have to be connected by edges with tau > 0, rotations by edges with kappa > 0.
    """
    whats = ("graph falls", "positions fall", "rotations fall")
    for kind, what in enumerate(whats):
        count, _ = _components(borders, num_poses, kind)
        if count > 1:
            problem = f"the {what} into {count} parts, no edge between"
            raise ApartError(f"{folder}: {problem}; {SOLVE_PARTS}", _joined_robots(borders))


def _components(borders: Sequence[Border], num_poses: int, kind: int) -> tuple[int, list[IntArray]]:
    """How many components a graph has, by one of three kinds, and those of every robot's border.

    A component of one robot that has a shared pose is a vertex, as the shared poses are; the rest
    are components of their own.
    """
    robot, pose = _shared_poses(borders)
    label = np.concatenate([border.labels[kind] for border in borders])
    parts, part = np.unique(np.stack([robot, label]), axis=1, return_inverse=True)
    num_shared = int(pose.max(initial=-1)) + 1
    tied = edge_counts(pose, num_shared + part.ravel(), num_shared + parts.shape[1])
    count, component = connected_components(tied) if num_shared else (0, pose)
    count += num_poses - sum(border.counts[0] for border in borders)
    count += sum(int(border.alone[kind]) for border in borders)
    return count, [component[pose[robot == each]] for each in range(len(borders))]


def _components_to_leave_out(borders: Sequence[Border], num_poses: int) -> list[IntArray] | None:
    """Components of every robot's border, where edges join all robots and not all of their poses.

    Robots that no edge joins are parts (`ApartError`), each of which solves for itself.
    """
    count, components = _components(borders, num_poses, kind=0)
    return components if count > 1 and len(_joined_robots(borders)) == 1 else None


def _shared_poses(borders: Sequence[Border]) -> tuple[IntArray, IntArray]:
    """Every robot and every pose at its border, (k,) each; robots and poses count from 0."""
    robot = np.repeat(np.arange(len(borders)), [len(border.poses) for border in borders])
    shared = np.concatenate([border.poses for border in borders])
    return robot, np.unique(shared, return_inverse=True)[1]


def _joined_robots(borders: Sequence[Border]) -> tuple[tuple[int, ...], ...]:
    """Parts of robots that edges join, as two that have the same pose at their borders are."""
    robot, pose = _shared_poses(borders)
    num_robots = len(borders)
    num_vertices = num_robots + int(pose.max(initial=-1)) + 1
    num_parts, part = connected_components(edge_counts(robot, num_robots + pose, num_vertices))
    members = [np.flatnonzero(part[:num_robots] == k) for k in range(num_parts)]
    return tuple(tuple(robots.tolist()) for robots in members)
