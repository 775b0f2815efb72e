"""Other starts of Newton, for a cost with several minima: cheap beside a relaxation.

They are the estimate of the file, poses along a spanning tree, those of the chordal relaxation or,
where the cost is not F, the optimum of F, and on small graphs random poses.
Half of the random starts have random rotations. The other half are the best poses so far, with all
poses from a random one on turned by the same rotation.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations
from pgo_models.problem.initialization import chordal_start, spanning_tree_start
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.riemannian.polish import polish

MOST_RANDOM_POSES = 100  # of a graph that is started at random
NUM_RANDOM = 12
TRIAL_STEPS = 25  # factorisations for a start
BETTER = 1e-9  # share of the cost by which a start has to be better


@dataclass(frozen=True, eq=False)
class FoundStart:
    """Poses that Newton leads to from one of the starts."""

    name: str
    poses: Poses
    objective: float
    num_tried: int


def starts_of_graph(problem: PGOProblem, best: Poses) -> Iterator[tuple[str, Poses]]:
    """Starts that follow from the graph, with their names."""
    graph = problem.graph
    if graph.initial is not None:
        yield "file", graph.near_zero(graph.initial)
    yield "tree", spanning_tree_start(graph)
    if problem.is_quadratic:
        yield "chordal", chordal_start(problem)
    else:
        isotropic = PGOProblem(graph, problem.backend, Weighting.ISOTROPIC)
        yield "optimum of F", polish(isotropic, chordal_start(isotropic))


def random_starts(problem: PGOProblem, best: Poses) -> Iterator[tuple[str, Poses]]:
    """Random starts of a small graph, with their names."""
    if problem.num_poses > MOST_RANDOM_POSES:
        return
    rng = np.random.default_rng(0)
    for k in range(NUM_RANDOM):
        if k % 2:
            R = _turned_from_some_pose_on(best.R, rng)
        else:
            R = _random_rotations(problem.num_poses, problem.d, rng)
        yield str(k + 1), problem.convex_part.with_best_translations(R)


# In the order in which they are tried, while the answer is open, with their names.
KINDS_OF_STARTS = (("other starts", starts_of_graph), ("random starts", random_starts))


def best_of_starts(
    problem: PGOProblem,
    starts: Iterator[tuple[str, Poses]],
    best: Poses,
    objective: float,
    deadline: float,
) -> FoundStart:
    """The cheapest poses that the starts lead to, or the best ones where none are cheaper.

    A cost below zero is zero but for rounding. No start begins after the deadline, by
    `time.perf_counter`.
    """
    cheapest = FoundStart("none is better", best, objective, 0)
    for name, start in starts:
        if time.perf_counter() > deadline:
            break
        poses = polish(problem, start, TRIAL_STEPS)
        cost = problem.objective(poses)
        num_tried = cheapest.num_tried + 1
        if max(cost, 0.0) < cheapest.objective * (1.0 - BETTER):
            cheapest = FoundStart(name, poses, cost, num_tried)
        else:
            cheapest = replace(cheapest, num_tried=num_tried)
    return cheapest


def _random_rotations(num_poses: int, d: int, rng: np.random.Generator) -> Array:
    """Rotations, (n, d, d), each uniformly distributed."""
    return project_to_rotations(rng.normal(size=(num_poses, d, d)))


def _turned_from_some_pose_on(R: Array, rng: np.random.Generator) -> Array:
    """Rotations, (n, d, d), of which those from a random pose on are turned alike."""
    turned = R.copy()
    first = int(rng.integers(1, len(R)))
    turned[first:] = _random_rotations(1, R.shape[1], rng) @ R[first:]
    return turned
