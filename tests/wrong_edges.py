"""Graphs with wrong loop closures, for tests of robust estimation."""

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import BoolArray, random_rotations
from pgo_models.graphs.pose_graph import PoseGraph
from solvers.robust.consistency import odometry


def spoiled(graph: PoseGraph, share: float, kind: str, seed: int) -> tuple[PoseGraph, BoolArray]:
    """The graph with wrong loop closures, `share` of all, and which edges they are.

    random: any two poses and any motion; aliased: runs of 5 that agree with each other.
    """
    rng, loops = np.random.default_rng(seed), np.flatnonzero(~odometry(graph))
    count, run = round(share / (1 - share) * len(loops)), 1 if kind == "random" else 5
    pairs, n = [], graph.num_poses
    while len(pairs) < count:
        a, b = rng.integers(0, n - run, 2)
        if abs(a - b) > 10 + run:
            pairs += [(a + k, b + k, len(pairs) // run) for k in range(run)]
    i, j, group = np.array(pairs[:count]).T
    reach = 3.0 * np.abs(graph.t_ij).max()
    R, t = random_rotations(count, graph.d, rng), rng.uniform(-reach, reach, (count, graph.d))
    like = rng.choice(loops, count)
    more = graph.with_edges(i, j, Poses(R[group], t[group]), graph.kappa[like], graph.tau[like])
    return more, np.arange(more.num_edges) >= graph.num_edges
