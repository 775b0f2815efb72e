import importlib.util
from pathlib import Path

import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, SEEDS, exact_graph, random_poses, varied_graph, varied_problem
from hypothesis import given, settings, strategies as st
from scipy.sparse import csc_array

from pgo_models import PGOError, PGOProblem, PoseGraph, Poses, chordal_start, log_map, multipliers
from pgo_models.errors import NotPositiveDefiniteError, SettingError
from pgo_models.geometry.rotations import Array, hat
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian
from pgo_models.problem.marginals import Marginals, write_covariances
from solvers import polish

needs_gtsam = pytest.mark.skipif(
    importlib.util.find_spec("gtsam") is None, reason="GTSAM is an optional rival"
)
BACKENDS = st.sampled_from(CholeskyBackend)
SIZES = st.integers(2, 30)


def marginals_at(
    problem: PGOProblem, poses: Poses, anchor: int = 0, backend: CholeskyBackend | None = None
) -> Marginals:
    hessian = riemannian_hessian(problem.at(poses), multipliers(problem, poses))
    return Marginals(hessian, TangentLayout(problem.num_poses, problem.d), anchor, backend)


def dense_covariance(marginals: Marginals) -> Array:
    """All of the inverse, (n, p, n, p), the anchor's part zero."""
    layout = marginals.layout
    n = marginals.layout.num_poses
    every = np.arange(n)
    columns = np.concatenate([layout.translations(every), layout.rotations(every)], axis=1)
    free = np.delete(columns, marginals.anchor, axis=0).ravel()
    whole = np.zeros((layout.side, layout.side))
    whole[np.ix_(free, free)] = np.linalg.inv(0.5 * marginals.hessian.toarray()[np.ix_(free, free)])
    return whole[columns.ravel()][:, columns.ravel()].reshape(
        n, layout.side // n, n, layout.side // n
    )


def in_body_axes(blocks: Array, poses: Poses) -> Array:
    """Blocks (n, p, p) of moves (R_i^T v_i, w_i)."""
    axes = np.tile(np.eye(blocks.shape[1]), (len(blocks), 1, 1))
    axes[:, : poses.d, : poses.d] = np.swapaxes(poses.R, 1, 2)
    return axes @ blocks @ np.swapaxes(axes, 1, 2)


def cross(t: Array) -> Array:
    """K, (d, 1 or 3), with K w the cross product of t and w."""
    return hat(t[None])[0] if len(t) == 3 else np.array([[t[1]], [-t[0]]])


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, backend=BACKENDS)
def test_blocks_and_joints_are_those_of_the_dense_inverse(
    seed: int, n: int, d: int, backend: CholeskyBackend
) -> None:
    problem = varied_problem(seed, n, d)
    rng = np.random.default_rng(seed)
    anchor = int(rng.integers(n))
    marginals = marginals_at(problem, polish(problem, chordal_start(problem)), anchor, backend)
    dense = dense_covariance(marginals)
    allowed = 1e-8 * np.abs(dense).max()
    p = 3 * d - 3
    every = np.arange(n)
    picked = rng.integers(0, n, int(rng.integers(1, 5))).tolist()
    joint = dense[picked][:, :, picked].reshape(p * len(picked), -1)
    i, j = rng.integers(0, n, (2, 5))
    pairs = [dense[[a, b]][:, :, [a, b]].reshape(2 * p, -1) for a, b in zip(i, j, strict=True)]
    for _ in range(2):  # before and after the factor is used up
        np.testing.assert_allclose(marginals.joint(*picked), joint, rtol=0, atol=allowed)
        np.testing.assert_allclose(marginals.joint_of_pairs(i, j), pairs, rtol=0, atol=allowed)
        np.testing.assert_allclose(marginals.diagonal, dense[every, :, every], rtol=0, atol=allowed)
    assert not marginals.diagonal[anchor].any()
    assert not marginals.joint(anchor).any()


