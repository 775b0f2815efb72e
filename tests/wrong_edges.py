"""Graphs with wrong loop closures, for tests of robust estimation."""

from dataclasses import replace

import numpy as np

from pgo_models import NoiseModel, PoseGraph, Poses, exp_map, grid_world, random_rotations
from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.scenes import observe
from solvers.robust.known import odometry


def spoiled(graph: PoseGraph, share: float, kind: str, seed: int) -> tuple[PoseGraph, BoolArray]:
    """The graph with wrong loop closures, `share` of all, and which edges these are.

    Of the kind "random" they join any two poses by any motion; those of the kind "aliased" are runs
    of five that agree with each other.
    """
    rng = np.random.default_rng(seed)
    closures = np.flatnonzero(~odometry(graph))
    count = round(share / (1 - share) * len(closures))
    run = 1 if kind == "random" else 5
    pairs = []
    n = graph.num_poses
    while len(pairs) < count:
        a, b = rng.integers(0, n - run, 2)
        if abs(a - b) > 10 + run:
            group = len(pairs) // run
            pairs += [(a + k, b + k, group) for k in range(run)]
    i, j, group = np.array(pairs[:count]).T
    reach = 3.0 * np.abs(graph.t_ij).max()
    R = random_rotations(count, graph.d, rng)
    t = rng.uniform(-reach, reach, (count, graph.d))
    motions = Poses(R[group], t[group])
    like = rng.choice(closures, count)
    kappa = graph.kappa[like]
    tau = graph.tau[like]
    spoiled_graph = graph.with_edges(i, j, motions, kappa, tau)
    is_wrong = np.arange(spoiled_graph.num_edges) >= graph.num_edges
    return spoiled_graph, is_wrong


def noisy_sphere(num_poses: int, per_turn: int, noise: NoiseModel, seed: int) -> PoseGraph:
    """Poses a metre apart along a spiral on a sphere, each joined to three of the turn before.

    Errors are as large as the matrices claim. Where they are large, odometry is of no use as a
    start.
    """
    rng = np.random.default_rng(seed)
    num_turns = num_poses / per_turn
    share = (np.arange(num_poses) + 0.5) / num_poses
    polar = np.pi * share
    azimuth = 2.0 * np.pi * num_turns * share
    radius = per_turn / (2.0 * np.pi)
    ring = np.sin(polar)
    x = ring * np.cos(azimuth)
    y = ring * np.sin(azimuth)
    z = np.cos(polar)
    t = radius * np.stack([x, y, z], axis=1)
    pairs = []
    for step in (1, per_turn - 1, per_turn, per_turn + 1):
        later = np.arange(step, num_poses)
        pairs.append(np.column_stack([later - step, later]))
    i, j = np.concatenate(pairs).T
    truth = Poses(random_rotations(num_poses, 3, rng), t)
    return observe("noisy_sphere", truth, i, j, noise, noise.kappa(3), noise.tau, rng)


def ring_road(seed: int, num_poses: int = 500, per_turn: int = 320) -> PoseGraph:
    """A road once and a half around: where it comes along again, closures come in runs.

    Odometry has drifted by metres then, and closures measure centimetres.
    """
    rng = np.random.default_rng(seed)
    angle = 2.0 * np.pi * np.arange(num_poses) / per_turn
    radius = 50.0 * (1.0 + 0.15 * np.sin(3.0 * angle))
    t = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    along = np.gradient(t, axis=0)
    heading = np.unwrap(np.arctan2(along[:, 1], along[:, 0]))
    later = np.arange(per_turn, num_poses)
    later = later[(later - per_turn) % 60 < 35]
    i = np.concatenate([np.arange(num_poses - 1), later - per_turn])
    j = np.concatenate([np.arange(1, num_poses), later])
    truth = Poses(exp_map(heading[:, None]), t)
    noise = NoiseModel(0.03, 0.01)
    return observe("ring_road", truth, i, j, noise, noise.kappa(2), noise.tau, rng)


def joined_by(num_between: int) -> PoseGraph:
    """Two robots with closures of their own, and so many between them."""
    graph = grid_world(2, 60, np.random.default_rng(0), d=2)
    between = np.flatnonzero(graph.robots[graph.i] != graph.robots[graph.j])
    left_out = np.zeros(graph.num_edges, dtype=bool)
    left_out[between[num_between:]] = True
    return graph.without_edges(left_out)


def slipped_loop(seed: int) -> PoseGraph:
    """A loop of 8 to 19 poses and the beginning of a second one, with a slip of the odometry.

    In half of the graphs an edge that may be a closure has slipped, too.
    """
    rng = np.random.default_rng(seed)
    per_turn = int(rng.integers(5, 11))
    n = int(rng.integers(per_turn + 3, 2 * per_turn))
    angle = 2.0 * np.pi * np.arange(n) / per_turn
    c, s = np.cos(angle), np.sin(angle)
    R = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
    truth = Poses(R, np.stack([s, 1.0 - c], axis=1))
    k = np.arange(n)
    i = np.concatenate([k[:-1], k[: n - per_turn]])
    j = np.concatenate([k[1:], k[per_turn:]])
    noise = NoiseModel(0.01, 0.05)
    graph = observe("slipped_loop", truth, i, j, noise, noise.kappa(2), noise.tau, rng)
    t_ij = graph.t_ij.copy()
    t_ij[rng.integers(0, n - 1)] += rng.normal(0.0, 0.5, 2)
    if rng.random() < 0.5:
        t_ij[rng.integers(n - 1, graph.num_edges)] += rng.normal(0.0, 0.5, 2)
    return replace(graph, t_ij=t_ij)


def false_fixes(seed: int) -> tuple[PoseGraph, BoolArray]:
    """A small world with five to ten fixes, a minority of them false, and which edges are wrong.

    The false ones are shifted by 5 to 100 m: in two worlds of three by the same motion, else each
    by its own. Fixes are good to half a metre; a step of odometry is to 5 cm and 0.01 rad or, in
    every other world, to 1 cm and 0.05 rad.
    """
    rng = np.random.default_rng(seed)
    d = 3 if seed % 4 == 3 else 2
    n = int(rng.integers(10, 60))
    noise = NoiseModel(0.01, 0.05) if seed % 2 else NoiseModel(0.05, 0.01)
    graph = grid_world(1, n, rng, d=d, loop_closure_probability=0.1, noise=noise)
    # An error of the angle w adds 2 kappa w^2 to F: so the precisions are those of the errors.
    graph = replace(graph, kappa=np.full(graph.num_edges, 0.5 / noise.rotation_std**2))
    assert graph.truth is not None
    num_fixes = int(rng.integers(5, 11))
    num_false = int(rng.integers(1, (num_fixes - 1) // 2 + 1))
    poses = rng.choice(n, num_fixes, replace=False)
    shifts = rng.standard_normal((num_false, d))
    if rng.random() < 2.0 / 3.0:
        shifts[:] = shifts[0]
    shifts *= np.exp(rng.uniform(np.log(5.0), np.log(100.0))) / np.linalg.norm(shifts[0])
    positions = graph.truth.t[poses] + rng.normal(0.0, 0.5, (num_fixes, d))
    positions[:num_false] += shifts
    spoiled_graph = graph.with_position_prior(poses, positions, 4.0)
    is_wrong = np.zeros(spoiled_graph.num_edges, dtype=bool)
    is_wrong[graph.num_edges :][:num_false] = True
    return spoiled_graph, is_wrong
