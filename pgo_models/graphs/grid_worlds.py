"""A multi-robot grid world of any size, in the plane or in space.

Robots walk on a lattice, as in the streets of Manhattan, and close loops where they meet.
"""

import math

import numpy as np
import scipy  # and scipy.spatial when it is used
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, as_generator, exp_map
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.graphs.scenes import (
    MILD_NOISE,
    NoiseModel,
    check_dimension,
    observe,
    sorted_pairs,
)

# Sets the size of the world: enough meetings to close loops, and room to walk.
_POSES_PER_CELL = 2.0
_STRAIGHT = 0.6  # probability of going straight on where nothing is in the way
_REACH = 1.1  # metres: poses in the same cell or in cells side by side see each other


def grid_world(
    num_robots: int,
    poses_per_robot: int,
    rng: np.random.Generator | int,
    *,
    d: int = 3,
    noise: NoiseModel = MILD_NOISE,
    loop_closure_probability: float = 0.1,
) -> PoseGraph:
    """Generate the pose graph of robots that walk on a lattice and close loops where they meet.

    A robot starts in a cell of 1 m and with a heading of its own. Every step turns it by 0 or 90
    degrees and moves it one cell along its x axis; walls keep it in a box with about two poses a
    cell. Edges are, in this order, odometry between consecutive poses, loop closures, and edges
    that connect the graph. A loop closure joins two poses in one cell or in cells side by side, of
    one robot or of two. Poses are numbered robot by robot.

    The graph is connected by construction: odometry connects a robot's own poses, and where
    closures leave groups of robots apart, the smallest group gets an edge to the rest between the
    two poses that come closest, until there is one group.

    It has owners, estimate and truth.

    Parameters
    ----------
    num_robots : int
        Number of robots, at least 1.
    poses_per_robot : int
        Number of poses of each, at least 2.
    rng : numpy.random.Generator or int
        Source of the walks, the closures and the noise.
    d : int
        Dimension of space: 2 or 3.
    noise : NoiseModel
        Noise of the measurements and of the initial guess. The precisions are `noise.tau` and
        `noise.kappa(d)`.
    loop_closure_probability : float
        Probability that two poses which see each other are measured.

    Examples
    --------
    >>> grid_world(2, 10, np.random.default_rng(0), d=2).is_connected
    True
    """
    rng = as_generator(rng)
    if num_robots < 1:
        raise SettingError(f"num_robots must be at least 1, got {num_robots}")
    if poses_per_robot < 2:
        raise SettingError(f"poses_per_robot must be at least 2, got {poses_per_robot}")
    check_dimension(d)
    if not 0 <= loop_closure_probability <= 1:
        raise SettingError(
            f"loop_closure_probability must be between 0 and 1, got {loop_closure_probability}"
        )
    truth = _walks(num_robots, poses_per_robot, d, rng)
    robot = np.repeat(np.arange(num_robots), poses_per_robot)
    step = np.arange(len(robot)) % poses_per_robot
    not_first = np.flatnonzero(step)
    odometry = np.column_stack([not_first - 1, not_first])
    closures = _loop_closures(truth.t, robot, loop_closure_probability, rng)
    meetings = _meetings(truth.t, robot, closures)
    edges = np.concatenate([odometry, closures, meetings])
    i, j = edges.T
    kappa = noise.kappa(d)
    return observe("grid_world", truth, i, j, noise, kappa, noise.tau, rng, robot=robot)


