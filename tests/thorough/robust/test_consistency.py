"""Pairwise consistency: by hand, as often as chance predicts, and in graphs with wrong edges."""

from dataclasses import replace

import numpy as np
import pytest
from graphs import informed

import pgo_models as pgo
from pgo_models import NoiseModel, PoseGraph, Poses, exp_map, random_rotations
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.precisions import edge_precisions, proper_information
from solvers.robust.consistency import pairwise_consistent
from solvers.robust.known import odometry


def relative(poses: Poses, i: Array, j: Array) -> Poses:
    """Motions x_i^-1 x_j."""
    back = np.swapaxes(poses.R[i], 1, 2)
    t = rotated(back, poses.t[j] - poses.t[i])
    return Poses(back @ poses.R[j], t)


def rotated(R: Array, v: Array) -> Array:
    return np.einsum("mab,mb->ma", R, v)


def noisy(
    rng: np.random.Generator, truth: Poses, i: Array, j: Array, information: Array, robot: Array
) -> PoseGraph:
    """Measurements with errors as the matrices claim, in the frame of the measured end pose."""
    exact = relative(truth, i, j)
    d = truth.d
    root = np.swapaxes(np.linalg.cholesky(information), 1, 2)
    standard = rng.standard_normal(information.shape[:2])
    r = np.linalg.solve(root, standard[..., None])[..., 0]
    t_ij = exact.t + rotated(exact.R, r[:, :d])
    weights = edge_precisions(information)
    return PoseGraph(
        truth.num_poses,
        i,
        j,
        exact.R @ exp_map(r[:, d:]),
        t_ij,
        *weights,
        information=information,
        robot=robot,
    )


def wandering(rng: np.random.Generator, n: int, d: int) -> Poses:
    R = random_rotations(n, d, rng)
    t = rng.uniform(-3.0, 3.0, (n, d))
    return Poses(R, t)


def in_the_plane(
    ends: list[tuple[int, int]], shifts: list[tuple[float, float]], num_robots: int = 2
) -> PoseGraph:
    """Robots that go ten steps along x from the origin, with loop closures off by `shifts`."""
    n = 10 * num_robots
    pose = np.arange(n)
    t = np.stack([pose % 10, np.zeros(n)], axis=1)
    truth = Poses(np.tile(np.eye(2), (n, 1, 1)), t)
    steps = np.flatnonzero(pose % 10 < 9)
    first, second = np.array(ends).T
    i = np.concatenate([steps, first])
    j = np.concatenate([steps + 1, second])
    measured = relative(truth, i, j)
    errors = np.concatenate([np.zeros((len(steps), 2)), shifts])
    precision = np.full(len(i), 1e4)
    return PoseGraph(
        n, i, j, measured.R, measured.t + errors, precision, precision, robot=pose // 10
    )


def test_of_two_sets_that_agree_the_larger_is_kept() -> None:
    right = [(0, 10), (4, 15), (17, 9)]
    two_wrong = [(2, 13), (6, 17)]
    graph = in_the_plane([*right, *two_wrong], [(0, 0)] * 3 + [(3, 3)] * 2)
    kept = pairwise_consistent(graph)
    assert kept[:18].all()
    assert kept[18:].tolist() == [True] * 3 + [False] * 2
    # With four wrong ones that agree the test cannot know better.
    four_wrong = [*two_wrong, (1, 12), (5, 16)]
    graph = in_the_plane([*right, *four_wrong], [(0, 0)] * 3 + [(3, 3)] * 4)
    kept = pairwise_consistent(graph)
    assert kept[18:].tolist() == [False] * 3 + [True] * 4


