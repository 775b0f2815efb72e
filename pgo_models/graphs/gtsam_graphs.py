"""Graphs of GTSAM in memory: to certify what its optimisers return, and to give it ours.

GTSAM's cost has the factor one half and the logarithm in SE(d) for a residual; chi2 here has
neither. To second order in the residuals, chi2 is twice GTSAM's error. The extra `peers` brings it.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pgo_models.errors import GraphError, GraphWarning, SettingError, extra_module, printable
from pgo_models.files import Problem, check_lines
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, log_map, project_to_rotations
from pgo_models.graphs.g2o import graph_of_files
from pgo_models.graphs.g2o_folder import robot_letters
from pgo_models.graphs.g2o_parser import problems_of
from pgo_models.graphs.g2o_tags import Noise, Tag
from pgo_models.graphs.jrl import (
    TRANSLATION_FIRST,
    Measurements,
    common_dimension,
    lines_of_measurements,
)
from pgo_models.graphs.pose_graph import WORLD_ID, IntArray, PoseGraph
from pgo_models.graphs.precisions import (
    LEAST_SCALED,
    are_definite,
    proper_information,
)
from pgo_models.graphs.residuals import check_poses

if TYPE_CHECKING:
    from types import ModuleType

# Factors that become edges, and what stands on a line with such an edge. GPS measures the position
# of a pose, a prior on a point that of a landmark. Factors of rotations have no information on
# positions.
_FACTORS = {
    "BetweenFactorPose2": Tag(2, 2),
    "BetweenFactorPose3": Tag(3, 2),
    "PriorFactorPose2": Tag(2, 1),
    "PriorFactorPose3": Tag(3, 1),
    "GPSFactor": Tag(3, 1, is_point=True),
    "PoseTranslationPrior2D": Tag(2, 1, is_point=True),
    "PoseTranslationPrior3D": Tag(3, 1, is_point=True),
    "PriorFactorPoint2": Tag(2, 1, is_point=True, to_landmark=True),
    "PriorFactorPoint3": Tag(3, 1, is_point=True, to_landmark=True),
    "PoseRotationPrior2D": Tag(2, 1),
    "PoseRotationPrior3D": Tag(3, 1),
    "PriorFactorRot2": Tag(2, 1),
    "PriorFactorRot3": Tag(3, 1),
    "BetweenFactorRot2": Tag(2, 2),
    "BetweenFactorRot3": Tag(3, 2),
    "AttitudeFactorPose3": Tag(3, 1, is_direction=True),
    "AttitudeFactorRot3": Tag(3, 1, is_direction=True),
    "BearingRangeFactor2D": Tag(2, 2, is_point=True, to_landmark=True, noise=Noise.DEVIATIONS),
    "GPSFactorArm": Tag(3, 2, is_point=True, to_landmark=True),
}
_ARM = "GPSFactorArm"  # two edges, see `_Antenna`
_SOURCE = Path("factors of GTSAM")  # in messages, in place of a file


class _UnreadableFactorError(Exception):
    """A factor that is no edge; the text says why."""


@dataclass(frozen=True, eq=False)
class _Antenna:
    """A landmark for an antenna, which is at `arm` (3,) in the frame of a pose.

    Measured is its position (3,) in the world, with the information L. An edge from the pose to the
    landmark has the information w I, a prior on the landmark P, with P^-1 + I / w = L^-1. Where the
    landmark is best, both cost r^T L r together, r = R arm + t - position.
    """

    place: int  # of the factor, from 1
    pose: int  # its key
    arm: Array
    position: Array
    w: float
    P: Array

    @classmethod
    def of(cls, gtsam: ModuleType, factor: Any, information: Array, place: int) -> _Antenna:  # noqa: ANN401
        """The antenna of a GPSFactorArm, whose error at the identity is arm - position."""
        position = np.asarray(factor.measurementIn())
        precisions, axes = np.linalg.eigh(information)
        w = 2.0 * float(precisions[-1])
        P = (axes * (precisions * w / (w - precisions))) @ axes.T
        arm = factor.evaluateError(gtsam.Pose3()) + position
        return cls(place, int(factor.keys()[0]), arm, position, w, P)

    def edges(self, key: int) -> tuple[tuple[str, list[int], list[float]], ...]:
        """Type, ids and numbers of the edge and of the prior, with the key of the landmark."""
        upper = np.triu_indices(3)
        to_antenna = [*self.arm.tolist(), *(self.w * np.eye(3))[upper].tolist()]
        of_world = [*self.position.tolist(), *self.P[upper].tolist()]
        return (
            (_ARM, [self.pose, key], to_antenna),
            ("PriorFactorPoint3", [WORLD_ID, key], of_world),
        )

    def best_position(self, gtsam_pose: Any) -> Array:  # noqa: ANN401
        """Position of the landmark, (3,), at which its two edges cost least."""
        pulled = self.P @ self.position + self.w * gtsam_pose.transformFrom(self.arm)
        return np.linalg.solve(self.P + self.w * np.eye(3), pulled)


def from_gtsam(
    factors: Any,  # noqa: ANN401 - GTSAM has no types
    values: Any = None,  # noqa: ANN401
    *,
    skip_unknown: bool = False,
) -> PoseGraph:
    """Make a PoseGraph of a factor graph of GTSAM, to solve it or to certify GTSAM's answer.

    Read are between factors and priors of poses and rotations, GPS and other positions of poses,
    attitudes, positions of points, and bearing and range in the plane. GPS at a lever arm measures
    the position of the antenna, which becomes a landmark with the next free key. Of a robust noise
    model its Gaussian is read, with a warning. A pose whose only prior is a constrained one is an
    anchor: it is where the prior has it. Other constrained factors are no edges with information
    matrices. Keys become the ids of the poses, and a letter in the key of a pose names the robot.
    Slots without a factor, as iSAM2 leaves them, are skipped.

    Parameters
    ----------
    factors : gtsam.NonlinearFactorGraph
        Factors, whose noise models give the information matrices.
    values : gtsam.Values, optional
        Values of all keys, which become `PoseGraph.initial`.
    skip_unknown : bool
        Whether other factors are left out, with a warning that names and counts them.

    Raises
    ------
    GraphError
        For factors of other kinds, named and counted, unless they are to be skipped; for values
        that lack a key.
    FileFormatError
        For factors that measure nothing, with their numbers in the graph, from 1.

    Examples
    --------
    To certify what an optimiser of GTSAM has returned:

    >>> import pgo_models as pgo, solvers  # doctest: +SKIP
    >>> graph = pgo.from_gtsam(factors, optimizer.optimize())  # doctest: +SKIP
    >>> solvers.certify(pgo.PGOProblem(graph), graph.initial)  # doctest: +SKIP
    """
    gtsam = extra_module("gtsam", "peers")
    if not isinstance(factors, gtsam.NonlinearFactorGraph):
        raise SettingError(f"factors are a {type(factors).__name__}; give a NonlinearFactorGraph")
    if values is not None and not isinstance(values, gtsam.Values):
        raise SettingError(f"values are a {type(values).__name__}; give gtsam.Values")
    by_type, unreadable, num_robust, antennas = _measurements(gtsam, factors)
    if unreadable:
        _report_unreadable(unreadable, skip_unknown)
    if num_robust:
        warnings.warn(
            f"{num_robust} factors have robust noise models, of which the Gaussian is read; "
            "solve(graph, robust=solvers.GNC()) finds wrong edges",
            GraphWarning,
            stacklevel=2,
        )
    problems: list[Problem] = []
    d = common_dimension(_SOURCE, [by_type], problems)
    lines = lines_of_measurements(_SOURCE, d, by_type, problems)
    check_lines(_SOURCE, problems + problems_of(lines), "factors")
    graph = graph_of_files(_SOURCE, [lines], _letters(lines.edge_ids, lines.landmarks))
    graph = replace(graph, name="gtsam")
    if values is None:
        return graph
    return replace(graph, initial=_poses_of_values(gtsam, values, graph, antennas))


def to_gtsam(graph: PoseGraph, poses: Poses | None = None) -> tuple[Any, Any]:
    """Make a factor graph of GTSAM of a PoseGraph: between factors, priors and positions of poses.

    Twice its error is chi2 of the graph to second order in the residuals. A graph without
    information matrices has those of its kappa and tau, as `write_g2o` writes them. Without priors
    GTSAM leaves the frame open: add a prior on one pose.

    Returned are the gtsam.NonlinearFactorGraph, and gtsam.Values of the given poses or
    `graph.initial`, empty if there are none. Keys are the ids of the poses. A GraphError when the
    graph has landmarks, or the poses do not fit it.
    """
    gtsam = extra_module("gtsam", "peers")
    if len(graph.landmarks):
        raise GraphError(f"{graph.name} has landmarks, which are not written for GTSAM; leave out")
    if poses is None:
        poses = graph.initial
    if poses is not None:
        poses = check_poses(graph, poses)
    information = proper_information(graph)
    is_position = graph.is_prior & ~(graph.kappa > 0.0)
    d = graph.d
    factors = gtsam.NonlinearFactorGraph()
    ids = graph.pose_ids
    t_ij = graph.t_ij + np.where(graph.is_prior[:, None], graph.world_point, 0.0)
    measured = poses_in_gtsam(gtsam, Poses(graph.R_ij, t_ij))
    in_order = np.roll(information, 3, axis=(1, 2)) if d == 3 else information
    between = gtsam.BetweenFactorPose3 if d == 3 else gtsam.BetweenFactorPose2
    prior = gtsam.PriorFactorPose3 if d == 3 else gtsam.PriorFactorPose2
    position = gtsam.GPSFactor if d == 3 else gtsam.PoseTranslationPrior2D
    for e in range(graph.num_edges):
        j = int(ids[graph.j[e]])
        if is_position[e]:
            factors.add(position(j, t_ij[e], _noise(gtsam, information[e, :d, :d])))
        elif graph.is_prior[e]:
            factors.add(prior(j, measured[e], _noise(gtsam, in_order[e])))
        else:
            noise = _noise(gtsam, in_order[e])
            factors.add(between(int(ids[graph.i[e]]), j, measured[e], noise))
    values = gtsam.Values()
    if poses is not None:
        shown = graph.in_files
        for pose_id, pose in zip(
            ids[shown].tolist(), poses_in_gtsam(gtsam, poses[shown]), strict=True
        ):
            values.insert(pose_id, pose)
    return factors, values


def _noise(gtsam: ModuleType, information: Array) -> Any:  # noqa: ANN401
    """Noise model of a matrix; `Gaussian.Information` factors singular ones wrongly in silence."""
    if are_definite(information[None], LEAST_SCALED)[0]:
        return gtsam.noiseModel.Gaussian.Information(information)
    eigenvalues, axes = np.linalg.eigh(information)
    root = np.sqrt(np.maximum(eigenvalues, 0.0))[:, None] * axes.T
    triangle = np.linalg.qr(root)[1]
    # A diagonal triangle becomes a model of standard deviations, which must not be negative.
    signs = np.where(np.diag(triangle) < 0.0, -1.0, 1.0)
    return gtsam.noiseModel.Gaussian.SqrtInformation(signs[:, None] * triangle)


def poses_in_gtsam(gtsam: ModuleType, poses: Poses) -> list[Any]:
    """Poses as GTSAM's Pose2 or Pose3."""
    if poses.d == 3:
        return [gtsam.Pose3(gtsam.Rot3(R), t) for R, t in zip(poses.R, poses.t, strict=True)]
    angles: Array = log_map(poses.R)[:, 0]
    t_and_angles = zip(poses.t.tolist(), angles.tolist(), strict=True)
    return [gtsam.Pose2(t[0], t[1], angle) for t, angle in t_and_angles]


