"""PoseGraph: the measurements as arrays, checked once; its components, and which robot owns which pose."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from pgo_models.errors import GraphError
from pgo_models.geometry.arrays import ReadOnly, read_only, real_array, whole_array, whole_number
from pgo_models.geometry.poses import Poses, rotations_to_rounding
from pgo_models.geometry.rotations import Array
from pgo_models.html_tables import facts_table

IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class PoseGraph(ReadOnly):
    """n poses and m measured edges; edge e says x_i^-1 x_j = (R_ij, t_ij) with precisions kappa and tau.

    Attributes
    ----------
    num_poses : int
    i, j : (m,)
        0-based poses of every edge. Repeated edges all count.
    R_ij : (m, d, d)
        Measured rotations; what is given is treated as by `Poses`.
    t_ij : (m, d)
        Measured translations, metres, in the frame of pose i.
    kappa, tau : (m,)
        Positive precisions of the rotation (per radian^2) and of the translation (per metre^2).
    information : (m, k, k), optional
        Information matrices as read, k = 3 in the plane (x, y, theta) and 6 in space (x, y, z, then rotation).
    ids : (n,), optional
        Names of the poses in the file, unique integers; 0 .. n-1 unless given.
    robot : (n,), optional
        Which robot, 0 .. num_robots - 1, owns the pose; all 0 unless given.
    initial, truth : Poses, optional
        The estimate that came with the file, and the ground truth of a generated scene.
    fixed : (f,)
        Poses that the file says are fixed. F does not depend on the gauge: the solution is moved so that the first of
        them is where the file has it, and all are kept for writing.
    times : (n,), optional
        Seconds of the poses, ascending, for the trajectories that are written.
    name : str

    All arrays are read-only copies: `dataclasses.replace` makes a graph with others.

    Raises
    ------
    GraphError
        On wrong shapes, entries that are no real or no whole numbers, an edge to itself or to no pose, nan or inf, no
        rotation, or a precision that is not positive.

    Examples
    --------
    >>> import numpy as np
    >>> turn = np.eye(2)[None]
    >>> PoseGraph(2, np.array([0]), np.array([1]), turn, np.ones((1, 2)), np.ones(1), np.ones(1), name="pair")
    PoseGraph('pair', d=2, poses=2, edges=1, robots=1)
    """

    num_poses: int
    i: IntArray
    j: IntArray
    R_ij: Array
    t_ij: Array
    kappa: Array
    tau: Array
    information: Array | None = None
    ids: IntArray | None = None
    robot: IntArray | None = None
    initial: Poses | None = None
    truth: Poses | None = None
    fixed: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    times: Array | None = None
    name: str = "graph"

    def __post_init__(self) -> None:
        object.__setattr__(self, "num_poses", whole_number(self.num_poses, "num_poses"))
        for name in ("i", "j", "ids", "robot", "fixed"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, whole_array(value, name))
        for name in ("R_ij", "t_ij", "kappa", "tau", "information", "times"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, real_array(value, name))
        self._check_shapes()
        self._check_values()
        object.__setattr__(
            self, "R_ij", rotations_to_rounding(self.R_ij, lambda edge: f"R_ij of {self.edge_label(edge)}")
        )

    @property
    def d(self) -> int:
        """Dimension of space: 2 or 3."""
        return int(self.R_ij.shape[-1])

    @property
    def num_edges(self) -> int:
        """Number of measurements, m."""
        return len(self.i)

    @property
    def pose_ids(self) -> IntArray:
        """Names of the poses, (n,)."""
        return np.arange(self.num_poses) if self.ids is None else self.ids

    @property
    def robots(self) -> IntArray:
        """Owner of every pose, (n,)."""
        return np.zeros(self.num_poses, dtype=np.int64) if self.robot is None else self.robot

    @property
    def num_robots(self) -> int:
        """Number of robots that own the poses."""
        return 1 if self.robot is None else int(self.robot.max()) + 1

    def __repr__(self) -> str:
        return (
            f"PoseGraph({self.name!r}, d={self.d}, poses={self.num_poses}, edges={self.num_edges}, "
            f"robots={self.num_robots})"
        )

    def _repr_html_(self) -> str:
        facts = [
            ("graph", f"{self.name}, {self.d}D"),
            ("poses", str(self.num_poses)),
            ("edges", str(self.num_edges)),
            ("robots", str(self.num_robots)),
            ("components", str(len(self.components()))),
            ("kappa", f"{self.kappa.min():.4g} to {self.kappa.max():.4g} per rad^2"),
            ("tau", f"{self.tau.min():.4g} to {self.tau.max():.4g} per m^2"),
            ("estimate", "with the graph" if self.initial is not None else "none"),
            ("truth", "with the graph" if self.truth is not None else "none"),
        ]
        return facts_table(facts)

    @cached_property
    def adjacency(self) -> csr_array:
        """Number of edges from pose to pose, (n, n)."""
        edges = np.ones(self.num_edges), (self.i, self.j)
        return read_only(coo_array(edges, shape=(self.num_poses, self.num_poses)).tocsr())

    def components(self) -> list[IntArray]:
        """Poses of every connected component, largest first."""
        count, label = connected_components(self.adjacency, directed=False)
        parts = [np.flatnonzero(label == c) for c in range(count)]
        return sorted(parts, key=lambda part: (-len(part), int(part[0])))

    @property
    def is_connected(self) -> bool:
        """Whether every pose can be reached from every other along edges."""
        return len(self.components()) == 1

    def check_connected(self) -> None:
        """Raise a GraphError that names the components when there is more than one."""
        parts = self.components()
        if len(parts) > 1:
            sizes = ", ".join(str(len(part)) for part in parts[:5])
            more = f" and {len(parts) - 5} more" if len(parts) > 5 else ""
            firsts = ", ".join(str(self.pose_ids[part[0]]) for part in parts[:5])
            raise GraphError(
                f"pose graph has {len(parts)} components (sizes {sizes}{more}; with poses {firsts}{more}); "
                "solve each on its own: PoseGraph.subgraph(PoseGraph.components()[k])"
            )

    def subgraph(self, poses: IntArray) -> PoseGraph:
        """Return the graph of the given poses, in ascending order, and of the edges among them."""
        chosen = np.unique(poses)
        number = np.full(self.num_poses, -1, dtype=np.int64)
        number[chosen] = np.arange(len(chosen))
        edges = (number[self.i] >= 0) & (number[self.j] >= 0)
        robot = None if self.robot is None else np.unique(self.robot[chosen], return_inverse=True)[1]
        return replace(
            self,
            num_poses=len(chosen),
            i=number[self.i[edges]],
            j=number[self.j[edges]],
            R_ij=self.R_ij[edges],
            t_ij=self.t_ij[edges],
            kappa=self.kappa[edges],
            tau=self.tau[edges],
            information=None if self.information is None else self.information[edges],
            ids=self.pose_ids[chosen],
            robot=robot,
            initial=None if self.initial is None else self.initial[chosen],
            truth=None if self.truth is None else self.truth[chosen],
            fixed=number[self.fixed][number[self.fixed] >= 0],
            times=None if self.times is None else self.times[chosen],
        )

    def unit_weights(self) -> PoseGraph:
        """Return the same measurements with kappa = tau = 1, the weights of the paper's equation (`min overall`)."""
        return self.with_weights(np.ones(self.num_edges), np.ones(self.num_edges))

    def with_weights(self, kappa: Array, tau: Array) -> PoseGraph:
        """Return the same measurements with other precisions, (m,); information matrices as read do not go along."""
        return replace(self, kappa=kappa, tau=tau, information=None)

    def with_robots(self, robot: IntArray) -> PoseGraph:
        """Return the same graph with `robot`, (n,), as owners of the poses."""
        return replace(self, robot=robot)

    def edge_label(self, e: int) -> str:
        """Name edge e by its place and the ids of its poses, for messages."""
        return f"edge {e} ({self._id_of(self.i[e])} -> {self._id_of(self.j[e])})"

    def _id_of(self, pose: int) -> int:
        return int(self.ids[pose]) if self.ids is not None and 0 <= pose < len(self.ids) else int(pose)

    def _check_shapes(self) -> None:
        m = len(self.i)
        if m == 0:
            raise GraphError(f"{self.name} has no edges; a pose graph needs at least one measurement")
        if self.R_ij.ndim != 3 or self.R_ij.shape[1:] not in ((2, 2), (3, 3)):
            raise GraphError(f"R_ij has shape {self.R_ij.shape}; give (m, 2, 2) or (m, 3, 3)")
        d = self.R_ij.shape[-1]
        k = 3 if d == 2 else 6
        expected: dict[str, tuple[int, ...]] = {
            "i": (m,),
            "j": (m,),
            "R_ij": (m, d, d),
            "t_ij": (m, d),
            "kappa": (m,),
            "tau": (m,),
            "information": (m, k, k),
            "ids": (self.num_poses,),
            "robot": (self.num_poses,),
            "fixed": (len(self.fixed),),
            "times": (self.num_poses,),
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise GraphError(f"{name} has shape {value.shape}; with {m} edges in {d}D give {shape}")
        for name in ("initial", "truth"):
            poses: Poses | None = getattr(self, name)
            if poses is not None and poses.t.shape != (self.num_poses, d):
                raise GraphError(f"{name} is {poses}; give {self.num_poses} poses in {d}D")

    def _check_values(self) -> None:
        both = np.stack([self.i, self.j])
        outside = ((both < 0) | (both >= self.num_poses)).any(axis=0)
        if outside.any():
            raise GraphError(
                f"{self.edge_label(int(np.argmax(outside)))} names a pose outside 0 .. {self.num_poses - 1}"
            )
        loops = self.i == self.j
        if loops.any():
            raise GraphError(f"{self.edge_label(int(np.argmax(loops)))} leads from a pose to itself; remove it")
        if ((self.fixed < 0) | (self.fixed >= self.num_poses)).any():
            raise GraphError(f"fixed names a pose outside 0 .. {self.num_poses - 1}")
        if self.times is not None and not (np.isfinite(self.times).all() and (np.diff(self.times) > 0).all()):
            raise GraphError("times do not ascend; give one for every pose, in the order of their ids")
        for name in ("R_ij", "t_ij", "kappa", "tau", "information"):
            value = getattr(self, name)
            if value is not None and not np.isfinite(value).all():
                finite = np.isfinite(value.reshape(self.num_edges, -1)).all(axis=1)
                raise GraphError(f"{name} of {self.edge_label(int(np.argmin(finite)))} has nan or inf; remove the edge")
        for name in ("kappa", "tau"):
            value = getattr(self, name)
            if not (value > 0).all():
                e = int(np.argmin(value > 0))
                raise GraphError(f"{name} of {self.edge_label(e)} is {value[e]:.6g}; a precision must be positive")
        if self.ids is not None and len(np.unique(self.ids)) != self.num_poses:
            raise GraphError("ids are not unique; every pose needs a name of its own")
        if self.robot is not None and not has_no_gap(self.robot):
            raise GraphError("robot must number the robots 0, 1, .. without a gap; see numpy.unique")


def has_no_gap(robot: IntArray) -> bool:
    """Whether the robots are numbered 0, 1, .. and every one owns a pose."""
    return len(robot) > 0 and robot.min() == 0 and len(np.unique(robot)) == robot.max() + 1


def middle_pose(graph: PoseGraph) -> int:
    """A pose half-way along a long shortest path of a connected graph, found by two breadth-first searches."""
    end = poses_by_distance(graph, 0)[-1]
    order, parent = breadth_first_order(graph.adjacency, end, directed=False)
    path = [int(order[-1])]
    while path[-1] != end:
        path.append(int(parent[path[-1]]))
    return path[len(path) // 2]


def poses_by_distance(graph: PoseGraph, pose: int) -> IntArray:
    """Poses of a connected graph, (n,), by their number of edges to a pose, which is the first."""
    return np.asarray(breadth_first_order(graph.adjacency, pose, directed=False, return_predecessors=False))


def edge_counts(i: IntArray, j: IntArray, size: int) -> csr_array:
    """Symmetric matrix with the number of edges (i, j) between every two."""
    ends = np.concatenate([i, j]), np.concatenate([j, i])
    return csr_array(coo_array((np.ones(2 * len(i)), ends), shape=(size, size)))
