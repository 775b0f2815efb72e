"""A multi-robot grid world of any size, in the plane or in space: Manhattan walks on a lattice with loop closures."""

import math

import numpy as np
import scipy  # and scipy.spatial when it is used
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, exp_map
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.graphs.scenes import MILD_NOISE, NoiseModel, check_dimension, observe

_POSES_PER_CELL = 2.0  # sets the size of the world: enough meetings to close loops, and room to walk
_STRAIGHT = 0.6  # probability of going straight on where nothing is in the way
_REACH = 1.1  # metres: poses in the same cell or in cells side by side see each other


def grid_world(
    num_robots: int,
    poses_per_robot: int,
    rng: np.random.Generator,
    *,
    d: int = 3,
    noise: NoiseModel = MILD_NOISE,
    loop_closure_probability: float = 0.1,
) -> PoseGraph:
    """Pose graph of robots that walk on one lattice of 1 m cells and see each other and places they were at.

    A robot starts in a cell and with a heading of its own, and every step turns it by 0 or 90 degrees and moves it
    one cell along its x axis; walls keep it in a box with about two poses a cell. Edges are, in this order, odometry
    between consecutive poses, and loop closures: two poses in one cell or in cells side by side, of one robot or of
    two, are measured with the given probability. Poses are numbered robot by robot.

    Connected by construction: odometry connects a robot's own poses, and where closures leave groups of robots apart,
    the smallest group gets an edge to the rest between the two poses that come closest, until there is one group.

    Precisions of all edges are `noise.tau` and `noise.kappa(d)`; the initial guess is the truth with this noise.

    A SettingError for a number of robots below 1, fewer than 2 poses a robot, d other than 2 and 3, or no probability.

    Examples
    --------
    >>> grid_world(2, 10, np.random.default_rng(0), d=2).is_connected
    True
    """
    if num_robots < 1:
        raise SettingError(f"num_robots must be at least 1, got {num_robots}")
    if poses_per_robot < 2:
        raise SettingError(f"poses_per_robot must be at least 2, got {poses_per_robot}")
    check_dimension(d)
    if not 0 <= loop_closure_probability <= 1:
        raise SettingError(f"loop_closure_probability must be between 0 and 1, got {loop_closure_probability}")
    truth = _walks(num_robots, poses_per_robot, d, rng)
    robot = np.repeat(np.arange(num_robots), poses_per_robot)
    later = np.flatnonzero(np.arange(len(robot)) % poses_per_robot)
    odometry = np.column_stack([later - 1, later])
    closures = _loop_closures(truth.t, robot, loop_closure_probability, rng)
    edges = np.concatenate([odometry, closures, _meetings(truth.t, robot, closures)])
    return observe("grid_world", truth, edges[:, 0], edges[:, 1], noise, noise.kappa(d), noise.tau, rng, robot=robot)


def _walks(num_robots: int, num_steps: int, d: int, rng: np.random.Generator) -> Poses:
    """Truth of all robots, robot by robot; all take a step at a time."""
    side = max(2, math.ceil((num_robots * num_steps / _POSES_PER_CELL) ** (1 / d)))
    turns = _quarter_turns(d)
    likely = np.array([_STRAIGHT] + [(1 - _STRAIGHT) / (len(turns) - 1)] * (len(turns) - 1))
    everyone = np.arange(num_robots)
    R, cell = np.empty((num_steps, num_robots, d, d)), np.empty((num_steps, num_robots, d))
    R[0] = np.eye(d)
    for _ in range(3):  # after three turns every heading can be had
        R[0] = R[0] @ turns[rng.integers(0, len(turns), num_robots)]
    cell[0] = rng.integers(0, side, (num_robots, d))
    for k in range(1, num_steps):
        options = R[k - 1][:, None] @ turns
        ahead = cell[k - 1][:, None] + options[..., 0]
        inside = ((ahead >= 0) & (ahead <= side - 1)).all(axis=2)
        # Sampling with weights: the smallest of exponential variables with these rates.
        wait = rng.exponential(size=inside.shape) / likely
        choice = np.argmin(np.where(inside, wait, np.inf), axis=1)
        R[k], cell[k] = options[everyone, choice], ahead[everyone, choice]
    return Poses(R.swapaxes(0, 1).reshape(-1, d, d), cell.swapaxes(0, 1).reshape(-1, d))


def _quarter_turns(d: int) -> Array:
    """Going straight on, then the turns by 90 degrees, left and right, and in space up and down: (3 or 5, d, d)."""
    axes = [[0], [1], [-1]] if d == 2 else [[0, 0, 0], [0, 0, 1], [0, 0, -1], [0, 1, 0], [0, -1, 0]]
    return np.rint(exp_map(np.pi / 2 * np.array(axes)))


def _loop_closures(t: Array, robot: IntArray, probability: float, rng: np.random.Generator) -> IntArray:
    pairs = scipy.spatial.KDTree(t).query_pairs(_REACH, output_type="ndarray").astype(np.int64)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    consecutive = (pairs[:, 1] == pairs[:, 0] + 1) & (robot[pairs[:, 0]] == robot[pairs[:, 1]])
    pairs = pairs[~consecutive]
    return np.asarray(pairs[rng.random(len(pairs)) < probability])


def _meetings(t: Array, robot: IntArray, closures: IntArray) -> IntArray:
    """Edges (k, 2) that join the groups of robots which the closures leave apart."""
    num_robots = int(robot[-1]) + 1
    met = coo_array((np.ones(len(closures)), (robot[closures[:, 0]], robot[closures[:, 1]])), (num_robots, num_robots))
    count, group = connected_components(met, directed=False)
    added = np.zeros((0, 2), dtype=np.int64)
    while count > 1:
        sizes = np.bincount(group)
        smallest = int(np.argmin(np.where(sizes > 0, sizes, num_robots + 1)))
        mine, rest = np.flatnonzero(group[robot] == smallest), np.flatnonzero(group[robot] != smallest)
        distance, nearest = scipy.spatial.KDTree(t[rest]).query(t[mine])
        at = int(np.argmin(distance))
        edge = sorted((int(mine[at]), int(rest[nearest[at]])))
        added = np.concatenate([added, [edge]])
        group[group == smallest] = group[robot[rest[nearest[at]]]]
        count -= 1
    return added
