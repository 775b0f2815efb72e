import json
from dataclasses import replace

import numpy as np
import pytest

import pgo_models as pgo
import solvers
from pgo_models import read_kitti
from pgo_models.errors import SettingError
from pgo_models.figures import rounded_up
from pgo_models.graphs.pose_graph import isotropic_information


@pytest.fixture(scope="module")
def solution():
    return solvers.solve(pgo.circle(np.random.default_rng(0)))


def test_it_prints_cost_bound_gap_and_verdict(solution):
    text = str(solution)
    for part in (
        "circle: 25 poses, 300 edges, 3D",
        solution.certificate.cost_text,
        solution.certificate.bound_text,
    ):
        assert part in text
    assert "CERTIFIED: globally optimal within the gap asked for" in text
    assert repr(solution).startswith("Solution('circle', F=")


def test_it_says_what_the_information_of_the_file_would_cost(solution):
    from dataclasses import replace

    graph = solution.problem.graph
    assert "chi2" not in str(solution)
    assert solution.as_json()["chi2"] is None
    isotropic = replace(graph, information=isotropic_information(graph.kappa, graph.tau, 3))
    same = replace(solution, problem=pgo.PGOProblem(isotropic))
    assert "chi2" not in str(same)  # it is F
    assert same.as_json()["chi2"] == pytest.approx(solution.objective, rel=1e-12)
    twice = replace(
        solution, problem=pgo.PGOProblem(replace(graph, information=2.0 * isotropic.information))
    )
    chi2 = rounded_up(pgo.chi2(twice.problem.graph, solution.poses))
    expected = f"chi2         {chi2} with the file's information matrices"
    assert f"{expected}; the bound is on F alone" in str(twice)
    assert twice.as_json()["chi2"] == pytest.approx(2 * solution.objective, rel=1e-12)


def test_a_solved_graph_reads_back_with_the_same_cost(solution, tmp_path):
    solution.save(tmp_path / "solved.g2o")
    graph = pgo.read_g2o(tmp_path / "solved.g2o")
    np.testing.assert_allclose(
        pgo.PGOProblem(graph).objective(graph.initial), solution.objective, rtol=1e-12, atol=0
    )


def test_trajectories_read_back(solution, tmp_path):
    for suffix, read in ((".tum", pgo.read_tum), (".kitti", read_kitti)):
        solution.save(tmp_path / f"poses{suffix}")
        poses = read(tmp_path / f"poses{suffix}")
        np.testing.assert_allclose(poses.t, solution.poses.t, rtol=0, atol=1e-12)
        np.testing.assert_allclose(poses.R, solution.poses.R, rtol=0, atol=1e-12)


def test_json_holds_the_figures_and_the_poses(solution, tmp_path):
    solution.save(tmp_path / "solution.json")
    record = json.loads((tmp_path / "solution.json").read_text())
    assert record["objective"] == solution.objective
    assert record["lower_bound"] == solution.lower_bound
    assert record["verdict"] == "CERTIFIED"
    assert record["stages"][-1]["name"] == "Newton"
    np.testing.assert_array_equal(record["R"], solution.poses.R)
    assert record["ids"] == list(range(25))


def test_an_unknown_suffix_is_refused_and_nothing_is_written(solution, tmp_path):
    with pytest.raises(SettingError, match=r"no format has suffix '\.xyz'"):
        solution.save(tmp_path / "solution.xyz")
    assert list(tmp_path.iterdir()) == []


def test_an_unwritable_place_is_one_error(solution, tmp_path):
    with pytest.raises(pgo.PGOError, match="cannot write"):
        solution.save(tmp_path / "no" / "folder" / "solution.json")


def test_the_uncertified_solution_of_an_impossible_graph_saves_too(tmp_path):
    from pgo_models import NoiseModel

    graph = pgo.random_geometric(12, np.random.default_rng(5), noise=NoiseModel(1.0, 2.5))
    solution = solvers.solve(graph, solvers.Pipeline(handedness=None))  # they would certify it
    assert not solution.is_certified
    solution.save(tmp_path / "solution.json")
    record = json.loads((tmp_path / "solution.json").read_text())
    assert record["verdict"] in ("NOT_CERTIFIED", "TRIVIAL")
    assert record["lower_bound"] <= record["objective"]


def test_its_marginals_are_of_poses_it_names_beside_its_anchor(solution):
    blocks = solution.marginals()
    joint = solution.marginals(3, 19)
    assert (blocks.shape, joint.shape) == ((25, 6, 6), (12, 12))
    for one, place in ((3, 0), (19, 6)):
        own = joint[place : place + 6, place : place + 6]
        np.testing.assert_allclose(own, blocks[one], rtol=0, atol=1e-10 * np.abs(blocks).max())
    assert np.flatnonzero(~blocks.any(axis=(1, 2))).tolist() == [solution.anchor] == [0]
    assert np.flatnonzero(~solution.marginals(anchor=4).any(axis=(1, 2))).tolist() == [4]
    assert solvers.solve(solution.problem, anchor=9).anchor == 9
    with pytest.raises(SettingError, match="there is no pose 25; give one of 0 to 24"):
        solution.marginals(25)


@pytest.mark.parametrize("robots", [None, 3])
@pytest.mark.parametrize("away", [1e6, 1e12, 1e15])
def test_what_is_certified_are_the_poses_that_are_returned_however_far_their_frame(away, robots):
    graph = pgo.grid_world(2, 15, np.random.default_rng(0), d=2)
    far = replace(graph, initial=graph.truth.moved(np.eye(2), np.array([away, -away])), truth=None)
    near, found = (solvers.solve(one, robots=robots) for one in (graph, far))
    F = pgo.PGOProblem(far).objective(found.poses)
    assert found.certificate.objective == found.objective == F
    assert found.gap == pytest.approx((F - near.lower_bound) / F, rel=1e-6, abs=1e-12)
    assert found.is_certified == (found.gap <= 1e-6)
    assert away < 1e15 or not found.is_certified
