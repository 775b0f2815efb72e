"""Pairwise consistency: by hand, as often as chance has it, and what it finds in spoiled graphs."""

from dataclasses import replace

import numpy as np
import pytest
from graphs import informed

import pgo_models as pgo
from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, exp_map, random_rotations
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import edge_precisions, proper_information
from pgo_models.graphs.scenes import NoiseModel
from solvers.robust.consistency import odometry, pairwise_consistent


def relative(poses: Poses, i: Array, j: Array) -> Poses:
    back = np.swapaxes(poses.R[i], 1, 2)
    return Poses(back @ poses.R[j], np.einsum("mab,mb->ma", back, poses.t[j] - poses.t[i]))


def noisy(rng: np.random.Generator, truth: Poses, i: Array, j: Array, information: Array, robot: Array) -> PoseGraph:
    """Measurements whose errors are as the information matrices say, in the frame of the measured end pose."""
    exact, d = relative(truth, i, j), truth.d
    r = np.linalg.solve(
        np.swapaxes(np.linalg.cholesky(information), 1, 2), rng.standard_normal(information.shape[:2])[..., None]
    )[..., 0]
    t_ij = exact.t + np.einsum("mab,mb->ma", exact.R, r[:, :d])
    weights = edge_precisions(information)
    return PoseGraph(
        truth.num_poses, i, j, exact.R @ exp_map(r[:, d:]), t_ij, *weights, information=information, robot=robot
    )


def wandering(rng: np.random.Generator, n: int, d: int) -> Poses:
    return Poses(random_rotations(n, d, rng), rng.uniform(-3.0, 3.0, (n, d)))