def _measurements(
    gtsam: ModuleType,
    factors: Any,  # noqa: ANN401
) -> tuple[dict[str, Measurements], dict[str, list[int]], int, dict[int, _Antenna]]:
    """Measurements by the type of their factors, factors that are no edges, and robust ones.

    Antennas are returned by the keys of their landmarks.
    """
    by_type: dict[str, Measurements] = {}
    unreadable: dict[str, list[int]] = {}
    num_robust = 0
    num_priors = _num_priors(factors)
    antennas: list[_Antenna] = []

    def add(place: int, name: str, ids: list[int], numbers: list[float]) -> None:
        of_type = by_type.setdefault(name, Measurements(_FACTORS[name]))
        of_type.places.append(place)
        of_type.ids.append(ids)
        of_type.numbers.append(numbers)

    for place in range(factors.size()):
        factor = factors.at(place)
        if factor is None:
            continue
        try:
            if type(factor).__name__ == _ARM:
                information = _information(gtsam, _ARM, factor.noiseModel(), num_priors)
                antennas.append(_Antenna.of(gtsam, factor, information, place + 1))
            else:
                add(place + 1, *_measurement(gtsam, factor, num_priors))
        except _UnreadableFactorError as error:
            unreadable.setdefault(str(error), []).append(place + 1)
            continue
        num_robust += isinstance(factor.noiseModel(), gtsam.noiseModel.Robust)
    free_key = 1 + max(map(int, gtsam.KeyVector(factors.keyVector())), default=0)
    by_key = dict(enumerate(antennas, free_key))
    for key, antenna in by_key.items():
        for edge in antenna.edges(key):
            add(antenna.place, *edge)
    return by_type, unreadable, num_robust, by_key


