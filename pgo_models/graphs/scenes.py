"""Generated pose graphs with known truth: the paper's circle, grid and sphere networks, and random geometric graphs.

The three networks follow the paper's section `SIMULATION RESULTS` and, for the geometry, Cristofalo et al. 2020 (GeoD);
the figures stand in data/reference.json under "scenes". Every function takes its random generator.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy  # and scipy.spatial when it is used
from numpy.typing import NDArray

from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, exp_map, random_rotations, tangent_dimension
from pgo_models.graphs.pose_graph import IntArray, PoseGraph

NETWORK_KAPPA = np.pi / 6  # the weights of the published experiments: the standard deviations, not their squares
NETWORK_TAU = 0.5
_SLACK = 1e-9  # metres: distances that equal the communication radius count, whatever their last bit
_SPHERE_PAIR_LEFT_OUT = (0, 12)


@dataclass(frozen=True)
class NoiseModel:
    """Zero-mean Gaussian noise of measurements and initial guesses; the defaults are the paper's.

    Standard deviations of every component of a translation, metres, and of the tangent vector of a rotation, radians. A
    SettingError when one is not positive and finite: a precision would be infinite.
    """

    translation_std: float = 0.5
    rotation_std: float = np.pi / 6

    def __post_init__(self) -> None:
        check_settings(self, finite=["translation_std", "rotation_std"])

    @property
    def tau(self) -> float:
        """Translation precision 1 / translation_std^2, per metre^2."""
        return self.translation_std**-2

    def kappa(self, d: int) -> float:
        """Rotation precision, per radian^2: 1 / rotation_std^2 in the plane, 1 / (2 rotation_std^2) in space.

        They are what the information matrix I / rotation_std^2 becomes on reading (`edge_precisions`), as in SE-Sync.
        """
        return self.rotation_std**-2 / (d - 1)


MILD_NOISE = NoiseModel(translation_std=0.1, rotation_std=np.pi / 60)  # 0.1 m and 3 degrees, of a good odometry


def circle(rng: np.random.Generator) -> PoseGraph:
    """25 poses on a circle of radius 2.6 m in the x-y plane, 300 directed edges between those within 4.0 m.

    Truth rotations are uniform on SO(3), measurements and initial guess have `NoiseModel()`, and the weights are
    kappa = pi / 6, tau = 0.5 on every edge. The edges are the same for every `rng`.

    Examples
    --------
    >>> circle(np.random.default_rng(0))
    PoseGraph('circle', d=3, poses=25, edges=300, robots=1)
    """
    angle = 2 * np.pi * np.arange(25) / 25
    return _network("circle", 2.6 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]), 4.0, rng)


def grid(rng: np.random.Generator) -> PoseGraph:
    """27 poses on a 3 x 3 x 3 lattice, 1.66 m apart, 108 directed edges between neighbours; else as `circle`.

    Examples
    --------
    >>> grid(np.random.default_rng(0))
    PoseGraph('grid', d=3, poses=27, edges=108, robots=1)
    """
    lattice = np.stack(np.meshgrid(*[np.arange(3.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return _network("grid", 1.66 * lattice, 1.66, rng)


def sphere(rng: np.random.Generator) -> PoseGraph:
    """50 poses on a sphere of radius 3 m by Deserno's equal-area rule, 544 directed edges within 3 m; else as `circle`.

    Four pairs on the meridian of zero longitude, (0, 12), (3, 25), (12, 38) and (25, 47), are 60 degrees apart and so
    at exactly the communication radius; the next distances differ by 3 mm. With all four there are 546 directed edges,
    with none 538. The published 544 is what double precision makes of it: the pair (0, 12) comes out one bit too long.
    That pair is left out by name here, and the others are in by a tolerance, so that no last bit decides.

    Examples
    --------
    >>> sphere(np.random.default_rng(0))
    PoseGraph('sphere', d=3, poses=50, edges=544, robots=1)
    """
    return _network("sphere", 3.0 * _equal_area_points(50), 3.0, rng, _SPHERE_PAIR_LEFT_OUT)


def random_geometric(
    num_poses: int, rng: np.random.Generator, *, d: int = 3, mean_degree: float = 6.0, noise: NoiseModel = MILD_NOISE
) -> PoseGraph:
    """Poses uniform in a box at one per metre^d, with an edge i < j wherever two are closer than a radius.

    The radius is that of the ball which holds `mean_degree` poses on average; near the walls there are fewer. Connected
    by construction: a pose without an edge to an earlier one gets an edge to the nearest earlier one. Precisions are
    `noise.tau` and `noise.kappa(d)`; truth rotations are uniform, the initial guess is the truth with the same noise. A
    SettingError for fewer than 2 poses, d other than 2 and 3, or a mean degree that is not positive.

    Examples
    --------
    >>> random_geometric(20, np.random.default_rng(0), d=2).is_connected
    True
    """
    if num_poses < 2:
        raise SettingError(f"num_poses must be at least 2, got {num_poses}")
    check_dimension(d)
    if not 0 < mean_degree < np.inf:
        raise SettingError(f"mean_degree must be positive and finite, got {mean_degree}")
    t = rng.uniform(0.0, num_poses ** (1 / d), (num_poses, d))
    ball = np.pi if d == 2 else 4 * np.pi / 3
    pairs = scipy.spatial.KDTree(t).query_pairs((mean_degree / ball) ** (1 / d), output_type="ndarray").astype(np.int64)
    alone = np.setdiff1d(np.arange(1, num_poses), pairs[:, 1])
    nearest = [int(np.argmin(np.sum((t[:pose] - t[pose]) ** 2, axis=1))) for pose in alone]
    pairs = np.concatenate([pairs, np.column_stack([np.array(nearest, dtype=np.int64), alone])])
    i, j = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].T
    truth = Poses(random_rotations(num_poses, d, rng), t)
    return observe("random_geometric", truth, i, j, noise, noise.kappa(d), noise.tau, rng)


def victoria_park(
    rng: np.random.Generator, *, num_poses: int = 300, noise: NoiseModel = MILD_NOISE, reach: float = 12.0
) -> PoseGraph:
    """A drive in rounds among trees, like the Victoria Park data set: poses 1 m apart, landmarks seen within `reach`.

    The poses of the plane are joined by odometry alone, along two rounds of a wavy loop; the trees, one for every four
    poses, stand along it, those seen but once felled. Truth, estimate and precisions as in `random_geometric`; a
    SettingError for fewer than 20 poses.

    Examples
    --------
    >>> victoria_park(np.random.default_rng(0))
    PoseGraph('victoria_park', d=2, poses=300, edges=3523, landmarks=75, robots=1)
    """
    if num_poses < 20:
        raise SettingError(f"num_poses must be at least 20, got {num_poses}")
    angle = 4 * np.pi * np.arange(num_poses) / num_poses
    radius = num_poses / (4 * np.pi) * (1 + 0.2 * np.cos(3 * angle))
    t = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    heading = np.arctan2(*np.gradient(t, axis=0).T[::-1])
    trees = t[rng.integers(0, num_poses, num_poses // 4)] + rng.uniform(-reach / 2, reach / 2, (num_poses // 4, 2))
    sight = np.linalg.norm(t[:, None] - trees, axis=2) <= reach
    trees, sight = trees[sight.sum(axis=0) > 1], sight[:, sight.sum(axis=0) > 1]
    seen_from, tree = np.nonzero(sight)
    i, j = np.append(np.arange(num_poses - 1), seen_from), np.append(np.arange(1, num_poses), num_poses + tree)
    truth = Poses(exp_map(np.append(heading, np.zeros(len(trees)))[:, None]), np.concatenate([t, trees]))
    made = observe("victoria_park", truth, i, j, noise, noise.kappa(2), noise.tau, rng)
    R_ij = np.where((j < num_poses)[:, None, None], made.R_ij, np.eye(2))
    return replace(made, R_ij=R_ij, landmarks=np.arange(num_poses, truth.num_poses))


def observe(
    name: str,
    truth: Poses,
    i: IntArray,
    j: IntArray,
    noise: NoiseModel,
    kappa: float,
    tau: float,
    rng: np.random.Generator,
    robot: IntArray | None = None,
) -> PoseGraph:
    """Pose graph with measurements of the edges (i, j), and an initial guess like GPS and IMU, of known poses.

    t_ij = R_i^T (t_j - t_i) + N(0, s_t^2 I),  R_ij = Exp(N(0, s_R^2 I)) R_i^T R_j;  the initial guess is
    t_i + N(0, s_t^2 I),  R_i Exp(N(0, s_R^2 I)).  All draws are independent (Ebrahimi & Deghat, `SIMULATION RESULTS`).
    """
    R_inverse = np.swapaxes(truth.R[i], 1, 2)
    t_ij = np.einsum("mab,mb->ma", R_inverse, truth.t[j] - truth.t[i])
    t_ij += noise.translation_std * rng.standard_normal(t_ij.shape)
    R_ij = _random_turns(len(i), truth.d, noise, rng) @ R_inverse @ truth.R[j]
    turned = truth.R @ _random_turns(truth.num_poses, truth.d, noise, rng)
    initial = Poses(turned, truth.t + noise.translation_std * rng.standard_normal(truth.t.shape))
    measured = R_ij, t_ij, np.full(len(i), kappa), np.full(len(i), tau)
    return PoseGraph(truth.num_poses, i, j, *measured, robot=robot, initial=initial, truth=truth, name=name)


def check_dimension(d: int) -> None:
    """Raise a SettingError unless d is 2 or 3."""
    if d not in (2, 3):
        raise SettingError(f"d must be 2 or 3, got {d}")


def _random_turns(count: int, d: int, noise: NoiseModel, rng: np.random.Generator) -> Array:
    return exp_map(noise.rotation_std * rng.standard_normal((count, tangent_dimension(d))))


def _network(name: str, t: Array, radius: float, rng: np.random.Generator, left_out: tuple[int, ...] = ()) -> PoseGraph:
    """Both directed edges between poses at most `radius` apart but a pair left out, each with noise of its own."""
    near: NDArray[np.bool_] = np.linalg.norm(t[:, None] - t[None], axis=2) <= radius + _SLACK
    np.fill_diagonal(near, False)
    if left_out:
        near[left_out] = near[left_out[::-1]] = False
    i, j = np.nonzero(near)
    truth = Poses(random_rotations(len(t), 3, rng), t)
    return observe(name, truth, i, j, NoiseModel(), NETWORK_KAPPA, NETWORK_TAU, rng)


def _equal_area_points(count: int) -> Array:
    """About `count` unit vectors, (n, 3), on circles of latitude, each with about the same area (Deserno 2004)."""
    area = 4 * np.pi / count
    num_circles = round(np.pi / np.sqrt(area))
    points = []
    for theta in np.pi * (np.arange(num_circles) + 0.5) / num_circles:
        on_circle = round(2 * np.pi * np.sin(theta) * np.pi / num_circles / area)
        phi = 2 * np.pi * np.arange(on_circle) / on_circle
        latitude = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi
        points.append(np.column_stack(latitude))
    return np.concatenate(points)
