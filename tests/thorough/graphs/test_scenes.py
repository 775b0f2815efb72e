import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from pgo_models import NoiseModel, PoseGraph, Poses, circle, grid, log_map, random_geometric, sphere
from pgo_models.errors import SettingError
from pgo_models.graphs.scenes import observe

SEEDS = st.integers(0, 2**32 - 1)
DIMENSIONS = st.sampled_from([2, 3])
SCENES = json.loads((Path(__file__).parents[3] / "data" / "reference.json").read_text())["scenes"]
NETWORKS = [circle, grid, sphere]
Scene = Callable[[np.random.Generator], PoseGraph]


def errors(graph: PoseGraph) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Noise of t_ij and R_ij (tangent), and of t and R of the initial guess."""
    truth = graph.truth
    initial = graph.initial
    assert truth is not None
    assert initial is not None
    R_inverse = np.swapaxes(truth.R[graph.i], 1, 2)
    t = graph.t_ij - np.einsum("mab,mb->ma", R_inverse, truth.t[graph.j] - truth.t[graph.i])
    R = log_map(graph.R_ij @ np.swapaxes(R_inverse @ truth.R[graph.j], 1, 2))
    return t, R, initial.t - truth.t, log_map(np.swapaxes(truth.R, 1, 2) @ initial.R)


@pytest.mark.parametrize("scene", NETWORKS)
@given(seed=SEEDS)
def test_networks_are_those_of_the_reference(scene: Scene, seed: int) -> None:
    graph = scene(np.random.default_rng(seed))
    expected = SCENES[graph.name]
    assert (graph.num_poses, graph.num_edges, graph.d) == (expected["poses"], expected["edges"], 3)
    assert graph.is_connected
    assert (graph.kappa == SCENES["weights"]["kappa"]).all()
    assert (graph.tau == SCENES["weights"]["tau"]).all()
    edges = set(zip(graph.i.tolist(), graph.j.tolist(), strict=True))
    assert len(edges) == graph.num_edges
    assert {(j, i) for i, j in edges} == edges
    assert graph.truth is not None
    distance = np.linalg.norm(graph.truth.t[:, None] - graph.truth.t, axis=2)
    linked = np.zeros(distance.shape, dtype=bool)
    linked[graph.i, graph.j] = True
    slack = 1e-9
    assert (distance[linked] <= expected["comm_radius"] + slack).all()
    apart = (
        ~linked
        & ~np.eye(graph.num_poses, dtype=bool)
        & (distance <= expected["comm_radius"] + slack)
    )
    left_out = {(0, 12), (12, 0)} if graph.name == "sphere" else set()
    assert set(zip(*(index.tolist() for index in np.nonzero(apart)), strict=True)) == left_out


@pytest.mark.parametrize("scene", NETWORKS)
def test_the_same_seed_gives_the_same_bits(scene: Scene) -> None:
    a, b, other = (scene(np.random.default_rng(seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(a.R_ij, b.R_ij)
    np.testing.assert_array_equal(a.t_ij, b.t_ij)
    assert np.abs(a.t_ij - other.t_ij).min() > 0


@pytest.mark.parametrize("d", [2, 3])
def test_noise_has_its_standard_deviations(d: int) -> None:
    noise = NoiseModel(translation_std=0.2, rotation_std=0.1)
    graph = random_geometric(2000, np.random.default_rng(0), d=d, noise=noise)
    t, R, t_initial, R_initial = errors(graph)
    for values, std in ((t, 0.2), (R, 0.1), (t_initial, 0.2), (R_initial, 0.1)):
        # The standard deviation of an estimated standard deviation is std / sqrt(2 size); five of
        # them.
        assert values.std() == pytest.approx(std, rel=5 / np.sqrt(2 * values.size))
        assert abs(values.mean()) < 5 * std / np.sqrt(values.size)
    assert (graph.tau == noise.tau).all()
    assert (graph.kappa == noise.kappa(d)).all()


@pytest.mark.parametrize("value", [0.0, -1.0, np.inf, np.nan])
def test_noise_must_be_positive(value: float) -> None:
    with pytest.raises(SettingError, match="translation_std must be positive"):
        NoiseModel(translation_std=value)
    with pytest.raises(SettingError, match="rotation_std must be positive"):
        NoiseModel(rotation_std=value)


@given(seed=SEEDS, n=st.integers(2, 60), d=DIMENSIONS, mean_degree=st.sampled_from([0.1, 2.0, 8.0]))
def test_random_geometric_is_connected_and_links_the_close(
    seed: int, n: int, d: int, mean_degree: float
) -> None:
    graph = random_geometric(n, np.random.default_rng(seed), d=d, mean_degree=mean_degree)
    assert graph.is_connected
    assert (graph.num_poses, graph.d) == (n, d)
    assert (graph.i < graph.j).all()
    assert len(set(zip(graph.i.tolist(), graph.j.tolist(), strict=True))) == graph.num_edges
    assert graph.truth is not None
    distance = np.linalg.norm(graph.truth.t[:, None] - graph.truth.t, axis=2)
    radius = (mean_degree / (np.pi if d == 2 else 4 * np.pi / 3)) ** (1 / d)
    linked = np.zeros((n, n), dtype=bool)
    linked[graph.i, graph.j] = True
    assert linked[np.triu(distance <= radius, 1)].all()


@pytest.mark.parametrize(
    ("num_poses", "d", "mean_degree", "message"),
    [(1, 3, 6.0, "at least 2, got 1"), (5, 4, 6.0, "2 or 3, got 4"), (5, 3, 0.0, "mean_degree")],
)
def test_random_geometric_settings_are_checked(
    num_poses: int, d: int, mean_degree: float, message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        random_geometric(num_poses, np.random.default_rng(0), d=d, mean_degree=mean_degree)


@given(seed=SEEDS, d=DIMENSIONS)
def test_without_noise_measurements_are_relative_poses(seed: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_geometric(8, rng, d=d).truth
    assert isinstance(truth, Poses)
    i = np.array([0, 3, 5])
    j = np.array([1, 2, 0])
    graph = observe("exact", truth, i, j, NoiseModel(1e-300, 1e-300), 2.0, 3.0, rng)
    # x_j = x_i (R_ij, t_ij)
    np.testing.assert_allclose(truth.R[i] @ graph.R_ij, truth.R[j], rtol=0, atol=1e-14)
    moved = np.einsum("mab,mb->ma", truth.R[i], graph.t_ij) + truth.t[i]
    np.testing.assert_allclose(moved, truth.t[j], rtol=0, atol=1e-14)