def test_groups_are_pairs_of_robots_and_a_robot_with_itself_is_held_to_its_odometry() -> None:
    shift_of = {
        (0, 10): (0, 0),
        (4, 15): (0, 0),
        (12, 22): (2, 0),
        (13, 25): (2, 0),
        (3, 27): (5, 5),
        (2, 8): (0, 0),
        (9, 1): (0, 1),
    }
    graph = in_the_plane(list(shift_of), list(shift_of.values()), num_robots=3)
    # The wrong ones between robots 1 and 2 agree with each other, the one between robots 0 and 2
    # is alone, and the odometry contradicts the one of robot 0.
    assert pairwise_consistent(graph)[27:].tolist() == [True] * 6 + [False]
    known = odometry(graph)
    known[-1] = True
    assert pairwise_consistent(graph, known).all()
    # Without an edge of its odometry robot 0 has two chains, and the two closures between them
    # disagree.
    missing = graph.without_edges(np.arange(graph.num_edges) == 4)
    assert pairwise_consistent(missing)[26:-2].all()
    assert pairwise_consistent(missing)[-2:].sum() == 1


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("own", [False, True])
def test_right_loop_closures_agree_as_often_as_the_quantile_says(d: int, own: bool) -> None:
    rng = np.random.default_rng(d)
    num_trials = 400
    are_kept = []
    n = 12
    steps = np.array([k for k in range(n - 1) if own or k != n // 2 - 1])
    closures = np.array([(2, 9)] if own else [(1, 10), (8, 4)])
    robot = None if own else np.arange(n) // (n // 2)
    for _ in range(num_trials):
        is_backward = rng.random(len(steps)) < 0.5
        first = np.where(is_backward, steps + 1, steps)
        second = np.where(is_backward, steps, steps + 1)
        i = np.concatenate([first, closures[:, 0]])
        j = np.concatenate([second, closures[:, 1]])
        seed = int(rng.integers(2**31))
        information = 1e6 * proper_information(informed(seed, 20, d, True))
        truth = wandering(rng, n, d)
        graph = noisy(rng, truth, i, j, information[: len(i)], robot)
        kept = pairwise_consistent(graph, quantile=0.7)
        are_kept.append(kept[len(steps) :].all())
    standard_deviation = np.sqrt(0.7 * 0.3 / num_trials)
    assert np.mean(are_kept) == pytest.approx(0.7, abs=4.0 * standard_deviation)


def spoiled(graph: PoseGraph, share: float, run: int, seed: int) -> tuple[PoseGraph, np.ndarray]:
    """A graph with wrong loop closures, in runs that agree with each other, and which these are.

    Each run begins with a random motion, and its others are what odometry makes of it.
    """
    rng = np.random.default_rng(seed)
    chain = pgo.odometry_start(replace(graph, robot=None))
    num_closures = int((np.abs(graph.i - graph.j) != 1).sum())
    num_runs = round(share / (1 - share) * num_closures / run)
    starts = rng.integers(0, graph.num_poses - run, (num_runs, 2))
    distance = np.abs(starts[:, 0] - starts[:, 1])
    starts = starts[distance > 2 * run]
    first_i, first_j = np.repeat(starts.T, run, axis=1)
    step = np.tile(np.arange(run), len(starts))
    i = first_i + step
    j = first_j + step
    first_motions = wandering(rng, len(starts), graph.d)
    R = np.repeat(first_motions.R, run, axis=0)
    t = np.repeat(first_motions.t, run, axis=0)
    to_first = relative(chain, i, first_i)
    along = relative(chain, first_j, j)
    t = t + rotated(R, along.t)
    t = to_first.t + rotated(to_first.R, t)
    motions = Poses(to_first.R @ R @ along.R, t)
    kappa = np.median(graph.kappa)
    tau = np.median(graph.tau)
    spoiled_graph = graph.with_edges(i, j, motions, kappa, tau)
    return spoiled_graph, np.arange(spoiled_graph.num_edges) >= graph.num_edges


@pytest.mark.parametrize(
    ("name", "run", "robots", "precision", "recall"),
    [
        ("CSAIL", 1, 1, 0.98, 0.98),
        ("CSAIL", 1, 5, 0.9, 0.8),
        ("CSAIL", 10, 1, 0.9, 0.9),
        ("smallGrid3D", 1, 1, 0.9, 0.85),
        ("smallGrid3D", 1, 5, 0.9, 0.75),
    ],
)
def test_what_it_finds_in_spoiled_graphs(
    name, run, robots, precision, recall, benchmark_problem
) -> None:
    graph, is_wrong = spoiled(benchmark_problem(name).graph, 0.5, run, 0)
    if robots > 1:
        robot = np.arange(graph.num_poses) * robots // graph.num_poses
        graph = graph.with_robots(robot)
    rejected = ~pairwise_consistent(graph)
    num_right_rejections = (rejected & is_wrong).sum()
    assert num_right_rejections >= precision * rejected.sum()
    assert num_right_rejections >= recall * is_wrong.sum()


def test_right_ones_of_a_scene_are_kept_and_wrong_ones_go() -> None:
    noise = NoiseModel(0.01, 0.005)
    scene = pgo.grid_world(3, 30, np.random.default_rng(0), d=3, noise=noise)
    quantile = 1.0 - 1e-6
    assert pairwise_consistent(scene, quantile=quantile).all()
    rng = np.random.default_rng(1)
    i = np.arange(0, 30, 3)
    j = np.arange(60, 90, 3)
    wrong = wandering(rng, len(i), 3)
    graph = scene.with_edges(i, j, wrong, scene.kappa[0], scene.tau[0])
    kept = pairwise_consistent(graph, quantile=quantile)
    assert kept[: scene.num_edges].all()
    assert not kept[scene.num_edges :].any()


def test_what_measures_no_whole_motion_is_not_tested() -> None:
    graph = in_the_plane([(0, 10), (4, 15)], [(0, 0), (0, 0)])
    sightings = np.array([[50.0, 0.0], [0.0, 70.0]])
    graph = graph.with_landmark(np.array([1, 12]), sightings, 1e4)
    positions = np.full((3, 2), 99.0)
    graph = graph.with_position_prior(np.arange(3), positions, 1e4)
    assert pairwise_consistent(graph).all()


@pytest.mark.parametrize("quantile", [0.0, 1.0, np.nan])
def test_a_quantile_is_a_probability(quantile: float) -> None:
    with pytest.raises(SettingError, match="between 0 and 1"):
        pairwise_consistent(in_the_plane([(0, 10)], [(0, 0)]), quantile=quantile)
