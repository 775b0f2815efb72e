"""Small problems, hostile poses and published optima that several test files share."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

from pgo_models import (
    NoiseModel,
    PartitionMethod,
    PGOProblem,
    PoseGraph,
    Poses,
    Weighting,
    chordal_start,
    exp_map,
    random_geometric,
    random_rotations,
)
from pgo_models.certificates.rounding_errors import objective_rounding
from pgo_models.geometry.rotations import Array, tangent_dimension
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.scenes import MILD_NOISE, observe
from solvers import polish
from solvers.studies.tightness import noisy_lattice

EPS = float(np.finfo(float).eps)
SEEDS = st.integers(0, 2**32 - 1)
SIZES = st.integers(2, 12)
DIMENSIONS = st.sampled_from([2, 3])
LOUD_NOISE = NoiseModel(translation_std=0.3, rotation_std=0.3)

REFERENCE = json.loads((Path(__file__).parent.parent / "data" / "reference.json").read_text())
OPTIMUM: dict[str, float] = {
    k: v for k, v in REFERENCE["certified_optimum"].items() if k != "source"
}


# All costs: `Weighting.OWN` stands for one of them.
COSTS = (Weighting.ISOTROPIC, Weighting.INFORMATION, Weighting.ROTATIONS)
# Costs that translations have a part in, for graphs with landmarks or priors of positions.
COSTS_OF_POSES = (Weighting.ISOTROPIC, Weighting.INFORMATION)


def optimum_tolerance(name: str) -> float:
    """1e-7 of the published optimum, or half a unit of the ninth decimal, the last of FRH's."""
    return max(1e-7 * OPTIMUM[name], 0.5e-9)


def varied_graph(
    seed: int, n: int, d: int, noise: NoiseModel = MILD_NOISE, weights: float = 1.0
) -> PoseGraph:
    """Random geometric graph, some edges reversed, some repeated, with log-normal factors on kappa
    and tau.
    """
    rng = np.random.default_rng(seed)
    graph = random_geometric(n, rng, d=d, mean_degree=rng.uniform(1.0, 6.0), noise=noise)
    edges = np.concatenate(
        [np.arange(graph.num_edges), rng.integers(0, graph.num_edges, graph.num_edges // 4)]
    )
    back = rng.random(len(edges)) < 0.5
    i = graph.i[edges]
    j = graph.j[edges]
    R_ij = graph.R_ij[edges]
    t_ij = graph.t_ij[edges]
    i[back], j[back] = j[back], i[back]
    R_ij[back] = np.swapaxes(R_ij[back], 1, 2)
    t_ij[back] = -np.einsum("mab,mb->ma", R_ij[back], t_ij[back])
    return replace(
        graph,
        i=i,
        j=j,
        R_ij=R_ij,
        t_ij=t_ij,
        kappa=graph.kappa[edges] * np.exp(weights * rng.standard_normal(len(edges))),
        tau=graph.tau[edges] * np.exp(weights * rng.standard_normal(len(edges))),
    )


def informed(
    seed: int, n: int, d: int, coupled: bool, spread: float = 1.0, noise: NoiseModel = MILD_NOISE
) -> PoseGraph:
    """A graph with random information matrices, of conditions up to about exp(4 spread)."""
    graph = varied_graph(seed, n, d, noise)
    rng = np.random.default_rng(seed)
    k = d + tangent_dimension(d)
    axes = np.linalg.qr(rng.standard_normal((graph.num_edges, k, k)))[0]
    values = np.exp(spread * rng.uniform(-2.0, 2.0, (graph.num_edges, 1, k)))
    information = (axes * values) @ np.swapaxes(axes, 1, 2)
    information = 0.5 * (information + np.swapaxes(information, 1, 2))
    if not coupled:
        information[:, :d, d:] = information[:, d:, :d] = 0.0
    return replace(graph, information=information)


def planar_lattice(seed: int, side: int, rotation_std: float, kappa: float = 1.0) -> PoseGraph:
    """A lattice whose kappa, far below tau, leaves the relaxation over the rows of X loose."""
    return noisy_lattice(side, rotation_std, np.random.default_rng(seed), d=2, kappa=kappa)


def varied_problem(seed: int, n: int, d: int, noise: NoiseModel = MILD_NOISE) -> PGOProblem:
    """Problem of `varied_graph`."""
    return PGOProblem(varied_graph(seed, n, d, noise))


def exact_graph(seed: int, n: int, d: int) -> PoseGraph:
    """Connected graph of edges in both directions that measure the true relative poses."""
    pattern = varied_graph(seed, n, d)
    assert pattern.truth is not None
    silence = NoiseModel(1e-300, 1e-300)
    rng = np.random.default_rng(seed)
    graph = observe("exact", pattern.truth, pattern.i, pattern.j, silence, 1.0, 1.0, rng)
    return replace(graph, kappa=pattern.kappa, tau=pattern.tau)


def spread_graph(seed: int, n: int, d: int) -> PoseGraph:
    """A noisy random geometric graph whose weights are up to twenty orders of magnitude apart."""
    rng = np.random.default_rng(seed)
    graph = random_geometric(n, rng, d=d, mean_degree=2.0, noise=NoiseModel(0.1, 0.5))
    kappa, tau = (10.0 ** rng.uniform(-8, 12, graph.num_edges) for _ in range(2))
    return replace(graph, kappa=kappa, tau=tau)


def wound_ring(n: int, d: int) -> tuple[PGOProblem, Poses]:
    """A ring of unrotated poses, and a start whose headings wind around once: a local minimum of
    its own.
    """
    angle = 2 * np.pi * np.arange(n) / n
    t = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])[:, :d]
    truth = Poses(np.broadcast_to(np.eye(d), (n, d, d)), t)
    i = np.arange(n)
    j = (np.arange(n) + 1) % n
    graph = observe(
        "ring", truth, i, j, NoiseModel(0.01, 0.01), 100.0, 1.0, np.random.default_rng(0)
    )
    w = angle[:, None] if d == 2 else np.column_stack([np.zeros((n, 2)), angle])
    return PGOProblem(graph), Poses(exp_map(w), t)


