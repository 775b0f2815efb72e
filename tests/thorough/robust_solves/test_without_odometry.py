"""Wrong edges where no chain of edges can be trusted: rigs, view graphs and scans."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from wrong_edges import noisy_sphere

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel, PGOProblem, PoseGraph, Weighting
from solvers import GNC, Known
from solvers.robust.rejection import Support

CASES = Path(__file__).parents[2] / "cases"


def rejected_lines(name: str, solution: solvers.Solution) -> list[int]:
    """Lines of a file, from 1, whose edges were rejected."""
    text = (CASES / f"{name}.g2o").read_text().splitlines()
    lines = [number for number, line in enumerate(text, start=1) if line.startswith("EDGE")]
    assert solution.robust is not None
    return np.array(lines)[solution.robust.rejected].tolist()


@pytest.mark.parametrize(
    ("name", "wrong", "cost"),
    [
        ("p1_camera_board_rig_57", [1, 35, 42, 54], 324.47),
        ("b2_tls_all_uncertain", [15, 29, 31], 92.352),
        ("g1_rotation_averaging_outliers", [19, 21, 25, 26, 29, 31, 33], 101.640),
    ],
)
def test_the_wrong_edges_of_reported_graphs_are_found(
    name: str, wrong: list[int], cost: float
) -> None:
    graph = pgo.read_g2o(CASES / f"{name}.g2o")
    weighting = Weighting.ROTATIONS if name.startswith("g1") else Weighting.ISOTROPIC
    solution = solvers.solve(PGOProblem(graph, weighting=weighting), robust=GNC())
    assert rejected_lines(name, solution) == wrong
    assert solution.robust.cost <= cost + 0.01
    assert solution.is_certified


def test_a_pose_that_hangs_on_one_edge_is_doubted() -> None:
    graph = pgo.read_g2o(CASES / "p1_camera_board_rig_57.g2o")
    of_board = np.flatnonzero(graph.j == graph.num_poses - 1)
    left_out = np.isin(np.arange(graph.num_edges), of_board[:-1])
    solution = solvers.solve(graph.without_edges(left_out), robust=GNC())
    assert solution.robust.bridges.sum() == 1
    assert solution.robust.standing is Support.DOUBTFUL


def spread(graph: PoseGraph, step: int) -> PoseGraph:
    """The graph with ids in steps."""
    return replace(graph, ids=step * np.arange(graph.num_poses))


def known_edges(graph: PoseGraph, known: Known = Known.AUTO) -> np.ndarray:
    """Edges that graduated non-convexity takes for right."""
    return np.isinf(GNC(known=known).thresholds(PGOProblem(graph)))


@pytest.mark.parametrize("step", [2, 10])
def test_ids_in_steps_are_odometry_as_long_as_edges_join_them(step: int) -> None:
    graph = pgo.grid_world(1, 30, np.random.default_rng(0), d=2)
    chain = graph.j == graph.i + 1
    np.testing.assert_array_equal(known_edges(graph), chain)
    np.testing.assert_array_equal(known_edges(spread(graph, step)), chain)
    middle = np.flatnonzero(chain & (graph.i == 15))
    left_out = np.isin(np.arange(graph.num_edges), middle)
    broken = graph.without_edges(left_out)
    np.testing.assert_array_equal(known_edges(broken), chain[~left_out])
    assert not known_edges(spread(broken, step)).any()


def test_edges_between_some_consecutive_poses_are_no_odometry() -> None:
    graph = pgo.read_g2o(CASES / "p1_camera_board_rig_57.g2o")
    assert not known_edges(graph).any()
    assert not known_edges(graph, Known.ODOMETRY).any()
    in_steps = noisy_sphere(50, 10, NoiseModel(0.01, 0.01), seed=0)
    left_out = (in_steps.j == in_steps.i + 1) & (in_steps.i % 5 == 0)
    some = in_steps.without_edges(left_out)
    assert known_edges(in_steps).any()
    assert not known_edges(some).any()
    assert known_edges(some, Known.ODOMETRY).any()


def test_what_is_asked_for_is_known_and_the_answer_says_why() -> None:
    graph = pgo.read_g2o(CASES / "b2_tls_all_uncertain.g2o")
    chain = graph.j == graph.i + 1
    for known, expected in ((Known.ODOMETRY, chain), (Known.NONE, np.zeros_like(chain))):
        robust = solvers.solve(graph, robust=GNC(known=known)).robust
        np.testing.assert_array_equal(robust.known, expected)
        assert "asked for" in dict(robust.facts())["taken for right"]
    by_itself = solvers.solve(graph, robust=GNC()).robust
    assert not by_itself.known[by_itself.rejected].any()
    assert "cycles contradict 1 of 9" in dict(by_itself.facts())["taken for right"]