def _walks(num_robots: int, num_steps: int, d: int, rng: np.random.Generator) -> Poses:
    """Truth of all robots, robot by robot; all take a step at a time."""
    num_cells = num_robots * num_steps / _POSES_PER_CELL
    exact_side = num_cells ** (1 / d)
    side = max(2, math.ceil(exact_side))
    turns = _quarter_turns(d)
    num_turns = len(turns) - 1
    probability_of_turn = (1 - _STRAIGHT) / num_turns
    probability = np.array([_STRAIGHT] + [probability_of_turn] * num_turns)
    robots = np.arange(num_robots)
    R = np.empty((num_steps, num_robots, d, d))
    cell = np.empty((num_steps, num_robots, d))
    R[0] = np.eye(d)
    for _ in range(3):  # three turns lead to every heading
        drawn = rng.integers(0, len(turns), num_robots)
        R[0] = R[0] @ turns[drawn]
    cell[0] = rng.integers(0, side, (num_robots, d))
    for k in range(1, num_steps):
        options = R[k - 1][:, None] @ turns
        x_axes = options[..., 0]
        next_cells = cell[k - 1][:, None] + x_axes
        is_within = (next_cells >= 0) & (next_cells <= side - 1)
        is_inside = is_within.all(axis=2)
        # A draw with these probabilities among the options inside: the smallest of exponential
        # variables whose rates are the probabilities.
        wait = rng.exponential(size=is_inside.shape) / probability
        wait_inside = np.where(is_inside, wait, np.inf)
        choice = np.argmin(wait_inside, axis=1)
        R[k] = options[robots, choice]
        cell[k] = next_cells[robots, choice]
    R_by_robot = R.swapaxes(0, 1).reshape(-1, d, d)
    t_by_robot = cell.swapaxes(0, 1).reshape(-1, d)
    return Poses(R_by_robot, t_by_robot)


def _quarter_turns(d: int) -> Array:
    """Rotations of a step, (3 or 5, d, d): none, left and right, and in space up and down."""
    if d == 2:
        axes = np.array([[0], [1], [-1]])
    else:
        axes = np.array([[0, 0, 0], [0, 0, 1], [0, 0, -1], [0, 1, 0], [0, -1, 0]])
    return np.rint(exp_map(np.pi / 2 * axes))


def _loop_closures(
    t: Array, robot: IntArray, probability: float, rng: np.random.Generator
) -> IntArray:
    """Pairs, (k, 2), of poses that see each other and are measured, without odometry."""
    pairs_in_reach = scipy.spatial.KDTree(t).query_pairs(_REACH, output_type="ndarray")
    near = sorted_pairs(pairs_in_reach.astype(np.int64))
    i, j = near.T
    is_same_robot = robot[i] == robot[j]
    is_odometry = (j == i + 1) & is_same_robot
    pairs = near[~is_odometry]
    is_measured = rng.random(len(pairs)) < probability
    return np.asarray(pairs[is_measured])


def _meetings(t: Array, robot: IntArray, closures: IntArray) -> IntArray:
    """Edges (k, 2) that join the groups of robots which the closures leave apart."""
    num_robots = int(robot[-1]) + 1
    robots_i, robots_j = robot[closures].T
    ones = np.ones(len(closures))
    met = coo_array((ones, (robots_i, robots_j)), shape=(num_robots, num_robots))
    num_groups, labels = connected_components(met, directed=False)
    group: IntArray = np.asarray(labels, dtype=np.int64)
    added = np.zeros((0, 2), dtype=np.int64)
    while num_groups > 1:
        sizes = np.bincount(group)
        sizes_of_groups = np.where(sizes > 0, sizes, num_robots + 1)  # a joined group has size 0
        smallest = int(np.argmin(sizes_of_groups))
        group_of_pose = group[robot]
        inside = np.flatnonzero(group_of_pose == smallest)
        outside = np.flatnonzero(group_of_pose != smallest)
        tree = scipy.spatial.KDTree(t[outside])
        distance, nearest = tree.query(t[inside])
        closest = int(np.argmin(distance))
        pose = int(inside[closest])
        other = int(outside[np.asarray(nearest)[closest]])
        pair = sorted((pose, other))
        added = np.concatenate([added, [pair]])
        group[group == smallest] = group[robot[other]]
        num_groups -= 1
    return added
