"""Measurements: the arrays of a pose graph, checked once, and which poses are the world's and landmarks'."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pgo_models.errors import GraphError
from pgo_models.geometry.arrays import ReadOnly, read_only, real_array, whole_array, whole_number
from pgo_models.geometry.poses import Poses, rotations_to_rounding
from pgo_models.geometry.rotations import Array, BoolArray

IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Measurements(ReadOnly):
    """What a `PoseGraph` is made of; its attributes and errors are told there."""

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
    world: int | None = None
    landmarks: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __post_init__(self) -> None:
        checks: dict[str, Callable[..., object]] = dict.fromkeys(("num_poses", "world"), whole_number)
        checks |= dict.fromkeys(("i", "j", "ids", "robot", "fixed", "landmarks"), whole_array)
        checks |= dict.fromkeys(("R_ij", "t_ij", "kappa", "tau", "information", "times"), real_array)
        for name, checked in checks.items():
            if getattr(self, name) is not None:
                object.__setattr__(self, name, checked(getattr(self, name), name))
        self._check_shapes()
        self._check_values()
        object.__setattr__(self, "R_ij", rotations_to_rounding(self.R_ij, lambda e: f"R_ij of {self.edge_label(e)}"))
        for name, settled in self._settled_landmarks().items():
            object.__setattr__(self, name, settled)
        for name in ("initial", "truth"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, self.completed(getattr(self, name)))

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

    @cached_property
    def bodies(self) -> IntArray:
        """Poses that are neither the world's nor a landmark's, (b,)."""
        is_body = np.arange(self.num_poses) != self.world
        is_body[self.landmarks] = False
        return read_only(np.flatnonzero(is_body))

    @property
    def in_files(self) -> IntArray:
        """All poses but that of the world."""
        return np.flatnonzero(np.arange(self.num_poses) != self.world)

    @property
    def is_prior(self) -> BoolArray:
        """Whether an edge begins at the world pose, (m,)."""
        return np.asarray(self.i == self.world)

    def completed(self, poses: Poses) -> Poses:
        """Poses with the world's, if it is left out, and with landmarks turned like the poses that saw them first."""
        R, t, first = poses.R, poses.t, self.first_sights
        if self.world is None and not len(first):
            return poses
        if self.world is not None and len(t) == self.num_poses - 1:
            R, t = np.insert(R, self.world, np.eye(poses.d), axis=0), np.insert(t, self.world, 0.0, axis=0)
        if len(first) and len(t) == self.num_poses:
            R = R.copy()
            R[self.j[first]] = R[self.i[first]]
        return Poses(R, t)

    def pose_name(self, pose: int) -> str:
        """Id of a pose, or that it is the world."""
        if pose == self.world:
            return "the world"
        return str(self.ids[pose] if self.ids is not None and 0 <= pose < len(self.ids) else pose)

    def edge_label(self, e: int) -> str:
        """Name edge e by its place and the ids of its poses, for messages."""
        return f"edge {e} ({self.pose_name(self.i[e])} -> {self.pose_name(self.j[e])})"

    @cached_property
    def first_sights(self) -> IntArray:
        """The first edge to every landmark that has one, from a pose if there is such an edge, not from the world."""
        ends = np.flatnonzero(np.isin(self.j, self.landmarks))
        ends = ends[np.argsort(self.is_prior[ends], kind="stable")]
        return read_only(ends[np.unique(self.j[ends], return_index=True)[1]])

    def _settled_landmarks(self) -> dict[str, Array]:
        """The fields kappa and information of a graph with what it says of edges to landmarks."""
        to_points, first, d = np.isin(self.j, self.landmarks), self.first_sights, self.d
        if not len(first):
            return {}
        kappa = np.where(to_points, 0.0, self.kappa)
        usual = np.median(kappa[kappa > 0]) if kappa.any() else 1.0
        kappa[first] = np.where(self.kappa[first] > 0, self.kappa[first], usual)
        if self.information is None:
            return {"kappa": read_only(kappa)}
        information = self.information.copy()
        information[to_points, d:], information[to_points, :, d:] = 0.0, 0.0
        information[first, d:, d:] = isotropic_information(kappa, kappa, d)[first, d:, d:]
        return {"kappa": read_only(kappa), "information": read_only(information)}

    def _check_shapes(self) -> None:
        m = len(self.i)
        if m == 0:
            raise GraphError(f"{self.name} has no edges; a pose graph needs at least one measurement")
        if len(self.landmarks) and not (self.landmarks.min() >= 0 and self.landmarks.max() < self.num_poses):
            raise GraphError(f"landmarks are poses {self.landmarks}, not all of them of 0 .. {self.num_poses - 1}")
        if self.R_ij.ndim != 3 or self.R_ij.shape[1:] not in ((2, 2), (3, 3)):
            raise GraphError(f"R_ij has shape {self.R_ij.shape}; give (m, 2, 2) or (m, 3, 3)")
        d, k, of_poses = self.d, 3 * self.d - 3, (self.num_poses,)
        of_edges = dict(i=(m,), j=(m,), R_ij=(m, d, d), t_ij=(m, d), kappa=(m,), tau=(m,), information=(m, k, k))
        others = dict(ids=of_poses, robot=of_poses, fixed=(len(self.fixed),), times=(len(self.bodies),))
        for name, shape in {**of_edges, **others}.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise GraphError(f"{name} has shape {value.shape}; with {m} edges in {d}D give {shape}")
        for name in ("initial", "truth"):
            poses: Poses | None = getattr(self, name)
            if poses is not None and poses.t.shape not in ((self.num_poses, d), (len(self.in_files), d)):
                raise GraphError(f"{name} is {poses}; give {self.num_poses} poses in {d}D")

    def _check_values(self) -> None:
        both = np.stack([self.i, self.j])
        outside = ((both < 0) | (both >= self.num_poses)).any(axis=0)
        if outside.any():
            edge = self.edge_label(int(np.argmax(outside)))
            raise GraphError(f"{edge} names a pose outside 0 .. {self.num_poses - 1}")
        loops = self.i == self.j
        if loops.any():
            raise GraphError(f"{self.edge_label(int(np.argmax(loops)))} leads from a pose to itself; remove it")
        if ((self.fixed < 0) | (self.fixed >= self.num_poses)).any():
            raise GraphError(f"fixed names a pose outside 0 .. {self.num_poses - 1}")
        if self.times is not None and not (np.isfinite(self.times).all() and (np.diff(self.times) > 0).all()):
            raise GraphError("times do not ascend; give one for every pose, in the order of their ids")
        if len(self.bodies) + len(self.landmarks) + (self.world is not None) != self.num_poses:
            raise GraphError(f"world and landmarks are not different poses, 0 to {self.num_poses - 1}; name each once")
        turned = np.isin(self.j, self.landmarks) & (self.R_ij != np.eye(self.d)).any(axis=(1, 2))
        wrong = turned | np.isin(self.i, self.landmarks) | (self.j == self.world)
        if wrong.any():
            edge = self.edge_label(int(np.argmax(wrong)))
            raise GraphError(f"{edge} begins at a landmark, has R_ij of one, or ends at the world; turn it, R_ij = I")
        for name in ("R_ij", "t_ij", "kappa", "tau", "information"):
            value = getattr(self, name)
            if value is not None and not np.isfinite(value).all():
                finite = np.isfinite(value.reshape(self.num_edges, -1)).all(axis=1)
                raise GraphError(f"{name} of {self.edge_label(int(np.argmin(finite)))} has nan or inf; remove the edge")
        for name in ("kappa", "tau"):
            value = getattr(self, name)
            if not (value >= 0).all():
                e = int(np.argmin(value >= 0))
                raise GraphError(f"{name} of {self.edge_label(e)} is {value[e]:.6g}; a precision must not be negative")
        if (empty := (self.kappa == 0) & (self.tau == 0)).any():
            raise GraphError(f"kappa and tau of {self.edge_label(int(np.argmax(empty)))} are 0; remove it")
        if self.ids is not None and not np.diff(np.sort(self.ids)).all():
            raise GraphError("ids are not unique; every pose needs a name of its own")
        if self.robot is not None and not has_no_gap(self.robot):
            raise GraphError("robot must number the robots 0, 1, .. without a gap; see numpy.unique")


def isotropic_information(kappa: Array, tau: Array, d: int) -> Array:
    """Diagonal information matrices, (m, 3, 3) or (m, 6, 6), whose `edge_precisions` are kappa and tau."""
    diagonal = [tau, tau, kappa] if d == 2 else [tau, tau, tau, 2 * kappa, 2 * kappa, 2 * kappa]
    return np.asarray(np.stack(diagonal, axis=1)[:, :, None] * np.eye(len(diagonal)))


def has_no_gap(robot: IntArray) -> bool:
    """Whether the robots are numbered 0, 1, .. and every one owns a pose."""
    return len(robot) > 0 and robot.min() == 0 and robot.max() < len(robot) and bool(np.bincount(robot).all())