@given(seed=SEEDS, d=DIMENSIONS)
def test_one_edge_says_what_the_precisions_mean(seed: int, d: int) -> None:
    graph = exact_graph(seed, 2, d)
    graph = PoseGraph(
        2, graph.i[:1], graph.j[:1], graph.R_ij[:1], graph.t_ij[:1], graph.kappa[:1], graph.tau[:1]
    )
    problem = PGOProblem(graph)
    poses = chordal_start(problem)
    # The measuring pose is held: what it measures is the other's place and turn.
    found = marginals_at(problem, poses, anchor=int(graph.i[0])).diagonal[graph.j[0]]
    expected = np.diag([*[1.0 / graph.tau[0]] * d, *[0.5 / graph.kappa[0]] * (2 * d - 3)])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * expected.max())


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_two_poses_know_as_much_of_each_other(seed: int, n: int, d: int) -> None:
    # The move of b beside a is minus that of a beside b, carried over by the adjoint of T_b^-1 T_a.
    problem = varied_problem(seed, n, d)
    poses = polish(problem, chordal_start(problem))
    a, b = np.random.default_rng(seed).choice(n, 2, replace=False).tolist()
    beside_a = in_body_axes(marginals_at(problem, poses, a).diagonal, poses)[b]
    beside_b = in_body_axes(marginals_at(problem, poses, b).diagonal, poses)[a]
    R = poses.R[a].T @ poses.R[b]
    t = poses.R[a].T @ (poses.t[b] - poses.t[a])
    turn = R.T if d == 3 else np.eye(1)
    adjoint = np.block([[R.T, -R.T @ cross(t)], [np.zeros((2 * d - 3, d)), turn]])
    expected = adjoint @ beside_b @ adjoint.T
    np.testing.assert_allclose(beside_a, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["sphere2500", "city10000"])
def test_public_graphs(name, benchmark_problem, benchmark_optimum) -> None:
    marginals = marginals_at(benchmark_problem(name), benchmark_optimum(name))
    p = marginals.diagonal.shape[1]
    picked = [1, 700, marginals.layout.num_poses - 1]
    scale = np.abs(marginals.diagonal).max()
    for pose in picked:
        np.testing.assert_allclose(
            marginals.diagonal[pose], marginals.joint(pose), rtol=0, atol=1e-8 * scale
        )
    assert np.linalg.eigvalsh(marginals.joint(*picked))[0] > 0.0
    assert (np.linalg.eigvalsh(np.delete(marginals.diagonal, 0, axis=0))[:, 0] > 0.0).all()
    assert marginals.joint(*picked).shape == (3 * p, 3 * p)


def test_poses_that_are_none_are_named() -> None:
    problem = varied_problem(0, 5, 2)
    poses = polish(problem, chordal_start(problem))
    with pytest.raises(SettingError, match="there is no pose 5; give one of 0 to 4"):
        _ = marginals_at(problem, poses, anchor=5).diagonal
    with pytest.raises(SettingError, match="there is no pose -1"):
        marginals_at(problem, poses).joint(2, -1)


@pytest.mark.parametrize("backend", CholeskyBackend)
def test_away_from_a_minimum_there_are_none(backend: CholeskyBackend) -> None:
    problem = varied_problem(0, 12, 3)
    marginals = marginals_at(problem, random_poses(12, 3, 0), backend=backend)
    for ask in (lambda: marginals.diagonal, lambda: marginals.joint(1)):
        with pytest.raises(
            NotPositiveDefiniteError,
            match="at no strict minimum; solve to the end first, or polish",
        ):
            ask()


@pytest.mark.parametrize("d", [2, 3])
def test_the_table_reads_back(d: int, tmp_path: Path) -> None:
    problem = varied_problem(0, 6, d)
    blocks = marginals_at(problem, polish(problem, chordal_start(problem))).diagonal
    ids = np.arange(6) + 2**60
    path = tmp_path / "covariances.csv"
    write_covariances(blocks, ids, path)
    head, *lines = path.read_text().splitlines()
    heads = head.split(",")
    assert heads[:3] == ["id", "x*x (m m)", "x*y (m m)"]
    assert heads[-1] == ("theta*theta (rad rad)" if d == 2 else "rz*rz (rad rad)")
    rows, columns = np.triu_indices(3 * d - 3)
    for one, line, block in zip(ids.tolist(), lines, blocks, strict=True):
        first, *rest = line.split(",")
        assert int(first) == one
        assert list(map(float, rest)) == block[rows, columns].tolist()
    with pytest.raises(PGOError, match="cannot write"):
        write_covariances(blocks, ids, tmp_path / "nowhere" / "covariances.csv")


