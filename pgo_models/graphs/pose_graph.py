"""PoseGraph: measured edges between poses, checked once, and the parts and edits of such a graph.

The measurements and their precisions kappa and tau are those of the cost F (Ebrahimi & Deghat,
equation (16); Rosen et al. 2019, equation 11).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from pgo_models.errors import GraphError, check_settings, door
from pgo_models.geometry.arrays import ReadOnly, read_only, real_array, whole_array, whole_number
from pgo_models.geometry.poses import Poses, rotations_to_rounding
from pgo_models.geometry.rotations import Array, BoolArray, MaybeNone
from pgo_models.graphs.origin import far_middle, is_exact_difference
from pgo_models.html_tables import facts_table

# Numbers of poses and edges; those that come from sparse matrices have 32 bits.
IntArray = NDArray[np.integer[Any]]
Weights = Array | float

WORLD_ID = 2**63 - 1  # id of the world pose, which no file names

# Positions are collinear when their spread across a line is below this share of that along it.
_COLLINEAR = 1e-9
# Relative rounding of coordinates: the mean of equal numbers differs from them by at most this.
_ROUNDING = 1e-14
_NAMED_COMPONENTS = 5  # components that an error names

_WHOLE_NUMBERS = ("num_poses", "world")
_WHOLE_ARRAYS = ("i", "j", "ids", "robot", "fixed", "landmarks", "absent")
_REAL_ARRAYS = (
    "R_ij",
    "t_ij",
    "kappa",
    "tau",
    "information",
    "unheld",
    "times",
    "written_error",
    "origin",
)
_OPTIONAL = ("world", "ids", "robot", "information", "unheld", "times", "written_error", "origin")
_EDGE_FIELDS = (
    "i",
    "j",
    "R_ij",
    "t_ij",
    "kappa",
    "tau",
    "information",
    "unheld",
    "uncoupled",
    "written_error",
)


def _no_poses() -> IntArray:
    return np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class PoseGraph(ReadOnly):
    """Graph of n poses and m edges, each a measurement of x_i^-1 x_j.

    Edge e measures x_i^-1 x_j = (R_ij, t_ij) with the precisions kappa and tau.

    A prior is an edge that begins at the world pose. The world pose is an unknown like any other
    pose; after the solve all poses are given in its frame. A prior of a position (GPS) has
    kappa = 0 and R_ij = I.

    A landmark is a pose whose rotation has no meaning, so that an edge to it has R_ij = I and
    kappa = 0. The first edge to a landmark is the exception: its kappa is positive. The rotation
    R_l of the landmark stands in that term alone, which is therefore zero at every optimum, with
    R_l = R_i. Minimised over R_l, F is the same function of the other unknowns.

    All arrays are kept as read-only copies. `dataclasses.replace` makes a graph with other arrays.

    Parameters
    ----------
    num_poses : int
        Number of poses n, with landmarks and the world pose.
    i, j : IntArray, (m,)
        First and second pose of every edge, 0-based. Repeated edges all count. No edge ends at the
        world pose, and no edge begins at a landmark.
    R_ij : Array, (m, d, d)
        Measured rotations, d = 2 or 3. As for `Poses`, a matrix within 64 eps of a rotation is
        kept, and any other is projected; costs and bounds are those of the stored R_ij.
    t_ij : Array, (m, d)
        Measured translations in the frame of pose i, metres.
    kappa : Array, (m,)
        Precisions of the rotations, per radian^2, at least 0. Of the edges to a landmark the first
        keeps its kappa, or has the median of the others if that is 0; kappa of the rest becomes 0.
    tau : Array, (m,)
        Precisions of the translations, per metre^2, at least 0. After that, kappa and tau of one
        edge are not both 0.
    information : Array, (m, k, k), optional
        Information matrices as read: k = 3 in the plane (x, y, theta), k = 6 in space (x, y, z,
        then rotation).
    ids : IntArray, (n,), optional
        Name of every pose in the file, unique; 0 .. n-1 unless given. The world pose, which no
        file names, has 2^63 - 1 (`WORLD_ID`) as its place in the row: `pose_ids[in_files]` are the
        names that a file or GTSAM gave.
    robot : IntArray, (n,), optional
        Robot 0 .. num_robots - 1 that owns every pose; all 0 unless given.
    initial : Poses, optional
        Estimate of the file, of all poses but the world pose, which may be given, too.
    truth : Poses, optional
        Ground truth, for example of a generated scene; of the same poses as the estimate.
    fixed : IntArray, (f,)
        Poses that the file calls fixed. F does not depend on the gauge: the solution is moved so
        that the first of them is where the file has it. All of them are kept for writing.
    times : Array, (b,), optional
        Time stamps of the `bodies`, seconds, ascending, for trajectories that are written.
    name : str
        Name of the graph, for texts.
    world : int, optional
        The world pose, if the graph has priors. No file names it.
    landmarks : IntArray, (l,)
        Poses that are points.
    uncoupled : BoolArray, (m,), optional
        Which information matrices have lost their coupling block because they were indefinite with
        it, see `pgo_models.without_indefinite_coupling`.
    absent : IntArray, (a,)
        Poses of robots without a file in the folder that was read: edges of others name them. What
        is found holds for these edges, and not for the graph of all robots.
    written_error : Array, (m, 2), optional
        What ||t_ij|| and ||R_ij||_F may be off by because a file writes measurements with so many
        digits: half a unit of the last one (`pgo_models.graphs.written_digits`). 0 where nothing is
        known of that, as of measurements that no file has.
    weights_error : float
        How far the weights can be from those of a file, whose covariances were inverted: those of
        the file are between 1 - weights_error and 1 + weights_error times these. Certificates count
        it. 0 where the file has the weights itself, and of weights that are given.

    origin : Array, (d,), optional
        Where the world pose stands in the frame of the file: a point near priors that are far from
        zero, as in UTM coordinates, else zero. The t_ij of priors are measured from it, and poses
        in the frame of the file have the world pose there. Unless given it is found, and the t_ij
        given are seen from it if that takes no rounding.
    free : str
        Which directions of the map no edge measures, and how they are held: a sentence, "" for none
        (`pgo_models.graphs.free_directions`).
    unheld : Array, (m, k, k), optional
        Information matrices before that: what the edges measure.

    Raises
    ------
    GraphError
        For a wrong shape, an entry that is no real or no whole number, an edge to itself or to no
        pose, nan or inf, a matrix that is no rotation, a negative precision, two precisions that
        are zero, or an edge that begins at a landmark or ends at the world.

    Examples
    --------
    Two poses one metre apart, and the second one metre from a third:

    >>> R_ij = np.array([np.eye(2), np.eye(2)])
    >>> t_ij = np.array([[1.0, 0.0], [1.0, 0.0]])
    >>> ones = np.ones(2)
    >>> PoseGraph(3, np.array([0, 1]), np.array([1, 2]), R_ij, t_ij, kappa=ones, tau=ones)
    PoseGraph('graph', d=2, poses=3, edges=2, robots=1)
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
    initial: Poses | MaybeNone = None
    truth: Poses | MaybeNone = None
    fixed: IntArray = field(default_factory=_no_poses)
    times: Array | None = None
    name: str = "graph"
    world: int | None = None
    landmarks: IntArray = field(default_factory=_no_poses)
    uncoupled: BoolArray | None = None
    absent: IntArray = field(default_factory=_no_poses)
    written_error: Array | None = None
    weights_error: float = 0.0
    origin: Array | None = None
    free: str = ""
    unheld: Array | None = None

    _way_out = "pgo_models.load(..) reads a graph, and `.graph` of a problem is one"

    def __post_init__(self) -> None:
        check_settings(self, of_any_type=_WHOLE_NUMBERS + _WHOLE_ARRAYS + _REAL_ARRAYS)
        self._convert(_WHOLE_NUMBERS, whole_number)
        self._convert(_WHOLE_ARRAYS, whole_array)
        self._convert(_REAL_ARRAYS, real_array)
        if self.information is None:
            self._set("uncoupled", None)
        elif self.uncoupled is not None:
            uncoupled = np.array(self.uncoupled, dtype=bool)
            self._set("uncoupled", read_only(uncoupled))
        self._check_shapes()
        self._check_ends()
        self._check_poses()
        self._check_landmark_edges()
        self._check_precisions()
        self._check_names()
        R_ij, _ = rotations_to_rounding(self.R_ij, lambda e: f"R_ij of {self.edge_label(e)}")
        self._set("R_ij", R_ij)
        self._check_not_empty()
        self._settle_landmarks()
        self._check_not_empty()
        self._settle_origin()
        for name in ("initial", "truth"):
            poses = getattr(self, name)
            if poses is not None:
                self._set(name, self._as_in_files(poses))

    def _set(self, name: str, value: object) -> None:
        """Set a field while the frozen object is being made."""
        object.__setattr__(self, name, value)

    def _convert(self, names: tuple[str, ...], checked: Callable[..., object]) -> None:
        """Replace the given fields by what `checked(value, name)` returns for them."""
        for name in names:
            value = getattr(self, name)
            if value is not None or name not in _OPTIONAL:
                self._set(name, checked(value, name))

    # Sizes and names

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
        """Names of the poses, (n,); `WORLD_ID`, which is no name, in place of the world pose's."""
        if self.ids is not None:
            return self.ids
        return np.arange(self.num_poses)

    @property
    def robots(self) -> IntArray:
        """Owner of every pose, (n,)."""
        if self.robot is not None:
            return self.robot
        return np.zeros(self.num_poses, dtype=np.int64)

    @property
    def num_robots(self) -> int:
        """Number of robots that own the poses."""
        if self.robot is None:
            return 1
        return int(self.robot.max()) + 1

    def pose_name(self, pose: int) -> str:
        """Return the id of a pose, for messages.

        The world pose is "the world". A number that the graph does not have is its own name.
        """
        if pose == self.world:
            return "the world"
        if self.ids is not None and 0 <= pose < len(self.ids):
            return str(self.ids[pose])
        return str(pose)

    def edge_label(self, e: int) -> str:
        """Return the number of an edge and the ids of its poses, such as "edge 3 (17 -> 18)"."""
        name_i = self.pose_name(self.i[e])
        name_j = self.pose_name(self.j[e])
        return f"edge {e} ({name_i} -> {name_j})"

    @property
    def extras(self) -> str:
        """Text with the number of landmarks, priors and absent robots' poses, "" for none."""
        text = ""
        if len(self.landmarks):
            text += f", landmarks={len(self.landmarks)}"
        num_priors = int(self.is_prior.sum())
        if num_priors:
            text += f", priors={num_priors}"
        if len(self.absent):
            text += f", poses of absent robots={len(self.absent)}"
        return text

    def __repr__(self) -> str:
        size = f"poses={len(self.bodies)}, edges={self.num_edges}{self.extras}"
        return f"PoseGraph({self.name!r}, d={self.d}, {size}, robots={self.num_robots})"

    def _repr_html_(self) -> str:
        return facts_table(self.facts())

    def facts(self) -> list[tuple[str, str]]:
        """Return what the graph consists of, as labels and texts."""
        tau = "no edge measures a translation"
        if self.has_translations:
            tau = f"{self.tau.min():.4g} to {self.tau.max():.4g} per m^2"
        return [
            ("graph", f"{self.name}, {self.d}D"),
            ("poses", str(len(self.bodies))),
            ("edges", f"{self.num_edges}{self.extras}"),
            ("robots", str(self.num_robots)),
            ("components", str(len(self.components()))),
            ("kappa", f"{self.kappa.min():.4g} to {self.kappa.max():.4g} per rad^2"),
            ("tau", tau),
            ("estimate", "with the graph" if self.initial is not None else "none"),
            ("truth", "with the graph" if self.truth is not None else "none"),
        ]

    # Landmarks and the world pose

    @cached_property
    def bodies(self) -> IntArray:
        """Poses that are neither the world pose nor landmarks, (b,)."""
        is_body = np.arange(self.num_poses) != self.world
        is_body[self.landmarks] = False
        bodies = np.flatnonzero(is_body)
        return read_only(bodies)

    @property
    def in_files(self) -> IntArray:
        """All poses but the world pose, which files do not name."""
        is_in_files = np.arange(self.num_poses) != self.world
        return np.flatnonzero(is_in_files)

    @property
    def is_prior(self) -> BoolArray:
        """Whether an edge begins at the world pose, (m,)."""
        return np.asarray(self.i == self.world)

    @property
    def is_world_loose(self) -> bool:
        """Whether every prior measures a position alone.

        Then no single prior fixes the rotation of the world frame, only all of them together.
        """
        if self.world is None:
            return False
        to_landmarks = np.isin(self.j, self.landmarks)
        kappa_of_priors = self.kappa[self.is_prior & ~to_landmarks]
        return not kappa_of_priors.any()

    @cached_property
    def first_sights(self) -> IntArray:
        """The first edge to every landmark that has one, from a pose rather than from the world."""
        to_landmarks = np.flatnonzero(np.isin(self.j, self.landmarks))
        priors_last = np.argsort(self.is_prior[to_landmarks], kind="stable")
        candidates = to_landmarks[priors_last]
        seen = self.j[candidates]
        _, first = np.unique(seen, return_index=True)
        return read_only(candidates[first])

    def completed(self, poses: Poses) -> Poses:
        """Return all n poses: those given, the world pose, and landmarks with rotations.

        The world pose is at the `origin` where it was left out. A landmark has the rotation of the
        pose that saw it first.
        """
        poses = self.with_world_of(poses)
        first = self.first_sights
        if not len(first) or poses.num_poses != self.num_poses:
            return poses
        R = poses.R.copy()
        R[self.j[first]] = R[self.i[first]]
        return Poses(R, poses.t)

    def with_world_of(self, poses: Poses) -> Poses:
        """Return poses with the world pose, which stands at the `origin` where it was left out."""
        if self.world is None or poses.num_poses != self.num_poses - 1:
            return poses
        R = np.insert(poses.R, self.world, np.eye(poses.d), axis=0)
        return Poses(R, np.insert(poses.t, self.world, self.world_point, axis=0))

    def _as_in_files(self, poses: Poses) -> Poses:
        """Estimate or truth, without the world pose, in whose frame they are."""
        if self.world is None:
            return self.completed(poses)
        if poses.num_poses == self.num_poses:
            poses = self.in_frame_of_priors(poses)
        return self.completed(poses)[self.in_files]

    @property
    def world_point(self) -> Array:
        """Where the world pose stands in the frame of the file, (d,): the `origin`."""
        assert self.origin is not None
        return self.origin

    @property
    def has_far_priors(self) -> bool:
        """Whether priors are seen from a point among them that is far from zero."""
        return self.world is not None and bool(self.world_point.any())

    def near_zero(self, poses: Poses) -> Poses:
        """Return poses with the world pose, which is at the identity if priors are far away.

        Poses in the frame of the file lose nothing.
        """
        poses = self.with_world_of(poses)
        if not self.has_far_priors:
            return poses
        world = self.world
        assert world is not None
        moved = poses.with_gauge_at(world)
        R = moved.R.copy()
        R[world] = np.eye(self.d)
        return Poses(R, moved.t)

    def in_frame_of_priors(self, poses: Poses) -> Poses:
        """Return poses of a graph with priors in the frame of its file.

        The world pose is unturned at the `origin`. Far from zero each coordinate is rounded.
        """
        assert self.world is not None
        poses = self.with_world_of(poses)
        if not self.has_far_priors:
            return poses.with_gauge_at(self.world)
        near = self.near_zero(poses)
        return near.with_translations(near.t + self.world_point)

    def _settle_origin(self) -> None:
        """Find the origin of far priors, and measure them from there, unless it is given."""
        if self.origin is not None:
            return
        origin = np.zeros(self.d)
        if self.world is not None:
            is_prior = self.is_prior
            origin = far_middle(self.t_ij[is_prior & (self.tau > 0)], self.t_ij[~is_prior])
            is_exact = is_exact_difference(self.t_ij[is_prior], origin).all(axis=0)
            origin = np.where(is_exact, origin, 0.0)
            if origin.any():
                t_ij = self.t_ij.copy()
                t_ij[is_prior] -= origin
                self._set("t_ij", read_only(t_ij))
                self._move_world_of_poses(self.world, origin)
        self._set("origin", read_only(origin))

    def _move_world_of_poses(self, world: int, origin: Array) -> None:
        """Let the world pose of estimate and truth, where they have one, stand at the origin."""
        for name in ("initial", "truth"):
            poses: Poses | None = getattr(self, name)
            if poses is not None and poses.num_poses == self.num_poses:
                t = poses.t.copy()
                t[world] += poses.R[world] @ origin
                self._set(name, poses.with_translations(t))

    def _settle_landmarks(self) -> None:
        """Set kappa and information of the edges to landmarks, see the docstring of the class."""
        first = self.first_sights
        if not len(first):
            return
        to_landmarks = np.isin(self.j, self.landmarks)
        kappa = np.where(to_landmarks, 0.0, self.kappa)
        usual = np.median(kappa[kappa > 0]) if kappa.any() else 1.0
        kappa_of_first = self.kappa[first]
        kappa[first] = np.where(kappa_of_first > 0, kappa_of_first, usual)
        self._set("kappa", read_only(kappa))
        if self.information is None:
            return
        d = self.d
        isotropic = isotropic_information(kappa, kappa, d)
        information = self.information.copy()
        information[to_landmarks, d:] = 0.0
        information[to_landmarks, :, d:] = 0.0
        information[first, d:, d:] = isotropic[first, d:, d:]
        self._set("information", read_only(information))

    # Checks when a graph is made, in the order in which they are called

    def _check_shapes(self) -> None:
        if self.num_edges == 0:
            raise GraphError(
                f"{self.name} has no edges; a pose graph needs at least one measurement"
            )
        for name in ("landmarks", "absent"):
            poses_of_kind = getattr(self, name)
            if not self._has_poses(poses_of_kind):
                raise GraphError(
                    f"{name} are poses {poses_of_kind}, "
                    f"not all of them of 0 .. {self.num_poses - 1}"
                )
        matrix_shape = self.R_ij.shape[1:]
        if self.R_ij.ndim != 3 or matrix_shape not in ((2, 2), (3, 3)):
            raise GraphError(f"R_ij has shape {self.R_ij.shape}; give (m, 2, 2) or (m, 3, 3)")
        for name, shape in self._expected_shapes().items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise GraphError(
                    f"{name} has shape {value.shape}; "
                    f"with {self.num_edges} edges in {self.d}D give {shape}"
                )
        for name in ("initial", "truth"):
            poses: Poses | None = getattr(self, name)
            if poses is not None and not self._fits(poses):
                raise GraphError(f"{name} is {poses}; give {self.num_poses} poses in {self.d}D")

    def _has_poses(self, poses: IntArray) -> bool:
        is_pose = (poses >= 0) & (poses < self.num_poses)
        return bool(is_pose.all())

    def _expected_shapes(self) -> dict[str, tuple[int, ...]]:
        n = self.num_poses
        m = self.num_edges
        d = self.d
        k = 3 * d - 3
        return {
            "i": (m,),
            "j": (m,),
            "R_ij": (m, d, d),
            "t_ij": (m, d),
            "kappa": (m,),
            "tau": (m,),
            "information": (m, k, k),
            "unheld": (m, k, k),
            "uncoupled": (m,),
            "written_error": (m, 2),
            "ids": (n,),
            "robot": (n,),
            "fixed": (len(self.fixed),),
            "times": (len(self.bodies),),
            "origin": (d,),
        }

    def _fits(self, poses: Poses) -> bool:
        """Whether poses are as many as those of the graph, with or without the world pose."""
        possible_sizes = (self.num_poses, len(self.in_files))
        return poses.d == self.d and poses.num_poses in possible_sizes

    def _refuse_edges(self, wrong: BoolArray, problem: str) -> None:
        """Raise a GraphError for the first edge of a mask, (m,); `{edge}` stands for its label."""
        if wrong.any():
            label = self.edge_label(int(np.argmax(wrong)))
            raise GraphError(problem.format(edge=label))

    def _check_ends(self) -> None:
        ends = np.stack([self.i, self.j])
        is_end_outside = (ends < 0) | (ends >= self.num_poses)
        is_outside = np.asarray(is_end_outside.any(axis=0))
        self._refuse_edges(is_outside, f"{{edge}} names a pose outside 0 .. {self.num_poses - 1}")
        is_loop = self.i == self.j
        self._refuse_edges(is_loop, "{edge} leads from a pose to itself; remove it")

    def _check_poses(self) -> None:
        """Check the fields that number poses, and the times."""
        if not self._has_poses(self.fixed):
            raise GraphError(f"fixed names a pose outside 0 .. {self.num_poses - 1}")
        if self.times is not None and not is_ascending(self.times):
            raise GraphError(
                "times do not ascend; give one for every pose, in the order of their ids"
            )
        num_worlds = 0 if self.world is None else 1
        # Landmarks that are named twice, or a world pose among them, make this sum too large.
        sum_of_kinds = len(self.bodies) + len(self.landmarks) + num_worlds
        if sum_of_kinds != self.num_poses:
            raise GraphError(
                "world and landmarks are not different poses, "
                f"0 to {self.num_poses - 1}; name each once"
            )

    def _check_landmark_edges(self) -> None:
        """Check that no edge ends at the world, begins at a landmark or turns one."""
        is_turned = (self.R_ij != np.eye(self.d)).any(axis=(1, 2))
        to_landmark = np.isin(self.j, self.landmarks)
        from_landmark = np.isin(self.i, self.landmarks)
        to_world = self.j == self.world
        self._refuse_edges(
            (to_landmark & is_turned) | from_landmark | to_world,
            "{edge} begins at a landmark, has R_ij of one, or ends at the world; turn it, R_ij = I",
        )

    def _check_precisions(self) -> None:
        """Check that the numbers of all edges are finite, and their precisions not negative."""
        for name in ("R_ij", "t_ij", "kappa", "tau", "information", "written_error"):
            values = getattr(self, name)
            if values is not None:
                numbers_of_edges = values.reshape(self.num_edges, -1)
                is_finite = np.isfinite(numbers_of_edges).all(axis=1)
                problem = f"{name} of {{edge}} has nan or inf; remove the edge"
                self._refuse_edges(~is_finite, problem)
        for name in ("kappa", "tau"):
            values = getattr(self, name)
            is_negative = values < 0
            first = values[int(np.argmax(is_negative))]
            problem = f"{name} of {{edge}} is {first:.6g}; a precision must not be negative"
            self._refuse_edges(is_negative, problem)

    def _check_not_empty(self) -> None:
        """Check that every edge measures something, before and after landmarks are settled."""
        is_empty = (self.kappa == 0) & (self.tau == 0)
        self._refuse_edges(is_empty, "kappa and tau of {edge} are 0; remove it")

    def _check_names(self) -> None:
        if self.ids is not None:
            steps = np.diff(np.sort(self.ids))
            if not steps.all():
                raise GraphError("ids are not unique; every pose needs a name of its own")
        if self.robot is not None and not has_no_gap(self.robot):
            raise GraphError(
                "robot must number the robots 0, 1, .. without a gap; see numpy.unique"
            )

    # Connectivity

    @cached_property
    def adjacency(self) -> csr_array:
        """Number of edges between every two poses, a sparse (n, n) matrix."""
        counts = edge_counts(self.i, self.j, self.num_poses)
        return read_only(counts)

    def components(self, edges: BoolArray | None = None) -> list[IntArray]:
        """Return the poses of every connected component, the largest component first.

        All edges connect poses unless a mask, (m,), says which.
        """
        if edges is None:
            adjacency = self.adjacency
        else:
            adjacency = edge_counts(self.i[edges], self.j[edges], self.num_poses)
        # The matrix is symmetric, so that strong components are the components; they are faster.
        count, label = connected_components(adjacency, connection="strong")
        parts = [np.flatnonzero(label == c) for c in range(count)]

        def largest_then_first(part: IntArray) -> tuple[int, int]:
            return -len(part), int(part[0])

        return sorted(parts, key=largest_then_first)

    def parts(self) -> list[IntArray]:
        """Return the poses of every part that is solved on its own, the largest part first.

        Parts are the components, but for priors of rotations alone, which tie no positions: where
        nothing else joins two parts, each has the world of its priors.
        """
        ties = ~self.is_prior | (self.tau > 0.0)
        if ties.all() or not self.has_translations:
            return self.components()
        of_world = np.array([self.world])
        parts = [part for part in self.components(ties) if not np.array_equal(part, of_world)]
        with_priors = self.j[self.is_prior]
        return [
            np.union1d(part, of_world) if np.isin(part, with_priors).any() else part
            for part in parts
        ]

    @property
    def is_connected(self) -> bool:
        """Whether every pose can be reached from every other along edges."""
        return len(self.components()) == 1

    @property
    def has_translations(self) -> bool:
        """Whether any edge measures a translation; without one only rotations can be estimated."""
        return bool(self.tau.any())

    def check_connected(self) -> None:
        """Check that the measurements determine all poses up to one gauge.

        Where no edge measures a translation, the rotations alone are what they determine.

        Raises
        ------
        GraphError
            When the graph has several components, which the message names; when no edge with a
            positive precision ties the positions or rotations of some poses to those of the
            others; or when there are priors of positions alone, and no edges between poses, or of
            rotations alone.
        """
        if not self.has_translations:
            self.check_rotations_connected()
            return
        self._check_one_component()
        if self.world is not None:
            self._check_kinds_of_priors()
        self._check_tied("tau", "position")
        self._check_tied("kappa", "rotation")

    def check_rotations_connected(self) -> None:
        """Check that the measured rotations determine those of all poses up to one gauge.

        Raises
        ------
        GraphError
            When the graph has landmarks, which have no rotation, or several components; or when no
            edge with a positive kappa ties the rotations of some poses, or of the world, to the
            others.
        """
        if len(self.landmarks):
            raise GraphError(
                f"{self.name} has {len(self.landmarks)} landmarks, which have no rotation; "
                "leave them out (PoseGraph.subgraph with its bodies), or solve for poses"
            )
        self._check_one_component()
        if self.is_world_loose:
            raise GraphError(
                "priors of positions alone say nothing of rotations; leave them out "
                "(PoseGraph.without_edges), or solve for poses"
            )
        self._check_tied("kappa", "rotation")

    def _check_one_component(self) -> None:
        """Raise a GraphError that names the components where there are several."""
        parts = self.parts()
        alone = [part[0] for part in parts[1:] if len(part) == 1]
        if alone and len(alone) == len(parts) - 1:
            first = self.pose_name(alone[0])
            poses = f"{len(alone)} poses have no edges (the first is {first})"
            if len(alone) == 1:
                poses = f"pose {first} has no edges"
            raise GraphError(
                f"{poses}; leave out what is not connected with --largest-component "
                "(PoseGraph.components and subgraph), or add edges"
            )
        if len(parts) > 1:
            named = parts[:_NAMED_COMPONENTS]
            num_unnamed = len(parts) - len(named)
            rest = f" and {num_unnamed} more" if num_unnamed else ""
            sizes = ", ".join(str(len(part)) for part in named)
            firsts = ", ".join(self.pose_name(part[0]) for part in named)
            raise GraphError(
                f"pose graph has {len(parts)} components "
                f"(sizes {sizes}{rest}; with poses {firsts}{rest}); add edges between them, "
                "or solve the first with --largest-component, and each with --all-components "
                "(PoseGraph.components and PoseGraph.subgraph)"
            )

    def _check_tied(self, precision: str, quantity: str) -> None:
        """Raise a GraphError unless edges whose `precision` is positive connect all poses."""
        measures = getattr(self, precision) > 0
        if measures.all():
            return
        parts = self.components(measures)
        if precision == "kappa" and self.is_world_loose:
            # Priors of positions fix this rotation together, see _check_priors_fix_world.
            parts = [part for part in parts if part[0] != self.world]
        if len(parts) > 1:
            untied = parts[1]
            poses = f"{len(untied)} poses (with {self.pose_name(untied[0])})"
            raise GraphError(
                f"the {quantity} of {poses} is not tied to that of the others: "
                f"no edge between has {precision} > 0; add one, or leave these out"
            )

    def _check_kinds_of_priors(self) -> None:
        """Raise a GraphError where positions are all that is measured, or priors have none."""
        if self.is_prior.all() and self.is_world_loose:
            raise GraphError(
                f"{self.name} has {self.num_edges} positions of single poses (GPS) and no edges "
                "between poses: nothing says how the poses are turned; add odometry"
            )
        if not self.tau[self.is_prior].any():
            raise GraphError(
                f"the priors of {self.name} measure rotations alone, and nothing says where the "
                "origin of their frame is; add the position of a pose "
                "(EDGE_SE3_PRIORXYZ, EDGE_PRIOR_SE2_XY), or leave these priors out"
            )

    def is_world_fixed(self, kept: BoolArray) -> bool:
        """Return whether positions among the kept edges, (m,), fix the rotation of the world.

        In a point or, in space, on a line they do not.
        """
        priors = self.is_prior & kept
        _, first = np.unique(self.j[priors], return_index=True)
        measured = self.t_ij[priors][first]  # one position of every pose
        if len(measured) < self.d:
            return False
        centred = measured - measured.mean(axis=0)
        spread = np.linalg.svd(centred, compute_uv=False)
        rounding = _ROUNDING * np.abs(measured).max(initial=0.0)
        threshold = max(_COLLINEAR * spread[0], rounding, 1e-300)
        return bool(spread[self.d - 2] > threshold)

    # Other graphs made of this one

    def subgraph(self, poses: IntArray) -> PoseGraph:
        """Return the graph of some poses, (k,), and of the edges among them.

        The poses keep their ids, and are numbered anew in ascending order.

        Raises
        ------
        GraphError
            When there is no pose, or one that the graph does not have, or no edge among them.
        """
        chosen = np.unique(whole_array(poses, "poses"))
        if not len(chosen) or not self._has_poses(chosen):
            raise GraphError(
                f"poses of a subgraph are some of 0 .. {self.num_poses - 1}, got {chosen}"
            )
        new_number = np.full(self.num_poses, -1, dtype=np.int64)
        new_number[chosen] = np.arange(len(chosen))
        is_kept = new_number >= 0
        edges = is_kept[self.i] & is_kept[self.j]
        rows = self._edge_rows(edges)
        rows["i"] = new_number[rows["i"]]
        rows["j"] = new_number[rows["j"]]
        robot = None
        if self.robot is not None:
            _, robot = np.unique(self.robot[chosen], return_inverse=True)
        world = None
        if self.world is not None and is_kept[self.world]:
            world = int(new_number[self.world])
        times = None
        if self.times is not None:
            times = self.times[is_kept[self.bodies]]
        fixed = new_number[self.fixed]
        landmarks = new_number[self.landmarks]
        absent = new_number[self.absent]
        return replace(
            self,
            num_poses=len(chosen),
            **rows,
            ids=self.pose_ids[chosen],
            robot=robot,
            initial=None if self.initial is None else self.with_world_of(self.initial)[chosen],
            truth=None if self.truth is None else self.with_world_of(self.truth)[chosen],
            fixed=fixed[fixed >= 0],
            times=times,
            world=world,
            landmarks=landmarks[landmarks >= 0],
            absent=absent[absent >= 0],
        )

    def edge_subgraph(self, edges: IntArray) -> PoseGraph:
        """Return the graph of some edges, (k,), in the given order, and of the poses they join.

        The poses keep their ids, and are numbered anew in ascending order. Estimates, truth, robots
        and times are left out.

        Examples
        --------
        >>> from pgo_models.graphs.scenes import grid
        >>> grid(np.random.default_rng(0)).edge_subgraph(np.array([5, 6])).num_edges
        2
        """
        poses = np.unique(np.concatenate([self.i[edges], self.j[edges]]))
        rows = self._edge_rows(edges)
        rows["i"] = np.searchsorted(poses, rows["i"])
        rows["j"] = np.searchsorted(poses, rows["j"])
        return PoseGraph(
            len(poses),
            **rows,
            ids=self.pose_ids[poses],
            name=self.name,
            weights_error=self.weights_error,
            origin=self.origin,
        )

    def unit_weights(self) -> PoseGraph:
        """Return the graph with kappa = tau = 1, as in the paper, but where they are zero.

        Information matrices as read are left out.

        References
        ----------
        Ebrahimi & Deghat, equation (16).
        """
        kappa = (self.kappa > 0).astype(float)
        tau = (self.tau > 0).astype(float)
        return self.with_weights(kappa, tau)

    def with_weights(self, kappa: Array, tau: Array) -> PoseGraph:
        """Return the graph with other precisions, (m,), per radian^2 and per metre^2.

        Information matrices as read are left out.
        """
        return replace(self, kappa=kappa, tau=tau, information=None, unheld=None, weights_error=0.0)

    def with_robots(self, robot: IntArray) -> PoseGraph:
        """Return the graph with other owners of the poses, (n,), each 0 .. num_robots - 1."""
        return replace(self, robot=robot)

    @door
    def without_edges(self, mask: BoolArray) -> PoseGraph:
        """Return the graph without the edges that a mask, (m,), names; some have to be left.

        It has no world pose if no prior is left.
        """
        if mask.shape != (self.num_edges,):
            raise GraphError(
                f"the mask has shape {mask.shape}; "
                f"give one truth value for each of {self.num_edges} edges"
            )
        remaining = replace(self, **self._edge_rows(~mask))
        if self.world is None or remaining.is_prior.any():
            return remaining
        return remaining.subgraph(self.in_files)

    def with_edges(
        self,
        i: IntArray | Sequence[int],
        j: IntArray | Sequence[int],
        measured: Poses,
        kappa: Weights,
        tau: Weights,
    ) -> PoseGraph:
        """Return the graph with additional edges, the new ones last.

        Where the graph has information matrices, the new edges have those of their precisions.

        Parameters
        ----------
        i, j : IntArray or sequence of int, (k,)
            First and second pose of every new edge.
        measured : Poses
            Measured x_i^-1 x_j of the k edges.
        kappa, tau : Array, (k,), or float
            Precisions, per radian^2 and per metre^2, each or one for all new edges.

        Raises
        ------
        GraphError
            When there is not one measurement for every edge, or as for `PoseGraph`.
        """
        i = whole_array(i, "i")
        j = whole_array(j, "j")
        if measured.d != self.d or not i.shape == j.shape == (measured.num_poses,):
            raise GraphError(
                f"{measured} for {len(i)} edges in {self.d}D; give one measured pose for every edge"
            )
        offsets = measured.t - np.where((i == self.world)[:, None], self.world_point, 0.0)
        kappa_rows = _rows_of_weights(kappa, len(i), "kappa")
        tau_rows = _rows_of_weights(tau, len(i), "tau")
        information = isotropic_information(kappa_rows, tau_rows, self.d)
        new_rows = {
            "i": i,
            "j": j,
            "R_ij": measured.R,
            "t_ij": offsets,
            "kappa": kappa_rows,
            "tau": tau_rows,
            "information": information,
            "unheld": information,
            "uncoupled": np.zeros(len(kappa_rows), dtype=bool),
            "written_error": np.zeros((len(kappa_rows), 2)),
        }
        all_edges = np.ones(self.num_edges, dtype=bool)
        own_rows = self._edge_rows(all_edges)
        extended: dict[str, Any] = {}
        for name, rows in own_rows.items():
            extended[name] = np.concatenate([rows, new_rows[name]])
        # Where nothing was far before, the origin is found anew.
        origin = self.origin if self.world_point.any() else None
        return replace(self, **extended, origin=origin)

    def with_prior(
        self, poses: IntArray, measured: Poses, kappa: Weights, tau: Weights
    ) -> PoseGraph:
        """Return the graph with priors, after which the solution is in the frame of the world.

        The k `poses` are measured in this frame. Precisions and errors are those of `with_edges`.
        """
        poses = self._checked_poses(poses)
        graph = self
        if self.world is None:
            graph = self._with_node(poses[0], WORLD_ID, {"world": self.num_poses})
        world = np.full(len(poses), graph.world)
        return graph.with_edges(world, poses, measured, kappa, tau)

    def with_position_prior(self, poses: IntArray, positions: Array, tau: Weights) -> PoseGraph:
        """Return the graph with priors of positions, as measured by GPS.

        The k `poses` have these positions, (k, d), in the frame of the world, metres. Precisions
        and errors are those of `with_edges`.

        Examples
        --------
        >>> from pgo_models.graphs.datasets import load
        >>> load("grid").with_position_prior(np.array([0, 5, 9]), np.eye(3), tau=1.0)
        PoseGraph('grid', d=3, poses=27, edges=111, priors=3, robots=1)
        """
        poses = self._checked_poses(poses)
        measured = Poses.of_points(positions)
        return self.with_prior(poses, measured, kappa=0.0, tau=tau)

    def with_landmark(self, seen_from: IntArray, positions: Array, tau: Weights) -> PoseGraph:
        """Return the graph with one more landmark; the ground truth is left out.

        Its id is the first above all others. The estimate, if there is one, has the landmark where
        the first pose sees it. Errors are those of `with_edges`.

        Parameters
        ----------
        seen_from : IntArray, (k,)
            Poses that see the landmark.
        positions : Array, (k, d)
            Measured positions of the landmark in the frames of these poses, metres.
        tau : Array, (k,), or float
            Precisions of the positions, per metre^2.
        """
        seen_from = self._checked_poses(seen_from)
        points = Poses.of_points(positions)
        if (points.num_poses, points.d) != (len(seen_from), self.d):
            raise GraphError(
                f"{points.t.shape} positions seen from {len(seen_from)} poses in {self.d}D; "
                "give one each"
            )
        first = seen_from[0]
        name = int(self.pose_ids[self.in_files].max()) + 1
        initial = self.initial
        if initial is not None:
            initial = self.with_world_of(initial)
            R_first = initial.R[first]
            position = initial.t[first] + R_first @ points.t[0]
            R = np.append(initial.R, R_first[None], axis=0)
            t = np.append(initial.t, position[None], axis=0)
            initial = Poses(R, t)
        landmark = self.num_poses
        landmarks = np.append(self.landmarks, landmark)
        fields = {"landmarks": landmarks, "initial": initial, "truth": None}
        graph = self._with_node(first, name, fields)
        j = np.full(len(seen_from), landmark)
        return graph.with_edges(seen_from, j, points, kappa=0.0, tau=tau)

    def _checked_poses(self, poses: IntArray) -> IntArray:
        """Poses (k,), k > 0, as whole numbers; a GraphError unless the graph has them."""
        poses = whole_array(poses, "poses")
        if poses.ndim != 1 or not poses.size or not self._has_poses(poses):
            raise GraphError(
                f"measured poses are {poses}; give one or more, 0 to {self.num_poses - 1}, in a row"
            )
        return poses

    def _edge_rows(self, edges: BoolArray | IntArray) -> dict[str, Any]:
        """Rows of the given edges of every field that has a row for each edge."""
        rows = {}
        for name in _EDGE_FIELDS:
            values = getattr(self, name)
            if values is not None:
                rows[name] = values[edges]
        return rows

    def _with_node(self, beside: int, name: int, others: Mapping[str, Any]) -> PoseGraph:
        """Return the graph with one more pose, owned by the robot of `beside`, and other fields."""
        robot = None
        if self.robot is not None:
            robot = np.append(self.robot, self.robot[beside])
        ids = np.append(self.pose_ids, name)
        return replace(self, num_poses=self.num_poses + 1, ids=ids, robot=robot, **others)