def _num_priors(factors: Any) -> int:  # noqa: ANN401
    """Number of factors that are priors."""
    names = [type(factors.at(place)).__name__ for place in range(factors.size())]
    one_pose = {name for name, kind in _FACTORS.items() if kind.num_ids == 1} | {_ARM}
    return sum(name in one_pose for name in names)


def _measurement(
    gtsam: ModuleType,
    factor: Any,  # noqa: ANN401
    num_priors: int,
) -> tuple[str, list[int], list[float]]:
    """Type of a factor, its ids, and the numbers of its measurement and its noise."""
    name = type(factor).__name__
    if name not in _FACTORS:
        raise _UnreadableFactorError(name)
    kind = _FACTORS[name]
    information = _information(gtsam, name, factor.noiseModel(), num_priors)
    keys = [int(key) for key in list(factor.keys())]
    ids = [WORLD_ID, *keys] if kind.num_ids == 1 else keys
    if kind.noise is Noise.DEVIATIONS:
        if information[0, 1] != 0.0:
            raise _UnreadableFactorError(f"{name} with correlated noise")
        value = factor.measured()
        deviations = np.diag(information) ** -0.5
        return name, ids, [value.bearing().theta(), value.range(), *deviations.tolist()]
    if kind.is_direction:
        return name, ids, _numbers_of_attitude(name, factor, information)
    if name == "GPSFactor":
        value = factor.measurementIn()
    else:
        value = factor.prior() if name.startswith("PriorFactor") else factor.measured()
    numbers = _numbers_of(value)
    if "Rot" in name:
        information = _of_rotation_alone(information)
        numbers = [0.0, 0.0, *numbers] if kind.d == 2 else [0.0, 0.0, 0.0, *numbers]
    elif len(information) == 6:
        information = information[np.ix_(TRANSLATION_FIRST, TRANSLATION_FIRST)]
    triangle = information[np.triu_indices(len(information))]
    return name, ids, [*numbers, *triangle.tolist()]


