"""Landmarks, priors and positions count the same whatever the order of their edges."""

import numpy as np
import pytest

import pgo_models as pgo
import solvers
from pgo_models import Poses, chi2, chi2_thresholds, spanning_tree_start, victoria_park
from pgo_models.errors import GraphError, SettingError

ODOMETRY = "EDGE_SE2 {} {} 1 0 0.5 100 0 0 100 0 400"
SIGHT = "EDGE_SE2_XY {} 1{} {} 25 0 25"
PRIOR = "EDGE_PRIOR_XY 1{} {} 25 0 25"


def survey(tmp_path, priors_first):
    poses = [(np.zeros(2), 0.0)]
    for _ in range(3):
        t, angle = poses[-1]
        poses.append((t + np.array([np.cos(angle), np.sin(angle)]), angle + 0.5))
    known = np.array([[0.0, 3.0], [4.0, 1.0], [2.0, -3.0]])
    sights = []
    priors = [PRIOR.format(k, f"{x!r} {y!r}") for k, (x, y) in enumerate(known.tolist())]
    for i, (t, angle) in enumerate(poses):
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        sights += [
            SIGHT.format(i, k, " ".join(map(repr, (turn @ (x - t)).tolist())))
            for k, x in enumerate(known)
        ]
    lines = [ODOMETRY.format(i, i + 1) for i in range(3)]
    lines += priors + sights if priors_first else sights + priors
    path = tmp_path / f"survey{priors_first}.g2o"
    path.write_text("\n".join(lines) + "\n")
    return pgo.read_g2o(path)


@pytest.mark.parametrize("priors_first", [False, True])
def test_known_landmarks_fix_the_frame_in_any_order_of_the_lines(tmp_path, priors_first):
    graph = survey(tmp_path, priors_first)
    assert graph.is_world_loose
    assert not graph.is_prior[graph.first_sights].any()
    solution = solvers.solve(graph)
    assert solution.certificate.verdict.name == "EXACT"
    np.testing.assert_allclose(solution.poses.t[1], [1.0, 0.0], atol=1e-9)
    with pytest.raises(SettingError, match="root is the world"):
        spanning_tree_start(graph, graph.world)


def test_a_position_costs_the_same_by_every_convention():
    graph = victoria_park(np.random.default_rng(0), num_poses=40)
    points = graph.without_edges(~np.isin(graph.j, graph.landmarks))
    poses = graph.truth.moved(pgo.exp_map(np.array([[0.3]]))[0], np.ones(2))
    chordal, *others = (chi2(points, poses, convention) for convention in pgo.Chi2Convention)
    assert others == pytest.approx([chordal] * len(others), rel=1e-9)


def test_the_first_sight_of_a_landmark_has_two_degrees_of_freedom_too():
    graph = victoria_park(np.random.default_rng(0), num_poses=40)
    problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.INFORMATION)
    sights = np.isin(graph.j, graph.landmarks)
    np.testing.assert_allclose(chi2_thresholds(problem)[sights], 9.2103, atol=1e-3)


@pytest.mark.parametrize("at", [0.1, 0.5, 1e6])
def test_positions_in_one_point_leave_turns_open_wherever_it_is(at):
    graph = pgo.circle(np.random.default_rng(0)).subgraph(np.arange(12))
    fixed = graph.with_position_prior(np.arange(3), np.full((3, graph.d), at), 1.0)
    free = pgo.PGOProblem(fixed).graph.free
    assert "the turn of the map about the point of its fixes is free" in free


def test_what_is_no_part_of_a_graph_is_refused():
    graph = pgo.load("grid")
    for poses in ([-1, 0, 1], [0, 99], []):
        with pytest.raises(GraphError, match=r"poses of a subgraph are some of 0 \.\. 26"):
            graph.subgraph(np.array(poses, dtype=np.int64))
    with pytest.raises(GraphError, match="one truth value for each of 108 edges"):
        graph.without_edges(np.zeros(3, dtype=bool))
    with pytest.raises(GraphError, match="one measured pose for every edge"):
        graph.with_edges(np.array([0]), np.array([2]), Poses.identity(2, 3), 1.0, 1.0)
    with pytest.raises(SettingError, match=r"method must be .* got 'contigous'; did you mean"):
        pgo.partition(graph, 3, "contigous")
    with pytest.raises(SettingError, match=r"backend must be .* got 'CHOL'"):
        pgo.PGOProblem(graph, "CHOL")


def test_metis_takes_graphs_in_several_parts():
    graph = pgo.load("grid")
    apart = graph.without_edges((graph.i < 9) != (graph.j < 9))
    assert pgo.partition(apart, 9, pgo.PartitionMethod.METIS).num_robots == 9
