"""Far priors are seen from a point among them: the same cost to the last bit, or not moved."""

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, varied_graph
from hypothesis import given, strategies as st

import pgo_models as pgo

UTM = np.array([691234.5, 5572094.1, 312.7])


def with_gps(seed: int, n: int, d: int, offset: np.ndarray) -> tuple[pgo.PoseGraph, np.ndarray]:
    """A graph with GPS on all poses, in millimetres, whose frame is so far away; the positions."""
    graph = varied_graph(seed, n, d)
    noise = 0.1 * np.random.default_rng(seed).standard_normal((n, d))
    positions = np.round(graph.truth.t + noise + offset[:d], 3)
    return graph.with_position_prior(np.arange(n), positions, 4.0), positions


@given(seed=SEEDS, d=DIMENSIONS, size=st.floats(1e3, 1e8))
def test_every_position_is_moved_without_rounding(seed, d, size):
    direction = np.random.default_rng(seed).uniform(-1.0, 1.0, d)
    graph, positions = with_gps(seed, 6, d, size * direction)
    for before, after in zip(positions, graph.t_ij[graph.is_prior], strict=True):
        for p, q, o in zip(before, after, graph.origin, strict=True):
            assert Fraction(p) - Fraction(o) == Fraction(q)
    # Changed copies keep the point, and positions that are added are seen from it.
    more = graph.with_position_prior(np.arange(1), positions[:1], 4.0)
    np.testing.assert_array_equal(more.origin, graph.origin)
    np.testing.assert_allclose(more.t_ij[-1] + more.origin, positions[0], rtol=1e-15, atol=0)


@pytest.mark.parametrize("word", ["5334875.97", "5334875.9699999997", "5334875.970000000000001"])
def test_decimals_of_a_file_are_moved_exactly_and_rounded_once(word: str, tmp_path: Path):
    lines = [f"EDGE_SE2 {k} {k + 1} 1 0 0.1 100 0 0 100 0 100" for k in range(3)]
    lines += [f"EDGE_PRIOR_SE2_XY {k} 68901{k}.123 {word} 100 0 100" for k in range(4)]
    path = tmp_path / "gps.g2o"
    path.write_text("\n".join(lines))
    graph = pgo.read_g2o(path)
    exactly = [
        [Fraction(f"68901{k}.123") - Fraction(graph.origin[0]), Fraction(word)] for k in range(4)
    ]
    expected = [[float(x), float(y - Fraction(graph.origin[1]))] for x, y in exactly]
    np.testing.assert_array_equal(graph.t_ij[graph.is_prior], expected)
    # What is written is the same graph again, digit for digit.
    pgo.write_g2o(graph, path)
    again = pgo.read_g2o(path)
    np.testing.assert_array_equal(again.t_ij, graph.t_ij)
    np.testing.assert_array_equal(again.origin, graph.origin)


def test_an_axis_is_far_only_where_it_is_and_where_all_can_be_moved_exactly():
    near, _ = with_gps(0, 8, 2, np.zeros(3))
    np.testing.assert_array_equal(near.origin, 0.0)
    graph, _ = with_gps(0, 8, 3, UTM * [1.0, 1.0, 0.0] + [0.0, 0.0, 3.0])
    assert graph.origin[2] == 0.0
    np.testing.assert_allclose(graph.origin[:2], UTM[:2], rtol=0, atol=20.0)
    _, positions = with_gps(0, 9, 2, UTM)
    plain = varied_graph(0, 9, 2)
    positions[3, 0] = 0.1
    origin = plain.with_position_prior(np.arange(9), positions, 4.0).origin
    assert origin[0] == 0.0
    assert origin[1] != 0.0
    # A few fixes at zero are wrong, and leave the point among the others.
    positions[3, 0] = 691234.0
    positions[:3] = 0.0
    origin = plain.with_position_prior(np.arange(9), positions, 4.0).origin
    np.testing.assert_allclose(origin, UTM[:2], rtol=0, atol=20.0)


@pytest.mark.parametrize("huge", [1e200, 1.7e308])
def test_numbers_near_the_largest_have_no_point_or_an_exact_one(huge):
    positions = np.array([[huge, -huge], [-huge, huge], [huge, huge], [huge, 1.0]])
    graph = varied_graph(0, 4, 2).with_position_prior(np.arange(4), positions, 4.0)
    assert np.isfinite(graph.origin).all()


def test_poses_without_the_world_pose_are_in_the_frame_of_the_file():
    graph, _ = with_gps(1, 6, 3, UTM)
    bodies = graph.bodies
    far = pgo.Poses(graph.truth.R[bodies], graph.truth.t[bodies] + UTM)
    graph = replace(graph, initial=far, truth=None)
    np.testing.assert_array_equal(graph.initial.t, far.t)
    completed = graph.completed(graph.initial)
    np.testing.assert_array_equal(completed.t[graph.world], graph.origin)
    near = graph.near_zero(graph.initial)
    np.testing.assert_array_equal(near.t + graph.origin, completed.t)
    np.testing.assert_array_equal(graph.in_frame_of_priors(near).t, completed.t)
    problem = pgo.PGOProblem(graph)
    assert problem.objective(near) == pytest.approx(problem.objective(graph.initial), rel=1e-9)


@pytest.mark.parametrize("d", [2, 3])
def test_poses_with_the_world_pose_of_the_priors_as_given_are_the_same_poses(d: int):
    near, _ = with_gps(1, 6, d, np.zeros(3))
    t_ij = near.t_ij + np.where(near.is_prior[:, None], UTM[:d], 0.0)
    poses = near.completed(near.truth)
    t = poses.t.copy()
    t[near.in_files] += UTM[:d]
    given = poses.with_translations(t)
    far = replace(near, t_ij=t_ij, truth=given, initial=given, origin=None)
    assert far.origin.any()
    expected = pgo.PGOProblem(near).objective(poses)
    for kept in (far.truth, far.initial):
        assert pgo.PGOProblem(far).objective(kept) == pytest.approx(expected, rel=1e-6)
