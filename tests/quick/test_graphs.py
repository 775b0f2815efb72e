"""Pose graphs: files that are read and written, generated scenes, partitions, bad input."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, informed, varied_graph
from hypothesis import given, strategies as st

import pgo_models as pgo
import solvers

DATA = Path(__file__).parents[2] / "data"
IDENTITY_3D = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"


@given(seed=SEEDS, n=st.integers(2, 12), d=DIMENSIONS, coupled=st.booleans())
def test_what_is_written_is_read_again(seed, n, d, coupled, tmp_path_factory):
    graph = informed(seed, n, d, coupled)
    path = tmp_path_factory.mktemp("written") / "graph.g2o"
    pgo.write_g2o(graph, path)
    again = pgo.read_g2o(path)
    np.testing.assert_array_equal(again.i, graph.i)
    np.testing.assert_array_equal(again.j, graph.j)
    # A rotation is written as a unit quaternion, from and to which a dozen operations round.
    np.testing.assert_allclose(again.R_ij, graph.R_ij, rtol=0, atol=16 * np.finfo(float).eps)
    np.testing.assert_array_equal(again.t_ij, graph.t_ij)
    np.testing.assert_array_equal(again.information, graph.information)


@given(seed=SEEDS)
def test_isotropic_precisions_are_those_of_se_sync(seed, tmp_path_factory):
    graph = informed(seed, 5, 3, coupled=False)
    path = tmp_path_factory.mktemp("precisions") / "graph.g2o"
    pgo.write_g2o(graph, path)
    again = pgo.read_g2o(path)
    tau = 3.0 / np.trace(np.linalg.inv(graph.information[:, :3, :3]), axis1=1, axis2=2)
    kappa = 1.5 / np.trace(np.linalg.inv(graph.information[:, 3:, 3:]), axis1=1, axis2=2)
    np.testing.assert_allclose(again.tau, tau, rtol=1e-9)
    np.testing.assert_allclose(again.kappa, kappa, rtol=1e-9)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["EDGE_SE2 0 1 1 0 x 1 0 0 1 0 1"], r"bad.g2o:1: .*'x'"),
        (["EDGE_SE2 0 1 1 0 0 1 0 0 1 0"], r"bad.g2o:1: "),
        (["EDGE_SE2 0 1 1 0 0 1 0 0 1 0 nan"], r"bad.g2o:1: "),
        (["EDGE_SE2 0 0 1 0 0 1 0 0 1 0 1"], r"bad.g2o:1: "),
        (["EDGE_SE2 0 1 1 0 0 -1 0 0 1 0 1"], r"bad.g2o:1: "),
        (["EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 0 " + IDENTITY_3D], r"bad.g2o:1: "),
        (["NO_SUCH_TAG 1 2 3"], r"bad.g2o:1: unknown tag 'NO_SUCH_TAG'"),
        (
            ["EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1", "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 " + IDENTITY_3D],
            r"bad.g2o:2: ",
        ),
        ([], "bad.g2o"),
    ],
)
def test_a_bad_line_is_named_by_file_and_number(lines, message, tmp_path):
    (tmp_path / "bad.g2o").write_text("\n".join(lines) + "\n")
    with pytest.raises(pgo.PGOError, match=message) as caught:
        pgo.read_g2o(tmp_path / "bad.g2o")
    assert "\n" not in str(caught.value)


def test_a_graph_in_two_components_is_refused_with_the_way_out(tmp_path):
    lines = ["EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1", "EDGE_SE2 2 3 1 0 0 1 0 0 1 0 1"]
    (tmp_path / "two.g2o").write_text("\n".join(lines) + "\n")
    with pytest.raises(pgo.PGOError, match="2 components"):
        pgo.PGOProblem(pgo.read_g2o(tmp_path / "two.g2o"))


@pytest.mark.parametrize("name", ["circle", "grid", "sphere"])
def test_bundled_graphs_load_by_name_and_have_their_truth(name):
    graph = pgo.load(name)
    assert graph.truth is not None
    assert graph.num_poses == graph.truth.num_poses
    assert pgo.chi2(graph, graph.truth) > 0.0


def test_an_unknown_name_suggests_one_that_exists():
    with pytest.raises(pgo.PGOError, match="sphere"):
        pgo.load("spere")


@pytest.mark.parametrize(
    "make", [pgo.circle, pgo.grid, pgo.sphere, lambda seed: pgo.grid_world(2, 20, seed)]
)
def test_scenes_repeat_with_their_seed_and_differ_without(make):
    first, again, other = make(3), make(3), make(4)
    np.testing.assert_array_equal(first.t_ij, again.t_ij)
    assert not np.array_equal(first.t_ij, other.t_ij)
    assert first.is_connected


@given(seed=SEEDS, n=st.integers(4, 20), num_robots=st.integers(1, 4))
def test_a_partition_gives_every_pose_to_one_robot(seed, n, num_robots):
    graph = varied_graph(seed, n, 2)
    robots = pgo.partition(graph, num_robots)
    assert robots.num_robots == num_robots
    assert robots.sizes.sum() == n
    assert (robots.sizes > 0).all()
    cut = robots.robot[graph.i] != robots.robot[graph.j]
    np.testing.assert_array_equal(robots.cut_edges(graph), cut)
    ends = np.union1d(graph.i[cut], graph.j[cut])
    np.testing.assert_array_equal(robots.separators(graph), ends)


def test_trajectories_of_tum_keep_poses(tmp_path):
    poses = pgo.sphere(0).truth
    pgo.write_tum(poses, tmp_path / "poses.tum")
    again = pgo.read_tum(tmp_path / "poses.tum")
    np.testing.assert_allclose(again.R, poses.R, rtol=0, atol=1e-8)
    np.testing.assert_allclose(again.t, poses.t, rtol=0, atol=1e-8)


def test_priors_landmarks_and_fixed_poses_are_part_of_a_graph():
    graph = pgo.grid_world(1, 12, 0, d=2)
    located = graph.with_position_prior([3, 7], [[1.0, 2.0], [3.0, 2.0]], 100.0)
    assert located.num_edges == graph.num_edges + 2
    assert located.is_prior.sum() == 2
    assert solvers.solve(located).is_certified


def test_reading_says_what_it_assumed_once(tmp_path):
    text = "\n".join(f"EDGE_SE2 {k} {k + 1} 1 0 0 1 0 0 1 0 1" for k in range(5))
    (tmp_path / "chain.g2o").write_text(text)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        graph = pgo.read_g2o(tmp_path / "chain.g2o")
    assert graph.num_poses == 6
    assert len(said) <= 1


def test_edges_are_removed_and_added_by_value():
    graph = pgo.grid(0)
    mask = np.arange(graph.num_edges) == 5
    smaller = graph.without_edges(mask)
    assert smaller.num_edges == graph.num_edges - 1
    assert graph.num_edges == pgo.grid(0).num_edges
    assert replace(graph, name="other").name == "other"
