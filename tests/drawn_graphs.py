"""Small graphs of every kind that a file can hold, drawn from a seed and written to a file."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from graphs import LOUD_NOISE, exact_graph, informed, varied_graph

from pgo_models import PoseGraph, Poses, project_to_rotations, random_rotations, write_g2o
from pgo_models.geometry.rotations import Array, tangent_dimension
from pgo_models.graphs.g2o_rows import numbers_of
from solvers import SweptScene
from solvers.studies.tightness import noisy_scene

Draw = Callable[[np.random.Generator], PoseGraph]


def size_and_dimension(rng: np.random.Generator) -> tuple[int, int]:
    return int(rng.integers(2, 9)), int(rng.integers(2, 4))


def seed_of(rng: np.random.Generator) -> int:
    return int(rng.integers(2**31))


def of_matrices(rng: np.random.Generator, information: Callable[[int, int], Array]) -> PoseGraph:
    """A graph with information matrices, `information(m, d)`."""
    n, d = size_and_dimension(rng)
    graph = varied_graph(seed_of(rng), n, d, LOUD_NOISE)
    return replace(graph, information=information(graph.num_edges, d))


def spread_matrices(rng: np.random.Generator, m: int, k: int, decades: float) -> Array:
    """Matrices, (m, k, k), whose eigenvalues are up to so many orders of magnitude apart."""
    axes = np.linalg.qr(rng.standard_normal((m, k, k)))[0]
    values = 10.0 ** (decades * rng.uniform(-0.5, 0.5, (m, 1, k)))
    information = (axes * values) @ axes.mT
    return np.asarray(0.5 * (information + information.mT))


def plain(rng: np.random.Generator) -> PoseGraph:
    """Two precisions an edge."""
    n, d = size_and_dimension(rng)
    return varied_graph(seed_of(rng), n, d)


def loud(rng: np.random.Generator) -> PoseGraph:
    """Large noise."""
    n, d = size_and_dimension(rng)
    return varied_graph(seed_of(rng), n, d, LOUD_NOISE)


def matrices(rng: np.random.Generator) -> PoseGraph:
    """Information matrices, coupled in half of the graphs."""
    n, d = size_and_dimension(rng)
    is_coupled = bool(rng.integers(2))
    return informed(seed_of(rng), n, d, is_coupled, spread=rng.uniform(0.1, 1.0))


def semidefinite(rng: np.random.Generator) -> PoseGraph:
    """Coupled matrices of less than full rank, in doubles: semidefinite but for rounding."""

    def draw(m: int, d: int) -> Array:
        k = d + tangent_dimension(d)
        half = rng.standard_normal((m, k, k - 1))
        information = half @ half.mT
        return np.asarray(0.5 * (information + information.mT))

    return of_matrices(rng, draw)


def stiff(rng: np.random.Generator) -> PoseGraph:
    """Uncoupled matrices with conditions of up to 1e12."""
    decades = rng.uniform(4.0, 12.0)

    def draw(m: int, d: int) -> Array:
        p = tangent_dimension(d)
        information = np.zeros((m, d + p, d + p))
        information[:, :d, :d] = spread_matrices(rng, m, d, decades)
        information[:, d:, d:] = spread_matrices(rng, m, p, min(decades, 4.0))
        return information

    return of_matrices(rng, draw)


def stiff_and_coupled(rng: np.random.Generator) -> PoseGraph:
    """Coupled matrices with conditions of up to 1e9."""
    decades = rng.uniform(2.0, 9.0)
    return of_matrices(rng, lambda m, d: spread_matrices(rng, m, d + tangent_dimension(d), decades))


def priors(rng: np.random.Generator) -> PoseGraph:
    """A few poses with large matrices, coupled, and priors of whole poses."""
    graph = matrices(rng)
    assert graph.truth is not None
    count = int(rng.integers(1, 4))
    chosen = rng.integers(0, graph.num_poses, count)
    turned = random_rotations(count, graph.d, rng)
    R = project_to_rotations(graph.truth.R[chosen] + 0.1 * turned)
    t = graph.truth.t[chosen] + 0.3 * rng.standard_normal((count, graph.d))
    ones = np.ones(count)
    return graph.with_prior(chosen, Poses(R, t), 2.0 * ones, 3.0 * ones)


def positions(rng: np.random.Generator) -> PoseGraph:
    """Positions of a few poses, as of GPS."""
    n, d = size_and_dimension(rng)
    graph = varied_graph(seed_of(rng), n + 3, d)
    assert graph.truth is not None
    chosen = rng.permutation(n + 3)[: d + 1]
    far = 10.0 ** rng.uniform(0.0, 3.0) * rng.standard_normal(d)
    t = graph.truth.t[chosen] + far + 0.3 * rng.standard_normal((d + 1, d))
    return graph.with_position_prior(chosen, t, tau=float(rng.uniform(0.1, 10.0)))


def by_axis(rng: np.random.Generator) -> PoseGraph:
    """Positions that are measured axis by axis, as by GPS without or with a poor height."""
    n = int(rng.integers(6, 12))
    graph = informed(seed_of(rng), n, 3, coupled=bool(rng.integers(2)), spread=0.2)
    truth = graph.truth
    assert truth is not None
    chosen = np.sort(rng.permutation(n)[: int(rng.integers(4, n + 1))])
    noise = rng.uniform(0.05, 0.5)
    t = truth.t[chosen] + noise * rng.standard_normal((len(chosen), 3))
    graph = graph.with_position_prior(chosen, t, tau=noise**-2)
    weights = np.ones(3)
    weights[rng.integers(3)] = rng.choice([0.0, 10.0 ** rng.uniform(-6.0, 1.0)])
    assert graph.information is not None
    information = graph.information.copy()
    information[graph.is_prior, :3, :3] *= np.diag(weights)
    return replace(graph, information=information)


def landmarks(rng: np.random.Generator) -> PoseGraph:
    """Poses that see a few points."""
    graph = matrices(rng)
    truth = graph.truth
    assert truth is not None
    for _ in range(int(rng.integers(1, 4))):
        point = 3.0 * rng.standard_normal(graph.d)
        seen_from = rng.permutation(len(truth.t))[:2]
        offsets = point - truth.t[seen_from]
        positions = np.einsum("nba,nb->na", truth.R[seen_from], offsets)
        noisy = positions + 0.3 * rng.standard_normal(positions.shape)
        graph = graph.with_landmark(seen_from, noisy, tau=float(rng.uniform(0.1, 10.0)))
    return graph


def coupled_points(rng: np.random.Generator) -> PoseGraph:
    """Loud coupled matrices beside landmarks or positions: most bounds are far from the cost."""
    n = int(rng.integers(3, 7))
    d = (2, 2, 3)[int(rng.integers(3))]
    graph = varied_graph(seed_of(rng), n, d, LOUD_NOISE)
    decades = rng.uniform(0.3, 1.0)
    k = d + tangent_dimension(d)
    graph = replace(graph, information=spread_matrices(rng, graph.num_edges, k, decades))
    chosen = rng.permutation(n)[:3]
    points = 3.0 * rng.standard_normal((len(chosen), d))
    tau = float(rng.uniform(0.1, 3.0))
    if rng.integers(2):
        return graph.with_landmark(chosen, points, tau=tau)
    return graph.with_position_prior(chosen, points, tau=tau)


def handed(rng: np.random.Generator) -> PoseGraph:
    """Rotations so noisy that the relaxation is loose without handedness terms."""
    scene = (SweptScene.CIRCLE, SweptScene.GRID)[int(rng.integers(2))]
    degrees = rng.uniform(45.0, 75.0)
    return noisy_scene(scene, np.deg2rad(degrees), rng)


def few_and_coupled(rng: np.random.Generator) -> PoseGraph:
    """Two or three poses in space, coupled matrices with large residuals, and priors."""
    graph = varied_graph(seed_of(rng), int(rng.integers(2, 4)), 3, LOUD_NOISE)
    half = rng.standard_normal((graph.num_edges, 6, 6))
    graph = replace(graph, information=half @ half.mT)
    assert graph.truth is not None
    chosen = rng.integers(0, graph.num_poses, 3)
    R = project_to_rotations(graph.truth.R[chosen] + 0.3 * random_rotations(3, 3, rng))
    t = graph.truth.t[chosen] + rng.standard_normal((3, 3))
    graph = graph.with_prior(chosen, Poses(R, t), np.ones(3), np.ones(3))
    half = rng.standard_normal((graph.num_edges, 6, 6))
    return replace(graph, information=half @ half.mT)


def noise_free(rng: np.random.Generator) -> PoseGraph:
    """Measurements that agree."""
    n, d = size_and_dimension(rng)
    return exact_graph(seed_of(rng), n, d)


def covariances(rng: np.random.Generator) -> PoseGraph:
    """Poses in the plane that see points, with covariances."""
    n = int(rng.integers(3, 9))
    graph = varied_graph(seed_of(rng), n, 2, LOUD_NOISE)
    assert graph.truth is not None
    decades = rng.uniform(0.0, 8.0)
    graph = replace(graph, information=spread_matrices(rng, graph.num_edges, 3, decades))
    seen_from = rng.permutation(n)[:3]
    return graph.with_landmark(seen_from, rng.standard_normal((3, 2)), tau=2.0)


def robot_log(rng: np.random.Generator) -> PoseGraph:
    """Poses with covariances, and priors of a few."""
    n, d = size_and_dimension(rng)
    k = d + tangent_dimension(d)
    graph = varied_graph(seed_of(rng), n, d, LOUD_NOISE)
    assert graph.truth is not None
    chosen = rng.integers(0, n, 2)
    t = graph.truth.t[chosen] + 0.3 * rng.standard_normal((2, d))
    priors = Poses(graph.truth.R[chosen], t)
    graph = graph.with_prior(chosen, priors, np.ones(2), np.ones(2))
    decades = rng.uniform(0.0, 8.0)
    return replace(graph, information=spread_matrices(rng, graph.num_edges, k, decades))


GRAPHS: tuple[Draw, ...] = (
    plain,
    loud,
    matrices,
    semidefinite,
    stiff,
    stiff_and_coupled,
    priors,
    positions,
    by_axis,
    landmarks,
    coupled_points,
    handed,
    few_and_coupled,
    noise_free,
    covariances,
    robot_log,
)


def drawn_file(draw: Draw, seed: int, folder: Path) -> Path:
    """The file of a graph: with covariances where the graph is to have them, else as g2o."""
    graph = draw(np.random.default_rng(seed))
    if draw is robot_log:
        path = folder / "graph.jrl"
        write_robot_log(graph, path)
        return path
    path = folder / "graph.g2o"
    if draw is covariances:
        write_covariances(graph, path)
    else:
        write_g2o(graph, path)
    return path


def write_covariances(graph: PoseGraph, path: Path) -> None:
    """Write a graph in the plane as ODOMETRY and LANDMARK lines, ids of landmarks from 0."""
    information = graph.information
    assert information is not None
    lines = []
    edges = zip(graph.i, graph.j, graph.R_ij, graph.t_ij, information, strict=True)
    for i, j, R, t, matrix in edges:
        if j in graph.landmarks:
            C = np.linalg.inv(matrix[:2, :2])
            numbers = [*t, *C[np.triu_indices(2)]]
            ends = f"LANDMARK {i} {j - graph.landmarks[0]}"
        else:
            C = np.linalg.inv(matrix)
            numbers = [*t, np.arctan2(R[1, 0], R[0, 0]), *C[np.triu_indices(3)]]
            ends = f"ODOMETRY {i} {j}"
        lines.append(f"{ends} {' '.join(repr(float(x)) for x in numbers)}\n")
    path.write_text("".join(lines))


def write_robot_log(graph: PoseGraph, path: Path) -> None:
    """Write a graph as a JSON robot log of one robot, priors included."""
    assert graph.information is not None
    d = graph.d
    k = d + tangent_dimension(d)
    order = [3, 4, 5, 0, 1, 2] if d == 3 else [0, 1, 2]
    rows = numbers_of(graph.R_ij, graph.t_ij)
    measurements = []
    for i, j, numbers, matrix in zip(
        graph.i, graph.j, rows.tolist(), graph.information, strict=True
    ):
        if d == 2:
            value = {"type": "Pose2"} | dict(zip(("x", "y", "theta"), numbers, strict=True))
        else:
            *xyz, w = numbers[3:]
            value = {"type": "Pose3", "translation": numbers[:3], "rotation": [w, *xyz]}
        C = np.linalg.inv(matrix)
        C = (0.5 * (C + C.T))[np.ix_(order, order)]
        entry: dict[str, object] = {"covariance": C.reshape(k * k).tolist()}
        if i == graph.world:
            entry |= {"type": f"PriorFactorPose{d}", "key": int(j), "prior": value}
        else:
            entry |= {"type": f"BetweenFactorPose{d}", "measurement": value}
            entry |= {"key1": int(i), "key2": int(j)}
        measurements.append(entry)
    log = {"name": "log", "robots": ["a"], "measurements": {"a": [{"measurements": measurements}]}}
    path.write_text(json.dumps(log))
