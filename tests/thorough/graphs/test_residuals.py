from dataclasses import replace

import numpy as np
import pytest
from graphs import REFERENCE, random_poses
from hypothesis import given, strategies as st
from scipy.linalg import logm
from scipy.spatial.transform import Rotation

import pgo_models as pgo
from pgo_models import Chi2Convention, chi2
from pgo_models.errors import GraphError, SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import isotropic_information
from pgo_models.graphs.residuals import uncertain_edges


@given(st.integers(0, 2**32 - 1), st.sampled_from([2, 3]))
def test_costs_are_the_summands_of_F(seed, d):
    graph = pgo.random_geometric(8, np.random.default_rng(seed), d=d)
    poses = random_poses(8, d, seed)
    problem = pgo.PGOProblem(graph)
    cost = pgo.edge_residuals(graph, poses).cost
    np.testing.assert_allclose(cost, problem.edge_costs(poses), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(cost.sum(), problem.objective(poses), rtol=1e-9, atol=0)


@pytest.mark.parametrize("d", [2, 3])
def test_an_edge_off_by_a_known_motion_has_that_residual(d):
    rng = np.random.default_rng(1)
    pose = random_poses(2, d, 1)
    angle = 0.3
    shift = rng.standard_normal(d)
    turn = pgo.exp_map(np.array([[angle]]) if d == 2 else np.array([[0.0, angle, 0.0]]))[0]
    R_ij = pose.R[0].T @ pose.R[1] @ turn
    t_ij = pose.R[0].T @ (pose.t[1] - pose.t[0]) + shift
    graph = pgo.PoseGraph(2, [0], [1], R_ij[None], t_ij[None], [2.0], [5.0])
    residuals = pgo.edge_residuals(graph, pose)
    np.testing.assert_allclose(residuals.translation, np.linalg.norm(shift), rtol=1e-12, atol=0)
    np.testing.assert_allclose(residuals.rotation, angle, rtol=1e-9, atol=0)


def test_residuals_do_not_see_the_gauge():
    graph = pgo.circle(np.random.default_rng(0))
    moved = graph.truth.moved(
        pgo.random_rotations(1, 3, np.random.default_rng(2))[0], np.array([1.0, -2.0, 3.0])
    )
    ours = pgo.edge_residuals(graph, graph.truth)
    theirs = pgo.edge_residuals(graph, moved)
    for name in ("translation", "rotation", "cost"):
        np.testing.assert_allclose(
            getattr(theirs, name), getattr(ours, name), rtol=1e-9, atol=1e-12
        )


@pytest.mark.parametrize("weak", ["kappa", "tau"])
def test_an_edge_is_uncertain_by_either_precision(weak):
    graph = pgo.circle(np.random.default_rng(0))
    kappa = graph.kappa.copy()
    tau = graph.tau.copy()
    {"kappa": kappa, "tau": tau}[weak][[3, 8]] *= 0.05
    assert np.flatnonzero(uncertain_edges(graph.with_weights(kappa, tau))).tolist() == [3, 8]
    assert not uncertain_edges(graph).any()


@pytest.mark.parametrize("weak", ["kappa", "tau"])
def test_an_uncertain_precision_is_under_a_tenth_of_the_median(weak):
    graph = pgo.circle(np.random.default_rng(0)).unit_weights()
    values = np.ones(graph.num_edges)
    values[:2] = 0.1, 0.0999
    weights = {"kappa": graph.kappa, "tau": graph.tau, weak: values}
    assert np.flatnonzero(uncertain_edges(graph.with_weights(**weights))).tolist() == [1]


def test_poses_of_another_graph_are_refused():
    with pytest.raises(GraphError, match="one pose for every pose"):
        pgo.edge_residuals(pgo.circle(np.random.default_rng(0)), pgo.Poses.identity(3, 3))


# chi2 with the file's information.


def one_edge(
    d: int, turn: Array, shift: Array, information: Array
) -> tuple[pgo.PoseGraph, pgo.Poses]:
    """Edge whose second pose is off by a rotation and a shift, in the frame of the measured end."""
    pose = random_poses(2, d, 1)
    E = pgo.exp_map(turn[None])[0]
    R_ij = pose.R[0].T @ pose.R[1] @ E.T
    t_ij = pose.R[0].T @ (pose.t[1] - pose.t[0]) - R_ij @ shift
    graph = pgo.PoseGraph(
        2, [0], [1], R_ij[None], t_ij[None], [1.0], [1.0], information=information[None]
    )
    return graph, pose


def random_information(k: int, rng: np.random.Generator) -> Array:
    A = rng.standard_normal((k, k))
    return A @ A.T + np.eye(k)


def test_chi2_in_the_plane_by_hand():
    rng = np.random.default_rng(0)
    info = random_information(3, rng)
    r = np.array([0.3, -0.2])
    theta = 0.7
    graph, pose = one_edge(2, np.array([theta]), r, info)
    residual = np.append(r, theta)
    for convention in (Chi2Convention.GEODESIC, Chi2Convention.G2O):
        assert chi2(graph, pose, convention) == pytest.approx(residual @ info @ residual, rel=1e-12)
    chordal = (
        r @ info[:2, :2] @ r
        + 2 * (r @ info[:2, 2]) * np.sin(theta)
        + 2 * (1 - np.cos(theta)) * info[2, 2]
    )
    assert chi2(graph, pose) == pytest.approx(chordal, rel=1e-12)
    V = np.array([[np.sin(theta), np.cos(theta) - 1], [1 - np.cos(theta), np.sin(theta)]]) / theta
    logarithm = np.append(np.linalg.solve(V, r), theta)
    assert chi2(graph, pose, Chi2Convention.GTSAM) == pytest.approx(
        logarithm @ info @ logarithm, rel=1e-12
    )


def test_chi2_in_space_by_hand():
    rng = np.random.default_rng(1)
    info = random_information(6, rng)
    r = rng.standard_normal(3)
    w = np.array([0.4, -0.8, 0.5])
    graph, pose = one_edge(3, w, r, info)
    theta = np.linalg.norm(w)
    a = w / theta
    for convention, turned in (
        (Chi2Convention.GEODESIC, w),
        (Chi2Convention.G2O, Rotation.from_rotvec(w).as_quat(canonical=True)[:3]),
    ):
        residual = np.concatenate([r, turned])
        assert chi2(graph, pose, convention) == pytest.approx(residual @ info @ residual, rel=1e-12)
    twice = 2 * (1 - np.cos(theta)) * (a @ info[3:, 3:] @ a)
    chordal = r @ info[:3, :3] @ r + 2 * r @ info[:3, 3:] @ a * np.sin(theta) + twice
    assert chi2(graph, pose) == pytest.approx(chordal, rel=1e-12)
    # 2 (1 - cos theta) a^T I_rr a is tr(W (2 I - E - E^T)), quadratic in the rotations, with W =
    # tr(I_rr) / 2 I - I_rr.
    W = 0.5 * np.trace(info[3:, 3:]) * np.eye(3) - info[3:, 3:]
    E = pgo.exp_map(w[None])[0]
    assert twice == pytest.approx(np.trace(W @ (2 * np.eye(3) - E - E.T)), rel=1e-12)
    twist = np.zeros((4, 4))
    twist[:3, :3] = pgo.exp_map(w[None])[0]
    twist[:3, 3] = r
    twist[3, 3] = 1.0
    logarithm = np.real(logm(twist))
    residual = np.concatenate([logarithm[:3, 3], w])
    assert chi2(graph, pose, Chi2Convention.GTSAM) == pytest.approx(
        residual @ info @ residual, rel=1e-10
    )


@given(seed=st.integers(0, 2**32 - 1), d=st.sampled_from([2, 3]))
def test_the_chordal_chi2_is_below_the_geodesic_one_and_next_to_it_for_small_residuals(seed, d):
    rng = np.random.default_rng(seed)
    graph = pgo.random_geometric(6, rng, d=d)
    k = 3 * d - 3
    information = np.array([random_information(k, rng) for _ in range(graph.num_edges)])
    information[:, :d, d:] = 0.0
    information[:, d:, :d] = 0.0
    graph = replace(graph, information=information)
    far = random_poses(6, d, seed)
    assert chi2(graph, far) <= chi2(graph, far, Chi2Convention.GEODESIC) * (1 + 1e-12)
    values = [chi2(graph, graph.truth, convention) for convention in Chi2Convention]
    if d == 2:
        np.testing.assert_allclose(values, values[1], rtol=0.2)


def test_without_information_chi2_is_of_the_isotropic_one():
    for d in (2, 3):
        graph = pgo.random_geometric(6, np.random.default_rng(0), d=d)
        isotropic = replace(graph, information=isotropic_information(graph.kappa, graph.tau, d))
        for convention in Chi2Convention:
            assert chi2(graph, graph.truth, convention) == chi2(isotropic, graph.truth, convention)


@pytest.mark.parametrize("name", ["intel", "CSAIL", "MIT", "FR079"])
def test_chi2_at_the_optimum_of_F_is_the_measured_one(name, benchmark_data, benchmark_optimum):
    graph = pgo.read_g2o(benchmark_data / f"{name}.g2o")
    information = graph.information.copy()
    # the reference leaves out what couples the blocks
    information[:, :2, 2] = 0.0
    information[:, 2, :2] = 0.0
    found = chi2(replace(graph, information=information), benchmark_optimum(name))
    assert found == pytest.approx(REFERENCE["full_information_optimum"][name][0], rel=1e-5)


def test_chi2_refuses_other_poses_and_conventions():
    graph = pgo.circle(np.random.default_rng(0))
    with pytest.raises(GraphError, match="give one pose for every pose of the graph"):
        chi2(graph, random_poses(3, 3, 0))
    with pytest.raises(SettingError, match=r"convention must be Chi2Convention\.CHORDAL or "):
        chi2(graph, graph.truth, "ceres")
