"""PoseGraph: measurements, their components, parts and edits, and which robot owns which pose."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from pgo_models.errors import GraphError
from pgo_models.geometry.arrays import read_only, whole_array
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.measurements import IntArray as IntArray  # others have it from here
from pgo_models.graphs.measurements import Measurements, isotropic_information
from pgo_models.html_tables import facts_table

Weights = Array | float
WORLD_ID = 2**63 - 1  # of the world pose, which no file names
_COLLINEAR = 1e-9  # spread of positions across a line, over that along it
_ROUNDING = 1e-14  # of coordinates, relative: what the mean of equal ones may differ from them by
_OF_EDGES = ("i", "j", "R_ij", "t_ij", "kappa", "tau", "information")


@dataclass(frozen=True, eq=False)
class PoseGraph(Measurements):
    """n poses and m measured edges; edge e says x_i^-1 x_j = (R_ij, t_ij) with precisions kappa and tau.

    A prior is an edge from the world pose, a pose like any other but that it is the frame of the solution; of a
    position (GPS) it has kappa = 0 and R_ij = I. A landmark is a pose whose rotation nobody asks for, so that an edge
    to it has R_ij = I and kappa = 0; but for the first, whose kappa is positive: R_l stands in that term alone, which
    is so zero at every optimum, R_l = R_i. F over the other unknowns is not changed by it, nor is its minimum.

    Of every edge: `i`, `j`, (m,), its 0-based poses, where repeated edges all count; `R_ij`, (m, d, d), the measured
    rotation, treated as by `Poses`; `t_ij`, (m, d), the measured translation, metres, in the frame of pose i; `kappa`,
    `tau`, (m,), precisions of the rotation (per radian^2) and of the translation (per metre^2), at least one of them
    positive (of edges to landmarks kappa is settled here); optionally `information`, (m, k, k), matrices as read, k = 3
    in the plane (x, y, theta) and 6 in space (x, y, z, then rotation).

    Of every pose, each optional: `ids`, (n,), its name in the file, a unique integer, 0 .. n-1 unless given; `robot`,
    (n,), which robot, 0 .. num_robots - 1, owns it, all 0 unless given; `initial`, the estimate of the file, and
    `truth`, that of a generated scene; `times`, (b,), seconds of the `bodies`, ascending, for trajectories written.

    Of some poses: `fixed`, (f,), those that the file says are fixed (F does not depend on the gauge: the solution is
    moved so that the first of them is where the file has it, and all are kept for writing); `landmarks`, (l,), those
    that are points, where edges can only end; `world`, optional, the world pose, where edges can only begin: no file
    names it, and `initial` and `truth` may leave it out.

    All arrays are read-only copies: `dataclasses.replace` makes a graph with others. A GraphError on wrong shapes,
    entries that are no real or no whole numbers, an edge to itself or to no pose, nan or inf, no rotation, a negative
    precision, two that are zero, or an edge that starts at a landmark or ends at the world.
    """

    @property
    def extras(self) -> str:
        """How many landmarks and priors there are, if any, for texts."""
        found = [(len(self.landmarks), "landmarks"), (int(self.is_prior.sum()), "priors")]
        return "".join(f", {name}={count}" for count, name in found if count)

    def __repr__(self) -> str:
        size = f"poses={len(self.bodies)}, edges={self.num_edges}{self.extras}"
        return f"PoseGraph({self.name!r}, d={self.d}, {size}, robots={self.num_robots})"

    def _repr_html_(self) -> str:
        return facts_table(self.facts())

    def facts(self) -> list[tuple[str, str]]:
        """Labels and texts, as they are shown."""
        return [
            ("graph", f"{self.name}, {self.d}D"),
            ("poses", str(len(self.bodies))),
            ("edges", f"{self.num_edges}{self.extras}"),
            ("robots", str(self.num_robots)),
            ("components", str(len(self.components()))),
            ("kappa", f"{self.kappa.min():.4g} to {self.kappa.max():.4g} per rad^2"),
            ("tau", f"{self.tau.min():.4g} to {self.tau.max():.4g} per m^2"),
            ("estimate", "with the graph" if self.initial is not None else "none"),
            ("truth", "with the graph" if self.truth is not None else "none"),
        ]

    @cached_property
    def adjacency(self) -> csr_array:
        """Number of edges between every two poses, (n, n)."""
        return read_only(edge_counts(self.i, self.j, self.num_poses))

    def components(self, edges: BoolArray | None = None) -> list[IntArray]:
        """Poses of every connected component, largest first; of some of the edges, (m,), or of all."""
        between = self.adjacency if edges is None else edge_counts(self.i[edges], self.j[edges], self.num_poses)
        count, label = connected_components(between, connection="strong")  # which is quick where symmetric
        parts = [np.flatnonzero(label == c) for c in range(count)]
        return sorted(parts, key=lambda part: (-len(part), int(part[0])))

    @property
    def is_connected(self) -> bool:
        """Whether every pose can be reached from every other along edges."""
        return len(self.components()) == 1

    def check_connected(self) -> None:
        """Raise a GraphError that names the components when there is more than one, or poses left undetermined."""
        parts = self.components()
        if len(parts) > 1:
            sizes = ", ".join(str(len(part)) for part in parts[:5])
            more = f" and {len(parts) - 5} more" if len(parts) > 5 else ""
            firsts = ", ".join(self.pose_name(part[0]) for part in parts[:5])
            found = f"{len(parts)} components (sizes {sizes}{more}; with poses {firsts}{more})"
            way_out = "add edges between them, or solve each on its own (PoseGraph.components, PoseGraph.subgraph)"
            raise GraphError(f"pose graph has {found}; {way_out}")
        self._check_determined()

    @property
    def is_world_loose(self) -> bool:
        """Whether all priors are of positions, so that the rotation of the world hangs on all of them together."""
        to_poses = self.is_prior & ~np.isin(self.j, self.landmarks)
        return self.world is not None and not self.kappa[to_poses].any()

    def _check_determined(self) -> None:
        """Raise a GraphError when no edge with a positive precision ties some poses, or the world, to the others."""
        loose = self.is_world_loose
        for name, what in (("tau", "position"), ("kappa", "rotation")):
            said = getattr(self, name) > 0
            parts = [] if said.all() else self.components(said)
            parts = [part for part in parts if name == "tau" or not loose or part[0] != self.world]
            if len(parts) > 1:
                some = f"{len(parts[1])} poses (with {self.pose_name(parts[1][0])}) is not tied to that of the others"
                raise GraphError(f"the {what} of {some}: no edge between has {name} > 0; add one, or leave these out")
        if loose:
            measured = self.t_ij[self.is_prior][np.unique(self.j[self.is_prior], return_index=True)[1]]
            spread = np.linalg.svd(measured - measured.mean(axis=0), compute_uv=False)
            least = max(_COLLINEAR * spread[0], _ROUNDING * np.abs(measured).max(initial=0.0), 1e-300)
            if len(measured) < self.d or not spread[self.d - 2] > least:
                few = f"positions of {len(measured)} poses, in a point or on a line, leave turns of the world open"
                raise GraphError(f"the priors do not fix the gauge: {few}; give more, or a prior with a rotation")

    def subgraph(self, poses: IntArray) -> PoseGraph:
        """Return the graph of some poses, (k,), in ascending order, and of the edges among them."""
        chosen = np.unique(whole_array(poses, "poses"))
        if not len(chosen) or chosen[0] < 0 or chosen[-1] >= self.num_poses:
            raise GraphError(f"poses of a subgraph are some of 0 .. {self.num_poses - 1}, got {chosen}")
        number = np.full(self.num_poses, -1, dtype=np.int64)
        number[chosen] = np.arange(len(chosen))
        edges = (number[self.i] >= 0) & (number[self.j] >= 0)
        robot = None if self.robot is None else np.unique(self.robot[chosen], return_inverse=True)[1]
        return replace(
            self,
            num_poses=len(chosen),
            **(self._rows(edges) | {"i": number[self.i[edges]], "j": number[self.j[edges]]}),
            ids=self.pose_ids[chosen],
            robot=robot,
            initial=None if self.initial is None else self.initial[chosen],
            truth=None if self.truth is None else self.truth[chosen],
            fixed=number[self.fixed][number[self.fixed] >= 0],
            times=None if self.times is None else self.times[np.isin(self.bodies, chosen)],
            world=None if self.world not in chosen else int(number[self.world]),
            landmarks=number[self.landmarks][number[self.landmarks] >= 0],
        )

    def unit_weights(self) -> PoseGraph:
        """Return the graph with kappa = tau = 1, as in the paper (`min overall`), but where they are zero."""
        return self.with_weights((self.kappa > 0).astype(float), (self.tau > 0).astype(float))

    def with_weights(self, kappa: Array, tau: Array) -> PoseGraph:
        """The same measurements with other kappa and tau, (m,); information matrices as read do not go along."""
        return replace(self, kappa=kappa, tau=tau, information=None)

    def with_robots(self, robot: IntArray) -> PoseGraph:
        """Return the same graph with `robot`, (n,), as owners of the poses."""
        return replace(self, robot=robot)

    def without_edges(self, mask: BoolArray) -> PoseGraph:
        """Return the graph without the edges of a mask, (m,); with the last prior goes the world pose."""
        mask = np.asarray(mask, dtype=bool)
        if mask.shape != (self.num_edges,):
            raise GraphError(
                f"the mask has shape {mask.shape}; give one truth value for each of {self.num_edges} edges"
            )
        kept = replace(self, **self._rows(~mask))
        return kept if self.world is None or kept.is_prior.any() else kept.subgraph(self.in_files)

    def with_edges(self, i: IntArray, j: IntArray, measured: Poses, kappa: Weights, tau: Weights) -> PoseGraph:
        """Return the graph with more edges (i, j), (k,), of precisions (k,) or the same; information as they say."""
        if measured.d != self.d or not len(i) == len(j) == measured.num_poses:
            raise GraphError(f"{measured} for {len(i)} edges in {self.d}D; give one measured pose for every edge")
        kappa, tau = (np.array(np.broadcast_to(one, np.shape(i)), dtype=float) for one in (kappa, tau))
        more = i, j, measured.R, measured.t, kappa, tau, isotropic_information(kappa, tau, self.d)
        rows = zip(self._rows(np.ones(self.num_edges, dtype=bool)).items(), more, strict=False)
        extended: dict[str, Any] = {name: np.concatenate([own, new]) for (name, own), new in rows}
        return replace(self, **extended)

    def with_prior(self, poses: IntArray, measured: Poses, kappa: Weights, tau: Weights) -> PoseGraph:
        """Return the graph with poses (k,) measured in the frame of the world, in which the solution is then."""
        poses = self._checked(poses)
        graph = self if self.world is not None else self._with_node(poses[0], WORLD_ID, {"world": self.num_poses})
        return graph.with_edges(np.full(len(poses), graph.world), poses, measured, kappa, tau)

    def with_position_prior(self, poses: IntArray, positions: Array, tau: Weights) -> PoseGraph:
        """Return the graph with positions (k, d) of poses (k,) measured in the frame of the world, as by GPS."""
        return self.with_prior(poses, Poses.of_points(positions), 0.0, tau)

    def with_landmark(self, seen_from: IntArray, positions: Array, tau: Weights, name: int | None = None) -> PoseGraph:
        """The graph, without truth, with a landmark `seen_from` poses, (k,), at `positions` in their frames, (k, d)."""
        seen_from = self._checked(seen_from)
        points, n, first, initial = Poses.of_points(positions), self.num_poses, seen_from[0], self.initial
        if (points.num_poses, points.d) != (len(seen_from), self.d):
            raise GraphError(f"{points.t.shape} positions seen from {len(seen_from)} poses in {self.d}D; give one each")
        name = int(self.pose_ids[self.in_files].max()) + 1 if name is None else name
        if initial is not None:
            there = initial.t[first] + initial.R[first] @ points.t[0]
            initial = Poses(initial.R[[*range(n), first]], np.append(initial.t, there[None], axis=0))
        others = {"landmarks": np.append(self.landmarks, n), "initial": initial, "truth": None}
        return self._with_node(first, name, others).with_edges(seen_from, np.full(len(seen_from), n), points, 0.0, tau)

    def _checked(self, poses: IntArray) -> IntArray:
        """Poses (k,), k > 0, as whole numbers; a GraphError unless the graph has them."""
        poses = whole_array(poses, "poses")
        if not (poses.size and 0 <= poses.min() <= poses.max() < self.num_poses):
            raise GraphError(f"measured poses are {poses}; give one or more, 0 to {self.num_poses - 1}")
        return poses

    def _rows(self, edges: BoolArray) -> dict[str, Any]:
        return {name: getattr(self, name)[edges] for name in _OF_EDGES if getattr(self, name) is not None}

    def _with_node(self, beside: int, name: int, others: dict[str, Any]) -> PoseGraph:
        """Graph with one more pose, of the robot of another, and other fields."""
        robot = None if self.robot is None else np.append(self.robot, self.robot[beside])
        return replace(self, num_poses=self.num_poses + 1, ids=np.append(self.pose_ids, name), robot=robot, **others)


def middle_pose(graph: PoseGraph) -> int:
    """A pose half-way along a long shortest path of a connected graph, found by two breadth-first searches."""
    end = poses_by_distance(graph, 0)[-1]
    order, parent = breadth_first_order(graph.adjacency, end)
    path, before = [int(order[-1])], parent.tolist()
    while path[-1] != end:
        path.append(before[path[-1]])
    return path[len(path) // 2]


def poses_by_distance(graph: PoseGraph, pose: int) -> IntArray:
    """Poses of a connected graph, (n,), by their number of edges to a pose, which is the first."""
    return np.asarray(breadth_first_order(graph.adjacency, pose, return_predecessors=False))


def bridges(graph: PoseGraph, kept: BoolArray, ratio: Array) -> IntArray:
    """Edges of the least ratios, (m,), that connect what the kept ones, (m,), leave apart (Kruskal)."""
    n = graph.num_poses
    count, part = connected_components(edge_counts(graph.i[kept], graph.j[kept], n), directed=False)
    order = np.argsort(ratio, kind="stable")
    ends = np.sort(np.stack([part[graph.i[order]], part[graph.j[order]]]).astype(np.int64), axis=0)
    order, ends = order[ends[0] != ends[1]], ends[:, ends[0] != ends[1]]
    _, first = np.unique(ends[0] * count + ends[1], return_index=True)
    tree = minimum_spanning_tree(csr_array((first + 1.0, ends[:, first]), shape=(count, count)))
    return np.asarray(order[tree.data.astype(np.int64) - 1])


def edge_counts(i: IntArray, j: IntArray, size: int) -> csr_array:
    """Symmetric matrix with the number of edges (i, j) between every two."""
    ends = np.concatenate([i, j]), np.concatenate([j, i])
    return csr_array((np.ones(2 * len(i)), ends), shape=(size, size))