def in_the_plane(ends: list[tuple[int, int]], shifts: list[tuple[float, float]], num_robots: int = 2) -> PoseGraph:
    """Robots that go ten steps along x, all beginning at the origin, with loop closures off by shifts."""
    n = 10 * num_robots
    truth = Poses(np.tile(np.eye(2), (n, 1, 1)), np.stack([np.arange(n) % 10, np.zeros(n)], axis=1))
    steps = np.flatnonzero(np.arange(n) % 10 < 9)
    i, j = (np.concatenate([steps + k, np.array(ends)[:, k]]) for k in (0, 1))
    measured = relative(truth, i, j)
    t_ij = measured.t + np.concatenate([np.zeros((len(steps), 2)), shifts])
    ones = np.full(len(i), 1e4)
    return PoseGraph(n, i, j, measured.R, t_ij, ones, ones, robot=np.arange(n) // 10)


def test_of_two_sets_that_agree_the_larger_is_kept() -> None:
    right = [(0, 10), (4, 15), (17, 9)]
    graph = in_the_plane([*right, (2, 13), (6, 17)], [(0, 0)] * 3 + [(3, 3)] * 2)
    kept = pairwise_consistent(graph)
    assert kept[:18].all()
    assert kept[18:].tolist() == [True] * 3 + [False] * 2
    fooled = in_the_plane([*right, (2, 13), (6, 17), (1, 12), (5, 16)], [(0, 0)] * 3 + [(3, 3)] * 4)
    assert pairwise_consistent(fooled)[18:].tolist() == [False] * 3 + [True] * 4  # what it cannot know


def test_groups_are_pairs_of_robots_and_a_robot_with_itself_is_held_to_its_odometry() -> None:
    ends = [(0, 10), (4, 15), (12, 22), (13, 25), (3, 27), (2, 8), (9, 1)]
    shifts = [(0, 0), (0, 0), (2, 0), (2, 0), (5, 5), (0, 0), (0, 1)]
    graph = in_the_plane(ends, shifts, num_robots=3)
    # The wrong ones of robots 1 and 2 agree, and that of 0 and 2 is alone; that of robot 0 the odometry contradicts.
    assert pairwise_consistent(graph)[27:].tolist() == [True] * 6 + [False]
    known = odometry(graph)
    known[-1] = True
    assert pairwise_consistent(graph, known).all()
    missing = graph.without_edges(np.arange(graph.num_edges) == 4)  # robot 0 in two pieces: two that disagree, not one
    assert pairwise_consistent(missing)[26:-2].all()
    assert pairwise_consistent(missing)[-2:].sum() == 1


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("own", [False, True])
def test_right_loop_closures_agree_as_often_as_the_quantile_says(d: int, own: bool) -> None:
    rng, kept = np.random.default_rng(d), []
    for _ in range(400):
        n = 12
        steps = np.array([k for k in range(n - 1) if own or k != n // 2 - 1])
        back = rng.random(len(steps)) < 0.5
        loops = [(2, 9)] if own else [(1, 10), (8, 4)]
        i = np.concatenate([np.where(back, steps + 1, steps), [a for a, _ in loops]])
        j = np.concatenate([np.where(back, steps, steps + 1), [b for _, b in loops]])
        information = 1e6 * proper_information(informed(int(rng.integers(2**31)), 20, d, True))
        robot = None if own else np.arange(n) // (n // 2)
        graph = noisy(rng, wandering(rng, n, d), i, j, information[: len(i)], robot)
        kept.append(pairwise_consistent(graph, quantile=0.7)[len(steps) :].all())
    assert np.mean(kept) == pytest.approx(0.7, abs=4.0 * np.sqrt(0.21 / 400))


def spoiled(graph: PoseGraph, share: float, run: int, seed: int) -> tuple[PoseGraph, np.ndarray]:
    """A graph with more loop closures, at random or in runs that agree with each other, and which are wrong."""
    rng, chain = np.random.default_rng(seed), pgo.odometry_start(replace(graph, robot=None))
    loops = np.flatnonzero(np.abs(graph.i - graph.j) != 1)
    starts = rng.integers(0, graph.num_poses - run, (round(share / (1 - share) * len(loops) / run), 2))
    starts = starts[np.abs(starts[:, 0] - starts[:, 1]) > 2 * run]
    i, j = (np.repeat(starts[:, k], run) + np.tile(np.arange(run), len(starts)) for k in (0, 1))
    first_i, first_j = np.repeat(starts.T, run, axis=1)
    R = np.repeat(random_rotations(len(starts), graph.d, rng), run, axis=0)
    t = np.repeat(rng.uniform(-3.0, 3.0, (len(starts), graph.d)), run, axis=0)
    to, along = relative(chain, i, first_i), relative(chain, first_j, j)
    t = to.t + np.einsum("mab,mb->ma", to.R, t + np.einsum("mab,mb->ma", R, along.t))
    more = graph.with_edges(i, j, Poses(to.R @ R @ along.R, t), np.median(graph.kappa), np.median(graph.tau))
    return more, np.arange(more.num_edges) >= graph.num_edges


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
def test_what_it_finds_in_spoiled_graphs(name, run, robots, precision, recall, benchmark_problem) -> None:
    graph, is_wrong = spoiled(benchmark_problem(name).graph, 0.5, run, 0)
    if robots > 1:
        graph = graph.with_robots(np.arange(graph.num_poses) * robots // graph.num_poses)
    rejected = ~pairwise_consistent(graph)
    both = (rejected & is_wrong).sum()
    assert both >= precision * rejected.sum()
    assert both >= recall * is_wrong.sum()


def test_right_ones_of_a_scene_are_kept_and_wrong_ones_go() -> None:
    scene = pgo.grid_world(3, 30, np.random.default_rng(0), d=3, noise=NoiseModel(0.01, 0.005))
    clean = pairwise_consistent(scene, quantile=1.0 - 1e-6)
    assert clean.all()
    rng = np.random.default_rng(1)
    i, j = np.arange(0, 30, 3), np.arange(60, 90, 3)
    wrong = Poses(random_rotations(10, 3, rng), rng.uniform(-3.0, 3.0, (10, 3)))
    kept = pairwise_consistent(scene.with_edges(i, j, wrong, scene.kappa[0], scene.tau[0]), quantile=1.0 - 1e-6)
    assert kept[: scene.num_edges].all()
    assert not kept[scene.num_edges :].any()


def test_what_measures_no_whole_motion_is_not_tested() -> None:
    graph = in_the_plane([(0, 10), (4, 15)], [(0, 0), (0, 0)])
    graph = graph.with_landmark(np.array([1, 12]), np.array([[50.0, 0.0], [0.0, 70.0]]), 1e4)
    graph = graph.with_position_prior(np.arange(3), np.full((3, 2), 99.0), 1e4)
    assert pairwise_consistent(graph).all()


@pytest.mark.parametrize("quantile", [0.0, 1.0, np.nan])
def test_a_quantile_is_a_probability(quantile: float) -> None:
    with pytest.raises(SettingError, match="between 0 and 1"):
        pairwise_consistent(in_the_plane([(0, 10)], [(0, 0)]), quantile=quantile)