def _rows_of_weights(weights: Weights, count: int, name: str) -> Array:
    """Weights of so many edges, of which one may be given for all; else a GraphError."""
    rows = real_array(weights, name)
    if rows.shape not in ((), (1,), (count,)):
        raise GraphError(
            f"{name} has shape {rows.shape} for {count} edges; give one number for all, or each"
        )
    return np.array(np.broadcast_to(rows, count))


def written_error_of(graph: PoseGraph, edges: BoolArray | IntArray) -> Array | None:
    """`PoseGraph.written_error` of the given edges."""
    return None if graph.written_error is None else graph.written_error[edges]


def isotropic_information(kappa: Array, tau: Array, d: int) -> Array:
    """Diagonal information matrices, (m, k, k), whose `edge_precisions` are kappa and tau.

    k is 3 in the plane and 6 in space.
    """
    if d == 2:
        diagonal = [tau, tau, kappa]
    else:
        rotation = 2 * kappa
        diagonal = [tau, tau, tau, rotation, rotation, rotation]
    rows = np.stack(diagonal, axis=1)
    identity = np.eye(len(diagonal))
    return np.asarray(rows[:, :, None] * identity)


def matrices_of_edges(graph: PoseGraph) -> Array:
    """Information matrices of the edges, (m, k, k), isotropic where the graph has none."""
    if graph.information is None:
        return isotropic_information(graph.kappa, graph.tau, graph.d)
    return graph.information