def _information(
    gtsam: ModuleType,
    name: str,
    noise: Any,  # noqa: ANN401
    num_priors: int,
) -> Array:
    """Information matrix of a noise model; the identity for a constrained prior with no other."""
    kind = type(noise).__name__
    if isinstance(noise, gtsam.noiseModel.Robust):
        noise = noise.noise()
    is_gaussian = isinstance(noise, gtsam.noiseModel.Gaussian)
    if not is_gaussian:
        raise _UnreadableFactorError(f"{name} with {kind} noise")
    if not noise.isConstrained():
        return np.asarray(noise.information())
    is_of_pose = name.startswith("PriorFactor") and not _FACTORS[name].to_landmark
    if not is_of_pose or noise.sigmas().any():
        raise _UnreadableFactorError(f"{name} with {kind} noise")
    if num_priors > 1:
        raise _UnreadableFactorError(f"{name} with {kind} noise beside other priors")
    return np.eye(len(noise.sigmas()))


def _numbers_of_attitude(name: str, factor: Any, information: Array) -> list[float]:  # noqa: ANN401
    """Numbers of EDGE_SE3_PRIORVEC: nRef in the frame of the world, bMeasured in that of the pose.

    Both errors, of two numbers in GTSAM and of three here, have the length of the difference of the
    directions to first order.
    """
    weight = information[0, 0]
    if (information != weight * np.eye(2)).any():
        raise _UnreadableFactorError(f"{name} with noise that is not isotropic")
    directions = [*factor.nRef().point3(), *factor.bMeasured().point3()]
    return [*map(float, directions), weight, 0.0, 0.0, weight, 0.0, weight]