def gtsam_marginals(problem: PGOProblem, poses: Poses) -> tuple[Array, Array, csc_array]:
    """GTSAM's covariances of poses at its linearisation, pose 0 held, in our order and axes.

    With them come the joint one of (0, 1) and its Hessian.
    """
    import gtsam

    from solvers.baselines.gtsam import factor_graph

    n = problem.num_poses
    d = problem.d
    p = 3 * problem.d - 3
    values = gtsam.Values()
    for key, (R, t) in enumerate(zip(poses.R, poses.t, strict=True)):
        angle = 0.0 if d == 3 else float(log_map(R[None])[0, 0])
        values.insert(key, gtsam.Pose3(gtsam.Rot3(R), t) if d == 3 else gtsam.Pose2(*t, angle))
    factors = factor_graph(problem)
    factors.remove(factors.size() - 1)  # the prior, which is not of the problem
    information = factors.linearize(values).hessian()[0]
    prior, at = (
        (gtsam.PriorFactorPose3, values.atPose3(0))
        if d == 3
        else (gtsam.PriorFactorPose2, values.atPose2(0))
    )
    factors.add(prior(0, at, gtsam.noiseModel.Isotropic.Sigma(p, 1e-8)))
    found = gtsam.Marginals(factors, values)
    order = np.r_[3:6, 0:3] if d == 3 else np.arange(3)  # its Pose3 turns first
    blocks = np.stack([found.marginalCovariance(key)[np.ix_(order, order)] for key in range(n)])
    axes = np.tile(np.eye(p), (n, 1, 1))
    axes[:, :d, :d] = poses.R
    # Moves (v, w) of ours, field by field, in terms of its own.
    layout = TangentLayout(n, d)
    every = np.arange(n)
    ours = np.concatenate([layout.translations(every), layout.rotations(every)], axis=1)
    into = np.zeros((n * p, n * p))
    for k in range(n):
        into[np.ix_(p * k + order, ours[k])] = axes[k].T
    pair = found.jointMarginalCovariance(gtsam.KeyVector([n - 2, n - 1])) if n > 2 else None
    joint = np.zeros((2, p, 2, p))
    if pair is not None:
        for a, b in np.ndindex(2, 2):
            block = pair.at(n - 2 + a, n - 2 + b)[np.ix_(order, order)]
            joint[a, :, b] = axes[n - 2 + a] @ block @ axes[n - 2 + b].T
    # Its error is F where ours is twice a negative log-likelihood.
    return (
        2.0 * axes @ blocks @ np.swapaxes(axes, 1, 2),
        2.0 * joint.reshape(2 * p, 2 * p),
        csc_array(into.T @ information @ into),
    )


@needs_gtsam
@settings(max_examples=examples(20), deadline=None)
@given(seed=SEEDS, n=st.integers(3, 12), d=DIMENSIONS)
def test_they_are_gtsams_where_edges_fit(seed: int, n: int, d: int) -> None:
    problem = PGOProblem(exact_graph(seed, n, d))
    poses = problem.graph.truth
    marginals = marginals_at(problem, poses)
    blocks, joint, hessian = gtsam_marginals(problem, poses)
    np.testing.assert_allclose(
        hessian.toarray(), marginals.hessian.toarray(), rtol=0, atol=1e-8 * abs(hessian).max()
    )
    np.testing.assert_allclose(marginals.diagonal, blocks, rtol=0, atol=1e-8 * np.abs(blocks).max())
    np.testing.assert_allclose(
        marginals.joint(n - 2, n - 1), joint, rtol=0, atol=1e-8 * np.abs(joint).max()
    )


@needs_gtsam
@settings(max_examples=examples(20), deadline=None)
@given(seed=SEEDS, n=st.integers(3, 12), d=DIMENSIONS)
def test_they_are_gtsams_on_its_own_linearisation(seed: int, n: int, d: int) -> None:
    problem = PGOProblem(varied_graph(seed, n, d))
    blocks, joint, hessian = gtsam_marginals(problem, polish(problem, chordal_start(problem)))
    marginals = Marginals(hessian, TangentLayout(n, d))
    np.testing.assert_allclose(marginals.diagonal, blocks, rtol=0, atol=1e-8 * np.abs(blocks).max())
    np.testing.assert_allclose(
        marginals.joint(n - 2, n - 1), joint, rtol=0, atol=1e-8 * np.abs(joint).max()
    )