def still_ring(n: int, d: int) -> PoseGraph:
    """A ring of poses measured in one place, unturned, with kappa 0.7 and tau 1."""
    i = np.arange(n)
    return PoseGraph(
        n,
        i,
        (i + 1) % n,
        np.broadcast_to(np.eye(d), (n, d, d)),
        np.zeros((n, d)),
        np.full(n, 0.7),
        np.ones(n),
    )


def turned_away(problem: PGOProblem, poses: Poses, size: float, seed: int) -> Poses:
    """The poses, every rotation turned at random by about so many radians, with their best
    translations.
    """
    w = size * np.random.default_rng(seed).standard_normal(
        (problem.num_poses, tangent_dimension(problem.d))
    )
    return problem.with_best_translations(poses.R @ exp_map(w))


def random_poses(n: int, d: int, seed: int, spread: float = 1.0) -> Poses:
    """Uniform rotations, and normal translations with standard deviation `spread`."""
    rng = np.random.default_rng([seed, 1])
    return Poses(random_rotations(n, d, rng), spread * rng.standard_normal((n, d)))


def rounding_of_objective(problem: PGOProblem, X: Array) -> float:
    """What tr(X^T M X) can lose to rounding."""
    return 16 * EPS * float(abs(problem.M).sum(axis=0).max()) * float(np.sum(X**2))


def median_slope(
    error: Callable[[Array, Array, float], float],
    moves: list[tuple[Array, Array]],
    exponents: tuple[float, float],
) -> float:
    """Median over moves (w, v) of the order in h of error(w, v, h), h from 10^first to 10^last."""
    h = np.logspace(*exponents, 5)
    return float(
        np.median(
            [np.polyfit(np.log(h), np.log([error(w, v, x) for x in h]), 1)[0] for w, v in moves]
        )
    )


def best_known(problem: PGOProblem, seed: int = 0) -> float:
    """An upper bound on the global optimum, rounding included: the best of what several starts
    polish to.
    """
    n = problem.num_poses
    d = problem.d
    starts = [chordal_start(problem), *(random_poses(n, d, seed + k) for k in range(3))]
    if problem.graph.truth is not None:
        starts.append(problem.graph.truth)
    return min(rounded_up(problem, polish(problem, start)) for start in starts)


def restarts(problem: PGOProblem, count: int, seed: int) -> float:
    """Lowest F that polishing from random rotations finds."""
    starts = (random_poses(problem.num_poses, problem.d, seed + k) for k in range(count))
    return min(
        problem.objective(polish(problem, problem.with_best_translations(s.R))) for s in starts
    )


def rounded_up(problem: PGOProblem, poses: Poses) -> float:
    """F of poses, and what it can be off by."""
    return problem.objective(poses) + objective_rounding(problem, poses).error


def assert_says(error: Exception, opening: str, words: list[str]) -> None:
    """One line that opens with where the fault is, and has these words."""
    message = str(error)
    assert message.startswith(opening)
    assert "\n" not in message
    for word in words:
        assert word in message


def translation_scale(problem: PGOProblem) -> Array:
    """Diagonal of M over the translation row of every pose, (n,)."""
    return np.asarray(problem.M.data[problem.diagonal_positions[: problem.num_poses]])


def polar_factor(A: Array, *, rotation: bool = False) -> Array:
    """U V^T of the SVD, with its determinant made 1 for rotations."""
    U, _, Vt = np.linalg.svd(A, full_matrices=False)
    if rotation and np.linalg.det(U @ Vt) < 0:
        U[:, -1] *= -1.0
    return np.asarray(U @ Vt)


def chain_with_closures(seed: int, n: int, d: int, num_closures: int) -> PoseGraph:
    """A chain whose edges point either way, with weights of all sizes, and closures at random."""
    rng = np.random.default_rng(seed)
    i = np.arange(n - 1)
    j = i + 1
    is_turned = rng.random(n - 1) < 0.5
    i, j = np.where(is_turned, j, i), np.where(is_turned, i, j)
    ends = np.array([rng.choice(n, 2, replace=False) for _ in range(num_closures)], dtype=int)
    ends = ends.reshape(-1, 2)
    i = np.concatenate([i, ends[:, 0]])
    j = np.concatenate([j, ends[:, 1]])
    m = len(i)
    spread = rng.choice([0.1, 1.0, 3.0])
    R = exp_map(spread * rng.standard_normal((m, 2 * d - 3)))
    t = rng.choice([0.1, 1.0, 10.0]) * rng.standard_normal((m, d))
    kappa, tau = np.exp(rng.uniform(-3.0, 6.0, (2, m)))
    return PoseGraph(n, i, j, R, t, kappa, tau)


def scattered(graph: PoseGraph, num_robots: int, seed: int) -> Partition:
    """Poses to robots at random, so that a robot's poses fall into pieces."""
    num_free = graph.num_poses - num_robots
    drawn_robots = np.random.default_rng(seed).integers(0, num_robots, num_free)
    robot = np.concatenate([np.arange(num_robots), drawn_robots])
    return Partition(np.random.default_rng(seed).permutation(robot), PartitionMethod.GIVEN)