def _of_rotation_alone(information: Array) -> Array:
    """Information of a pose of which a rotation is known, with its information, (p, p)."""
    p = len(information)
    d = 3 if p == 3 else 2
    whole = np.zeros((d + p, d + p))
    whole[d:, d:] = information
    return whole


def _numbers_of(value: Any) -> list[float]:  # noqa: ANN401
    """Numbers of a pose, rotation or point, as on a line of a g2o file."""
    if isinstance(value, np.ndarray):
        return [float(number) for number in value]
    if hasattr(value, "theta"):
        return [value.x(), value.y(), value.theta()] if hasattr(value, "x") else [value.theta()]
    if not hasattr(value, "rotation"):
        quaternion = value.toQuaternion()
        return [quaternion.x(), quaternion.y(), quaternion.z(), quaternion.w()]
    return [value.x(), value.y(), value.z(), *_numbers_of(value.rotation())]


def _report_unreadable(unreadable: dict[str, list[int]], skip_unknown: bool) -> None:
    """Raise a GraphError that names and counts the factors that are no edges, or warn of them."""
    counts = [
        f"{len(places)} {printable(name)} (first: factor {places[0]})"
        for name, places in unreadable.items()
    ]
    text = f"factors that no edge of a pose graph stands for: {', '.join(counts)}"
    if not skip_unknown:
        raise GraphError(f"{text}; leave them out, or give skip_unknown=True")
    warnings.warn(f"left out: {text}", GraphWarning, stacklevel=3)


def _letters(ids: IntArray, landmarks: IntArray) -> list[int]:
    """Codes of the letters in the keys of poses. Each letter names a robot."""
    letters, _ = robot_letters(ids[(ids != WORLD_ID) & ~np.isin(ids, landmarks)])
    return [int(code) for code in np.unique(letters) if code > 0]


def _poses_of_values(
    gtsam: ModuleType,
    values: Any,  # noqa: ANN401
    graph: PoseGraph,
    antennas: dict[int, _Antenna],
) -> Poses:
    """Poses of all keys of a graph; the world is at the origin, and landmarks are not turned."""
    d = graph.d
    R = np.tile(np.eye(d), (graph.num_poses, 1, 1))
    t = np.zeros((graph.num_poses, d))
    for place in graph.in_files.tolist():
        key = int(graph.pose_ids[place])
        if key in antennas and values.exists(antennas[key].pose):
            t[place] = antennas[key].best_position(values.atPose3(antennas[key].pose))
            continue
        if not values.exists(key):
            name = gtsam.DefaultKeyFormatter(key)
            raise GraphError(f"the values have no pose {name}; give one for every key")
        if place in graph.landmarks:
            t[place] = values.atPoint2(key) if d == 2 else values.atPoint3(key)
            continue
        if not graph.has_translations:
            rotation = values.atRot2(key) if d == 2 else values.atRot3(key)
            R[place] = rotation.matrix()
            continue
        pose = values.atPose2(key) if d == 2 else values.atPose3(key)
        R[place] = pose.rotation().matrix()
        t[place] = np.asarray(pose.translation())
    return Poses(project_to_rotations(R), t)