def has_no_gap(robot: IntArray) -> bool:
    """Whether the robots are numbered 0, 1, .. and every one owns a pose."""
    if not len(robot) or robot.min() != 0 or robot.max() >= len(robot):
        return False
    num_owned = np.bincount(robot)
    return bool(num_owned.all())


def is_ascending(times: Array) -> bool:
    """Whether times are finite, and each is later than the one before."""
    if not np.isfinite(times).all():
        return False
    is_later = np.diff(times) > 0
    return bool(is_later.all())


def middle_pose(graph: PoseGraph) -> int:
    """Pose half-way along a long shortest path of a connected graph, see `middle_node`."""
    return middle_node(graph.adjacency)


def middle_node(adjacency: csr_array) -> int:
    """Node half-way along a long shortest path of a connected graph with this adjacency matrix.

    The path ends at the node farthest from node 0, and at the node farthest from that one. Two
    breadth-first searches find them.
    """
    end = int(breadth_first_order(adjacency, 0, return_predecessors=False)[-1])
    order, parents = breadth_first_order(adjacency, end)
    parent = parents.tolist()
    node = int(order[-1])
    path = [node]
    while node != end:
        node = parent[node]
        path.append(node)
    return path[len(path) // 2]


def connecting_edges(graph: PoseGraph, kept: BoolArray, ratio: Array) -> IntArray:
    """Edges that connect the components of the kept edges, with the smallest ratios.

    They are a minimum spanning tree (Kruskal) of the graph whose nodes are these components; kept
    and ratio are (m,).
    """
    kept_edges = edge_counts(graph.i[kept], graph.j[kept], graph.num_poses)
    count, part = connected_components(kept_edges, directed=False)
    return least_tree(part[graph.i], part[graph.j], count, ratio)


def least_tree(i: IntArray, j: IntArray, count: int, ratio: Array) -> IntArray:
    """Links, of those from i to j (m,), of a minimum spanning tree of `count` nodes (Kruskal).

    Nodes that no link joins to others have trees of their own.
    """
    order = np.argsort(ratio, kind="stable")
    parts = np.stack([i[order], j[order]]).astype(np.int64)
    ends = np.sort(parts, axis=0)
    is_between = ends[0] != ends[1]
    order = order[is_between]
    ends = ends[:, is_between]
    # Of several edges between two components the first, with the smallest ratio, is enough.
    pair = ends[0] * count + ends[1]
    _, first = np.unique(pair, return_index=True)
    links = ends[:, first].astype(np.int32)  # SciPy 1.14 finds no trees with indices of 64 bits
    # The place in the order is the length of a link. It is positive, since 0 would be no link.
    lengths = csr_array((first + 1.0, links), shape=(count, count))
    tree = minimum_spanning_tree(lengths)
    places = tree.data.astype(np.int64) - 1
    return np.asarray(order[places])


def edge_counts(i: IntArray, j: IntArray, size: int) -> csr_array:
    """Symmetric matrix with the number of edges (i, j) between every two.

    Its indices have 32 bits: SciPy 1.14 finds no shortest paths with others.
    """
    both_ways = np.concatenate([[i, j], [j, i]], axis=1)
    rows, columns = both_ways.astype(np.int32)
    ones = np.ones(2 * len(i))
    return csr_array((ones, (rows, columns)), shape=(size, size))
